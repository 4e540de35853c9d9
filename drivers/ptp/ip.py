"""PTP over a network: transactions on one TCP connection, events on a second one.

A packet is its length (32 bits, these included), its type (32), then the fields of that type. The initiator opens the
command channel and sends `InitCommandRequest`, the responder answers `InitCommandAck` with a number; the initiator
opens the event channel and sends that number in `InitEventRequest`, the responder answers `InitEventAck`. `InitFail`
may stand for either answer. Transactions run on the command channel; events, `Ping` and `Pong` on the other: whoever
waits for the device also answers its pings, at least once a second, for nothing here has a thread.

`PacketCutter` takes a stream in any pieces. Whatever comes of a data packet is handed on as `Data` at once and only its
last bytes as `EndData`, which means the same. After its only error, `ProtocolError`, the stream has lost its place and
every further `feed` raises too.

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
HEADER_LENGTH: Final = _HEADER.size  # Bytes of these
_DATA_HEADER: Final = struct.Struct("<III")  # The same, and the transaction that data belong to
MAX_PACKET = 4096  # Bytes of the longest packet that is no data; the longest real one carries a name of 40 characters
MAX_NAME_UNITS = 255  # UTF-16 units of the longest name; the standard allows 39
UNKNOWN_TOTAL = 0xFFFFFFFFFFFFFFFF  # Total length of a data phase whose sender does not know it yet
GUID_LENGTH = 16  # Bytes of a GUID


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


def _encode_guid(guid: bytes) -> bytes:
    if len(guid) != GUID_LENGTH:
        raise ValueError(f"a GUID of {len(guid)} bytes; {GUID_LENGTH} are right")
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
        raise ValueError(f"{name[:40]!r} is no PTP/IP name; at most {MAX_NAME_UNITS} UTF-16 units, no NUL")
    return octets + b"\0\0"


def _read_version(cursor: Cursor, field: str) -> int:
    # Some responders end with the name.
    return cursor.u32(field) if cursor.left else VERSION


def _read_total(cursor: Cursor, field: str) -> int | None:
    total = cursor.u64(field)
    return None if total == UNKNOWN_TOTAL else total


def _read_sends_data(cursor: Cursor, _: str) -> bool:
    phase = cursor.u32("data phase")
    if phase > _DATA_OUT:
        raise cursor.fault("data phase", "1 none or in, 2 out", phase)
    return phase == _DATA_OUT


_NO_DATA_OR_IN = 1  # Data phase information of an operation without data, or whose data come to the initiator
_DATA_OUT = 2  # Data phase information of an operation whose data go to the responder

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
# What a packet's fields are on the wire, beside those of every dataset.
Request = Annotated[PtpRequest, FieldKind(lambda cursor, _: PtpRequest.read(cursor), PtpRequest.encode)]


@dataclass(frozen=True)
class InitCommandRequest(PtpDataset):
    """The initiator names itself: a GUID of 16 bytes, which a camera may have been paired with, and a name."""

    guid: Guid
    name: Name
    version: Version = VERSION


@dataclass(frozen=True)
class InitCommandAck(PtpDataset):
    """The responder accepts, numbers the connection and names itself."""

    connection: U32
    guid: Guid
    name: Name
    version: Version = VERSION


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
    """Whether the initiator will send the data phase of a request, and the request."""

    sends_data: SendsData
    request: Request


@dataclass(frozen=True)
class StartData(PtpDataset):
    """A data phase begins; `total` counts its bytes, None where the sender does not know."""

    transaction: U32
    total: Total


@dataclass(frozen=True)
class Data(PtpDataset):
    """The next bytes of a data phase."""

    transaction: U32
    data: Rest


@dataclass(frozen=True)
class EndData(PtpDataset):
    """The last bytes of a data phase, all or none of it."""

    transaction: U32
    data: Rest = b""


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
_KINDS = {packet: kind for kind, packet in _PACKETS.items()}
_DATA_TYPES = (PacketType.DATA, PacketType.END_DATA)
_P = TypeVar("_P", bound=Packet)
_T = TypeVar("_T")


def encode(packet: Packet) -> bytes:
    """Return a packet's bytes."""
    body = packet.encode()
    return encode_integer(HEADER_LENGTH + len(body), 4) + encode_integer(_KINDS[type(packet)], 4) + body


def encode_data(transaction: int, data: bytes | memoryview, *, last: bool) -> bytes:
    """Return the packet `Data`, or `EndData` for the last one, around a part of something large: it is copied once."""
    length = _DATA_HEADER.size + len(data)
    kind = PacketType.END_DATA if last else PacketType.DATA
    return b"".join((encode_integer(length, 4), encode_integer(kind, 4), encode_integer(transaction, 4), data))


