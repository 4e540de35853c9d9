"""PTP over a network: transactions on one TCP connection, events on a second one.

A packet is its length (32 bits, these included), its type (32), then the fields of that type. The initiator opens the
command channel and sends `InitCommandRequest`, the responder answers `InitCommandAck` with a number; the initiator
opens the event channel and sends that number in `InitEventRequest`, the responder answers `InitEventAck`. `InitFail`
may stand for either answer. Transactions run on the command channel; events, `Ping` and `Pong` on the other.

Rules that hold inside:

- `PacketCutter` takes a stream in any pieces. Data packets may be of any length, whatever comes of them is handed on
  as `Data` at once and only their last bytes as `EndData`, which means the same; every other packet is at most
  `MAX_PACKET` bytes. Whatever arrives, its only error is `ProtocolError`; after it the stream has lost its place and
  every further `feed` raises too.
- Whoever waits for the device also answers its pings, at least once a second; nothing here has a thread.
- Events are kept until asked for, the newest `MAX_EVENTS` of them.
- A transaction that is called off is awaited to its response.

Source: CIPA DC-005-2005, PTP-IP, clauses 2.2 (connections) and 2.3 (packets).
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Self, cast

from drivers.links.link import Link
from drivers.links.network import TcpLink
from drivers.ptp.datasets import U32, Cursor, PtpDataset, encode_integer
from drivers.ptp.session import (
    MAX_PARAMETERS,
    CableTransport,
    PtpEvent,
    PtpRequest,
    PtpResponse,
    Reception,
    Transaction,
)
from foundation.clock import Clock
from foundation.errors import DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError

PORT = 15740
"""TCP port of PTP-IP (CIPA DC-005-2005)."""
VERSION = 0x00010000
"""PTP/IP 1.0."""
HEADER_LENGTH = 8
"""Bytes of length and type."""
MAX_PACKET = 4096
"""Bytes of the longest packet that is no data; the longest real one carries a name of 40 characters."""
MAX_NAME_UNITS = 255
"""UTF-16 units of the longest name; the standard allows 39."""
UNKNOWN_TOTAL = 0xFFFFFFFFFFFFFFFF
"""Total length of a data phase whose sender does not know it yet."""
GUID_LENGTH = 16
"""Bytes of a GUID."""


class PacketType(IntEnum):
    """What a packet is."""

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
    """Why a responder refuses a connection."""

    REJECTED = 1
    BUSY = 2
    UNSPECIFIED = 3


@dataclass(frozen=True)
class InitCommandRequest(PtpDataset):
    """The initiator names itself: a GUID of 16 bytes, which a camera may have been paired with, and a name."""

    guid: bytes
    name: str
    version: int = VERSION

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Return the initiator at a cursor."""
        return cls(*_read_names(cursor))

    def encode(self) -> bytes:
        """Return the initiator as bytes."""
        return _encode_names(self.guid, self.name, self.version)


@dataclass(frozen=True)
class InitCommandAck(PtpDataset):
    """The responder accepts, numbers the connection and names itself."""

    connection: int
    guid: bytes
    name: str
    version: int = VERSION

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Return the responder at a cursor."""
        return cls(cursor.u32("connection number"), *_read_names(cursor))

    def encode(self) -> bytes:
        """Return the responder as bytes."""
        return encode_integer(self.connection, 4) + _encode_names(self.guid, self.name, self.version)


@dataclass(frozen=True)
class InitEventRequest(PtpDataset):
    """The initiator names the connection that the event channel belongs to."""

    connection: U32


@dataclass(frozen=True)
class InitEventAck(PtpDataset):
    """The event channel stands."""


@dataclass(frozen=True)
class InitFail(PtpDataset):
    """The responder refuses; see `FailReason`."""

    reason: U32


@dataclass(frozen=True)
class OperationRequest(PtpDataset):
    """A request, and whether the initiator will send the data phase."""

    request: PtpRequest
    sends_data: bool = False

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Return the request at a cursor."""
        phase = cursor.u32("data phase")
        if phase > _DATA_OUT:
            raise cursor.fault("data phase", "1 none or in, 2 out", phase)
        return cls(PtpRequest(*_read_message(cursor)), phase == _DATA_OUT)

    def encode(self) -> bytes:
        """Return the request as bytes."""
        return encode_integer(_DATA_OUT if self.sends_data else _NO_DATA_OR_IN, 4) + _message(self.request)


