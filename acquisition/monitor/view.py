"""A session as its journal shows it at one moment: its attempts, and how it stands.

Nothing is ever written, and nothing is held open. What is asked first of a run that nobody attends is whether it lives,
is good, when it is done, and what must be done (`Head`). An attempt changes as long as it has no verdict, and once more
when it is voided; what else is known of it is written once, so that of 800 attempts a few are read in detail.
"""

from __future__ import annotations

import shlex
import shutil
import statistics
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from experiment.lights import Illumination, load_illuminations
from experiment.session.heartbeat import AGAIN, BEAT_S, LATE_S, Heartbeat, SessionPlace
from experiment.session.journal import JOURNAL_FILE, Journal, lost_files, open_journal
from experiment.session.records import (
    ACCEPTED,
    FAILED,
    RECENT,
    REFUSED,
    VOIDED,
    Attempt,
    AttemptDetails,
    Check,
    SessionEvent,
    SessionStep,
    TimedAttempt,
    time_left,
)
from foundation.errors import CropError, first_of

RUN_STARTS = "start"
"""The event with which a run begins to take frames."""

LATE_FRAMES = 3
"""Times that frames lately took, after which one is late: a download that is tried again takes twice as long."""

AT_WORK = ("running", "waiting", "paused", "late")
"""States of a run that is at work."""

CAUSES = ("the camera", "the screen", "the projector", "the disk", "the frames")
"""What a run may hang at, or wait for somebody to mend."""

LEAST_FREE_BYTES = 1 << 20
"""A disk with less is full, also before the first frame: a row of the journal with what the judge keeps has 100 kB."""

LOOK = "look at the camera, its cable and the machine"
"""What helps where a run says nothing."""

LAB_CLOCK_S = 600.0
"""How far the lab's clock may be from that of the wall for the end to be told as a time of day; a simulated lab's time
passes otherwise, and an attempt that is older than this says nothing of when the run will end."""


