"""A page's own server on this machine: a few addresses, answered to anybody whom `Access` lets look.

A page on this machine's loopback needs no token: who is logged in here may read the files anyway. Names that another
site has made to point here are still refused there (DNS rebinding), and so is what another site's page sends: browsers
ask before a PUT, and say where the page is from. For other machines the address itself holds a token, as its first
part, so that the page's relative addresses carry it on; a QR code (ISO/IEC 18004) in the terminal gives it to a phone.

Everybody can connect, with or without a token, so connections cost little and give way: a request's head must be there
in `HEAD_S` from its first byte; and where there are as many connections as there may be, a new one takes the place of
one that asks for nothing, of the address that has the most.
"""

from __future__ import annotations

import gzip
import hmac
import io
import ipaddress
import secrets
import socket
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, ClassVar, Literal
from urllib.parse import parse_qs

from foundation.errors import InputError

# Random bytes of a token: 128 bits cannot be guessed, and still make a QR code that a terminal has room for.
TOKEN_BYTES = 16


QUIET_MODULES = 4  # Light modules around a code, as ISO/IEC 18004 asks for


MOST_CONNECTIONS = 64  # Connections at once; a page holds one or two

# A request whose head is not whole so long after its first byte, or after the connection was made, is none.
HEAD_S = 5.0

BODY_S = 30.0  # What is sent along must be there in this time behind the head

ANSWER_S = 2.0  # A viewer who has not taken an answer in this time may lose the place to another, in seconds

# A connection on which nothing is asked for so long is closed; a page that is hidden asks every ten seconds.
IDLE_S = 30.0

GZIP_FROM_BYTES = 2048  # A smaller answer is one packet or two either way

_TEXT = "text/plain; charset=utf-8"

# Kinds of answers that gzip does not make smaller: pictures, and numbers with noise.
_PICTURES = frozenset({"image/jpeg", "image/png", "application/octet-stream"})


@dataclass(frozen=True)
class Request:
    """What is asked for.

    - `path`: the address behind the server's own, without a slash before it; empty for the page.
    - `query`: the first value of each name behind the question mark.
    - `body`: what was sent along by a PUT; None where something is asked for.
    """

    path: str
    query: Mapping[str, str] = field(default_factory=dict[str, str])
    body: bytes | None = None


@dataclass(frozen=True)
class Refusal:
    """Why a request is not answered: HTTP status and sentence."""

    status: int
    sentence: str


@dataclass(frozen=True)
class Response:
    """What a request is answered: media type, bytes, further headers; without a type, that nothing is new."""

    kind: str
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict[str, str])


class Connections:
    """Who is connected, and who gives way where there is no room.

    `most`: connections at once, 1 or more. `now`: time, seconds.
    """

    def __init__(self, most: int, now: Callable[[], float] = time.monotonic) -> None:
        self._most = most
        self._now = now
        self._guard = threading.Lock()
        self._open: dict[int, _Connection] = {}

    def admit(self, link: socket.socket, address: str) -> bool:
        """Return whether there is room for a connection; another is closed for it if need be."""
        with self._guard:
            if len(self._open) >= self._most:
                gives_way = self._who_gives_way()
                if gives_way is None:
                    return False
                del self._open[id(gives_way.link)]
                _hang_up(gives_way.link)
            self._open[id(link)] = _Connection(link, address, "new", self._now())
            return True

    def mark(self, link: socket.socket, state: Literal["idle", "answered"]) -> None:
        """Note that a connection waits for its next request, or that one is being answered."""
        with self._guard:
            if known := self._open.get(id(link)):
                known.state, known.since = state, self._now()

    def forget(self, link: socket.socket) -> None:
        """Note that a connection has ended."""
        with self._guard:
            self._open.pop(id(link), None)

    def _who_gives_way(self) -> _Connection | None:
        """Return a connection that may be closed: first those that never asked, then idle ones, then the slow."""
        late = self._now() - ANSWER_S
        ranks = {"new": 0, "idle": 1, "answered": 2}
        could = [one for one in self._open.values() if one.state != "answered" or one.since < late]
        held = Counter(one.address for one in self._open.values())
        return min(could, key=lambda one: (-held[one.address], ranks[one.state], one.since), default=None)


