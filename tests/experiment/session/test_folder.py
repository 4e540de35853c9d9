"""The session folder: counted frames, strays, refusals, and failing disks."""

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
from experiment.lights import Illuminant, save_illuminants
from experiment.session.folder import Session, journal_path, session_exists
from experiment.session.records import Judgement, plan_steps
from foundation.errors import FormatError, InputError, StorageError
from foundation.folders import unmounted_folder
from tests.failing_calls import DISK_FAULTS, FailingCalls, failing_calls, why_not

LIGHTS = tuple(Illuminant(number, "uniform", None, Colour(255, number, 0)) for number in range(5))
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


def test_frames_csv_has_the_documented_format(session: Session) -> None:
    take(session, 0, b"white")
    take(session, 2, b"light", "too dark")
    session.write_frames_csv()
    lines = (session.folder / "frames.csv").read_text().splitlines()
    assert lines[0] == "kind,illumination,file,sha256,taken_at,exposure_s,verdict"
    assert lines[1:] == [
        f"white,,frames/0000_white.cr2,{WHITE_SHA},2026-01-01T09:30:00.000000+00:00,0.5,accepted",
        f"light,0,frames/0002_light_000.cr2,{LIGHT_SHA},2026-01-01T09:30:00.000000+00:00,0.5,refused: too dark",
    ]


def test_counted_frames_are_on_disk_and_in_the_journal(session: Session) -> None:
    take(session, 0, b"frame")
    take(session, 1, b"frame", "dark")
    assert session.done_steps() == {0}
    (session.frames_folder / "0000_white.cr2").write_bytes(b"fra")
    assert session.done_steps() == set(), "a truncated file is no frame"


def test_renames_strays_and_deletes_partial_files(session: Session) -> None:
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


def test_never_creates_over_existing_files(tmp_path: Path, session: Session) -> None:
    with pytest.raises(InputError):
        Session.create(session.folder, "", design_chart(bits=1), LIGHTS)


@pytest.mark.parametrize(
    ("lights", "message"),
    [
        ((LIGHTS[0], replace(LIGHTS[1], colour=LIGHTS[2].colour), *LIGHTS[2:]), "planned as 255 1 0"),
        (LIGHTS[:4], "illuminant 4 .* 255 4 0"),
    ],
)
def test_refuses_edited_illuminants(session: Session, lights: tuple[Illuminant, ...], message: str) -> None:
    session.close()
    save_illuminants(lights, session.folder / "illuminations.csv")
    with pytest.raises(FormatError, match=rf"illuminations\.csv .*{message}"):
        Session.open(session.folder)


def _empty(path: Path) -> None:
    path.write_text("")


@pytest.mark.parametrize("name", ["chart.json", "illuminations.csv"])
@pytest.mark.parametrize("damage", [Path.unlink, _empty])
def test_missing_copy_has_a_remedy(session: Session, name: str, damage: Callable[[Path], object]) -> None:
    session.close()
    damage(session.folder / name)
    with pytest.raises(FormatError, match=name.replace(".", r"\.")) as caught:
        Session.open(session.folder)
    assert "restore it from a copy of the session" in caught.value.remedy
    assert "acquire illuminations" not in str(caught.value)


def test_refuses_empty_settings(session: Session) -> None:
    (session.folder / "session.toml").write_text("\n")
    with pytest.raises(FormatError, match=r"session\.toml: empty"):
        session.settings_text()


