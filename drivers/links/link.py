"""A cable is three verbs and a time limit.

Implementations live in `drivers.links`; tests and the simulated lab join two ends in memory. A link translates the
system's errors into `LinkTimeout` and `LinkClosed` at this border and nowhere else.
"""

from __future__ import annotations

from typing import Protocol


class Link(Protocol):
    """One open, ordered, two-way stream of bytes to a device."""

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds.

        Raises
        ------
        LinkTimeout
            Not everything went out in time; how much did is unknown.
        LinkClosed
            The other side hung up.
        """
        ...

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 … `limit` bytes, waiting at most `timeout` seconds for the first.

        Raises
        ------
        LinkTimeout
            Nothing arrived in time.
        LinkClosed
            The other side hung up and everything it sent has been read.
        """
        ...

    def close(self) -> None:
        """Hang up; a second call does nothing."""
        ...
