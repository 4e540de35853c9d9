"""Create, open and check the folder of a session.

A frame is recorded in two steps: first its raw file is written, flushed and renamed, then its row in the journal is
committed. If a crash happens between the steps, the next run appends `.stray` to the file name and ignores the
file. The journal is authoritative, and `frames.csv` is derived from it.
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
from experiment.lights import Illuminant, load_illuminants, save_illuminants
from experiment.session.journal import (
    JOURNAL_FILE,
    PATIENCE_S,
    IncomingFile,
    Journal,
    ReceivedFile,
    ledger_path,
    lost_files,
    no_journal_text,
    open_journal,
    read_ledger,
    time_text,
)
from experiment.session.opening import MOST_BYTES
from experiment.session.records import AcceptedFile, FrameRecord, SessionStep
from experiment.session.repair import (
    BAD,
    damaged_files,
    lights_text,
    newest_report,
    parse_lights,
    require_frames_folder,
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
    """Illuminants and frames that must be repeated."""

    lights: tuple[int, ...]  # numbers of the illuminants
    frames: tuple[AcceptedFile, ...]  # accepted frames that will be voided
    reason: str  # reason for the journal; empty if the frames are already voided
    text: str = ""  # numbers of the illuminants, as recorded in the journal; empty if a report lists the frames


_Loaded = TypeVar("_Loaded")


class Session:
    """An open session folder; close it, or use it in a `with` block.

    `hold`: lock of the folder against other runs, which is released by `close`; None for a reader.
    """

    def __init__(self, folder: Path, journal: Journal, hold: ExitStack | None = None) -> None:
        self.folder = folder
        self.frames_folder: Final = folder / "frames"  # raw files, exactly as the camera wrote them
        self.journal = journal
        self._hold = hold
        require_plain_folder(folder, MOST_BYTES, ("frames", "previews"))
        self.chart: Chart = _own_copy(load_chart, folder / "chart.json", "chart")
        self.illuminations: tuple[Illuminant, ...] = _own_copy(
            load_illuminants, folder / "illuminations.csv", "illuminations"
        )
        self.steps: tuple[SessionStep, ...] = journal.steps()
        self._require_planned_lights()

    # If illuminations.csv differed from the plan, frames would be assigned to wrong codes.
    def _require_planned_lights(self) -> None:
        for step in self.steps:
            if step.illumination is None:
                continue
            csv_rows = self.illuminations[step.illumination : step.illumination + 1]
            if not csv_rows or csv_rows[0].colour != step.colour:
                difference = "has no such illuminant" if not csv_rows else f"has {_codes(csv_rows[0].colour)}"
                raise FormatError(
                    f"{self.folder / 'illuminations.csv'} was changed after the session was planned: the file "
                    f"{difference}, illuminant {step.illumination} was planned as {_codes(step.colour)}; restore it "
                    "from a copy"
                )

    @classmethod
    def create(
        cls,
        folder: Path,
        settings: str,
        chart: Chart,
        illuminations: Sequence[Illuminant],
        steps: Sequence[SessionStep] = (),
    ) -> Session:
        """Create a new session folder, completely or not at all, and open it for a run.

        Parameters
        ----------
        settings
            Text of `session.toml`.
        steps
            The plan: every frame to take, in order.
        """
        with atomic_folder(folder, "the session") as new:
            (new / "frames").mkdir()
            write_atomic(new / "session.toml", settings)
            chart.save(new / "chart.json")
            save_illuminants(illuminations, new / "illuminations.csv")
            Journal.create(new / JOURNAL_FILE, steps)
        return cls.open_for_run(folder)

    @classmethod
    def open(cls, folder: Path) -> Session:
        """Open a session folder for reading, also while frames are taken; nothing is created or changed."""
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
        """Open a session folder for taking frames. It is locked until it is closed.

        Parameters
        ----------
        patience_s
            Longest time to wait for other programs that use the journal, seconds.
        announce
            Called with messages for the user.
        """
        path = folder / JOURNAL_FILE
        if not _is_file(path) and not _is_file(ledger_path(folder)):
            journal_path(folder)
        with ExitStack() as resources:
            resources.enter_context(locked_folder(folder, busy_message(folder)))
            if not _is_file(path):
                rebuild_journal(folder)
                announce(f"journal: {path} was missing and was restored from {ledger_path(folder)}")
            journal = Journal.open_for_run(path, patience_s, announce)
            resources.callback(journal.close)
            journal.attach_ledger(ledger_path(folder))
            session = cls(folder, journal, resources)
            session.write_frames_csv()
            session._hold = resources.pop_all()
        return session

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the journal and unlock the folder; a second call does nothing."""
        if self._hold is None:
            self.journal.close()
        else:
            self._hold.close()

    def settings_text(self) -> str:
        """Return the text of `session.toml`; `FormatError` if it is empty."""
        path, remedy = self.folder / "session.toml", "restore it from a copy"
        text = read_text(path, remedy, "the session's settings")
        if not text.strip():
            raise FormatError("empty, expected the settings of the session", about=path, remedy=remedy)
        return text

    def receive(self, stem: str, fill: Callable[[BinaryIO], CapturedFrame]) -> ReceivedFile:
        """Write a raw file into `frames/` with `fill`; the file is complete on disk when this returns."""
        with IncomingFile(self.frames_folder / stem) as incoming:
            return incoming.complete(fill(incoming.stream))

    def add_steps(self, steps: Sequence[SessionStep]) -> None:
        """Append steps to the plan; their numbers must be free."""
        self.journal.add_steps(steps)
        self.steps = self.journal.steps()

    def verify(self, observe: Callable[[int, int], None] = lambda done, total: None) -> tuple[str, ...]:
        """Void accepted frames whose files are missing or changed, so that they are repeated; return the reasons."""
        damaged = damaged_files(self.folder, self.journal.accepted_files(), observe)
        for attempt, reason in damaged.items():
            self.journal.void([attempt], datetime.now(UTC), reason)
        return tuple(damaged.values())

    def plan_retake(self, selection: str) -> Retake:
        """Return the frames that a selection such as "12,40-44" or "bad" would repeat; nothing is written.

        Raises
        ------
        InputError
            If the selection contains no illuminant of the session, or is "bad" and no report names a frame.
        """
        accepted = self.journal.accepted_files()
        valid_numbers = range(len(self.illuminations))
        if selection.strip() == BAD:
            refused = newest_report(self.folder, {frame.sha256: frame.attempt for frame in self.frames()})
            if not refused.sha256:
                raise InputError(
                    f"--retake bad: {refused.report}, the newest report on {self.folder}, has no frame to repeat; "
                    "omit --retake, or give numbers of illuminants, as in --retake 12,40-44"
                )
            retaken = tuple(frame for frame in accepted if frame.sha256 in refused.sha256)
            lights = parse_lights(refused.lights, valid_numbers) if refused.lights else ()
            return Retake(lights, retaken, f"refused by build-lut, see {refused.report}")
        lights = parse_lights(selection, valid_numbers)
        text = lights_text(lights)
        accepted_lights = {frame.illumination for frame in accepted}
        if self.journal.records().get("retake") == text and not accepted_lights.issuperset(lights):
            # The same request was made before, and its frames are not complete yet.
            return Retake(lights, (), "", text)
        retaken = tuple(frame for frame in accepted if frame.illumination in lights)
        return Retake(lights, retaken, f"to be repeated, as requested with --retake {text}", text)

    def retake(self, selection: str) -> tuple[int, ...]:
        """Void accepted frames so that they are repeated; return their illuminants."""
        plan = self.plan_retake(selection)
        if plan.text and plan.reason:
            self.journal.record("retake", plan.text)
        self.journal.void([frame.attempt for frame in plan.frames], datetime.now(UTC), plan.reason)
        return plan.lights

    def done_steps(self) -> set[int]:
        """Return the numbers of the steps whose accepted frame has a complete file."""
        accepted = self.journal.accepted_files()
        return {frame.step for frame in accepted} - {frame.step for frame in lost_files(self.folder, accepted)}

    def frames(self) -> list[FrameRecord]:
        """Return every frame that was taken and judged, also refused frames, in the order of the plan."""
        return self.journal.frames()

    def lost_files(self) -> list[AcceptedFile]:
        """Return the newest accepted frame of each step, if its file is missing or has another size."""
        require_frames_folder(self.folder)
        return lost_files(self.folder, self.journal.accepted_files())

    def write_frames_csv(self) -> None:
        """Write `frames.csv` from the journal."""
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
        """Delete partial files that a crash left, and rename complete files without a row in the journal."""
        try:
            return self._set_aside_strays()
        except OSError as error:
            raise storage_error(self.frames_folder, error, "clear") from error

    def _set_aside_strays(self) -> list[Path]:
        require_frames_folder(self.folder)
        recorded = {frame.file for frame in self.frames()}
        renamed: list[Path] = []
        for path in sorted(self.frames_folder.iterdir()):
            if is_partial(path.name):
                path.unlink()
            elif f"frames/{path.name}" not in recorded and not path.name.endswith(".stray"):
                target = path.with_name(path.name + ".stray")
                number = 1
                while target.exists():
                    number += 1
                    target = path.with_name(f"{path.name}.{number}.stray")
                path.rename(target)
                renamed.append(target)
        return renamed


