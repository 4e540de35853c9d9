"""What is asked first of a run that nobody attends: whether it lives, is good, when it is done, what must be done."""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from acquisition.monitor.rows import AttemptView
from experiment.session.heartbeat import AGAIN, Heartbeat, SessionPlace
from experiment.session.plan import SessionStep
from experiment.session.progress import RECENT, TimedAttempt, time_left
from experiment.session.records import ACCEPTED, FAILED, REFUSED, VOIDED

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
