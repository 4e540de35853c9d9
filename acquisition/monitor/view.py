"""A session as its journal shows it: its attempts, how it stands, and what a page gets of it while it grows.

Nothing is ever written, and nothing is held open. What is asked first of a run that nobody attends is whether it lives,
is good, when it is done, and what must be done (`Head`). An attempt changes as long as it has no verdict, and once more
when it is voided; what else is known of it is written once, so that of 800 attempts a few are read in detail.

One `SessionWatch` serves any number of pages. It opens the journal only when the file has changed, for as long as a few
queries take, so that a session can be begun, ended, deleted, replaced or restored meanwhile. Each change gets a number;
a page names the newest that it has and gets what came since, as JSON, and previews of frames.

Times of a page are milliseconds since 1970 UTC, numbers have six digits; its script (`web/page.js`) reads exactly this.
All of it is data; the page makes elements of it, never markup.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
import secrets
import shlex
import shutil
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from experiment.lights import Illumination, load_illuminations
from experiment.session.heartbeat import AGAIN, BEAT_S, LATE_S, Heartbeat, Process, SessionPlace
from experiment.session.journal import JOURNAL_FILE, Journal, ledger_path, lost_files, no_journal_text, open_journal
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
    duration_text,
    preview_path,
    time_left,
)
from foundation.colorimetry import decode_srgb
from foundation.errors import CropError, FormatError, first_few
from foundation.files import write_atomic

RUN_STARTS = "start"  # The event with which a run begins to take frames

# Times that frames lately took, after which one is late: a download that is tried again takes twice as long.
LATE_FRAMES = 3

AT_WORK = ("running", "waiting", "paused", "late")  # States of a run that is at work

# What a run may hang at, or wait for somebody to mend.
CAUSES = ("the camera", "the screen", "the projector", "the disk", "the frames")

# A disk with less is full, also before the first frame: a row of the journal with what the judge keeps has 100 kB.
LEAST_FREE_BYTES = 1 << 20

LOOK = "look at the camera, its cable and the machine"  # What helps where a run says nothing

# How far the lab's clock may be from that of the wall for the end to be told as a time of day; a simulated lab's time
# passes otherwise, and an attempt that is older than this says nothing of when the run will end.
LAB_CLOCK_S = 600.0


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
    """A session as it was read; attempts and events oldest first.

    - `name`, `given`: its folder, by name and as it was named by who asked, for the sentence that says what comes next.
    - `lights`: those of the plan; none if their file cannot be read.
    - `records`: what the journal says of devices, software and plan.
    - `heartbeat`, `place`: the newest sign of life, and where it lies; None where that is not known.
    - `frame_bytes`: size of its largest frame; 0 before the first.
    - `lost`: files of frames that count and are gone or cut, by step; only looked for where all frames are there.
    - `unreadable`: why no table can be made of it, and what helps, such as a lost chart; only looked for where all
      frames are there.
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
            free_bytes=_free_bytes_of(Path(self.given)),
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
    with closing(opened) as journal, journal.snapshot():
        steps, verdicts, events = journal.steps(), journal.verdicts(), journal.events()
        accepted = journal.accepted_files()
        known = {view.id: view for view in before.attempts} if before else {}
        changed = [
            number
            for number, started_at, verdict in verdicts
            if (old := known.get(number)) is None or (old.verdict, old.started_at) != (verdict, started_at)
        ]
        rows = journal.attempts(changed)
        details, nothing = journal.details(changed), AttemptDetails()
        known |= {row.id: AttemptView(**vars(row), **vars(details.get(row.id, nothing))) for row in rows}
        records, heartbeat = journal.records(), journal.heartbeat()
    starts = [event.at for event in events if event.what == RUN_STARTS]
    is_complete = {step.number for step in steps} <= {frame.step for frame in accepted}
    return SessionView(
        folder.resolve().name,
        str(folder),
        steps,
        before.lights if before and before.steps == steps else _lights_of(folder),
        records,
        with_seconds([known[number] for number, *_ in verdicts], starts),
        tuple(events),
        heartbeat,
        SessionPlace.of(path),
        max((frame.size for frame in accepted), default=0),
        {frame.step: frame.file for frame in lost_files(folder, accepted)} if is_complete else {},
        _without_own_files(folder) if is_complete else "",
    )


