"""View of a session, read from its journal: attempts, state of the run, and data for the live page.

Nothing is written. `Head` contains the state of the run, its expected end, and the next action of the user.

A `SessionWatch` reads a session repeatedly for any number of pages. It opens the journal only after a change and for a
short time, so the session can be started, ended, deleted, replaced or restored at any time. Rows that cannot change any
more are read once. Each change has a number. A page sends the highest number that it has received, and gets the later
changes as JSON.

The script `web/page.js` reads the JSON. Times are milliseconds since 1970 UTC, and numbers have six digits. The page
inserts all data as text, never as markup.
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

from experiment.lights import Illuminant, load_illuminants
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

RUN_STARTS = "start"  # Name of the event at the start of the first frame of a run.

# A frame is late after this number of usual frame durations. A repeated download needs two.
LATE_FRAMES = 3

AT_WORK = ("running", "waiting", "paused", "late")  # States of an active run.

# Causes of a delay, a pause or missing frames, as named in the sentences of a run.
CAUSES = ("the camera", "the screen", "the projector", "the disk", "the frames")

# Free space below which a disk counts as full before the first frame. A row of the journal has 100 kB.
LEAST_FREE_BYTES = 1 << 20

LOOK = "check the camera, its cable and the computer"  # Remedy if a run reports nothing.

# Longest time, s, between the newest attempt and the last sign of life at which the expected end is shown as a time of
# day. In a simulated lab, time passes at another rate.
LAB_CLOCK_S = 600.0


@dataclass(frozen=True)
class AttemptView(Attempt):
    """An attempt to take a frame, with its details (`AttemptDetails`).

    `seconds`: time from the start of the previous attempt to the start of this attempt; None for the first of a run.
    """

    seen: tuple[float, float, float] | None = None
    checks: tuple[Check, ...] = ()
    timings: Mapping[str, float] = field(default_factory=dict[str, float])
    seconds: float | None = None


@dataclass(frozen=True)
class Head:
    """State of a session. A run regularly writes a sign of life (`Heartbeat`) into the journal.

    - `state`: one of
        - ``running``, ``waiting``, ``paused``: as reported by the run;
        - ``late``: a frame takes much longer than the previous frames;
        - ``silent``: the process of the run exists, but its sign of life is overdue;
        - ``complete``: all frames are accepted;
        - ``incomplete``: the run has ended, and frames are missing;
        - ``stopped``: the run was killed, or the power failed;
        - ``copy``: the signs of life belong to another folder;
        - ``unknown``: the journal has no sign of life;
        - ``absent``, ``gone``, ``unreadable``: there is no journal yet, or no longer, or it cannot be read.
    - `sentence`: the state in words, with the remedy after a semicolon; may be "".
    - `alive`: whether a run is active.
    - `beat`, `until`: times of the last sign of life, and of the next one, by the clock of the computer; may be None.
    - `total`, `done`: planned and accepted frames.
    - `lights_total`, `lights_done`: planned and accepted frames of illuminants.
    - `refused`, `failed`, `voided`: number of such attempts.
    - `seconds_per_frame`: median interval of the newest `RECENT` attempts; None before the second attempt.
    - `remaining_s`: remaining time by the clock of the lab, with retakes and references; None if unknown.
    - `eta`: time at which all frames will be complete, by the clock of the computer; None if unknown.
    - `cause`: one of `CAUSES` if the run is late or paused, or ended with missing frames; "" if unknown.
    - `last`: time of the newest frame by the clock of the lab.
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
        """Return the fields for programs, times as ISO 8601 text."""
        return {name: at.isoformat() if isinstance(at, datetime) else at for name, at in vars(self).items()}


