"""PTP over USB: commands, data and responses as containers on the bulk pipes, events on the interrupt pipe.

A container is its length (32 bits, header included), its type (16), a code (16), the transaction (32), then up to five
parameters of 32 bits, or a payload. A device may cut its containers as it likes: header alone, data and response in one
transfer, a zero-length packet or none.

`ContainerReader` takes a stream in any pieces and hands the payload of a data phase on as it comes. The one thing a
stream alone does not show is where a data phase of unknown length ends: only there a piece must be what one read of the
pipe returned, for a short packet ends it. Lengths are checked before they are believed; after its only error,
`ProtocolError`, the stream has lost its place: every further `feed` raises too, until a new reader is taken.

Sources: USB Still Image Capture Device Definition 1.0, clauses 5 (control requests) and 7 (containers); ISO 15740:2013,
annex D.
"""

from __future__ import annotations

import contextlib
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from drivers.links.usb import Pipe, PipeStalled, UsbPipes
from drivers.ptp.codes import ResponseCode
from drivers.ptp.protocol import (
    MAX_PARAMETERS,
    CableTransport,
    Cursor,
    PtpEvent,
    PtpRequest,
    PtpResponse,
    Reception,
    Transaction,
    encode_integer,
)
from foundation.clock import Clock
from foundation.errors import LinkError, LinkTimeout, ProtocolError

_HEADER: Final = struct.Struct("<IHHI")  # Length, type, code and transaction (clause 7)
HEADER_LENGTH: Final = _HEADER.size  # Bytes of these
_LENGTH_AND_TYPE = 6  # Bytes before the code: what follows them is a message as ISO 15740 has it
# A container's length where the payload goes on until a short packet: more than 4 GiB, or not known.
UNKNOWN_LENGTH = 0xFFFFFFFF
HIGH_SPEED_PACKET = 512  # wMaxPacketSize of a bulk pipe at high speed; 64 at full speed, 1024 at super speed


class ContainerType(IntEnum):
    """What a container holds."""

    COMMAND = 1
    DATA = 2
    RESPONSE = 3
    EVENT = 4


@dataclass(frozen=True)
class DataStart:
    """A data phase begins; `length` counts the payload's bytes, None where only a short packet ends it."""

    code: int
    transaction: int
    length: int | None


@dataclass(frozen=True)
class DataPiece:
    """The next bytes of the payload, perhaps none; the piece with `last` closes the data phase."""

    data: bytes
    last: bool = False


_MESSAGES: dict[int, type[PtpRequest | PtpResponse | PtpEvent]] = {
    ContainerType.COMMAND: PtpRequest,
    ContainerType.RESPONSE: PtpResponse,
    ContainerType.EVENT: PtpEvent,
}
_KINDS = {message: kind for kind, message in _MESSAGES.items()}
Message = PtpRequest | PtpResponse | PtpEvent | DataStart | DataPiece


