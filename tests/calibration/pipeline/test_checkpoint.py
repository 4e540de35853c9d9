"""An interrupted or incremental build ends with the bytes of an undisturbed one."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import shutil
import signal
import sqlite3
from collections.abc import Generator
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import calibration.pipeline.build as building
from calibration.pipeline import checkpoint
from calibration.pipeline.build import TableProgress, append, build
from calibration.pipeline.checkpoint import RECORD, Checkpoint, unfinished_table
from calibration.pipeline.collecting import stored_names
from calibration.pipeline.frames import frame_faults
from calibration.table import writing
from calibration.table.lut import open_lut
from calibration.table.verification import find_faults
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from foundation.errors import FormatError, InputError
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, Lab, hang, renumbered, take

pytestmark = pytest.mark.slow

# Starts processes without repeating their imports.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([__name__])

PLACES = {
    "putting": (writing.LutWriter, "put"),
    "saving": (checkpoint.UnfinishedTable, "save"),
    "finishing": (writing, "write_atomic"),
    "publishing": (Path, "replace"),
}


@pytest.fixture(scope="module")
def lab() -> Lab:
    """Return a lab with few colours, in which the lens is not measured."""
    return hang(2, "A6")


def build_until_killed(place: str, count: int, folder: Path, out: Path) -> None:
    """Build a table; the process is killed before the `count`-th call of a function."""
    building.CHECKPOINT_EVERY = 3  # pyrefly: ignore[bad-assignment]
    owner, name = PLACES[place]
    real, left = getattr(owner, name), itertools.count(count, -1)

    def deadly(*given: Any, **named: Any) -> Any:
        if (place != "publishing" or given[0].is_dir()) and next(left) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*given, **named)

    setattr(owner, name, deadly)
    with Session.open(folder) as session:
        build(session, out)


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(building, "CHECKPOINT_EVERY", 3)


def files(folder: Path) -> dict[str, bytes]:
    """Return a table's files without the reports, which only the command writes."""
    assert not list(folder.glob(f"{RECORD}*"))
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith("report")}