@dataclass(frozen=True)
class SessionView:
    """A session as read from the disk; attempts and events, oldest first.

    - `name`, `path_text`: name of the folder, and its path as the user gave it.
    - `lights`: illuminants of the plan; empty if their file cannot be read.
    - `records`: devices, software and plan, as recorded in the journal.
    - `heartbeat`, `place`: newest sign of life, and the location of the folder; None if unknown.
    - `frame_bytes`: size of the largest frame; 0 without frames.
    - `lost`: deleted or truncated files of accepted frames by step; determined only if all frames are accepted.
    - `unreadable`: reason why no LUT can be built, and the remedy; determined only if all frames are accepted.
    """

    name: str
    path_text: str
    steps: tuple[SessionStep, ...]
    lights: tuple[Illuminant, ...]
    records: Mapping[str, str]
    attempts: tuple[AttemptView, ...]
    events: tuple[SessionEvent, ...]
    heartbeat: Heartbeat | None
    place: SessionPlace | None
    frame_bytes: int = 0
    lost: Mapping[int, str] = field(default_factory=dict[int, str])
    unreadable: str = ""

    def head(self, now: datetime) -> Head:
        """Return the state at the time `now` of the computer. The process of the run and the disk are also queried."""
        process = self.heartbeat.process if self.heartbeat else None
        return head_of(
            self,
            now,
            process.is_alive() if process else None,
            is_stopped=bool(process and process.is_stopped()),
            free_bytes=_free_bytes_of(Path(self.path_text)),
        )

    def whites(self) -> dict[int, tuple[float, float, float] | None]:
        """Return for each attempt the RGB of the newest accepted white frame up to this attempt.

        Attempts before the first white frame have the RGB of the first white frame.
        """
        white_steps = {step.number for step in self.steps if step.kind == "white"}
        whites = {
            view.id: view.seen
            for view in self.attempts
            if view.step in white_steps and view.verdict == ACCEPTED and view.seen and min(view.seen) > 0
        }
        newest = next(iter(whites.values()), None)
        white_of_attempt: dict[int, tuple[float, float, float] | None] = {}
        for view in self.attempts:
            newest = whites.get(view.id, newest)
            white_of_attempt[view.id] = newest
        return white_of_attempt


def read_session(folder: Path, earlier: SessionView | None = None) -> SessionView:
    """Read a session from the disk; `earlier`: a previous view, of which only changes are read again."""
    path = folder / JOURNAL_FILE
    opened = Journal.open(path) if earlier else open_journal(folder)
    with closing(opened) as journal, journal.snapshot():
        steps, verdicts, events = journal.steps(), journal.verdicts(), journal.events()
        accepted = journal.accepted_files()
        views = {view.id: view for view in earlier.attempts} if earlier else {}
        changed = [
            number
            for number, started_at, verdict in verdicts
            if (old := views.get(number)) is None or (old.verdict, old.started_at) != (verdict, started_at)
        ]
        rows = journal.attempts(changed)
        details, nothing = journal.details(changed), AttemptDetails()
        views |= {row.id: AttemptView(**vars(row), **vars(details.get(row.id, nothing))) for row in rows}
        records, heartbeat = journal.records(), journal.heartbeat()
    starts = [event.at for event in events if event.what == RUN_STARTS]
    is_complete = {step.number for step in steps} <= {frame.step for frame in accepted}
    return SessionView(
        folder.resolve().name,
        str(folder),
        steps,
        earlier.lights if earlier and earlier.steps == steps else _lights_of(folder),
        records,
        with_seconds([views[number] for number, *_ in verdicts], starts),
        tuple(events),
        heartbeat,
        SessionPlace.of(path),
        max((frame.size for frame in accepted), default=0),
        {frame.step: frame.file for frame in lost_files(folder, accepted)} if is_complete else {},
        _missing_files_text(folder) if is_complete else "",
    )


def _missing_files_text(folder: Path) -> str:
    missing = [str(folder / name) for name in ("chart.json", "illuminations.csv") if not (folder / name).exists()]
    return f"{' and '.join(missing)}: missing; restore it from a copy of the session" if missing else ""


