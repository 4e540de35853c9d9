"""A session: the folder in which an experiment is taken; nothing here touches a device.

A frame counts as taken when its raw file is complete on disk (written, flushed, renamed) *and* its journal row is
committed, in that order. Whatever a crash leaves between the two is set aside, never counted, never deleted. The
journal is the truth; `frames.csv` is derived from it.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.chart.model import Chart, load_chart
from experiment.lights import Illumination, load_illuminations, save_illuminations
from experiment.session.journal import (
    JOURNAL_FILE,
    PATIENCE_S,
    IncomingFile,
    Journal,
    ReceivedFile,
    ledger_path,
    lost_files,
    open_journal,
    read_ledger,
    time_text,
    without_journal,
)
from experiment.session.opening import MOST_BYTES
from experiment.session.records import AcceptedFile, FrameRecord, SessionStep
from experiment.session.repair import (
    BAD,
    lights_text,
    newest_report,
    parse_lights,
    require_frames_folder,
    unsound_files,
)
from foundation.errors import FormatError, InputError, StorageError
from foundation.files import (
    csv_text,
    is_partial,
    read_text,
    reading_error,
    require_plain_folder,
    storage_error,
    write_atomic,
)
from foundation.folders import atomic_folder, locked_folder, require_free, unmounted_folder

# Columns of `frames.csv` (docs/formats.md).
FRAME_COLUMNS = ("kind", "illumination", "file", "sha256", "taken_at", "exposure_s", "verdict")


@dataclass(frozen=True)
class Retake:
    """What is to be taken again.

    - `lights`: their numbers.
    - `frames`: accepted frames that will be voided.
    - `reason`: why, for the journal; empty where they have been.
    - `text`: the lights as a record of the journal; empty where a report names the frames.
    """

    lights: tuple[int, ...]
    frames: tuple[AcceptedFile, ...]
    reason: str
    text: str = ""


_Loaded = TypeVar("_Loaded")


class Session:
    """An open session folder; close it, or use it in a `with` block.

    `hold`: what holds the folder against other runs, released at the end; None for a reader.
    """

    def __init__(self, folder: Path, journal: Journal, hold: ExitStack | None = None) -> None:
        self.folder = folder
        self.frames_folder: Final = folder / "frames"
        """Where the raw files are, exactly as the camera wrote them."""
        self.journal = journal
        self._hold = hold
        require_plain_folder(folder, MOST_BYTES, ("frames", "previews"))
        self.chart: Chart = _own_copy(load_chart, folder / "chart.json", "chart")
        self.illuminations: tuple[Illumination, ...] = _own_copy(
            load_illuminations, folder / "illuminations.csv", "lights"
        )
        self.steps: tuple[SessionStep, ...] = journal.steps()
        self._require_planned_lights()

    def _require_planned_lights(self) -> None:
        """Refuse lights that are not those of the plan: what was shown would bear other codes."""
        for step in self.steps:
            if step.illumination is None:
                continue
            known = self.illuminations[step.illumination : step.illumination + 1]
            if not known or known[0].colour != step.colour:
                says = "has no such light" if not known else f"says {_codes(known[0].colour)}"
                raise FormatError(
                    f"{self.folder / 'illuminations.csv'} is not what the session was taken with: light "
                    f"{step.illumination} was planned as {_codes(step.colour)}, the file {says}; "
                    "restore it from a copy"
                )

    @classmethod
    def create(
        cls,
        folder: Path,
        settings: str,
        chart: Chart,
        illuminations: Sequence[Illumination],
        steps: Sequence[SessionStep] = (),
    ) -> Session:
        """Make a new session folder, whole or not at all, and open it.

        `steps`: the plan: every frame to take, in order.
        """
        with atomic_folder(folder, "the session") as new:
            (new / "frames").mkdir()
            write_atomic(new / "session.toml", settings)
            chart.save(new / "chart.json")
            save_illuminations(illuminations, new / "illuminations.csv")
            Journal.create(new / JOURNAL_FILE, steps)
        return cls.open_for_run(folder)

    @classmethod
    def open(cls, folder: Path) -> Session:
        """Open a session folder to read it, also while it is being taken; nothing in it is created or changed."""
        journal_path(folder)
        journal = open_journal(folder)
        try:
            return cls(folder, journal)
        except BaseException:
            journal.close()
            raise

    @classmethod
    def open_for_run(
        cls,
        folder: Path,
        patience_s: float = PATIENCE_S,
        announce: Callable[[str], object] = lambda sentence: None,
    ) -> Session:
        """Open a session folder to take frames into it.

        It is held until it is closed, and `frames.csv` is made anew.
        """
        path = folder / JOURNAL_FILE
        if not _is_file(path) and not _is_file(ledger_path(folder)):
            journal_path(folder)
        with ExitStack() as opened:
            opened.enter_context(locked_folder(folder, busy_sentence(folder)))
            if not _is_file(path):
                rebuild_journal(folder)
                announce(f"journal: {path} was gone, and was made anew from {ledger_path(folder)}")
            journal = Journal.open_for_run(path, patience_s, announce)
            opened.callback(journal.close)
            journal.keep_twice(ledger_path(folder))
            session = cls(folder, journal, opened)
            session.write_frames_csv()
            session._hold = opened.pop_all()
        return session

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release journal and folder; a second call does nothing."""
        if self._hold is None:
            self.journal.close()
        else:
            self._hold.close()

    def settings_text(self) -> str:
        """Return the text of `session.toml`; one that says nothing is damaged."""
        path, remedy = self.folder / "session.toml", "restore it from a copy"
        text = read_text(path, remedy, "the session's settings")
        if not text.strip():
            raise FormatError(
                "empty; the settings with which a session was begun stand in it", about=path, remedy=remedy
            )
        return text

    def receive(self, stem: str, fill: Callable[[BinaryIO], CapturedFrame]) -> ReceivedFile:
        """Let a raw file be written into `frames/`; it is complete and on the disk when this returns."""
        with IncomingFile(self.frames_folder / stem) as incoming:
            return incoming.complete(fill(incoming.stream))

    def add_steps(self, steps: Sequence[SessionStep]) -> None:
        """Put steps at the end of the plan; their numbers must be free."""
        self.journal.add_steps(steps)
        self.steps = self.journal.steps()

    def verify(self, observe: Callable[[int, int], None] = lambda done, total: None) -> tuple[str, ...]:
        """Void the accepted frames whose files are gone or changed, so that they are taken again; return why, each."""
        unsound = unsound_files(self.folder, self.journal.accepted_files(), observe)
        for attempt, reason in unsound.items():
            self.journal.void([attempt], datetime.now(UTC), reason)
        return tuple(unsound.values())

    def asked_again(self, selection: str) -> Retake:
        """Return what a selection such as "12,40-44" or "bad" would take again; nothing is written.

        Raises
        ------
        InputError
            It names no light of the session, or "bad" and no report names a frame.
        """
        accepted = self.journal.accepted_files()
        known = range(len(self.illuminations))
        if selection.strip() == BAD:
            refused = newest_report(self.folder, {frame.sha256: frame.attempt for frame in self.frames()})
            if not refused.sha256:
                raise InputError(
                    f"--retake bad: {refused.report}, the newest report on {self.folder}, names no frame to be taken "
                    "again; leave --retake out, or name the lights, as in --retake 12,40-44"
                )
            chosen = tuple(frame for frame in accepted if frame.sha256 in refused.sha256)
            lights = parse_lights(refused.lights, known) if refused.lights else ()
            return Retake(lights, chosen, f"refused by build-lut, as {refused.report} says")
        lights = parse_lights(selection, known)
        asked = lights_text(lights)
        done = {frame.illumination for frame in accepted}
        if self.journal.records().get("retake") == asked and not done.issuperset(lights):
            # It was asked for before, and is not done yet.
            return Retake(lights, (), "", asked)
        chosen = tuple(frame for frame in accepted if frame.illumination in lights)
        return Retake(lights, chosen, f"to be taken again, as asked for with --retake {asked}", asked)

    def retake(self, selection: str) -> tuple[int, ...]:
        """Void accepted frames so that they are taken again; return the lights that this is about."""
        asked = self.asked_again(selection)
        if asked.text and asked.reason:
            self.journal.record("retake", asked.text)
        self.journal.void([frame.attempt for frame in asked.frames], datetime.now(UTC), asked.reason)
        return asked.lights

    def done_steps(self) -> set[int]:
        """Return the numbers of the steps whose frame was taken, accepted, and is still there in full size."""
        accepted = self.journal.accepted_files()
        return {frame.step for frame in accepted} - {frame.step for frame in lost_files(self.folder, accepted)}

    def frames(self) -> list[FrameRecord]:
        """Return every frame that was taken and judged, in the order of the plan, refused ones included."""
        return self.journal.frames()

    def lost_files(self) -> list[AcceptedFile]:
        """Return the frames that count, one a step, whose files are not there in full size any more."""
        require_frames_folder(self.folder)
        return lost_files(self.folder, self.journal.accepted_files())

    def write_frames_csv(self) -> None:
        """Derive `frames.csv` anew from the journal."""
        rows = (
            [
                frame.kind,
                frame.illumination,
                frame.file,
                frame.sha256,
                time_text(frame.taken_at),
                f"{frame.exposure_s:.9g}",
                frame.verdict,
            ]
            for frame in self.frames()
        )
        write_atomic(self.folder / "frames.csv", csv_text([FRAME_COLUMNS, *rows]))

    def set_aside_strays(self) -> list[Path]:
        """Clear what a crash left: hidden partial files go, complete files that no row counts are renamed."""
        try:
            return self._set_aside_strays()
        except OSError as error:
            raise storage_error(self.frames_folder, error, "clear") from error

    def _set_aside_strays(self) -> list[Path]:
        require_frames_folder(self.folder)
        counted = {frame.file for frame in self.frames()}
        moved: list[Path] = []
        for path in sorted(self.frames_folder.iterdir()):
            if is_partial(path.name):
                path.unlink()
            elif f"frames/{path.name}" not in counted and not path.name.endswith(".stray"):
                target = path.with_name(path.name + ".stray")
                number = 1
                while target.exists():
                    number += 1
                    target = path.with_name(f"{path.name}.{number}.stray")
                path.rename(target)
                moved.append(target)
        return moved


