"""The journal of a session, `journal.sqlite`: the plan, every attempt at its frames, their verdicts, and events.

Rules that hold inside:

- The journal is written before and after each frame; every write is a transaction of its own and on the disk when the
  call returns, since a committed row is what makes a frame count.
- Rows are never deleted; a frame that was accepted can be voided. Times are ISO 8601 text with microseconds and zone,
  files are named relative to the session's folder.
- A reader changes nothing, and never stops a run.

Knows one file (`experiment.session.journal_file`: how it is opened); `experiment.session.folder` knows which raw
files are really there.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from drivers.presenter import Colour
from experiment.session.guard import JournalGuard
from experiment.session.heartbeat import Heartbeat, Process, RunState, SessionPlace
from experiment.session.journal_file import (
    JOURNAL_VERSION,
    LockRetry,
    LostJournalError,
    close_after_run,
    connect_to_write,
    create_file,
    open_for_run,
    open_to_read,
    reading_error,
    restoring,
    set_aside,
    writing_error,
)
from experiment.session.ledger import (
    PLACE,
    Frames,
    Ledger,
    Row,
    Rows,
    insert_rows,
    lacking_frames,
    ledger_path,
    require_none_lacking,
    rows_of,
    settled_frames,
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
from foundation.errors import FormatError, counted
from foundation.files import partial_path, sync_folder

JOURNAL_FILE = "journal.sqlite"
"""Name of the journal in a session's folder."""

_AMONG = "IN (SELECT value FROM json_each(?))"
"""Condition on numbers that are given as a JSON list, however many there are."""

PATIENCE_S = 600.0
"""How long a write waits for another program's unless the caller says otherwise: as long as a run waits for a device by
default (`sequence.patience_s`)."""


