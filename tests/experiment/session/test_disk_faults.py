"""Every system call of opening a session and saving a frame fails: one sentence, no frame lost, none counted twice."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Generator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

import pytest

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.lights import Illumination
from experiment.session.folder import Session
from experiment.session.records import Judgement, plan_steps
from foundation.errors import FormatError, StorageError
from tests.failing_calls import DISK_FAULTS, FailingCalls, failing_calls, why_not

pytestmark = [pytest.mark.slow, pytest.mark.skipif(why_not() != "", reason=why_not())]

AT = datetime(2026, 1, 1, tzinfo=UTC)
LIGHTS = (Illumination(0, "uniform", None, Colour(255, 0, 0)),)
FRAMES = [f"frame {number} ".encode() * 9000 for number in range(2)]


def capture(data: bytes) -> Callable[[BinaryIO], CapturedFrame]:
    def write(into: BinaryIO) -> CapturedFrame:
        into.write(data)
        return CapturedFrame("IMG_0001.CR2", len(data), AT)

    return write


def save(session: Session, number: int) -> None:
    step = session.steps[number]
    attempt = session.journal.begin(step, f"frames/{step.stem}", AT)
    received = session.receive(step.stem, capture(FRAMES[number]))
    session.journal.commit(attempt, received, Judgement(()), exposure_s=0.5, ended_at=AT)


class Night:
    """A session with one frame, and a run that opens it and saves a second one, on a disk that fails."""

    def __init__(self, folder: Path, disk: FailingCalls) -> None:
        self._pristine, self.folder, self._disk = folder / "pristine", folder / "disk" / "night", disk
        with Session.create(self._pristine, "rig", design_chart(1), LIGHTS, plan_steps(LIGHTS, 25)) as session:
            save(session, 0)

    def restore(self) -> None:
        """Put the session back to its one frame."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self._pristine, self.folder)

    def run(self) -> None:
        with Session.open_for_run(self.folder) as session:
            session.set_aside_strays()
            save(session, 1)

    def sweep(self, numbers: Sequence[int], lasting: bool, every: int = 1) -> int:
        """Let each `every`-th call fail with each fault; return how many runs ended by it."""
        ended = 0
        for number in numbers:
            for at in range(0, 1000, every):
                self.restore()
                ran = self._disk.run(self.run, at, number, lasting=lasting)
                if ran.error is not None:
                    ended += 1
                    assert isinstance(ran.error, StorageError), f"{ran.failed}: {ran.error!r}"
                    assert "\n" not in str(ran.error)
                    if lasting:
                        assert os.strerror(number) in str(ran.error), ran.failed
                self.look(saved=ran.error is None)
                if ran.failed is None:
                    assert ran.error is None
                    break
        return ended

    def look(self, saved: bool) -> None:
        """Take the session up on a disk that works: what was saved is there, what was not can be, nothing is twice."""
        with Session.open_for_run(self.folder) as session:
            session.set_aside_strays()
            assert session.verify() == ()
            done = session.done_steps()
            assert done == {0, 1} if saved else done in ({0}, {0, 1})
            if 1 not in done:
                save(session, 1)
            assert [(self.folder / frame.file).read_bytes() for frame in session.frames()] == FRAMES
        listed = (self.folder / "frames.csv").read_text()
        assert listed.count("accepted") >= 1 + saved


@pytest.fixture
def night() -> Generator[Night]:
    # Where there is a file system in memory, flushing costs nothing.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name:
        folder = Path(name).resolve()
        (folder / "disk").mkdir()
        with failing_calls(folder / "disk") as disk:
            yield Night(folder, disk)


def test_a_call_that_fails_once(night: Night) -> None:
    # Every ninth of four hundred, so that each of opening, reading, syncing and closing has its turn.
    assert night.sweep([errno.EIO], lasting=False, every=9) > 5


def test_a_disk_that_fails_from_some_call_on(night: Night) -> None:
    assert night.sweep([errno.EIO], lasting=True, every=13) > 10


def test_each_other_fault_of_a_disk(night: Night) -> None:
    others = [number for number in DISK_FAULTS if number != errno.EIO]
    assert night.sweep(others, lasting=True, every=41) > 20


def test_a_journal_that_is_damaged_is_called_so(night: Night) -> None:
    night.restore()
    path = night.folder / "journal.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = bytes(len(data) - 4096)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"journal\.sqlite is damaged"):
        night.run()


def test_a_disk_that_was_unmounted_is_not_written_below(night: Night) -> None:
    night.restore()
    with Session.open_for_run(night.folder) as session:
        # What an unmounted disk leaves: the open journal, and nothing under the name.
        shutil.rmtree(session.frames_folder)
        with pytest.raises(StorageError):
            session.receive("0001_dark", capture(FRAMES[1]))
        assert not session.frames_folder.exists()