def session_exists(folder: Path) -> bool:
    """Return whether `folder` is a session; refuse when it holds something else."""
    if _is_file(folder / JOURNAL_FILE) or _is_file(ledger_path(folder)):
        return True
    if _is_file(folder / "session.toml") and (folder / "frames").is_dir():
        raise FormatError(without_journal(folder))
    _require_mounted(folder)
    require_free(folder, "the session")
    return False


def _own_copy(load: Callable[[Path], _Loaded], path: Path, what: str) -> _Loaded:
    """Return what a session's own copy of a file holds that LAB.toml named; one that is lost is had there again."""
    try:
        return load(path)
    except FormatError as error:
        remedy = (
            f"restore it from a copy of the session, or copy the {what} there with which it was begun, as its "
            "session.toml names them"
        )
        raise FormatError(error.problem, about=error.about, remedy=remedy, value=error.value) from error


def busy_sentence(folder: Path) -> str:
    """Return what is said where another program takes a session."""
    return f"{folder} is being taken by another program; wait for it, or look with acquire status"


def journal_path(folder: Path) -> Path:
    """Return the path of a session's journal."""
    path = folder / JOURNAL_FILE
    if not _is_file(path):
        if _is_file(ledger_path(folder)) or (_is_file(folder / "session.toml") and (folder / "frames").is_dir()):
            raise FormatError(without_journal(folder))
        _require_mounted(folder)
        raise FormatError(
            f"{folder} is no session: it holds no {JOURNAL_FILE}; name a folder made by acquire run or import"
        )
    return path


