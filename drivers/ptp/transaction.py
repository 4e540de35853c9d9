"""One transaction of PTP, whatever the cable: a request, at most one data phase, a response; and the events beside it.

Rules that hold inside:

- A `Transport` deals with bytes, pipes and time limits, not with sessions or the meaning of operations. Codes stay
  plain integers, for a device may use any; `drivers.ptp.codes` names those that are known.
- Nothing is kept of a data phase that the caller takes piece by piece; otherwise at most `MAX_COLLECTED` bytes are.
- Data and response must carry the request's transaction number, and a data phase the length that it announced.
- A transaction that did not reach its response leaves the cable without a known place: every further one is refused
  until the cable has been reset. Where the fault was the caller's, who could not take the data, the transaction is
  called off, so that the session lives on.

Source: ISO 15740:2013, clause 9.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.ptp.codes import EventCode, Operation, ResponseCode, describe
from foundation.errors import LinkClosed, LinkError, ProtocolError

MAX_PARAMETERS = 5
"""Parameters of 32 bits that a request, response or event may carry."""
LAST_TRANSACTION = 0xFFFFFFFE
"""The highest transaction number; 1 follows it, for 0 and 0xffffffff are taken."""


@dataclass(frozen=True)
class PtpRequest:
    """An operation that the initiator asks for."""

    code: int
    transaction: int = 0
    parameters: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{describe(Operation, self.code)}{_listed(self.parameters)}"


@dataclass(frozen=True)
class PtpResponse:
    """How an operation ended; `transaction` is the request's."""

    code: int
    transaction: int = 0
    parameters: tuple[int, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the operation was carried out."""
        return self.code == ResponseCode.OK

    def __str__(self) -> str:
        return f"{describe(ResponseCode, self.code)}{_listed(self.parameters)}"


@dataclass(frozen=True)
class PtpEvent:
    """Something that happened in the device; `transaction` is 0xffffffff where it belongs to none."""

    code: int
    transaction: int = 0xFFFFFFFF
    parameters: tuple[int, ...] = ()

    def __str__(self) -> str:
        return f"{describe(EventCode, self.code)}{_listed(self.parameters)}"


def next_transaction(transaction: int) -> int:
    """Return the number that follows `transaction`; OpenSession carries 0 and 0xffffffff means none."""
    return 1 if transaction >= LAST_TRANSACTION else transaction + 1


def _listed(parameters: tuple[int, ...]) -> str:
    return "(" + ", ".join(f"0x{parameter:x}" for parameter in parameters) + ")" if parameters else ""


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