def _lights_of(folder: Path) -> tuple[Illuminant, ...]:
    # The session can be shown without this file, because the plan contains the codes.
    try:
        return load_illuminants(folder / "illuminations.csv")
    except (CropError, OSError):
        return ()


def with_seconds(views: Sequence[AttemptView], starts: Iterable[datetime]) -> tuple[AttemptView, ...]:
    """Set `seconds` of attempts, oldest first; `starts`: times at which runs started."""
    start_times = sorted(starts)
    timed: list[AttemptView] = []
    for previous, view in zip([None, *views], views, strict=False):
        is_first = previous is None or any(previous.started_at < start <= view.started_at for start in start_times)
        seconds = None if previous is None or is_first else (view.started_at - previous.started_at).total_seconds()
        # A negative interval means that the clock was set back.
        seconds = None if seconds is not None and seconds < 0 else seconds
        timed.append(view if seconds == view.seconds else replace(view, seconds=seconds))
    return tuple(timed)


def _free_bytes_of(folder: Path) -> int | None:
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
    """Return the state of a session.

    `process_alive`: whether the process of the newest sign of life exists; None if unknown. `is_stopped`: whether this
    process was stopped by a signal. `free_bytes`: free space on the disk of the session; None if unknown.
    """
    steps, attempts, heartbeat = view.steps, view.attempts, view.heartbeat
    numbers = {step.number for step in steps} - {*view.lost}
    complete = {attempt.step for attempt in attempts if attempt.verdict == ACCEPTED} & numbers
    verdicts = [attempt.verdict for attempt in attempts]
    missing = len(steps) - len(complete)
    intervals = [attempt.seconds for attempt in attempts[-RECENT:] if attempt.seconds is not None]
    frame_s = statistics.median(intervals) if intervals else None
    state, sentence = _state_of(view, now, process_alive, missing, frame_s)
    if state in AT_WORK and heartbeat is not None:
        if is_stopped:
            pid = heartbeat.process.pid
            state, sentence = "silent", f"its process {pid} was stopped by a signal; resume it with kill -CONT {pid}"
        elif _is_full(view, free_bytes) and (state, _cause(sentence)) != ("paused", "the disk"):
            state, sentence = "late", "the disk is full; free space, then the run resumes automatically"
    judged = [attempt for attempt in attempts if attempt.verdict is not None]
    remaining = time_left((TimedAttempt(view.seconds, view.verdict in (ACCEPTED, VOIDED)) for view in judged), missing)
    is_lab_time_real = (
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
        done=len(complete),
        lights_total=sum(step.kind == "light" for step in steps),
        lights_done=sum(step.kind == "light" and step.number in complete for step in steps),
        refused=verdicts.count(REFUSED),
        failed=verdicts.count(FAILED),
        voided=verdicts.count(VOIDED),
        seconds_per_frame=frame_s,
        remaining_s=remaining,
        eta=now + timedelta(seconds=remaining) if is_lab_time_real and remaining is not None else None,
        cause=_cause(sentence) if state in ("late", "paused", "incomplete") else "",
        last=next((attempt.taken_at for attempt in reversed(attempts) if attempt.taken_at is not None), None),
    )


def _is_full(view: SessionView, free_bytes: int | None) -> bool:
    return free_bytes is not None and free_bytes < max(view.frame_bytes, LEAST_FREE_BYTES)


def _cause(sentence: str) -> str:
    positions = {sentence.find(cause): cause for cause in CAUSES if cause in sentence}
    return positions[min(positions)] if positions else ""


