"""Faults of cameras and cables, as wrappers around a working device or cable.

Faults can be in the device (`drivers.ptp.protocol.Responder`), in its pipes (`drivers.links.usb.UsbPipes`), or in the
whole cable (`drivers.ptp.protocol.Transport`). A wrapper keeps the contract of the wrapped object and can be wrapped
again. Faults and their times are set on construction; nothing is random.

A device that restarts during an operation is `Interrupting` with ``replug`` of the simulated bus; one that is
disconnected uses ``unplug``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from drivers.links.usb import Pipe, PipeStalled, UsbPipes
from drivers.ptp.protocol import Answer, NoAnswer, PtpEvent, PtpRequest, PtpResponse, Responder, Transaction, Transport
from drivers.ptp.usb import HEADER_LENGTH
from foundation.errors import LinkClosed, LinkTimeout


class Occasion:
    """Selects operations: those in `codes` (None: all), without the first `after`, at most `times` (None: all).

    Each operation is checked once, in order.
    """

    def __init__(self, codes: Collection[int] | None = None, *, after: int = 0, times: int | None = 1) -> None:
        self._codes = codes
        self._after = after
        self._times = times
        self._count = 0

    def is_due(self, code: int) -> bool:
        """Count an operation and return whether it is selected."""
        if self._codes is not None and code not in self._codes:
            return False
        self._count += 1
        number = self._count - 1 - self._after
        return number >= 0 and (self._times is None or number < self._times)


class TroubledResponder:
    """A device without faults; subclasses add them."""

    def __init__(self, good: Responder) -> None:
        self.good = good

    def takes_data(self, request: PtpRequest) -> bool:
        return self.good.takes_data(request)

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        return self.good.answer(request, data)

    def events(self) -> tuple[PtpEvent, ...]:
        return self.good.events()

    def cancelled(self, transaction: int) -> None:
        self.good.cancelled(transaction)

    def unplugged(self) -> None:
        self.good.unplugged()


class Declining(TroubledResponder):
    """Answers `code`, such as DEVICE_BUSY, on an occasion, without carrying out the operation."""

    def __init__(self, good: Responder, code: int, occasion: Occasion) -> None:
        super().__init__(good)
        self._code = code
        self._occasion = occasion

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if self._occasion.is_due(request.code):
            return Answer(PtpResponse(self._code, request.transaction))
        return super().answer(request, data)


class Hanging(TroubledResponder):
    """Does not answer on an occasion; if `obeys`, it still carries out the operation."""

    def __init__(self, good: Responder, occasion: Occasion, *, obeys: bool = False) -> None:
        super().__init__(good)
        self._occasion = occasion
        self._obeys = obeys

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if self._occasion.is_due(request.code):
            if self._obeys:
                super().answer(request, data)
            raise NoAnswer
        return super().answer(request, data)


class Interrupting(TroubledResponder):
    """Calls `action` on an occasion, before the operation."""

    def __init__(self, good: Responder, action: Callable[[], object], occasion: Occasion) -> None:
        super().__init__(good)
        self._action = action
        self._occasion = occasion

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if self._occasion.is_due(request.code):
            self._action()
        return super().answer(request, data)


class Falsifying(TroubledResponder):
    """Changes the data of the device on an occasion."""

    def __init__(self, good: Responder, change: Callable[[bytes], bytes], occasion: Occasion) -> None:
        super().__init__(good)
        self._change = change
        self._occasion = occasion

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        answer = super().answer(request, data)
        if self._occasion.is_due(request.code) and answer.data is not None:
            return Answer(answer.response, self._change(answer.data))
        return answer


class ChangingEvents(TroubledResponder):
    """Changes the events of the device: none, repeated ones, unknown ones."""

    def __init__(self, good: Responder, change: Callable[[tuple[PtpEvent, ...]], tuple[PtpEvent, ...]]) -> None:
        super().__init__(good)
        self._change = change

    def events(self) -> tuple[PtpEvent, ...]:
        return self._change(super().events())


class DelayingEvents(TroubledResponder):
    """Reports each event only after `calls` further requests."""

    def __init__(self, good: Responder, calls: int) -> None:
        super().__init__(good)
        self._delayed: list[tuple[PtpEvent, ...]] = [()] * calls

    def events(self) -> tuple[PtpEvent, ...]:
        self._delayed.append(super().events())
        return self._delayed.pop(0)


class TroubledPipes:
    """Pipes without faults; subclasses add them."""

    def __init__(self, good: UsbPipes) -> None:
        self.good = good

    @property
    def label(self) -> str:
        return self.good.label

    @property
    def packet_size(self) -> int:
        return self.good.packet_size

    @property
    def polling_s(self) -> float:
        return self.good.polling_s

    def bulk_write(self, data: bytes, timeout: float) -> None:
        self.good.bulk_write(data, timeout)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        return self.good.bulk_read(limit, timeout)

    def interrupt_read(self, timeout: float) -> bytes:
        return self.good.interrupt_read(timeout)

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        self.good.control_out(request, data, timeout)

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        return self.good.control_in(request, limit, timeout)

    def clear_halt(self, pipe: Pipe) -> None:
        self.good.clear_halt(pipe)

    def reset_port(self) -> None:
        self.good.reset_port()

    def close(self) -> None:
        self.good.close()


class Stalling(TroubledPipes):
    """Stalls a bulk pipe at the transfers with these numbers, from 0, before any data."""

    def __init__(self, good: UsbPipes, pipe: Pipe, transfers: Collection[int]) -> None:
        super().__init__(good)
        self._pipe = pipe
        self._transfers = transfers
        self._next = 0
        self._halted = False

    def bulk_write(self, data: bytes, timeout: float) -> None:
        self._stall_if_due(Pipe.BULK_OUT)
        super().bulk_write(data, timeout)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        self._stall_if_due(Pipe.BULK_IN)
        return super().bulk_read(limit, timeout)

    def clear_halt(self, pipe: Pipe) -> None:
        if pipe is self._pipe:
            self._halted = False
        super().clear_halt(pipe)

    def _stall_if_due(self, pipe: Pipe) -> None:
        if pipe is not self._pipe:
            return
        if not self._halted:
            self._halted = self._next in self._transfers
            self._next += 1
        if self._halted:
            raise PipeStalled(f"{self.label} stalls on purpose")


class ShortReads(TroubledPipes):
    """Returns at most `packets` packets per read."""

    def __init__(self, good: UsbPipes, packets: int = 1) -> None:
        super().__init__(good)
        self._packets = packets

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        return super().bulk_read(min(limit, self._packets * self.packet_size), timeout)


class HeaderAlone(TroubledPipes):
    """Returns the first 12 bytes of every read separately, like devices that send the header in its own transfer."""

    def __init__(self, good: UsbPipes) -> None:
        super().__init__(good)
        self._rest = b""

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        data, self._rest = self._rest or super().bulk_read(limit, timeout), b""
        if len(data) <= HEADER_LENGTH or data[4:6] != b"\x02\x00":
            return data
        data, self._rest = data[:HEADER_LENGTH], data[HEADER_LENGTH:]
        return data


class Joining(TroubledPipes):
    """Returns data and response in one read, up to the limit."""

    def __init__(self, good: UsbPipes) -> None:
        super().__init__(good)
        self._waiting = bytearray()

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        while len(self._waiting) < limit:
            try:
                self._waiting += super().bulk_read(limit, timeout)
            except LinkTimeout:
                if not self._waiting:
                    raise
                break
        data = bytes(self._waiting[:limit])
        del self._waiting[:limit]
        return data


class WithoutEmptyPackets(TroubledPipes):
    """Omits the zero-length packets that close full transfers, as some devices do."""

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        while not (data := super().bulk_read(limit, timeout)):
            pass
        return data


class CutOff(TroubledPipes):
    """Is disconnected after `after` bytes from the bulk pipe."""

    def __init__(self, good: UsbPipes, after: int) -> None:
        super().__init__(good)
        self._remaining = after

    def bulk_write(self, data: bytes, timeout: float) -> None:
        self._check()
        super().bulk_write(data, timeout)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        self._check()
        data = super().bulk_read(limit, timeout)
        delivered, self._remaining = data[: self._remaining], self._remaining - len(data)
        if not delivered:
            self._check()
        return delivered

    def _check(self) -> None:
        if self._remaining <= 0:
            raise LinkClosed(f"{self.label} was pulled out on purpose")


class Deaf(TroubledPipes):
    """Returns nothing on the bulk pipe after `reads` reads."""

    def __init__(self, good: UsbPipes, reads: int) -> None:
        super().__init__(good)
        self._remaining = reads

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        if self._remaining <= 0:
            raise LinkTimeout(f"{self.label} sends nothing, on purpose")
        self._remaining -= 1
        return super().bulk_read(limit, timeout)


class Garbling(TroubledPipes):
    """Changes the data from the bulk pipe."""

    def __init__(self, good: UsbPipes, change: Callable[[bytes], bytes]) -> None:
        super().__init__(good)
        self._change = change

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        return self._change(super().bulk_read(limit, timeout))


class TroubledTransport:
    """A cable without faults; subclasses add them."""

    def __init__(self, good: Transport) -> None:
        self.good = good

    @property
    def label(self) -> str:
        return self.good.label

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        return self.good.transact(request, send=send, receive=receive, timeout=timeout)

    def events(self) -> tuple[PtpEvent, ...]:
        return self.good.events()

    def reset(self) -> None:
        self.good.reset()

    def close(self) -> None:
        self.good.close()


class LosingResponses(TroubledTransport):
    """Carries out operations but loses the responses on an occasion, as if the device were silent."""

    def __init__(self, good: Transport, occasion: Occasion) -> None:
        super().__init__(good)
        self._occasion = occasion

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        transaction = super().transact(request, send=send, receive=receive, timeout=timeout)
        if self._occasion.is_due(request.code):
            raise LinkTimeout(f"{self.label} lost the response to {request} on purpose")
        return transaction


class PulledOut(TroubledTransport):
    """Is disconnected on an occasion, before the operation reaches the device, and stays so."""

    def __init__(self, good: Transport, occasion: Occasion) -> None:
        super().__init__(good)
        self._occasion = occasion

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        if self._occasion.is_due(request.code):
            self.good.close()
        return super().transact(request, send=send, receive=receive, timeout=timeout)