@pytest.mark.parametrize("call", ["stat", "iterdir", "unlink", "rename"])
def test_reports_a_failing_disk(session: Session, call: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (session.frames_folder / "stray.cr2").write_bytes(b"stray")
    (session.frames_folder / ".0002_light_000.partial").write_bytes(b"half")
    real = getattr(Path, call)

    def fail(path: Path, *arguments: Any, **keywords: Any) -> Any:
        if path.is_relative_to(session.frames_folder):
            raise OSError(errno.EIO, "Input/output error", str(path))
        return real(path, *arguments, **keywords)

    with monkeypatch.context() as patched:
        patched.setattr(Path, call, fail)
        with pytest.raises(StorageError, match="frames: Input/output error"):
            session.set_aside_strays()
    assert len(session.set_aside_strays()) == 1, "when the disk is back the same goes through"


def test_refuses_files_under_a_mount_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames without journal and settings, and an empty mount point."""
    folder = tmp_path / "night"
    (folder / "frames").mkdir(parents=True)
    for check in (session_exists, journal_path):
        with pytest.raises(FormatError) as refused:
            check(folder)
        assert "remove" not in str(refused.value)
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
    for check in (session_exists, journal_path):
        with pytest.raises(StorageError):
            check(folder)
    tables[1].write_text(f"/dev/sda1 / ext4 rw 0 0\n/dev/sdb1 {tmp_path} ext4 rw 0 0\n")
    assert unmounted_folder(folder, *tables) is None
    assert unmounted_folder(folder, tmp_path / "none", tables[1]) is None
    tables[0].write_text(f"UUID=2 {tmp_path}/two\\040words ext4 rw 0 0\n")
    assert unmounted_folder(tmp_path / "two words" / "night", *tables) == tmp_path / "two words"


def test_unreadable_journal_is_not_missing(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(path: Path, **_: object) -> None:
        raise OSError(errno.EIO, "Input/output error", str(path))

    monkeypatch.setattr(Path, "stat", fail)
    with pytest.raises(StorageError, match=r"journal\.sqlite: Input/output error"):
        session_exists(session.folder)
    with pytest.raises(StorageError, match=r"journal\.sqlite: Input/output error"):
        Session.open(session.folder)


AT = datetime(2026, 1, 1, tzinfo=UTC)
NIGHT_LIGHTS = (Illuminant(0, "uniform", None, Colour(255, 0, 0)),)
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
    """A session with one frame, and a run that saves a second one on a failing disk."""

    def __init__(self, folder: Path, disk: FailingCalls) -> None:
        self._pristine, self.folder, self._disk = folder / "pristine", folder / "disk" / "night", disk
        with Session.create(
            self._pristine, "rig", design_chart(1), NIGHT_LIGHTS, plan_steps(NIGHT_LIGHTS, 25)
        ) as session:
            save(session, 0)

    def restore(self) -> None:
        """Restore the session with its one frame."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self._pristine, self.folder)

    def run(self) -> None:
        with Session.open_for_run(self.folder) as session:
            session.set_aside_strays()
            save(session, 1)

    def sweep(self, numbers: Sequence[int], lasting: bool, every: int = 1) -> int:
        """Let each `every`-th call fail with each fault; return the number of runs that ended by it."""
        ended_runs = 0
        for number in numbers:
            for call_number in range(0, 1000, every):
                self.restore()
                result = self._disk.run(self.run, call_number, number, lasting=lasting)
                if result.error is not None:
                    ended_runs += 1
                    assert isinstance(result.error, StorageError), f"{result.failed}: {result.error!r}"
                    assert "\n" not in str(result.error)
                    if lasting:
                        assert os.strerror(number) in str(result.error), result.failed
                self.require_consistent(saved=result.error is None)
                if result.failed is None:
                    assert result.error is None
                    break
        return ended_runs

    def require_consistent(self, saved: bool) -> None:
        """Resume the session on a working disk: saved frames exist, others can be taken, and none is double."""
        with Session.open_for_run(self.folder) as session:
            session.set_aside_strays()
            assert session.verify() == ()
            done_steps = session.done_steps()
            assert done_steps == {0, 1} if saved else done_steps in ({0}, {0, 1})
            if 1 not in done_steps:
                save(session, 1)
            assert [(self.folder / frame.file).read_bytes() for frame in session.frames()] == FRAMES
        frames_csv = (self.folder / "frames.csv").read_text()
        assert frames_csv.count("accepted") >= 1 + saved


@pytest.fixture
def night() -> Generator[Night]:
    # On a file system in memory, flushing costs no time.
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name:
        folder = Path(name).resolve()
        (folder / "disk").mkdir()
        with failing_calls(folder / "disk") as disk:
            yield Night(folder, disk)


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_survives_one_failing_call(night: Night) -> None:
    # Every ninth of four hundred calls, so that opening, reading, syncing and closing all fail.
    assert night.sweep([errno.EIO], lasting=False, every=9) > 5


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_survives_a_disk_that_stops_working(night: Night) -> None:
    assert night.sweep([errno.EIO], lasting=True, every=13) > 10


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_survives_other_disk_faults(night: Night) -> None:
    others = [number for number in DISK_FAULTS if number != errno.EIO]
    assert night.sweep(others, lasting=True, every=41) > 20


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_reports_a_damaged_journal(night: Night) -> None:
    night.restore()
    path = night.folder / "journal.sqlite"
    data = bytearray(path.read_bytes())
    data[4096:] = bytes(len(data) - 4096)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"journal\.sqlite is damaged"):
        night.run()


@pytest.mark.slow
@pytest.mark.skipif(why_not() != "", reason=why_not())
def test_does_not_write_under_an_unmounted_disk(night: Night) -> None:
    night.restore()
    with Session.open_for_run(night.folder) as session:
        # After unmounting, the journal is open, but the folder is missing.
        shutil.rmtree(session.frames_folder)
        with pytest.raises(StorageError):
            session.receive("0001_dark", capture(FRAMES[1]))
        assert not session.frames_folder.exists()
