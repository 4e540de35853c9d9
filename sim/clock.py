"""Time in the simulated lab: it passes only when somebody waits for it."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

OPENING = datetime(2026, 1, 1, 8, 0, 0, tzinfo=UTC)
"""When the simulated lab opens for a session that has not begun."""


class SimulatedClock:
    """A `foundation.clock.Clock` that stands still until `sleep` moves it."""

    def __init__(self, start: datetime = OPENING) -> None:
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