def _without_own_files(folder: Path) -> str:
    """Return that chart or lights of a session are gone, and what helps; nothing where they are there."""
    gone = [str(folder / name) for name in ("chart.json", "illuminations.csv") if not (folder / name).exists()]
    return f"{' and '.join(gone)}: gone; restore it from a copy of the session" if gone else ""


def _lights_of(folder: Path) -> tuple[Illumination, ...]:
    """Return the lights' kinds and temperatures; the plan has their codes, which are shown also without the file."""
    try:
        return load_illuminations(folder / "illuminations.csv")
    except (CropError, OSError):
        return ()


def with_seconds(views: Sequence[AttemptView], starts: Iterable[datetime]) -> tuple[AttemptView, ...]:
    """Return attempts, oldest first, with the seconds since the one before; none across the start of a run.

    And none where time goes back, as where the clock was set.
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


def _free_bytes_of(folder: Path) -> int | None:
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
    copied = heartbeat is not None and heartbeat.state != "ended" and heartbeat.belongs_to(here) is False
    over = heartbeat is None or heartbeat.state == "ended" or copied or heartbeat.is_dead(now, process_alive)
    if over and view.unreadable:
        return "incomplete", view.unreadable
    if over and total and not left:
        return "complete", f"complete, {total} frames; next: build-lut {shlex.quote(view.given)} LUT/"
    if over and view.lost:
        gone = first_few(list(view.lost.values()), 3)
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


Json = dict[str, Any]  # A JSON object


# A file that changed so short a time before it was looked at may change again within the resolution of its time stamp
# (10 ms at the slowest tick of Linux, more over a network), and is read once more.
FRESH_S = 0.25

# After so long a session is read again though its journal is as before: files of its frames may be gone.
LOOK_AGAIN_S = 10.0

# Newest attempts that are told again whenever anything is: a preview is written after its row, and a pipeline has two
# frames in hand beside the one that it shows.
_TOLD_AGAIN = 3


MOST_PICTURE_BYTES = 4 << 20  # Bytes of a preview that is shown: many times what one of 640 pixels has

_JPEG = b"\xff\xd8\xff"

_REVISION = re.compile("[0-9]{1,9}")

# Inode, time of change in ns and size of the journal and of what is written beside it; empty without a journal.
_Signature = tuple[tuple[int, int, int], ...]


@dataclass(frozen=True)
class _Numbered:
    """A session as it was read, and at which change each part of it became as it is."""

    epoch: str
    inode: int
    revision: int
    view: SessionView
    whites: Mapping[int, tuple[float, float, float] | None]
    attempts: Mapping[int, int]
    events: Mapping[int, int]


class SessionWatch:
    """A session that is looked at again and again; may be used from several threads.

    `clock`: returns seconds; the machine's own unless a test has another.
    """

    def __init__(self, folder: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.folder = folder
        self._clock = clock
        self._read_at = -math.inf
        self._lock = threading.Lock()
        self._signature: _Signature = ()
        self._unsettled = True
        self._known: _Numbered | None = None
        self._trouble: Head | None = None

    def view(self) -> SessionView | None:
        """Return the session as it stands now; None if there is none to read."""
        with self._lock:
            self._refresh()
            return self._known.view if self._known else None

    def head(self) -> Head:
        """Return how the session stands now."""
        with self._lock:
            self._refresh()
            return self._head()

    def picture(self, attempt: int) -> bytes:
        """Return the preview of an attempt's frame as JPEG; none if there is no such attempt, or no preview."""
        view = self.view()
        found = next((one for one in view.attempts if one.id == attempt and one.has_frame), None) if view else None
        return _read_picture(self.folder, found.file) if found else b""

    def state(self, since: str = "") -> Json | None:
        """Return what has changed since a page's cursor; None if nothing has.

        `since`: the `cursor` of the answer before; one that is not known here, or empty, gives everything.
        """
        with self._lock:
            self._refresh()
            known = self._known
            head = _head_json(self._head())
            epoch, revision = (known.epoch, known.revision) if known else ("", 0)
            cursor = f"{epoch}.{revision}.{digest(head)}"
            if since == cursor:
                return None
            state: Json = {"cursor": cursor, "head": head}
            if known is not None:
                state |= self._news(known, since)
            return state

    def _head(self) -> Head:
        if self._trouble is not None or self._known is None:
            return self._trouble or Head("absent", f"there is no session {self.folder} yet: this page waits for it")
        return self._known.view.head(datetime.now(UTC))

    def _news(self, known: _Numbered, since: str) -> Json:
        """Return what a page with this cursor does not have."""
        view = known.view
        epoch, revision, *_ = (*since.split("."), "", "")
        whole = epoch != known.epoch or not _REVISION.fullmatch(revision)
        seen = -1 if whole else int(revision)
        recent = {one.id for one in view.attempts[-_TOLD_AGAIN:]}
        news = [one for one in view.attempts if known.attempts[one.id] > seen or one.id in recent]
        changes: Json = {
            "frames": [
                _attempt_json(one, known.whites[one.id], _preview_version(self.folder, one.file)) for one in news
            ],
            "events": [_event_json(one) for one in view.events if known.events[one.number] > seen],
        }
        if whole:
            changes["session"] = _session_json(view)
        return {key: value for key, value in changes.items() if value}

    def _refresh(self) -> None:
        signature = _signature(self.folder / JOURNAL_FILE)
        now = self._clock()
        if signature == self._signature and not self._unsettled and now < self._read_at + LOOK_AGAIN_S:
            return
        self._read_at = now
        newest = max((changed for _, changed, _ in signature), default=0)
        self._unsettled = bool(signature) and time.time_ns() - newest < FRESH_S * 1e9
        self._signature = signature
        if not signature:
            if ledger_path(self.folder).exists():
                self._trouble = Head("gone", no_journal_text(self.folder))
                self._known = None
            elif self._known is not None:
                self._trouble = Head("gone", f"the session {self.folder} is gone; this page goes on when it is back")
                self._known = None
            return
        inode = signature[0][0]
        known = self._known if self._known is not None and self._known.inode == inode else None
        try:
            view = read_session(self.folder, known.view if known else None)
        except CropError as error:
            self._trouble = Head("unreadable", str(error))
            self._unsettled = True
            return
        self._trouble = None
        self._known = _numbered(inode, view, known)