class Journal:
    """An open journal; close it after use. Used from one thread.

    `retry`: with which other programs are waited for; None for a reader, for whom SQLite waits.
    """

    def __init__(
        self, path: Path, connection: sqlite3.Connection, version: int, retry: LockRetry | None = None
    ) -> None:
        self.path = path
        self._connection = connection
        self._version = version
        self._writes = retry is not None
        self._retry = retry or LockRetry(path, 0, lambda sentence: None)
        self._ledger: Ledger | None = None
        self._guard: JournalGuard | None = None
        self._gives_signs = False

    @staticmethod
    def create(path: Path, steps: Sequence[SessionStep]) -> None:
        """Write a new journal with the plan and nothing else."""
        alone = LockRetry(path, 0, lambda sentence: None)
        with closing(Journal(path, create_file(path), JOURNAL_VERSION, alone)) as journal:
            journal.add_steps(steps)

    @classmethod
    def open(cls, path: Path) -> Journal:
        """Open a journal to read it, also while a run writes it; nothing is created or changed."""
        return cls(path, *open_to_read(path))

    @classmethod
    def open_for_run(
        cls,
        path: Path,
        patience_s: float = PATIENCE_S,
        announce: Callable[[str], object] = lambda sentence: None,
    ) -> Journal:
        """Open a journal to write it; one of an older version gets what it lacks."""
        retry = LockRetry(path, patience_s, announce)
        return cls(path, open_for_run(path, retry), JOURNAL_VERSION, retry)

    @staticmethod
    def rebuild(path: Path, rows: Rows) -> None:
        """Write a journal anew that holds these facts; what stands in its place keeps its bytes under another name."""
        copy = partial_path(path)
        copy.unlink(missing_ok=True)
        with closing(create_file(copy)) as connection, connection:
            connection.execute("BEGIN")
            insert_rows(connection, rows)
        Journal.open(copy).close()
        set_aside(path)
        copy.replace(path)
        sync_folder(path.parent)

    def keep_twice(self, ledger: Path) -> None:
        """Keep all facts in a second place, too, and watch that the journal stays the one that is open."""
        try:
            rows = self._retry.run(lambda: rows_of(self._connection))
        except sqlite3.DatabaseError as error:
            raise reading_error(self.path, error) from error
        self._ledger = Ledger(ledger, rows)
        self._guard = JournalGuard(self.path, self._ledger)

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
        self._retry = LockRetry(self.path, patience_s, announce)

    @contextmanager
    def one_moment(self) -> Generator[None]:
        """Let all that is read inside be of one moment: a verdict is never seen without its checks."""
        self._rows("BEGIN")
        yield
        self._rows("ROLLBACK")

    def steps(self) -> tuple[SessionStep, ...]:
        """Return the plan, in taking order."""
        rows = self._rows("SELECT step, kind, illumination, red, green, blue FROM plan ORDER BY step")
        return tuple(SessionStep(row[0], self._kind(row[1]), row[2], Colour(*row[3:])) for row in rows)

    def add_steps(self, steps: Sequence[SessionStep]) -> None:
        """Put steps at the end of the plan; their numbers must be free."""
        with self._writing() as change:
            for step in steps:
                red, green, blue = step.colour.codes
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
        *,
        file: str,
        size: int,
        sha256: str,
        taken_at: datetime,
        exposure_s: float,
        ended_at: datetime,
        judgement: Judgement,
        timings: Mapping[str, float] | None = None,
    ) -> None:
        """Note that an attempt's raw file is complete and how it was judged; only now does the frame count.

        `file`, `size`, `sha256`: the raw file, relative to the session's folder, its bytes and their hash.
        `exposure_s`: the exposure asked for, seconds.
        """
        verdict = ACCEPTED if judgement.accepted else REFUSED
        row = {"file": file, "size": size, "sha256": sha256, "taken_at": time_text(taken_at), "exposure_s": exposure_s}
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
        return dict(self._newer_rows(f"SELECT key, text FROM records WHERE key <> '{PLACE}' ORDER BY key"))

    def heartbeat(self) -> Heartbeat | None:
        """Return the newest sign of life; None if none was ever given."""
        rows = self._newer_rows("SELECT at, pid, started, host, boot, state, sentence, until FROM heartbeat")
        if not rows:
            return None
        at, *process, state, sentence, until = rows[0]
        said = self._newer_rows(f"SELECT text FROM records WHERE key = '{PLACE}'")
        place = SessionPlace.from_text(said[0][0]) if said else None
        begun, due = datetime.fromisoformat(at), datetime.fromisoformat(until)
        return Heartbeat(begun, Process(*process), state, sentence, due, place)

    def attempts(self) -> list[Attempt]:
        """Return every attempt, oldest first."""
        rows = self._rows(
            "SELECT id, step, kind, illumination, file, started_at, ended_at, taken_at, verdict, reason"
            " FROM attempts ORDER BY id"
        )
        return [
            Attempt(
                *(number, step, self._kind(kind), light, file),
                *(datetime.fromisoformat(started_at), _time(ended_at), _time(taken_at), verdict, reason),
            )
            for number, step, kind, light, file, started_at, ended_at, taken_at, verdict, reason in rows
        ]

    def events(self) -> list[SessionEvent]:
        """Return every event, oldest first."""
        rows = self._rows("SELECT at, what, detail, id FROM events ORDER BY id")
        return [SessionEvent(datetime.fromisoformat(at), *event) for at, *event in rows]

    def details(self, attempts: Sequence[int] | None = None) -> dict[int, AttemptDetails]:
        """Return what is kept of attempts, those of these numbers or all, by number, oldest first; see `begin`.

        Those of which nothing is kept, as in journals of version 1, are not there.
        """
        among, numbers = "", tuple[str, ...]()
        if attempts is not None:
            among, numbers = f"AND attempt {_AMONG}", (json.dumps(list(attempts)),)
        seen: dict[int, tuple[float, float, float]] = {
            attempt: (red, green, blue)
            for attempt, red, green, blue in self._newer_rows(
                f"SELECT attempt, red, green, blue FROM measurements WHERE red IS NOT NULL {among}", numbers
            )
        }
        checks: dict[int, list[Check]] = {}
        for attempt, *check in self._newer_rows(
            "SELECT attempt, name, value, low, high, unit, reason FROM checks"
            f" WHERE TRUE {among} ORDER BY attempt, position",
            numbers,
        ):
            checks.setdefault(attempt, []).append(Check(*check))
        timings: dict[int, dict[str, float]] = {}
        for attempt, name, seconds in self._newer_rows(
            f"SELECT attempt, name, seconds FROM timings WHERE TRUE {among} ORDER BY rowid", numbers
        ):
            timings.setdefault(attempt, {})[name] = seconds
        return {
            number: AttemptDetails(seen.get(number), tuple(checks.get(number, ())), timings.get(number, {}))
            for number in sorted(seen.keys() | checks.keys() | timings.keys())
        }

    def measurements(self) -> Iterator[tuple[SessionStep, int, bytes, bool]]:
        """Return what the judge keeps of each frame, in taking order: step, attempt, bytes, and whether it counts."""
        plan = {step.number: step for step in self.steps()}
        for attempt, step, data, verdict in self._newer_rows(
            "SELECT id, step, data, verdict FROM attempts JOIN measurements ON attempt = id ORDER BY id"
        ):
            if step in plan and data:
                yield plan[step], attempt, data, verdict == ACCEPTED

    def accepted_files(self) -> list[AcceptedFile]:
        """Return every frame that was accepted, oldest first."""
        rows = self._rows(
            "SELECT id, step, illumination, file, size, sha256 FROM attempts WHERE verdict=? ORDER BY id", (ACCEPTED,)
        )
        return [AcceptedFile(*row) for row in rows]

    def lacking(self, frames: Frames) -> Frames:
        """Return the frames among these that are not here, or have another verdict."""
        return lacking_frames(
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
        """Return every frame that was taken and judged, in the order of the plan, refused ones included.

        Of a step with several accepted frames, as older software could leave them, the newest counts.
        """
        rows = self._rows(
            "SELECT step, kind, illumination, file, sha256, taken_at, exposure_s, verdict, reason, id FROM attempts"
            " WHERE sha256 IS NOT NULL ORDER BY step, id"
        )
        newest = {step: attempt for step, *_, verdict, _, attempt in rows if verdict == ACCEPTED}
        return [
            FrameRecord(
                *(self._kind(kind), light, file, sha256, datetime.fromisoformat(taken_at), exposure_s),
                _verdict_text(verdict, reason, newest.get(step, attempt) == attempt),
                attempt,
            )
            for step, kind, light, file, sha256, taken_at, exposure_s, verdict, reason, attempt in rows
        ]

    def _kind(self, kind: str) -> FrameKind:
        if kind not in KINDS:
            raise FormatError(
                f"{self.path} holds a frame of the kind {kind!r}, this software knows {', '.join(KINDS)}; use the "
                "software that took the session"
            )
        return kind

    def _newer_rows(self, query: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """Return rows of a table that journals of version 1 do not have."""
        return [] if self._version < JOURNAL_VERSION else self._rows(query, values)

    def _rows(self, query: str, values: tuple[Any, ...] = ()) -> list[Any]:
        """Return all rows at once, so that nothing is held once they are read."""
        try:
            return self._retry.run(lambda: self._connection.execute(query, values).fetchall())
        except sqlite3.DatabaseError as error:
            raise reading_error(self.path, error) from error

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

    def _append(self, ledger: Ledger, rows: Mapping[str, Sequence[Row]]) -> None:
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
        require_none_lacking(ledger_path(folder), journal.lacking(settled))
    except BaseException:
        journal.close()
        raise
    return journal


def lost_files(folder: Path, accepted: Sequence[AcceptedFile]) -> list[AcceptedFile]:
    """Return, of the accepted frames that count, one a step, those whose files are not there in full size."""
    newest = {frame.step: frame for frame in accepted}
    return [frame for frame in newest.values() if not _has_size(folder / frame.file, frame.size)]


def _has_size(path: Path, size: int) -> bool:
    try:
        return path.stat().st_size == size
    except OSError:
        return False


def without_journal(folder: Path) -> str:
    """Return what is said, and what helps, where a session's journal is gone."""
    path = folder / JOURNAL_FILE
    return f"{folder} holds the frames of a session, and its journal {path.name} is gone; {restoring(path)}"


def beat_beside(path: Path, state: RunState, sentence: str, until: datetime) -> None:
    """Give a sign of life from another thread than the one that has the journal open; none where that fails."""
    with suppress(sqlite3.Error), closing(connect_to_write(path)) as connection:
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


def _time(text: str | None) -> datetime | None:
    return datetime.fromisoformat(text) if text else None


def _verdict_text(verdict: str, reason: str, newest: bool) -> str:
    """Return a verdict as readers of frames know it: accepted, or refused with the reason."""
    if verdict == ACCEPTED:
        return ACCEPTED if newest else f"{REFUSED}: taken again since"
    return f"{REFUSED}: {reason}" if reason else REFUSED