class ContainerReader:
    """Cuts the bytes from a pipe into messages, however the transfers split them.

    One for each pipe. `packet_size` is the pipe's wMaxPacketSize; it matters only to data phases of unknown length.
    """

    def __init__(self, packet_size: int = HIGH_SPEED_PACKET) -> None:
        self._packet_size = packet_size
        self._rest = bytearray()
        self._payload_left: int | None = 0
        self._in_data = False

    def feed(self, piece: bytes) -> list[Message]:
        """Take the next bytes, an empty piece for a zero-length packet, and return what they complete."""
        if self._in_data and self._payload_left is None:
            return self._feed_until_short(piece)
        messages: list[Message] = []
        self._rest += piece
        try:
            while self._next(messages, piece):
                pass
        except ProtocolError:
            if not messages:
                raise
        return messages

    def _feed_until_short(self, piece: bytes) -> list[Message]:
        last = len(piece) % self._packet_size != 0 or not piece
        self._in_data = not last
        return [DataPiece(bytes(piece), last)] if piece or last else []

    def _next(self, messages: list[Message], piece: bytes) -> bool:
        """Move one message, or a piece of one, from what is left to `messages`; return whether more may follow."""
        if self._in_data:
            return self._next_payload(messages)
        if len(self._rest) < HEADER_LENGTH:
            return False
        length, kind, code, transaction = _HEADER.unpack_from(self._rest)
        if kind == ContainerType.DATA:
            if length < HEADER_LENGTH:
                raise _unusable(f"a data container of {length} bytes; its header alone has {HEADER_LENGTH}")
            self._start_data(messages, code, transaction, length, piece)
            return bool(self._in_data or self._rest)
        _check_length(kind, length)
        if len(self._rest) < length:
            return False
        messages.append(_MESSAGES[kind].decode(bytes(self._rest[_LENGTH_AND_TYPE:length])))
        del self._rest[:length]
        return bool(self._rest)

    def _start_data(self, messages: list[Message], code: int, transaction: int, length: int, piece: bytes) -> None:
        del self._rest[:HEADER_LENGTH]
        self._in_data = True
        if length != UNKNOWN_LENGTH:
            self._payload_left = length - HEADER_LENGTH
            messages.append(DataStart(code, transaction, self._payload_left))
            return
        self._payload_left = None
        messages.append(DataStart(code, transaction, None))
        payload = bytes(self._rest)
        self._rest.clear()
        # A header that travels alone is a short packet too, but it opens the phase and does not end it.
        last = bool(payload) and len(piece) % self._packet_size != 0
        if payload:
            messages.append(DataPiece(payload, last))
        self._in_data = not last

    def _next_payload(self, messages: list[Message]) -> bool:
        left = self._payload_left
        if left is None:
            return False
        payload = bytes(self._rest[:left])
        del self._rest[: len(payload)]
        self._payload_left = left - len(payload)
        self._in_data = self._payload_left > 0
        if payload or not self._in_data:
            messages.append(DataPiece(payload, last=not self._in_data))
        return bool(self._rest)


def encode(message: PtpRequest | PtpResponse | PtpEvent) -> bytes:
    """Return the container of a message."""
    body = message.encode()
    return encode_integer(_LENGTH_AND_TYPE + len(body), 4) + encode_integer(_KINDS[type(message)], 2) + body


def encode_data_header(code: int, transaction: int, length: int | None) -> bytes:
    """Return what stands before a payload of `length` bytes; None, or too many for 32 bits, until a short packet."""
    total = UNKNOWN_LENGTH if length is None else min(HEADER_LENGTH + length, UNKNOWN_LENGTH)
    kind = ContainerType.DATA
    return encode_integer(total, 4) + encode_integer(kind, 2) + encode_integer(code, 2) + encode_integer(transaction, 4)


def ends_with_empty_packet(total: int, packet_size: int) -> bool:
    """Return whether a transfer of `total` bytes, header included, must be closed by a zero-length packet.

    A receiver detects the end of a transfer by a packet that is not full; where all are full, an empty one is due.
    """
    return total % packet_size == 0


def _check_length(kind: int, length: int) -> None:
    if kind not in _MESSAGES:
        raise _unusable(f"a container of type {kind}; 1 command, 2 data, 3 response or 4 event was expected")
    count, odd = divmod(length - HEADER_LENGTH, 4)
    if odd or not 0 <= count <= MAX_PARAMETERS:
        raise _unusable(
            f"a {ContainerType(kind).name.lower()} container of {length} bytes; "
            f"12 and 4 for each of 0 to {MAX_PARAMETERS} parameters were expected"
        )


def _unusable(what: str) -> ProtocolError:
    return ProtocolError(f"the USB pipe gives {what}; reset the device")


class ControlRequest(IntEnum):
    """Requests of the still image class on the control pipe (clause 5.2)."""

    CANCEL = 0x64
    GET_EXTENDED_EVENT_DATA = 0x65
    RESET_DEVICE = 0x66
    GET_DEVICE_STATUS = 0x67


_CANCELLATION = 0x4001  # Cancellation code in the data of a CANCEL request (clause 5)
# Bytes that GET_DEVICE_STATUS is asked for: a header of 4, and parameters that name stalled pipes.
MAX_DEVICE_STATUS = 0x14


