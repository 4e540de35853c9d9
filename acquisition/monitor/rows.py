"""What the page shows of each attempt, read from a journal's tables; only those that may have changed are read again.

An attempt changes as long as it has no verdict, and once more when it is voided. Everything else is written once, so
that a look at a journal of 800 attempts reads a handful of rows.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

from experiment.session.journal import AMONG, Journal
from experiment.session.judgement import AttemptDetails, Check
from experiment.session.records import VOIDED


@dataclass(frozen=True)
class AttemptView:
    """One attempt at a frame as the page shows it.

    - `id`, `step`: its number, and that of its step in the plan.
    - `file`: its raw file, relative to the session's folder.
    - `started_at`, `ended_at`, `taken_at`: times of the lab's clock; None where it has not come so far.
    - `verdict`, `reason`: as in the journal; the verdict is None while it is under way, or if it was cut off.
    - `seen`: camera RGB of the paper above black, counts; None if not measured.
    - `checks`: what was looked at, in the judge's order.
    - `timings`: seconds of each part of it, by name.
    - `seconds`: from the start of the attempt before to the start of this one; None for the first of a run.
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
    connection: sqlite3.Connection, journal: Journal, known: Mapping[int, AttemptView]
) -> tuple[AttemptView, ...]:
    """Return the attempts that are new, or may have changed since they were read as `known`; oldest first."""
    voided = {number for (number,) in connection.execute("SELECT id FROM attempts WHERE verdict = ?", (VOIDED,))}
    new = [number for (number,) in connection.execute("SELECT id FROM attempts WHERE id > ?", (max(known, default=0),))]
    stale = {number for number, view in known.items() if view.verdict is None}
    stale |= {number for number in voided if number in known and known[number].verdict != VOIDED}
    numbers = sorted(stale.union(new))
    return tuple(_attempts(connection, journal, numbers))


def with_seconds(views: Sequence[AttemptView], starts: Iterable[datetime]) -> tuple[AttemptView, ...]:
    """Return attempts, oldest first, with the seconds since the one before; none across the start of a run.

    And none where time goes back, as in sessions of older software whose clock was set.
    """
    begun = sorted(starts)
    timed: list[AttemptView] = []
    for before, view in zip([None, *views], views, strict=False):
        apart = before is None or any(before.started_at < start <= view.started_at for start in begun)
        seconds = None if before is None or apart else (view.started_at - before.started_at).total_seconds()
        # A clock that was set back between the two says nothing of how long it took.
        seconds = None if seconds is not None and seconds < 0 else seconds
        timed.append(view if seconds == view.seconds else replace(view, seconds=seconds))
    return tuple(timed)


def _attempts(connection: sqlite3.Connection, journal: Journal, numbers: Sequence[int]) -> list[AttemptView]:
    """Return the attempts of these numbers, rising, with all that is known of them."""
    details, nothing = journal.details(numbers), AttemptDetails()
    query = "SELECT id, step, file, started_at, ended_at, taken_at, verdict, reason FROM attempts"
    views: list[AttemptView] = []
    for row in connection.execute(f"{query} WHERE id {AMONG} ORDER BY id", (json.dumps(numbers),)):
        known = details.get(row[0], nothing)
        views.append(
            AttemptView(
                row[0],
                row[1],
                row[2],
                datetime.fromisoformat(row[3]),
                _time(row[4]),
                _time(row[5]),
                row[6],
                row[7],
                known.seen,
                known.checks,
                known.timings,
            )
        )
    return views


def _time(text: Any) -> datetime | None:
    return datetime.fromisoformat(text) if text else None
