"""What the page shows of each attempt, read from a journal's tables; only those that may have changed are read again.

An attempt changes as long as it has no verdict, and once more when it is voided. Everything else is written once, so
that a look at a journal of 800 attempts reads a handful of rows.

What is asked first of a run that nobody attends: whether it lives, is good, when it is done, what must be done.

A session read from its journal, at once or in steps; nothing is ever written, and nothing is held open.
"""

from __future__ import annotations

import json
import shlex
import sqlite3
import statistics
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from experiment.lights import Illumination, load_illuminations
from experiment.session.heartbeat import AGAIN, Heartbeat, SessionPlace
from experiment.session.journal import AMONG, JOURNAL_FILE, Journal
from experiment.session.journal_file import open_to_read, reading_error
from experiment.session.plan import SessionStep
from experiment.session.records import (
    ACCEPTED,
    FAILED,
    RECENT,
    REFUSED,
    VOIDED,
    AttemptDetails,
    Check,
    TimedAttempt,
    time_left,
)
from foundation.errors import CropError


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


LAB_CLOCK_S = 600.0
"""How far the lab's clock may be from that of the wall for the end to be told as a time of day; a simulated lab's time
passes otherwise, and an attempt that is older than this says nothing of when the run will end."""


@dataclass(frozen=True)
class Head:
    """How a session stands.

    - `state`: ``running``, ``waiting`` or ``paused`` as the run says it; ``complete``; ``incomplete``: it has ended and
      frames are left; ``stopped``: killed or power lost; ``copy``: the run's signs of life are those of another folder;
      ``unknown``: the journal has no sign of life; ``absent``, ``gone``, ``unreadable``: there is no journal to read,
      yet, or any more.
    - `sentence`: the same in words, with the remedy behind a semicolon where there is one; empty while there is nothing
      to say.
    - `alive`: whether a run is at work.
    - `beat`, `until`: when it last gave a sign of life, and when the next is due, by the wall clock; None if it never
      did.
    - `total`, `done`, `lights_total`, `lights_done`: frames of the plan, and those that are accepted; the same of the
      lights alone.
    - `refused`, `failed`, `voided`: attempts that ended so.
    - `seconds_per_frame`: median interval of the newest `RECENT` attempts; None before the second.
    - `remaining_s`: time left by the lab's clock, retakes and references included; None while it is unknown.
    - `eta`: when all frames are there, by the wall clock; None where that cannot be told.
    - `last`: when the newest frame was released, by the lab's clock.
    """

    state: str
    sentence: str
    alive: bool = False
    beat: datetime | None = None
    until: datetime | None = None
    total: int = 0
    done: int = 0
    lights_total: int = 0
    lights_done: int = 0
    refused: int = 0
    failed: int = 0
    voided: int = 0
    seconds_per_frame: float | None = None
    remaining_s: float | None = None
    eta: datetime | None = None
    last: datetime | None = None


def head_of(
    steps: Sequence[SessionStep],
    attempts: Sequence[AttemptView],
    heartbeat: Heartbeat | None,
    now: datetime,
    *,
    process_alive: bool | None,
    name: str,
    here: SessionPlace | None = None,
) -> Head:
    """Return how a session stands.

    `heartbeat`: the newest sign of life; None where the journal has none. `process_alive`: whether the process that
    gave it is there; None if that cannot be told. `here`: where it lies; None if that is not known.
    """
    done = {view.step for view in attempts if view.verdict == ACCEPTED} & {step.number for step in steps}
    verdicts = [view.verdict for view in attempts]
    state, sentence = _state_of(heartbeat, now, process_alive, len(steps) - len(done), len(steps), name, here)
    alive = state in ("running", "waiting", "paused")
    pace = _pace(attempts)
    left = len(steps) - len(done)
    judged = (view for view in attempts if view.verdict is not None)
    remaining = time_left((TimedAttempt(view.seconds, view.verdict in (ACCEPTED, VOIDED)) for view in judged), left)
    newest = next((view.started_at for view in reversed(attempts)), None)
    near = (
        heartbeat is not None
        and newest is not None
        and state == "running"
        and abs((heartbeat.at - newest).total_seconds()) < LAB_CLOCK_S
    )
    return Head(
        state,
        sentence,
        alive,
        heartbeat.at if heartbeat else None,
        heartbeat.until if heartbeat else None,
        total=len(steps),
        done=len(done),
        lights_total=sum(step.kind == "light" for step in steps),
        lights_done=sum(step.kind == "light" and step.number in done for step in steps),
        refused=verdicts.count(REFUSED),
        failed=verdicts.count(FAILED),
        voided=verdicts.count(VOIDED),
        seconds_per_frame=pace,
        remaining_s=remaining,
        eta=now + timedelta(seconds=remaining) if near and remaining is not None else None,
        last=next((view.taken_at for view in reversed(attempts) if view.taken_at is not None), None),
    )


