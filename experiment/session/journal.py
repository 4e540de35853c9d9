"""The journal of a session, `journal.sqlite`: the plan, every attempt at its frames, their verdicts, and events.

- It is written before and after each frame; every write is a transaction of its own and on the disk when the call
  returns, since a committed row is what makes a frame count. Rows are never deleted; an accepted frame can be voided.
- While a run has it open the journal is in SQLite's write-ahead mode, where that works: readers see the last commit and
  hold nobody up. When the run ends in order it is one file again. A reader creates, migrates and changes nothing.
- A session may be a stranger's: what an SQLite file can hold beside rows is refused when the journal is opened
  (`experiment.session.opening`), so that nothing behind this has to expect it.
- Files are deleted, replaced and cut, and nobody says so; SQLite does not look twice at pages that it has read. So a
  run looks whether the journal on the disk is its own, and whole (`_JournalGuard`).
- Its facts stand a second time in `ledger.jsonl`, from which a journal that was lost is made anew. A line of it is a
  transaction: the rows that it put or changed, by table, as a JSON object, on the disk before the journal commits the
  same. Signs of life, and where the session lies, are no facts. What a crash cut off is the last line alone.

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
    beside,
    close_after_run,
    connect,
    create_file,
    is_busy,
    open_for_run,
    open_to_read,
    reading_fault,
    restoring,
    set_aside,
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

JOURNAL_FILE = "journal.sqlite"  # Name of the journal in a session's folder

# How long a write waits for another program's unless the caller says otherwise: as long as a run waits for a device
# by default (`sequence.patience_s`).
PATIENCE_S = 600.0


@dataclass(frozen=True)
class ReceivedFile:
    """A raw file that is complete on the disk, not yet counted."""

    path: Path
    size: int
    sha256: str
    captured: CapturedFrame


class _Abandoned(Exception):
    """Ends a file that is not wanted."""


class IncomingFile:
    """A raw file in the making under a hidden name; gone at the end of a `with` block unless it was completed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._final = path
        # A folder that is gone means a disk that was unmounted: what lies under its name is another one.
        self._file = atomic_file(path, lambda: self._final, make_parents=False)
        self._open = True
        self.stream: BinaryIO = self._file.__enter__()

    def __enter__(self) -> IncomingFile:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is None:
            self.abandon()
        else:
            self._leave(kind, error, trace)

    def complete(self, captured: CapturedFrame) -> ReceivedFile:
        """Check the size, hash, flush and rename the file; from any thread."""
        try:
            size = self.stream.seek(0, 2)
            if size != captured.size or size == 0:
                raise DeviceError(
                    f"{captured.name}: the camera says {captured.size} bytes, {size} arrived; the frame is taken again"
                )
            self.stream.seek(0)
            sha256 = stream_sha256(self.stream)
            self._final = self._path.with_name(self._path.name + Path(captured.name).suffix.lower())
        except BaseException:
            self._leave(*sys.exc_info())
            raise
        self._leave(None, None, None)
        return ReceivedFile(self._final, size, sha256, captured)

    def abandon(self) -> None:
        """Remove the file unless it was completed; a second call does nothing."""
        self._leave(_Abandoned, _Abandoned(), None)

    def _leave(self, kind: Any, error: Any, trace: Any) -> None:
        if self._open:
            self._open = False
            self._file.__exit__(kind, error, trace)


