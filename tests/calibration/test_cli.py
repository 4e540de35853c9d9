"""`build-lut` with existing tables: info, verify, match; and the output for an unfinished one."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.main import get_command

from calibration.cli import app, main
from calibration.sampling import WINDOW
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from tests.calibration.lab import LIGHTS
from tests.json_of import json_of

pytestmark = pytest.mark.slow


Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    def run(*arguments: object) -> tuple[int, str, str]:
        code = main([*map(str, arguments)])
        output = capsys.readouterr()
        return code, output.out, output.err

    return run


@pytest.fixture
def lut(built: BuildResult) -> Path:
    assert built.lut is not None
    return built.lut


def test_info_prints_table(lut: Path, command: Command) -> None:
    code, out, _ = command("info", lut)
    assert code == 0
    assert "Canon CroP Test" in out
    assert f"{len(LIGHTS)}: {len(LIGHTS) - 3} uniform, 3 black bodies 2500 to 6500 K" in out
    assert "512 (3 bits a channel), 25 samples each" in out
    assert "black, half size, saturation, field, rounding" in out


def test_check_reports_only_figures_of_one_frame(session: Session, command: Command) -> None:
    code, out, _ = command("check", session.folder)
    assert code == 0
    assert "remark: Frames" not in out
    assert "Movement of the chart" not in out
    assert "Drift of white" not in out
    assert "Detected tags" in out


def test_verify_accepts_intact_table(lut: Path, session: Session, command: Command) -> None:
    assert command("verify", lut)[0] == 0
    code, out, _ = command("verify", lut, session.folder)
    assert code == 0
    assert "the hashes of all files" in out


def test_verify_names_changed_light(lut: Path, session: Session, command: Command, tmp_path: Path) -> None:
    shutil.copytree(lut, tmp_path / "lut")
    shutil.copytree(session.folder, tmp_path / "session")
    path = tmp_path / "lut" / "samples.npy"
    data = bytearray(path.read_bytes())
    data[128 + 4 * 512 * 25 * 6] ^= 1
    path.write_bytes(data)
    next((tmp_path / "session" / "frames").glob("*light_003*")).unlink()
    code, out, err = command("verify", tmp_path / "lut", tmp_path / "session")
    assert code == 2
    assert f"the samples of 1 of {len(LIGHTS)} illuminants have changed: 4\n" in out
    assert "light_003.dng cannot be read" in out
    assert "2 faults" in err


def test_match_compares_two_tables(lut: Path, command: Command) -> None:
    code, out, _ = command("match", lut, lut)
    assert code == 0
    assert "colours and illuminants correspond" in out


def test_append_prints_progress(session: Session, command: Command, tmp_path: Path) -> None:
    shutil.copytree(session.folder, tmp_path / "session")
    last = next((tmp_path / "session" / "frames").glob("*light_012*"))
    with Session.open(tmp_path / "session") as copy:
        victim = next(record for record in copy.frames() if record.file.endswith(last.name))
    _refuse(tmp_path / "session", victim.file)
    code, out, _ = command("--append", tmp_path / "session", tmp_path / "lut")
    assert code == 0
    assert f"{len(LIGHTS) - 1} of {len(LIGHTS)} illuminants" in out
    assert command("info", tmp_path / "lut")[2].count("is not complete") == 1


def _refuse(folder: Path, file: str) -> None:
    import sqlite3
    from contextlib import closing

    with closing(sqlite3.connect(folder / "journal.sqlite")) as journal, journal:
        journal.execute("UPDATE attempts SET verdict='refused' WHERE file=?", (file,))
    # What the second place says would contradict the journal.
    (folder / "ledger.jsonl").unlink()


def test_builds_session_named_like_command(
    session: Session, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(session.folder, "check")
    assert command("--append", "./check", "lut")[0] == 0
    assert Path("lut/lut.json").is_file()


def test_default_window_is_five() -> None:
    (window,) = [option for option in get_command(app).params if "--window" in option.opts]
    assert window.default == WINDOW


def test_info_json_contains_entry(lut: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = json_of(main, ["info", lut], capsys)
    assert main(["info", str(lut), "--cite"]) == 0
    assert result["bibtex"] == capsys.readouterr().out
    assert result["sha256"] in result["bibtex"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--info", "lut"], "--info is a command, not an option: build-lut info"),
        (["-v", "--check", "session"], "build-lut check"),
        (["--window", 4, "session", "lut"], "4 px"),
        (["nowhere", "lut"], "nowhere is not a session"),
        (["info", "nowhere"], "nowhere is not a LUT"),
        (["compare", "a", "b"], "a is not a LUT"),
    ],
)
def test_refuses_meaningless_options(
    arguments: list[object], said: str, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = command(*arguments)
    assert code == 2
    assert said in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize("arguments", [["nowhere"], ["check", "nowhere", "lut"], ["lut", "--chart", "x"]])
def test_refuses_missing_or_extra_arguments(arguments: list[str], command: Command) -> None:
    assert command(*arguments)[0] == 2