def _state_of(
    heartbeat: Heartbeat | None,
    now: datetime,
    process_alive: bool | None,
    left: int,
    total: int,
    name: str,
    here: SessionPlace | None,
) -> tuple[str, str]:
    copied = heartbeat is not None and heartbeat.state != "ended" and heartbeat.is_of(here) is False
    over = heartbeat is None or heartbeat.state == "ended" or copied or heartbeat.is_dead(now, process_alive)
    if over and total and not left:
        return "complete", f"complete, {total} frames; next: build-lut {shlex.quote(name)} LUT/"
    if heartbeat is None:
        return "unknown", f"{left} of {total} frames are left, and the journal has no sign of life of a run"
    if copied and here is not None:
        return "copy", heartbeat.sentence_of_copy(here, process_alive)
    if heartbeat.is_dead(now, process_alive):
        return "stopped", heartbeat.sentence_for(now, process_alive)
    if heartbeat.state == "ended":
        return "incomplete", heartbeat.sentence or f"ended with {left} of {total} frames left; {AGAIN}"
    return heartbeat.state, heartbeat.sentence


def _pace(attempts: Sequence[AttemptView]) -> float | None:
    """Return the median interval of the newest attempts, seconds."""
    intervals = [view.seconds for view in attempts[-RECENT:] if view.seconds is not None]
    return statistics.median(intervals) if intervals else None


RUN_STARTS = "start"
"""The event with which a run begins to take frames."""


@dataclass(frozen=True)
class SessionView:
    """A session as it was read.

    - `name`: name of its folder.
    - `given`: the same as it was named by who asked, for the sentence that says what comes next.
    - `steps`, `lights`: the plan, and the lights that it shows; no lights if their file cannot be read.
    - `records`: what the journal says of devices, software and plan.
    - `attempts`, `events`: all of them, oldest first.
    - `heartbeat`: the newest sign of life; None where there is none.
    - `place`: where it lies; None if that is not known.
    """

    name: str
    steps: tuple[SessionStep, ...]
    lights: tuple[Illumination, ...]
    records: Mapping[str, str]
    attempts: tuple[AttemptView, ...]
    events: tuple[EventView, ...]
    heartbeat: Heartbeat | None
    given: str = ""
    place: SessionPlace | None = None

    def head(self, now: datetime) -> Head:
        """Return how it stands at the wall clock's `now`; the process that takes it is looked for."""
        alive = self.heartbeat.process.is_alive() if self.heartbeat else None
        return head_of(
            self.steps,
            self.attempts,
            self.heartbeat,
            now,
            process_alive=alive,
            name=self.given or self.name,
            here=self.place,
        )

    def whites(self) -> dict[int, tuple[float, float, float] | None]:
        """Return by attempt what was seen of the white frame that it is held against.

        That is the newest accepted one up to it; before the first of them, the first.
        """
        white_steps = {step.number for step in self.steps if step.kind == "white"}
        whites = {
            view.id: view.seen
            for view in self.attempts
            if view.step in white_steps and view.verdict == ACCEPTED and view.seen and min(view.seen) > 0
        }
        held = next(iter(whites.values()), None)
        against: dict[int, tuple[float, float, float] | None] = {}
        for view in self.attempts:
            held = whites.get(view.id, held)
            against[view.id] = held
        return against


def read_session(folder: Path, before: SessionView | None = None) -> SessionView:
    """Return a session as it stands on the disk."""
    path = folder / JOURNAL_FILE
    connection, version = open_to_read(path)
    journal = Journal(path, connection, version)
    with closing(journal):
        try:
            # One transaction: a verdict is never seen without its checks.
            connection.execute("BEGIN")
            newest = connection.execute("SELECT COALESCE(MAX(id), 0) FROM attempts").fetchone()[0]
            planned = connection.execute("SELECT COUNT(*) FROM plan").fetchone()[0]
            if before is not None and (planned != len(before.steps) or any(one.id > newest for one in before.attempts)):
                before = None
            known = {view.id: view for view in before.attempts} if before else {}
            known |= {view.id: view for view in changed_attempts(connection, journal, known)}
            events = before.events if before else ()
            events += events_after(connection, events[-1].id if events else 0)
            steps = before.steps if before else journal.steps()
            records, heartbeat = journal.records(), journal.heartbeat()
        except sqlite3.DatabaseError as error:
            raise reading_error(path, error) from error
    starts = [event.at for event in events if event.what == RUN_STARTS]
    attempts = with_seconds([known[number] for number in sorted(known)], starts)
    lights = before.lights if before else _lights_of(folder)
    name, place = folder.resolve().name, SessionPlace.of(path)
    return SessionView(name, steps, lights, records, attempts, events, heartbeat, str(folder), place)


def _lights_of(folder: Path) -> tuple[Illumination, ...]:
    """Return the lights' kinds and temperatures; the plan has their codes, which are shown also without the file."""
    try:
        return tuple(load_illuminations(folder / "illuminations.csv"))
    except (CropError, OSError):
        return ()