class Journal:
    """An open journal; close it after use. Used from one thread.

    `retry`: with which other programs are waited for; None for a reader, for whom SQLite waits.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection, retry: Retry | None = None) -> None:
        self.path = path
        self._connection = connection
        self._writes = retry is not None
        self._retry = retry or _LockRetry(path, 0, lambda sentence: None)
        self._ledger: _Ledger | None = None
        self._guard: _JournalGuard | None = None
        self._gives_signs = False

    @staticmethod
    def create(path: Path, steps: Sequence[SessionStep]) -> None:
        """Write a new journal with the plan and nothing else."""
        alone = _LockRetry(path, 0, lambda sentence: None)
        with closing(Journal(path, create_file(path), alone)) as journal:
            journal.add_steps(steps)

    @classmethod
    def open(cls, path: Path) -> Journal:
        """Open a journal to read it, also while a run writes it; nothing is created or changed."""
        return cls(path, open_to_read(path))

    @classmethod
    def open_for_run(
        cls,
        path: Path,
        patience_s: float = PATIENCE_S,
        announce: Callable[[str], object] = lambda sentence: None,
    ) -> Journal:
        """Open a journal to write it."""
        retry = _LockRetry(path, patience_s, announce)
        return cls(path, open_for_run(path, retry), retry)

    @staticmethod
    def rebuild(path: Path, rows: Rows) -> None:
        """Write a journal anew that holds these facts; what stands in its place keeps its bytes under another name."""
        copy = partial_path(path)
        copy.unlink(missing_ok=True)
        with closing(create_file(copy)) as connection, connection:
            connection.execute("BEGIN")
            for table, row in ((table, row) for table, of_table in rows.items() for row in of_table.values()):
                marks = ", ".join("?" * len(row))
                connection.execute(f"INSERT INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values()))
        Journal.open(copy).close()
        set_aside(path)
        copy.replace(path)
        sync_folder(path.parent)

    def keep_twice(self, ledger: Path) -> None:
        """Keep all facts in a second place, too, and watch that the journal stays the one that is open."""
        try:
            rows = self._retry.run(lambda: rows_of(self._connection))
        except sqlite3.DatabaseError as error:
            raise reading_fault(self.path, error) from error
        self._ledger = _Ledger(ledger, rows)
        self._guard = _JournalGuard(self.path, self._ledger)

    def require_whole(self) -> None:
        """Raise where the journal on the disk is not the one that is open, or does not hold what was written."""
        if self._guard is not None:
            self._guard.require_same()
            self._guard.require_whole()

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        if self._ledger is not None:
            self._ledger.close()
        if self._writes:
            close_after_run(self._connection)
        else:
            self._connection.close()

    def retry_locked(self, patience_s: float, announce: Callable[[str], object]) -> None:
        """Change how long a write waits for other programs, and who is told that it does; see `open_for_run`."""
        self._retry = _LockRetry(self.path, patience_s, announce)

    @contextmanager
    def one_moment(self) -> Generator[None]:
        """Let all that is read inside be of one moment: a verdict is never seen without its checks."""
        self._rows("BEGIN")
        yield
        self._rows("ROLLBACK")

    def steps(self) -> tuple[SessionStep, ...]:
        """Return the plan, in taking order."""
        rows = self._rows("SELECT step, kind, illumination, red, green, blue FROM plan ORDER BY step")
        self._require_known_kinds(row[1] for row in rows)
        return tuple([_step(*row) for row in rows])

    def add_steps(self, steps: Sequence[SessionStep]) -> None:
        """Put steps at the end of the plan; their numbers must be free."""
        with self._writing() as change:
            for step in steps:
                red, green, blue = step.colour
                row = {"step": step.number, "kind": step.kind, "illumination": step.illumination}
                change.put("plan", row | {"red": red, "green": green, "blue": blue})

    def begin(self, step: SessionStep, file: str, at: datetime) -> int:
        """Note that an attempt at `step` begins, to be saved as `file`; return the attempt's id."""
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
        """Note that an attempt's raw file is complete and how it was judged; only now does the frame count.

        `exposure_s`: the exposure asked for, seconds.
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
        """Note that an attempt gave no frame."""
        with self._writing() as change:
            change.set_attempt(attempt, {"ended_at": time_text(at), "verdict": FAILED, "reason": reason})

    def void(self, attempts: Iterable[int], at: datetime, reason: str) -> None:
        """Note that frames that were accepted must not be used after all; their rows and files stay."""
        accepted = {frame.attempt for frame in self.accepted_files()} & set(attempts)
        if not accepted:
            return
        with self._writing() as change:
            for attempt in sorted(accepted):
                change.set_attempt(attempt, {"verdict": VOIDED, "reason": reason})
            detail = f"{counted(len(accepted), 'frame')}: {reason}"
            change.put_numbered("events", {"at": time_text(at), "what": VOIDED, "detail": detail})

    def note(self, at: datetime, what: str, detail: str = "") -> None:
        """Note an event."""
        with self._writing() as change:
            change.put_numbered("events", {"at": time_text(at), "what": what, "detail": detail})

    def beat(self, state: RunState, sentence: str, until: datetime) -> None:
        """Give a sign of life, in place of the one before."""
        with self._writing():
            _put_beat(self._connection, self.path, state, sentence, until)
        self._gives_signs = state != "ended"

    def record(self, key: str, text: str) -> None:
        """Note what a session is taken with, such as a device's identity, in place of what stood under `key`."""
        with self._writing() as change:
            change.put("records", {"key": key, "text": text})

    def records(self) -> dict[str, str]:
        """Return what the session was taken with, by key."""
        return dict(self._rows(f"SELECT key, text FROM records WHERE key <> '{PLACE}' ORDER BY key"))

    def heartbeat(self) -> Heartbeat | None:
        """Return the newest sign of life; None if none was ever given."""
        rows = self._rows("SELECT at, pid, started, host, boot, state, sentence, until FROM heartbeat")
        if not rows:
            return None
        at, *process, state, sentence, until = rows[0]
        said = self._rows(f"SELECT text FROM records WHERE key = '{PLACE}'")
        place = SessionPlace.from_text(said[0][0]) if said else None
        begun, due = datetime.fromisoformat(at), datetime.fromisoformat(until)
        return Heartbeat(begun, Process(*process), state, sentence, due, place)

    def run_state(self) -> RunState | None:
        """Return what the newest sign of life says that the run does; None if none was ever given."""
        rows = self._rows("SELECT state FROM heartbeat")
        return rows[0][0] if rows else None

    def attempts(self, numbers: Sequence[int] | None = None) -> list[Attempt]:
        """Return attempts, those of these numbers or all, oldest first."""
        among, values = _among("id", numbers)
        rows = self._rows(
            "SELECT id, step, kind, illumination, file, started_at, ended_at, taken_at, verdict, reason"
            f" FROM attempts WHERE {among} ORDER BY id",
            values,
        )
        self._require_known_kinds(row[2] for row in rows)
        return [_attempt(*row) for row in rows]

    def verdicts(self) -> list[tuple[int, datetime, str | None]]:
        """Return of every attempt, oldest first, number, start and verdict: what a whole night is looked through by."""
        rows = self._rows("SELECT id, started_at, verdict, kind FROM attempts ORDER BY id")
        self._require_known_kinds(row[3] for row in rows)
        return [(number, datetime.fromisoformat(at), verdict) for number, at, verdict, _ in rows]

    def events(self) -> list[SessionEvent]:
        """Return every event, oldest first."""
        rows = self._rows("SELECT at, what, detail, id FROM events ORDER BY id")
        return [SessionEvent(datetime.fromisoformat(at), *event) for at, *event in rows]

    def details(self, attempts: Sequence[int] | None = None) -> dict[int, AttemptDetails]:
        """Return what is kept of attempts, those of these numbers or all, by number, oldest first; see `begin`.

        Attempts of which nothing is kept are left out.
        """
        among, numbers = _among("attempt", attempts)
        seen: dict[int, tuple[float, float, float]] = {
            attempt: (red, green, blue)
            for attempt, red, green, blue in self._rows(
                f"SELECT attempt, red, green, blue FROM measurements WHERE red IS NOT NULL AND {among}", numbers
            )
        }
        checks: dict[int, list[Check]] = {}
        for attempt, *check in self._rows(
            "SELECT attempt, name, value, low, high, unit, reason FROM checks"
            f" WHERE {among} ORDER BY attempt, position",
            numbers,
        ):
            checks.setdefault(attempt, []).append(Check(*check))
        timings: dict[int, dict[str, float]] = {}
        for attempt, name, seconds in self._rows(
            f"SELECT attempt, name, seconds FROM timings WHERE {among} ORDER BY rowid", numbers
        ):
            timings.setdefault(attempt, {})[name] = seconds
        return {
            number: AttemptDetails(seen.get(number), tuple(checks.get(number, ())), timings.get(number, {}))
            for number in sorted(seen.keys() | checks.keys() | timings.keys())
        }

    def measurements(self) -> Iterator[tuple[SessionStep, int, bytes, bool]]:
        """Return what the judge keeps of each frame, in taking order: step, attempt, bytes, and whether it counts."""
        plan = {step.number: step for step in self.steps()}
        for attempt, step, data, verdict in self._rows(
            "SELECT id, step, data, verdict FROM attempts JOIN measurements ON attempt = id ORDER BY id"
        ):
            if step in plan and data:
                yield plan[step], attempt, data, verdict == ACCEPTED

    def accepted_files(self) -> list[AcceptedFile]:
        """Return every frame that was accepted, oldest first."""
        rows = self._rows(
            "SELECT id, step, illumination, file, size, sha256 FROM attempts WHERE verdict=? ORDER BY id", (ACCEPTED,)
        )
        return [_accepted_file(*row) for row in rows]

    def lacking(self, frames: Frames) -> Frames:
        """Return the frames among these that are not here, or have another verdict."""
        return _lacking_frames(
            frames, {*self._rows("SELECT id, sha256, verdict FROM attempts WHERE sha256 IS NOT NULL")}
        )

    def unused_bytes(self, after: int) -> int:
        """Return how many bytes the raw files of refused and voided attempts with numbers above `after` take."""
        query = "SELECT COALESCE(SUM(size), 0) FROM attempts WHERE id > ? AND verdict IN (?, ?)"
        return int(self._rows(query, (after, REFUSED, VOIDED))[0][0])

    def kept_files(self, step: SessionStep) -> int:
        """Return how many raw files, accepted or refused, `step` has already."""
        query = "SELECT COUNT(*) FROM attempts WHERE step=? AND sha256 IS NOT NULL"
        return int(self._rows(query, (step.number,))[0][0])

    def frames(self) -> list[FrameRecord]:
        """Return every frame that was taken and judged, in the order of the plan, refused ones included."""
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
                f"{self.path} holds a frame of the kind {unknown[0]!r}, this software knows {', '.join(KINDS)}; use "
                "the software that took the session"
            )

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """Return all rows at once, so that nothing is held once they are read."""
        try:
            return self._retry.run(lambda: self._connection.execute(query, values).fetchall())
        except sqlite3.DatabaseError as error:
            raise reading_fault(self.path, error) from error

    @contextmanager
    def _writing(self) -> Generator[_Change]:
        """Make what is written inside one transaction, which is on the disk when the block ends.

        What is lost with the journal stands in the ledger all the same.
        """
        try:
            self._retry.run(lambda: self._connection.execute("BEGIN IMMEDIATE"))
            change = _Change(self._connection)
            yield change
            if self._ledger is not None and change.rows:
                self._append(self._ledger, change.rows)
            if self._gives_signs and change.rows:
                # A frame is a sign of life, too: a run that is killed was there when its last one was written.
                self._connection.execute("UPDATE heartbeat SET at = ?", (time_text(datetime.now(UTC)),))
            if self._guard is not None:
                self._guard.require_same()
            self._retry.run(lambda: self._connection.execute("COMMIT"))
            if self._guard is not None:
                self._guard.wrote()
            if self._ledger is not None:
                self._ledger.keep()
        except LostJournalError:
            if self._ledger is not None:
                self._ledger.keep()
            raise
        except sqlite3.DatabaseError as error:
            raise writing_error(self.path, error) from error
        finally:
            with suppress(sqlite3.Error):
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")

    def _append(self, ledger: _Ledger, rows: Mapping[str, Sequence[Row]]) -> None:
        if not ledger.is_there():
            # Of the file that is open: that on the disk may be gone as well.
            ledger.restore(rows_of(self._connection))
        ledger.append(rows)


