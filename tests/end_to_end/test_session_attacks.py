"""What may befall a session between and during runs: files exchanged, copies, disks that fail."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquisition.cli import main
from acquisition.run import run as runs
from acquisition.run.run import run_session
from experiment.config import load_lab
from experiment.session.folder import Session
from experiment.session.journal import Journal
from foundation.errors import InputError, StorageError

pytestmark = pytest.mark.slow

Hashes = Callable[[Path], dict[tuple[str, str], list[str]]]


def run(*arguments: object) -> int:
    return main(list(map(str, arguments)))


def interrupted(lab: Path, frames: int) -> Path:
    """Return the folder of a session that was ended after some frames."""
    folder = lab.parent / "session"
    told: list[int] = []

    def interrupt(done: int, total: int) -> None:
        told.append(done)
        if len(told) > frames:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_session(load_lab(lab), folder, interrupt)
    return folder


def counted_once(folder: Path) -> bool:
    """Return whether each step has one accepted frame."""
    with Session.open(folder) as session:
        accepted = [frame.step for frame in session.journal.accepted_files()]
        return sorted(accepted) == [step.number for step in session.steps]


def test_exchanged_frames_are_both_taken_again_and_stay(
    lab: Path, frame_hashes: Hashes, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = interrupted(lab, 7)
    first, second = sorted((folder / "frames").glob("*_light_*"))[:2]
    contents = first.read_bytes(), second.read_bytes()
    first.write_bytes(contents[1])
    second.write_bytes(contents[0])
    assert run("run", lab, folder) == 0
    said = capsys.readouterr().err
    for path in (first, second):
        assert f"frames/{path.name} has changed since it was taken" in said
    assert counted_once(folder)
    assert (first.read_bytes(), second.read_bytes()) == contents[::-1]


def test_a_copy_of_a_session_that_is_being_taken_goes_on_by_itself(lab: Path, frame_hashes: Hashes) -> None:
    folder, copy = lab.parent / "session", lab.parent / "elsewhere" / "copy"

    def copied(done: int, total: int) -> None:
        if done == 5:
            # What is being written has a hidden name, and may be gone before it is copied.
            shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(".*"))

    assert run_session(load_lab(lab), folder, copied).complete
    before = frame_hashes(folder)
    assert run("run", lab, copy) == 0
    assert counted_once(copy)
    assert frame_hashes(folder) == before


def test_a_session_that_another_run_makes_meanwhile_is_not_to_be_removed(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = lab.parent / "session"
    real = runs.require_plan

    def meanwhile(*given: Any) -> object:
        monkeypatch.setattr(runs, "require_plan", real)
        assert run("run", lab, folder) == 0
        return real(*given)

    monkeypatch.setattr(runs, "require_plan", meanwhile)
    with pytest.raises(InputError):
        run_session(load_lab(lab), folder, lambda done, total: None)
    assert counted_once(folder)


@pytest.mark.parametrize(
    ("part", "said", "code"), [("previews", "preview: ", errno.ENOSPC), ("report.html", "report: ", errno.EIO)]
)
def test_what_is_derived_and_cannot_be_written_is_said_once_and_costs_no_frame(
    lab: Path, part: str, said: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = lab.parent / "session"
    replace = Path.replace

    def fail(path: Path, target: Path) -> Path:
        if part in Path(target).parts:
            raise OSError(code, "the disk's fault", str(target))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", fail)
    told: list[str] = []
    assert run_session(load_lab(lab), folder, lambda done, total: None, told.append).complete
    (sentence,) = [one for one in told if one.startswith(said)]
    assert str(folder / part) in sentence
    assert "the disk's fault" in sentence
    assert counted_once(folder)


def test_a_heartbeat_that_cannot_be_written_costs_no_frame(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = lab.parent / "session"

    def fail(journal: Journal, *_: object) -> None:
        raise StorageError("cannot write journal.sqlite: disk I/O error")

    monkeypatch.setattr(Journal, "beat", fail)
    assert run("run", lab, folder) == 0
    assert counted_once(folder)
    assert run("status", folder) == 0