def _numbered(inode: int, view: SessionView, before: _Numbered | None) -> _Numbered:
    """Return a session with its changes numbered; one that is not the same any more is told anew as a whole."""
    whites = view.whites()
    lost = before is not None and not before.attempts.keys() <= whites.keys()
    if before is None or lost or (view.steps, view.records) != (before.view.steps, before.view.records):
        attempts, events = dict.fromkeys(whites, 0), dict.fromkeys((one.number for one in view.events), 0)
        return _Numbered(secrets.token_hex(4), inode, 0, view, whites, attempts, events)
    old = {one.id: one for one in before.view.attempts}
    # Identity first: what was not read again is the same object, and comparing its checks would take its time.
    differing = {one.id for one in view.attempts if old.get(one.id) is not one and old.get(one.id) != one}
    changed = [number for number, white in whites.items() if number in differing or before.whites[number] != white]
    new = [one.number for one in view.events if one.number not in before.events]
    revision = before.revision + bool(changed or new)
    attempts = {**before.attempts, **dict.fromkeys(changed, revision)}
    events = {**before.events, **dict.fromkeys(new, revision)}
    return _Numbered(before.epoch, inode, revision, view, whites, attempts, events)


def _signature(path: Path) -> _Signature:
    """Return what tells whether a journal has changed: of its file, and of the one that write-ahead mode adds."""
    found: list[tuple[int, int, int]] = []
    for suffix in ("", "-wal"):
        try:
            of = path.with_name(path.name + suffix).stat()
        except OSError:
            if not suffix:
                return ()
            continue
        found.append((of.st_ino, of.st_mtime_ns, of.st_size))
    return tuple(found)