@dataclass(frozen=True)
class StartData(PtpDataset):
    """A data phase begins; `total` counts its bytes, None where the sender does not know."""

    transaction: int
    total: int | None

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Return the beginning at a cursor."""
        transaction, total = cursor.u32("transaction"), cursor.u64("total")
        return cls(transaction, None if total == UNKNOWN_TOTAL else total)

    def encode(self) -> bytes:
        """Return the beginning as bytes."""
        return encode_integer(self.transaction, 4) + encode_integer(
            UNKNOWN_TOTAL if self.total is None else self.total, 8
        )


@dataclass(frozen=True)
class Data:
    """The next bytes of a data phase."""

    transaction: int
    data: bytes


@dataclass(frozen=True)
class EndData:
    """The last bytes of a data phase, all or none of it."""

    transaction: int
    data: bytes = b""


@dataclass(frozen=True)
class Cancel(PtpDataset):
    """The data phase is called off."""

    transaction: U32


@dataclass(frozen=True)
class Ping(PtpDataset):
    """Asks whether the other side is there."""


@dataclass(frozen=True)
class Pong(PtpDataset):
    """Answers `Ping`."""


Packet = (
    InitCommandRequest
    | InitCommandAck
    | InitEventRequest
    | InitEventAck
    | InitFail
    | OperationRequest
    | PtpResponse
    | PtpEvent
    | StartData
    | Data
    | EndData
    | Cancel
    | Ping
    | Pong
)

_DATA_TYPES = (PacketType.DATA, PacketType.END_DATA)
_NO_DATA_OR_IN = 1
"""Data phase information of an operation without data, or whose data come to the initiator."""
_DATA_OUT = 2
"""Data phase information of an operation whose data go to the responder."""


def encode(packet: Packet) -> bytes:
    """Return a packet's bytes."""
    match packet:
        case PtpResponse():
            kind, body = PacketType.OPERATION_RESPONSE, _message(packet)
        case PtpEvent():
            kind, body = PacketType.EVENT, _message(packet)
        case Data(transaction, data) | EndData(transaction, data):
            return encode_data(transaction, data, last=isinstance(packet, EndData))
        case _:
            kind, body = _KINDS[type(packet)], packet.encode()
    return encode_integer(HEADER_LENGTH + len(body), 4) + encode_integer(kind, 4) + body


def encode_data(transaction: int, data: bytes | memoryview, *, last: bool) -> bytes:
    """Return the packet `Data`, or `EndData` for the last one, around a part of something large: it is copied once."""
    length = HEADER_LENGTH + 4 + len(data)
    kind = PacketType.END_DATA if last else PacketType.DATA
    return b"".join((encode_integer(length, 4), encode_integer(kind, 4), encode_integer(transaction, 4), data))


def decode(data: bytes) -> Packet:
    """Return the packet that `data` is, from its first byte to its last."""
    cursor = Cursor(data, "a PTP/IP packet")
    length, kind = cursor.u32("length"), cursor.u32("type")
    if length != len(data):
        raise cursor.fault("length", f"{len(data)}, the bytes there are", length, at=0)
    _checked(kind, length)
    packet = _read(kind, cursor)
    if cursor.left:
        raise cursor.fault("the end", "no more bytes", f"followed by {cursor.left} bytes", at=cursor.at)
    return packet


