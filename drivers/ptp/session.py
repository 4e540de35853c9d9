"""A PTP session and its numbered transactions: request, at most one data phase, response, events; over any cable.

Rules that hold inside:

- A response other than OK raises `OperationDeclined`, which has its code by number and by name; what a device declines
  for the moment only (`PASSING`) is asked again, for a limited time.
- A fault of cable or protocol goes straight to the caller: whether an operation may be repeated is not known here.
  After one, the session is spent; a new one begins with `Transport.reset` or a new transport.

Source: ISO 15740:2013, clause 9.3 (sessions and transactions).
"""

from __future__ import annotations

import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, ClassVar, Protocol

from drivers.ptp.codes import EventCode, Operation, ResponseCode
from drivers.ptp.datasets import U16, U32, Cursor, FieldKind, PtpDataset, describe, encode_integer
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError

_log = logging.getLogger(__name__)

START_TIMEOUT_S = 1.5
"""Wait for the answer to OpenSession: a body that a killed host left behind never answers before a reset."""
TIMEOUT_S = 20.0
"""Wait for every other answer, unless the caller sets another; libgphoto2 waits as long."""
PASSING_LIMIT_S = 10.0
"""How long an operation is asked again when a device declines it for the moment."""
OPEN_TRIES = 3
"""Tries at OpenSession with a reset between them, as many as libgphoto2 makes."""

PASSING = (ResponseCode.DEVICE_BUSY, ResponseCode.EOS_OBJECT_NOT_READY, ResponseCode.EOS_MEMORY_STATUS_NOT_READY)
"""Responses that mean: not now."""

_FIRST_PAUSE_S = 0.05
"""Before the first repetition: short to an operator, long beside the milliseconds of an operation."""
_LONGEST_PAUSE_S = 1.0
"""Pauses double up to here, so that a device that is free again waits for a second at most."""
_LAST_SESSION = 8
"""Session numbers tried where a device declines the transaction number, as libgphoto2 does; a few, then no more."""


