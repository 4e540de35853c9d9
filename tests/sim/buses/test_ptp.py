"""The simulated device on the network, in the standard's bytes, by a client that shares nothing with it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import pytest

from drivers.links.network import TcpServer
from sim.buses.ptp import serve_ptpip
from tests.contracts.transport import ECHO, GIVE, PATIENCE_S, RAISE, TAKE, Echo, payload

GUID = bytes(range(100, 116))
VERSION = bytes.fromhex("00000100")


class Client:
    """One connection, and packets as type and body."""

    def __init__(self, server: TcpServer) -> None:
        self._socket = socket.create_connection(server.address, PATIENCE_S)

    def say(self, kind: int, body: bytes = b"") -> None:
        self._socket.sendall((8 + len(body)).to_bytes(4, "little") + kind.to_bytes(4, "little") + body)

    def hear(self) -> tuple[int, bytes]:
        head = self._exactly(8)
        body = self._exactly(int.from_bytes(head[:4], "little") - 8)
        return int.from_bytes(head[4:], "little"), body

    def ask(self, code: int, *parameters: int, phase: int = 1) -> None:
        numbers = b"".join(number.to_bytes(4, "little") for number in parameters)
        self.say(6, phase.to_bytes(4, "little") + code.to_bytes(2, "little") + bytes.fromhex("05000000") + numbers)

    def greet(self) -> tuple[int, bytes]:
        self.say(1, GUID + "me\0".encode("utf-16-le") + VERSION)
        return self.hear()

    def is_over(self) -> bool:
        return self._socket.recv(1) == b""

    def close(self) -> None:
        self._socket.close()

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            piece = self._socket.recv(count - len(data))
            assert piece, "the server hung up"
            data += piece
        return data


@pytest.fixture
def device() -> Echo:
    return Echo()


@pytest.fixture
def server(device: Echo) -> Iterator[TcpServer]:
    before = set(threading.enumerate())
    with serve_ptpip(device, 0, name="EOS") as server:
        yield server
    assert set(threading.enumerate()) <= before


@pytest.fixture
def joined(server: TcpServer) -> Iterator[tuple[Client, Client]]:
    command, event = Client(server), Client(server)
    kind, body = command.greet()
    assert (kind, body[4:]) == (2, bytes(range(16)) + "EOS\0".encode("utf-16-le") + VERSION)
    event.say(3, body[:4])
    assert event.hear() == (4, b"")
    yield command, event
    command.close()
    event.close()


OK = bytes.fromhex("0120 05000000")
TRANSACTION = bytes.fromhex("05000000")


def test_data_are_announced_and_end_even_if_there_are_none(joined: tuple[Client, Client]) -> None:
    command, _ = joined
    command.ask(GIVE, 0)
    assert [command.hear() for _ in range(3)] == [(9, TRANSACTION + bytes(8)), (12, TRANSACTION), (7, OK)]


def test_what_fits_goes_out_in_one_end_of_data(joined: tuple[Client, Client]) -> None:
    command, _ = joined
    command.ask(GIVE, 262144)
    start = (9, TRANSACTION + (262144).to_bytes(8, "little"))
    assert [command.hear() for _ in range(3)] == [start, (12, TRANSACTION + payload(262144)), (7, OK)]
    command.ask(GIVE, 262145)
    heard = [command.hear() for _ in range(4)]
    assert [kind for kind, _ in heard] == [9, 10, 12, 7]
    assert heard[1][1][4:] + heard[2][1][4:] == payload(262145)


def test_data_come_in_any_packets(joined: tuple[Client, Client]) -> None:
    command, _ = joined
    command.ask(TAKE, phase=2)
    command.say(9, TRANSACTION + (9).to_bytes(8, "little"))
    command.say(10, TRANSACTION + b"1234")
    command.say(10, TRANSACTION + b"56789")
    command.say(12, TRANSACTION)
    # The CRC-32 of the digits is the algorithm's published check value.
    assert command.hear() == (7, OK + (9).to_bytes(4, "little") + (0xCBF43926).to_bytes(4, "little"))


def test_data_called_off_are_not_carried_out(joined: tuple[Client, Client], device: Echo) -> None:
    command, _ = joined
    command.ask(TAKE, phase=2)
    command.say(9, TRANSACTION + (9).to_bytes(8, "little"))
    command.say(11, TRANSACTION)
    assert command.hear() == (7, bytes.fromhex("1f20 05000000"))
    assert device.cancellations == [5]
    command.ask(ECHO)
    assert command.hear() == (7, OK)


def test_events_go_out_on_their_own_connection(joined: tuple[Client, Client], device: Echo) -> None:
    command, event = joined
    command.ask(RAISE, 1)
    assert command.hear() == (7, OK)
    assert event.hear() == (8, bytes.fromhex("01c1 ffffffff 00000000"))


def test_events_wait_until_there_is_a_connection_for_them(server: TcpServer) -> None:
    command, event = Client(server), Client(server)
    _, body = command.greet()
    command.ask(RAISE, 1)
    assert command.hear() == (7, OK)
    event.say(3, body[:4])
    assert [event.hear()[0] for _ in range(2)] == [4, 8]
    command.close()
    event.close()


def test_one_initiator_at_a_time(server: TcpServer, joined: tuple[Client, Client]) -> None:
    second = Client(server)
    assert second.greet() == (5, bytes.fromhex("02000000"))
    assert second.is_over()
    second.close()
    joined[0].ask(ECHO)
    assert joined[0].hear() == (7, OK)


def test_who_leaves_by_one_connection_has_left_by_both(joined: tuple[Client, Client]) -> None:
    command, event = joined
    command.close()
    assert event.is_over()


def test_garbage_ends_a_connection_and_frees_the_device(server: TcpServer, device: Echo) -> None:
    first = Client(server)
    assert first.greet()[0] == 2
    first.say(99, b"?")
    assert first.is_over()
    first.close()
    assert _until_free(server) == 2
    assert device.unplugs >= 1


def _until_free(server: TcpServer) -> int:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        client = Client(server)
        kind, _ = client.greet()
        client.close()
        if kind == 2:
            return kind
    return 5
