"""Whether the run gets on: times in which the program stood still, and steps that take longer than they should.

The machine slept, or somebody stopped the process: nobody knows what the screen showed meanwhile. A step that hangs, a
camera that does not answer for one, leaves the run unable to say so itself: a thread of its own looks, each second.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final, Self

from experiment.session.records import duration_text
from foundation import clock

TICK_S: Final = 1.0
"""Between two looks at the time."""

GAP_S: Final = 10.0
"""A look that comes so late was held up: a busy machine lets a thread wait for a second or two."""

LATE_TIMES: Final = 3.0
"""A step is late when it takes so many times as long as it is expected to: a download that is tried again takes two."""

LATE_S: Final = 10.0
"""And so many seconds more: a disk, or a machine with other work, may stall for some."""


@dataclass
class _Step:
    """What `device` does since `begun`, seconds as they elapse; `expected_s` is what it takes."""

    device: str
    doing: str
    expected_s: float
    begun: float
    is_told: bool = False


class RunWatch:
    """Looks at the time in a thread of its own; use it in a `with` block.

    `on_late`: called by that thread, once for a step that is late, with the sentence that says so and when it began.
    `elapsed`: returns seconds that pass while the machine sleeps, too; None: the machine's.
    """

    def __init__(
        self,
        on_late: Callable[[str, datetime], object] = lambda sentence, begun: None,
        elapsed: Callable[[], float] | None = None,
    ) -> None:
        self._on_late = on_late
        self._elapsed = elapsed or clock.elapsed_s
        self._lock = threading.Lock()
        self._last = self._elapsed()
        self._gap_s = 0.0
        self._step: _Step | None = None
        self._took: dict[str, float] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watch", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def gap_s(self) -> float:
        """Return for how long the program stood still since this was asked last, seconds; 0 where it did not."""
        self.look()
        with self._lock:
            gap_s, self._gap_s = self._gap_s, 0.0
        return gap_s

    @contextmanager
    def step(self, device: str, doing: str, expected_s: float, kind: str) -> Generator[None]:
        """Note what a device does in the block: at least `expected_s`, or as long as the last of its `kind` took."""
        step = _Step(device, doing, max(expected_s, self._took.get(kind, 0.0)), self._elapsed())
        with self._lock:
            self._step = step
        try:
            yield
        finally:
            with self._lock:
                self._step = None
                if not step.is_told:
                    self._took[kind] = self._elapsed() - step.begun

    def look(self) -> None:
        """Look at the time."""
        late: _Step | None = None
        with self._lock:
            now = self._elapsed()
            passed, self._last = now - self._last, now
            step = self._step
            if passed > GAP_S:
                self._gap_s += passed
                if step is not None:
                    step.begun += passed
            if step is not None and not step.is_told and now - step.begun > LATE_TIMES * step.expected_s + LATE_S:
                late, step.is_told = step, True
        if late is not None:
            begun = datetime.now(UTC) - timedelta(seconds=now - late.begun)
            expected = duration_text(late.expected_s) if late.expected_s >= 1 else f"{late.expected_s:.1g} s"
            since = f"{begun.astimezone():%Y-%m-%d %H:%M:%S}"
            self._on_late(
                f"late since {since}: {late.device} {late.doing}, for which {expected} is expected; look at "
                f"{late.device} and what it is connected by",
                begun,
            )

    def _watch(self) -> None:
        while not self._over.wait(TICK_S):
            self.look()