def open_journal(folder: Path) -> Journal:
    """Open a session's journal to read it; refuse one that lacks what the ledger has, an older one for instance."""
    # A run writes the ledger first: read in this order, the journal is behind by one transaction at most.
    settled = settled_frames(ledger_path(folder))
    journal = Journal.open(folder / JOURNAL_FILE)
    try:
        _require_none_lacking(ledger_path(folder), journal.lacking(settled))
    except BaseException:
        journal.close()
        raise
    return journal


def lost_files(folder: Path, accepted: Sequence[AcceptedFile]) -> list[AcceptedFile]:
    """Return, of the accepted frames that count, one a step, those whose files are not there in full size."""
    newest = {frame.step: frame for frame in accepted}
    # As text: a path object for each of 800 frames takes twice as long as the look.
    return [frame for frame in newest.values() if not _has_size(f"{folder}/{frame.file}", frame.size)]


def _has_size(path: str, size: int) -> bool:
    try:
        return os.stat(path).st_size == size  # noqa: PTH116 - see above
    except OSError:
        return False


def without_journal(folder: Path) -> str:
    """Return what is said, and what helps, where a session's journal is gone."""
    path = folder / JOURNAL_FILE
    return f"{folder} holds the frames of a session, and its journal {path.name} is gone; {restoring(path)}"


