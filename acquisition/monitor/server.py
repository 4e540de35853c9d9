"""The live page's server: four addresses, answered from the journal, to anybody whom `Access` lets look.

It never writes, and holds nothing open between two requests; any number of pages may look, and it may be ended at any
time.
"""

from __future__ import annotations

import gzip
import json
import socket
import threading
from datetime import datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from acquisition.monitor.access import Access, Refusal, Request, is_loopback
from acquisition.monitor.encoding import to_bytes
from acquisition.monitor.page import live_page
from acquisition.monitor.pictures import read_picture
from acquisition.monitor.reading import read_session
from acquisition.monitor.watching import SessionWatch
from experiment.session.journal import JOURNAL_FILE
from foundation.errors import FormatError, InputError

MOST_CONNECTIONS = 64
"""Connections at once; a page holds one or two, and what goes beyond is turned away rather than served by threads
without number."""

IDLE_S = 30.0
"""A connection on which nothing is asked for so long is closed; a page that is hidden asks every ten seconds."""

GZIP_FROM_BYTES = 2048
"""A smaller answer is one packet or two either way."""

_TEXT = "text/plain; charset=utf-8"


class MonitorServer(ThreadingHTTPServer):
    """Serves one session; not yet serving when it is made."""

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(self, watch: SessionWatch, host: str, port: int) -> None:
        self.watch = watch
        self.access = Access.to(host)
        self.page = live_page(watch.folder.resolve().name)
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host, port), _Handler)

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self.server_address[1]

    @property
    def path(self) -> str:
        """What stands behind the first slash of the page's address: its token and a slash, or nothing."""
        return f"{self.access.token}/" if self.access.token else ""

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, unless there are too many."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection, and make room for the next."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of viewers that went away: the terminal is the user's."""


class _Handler(BaseHTTPRequestHandler):
    server: MonitorServer  # pyright: ignore[reportIncompatibleVariableOverride]  # the handler's own server, by construction
    protocol_version = "HTTP/1.1"
    timeout = IDLE_S

    def do_GET(self) -> None:  # the name is http.server's
        asked = self.server.access.judge(self.path, self.headers.get("Host"))
        if isinstance(asked, Refusal):
            self._answer(asked.status, _TEXT, f"{asked.sentence}\n".encode())
            return
        match asked.what:
            case "page":
                page = self.server.page
                more = {"Content-Security-Policy": page.policy}
                self._answer(200, "text/html; charset=utf-8", page.text.encode(), more)
            case "state":
                state = self.server.watch.state(asked.since)
                if state is None:
                    self._answer(204, "", b"")
                else:
                    self._answer(200, "application/json", to_bytes(state))
            case "status":
                self._answer(200, "application/json", self._status())
            case "frame":
                self._send_picture(asked)

    do_HEAD = do_GET  # noqa: N815

    def _refuse(self) -> None:
        # A body that comes along is not read: what follows on this connection would be taken for a request.
        more = {"Allow": "GET, HEAD", "Connection": "close"}
        self._answer(405, _TEXT, b"this server only shows; ask with GET\n", more)

    do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = _refuse  # noqa: N815

    def _status(self) -> bytes:
        """Return how the session stands, for scripts: `Head` with times as ISO 8601 text."""
        head = self.server.watch.head()
        told = {name: value.isoformat() if isinstance(value, datetime) else value for name, value in vars(head).items()}
        return json.dumps(told).encode()

    def _send_picture(self, asked: Request) -> None:
        path = self.server.watch.picture(asked.attempt)
        data = b"" if path is None else read_picture(path)
        if not data:
            self._answer(404, _TEXT, b"there is no picture of that frame\n")
            return
        # The page names the version of a picture, so that one that is written anew has another address.
        self._answer(200, "image/jpeg", data, {"Cache-Control": "private, max-age=86400"})

    def _answer(self, status: int, kind: str, body: bytes, more: dict[str, str] | None = None) -> None:
        headers = {"Content-Type": kind} if kind else {}
        headers |= {
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        if kind != "image/jpeg" and len(body) >= GZIP_FROM_BYTES and "gzip" in self.headers.get("Accept-Encoding", ""):
            body = gzip.compress(body, 5, mtime=0)
            headers["Content-Encoding"] = "gzip"
        if status != 204:
            headers["Content-Length"] = str(len(body))
        self.send_response(status)
        for name, value in (headers | (more or {})).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def version_string(self) -> str:
        """Return what the Server header says: no versions for strangers."""
        return "acquire monitor"

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the terminal is the user's."""


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
