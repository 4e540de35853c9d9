"""PTP over a network: packets against golden bytes and any split, and the transport over links in memory."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.link import Link
from drivers.ptp import ip as ptpip
from drivers.ptp.ip import (
    Cancel,
    Data,
    EndData,
    InitCommandAck,
    InitCommandRequest,
    InitEventAck,
    InitEventRequest,
    InitFail,
    IpTransport,
    OperationRequest,
    Packet,
    PacketCutter,
    Ping,
    Pong,
    StartData,
)
from drivers.ptp.protocol import PtpEvent, PtpRequest, PtpResponse
from foundation.clock import SimulatedClock, SystemClock
from foundation.errors import DeviceRefused, LinkClosed, LinkTimeout, ProtocolError
from sim.buses.ptp import serve_ptpip
from tests.contracts.link import read_exactly
from tests.contracts.transport import PATIENCE_S, Bench, Echo, TransportContract
from tests.drivers.ptp import examples
from tests.drivers.ptp.examples import PARAMETERS, U16, U32, split
from tests.joined_links import JoinedLink, joined_links

CONVERSATION: tuple[Packet, ...] = (
    InitCommandRequest(bytes(range(16)), "lab"),
    InitCommandAck(7, bytes(range(0xF0, 0x100)), "EOS"),
    InitEventRequest(7),
    InitEventAck(),
    InitFail(1),
    OperationRequest(sends_data=False, request=PtpRequest(0x1002, 0, (1,))),
    OperationRequest(sends_data=True, request=PtpRequest(0x9110, 5)),
    StartData(5, 12),
    Data(5, b"\x0c\0\0\0"),
    EndData(5, b"\x1c\xd1\0\0\x04\0\0\0"),
    PtpResponse(0x2001, 5),
    PtpEvent(0x4002, 0xFFFFFFFF, (0x91910021,)),
    Cancel(5),
    Ping(),
    Pong(),
)
"""What `examples.IP_PACKETS` say."""

NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)
GUIDS = st.binary(min_size=16, max_size=16)
REQUESTS = st.builds(PtpRequest, U16, U32, PARAMETERS)
PACKETS = st.one_of(
    st.builds(InitCommandRequest, GUIDS, NAMES, U32),
    st.builds(InitCommandAck, U32, GUIDS, NAMES, U32),
    st.builds(InitEventRequest, U32),
    st.just(InitEventAck()),
    st.builds(InitFail, U32),
    st.builds(OperationRequest, st.booleans(), REQUESTS),
    st.builds(PtpResponse, U16, U32, PARAMETERS),
    st.builds(PtpEvent, U16, U32, PARAMETERS),
    st.builds(StartData, U32, st.one_of(st.none(), st.integers(0, ptpip.UNKNOWN_TOTAL - 1))),
    st.builds(Data, U32, st.binary(max_size=300)),
    st.builds(EndData, U32, st.binary(max_size=300)),
    st.builds(Cancel, U32),
    st.just(Ping()),
    st.just(Pong()),
)


def joined(packets: Iterable[Packet]) -> list[Packet]:
    """Return the packets with consecutive data of one transaction joined."""
    result: list[Packet] = []
    for packet in packets:
        before = result[-1] if result else None
        if isinstance(packet, Data | EndData) and isinstance(before, Data) and before.transaction == packet.transaction:
            result[-1] = type(packet)(packet.transaction, before.data + packet.data)
        elif packet != Data(getattr(packet, "transaction", 0), b""):
            result.append(packet)
    return result


@pytest.mark.parametrize(("octets", "packet"), list(zip(examples.IP_PACKETS, CONVERSATION, strict=True)))
def test_packets_match_the_standards_bytes(octets: bytes, packet: Packet) -> None:
    assert PacketCutter().feed(octets) == [packet]
    assert ptpip.encode(packet) == octets


@given(st.lists(PACKETS, max_size=6), st.lists(st.integers(0, 10_000), max_size=12))
def test_packets_do_not_depend_on_splitting(packets: list[Packet], cuts: list[int]) -> None:
    stream = b"".join(map(ptpip.encode, packets))
    cutter = PacketCutter()
    assert joined(packet for piece in split(stream, cuts) for packet in cutter.feed(piece)) == joined(packets)


@pytest.mark.parametrize(
    ("octets", "reason"),
    [
        ("08000000 00000000", "type 0"),
        ("08000000 0f000000", "type 15"),
        ("07000000 0d000000", "PING packet of 7 bytes, expected 8 to 4096"),
        ("01100000 0d000000", "PING packet of 4097 bytes"),
        ("ffffffff 01000000", "INIT_COMMAND_REQUEST packet of 4294967295 bytes"),
        ("0b000000 0a000000", "DATA packet of 11 bytes"),
        ("00000000 00000000", "type 0 and 0 bytes"),
        ("48545450 2f312e31", "an HTTP server answers"),
        ("13000000 07000000 0120 05000000 0000000000", "list of parameters"),
        ("26000000 07000000 0120 05000000" + "00" * 24, "0 to 5 of 4 bytes"),
        ("12000000 06000000 03000000 1091 05000000", "data phase"),
        ("20000000 01000000" + "00" * 16 + "6c00 6100 6200 6300", "closing NUL"),
        ("1e020000 01000000" + "00" * 16 + "6c00" * 262 + "0000", "name at byte 534 is longer"),
        ("09000000 0d000000 00", "followed by 1 bytes"),
    ],
)
def test_refuses_invalid_packets(octets: str, reason: str) -> None:
    cutter = PacketCutter()
    with pytest.raises(ProtocolError, match=reason):
        cutter.feed(bytes.fromhex(octets))
    with pytest.raises(ProtocolError, match=reason):
        cutter.feed(ptpip.encode(Ping()))


GUID = bytes(range(16))


class TestLoopback(TransportContract):
    @pytest.fixture
    def bench(self) -> Iterator[Bench]:
        device = Echo()
        with serve_ptpip(device, 0) as server:
            transport = IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())
            yield Bench(transport, device, server.close)
            transport.close()


def packet(packet_type: int, body: bytes = b"") -> bytes:
    return (8 + len(body)).to_bytes(4, "little") + packet_type.to_bytes(4, "little") + body


ACK = packet(2, (7).to_bytes(4, "little") + bytes(16) + "cam\0".encode("utf-16-le") + bytes.fromhex("00000100"))
EVENT_ACK = packet(4)
DONE = packet(7, bytes.fromhex("0120 05000000"))


class FarEnd:
    """Both connections of a device with prepared replies."""

    def __init__(self, command: bytes = ACK, event: bytes = EVENT_ACK) -> None:
        near_command, self.command = joined_links()
        near_event, self.event = joined_links()
        self.command.write(command, PATIENCE_S)
        self.event.write(event, PATIENCE_S)
        self._near: list[JoinedLink] = [near_event, near_command]
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

    def heard(self, link: JoinedLink) -> bytes:
        return link.read(1 << 20, 0)


def connected() -> tuple[FarEnd, IpTransport]:
    """Return a device and its transport."""
    far = FarEnd()
    return far, far.connect()


def connect_in_turn(far_end: Callable[[], FarEnd], clock: SimulatedClock) -> IpTransport:
    """Connect to a new device at each attempt."""
    current: list[FarEnd] = []

    def open_command() -> Link:
        current.append(far_end())
        return current[-1].open_command()

    return IpTransport(open_command, lambda: current[-1].open_event(), guid=GUID, name="Cr", clock=clock)


def test_greeting_matches_the_standards_bytes() -> None:
    # CIPA DC-005-2005, 2.3.1 and 2.3.3.
    far, transport = connected()
    hello = GUID + "Cr\0".encode("utf-16-le") + bytes.fromhex("00000100")
    assert far.heard(far.command) == packet(1, hello)
    assert far.heard(far.event) == packet(3, bytes.fromhex("07000000"))
    assert transport.label == "cam (camera)"


def test_request_and_data_match_the_standards_bytes() -> None:
    far, transport = connected()
    far.heard(far.command)
    far.command.write(DONE, PATIENCE_S)
    transaction = transport.transact(PtpRequest(0x9110, 5, (1, 2)), send=bytes(70000), timeout=PATIENCE_S)
    assert transaction.response == PtpResponse(0x2001, 5)
    assert far.heard(far.command) == (
        packet(6, bytes.fromhex("02000000 1091 05000000 01000000 02000000"))
        + packet(9, bytes.fromhex("05000000 7011010000000000"))
        + packet(10, bytes.fromhex("05000000") + bytes(65536))
        + packet(12, bytes.fromhex("05000000") + bytes(4464))
    )


@pytest.mark.parametrize(("total", "reason"), [(5, "announced 5"), (7, "announced 7")])
def test_refuses_data_of_another_length(total: int, reason: str) -> None:
    far, transport = connected()
    start = packet(9, bytes.fromhex("05000000") + total.to_bytes(8, "little"))
    end = packet(12, bytes.fromhex("05000000") + b"abcdef")
    far.command.write(start + end + DONE, PATIENCE_S)
    with pytest.raises(ProtocolError, match=reason):
        transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S)


def test_waits_for_the_event_connection() -> None:
    far = FarEnd()
    far.refusals = 3
    clock = SimulatedClock()
    far.connect(clock)
    assert 0.2 < clock.monotonic() < 0.5


def test_wait_for_the_event_connection_is_limited() -> None:
    far = FarEnd()
    far.refusals = 1000
    clock = SimulatedClock()
    with pytest.raises(LinkClosed):
        far.connect(clock)
    assert clock.monotonic() < 5
    with pytest.raises(LinkClosed):
        far.command.write(b"x", PATIENCE_S)


@pytest.mark.parametrize(
    ("reason", "remedy"), [(1, "pair it again"), (2, "another program"), (3, "off and on"), (9, "reason 9")]
)
def test_refusal_names_the_remedy(reason: int, remedy: str) -> None:
    refusal = packet(5, reason.to_bytes(4, "little"))
    for words in ((refusal,), (ACK, refusal)):
        with pytest.raises(DeviceRefused, match=remedy):
            connect_in_turn(lambda words=words: FarEnd(*words), SimulatedClock())


def test_reports_other_servers() -> None:
    with pytest.raises(ProtocolError, match="PTP/IP stream has"):
        FarEnd(b"SSH-2.0-OpenSSH_9.6\r\n").connect()
    with pytest.raises(ProtocolError):
        FarEnd(packet(14)).connect()


def test_answers_pings_between_transactions() -> None:
    far, transport = connected()
    far.heard(far.event)
    far.event.write(packet(13), PATIENCE_S)
    assert transport.events() == ()
    assert far.heard(far.event) == packet(14)


def test_answers_pings_during_a_long_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.ptp.ip._EVENT_READ_INTERVAL_S", 0.01)
    far, transport = connected()
    far.heard(far.event)
    far.event.write(packet(13), PATIENCE_S)
    answers: list[bytes] = []

    def device() -> None:
        answers.append(read_exactly(far.event, 8))
        far.command.write(DONE, PATIENCE_S)

    thread = threading.Thread(target=device)
    thread.start()
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).response.ok
    thread.join()
    assert answers == [packet(14)]


@pytest.mark.slow
def test_keeps_the_newest_events() -> None:
    far, transport = connected()
    far.event.write(
        b"".join(packet(8, bytes.fromhex("01c1 ffffffff") + n.to_bytes(4, "little")) for n in range(9000)), PATIENCE_S
    )
    events = transport.events()
    assert len(events) == 4096
    assert events[-1].parameters == (8999,)


def test_reports_a_lost_event_connection() -> None:
    far, transport = connected()
    far.event.close()
    with pytest.raises(LinkClosed):
        transport.events()


def test_refuses_an_unexpected_packet_in_a_transaction() -> None:
    far, transport = connected()
    far.command.write(packet(4), PATIENCE_S)
    with pytest.raises(ProtocolError):
        transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S)


@pytest.mark.slow
def test_second_initiator_gets_busy() -> None:
    with serve_ptpip(Echo(), 0) as server:
        first = IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())
        with pytest.raises(DeviceRefused):
            IpTransport.connect(*server.address, guid=GUID, name="CroP", clock=SystemClock())
        assert first.transact(PtpRequest(0x9F01, 1, (3,)), timeout=PATIENCE_S).response.parameters == (3,)
        first.close()


def answer(size: int) -> bytes:
    start = packet(9, bytes.fromhex("05000000") + size.to_bytes(8, "little"))
    pieces = packet(10, bytes.fromhex("05000000") + bytes(size - 10)) + packet(
        12, bytes.fromhex("05000000") + bytes(10)
    )
    return start + pieces + DONE


@given(cut=st.integers(0, len(answer(100)) - 1), hangs_up=st.booleans())
def test_truncated_stream_is_closed_or_late(cut: int, hangs_up: bool) -> None:
    far, transport = connected()
    far.command.write(answer(100)[:cut], PATIENCE_S)
    if hangs_up:
        far.command.close()
    with pytest.raises(LinkClosed if hangs_up else LinkTimeout):
        transport.transact(PtpRequest(0x9116, 5), timeout=0.0 if not hangs_up else PATIENCE_S)
    with pytest.raises(LinkClosed if hangs_up else ProtocolError):
        transport.transact(PtpRequest(0x9116, 6), timeout=PATIENCE_S)


@given(at=st.integers(0, len(answer(100)) - 1), value=st.integers(0, 255))
def test_changed_byte_gives_only_our_errors(at: int, value: int) -> None:
    far, transport = connected()
    stream = bytearray(answer(100))
    stream[at] = value
    far.command.write(bytes(stream), PATIENCE_S)
    try:
        transaction = transport.transact(PtpRequest(0x9116, 5), timeout=0.0)
    except (ProtocolError, LinkTimeout):
        return
    assert transaction.response.transaction == 5
    assert len(transaction.data) == 100 or not transaction.response.ok


@pytest.mark.parametrize("taken_up_before", [True, False])
def test_waits_for_a_device_with_an_old_connection(taken_up_before: bool) -> None:
    busy = [FarEnd(packet(5, (2).to_bytes(4, "little"))) for _ in range(3)]
    ends = [FarEnd(), *busy, *([FarEnd()] if taken_up_before else [])]
    clock = SimulatedClock()
    transport = connect_in_turn(ends.pop, clock)
    if taken_up_before:
        transport.reset()
    assert 0.2 < clock.monotonic() < 0.5
