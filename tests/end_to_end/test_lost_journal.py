"""A journal that is deleted, replaced or cut during a run is noticed, and can be rebuilt from the ledger."""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import pytest

from acquisition.cli import main
from acquisition.monitor.view import LOOK_AGAIN_S, SessionWatch, read_session
from acquisition.run.pipeline import Taken
from acquisition.run.run import RunOutcome, take_session
from drivers.presenter import Colour
from experiment.lights import Illuminant
from experiment.session.folder import Session, rebuild_journal, session_exists
from experiment.session.journal import Journal, LostJournalError, Rows, ledger_path, read_ledger, rows_of, thread_beat
from experiment.session.opening import open_to_read
from experiment.session.records import ACCEPTED
from foundation.clock import SimulatedClock
from foundation.errors import FormatError, StorageError
from tests.acquisition.run.scripted import SETTINGS, Lab

pytestmark = pytest.mark.slow

LIGHTS = tuple(Illuminant(n, "uniform", None, Colour(255, 30 * n, 0)) for n in range(6))


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    return Lab(tmp_path / "session", lights=LIGHTS, reference_every=3)


def run(lab: Lab, after: int = 0, mishap: Callable[[Path], object] = lambda folder: None) -> RunOutcome:
    """Take the session; call `mishap` once after `after` judged frames."""
    judged = 0

    def observe(taken: Taken) -> None:
        nonlocal judged
        judged += 1
        if judged == after:
            mishap(lab.session.folder)

    return take_session(lab.session, lab.devices, SETTINGS, observe=observe)


def delete(folder: Path) -> None:
    (folder / "journal.sqlite").unlink()


