"""The live page's server: four addresses, answered from the journal, to anybody whom `Access` lets look.

It never writes, and holds nothing open between two requests; any number of pages may look, and it may be ended at any
time.

Who may look, and at what, is decided from a request's text alone. A page on this machine's loopback needs no token: who
is logged in here may read the folder anyway. Two things are still refused there: names that another site has made to
point here (DNS rebinding, by which a web page could read what answers on loopback), and everything that is not one of
the four addresses. For other machines the address itself holds a token, as its first part, so that the page's relative
addresses carry it on and nothing has to be typed; a QR code (ISO/IEC 18004) in the terminal gives it to a phone.
"""

from __future__ import annotations

import gzip
import hmac
import ipaddress
import json
import re
import secrets
import socket
import threading
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs

import numpy as np

from acquisition.monitor.feed import SessionWatch, live_page, to_bytes
from acquisition.monitor.view import read_session
from experiment.session.journal import JOURNAL_FILE
from foundation.errors import FormatError, InputError

TOKEN_BYTES = 16
"""Random bytes of a token: 128 bits cannot be guessed, and still make a QR code that a terminal has room for."""


QUIET_MODULES = 4
"""Light modules around a code, as ISO/IEC 18004 asks for."""


MOST_CONNECTIONS = 64
"""Connections at once; a page holds one or two, and what goes beyond is turned away rather than served by threads
without number."""

IDLE_S = 30.0
"""A connection on which nothing is asked for so long is closed; a page that is hidden asks every ten seconds."""

GZIP_FROM_BYTES = 2048
"""A smaller answer is one packet or two either way."""

_TEXT = "text/plain; charset=utf-8"

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
                text, policy = self.server.page
                self._answer(200, "text/html; charset=utf-8", text.encode(), {"Content-Security-Policy": policy})
            case "state":
                state = self.server.watch.state(asked.since)
                if state is None:
                    self._answer(204, "", b"")
                else:
                    self._answer(200, "application/json", to_bytes(state))
            case "status":
                self._answer(200, "application/json", json.dumps(self.server.watch.head().to_plain()).encode())
            case "frame":
                self._send_picture(asked)

    do_HEAD = do_GET  # noqa: N815

    def _refuse(self) -> None:
        # A body that comes along is not read: what follows on this connection would be taken for a request.
        more = {"Allow": "GET, HEAD", "Connection": "close"}
        self._answer(405, _TEXT, b"this server only shows; ask with GET\n", more)

    do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = _refuse  # noqa: N815

    def _send_picture(self, asked: Request) -> None:
        data = self.server.watch.picture(asked.attempt)
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


@dataclass(frozen=True)
class Request:
    """What is asked for: the page, its state since a cursor, the picture of an attempt, or the old summary."""

    what: Literal["page", "state", "frame", "status"]
    since: str = ""
    attempt: int = 0


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered: HTTP status and sentence."""

    status: int
    sentence: str


@dataclass(frozen=True)
class Access:
    """The rule of one server: the token that addresses must begin with, empty on loopback, and the names it goes by."""

    token: str
    names: frozenset[str]

    @classmethod
    def to(cls, host: str) -> Access:
        """Return the rule of a server that listens on `host`, with a new token unless that is loopback."""
        own = socket.gethostname().lower()
        names = frozenset({"localhost", host.lower(), own, f"{own}.local"})
        return cls("" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES), names)

    def judge(self, target: str, host: str | None) -> Request | Refusal:
        """Return what a request asks for, or why it is refused.

        `host`: the Host header; None if there is none.
        """
        if not self._knows(host):
            return Refusal(421, "this server does not go by that name; open the address that acquire monitor printed")
        path, _, query = target.removeprefix("/").partition("?")
        if self.token:
            token, slash, path = path.partition("/")
            if not slash or not hmac.compare_digest(token.encode(), self.token.encode()):
                return Refusal(403, "the address lacks its token; open the one that acquire monitor printed, whole")
        since = parse_qs(query).get("since", [""])[0]
        if path == "":
            return Request("page")
        if path == "state.json":
            return Request("state", since=since)
        if path == "status.json":
            return Request("status")
        if found := _FRAME.fullmatch(path):
            return Request("frame", attempt=int(found[1]))
        return Refusal(404, "here are /, /state.json, /status.json and /frame/ATTEMPT.jpg")

    def _knows(self, host: str | None) -> bool:
        """Return whether a Host header (RFC 9110, 7.2) names this server: an address by number cannot be rebound."""
        if not host:
            return False
        name = host.lower()
        name = name[1 : name.index("]")] if name.startswith("[") and "]" in name else name.partition(":")[0]
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name in self.names
        return True


def is_loopback(host: str) -> bool:
    """Return whether a host to listen on can be reached from this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def reachable_addresses(host: str) -> tuple[str, ...]:
    """Return the names and numbers, for a URL, under which others reach a server that listens on `host`.

    For a server on all interfaces: the address with which this machine would send into its network (nothing is sent),
    else its name.
    """
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        return (host,)
    if not number.is_unspecified:
        return (f"[{host}]" if number.version == 6 else host,)
    found: list[str] = []
    # TEST-NET-1 (RFC 5737) and its counterpart (RFC 3849): addresses of nobody, reached by the default route.
    for family, nobody in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        if family == socket.AF_INET6 and number.version == 4:
            continue
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.connect((nobody, 9))
                own = str(probe.getsockname()[0])
        except OSError:
            continue
        found.append(f"[{own}]" if ":" in own else own)
    return tuple(found) or (socket.gethostname(),)


def qr_text(text: str) -> str:
    """Return a QR code of `text` as lines of half blocks, dark on light on any terminal: two rows of modules a line."""
    import cv2

    code = np.asarray(cv2.QRCodeEncoder.create().encode(text)) < 128
    rows, columns = np.flatnonzero(code.any(axis=1)), np.flatnonzero(code.any(axis=0))
    code = np.pad(code[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], QUIET_MODULES)
    if len(code) % 2:
        code = np.pad(code, ((0, 1), (0, 0)))
    # Light modules are drawn, in white on black, whatever the terminal's own colours are.
    blocks = {(False, False): "█", (False, True): "▀", (True, False): "▄", (True, True): " "}
    lines = (
        "".join(blocks[bool(upper), bool(lower)] for upper, lower in zip(above, below, strict=True))
        for above, below in zip(code[::2], code[1::2], strict=True)
    )
    return "\n".join(f"\x1b[97;40m{line}\x1b[0m" for line in lines)
