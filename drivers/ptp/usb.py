"""PTP over USB: commands, data and responses in containers on the bulk pipes, events on the interrupt pipe.

A container has its length with header (32 bits), its type (16), a code (16), the transaction (32), and up to five
parameters of 32 bits, or data (the payload). Devices divide containers into transfers in different ways. The header may
be a transfer on its own, data and response may share one, and a zero-length packet may follow.

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
HEADER_LENGTH: Final = _HEADER.size  # Bytes
_LENGTH_AND_TYPE = 6  # Bytes of length and type, before the message as in ISO 15740
UNKNOWN_LENGTH = 0xFFFFFFFF  # Length field if a short packet ends the container: length unknown or above 4 GiB
HIGH_SPEED_PACKET = 512  # wMaxPacketSize of a bulk pipe at high speed; 64 at full speed, 1024 at super speed


class ContainerType(IntEnum):
    """Types of containers."""

    COMMAND = 1
    DATA = 2
    RESPONSE = 3
    EVENT = 4


@dataclass(frozen=True)
class DataStart:
    """Start of a data phase; `length` of the payload in bytes, None if a short packet ends the payload."""

    code: int
    transaction: int
    length: int | None


@dataclass(frozen=True)
class DataPiece:
    """The next bytes of the payload, which may be empty; the piece with `last` ends the data phase."""

    data: bytes
    last: bool = False


_MESSAGES: dict[int, type[PtpRequest | PtpResponse | PtpEvent]] = {
    ContainerType.COMMAND: PtpRequest,
    ContainerType.RESPONSE: PtpResponse,
    ContainerType.EVENT: PtpEvent,
}
_CONTAINER_TYPES = {message: container_type for container_type, message in _MESSAGES.items()}
Message = PtpRequest | PtpResponse | PtpEvent | DataStart | DataPiece


class ContainerReader:
    """Divides the bytes of one pipe into messages; the bytes may arrive in pieces of any size.

    If the length of the data is unknown, a packet that is not full (`packet_size`) ends them; each piece must then be
    the result of one read. After a `ProtocolError`, every further call of `feed` raises it again.
    """

    def __init__(self, packet_size: int = HIGH_SPEED_PACKET) -> None:
        self._packet_size = packet_size
        self._buffer = bytearray()
        self._payload_remaining: int | None = 0
        self._in_data = False

    def feed(self, piece: bytes) -> list[Message]:
        """Process the next bytes, b"" for a zero-length packet; return the messages that they complete."""
        if self._in_data and self._payload_remaining is None:
            return self._feed_until_short(piece)
        messages: list[Message] = []
        self._buffer += piece
        try:
            while self._take_message(messages, piece):
                pass
        except ProtocolError:
            if not messages:
                raise
        return messages

    def _feed_until_short(self, piece: bytes) -> list[Message]:
        last = len(piece) % self._packet_size != 0 or not piece
        self._in_data = not last
        return [DataPiece(bytes(piece), last)] if piece or last else []

    def _take_message(self, messages: list[Message], piece: bytes) -> bool:
        """Move one message, or a part of its data, from the buffer to `messages`; return whether to continue."""
        if self._in_data:
            return self._take_payload(messages)
        if len(self._buffer) < HEADER_LENGTH:
            return False
        length, container_type, code, transaction = _HEADER.unpack_from(self._buffer)
        if container_type == ContainerType.DATA:
            if length < HEADER_LENGTH:
                raise _stream_error(f"a data container of {length} bytes, expected {HEADER_LENGTH} or more")
            self._start_data(messages, code, transaction, length, piece)
            return bool(self._in_data or self._buffer)
        _check_length(container_type, length)
        if len(self._buffer) < length:
            return False
        messages.append(_MESSAGES[container_type].decode(bytes(self._buffer[_LENGTH_AND_TYPE:length])))
        del self._buffer[:length]
        return bool(self._buffer)

    def _start_data(self, messages: list[Message], code: int, transaction: int, length: int, piece: bytes) -> None:
        del self._buffer[:HEADER_LENGTH]
        self._in_data = True
        if length != UNKNOWN_LENGTH:
            self._payload_remaining = length - HEADER_LENGTH
            messages.append(DataStart(code, transaction, self._payload_remaining))
            return
        self._payload_remaining = None
        messages.append(DataStart(code, transaction, None))
        payload = bytes(self._buffer)
        self._buffer.clear()
        # A header without data is also a short packet, but it does not end the data phase.
        last = bool(payload) and len(piece) % self._packet_size != 0
        if payload:
            messages.append(DataPiece(payload, last))
        self._in_data = not last

    def _take_payload(self, messages: list[Message]) -> bool:
        remaining = self._payload_remaining
        if remaining is None:
            return False
        payload = bytes(self._buffer[:remaining])
        del self._buffer[: len(payload)]
        self._payload_remaining = remaining - len(payload)
        self._in_data = self._payload_remaining > 0
        if payload or not self._in_data:
            messages.append(DataPiece(payload, last=not self._in_data))
        return bool(self._buffer)


def encode(message: PtpRequest | PtpResponse | PtpEvent) -> bytes:
    """Return the container of a message."""
    body = message.encode()
    return encode_integer(_LENGTH_AND_TYPE + len(body), 4) + encode_integer(_CONTAINER_TYPES[type(message)], 2) + body


def encode_data_header(code: int, transaction: int, length: int | None) -> bytes:
    """Return the header of a data container with `length` bytes of payload, None if the length is unknown."""
    total = UNKNOWN_LENGTH if length is None else min(HEADER_LENGTH + length, UNKNOWN_LENGTH)
    start = encode_integer(total, 4) + encode_integer(ContainerType.DATA, 2)
    return start + encode_integer(code, 2) + encode_integer(transaction, 4)


def ends_with_empty_packet(total: int, packet_size: int) -> bool:
    """Return whether a transfer of `total` bytes, including the header, must end with a zero-length packet."""
    # The receiver detects the end by a packet that is not full. If all packets are full, an empty one must follow.
    return total % packet_size == 0


def _check_length(container_type: int, length: int) -> None:
    if container_type not in _MESSAGES:
        raise _stream_error(f"a container of type {container_type}, expected 1 command, 2 data, 3 response or 4 event")
    count, excess = divmod(length - HEADER_LENGTH, 4)
    if excess or not 0 <= count <= MAX_PARAMETERS:
        raise _stream_error(
            f"a {ContainerType(container_type).name.lower()} container of {length} bytes, "
            f"expected 12 plus 4 for each of 0 to {MAX_PARAMETERS} parameters"
        )


def _stream_error(fault: str) -> ProtocolError:
    return ProtocolError(f"the USB pipe has {fault}; reset the device")


class ControlRequest(IntEnum):
    """Requests of the still image class on the control pipe (clause 5.2)."""

    CANCEL = 0x64
    GET_EXTENDED_EVENT_DATA = 0x65
    RESET_DEVICE = 0x66
    GET_DEVICE_STATUS = 0x67


_CANCELLATION = 0x4001  # Cancellation code in the data of a CANCEL request (clause 5)
# Bytes that GET_DEVICE_STATUS requests: a header of 4 bytes and the addresses of stalled pipes.
MAX_DEVICE_STATUS = 0x14


def encode_cancel(transaction: int) -> bytes:
    """Return the data of a CANCEL request."""
    return encode_integer(_CANCELLATION, 2) + encode_integer(transaction, 4)


def decode_cancel(data: bytes) -> int:
    """Return the number of the transaction that a CANCEL request cancels."""
    cursor = Cursor(data, "a cancel request", 6)
    code = cursor.u16("code")
    if code != _CANCELLATION:
        raise cursor.fault("code", f"0x{_CANCELLATION:04x}", f"0x{code:04x}")
    return cursor.u32("transaction")


@dataclass(frozen=True)
class DeviceStatus:
    """Reply to GET_DEVICE_STATUS: a response code, and the addresses of stalled endpoints."""

    code: int
    parameters: tuple[int, ...] = ()

    @classmethod
    def decode(cls, data: bytes) -> DeviceStatus:
        """Return the status in a reply."""
        cursor = Cursor(data, "the device status", 0xFFFF)
        length = cursor.u16("length")
        count, excess = divmod(length - 4, 4)
        if excess or count < 0 or count > MAX_PARAMETERS:
            raise cursor.fault("length", f"4 plus 4 for each of 0 to {MAX_PARAMETERS} parameters", length)
        return cls(cursor.u16("code"), cursor.integers(count, 4, "parameters"))

    def encode(self) -> bytes:
        """Return the bytes of the reply."""
        parameters = b"".join(encode_integer(parameter, 4) for parameter in self.parameters)
        return encode_integer(4 + len(parameters), 2) + encode_integer(self.code, 2) + parameters


PIECE = 512 * 1024  # Largest transfer, bytes; some computers and cameras fail with larger transfers
MAX_EVENTS = 4096  # Most events that one call returns, because a faulty device may never stop sending

_CONTROL_S = 1.0  # Timeout of a control request, seconds; a reply takes milliseconds
_READY_TRIES = 40  # Most status requests after a cancellation or reset
_READY_EVERY_S = 0.05  # Pause between two status requests, seconds
_DRAIN_S = 0.05  # Time without data after which all old data have been discarded, seconds
_DRAIN_READS = 256  # Most pieces that are discarded, because a faulty device may never stop sending
_EMPTY_READS = 16  # Most empty packets in a row; one may follow a full packet, more are a fault of the device


class UsbTransport(CableTransport):
    """A `drivers.ptp.protocol.Transport` over the pipes of a still image interface; `close` also closes the pipes."""

    def __init__(self, pipes: UsbPipes, clock: Clock) -> None:
        super().__init__()
        self._pipes = pipes
        self._clock = clock
        self._stall_count = 0
        self._reader = ContainerReader(pipes.packet_size)
        self._events_reader = ContainerReader(pipes.packet_size)

    @property
    def label(self) -> str:
        """Name, numbers and port of the device."""
        return self._pipes.label

    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request with its data phase, and return the reply of the device."""
        self._stall_count = 0
        self._reader = ContainerReader(self._pipes.packet_size)
        self._send_request(reception.request, send, timeout)
        return self._receive_reply(reception, timeout)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that were received since the last call.

        It waits for one polling interval of the interrupt pipe, which is some milliseconds.
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
        """Reset the device; an open session ends."""
        self.check_open()
        try:
            self._pipes.control_out(ControlRequest.RESET_DEVICE, b"", _CONTROL_S)
            self._await_ready()
        except (LinkTimeout, PipeStalled, ProtocolError):
            self._pipes.reset_port()
        self._clear_pipes()
        self._events_reader = ContainerReader(self._pipes.packet_size)
        self.between_transactions = True

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        self.closed = True
        self._pipes.close()

    def _send_request(self, request: PtpRequest, send: bytes | None, timeout: float) -> None:
        self._write(encode(request), timeout)
        if send is None:
            return
        container = encode_data_header(request.code, request.transaction, len(send)) + send
        for start in range(0, len(container), PIECE):
            self._write(container[start : start + PIECE], timeout)
        if ends_with_empty_packet(len(container), self._pipes.packet_size):
            self._write(b"", timeout)

    def _write(self, data: bytes, timeout: float) -> None:
        try:
            self._pipes.bulk_write(data, timeout)
        except PipeStalled as stall:
            self._clear_stall(Pipe.BULK_OUT, stall)
            self._write(data, timeout)

    def _read(self, limit: int, timeout: float) -> bytes:
        try:
            return self._pipes.bulk_read(limit, timeout)
        except PipeStalled as stall:
            self._clear_stall(Pipe.BULK_IN, stall)
            return self._read(limit, timeout)

    def _clear_stall(self, pipe: Pipe, stall: PipeStalled) -> None:
        self._pipes.clear_halt(pipe)
        self._stall_count += 1
        if self._stall_count > 1:
            raise ProtocolError(f"{self.label} stalls repeatedly on its pipe {pipe.value}; reset it") from stall

    def _receive_reply(self, reception: Reception, timeout: float) -> Transaction:
        empty_count = 0
        is_open_ended = False
        while True:
            limit = self._read_limit(reception.remaining, is_open_ended)
            piece = self._read(limit, timeout)
            empty_count = 0 if piece else empty_count + 1
            if empty_count > _EMPTY_READS:
                raise ProtocolError(f"{self.label} sent {empty_count} empty packets in a row; reset it")
            messages = self._reader.feed(piece)
            if is_open_ended and piece and len(piece) < limit and len(piece) % self._pipes.packet_size == 0:
                # All packets were full, so a zero-length packet has ended this read. It also ends the data phase.
                messages += self._reader.feed(b"")
            for message in messages:
                match message:
                    case DataStart(_, transaction, length):
                        reception.start(transaction, length)
                        is_open_ended = length is None
                    case DataPiece(data, last):
                        reception.take(data)
                        is_open_ended = is_open_ended and not last
                    case PtpResponse() as response:
                        return reception.end(response)
                    case _:
                        raise ProtocolError(f"{self.label} sent {message}, expected a response; reset it")

    def _read_limit(self, remaining: int | None, is_open_ended: bool) -> int:
        packet_size = self._pipes.packet_size
        if is_open_ended:
            return PIECE
        if not remaining:
            return packet_size
        # Read only whole packets of the data, so that a read never returns data and the response together.
        return max(packet_size, min(PIECE, remaining // packet_size * packet_size))

    def cancel(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take; return whether another transaction is possible."""
        with contextlib.suppress(LinkError, ProtocolError):
            self._pipes.control_out(ControlRequest.CANCEL, encode_cancel(transaction), _CONTROL_S)
            self._await_ready()
            self._clear_pipes()
            return True
        return False

    def _await_ready(self) -> None:
        for _ in range(_READY_TRIES):
            status = self._pipes.control_in(ControlRequest.GET_DEVICE_STATUS, MAX_DEVICE_STATUS, _CONTROL_S)
            if DeviceStatus.decode(status).code != ResponseCode.DEVICE_BUSY:
                return
            self._clock.sleep(_READY_EVERY_S)
        raise LinkTimeout(f"{self.label} stays busy after a reset; switch it off and on")

    def _clear_pipes(self) -> None:
        """Clear the halts of the bulk pipes, and discard data that the device still sends."""
        for pipe in (Pipe.BULK_OUT, Pipe.BULK_IN):
            # Some devices refuse to clear a pipe that is not stalled.
            with contextlib.suppress(PipeStalled):
                self._pipes.clear_halt(pipe)
        for _ in range(_DRAIN_READS):
            try:
                self._pipes.bulk_read(PIECE, _DRAIN_S)
            except LinkTimeout:
                return
        raise ProtocolError(f"{self.label} does not stop sending; switch it off and on")