def _state_of(
    view: SessionView, now: datetime, process_alive: bool | None, missing: int, frame_s: float | None
) -> tuple[str, str]:
    heartbeat, location, total = view.heartbeat, view.place, len(view.steps)
    is_copy = heartbeat is not None and heartbeat.state != "ended" and heartbeat.belongs_to(location) is False
    is_over = heartbeat is None or heartbeat.state == "ended" or is_copy or heartbeat.is_dead(now, process_alive)
    if is_over and view.unreadable:
        return "incomplete", view.unreadable
    if is_over and total and not missing:
        return "complete", f"complete, {total} frames; next: build-lut {shlex.quote(view.path_text)} LUT/"
    if is_over and view.lost:
        files = first_few(list(view.lost.values()), 3)
        return "incomplete", f"{files}: deleted or truncated; restore them from a copy, or {AGAIN} to repeat the frames"
    if heartbeat is None:
        return (
            "unknown",
            f"{missing} of {total} frames are missing, and the journal has no sign of life of a run; {AGAIN}",
        )
    if is_copy and location is not None:
        return "copy", heartbeat.sentence_of_copy(location, process_alive)
    if heartbeat.is_dead(now, process_alive):
        return "stopped", heartbeat.sentence_for(now, process_alive)
    if heartbeat.state == "ended":
        return "incomplete", heartbeat.sentence or f"ended, {missing} of {total} frames are missing; {AGAIN}"
    since = f"{heartbeat.at.astimezone():%Y-%m-%d %H:%M:%S}"
    if now > heartbeat.until + timedelta(seconds=LATE_S):
        report = f"last report: {heartbeat.sentence}"
        return "silent", f"no sign of life since {since}, but its process exists: it hangs ({report}); {LOOK}"
    if heartbeat.state == "running" and frame_s is not None:
        due_s = BEAT_S + LATE_FRAMES * frame_s + LATE_S
        if (now - heartbeat.at).total_seconds() > due_s:
            return "late", f"late since {since}: no frame was taken, expected after {frame_s:.1f} s; {LOOK}"
    return heartbeat.state, heartbeat.sentence


Json = dict[str, Any]  # A JSON object


# A journal is read again if its last change is more recent than this, s. A further change may have the same time stamp,
# and would not be detected.
FRESH_S = 0.25

# Interval, s, after which an unchanged session is read again, because files of frames may have been deleted.
LOOK_AGAIN_S = 10.0

# Number of newest attempts that are sent again with each change, because previews are written later than rows.
_SENT_AGAIN = 3


MOST_PICTURE_BYTES = 4 << 20  # Size limit of a preview. Previews of 640 px are much smaller.

_JPEG = b"\xff\xd8\xff"

_REVISION = re.compile("[0-9]{1,9}")

# Inode, time of change (ns) and size of the journal and of its write-ahead file. Empty without a journal.
_Signature = tuple[tuple[int, int, int], ...]


@dataclass(frozen=True)
class _Numbered:
    """A view of a session with numbered changes."""

    epoch: str  # Random; another one after the session was replaced
    inode: int  # Inode of the journal
    revision: int  # Number of the last change
    view: SessionView
    whites: Mapping[int, tuple[float, float, float] | None]  # RGB of the white frame of each attempt
    attempts: Mapping[int, int]  # Number of the last change of each attempt
    events: Mapping[int, int]  # Number of the change that added each event