def encode_cancel(transaction: int) -> bytes:
    """Return the data of a CANCEL request."""
    return encode_integer(_CANCELLATION, 2) + encode_integer(transaction, 4)


def decode_cancel(data: bytes) -> int:
    """Return the transaction that a CANCEL request ends."""
    cursor = Cursor(data, "a cancel request", 6)
    code = cursor.u16("code")
    if code != _CANCELLATION:
        raise cursor.fault("code", f"0x{_CANCELLATION:04x}", f"0x{code:04x}")
    return cursor.u32("transaction")


@dataclass(frozen=True)
class DeviceStatus:
    """What GET_DEVICE_STATUS answers: a response code, and the addresses of stalled endpoints."""

    code: int
    parameters: tuple[int, ...] = ()

    @classmethod
    def decode(cls, data: bytes) -> DeviceStatus:
        """Return the status in an answer."""
        cursor = Cursor(data, "the device status", 0xFFFF)
        length = cursor.u16("length")
        count, odd = divmod(length - 4, 4)
        if odd or count < 0 or count > MAX_PARAMETERS:
            raise cursor.fault("length", f"4 and 4 for each of 0 to {MAX_PARAMETERS} parameters", length)
        return cls(cursor.u16("code"), cursor.integers(count, 4, "parameters"))

    def encode(self) -> bytes:
        """Return the answer."""
        parameters = b"".join(encode_integer(parameter, 4) for parameter in self.parameters)
        return encode_integer(4 + len(parameters), 2) + encode_integer(self.code, 2) + parameters


PIECE = 512 * 1024  # Bytes of the largest transfer; bigger ones are more than some hosts and cameras bear
MAX_EVENTS = 4096  # Events returned at once from a device that never stops raising them

_CONTROL_S = 1.0  # For a control request, which a device answers in milliseconds if at all
_READY_TRIES = 40  # Two seconds in all for a device to be ready after a cancellation or reset
_READY_EVERY_S = 0.05  # Between two questions for the status: little beside what a reset takes
_DRAIN_S = 0.05  # A device that has been silent for so long has sent all that it had
# Pieces thrown away, 128 MiB at most: more than a raw frame, and an end to a device that never stops.
_DRAIN_READS = 256
_EMPTY_READS = 16  # Empty packets in a row that are skipped: one may follow a full packet, so many mean a fault


