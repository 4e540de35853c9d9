"""How camera, screen, projector and disk are waited for: what fails is tried again until it works or the time is over.

How it is used::

    retry = RetryPolicy(clock, settings.sequence.patience_s, report, idle, on_wait)
    retry.attempt(lambda: presenter.show(colour), "the screen")
    retry.attempt(lambda: journal.begin(step, file, clock.now()), "the disk")

or, where a try is more than one call::

    pause = retry.pause("the camera", idle=False)
    while True:
        try:
            frame = …
        except DeviceError as fault:
            pause.wait(fault)  # returns after some seconds for the next try; raises when the time is over
        else:
            pause.over()  # says that the run goes on, if it had said that it paused
            break

Rules that hold inside:

- The first failure is tried again after a second (`retry`), so that what passes at once pauses nothing. What lasts
  pauses the run (`paused`) with the cause that holds *now*; another cause is told as soon as it is there (`still
  paused`); with other digits it is no other. `resumed` ends it.
- Every few seconds of a pause come `on_wait`, with cause and countdown, and `idle`, for devices that are not at fault.
- When the time is over, the error is of the first cause's class and names it first; what held at last is added.
- What fails again before `RECURS_WITHIN` frames were accepted was not mended: its pauses count together, and share one
  patience and one back-off. A cause that comes and goes ends a run as one does that stays.
- Nothing that is told may end the run: a full disk, which cannot take the note of a pause, gets it when there is space.
- What is no `CropError` passes through at once: Ctrl-C ends a pause; `on_wait` and `idle` may raise
  `KeyboardInterrupt`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from datetime import datetime
from typing import Final, Protocol, TypeVar

from experiment.session.journal_file import HeldJournalError, LostJournalError
from experiment.session.records import duration_text
from foundation import errors
from foundation.clock import Clock
from foundation.errors import CropError, DeviceError, StorageError

RETRY_S: Final = 1.0
"""Before the second try: a notification in front of the picture, or a cable put back, needs no more."""
PAUSE_S: Final = 5.0
"""Between two tries in a pause; an operator who mends something does not notice so short a wait."""
SLOW_S: Final = 10.0
"""A try that failed after so long has been tried often enough by its driver: the pause is told at once."""
TRY_S: Final = 300.0
"""How long a try may go without a sign of life: a camera's driver waits 90 s for a frame of 30 s, then
looks for it for 70 s more over a new connection, and a question may go without an answer for 20 s."""
RECURS_WITHIN: Final = 10
"""Frames that must be accepted after a pause for the next one to count anew: what works for half a minute between two
faults lets a session get on, and what works for a frame or two does not."""
BACK_OFF_S: Final = 5.0
"""Between the second and the third try of what costs a refused file each; the second comes at once, each later pause is
twice the one before."""
LONGEST_BACK_OFF_S: Final = 300.0
"""Between two such tries at most: an operator can wait for five minutes."""
FRAMES: Final = "the frames"
"""What is waited for where nothing fails but every frame is refused."""
TOLD_LATER: Final = " (this was at "
"""What stands behind a sentence that the disk could not take when it was said."""
INSTANT_S: Final = 1e-6
"""Resolution of simulated time: nothing shorter can be waited for."""

_Result = TypeVar("_Result")


class Report(Protocol):
    """Where words and sentences of a run go: terminal first, then journal, then whoever is notified."""

    def __call__(self, what: str, sentence: str, /) -> None:
        """Tell what happens, with its cause.

        ``retry``, ``paused``, ``still paused``, ``resumed``, ``relit`` or ``warming up``.
        """
        ...


class WaitCallback(Protocol):
    """Where signs of life of a wait go: the journal's heartbeat, and a line on the terminal."""

    def __call__(self, state: str, sentence: str, within_s: float, /) -> None:
        """Tell the state (``paused`` or ``waiting``), what is waited for and how long, and when the next is due."""
        ...


def is_curable(fault: CropError) -> bool:
    """Return whether waiting may help: any fault of a device or of the disk, but nothing that the user gave."""
    return isinstance(fault, DeviceError | StorageError) and not isinstance(fault, HeldJournalError | LostJournalError)


