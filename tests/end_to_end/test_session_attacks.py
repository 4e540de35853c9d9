"""Accidents between and during runs: exchanged files, copies, failing disks."""

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


def interrupt_session(lab: Path, frames: int) -> Path:
    """Return the folder of a session that was interrupted after some frames."""
    folder = lab.parent / "session"
    calls: list[int] = []

    def interrupt(count: int, total: int) -> None:
        calls.append(count)
        if len(calls) > frames:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_session(load_lab(lab), folder, interrupt)
    return folder


def has_one_frame_per_step(folder: Path) -> bool:
    """Return whether each step has one accepted frame."""
    with Session.open(folder) as session:
        accepted = [frame.step for frame in session.journal.accepted_files()]
        return sorted(accepted) == [step.number for step in session.steps]


def test_repeats_exchanged_frames_and_keeps_files(
    lab: Path, frame_hashes: Hashes, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = interrupt_session(lab, 7)
    first, second = sorted((folder / "frames").glob("*_light_*"))[:2]
    contents = first.read_bytes(), second.read_bytes()
    first.write_bytes(contents[1])
    second.write_bytes(contents[0])
    assert run("run", lab, folder) == 0
    output = capsys.readouterr().err
    for path in (first, second):
        assert f"frames/{path.name} has changed since it was taken" in output
    assert has_one_frame_per_step(folder)
    assert (first.read_bytes(), second.read_bytes()) == contents[::-1]


def test_copy_of_running_session_is_independent(lab: Path, frame_hashes: Hashes) -> None:
    folder, copy = lab.parent / "session", lab.parent / "elsewhere" / "copy"

    def copied(count: int, total: int) -> None:
        if count == 5:
            # Files in progress have hidden names, and may disappear before they are copied.
            shutil.copytree(folder, copy, ignore=shutil.ignore_patterns(".*"))

    assert run_session(load_lab(lab), folder, copied).complete
    hashes = frame_hashes(folder)
    assert run("run", lab, copy) == 0
    assert has_one_frame_per_step(copy)
    assert frame_hashes(folder) == hashes


def test_refuses_session_created_by_other_run(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = lab.parent / "session"
    original = runs.require_plan

    def meanwhile(*arguments: Any) -> object:
        monkeypatch.setattr(runs, "require_plan", original)
        assert run("run", lab, folder) == 0
        return original(*arguments)

    monkeypatch.setattr(runs, "require_plan", meanwhile)
    with pytest.raises(InputError):
        run_session(load_lab(lab), folder, lambda count, total: None)
    assert has_one_frame_per_step(folder)


@pytest.mark.parametrize(
    ("name", "prefix", "code"), [("previews", "preview: ", errno.ENOSPC), ("report.html", "report: ", errno.EIO)]
)
def test_reports_unwritable_reports_once(
    lab: Path, name: str, prefix: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = lab.parent / "session"
    replace = Path.replace

    def fail(path: Path, target: Path) -> Path:
        if name in Path(target).parts:
            raise OSError(code, "the disk's fault", str(target))
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", fail)
    messages: list[str] = []
    assert run_session(load_lab(lab), folder, lambda count, total: None, messages.append).complete
    (sentence,) = [message for message in messages if message.startswith(prefix)]
    assert str(folder / name) in sentence
    assert "the disk's fault" in sentence
    assert has_one_frame_per_step(folder)


def test_unwritable_heartbeat_costs_no_frame(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = lab.parent / "session"

    def fail(journal: Journal, *_: object) -> None:
        raise StorageError("cannot write journal.sqlite: disk I/O error")

    monkeypatch.setattr(Journal, "beat", fail)
    assert run("run", lab, folder) == 0
    assert has_one_frame_per_step(folder)
    assert run("status", folder) == 0