class OperationDeclined(DeviceRefused):
    """A device answered an operation with another response than OK: `code`."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


_REMEDIES: dict[int, str] = {
    ResponseCode.STORE_FULL: "; its card is full: empty it, or put another in",
    ResponseCode.STORE_READ_ONLY: "; its card is read-only: unlock it",
    ResponseCode.EOS_LOW_BATTERY: "; its battery is empty: change it, or connect a mains adapter",
}


class PtpSession:
    """The initiator's side of a session."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport = transport
        self._clock = clock
        self._transaction = 0

    @property
    def label(self) -> str:
        """What messages call the device."""
        return self._transport.label

    def open(self) -> None:
        """Open the session; one that a former host left open is taken over."""
        faults = 0
        session = 1
        pauses = self._pauses(PASSING_LIMIT_S)
        while True:
            try:
                code = self._transport.transact(
                    PtpRequest(Operation.OPEN_SESSION, 0, (session,)), timeout=START_TIMEOUT_S
                ).response.code
            except (LinkTimeout, ProtocolError):
                faults += 1
                if faults == OPEN_TRIES:
                    raise
                self._transport.reset()
                continue
            if code in (ResponseCode.OK, ResponseCode.SESSION_ALREADY_OPEN):
                self._transaction = 0
                return
            if code == ResponseCode.INVALID_TRANSACTION_ID and session < _LAST_SESSION:
                session += 1
            elif code not in PASSING or not next(pauses, False):
                raise self._declined(PtpRequest(Operation.OPEN_SESSION, 0, (session,)), code)

    def close(self) -> None:
        """Close the session as far as the device still answers; the cable stays open."""
        with contextlib.suppress(DeviceError):
            self.call(Operation.CLOSE_SESSION, timeout=START_TIMEOUT_S, retry_s=0.0)

    def call(
        self,
        operation: int,
        *parameters: int,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float = TIMEOUT_S,
        retry_s: float = PASSING_LIMIT_S,
    ) -> tuple[tuple[int, ...], bytes]:
        """Carry out an operation.

        `send`: the data phase to the device; None where the operation has none. `receive`: takes the data phase from
        the device piece by piece; None collects it. `timeout`: longest wait for each answer, seconds. `retry_s`: how
        long it is asked again when the device declines for the moment, seconds.
        """
        pauses = self._pauses(retry_s)
        while True:
            self._transaction = next_transaction(self._transaction)
            request = PtpRequest(operation, self._transaction, parameters)
            done = self._transport.transact(request, send=send, receive=receive, timeout=timeout)
            answered = describe(ResponseCode, done.response.code)
            _log.debug("%s%s: %s", describe(Operation, operation), parameters, answered)
            if done.response.ok:
                return done.response.parameters, done.data
            # A device that declines sends no data, so that `receive` has seen nothing of a try that is repeated.
            if done.response.code not in PASSING or not next(pauses, False):
                raise self._declined(request, done.response.code)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that came on the event channel since the last call; never waits."""
        return self._transport.events()

    def _pauses(self, limit: float) -> Iterator[bool]:
        """Let growing pauses pass, one at each step; end when `limit` seconds are over."""
        end = self._clock.monotonic() + limit
        pause = _FIRST_PAUSE_S
        while (left := end - self._clock.monotonic()) > 0:
            self._clock.sleep(min(pause, left))
            pause = min(2 * pause, _LONGEST_PAUSE_S)
            yield True

    def _declined(self, request: PtpRequest, code: int) -> OperationDeclined:
        remedy = "; wait until it is idle, then try again" if code in PASSING else _REMEDIES.get(code, "")
        return OperationDeclined(f"{self.label} answers {describe(ResponseCode, code)} to {request}{remedy}", code)


MAX_PARAMETERS = 5
"""Parameters of 32 bits that a request, response or event may carry."""
LAST_TRANSACTION = 0xFFFFFFFE
"""The highest transaction number; 1 follows it, for 0 and 0xffffffff are taken."""


def _read_parameters(cursor: Cursor, field: str) -> tuple[int, ...]:
    count, odd = divmod(cursor.left, 4)
    if odd or count > MAX_PARAMETERS:
        expected = f"0 to {MAX_PARAMETERS} of 4 bytes"
        raise cursor.fault(f"the list of {field}", expected, f"{cursor.left} bytes", at=cursor.at)
    return cursor.integers(count, 4, field)


def _encode_parameters(parameters: tuple[int, ...]) -> bytes:
    if len(parameters) > MAX_PARAMETERS:
        raise ValueError(f"{len(parameters)} parameters; at most {MAX_PARAMETERS} are possible")
    return b"".join(encode_integer(parameter, 4) for parameter in parameters)


@dataclass(frozen=True)
class _Coded(PtpDataset):
    """What request, response and event have: a number of `codes`, and parameters; in text ``NAME(0x1, 0x2)``."""

    codes: ClassVar[type[IntEnum]]
    code: U16
    transaction: U32 = 0
    parameters: Annotated[tuple[int, ...], FieldKind(_read_parameters, _encode_parameters)] = ()

    def __str__(self) -> str:
        listed = ", ".join(f"0x{parameter:x}" for parameter in self.parameters)
        return describe(self.codes, self.code) + (f"({listed})" if listed else "")


@dataclass(frozen=True)
class PtpRequest(_Coded):
    """An operation that the initiator asks for."""

    codes = Operation


@dataclass(frozen=True)
class PtpResponse(_Coded):
    """How an operation ended; `transaction` is the request's."""

    codes = ResponseCode

    @property
    def ok(self) -> bool:
        """Whether the operation was carried out."""
        return self.code == ResponseCode.OK


@dataclass(frozen=True)
class PtpEvent(_Coded):
    """Something that happened in the device; `transaction` is 0xffffffff where it belongs to none."""

    codes = EventCode
    transaction: U32 = 0xFFFFFFFF


def next_transaction(transaction: int) -> int:
    """Return the number that follows `transaction`; OpenSession carries 0 and 0xffffffff means none."""
    return 1 if transaction >= LAST_TRANSACTION else transaction + 1


MAX_COLLECTED = 4 * 1024 * 1024
"""Bytes of a data phase that a transport collects for a caller who takes none of it piece by piece."""


@dataclass(frozen=True)
class Transaction:
    """How a transaction ended: the device's response, and the data phase if it was collected."""

    response: PtpResponse
    data: bytes = b""


class Transport(Protocol):
    """An open cable to a PTP device, seen from the initiator."""

    @property
    def label(self) -> str:
        """What messages call the device: address and name as far as known."""
        ...

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction.

        `send`: the data phase to the device; None where the operation has none. `receive`: takes the data phase from
        the device piece by piece; None collects up to `MAX_COLLECTED` bytes. `timeout`: longest wait for each answer of
        the device, seconds.
        """
        ...

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call; never waits."""
        ...

    def reset(self) -> None:
        """Bring cable and device back to where a session can be opened; costs a session that is open."""
        ...

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        ...


