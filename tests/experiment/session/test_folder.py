"""The session folder: what counts, what is set aside, what is refused."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import pytest

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.lights import Illumination, save_illuminations
from experiment.session.folder import Session, journal_path, session_exists
from experiment.session.records import Judgement, plan_steps
from foundation.errors import FormatError, InputError, StorageError
from foundation.folders import unmounted_folder
from tests.failing_calls import DISK_FAULTS, FailingCalls, failing_calls, why_not

LIGHTS = tuple(Illumination(number, "uniform", None, Colour(255, number, 0)) for number in range(5))
NOW = datetime(2026, 1, 1, 9, 30, tzinfo=UTC)
# printf white | sha256sum, printf light | sha256sum
WHITE_SHA = "018fa96a44715c90bf93be148069cb28dd45d398f2cc75aa1565311f6e55d174"
LIGHT_SHA = "99a7026172d42714d0293e5598ec1c8e8260d7d0c4b8582ad002c1883494e216"


@pytest.fixture
def session(tmp_path: Path) -> Session:
    return Session.create(tmp_path / "s", "", design_chart(bits=1), LIGHTS, plan_steps(LIGHTS, 2))


def take(session: Session, number: int, content: bytes, reason: str = "") -> None:
    step = session.steps[number]
    attempt = session.journal.begin(step, f"frames/{step.stem}", NOW)
    received = session.receive(step.stem, lambda into: CapturedFrame("IMG_1.CR2", into.write(content), NOW))
    judgement = Judgement.of_reason("exposure", reason or None)
    session.journal.commit(attempt, received, judgement, exposure_s=0.5, ended_at=NOW)


def test_frames_csv_is_as_the_format_says(session: Session) -> None:
    take(session, 0, b"white")
    take(session, 2, b"light", "too dark")
    session.write_frames_csv()
    lines = (session.folder / "frames.csv").read_text().splitlines()
    assert lines[0] == "kind,illumination,file,sha256,taken_at,exposure_s,verdict"
    assert lines[1:] == [
        f"white,,frames/0000_white.cr2,{WHITE_SHA},2026-01-01T09:30:00.000000+00:00,0.5,accepted",
        f"light,0,frames/0002_light_000.cr2,{LIGHT_SHA},2026-01-01T09:30:00.000000+00:00,0.5,refused: too dark",
    ]


def test_what_counts_is_on_disk_and_in_the_journal(session: Session) -> None:
    take(session, 0, b"frame")
    take(session, 1, b"frame", "dark")
    assert session.done_steps() == {0}
    (session.frames_folder / "0000_white.cr2").write_bytes(b"fra")
    assert session.done_steps() == set(), "a file that lost bytes is no frame"


def test_strays_are_kept_aside_and_leftovers_removed(session: Session) -> None:
    take(session, 0, b"frame")
    stray = session.frames_folder / "0001_dark.cr2"
    stray.write_bytes(b"complete, but no row counts it")
    leftover = session.frames_folder / ".0002_light_000.partial"
    leftover.write_bytes(b"half")
    moved = session.set_aside_strays()
    assert [path.read_bytes() for path in moved] == [b"complete, but no row counts it"]
    assert sorted(path.name for path in session.frames_folder.iterdir()) == ["0000_white.cr2", "0001_dark.cr2.stray"]
    assert session.set_aside_strays() == []
    stray.write_bytes(b"again")
    session.set_aside_strays()
    assert len(list(session.frames_folder.glob("*.stray"))) == 2, "an earlier stray is never overwritten"


def test_a_session_is_never_made_over_something(tmp_path: Path, session: Session) -> None:
    with pytest.raises(InputError):
        Session.create(session.folder, "", design_chart(bits=1), LIGHTS)


@pytest.mark.parametrize(
    ("lights", "said"),
    [
        ((LIGHTS[0], replace(LIGHTS[1], colour=LIGHTS[2].colour), *LIGHTS[2:]), "planned as 255 1 0"),
        (LIGHTS[:4], "light 4 .* 255 4 0"),
    ],
)
def test_lights_edited_since_are_refused(session: Session, lights: tuple[Illumination, ...], said: str) -> None:
    session.close()
    save_illuminations(lights, session.folder / "illuminations.csv")
    with pytest.raises(FormatError, match=rf"illuminations\.csv .*{said}"):
        Session.open(session.folder)


def _empty(path: Path) -> None:
    path.write_text("")


@pytest.mark.parametrize("name", ["chart.json", "illuminations.csv"])
@pytest.mark.parametrize("damage", [Path.unlink, _empty])
def test_a_lost_copy_is_restored_and_not_made_anew(
    session: Session, name: str, damage: Callable[[Path], object]
) -> None:
    session.close()
    damage(session.folder / name)
    with pytest.raises(FormatError, match=name.replace(".", r"\.")) as caught:
        Session.open(session.folder)
    assert "restore it from a copy of the session" in caught.value.remedy
    assert "acquire illuminations" not in str(caught.value)


def test_settings_that_were_emptied_are_damaged(session: Session) -> None:
    (session.folder / "session.toml").write_text("\n")
    with pytest.raises(FormatError, match=r"session\.toml: empty"):
        session.settings_text()


@pytest.mark.parametrize("call", ["stat", "iterdir", "unlink", "rename"])
def test_a_disk_that_fails_is_no_traceback(session: Session, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (session.frames_folder / "stray.cr2").write_bytes(b"stray")
    (session.frames_folder / ".0002_light_000.partial").write_bytes(b"half")
    real = getattr(Path, call)

    def fail(path: Path, *given: Any, **named: Any) -> Any:
        if path.is_relative_to(session.frames_folder):
            raise OSError(errno.EIO, "Input/output error", str(path))
        return real(path, *given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(Path, call, fail)
        with pytest.raises(StorageError, match="frames: Input/output error"):
            session.set_aside_strays()
    assert len(session.set_aside_strays()) == 1, "when the disk is back the same goes through"


def test_what_was_left_below_a_mount_point_is_no_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames without a journal and without settings, and an empty place where a disk should be."""
    folder = tmp_path / "night"
    (folder / "frames").mkdir(parents=True)
    for look in (session_exists, journal_path):
        with pytest.raises(FormatError) as told:
            look(folder)
        assert "remove" not in str(told.value)
    (folder / "frames").rmdir()
    assert not session_exists(folder)
    tables = tmp_path / "fstab", tmp_path / "mounts"
    disks = ("# <disk>", "UUID=1 / ext4 defaults 0 1", f"UUID=2 {tmp_path} ext4 noauto 0 0", "UUID=3 none swap sw 0 0")
    tables[0].write_text("\n".join(disks))
    tables[1].write_text("/dev/sda1 / ext4 rw 0 0\n")
    assert unmounted_folder(folder, *tables) == tmp_path
    monkeypatch.setattr(
        "experiment.session.folder.unmounted_folder", partial(unmounted_folder, fstab=tables[0], mounts=tables[1])
    )
    for look in (session_exists, journal_path):
        with pytest.raises(StorageError):
            look(folder)
    tables[1].write_text(f"/dev/sda1 / ext4 rw 0 0\n/dev/sdb1 {tmp_path} ext4 rw 0 0\n")
    assert unmounted_folder(folder, *tables) is None
    assert unmounted_folder(folder, tmp_path / "none", tables[1]) is None
    tables[0].write_text(f"UUID=2 {tmp_path}/two\\040words ext4 rw 0 0\n")
    assert unmounted_folder(tmp_path / "two words" / "night", *tables) == tmp_path / "two words"


