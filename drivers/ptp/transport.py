"""The interface of a PTP cable to a device: one transaction at a time, and the events beside it.

The contract of `drivers.ptp.usb_transport` and `drivers.ptp.ip_transport`; the simulated lab has one in memory.
A transport deals with bytes, pipes and time limits, not with sessions or the meaning of operations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from drivers.ptp.messages import PtpEvent, PtpRequest, PtpResponse

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
