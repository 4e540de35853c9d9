"""PTP over USB: commands, data and responses as containers on the bulk pipes, events on the interrupt pipe.

Rules that hold inside:

- What is read is never less than a packet nor more than 512 KiB, and always whole packets. A device may cut its
  containers as it likes: header alone, data and response in one transfer, a zero-length packet or none.
- A stalled pipe is cleared and the transfer tried once more; a second stall in the same transaction is an error.

Sources: USB Still Image Capture Device Definition 1.0, clauses 5 and 7; ISO 15740:2013, annex D.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from drivers.links.pipes import Pipe, PipeStalled, UsbPipes
from drivers.ptp.codes import ResponseCode
from drivers.ptp.container import (
    MAX_DEVICE_STATUS,
    ContainerReader,
    ControlRequest,
    DataPiece,
    DataStart,
    DeviceStatus,
    encode,
    encode_cancel,
    encode_data_header,
    ends_with_empty_packet,
)
from drivers.ptp.messages import PtpEvent, PtpRequest, PtpResponse
from drivers.ptp.reception import Reception, TransactionState
from drivers.ptp.transport import Transaction
from foundation.clock import Clock
from foundation.errors import LinkError, LinkTimeout, ProtocolError

PIECE = 512 * 1024
"""Bytes of the largest transfer; bigger ones are more than some hosts and cameras bear."""
MAX_EVENTS = 4096
"""Events returned at once from a device that never stops raising them."""

_CONTROL_S = 1.0
"""For a control request, which a device answers in milliseconds if at all."""
_READY_TRIES = 40
"""Two seconds in all for a device to be ready after a cancellation or reset."""
_READY_EVERY_S = 0.05
"""Between two questions for the status: little beside what a reset takes."""
_DRAIN_S = 0.05
"""A device that has been silent for so long has sent all that it had."""
_DRAIN_READS = 256
"""Pieces thrown away, 128 MiB at most: more than a raw frame, and an end to a device that never stops."""
_EMPTY_READS = 16
"""Empty packets in a row that are skipped: one may follow a full packet, so many mean a fault."""


class UsbTransport:
    """A `drivers.ptp.transport.Transport` over the pipes of a still image interface, which it closes in the end."""

    def __init__(self, pipes: UsbPipes, clock: Clock) -> None:
        self._pipes = pipes
        self._clock = clock
        self._state = TransactionState()
        self._stalls = 0
        self._reader = ContainerReader(pipes.packet_size)
        self._events_reader = ContainerReader(pipes.packet_size)

    @property
    def label(self) -> str:
        """The device's name, numbers and port."""
        return self._pipes.label

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction; see `drivers.ptp.transport.Transport`."""

        def exchange(reception: Reception) -> Transaction:
            self._stalls = 0
            self._reader = ContainerReader(self._pipes.packet_size)
            self._send(request, send, timeout)
            return self._receive(reception, timeout)

        return self._state.take(Reception(request, receive, self.label), exchange, self._cancel)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call.

        Takes one polling interval of the interrupt pipe, some milliseconds, for the bus looks no more often.
        """
        self._state.check_open(self.label)
        events: list[PtpEvent] = []
        while len(events) < MAX_EVENTS:
            try:
                piece = self._pipes.interrupt_read(self._pipes.polling_s)
            except LinkTimeout:
                break
            except PipeStalled:
                self._pipes.clear_halt(Pipe.INTERRUPT_IN)
                break
            try:
                messages = self._events_reader.feed(piece)
            except ProtocolError:
                self._events_reader = ContainerReader(self._pipes.packet_size)
                raise
            events += [message for message in messages if isinstance(message, PtpEvent)]
            if not piece:
                break
        return tuple(events)

    def reset(self) -> None:
        """Have the device forget everything; the session that was open is over."""
        self._state.check_open(self.label)
        try:
            self._pipes.control_out(ControlRequest.RESET_DEVICE, b"", _CONTROL_S)
            self._await_ready()
        except (LinkTimeout, PipeStalled, ProtocolError):
            self._pipes.reset_port()
        self._clean()
        self._events_reader = ContainerReader(self._pipes.packet_size)
        self._state.between_transactions = True

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        self._state.closed = True
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

    def _cancel(self, transaction: int) -> bool:
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
