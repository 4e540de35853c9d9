"""Network cables: the link contract over memory and loopback TCP, and the features of each cable."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from drivers.links.link import PeerLink, quoted
from drivers.links.network import LOOPBACK, TcpLink, TcpServer
from foundation.errors import LinkClosed, LinkTimeout
from tests.contracts.link import PATIENCE_S, Ends, LinkContract, read_exactly


class TestTcpClient(LinkContract):
    @pytest.fixture
    def ends(self) -> Iterator[Ends]:
        with _tcp_ends() as (client, served):
            yield client, served


class TestTcpServed(LinkContract):
    @pytest.fixture
    def ends(self) -> Iterator[Ends]:
        with _tcp_ends() as (client, served):
            yield served, client


class _tcp_ends:  # noqa: N801 – reads as the function it stands for
    """Both ends of one TCP connection; the server's thread ends with the block."""

    def __enter__(self) -> Ends:
        self._taken: list[TcpLink] = []
        self._arrived = threading.Event()
        self._done = threading.Event()
        self._server = TcpServer(self._hold)
        self._client = TcpLink.connect(*self._server.address, PATIENCE_S)
        assert self._arrived.wait(PATIENCE_S)
        return self._client, self._taken[0]

    def __exit__(self, *_: object) -> None:
        self._done.set()
        self._client.close()
        self._server.close()

    def _hold(self, link: TcpLink) -> None:
        self._taken.append(link)
        self._arrived.set()
        self._done.wait(PATIENCE_S)


class _Echo:
    """A peer that greets, repeats its input, and disconnects after ``bye``."""

    def __init__(self) -> None:
        self.connections = 0
        self.closed = False

    def connect(self) -> bytes:
        self.connections += 1
        self.closed = False
        return b"hello "

    def receive(self, data: bytes) -> bytes:
        self.closed = data == b"bye"
        return data


def test_peer_answers_without_waiting() -> None:
    link = PeerLink(_Echo())
    link.write(b"you", 0.0)
    assert link.read(100, 3600.0) == b"hello you"
    assert link.read(100, 0.0) == b""
    with pytest.raises(LinkTimeout, match="3600 s"):
        link.read(100, 3600.0)


def test_last_bytes_of_a_disconnected_peer_are_read() -> None:
    peer = _Echo()
    link = PeerLink(peer)
    link.write(b"bye", 0.0)
    assert link.read(100, 0.0) == b"hello bye"
    link.write(b"still there?", 0.0)
    with pytest.raises(LinkClosed):
        link.read(100, 0.0)
    assert PeerLink(peer).read(100, 0.0) == b"hello "
    assert peer.connections == 2


def test_tcp_refusal_names_host_port_and_remedy() -> None:
    with TcpServer(lambda link: None) as server:
        _, port = server.address
    with pytest.raises(LinkClosed, match=rf"{LOOPBACK}:{port}.*check the port"):
        TcpLink.connect(LOOPBACK, port, PATIENCE_S)


@pytest.mark.parametrize(("host", "port"), [("no such host", 1), (LOOPBACK, 70000), ("", 0)])
def test_tcp_refuses_invalid_addresses(host: str, port: int) -> None:
    with pytest.raises(LinkClosed):
        TcpLink.connect(host, port, PATIENCE_S)


def test_full_tcp_buffer_is_a_timeout() -> None:
    with _tcp_ends() as (near, _), pytest.raises(LinkTimeout):
        # More than any socket buffer; the far end never reads.
        near.write(bytes(1 << 28), 0.05)


def test_refuses_a_port_in_use() -> None:
    with TcpServer(lambda link: None) as server, pytest.raises(LinkClosed, match=str(server.address[1])):
        TcpServer(lambda link: None, server.address[1])


def test_server_accepts_several_connections_and_leaves_no_thread() -> None:
    thread_count = threading.active_count()

    def echo(link: TcpLink) -> None:
        while True:
            link.write(link.read(100, PATIENCE_S), PATIENCE_S)

    with TcpServer(echo) as server:
        links = [TcpLink.connect(*server.address, PATIENCE_S) for _ in range(3)]
        for number, link in enumerate(links):
            link.write(bytes([number]), PATIENCE_S)
        assert [read_exactly(link, 1) for link in links] == [b"\0", b"\1", b"\2"]
        server.hang_up()
        for link in links:
            with pytest.raises(LinkClosed):
                link.read(1, PATIENCE_S)
            link.close()
        new_link = TcpLink.connect(*server.address, PATIENCE_S)
        new_link.write(b"x", PATIENCE_S)
        assert read_exactly(new_link, 1) == b"x"
        new_link.close()
    server.close()
    assert threading.active_count() == thread_count


def test_quotes_mark_truncation() -> None:
    assert quoted(b"%" * 40) == repr("%" * 40)
    assert quoted(b"%" * 41) == repr("%" * 40) + "…"