@dataclass(eq=False)
class _Connection:
    """`state`: "new" before its first request; `since`: when it came to be in that state."""

    link: socket.socket
    address: str
    state: Literal["new", "idle", "answered"]
    since: float


def _hang_up(link: socket.socket) -> None:
    try:
        link.shutdown(socket.SHUT_RDWR)
    except OSError:
        # It has gone by itself.
        return


class _PatientLink(io.RawIOBase):
    """A connection as `http.server` takes it, read with patience: `idle_s` for a first byte, then `head_s`."""

    def __init__(self, link: socket.socket, head_s: float, idle_s: float) -> None:
        self.link = link
        self._head_s = head_s
        self._idle_s = idle_s
        self._until: float | None = time.monotonic() + head_s
        link.settimeout(idle_s)
        self.sendall = link.sendall
        self.fileno = link.fileno
        self.setsockopt = link.setsockopt

    def makefile(self, mode: str, size: int) -> io.BufferedReader:
        """Return what is read from."""
        del mode, size
        return io.BufferedReader(self)

    def expect(self, within_s: float | None = None) -> None:
        """Begin to wait for the next request; or for what must be there in so many seconds."""
        self._until = None if within_s is None else time.monotonic() + within_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        until = time.monotonic() + self._idle_s if self._until is None else self._until
        left = until - time.monotonic()
        if left <= 0:
            raise TimeoutError("the request's head is not whole in time")
        self.link.settimeout(left)
        try:
            count = self.link.recv_into(buffer)
        finally:
            self.link.settimeout(self._idle_s)
        if self._until is None:
            self._until = time.monotonic() + self._head_s
        return count


