"""Time as people want to know it: how long a session will still take, and durations in words."""

from __future__ import annotations

import statistics
from collections.abc import Collection


def time_left(intervals: Collection[float], attempts: int, gained: int, left: int) -> float | None:
    """Return how long the frames that are left will take, seconds; None while that is unknown.

    Each frame costs as many attempts as frames have cost lately, retakes and references included; each attempt the
    median interval, so that a pause does not count for ever.

    Parameters
    ----------
    intervals
        Seconds from one attempt to the next, of the newest attempts.
    attempts, gained
        How many of the newest attempts there are, and how many of them gave a frame that was accepted.
    left
        Steps without an accepted frame.

    Examples
    --------
    >>> time_left([5.0, 5.0, 300.0, 5.0], attempts=6, gained=4, left=10)
    75.0
    """
    if not left:
        return 0.0
    if not intervals or not gained:
        return None
    return statistics.median(intervals) * attempts / gained * left


def duration_text(seconds: float | None) -> str:
    """Return seconds as ``2 h 05 min``, ``3 min 20 s`` or ``45 s``; ``unknown`` for None."""
    if seconds is None:
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
