"""Repeated frames: damaged files, illuminants given by the user, and refusals of a report."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Generator, Sequence
from datetime import UTC, datetime
from pathlib import Path

import pytest

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.layout import design_chart
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.records import Judgement, plan_steps
from experiment.session.repair import MOST_UNREADABLE, lights_text, parse_lights
from foundation.errors import FormatError, InputError, StorageError

LIGHTS = tuple(Illuminant(number, "uniform", None, Colour(255, number, 0)) for number in range(5))
NOW = datetime(2026, 1, 1, 9, 30, tzinfo=UTC)


@pytest.fixture
def session(tmp_path: Path) -> Generator[Session]:
    """Yield a complete session: white, dark, five illuminants, white, dark."""
    session = Session.create(tmp_path / "s", "", design_chart(bits=1), LIGHTS, plan_steps(LIGHTS, 25))
    with session:
        take_missing(session)
        yield session


def take_missing(session: Session) -> list[int]:
    """Take every step without an accepted frame; return their numbers."""
    missing = [step for step in session.steps if step.number not in session.done_steps()]
    for step in missing:
        kept = session.journal.kept_files(step)
        stem = step.stem if not kept else f"{step.stem}_try{kept + 1}"
        content = f"frame {stem}".encode()
        attempt = session.journal.begin(step, f"frames/{stem}", NOW)
        received = session.receive(stem, lambda into, data=content: CapturedFrame("a.cr2", into.write(data), NOW))
        session.journal.commit(attempt, received, Judgement(()), exposure_s=0.5, ended_at=NOW)
    return [step.number for step in missing]


def take_again(session: Session, number: int) -> Path:
    """Take another accepted frame of a step; return its file."""
    attempt = session.journal.begin(session.steps[number], "frames/again", NOW)
    received = session.receive("again", lambda into: CapturedFrame("a.cr2", into.write(b"again"), NOW))
    session.journal.commit(attempt, received, Judgement(()), exposure_s=0.5, ended_at=NOW)
    return received.path


def verdicts(session: Session, number: int) -> list[str | None]:
    return [attempt.verdict for attempt in session.journal.attempts() if attempt.step == number]


@pytest.mark.parametrize("damage", ["a flipped byte", "cut off", "longer", "gone", "a folder"])
def test_repeats_damaged_frames(session: Session, damage: str) -> None:
    path = session.frames_folder / "0003_light_001.cr2"
    original = path.read_bytes()
    match damage:
        case "a flipped byte":
            path.write_bytes(original[:-1] + bytes([original[-1] ^ 1]))
        case "cut off":
            path.write_bytes(original[:-1])
        case "longer":
            path.write_bytes(original + b"!")
        case _:
            path.unlink()
            if damage == "a folder":
                path.mkdir()
    (reason,) = session.verify()
    assert reason.startswith("frames/0003_light_001.cr2 ")
    assert take_missing(session) == [3]
    assert verdicts(session, 3) == ["voided", "accepted"]
    of_light = [frame for frame in session.frames() if frame.illumination == 1]
    assert [frame.verdict for frame in of_light] == [f"refused: {reason}", "accepted"]
    assert of_light[1].file == "frames/0003_light_001_try2.cr2"
    assert session.verify() == (), "void frames are not checked again"
    assert path.exists() == (damage != "gone"), "nothing is deleted"


def make_unreadable(names: Sequence[str], monkeypatch: pytest.MonkeyPatch, code: int = errno.EIO) -> None:
    """Make the disk fail at files with these names."""
    real = Path.open

    def fail(path: Path, mode: str = "r") -> object:
        if path.name in names:
            raise OSError(code, os.strerror(code), str(path))
        return real(path, mode)

    monkeypatch.setattr(Path, "open", fail)


def test_repeats_unreadable_frame_and_keeps_its_file(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        make_unreadable(["0003_light_001.cr2"], patched)
        assert session.verify() == (
            "frames/0003_light_001.cr2 cannot be read: Input/output error; the frame is repeated",
        )
    assert verdicts(session, 3) == ["voided"]
    assert take_missing(session) == [3]
    assert (session.frames_folder / "0003_light_001.cr2").read_bytes() == b"frame 0003_light_001"


@pytest.mark.parametrize(
    ("code", "count", "message"),
    [
        (errno.EIO, MOST_UNREADABLE + 1, rf" and 3 more: {os.strerror(errno.EIO)}; check the disk"),
        (errno.EACCES, 1, rf": {os.strerror(errno.EACCES)}; check the disk, its cable and the permissions"),
    ],
)
def test_keeps_frames_that_may_be_intact(
    session: Session, monkeypatch: pytest.MonkeyPatch, code: int, count: int, message: str
) -> None:
    """So many files are not in bad sectors, and missing permissions are no damage."""
    names = [Path(frame.file).name for frame in session.journal.accepted_files()][:count]
    with monkeypatch.context() as patched:
        make_unreadable(names, patched, code)
        with pytest.raises(StorageError, match=f"{names[0]}{message}"):
            session.verify()
    assert session.done_steps() == set(range(9))


def test_missing_folder_of_frames_voids_nothing(session: Session) -> None:
    session.frames_folder.rename(session.folder / "elsewhere")
    with pytest.raises(FormatError):
        session.verify()
    (session.folder / "elsewhere").rename(session.frames_folder)
    assert session.done_steps() == set(range(9))


def test_repeats_the_given_illuminants(session: Session) -> None:
    assert session.retake("4, 1-2") == (1, 2, 4)
    assert take_missing(session) == [3, 4, 6]
    assert verdicts(session, 3) == ["voided", "accepted"]
    assert "--retake 1-2,4" in session.journal.attempts()[3].reason
    assert session.retake("1-2,4") == (1, 2, 4), "a request after completion repeats the frames again"
    assert take_missing(session) == [3, 4, 6]


def test_repeated_command_takes_nothing_twice(session: Session) -> None:
    session.retake("1,2")
    take_again(session, 3)
    session.retake("1-2")
    assert take_missing(session) == [4]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("900", "illuminant 900.*0 … 4"),
        ("3-7", "no illuminant 7"),
        ("4-2", r"4-2 is a reversed range; write 2-4"),
        ("white", "'white'"),
        ("²", "is not the number of an illuminant"),
        ("", "'' is not the number of an illuminant"),
    ],
)
def test_refuses_wrong_selections(session: Session, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        session.retake(text)
    assert session.done_steps() == set(range(9))


@pytest.mark.parametrize("text", ["0", "0-4", "1,3", "0-1,3-4"])
def test_parses_the_text_of_illuminants(text: str) -> None:
    assert lights_text(parse_lights(text, range(5))) == text


def write_report(
    folder: Path, lights: str, frames: Sequence[bytes], registered: bytes, age: int, newest: bytes = b"frame 0000_white"
) -> None:
    folder.mkdir()
    content: dict[str, object] = {
        "retake": lights,
        "retake_sha256": [hashlib.sha256(frame).hexdigest() for frame in frames],
        "registered_sha256": hashlib.sha256(registered).hexdigest(),
        "newest_sha256": hashlib.sha256(newest).hexdigest(),
    }
    (folder / "report.json").write_text(json.dumps(content))
    os.utime(folder / "report.json", (age, age))


def test_repeats_refusals_of_the_newest_report_once(session: Session, tmp_path: Path) -> None:
    white = b"frame 0000_white"
    write_report(tmp_path / "lut", "0", [b"frame 0002_light_000"], white, 100)
    write_report(tmp_path / "lut.refused", "2", [b"frame 0004_light_002", white], white, 200)
    write_report(tmp_path / "of another session", "3", [b"frame 0005_light_003"], b"another", 300, b"another")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "report.json").write_text("{")
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "report.json").write_text('{"format": "crop.report"}')
    assert session.retake("bad") == (2,)
    assert take_missing(session) == [0, 4], "refused references are repeated, too"
    assert "lut.refused/report.json" in session.journal.attempts()[4].reason
    session.retake("bad")
    assert take_missing(session) == [], "the report is about earlier frames"


def test_newest_report_has_the_newest_frame(session: Session, tmp_path: Path) -> None:
    white = b"frame 0000_white"
    write_report(tmp_path / "lut", "0", [b"frame 0002_light_000"], white, 900, newest=b"frame 0004_light_002")
    # The clock was set back before this report was written, which includes a later frame.
    write_report(tmp_path / "later", "1", [b"frame 0003_light_001"], white, 100, newest=b"frame 0006_light_004")
    # A copy of the session continued independently: its report says nothing about this one.
    write_report(tmp_path / "of a copy", "3", [b"frame 0005_light_003"], white, 999, newest=b"taken in the copy")
    assert session.retake("bad") == (1,)
    assert take_missing(session) == [3]


def test_bad_needs_a_report_on_this_session(session: Session, tmp_path: Path) -> None:
    write_report(tmp_path / "of another session", "3", [b"frame 0005_light_003"], b"another", 300)
    with pytest.raises(FormatError, match=r"build-lut on .*/s "):
        session.retake("bad")
