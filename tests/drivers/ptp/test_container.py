"""USB containers against bytes from the standard, and any split of their stream."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.ptp import usb as container
from drivers.ptp.codes import EventCode, Operation, ResponseCode
from drivers.ptp.transaction import PtpEvent, PtpRequest, PtpResponse, next_transaction
from drivers.ptp.usb import ContainerReader, DataPiece, DataStart, DeviceStatus, Message
from foundation.errors import ProtocolError
from tests.drivers.ptp import examples

U16 = st.integers(0, 0xFFFF)
U32 = st.integers(0, 0xFFFFFFFF)
PARAMETERS = st.lists(U32, max_size=5).map(tuple)
MESSAGES = st.one_of(
    st.builds(PtpRequest, U16, U32, PARAMETERS),
    st.builds(PtpResponse, U16, U32, PARAMETERS),
    st.builds(PtpEvent, U16, U32, PARAMETERS),
)


def joined(messages: Iterable[Message]) -> list[Message]:
    """Return the messages with the pieces of each data phase put together."""
    result: list[Message] = []
    for message in messages:
        before = result[-1] if result else None
        if isinstance(message, DataPiece) and isinstance(before, DataPiece) and not before.last:
            result[-1] = DataPiece(before.data + message.data, message.last)
        else:
            result.append(message)
    return result


def split(data: bytes, cuts: Iterable[int]) -> list[bytes]:
    places = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    return [data[start:end] for start, end in pairwise(places)]


def test_commands_are_the_standards_bytes() -> None:
    # USB Still Image 1.0, 7.1.1: length, type, code, transaction, parameters.
    assert container.encode(PtpRequest(Operation.OPEN_SESSION, 0, (1,))) == bytes.fromhex(
        "10000000 0100 0210 00000000 01000000"
    )
    assert container.encode(PtpResponse(ResponseCode.OK, 7)) == bytes.fromhex("0c000000 0300 0120 07000000")
    assert container.encode(PtpEvent(EventCode.OBJECT_ADDED, 0xFFFFFFFF, (0x91910021,))) == bytes.fromhex(
        "10000000 0400 0240 ffffffff 21009191"
    )


def test_a_transaction_as_the_60d_sends_it() -> None:
    assert joined(ContainerReader().feed(examples.USB_STREAM)) == [
        PtpRequest(Operation.GET_DEVICE_PROP_DESC, 22, (0x5001,)),
        DataStart(Operation.GET_DEVICE_PROP_DESC, 22, 20),
        DataPiece(examples.BATTERY_DESC, last=True),
        PtpResponse(ResponseCode.OK, 22),
        PtpEvent(EventCode.EOS_REQUEST_GET_EVENT, 0xFFFFFFFF, (7,)),
    ]


def test_an_event_of_the_400d() -> None:
    (start, piece) = ContainerReader().feed(examples.EOS_400D_SHOT)
    assert start == DataStart(Operation.EOS_GET_EVENT, 0x070B, 68)
    assert piece == DataPiece(examples.EOS_400D_SHOT[12:], last=True)


def test_a_header_that_travels_alone() -> None:
    reader = ContainerReader()
    assert reader.feed(container.encode_data_header(0x1009, 5, 3)) == [DataStart(0x1009, 5, 3)]
    assert not reader.at_boundary
    assert reader.feed(b"") == []
    assert reader.feed(b"abc") == [DataPiece(b"abc", last=True)]
    assert reader.at_boundary


def test_empty_packets_are_passed_over() -> None:
    reader = ContainerReader()
    phase = container.encode_data(0x1009, 5, bytes(500))
    assert container.ends_with_empty_packet(len(phase), 512)
    pieces = (phase, b"", container.encode(PtpResponse(0x2001, 5)))
    messages = [message for piece in pieces for message in reader.feed(piece)]
    assert messages == [DataStart(0x1009, 5, 500), DataPiece(bytes(500), last=True), PtpResponse(0x2001, 5)]


def test_a_response_may_share_a_read_with_the_data() -> None:
    reader = ContainerReader()
    stream = container.encode_data(0x1009, 5, b"abc") + container.encode(PtpResponse(0x2001, 5, (3,)))
    assert reader.feed(stream)[-1] == PtpResponse(0x2001, 5, (3,))


def test_an_empty_data_phase_is_closed_at_once() -> None:
    assert ContainerReader().feed(container.encode_data(0x9116, 1, b"")) == [
        DataStart(0x9116, 1, 0),
        DataPiece(b"", last=True),
    ]


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("length", [0, 1, 499, 500, 501, 512, 1024, 1500])
def test_a_phase_of_unknown_length_ends_with_a_short_packet(length: int, alone: bool) -> None:
    header, payload = container.encode_data_header(0x1009, 5, None), bytes(range(256)) * 6
    payload = payload[:length]
    transfers = [header, payload] if alone else [header + payload]
    pieces: list[bytes] = []
    for transfer in transfers:
        pieces += [transfer[at : at + 512] for at in range(0, len(transfer), 512)]
    if container.ends_with_empty_packet(len(transfers[-1]), 512) or (not alone and length == 0):
        pieces.append(b"")
    reader = ContainerReader(512)
    messages = joined(message for piece in pieces for message in reader.feed(piece))
    assert messages == [DataStart(0x1009, 5, None), DataPiece(payload, last=True)]
    assert reader.feed(container.encode(PtpResponse(0x2001, 5))) == [PtpResponse(0x2001, 5)]


def test_lengths_beyond_32_bits_are_unknown() -> None:
    assert container.encode_data_header(0x1009, 5, 1 << 33)[:4] == b"\xff\xff\xff\xff"
    assert container.encode_data_header(0x1009, 5, 0xFFFFFFFE - 12)[:4] == b"\xfe\xff\xff\xff"


@pytest.mark.parametrize(
    ("total", "packet", "due"),
    [(12, 512, False), (512, 512, True), (1024, 512, True), (1025, 512, False), (64, 64, True)],
)
def test_when_an_empty_packet_is_due(total: int, packet: int, due: bool) -> None:
    assert container.ends_with_empty_packet(total, packet) is due


@pytest.mark.parametrize(
    ("octets", "says"),
    [
        ("0b000000 0100 0210 00000000", "command container of 11 bytes"),
        ("0d000000 0300 0120 00000000 00", "response container of 13 bytes"),
        ("24000000 0400 0240 00000000", "event container of 36 bytes"),
        ("ffffffff 0300 0120 00000000", "response container of 4294967295 bytes"),
        ("0b000000 0200 0210 00000000", "data container of 11 bytes"),
        ("0c000000 0000 0210 00000000", "container of type 0"),
        ("0c000000 0500 0210 00000000", "container of type 5"),
    ],
)
def test_what_is_no_container_is_named(octets: str, says: str) -> None:
    reader = ContainerReader()
    with pytest.raises(ProtocolError, match=says):
        reader.feed(bytes.fromhex(octets))
    with pytest.raises(ProtocolError, match=says):
        reader.feed(container.encode(PtpResponse(0x2001, 5)))


def test_a_message_before_the_fault_is_not_lost() -> None:
    reader = ContainerReader()
    assert reader.feed(container.encode(PtpResponse(0x2001, 5)) + b"\xff" * 12) == [PtpResponse(0x2001, 5)]
    with pytest.raises(ProtocolError, match="container of type 65535"):
        reader.feed(b"")


def test_nothing_of_a_payload_stays_in_the_reader() -> None:
    reader = ContainerReader()
    reader.feed(container.encode_data_header(0x1009, 5, 1 << 31))
    for _ in range(3):
        assert reader.feed(bytes(512)) == [DataPiece(bytes(512))]


def test_six_parameters_are_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="at most 5"):
        container.encode(PtpRequest(0x1002, 0, (0,) * 6))
    with pytest.raises(ValueError, match="does not fit"):
        container.encode(PtpRequest(0x10002))


@given(
    st.lists(st.one_of(MESSAGES, st.tuples(U16, U32, st.binary(max_size=600))), max_size=6),
    st.lists(st.integers(0, 10_000), max_size=12),
)
def test_any_split_gives_the_same_messages(
    items: list[PtpRequest | PtpResponse | PtpEvent | tuple[int, int, bytes]], cuts: list[int]
) -> None:
    stream, expected = b"", list[Message]()
    for item in items:
        if isinstance(item, tuple):
            stream += container.encode_data(*item)
            expected += [DataStart(item[0], item[1], len(item[2])), DataPiece(item[2], last=True)]
        else:
            stream += container.encode(item)
            expected.append(item)
    reader = ContainerReader()
    assert joined(message for piece in split(stream, cuts) for message in reader.feed(piece)) == expected
    assert reader.at_boundary


def test_control_requests_are_the_standards_bytes() -> None:
    # USB Still Image 1.0, 5.2.1 and 5.2.4.
    assert container.encode_cancel(5) == bytes.fromhex("0140 05000000")
    assert container.decode_cancel(bytes.fromhex("0140 05000000")) == 5
    status = DeviceStatus(ResponseCode.DEVICE_BUSY, (0x81, 0x02))
    assert status.encode() == bytes.fromhex("0c00 1920 81000000 02000000")
    assert DeviceStatus.decode(status.encode()) == status


@pytest.mark.parametrize("octets", ["0300 0120", "0600 0120 0000", "1c00 0120" + "00" * 24])
def test_a_status_that_is_none(octets: str) -> None:
    with pytest.raises(ProtocolError, match="the device status: length"):
        DeviceStatus.decode(bytes.fromhex(octets))


def test_transactions_are_numbered_past_the_reserved_ones() -> None:
    assert [next_transaction(n) for n in (0, 1, 0xFFFFFFFD, 0xFFFFFFFE)] == [1, 2, 0xFFFFFFFE, 1]


def test_messages_read_well() -> None:
    assert [PtpResponse(code).ok for code in (0x2001, 0x2019)] == [True, False]
    assert str(PtpRequest(0x1002, 0, (1,))) == "OPEN_SESSION (0x1002)(0x1)"
    assert str(PtpResponse(0x2019)) == "DEVICE_BUSY (0x2019)"
    assert str(PtpEvent(0xC999)) == "0xc999"