class PacketCutter:
    """Cuts a channel's stream into packets, however it was split in transit. One for each channel."""

    def __init__(self) -> None:
        self._waiting: bytes = b""
        self._at: int = 0
        self._data_left: int = 0
        self._data_kind: int = 0
        self._transaction: int = 0

    @property
    def at_boundary(self) -> bool:
        """Whether the stream stands between two packets."""
        return not self._waiting and not self._data_kind

    def feed(self, piece: bytes) -> list[Packet]:
        """Take the next bytes and return what they complete."""
        packets: list[Packet] = []
        # Data are handed on at once, so that what waits is never more than the beginning of a short packet.
        self._waiting = self._waiting + piece if self._waiting else piece
        self._at = 0
        try:
            while self._next(packets):
                pass
        except ProtocolError:
            if not packets:
                raise
        finally:
            self._waiting = self._waiting[self._at :]
        return packets

    @property
    def _left(self) -> int:
        return len(self._waiting) - self._at

    def _next(self, packets: list[Packet]) -> bool:
        """Move one packet, or a piece of one, from what waits to `packets`; return whether more may follow."""
        if self._data_kind:
            return self._next_data(packets)
        if self._left < HEADER_LENGTH:
            return False
        cursor = Cursor(self._waiting[self._at : self._at + HEADER_LENGTH + 4], "a PTP/IP packet")
        length, kind = cursor.u32("length"), cursor.u32("type")
        _checked(kind, length)
        if kind in _DATA_TYPES:
            if cursor.left < 4:
                return False
            self._transaction = cursor.u32("transaction")
            self._data_kind = kind
            self._data_left = length - cursor.at
            self._at += cursor.at
            return True
        if self._left < length:
            return False
        packet = decode(self._waiting[self._at : self._at + length])
        self._at += length
        packets.append(packet)
        return self._left > 0

    def _next_data(self, packets: list[Packet]) -> bool:
        data = self._waiting[self._at : self._at + self._data_left]
        self._at += len(data)
        self._data_left -= len(data)
        if not self._data_left and self._data_kind == PacketType.END_DATA:
            packets.append(EndData(self._transaction, data))
        elif data:
            packets.append(Data(self._transaction, data))
        if not self._data_left:
            self._data_kind = 0
        return self._left > 0


def _checked(kind: int, length: int) -> None:
    """Raise ProtocolError unless a packet of this type can be of this length."""
    if kind not in _SHORTEST:
        raise _unusable(f"a packet of type {kind} and {length} bytes; a type of 1 to 14 was expected")
    least = _SHORTEST[kind]
    most = 0xFFFFFFFF if kind in _DATA_TYPES else MAX_PACKET
    if not least <= length <= most:
        raise _unusable(f"a {PacketType(kind).name} packet of {length} bytes; {least} to {most} were expected")


def _unusable(what: str) -> ProtocolError:
    return ProtocolError(f"the PTP/IP connection gives {what}; check that a camera answers at this port, and reconnect")


def _encode_names(guid: bytes, name: str, version: int) -> bytes:
    octets = name.encode("utf-16-le")
    if len(guid) != GUID_LENGTH:
        raise ValueError(f"a GUID of {len(guid)} bytes; {GUID_LENGTH} are right")
    if "\0" in name or len(octets) > 2 * MAX_NAME_UNITS:
        raise ValueError(f"{name[:40]!r} is no PTP/IP name; at most {MAX_NAME_UNITS} UTF-16 units, no NUL")
    return guid + octets + b"\0\0" + encode_integer(version, 4)


def _read_names(cursor: Cursor) -> tuple[bytes, str, int]:
    guid = cursor.take(GUID_LENGTH, "GUID")
    octets = bytearray()
    while (unit := cursor.take(2, "name, or its closing NUL,")) != b"\0\0":
        octets += unit
        if len(octets) > 2 * MAX_NAME_UNITS:
            raise cursor.fault("name", f"at most {MAX_NAME_UNITS} UTF-16 units", "longer")
    # Some responders end with the name.
    version = cursor.u32("version") if cursor.left else VERSION
    return guid, octets.decode("utf-16-le", "replace"), version


def _message(message: PtpRequest | PtpResponse | PtpEvent) -> bytes:
    if len(message.parameters) > MAX_PARAMETERS:
        raise ValueError(f"{message} has {len(message.parameters)} parameters; at most {MAX_PARAMETERS} are possible")
    return (
        encode_integer(message.code, 2)
        + encode_integer(message.transaction, 4)
        + b"".join(encode_integer(parameter, 4) for parameter in message.parameters)
    )