def session_exists(folder: Path) -> bool:
    """Return whether `folder` is a session; refuse a folder with other contents."""
    if _is_file(folder / JOURNAL_FILE) or _is_file(ledger_path(folder)):
        return True
    if _is_file(folder / "session.toml") and (folder / "frames").is_dir():
        raise FormatError(no_journal_text(folder))
    _require_mounted(folder)
    require_free(folder, "the session")
    return False


def _own_copy(load: Callable[[Path], _Loaded], path: Path, content: str) -> _Loaded:
    try:
        return load(path)
    except FormatError as error:
        remedy = (
            f"restore it from a copy of the session, or copy the {content} file that session.toml names to this place"
        )
        raise FormatError(error.problem, about=error.about, remedy=remedy, value=error.value) from error


def busy_message(folder: Path) -> str:
    """Return the message for a session that another program is taking."""
    return f"another program is taking the session {folder}; wait for its end, or watch it with acquire status"


def journal_path(folder: Path) -> Path:
    """Return the path of a session's journal."""
    path = folder / JOURNAL_FILE
    if not _is_file(path):
        if _is_file(ledger_path(folder)) or (_is_file(folder / "session.toml") and (folder / "frames").is_dir()):
            raise FormatError(no_journal_text(folder))
        _require_mounted(folder)
        raise FormatError(
            f"{folder} is not a session: it has no {JOURNAL_FILE}; give a folder made by acquire run or import"
        )
    return path


def _require_mounted(folder: Path) -> None:
    if mount_point := unmounted_folder(folder):
        raise StorageError(
            f"no disk is mounted at {mount_point}, but /etc/fstab lists one, so {folder} is not on that disk",
            remedy="mount the disk, or give a folder on another disk",
        )
    if os.path.isdir(folder / "frames"):  # noqa: PTH112 - a fault of the disk is reported later
        raise FormatError(
            f"{folder} is not a session but has frames/: it is a part of a session, or was written while its disk was "
            "not mounted; mount the disk of the session, or give another folder, and keep these files until their "
            "origin is clear",
        )


def rebuild_journal(folder: Path) -> int:
    """Restore the journal of a session from its ledger; return its number of attempts.

    The existing journal is kept under another name.
    """
    ledger = ledger_path(folder)
    rows = read_ledger(ledger)
    if "plan" not in rows:
        raise FormatError(f"{ledger} has no plan; restore the session from a copy")
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
