"""The journal of a session, `journal.sqlite`: plan, attempts at frames, verdicts and events.

- Every write is a transaction that is on disk when the call returns. A frame without a committed row is not accepted.
  Rows are never deleted, but an accepted frame can be voided.
- During a run the journal is in SQLite's write-ahead mode, if the disk allows it. Readers then see the last commit and
  block no writer. After a normal end the journal is a single file again.
- Another program may delete, replace or truncate the file. SQLite would not notice this, because it caches pages. So a
  run checks that the journal on disk is the open journal and is complete (`_JournalGuard`).
- All rows except signs of life and the place of the session are called facts. They are also written to the ledger,
  `ledger.jsonl`, from which a lost journal can be restored. Each line of the ledger is a JSON object with the rows of
  one transaction, by table. It is on disk before the journal commits the transaction, and a crash can truncate only
  the last line.

Source: sqlite.org/wal.html, in particular "Read-Only Databases" and "Disadvantages".
"""

from __future__ import annotations

import base64
import json
import os
import shlex
import sqlite3
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Final, TypeVar, cast

from drivers.camera import CapturedFrame
from drivers.presenter import Colour
from experiment.session.heartbeat import INVENTED_NUMBERS, Heartbeat, Process, RunState, SessionPlace, file_system_of
from experiment.session.opening import (
    Retry,
    close_after_run,
    connect,
    create_file,
    is_busy,
    open_for_run,
    open_to_read,
    reading_fault,
    restore_remedy,
    set_aside,
    side_file,
    writing_error,
)
from experiment.session.records import (
    ACCEPTED,
    FAILED,
    KINDS,
    REFUSED,
    VOIDED,
    AcceptedFile,
    Attempt,
    AttemptDetails,
    Check,
    FrameKind,
    FrameRecord,
    Judgement,
    SessionEvent,
    SessionStep,
)
from foundation.errors import DeviceError, FormatError, StorageError, counted
from foundation.files import (
    atomic_file,
    is_inside_name,
    open_inside,
    partial_path,
    reading_error,
    storage_error,
    stream_sha256,
    sync_folder,
    write_atomic,
)

JOURNAL_FILE = "journal.sqlite"  # Name of the journal in the folder of a session

# Default time that a write waits for another program, seconds; the same as the default of `sequence.patience_s`.
PATIENCE_S = 600.0


@dataclass(frozen=True)
class ReceivedFile:
    """A raw file that is complete on disk, but not yet recorded in the journal."""

    path: Path
    size: int
    sha256: str
    captured: CapturedFrame


class _Abandoned(Exception):
    """Signals that an incoming file is discarded."""


