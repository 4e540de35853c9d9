"""A session that grows, and what of it a page has not seen yet.

One `SessionWatch` serves any number of pages. It opens the journal only when the file has changed, for as long as a few
queries take, so that a session can be begun, ended, deleted, replaced or restored meanwhile. Each change gets a number;
a page names the newest that it has and gets what came since.
"""

from __future__ import annotations

import re
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from acquisition.monitor.encoding import Json, attempt_json, digest, event_json, head_json, session_json
from acquisition.monitor.head import Head
from acquisition.monitor.pictures import preview_version
from acquisition.monitor.reading import SessionView, read_session
from experiment.session.journal import JOURNAL_FILE
from experiment.session.records import preview_path
from foundation.errors import CropError

FRESH_S = 0.25
"""A file that changed so short a time before it was looked at may change again within the resolution of its time stamp
(10 ms at the slowest tick of Linux, more over a network), and is read once more."""

RECENT = 3
"""Newest attempts that are told again whenever anything is: a preview is written after its row, and a pipeline has two
frames in hand beside the one that it shows."""

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
    """A session that is looked at again and again; may be used from several threads."""

    def __init__(self, folder: Path, wall: Callable[[], datetime] = lambda: datetime.now(UTC)) -> None:
        self.folder = folder
        self._wall = wall
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

    def picture(self, attempt: int) -> Path | None:
        """Return where the preview of an attempt's frame is, if there is one; None if there is no such attempt."""
        view = self.view()
        found = next((one for one in view.attempts if one.id == attempt and one.has_frame), None) if view else None
        return preview_path(self.folder, found.file) if found else None

    def state(self, since: str = "") -> Json | None:
        """Return what has changed since a page's cursor; None if nothing has.

        `since`: the `cursor` of the answer before; one that is not known here, or empty, gives everything.
        """
        with self._lock:
            self._refresh()
            known = self._known
            told = head_json(self._head())
            epoch, revision = (known.epoch, known.revision) if known else ("", 0)
            cursor = f"{epoch}.{revision}.{digest(told)}"
            if since == cursor:
                return None
            state: Json = {"cursor": cursor, "head": told}
            if known is not None:
                state |= self._news(known, since)
            return state

    def _head(self) -> Head:
        if self._trouble is not None or self._known is None:
            return self._trouble or Head("absent", f"there is no session {self.folder} yet: this page waits for it")
        return self._known.view.head(self._wall())

    def _news(self, known: _Numbered, since: str) -> Json:
        """Return what a page with this cursor does not have."""
        view = known.view
        epoch, revision, *_ = (*since.split("."), "", "")
        whole = epoch != known.epoch or not _REVISION.fullmatch(revision)
        seen = -1 if whole else int(revision)
        recent = {one.id for one in view.attempts[-RECENT:]}
        news = [one for one in view.attempts if known.attempts[one.id] > seen or one.id in recent]
        told: Json = {
            "frames": [attempt_json(one, known.whites[one.id], preview_version(self.folder, one.file)) for one in news],
            "events": [event_json(one) for one in view.events if known.events[one.id] > seen],
        }
        if whole:
            told["session"] = session_json(view.name, view.steps, view.lights, view.records)
        return {key: value for key, value in told.items() if value}

    def _refresh(self) -> None:
        """Read what has changed, and number the changes."""
        signature = _signature(self.folder / JOURNAL_FILE)
        if signature == self._signature and not self._unsettled:
            return
        newest = max((changed for _, changed, _ in signature), default=0)
        self._unsettled = bool(signature) and time.time_ns() - newest < FRESH_S * 1e9
        self._signature = signature
        if not signature:
            if self._known is not None:
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
        attempts, events = dict.fromkeys(whites, 0), dict.fromkeys((one.id for one in view.events), 0)
        return _Numbered(secrets.token_hex(4), inode, 0, view, whites, attempts, events)
    old = {one.id: one for one in before.view.attempts}
    # Identity first: what was not read again is the same object, and comparing its checks would take its time.
    differing = {one.id for one in view.attempts if old.get(one.id) is not one and old.get(one.id) != one}
    changed = [number for number, white in whites.items() if number in differing or before.whites[number] != white]
    new = [one.id for one in view.events if one.id not in before.events]
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
