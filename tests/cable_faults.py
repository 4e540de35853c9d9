"""Faults of cameras and cables, each as a wrapper around a device or cable that works.

Three places can be troubled: the device, as a `drivers.ptp.protocol.Responder`; its pipes, as
`drivers.links.usb.UsbPipes`; the whole cable, as a `drivers.ptp.protocol.Transport`. A wrapper keeps the contract
of what it wraps and may be wrapped again. What happens and when is set on construction; nothing is random.

A device that restarts in the middle of an operation is `Interrupting` with the simulated bus's ``replug``, one that is
pulled out the same with ``unplug``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from drivers.links.usb import Pipe, PipeStalled, UsbPipes
from drivers.ptp.protocol import Answer, NoAnswer, PtpEvent, PtpRequest, PtpResponse, Responder, Transaction, Transport
from drivers.ptp.usb import HEADER_LENGTH
from foundation.errors import LinkClosed, LinkTimeout


class Occasion:
    """Some of the operations that come: those of `codes` (None: all), without the first `after`, `times` of them.

    `times` None means all that follow. Each is asked about once, in order.
    """

    def __init__(self, codes: Collection[int] | None = None, *, after: int = 0, times: int | None = 1) -> None:
        self._codes = codes
        self._after = after
        self._times = times
        self._seen = 0

    def has_come(self, code: int) -> bool:
        """Count an operation and return whether it is one of them."""
        if self._codes is not None and code not in self._codes:
            return False
        self._seen += 1
        number = self._seen - 1 - self._after
        return number >= 0 and (self._times is None or number < self._times)


class TroubledResponder:
    """A device that passes everything on; what goes wrong is in the subclasses."""

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
    """Answers `code`, such as DEVICE_BUSY, on an occasion, and carries nothing out."""

    def __init__(self, good: Responder, code: int, occasion: Occasion) -> None:
        super().__init__(good)
        self._code = code
        self._occasion = occasion

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Decline, or ask the good device."""
        if self._occasion.has_come(request.code):
            return Answer(PtpResponse(self._code, request.transaction))
        return super().answer(request, data)


class Hanging(TroubledResponder):
    """Does not answer on an occasion; `obeys`: whether it carries the operation out all the same."""

    def __init__(self, good: Responder, occasion: Occasion, *, obeys: bool = False) -> None:
        super().__init__(good)
        self._occasion = occasion
        self._obeys = obeys

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Hang, or ask the good device."""
        if self._occasion.has_come(request.code):
            if self._obeys:
                super().answer(request, data)
            raise NoAnswer
        return super().answer(request, data)


class Interrupting(TroubledResponder):
    """Has something happen on an occasion, before the operation is carried out."""

    def __init__(self, good: Responder, happens: Callable[[], object], occasion: Occasion) -> None:
        super().__init__(good)
        self._happens = happens
        self._occasion = occasion

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Let it happen, then ask the good device."""
        if self._occasion.has_come(request.code):
            self._happens()
        return super().answer(request, data)


class Falsifying(TroubledResponder):
    """Sends other data than the good device on an occasion: fewer, more, or garbage."""

    def __init__(self, good: Responder, change: Callable[[bytes], bytes], occasion: Occasion) -> None:
        super().__init__(good)
        self._change = change
        self._occasion = occasion

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Ask the good device, and change the data."""
        answer = super().answer(request, data)
        if self._occasion.has_come(request.code) and answer.data is not None:
            return Answer(answer.response, self._change(answer.data))
        return answer


class ChangingEvents(TroubledResponder):
    """Reports other events than the good device: none, each several times, unknown ones between."""

    def __init__(self, good: Responder, change: Callable[[tuple[PtpEvent, ...]], tuple[PtpEvent, ...]]) -> None:
        super().__init__(good)
        self._change = change

    def events(self) -> tuple[PtpEvent, ...]:
        """Take the good device's events, and change them."""
        return self._change(super().events())


class DelayingEvents(TroubledResponder):
    """Reports each event only after it was asked `calls` times more."""

    def __init__(self, good: Responder, calls: int) -> None:
        super().__init__(good)
        self._under_way: list[tuple[PtpEvent, ...]] = [()] * calls

    def events(self) -> tuple[PtpEvent, ...]:
        """Return what came up some calls ago."""
        self._under_way.append(super().events())
        return self._under_way.pop(0)


