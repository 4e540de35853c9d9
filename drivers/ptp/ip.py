"""PTP over a network (PTP/IP): transactions on one TCP connection, events on a second one.

A header of two numbers of 32 bits, the length of the packet and its type, precedes the fields of the type. The length
includes the header. The initiator opens the command channel with `InitCommandRequest`. The reply `InitCommandAck` has a
connection number, with which the initiator opens the event channel (`InitEventRequest`, reply `InitEventAck`). To
refuse, the camera replies `InitFail`.
Transactions use the command channel. Events, `Ping` and `Pong` use the event channel. There is no thread: a call that
waits for a reply also answers the pings of the camera.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 (connections) and 2.3 (packets).
"""

from __future__ import annotations

import contextlib
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Final, TypeVar

from drivers.links.link import Link
from drivers.links.network import TcpLink
from drivers.ptp.protocol import (
    U32,
    CableTransport,
    Cursor,
    FieldKind,
    PtpDataset,
    PtpEvent,
    PtpRequest,
    PtpResponse,
    Reception,
    Rest,
    Transaction,
    encode_integer,
)
from foundation.clock import Clock
from foundation.errors import DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError

PORT = 15740  # TCP port of PTP-IP (CIPA DC-005-2005)
VERSION = 0x00010000  # PTP/IP 1.0
_HEADER: Final = struct.Struct("<II")  # Length and type of a packet (clause 2.3)
HEADER_LENGTH: Final = _HEADER.size  # Bytes
_DATA_HEADER: Final = struct.Struct("<III")  # Length, type and transaction of a data packet
MAX_PACKET = 4096  # Longest accepted packet without data, bytes; real packets hold at most a name of 40 characters
MAX_NAME_UNITS = 255  # Longest accepted name, UTF-16 units; the standard permits 39
UNKNOWN_TOTAL = 0xFFFFFFFFFFFFFFFF  # Total length in `StartData` if the length of the data is unknown
GUID_LENGTH = 16  # Bytes of a GUID


class PacketType(IntEnum):
    """Types of packets."""

    INIT_COMMAND_REQUEST = 1
    INIT_COMMAND_ACK = 2
    INIT_EVENT_REQUEST = 3
    INIT_EVENT_ACK = 4
    INIT_FAIL = 5
    OPERATION_REQUEST = 6
    OPERATION_RESPONSE = 7
    EVENT = 8
    START_DATA = 9
    DATA = 10
    CANCEL = 11
    END_DATA = 12
    PING = 13
    PONG = 14


class FailReason(IntEnum):
    """Reasons why a responder refuses a connection."""

    REJECTED = 1
    BUSY = 2
    UNSPECIFIED = 3


def _encode_guid(guid: bytes) -> bytes:
    if len(guid) != GUID_LENGTH:
        raise ValueError(f"a GUID of {len(guid)} bytes, expected {GUID_LENGTH}")
    return guid


def _read_name(cursor: Cursor, field: str) -> str:
    octets = bytearray()
    while (unit := cursor.take(2, f"{field}, or its closing NUL,")) != b"\0\0":
        octets += unit
        if len(octets) > 2 * MAX_NAME_UNITS:
            raise cursor.fault(field, f"at most {MAX_NAME_UNITS} UTF-16 units", "longer")
    return octets.decode("utf-16-le", "replace")


def _encode_name(name: str) -> bytes:
    octets = name.encode("utf-16-le")
    if "\0" in name or len(octets) > 2 * MAX_NAME_UNITS:
        raise ValueError(f"PTP/IP name {name[:40]!r}: expected at most {MAX_NAME_UNITS} UTF-16 units and no NUL")
    return octets + b"\0\0"


def _read_version(cursor: Cursor, field: str) -> int:
    # Some responders leave out the version.
    return cursor.u32(field) if cursor.remaining else VERSION


def _read_total(cursor: Cursor, field: str) -> int | None:
    total = cursor.u64(field)
    return None if total == UNKNOWN_TOTAL else total


def _read_sends_data(cursor: Cursor, _: str) -> bool:
    phase = cursor.u32("data phase")
    if phase > _DATA_OUT:
        raise cursor.fault("data phase", "1 (no data, or data to the initiator) or 2 (data to the responder)", phase)
    return phase == _DATA_OUT


_NO_DATA_OR_IN = 1  # Data phase of a request: no data, or data to the initiator
_DATA_OUT = 2  # Data phase of a request: data to the responder

