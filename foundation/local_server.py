"""HTTP server of one page on this machine; `Access` decides which requests are answered.

The server refuses requests under foreign host names (DNS rebinding) and data from pages of other sites. On the loopback
address it needs no token, because users of this machine can read the files anyway. For other machines, the first part
of the path is a token. Relative addresses in the page keep the token. The terminal shows the address as a QR code for
phones.

Everybody can connect, even without the token, so the number and the duration of connections are limited. If too many
are open, a new connection replaces an inactive one.
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

# Number of random bytes in a token. 128 bits cannot be guessed, and their QR code fits on a terminal.
TOKEN_BYTES = 16


QUIET_MODULES = 4  # Width of the light border of a QR code, in modules (ISO/IEC 18004)


MAX_CONNECTIONS = 64  # Largest number of open connections; a page uses one or two

# Time limit for the head of a request, s, from its first byte or from the start of the connection.
HEAD_S = 5.0

BODY_S = 30.0  # Time limit for the body of a request, s, after its head

ANSWER_S = 2.0  # Time after which a new connection may replace a connection with an unfinished answer, s

# A connection without requests is closed after this time, s. A hidden page sends a request every 10 s.
IDLE_S = 30.0

GZIP_FROM_BYTES = 2048  # Smaller answers are not compressed, because they fit into two packets

_TEXT = "text/plain; charset=utf-8"

# Media types that gzip does not make smaller: compressed pictures and noisy numbers.
_INCOMPRESSIBLE = frozenset({"image/jpeg", "image/png", "application/octet-stream"})


@dataclass(frozen=True)
class Request:
    """An accepted request."""

    path: str  # Path without token and leading slash; empty for the page
    query: Mapping[str, str] = field(default_factory=dict[str, str])  # First value of each query parameter
    body: bytes | None = None  # Body of a PUT; None for a GET


@dataclass(frozen=True)
class Refusal:
    """HTTP status and message of a refused request."""

    status: int
    message: str


@dataclass(frozen=True)
class Response:
    """Media type, body and additional headers of an answer; an empty media type means "no change" (status 204)."""

    media_type: str
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict[str, str])


class Connections:
    """Open connections, at most `limit` (1 or more); `now` returns the time in seconds."""

    def __init__(self, limit: int, now: Callable[[], float] = time.monotonic) -> None:
        self._limit = limit
        self._now = now
        self._lock = threading.Lock()
        self._open: dict[int, _Connection] = {}

    def admit(self, link: socket.socket, address: str) -> bool:
        """Add a connection, if necessary by closing another one; return whether it was added."""
        with self._lock:
            if len(self._open) >= self._limit:
                replaceable = self._replaceable()
                if replaceable is None:
                    return False
                del self._open[id(replaceable.link)]
                _shut_down(replaceable.link)
            self._open[id(link)] = _Connection(link, address, "new", self._now())
            return True

    def mark(self, link: socket.socket, state: Literal["idle", "busy"]) -> None:
        """Record that a connection waits for its next request ("idle"), or that a request is being answered."""
        with self._lock:
            if connection := self._open.get(id(link)):
                connection.state, connection.since = state, self._now()

    def remove(self, link: socket.socket) -> None:
        """Remove a connection that has ended."""
        with self._lock:
            self._open.pop(id(link), None)

    def _replaceable(self) -> _Connection | None:
        # Replace a connection of the address with most connections: preferably a new connection, or an idle connection,
        # or else a connection that is busy for longer than `ANSWER_S`.
        latest_start = self._now() - ANSWER_S
        ranks = {"new": 0, "idle": 1, "busy": 2}
        connections = [c for c in self._open.values() if c.state != "busy" or c.since < latest_start]
        counts = Counter(connection.address for connection in self._open.values())
        return min(connections, key=lambda c: (-counts[c.address], ranks[c.state], c.since), default=None)


@dataclass(eq=False)
class _Connection:
    """`state` is "new" before the first request, and "busy" during an answer. `since`: start of the state, seconds."""

    link: socket.socket
    address: str
    state: Literal["new", "idle", "busy"]
    since: float


def _shut_down(link: socket.socket) -> None:
    try:
        link.shutdown(socket.SHUT_RDWR)
    except OSError:
        # The other side has already closed the connection.
        return


class _TimedLink(io.RawIOBase):
    """Connection for `http.server` with time limits for the first byte of a request and for its head."""

    def __init__(self, link: socket.socket, head_s: float, idle_s: float) -> None:
        self.link = link
        self._head_s = head_s
        self._idle_s = idle_s
        self._deadline: float | None = time.monotonic() + head_s
        link.settimeout(idle_s)
        self.sendall = link.sendall
        self.fileno = link.fileno
        self.setsockopt = link.setsockopt

    def makefile(self, mode: str, size: int) -> io.BufferedReader:
        """Return a buffered reader of this connection."""
        del mode, size
        return io.BufferedReader(self)

    def expect(self, within_s: float | None = None) -> None:
        """Set the time in which the next data must arrive; None means the limits of a new request."""
        self._deadline = None if within_s is None else time.monotonic() + within_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        deadline = time.monotonic() + self._idle_s if self._deadline is None else self._deadline
        remaining_s = deadline - time.monotonic()
        if remaining_s <= 0:
            raise TimeoutError("the head of the request is incomplete at its time limit")
        self.link.settimeout(remaining_s)
        try:
            count = self.link.recv_into(buffer)
        finally:
            self.link.settimeout(self._idle_s)
        if self._deadline is None:
            self._deadline = time.monotonic() + self._head_s
        return count


class LocalServer(ABC, ThreadingHTTPServer):
    """Server of one page, started by `serve`; the constructor raises an InputError if it cannot listen."""

    command: ClassVar[str]  # Name of the serving command in messages
    max_bytes: ClassVar[int] = 0  # Size limit for the body of a PUT; with 0, every PUT is refused

    daemon_threads = True
    request_queue_size = MAX_CONNECTIONS

    def __init__(
        self,
        host: str,
        port: int,
        *,
        max_connections: int = MAX_CONNECTIONS,
        head_s: float = HEAD_S,
        idle_s: float = IDLE_S,
    ) -> None:
        self.access = Access.for_host(host, self.command)
        self._host = host
        self.connections = Connections(max_connections)
        self._head_s = head_s
        self._idle_s = idle_s
        if ":" in host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((host, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            hint = "" if is_loopback(host) else " or an address of this machine with --host"
            raise InputError(f"cannot serve on {host} port {port}: {reason}; give another with --port{hint}") from error

    @abstractmethod
    def answer(self, request: Request) -> Response | Refusal:
        """Return the answer to a request; called from several threads."""

    def serve(self, content: str, warning: str) -> None:
        """Print the address of the page and serve it until interrupted.

        `content`: what the page shows. `warning`: what other people can do if they can reach the server.
        """
        with suppress(KeyboardInterrupt):
            addresses = [f"http://{name}:{self.port}/{self.path}" for name in reachable_addresses(self._host)]
            print(f"{' and '.join(addresses)} shows {content}; Ctrl-C ends it", flush=True)
            if not is_loopback(self._host):
                print(
                    f"warning: everybody who has this address and can reach this machine {warning}, and data are sent "
                    "without encryption; use it only in your own network",
                    file=sys.stderr,
                )
                if sys.stdout.isatty() and "utf" in sys.stdout.encoding.lower():
                    print(qr_text(addresses[0]), flush=True)
            self.serve_forever()

    @property
    def port(self) -> int:
        """Port of the server."""
        return self.server_address[1]

    @property
    def path(self) -> str:
        """Path of the page: the token and a slash, or an empty text without a token."""
        return f"{self.access.token}/" if self.access.token else ""

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a new thread, or close it if too many connections are busy."""
        if self.connections.admit(request, str(client_address[0])):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection, then remove it."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.connections.remove(request)

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Answer the requests of a connection, with time limits for each request."""
        super().finish_request(_TimedLink(request, self._head_s, self._idle_s), client_address)  # pyrefly: ignore[bad-argument-type]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing, because viewers may disconnect at any time."""