def beat_beside(path: Path, state: RunState, sentence: str, until: datetime) -> None:
    """Give a sign of life from another thread than the one that has the journal open; none where that fails."""
    with suppress(sqlite3.Error), closing(connect(path, "rw")) as connection:
        connection.execute("BEGIN IMMEDIATE")
        _put_beat(connection, path, state, sentence, until)
        connection.execute("COMMIT")


def _put_beat(connection: sqlite3.Connection, path: Path, state: RunState, sentence: str, until: datetime) -> None:
    own, at, place = Process.own(), datetime.now(UTC), SessionPlace.of(path)
    if place is not None:
        connection.execute("INSERT OR REPLACE INTO records VALUES (?, ?)", (PLACE, place.to_text()))
    connection.execute(
        "INSERT OR REPLACE INTO heartbeat VALUES (1, ?, ?, ?, ?, ?, ?, ?, ?)",
        (time_text(at), own.pid, own.started, own.host, own.boot, state, sentence, time_text(until)),
    )


class _Change:
    """A transaction: what is put into it is written, and remembered for the ledger."""

    def __init__(self, connection: sqlite3.Connection) -> None:
        self._connection = connection
        self.rows: dict[str, list[Row]] = {}

    def put(self, table: str, row: Row) -> int:
        """Write a row, in place of one of the same key among the records; return its number."""
        verb = "INSERT OR REPLACE" if table == "records" else "INSERT"
        marks = ", ".join("?" * len(row))
        cursor = self._connection.execute(
            f"{verb} INTO {table} ({', '.join(row)}) VALUES ({marks})", tuple(row.values())
        )
        # SQLite keeps what is no number as NULL.
        plain = {name: None if isinstance(value, float) and value != value else value for name, value in row.items()}
        self.rows.setdefault(table, []).append(plain)
        assert cursor.lastrowid is not None
        return cursor.lastrowid

    def put_numbered(self, table: str, row: Row) -> int:
        """Write a row of a table that numbers its rows; return the number."""
        number = self.put(table, row)
        self.rows[table][-1] = {"id": number, **row}
        return number

    def set_attempt(self, attempt: int, row: Row) -> None:
        """Change columns of an attempt."""
        columns = ", ".join(f"{name}=?" for name in row)
        self._connection.execute(f"UPDATE attempts SET {columns} WHERE id=?", (*row.values(), attempt))
        self.rows.setdefault("attempts", []).append({"id": attempt, **row})