def _read_message(cursor: Cursor) -> tuple[int, int, tuple[int, ...]]:
    code, transaction = cursor.u16("code"), cursor.u32("transaction")
    count, odd = divmod(cursor.left, 4)
    if odd or count > MAX_PARAMETERS:
        raise cursor.fault(
            "the list of parameters", f"0 to {MAX_PARAMETERS} of 4 bytes", f"{cursor.left} bytes", at=cursor.at
        )
    return code, transaction, cursor.integers(count, 4, "parameters")


_PACKETS: dict[int, type[PtpDataset]] = {
    PacketType.INIT_COMMAND_REQUEST: InitCommandRequest,
    PacketType.INIT_COMMAND_ACK: InitCommandAck,
    PacketType.INIT_EVENT_REQUEST: InitEventRequest,
    PacketType.INIT_EVENT_ACK: InitEventAck,
    PacketType.INIT_FAIL: InitFail,
    PacketType.OPERATION_REQUEST: OperationRequest,
    PacketType.START_DATA: StartData,
    PacketType.CANCEL: Cancel,
    PacketType.PING: Ping,
    PacketType.PONG: Pong,
}
_KINDS = {packet: kind for kind, packet in _PACKETS.items()}


def _read(kind: int, cursor: Cursor) -> Packet:
    match kind:
        case PacketType.OPERATION_RESPONSE:
            return PtpResponse(*_read_message(cursor))
        case PacketType.EVENT:
            return PtpEvent(*_read_message(cursor))
        case PacketType.DATA:
            return Data(cursor.u32("transaction"), cursor.rest())
        case PacketType.END_DATA:
            return EndData(cursor.u32("transaction"), cursor.rest())
        case _:
            return cast("Packet", _PACKETS[kind].read(cursor))


_SHORTEST: dict[int, int] = {
    PacketType.INIT_COMMAND_REQUEST: HEADER_LENGTH + GUID_LENGTH + 2,
    PacketType.INIT_COMMAND_ACK: HEADER_LENGTH + 4 + GUID_LENGTH + 2,
    PacketType.INIT_EVENT_REQUEST: HEADER_LENGTH + 4,
    PacketType.INIT_EVENT_ACK: HEADER_LENGTH,
    PacketType.INIT_FAIL: HEADER_LENGTH + 4,
    PacketType.OPERATION_REQUEST: HEADER_LENGTH + 10,
    PacketType.OPERATION_RESPONSE: HEADER_LENGTH + 6,
    PacketType.EVENT: HEADER_LENGTH + 6,
    PacketType.START_DATA: HEADER_LENGTH + 12,
    PacketType.DATA: HEADER_LENGTH + 4,
    PacketType.CANCEL: HEADER_LENGTH + 4,
    PacketType.END_DATA: HEADER_LENGTH + 4,
    PacketType.PING: HEADER_LENGTH,
    PacketType.PONG: HEADER_LENGTH,
}


MAX_EVENTS: Final = 4096
"""Events kept for a caller who never asks for them."""

CONNECT_S: Final = 10.0
"""Wait for each connection and each greeting: a camera wakes its network up in a few seconds."""

EVENT_CHANNEL_S: Final = 2.0
"""How long the second connection is tried: devices refuse it for about 0.1 s after they acknowledged the first."""

RETRY_S: Final = 0.1
"""Pause between two such tries."""

_READ: Final = 128 * 1024
"""Bytes asked of a link at once: two pieces of data as bodies send them."""

_PING_EVERY_S: Final = 1.0
"""Longest wait on the command connection without a look at the event connection."""

_EVENT_READS: Final = 64
"""Reads of the event connection at one look: a device that never stops talking must not keep us there."""