class RetryPolicy:
    """How long, and how, a run waits for what fails.

    `idle`: keeps the other devices awake; called every few seconds. Its `DeviceError` is left to the device's own next
    use. `on_wait`: told every few seconds of a wait, with the time left in the sentence.
    `breakable`: a block in which somebody's request ends the run at once, put around every wait.
    """

    def __init__(
        self,
        clock: Clock,
        limit_s: float,
        report: Report = lambda what, sentence: None,
        idle: Callable[[], None] = lambda: None,
        on_wait: WaitCallback = lambda state, sentence, within_s: None,
        breakable: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:
        self.clock = clock
        self.limit_s = limit_s
        self.breakable = breakable
        self._tell, self._idle, self._on_wait = report, idle, on_wait
        self._untold: list[tuple[str, str, datetime]] = []
        self._histories: dict[str, _History] = {}

    def accepted(self) -> None:
        """Note an accepted frame: what was waited for before so many of them counts as mended."""
        for name, history in list(self._histories.items()):
            history.frames += 1
            if history.frames >= RECURS_WITHIN:
                del self._histories[name]

    def attempt(
        self,
        action: Callable[[], _Result],
        name: str,
        *,
        curable: Callable[[CropError], bool] = is_curable,
        idle: bool = True,
    ) -> _Result:
        """Return what `action` returns, tried until it succeeds or the time is over."""
        pause = self.pause(name, idle=idle)
        while True:
            try:
                result = action()
            except CropError as fault:
                if not curable(fault):
                    raise
                pause.wait(fault)
            else:
                pause.over()
                return result

    def pause(self, name: str, *, idle: bool = True) -> Pause:
        """Return what waits for `name`, and counts from its first failure; parameters as those of `attempt`."""
        return Pause(self, name, idle, self._histories.setdefault(name, _History()))

    def report(self, what: str, sentence: str) -> None:
        """Tell what happens; where the disk cannot take it, it is told again as soon as something else can be."""
        self._untold.append((what, sentence, self.clock.now()))
        with suppress(StorageError):
            while self._untold:
                what, sentence, at = self._untold[0]
                late = (self.clock.now() - at).total_seconds() > RETRY_S
                self._tell(what, f"{sentence}{TOLD_LATER}{at.astimezone():%H:%M:%S})" if late else sentence)
                self._untold.pop(0)

    def wait(self, seconds: float, state: str, sentence: Callable[[], str], *, idle: bool = True) -> None:
        """Let `seconds` pass; what `sentence` returns is told every few of them."""
        until = self.clock.monotonic() + seconds
        while (left := until - self.clock.monotonic()) >= INSTANT_S:
            self.sign_of_life(state, sentence(), 2 * PAUSE_S + TRY_S * idle)
            self.clock.sleep(min(left, PAUSE_S))
            if idle:
                with suppress(DeviceError):
                    self._idle()

    def sign_of_life(self, state: str, sentence: str, within_s: float) -> None:
        """Tell what is waited for; a disk that cannot take it does not matter."""
        with suppress(StorageError):
            self._on_wait(state, sentence, within_s)


@dataclass
class _History:
    """What was waited for a thing so far: `pauses` of `spent_s` together, and accepted `frames` since the last."""

    pauses: int = 0
    spent_s: float = 0.0
    back_off_s: float = 0.0
    frames: int = 0


class Pause:
    """The wait for one thing that fails; given by `RetryPolicy.pause`."""

    def __init__(self, policy: RetryPolicy, name: str, idle: bool, history: _History) -> None:
        self._policy = policy
        self._history = history
        self._name = name
        self._idle = idle
        self._begun_trying = policy.clock.monotonic()
        self._first: CropError | None = None
        self._failed_at = self._begun_trying
        self._told = ""

    def wait(self, fault: CropError) -> None:
        """Say what holds now, and return when it is time for the next try."""
        with self._policy.breakable():
            self._wait(fault)

    def back_off(self, fault: CropError) -> None:
        """Wait as `wait` does, longer each time, for a try that costs something."""
        clock, history = self._policy.clock, self._history
        until = clock.monotonic() + history.back_off_s
        self.wait(fault)
        while clock.monotonic() < until:
            self.wait(fault)
        history.back_off_s = min(max(2 * history.back_off_s, BACK_OFF_S), LONGEST_BACK_OFF_S)

    def _wait(self, fault: CropError) -> None:
        policy = self._policy
        now = policy.clock.monotonic()
        first = self._first or fault
        again = self._first is not None
        if not again:
            self._first, self._failed_at = fault, now
        left = self._left_s()
        if left < INSTANT_S:
            raise self._ended(first, fault) from fault
        if not again and now - self._begun_trying < SLOW_S:
            policy.report("retry", _named(self._name, fault.while_waiting()))
            policy.clock.sleep(min(RETRY_S, left))
            return
        kind = _kind(fault)
        if kind != self._told:
            how_long = "for as long as it takes" if math.isinf(policy.limit_s) else f"up to {duration_text(left)}"
            policy.report(
                "still paused" if self._told else "paused",
                f"{_named(self._name, fault.while_waiting())} (the run waits {how_long}, and goes on by itself)",
            )
            self._told = kind
        policy.wait(min(PAUSE_S, left), "paused", lambda: self._countdown(fault), idle=self._idle)
        policy.sign_of_life("paused", self._countdown(fault), TRY_S)

    def over(self) -> None:
        """Say that the run goes on, where it had said that it paused."""
        if self._told:
            are = "are" if self._name.endswith("s") else "is"
            lasted = duration_text(self._lasted_s())
            self._policy.report("resumed", f"{self._name} {are} ready again after a pause of {lasted}")
            self._history.pauses += 1
            self._history.frames = 0
            self._history.spent_s += max(self._lasted_s(), PAUSE_S)
            self._told = ""

    def _left_s(self) -> float:
        return self._policy.limit_s - self._history.spent_s - self._lasted_s()

    def _lasted_s(self) -> float:
        return self._policy.clock.monotonic() - self._failed_at

    def _countdown(self, fault: CropError) -> str:
        left = self._left_s()
        end = "waits for as long as it takes" if math.isinf(left) else f"ends in {duration_text(max(left, 0))}"
        held = _named(self._name, fault.while_waiting())
        return f"{held} (paused for {duration_text(self._lasted_s())}; goes on by itself, {end})"

    def _ended(self, first: CropError, fault: CropError) -> CropError:
        if not self._policy.limit_s:
            return first
        # What came first is told without its remedy: that of what holds now helps. A fault may name it already.
        cause, held = first.without_remedy(), fault.while_waiting()
        at_last = held if _kind(cause) in _kind(held) else f"{cause}; at last: {held}"
        waited = duration_text(self._policy.limit_s)
        if self._history.pauses:
            waited += f", in {self._history.pauses + 1} pauses with few frames between them,"
        return _family(first)(
            _named(self._name, at_last),
            remedy=f"the run waited {waited} for that and ended: when it is mended run the same command again",
        )


def pause_cause(sentence: str) -> str:
    """Return what a pause is for, of the sentence that tells it: the same at each of its times, and for all frames."""
    name, *_ = sentence.partition(": ")
    return name if name == FRAMES else _kind(sentence.partition(TOLD_LATER)[0].rpartition(" (")[0])


def _named(name: str, sentence: str) -> str:
    """Return what is said of a fault with the name of what has it, which many name themselves."""
    return sentence if sentence.startswith(name) else f"{name}: {sentence}"


def _kind(fault: CropError | str) -> str:
    """Return a fault's words without its numbers, which may change from one try to the next."""
    return re.sub(r"\d+(?:[.,]\d+)*", "#", str(fault))


def _family(fault: CropError) -> type[CropError]:
    """Return the nearest class of the tree of errors; classes of drivers want more than a sentence."""
    return next(kind for kind in type(fault).__mro__ if kind.__module__ == errors.__name__)