class _Handler(BaseHTTPRequestHandler):
    server: LocalServer  # pyrefly: ignore[bad-override-mutable-attribute]  # http.server sets it to the LocalServer
    protocol_version = "HTTP/1.1"
    # Head and body are written separately. Nagle's algorithm would delay the body by 40 ms.
    disable_nagle_algorithm = True

    def handle_one_request(self) -> None:
        super().handle_one_request()
        self.server.connections.mark(self.request.link, "idle")
        self.request.expect()

    def do_GET(self) -> None:  # name of http.server
        self.server.connections.mark(self.request.link, "busy")
        request = self.server.access.check(self.path, self.headers.get("Host"))
        self._send(request if isinstance(request, Refusal) else self.server.answer(request))

    do_HEAD = do_GET  # noqa: N815

    def do_PUT(self) -> None:  # name of http.server
        if not self.server.max_bytes:
            self._refuse()
            return
        request = self.server.access.check(self.path, self.headers.get("Host"), self.headers.get("Origin"))
        if isinstance(request, Refusal):
            self._send(request, close=True)
            return
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit() and 0 < int(length) <= self.server.max_bytes):
            limit = self.server.max_bytes >> 20
            self._send(Refusal(413, f"expected a body of at most {limit} MiB, with Content-Length"), close=True)
            return
        self.request.expect(BODY_S)
        body = self.rfile.read(int(length))
        self.server.connections.mark(self.request.link, "busy")
        self._send(self.server.answer(replace(request, body=body)))

    def _refuse(self) -> None:
        # Close the connection, because the body is not read and would be taken for the next request.
        headers = {"Allow": "GET, HEAD", "Connection": "close"}
        self._answer(405, _TEXT, b"method not allowed; use GET\n", headers)

    do_POST = do_DELETE = do_PATCH = do_OPTIONS = _refuse  # noqa: N815

    def _send(self, answer: Response | Refusal, close: bool = False) -> None:
        if isinstance(answer, Refusal):
            headers = {"Connection": "close"} if close else {}
            self._answer(answer.status, _TEXT, f"{answer.message}\n".encode(), headers)
        else:
            self._answer(200 if answer.media_type else 204, answer.media_type, answer.body, answer.headers)

    def _answer(self, status: int, media_type: str, body: bytes, extra_headers: Mapping[str, str]) -> None:
        headers = {"Content-Type": media_type} if media_type else {}
        headers |= {
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
        accepts_gzip = "gzip" in self.headers.get("Accept-Encoding", "")
        if media_type not in _INCOMPRESSIBLE and len(body) >= GZIP_FROM_BYTES and accepts_gzip:
            body = gzip.compress(body, 5, mtime=0)
            headers["Content-Encoding"] = "gzip"
        if status != 204:
            headers["Content-Length"] = str(len(body))
        self.send_response(status)
        for name, value in (headers | dict(extra_headers)).items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def version_string(self) -> str:
        """Return the Server header, without versions."""
        return self.server.command

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, to keep the terminal free."""


@dataclass(frozen=True)
class Access:
    """Rules that decide which requests are answered."""

    token: str  # First part of all addresses; empty on the loopback address
    names: frozenset[str]  # Host names of this server
    command: str  # Command that printed the address, for messages

    @classmethod
    def for_host(cls, host: str, command: str) -> Access:
        """Return the rules of a server that listens on `host`, with a new token unless it is a loopback address."""
        own = socket.gethostname().lower()
        names = frozenset({"localhost", host.lower(), own, f"{own}.local"})
        return cls("" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES), names, command)

    def check(self, target: str, host: str | None, origin: str | None = None) -> Request | Refusal:
        """Return the accepted request, or the refusal.

        `host`: Host header, None if missing. `origin`: Origin header of a PUT, None if missing.
        """
        if not self._is_own_name(host):
            return Refusal(421, f"unknown host name; open the address that {self.command} printed")
        # Browsers send the origin of the requesting page with a PUT.
        if origin is not None and origin.lower() != f"http://{host}".lower():
            return Refusal(403, "data from a page of another server; use the page of this server")
        path, _, query = target.removeprefix("/").partition("?")
        if self.token:
            token, slash, path = path.partition("/")
            if not slash or not hmac.compare_digest(token.encode(), self.token.encode()):
                return Refusal(403, f"wrong or missing token; open the complete address that {self.command} printed")
        return Request(path, {name: values[0] for name, values in parse_qs(query).items()})

    def _is_own_name(self, host: str | None) -> bool:
        # Host header: RFC 9110, 7.2. Numeric addresses are accepted, because DNS rebinding works only with a name.
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
    """Return whether a host address is reachable from this machine only."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def reachable_addresses(host: str) -> tuple[str, ...]:
    """Return the host names or addresses, for a URL, at which a server that listens on `host` can be reached.

    For a server on all interfaces, these are the addresses of this machine on its default routes, or else its name.
    """
    try:
        number = ipaddress.ip_address(host)
    except ValueError:
        return (host,)
    if not number.is_unspecified:
        return (f"[{host}]" if number.version == 6 else host,)
    addresses: list[str] = []
    # A connected datagram socket sends nothing, but gets the address that this machine uses for the destination. The
    # destinations are reserved for documentation (RFC 5737, RFC 3849), so the system uses the default route.
    for family, destination in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):
        if family == socket.AF_INET6 and number.version == 4:
            continue
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.connect((destination, 9))
                address = str(probe.getsockname()[0])
        except OSError:
            continue
        addresses.append(f"[{address}]" if ":" in address else address)
    return tuple(addresses) or (socket.gethostname(),)


def qr_text(text: str) -> str:
    """Return a QR code (ISO/IEC 18004) of a text. A line of half-block characters shows two rows of modules."""
    import cv2
    import numpy as np

    code = np.asarray(cv2.QRCodeEncoder.create().encode(text)) < 128
    rows, columns = np.flatnonzero(code.any(axis=1)), np.flatnonzero(code.any(axis=0))
    code = np.pad(code[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], QUIET_MODULES)
    if len(code) % 2:
        code = np.pad(code, ((0, 1), (0, 0)))
    # Light modules are drawn in white on black, independent of the colours of the terminal.
    blocks = {(False, False): "█", (False, True): "▀", (True, False): "▄", (True, True): " "}
    lines = (
        "".join(blocks[bool(upper), bool(lower)] for upper, lower in zip(above, below, strict=True))
        for above, below in zip(code[::2], code[1::2], strict=True)
    )
    return "\n".join(f"\x1b[97;40m{line}\x1b[0m" for line in lines)
