"""Times in which the program stood still: the machine slept, or somebody stopped the process."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Self

from foundation import clock

TICK_S: Final = 1.0
"""Between two looks at the time."""

GAP_S: Final = 10.0
"""A look that comes so late was held up: a busy machine lets a thread wait for a second or two."""


class GapWatch:
    """Looks at the time in a thread of its own, and notes where it jumped; use it in a `with` block.

    `elapsed`: returns seconds that pass while the machine sleeps, too; None: the machine's.
    """

    def __init__(self, elapsed: Callable[[], float] | None = None) -> None:
        self._elapsed = elapsed or clock.elapsed_s
        self._lock = threading.Lock()
        self._last = self._elapsed()
        self._gap_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="gaps", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def taken(self) -> float:
        """Return for how long the program stood still since this was asked last, seconds; 0 where it did not."""
        self._look()
        with self._lock:
            gap_s, self._gap_s = self._gap_s, 0.0
        return gap_s

    def _look(self) -> None:
        with self._lock:
            now = self._elapsed()
            passed, self._last = now - self._last, now
            if passed > GAP_S:
                self._gap_s += passed

    def _watch(self) -> None:
        while not self._over.wait(TICK_S):
            self._look()
