"""Server of a page: access, number of connections, time limits."""

from __future__ import annotations

import http.client
import ipaddress
import re
import socket
import threading
from contextlib import AbstractContextManager, ExitStack, suppress
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.local_server import (
    Access,
    LocalServer,
    Refusal,
    Request,
    Response,
    is_loopback,
    qr_text,
    reachable_addresses,
)
from tests.serving import serving

OPEN = Access("", frozenset({"localhost"}), "acquire monitor")
CLOSED = Access("secret", frozenset({"localhost"}), "acquire monitor")


@pytest.mark.parametrize(
    ("origin", "is_taken"),
    [
        (None, True),
        ("http://localhost:8707", True),
        ("HTTP://LOCALHOST:8707", True),
        ("http://localhost:80", False),
        ("https://localhost:8707", False),
        ("http://evil.example", False),
        ("null", False),
    ],
)
def test_refuses_data_from_pages_of_other_sites(origin: str | None, is_taken: bool) -> None:
    assert isinstance(OPEN.check("/", "localhost:8707", origin), Request) == is_taken


@given(st.text(max_size=40), st.text(max_size=20))
def test_refuses_requests_without_token(target: str, host: str) -> None:
    for request_on in (target, f"/{target}", "/" + target.replace("secret", "")):
        assert isinstance(CLOSED.check(request_on, host), Refusal) or request_on.startswith("/secret/")


@given(st.text(max_size=60))
def test_accepts_only_numeric_and_own_host_names(host: str) -> None:
    answer = OPEN.check("/", host)
    if answer == Request(""):
        name = host.lower().partition(":")[0] if not host.startswith("[") else host[1:].partition("]")[0]
        assert name == "localhost" or ipaddress.ip_address(name)


def test_requires_a_token_unless_on_loopback() -> None:
    assert Access.for_host("127.0.0.1", "x").token == ""
    assert Access.for_host("localhost", "x").token == ""
    assert Access.for_host("::1", "x").token == ""
    for host in ("0.0.0.0", "::", "192.168.1.7", socket.gethostname() + ".example"):
        assert len(Access.for_host(host, "x").token) >= 22
    assert not is_loopback("127.0.0.1.example")


class Probe:
    """A socket of a machine with routes to networks of both address families."""

    def __init__(self, family: socket.AddressFamily, kind: socket.SocketKind) -> None:
        assert kind == socket.SOCK_DGRAM, "no bytes may be sent"
        self.own = "192.168.1.7" if family == socket.AF_INET else "fd00::7"

    def __enter__(self) -> Probe:
        return self

    def __exit__(self, *_: object) -> None: ...

    def connect(self, address: tuple[str, int]) -> None:
        assert ipaddress.ip_address(address[0]).version == ipaddress.ip_address(self.own).version

    def getsockname(self) -> tuple[str, int]:
        return self.own, 40000


def test_reports_the_addresses_of_the_default_routes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(socket, "socket", Probe)
    assert reachable_addresses("0.0.0.0") == ("192.168.1.7",)
    assert reachable_addresses("::") == ("192.168.1.7", "[fd00::7]")


ADDRESS = "http://192.168.178.123:8707/abcdefghijklmnopqrstuv/"


def test_qr_code_has_the_printed_address() -> None:
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in qr_text(ADDRESS).splitlines()]
    assert len({len(line) for line in lines}) == 1
    light = {"█": (1, 1), "▀": (1, 0), "▄": (0, 1), " ": (0, 0)}
    rows = [[light[character][half] for character in line] for line in lines for half in (0, 1)]
    picture = np.kron(np.array(rows, np.uint8) * 255, np.ones((8, 8), np.uint8))
    assert cv2.QRCodeDetector().detectAndDecode(picture)[0] == ADDRESS
    # ISO/IEC 18004, 6.3.8: four light modules on each side.
    down, across = np.nonzero(np.array(rows) == 0)
    assert (across.min(), len(rows[0]) - 1 - across.max(), down.min()) == (4, 4, 4)
    # Two rows make a line of text.
    assert len(rows) - 1 - down.max() == 4 + (down.max() - down.min() + 1) % 2


class Echo(LocalServer):
    command = "echo"

    def answer(self, request: Request) -> Response:
        return Response("text/plain", request.path.encode())


def served(**limits: Any) -> AbstractContextManager[LocalServer]:
    return serving(Echo("127.0.0.1", 0, **limits))


def connect(server: LocalServer) -> socket.socket:
    return socket.create_connection(("127.0.0.1", server.port), timeout=20)


def request_on(link: socket.socket) -> bytes:
    """Send a request on a connection and return the body of the answer."""
    link.sendall(b"GET /here HTTP/1.1\r\nHost: localhost\r\n\r\n")
    answer = http.client.HTTPResponse(link)
    answer.begin()
    assert (answer.status, answer.getheader("Content-Type")) == (200, "text/plain")
    return answer.read()


def test_answers_viewers_despite_incomplete_requests() -> None:
    with served(max_connections=8) as server, ExitStack() as held:
        for number in range(40):
            link = held.enter_context(connect(server))
            link.sendall(b"GET / HTTP/1.1\r\nX: "[: number % 3 * 9])
        viewer = held.enter_context(connect(server))
        assert request_on(viewer) == b"here"
        # Clients that have sent a request stay connected if more clients come.
        for _ in range(20):
            held.enter_context(connect(server))
        assert request_on(viewer) == b"here"


def test_ends_a_slow_request_at_its_time_limit() -> None:
    with served(head_s=0.05) as server, connect(server) as link:
        link.settimeout(0.005)
        while not is_closed(link):
            with suppress(ConnectionError):
                link.sendall(b"G")


@pytest.mark.slow
def test_keeps_a_connection_with_occasional_requests() -> None:
    with served(head_s=0.05) as server, connect(server) as link:
        assert request_on(link) == b"here"
        # No request is outstanding for longer than the time limit of its head.
        link.settimeout(0.2)
        with pytest.raises(TimeoutError):
            link.recv(1)
        link.settimeout(20)
        assert request_on(link) == b"here"
    with served(idle_s=0.05) as server, connect(server) as link:
        assert request_on(link) == b"here"
        assert link.recv(1) == b"", "an idle connection ends"


def is_closed(far: socket.socket) -> bool:
    try:
        return far.recv(1) == b""
    except TimeoutError:
        return False
    except ConnectionError:
        return True


def test_replaces_a_viewer_that_reads_nothing() -> None:
    ended = threading.Event()

    class Flood(Echo):
        def answer(self, request: Request) -> Response:
            return Response("image/png", bytes(1 << 26))

        def process_request_thread(self, request: Any, client_address: Any) -> None:
            super().process_request_thread(request, client_address)
            ended.set()

    with serving(Flood("127.0.0.1", 0, max_connections=1, idle_s=0.05)) as server, connect(server) as link:
        link.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = http.client.HTTPResponse(link)
        answer.begin()
        assert ended.wait(20)
        # What the system had taken is all that comes.
        with pytest.raises((http.client.IncompleteRead, ConnectionError)):
            answer.read()
