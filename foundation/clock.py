"""Clocks, real and simulated.

Code that waits or records a time takes a `Clock` as a parameter.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Final, Protocol


class Clock(Protocol):
    """Interface of a clock, which gives the date and elapsed seconds, and waits."""

    def now(self) -> datetime:
        """Return the date, timezone-aware, UTC."""

    def monotonic(self) -> float:
        """Return seconds since an arbitrary origin; they never decrease."""

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` (≥ 0)."""


class SystemClock:
    """Clock of the machine."""

    def now(self) -> datetime:
        """Return the date, timezone-aware, UTC."""
        return datetime.now(UTC)

    def monotonic(self) -> float:
        """Return seconds of the machine's monotonic clock."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Block the calling thread for `seconds`."""
        time.sleep(seconds)


SYSTEM_CLOCK: Final = SystemClock()  # Default clock


def elapsed_s() -> float:
    """Return seconds since an arbitrary origin, including the time in suspend mode."""
    # time.monotonic() stops while a Linux machine is suspended.
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


# Smallest adjustment of the system date that counts as made by hand, s. Network time makes smaller adjustments.
MIN_STEP_S = 10.0


class SteadyClock:
    """Clock whose date advances with elapsed time and never goes back, even if the system date is set back.

    White frames are interpolated in time. If the date went back during a session, frames would be interpolated between
    the wrong white frames.

    The start date is the date of `clock`, or `not_before` if this is later. `behind_s`: seconds by which `clock` was
    then behind the start date. `sleep` uses `clock`. `elapsed`: function that returns seconds since any origin; they
    never decrease.
    """

    def __init__(
        self, clock: Clock, not_before: datetime | None = None, elapsed: Callable[[], float] = elapsed_s
    ) -> None:
        date = clock.now()
        self._clock = clock
        self._elapsed = elapsed
        self._start = date if not_before is None else max(date, not_before)
        self._origin = elapsed()
        self.behind_s = (self._start - date).total_seconds()
        self._offset_s = -self.behind_s

    def step_s(self) -> float:
        """Return the adjustment of the date of `clock` since the last returned one, s; 0 below `MIN_STEP_S`."""
        offset_s = (self._clock.now() - self.now()).total_seconds()
        step_s = offset_s - self._offset_s
        if abs(step_s) < MIN_STEP_S:
            return 0.0
        self._offset_s = offset_s
        return step_s

    def now(self) -> datetime:
        """Return the date at the start plus the elapsed time, timezone-aware, UTC."""
        return self._start + timedelta(seconds=self._elapsed() - self._origin)

    def monotonic(self) -> float:
        """Return the seconds of `clock.monotonic()`."""
        return self._clock.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait for `seconds` (≥ 0)."""
        self._clock.sleep(seconds)


# Start of simulated time for a new session.
SIM_START = datetime(2026, 1, 1, 8, 0, 0, tzinfo=UTC)


class SimulatedClock:
    """Clock whose time advances only in `sleep`."""

    def __init__(self, start: datetime = SIM_START) -> None:
        self._start = start
        self._elapsed = timedelta()

    def now(self) -> datetime:
        """Return the simulated date, UTC."""
        return self._start + self._elapsed

    def monotonic(self) -> float:
        """Return simulated seconds since the start of this clock."""
        return self._elapsed.total_seconds()

    def sleep(self, seconds: float) -> None:
        """Advance simulated time by `seconds` (≥ 0) and return at once."""
        if seconds < 0:
            raise ValueError(f"cannot sleep {seconds} s, expected 0 s or more")
        self._elapsed += timedelta(seconds=seconds)
