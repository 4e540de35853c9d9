"""The other end of PTP: the interface of a simulated device, whatever the cable.

`sim.camera.eos` is one; `sim.buses.usb`, `sim.buses.ptp` and `sim.buses.usbip` put it on a cable. A responder
deals with operations and state, not with containers or packets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from drivers.ptp.session import PtpEvent, PtpRequest, PtpResponse


@dataclass(frozen=True)
class Answer:
    """A response, and the data phase before it; None where there is none (an empty one is b"")."""

    response: PtpResponse
    data: bytes | None = None


class NoAnswer(Exception):
    """Raised instead of answering: the device says nothing, and the initiator waits in vain."""


class Responder(Protocol):
    """A device that answers one request at a time."""

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