@dataclass(frozen=True)
class Answer:
    """A response, and the data phase before it; None where there is none (an empty one is b"")."""

    response: PtpResponse
    data: bytes | None = None


class NoAnswer(Exception):
    """Raised instead of answering: the device says nothing, and the initiator waits in vain."""


class Responder(Protocol):
    """The other end of a cable: a device that answers one request at a time, without containers or packets."""

    def takes_data(self, request: PtpRequest) -> bool:
        """Return whether the initiator sends a data phase with this operation."""
        ...

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Carry out a request; `data` is the initiator's data phase."""
        ...

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come up since the last call."""
        ...

    def cancelled(self, transaction: int) -> None:
        """Note that the initiator gave up a transaction."""
        ...

    def unplugged(self) -> None:
        """Note that the cable was pulled or reset: the session is over."""
        ...


class Reception:
    """Takes what the device sends between a request and the end of its response; `label` names the device."""

    def __init__(self, request: PtpRequest, receive: Callable[[bytes], object] | None, label: str) -> None:
        self.request = request
        self._receive = receive
        self.label = label
        self._started = False
        self._announced: int | None = None
        self._taken = 0
        self._collected = bytearray()

    @property
    def left(self) -> int | None:
        """Bytes of the data phase still to come; None where no length was announced."""
        return None if self._announced is None else self._announced - self._taken

    def start(self, transaction: int, length: int | None) -> None:
        """Note that a data phase of `length` bytes begins; None where the device does not know."""
        self._check_transaction("data", transaction)
        if self._started:
            raise ProtocolError(f"{self.label} sends a second data phase with {self.request}; reset it")
        if self._receive is None and length is not None and length > MAX_COLLECTED:
            raise self._too_long(length)
        self._started = True
        self._announced = length

    def take(self, piece: bytes) -> None:
        """Take the next bytes of the data phase."""
        if not self._started:
            raise ProtocolError(f"{self.label} sends data with {self.request} but never announced them; reset it")
        self._taken += len(piece)
        if self._announced is not None and self._taken > self._announced:
            raise ProtocolError(
                f"{self.label} announced {self._announced} bytes with {self.request} "
                f"and sends at least {self._taken}; reset it"
            )
        if self._receive is not None:
            if piece:
                self._receive(piece)
        elif self._taken > MAX_COLLECTED:
            raise self._too_long(self._taken)
        else:
            self._collected += piece

    def end(self, response: PtpResponse) -> Transaction:
        """Return the transaction that `response` ends."""
        self._check_transaction("a response", response.transaction)
        # A device that gives up in the middle reports that by its response: then the response is what counts.
        if response.ok and self._announced is not None and self._taken != self._announced:
            raise ProtocolError(
                f"{self.label} announced {self._announced} bytes with {self.request}, sent {self._taken}, "
                f"and reports success; ask again"
            )
        return Transaction(response, bytes(self._collected))

    def _check_transaction(self, what: str, transaction: int) -> None:
        if transaction != self.request.transaction:
            raise ProtocolError(
                f"{self.label} sends {what} of transaction {transaction} during {self.request}, "
                f"which is transaction {self.request.transaction}; reset it"
            )

    def _too_long(self, length: int) -> ProtocolError:
        return ProtocolError(
            f"{self.label} sends {length} bytes or more with {self.request}; at most {MAX_COLLECTED} were expected"
        )


class CableTransport(ABC):
    """A `Transport` over a real cable: one transaction after the other, and none where one was left unfinished."""

    def __init__(self) -> None:
        self.closed = False
        self.between_transactions = True

    @property
    @abstractmethod
    def label(self) -> str:
        """What messages call the device: address and name as far as known."""

    @abstractmethod
    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request and the data phase to the device, and return what the device answers."""

    @abstractmethod
    def call_off(self, transaction: int) -> bool:
        """Call off a transaction whose data the caller cannot take; return whether the next can follow."""

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction; see `Transport`."""
        self.check_open()
        if not self.between_transactions:
            raise ProtocolError(f"{self.label}: the transaction before {request} did not end; reset the connection")
        self.between_transactions = False
        try:
            transaction = self.exchange(Reception(request, receive, self.label), send, timeout)
        except LinkClosed:
            self.closed = True
            raise
        except (LinkError, ProtocolError):
            raise
        except BaseException:
            self.between_transactions = self.call_off(request.transaction)
            raise
        self.between_transactions = True
        return transaction

    def check_open(self) -> None:
        """Require that the cable is open."""
        if self.closed:
            raise LinkClosed(f"{self.label} is gone, or the connection to it was closed; open it again")