# Types of fields in packets.
Guid = Annotated[bytes, FieldKind(lambda cursor, field: cursor.take(GUID_LENGTH, field), _encode_guid)]
Name = Annotated[str, FieldKind(_read_name, _encode_name)]
Version = Annotated[int, FieldKind(_read_version, lambda version: encode_integer(version, 4))]
Total = Annotated[
    int | None,
    FieldKind(_read_total, lambda total: encode_integer(UNKNOWN_TOTAL if total is None else total, 8)),
]
SendsData = Annotated[
    bool, FieldKind(_read_sends_data, lambda sends: encode_integer(_DATA_OUT if sends else _NO_DATA_OR_IN, 4))
]
Request = Annotated[PtpRequest, FieldKind(lambda cursor, _: PtpRequest.read(cursor), PtpRequest.encode)]


@dataclass(frozen=True)
class InitCommandRequest(PtpDataset):
    """Identifies the initiator by a name and a GUID of 16 bytes, which a paired camera checks."""

    guid: Guid
    name: Name
    version: Version = VERSION


@dataclass(frozen=True)
class InitCommandAck(PtpDataset):
    """The responder accepts, and sends the number of the connection and its own name."""

    connection: U32
    guid: Guid
    name: Name
    version: Version = VERSION


@dataclass(frozen=True)
class InitEventRequest(PtpDataset):
    """Opens the event channel of the connection with this number."""

    connection: U32


@dataclass(frozen=True)
class InitEventAck(PtpDataset):
    """The event channel is open."""


@dataclass(frozen=True)
class InitFail(PtpDataset):
    """The responder refuses the connection; see `FailReason`."""

    reason: U32


@dataclass(frozen=True)
class OperationRequest(PtpDataset):
    """A request, and whether the initiator sends data with it."""

    sends_data: SendsData
    request: Request


@dataclass(frozen=True)
class StartData(PtpDataset):
    """Start of a data phase of `total` bytes, or of unknown length (None)."""

    transaction: U32
    total: Total


@dataclass(frozen=True)
class Data(PtpDataset):
    """The next bytes of a data phase."""

    transaction: U32
    data: Rest


@dataclass(frozen=True)
class EndData(PtpDataset):
    """The last bytes of a data phase, which may be none or all of its bytes."""

    transaction: U32
    data: Rest = b""


@dataclass(frozen=True)
class Cancel(PtpDataset):
    """Cancels the data phase."""

    transaction: U32


@dataclass(frozen=True)
class Ping(PtpDataset):
    """Asks the other side to reply with `Pong`, to check the connection."""


@dataclass(frozen=True)
class Pong(PtpDataset):
    """Reply to `Ping`."""


Packet = PtpDataset  # One of `_PACKETS`

_PACKETS: dict[int, type[Packet]] = {
    PacketType.INIT_COMMAND_REQUEST: InitCommandRequest,
    PacketType.INIT_COMMAND_ACK: InitCommandAck,
    PacketType.INIT_EVENT_REQUEST: InitEventRequest,
    PacketType.INIT_EVENT_ACK: InitEventAck,
    PacketType.INIT_FAIL: InitFail,
    PacketType.OPERATION_REQUEST: OperationRequest,
    PacketType.OPERATION_RESPONSE: PtpResponse,
    PacketType.EVENT: PtpEvent,
    PacketType.START_DATA: StartData,
    PacketType.DATA: Data,
    PacketType.CANCEL: Cancel,
    PacketType.END_DATA: EndData,
    PacketType.PING: Ping,
    PacketType.PONG: Pong,
}
_PACKET_TYPES = {packet: packet_type for packet_type, packet in _PACKETS.items()}
_DATA_TYPES = (PacketType.DATA, PacketType.END_DATA)
_P = TypeVar("_P", bound=Packet)
_T = TypeVar("_T")


def encode(packet: Packet) -> bytes:
    """Return the bytes of a packet."""
    body = packet.encode()
    return encode_integer(HEADER_LENGTH + len(body), 4) + encode_integer(_PACKET_TYPES[type(packet)], 4) + body


def encode_data(transaction: int, data: bytes | memoryview, *, last: bool) -> bytes:
    """Return the bytes of a `Data` packet, or of an `EndData` packet if `last`; the data are copied once."""
    length = _DATA_HEADER.size + len(data)
    packet_type = PacketType.END_DATA if last else PacketType.DATA
    return b"".join((encode_integer(length, 4), encode_integer(packet_type, 4), encode_integer(transaction, 4), data))