class IncomingFile:
    """A raw file that is written under a hidden name. If it is not completed in a `with` block, it is deleted."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._final = path
        # Do not make a missing folder. Its disk was probably unmounted, so the new folder would be on another disk.
        self._file = atomic_file(path, lambda: self._final, make_parents=False)
        self._open = True
        self.stream: BinaryIO = self._file.__enter__()

    def __enter__(self) -> IncomingFile:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is None:
            self.abandon()
        else:
            self._close_file(kind, error, trace)

    def complete(self, captured: CapturedFrame) -> ReceivedFile:
        """Check the size, then hash, flush and rename the file; callable from any thread."""
        try:
            size = self.stream.seek(0, 2)
            if size != captured.size or size == 0:
                raise DeviceError(
                    f"{captured.name}: {size} bytes arrived, expected {captured.size} as announced by the camera; the "
                    "frame is repeated"
                )
            self.stream.seek(0)
            sha256 = stream_sha256(self.stream)
            self._final = self._path.with_name(self._path.name + Path(captured.name).suffix.lower())
        except BaseException:
            self._close_file(*sys.exc_info())
            raise
        self._close_file(None, None, None)
        return ReceivedFile(self._final, size, sha256, captured)

    def abandon(self) -> None:
        """Delete the file unless it is complete; a second call does nothing."""
        self._close_file(_Abandoned, _Abandoned(), None)

    def _close_file(self, kind: Any, error: Any, trace: Any) -> None:
        if self._open:
            self._open = False
            self._file.__exit__(kind, error, trace)


class Journal:
    """An open journal, for one thread; close it after use.

    `retry`: repeats writes while other programs use the file. None for a reader, because SQLite itself waits for reads.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, retry: Retry | None = None) -> None:
        self.path = path
        self._connection = connection
        self._writes = retry is not None
        self._retry = retry or _LockRetry(path, 0, lambda sentence: None)
        self._ledger: _Ledger | None = None
        self._guard: _JournalGuard | None = None
        self._is_run_alive = False

    @staticmethod
    def create(path: Path, steps: Sequence[SessionStep]) -> None:
        """Write a new journal that contains only the plan."""
        no_retry = _LockRetry(path, 0, lambda sentence: None)
        with closing(Journal(path, create_file(path), no_retry)) as journal:
            journal.add_steps(steps)

    @classmethod
    def open(cls, path: Path) -> Journal:
        """Open a journal for reading, also during a run; nothing is created or changed."""
        return cls(path, open_to_read(path))

    @classmethod
    def open_for_run(
        cls,
        path: Path,
        patience_s: float = PATIENCE_S,
        announce: Callable[[str], object] = lambda sentence: None,
    ) -> Journal:
        """Open a journal for writing."""
        retry = _LockRetry(path, patience_s, announce)
        return cls(path, open_for_run(path, retry), retry)

    @staticmethod
    def rebuild(path: Path, rows: Rows) -> None:
        """Write a journal with the given facts; the existing file is kept under another name."""
        copy = partial_path(path)
        copy.unlink(missing_ok=True)
        with closing(create_file(copy)) as connection, connection:
            connection.execute("BEGIN")
            for table, row in ((table, row) for table, table_rows in rows.items() for row in table_rows.values()):
                marks = ", ".join("?" * len(row))
                connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))
        Journal.open(copy).close()
        set_aside(path)
        copy.replace(path)
        sync_folder(path.parent)

    def attach_ledger(self, ledger: Path) -> None:
        """From now on, write all facts to a ledger, too, and check that the journal on disk is the open journal."""
        try:
            rows = self._retry.run(lambda: rows_of(self._connection))
        except sqlite3.DatabaseError as error:
            raise reading_fault(self.path, error) from error
        self._ledger = _Ledger(ledger, rows)
        self._guard = _JournalGuard(self.path, self._ledger)

    def require_whole(self) -> None:
        """Raise `LostJournalError` if the journal on disk is not the open journal, or is incomplete."""
        if self._guard is not None:
            self._guard.require_same()
            self._guard.require_whole()

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._ledger is not None:
            self._ledger.close()
        if self._writes:
            close_after_run(self._connection)
        else:
            self._connection.close()

    def retry_locked(self, patience_s: float, announce: Callable[[str], object]) -> None:
        """Change how long writes wait for other programs, and the function that announces the wait."""
        self._retry = _LockRetry(self.path, patience_s, announce)

    @contextmanager
    def snapshot(self) -> Generator[None]:
        """All reads in the block see the same state of the journal, so that each verdict has its checks."""
        self._rows("BEGIN")
        yield
        self._rows("ROLLBACK")

    def steps(self) -> tuple[SessionStep, ...]:
        """Return the plan, in the order in which frames are taken."""
        rows = self._rows("SELECT step, kind, illumination, red, green, blue FROM plan ORDER BY step")
        self._require_known_kinds(row[1] for row in rows)
        return tuple([_step(*row) for row in rows])

    def add_steps(self, steps: Sequence[SessionStep]) -> None:
        """Append steps to the plan; their numbers must be free."""
        with self._writing() as change:
            for step in steps:
                red, green, blue = step.colour
                row = {"step": step.number, "kind": step.kind, "illumination": step.illumination}
                change.put("plan", row | {"red": red, "green": green, "blue": blue})

    def begin(self, step: SessionStep, file: str, at: datetime) -> int:
        """Record the start of an attempt at `step`, to be saved as `file`; return the id of the attempt."""
        row = {"step": step.number, "kind": step.kind, "illumination": step.illumination}
        with self._writing() as change:
            return change.put_numbered("attempts", row | {"file": file, "started_at": time_text(at)})

    def commit(
        self,
        attempt: int,
        received: ReceivedFile,
        judgement: Judgement,
        timings: Mapping[str, float] | None = None,
        *,
        exposure_s: float,
        ended_at: datetime,
    ) -> None:
        """Record the complete raw file and the judgement of an attempt.

        `timings`: seconds of each stage by name. `exposure_s`: requested exposure time, seconds.
        """
        file = received.path.relative_to(self.path.parent).as_posix()
        verdict = ACCEPTED if judgement.accepted else REFUSED
        row = {"file": file, "size": received.size, "sha256": received.sha256, "exposure_s": exposure_s}
        row |= {"taken_at": time_text(received.captured.released_at)}
        row |= {"ended_at": time_text(ended_at), "verdict": verdict, "reason": judgement.reason}
        red, green, blue = judgement.seen or (None, None, None)
        measured = {"attempt": attempt, "red": red, "green": green, "blue": blue, "data": judgement.measurement}
        with self._writing() as change:
            change.set_attempt(attempt, row)
            for position, check in enumerate(judgement.checks):
                change.put("checks", {"attempt": attempt, "position": position, **vars(check)})
            change.put("measurements", measured | {"voids": int(judgement.voids), "lasting": int(judgement.lasting)})
            for name, seconds in (timings or {}).items():
                change.put("timings", {"attempt": attempt, "name": name, "seconds": seconds})

    def fail(self, attempt: int, at: datetime, reason: str) -> None:
        """Record that an attempt produced no frame."""
        with self._writing() as change:
            change.set_attempt(attempt, {"ended_at": time_text(at), "verdict": FAILED, "reason": reason})

    def void(self, attempts: Iterable[int], at: datetime, reason: str) -> None:
        """Record that accepted frames must not be used; their rows and files remain."""
        accepted = {frame.attempt for frame in self.accepted_files()} & set(attempts)
        if not accepted:
            return
        with self._writing() as change:
            for attempt in sorted(accepted):
                change.set_attempt(attempt, {"verdict": VOIDED, "reason": reason})
            detail = f"{counted(len(accepted), 'frame')}: {reason}"
            change.put_numbered("events", {"at": time_text(at), "what": VOIDED, "detail": detail})

    def note(self, at: datetime, event: str, detail: str = "") -> None:
        """Record an event."""
        with self._writing() as change:
            change.put_numbered("events", {"at": time_text(at), "what": event, "detail": detail})

    def beat(self, state: RunState, sentence: str, until: datetime) -> None:
        """Record a sign of life, which replaces the previous one."""
        with self._writing():
            _put_beat(self._connection, self.path, state, sentence, until)
        self._is_run_alive = state != "ended"

    def record(self, key: str, text: str) -> None:
        """Record a property of the session, such as the identity of a device; replaces the text of `key`."""
        with self._writing() as change:
            change.put("records", {"key": key, "text": text})

    def records(self) -> dict[str, str]:
        """Return the properties of the session, by key."""
        return dict(self._rows(f"SELECT key, text FROM records WHERE key <> '{PLACE}' ORDER BY key"))

    def heartbeat(self) -> Heartbeat | None:
        """Return the newest sign of life, if there is any."""
        rows = self._rows("SELECT at, pid, started, host, boot, state, sentence, until FROM heartbeat")
        if not rows:
            return None
        at, *process, state, sentence, until = rows[0]
        place_rows = self._rows(f"SELECT text FROM records WHERE key = '{PLACE}'")
        session_place = SessionPlace.from_text(place_rows[0][0]) if place_rows else None
        at_time, until_time = datetime.fromisoformat(at), datetime.fromisoformat(until)
        return Heartbeat(at_time, Process(*process), state, sentence, until_time, session_place)

    def run_state(self) -> RunState | None:
        """Return the state in the newest sign of life, if there is any."""
        rows = self._rows("SELECT state FROM heartbeat")
        return rows[0][0] if rows else None

    def attempts(self, numbers: Sequence[int] | None = None) -> list[Attempt]:
        """Return the attempts with these numbers, or all, oldest first."""
        condition, values = _condition_of("id", numbers)
        rows = self._rows(
            "SELECT id, step, kind, illumination, file, started_at, ended_at, taken_at, verdict, reason"
            f" FROM attempts WHERE {condition} ORDER BY id",
            values,
        )
        self._require_known_kinds(row[2] for row in rows)
        return [_attempt(*row) for row in rows]

    def verdicts(self) -> list[tuple[int, datetime, str | None]]:
        """Return number, start and verdict of every attempt, oldest first; faster than `attempts`."""
        rows = self._rows("SELECT id, started_at, verdict, kind FROM attempts ORDER BY id")
        self._require_known_kinds(row[3] for row in rows)
        return [(number, datetime.fromisoformat(at), verdict) for number, at, verdict, _ in rows]

    def events(self) -> list[SessionEvent]:
        """Return every event, oldest first."""
        rows = self._rows("SELECT at, what, detail, id FROM events ORDER BY id")
        return [SessionEvent(datetime.fromisoformat(at), *event) for at, *event in rows]

    def details(self, attempts: Sequence[int] | None = None) -> dict[int, AttemptDetails]:
        """Return the details of the attempts with these numbers, or of all, by number, oldest first.

        Attempts without details are omitted.
        """
        condition, numbers = _condition_of("attempt", attempts)
        paper_rgb: dict[int, tuple[float, float, float]] = {
            attempt: (red, green, blue)
            for attempt, red, green, blue in self._rows(
                f"SELECT attempt, red, green, blue FROM measurements WHERE red IS NOT NULL AND {condition}", numbers
            )
        }
        checks: dict[int, list[Check]] = {}
        for attempt, *check in self._rows(
            "SELECT attempt, name, value, low, high, unit, reason FROM checks"
            f" WHERE {condition} ORDER BY attempt, position",
            numbers,
        ):
            checks.setdefault(attempt, []).append(Check(*check))
        timings: dict[int, dict[str, float]] = {}
        for attempt, name, seconds in self._rows(
            f"SELECT attempt, name, seconds FROM timings WHERE {condition} ORDER BY rowid", numbers
        ):
            timings.setdefault(attempt, {})[name] = seconds
        return {
            number: AttemptDetails(paper_rgb.get(number), tuple(checks.get(number, ())), timings.get(number, {}))
            for number in sorted(paper_rgb.keys() | checks.keys() | timings.keys())
        }

    def measurements(self) -> Iterator[tuple[SessionStep, int, bytes, bool]]:
        """Yield for each frame, in order: step, attempt, data of the judge, and whether the frame is accepted."""
        plan = {step.number: step for step in self.steps()}
        for attempt, step, data, verdict in self._rows(
            "SELECT id, step, data, verdict FROM attempts JOIN measurements ON attempt = id ORDER BY id"
        ):
            if step in plan and data:
                yield plan[step], attempt, data, verdict == ACCEPTED

    def accepted_files(self) -> list[AcceptedFile]:
        """Return every accepted frame, oldest first."""
        rows = self._rows(
            "SELECT id, step, illumination, file, size, sha256 FROM attempts WHERE verdict=? ORDER BY id", (ACCEPTED,)
        )
        return [_accepted_file(*row) for row in rows]

    def missing_frames(self, frames: Frames) -> Frames:
        """Return the given frames that are missing here or have another verdict."""
        return _missing_frames(
            frames, {*self._rows("SELECT id, sha256, verdict FROM attempts WHERE sha256 IS NOT NULL")}
        )

    def unused_bytes(self, after: int) -> int:
        """Return the size of the raw files of refused and voided attempts with numbers above `after`."""
        query = "SELECT COALESCE(SUM(size), 0) FROM attempts WHERE id > ? AND verdict IN (?, ?)"
        return int(self._rows(query, (after, REFUSED, VOIDED))[0][0])

    def kept_files(self, step: SessionStep) -> int:
        """Return the number of raw files of `step`, with any verdict."""
        query = "SELECT COUNT(*) FROM attempts WHERE step=? AND sha256 IS NOT NULL"
        return int(self._rows(query, (step.number,))[0][0])

    def frames(self) -> list[FrameRecord]:
        """Return every frame that was taken and judged, also refused ones, in the order of the plan."""
        rows = self._rows(
            "SELECT step, kind, illumination, file, sha256, taken_at, exposure_s, verdict, reason, id FROM attempts"
            " WHERE sha256 IS NOT NULL ORDER BY step, id"
        )
        self._require_known_kinds(row[1] for row in rows)
        return [
            FrameRecord(
                kind,
                light,
                file,
                sha256,
                datetime.fromisoformat(taken_at),
                exposure_s,
                _verdict_text(verdict, reason),
                attempt,
            )
            for _, kind, light, file, sha256, taken_at, exposure_s, verdict, reason, attempt in rows
        ]

    def _require_known_kinds(self, kinds: Iterable[str]) -> None:
        if unknown := sorted({*kinds} - {*KINDS}):
            raise FormatError(
                f"{self.path} has a frame of kind {unknown[0]!r}, this software reads the kinds {', '.join(KINDS)}; "
                "use the software that took the session"
            )

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> list[Any]:
        # Read all rows at once, so that no lock remains.
        try:
            return self._retry.run(lambda: self._connection.execute(query, values).fetchall())
        except sqlite3.DatabaseError as error:
            raise reading_fault(self.path, error) from error

    @contextmanager
    def _writing(self) -> Generator[_Change]:
        """Write everything in the block as one transaction, which is on disk at its end."""
        try:
            self._retry.run(lambda: self._connection.execute("BEGIN IMMEDIATE"))
            change = _Change(self._connection)
            yield change
            if self._ledger is not None and change.rows:
                self._append(self._ledger, change.rows)
            if self._is_run_alive and change.rows:
                # Each write is also a sign of life.
                self._connection.execute("UPDATE heartbeat SET at = ?", (time_text(datetime.now(UTC)),))
            if self._guard is not None:
                self._guard.require_same()
            self._retry.run(lambda: self._connection.execute("COMMIT"))
            if self._guard is not None:
                self._guard.remember()
            if self._ledger is not None:
                self._ledger.confirm()
        except LostJournalError:
            # Keep the transaction in the ledger, because the journal is lost.
            if self._ledger is not None:
                self._ledger.confirm()
            raise
        except sqlite3.DatabaseError as error:
            raise writing_error(self.path, error) from error
        finally:
            with suppress(sqlite3.Error):
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    def _append(self, ledger: _Ledger, rows: Mapping[str, Sequence[Row]]) -> None:
        if not ledger.is_intact():
            # Read the rows through the open connection, because the journal on disk may be missing, too.
            ledger.restore(rows_of(self._connection))
        ledger.append(rows)


