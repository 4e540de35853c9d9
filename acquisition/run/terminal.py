"""A run on the terminal: how far it is, the last verdict, the drift, the true time left, and what it waits for.

Lines that must stay (a refusal, a pause) are printed above a bar that is drawn anew; where the terminal is none, only
the lines are printed.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from types import TracebackType
from typing import Self

from acquisition.run.pipeline import Taken
from acquisition.run.queue import step_name
from experiment.session.records import RECENT, Check, Judgement, TimedAttempt, duration_text, time_left

SHOWN = ("light", "movement", "blur", "white drift", "dark", "ambient", "exposure")
"""Checks that the line about the last frame has, as far as they have a number."""


class TimeLeft:
    """Tells the time left by the machine's clock as the page and `acquire status` tell it by the journal's.

    `clock`: returns seconds; the machine's own unless a test has another.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since: float | None = None
        self._attempts: deque[TimedAttempt] = deque(maxlen=RECENT)

    def taken(self, accepted: bool = True) -> None:
        """Note that a frame was taken now, and whether it counts."""
        now = self._clock()
        self._attempts.append(TimedAttempt(None if self._since is None else now - self._since, accepted))
        self._since = now

    def paused(self) -> None:
        """Note that the run waits: the time until the next frame is no frame's."""
        self._since = None

    def left_s(self, frames: int) -> float | None:
        """Return seconds that so many frames will take, retaken ones included; None before the second frame."""
        return time_left(self._attempts, frames)


def verdict_line(taken: Taken) -> str:
    """Return what is said of the last frame in a line: its verdict, and numbers with their units."""
    judgement = taken.judgement
    numbers = [number_text(check) for name in SHOWN for check in _of_name(judgement, name)]
    said = "accepted" if judgement.accepted else "refused"
    return ", ".join([f"{step_name(taken.step)} {said}", *numbers])


def number_text(check: Check) -> str:
    """Return a check's name and number, as in ``light 0.21°``."""
    unit = "" if not check.unit else check.unit if check.unit.startswith("°") else f" {check.unit}"
    return f"{check.name} {check.value:.3g}{unit}{' (beyond its limit)' if check.is_beyond else ''}"


def _of_name(judgement: Judgement, name: str) -> list[Check]:
    return [check for check in judgement.checks if check.name == name and check.value is not None]


class Terminal:
    """Shows a run; use it in a `with` block."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._time = TimeLeft()
        self._left = self._total = 0
        self._bar = Progress(
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.fields[said]}"),
            console=Console(stderr=True),
            redirect_stdout=sys.stdout.isatty(),
        )
        self._task = self._bar.add_task("frames", total=None, left="", said="")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar.live.is_started:
            self._bar.update(self._task, left="", said="")
            self._bar.stop()

    def progress(self, done: int, total: int) -> None:
        """Show how many frames are done."""
        # What is refused before there is anything to count gets no bar.
        if not self._bar.live.is_started:
            self._bar.start()
        self._left, self._total = total - done, total
        left_s = self._time.left_s(self._left)
        left = "" if left_s is None or not self._left else f"left {duration_text(left_s)}"
        self._bar.update(self._task, completed=done, total=total, left=left)

    def taken(self, taken: Taken) -> None:
        """Show the verdict of a frame, and take its time for that of those to come."""
        self._time.taken(taken.judgement.accepted)
        self._bar.update(self._task, said=verdict_line(taken))

    def announce(self, sentence: str) -> None:
        """Print a line that stays."""
        print(sentence, file=sys.stderr)

    def state(self, sentence: str) -> None:
        """Show what the run waits for, until the next frame."""
        self._time.paused()
        self._bar.update(self._task, said=sentence, left="")