class PacketCutter:
    """Cuts the bytes of one channel into packets; the bytes may arrive in pieces of any size.

    Data are returned as soon as they arrive, as `Data`. Only the last bytes of an END_DATA packet are `EndData`. After
    a `ProtocolError` the position in the stream is unknown, and every further call of `feed` raises it again.
    """

    def __init__(self) -> None:
        self._buffer: bytes = b""
        self._position: int = 0
        self._data_remaining: int = 0
        self._data_type: int = 0
        self._transaction: int = 0

    def feed(self, piece: bytes) -> list[Packet]:
        """Process the next bytes and return the packets that they complete."""
        packets: list[Packet] = []
        # Data are returned at once, so the buffer holds at most the start of a short packet.
        self._buffer = self._buffer + piece if self._buffer else piece
        self._position = 0
        try:
            while self._take_packet(packets):
                pass
        except ProtocolError:
            if not packets:
                raise
        finally:
            self._buffer = self._buffer[self._position :]
        return packets

    @property
    def _remaining(self) -> int:
        return len(self._buffer) - self._position

    def _take_packet(self, packets: list[Packet]) -> bool:
        """Move one packet, or a part of its data, from the buffer to `packets`; return whether to continue."""
        if self._data_type:
            return self._take_data(packets)
        if self._remaining < HEADER_LENGTH:
            return False
        length, packet_type = _HEADER.unpack_from(self._buffer, self._position)
        if packet_type not in _PACKETS and self._buffer[self._position : self._position + 5].upper() in _HTTP_STARTS:
            raise ProtocolError(
                "an HTTP server answers, expected a camera; set the camera's address, and "
                f"port {PORT} unless its menu shows another"
            )
        _check_length(packet_type, length)
        if packet_type in _DATA_TYPES:
            if self._remaining < _DATA_HEADER.size:
                return False
            _, self._data_type, self._transaction = _DATA_HEADER.unpack_from(self._buffer, self._position)
            self._data_remaining = length - _DATA_HEADER.size
            self._position += _DATA_HEADER.size
            return True
        if self._remaining < length:
            return False
        packets.append(_decode(packet_type, self._buffer[self._position : self._position + length]))
        self._position += length
        return self._remaining > 0

    def _take_data(self, packets: list[Packet]) -> bool:
        data = self._buffer[self._position : self._position + self._data_remaining]
        self._position += len(data)
        self._data_remaining -= len(data)
        if not self._data_remaining and self._data_type == PacketType.END_DATA:
            packets.append(EndData(self._transaction, data))
        elif data:
            packets.append(Data(self._transaction, data))
        if not self._data_remaining:
            self._data_type = 0
        return self._remaining > 0


# First bytes that HTTP servers send. Read as a packet, they would mean a length of gigabytes.
_HTTP_STARTS: Final = (b"HTTP/", b"<!DOC", b"<HTML")


def _decode(packet_type: int, data: bytes) -> Packet:
    cursor = Cursor(data, "a PTP/IP packet")
    cursor.position = HEADER_LENGTH
    packet = _PACKETS[packet_type].read(cursor)
    if cursor.remaining:
        raise cursor.fault("the end", "no more bytes", f"followed by {cursor.remaining} bytes", cursor.position)
    return packet


def _check_length(packet_type: int, length: int) -> None:
    if packet_type not in _PACKETS:
        raise _stream_error(f"a packet of type {packet_type} and {length} bytes, expected types 1 to 14")
    shortest, longest = (_DATA_HEADER.size, 0xFFFFFFFF) if packet_type in _DATA_TYPES else (HEADER_LENGTH, MAX_PACKET)
    if not shortest <= length <= longest:
        name = PacketType(packet_type).name
        raise _stream_error(f"a {name} packet of {length} bytes, expected {shortest} to {longest}")


def _stream_error(fault: str) -> ProtocolError:
    return ProtocolError(f"the PTP/IP stream has {fault}; check that a camera answers at this port, and reconnect")


READ: Final = 128 * 1024  # Most bytes of one read; larger buffers would need a memory mapping of their own


