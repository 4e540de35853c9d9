"""Time as people want to know it: how long a session will still take, and durations in words."""

from __future__ import annotations

import statistics
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

RECENT = 50
"""Attempts by which the time left is told: enough that retakes and references do not sway their median, few enough to
follow a change of the settings."""


@dataclass(frozen=True)
class TimedAttempt:
    """How long after the one before an attempt came, seconds, None behind a pause; and whether it gave its frame."""

    seconds: float | None
    gained: bool


def time_left(attempts: Iterable[TimedAttempt], left: int) -> float | None:
    """Return how long the frames that are left will take, seconds; None while that is unknown.

    Each frame costs as many attempts as frames have cost lately, retakes and references included; each attempt the
    median interval, so that a pause does not count for ever.

    `attempts`: those that are judged, oldest first; the newest `RECENT` count.

    Examples
    --------
    >>> night = [TimedAttempt(seconds, gained=seconds != 7) for seconds in (None, 5, 300, 5, 7, 7)]
    >>> time_left(night, left=10)
    105.0
    """
    if not left:
        return 0.0
    recent = deque(attempts, RECENT)
    intervals = [attempt.seconds for attempt in recent if attempt.seconds is not None]
    gained = sum(attempt.gained for attempt in recent)
    if not intervals or not gained:
        return None
    return statistics.median(intervals) * len(recent) / gained * left


def duration_text(seconds: float | None) -> str:
    """Return seconds as ``2 h 05 min``, ``3 min 20 s`` or ``45 s``; ``unknown`` for None."""
    if seconds is None:
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