@pytest.fixture(scope="module")
def session(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Generator[Session]:
    lights = renumbered(LIGHTS[3:10])
    with take(lab, tmp_path_factory.mktemp("short") / "session", lights, every=3) as taken:
        yield taken


@pytest.fixture(scope="module")
def undisturbed(session: Session, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("undisturbed") / "lut"
    build(session, folder)
    return files(folder)


def interrupted_at(session: Session, out: Path, frame: int) -> None:
    def progress(done: int, total: int, what: str) -> None:
        if done == frame:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        build(session, out, progress)


@pytest.mark.parametrize(("place", "count"), [("putting", 2), ("saving", 2), ("finishing", 3), ("publishing", 1)])
def test_killed_build_resumes_to_same_bytes(
    session: Session, undisturbed: dict[str, bytes], tmp_path: Path, place: str, count: int
) -> None:
    program = FORKS.Process(target=build_until_killed, args=(place, count, session.folder, tmp_path / "lut"))
    program.start()
    program.join()
    assert program.exitcode == -signal.SIGKILL
    assert not (tmp_path / "lut").exists()
    build(session, tmp_path / "lut")
    assert files(tmp_path / "lut") == undisturbed
    assert list(tmp_path.iterdir()) == [tmp_path / "lut"]


def test_resumed_build_does_not_restart(session: Session, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    interrupted_at(session, tmp_path / "lut", 7)
    done: list[int] = []
    build(session, tmp_path / "lut", lambda number, total, what: done.append(number))
    assert done[:2] == [0, 7]
    assert files(tmp_path / "lut") == undisturbed


@pytest.mark.parametrize("what", ["checkpoint", "checkpoint.*.npz", "samples.npy"])
def test_detects_damaged_checkpoint(session: Session, undisturbed: dict[str, bytes], tmp_path: Path, what: str) -> None:
    interrupted_at(session, tmp_path / "lut", 8)
    (path,) = (tmp_path / ".lut.partial").glob(what)
    data = bytearray(path.read_bytes())
    data[128 + 7] ^= 1
    path.write_bytes(data)
    build(session, tmp_path / "lut")
    assert files(tmp_path / "lut") == undisturbed


def test_checkpoint_keeps_bump_and_lens(tmp_path: Path) -> None:
    lab, bumped = hang(), hang(room=Room(waviness_mm=0.5, roll_deg=0.7, fill=0.935))

    def frame(step: SessionStep) -> bytes:
        return (bumped if step.number >= 3 else lab).dng(step.colour, step.number)

    with take(lab, tmp_path / "session", renumbered(LIGHTS[3:7]), frame=frame) as session:
        build(session, tmp_path / "whole")
        interrupted_at(session, tmp_path / "lut", 4)
        result = build(session, tmp_path / "lut")
    assert [figures.reregistered for figures in result.figures.frames].count(True) == 1
    assert files(tmp_path / "lut") == files(tmp_path / "whole")


@pytest.fixture
def session_under_way(session: Session, tmp_path: Path) -> Generator[Session]:
    """Return a copy of the session, in which frames can appear one by one."""
    shutil.copytree(session.folder, tmp_path / "session")
    with Session.open(tmp_path / "session") as copy:
        yield copy


def show(session: Session, frames: int) -> None:
    """Let the first `frames` frames of a session appear."""
    rows = [record.file for record in session.frames()]
    changes: list[tuple[str, ...]] = [
        ("accepted" if number < frames else "refused", file) for number, file in enumerate(rows)
    ]
    alter(session, "UPDATE attempts SET verdict=? WHERE file=?", changes)


def alter(session: Session, change: str, rows: list[tuple[str, ...]]) -> None:
    with closing(sqlite3.connect(session.folder / "journal.sqlite")) as journal, journal:
        journal.executemany(change, rows)


def test_append_follows_session(session_under_way: Session, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    session, out = session_under_way, tmp_path / "lut"
    every = len(session.frames())
    lights = len(session.illuminations)
    seen: list[tuple[int, int]] = []
    for frames in (1, 5, 5, every - 3):
        show(session, frames)
        grown = append(session, out)
        assert isinstance(grown, TableProgress)
        seen.append((grown.lights, grown.new_frames))
        assert not out.exists()
        with pytest.raises(FormatError):
            open_lut(out)
    # Of few colours the lens would be measured on the white frames that came since, too: all are taken in again.
    assert seen == [(0, 1), (3, 4), (3, 0), (lights - 1, every - 3)]
    (path,) = (tmp_path / ".lut.partial").glob(f"{RECORD}.*.npz")
    with np.load(path) as stored:
        arrays = {name.rpartition(".")[2] for name in stored.files}
    assert arrays <= {name.partition(".")[2] for name in stored_names()}, "a checkpoint with other names is not used"
    with pytest.raises(FormatError, match=r"1 of \d+ illuminants .*--append"):
        build(session, out)
    show(session, every)
    assert isinstance(append(session, out), BuildResult)
    assert files(out) == undisturbed


def test_rereads_light_taken_again(session_under_way: Session, undisturbed: dict[str, bytes], tmp_path: Path) -> None:
    """Results of the previous frame must not remain."""
    session = session_under_way
    one, other = (next(r for r in session.frames() if r.illumination == light) for light in (2, 3))
    show(session, 6)
    append(session, tmp_path / "lut")
    change = "UPDATE attempts SET sha256=?, file=? WHERE illumination=?"
    alter(session, change, [(other.sha256, other.file, "2"), (one.sha256, one.file, "3")])
    show(session, 100)
    # The two bear each other's names now, for which the table would be refused.
    append(session, tmp_path / "lut", judged_by=())
    lut, before = open_lut(tmp_path / "lut"), np.load(BytesIO(undisturbed["samples.npy"]))
    assert np.array_equal(lut.samples[2], before[3])
    assert np.array_equal(lut.samples[3], before[2])


def test_refuses_second_program(session: Session, tmp_path: Path) -> None:
    with unfinished_table(tmp_path / "lut"), pytest.raises(InputError):
        build(session, tmp_path / "lut")


def test_restores_checkpoint_exactly(tmp_path: Path) -> None:
    values = {"value": 0.1 + 0.2, "tiny": 5e-324, "nothing": None}
    with unfinished_table(tmp_path / "lut") as unfinished:
        (unfinished.folder / "samples.npy").touch()
        unfinished.save(Checkpoint({"a": "b"}, ["x"], values, {"sum": np.array([0.1, np.inf], np.float32)}))
    assert (tmp_path / ".lut.partial").is_dir()
    with unfinished_table(tmp_path / "lut") as unfinished:
        assert unfinished.load({"a": "c"}, ["x"]) is None
        assert unfinished.load({"a": "b"}, ["y", "x"]) is None
        back = unfinished.load({"a": "b"}, ["x", "y"])
        unfinished.keep = False
    assert back is not None
    assert (back.identity, back.frames, back.values) == ({"a": "b"}, ["x"], values)
    assert back.arrays["sum"].tobytes() == np.array([0.1, np.inf], np.float32).tobytes()
    assert not list(tmp_path.iterdir())


def test_verifies_frames_of_table(session: Session, session_under_way: Session, tmp_path: Path) -> None:
    build(session, tmp_path / "lut")
    lut = open_lut(tmp_path / "lut")
    assert find_faults(lut) == []
    assert frame_faults(lut, session_under_way) == []
    first, second = (session_under_way.folder / frame.file for frame in lut.frames[1:3])
    first.unlink()
    data = bytearray(second.read_bytes())
    data[-1] ^= 1
    second.write_bytes(data)
    gone, changed = frame_faults(lut, session_under_way)
    assert f"{first} cannot be read" in gone
    assert f"{second} has changed" in changed
    os.truncate(tmp_path / "lut" / "samples.npy", 1000)
    with pytest.raises(FormatError, match=r"1000 bytes, expected 67328"):
        open_lut(tmp_path / "lut")
