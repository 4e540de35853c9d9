"""A session read from its journal, at once or in steps; nothing is ever written, and nothing is held open."""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from acquisition.monitor.head import Head, head_of
from acquisition.monitor.rows import AttemptView, EventView, changed_attempts, events_after, with_seconds
from experiment.lights.illuminations import Illumination, load_illuminations
from experiment.session.heartbeat import Heartbeat, SessionPlace
from experiment.session.journal import JOURNAL_FILE, Journal
from experiment.session.journal_file import open_to_read, reading_error
from experiment.session.plan import SessionStep
from experiment.session.records import ACCEPTED
from foundation.errors import CropError

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