def time_text(at: datetime) -> str:
    """Return a time as journal and `frames.csv` have it: ISO 8601 with microseconds and zone."""
    return at.isoformat(timespec="microseconds")


# Rows of each kind that are kept as values: whoever watches a session reads its 800 frames again after each.
_ROWS_KEPT: Final = 8192

_accepted_file: Final = lru_cache(_ROWS_KEPT)(AcceptedFile)


def _among(column: str, numbers: Sequence[int] | None) -> tuple[str, tuple[str, ...]]:
    """Return the condition that a column is one of some numbers, however many there are, and its value; None: any."""
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
    """Return a verdict as readers of frames know it: accepted, or refused with the reason."""
    if verdict == ACCEPTED:
        return ACCEPTED
    return f"{REFUSED}: {reason}" if reason else REFUSED


@dataclass(frozen=True)
class _Look:
    """A file as it is now: its numbers, its size, and when it was written last, ns."""

    numbers: tuple[int, int]
    size: int
    written: int


class _JournalGuard:
    """Watches the journal that a run has open; `ledger` holds the same facts."""

    def __init__(self, path: Path, ledger: _Ledger) -> None:
        self._path, self._ledger = path, ledger
        self._files = (path, beside(path, "-wal"))
        self._folders = {folder: self._look(folder) for folder in (path.parent, path.parent / "frames")}
        self._trusts_numbers = not file_system_of(path).startswith(INVENTED_NUMBERS)
        self._known: dict[Path, _Look] = {}
        self.wrote()

    def wrote(self) -> None:
        """Note that the run itself has written the journal."""
        self._known = {file: look for file in self._files if (look := self._look(file)) is not None}

    def require_same(self) -> None:
        """Raise `LostJournalError` where the journal is not as the run left it."""
        for folder, before in self._folders.items():
            now = self._look(folder)
            if now is None or before is None or (self._trusts_numbers and now.numbers != before.numbers):
                raise StorageError(f"{folder} is gone, or another one", remedy="see that its disk is mounted")
        is_written = False
        for file, before in self._known.items():
            now = self._look(file)
            if now is None:
                self._lost(file, "was deleted")
            elif self._trusts_numbers and now.numbers != before.numbers:
                self._lost(file, "was replaced by another file")
            elif now.size < before.size:
                self._lost(file, f"was cut from {before.size} to {now.size} bytes")
            is_written |= now != before
        if is_written:
            self.require_whole()
            self.wrote()

    def require_whole(self) -> None:
        """Raise `LostJournalError` where the journal, as everybody else reads it, does not hold what the run wrote."""
        try:
            with closing(connect(self._path, "ro")) as connection:
                sound = connection.execute("PRAGMA quick_check(1)").fetchall() == [("ok",)]
                same = sound and rows_of(connection) == self._ledger.rows()
        except sqlite3.DatabaseError as error:
            fault = reading_fault(self._path, error)
            if isinstance(fault, StorageError):
                raise fault from error
            same = False
        if not same:
            self._lost(self._path, "was written to by another program, and does not hold what the run wrote")

    def _look(self, path: Path) -> _Look | None:
        try:
            found = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise storage_error(path, error, "look at") from error
        return _Look((found.st_dev, found.st_ino), found.st_size, found.st_mtime_ns)

    def _lost(self, file: Path, how: str) -> None:
        raise LostJournalError(
            f"{file} {how} while the run had it open; every frame and verdict stands in ledger.jsonl, too",
            remedy=f"acquire rebuild {self._path.parent} makes the journal anew; then run the same command again",
        )