def open_journal(folder: Path) -> Journal:
    """Open the journal of a session for reading; refuse a journal that lacks frames of the ledger."""
    # A run writes to the ledger first. If the ledger is also read first, the journal lacks at most the last
    # transaction.
    settled = settled_frames(ledger_path(folder))
    journal = Journal.open(folder / JOURNAL_FILE)
    try:
        _require_no_missing_frames(ledger_path(folder), journal.missing_frames(settled))
    except BaseException:
        journal.close()
        raise
    return journal


def lost_files(folder: Path, accepted: Sequence[AcceptedFile]) -> list[AcceptedFile]:
    """Return the newest accepted frame of each step, if its file is missing or has another size."""
    newest = {frame.step: frame for frame in accepted}
    # The paths are texts, because creating 800 path objects would take longer than the check.
    return [frame for frame in newest.values() if not _has_size(f"{folder}/{frame.file}", frame.size)]


def _has_size(path: str, size: int) -> bool:
    try:
        return os.stat(path).st_size == size  # noqa: PTH116 - see `lost_files`
    except OSError:
        return False


def no_journal_text(folder: Path) -> str:
    """Return the message with remedy for a session without journal."""
    path = folder / JOURNAL_FILE
    return f"{folder} has the frames of a session, but its journal {path.name} is missing; {restore_remedy(path)}"


