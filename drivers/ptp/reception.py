"""The part of a transaction that comes from the device, the same on every cable: checked, and handed on.

Laws that hold inside:

- Nothing is kept of a data phase that the caller takes piece by piece; otherwise at most `MAX_COLLECTED` bytes are.
- Data and response must carry the request's transaction number, and a data phase the length that it announced.

Source: ISO 15740:2013, clause 9.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.errors import ProtocolError
from drivers.ptp.messages import Request, Response
from drivers.ptp.transport import MAX_COLLECTED, Transaction


class Reception:
    """Takes what the device sends between a request and the end of its response; `label` names the device."""

    def __init__(self, request: Request, receive: Callable[[bytes], object] | None, label: str) -> None:
        self._request = request
        self._receive = receive
        self._label = label
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
            raise ProtocolError(f"{self._label} sends a second data phase with {self._request}; reset it")
        if self._receive is None and length is not None and length > MAX_COLLECTED:
            raise self._too_long(length)
        self._started = True
        self._announced = length

    def take(self, piece: bytes) -> None:
        """Take the next bytes of the data phase.

        Raises
        ------
        ProtocolError
            They are more than were announced, or more than may be collected.
        """
        if not self._started:
            raise ProtocolError(f"{self._label} sends data with {self._request} but never announced them; reset it")
        self._taken += len(piece)
        if self._announced is not None and self._taken > self._announced:
            raise ProtocolError(
                f"{self._label} announced {self._announced} bytes with {self._request} "
                f"and sends at least {self._taken}; reset it"
            )
        if self._receive is not None:
            if piece:
                self._receive(piece)
        elif self._taken > MAX_COLLECTED:
            raise self._too_long(self._taken)
        else:
            self._collected += piece

    def end(self, response: Response) -> Transaction:
        """Return the transaction that `response` ends.

        Raises
        ------
        ProtocolError
            It is another transaction's, or reports success although data are missing.
        """
        self._check_transaction("a response", response.transaction)
        # A device that gives up in the middle says so by its response: then the response is what counts.
        if response.ok and self._announced is not None and self._taken != self._announced:
            raise ProtocolError(
                f"{self._label} announced {self._announced} bytes with {self._request}, sent {self._taken}, "
                f"and reports success; ask again"
            )
        return Transaction(response, bytes(self._collected))

    def _check_transaction(self, what: str, transaction: int) -> None:
        if transaction != self._request.transaction:
            raise ProtocolError(
                f"{self._label} sends {what} of transaction {transaction} during {self._request}, "
                f"which is transaction {self._request.transaction}; reset it"
            )

    def _too_long(self, length: int) -> ProtocolError:
        return ProtocolError(
            f"{self._label} sends {length} bytes or more with {self._request}; at most {MAX_COLLECTED} were expected"
        )