_T = TypeVar("_T")


class LostJournalError(StorageError):
    """The journal that a run has open is not the one on the disk any more: waiting does not bring it back."""


class _LockRetry:
    """Waits while another program holds the journal."""

    def __init__(self, path: Path, seconds: float, announce: Callable[[str], object]) -> None:
        self._path = path
        self._seconds = seconds
        self._announce = announce

    def run(self, attempt: Callable[[], _T]) -> _T:
        """Return what `attempt` returns, after trying it again while another program holds the journal."""
        begun, announced = time.monotonic(), False
        while True:
            try:
                return attempt()
            except sqlite3.OperationalError as error:
                if not is_busy(error) or time.monotonic() - begun >= self._seconds:
                    raise
                if not announced:
                    self._announce(f"another program holds {self._path}; the run goes on when it has finished")
                    announced = True


LEDGER_FILE: Final = "ledger.jsonl"  # Its name in a session's folder

# Of a ledger that is read: twenty times what 707 lights have, so that a stranger's fills no memory.
_MOST_LEDGER_BYTES: Final = 1 << 30

PLACE: Final = "place"  # Key of the record that says for which folder signs of life are given

# What tells the rows of a table apart.
_ROW_KEYS: Final = {
    "plan": ("step",),
    "attempts": ("id",),
    "events": ("id",),
    "checks": ("attempt", "position"),
    "measurements": ("attempt",),
    "timings": ("attempt", "name"),
    "records": ("key",),
}