@dataclass(frozen=True)
class AttemptView(Attempt):
    """One attempt at a frame with what is kept of it (`AttemptDetails`).

    `seconds`: from the start of the attempt before to the start of this one; None for the first of a run.
    """

    seen: tuple[float, float, float] | None = None
    checks: tuple[Check, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    seconds: float | None = None


@dataclass(frozen=True)
class Head:
    """How a session stands.

    - `state`: ``running``, ``waiting`` or ``paused`` as the run says it; ``late``: it runs, and a frame takes much
      longer than those before; ``silent``: it is there, and the sign of life that it announced did not come;
      ``complete``; ``incomplete``: it has ended and frames are left; ``stopped``: killed or power lost; ``copy``: the
      run's signs of life are those of another folder; ``unknown``: the journal has no sign of life; ``absent``,
      ``gone``, ``unreadable``: there is no journal to read, yet, or any more.
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
    - `cause`: of a run that is late or paused, or ended with frames left: one of `CAUSES`; empty where that is not
      known, or nothing is wrong.
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
    cause: str = ""
    last: datetime | None = None

    def to_plain(self) -> dict[str, Any]:
        """Return it for programs, times as ISO 8601 text."""
        return {name: at.isoformat() if isinstance(at, datetime) else at for name, at in vars(self).items()}


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
    - `frame_bytes`: size of its largest frame; 0 before the first.
    - `lost`: files of frames that count and are gone or cut, by step; only looked for where all frames are there.
    - `unreadable`: why no table can be made of it, and what helps, such as a lost chart; empty where nobody looked.
    """

    name: str
    given: str
    steps: tuple[SessionStep, ...]
    lights: tuple[Illumination, ...]
    records: Mapping[str, str]
    attempts: tuple[AttemptView, ...]
    events: tuple[SessionEvent, ...]
    heartbeat: Heartbeat | None
    place: SessionPlace | None
    frame_bytes: int = 0
    lost: Mapping[int, str] = field(default_factory=dict[int, str])
    unreadable: str = ""

    def head(self, now: datetime) -> Head:
        """Return how it stands at the wall clock's `now`; process and disk are looked at."""
        process = self.heartbeat.process if self.heartbeat else None
        return head_of(
            self,
            now,
            process.is_alive() if process else None,
            is_stopped=bool(process and process.is_stopped()),
            free_bytes=free_bytes_of(Path(self.given)),
        )

    def whites(self) -> dict[int, tuple[float, float, float] | None]:
        """Return by attempt what was seen of the white frame that it is compared with.

        That is the newest accepted one up to it; before the first of them, the first.
        """
        white_steps = {step.number for step in self.steps if step.kind == "white"}
        whites = {
            view.id: view.seen
            for view in self.attempts
            if view.step in white_steps and view.verdict == ACCEPTED and view.seen and min(view.seen) > 0
        }
        newest = next(iter(whites.values()), None)
        against: dict[int, tuple[float, float, float] | None] = {}
        for view in self.attempts:
            newest = whites.get(view.id, newest)
            against[view.id] = newest
        return against


def read_session(folder: Path, before: SessionView | None = None) -> SessionView:
    """Return a session as it stands on the disk; of what was read `before` only what has changed is read again."""
    path = folder / JOURNAL_FILE
    opened = Journal.open(path) if before else open_journal(folder)
    with closing(opened) as journal, journal.one_moment():
        steps, rows, events = journal.steps(), journal.attempts(), journal.events()
        accepted = journal.accepted_files()
        known = {view.id: view for view in before.attempts} if before else {}
        changed = [row for row in rows if row.id not in known or not _is_same(known[row.id], row)]
        details, nothing = journal.details([row.id for row in changed]), AttemptDetails()
        known |= {row.id: AttemptView(**vars(row), **vars(details.get(row.id, nothing))) for row in changed}
        records, heartbeat = journal.records(), journal.heartbeat()
    starts = [event.at for event in events if event.what == RUN_STARTS]
    is_complete = {step.number for step in steps} <= {frame.step for frame in accepted}
    return SessionView(
        folder.resolve().name,
        str(folder),
        steps,
        before.lights if before and before.steps == steps else _lights_of(folder),
        records,
        with_seconds([known[row.id] for row in rows], starts),
        tuple(events),
        heartbeat,
        SessionPlace.of(path),
        max((frame.size for frame in accepted), default=0),
        {frame.step: frame.file for frame in lost_files(folder, accepted)} if is_complete else {},
    )


def _is_same(view: AttemptView, row: Attempt) -> bool:
    return (view.verdict, view.started_at) == (row.verdict, row.started_at)


def _lights_of(folder: Path) -> tuple[Illumination, ...]:
    """Return the lights' kinds and temperatures; the plan has their codes, which are shown also without the file."""
    try:
        return load_illuminations(folder / "illuminations.csv")
    except (CropError, OSError):
        return ()


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


def free_bytes_of(folder: Path) -> int | None:
    """Return what a session's disk has free; None where it does not say."""
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return None


def head_of(
    view: SessionView,
    now: datetime,
    process_alive: bool | None,
    *,
    is_stopped: bool = False,
    free_bytes: int | None = None,
) -> Head:
    """Return how a session stands.

    `process_alive`: whether the process that gave the newest sign of life is there; None if that cannot be told.
    `is_stopped`: whether it was stopped by a signal. `free_bytes`: of the session's disk; None if it does not say.
    """
    steps, attempts, heartbeat = view.steps, view.attempts, view.heartbeat
    done = {one.step for one in attempts if one.verdict == ACCEPTED} & {step.number for step in steps} - {*view.lost}
    verdicts = [one.verdict for one in attempts]
    left = len(steps) - len(done)
    intervals = [one.seconds for one in attempts[-RECENT:] if one.seconds is not None]
    frame_s = statistics.median(intervals) if intervals else None
    state, sentence = _state_of(view, now, process_alive, left, frame_s)
    if state in AT_WORK and heartbeat is not None:
        if is_stopped:
            pid = heartbeat.process.pid
            state, sentence = "silent", f"its process {pid} was stopped by a signal; kill -CONT {pid} lets it go on"
        elif _is_full(view, free_bytes) and (state, _cause(sentence)) != ("paused", "the disk"):
            state, sentence = "late", "the disk is full; free space, and the run goes on by itself"
    judged = (one for one in attempts if one.verdict is not None)
    remaining = time_left((TimedAttempt(one.seconds, one.verdict in (ACCEPTED, VOIDED)) for one in judged), left)
    near = (
        heartbeat is not None
        and bool(attempts)
        and state == "running"
        and abs((heartbeat.at - attempts[-1].started_at).total_seconds()) < LAB_CLOCK_S
    )
    return Head(
        state,
        sentence,
        state in AT_WORK,
        heartbeat.at if heartbeat else None,
        heartbeat.until if heartbeat else None,
        total=len(steps),
        done=len(done),
        lights_total=sum(step.kind == "light" for step in steps),
        lights_done=sum(step.kind == "light" and step.number in done for step in steps),
        refused=verdicts.count(REFUSED),
        failed=verdicts.count(FAILED),
        voided=verdicts.count(VOIDED),
        seconds_per_frame=frame_s,
        remaining_s=remaining,
        eta=now + timedelta(seconds=remaining) if near and remaining is not None else None,
        cause=_cause(sentence) if state in ("late", "paused", "incomplete") else "",
        last=next((one.taken_at for one in reversed(attempts) if one.taken_at is not None), None),
    )


def _is_full(view: SessionView, free_bytes: int | None) -> bool:
    return free_bytes is not None and free_bytes < max(view.frame_bytes, LEAST_FREE_BYTES)


def _cause(sentence: str) -> str:
    """Return what a sentence names first."""
    named = {sentence.find(cause): cause for cause in CAUSES if cause in sentence}
    return named[min(named)] if named else ""


def _state_of(
    view: SessionView, now: datetime, process_alive: bool | None, left: int, frame_s: float | None
) -> tuple[str, str]:
    heartbeat, here, total = view.heartbeat, view.place, len(view.steps)
    copied = heartbeat is not None and heartbeat.state != "ended" and heartbeat.is_of(here) is False
    over = heartbeat is None or heartbeat.state == "ended" or copied or heartbeat.is_dead(now, process_alive)
    if over and view.unreadable:
        return "incomplete", view.unreadable
    if over and total and not left:
        return "complete", f"complete, {total} frames; next: build-lut {shlex.quote(view.given)} LUT/"
    if over and view.lost:
        gone = first_of(list(view.lost.values()), 3)
        return "incomplete", f"{gone}: gone or cut since taken; restore from a copy, or {AGAIN}, which takes it again"
    if heartbeat is None:
        return "unknown", f"{left} of {total} frames are left, and the journal has no sign of life of a run"
    if copied and here is not None:
        return "copy", heartbeat.sentence_of_copy(here, process_alive)
    if heartbeat.is_dead(now, process_alive):
        return "stopped", heartbeat.sentence_for(now, process_alive)
    if heartbeat.state == "ended":
        return "incomplete", heartbeat.sentence or f"ended with {left} of {total} frames left; {AGAIN}"
    since = f"{heartbeat.at.astimezone():%Y-%m-%d %H:%M:%S}"
    if now > heartbeat.until + timedelta(seconds=LATE_S):
        doing = f"then: {heartbeat.sentence}"
        return "silent", f"no sign since {since}, and its process is there: it hangs, or was stopped ({doing}); {LOOK}"
    if heartbeat.state == "running" and frame_s is not None:
        due_s = BEAT_S + LATE_FRAMES * frame_s + LATE_S
        if (now - heartbeat.at).total_seconds() > due_s:
            return "late", f"late since {since}: a frame takes {frame_s:.1f} s, and none came; {LOOK}"
    return heartbeat.state, heartbeat.sentence