class SessionWatch:
    """A session that is read repeatedly; may be used by several threads.

    `clock`: returns seconds.
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
        """Return the current view of the session; None if it cannot be read."""
        with self._lock:
            self._refresh()
            return self._known.view if self._known else None

    def head(self) -> Head:
        """Return the current state."""
        with self._lock:
            self._refresh()
            return self._head()

    def picture(self, attempt: int) -> bytes:
        """Return the preview of an attempt as JPEG, or b""."""
        view = self.view()
        match = next((row for row in view.attempts if row.id == attempt and row.has_frame), None) if view else None
        return _read_picture(self.folder, match.file) if match else b""

    def state(self, since: str = "") -> Json | None:
        """Return the changes since a page's cursor; None if there are none.

        `since`: the `cursor` of the previous answer; everything is returned if it is unknown or empty.
        """
        with self._lock:
            self._refresh()
            numbered = self._known
            head = _head_json(self._head())
            epoch, revision = (numbered.epoch, numbered.revision) if numbered else ("", 0)
            cursor = f"{epoch}.{revision}.{digest(head)}"
            if since == cursor:
                return None
            state: Json = {"cursor": cursor, "head": head}
            if numbered is not None:
                state |= self._changes(numbered, since)
            return state

    def _head(self) -> Head:
        if self._trouble is not None or self._known is None:
            return self._trouble or Head("absent", f"there is no session {self.folder} yet; this page waits for it")
        return self._known.view.head(datetime.now(UTC))

    def _changes(self, numbered: _Numbered, since: str) -> Json:
        view = numbered.view
        epoch, revision, *_ = (*since.split("."), "", "")
        is_complete = epoch != numbered.epoch or not _REVISION.fullmatch(revision)
        received = -1 if is_complete else int(revision)
        recent = {attempt.id for attempt in view.attempts[-_SENT_AGAIN:]}
        rows = [row for row in view.attempts if numbered.attempts[row.id] > received or row.id in recent]
        changes: Json = {
            "frames": [
                _attempt_json(row, numbered.whites[row.id], _preview_version(self.folder, row.file)) for row in rows
            ],
            "events": [_event_json(event) for event in view.events if numbered.events[event.number] > received],
        }
        if is_complete:
            changes["session"] = _session_json(view)
        return {key: value for key, value in changes.items() if value}

    def _refresh(self) -> None:
        signature = _signature(self.folder / JOURNAL_FILE)
        now_s = self._clock()
        if signature == self._signature and not self._unsettled and now_s < self._read_at + LOOK_AGAIN_S:
            return
        self._read_at = now_s
        newest = max((changed for _, changed, _ in signature), default=0)
        self._unsettled = bool(signature) and time.time_ns() - newest < FRESH_S * 1e9
        self._signature = signature
        if not signature:
            if ledger_path(self.folder).exists():
                self._trouble = Head("gone", no_journal_text(self.folder))
                self._known = None
            elif self._known is not None:
                self._trouble = Head("gone", f"the session {self.folder} is missing; this page waits until it is back")
                self._known = None
            return
        inode = signature[0][0]
        numbered = self._known if self._known is not None and self._known.inode == inode else None
        try:
            view = read_session(self.folder, numbered.view if numbered else None)
        except CropError as error:
            self._trouble = Head("unreadable", str(error))
            self._unsettled = True
            return
        self._trouble = None
        self._known = _numbered(inode, view, numbered)


def _numbered(inode: int, view: SessionView, earlier: _Numbered | None) -> _Numbered:
    """Return a view with numbered changes; after a session was replaced, all its content is new."""
    whites = view.whites()
    has_lost = earlier is not None and not earlier.attempts.keys() <= whites.keys()
    if earlier is None or has_lost or (view.steps, view.records) != (earlier.view.steps, earlier.view.records):
        attempts, events = dict.fromkeys(whites, 0), dict.fromkeys((event.number for event in view.events), 0)
        return _Numbered(secrets.token_hex(4), inode, 0, view, whites, attempts, events)
    old = {attempt.id: attempt for attempt in earlier.view.attempts}
    # Attempts that were not read again are identical objects. Identity is compared first, because equality is slow.
    differing = {new.id for new in view.attempts if old.get(new.id) is not new and old.get(new.id) != new}
    changed = [number for number, white in whites.items() if number in differing or earlier.whites[number] != white]
    new_events = [event.number for event in view.events if event.number not in earlier.events]
    revision = earlier.revision + bool(changed or new_events)
    attempts = {**earlier.attempts, **dict.fromkeys(changed, revision)}
    events = {**earlier.events, **dict.fromkeys(new_events, revision)}
    return _Numbered(earlier.epoch, inode, revision, view, whites, attempts, events)


def _signature(path: Path) -> _Signature:
    # The journal or its write-ahead file changes with every row.
    signature: list[tuple[int, int, int]] = []
    for suffix in ("", "-wal"):
        try:
            status = path.with_name(path.name + suffix).stat()
        except OSError:
            if not suffix:
                return ()
            continue
        signature.append((status.st_ino, status.st_mtime_ns, status.st_size))
    return tuple(signature)


def _session_json(view: SessionView) -> Json:
    """Return the content of a session that does not change: name, plan, illuminants and devices.

    A step is [number, kind, illuminant, red, green, blue], an illuminant [index, kind, K, [r, b], red, green, blue].
    The chromaticity [r, b] is defined in `experiment.lights`; None for black.
    """
    kinds = {light.index: (light.kind, light.cct_k) for light in view.lights}
    colours = {step.illumination: step.colour for step in view.steps if step.illumination is not None}
    codes = dict(sorted(colours.items()))
    chromaticities = planned_chromaticities(list(codes.values()))
    return {
        "name": view.name,
        "steps": [[step.number, step.kind, step.illumination, *step.colour] for step in view.steps],
        "lights": [
            [index, *kinds.get(index, ("", None)), chromaticity, *codes[index]]
            for index, chromaticity in zip(codes, chromaticities, strict=True)
        ],
        "records": [[key, text] for key, text in view.records.items()],
    }


def planned_chromaticities(codes: Sequence[tuple[int, int, int]]) -> list[list[float] | None]:
    """Return the chromaticities [r, b] (0 … 1) of the linear light of codes; None for black."""
    linear = decode_srgb(np.array(codes, dtype=np.float64).reshape(-1, 3) / 255)
    return [rb_of(red, green, blue) for red, green, blue in linear.tolist()]


def rb_of(red: float, green: float, blue: float) -> list[float] | None:
    """Return the chromaticity [r, b] of linear values; None if their sum is not positive."""
    total = red + green + blue
    if not math.isfinite(total) or total <= 0:
        return None
    return [float(f"{red / total:.6g}"), float(f"{blue / total:.6g}")]


def _attempt_json(view: AttemptView, white: tuple[float, float, float] | None, preview: int | None) -> Json:
    seen = view.seen
    chromaticity = rb_of(*(rgb / w for rgb, w in zip(seen, white, strict=True))) if seen and white else None
    values: Json = {
        "id": view.id,
        "step": view.step,
        "at": _milliseconds(view.started_at),
        "taken": _milliseconds(view.taken_at),
        "verdict": view.verdict,
        "reason": view.reason,
        "seen": [_rounded(value) for value in seen] if seen else None,
        "seen_at": chromaticity,
        "checks": [_check(check) for check in view.checks],
        "timings": {name: _rounded(seconds) for name, seconds in view.timings.items()},
        "seconds": None if view.seconds is None else _rounded(view.seconds),
        "preview": preview if view.has_frame else None,
    }
    return {key: value for key, value in values.items() if value not in (None, "", {}, [])}


def _check(check: Check) -> list[Any]:
    # [name, unit, value, low, high], and the reason if there is one.
    numbers = [None if number is None else _rounded(number) for number in (check.value, check.low, check.high)]
    return [check.name, check.unit, *numbers, *([check.reason] if check.reason else [])]


def _event_json(event: SessionEvent) -> list[Any]:
    return [_milliseconds(event.at), event.what, event.detail]


def _head_json(head: Head) -> Json:
    return {
        name: _milliseconds(value) if isinstance(value, datetime) else value for name, value in asdict(head).items()
    }


def _rounded(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _milliseconds(moment: datetime | None) -> int | None:
    return None if moment is None else round(moment.timestamp() * 1000)


def to_bytes(values: Json) -> bytes:
    """Return JSON as bytes, with characters escaped that could end a script element."""
    text = json.dumps(values, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029").encode()


def digest(values: Json) -> str:
    """Return a short hash of the content."""
    return hashlib.blake2b(to_bytes(values), digest_size=6).hexdigest()


def _preview_version(folder: Path, file: str) -> int | None:
    try:
        return preview_path(folder, file).stat().st_mtime_ns // 1_000_000
    except OSError:
        return None


def _read_picture(folder: Path, file: str) -> bytes:
    """Return the preview of a raw file; empty if it is missing, no regular file, no JPEG, or too large."""
    path = preview_path(folder, file)
    with suppress(OSError):
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_PICTURE_BYTES:
            return b""
        data = path.read_bytes()
        return data if data.startswith(_JPEG) else b""
    return b""


REPORT_FILE = "report.html"  # Name of the report in the folder of a session.

# Total size of the pictures in a report. Base64 adds a third, and most mail servers accept 10 MB.
MOST_PICTURES_BYTES = 6 << 20

# Files that form the script of the page, in this order; the last one starts the page.
SCRIPTS = ("plots.js", "head.js", "series.js", "page.js")

_FIELD = re.compile(r"\{(title|plain|policy|data|style|script)\}")


def live_page(name: str) -> tuple[str, str]:
    """Return the live page, and the content security policy for its header.

    `name` is shown until the server has answered.
    """
    plain = "This page needs JavaScript, which the browser does not run. Use acquire status instead."
    policy = _policy("connect-src 'self'; img-src 'self' data:; frame-ancestors 'none'")
    return _filled(title=name, plain=plain, policy="", data=""), policy


def write_session_report(folder: Path, path: Path | None = None) -> Path:
    """Write the report of the session in `folder`, by default into it, and return its path.

    A run calls this function at its end, so a run of this process counts as ended.
    """
    path = folder / REPORT_FILE if path is None else path
    read_session(folder)
    watch = SessionWatch(folder)
    state, view = watch.state(), watch.view()
    if state is None or view is None:
        raise FormatError(
            "the session was deleted while its report was written", about=folder, remedy="give another session"
        )
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
    """Yield attempts and pictures up to the size limit: refused attempts, the last accepted one, then a selection."""
    free_bytes = MOST_PICTURES_BYTES
    refused = [view for view in attempts if view.has_frame and view.verdict not in (None, ACCEPTED)]
    accepted = [view for view in attempts if view.verdict == ACCEPTED]
    for view in [*refused, *(accepted[index] for index in _spread(len(accepted)))]:
        data = _read_picture(folder, view.file)
        if data and len(data) <= free_bytes:
            free_bytes -= len(data)
            yield view.id, data


def _spread(count: int) -> list[int]:
    """Return the indices 0 … count − 1, ordered so that the first ones are evenly spread, however many are used."""
    indices = dict.fromkeys([count - 1, 0] if count else [])
    step = count
    while step > 1:
        step = (step + 1) // 2
        indices |= dict.fromkeys(range(0, count, step))
    return list(indices)


def _plain(head: Head) -> str:
    return "\n".join(
        (
            head.sentence,
            f"frames {head.done} of {head.total}, illuminants {head.lights_done} of {head.lights_total}",
            f"refused {head.refused}, failed {head.failed}, voided {head.voided}",
            f"time per frame {duration_text(head.seconds_per_frame)}",
            "Pictures and plots need JavaScript, which this viewer does not run; open the file in a browser.",
        )
    )


def _filled(*, title: str, plain: str, policy: str, data: str) -> str:
    values = {
        "title": html.escape(title),
        "plain": html.escape(plain),
        "policy": policy,
        "data": data,
        "style": _web_text("page.css"),
        "script": _script(),
    }
    # All fields are replaced in one pass, so that braces in inserted text are not replaced.
    return _FIELD.sub(lambda match: values[match[1]], _web_text("page.html"))


@cache
def _web_text(name: str) -> str:
    return (resources.files("acquisition.monitor") / "web" / name).read_text(encoding="utf-8")


def _script() -> str:
    return "".join(map(_web_text, SCRIPTS))


def _policy(sources: str) -> str:
    style, script = _hash(_web_text("page.css")), _hash(_script())
    return f"default-src 'none'; script-src {script}; style-src {style}; base-uri 'none'; form-action 'none'; {sources}"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