def _session_json(view: SessionView) -> Json:
    """Return what does not change while a session is taken: its name, plan, lights and devices.

    A step is [number, kind, light, red, green, blue], a light [index, kind, K, [r, b], red, green, blue]; its
    chromaticity is that of `experiment.lights`, None for one without any light.
    """
    kinds = {light.index: (light.kind, light.cct_k) for light in view.lights}
    shown = {step.illumination: step.colour for step in view.steps if step.illumination is not None}
    codes = dict(sorted(shown.items()))
    places = planned_places(list(codes.values()))
    return {
        "name": view.name,
        "steps": [[step.number, step.kind, step.illumination, *step.colour] for step in view.steps],
        "lights": [
            [index, *kinds.get(index, ("", None)), place, *codes[index]]
            for index, place in zip(codes, places, strict=True)
        ],
        "records": [[key, text] for key, text in view.records.items()],
    }


def planned_places(codes: Sequence[tuple[int, int, int]]) -> list[list[float] | None]:
    """Return the chromaticities [r, b] of the linear light that codes stand for, 0 … 1; None for no light."""
    linear = decode_srgb(np.array(codes, dtype=np.float64).reshape(-1, 3) / 255)
    return [place_of(red, green, blue) for red, green, blue in linear.tolist()]


def place_of(red: float, green: float, blue: float) -> list[float] | None:
    """Return the chromaticity [r, b] of linear values; None unless they are a light's."""
    total = red + green + blue
    if not math.isfinite(total) or total <= 0:
        return None
    return [float(f"{red / total:.6g}"), float(f"{blue / total:.6g}")]


def _attempt_json(view: AttemptView, white: tuple[float, float, float] | None, preview: int | None) -> Json:
    """Return an attempt.

    `white`: what was seen of the white frame that it is held against; None if there is none. `preview`: what names the
    version of its picture; None if there is none.
    """
    seen = view.seen
    place = place_of(*(one / of for one, of in zip(seen, white, strict=True))) if seen and white else None
    values: Json = {
        "id": view.id,
        "step": view.step,
        "at": _milliseconds(view.started_at),
        "taken": _milliseconds(view.taken_at),
        "verdict": view.verdict,
        "reason": view.reason,
        "seen": [_rounded(value) for value in seen] if seen else None,
        "seen_at": place,
        "checks": [_check(check) for check in view.checks],
        "timings": {name: _rounded(seconds) for name, seconds in view.timings.items()},
        "seconds": None if view.seconds is None else _rounded(view.seconds),
        "preview": preview if view.has_frame else None,
    }
    return {key: value for key, value in values.items() if value not in (None, "", {}, [])}


def _check(check: Check) -> list[Any]:
    """Return a check: [name, unit, value, low, high], and the reason where there is one."""
    numbers = [None if number is None else _rounded(number) for number in (check.value, check.low, check.high)]
    return [check.name, check.unit, *numbers, *([check.reason] if check.reason else [])]


def _event_json(event: SessionEvent) -> list[Any]:
    """Return an event: [time, what, detail]."""
    return [_milliseconds(event.at), event.what, event.detail]


def _head_json(head: Head) -> Json:
    return {
        name: _milliseconds(value) if isinstance(value, datetime) else value for name, value in asdict(head).items()
    }


