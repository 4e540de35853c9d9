"""The live page's server: four addresses, answered from the journal.

It never writes, and holds nothing open between two requests; any number of pages may look, and it may be ended at any
time. Who may look, and how many: `foundation.page_server`.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs

from acquisition.monitor.feed import SessionWatch, live_page, to_bytes
from acquisition.monitor.view import read_session
from experiment.session.journal import JOURNAL_FILE
from foundation.errors import FormatError, InputError
from foundation.page_server import TEXT, PageHandler, PageServer, is_loopback

_FRAME = re.compile(r"frame/([1-9][0-9]{0,8})\.jpg")


def open_monitor(folder: Path, port: int, host: str = "127.0.0.1") -> MonitorServer:
    """Return a server for a session, not yet serving."""
    if (folder / JOURNAL_FILE).exists():
        read_session(folder)
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FormatError(
            f"{folder} is no session: it holds no {JOURNAL_FILE}; name a folder made by acquire run or import, or one "
            "that is not there yet"
        )
    try:
        return MonitorServer(SessionWatch(folder), host, port)
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        own = "" if is_loopback(host) else " or an address of this machine with --host"
        raise InputError(f"cannot serve on {host} port {port}: {reason}; name another with --port{own}") from error


class MonitorServer(PageServer):
    """Serves one session; not yet serving when it is made."""

    def __init__(self, watch: SessionWatch, host: str, port: int, **limits: Any) -> None:
        self.watch = watch
        self.page = live_page(watch.folder.resolve().name)
        super().__init__(host, port, _Handler, **limits)


class _Handler(PageHandler):
    server: MonitorServer  # pyright: ignore[reportIncompatibleVariableOverride]  # the handler's own server, by construction

    def respond(self, path: str, query: str) -> None:
        """Answer one of the four addresses."""
        asked = request_of(path, query)
        if asked is None:
            self.answer(404, TEXT, b"here are /, /state.json, /status.json and /frame/ATTEMPT.jpg\n")
            return
        watch = self.server.watch
        match asked.what:
            case "page":
                text, policy = self.server.page
                self.answer(200, "text/html; charset=utf-8", text.encode(), {"Content-Security-Policy": policy})
            case "state":
                state = watch.state(asked.since)
                self.answer(204, "", b"") if state is None else self.answer(200, "application/json", to_bytes(state))
            case "status":
                self.answer(200, "application/json", json.dumps(watch.head().to_plain()).encode())
            case "frame":
                self._send_picture(asked.attempt)

    def _send_picture(self, attempt: int) -> None:
        data = self.server.watch.picture(attempt)
        if not data:
            self.answer(404, TEXT, b"there is no picture of that frame\n")
            return
        # The page names the version of a picture, so that one that is written anew has another address.
        self.answer(200, "image/jpeg", data, {"Cache-Control": "private, max-age=86400"})


@dataclass(frozen=True)
class Request:
    """What is asked for: the page, its state since a cursor, the picture of an attempt, or the old summary."""

    what: Literal["page", "state", "frame", "status"]
    since: str = ""
    attempt: int = 0


def request_of(path: str, query: str) -> Request | None:
    """Return what a path, without its first slash, asks for; None where there is nothing of that name."""
    if path == "":
        return Request("page")
    if path == "state.json":
        return Request("state", since=parse_qs(query).get("since", [""])[0])
    if path == "status.json":
        return Request("status")
    if found := _FRAME.fullmatch(path):
        return Request("frame", attempt=int(found[1]))
    return None
