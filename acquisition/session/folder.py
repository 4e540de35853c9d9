"""A session: the folder in which an experiment is taken, and its journal.

Rules that hold inside:

- A frame counts as taken when its raw file is complete on disk (written, flushed, renamed) *and* its journal row is
  committed, in that order. Whatever a crash leaves between the two is set aside, never counted, never deleted.
- The journal (`journal.sqlite`) is the truth: every attempt, verdict and event. `frames.csv` is derived from it.
- Nothing here touches a device; readers of a session need nothing else from this package than this file, the chart
  and the illuminations.
"""

from __future__ import annotations

import csv
import io
import sqlite3
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Literal

from acquisition.chart.model import Chart, load_chart
from acquisition.lights.illuminations import Illumination, load_illuminations, save_illuminations
from drivers.camera import CapturedFrame
from drivers.presenter import BLACK, WHITE, Colour
from foundation.errors import DeviceError, FormatError, StorageError
from foundation.files import is_partial, require_free, whole_file, whole_folder, write_whole
from foundation.hashing import stream_sha256
from foundation.held_folders import held_folder

FrameKind = Literal["light", "white", "dark"]
FRAME_COLUMNS = ("kind", "illumination", "file", "sha256", "taken_at", "exposure_s", "verdict")
ACCEPTED = "accepted"
REFUSED = "refused"
FAILED = "failed"
JOURNAL_VERSION = 1

_SCHEMA = """
CREATE TABLE attempts (
    id INTEGER PRIMARY KEY,
    step INTEGER NOT NULL,
    kind TEXT NOT NULL,
    illumination INTEGER,
    file TEXT NOT NULL,
    started_at TEXT NOT NULL,
    ended_at TEXT,
    taken_at TEXT,
    exposure_s REAL,
    size INTEGER,
    sha256 TEXT,
    verdict TEXT,
    reason TEXT NOT NULL DEFAULT ''
);
CREATE TABLE plan (
    step INTEGER PRIMARY KEY, kind TEXT NOT NULL, illumination INTEGER,
    red INTEGER NOT NULL, green INTEGER NOT NULL, blue INTEGER NOT NULL
);
CREATE TABLE events (id INTEGER PRIMARY KEY, at TEXT NOT NULL, what TEXT NOT NULL, detail TEXT NOT NULL);
"""

_TABLES = {"attempts", "plan", "events"}


@dataclass(frozen=True)
class Step:
    """One frame of the plan: `number` in taking order, what kind, under which light, showing which codes."""

    number: int
    kind: FrameKind
    illumination: int | None
    colour: Colour

    @property
    def stem(self) -> str:
        """The file name without suffix, e.g. ``0007_light_005``; sorts in taking order."""
        tail = "" if self.illumination is None else f"_{self.illumination:03d}"
        return f"{self.number:04d}_{self.kind}{tail}"


def plan_steps(illuminations: Sequence[Illumination], reference_every: int) -> tuple[Step, ...]:
    """Return the whole session as data: a white and a dark frame first, every `reference_every` lights, and last.

    Parameters
    ----------
    illuminations
        Lights in the order in which they are to be shown.
    reference_every
        Lights between two pairs of white and dark frames, ≥ 1.
    """
    steps: list[Step] = []

    def add(kind: FrameKind, illumination: int | None, colour: Colour) -> None:
        steps.append(Step(len(steps), kind, illumination, colour))

    for position, light in enumerate(illuminations):
        if position % reference_every == 0:
            add("white", None, WHITE)
            add("dark", None, BLACK)
        add("light", light.index, light.colour)
    add("white", None, WHITE)
    add("dark", None, BLACK)
    return tuple(steps)


@dataclass(frozen=True)
class FrameRecord:
    """A frame that counts as taken and judged; the row of `frames.csv`.

    `file` is relative to the session's folder; `illumination` is None for white and dark frames; `verdict` is
    ``accepted`` or ``refused: reason``.
    """

    kind: FrameKind
    illumination: int | None
    file: str
    sha256: str
    taken_at: datetime
    exposure_s: float
    verdict: str

    @property
    def accepted(self) -> bool:
        """Whether the frame may be used."""
        return self.verdict == ACCEPTED


