"""Time is handed in, so that a simulated lab need not wait.

Whoever waits or stamps a time takes a `Clock`. `SystemClock` is the real one, `SteadyClock` one whose date is not set
back, `SimulatedClock` the simulated lab's, whose time passes only when somebody waits for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Final, Protocol


class Clock(Protocol):
    """The interface of a clock: the date, seconds that pass, and waiting."""

    def now(self) -> datetime:
        """Return the wall-clock time, timezone-aware, UTC."""

    def monotonic(self) -> float:
        """Return seconds since an arbitrary origin; never goes back."""

    def sleep(self, seconds: float) -> None:
        """Let `seconds` (≥ 0) pass."""


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


SYSTEM_CLOCK: Final = SystemClock()  # The clock of whoever is given none


def elapsed_s() -> float:
    """Return seconds since an arbitrary origin that nobody sets; those of a suspended machine count on Linux."""
    # time.monotonic() stands still there while the machine is suspended.
    return time.clock_gettime(time.CLOCK_BOOTTIME) if hasattr(time, "CLOCK_BOOTTIME") else time.monotonic()


# Smallest step of the system clock that counts as set by hand, s: network time corrections are smaller in one night.
MIN_STEP_S = 10.0


class SteadyClock:
    """A clock whose date goes on as seconds pass, and never back, whatever the machine's clock is set to meanwhile.

    White frames are interpolated in time: where that clock is set back during a session, lights would lie between the
    wrong ones. `clock` tells the date once, which is `not_before` (with a time zone) at least, and makes every pause;
    `elapsed` returns seconds since any origin, and never goes back.
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
        """Seconds by which `clock` was behind `not_before` at the start; 0 where it was not."""
        self._set_by_s = -self.behind_s

    def step_s(self) -> float:
        """Return the seconds by which the date of `clock` was set since this was asked last; 0 below `MIN_STEP_S`."""
        step_s = (self._clock.now() - self.now()).total_seconds()
        moved_s = step_s - self._set_by_s
        if abs(moved_s) < MIN_STEP_S:
            return 0.0
        self._set_by_s = step_s
        return moved_s

    def now(self) -> datetime:
        """Return the date at the start and what has passed since, timezone-aware, UTC."""
        return self._start + timedelta(seconds=self._elapsed() - self._origin)

    def monotonic(self) -> float:
        """Return seconds of the clock that was handed in."""
        return self._clock.monotonic()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` (≥ 0) pass."""
        self._clock.sleep(seconds)


# Start of simulated time for a new session.
SIM_START = datetime(2026, 1, 1, 8, 0, 0, tzinfo=UTC)


class SimulatedClock:
    """A clock that stands still until `sleep` moves it."""

    def __init__(self, start: datetime = SIM_START) -> None:
        self._start = start
        self._elapsed = timedelta()

    def now(self) -> datetime:
        """Return the simulated wall-clock time, UTC."""
        return self._start + self._elapsed

    def monotonic(self) -> float:
        """Return simulated seconds since this clock was made."""
        return self._elapsed.total_seconds()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` (≥ 0) of simulated time pass at once."""
        if seconds < 0:
            raise ValueError(f"cannot sleep {seconds} s")
        self._elapsed += timedelta(seconds=seconds)
