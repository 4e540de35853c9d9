"""The journal of a session, `journal.sqlite`: the plan, every attempt at its frames, their verdicts, and events.

Rules that hold inside:

- The journal is written before and after each frame; every write is a transaction of its own and on the disk when the
  call returns, since a committed row is what makes a frame count.
- Rows are never deleted. Times are ISO 8601 text with microseconds and zone, files are named relative to the session's
  folder.

Knows one file; `acquisition.session.folder` knows which raw files are really there.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from datetime import datetime
from pathlib import Path

from acquisition.session.plan import FrameKind, SessionStep
from drivers.presenter import Colour
from foundation.errors import FormatError, StorageError

ACCEPTED = "accepted"
"""Verdict of a frame that may be used."""

REFUSED = "refused"
"""Verdict of a frame that is there and cannot be used."""

FAILED = "failed"
"""Verdict of an attempt that gave no frame."""

JOURNAL_VERSION = 1
"""`PRAGMA user_version` of the journals that this software writes and reads (docs/formats.md)."""

JOURNAL_FILE = "journal.sqlite"
"""Name of the journal in a session's folder."""

BUSY_LIMIT_S = 10
"""How long a write waits for another program's; a write takes milliseconds, and a disk may stall for seconds."""

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

    `verdict` is None while it is under way, or if it was cut off; `has_frame` is whether a raw file came of it.
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
class SessionEvent:
    """What happened at some time that is no frame: start, stop, warm-up, a device's fault."""

    at: datetime
    what: str
    detail: str


class Journal:
    """An open journal; close it after use.

    Parameters
    ----------
    path
        The file, for messages.
    connection
        To the same file; the journal closes it.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path = path
        self._connection = connection

    @staticmethod
    def create(path: Path, steps: Sequence[SessionStep]) -> None:
        """Write a new journal with the plan and nothing else.

        Raises
        ------
        StorageError
            The disk is full, read-only or gone.
        """
        connection = _connect(path)
        connection.executescript(_SCHEMA)
        with connection:
            connection.executemany(
                "INSERT INTO plan VALUES (?, ?, ?, ?, ?, ?)",
                [(step.number, step.kind, step.illumination, *astuple(step.colour)) for step in steps],
            )
        connection.execute(f"PRAGMA user_version = {JOURNAL_VERSION}")
        connection.close()

    @classmethod
    def open(cls, path: Path) -> Journal:
        """Open a journal.

        Raises
        ------
        FormatError
            It cannot be read, is damaged, or of a version not known here.
        """
        try:
            # SQLite calls a file that it may not read, too, one that it cannot open.
            path.open("rb").close()
            connection = _connect(path)
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        except OSError as error:
            raise FormatError(f"cannot read {path}: {error.strerror}; check its permissions and the disk") from error
        except sqlite3.OperationalError as error:
            raise FormatError(f"cannot read {path}: {error}; see that no other program holds it") from error
        except sqlite3.DatabaseError as error:
            raise FormatError(f"{path} is damaged: {error}; restore it from a copy") from error
        if version != JOURNAL_VERSION:
            connection.close()
            raise FormatError(f"{path} is of version {version}, this software reads {JOURNAL_VERSION}")
        if lacking := _TABLES - tables:
            connection.close()
            raise FormatError(
                f"{path} is damaged: it lacks its table {' and '.join(sorted(lacking))}; restore it from a copy"
            )
        return cls(path, connection)

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        self._connection.close()

    def steps(self) -> tuple[SessionStep, ...]:
        """Return the plan, in taking order."""
        rows = self._connection.execute("SELECT step, kind, illumination, red, green, blue FROM plan ORDER BY step")
        return tuple(SessionStep(row[0], row[1], row[2], Colour(*row[3:])) for row in rows)

    def begin(self, step: SessionStep, file: str, at: datetime) -> int:
        """Note that an attempt at `step` begins, to be saved as `file`; return the attempt's id."""
        with self._writing():
            cursor = self._connection.execute(
                "INSERT INTO attempts (step, kind, illumination, file, started_at) VALUES (?, ?, ?, ?, ?)",
                (step.number, step.kind, step.illumination, file, time_text(at)),
            )
        assert cursor.lastrowid is not None
        return cursor.lastrowid

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
            self._connection.execute(
                "UPDATE attempts SET file=?, size=?, sha256=?, taken_at=?, exposure_s=?, ended_at=?, verdict=?,"
                " reason=? WHERE id=?",
                (file, size, sha256, time_text(taken_at), exposure_s, time_text(ended_at), verdict, reason, attempt),
            )

    def fail(self, attempt: int, at: datetime, reason: str) -> None:
        """Note that an attempt gave no frame."""
        with self._writing():
            self._connection.execute(
                "UPDATE attempts SET ended_at=?, verdict=?, reason=? WHERE id=?",
                (time_text(at), FAILED, reason, attempt),
            )

    def note(self, at: datetime, what: str, detail: str = "") -> None:
        """Note an event."""
        with self._writing():
            self._connection.execute(
                "INSERT INTO events (at, what, detail) VALUES (?, ?, ?)", (time_text(at), what, detail)
            )

    def attempts(self) -> list[Attempt]:
        """Return every attempt, oldest first."""
        rows = self._connection.execute(
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

    def events(self) -> list[SessionEvent]:
        """Return every event, oldest first."""
        rows = self._connection.execute("SELECT at, what, detail FROM events ORDER BY id")
        return [SessionEvent(datetime.fromisoformat(row[0]), row[1], row[2]) for row in rows]

    def accepted_files(self) -> list[tuple[int, str, int]]:
        """Return the step, the file and the bytes of every frame that was accepted, oldest first."""
        query = "SELECT step, file, size FROM attempts WHERE verdict=? ORDER BY id"
        return [(step, file, size) for step, file, size in self._connection.execute(query, (ACCEPTED,))]

    def kept_files(self, step: SessionStep) -> int:
        """Return how many raw files, accepted or refused, `step` has already."""
        query = "SELECT COUNT(*) FROM attempts WHERE step=? AND sha256 IS NOT NULL"
        return int(self._connection.execute(query, (step.number,)).fetchone()[0])

    def frames(self) -> list[FrameRecord]:
        """Return every frame that was taken and judged, in the order of the plan, refused ones included."""
        rows = self._connection.execute(
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

    @contextmanager
    def _writing(self) -> Generator[None]:
        try:
            with self._connection:
                yield
        except sqlite3.OperationalError as error:
            raise StorageError(
                f"cannot write {self._path}: {error}; free space, or end the other program that "
                "holds the session, then run the same command again"
            ) from error


def time_text(at: datetime) -> str:
    """Return a time as journal and `frames.csv` have it: ISO 8601 with microseconds and zone."""
    return at.isoformat(timespec="microseconds")


def _connect(path: Path) -> sqlite3.Connection:
    connection = sqlite3.connect(path, timeout=BUSY_LIMIT_S)
    try:
        # A committed row must survive a power cut: it is what makes a frame count.
        connection.execute("PRAGMA synchronous = FULL")
    except sqlite3.DatabaseError:
        connection.close()
        raise
    return connection