def thread_beat(path: Path, state: RunState, sentence: str, until: datetime) -> None:
    """Write a sign of life from a thread that has no open journal; errors are ignored."""
    with suppress(sqlite3.Error), closing(connect(path, "rw")) as connection:
        connection.execute("BEGIN IMMEDIATE")
        _put_beat(connection, path, state, sentence, until)
        connection.execute("COMMIT")


def _put_beat(connection: sqlite3.Connection, path: Path, state: RunState, sentence: str, until: datetime) -> None:
    own, at, session_place = Process.own(), datetime.now(UTC), SessionPlace.of(path)
    if session_place is not None:
        connection.execute("INSERT OR REPLACE INTO records VALUES (?, ?)", (PLACE, session_place.to_text()))
    connection.execute(
        "INSERT OR REPLACE INTO heartbeat VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?)",
        (time_text(at), own.pid, own.started, own.host, own.boot, state, sentence, time_text(until)),
    )


class _Change:
    """A transaction; its rows are written to the journal and collected for the ledger."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self.rows: dict[str, list[Row]] = {}

    def put(self, table: str, row: Row) -> int:
        """Write a row, or replace one with the same key in `records`; return its number."""
        verb = "INSERT OR REPLACE" if table == "records" else "INSERT"
        marks = ", ".join("?" * len(row))
        cursor = self._connection.execute(
            f"{verb} INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values())
        )
        # SQLite stores NaN as NULL.
        stored = {name: None if isinstance(value, float) and value != value else value for name, value in row.items()}
        self.rows.setdefault(table, []).append(stored)
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def put_numbered(self, table: str, row: Row) -> int:
        """Write a row of a table with numbered rows; return the number."""
        number = self.put(table, row)
        self.rows[table][-1] = {"id": number, **row}
        return number

    def set_attempt(self, attempt: int, row: Row) -> None:
        """Change columns of an attempt."""
        columns = ", ".join(f"{name}=?" for name in row)
        self._connection.execute(f"UPDATE attempts SET {columns} WHERE id=?", (*row.values(), attempt))
        self.rows.setdefault("attempts", []).append({"id": attempt, **row})


def time_text(at: datetime) -> str:
    """Return a time as in the journal and `frames.csv`: ISO 8601 with microseconds and zone."""
    return at.isoformat(timespec="microseconds")


# Number of cached rows of each kind. The cache is useful because a reader reads all frames after each new frame.
_ROWS_KEPT: Final = 8192

_accepted_file: Final = lru_cache(_ROWS_KEPT)(AcceptedFile)


def _condition_of(column: str, numbers: Sequence[int] | None) -> tuple[str, tuple[str, ...]]:
    # Return the SQL condition that a column has one of the numbers, and its parameter.
    if numbers is None:
        return "TRUE", ()
    return f"{column} IN (SELECT value FROM json_each(?))", (json.dumps(list(numbers)),)


@lru_cache(_ROWS_KEPT)
def _step(number: int, kind: FrameKind, illumination: int | None, *codes: int) -> SessionStep:
    return SessionStep(number, kind, illumination, Colour(*codes))


def _attempt(
    number: int,
    step: int,
    kind: FrameKind,
    light: int | None,
    file: str,
    started_at: str,
    ended_at: str | None,
    taken_at: str | None,
    verdict: str | None,
    reason: str,
) -> Attempt:
    times = datetime.fromisoformat(started_at), _time(ended_at), _time(taken_at)
    return Attempt(number, step, kind, light, file, *times, verdict, reason)


def _time(text: str | None) -> datetime | None:
    return datetime.fromisoformat(text) if text else None


def _verdict_text(verdict: str, reason: str) -> str:
    if verdict == ACCEPTED:
        return ACCEPTED
    return f"{REFUSED}: {reason}" if reason else REFUSED


@dataclass(frozen=True)
class _FileState:
    numbers: tuple[int, int]  # device and inode
    size: int
    written: int  # time of the last write, ns


class _JournalGuard:
    """Checks that the journal on disk is the journal that a run has open. `ledger` has the same facts."""

    def __init__(self, path: Path, ledger: _Ledger) -> None:
        self._path, self._ledger = path, ledger
        self._files = (path, side_file(path, "-wal"))
        self._folders = {folder: self._file_state(folder) for folder in (path.parent, path.parent / "frames")}
        self._has_fixed_numbers = not file_system_of(path).startswith(INVENTED_NUMBERS)
        self._states: dict[Path, _FileState] = {}
        self.remember()

    def remember(self) -> None:
        """Remember the state of the files after the run has written to the journal."""
        self._states = {file: state for file in self._files if (state := self._file_state(file)) is not None}

    def require_same(self) -> None:
        """Raise `LostJournalError` if the journal was replaced or lost rows since the last write of the run."""
        for folder, previous in self._folders.items():
            current = self._file_state(folder)
            if current is None or previous is None or (self._has_fixed_numbers and current.numbers != previous.numbers):
                raise StorageError(f"{folder} is missing or was replaced", remedy="check that its disk is mounted")
        is_written = False
        for file, previous in self._states.items():
            current = self._file_state(file)
            if current is None:
                self._raise_lost(file, "was deleted")
            elif self._has_fixed_numbers and current.numbers != previous.numbers:
                self._raise_lost(file, "was replaced by another file")
            elif current.size < previous.size:
                self._raise_lost(file, f"was truncated from {previous.size} to {current.size} bytes")
            is_written |= current != previous
        if is_written:
            self.require_whole()
            self.remember()

    def require_whole(self) -> None:
        """Raise `LostJournalError` if the journal on disk does not have the rows of the run."""
        try:
            with closing(connect(self._path, "ro")) as connection:
                is_sound = connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
                is_same = is_sound and rows_of(connection) == self._ledger.rows()
        except sqlite3.DatabaseError as error:
            fault = reading_fault(self._path, error)
            if isinstance(fault, StorageError):
                raise fault from error
            is_same = False
        if not is_same:
            self._raise_lost(self._path, "was written by another program and does not have the rows of the run")

    def _file_state(self, path: Path) -> _FileState | None:
        try:
            stat = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise storage_error(path, error, "read") from error
        return _FileState((stat.st_dev, stat.st_ino), stat.st_size, stat.st_mtime_ns)

    def _raise_lost(self, file: Path, change: str) -> None:
        raise LostJournalError(
            f"{file} {change} during the run; ledger.jsonl still has all frames and verdicts",
            remedy=f"restore the journal with acquire rebuild {self._path.parent}, then run the same command again",
        )


_T = TypeVar("_T")


class LostJournalError(StorageError):
    """The journal on disk is not the open journal of the run; waiting does not help."""


class _LockRetry:
    def __init__(self, path: Path, seconds: float, announce: Callable[[str], object]) -> None:
        self._path = path
        self._seconds = seconds
        self._announce = announce

    def run(self, attempt: Callable[[], _T]) -> _T:
        """Return the result of `attempt`, repeated while another program holds the journal."""
        started, announced = time.monotonic(), False
        while True:
            try:
                return attempt()
            except sqlite3.OperationalError as error:
                if not is_busy(error) or time.monotonic() - started >= self._seconds:
                    raise
                if not announced:
                    self._announce(
                        f"another program is using {self._path}; the run resumes automatically when the file is free"
                    )
                    announced = True


LEDGER_FILE: Final = "ledger.jsonl"  # Name of the ledger in the folder of a session

# Largest accepted ledger, bytes: twenty times the size for 707 illuminants.
_MOST_LEDGER_BYTES: Final = 1 << 30

PLACE: Final = "place"  # Key of the place of the session in the table `records`; written with each sign of life

# Key columns of each table.
_ROW_KEYS: Final = {
    "plan": ("step",),
    "attempts": ("id",),
    "events": ("id",),
    "checks": ("attempt", "position"),
    "measurements": ("attempt",),
    "timings": ("attempt", "name"),
    "records": ("key",),
}

# Values of the columns of an attempt that are unknown at its start.
_START: Final = dict.fromkeys(("ended_at", "taken_at", "exposure_s", "size", "sha256", "verdict")) | {"reason": ""}

Row = dict[str, Any]
Rows = dict[str, dict[tuple[Any, ...], Row]]  # Rows by table and key, columns by name


def ledger_path(folder: Path) -> Path:
    """Return the path of the ledger of a session."""
    return folder / LEDGER_FILE


def rows_of(connection: sqlite3.Connection) -> Rows:
    """Return the facts in a journal."""
    rows: Rows = {}
    for table in _ROW_KEYS:
        cursor = connection.execute(f"SELECT * FROM {table} ORDER BY rowid")
        names = [column[0] for column in cursor.description]
        for values in cursor.fetchall():
            _put_row(rows, table, dict(zip(names, values, strict=True)))
    rows.get("records", {}).pop((PLACE,), None)
    return {table: table_rows for table, table_rows in rows.items() if table_rows}


def read_ledger(path: Path) -> Rows:
    """Return the facts in a ledger."""
    return _merge_transactions(_read_transactions(path))


def _read_transactions(path: Path, size: int = _MOST_LEDGER_BYTES + 1) -> list[Mapping[str, Sequence[Row]]]:
    try:
        with open_inside(path.parent, path.name) as stream:
            content = stream.read(size)
    except OSError as error:
        raise reading_error(path, error, "restore the session from a copy") from error
    if len(content) > _MOST_LEDGER_BYTES:
        raise FormatError(f"{path} has more than {_MOST_LEDGER_BYTES} bytes; restore it from a copy")
    return list(_transactions(path, content.split(b"\n")))


def _merge_transactions(transactions: Sequence[Mapping[str, Sequence[Row]]]) -> Rows:
    rows: Rows = {}
    for transaction in transactions:
        for table, changes in transaction.items():
            for row in changes:
                _put_row(rows, table, row)
    return rows


def _transactions(path: Path, lines: Sequence[bytes]) -> Iterator[Mapping[str, Sequence[Row]]]:
    """Yield the transaction of each line. Text after the last line break is incomplete and ignored."""
    for number, line in enumerate(lines[:-1], 1):
        try:
            yield {table: [_checked_row(table, row) for row in rows] for table, rows in json.loads(line).items()}
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            if number == len(lines) - 1 and not line.endswith(b"}"):
                return
            raise FormatError(f"{path}, line {number}, is damaged: {error}; restore it from a copy") from error


def _checked_row(table: str, row: Row) -> Row:
    # Names are checked because they become part of SQL statements.
    if any(key not in row for key in _ROW_KEYS[table]) or not all(name.isidentifier() for name in row):
        raise ValueError(f"a row of {table} without its key")
    if not all(value is None or isinstance(value, str | int | float) for value in row.values()):
        raise ValueError(f"a row of {table} with a value that is neither number nor text")
    if not is_inside_name(row.get("file", "frames")):
        raise ValueError(f"the file {row['file']!r}, which is outside the session")
    return row if "data" not in row else {**row, "data": base64.b64decode(row["data"], validate=True)}


def _put_row(rows: Rows, table: str, row: Row) -> None:
    key = tuple(row[name] for name in _ROW_KEYS[table])
    rows.setdefault(table, {}).setdefault(key, dict(_START) if table == "attempts" else {}).update(row)


def _ledger_line(rows: Mapping[str, Sequence[Row]]) -> bytes:

    def encoded(value: object) -> str:
        return base64.b64encode(cast("bytes", value)).decode()

    return json.dumps(rows, default=encoded, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"


def _ledger_lines(rows: Rows) -> bytes:
    single_tables = [{table: list(rows[table].values())} for table in ("plan", "records") if table in rows]
    attempts: dict[int, dict[str, list[Row]]] = {}
    for table, key in (("attempts", "id"), ("checks", "attempt"), ("measurements", "attempt"), ("timings", "attempt")):
        for row in rows.get(table, {}).values():
            attempts.setdefault(row[key], {}).setdefault(table, []).append(row)
    events = [{"events": list(rows["events"].values())}] if "events" in rows else []
    return b"".join(_ledger_line(transaction) for transaction in [*single_tables, *attempts.values(), *events])


class _Ledger:
    """A ledger that a run writes; close it after use.

    `rows`: facts of the journal. If the ledger has other facts, it is written again. If the ledger has frames that the
    journal lacks, a `FormatError` is raised.
    """

    def __init__(self, path: Path, rows: Rows) -> None:
        self._path = path
        try:
            exists = path.is_file()
        except OSError as error:
            raise storage_error(path, error, "read") from error
        if not exists or not self._has_facts(rows):
            write_atomic(path, _ledger_lines(rows))
        self._handle, self._end = self._open_file()
        self._next = self._end

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            with suppress(OSError):  # All data are on disk already.
                os.close(handle)

    def append(self, changes: Mapping[str, Sequence[Row]]) -> None:
        """Write a transaction, which replaces an unconfirmed transaction; it is on disk when this method returns."""
        line = _ledger_line(changes)
        try:
            os.pwrite(self._handle, line, self._end)
            os.ftruncate(self._handle, self._end + len(line))
            os.fsync(self._handle)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._handle, self._end)
            raise storage_error(self._path, error) from error
        self._next = self._end + len(line)

    def confirm(self) -> None:
        """Keep the last transaction, because the journal also has it, or because the journal is lost."""
        self._end = self._next

    def is_intact(self) -> bool:
        """Return whether the open file is still the file on disk, in full size."""
        try:
            on_disk, opened = self._path.stat(), os.fstat(self._handle)
        except OSError:
            return False
        return (on_disk.st_dev, on_disk.st_ino, on_disk.st_size) == (opened.st_dev, opened.st_ino, self._next)

    def restore(self, rows: Rows) -> None:
        """Write the file again after it was deleted or changed during the run."""
        self.close()
        write_atomic(self._path, _ledger_lines(rows))
        self._handle, self._end = self._open_file()
        self._next = self._end

    def rows(self) -> Rows:
        """Return the facts in the file, without an unconfirmed transaction."""
        return _merge_transactions(_read_transactions(self._path, self._end))

    def _has_facts(self, rows: Rows) -> bool:
        try:
            transactions = _read_transactions(self._path)
        except FormatError:
            return False
        if _merge_transactions(transactions) == rows:
            return True
        settled = _frames_in(_merge_transactions(transactions[:-1]))
        _require_no_missing_frames(self._path, _missing_frames(settled, _frames_in(rows)))
        return False

    def _open_file(self) -> tuple[int, int]:
        try:
            handle = os.open(self._path, os.O_RDWR)
            return handle, os.fstat(handle).st_size
        except OSError as error:
            raise storage_error(self._path, error) from error


Frames = set[tuple[int, str, str | None]]  # Frames by attempt and hash, with their verdicts


def settled_frames(path: Path) -> Frames:
    """Return the frames of a ledger that a journal opened later must also have: all but those of the last transaction.

    Empty if the ledger is missing or damaged, because the journal may be intact.
    """
    with suppress(FormatError, StorageError):
        if os.path.isfile(path):  # noqa: PTH113 - it never raises
            return _frames_in(_merge_transactions(_read_transactions(path)[:-1]))
    return set()


def _missing_frames(settled: Frames, journal_frames: Frames) -> Frames:
    # A frame that is voided in the journal is newer there, because `VOIDED` is always the last verdict.
    voided = {(attempt, sha256) for attempt, sha256, verdict in journal_frames if verdict == VOIDED}
    return {frame for frame in settled - journal_frames if frame[:2] not in voided}


def _require_no_missing_frames(path: Path, missing: Frames) -> None:
    if missing:
        raise FormatError(
            f"the journal of {path.parent} lacks {counted(len(missing), 'frame')} or verdicts that {path} has: "
            "the journal is older or damaged",
            remedy=f"restore it with acquire rebuild {shlex.quote(str(path.parent))}",
        )


def _frames_in(rows: Rows) -> Frames:
    return {
        (row["id"], row["sha256"], row["verdict"]) for row in rows.get("attempts", {}).values() if row.get("sha256")
    }
