"""PTP over USB: containers against golden bytes and any split, and the transport over pipes in memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.links.usb import Pipe, PipeStalled, UsbPipes, open_usb
from drivers.ptp import usb as container
from drivers.ptp.codes import EventCode, Operation, ResponseCode
from drivers.ptp.protocol import PtpEvent, PtpRequest, PtpResponse
from drivers.ptp.usb import ContainerReader, DataPiece, DataStart, DeviceStatus, Message, UsbTransport
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError, LinkClosed, LinkTimeout, ProtocolError
from sim.buses.usb import PtpUsbDevice, SimulatedBus
from tests.cable_faults import CutOff, Deaf, Garbling, HeaderAlone, Joining, ShortReads, Stalling, WithoutEmptyPackets
from tests.contracts.transport import (
    ECHO,
    GIVE,
    PATIENCE_S,
    RAISE,
    TAKE,
    Bench,
    Echo,
    TransportContract,
    payload,
)
from tests.drivers.ptp import examples
from tests.drivers.ptp.examples import PARAMETERS, U16, U32, split

MESSAGES = st.one_of(
    st.builds(PtpRequest, U16, U32, PARAMETERS),
    st.builds(PtpResponse, U16, U32, PARAMETERS),
    st.builds(PtpEvent, U16, U32, PARAMETERS),
)


def joined(messages: Iterable[Message]) -> list[Message]:
    """Return the messages with the pieces of each data phase joined."""
    result: list[Message] = []
    for message in messages:
        before = result[-1] if result else None
        if isinstance(message, DataPiece) and isinstance(before, DataPiece) and not before.last:
            result[-1] = DataPiece(before.data + message.data, message.last)
        else:
            result.append(message)
    return result


def test_commands_match_the_standards_bytes() -> None:
    # USB Still Image 1.0, 7.1.1: length, type, code, transaction, parameters.
    assert container.encode(PtpRequest(Operation.OPEN_SESSION, 0, (1,))) == bytes.fromhex(
        "10000000 0100 0210 00000000 01000000"
    )
    assert container.encode(PtpResponse(ResponseCode.OK, 7)) == bytes.fromhex("0c000000 0300 0120 07000000")
    assert container.encode(PtpEvent(EventCode.OBJECT_ADDED, 0xFFFFFFFF, (0x91910021,))) == bytes.fromhex(
        "10000000 0400 0240 ffffffff 21009191"
    )


def test_reads_a_transaction_of_the_60d() -> None:
    assert joined(ContainerReader().feed(examples.USB_STREAM)) == [
        PtpRequest(Operation.GET_DEVICE_PROP_DESC, 22, (0x5001,)),
        DataStart(Operation.GET_DEVICE_PROP_DESC, 22, 20),
        DataPiece(examples.BATTERY_DESC, last=True),
        PtpResponse(ResponseCode.OK, 22),
        PtpEvent(EventCode.EOS_REQUEST_GET_EVENT, 0xFFFFFFFF, (7,)),
    ]


def test_ignores_empty_packets() -> None:
    reader = ContainerReader()
    phase = container.encode_data_header(0x1009, 5, 500) + bytes(500)
    assert container.ends_with_empty_packet(len(phase), 512)
    pieces = (phase, b"", container.encode(PtpResponse(0x2001, 5)))
    messages = [message for piece in pieces for message in reader.feed(piece)]
    assert messages == [DataStart(0x1009, 5, 500), DataPiece(bytes(500), last=True), PtpResponse(0x2001, 5)]


@pytest.mark.parametrize("alone", [True, False])
@pytest.mark.parametrize("length", [0, 1, 499, 500, 501, 512, 1024, 1500])
def test_short_packet_ends_a_phase_of_unknown_length(length: int, alone: bool) -> None:
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


@pytest.mark.parametrize(
    ("octets", "reason"),
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
def test_refuses_invalid_containers(octets: str, reason: str) -> None:
    reader = ContainerReader()
    with pytest.raises(ProtocolError, match=reason):
        reader.feed(bytes.fromhex(octets))
    with pytest.raises(ProtocolError, match=reason):
        reader.feed(container.encode(PtpResponse(0x2001, 5)))


@given(
    st.lists(st.one_of(MESSAGES, st.tuples(U16, U32, st.binary(max_size=600))), max_size=6),
    st.lists(st.integers(0, 10_000), max_size=12),
)
def test_messages_do_not_depend_on_splitting(
    items: list[PtpRequest | PtpResponse | PtpEvent | tuple[int, int, bytes]], cuts: list[int]
) -> None:
    stream, expected = b"", list[Message]()
    for item in items:
        if isinstance(item, tuple):
            stream += container.encode_data_header(item[0], item[1], len(item[2])) + item[2]
            expected += [DataStart(item[0], item[1], len(item[2])), DataPiece(item[2], last=True)]
        else:
            stream += container.encode(item)
            expected.append(item)
    reader = ContainerReader()
    assert joined(message for piece in split(stream, cuts) for message in reader.feed(piece)) == expected


def test_control_requests_match_the_standards_bytes() -> None:
    # USB Still Image 1.0, 5.2.1 and 5.2.4.
    assert container.encode_cancel(5) == bytes.fromhex("0140 05000000")
    assert container.decode_cancel(bytes.fromhex("0140 05000000")) == 5
    status = DeviceStatus(ResponseCode.DEVICE_BUSY, (0x81, 0x02))
    assert status.encode() == bytes.fromhex("0c00 1920 81000000 02000000")
    assert DeviceStatus.decode(status.encode()) == status


WAYS: dict[str, Callable[[UsbPipes], UsbPipes]] = {
    "short reads": ShortReads,
    "header alone": HeaderAlone,
    "data and response together": Joining,
    "no empty packets": WithoutEmptyPackets,
    "after a stall": lambda good: Stalling(Stalling(good, Pipe.BULK_IN, range(0, 10000, 40)), Pipe.BULK_OUT, ()),
}


class TestOverMemory(TransportContract):
    @pytest.fixture(params=WAYS)
    def bench(self, request: pytest.FixtureRequest) -> Bench:
        responder = Echo()
        device = PtpUsbDevice(responder)
        bus = SimulatedBus(device)
        pipes = WAYS[request.param](open_usb(backend=bus))
        return Bench(UsbTransport(pipes, SimulatedClock()), responder, lambda: bus.unplug(device))


class Script:
    """Pipes that record writes and return scripted reads; b"" is an empty packet, an error is raised."""

    label = "the camera"
    packet_size = 512
    polling_s = 0.01

    def __init__(self, *reads: bytes | DeviceError, events: tuple[bytes, ...] = (), status: bytes = b"") -> None:
        self.reads = list(reads)
        self.events = list(events)
        self.status = status
        self.written: list[bytes | tuple[int, bytes] | Pipe] = []
        self.limits: list[int] = []

    def bulk_write(self, data: bytes, timeout: float) -> None:
        self.written.append(data)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        assert limit % 512 == 0
        assert limit <= 512 * 1024
        if not self.reads:
            raise LinkTimeout("silence")
        self.limits.append(limit)
        read = self.reads.pop(0)
        if isinstance(read, DeviceError):
            raise read
        assert len(read) <= limit
        return read

    def interrupt_read(self, timeout: float) -> bytes:
        return self.events.pop(0) if self.events else b""

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        self.written.append((request, data))

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        self.written.append((request, b""))
        return self.status

    def clear_halt(self, pipe: Pipe) -> None:
        self.written.append(pipe)

    def reset_port(self) -> None:
        self.written.append(b"port reset")

    def close(self) -> None:
        self.written.append(b"closed")


OK = bytes.fromhex("0c000000 0300 0120 05000000")
STALL = PipeStalled("on purpose")


def over(script: Script) -> UsbTransport:
    return UsbTransport(script, SimulatedClock())


def data(length: int, body: bytes) -> bytes:
    return length.to_bytes(4, "little") + bytes.fromhex("0200 1691 05000000") + body


def get(script: Script) -> bytes:
    return over(script).transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).data


def test_full_data_container_ends_with_an_empty_packet() -> None:
    script = Script(OK)
    over(script).transact(PtpRequest(0x9110, 5), send=bytes(500), timeout=PATIENCE_S)
    header = bytes.fromhex("00020000 0200 1091 05000000")
    assert script.written[1:] == [header + bytes(500), b""]
    script = Script(OK)
    over(script).transact(PtpRequest(0x9110, 5), send=bytes(501), timeout=PATIENCE_S)
    assert script.written[1:] == [b"\x01" + header[1:] + bytes(501)]


def test_reads_the_end_in_whole_packets() -> None:
    size = 12 + 1_000_000
    script = Script(
        data(size, bytes(500)),
        bytes(512 * 1024),
        bytes((size - 512 - 524288) // 512 * 512),
        bytes((size - 512 - 524288) % 512),
        OK,
    )
    pieces: list[bytes] = []
    over(script).transact(PtpRequest(0x9116, 5), receive=pieces.append, timeout=PATIENCE_S)
    assert sum(map(len, pieces)) == 1_000_000
    assert script.limits == [512, 524288, 475_136, 512, 512]


def test_repeats_a_read_after_one_stall() -> None:
    script = Script(STALL, OK)
    assert get(script) == b""
    assert script.written[1:] == [Pipe.BULK_IN]


def test_second_stall_is_an_error() -> None:
    script = Script(STALL, STALL, OK)
    with pytest.raises(ProtocolError):
        get(script)


@pytest.mark.parametrize("transfer", [0, 1, 2])
def test_repeats_a_write_after_one_stall(transfer: int) -> None:
    bench = Echo()
    pipes = Stalling(open_usb(backend=SimulatedBus(PtpUsbDevice(bench))), Pipe.BULK_OUT, {transfer})
    transport = UsbTransport(pipes, SimulatedClock())
    for _ in range(2):
        done = transport.transact(PtpRequest(TAKE, 1), send=payload(500), timeout=PATIENCE_S)
        assert done.response.parameters[0] == 500


def test_refuses_endless_empty_packets() -> None:
    with pytest.raises(ProtocolError):
        get(Script(*[b""] * 100))


@pytest.mark.parametrize(
    ("reads", "reason"),
    [
        ((data(100, bytes(88))[:4] + bytes.fromhex("0200 1691 06000000") + bytes(88), OK), "transaction 6"),
        ((data(13, b"a"), data(13, b"a"), OK), "second data phase"),
        ((bytes.fromhex("0c000000 0400 0120 05000000"),), "expected a response"),
        ((b"garbage that is no container at all",), "container"),
    ],
)
def test_refuses_protocol_violations(reads: tuple[bytes, ...], reason: str) -> None:
    with pytest.raises(ProtocolError, match=reason):
        get(Script(*reads))


def test_refuses_success_with_half_the_data() -> None:
    # A short packet cannot end a container of known length; the next bytes are its payload.
    with pytest.raises((ProtocolError, LinkTimeout)):
        get(Script(data(2000, bytes(100)), OK))


def test_joins_events_from_packets_of_eight_bytes() -> None:
    # As an EOS sends them: 16 bytes in two packets, 12 in two.
    script = Script(
        events=(
            bytes.fromhex("10000000 0400 01c1"),
            bytes.fromhex("ffffffff 2a000000"),
            bytes.fromhex("0c000000 0400 02c1"),
            bytes.fromhex("05000000"),
        )
    )
    assert over(script).events() == (PtpEvent(0xC101, 0xFFFFFFFF, (42,)), PtpEvent(0xC102, 5))


def test_reports_garbage_on_the_interrupt_pipe_once() -> None:
    script = Script(events=(b"\xff" * 8, b"\xff" * 8))
    transport = over(script)
    with pytest.raises(ProtocolError):
        transport.events()
    script.events[:] = [bytes.fromhex("0c000000 0400 01c1"), bytes.fromhex("05000000")]
    assert transport.events() == (PtpEvent(0xC101, 5),)


def test_reset_waits_until_the_device_is_ready() -> None:
    # 5.2.3 and 5.2.4: reset, then status until it is no longer busy.
    script = Script(status=bytes.fromhex("0400 0120"))
    transport = over(script)
    transport.reset()
    assert script.written == [(0x66, b""), (0x67, b""), Pipe.BULK_OUT, Pipe.BULK_IN]


def test_resets_the_port_of_a_busy_device() -> None:
    script = Script(status=bytes.fromhex("0400 1920"))
    clock = SimulatedClock()
    UsbTransport(script, clock).reset()
    assert clock.monotonic() == pytest.approx(2.0)
    assert b"port reset" in script.written


def test_cancels_if_the_caller_cannot_accept_data() -> None:
    def full(piece: bytes) -> None:
        raise KeyboardInterrupt

    script = Script(data(2000, bytes(500)), status=bytes.fromhex("0400 0120"))
    transport = over(script)
    with pytest.raises(KeyboardInterrupt):
        transport.transact(PtpRequest(0x9116, 5), receive=full, timeout=PATIENCE_S)
    # 5.2.1: the cancellation code, then the transaction.
    assert script.written[1:3] == [(0x64, bytes.fromhex("0140 05000000")), (0x67, b"")]
    script.reads.append(OK)
    assert transport.transact(PtpRequest(0x9116, 5), timeout=PATIENCE_S).response.ok


def camera() -> UsbPipes:
    return open_usb(backend=SimulatedBus(PtpUsbDevice(Echo())))


def _give_twice(transport: UsbTransport, pieces: list[bytes]) -> None:
    for number in range(2):
        transport.transact(PtpRequest(GIVE, number, (2000,)), receive=pieces.append, timeout=PATIENCE_S)


@given(after=st.integers(0, 3100))
def test_unplugged_at_any_byte_is_closed(after: int) -> None:
    pieces: list[bytes] = []
    transport = UsbTransport(CutOff(camera(), after), SimulatedClock())
    with pytest.raises(LinkClosed):
        _give_twice(transport, pieces)
    assert (payload(2000) * 2).startswith(b"".join(pieces))


@given(reads=st.integers(0, 3))
def test_missing_read_is_a_timeout(reads: int) -> None:
    transport = UsbTransport(Deaf(camera(), reads), SimulatedClock())
    with pytest.raises(LinkTimeout):
        transport.transact(PtpRequest(GIVE, 1, (3000,)), timeout=PATIENCE_S)


@given(at=st.integers(0, 11), value=st.integers(0, 255))
def test_refuses_a_response_with_a_changed_byte(at: int, value: int) -> None:
    def change(read: bytes) -> bytes:
        return read[:at] + bytes([value]) + read[at + 1 :]

    transport = UsbTransport(Garbling(camera(), change), SimulatedClock())
    try:
        done = transport.transact(PtpRequest(ECHO, 0x01020304), timeout=PATIENCE_S)
    except (ProtocolError, LinkTimeout):
        return
    # Only the code may differ, because any code is permitted.
    assert done.response.transaction == 0x01020304
    assert done.response.parameters == ()
    assert at in (6, 7) or done.response.ok


@pytest.mark.slow
def test_limits_the_events_of_one_call() -> None:
    transport = UsbTransport(camera(), SimulatedClock())
    transport.transact(PtpRequest(RAISE, 1, (5000,)), timeout=PATIENCE_S)
    assert len(transport.events()) == 4096
    assert len(transport.events()) == 904
