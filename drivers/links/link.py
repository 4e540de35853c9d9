"""A cable is three verbs and a time limit.

Implementations live in `drivers.links`; tests and the simulated lab join two ends in memory. A link translates the
system's errors into `LinkTimeout` and `LinkClosed` at this border and nowhere else.
"""

from __future__ import annotations

from typing import Protocol


class Link(Protocol):
    """One open, ordered, two-way stream of bytes to a device."""

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""
        ...

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 … `limit` bytes, waiting at most `timeout` seconds for the first."""
        ...

    def close(self) -> None:
        """Hang up; a second call does nothing."""
        ...