def test_a_journal_that_cannot_be_looked_for_is_not_missing(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, **_: object) -> None:
        raise OSError(errno.EIO, "Input/output error", str(path))

    monkeypatch.setattr(Path, "stat", fail)
    with pytest.raises(StorageError, match=r"journal\.sqlite: Input/output error"):
        session_exists(session.folder)
    with pytest.raises(StorageError, match=r"journal\.sqlite: Input/output error"):
        Session.open(session.folder)


AT = datetime(2026, 1, 1, tzinfo=UTC)
NIGHT_LIGHTS = (Illumination(0, "uniform", None, Colour(255, 0, 0)),)
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
        with Session.create(
            self._pristine, "rig", design_chart(1), NIGHT_LIGHTS, plan_steps(NIGHT_LIGHTS, 25)
        ) as session:
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


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_a_call_that_fails_once(night: Night) -> None:
    # Every ninth of four hundred, so that each of opening, reading, syncing and closing has its turn.
    assert night.sweep([errno.EIO], lasting=False, every=9) > 5


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_a_disk_that_fails_from_some_call_on(night: Night) -> None:
    assert night.sweep([errno.EIO], lasting=True, every=13) > 10


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_each_other_fault_of_a_disk(night: Night) -> None:
    others = [number for number in DISK_FAULTS if number != errno.EIO]
    assert night.sweep(others, lasting=True, every=41) > 20


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_a_journal_that_is_damaged_is_called_so(night: Night) -> None:
    night.restore()
    path = night.folder / "journal.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = bytes(len(data) - 4096)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"journal\.sqlite is damaged"):
        night.run()


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_a_disk_that_was_unmounted_is_not_written_below(night: Night) -> None:
    night.restore()
    with Session.open_for_run(night.folder) as session:
        # What an unmounted disk leaves: the open journal, and nothing under the name.
        shutil.rmtree(session.frames_folder)
        with pytest.raises(StorageError):
            session.receive("0001_dark", capture(FRAMES[1]))
        assert not session.frames_folder.exists()