class PacketCutter:
    """Cuts a channel's stream into packets, however it was split in transit. One for each channel."""

    def __init__(self) -> None:
        self._waiting: bytes = b""
        self._at: int = 0
        self._data_left: int = 0
        self._data_kind: int = 0
        self._transaction: int = 0

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
        length, kind = _HEADER.unpack_from(self._waiting, self._at)
        if kind not in _PACKETS and self._waiting[self._at : self._at + 5].upper() in _OF_HTTP:
            raise ProtocolError(
                "an HTTP server answers, no camera; give the camera's address, and as port "
                f"{PORT} unless its menu says another"
            )
        _checked(kind, length)
        if kind in _DATA_TYPES:
            if self._left < _DATA_HEADER.size:
                return False
            _, self._data_kind, self._transaction = _DATA_HEADER.unpack_from(self._waiting, self._at)
            self._data_left = length - _DATA_HEADER.size
            self._at += _DATA_HEADER.size
            return True
        if self._left < length:
            return False
        packets.append(_decode(kind, self._waiting[self._at : self._at + length]))
        self._at += length
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


# How what a server of pages says begins; as packets these would be of a gigabyte.
_OF_HTTP: Final = (b"HTTP/", b"<!DOC", b"<HTML")


def _decode(kind: int, data: bytes) -> Packet:
    """Return the packet of a type whose bytes, its header included, are `data`."""
    cursor = Cursor(data, "a PTP/IP packet")
    cursor.at = HEADER_LENGTH
    packet = _PACKETS[kind].read(cursor)
    if cursor.left:
        raise cursor.fault("the end", "no more bytes", f"followed by {cursor.left} bytes", at=cursor.at)
    return packet


def _checked(kind: int, length: int) -> None:
    if kind not in _PACKETS:
        raise _unusable(f"a packet of type {kind} and {length} bytes; a type of 1 to 14 was expected")
    least, most = (_DATA_HEADER.size, 0xFFFFFFFF) if kind in _DATA_TYPES else (HEADER_LENGTH, MAX_PACKET)
    if not least <= length <= most:
        raise _unusable(f"a {PacketType(kind).name} packet of {length} bytes; {least} to {most} were expected")


def _unusable(what: str) -> ProtocolError:
    return ProtocolError(f"the PTP/IP connection gives {what}; check that a camera answers at this port, and reconnect")


# Bytes asked of a link at once: few calls for a long transfer, and no buffer that has to be mapped anew for each.
READ: Final = 128 * 1024