@dataclass(frozen=True)
class Attempt:
    """One try at a step as the journal has it.

    `verdict` is None while it is under way, or if it was cut off; `has_frame` tells whether a raw file came of it.
    """

    id: int
    step: int
    kind: FrameKind
    illumination: int | None
    file: str
    started_at: datetime
    ended_at: datetime | None
    verdict: str | None
    reason: str
    has_frame: bool


@dataclass(frozen=True)
class Event:
    """Something worth remembering that is no frame: start, stop, warm-up, a device's fault."""

    at: datetime
    what: str
    detail: str


@dataclass(frozen=True)
class Received:
    """A raw file that is complete on the disk, not yet counted."""

    path: Path
    size: int
    sha256: str
    captured: CapturedFrame


class Session:
    """An open session folder; close it, or use it in a `with` block."""

    def __init__(self, folder: Path, journal: sqlite3.Connection) -> None:
        self.folder = folder
        self._journal = journal
        self.chart: Chart = load_chart(folder / "chart.json")
        self.illuminations: tuple[Illumination, ...] = load_illuminations(folder / "illuminations.csv")
        rows = journal.execute("SELECT step, kind, illumination, red, green, blue FROM plan ORDER BY step")
        self.steps: tuple[Step, ...] = tuple(Step(row[0], row[1], row[2], Colour(*row[3:])) for row in rows)
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

    @property
    def frames_folder(self) -> Path:
        """Where the raw files are, exactly as the camera wrote them."""
        return self.folder / "frames"

    @classmethod
    def create(
        cls,
        folder: Path,
        settings: str,
        chart: Chart,
        illuminations: Sequence[Illumination],
        steps: Sequence[Step] = (),
    ) -> Session:
        """Make a new session folder, whole or not at all, and open it.

        Parameters
        ----------
        settings
            Text of `session.toml`: the settings as used.
        steps
            The plan: every frame to take, in order.

        Raises
        ------
        InputError
            The folder holds something already.
        StorageError
            It cannot be written.
        """
        with whole_folder(folder, "the session") as new:
            (new / "frames").mkdir()
            write_whole(new / "session.toml", settings)
            chart.save(new / "chart.json")
            save_illuminations(illuminations, new / "illuminations.csv")
            journal = _connect(new / "journal.sqlite")
            journal.executescript(_SCHEMA)
            with journal:
                journal.executemany(
                    "INSERT INTO plan VALUES (?, ?, ?, ?, ?, ?)",
                    [(step.number, step.kind, step.illumination, *astuple(step.colour)) for step in steps],
                )
            journal.execute(f"PRAGMA user_version = {JOURNAL_VERSION}")
            journal.close()
        session = cls.open(folder)
        session.write_frames_csv()
        return session

    @classmethod
    def open(cls, folder: Path) -> Session:
        """Open a session folder.

        Raises
        ------
        FormatError
            The folder is no session, one of a version not known here, or its lights are not those of its plan.
        """
        path = folder / "journal.sqlite"
        if not path.is_file():
            raise FormatError(
                f"{folder} is no session: it holds no journal.sqlite; name a folder made by acquire run or import"
            )
        try:
            # SQLite calls a file that it may not read, too, one that it cannot open.
            path.open("rb").close()
            journal = _connect(path)
            version = journal.execute("PRAGMA user_version").fetchone()[0]
            tables = {name for (name,) in journal.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        except OSError as error:
            raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
        except sqlite3.OperationalError as error:
            raise FormatError(f"cannot read {path}: {error}; see that no other program holds it") from error
        except sqlite3.DatabaseError as error:
            raise FormatError(f"{path} is damaged: {error}; restore it from a copy") from error
        if version != JOURNAL_VERSION:
            journal.close()
            raise FormatError(f"{path} is of version {version}, this software reads {JOURNAL_VERSION}")
        if lacking := _TABLES - tables:
            journal.close()
            raise FormatError(
                f"{path} is damaged: it lacks its table {' and '.join(sorted(lacking))}; restore it from a copy"
            )
        try:
            return cls(folder, journal)
        except BaseException:
            journal.close()
            raise

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the journal; a second call does nothing."""
        self._journal.close()

    @contextmanager
    def held(self) -> Generator[None]:
        """Hold the session for writing, so that two programs never take it at once.

        Raises
        ------
        InputError
            Another program holds it.
        """
        busy = f"{self.folder} is being taken by another program; wait for it, or look with acquire status"
        with held_folder(self.folder, busy):
            yield

    def settings(self) -> str:
        """Return the text of `session.toml`.

        Raises
        ------
        FormatError
            It is missing or cannot be read.
        """
        path = self.folder / "session.toml"
        try:
            return path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise FormatError(
                f"cannot read {path}, the settings of the session: {reason}; restore it from a copy"
            ) from error

    def begin(self, step: Step, file: str, at: datetime) -> int:
        """Note that an attempt at `step` begins, to be saved as `file`; return the attempt's id."""
        with self._writing():
            cursor = self._journal.execute(
                "INSERT INTO attempts (step, kind, illumination, file, started_at) VALUES (?, ?, ?, ?, ?)",
                (step.number, step.kind, step.illumination, file, _text(at)),
            )
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def receive(self, stem: str, capture: Callable[[BinaryIO], CapturedFrame]) -> Received:
        """Let the camera write a raw file into `frames/`; it is complete and on the disk when this returns.

        Parameters
        ----------
        stem
            Name without suffix; the suffix is that of the camera's own file name.
        capture
            Writes the whole raw file into the stream it is given; `drivers.camera.Camera.capture`.

        Raises
        ------
        DeviceError
            The camera failed, or wrote another number of bytes than it says. Nothing is left behind.
        StorageError
            The disk is full, read-only or gone. Nothing is left behind.
        """
        path = self.frames_folder / stem
        with whole_file(path, lambda: path) as stream:
            captured = capture(stream)
            size = stream.seek(0, 2)
            if size != captured.size or size == 0:
                raise DeviceError(
                    f"{captured.name}: the camera says {captured.size} bytes, {size} arrived; the frame is taken again"
                )
            stream.seek(0)
            sha256 = stream_sha256(stream)
            path = path.with_name(stem + Path(captured.name).suffix.lower())
        return Received(path, size, sha256, captured)

    def commit(
        self,
        attempt: int,
        *,
        file: str,
        size: int,
        sha256: str,
        taken_at: datetime,
        exposure_s: float,
        ended_at: datetime,
        verdict: str,
        reason: str = "",
    ) -> None:
        """Note that an attempt's raw file is complete and how it was judged; only now does the frame count."""
        with self._writing():
            self._journal.execute(
                "UPDATE attempts SET file=?, size=?, sha256=?, taken_at=?, exposure_s=?, ended_at=?, verdict=?,"
                " reason=? WHERE id=?",
                (file, size, sha256, _text(taken_at), exposure_s, _text(ended_at), verdict, reason, attempt),
            )
        self.write_frames_csv()

    def fail(self, attempt: int, at: datetime, reason: str) -> None:
        """Note that an attempt gave no frame."""
        with self._writing():
            self._journal.execute(
                "UPDATE attempts SET ended_at=?, verdict=?, reason=? WHERE id=?", (_text(at), FAILED, reason, attempt)
            )

    def note(self, at: datetime, what: str, detail: str = "") -> None:
        """Note an event."""
        with self._writing():
            self._journal.execute("INSERT INTO events (at, what, detail) VALUES (?, ?, ?)", (_text(at), what, detail))

    def attempts(self) -> list[Attempt]:
        """Return every attempt, oldest first."""
        rows = self._journal.execute(
            "SELECT id, step, kind, illumination, file, started_at, ended_at, verdict, reason, sha256 IS NOT NULL"
            " FROM attempts ORDER BY id"
        )
        return [
            Attempt(
                row[0],
                row[1],
                row[2],
                row[3],
                row[4],
                datetime.fromisoformat(row[5]),
                datetime.fromisoformat(row[6]) if row[6] else None,
                row[7],
                row[8],
                bool(row[9]),
            )
            for row in rows
        ]

    def events(self) -> list[Event]:
        """Return every event, oldest first."""
        rows = self._journal.execute("SELECT at, what, detail FROM events ORDER BY id")
        return [Event(datetime.fromisoformat(row[0]), row[1], row[2]) for row in rows]

    def done_steps(self) -> set[int]:
        """Return the numbers of the steps whose frame was taken, accepted, and is still there in full size."""
        rows = self._journal.execute("SELECT step, file, size FROM attempts WHERE verdict=?", (ACCEPTED,))
        return {step for step, file, size in rows if _has_size(self.folder / file, size)}

    def kept_files(self, step: Step) -> int:
        """Return how many raw files, accepted or refused, `step` has already."""
        query = "SELECT COUNT(*) FROM attempts WHERE step=? AND sha256 IS NOT NULL"
        return int(self._journal.execute(query, (step.number,)).fetchone()[0])

    def frames(self) -> list[FrameRecord]:
        """Return every frame that was taken and judged, in the order of the plan, refused ones included."""
        rows = self._journal.execute(
            "SELECT kind, illumination, file, sha256, taken_at, exposure_s, verdict, reason FROM attempts"
            " WHERE sha256 IS NOT NULL ORDER BY step, id"
        )
        return [
            FrameRecord(
                row[0],
                row[1],
                row[2],
                row[3],
                datetime.fromisoformat(row[4]),
                row[5],
                row[6] if not row[7] else f"{row[6]}: {row[7]}",
            )
            for row in rows
        ]

    def write_frames_csv(self) -> None:
        """Derive `frames.csv` anew from the journal."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(FRAME_COLUMNS)
        for frame in self.frames():
            writer.writerow(
                [
                    frame.kind,
                    "" if frame.illumination is None else frame.illumination,
                    frame.file,
                    frame.sha256,
                    _text(frame.taken_at),
                    f"{frame.exposure_s:.9g}",
                    frame.verdict,
                ]
            )
        write_whole(self.folder / "frames.csv", text.getvalue())

    def set_aside_strays(self) -> list[Path]:
        """Clear what a crash left: hidden partial files go, complete files that no row counts are renamed.

        Returns
        -------
        list of Path
            The new names of the files set aside; their content is untouched.

        Raises
        ------
        FormatError
            The folder of the frames is missing.
        """
        if not self.frames_folder.is_dir():
            raise FormatError(
                f"{self.frames_folder} is missing, where the session's raw files are; restore it from a copy, or begin "
                "a new session"
            )
        counted = {frame.file for frame in self.frames()}
        moved: list[Path] = []
        for path in sorted(self.frames_folder.iterdir()):
            if is_partial(path):
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

    @contextmanager
    def _writing(self) -> Generator[None]:
        try:
            with self._journal:
                yield
        except sqlite3.OperationalError as error:
            raise StorageError(
                f"cannot write {self.folder / 'journal.sqlite'}: {error}; free space, or end the other program that "
                "holds the session, then run the same command again"
            ) from error


def session_exists(folder: Path) -> bool:
    """Return whether `folder` is a session; refuse when it holds something else.

    Raises
    ------
    InputError
        The folder holds something that is no session.
    """
    if (folder / "journal.sqlite").is_file():
        return True
    require_free(folder, "the session")
    return False


def _connect(path: Path) -> sqlite3.Connection:
    journal = sqlite3.connect(path, timeout=10)
    try:
        # A committed row must survive a power cut: it is what makes a frame count.
        journal.execute("PRAGMA synchronous = FULL")
    except sqlite3.DatabaseError:
        journal.close()
        raise
    return journal


def _codes(colour: Colour) -> str:
    return f"{colour.red} {colour.green} {colour.blue}"


def _text(at: datetime) -> str:
    return at.isoformat(timespec="microseconds")


def _has_size(path: Path, size: int) -> bool:
    try:
        return path.stat().st_size == size
    except OSError:
        return False
