"""PTP/IP: the contract over loopback TCP, and the conversation byte by byte against a scripted far end."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.link import Link, MemoryLink, memory_pair
from drivers.links.network import TcpServer
from drivers.ptp.ip import IpTransport
from drivers.ptp.transaction import PtpRequest, PtpResponse
from foundation.clock import SystemClock
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.buses.ptpip_server import serve_ptpip
from sim.clock import SimulatedClock
from tests.contracts.link import read_exactly
from tests.contracts.transport import PATIENCE_S, Bench, Echo, TransportContract
from tests.drivers.links.troubled_links import Dribbling

GUID = bytes(range(16))


class TestLoopback(TransportContract):
    @pytest.fixture
    def bench(self) -> Iterator[Bench]:
        device = Echo()
        with serve_ptpip(device, 0) as server:
            transport = IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())
            yield Bench(transport, device, server.close)
            transport.close()


def packet(kind: int, body: bytes = b"") -> bytes:
    return (8 + len(body)).to_bytes(4, "little") + kind.to_bytes(4, "little") + body


ACK = packet(2, (7).to_bytes(4, "little") + bytes(16) + "cam\0".encode("utf-16-le") + bytes.fromhex("00000100"))
EVENT_ACK = packet(4)


class FarEnd:
    """Both connections of a device whose words are put into its mouth beforehand."""

    def __init__(self, command: bytes = ACK, event: bytes = EVENT_ACK) -> None:
        near_command, self.command = memory_pair()
        near_event, self.event = memory_pair()
        self.command.write(command, PATIENCE_S)
        self.event.write(event, PATIENCE_S)
        self._near: list[MemoryLink] = [near_event, near_command]
        self.refusals = 0

    def open_command(self) -> Link:
        return self._near.pop()

    def open_event(self) -> Link:
        if self.refusals:
            self.refusals -= 1
            raise LinkClosed("nothing listens yet")
        return self._near.pop()

    def connect(self, clock: SimulatedClock | None = None) -> IpTransport:
        return IpTransport(
            self.open_command, self.open_event, guid=GUID, name="Cr", clock=clock or SimulatedClock(), label="camera"
        )

    def heard(self, link: MemoryLink) -> bytes:
        return link.read(1 << 20, 0)


def test_greets_in_the_standards_bytes() -> None:
    # CIPA DC-005-2005, 2.3.1 and 2.3.3.
    far = FarEnd()
    transport = far.connect()
    hello = GUID + "Cr\0".encode("utf-16-le") + bytes.fromhex("00000100")
    assert far.heard(far.command) == packet(1, hello)
    assert far.heard(far.event) == packet(3, bytes.fromhex("07000000"))
    assert transport.label == "cam (camera)"


def test_asks_and_sends_data_in_the_standards_bytes() -> None:
    far = FarEnd()
    transport = far.connect()
    far.heard(far.command)
    far.command.write(packet(7, bytes.fromhex("0120 05000000")), PATIENCE_S)
    done = transport.transact(PtpRequest(0x9110, 5, (1, 2)), send=bytes(70000), timeout=PATIENCE_S)
    assert done.response == PtpResponse(0x2001, 5)
    assert far.heard(far.command) == (
        packet(6, bytes.fromhex("02000000 1091 05000000 01000000 02000000"))
        + packet(9, bytes.fromhex("05000000 7011010000000000"))
        + packet(10, bytes.fromhex("05000000") + bytes(65536))
        + packet(12, bytes.fromhex("05000000") + bytes(4464))
    )


def test_takes_data_in_any_packets() -> None:
    far = FarEnd()
    transport = far.connect()
    start = packet(9, bytes.fromhex("05000000 0600000000000000"))
    pieces = packet(10, bytes.fromhex("05000000") + b"ab") + packet(10, bytes.fromhex("05000000") + b"cdef")
    end = packet(12, bytes.fromhex("05000000"))
    far.command.write(start + pieces + end + packet(7, bytes.fromhex("0120 05000000")), PATIENCE_S)
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).data == b"abcdef"


@pytest.mark.parametrize(("total", "wrong"), [(5, "announced 5"), (7, "announced 7")])
def test_data_must_be_as_long_as_announced(total: int, wrong: str) -> None:
    far = FarEnd()
    transport = far.connect()
    start = packet(9, bytes.fromhex("05000000") + total.to_bytes(8, "little"))
    end = packet(12, bytes.fromhex("05000000") + b"abcdef")
    far.command.write(start + end + packet(7, bytes.fromhex("0120 05000000")), PATIENCE_S)
    with pytest.raises(ProtocolError, match=wrong):
        transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S)


def test_data_of_unknown_length_are_taken() -> None:
    far = FarEnd()
    transport = far.connect()
    start = packet(9, bytes.fromhex("05000000") + b"\xff" * 8)
    end = packet(12, bytes.fromhex("05000000") + b"abcdef")
    far.command.write(start + end + packet(7, bytes.fromhex("0120 05000000")), PATIENCE_S)
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).data == b"abcdef"


def test_waits_for_the_event_connection_to_be_accepted() -> None:
    far = FarEnd()
    far.refusals = 3
    clock = SimulatedClock()
    far.connect(clock)
    assert 0.2 < clock.monotonic() < 0.5


def test_does_not_wait_for_it_for_ever() -> None:
    far = FarEnd()
    far.refusals = 1000
    clock = SimulatedClock()
    with pytest.raises(LinkClosed):
        far.connect(clock)
    assert clock.monotonic() < 5
    with pytest.raises(LinkClosed):
        far.command.write(b"x", PATIENCE_S)


@pytest.mark.parametrize(
    ("reason", "remedy"), [(1, "pair the two anew"), (2, "another program"), (3, "off and on"), (9, "reason 9")]
)
def test_a_refusal_says_what_helps(reason: int, remedy: str) -> None:
    with pytest.raises(DeviceRefused, match=remedy):
        FarEnd(packet(5, reason.to_bytes(4, "little"))).connect()
    with pytest.raises(DeviceRefused, match=remedy):
        FarEnd(ACK, packet(5, reason.to_bytes(4, "little"))).connect()


def test_what_is_no_camera_is_named() -> None:
    with pytest.raises(ProtocolError, match="PTP/IP connection gives"):
        FarEnd(b"SSH-2.0-OpenSSH_9.6\r\n").connect()
    with pytest.raises(ProtocolError, match="Pong"):
        FarEnd(packet(14)).connect()


def test_pings_are_answered_between_transactions() -> None:
    far = FarEnd()
    transport = far.connect()
    far.heard(far.event)
    far.event.write(packet(13), PATIENCE_S)
    assert transport.events() == ()
    assert far.heard(far.event) == packet(14)


def test_a_long_wait_for_a_response_answers_pings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.ptp.ip._PING_EVERY_S", 0.01)
    far = FarEnd()
    transport = far.connect()
    far.heard(far.event)
    far.event.write(packet(13), PATIENCE_S)
    answers: list[bytes] = []

    def device() -> None:
        answers.append(read_exactly(far.event, 8))
        far.command.write(packet(7, bytes.fromhex("0120 05000000")), PATIENCE_S)

    thread = threading.Thread(target=device)
    thread.start()
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).response.ok
    thread.join()
    assert answers == [packet(14)]


def test_events_split_over_reads_are_joined() -> None:
    far = FarEnd()
    transport = far.connect()
    event = packet(8, bytes.fromhex("01c1 ffffffff 2a000000"))
    far.event.write(event[:5], PATIENCE_S)
    assert transport.events() == ()
    far.event.write(event[5:] + event, PATIENCE_S)
    assert [event.parameters for event in transport.events()] == [(42,), (42,)]


def test_a_flood_of_events_keeps_the_newest() -> None:
    far = FarEnd()
    transport = far.connect()
    far.event.write(
        b"".join(packet(8, bytes.fromhex("01c1 ffffffff") + n.to_bytes(4, "little")) for n in range(9000)), PATIENCE_S
    )
    events = transport.events()
    assert len(events) == 4096
    assert events[-1].parameters == (8999,)


def test_an_event_connection_that_is_lost_is_told() -> None:
    far = FarEnd()
    transport = far.connect()
    far.event.close()
    with pytest.raises(LinkClosed):
        transport.events()


def test_a_stranger_in_the_middle_of_a_transaction_is_refused() -> None:
    far = FarEnd()
    transport = far.connect()
    far.command.write(packet(4), PATIENCE_S)
    with pytest.raises(ProtocolError, match="InitEventAck"):
        transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S)


def test_a_second_initiator_hears_that_the_device_is_busy() -> None:
    with serve_ptpip(Echo(), 0) as server:
        first = IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())
        with pytest.raises(DeviceRefused, match="another program"):
            IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())
        assert first.transact(PtpRequest(0x9F01, 1, (3,)), timeout=PATIENCE_S).response.parameters == (3,)
        first.close()


def test_a_web_server_is_no_camera() -> None:
    def serve(link: Link) -> None:
        link.read(100, PATIENCE_S)
        link.write(b"HTTP/1.1 400 Bad Request\r\n\r\n", PATIENCE_S)

    with TcpServer(serve) as server, pytest.raises(ProtocolError):
        IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())


def answer(size: int) -> bytes:
    start = packet(9, bytes.fromhex("05000000") + size.to_bytes(8, "little"))
    pieces = packet(10, bytes.fromhex("05000000") + bytes(size - 10)) + packet(
        12, bytes.fromhex("05000000") + bytes(10)
    )
    return start + pieces + packet(7, bytes.fromhex("0120 05000000"))


@given(cut=st.integers(0, len(answer(100)) - 1), hangs_up=st.booleans())
def test_a_stream_that_ends_at_any_byte_is_closed_or_late(cut: int, hangs_up: bool) -> None:
    far = FarEnd()
    transport = far.connect()
    far.command.write(answer(100)[:cut], PATIENCE_S)
    if hangs_up:
        far.command.close()
    with pytest.raises(LinkClosed if hangs_up else LinkTimeout):
        transport.transact(PtpRequest(0x9116, 5), timeout=0.0 if not hangs_up else PATIENCE_S)
    with pytest.raises(LinkClosed if hangs_up else ProtocolError):
        transport.transact(PtpRequest(0x9116, 6), timeout=PATIENCE_S)


@given(at=st.integers(0, len(answer(100)) - 1), value=st.integers(0, 255))
def test_a_garbled_byte_never_ends_in_anything_but_our_errors(at: int, value: int) -> None:
    far = FarEnd()
    transport = far.connect()
    stream = bytearray(answer(100))
    stream[at] = value
    far.command.write(bytes(stream), PATIENCE_S)
    try:
        done = transport.transact(PtpRequest(0x9116, 5), timeout=0.0)
    except (ProtocolError, LinkTimeout):
        return
    assert done.response.transaction == 5
    assert len(done.data) == 100 or not done.response.ok


def test_a_reader_that_gets_byte_by_byte_gets_all() -> None:
    far = FarEnd()
    transport = IpTransport(
        lambda: Dribbling(far.open_command()), far.open_event, guid=GUID, name="Cr", clock=SimulatedClock()
    )
    far.command.write(answer(3000), PATIENCE_S)
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).data == bytes(3000)


def test_reset_is_a_new_connection() -> None:
    first, second = FarEnd(), FarEnd()
    ends = [second, first]
    transport = IpTransport(
        lambda: ends[-1].open_command(), lambda: ends[-1].open_event(), guid=GUID, name="Cr", clock=SimulatedClock()
    )
    ends.pop()
    transport.reset()
    with pytest.raises(LinkClosed):
        first.command.write(b"x", PATIENCE_S)
    second.command.write(packet(7, bytes.fromhex("0120 05000000")), PATIENCE_S)
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).response.ok


def test_reset_waits_for_a_device_that_still_holds_the_old_connection() -> None:
    busy = [FarEnd(packet(5, (2).to_bytes(4, "little"))) for _ in range(3)]
    ends = [FarEnd(), *busy, FarEnd()]
    clock = SimulatedClock()
    current: list[FarEnd] = []

    def open_command() -> Link:
        current.append(ends.pop())
        return current[-1].open_command()

    transport = IpTransport(open_command, lambda: current[-1].open_event(), guid=GUID, name="Cr", clock=clock)
    transport.reset()
    assert 0.2 < clock.monotonic() < 0.5