class Channel:
    """The packets on one of the two connections, in both directions."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._cutter = PacketCutter()
        self._packets: deque[Packet] = deque()

    def send(self, packet: Packet, timeout: float) -> None:
        """Send a packet."""
        self._link.write(encode(packet), timeout)

    def send_data(self, transaction: int, data: bytes, piece: int, timeout: float) -> Iterator[None]:
        """Announce a data phase, and send `piece` bytes of it at each step; what fits goes out in one `EndData`."""
        self.send(StartData(transaction, len(data)), timeout)
        view = memoryview(data)
        last = max(0, len(data) - 1) // piece * piece
        for at in range(0, last + 1, piece):
            yield
            self._link.write(encode_data(transaction, view[at : at + piece], last=at == last), timeout)

    def next(self, timeout: float) -> Packet:
        """Return the next packet, waiting `timeout` seconds for each of its bytes."""
        while not self._packets:
            piece = self._link.read(READ, timeout)
            if not piece:
                raise LinkTimeout("no packet waits")
            self._packets.extend(self._cutter.feed(piece))
        return self._packets.popleft()

    def close(self) -> None:
        """Hang up; a second call does nothing."""
        self._link.close()


MAX_EVENTS: Final = 4096  # Events kept for a caller who never asks for them

CONNECT_S: Final = 10.0  # Wait for each connection and each greeting: a camera wakes its network up in a few seconds

# How long a connection is tried: devices refuse the second for about 0.1 s after they acknowledged the first.
EVENT_CHANNEL_S: Final = 2.0

RETRY_S: Final = 0.1  # Pause between two such tries

_PING_EVERY_S: Final = 1.0  # Longest wait on the command connection without a look at the event connection

# Packets taken off the event connection at one look: a device that never stops talking must not keep us there.
_MOST_AT_A_LOOK: Final = 1 << 17

# Bytes of data in a packet to the device; what libgphoto2 sends, and bodies are used to it.
DATA_PIECE: Final = 64 * 1024

_CALL_OFF_S: Final = 2.0  # Wait for the end of a transaction that was cancelled


class IpTransport(CableTransport):
    """A `drivers.ptp.protocol.Transport` over two links.

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
        self._events: deque[PtpEvent] = deque(maxlen=MAX_EVENTS)
        self._command, self._event, self._name = self._connect(DeviceRefused)

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
        return f"{self._name} ({self._place})" if self._name else self._place

    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request and the data phase to the device, and return what the device answers."""
        request = reception.request
        self._command.send(OperationRequest(send is not None, request), timeout)
        if send is not None:
            for _ in self._command.send_data(request.transaction, send, DATA_PIECE, timeout):
                pass
        while True:
            match self._next(timeout):
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
                case other:
                    raise ProtocolError(
                        f"{self.label} sends {type(other).__name__} in the middle of a transaction; reset it"
                    )

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call, and answer pings; never waits."""
        self._attend()
        events = tuple(self._events)
        self._events.clear()
        return events

    def reset(self) -> None:
        """Hang up and connect anew; the session that was open is over."""
        self.close()
        self._events.clear()
        self._command, self._event, self._name = self._connect(DeviceRefused, LinkClosed)
        self.closed, self.between_transactions = False, True

    def close(self) -> None:
        """Hang up both connections; a second call does nothing."""
        self.closed = True
        self._event.close()
        self._command.close()

    def call_off(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take, and wait for its end; return whether it came."""
        deadline = self._clock.monotonic() + _CALL_OFF_S
        with contextlib.suppress(LinkError, ProtocolError):
            self._event.send(Cancel(transaction), _CALL_OFF_S)
            while self._clock.monotonic() < deadline:
                packet = self._next(_CALL_OFF_S)
                if isinstance(packet, PtpResponse) and packet.transaction == transaction:
                    return True
        return False

    def _next(self, timeout: float) -> Packet:
        """Return the next packet on the command connection; answer pings on the other one meanwhile."""
        left = timeout
        while True:
            wait = min(left, _PING_EVERY_S)
            try:
                return self._command.next(wait)
            except LinkTimeout:
                left -= wait
                if left <= 0:
                    raise
                self._attend()

    def _attend(self) -> None:
        """Take what the event connection holds, and answer pings; never waits."""
        with contextlib.suppress(LinkTimeout):
            for _ in range(_MOST_AT_A_LOOK):
                match self._event.next(0.0):
                    case PtpEvent() as event:
                        self._events.append(event)
                    case Ping():
                        self._event.send(Pong(), _PING_EVERY_S)

    def _connect(self, *passing: type[Exception]) -> tuple[Channel, Channel, str]:
        # A device needs a moment to see that a connection is gone, ours or that of the command that ran before; until
        # then it calls itself busy.
        return self._tried(self._greet, *passing)

    def _greet(self) -> tuple[Channel, Channel, str]:
        """Open both connections and introduce the initiator on them (clause 2.2); return them and the device's name."""
        with contextlib.ExitStack() as opened:
            command = opened.enter_context(contextlib.closing(Channel(self._open_command())))
            command.send(self._initiator, CONNECT_S)
            accepted = self._acknowledged(command, InitCommandAck)
            event = opened.enter_context(contextlib.closing(Channel(self._tried(self._open_event, LinkClosed))))
            event.send(InitEventRequest(accepted.connection), CONNECT_S)
            self._acknowledged(event, InitEventAck)
            opened.pop_all()
        return command, event, accepted.name.strip()

    def _tried(self, attempt: Callable[[], _T], *passing: type[Exception]) -> _T:
        """Return what an attempt gives, made again for `EVENT_CHANNEL_S` where it fails for a reason that passes."""
        deadline = self._clock.monotonic() + EVENT_CHANNEL_S
        while True:
            try:
                return attempt()
            except passing:
                if self._clock.monotonic() >= deadline:
                    raise
            self._clock.sleep(RETRY_S)

    def _acknowledged(self, channel: Channel, expected: type[_P]) -> _P:
        try:
            answer = channel.next(CONNECT_S)
        except ProtocolError as error:
            raise ProtocolError(f"what answers in place of {self._place} speaks no PTP/IP: {error}") from error
        if isinstance(answer, expected):
            return answer
        if not isinstance(answer, InitFail):
            raise ProtocolError(
                f"{self._place} answers a greeting with {type(answer).__name__}; an acknowledgement was expected: "
                f"check that a camera listens at this port"
            )
        why = _REFUSALS.get(answer.reason, f"gives reason {answer.reason}: switch it off and on")
        raise DeviceRefused(f"{self._place} refuses the connection; it {why}")


# Why a device refuses, and what helps.
_REFUSALS: dict[int, str] = {
    FailReason.REJECTED: "does not know this computer: pair the two anew in the camera's wireless menu",
    FailReason.BUSY: "is in use by another program or computer: disconnect that one, or switch the camera off and on",
}
