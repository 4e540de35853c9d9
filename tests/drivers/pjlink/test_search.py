"""PJLink's datagrams against the standard's own examples, and the search with a network of paper.

Source: JBMIA, PJLink Specifications 2.00, 3.2 and 3.3.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import pjlink as wire
from drivers.links.network import Address, UdpSocket
from drivers.pjlink import FoundProjector, PjLinkReply, search
from foundation.clock import SimulatedClock
from foundation.errors import LinkClosed, LinkTimeout

MAC = "00:11:22:aa:bb:cc"


@pytest.mark.parametrize(
    ("datagram", "command", "value"),
    [
        (b"%2ACKN=00:11:22:aa:bb:cc\r", "ACKN", MAC),
        (b"%2LKUP=00:11:22:aa:bb:cc\r", "LKUP", MAC),
        (b"%2ERST=010020\r", "ERST", "010020"),
        (b"%2POWR=1\r", "POWR", "1"),
        (b"%2INPT=3A\r", "INPT", "3A"),
    ],
)
def test_the_standards_datagrams(datagram: bytes, command: str, value: str) -> None:
    reply = PjLinkReply(command, value, 2)
    assert wire.encode_reply(reply) == datagram
    for received in (datagram, datagram.lower() + b"\n", datagram[:-1], b"\r" + datagram + b"\0\0\0\0"):
        (found,) = wire.replies_in(received)
        assert (found.command, found.value.upper(), found.level) == (command, value.upper(), 2)


@pytest.mark.parametrize(
    "datagram",
    [
        b"", b"%2SRCH\r", b"%1POWR=1\r", b"PJLINK ERRA\r", b"\xff\xfe\x00", b"M-SEARCH * HTTP/1.1\r\n\r\n", b"x" * 2000,
    ],
)  # fmt: skip
def test_what_is_none_of_ours_is_passed_over(datagram: bytes) -> None:
    assert wire.replies_in(datagram) == ()


def test_several_in_one_datagram_keep_their_order() -> None:
    found = wire.replies_in(b"%2POWR=3\r%2what\r%2INPT=31\r")
    assert found == (PjLinkReply("POWR", "3", 2), PjLinkReply("INPT", "31", 2))


@given(st.binary(max_size=300))
def test_any_datagram_is_read_without_complaint(datagram: bytes) -> None:
    assert len(wire.replies_in(datagram)) <= len(datagram)


class PaperNetwork(UdpSocket):
    """Datagrams that arrive at given times, whoever asks; keeps what was sent and when."""

    def __init__(self, clock: SimulatedClock, *arrivals: tuple[float, bytes, str]) -> None:
        self._clock = clock
        self._arrivals = list(arrivals)
        self.sent: list[tuple[float, bytes, Address]] = []
        self.closed = False

    def send(self, data: bytes, address: Address) -> None:
        self.sent.append((self._clock.monotonic(), data, address))

    def receive(self, timeout: float) -> tuple[bytes, Address]:
        now = self._clock.monotonic()
        if self._arrivals and self._arrivals[0][0] <= now + timeout:
            at, datagram, host = self._arrivals.pop(0)
            self._clock.sleep(max(at - now, 0.0))
            return datagram, (host, 4352)
        self._clock.sleep(timeout)
        raise LinkTimeout("nothing")

    def close(self) -> None:
        self.closed = True


def look(network: PaperNetwork, clock: SimulatedClock) -> tuple[FoundProjector, ...]:
    ports: list[int] = []

    def opened(port: int) -> PaperNetwork:
        ports.append(port)
        return network

    found = search(open_socket=opened, clock=clock)
    assert ports == [4352]
    assert network.closed
    return found


def test_collects_for_thirty_seconds_and_names_each_once() -> None:
    clock = SimulatedClock()
    network = PaperNetwork(
        clock,
        (0.0, b"%2SRCH\r", "192.168.1.2"),  # our own question, come back
        (0.5, b"%2ACKN=00:11:22:aa:bb:01\r", "192.168.1.20"),
        (1.7, b"%2ACKN=00:11:22:aa:bb:01\r", "192.168.1.20"),
        (2.0, b"%2POWR=1\r", "192.168.1.22"),
        (9.9, b"%2ackn=00:11:22:AA:BB:02\r\n", "192.168.1.21"),
        (10.0, b"%2ACKN=001122aabbcc\r", "192.168.1.24"),
        (10.0, b"%2ACKN=00:11:22:aa:bb\r", "192.168.1.24"),
        (10.0, b"%2ACKN=0g:11:22:aa:bb:cc\r", "192.168.1.24"),
        (31.0, b"%2ACKN=00:11:22:aa:bb:03\r", "192.168.1.23"),
    )
    assert look(network, clock) == (
        FoundProjector("192.168.1.20", "00:11:22:aa:bb:01"),
        FoundProjector("192.168.1.21", "00:11:22:aa:bb:02"),
    )
    assert clock.monotonic() == pytest.approx(30.0)
    assert [(data, address) for _, data, address in network.sent] == [(b"%2SRCH\r", ("255.255.255.255", 4352))] * 3
    assert [at for at, _, _ in network.sent] == pytest.approx([0.0, 1.0, 2.0])


def test_a_search_counts_from_its_own_begin() -> None:
    clock = SimulatedClock()
    clock.sleep(1000)
    network = PaperNetwork(clock, (1000.5, b"%2ACKN=00:11:22:aa:bb:01\r", "192.168.1.20"))
    assert [found.host for found in look(network, clock)] == ["192.168.1.20"]
    assert clock.monotonic() == pytest.approx(1030.0)


def test_an_empty_network_has_no_projectors() -> None:
    clock = SimulatedClock()
    assert look(PaperNetwork(clock), clock) == ()


def test_junk_without_end_does_not_prolong_the_search() -> None:
    clock = SimulatedClock()
    network = PaperNetwork(clock, *[(0.01 * i, b"\xff" * 40, "192.168.1.9") for i in range(4000)])
    assert look(network, clock) == ()
    assert clock.monotonic() == pytest.approx(30.0, abs=0.1)


def test_a_taken_port_is_told_with_its_remedy() -> None:
    with UdpSocket(host="127.0.0.1") as taken, pytest.raises(LinkClosed, match="end the other program"):
        search(listen_port=taken.address[1])


def test_a_socket_that_was_closed_says_so() -> None:
    udp = UdpSocket(host="127.0.0.1")
    udp.close()
    udp.close()
    with pytest.raises(LinkClosed):
        udp.receive(0.0)
    with pytest.raises(LinkClosed, match=r"127\.0\.0\.1:9"):
        udp.send(b"x", ("127.0.0.1", 9))


def test_a_datagram_too_long_for_the_network_is_told() -> None:
    with UdpSocket(host="127.0.0.1") as udp, pytest.raises(LinkClosed):
        udp.send(b"x" * 70000, udp.address)