class IpConnection:
    """Both connections to one device, which has accepted this initiator.

    `name`: what the device calls itself; may be empty.
    """

    def __init__(
        self,
        command: tuple[Link, PacketCutter],
        event: tuple[Link, PacketCutter],
        name: str,
        events: Iterable[PtpEvent],
    ) -> None:
        self._command, self._command_cutter = command
        self._event, self._event_cutter = event
        self.name = name
        self._packets: deque[Packet] = deque()
        self._events = deque(events, maxlen=MAX_EVENTS)

    def write_command(self, data: bytes, timeout: float) -> None:
        """Send bytes on the command connection."""
        self._command.write(data, timeout)

    def write_event(self, data: bytes, timeout: float) -> None:
        """Send bytes on the event connection."""
        self._event.write(data, timeout)

    def next_command(self, timeout: float) -> Packet:
        """Return the next packet on the command connection, waiting `timeout` seconds for each of its bytes."""
        left = timeout
        while not self._packets:
            wait = min(left, _PING_EVERY_S)
            try:
                piece = self._command.read(_READ, wait)
            except LinkTimeout:
                left -= wait
                if left <= 0:
                    raise
                self.attend()
                continue
            left = timeout
            self._packets.extend(self._command_cutter.feed(piece))
        return self._packets.popleft()

    def attend(self) -> None:
        """Take what the event connection holds, and answer pings; never waits."""
        for _ in range(_EVENT_READS):
            try:
                piece = self._event.read(_READ, 0.0)
            except LinkTimeout:
                return
            for packet in self._event_cutter.feed(piece):
                match packet:
                    case PtpEvent():
                        self._events.append(packet)
                    case Ping():
                        self._event.write(encode(Pong()), _PING_EVERY_S)
                    case _:
                        pass

    def keep_event(self, event: PtpEvent) -> None:
        """Keep an event that came on the command connection."""
        self._events.append(event)

    def take_events(self) -> tuple[PtpEvent, ...]:
        """Return the events kept since the last call."""
        events = tuple(self._events)
        self._events.clear()
        return events

    def close(self) -> None:
        """Hang up both connections; a second call does nothing."""
        self._event.close()
        self._command.close()


def greet(
    open_command: Callable[[], Link],
    open_event: Callable[[], Link],
    initiator: InitCommandRequest,
    clock: Clock,
    place: str,
) -> IpConnection:
    """Open both connections and introduce the initiator on them (clause 2.2).

    `open_command`, `open_event`: open the two connections; the second is tried for `EVENT_CHANNEL_S`.
    """
    hello = encode(initiator)
    command, cutter = open_command(), PacketCutter()
    try:
        command.write(hello, CONNECT_S)
        acknowledgement, events = _greeting(command, cutter, place)
        if not isinstance(acknowledgement, InitCommandAck):
            raise _refusal(acknowledgement, place)
        event, event_cutter = _dial(open_event, clock), PacketCutter()
    except BaseException:
        command.close()
        raise
    try:
        event.write(encode(InitEventRequest(acknowledgement.connection)), CONNECT_S)
        answer, more = _greeting(event, event_cutter, place)
        if not isinstance(answer, InitEventAck):
            raise _refusal(answer, place)
    except BaseException:
        event.close()
        command.close()
        raise
    return IpConnection((command, cutter), (event, event_cutter), acknowledgement.name.strip(), [*events, *more])


def _dial(open_event: Callable[[], Link], clock: Clock) -> Link:
    """Open the second connection."""
    deadline = clock.monotonic() + EVENT_CHANNEL_S
    while True:
        try:
            return open_event()
        except LinkClosed:
            if clock.monotonic() >= deadline:
                raise
            clock.sleep(RETRY_S)


def _greeting(link: Link, cutter: PacketCutter, place: str) -> tuple[Packet, list[PtpEvent]]:
    """Return the first packet on a new connection, and the events behind it; nothing else comes unasked."""
    while True:
        try:
            packets = cutter.feed(link.read(_READ, CONNECT_S))
        except ProtocolError as error:
            raise ProtocolError(f"what answers in place of {place} speaks no PTP/IP: {error}") from error
        if packets:
            return packets[0], [packet for packet in packets[1:] if isinstance(packet, PtpEvent)]


def _refusal(answer: Packet, place: str) -> DeviceRefused | ProtocolError:
    if not isinstance(answer, InitFail):
        return ProtocolError(
            f"{place} answers a greeting with {type(answer).__name__}; an acknowledgement was expected: "
            f"check that a camera listens at this port"
        )
    match answer.reason:
        case FailReason.REJECTED:
            why = "does not know this computer: pair the two anew in the camera's wireless menu"
        case FailReason.BUSY:
            why = "is in use by another program or computer: disconnect that one, or switch the camera off and on"
        case _:
            why = f"gives reason {answer.reason}: switch it off and on"
    return DeviceRefused(f"{place} refuses the connection; it {why}")


