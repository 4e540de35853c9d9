"""What passes between the two ends of PTP, whatever the cable: requests, responses, events.

A transaction is one `PtpRequest`, then at most one data phase in either direction, then one `PtpResponse`. A `PtpEvent`
comes from the responder at any time. Codes stay plain integers here, for a device may use any; `drivers.ptp.codes`
names those that are known.

Source: ISO 15740:2013, clause 9.
"""

from __future__ import annotations

from dataclasses import dataclass

from drivers.ptp.codes import EventCode, Operation, ResponseCode, describe

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
