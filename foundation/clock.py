"""Time is handed in, so that a simulated lab need not wait.

Whoever waits or stamps a time takes a `Clock`. `SystemClock` is the real one; the simulated one lives in `sim.clock`.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Protocol


class Clock(Protocol):
    """The interface of a clock: the date, seconds that pass, and waiting."""

    def now(self) -> datetime:
        """Return the wall-clock time, timezone-aware, UTC."""
        ...

    def monotonic(self) -> float:
        """Return seconds since an arbitrary origin; never goes back."""
        ...

    def sleep(self, seconds: float) -> None:
        """Let `seconds` (≥ 0) pass."""
        ...


class SystemClock:
    """The machine's own time."""

    def now(self) -> datetime:
        """Return the wall-clock time, timezone-aware, UTC."""
        return datetime.now(UTC)

    def monotonic(self) -> float:
        """Return seconds of the machine's monotonic clock."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Block the calling thread for `seconds`."""
        time.sleep(seconds)