# Columns of an attempt that are not known when it begins, as the journal has them then.
_BEGUN: Final = dict.fromkeys(("ended_at", "taken_at", "exposure_s", "size", "sha256", "verdict")) | {"reason": ""}

Row = dict[str, Any]
Rows = dict[str, dict[tuple[Any, ...], Row]]  # Rows by table and key, columns by name


def ledger_path(folder: Path) -> Path:
    """Return the path of a session's ledger."""
    return folder / LEDGER_FILE


def rows_of(connection: sqlite3.Connection) -> Rows:
    """Return the facts that a journal of this version holds."""
    rows: Rows = {}
    for table in _ROW_KEYS:
        cursor = connection.execute(f"SELECT * FROM {table} ORDER BY rowid")
        names = [column[0] for column in cursor.description]
        for values in cursor.fetchall():
            _put_row(rows, table, dict(zip(names, values, strict=True)))
    rows.get("records", {}).pop((PLACE,), None)
    return {table: of_table for table, of_table in rows.items() if of_table}


def read_ledger(path: Path) -> Rows:
    """Return the facts that a ledger holds."""
    return _gathered(_read_transactions(path))


def _read_transactions(path: Path, size: int = _MOST_LEDGER_BYTES + 1) -> list[Mapping[str, Sequence[Row]]]:
    """Return the transactions in the first `size` bytes of a ledger."""
    try:
        with open_inside(path.parent, path.name) as stream:
            content = stream.read(size)
    except OSError as error:
        raise reading_error(path, error, "restore the session from a copy") from error
    if len(content) > _MOST_LEDGER_BYTES:
        raise FormatError(f"{path} has more than {_MOST_LEDGER_BYTES} bytes; restore it from a copy")
    return list(_transactions(path, content.split(b"\n")))


def _gathered(transactions: Sequence[Mapping[str, Sequence[Row]]]) -> Rows:
    rows: Rows = {}
    for transaction in transactions:
        for table, changes in transaction.items():
            for row in changes:
                _put_row(rows, table, row)
    return rows


def _transactions(path: Path, lines: Sequence[bytes]) -> Iterator[Mapping[str, Sequence[Row]]]:
    """Yield what each line says; what stands behind the last line break was cut off."""
    for number, line in enumerate(lines[:-1], 1):
        try:
            yield {table: [_checked_row(table, row) for row in rows] for table, rows in json.loads(line).items()}
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            if number == len(lines) - 1 and not line.endswith(b"}"):
                return
            raise FormatError(f"{path}, line {number}, is damaged: {error}; restore it from a copy") from error


def _checked_row(table: str, row: Row) -> Row:
    """Return a row as the journal has it; the names in it become part of statements."""
    if any(key not in row for key in _ROW_KEYS[table]) or not all(name.isidentifier() for name in row):
        raise ValueError(f"a row of {table} without its key")
    if not all(value is None or isinstance(value, str | int | float) for value in row.values()):
        raise ValueError(f"a row of {table} with what is no number and no text")
    if not is_inside_name(row.get("file", "frames")):
        raise ValueError(f"the file {row['file']!r}, which is none of the session")
    return row if "data" not in row else {**row, "data": base64.b64decode(row["data"], validate=True)}


def _put_row(rows: Rows, table: str, row: Row) -> None:
    key = tuple(row[name] for name in _ROW_KEYS[table])
    rows.setdefault(table, {}).setdefault(key, dict(_BEGUN) if table == "attempts" else {}).update(row)


def _ledger_line(rows: Mapping[str, Sequence[Row]]) -> bytes:

    def plain(value: object) -> str:
        return base64.b64encode(cast("bytes", value)).decode()

    return json.dumps(rows, default=plain, ensure_ascii=False, separators=(",", ":")).encode() + b"\n"


def _ledger_lines(rows: Rows) -> bytes:
    """Return facts as lines: the plan and the records, each attempt with what is known of it, and the events."""
    alone = [{table: list(rows[table].values())} for table in ("plan", "records") if table in rows]
    attempts: dict[int, dict[str, list[Row]]] = {}
    for table, column in (
        ("attempts", "id"),
        ("checks", "attempt"),
        ("measurements", "attempt"),
        ("timings", "attempt"),
    ):
        for row in rows.get(table, {}).values():
            attempts.setdefault(row[column], {}).setdefault(table, []).append(row)
    events = [{"events": list(rows["events"].values())}] if "events" in rows else []
    return b"".join(_ledger_line(one) for one in [*alone, *attempts.values(), *events])