DATA_PIECE: Final = 64 * 1024
"""Bytes of data in a packet to the device; what libgphoto2 sends, and bodies are used to it."""

_CALL_OFF_S: Final = 2.0
"""Wait for the end of a transaction that was cancelled."""


class IpTransport(CableTransport):
    """A `drivers.ptp.session.Transport` over two links.

    `open_command`, `open_event`: open the two connections; called again by `reset`. The second may raise `LinkClosed`
    for as long as the device has not opened its port: it is tried for 2 s. `guid`: 16 bytes by which a camera knows a
    computer that it was paired with.
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
        self._place = label
        self._connection = self._connect(DeviceRefused)

    @classmethod
    def connect(
        cls, host: str, port: int = PORT, *, event_port: int | None = None, guid: bytes, name: str, clock: Clock
    ) -> IpTransport:
        """Connect to the camera at an address; `event_port` only where it is not the same."""
        second = port if event_port is None else event_port
        return cls(
            lambda: TcpLink.connect(host, port, CONNECT_S),
            lambda: TcpLink.connect(host, second, CONNECT_S),
            guid=guid,
            name=name,
            clock=clock,
            label=f"the camera at {host}:{port}",
        )

    @property
    def label(self) -> str:
        """The name that the device gave, and its address."""
        name = self._connection.name
        return f"{name} ({self._place})" if name else self._place

    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request and the data phase to the device, and return what the device answers."""
        self._send(reception.request, send, timeout)
        return self._receive(reception, timeout)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call, and answer pings; never waits."""
        self._connection.attend()
        return self._connection.take_events()

    def reset(self) -> None:
        """Hang up and connect anew; the session that was open is over."""
        self.close()
        self._connection = self._connect(DeviceRefused, LinkClosed)
        self.closed, self.between_transactions = False, True

    def close(self) -> None:
        """Hang up both connections; a second call does nothing."""
        self.closed = True
        self._connection.close()

    def _connect(self, *passing: type[Exception]) -> IpConnection:
        # A device needs a moment to see that a connection is gone, ours or that of the command that ran before; until
        # then it calls itself busy.
        deadline = self._clock.monotonic() + EVENT_CHANNEL_S
        while True:
            try:
                return greet(self._open_command, self._open_event, self._initiator, self._clock, self._place)
            except passing:
                if self._clock.monotonic() >= deadline:
                    raise
                self._clock.sleep(RETRY_S)

    def _send(self, request: PtpRequest, send: bytes | None, timeout: float) -> None:
        self._connection.write_command(encode(OperationRequest(request, send is not None)), timeout)
        if send is None:
            return
        transaction = request.transaction
        self._connection.write_command(encode(StartData(transaction, len(send))), timeout)
        view = memoryview(send)
        last = max(0, len(send) - 1) // DATA_PIECE * DATA_PIECE
        for at in range(0, last, DATA_PIECE):
            self._connection.write_command(encode_data(transaction, view[at : at + DATA_PIECE], last=False), timeout)
        self._connection.write_command(encode_data(transaction, view[last:], last=True), timeout)

    def _receive(self, reception: Reception, timeout: float) -> Transaction:
        while True:
            match self._connection.next_command(timeout):
                case StartData(transaction, total):
                    reception.start(transaction, total)
                case Data(_, data) | EndData(_, data):
                    reception.take(data)
                case PtpResponse() as response:
                    return reception.end(response)
                case PtpEvent() as event:
                    self._connection.keep_event(event)
                case Ping():
                    self._connection.write_command(encode(Pong()), timeout)
                case Pong():
                    pass
                case other:
                    raise ProtocolError(
                        f"{self.label} sends {type(other).__name__} in the middle of a transaction; reset it"
                    )

    def call_off(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take, and wait for its end; return whether it came."""
        deadline = self._clock.monotonic() + _CALL_OFF_S
        with contextlib.suppress(LinkError, ProtocolError):
            self._connection.write_event(encode(Cancel(transaction)), _CALL_OFF_S)
            while self._clock.monotonic() < deadline:
                packet = self._connection.next_command(_CALL_OFF_S)
                if isinstance(packet, PtpResponse) and packet.transaction == transaction:
                    return True
        return False
