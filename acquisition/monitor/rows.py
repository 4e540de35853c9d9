"""What the page shows of each attempt, read from a journal's tables; only those that may have changed are read again.

An attempt changes as long as it has no verdict, and once more when it is voided. Everything else is written once, so
that a look at a journal of 800 attempts reads a handful of rows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from acquisition.session.judgement import Check
from acquisition.session.records import VOIDED

_AT_ONCE = 500
"""Rows asked for by number in one query; the oldest builds of SQLite take 999 parameters."""


@dataclass(frozen=True)
class AttemptView:
    """One attempt at a frame as the page shows it.

    Attributes
    ----------
    id, step
        Its number, and that of its step in the plan.
    file
        Its raw file, relative to the session's folder.
    started_at, ended_at, taken_at
        Times of the lab's clock; None where it has not come so far.
    verdict, reason
        As in the journal; the verdict is None while it is under way, or if it was cut off.
    seen
        Camera RGB of the paper above black, counts; None if not measured.
    checks
        What was looked at, in the judge's order.
    timings
        Seconds of each part of it, by name.
    seconds
        From the start of the attempt before to the start of this one; None for the first of a run.
    """

    id: int
    step: int
    file: str
    started_at: datetime
    ended_at: datetime | None
    taken_at: datetime | None
    verdict: str | None
    reason: str
    seen: tuple[float, float, float] | None = None
    checks: tuple[Check, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    seconds: float | None = None

    @property
    def has_frame(self) -> bool:
        """Whether a raw file came of it; the name of one that failed may be that of the next try."""
        return self.taken_at is not None


@dataclass(frozen=True)
class EventView:
    """An event of the journal with its number."""

    id: int
    at: datetime
    what: str
    detail: str


def events_after(connection: sqlite3.Connection, last: int) -> tuple[EventView, ...]:
    """Return the events behind number `last`, oldest first."""
    rows = connection.execute("SELECT id, at, what, detail FROM events WHERE id > ? ORDER BY id", (last,))
    return tuple(EventView(row[0], datetime.fromisoformat(row[1]), row[2], row[3]) for row in rows)


def changed_attempts(
    connection: sqlite3.Connection, has_details: bool, known: Mapping[int, AttemptView]
) -> tuple[AttemptView, ...]:
    """Return the attempts that are new, or may have changed since they were read as `known`; oldest first.

    Parameters
    ----------
    connection
        In a transaction, so that a verdict is never read without its checks.
    has_details
        Whether the journal has tables of checks, measurements and timings (version 2).
    known
        By their numbers.
    """
    voided = {number for (number,) in connection.execute("SELECT id FROM attempts WHERE verdict = ?", (VOIDED,))}
    new = [number for (number,) in connection.execute("SELECT id FROM attempts WHERE id > ?", (max(known, default=0),))]
    stale = {number for number, view in known.items() if view.verdict is None}
    stale |= {number for number in voided if number in known and known[number].verdict != VOIDED}
    numbers = sorted(stale.union(new))
    views: list[AttemptView] = []
    for begin in range(0, len(numbers), _AT_ONCE):
        views += _attempts(connection, has_details, numbers[begin : begin + _AT_ONCE])
    return tuple(views)


def with_seconds(views: Sequence[AttemptView], starts: Iterable[datetime]) -> tuple[AttemptView, ...]:
    """Return attempts, oldest first, with the seconds since the one before; none across the start of a run.

    Parameters
    ----------
    starts
        When runs began, by the lab's clock.
    """
    begun = sorted(starts)
    timed: list[AttemptView] = []
    for before, view in zip([None, *views], views, strict=False):
        apart = before is None or any(before.started_at < start <= view.started_at for start in begun)
        seconds = None if before is None or apart else (view.started_at - before.started_at).total_seconds()
        timed.append(view if seconds == view.seconds else replace(view, seconds=seconds))
    return tuple(timed)


def _attempts(connection: sqlite3.Connection, has_details: bool, numbers: Sequence[int]) -> list[AttemptView]:
    """Return the attempts of these numbers, with all that is known of them."""
    among = f"IN ({','.join('?' * len(numbers))})"
    seen: dict[int, tuple[float, float, float]] = {}
    checks: dict[int, list[Check]] = {}
    timings: dict[int, dict[str, float]] = {}
    if has_details:
        query = f"SELECT attempt, red, green, blue FROM measurements WHERE red IS NOT NULL AND attempt {among}"
        seen = {attempt: (red, green, blue) for attempt, red, green, blue in connection.execute(query, numbers)}
        query = f"SELECT attempt, name, value, low, high, unit, reason FROM checks WHERE attempt {among}"
        for attempt, *check in connection.execute(f"{query} ORDER BY attempt, position", numbers):
            checks.setdefault(attempt, []).append(Check(*check))
        query = f"SELECT attempt, name, seconds FROM timings WHERE attempt {among} ORDER BY rowid"
        for attempt, name, seconds in connection.execute(query, numbers):
            timings.setdefault(attempt, {})[name] = seconds
    query = "SELECT id, step, file, started_at, ended_at, taken_at, verdict, reason FROM attempts"
    return [
        AttemptView(
            row[0],
            row[1],
            row[2],
            datetime.fromisoformat(row[3]),
            _time(row[4]),
            _time(row[5]),
            row[6],
            row[7],
            seen.get(row[0]),
            tuple(checks.get(row[0], ())),
            timings.get(row[0], {}),
        )
        for row in connection.execute(f"{query} WHERE id {among} ORDER BY id", numbers)
    ]


def _time(text: Any) -> datetime | None:
    return datetime.fromisoformat(text) if text else None