class UsbTransport(CableTransport):
    """A `drivers.ptp.protocol.Transport` over the pipes of a still image interface, which it closes in the end."""

    def __init__(self, pipes: UsbPipes, clock: Clock) -> None:
        super().__init__()
        self._pipes = pipes
        self._clock = clock
        self._stalls = 0
        self._reader = ContainerReader(pipes.packet_size)
        self._events_reader = ContainerReader(pipes.packet_size)

    @property
    def label(self) -> str:
        """The device's name, numbers and port."""
        return self._pipes.label

    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request and the data phase to the device, and return what the device answers."""
        self._stalls = 0
        self._reader = ContainerReader(self._pipes.packet_size)
        self._send(reception.request, send, timeout)
        return self._receive(reception, timeout)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call.

        Takes one polling interval of the interrupt pipe, some milliseconds, for the bus looks no more often.
        """
        self.check_open()
        events: list[PtpEvent] = []
        while len(events) < MAX_EVENTS:
            try:
                piece = self._pipes.interrupt_read(self._pipes.polling_s)
            except PipeStalled:
                self._pipes.clear_halt(Pipe.INTERRUPT_IN)
                break
            if not piece:
                break
            try:
                messages = self._events_reader.feed(piece)
            except ProtocolError:
                self._events_reader = ContainerReader(self._pipes.packet_size)
                raise
            events += [message for message in messages if isinstance(message, PtpEvent)]
        return tuple(events)

    def reset(self) -> None:
        """Have the device forget everything; the session that was open is over."""
        self.check_open()
        try:
            self._pipes.control_out(ControlRequest.RESET_DEVICE, b"", _CONTROL_S)
            self._await_ready()
        except (LinkTimeout, PipeStalled, ProtocolError):
            self._pipes.reset_port()
        self._clean()
        self._events_reader = ContainerReader(self._pipes.packet_size)
        self.between_transactions = True

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        self.closed = True
        self._pipes.close()

    def _send(self, request: PtpRequest, send: bytes | None, timeout: float) -> None:
        self._write(encode(request), timeout)
        if send is None:
            return
        container = encode_data_header(request.code, request.transaction, len(send)) + send
        for at in range(0, len(container), PIECE):
            self._write(container[at : at + PIECE], timeout)
        if ends_with_empty_packet(len(container), self._pipes.packet_size):
            self._write(b"", timeout)

    def _write(self, data: bytes, timeout: float) -> None:
        try:
            self._pipes.bulk_write(data, timeout)
        except PipeStalled as stall:
            self._recover(Pipe.BULK_OUT, stall)
            self._write(data, timeout)

    def _read(self, limit: int, timeout: float) -> bytes:
        try:
            return self._pipes.bulk_read(limit, timeout)
        except PipeStalled as stall:
            self._recover(Pipe.BULK_IN, stall)
            return self._read(limit, timeout)

    def _recover(self, pipe: Pipe, stall: PipeStalled) -> None:
        self._pipes.clear_halt(pipe)
        self._stalls += 1
        if self._stalls > 1:
            raise ProtocolError(f"{self.label} stalls again and again on its pipe {pipe.value}; reset it") from stall

    def _receive(self, reception: Reception, timeout: float) -> Transaction:
        empty = 0
        open_ended = False
        while True:
            limit = self._limit(reception.left, open_ended)
            piece = self._read(limit, timeout)
            empty = 0 if piece else empty + 1
            if empty > _EMPTY_READS:
                raise ProtocolError(f"{self.label} sends one empty packet after the other; reset it")
            messages = self._reader.feed(piece)
            if open_ended and piece and len(piece) < limit and len(piece) % self._pipes.packet_size == 0:
                # The zero-length packet that ends the data phase ended this read too and left no other trace.
                messages += self._reader.feed(b"")
            for message in messages:
                match message:
                    case DataStart(_, transaction, length):
                        reception.start(transaction, length)
                        open_ended = length is None
                    case DataPiece(data, last):
                        reception.take(data)
                        open_ended = open_ended and not last
                    case PtpResponse() as response:
                        return reception.end(response)
                    case _:
                        raise ProtocolError(f"{self.label} sends {message} where a response was due; reset it")

    def _limit(self, left: int | None, open_ended: bool) -> int:
        packet = self._pipes.packet_size
        if open_ended:
            return PIECE
        if not left:
            return packet
        # Whole packets of the data only, so that the response never comes in the same read.
        return max(packet, min(PIECE, left // packet * packet))

    def call_off(self, transaction: int) -> bool:
        """Call off a transaction whose data the caller cannot take; return whether the next can follow."""
        with contextlib.suppress(LinkError, ProtocolError):
            self._pipes.control_out(ControlRequest.CANCEL, encode_cancel(transaction), _CONTROL_S)
            self._await_ready()
            self._clean()
            return True
        return False

    def _await_ready(self) -> None:
        for _ in range(_READY_TRIES):
            status = self._pipes.control_in(ControlRequest.GET_DEVICE_STATUS, MAX_DEVICE_STATUS, _CONTROL_S)
            if DeviceStatus.decode(status).code != ResponseCode.DEVICE_BUSY:
                return
            self._clock.sleep(_READY_EVERY_S)
        raise LinkTimeout(f"{self.label} stays busy; switch it off and on")

    def _clean(self) -> None:
        """Clear the bulk pipes of stalls, and of what the device had still to say."""
        for pipe in (Pipe.BULK_OUT, Pipe.BULK_IN):
            # Where no stall is, some devices decline to clear it.
            with contextlib.suppress(PipeStalled):
                self._pipes.clear_halt(pipe)
        for _ in range(_DRAIN_READS):
            try:
                self._pipes.bulk_read(PIECE, _DRAIN_S)
            except LinkTimeout:
                return
        raise ProtocolError(f"{self.label} does not stop sending; switch it off and on")