def _require_mounted(folder: Path) -> None:
    if place := unmounted_folder(folder):
        raise StorageError(
            f"nothing is mounted at {place}, where /etc/fstab has a disk, so that {folder} is not the folder on it",
            remedy="mount it, or name a folder on another disk",
        )
    if os.path.isdir(folder / "frames"):  # noqa: PTH112 - a disk that cannot be asked is told by what comes next
        raise FormatError(
            f"{folder} is no session, and has frames/: a part of one, or what was left below the place where a disk is "
            f"mounted; see that the disk of the session is mounted, or name another folder; keep what is there until "
            "it is known what it is",
        )


def rebuild_journal(folder: Path) -> int:
    """Make a session's journal anew from its ledger; return how many attempts it holds.

    The journal that is there keeps its bytes under another name.
    """
    ledger = ledger_path(folder)
    rows = read_ledger(ledger)
    if "plan" not in rows:
        raise FormatError(f"{ledger} holds no plan; restore the session from a copy")
    try:
        Journal.rebuild(folder / JOURNAL_FILE, rows)
    except OSError as error:
        raise storage_error(folder / JOURNAL_FILE, error) from error
    except sqlite3.Error as error:
        raise FormatError(f"{ledger} is damaged: {error}; restore the session from a copy") from error
    return len(rows.get("attempts", {}))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError as error:
        raise reading_error(path, error, "check its permissions") from error


def _codes(colour: Colour) -> str:
    return f"{colour.red} {colour.green} {colour.blue}"