class Channel:
    """Sends and receives packets on one of the two connections."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._cutter = PacketCutter()
        self._packets: deque[Packet] = deque()

    def send(self, packet: Packet, timeout: float) -> None:
        """Send a packet."""
        self._link.write(encode(packet), timeout)

    def send_data(self, transaction: int, data: bytes, piece: int, timeout: float) -> Iterator[None]:
        """Announce a data phase, and send `piece` bytes at each step of the iteration; the last packet is `EndData`."""
        self.send(StartData(transaction, len(data)), timeout)
        view = memoryview(data)
        last_start = max(0, len(data) - 1) // piece * piece
        for start in range(0, last_start + 1, piece):
            yield
            self._link.write(encode_data(transaction, view[start : start + piece], last=start == last_start), timeout)

    def next(self, timeout: float) -> Packet:
        """Return the next packet; wait at most `timeout` seconds for each read."""
        while not self._packets:
            piece = self._link.read(READ, timeout)
            if not piece:
                raise LinkTimeout(f"no packet arrived within {timeout:g} s; check that the camera is on")
            self._packets.extend(self._cutter.feed(piece))
        return self._packets.popleft()

    def close(self) -> None:
        """Disconnect; a second call does nothing."""
        self._link.close()


MAX_EVENTS: Final = 4096  # Most events that are stored if the caller does not read them

# Timeout of each connection and greeting, seconds; a camera wakes its network in a few seconds.
CONNECT_S: Final = 10.0

# Time for which attempts to connect are repeated, seconds. Some devices refuse the event channel for about 0.1 s.
EVENT_CHANNEL_S: Final = 2.0

RETRY_S: Final = 0.1  # Pause between two attempts, seconds

_EVENT_READ_INTERVAL_S: Final = 1.0  # Interval at which the event channel is read during a wait, seconds

# Most packets that one call reads from the event channel, because a faulty device may never stop sending.
_MAX_PACKETS_PER_READ: Final = 1 << 17

# Bytes of data in a packet to the device, as in libgphoto2.
DATA_PIECE: Final = 64 * 1024

_CANCEL_S: Final = 2.0  # Timeout for the end of a cancelled transaction, seconds


class IpTransport(CableTransport):
    """A `drivers.ptp.protocol.Transport` over a network.

    - `open_command`, `open_event`: open the two connections, also after `reset`. If `open_event` raises `LinkClosed`,
      it is repeated for `EVENT_CHANNEL_S`.
    - `guid`: 16 bytes by which a paired camera recognises this computer.
    - `name`: name of this computer on the camera's display.
    """

    def __init__(
        self,
        open_command: Callable[[], Link],
        open_event: Callable[[], Link],
        *,
        guid: bytes,
        name: str,
        clock: Clock,
        label: str = "the camera",
    ) -> None:
        super().__init__()
        self._open_command = open_command
        self._open_event = open_event
        self._initiator = InitCommandRequest(guid, name)
        self._clock = clock
        self._address = label
        self._events: deque[PtpEvent] = deque(maxlen=MAX_EVENTS)
        self._command, self._event, self._name = self._connect(DeviceRefused)

    @classmethod
    def connect(
        cls, host: str, port: int = PORT, *, event_port: int | None = None, guid: bytes, name: str, clock: Clock
    ) -> IpTransport:
        """Connect to the camera at an address; `event_port` None means the same port for the event channel."""
        second_port = port if event_port is None else event_port
        return cls(
            lambda: TcpLink.connect(host, port, CONNECT_S),
            lambda: TcpLink.connect(host, second_port, CONNECT_S),
            guid=guid,
            name=name,
            clock=clock,
            label=f"the camera at {host}:{port}",
        )

    @property
    def label(self) -> str:
        """Name reported by the device, and its address."""
        return f"{self._name} ({self._address})" if self._name else self._address

    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request with its data phase, and return the reply of the device."""
        request = reception.request
        self._command.send(OperationRequest(send is not None, request), timeout)
        if send is not None:
            for _ in self._command.send_data(request.transaction, send, DATA_PIECE, timeout):
                pass
        while True:
            match self._next_packet(timeout):
                case StartData(transaction, total):
                    reception.start(transaction, total)
                case Data(_, data) | EndData(_, data):
                    reception.take(data)
                case PtpResponse() as response:
                    return reception.end(response)
                case PtpEvent() as event:
                    self._events.append(event)
                case Ping():
                    self._command.send(Pong(), timeout)
                case Pong():
                    pass
                case packet:
                    raise ProtocolError(f"{self.label} sent {type(packet).__name__} instead of a response; reset it")

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that were received since the last call, and answer pings, without waiting."""
        self._read_event_channel()
        events = tuple(self._events)
        self._events.clear()
        return events

    def reset(self) -> None:
        """Disconnect and connect again; an open session ends."""
        self.close()
        self._events.clear()
        self._command, self._event, self._name = self._connect(DeviceRefused, LinkClosed)
        self.closed, self.between_transactions = False, True

    def close(self) -> None:
        """Disconnect both channels; a second call does nothing."""
        self.closed = True
        self._event.close()
        self._command.close()

    def cancel(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take; return whether its response arrived."""
        deadline = self._clock.monotonic() + _CANCEL_S
        with contextlib.suppress(LinkError, ProtocolError):
            self._event.send(Cancel(transaction), _CANCEL_S)
            while self._clock.monotonic() < deadline:
                packet = self._next_packet(_CANCEL_S)
                if isinstance(packet, PtpResponse) and packet.transaction == transaction:
                    return True
        return False

    def _next_packet(self, timeout: float) -> Packet:
        remaining = timeout
        while True:
            wait = min(remaining, _EVENT_READ_INTERVAL_S)
            try:
                return self._command.next(wait)
            except LinkTimeout as error:
                remaining -= wait
                if remaining <= 0:
                    raise LinkTimeout(
                        f"{self.label} has not answered within {timeout:g} s; check its network, or restart it"
                    ) from error
                self._read_event_channel()

    def _read_event_channel(self) -> None:
        """Read the packets that have arrived on the event channel, and answer pings, without waiting."""
        with contextlib.suppress(LinkTimeout):
            for _ in range(_MAX_PACKETS_PER_READ):
                match self._event.next(0.0):
                    case PtpEvent() as event:
                        self._events.append(event)
                    case Ping():
                        self._event.send(Pong(), _EVENT_READ_INTERVAL_S)

    def _connect(self, *transient: type[Exception]) -> tuple[Channel, Channel, str]:
        # A camera refuses new connections until it has detected the end of the previous one.
        return self._retry(self._greet, *transient)

    def _greet(self) -> tuple[Channel, Channel, str]:
        """Open both channels with their first messages (clause 2.2); return them and the name of the device."""
        with contextlib.ExitStack() as opened:
            command = opened.enter_context(contextlib.closing(Channel(self._open_command())))
            command.send(self._initiator, CONNECT_S)
            accepted = self._receive_ack(command, InitCommandAck)
            event = opened.enter_context(contextlib.closing(Channel(self._retry(self._open_event, LinkClosed))))
            event.send(InitEventRequest(accepted.connection), CONNECT_S)
            self._receive_ack(event, InitEventAck)
            opened.pop_all()
        return command, event, accepted.name.strip()

    def _retry(self, attempt: Callable[[], _T], *transient: type[Exception]) -> _T:
        """Call `attempt`; repeat it for `EVENT_CHANNEL_S` as long as it raises one of `transient`."""
        deadline = self._clock.monotonic() + EVENT_CHANNEL_S
        while True:
            try:
                return attempt()
            except transient:
                if self._clock.monotonic() >= deadline:
                    raise
            self._clock.sleep(RETRY_S)

    def _receive_ack(self, channel: Channel, expected: type[_P]) -> _P:
        try:
            answer = channel.next(CONNECT_S)
        except ProtocolError as error:
            raise ProtocolError(
                f"{self._address} sent no valid PTP/IP reply: {error}; check that a camera answers at this port"
            ) from error
        if isinstance(answer, expected):
            return answer
        if not isinstance(answer, InitFail):
            raise ProtocolError(
                f"{self._address} answers a greeting with {type(answer).__name__}, expected {expected.__name__}; "
                f"check that a camera answers at this port"
            )
        reason = _REFUSALS.get(answer.reason, f"reports reason {answer.reason}; switch it off and on")
        raise DeviceRefused(f"{self._address} refuses the connection: it {reason}")


# Message about each reason of a refusal, with a remedy.
_REFUSALS: dict[int, str] = {
    FailReason.REJECTED: "is not paired with this computer; pair it again in the camera's wireless menu",
    FailReason.BUSY: "is in use by another program or computer; disconnect that one, or switch the camera off and on",
}
