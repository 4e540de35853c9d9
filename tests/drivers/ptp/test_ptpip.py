"""PTP/IP packets against bytes from the standard, and any split of their stream."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

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
    OperationRequest,
    Packet,
    PacketCutter,
    Ping,
    Pong,
    StartData,
)
from drivers.ptp.transaction import PtpEvent, PtpRequest, PtpResponse
from foundation.errors import ProtocolError
from tests.drivers.ptp import examples

CONVERSATION: tuple[Packet, ...] = (
    InitCommandRequest(bytes(range(16)), "lab"),
    InitCommandAck(7, bytes(range(0xF0, 0x100)), "EOS"),
    InitEventRequest(7),
    InitEventAck(),
    InitFail(1),
    OperationRequest(PtpRequest(0x1002, 0, (1,))),
    OperationRequest(PtpRequest(0x9110, 5), sends_data=True),
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

U16 = st.integers(0, 0xFFFF)
U32 = st.integers(0, 0xFFFFFFFF)
PARAMETERS = st.lists(U32, max_size=5).map(tuple)
NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)
GUIDS = st.binary(min_size=16, max_size=16)
REQUESTS = st.builds(PtpRequest, U16, U32, PARAMETERS)
PACKETS = st.one_of(
    st.builds(InitCommandRequest, GUIDS, NAMES, U32),
    st.builds(InitCommandAck, U32, GUIDS, NAMES, U32),
    st.builds(InitEventRequest, U32),
    st.just(InitEventAck()),
    st.builds(InitFail, U32),
    st.builds(OperationRequest, REQUESTS, st.booleans()),
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
    """Return the packets with neighbouring data of one transaction put together."""
    result: list[Packet] = []
    for packet in packets:
        before = result[-1] if result else None
        if isinstance(packet, Data | EndData) and isinstance(before, Data) and before.transaction == packet.transaction:
            result[-1] = type(packet)(packet.transaction, before.data + packet.data)
        elif packet != Data(getattr(packet, "transaction", 0), b""):
            result.append(packet)
    return result


def split(data: bytes, cuts: Iterable[int]) -> list[bytes]:
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[start:end] for start, end in pairwise(places)]


@pytest.mark.parametrize(("octets", "packet"), list(zip(examples.IP_PACKETS, CONVERSATION, strict=True)))
def test_packets_are_the_standards_bytes(octets: bytes, packet: Packet) -> None:
    assert ptpip.decode(octets) == packet
    assert ptpip.encode(packet) == octets


def test_a_responder_that_ends_with_its_name() -> None:
    octets = bytes.fromhex("1e000000 02000000 01000000") + bytes(16) + b"\0\0"
    assert ptpip.decode(octets) == InitCommandAck(1, bytes(16), "")


def test_a_total_that_the_sender_does_not_know() -> None:
    octets = bytes.fromhex("14000000 09000000 05000000") + b"\xff" * 8
    assert ptpip.decode(octets) == StartData(5, None)
    assert ptpip.encode(StartData(5, None)) == octets


@given(PACKETS)
def test_any_packet_comes_back(packet: Packet) -> None:
    assert ptpip.decode(ptpip.encode(packet)) == packet


@given(st.lists(PACKETS, max_size=6), st.lists(st.integers(0, 10_000), max_size=12))
def test_any_split_gives_the_same_packets(packets: list[Packet], cuts: list[int]) -> None:
    stream = b"".join(map(ptpip.encode, packets))
    cutter = PacketCutter()
    assert joined(packet for piece in split(stream, cuts) for packet in cutter.feed(piece)) == joined(packets)
    assert cutter.at_boundary


def test_data_are_handed_on_as_they_come() -> None:
    cutter = PacketCutter()
    head = (1 << 30).to_bytes(4, "little") + bytes.fromhex("0c000000 05000000")
    assert cutter.feed(head) == []
    assert not cutter.at_boundary
    for _ in range(3):
        assert cutter.feed(bytes(1000)) == [Data(5, bytes(1000))]


def test_an_end_without_data() -> None:
    assert PacketCutter().feed(ptpip.encode(EndData(5))) == [EndData(5)]


@pytest.mark.parametrize(
    ("octets", "says"),
    [
        ("08000000 00000000", "type 0"),
        ("08000000 0f000000", "type 15"),
        ("07000000 0d000000", "PING packet of 7 bytes; 8 to 4096"),
        ("01100000 0d000000", "PING packet of 4097 bytes"),
        ("ffffffff 01000000", "INIT_COMMAND_REQUEST packet of 4294967295 bytes"),
        ("0b000000 0a000000", "DATA packet of 11 bytes"),
        ("00000000 00000000", "type 0 and 0 bytes"),
        ("48545450 2f312e31", "type 825110831"),
        ("13000000 07000000 0120 05000000 0000000000", "list of parameters"),
        ("26000000 07000000 0120 05000000" + "00" * 24, "0 to 5 of 4 bytes"),
        ("12000000 06000000 03000000 1091 05000000", "data phase"),
        ("20000000 01000000" + "00" * 16 + "6c00 6100 6200 6300", "closing NUL"),
        ("1e020000 01000000" + "00" * 16 + "6c00" * 262 + "0000", "name at byte 534 is longer"),
        ("09000000 0d000000 00", "followed by 1 bytes"),
    ],
)
def test_what_is_no_packet_is_named(octets: str, says: str) -> None:
    cutter = PacketCutter()
    with pytest.raises(ProtocolError, match=says):
        cutter.feed(bytes.fromhex(octets))
    with pytest.raises(ProtocolError, match=says):
        cutter.feed(ptpip.encode(Ping()))


def test_a_packet_before_the_fault_is_not_lost() -> None:
    cutter = PacketCutter()
    assert cutter.feed(ptpip.encode(Pong()) + b"\xff" * 8) == [Pong()]
    with pytest.raises(ProtocolError, match="type 4294967295"):
        cutter.feed(b"")


def test_a_length_that_is_not_the_packets() -> None:
    with pytest.raises(ProtocolError, match="length at byte 0 is 9; expected 8"):
        ptpip.decode(bytes.fromhex("09000000 0d000000"))


@pytest.mark.parametrize(
    "packet",
    [
        InitCommandRequest(bytes(15), "lab"),
        InitCommandRequest(bytes(16), "a\0b"),
        InitCommandRequest(bytes(16), "x" * 256),
        InitEventRequest(1 << 32),
        OperationRequest(PtpRequest(0x1002, 0, (0,) * 6)),
        StartData(5, 1 << 64),
    ],
)
def test_what_the_wire_cannot_hold_is_our_own_mistake(packet: Packet) -> None:
    with pytest.raises(ValueError, match=r"."):
        ptpip.encode(packet)