def cut_half(folder: Path) -> None:
    path = folder / "journal.sqlite"
    os.truncate(path, path.stat().st_size // 2)


def empty(folder: Path) -> None:
    os.truncate(folder / "journal.sqlite", 0)


def replace_by_copy(folder: Path) -> None:
    copy = folder / "copy"
    shutil.copyfile(folder / "journal.sqlite", copy)
    copy.replace(folder / "journal.sqlite")


def overwrite(folder: Path) -> None:
    path = folder / "journal.sqlite"
    with path.open("r+b") as stream:
        stream.write(bytes(path.stat().st_size))


def overwrite_by_other(folder: Path) -> None:
    other = folder.parent / "other.sqlite"
    Journal.create(other, ())
    other.write_bytes(other.read_bytes().ljust((folder / "journal.sqlite").stat().st_size, b"\0"))
    with (folder / "journal.sqlite").open("r+b") as stream:
        stream.write(other.read_bytes())


def delete_log(folder: Path) -> None:
    (folder / "journal.sqlite-wal").unlink()


def cut_log(folder: Path) -> None:
    os.truncate(folder / "journal.sqlite-wal", 40)


def delete_both(folder: Path) -> None:
    ledger_path(folder).unlink()
    delete(folder)


MISHAPS = (delete_both, delete, cut_half, empty, replace_by_copy, overwrite, overwrite_by_other, delete_log, cut_log)


def facts(folder: Path) -> Rows:
    """Return the rows of the journal as readers see them."""
    with closing(open_to_read(folder / "journal.sqlite")) as connection:
        return rows_of(connection)


@pytest.mark.parametrize(
    ("mishap", "frame"),
    [*zip(MISHAPS, itertools.cycle((2, 7, 12)), strict=False), (delete, 12), (delete_log, 12)],
)
def test_lost_journal_ends_run_and_is_rebuilt(lab: Lab, mishap: Callable[[Path], object], frame: int) -> None:
    folder = lab.session.folder
    assert len(lab.session.steps) == 12, "the last case happens after the last frame"
    with pytest.raises(LostJournalError, match="acquire rebuild"):
        run(lab, frame, mishap)
    assert lab.camera.captures <= frame + 2, "noticed at the next frame"
    lab.session.close()
    ledger = read_ledger(ledger_path(folder))
    accepted = [row for row in ledger["attempts"].values() if row["verdict"] == ACCEPTED]
    assert len(accepted) >= frame
    assert all((folder / row["file"]).stat().st_size == row["size"] for row in accepted)
    # If the log is cut, SQLite cannot read the number of the event.
    assert mishap is cut_log or any(row["what"] == "ended" for row in ledger["events"].values())
    assert main(["rebuild", str(folder)]) == 0
    assert facts(folder) == ledger
    assert main(["status", str(folder)]) == 0
    assert read_session(folder).head(lab.clock.now()).done == len(accepted)
    lab.session = Session.open_for_run(folder)
    assert run(lab).complete
    assert {row["sha256"] for row in accepted} <= {frame.sha256 for frame in lab.session.frames() if frame.accepted}
    lab.session.close()


def test_ledger_equals_journal_after_every_end(lab: Lab) -> None:
    lab.camera.script |= {2: b"no raw file", 5: StorageError("lost")}
    with pytest.raises(StorageError):
        run(lab)
    lab.session.close()
    folder = lab.session.folder
    assert facts(folder) == read_ledger(ledger_path(folder))
    lab.session = Session.open_for_run(folder)
    lab.camera.script.clear()
    assert run(lab).complete
    lab.session.retake("1")
    lab.session.journal.record("camera", "one")
    lab.session.journal.record("camera", "another")
    lab.session.close()
    rows = facts(folder)
    assert rows == read_ledger(ledger_path(folder))
    (folder / "journal.sqlite").unlink()
    rebuild_journal(folder)
    assert facts(folder) == rows


def test_same_command_rebuilds_missing_journal(lab: Lab) -> None:
    run(lab)
    lab.session.close()
    folder = lab.session.folder
    rows, messages = facts(folder), list[str]()
    delete(folder)
    with pytest.raises(FormatError, match="acquire rebuild") as refused:
        Session.open(folder)
    assert "remove" not in str(refused.value)
    assert session_exists(folder)
    with Session.open_for_run(folder, announce=messages.append):
        assert facts(folder) == rows
    assert [sentence.split(":")[0] for sentence in messages] == ["journal"]


def test_refuses_old_session_without_journal(lab: Lab) -> None:
    lab.session.close()
    folder = lab.session.folder
    delete(folder)
    ledger_path(folder).unlink()
    with pytest.raises(FormatError) as refused:
        session_exists(folder)
    assert "remove" not in str(refused.value)


def test_refuses_and_keeps_older_journal(lab: Lab) -> None:
    folder = lab.session.folder
    lab.session.close()
    old_journal = (folder / "journal.sqlite").read_bytes()
    lab.session = Session.open_for_run(folder)
    run(lab)
    lab.session.close()
    ledger = read_ledger(ledger_path(folder))
    (folder / "journal.sqlite").write_bytes(old_journal)
    with pytest.raises(FormatError, match="lacks 12 frames"):
        Session.open_for_run(folder)
    assert main(["rebuild", str(folder)]) == 0
    assert facts(folder) == ledger
    assert (folder / "journal.sqlite.1.lost").is_file()


def test_rewrites_missing_ledger(lab: Lab) -> None:
    path = ledger_path(lab.session.folder)
    assert run(lab, 4, lambda folder: path.unlink()).complete
    lab.session.close()
    assert read_ledger(path) == facts(lab.session.folder)


def test_completes_ledger_cut_by_crash(lab: Lab) -> None:
    run(lab)
    lab.session.close()
    path = ledger_path(lab.session.folder)
    os.truncate(path, path.stat().st_size - 9)
    Session.open_for_run(lab.session.folder).close()
    assert read_ledger(path) == facts(lab.session.folder)


def test_ignores_ledger_line_without_commit(lab: Lab) -> None:
    """The power failed after the ledger line and before the commit of the journal."""
    lab.session.close()
    path = ledger_path(lab.session.folder)
    attempt = {
        "id": 1,
        "step": 0,
        "kind": "white",
        "illumination": None,
        "file": "frames/a",
        "started_at": "2026-01-01",
    }
    with path.open("a") as stream:
        stream.write(json.dumps({"attempts": [attempt | {"sha256": "00", "verdict": ACCEPTED}]}) + "\n")
    lab.session = Session.open_for_run(lab.session.folder)
    assert read_ledger(path) == facts(lab.session.folder)
    assert run(lab).complete


@pytest.mark.parametrize("line", ['{"attempts": [{"id": 1, "x y": 2}]}', "[]", '{"heartbeat": [{"id": 1}]}', "no"])
def test_refuses_foreign_ledger(lab: Lab, line: str) -> None:
    lab.session.close()
    path = ledger_path(lab.session.folder)
    path.write_text(line + "\n" + path.read_text())
    with pytest.raises(FormatError, match="line 1, is damaged"):
        rebuild_journal(lab.session.folder)


@pytest.mark.parametrize(("mishap", "after"), [(Path.unlink, 4), (lambda path: os.truncate(path, 9), 12)])  # type: ignore[misc]
def test_repeats_deleted_or_cut_frame(lab: Lab, mishap: Callable[[Path], object], after: int) -> None:
    folder = lab.session.folder
    assert run(lab, after, lambda folder: mishap(folder / "frames" / "0002_light_000.dng")).complete
    assert len(lab.session.done_steps()) == len(lab.session.steps)
    assert lab.verdicts().count("voided") == 1
    assert not lab.session.verify()
    assert (folder / "frames" / "0002_light_000_try2.dng").is_file()


def test_foreign_heartbeat_does_not_end_run(lab: Lab) -> None:
    folder = lab.session.folder

    def beat(folder: Path) -> None:
        thread_beat(folder / "journal.sqlite", "late", "the camera hangs", datetime.now(UTC))

    assert run(lab, 5, beat).complete
    lab.session.close()
    assert facts(folder) == read_ledger(ledger_path(folder))


def test_commands_refuse_journal_contradicted_by_ledger(
    lab: Lab, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The journal is intact and the session complete, but with a frame that must no longer be used."""
    old_journal = lab.session.folder
    run(lab)
    lab.session.close()
    journal = (old_journal / "journal.sqlite").read_bytes()
    lab.session = Session.open_for_run(old_journal)
    lab.session.retake("1")
    assert run(lab).complete
    lab.session.close()
    (old_journal / "journal.sqlite").write_bytes(journal)
    (old_journal.parent / "LAB.toml").write_text(SETTINGS.to_toml())
    monkeypatch.chdir(old_journal.parent)
    for command in (["status"], ["report"], ["run", "LAB.toml"]):
        assert main([*command, str(old_journal)]) == 2
        assert "acquire rebuild" in capsys.readouterr().err, command
    with pytest.raises(FormatError, match="lacks 4 frames"):
        Session.open(old_journal)
    watch = SessionWatch(old_journal)
    assert (watch.head().state, "acquire rebuild" in watch.head().sentence) == ("unreadable", True)


def test_page_names_rebuild_command(lab: Lab) -> None:
    watch = SessionWatch(lab.session.folder)
    assert watch.head().total
    delete(lab.session.folder)
    assert "acquire rebuild" in watch.head().sentence


@pytest.mark.parametrize("mishap", [Path.unlink, lambda path: os.truncate(path, 9)])  # type: ignore[misc]
def test_session_with_lost_file_is_incomplete(
    lab: Lab, mishap: Callable[[Path], object], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lab.session.folder
    run(lab)
    lab.session.close()
    clock = SimulatedClock()
    watch = SessionWatch(folder, clock.monotonic)
    assert watch.head().state == "complete"
    mishap(folder / "frames" / "0002_light_000.dng")
    clock.sleep(LOOK_AGAIN_S)
    assert watch.head().state == "incomplete", "an open page checks again"
    assert main(["status", str(folder)]) == 4
    assert "incomplete: frames/0002_light_000.dng: deleted or truncated" in capsys.readouterr().out
    assert read_session(folder).head(lab.clock.now()).done == len(lab.session.steps) - 1


@pytest.mark.parametrize(
    ("name", "mishap"),
    [("chart.json", Path.unlink), ("illuminations.csv", lambda path: os.truncate(path, 9))],  # type: ignore[misc]
)
def test_reports_lost_chart_or_illuminants(
    lab: Lab, name: str, mishap: Callable[[Path], object], capsys: pytest.CaptureFixture[str]
) -> None:
    """All frames exist, but no LUT can be built from them."""
    folder = lab.session.folder
    run(lab)
    lab.session.close()
    content = (folder / name).read_bytes()
    mishap(folder / name)
    assert main(["status", str(folder)]) == 4
    output = capsys.readouterr()
    assert "incomplete" in output.out
    assert str(folder / name) in output.err
    assert " from a copy" in output.err
    (folder / name).write_bytes(content)
    assert main(["status", str(folder)]) == 0
