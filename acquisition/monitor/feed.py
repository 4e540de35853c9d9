"""The monitor's page, and what it gets of a session that grows: JSON of what it lacks, previews of frames.

One `SessionWatch` serves any number of pages. It opens the journal only when the file has changed, for as long as a few
queries take, so that a session can be begun, ended, deleted, replaced or restored meanwhile. Each change gets a number;
a page names the newest that it has and gets what came since.

Times are milliseconds since 1970 UTC, numbers have six digits; the page's script (`web/page.js`) reads exactly this.
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
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.monitor.view import AttemptView, Head, SessionView, read_session
from experiment.session.heartbeat import Process
from experiment.session.journal import JOURNAL_FILE, without_journal
from experiment.session.ledger import ledger_path
from experiment.session.records import ACCEPTED, Check, SessionEvent, duration_text, preview_path
from foundation.colorimetry import decode_srgb
from foundation.errors import CropError, FormatError
from foundation.files import write_whole

Json = dict[str, Any]
"""A JSON object."""


FRESH_S = 0.25
"""A file that changed so short a time before it was looked at may change again within the resolution of its time stamp
(10 ms at the slowest tick of Linux, more over a network), and is read once more."""

LOOK_AGAIN_S = 10.0
"""After so long a session is read again though its journal is as before: files of its frames may be gone."""

RECENT = 3
"""Newest attempts that are told again whenever anything is: a preview is written after its row, and a pipeline has two
frames in hand beside the one that it shows."""


MOST_PICTURE_BYTES = 4 << 20
"""Bytes of a preview that is shown: many times what one of 640 pixels has."""

_JPEG = b"\xff\xd8\xff"

_REVISION = re.compile("[0-9]{1,9}")

_Signature = tuple[tuple[int, int, int], ...]
"""Inode, time of change in ns and size of the journal and of what is written beside it; empty without a journal."""


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
        return read_picture(self.folder, found.file) if found else b""

    def state(self, since: str = "") -> Json | None:
        """Return what has changed since a page's cursor; None if nothing has.

        `since`: the `cursor` of the answer before; one that is not known here, or empty, gives everything.
        """
        with self._lock:
            self._refresh()
            known = self._known
            head = head_json(self._head())
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
        recent = {one.id for one in view.attempts[-RECENT:]}
        news = [one for one in view.attempts if known.attempts[one.id] > seen or one.id in recent]
        changes: Json = {
            "frames": [attempt_json(one, known.whites[one.id], preview_version(self.folder, one.file)) for one in news],
            "events": [event_json(one) for one in view.events if known.events[one.number] > seen],
        }
        if whole:
            changes["session"] = session_json(view)
        return {key: value for key, value in changes.items() if value}

    def _refresh(self) -> None:
        """Read what has changed, and number the changes."""
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
                self._trouble = Head("gone", without_journal(self.folder))
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


def session_json(view: SessionView) -> Json:
    """Return what does not change while a session is taken: its name, plan, lights and devices.

    A step is [number, kind, light, red, green, blue], a light [index, kind, K, [r, b], red, green, blue]; its
    chromaticity is that of `experiment.lights`, None for one without any light.
    """
    kinds = {light.index: (light.kind, light.cct_k) for light in view.lights}
    shown = {step.illumination: step.colour for step in view.steps if step.illumination is not None}
    codes = {index: colour.codes for index, colour in sorted(shown.items())}
    places = planned_places(list(codes.values()))
    return {
        "name": view.name,
        "steps": [[step.number, step.kind, step.illumination, *step.colour.codes] for step in view.steps],
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


def attempt_json(view: AttemptView, white: tuple[float, float, float] | None, preview: int | None) -> Json:
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


def event_json(event: SessionEvent) -> list[Any]:
    """Return an event: [time, what, detail]."""
    return [_milliseconds(event.at), event.what, event.detail]


def head_json(head: Head) -> Json:
    """Return how a session stands."""
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


def preview_version(folder: Path, file: str) -> int | None:
    """Return a number that is another for another preview, or None if there is none."""
    try:
        return preview_path(folder, file).stat().st_mtime_ns // 1_000_000
    except OSError:
        return None


def read_picture(folder: Path, file: str) -> bytes:
    """Return the bytes of a raw file's preview; none if it is not there, is no regular file, no JPEG, or too large."""
    path = preview_path(folder, file)
    with suppress(OSError):
        if path.is_symlink() or not path.is_file() or path.stat().st_size > MOST_PICTURE_BYTES:
            return b""
        data = path.read_bytes()
        return data if data.startswith(_JPEG) else b""
    return b""


REPORT_FILE = "report.html"
"""Name of a session's report in its folder."""

MOST_PICTURES_BYTES = 6 << 20
"""Bytes of all pictures in a report: with the third that base64 adds it can still be mailed (10 MB at most servers)."""

SCRIPTS = ("plots.js", "head.js", "series.js", "page.js")
"""Files that make up the page's script, in the order in which they stand in it; the last one begins."""

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
    state["head"] = head_json(head)
    state["pictures"] = {str(number): _data_url(data) for number, data in _pictures(folder, view.attempts)}
    text = _filled(
        title=f"{view.name}, report of {now.astimezone():%Y-%m-%d %H:%M}",
        plain=_plain(head),
        policy=f'<meta http-equiv="Content-Security-Policy" content="{_policy("img-src data:")}">',
        data=f'<script type="application/json" id="embedded">{to_bytes(state).decode()}</script>',
    )
    write_whole(path, text)
    return path


def _ended(view: SessionView) -> SessionView:
    """Return a session whose run, if this process is at it, has ended."""
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
        data = read_picture(folder, view.file)
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


def _data_url(data: bytes) -> str:
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode()}"


def _plain(head: Head) -> str:
    """Return the most important of it in a few lines."""
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