class TroubledPipes:
    """Pipes that pass everything on; what goes wrong is in the subclasses."""

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
    """Stalls a bulk pipe at the transfers with these numbers, counted from 0, before anything went through."""

    def __init__(self, good: UsbPipes, pipe: Pipe, transfers: Collection[int]) -> None:
        super().__init__(good)
        self._pipe = pipe
        self._transfers = transfers
        self._next = 0
        self._halted = False

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Stall, or write to the good pipe."""
        self._meet(Pipe.BULK_OUT)
        super().bulk_write(data, timeout)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Stall, or read from the good pipe."""
        self._meet(Pipe.BULK_IN)
        return super().bulk_read(limit, timeout)

    def clear_halt(self, pipe: Pipe) -> None:
        """End the stall."""
        if pipe is self._pipe:
            self._halted = False
        super().clear_halt(pipe)

    def _meet(self, pipe: Pipe) -> None:
        if pipe is not self._pipe:
            return
        if not self._halted:
            self._halted = self._next in self._transfers
            self._next += 1
        if self._halted:
            raise PipeStalled(f"{self.label} stalls on purpose")


class ShortReads(TroubledPipes):
    """Never gives more than `packets` packets at once."""

    def __init__(self, good: UsbPipes, packets: int = 1) -> None:
        super().__init__(good)
        self._packets = packets

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read less than was asked for."""
        return super().bulk_read(min(limit, self._packets * self.packet_size), timeout)


class HeaderAlone(TroubledPipes):
    """Gives the first 12 bytes of every read for themselves, as devices do that send the header in its own transfer."""

    def __init__(self, good: UsbPipes) -> None:
        super().__init__(good)
        self._kept = b""

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read the header, or what was left behind it."""
        data, self._kept = self._kept or super().bulk_read(limit, timeout), b""
        if len(data) <= HEADER_LENGTH or data[4:6] != b"\x02\x00":
            return data
        data, self._kept = data[:HEADER_LENGTH], data[HEADER_LENGTH:]
        return data


class Joining(TroubledPipes):
    """Gives all that the device has to say in one read, as far as there is room: data and response together."""

    def __init__(self, good: UsbPipes) -> None:
        super().__init__(good)
        self._waiting = bytearray()

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read on until nothing comes any more."""
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
    """Leaves out the zero-length packets that close full transfers, as some devices do."""

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read the next packet that is not empty."""
        while not (data := super().bulk_read(limit, timeout)):
            pass
        return data


class CutOff(TroubledPipes):
    """Is pulled out once `after` bytes have come in over the bulk pipe."""

    def __init__(self, good: UsbPipes, after: int) -> None:
        super().__init__(good)
        self._left = after

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Write, while the cable is in."""
        self._check()
        super().bulk_write(data, timeout)

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read what still comes through."""
        self._check()
        data = super().bulk_read(limit, timeout)
        through, self._left = data[: self._left], self._left - len(data)
        if not through:
            self._check()
        return through

    def _check(self) -> None:
        if self._left <= 0:
            raise LinkClosed(f"{self.label} was pulled out on purpose")


class Deaf(TroubledPipes):
    """Gives nothing more on the bulk pipe after `reads` reads."""

    def __init__(self, good: UsbPipes, reads: int) -> None:
        super().__init__(good)
        self._left = reads

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read, as long as something comes."""
        if self._left <= 0:
            raise LinkTimeout(f"{self.label} gives nothing, on purpose")
        self._left -= 1
        return super().bulk_read(limit, timeout)


class Garbling(TroubledPipes):
    """Changes what comes in over the bulk pipe."""

    def __init__(self, good: UsbPipes, change: Callable[[bytes], bytes]) -> None:
        super().__init__(good)
        self._change = change

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Read, and change what came."""
        return self._change(super().bulk_read(limit, timeout))


class TroubledTransport:
    """A cable that passes everything on; what goes wrong is in the subclasses."""

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
    """Carries operations out but loses the responses on an occasion: to the caller the device fell silent."""

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
        """Carry it out, and perhaps say nothing of it."""
        done = super().transact(request, send=send, receive=receive, timeout=timeout)
        if self._occasion.has_come(request.code):
            raise LinkTimeout(f"{self.label} lost the response to {request} on purpose")
        return done


class PulledOut(TroubledTransport):
    """Is pulled out on an occasion, before the operation reaches the device, and stays out."""

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
        """Pull the cable, or carry it out."""
        if self._occasion.has_come(request.code):
            self.good.close()
        return super().transact(request, send=send, receive=receive, timeout=timeout)