class LocalServer(ABC, ThreadingHTTPServer):
    """Serves one page; not yet serving when it is made. An InputError says why it cannot listen there."""

    command: ClassVar[str]  # The command that serves, as messages name it
    max_bytes: ClassVar[int] = 0  # Bytes of the largest body of a PUT that is taken; 0 takes none

    daemon_threads = True
    request_queue_size = MOST_CONNECTIONS

    def __init__(
        self,
        host: str,
        port: int,
        *,
        most: int = MOST_CONNECTIONS,
        head_s: float = HEAD_S,
        idle_s: float = IDLE_S,
    ) -> None:
        self.access = Access.to(host, self.command)
        self._host = host
        self.connections = Connections(most)
        self._head_s = head_s
        self._idle_s = idle_s
        if ":" in host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            own = "" if is_loopback(host) else " or an address of this machine with --host"
            raise InputError(f"cannot serve on {host} port {port}: {reason}; name another with --port{own}") from error

    @abstractmethod
    def answer(self, request: Request) -> Response | Refusal:
        """Return the answer to a request; called from any number of threads."""

    def serve(self, shows: str, warning: str) -> None:
        """Print the page's address and serve until interrupted.

        `shows`: what the page shows. `warning`: what everybody who has the address can do, where others reach it.
        """
        with suppress(KeyboardInterrupt):
            addresses = [f"http://{name}:{self.port}/{self.path}" for name in reachable_addresses(self._host)]
            print(f"{' and '.join(addresses)} shows {shows}; Ctrl-C ends it", flush=True)
            if not is_loopback(self._host):
                print(
                    f"warning: everybody who has this address and can reach this machine {warning}, and what is sent "
                    "is not encrypted; use it in your own network only",
                    file=sys.stderr,
                )
                if sys.stdout.isatty() and "utf" in sys.stdout.encoding.lower():
                    print(qr_text(addresses[0]), flush=True)
            self.serve_forever()

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self.server_address[1]

    @property
    def path(self) -> str:
        """What stands behind the first slash of the page's address: its token and a slash, or nothing."""
        return f"{self.access.token}/" if self.access.token else ""

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, unless there are too many that are being answered."""
        if self.connections.admit(request, str(client_address[0])):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one connection, and make room for the next."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.connections.forget(request)

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Answer what a connection asks, which has a deadline."""
        super().finish_request(_PatientLink(request, self._head_s, self._idle_s), client_address)  # pyrefly: ignore[bad-argument-type]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of viewers that went away: the terminal is the user's."""


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer  # pyrefly: ignore[bad-override-mutable-attribute]  # the handler's own server, by construction
    protocol_version = "HTTP/1.1"
    # Head and body are written one after the other: the second would wait for the first to be acknowledged, 40 ms.
    disable_nagle_algorithm = True

    def handle_one_request(self) -> None:
        super().handle_one_request()
        self.server.connections.mark(self.request.link, "idle")
        self.request.expect()

    def do_GET(self) -> None:  # the name is http.server's
        self.server.connections.mark(self.request.link, "answered")
        asked = self.server.access.judge(self.path, self.headers.get("Host"))
        self._send(asked if isinstance(asked, Refusal) else self.server.answer(asked))

    do_HEAD = do_GET  # noqa: N815

    def do_PUT(self) -> None:  # the name is http.server's
        if not self.server.max_bytes:
            self._refuse()
            return
        asked = self.server.access.judge(self.path, self.headers.get("Host"), self.headers.get("Origin"))
        if isinstance(asked, Refusal):
            self._send(asked, close=True)
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and 0 < int(length) <= self.server.max_bytes):
            most = self.server.max_bytes >> 20
            self._send(Refusal(413, f"expected up to {most} MiB, and their number in the head"), close=True)
            return
        self.request.expect(BODY_S)
        body = self.rfile.read(int(length))
        self.server.connections.mark(self.request.link, "answered")
        self._send(self.server.answer(replace(asked, body=body)))

    def _refuse(self) -> None:
        # A body that comes along is not read: what follows on this connection would be taken for a request.
        more = {"Allow": "GET, HEAD", "Connection": "close"}
        self._answer(405, _TEXT, b"this server only shows; ask with GET\n", more)

    do_POST = do_DELETE = do_PATCH = do_OPTIONS = _refuse  # noqa: N815

    def _send(self, answer: Response | Refusal, close: bool = False) -> None:
        if isinstance(answer, Refusal):
            more = {"Connection": "close"} if close else {}
            self._answer(answer.status, _TEXT, f"{answer.sentence}\n".encode(), more)
        else:
            self._answer(200 if answer.kind else 204, answer.kind, answer.body, answer.headers)

    def _answer(self, status: int, kind: str, body: bytes, more: Mapping[str, str]) -> None:
        headers = {"Content-Type": kind} if kind else {}
        headers |= {
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        if kind not in _PICTURES and len(body) >= GZIP_FROM_BYTES and "gzip" in self.headers.get("Accept-Encoding", ""):
            body = gzip.compress(body, 5, mtime=0)
            headers["Content-Encoding"] = "gzip"
        if status != 204:
            headers["Content-Length"] = str(len(body))
        self.send_response(status)
        for name, value in (headers | dict(more)).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def version_string(self) -> str:
        """Return what the Server header says: no versions for strangers."""
        return self.server.command

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: the terminal is the user's."""


@dataclass(frozen=True)
class Access:
    """The rule of one server: the token that addresses must begin with, empty on loopback, and the names it goes by.

    `command`: what printed the server's address, as messages name it.
    """

    token: str
    names: frozenset[str]
    command: str

    @classmethod
    def to(cls, host: str, command: str) -> Access:
        """Return the rule of a server that listens on `host`, with a new token unless that is loopback."""
        own = socket.gethostname().lower()
        names = frozenset({"localhost", host.lower(), own, f"{own}.local"})
        return cls("" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES), names, command)

    def judge(self, target: str, host: str | None, origin: str | None = None) -> Request | Refusal:
        """Return what a request asks for, or why it is refused.

        `host`: the Host header; None if there is none. `origin`: the Origin header, where something is sent.
        """
        if not self._knows(host):
            return Refusal(421, f"this server does not go by that name; open the address that {self.command} printed")
        if origin is not None and origin.lower() != f"http://{host}".lower():
            return Refusal(403, "only this server's own page may send something; use the page")
        path, _, query = target.removeprefix("/").partition("?")
        if self.token:
            token, slash, path = path.partition("/")
            if not slash or not hmac.compare_digest(token.encode(), self.token.encode()):
                return Refusal(403, f"the address lacks its token; open the one that {self.command} printed, whole")
        return Request(path, {name: values[0] for name, values in parse_qs(query).items()})

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
    import numpy as np

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