def _rounded(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _milliseconds(at: datetime | None) -> int | None:
    return None if at is None else round(at.timestamp() * 1000)


def to_bytes(values: Json) -> bytes:
    """Return JSON as it is sent; no character of it ends a script element, wherever it is put."""
    text = json.dumps(values, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029").encode()


def digest(values: Json) -> str:
    """Return a short text that is another for other content."""
    return hashlib.blake2b(to_bytes(values), digest_size=6).hexdigest()


def _preview_version(folder: Path, file: str) -> int | None:
    try:
        return preview_path(folder, file).stat().st_mtime_ns // 1_000_000
    except OSError:
        return None


def _read_picture(folder: Path, file: str) -> bytes:
    """Return the bytes of a raw file's preview; none if it is not there, is no regular file, no JPEG, or too large."""
    path = preview_path(folder, file)
    with suppress(OSError):
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_PICTURE_BYTES:
            return b""
        data = path.read_bytes()
        return data if data.startswith(_JPEG) else b""
    return b""


REPORT_FILE = "report.html"  # Name of a session's report in its folder

# Bytes of all pictures in a report: with the third that base64 adds it can still be mailed (10 MB at most servers).
MOST_PICTURES_BYTES = 6 << 20

# Files that make up the page's script, in the order in which they stand in it; the last one begins.
SCRIPTS = ("plots.js", "head.js", "series.js", "page.js")

_PLACE = re.compile(r"\{(title|plain|policy|data|style|script)\}")


def live_page(name: str) -> tuple[str, str]:
    """Return the page that asks its server for the session's state, and the policy that the server sends along.

    `name` is shown until the server has answered.
    """
    plain = "This page shows the session by a script, which the browser does not run. See acquire status instead."
    policy = _policy("connect-src 'self'; img-src 'self' data:; frame-ancestors 'none'")
    return _filled(title=name, plain=plain, policy="", data=""), policy


def write_session_report(folder: Path, path: Path | None = None) -> Path:
    """Write the report of the session in `folder`, into it where no path is given, and return its path.

    To be called at the end of a run, also by the run itself: a run that goes on in this very process counts as ended.
    """
    path = folder / REPORT_FILE if path is None else path
    read_session(folder)
    watch = SessionWatch(folder)
    state, view = watch.state(), watch.view()
    if state is None or view is None:
        raise FormatError("has gone while its report was made", about=folder, remedy="name a session")
    now = datetime.now(UTC)
    head = _ended(view).head(now)
    state["head"] = _head_json(head)
    state["pictures"] = {
        str(number): f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"
        for number, data in _pictures(folder, view.attempts)
    }
    text = _filled(
        title=f"{view.name}, report of {now.astimezone():%Y-%m-%d %H:%M}",
        plain=_plain(head),
        policy=f'<meta http-equiv="Content-Security-Policy" content="{_policy("img-src data:")}">',
        data=f'<script type="application/json" id="embedded">{to_bytes(state).decode()}</script>',
    )
    write_atomic(path, text)
    return path


def _ended(view: SessionView) -> SessionView:
    beat = view.heartbeat
    if beat is None or beat.process != Process.own() or beat.state == "ended":
        return view
    return replace(view, heartbeat=replace(beat, state="ended", sentence=""))


def _pictures(folder: Path, attempts: Sequence[AttemptView]) -> Iterator[tuple[int, bytes]]:
    """Yield attempts with their pictures, as many as fit: the refused ones, then the last, then evenly spread ones."""
    left = MOST_PICTURES_BYTES
    refused = [view for view in attempts if view.has_frame and view.verdict not in (None, ACCEPTED)]
    accepted = [view for view in attempts if view.verdict == ACCEPTED]
    for view in [*refused, *(accepted[place] for place in _spread(len(accepted)))]:
        data = _read_picture(folder, view.file)
        if data and len(data) <= left:
            left -= len(data)
            yield view.id, data


def _spread(count: int) -> list[int]:
    """Return 0 … count − 1 so that any number of them from the front is spread evenly; the last and the first lead."""
    places = dict.fromkeys([count - 1, 0] if count else [])
    step = count
    while step > 1:
        step = (step + 1) // 2
        places |= dict.fromkeys(range(0, count, step))
    return list(places)


def _plain(head: Head) -> str:
    return "\n".join(
        (
            head.sentence,
            f"frames {head.done} of {head.total}, lights {head.lights_done} of {head.lights_total}",
            f"refused {head.refused}, failed {head.failed}, voided {head.voided}",
            f"a frame took {duration_text(head.seconds_per_frame)}",
            "Pictures and plots are shown by a script, which this viewer does not run; open the file in a browser.",
        )
    )


def _filled(*, title: str, plain: str, policy: str, data: str) -> str:
    values = {
        "title": html.escape(title),
        "plain": html.escape(plain),
        "policy": policy,
        "data": data,
        "style": _part("page.css"),
        "script": _script(),
    }
    # In one pass: what is put in is not looked through for further places.
    return _PLACE.sub(lambda found: values[found[1]], _part("page.html"))


@cache
def _part(name: str) -> str:
    return (resources.files("acquisition.monitor") / "web" / name).read_text(encoding="utf-8")


def _script() -> str:
    return "".join(map(_part, SCRIPTS))


def _policy(more: str) -> str:
    style, script = _hash(_part("page.css")), _hash(_script())
    return f"default-src 'none'; script-src {script}; style-src {style}; base-uri 'none'; form-action 'none'; {more}"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