class _Ledger:
    """A ledger that a run writes; close it after use.

    `rows`: what the journal holds. Where the file says something else it is written anew; a journal that lacks
    frames which the file has is refused by a FormatError.
    """

    def __init__(self, path: Path, rows: Rows) -> None:
        self._path = path
        try:
            is_there = path.is_file()
        except OSError as error:
            raise storage_error(path, error, "look at") from error
        if not is_there or not self._is_of(rows):
            write_atomic(path, _ledger_lines(rows))
        self._handle, self._end = self._opened()
        self._next = self._end

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            with suppress(OSError):  # All that it was given is on the disk.
                os.close(handle)

    def append(self, changes: Mapping[str, Sequence[Row]]) -> None:
        """Put a transaction down, in place of one that was never kept; it is on the disk when this returns."""
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

    def keep(self) -> None:
        """Let the last transaction stay: the journal has it, too, or is lost."""
        self._end = self._next

    def is_there(self) -> bool:
        """Return whether the file that is written is the one on the disk, in full size."""
        try:
            found, own = self._path.stat(), os.fstat(self._handle)
        except OSError:
            return False
        return (found.st_dev, found.st_ino, found.st_size) == (own.st_dev, own.st_ino, self._next)

    def restore(self, rows: Rows) -> None:
        """Write the file anew, which was removed or changed while it was open."""
        self.close()
        write_atomic(self._path, _ledger_lines(rows))
        self._handle, self._end = self._opened()
        self._next = self._end

    def rows(self) -> Rows:
        """Return the facts in the file, without a transaction that the journal does not have yet."""
        return _gathered(_read_transactions(self._path, self._end))

    def _is_of(self, rows: Rows) -> bool:
        """Return whether the file holds these facts; refuse where it knows of frames that are not among them."""
        try:
            transactions = _read_transactions(self._path)
        except FormatError:
            return False
        if _gathered(transactions) == rows:
            return True
        _require_none_lacking(self._path, _lacking_frames(_frames_in(_gathered(transactions[:-1])), _frames_in(rows)))
        return False

    def _opened(self) -> tuple[int, int]:
        try:
            handle = os.open(self._path, os.O_RDWR)
            return handle, os.fstat(handle).st_size
        except OSError as error:
            raise storage_error(self._path, error) from error


Frames = set[tuple[int, str, str | None]]  # Frames by attempt and hash, with their verdicts


def settled_frames(path: Path) -> Frames:
    """Return the frames that a journal must hold that is opened after this: all but those of the last transaction.

    None where there is no ledger, or a damaged one, which says nothing against a journal that is whole.
    """
    with suppress(FormatError, StorageError):
        if os.path.isfile(path):  # noqa: PTH113 - it never raises
            return _frames_in(_gathered(_read_transactions(path)[:-1]))
    return set()


def _lacking_frames(settled: Frames, known: Frames) -> Frames:
    """Return the settled frames that are not among those known, or have another verdict there.

    A frame that is known to be voided is no older state of it, since no verdict follows that one.
    """
    voided = {(attempt, sha256) for attempt, sha256, verdict in known if verdict == VOIDED}
    return {frame for frame in settled - known if frame[:2] not in voided}


def _require_none_lacking(path: Path, lacking: Frames) -> None:
    """Refuse a journal that lacks frames of the ledger `path`, or verdicts on them."""
    if lacking:
        raise FormatError(
            f"the journal of {path.parent} lacks {counted(len(lacking), 'frame')} that {path} has, or what was said of "
            "them: it is an older one, or was damaged",
            remedy=f"acquire rebuild {shlex.quote(str(path.parent))} makes it anew",
        )


def _frames_in(rows: Rows) -> Frames:
    return {
        (row["id"], row["sha256"], row["verdict"]) for row in rows.get("attempts", {}).values() if row.get("sha256")
    }
