"""Which frame is taken next: the plan's open steps, what must be taken again, and what closes a run.

`StepQueue` is a value that changes: no device, no clock, no file. The pipeline (`acquisition.run.pipeline`) asks it for
the next step and tells it how each ended. What a run that is taken up shows first is put into the session's plan by
`link_runs` and `white_first`.

Rules that hold inside:

- Open steps are taken in the plan's order, so that a refused one comes before those behind it.
- A reference that voids other frames is taken again before them: it shows whether the cause is still there.
- Lights are followed by a white and a dark frame. Where lights that are taken again would have none behind them,
  another pair is put behind the plan before they are, so that a run that is killed meanwhile is not complete.
- A refused reference may void all lights since the last good one. Where more lights than usual are taken again in a
  row, a pair comes between them, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from datetime import datetime

from experiment.session.folder import Session
from experiment.session.records import ACCEPTED, REFERENCES, Attempt, FrameKind, SessionStep, link_steps

GIVEN_UP_IN_A_ROW = 3
"""Steps given up one after another after which going on makes no sense: something lasting is wrong. One may be chance,
and two neighbours may share a cause that passes."""


class StepQueue:
    """The steps of a session that are still to be taken in this run.

    `append`: given a reference's kind, puts one behind the plan and returns it; None: nothing is put there.
    `reference_every`: lights that are taken in a row without references between them; None: as many as the plan has.
    """

    def __init__(
        self,
        steps: Sequence[SessionStep],
        done: Collection[int],
        attempts: int,
        first: Iterable[int] = (),
        unclosed: Collection[str] = (),
        append: Callable[[FrameKind], SessionStep] | None = None,
        reference_every: int | None = None,
    ) -> None:
        self._steps = {step.number: step for step in steps}
        self._first = list(first)
        self._probes: list[int] = []
        self._open = {step.number for step in steps if step.number not in done} | set(self._first)
        self._attempts = attempts
        self._tries: Counter[int] = Counter()
        self._under_way: set[int] = set()
        self._given_up: dict[int, str] = {}
        self._in_a_row = 0
        self._unclosed: set[str] = set(unclosed)
        self._append = append
        planned = {step.kind for step in steps}
        self._closing: list[FrameKind] = [kind for kind in REFERENCES if kind in planned]
        self._reference_every = reference_every
        self._lights_since = dict.fromkeys(self._closing, 0)

    def __len__(self) -> int:
        """Return how many steps are without an accepted frame, given up or under way included."""
        return len(self._open)

    @property
    def given_up(self) -> tuple[str, ...]:
        """Why steps were left for the next run, a sentence each, in the order in which they were."""
        return tuple(f"{step_name(self._steps[number])}: {reason}" for number, reason in self._given_up.items())

    @property
    def is_stuck(self) -> bool:
        """Whether so many steps were given up in a row that something lasting is wrong."""
        return self._in_a_row >= GIVEN_UP_IN_A_ROW

    def next(self) -> SessionStep | None:
        """Return the step to take next; None while nothing is to be taken that is not under way."""
        ready = self._open - self._under_way - self._given_up.keys()
        number = next((number for number in self._first if number in ready), min(ready, default=None))
        if number is None and not self._under_way:
            number = self._closed()
        if number is not None and self._steps[number].kind == "light":
            number = self._between(number)
        return None if number is None else self._steps[number]

    def is_open(self, number: int) -> bool:
        """Return whether a step is without an accepted frame."""
        return number in self._open

    def begin(self, step: SessionStep) -> None:
        """Note that an attempt at `step` begins."""
        self._under_way.add(step.number)
        self._tries[step.number] += 1

    def withdraw(self, step: SessionStep) -> None:
        """Note that the attempt under way came to nothing by no fault of the frame: it is no try."""
        self._under_way.discard(step.number)
        self._tries[step.number] -= 1

    def retry(self) -> None:
        """Give the steps that were given up their tries again: somebody has had time to remove the cause.

        Those that came before all others do so again: they show whether it is removed.
        """
        for number in self._given_up:
            self._tries[number] = 0
        self._given_up.clear()
        self._first = [*self._probes, *self._first]
        self._probes = []
        self._in_a_row = 0

    def accept(self, step: SessionStep) -> None:
        """Note that the attempt under way gave an accepted frame."""
        self._under_way.discard(step.number)
        self._open.discard(step.number)
        self._forget_first(step.number)
        if step.kind == "light":
            self._unclosed.update(REFERENCES)
            self._lights_since = {kind: count + 1 for kind, count in self._lights_since.items()}
        elif step.kind in self._lights_since:
            self._lights_since[step.kind] = 0
        self._unclosed.discard(step.kind)
        # A dark frame is accepted where no light reaches the chart, too.
        if step.kind != "dark":
            self._in_a_row = 0

    def refuse(self, step: SessionStep, reason: str, *, before_others: bool = False) -> bool:
        """Note that the attempt under way gave no frame that can be used; return whether the step is tried again."""
        self._under_way.discard(step.number)
        self._open.add(step.number)
        if before_others and step.number not in self._first:
            self._first.append(step.number)
        if self._tries[step.number] >= self._attempts:
            self._give_up(step.number, reason)
            return False
        return True

    def void(self, numbers: Iterable[int], reason: str) -> None:
        """Open steps again whose frames cannot be trusted any more; those without a try left are given up."""
        for number in sorted(numbers):
            self._open.add(number)
            if self._tries[number] >= self._attempts:
                self._give_up(number, reason)

    def begin_with(self, steps: Iterable[SessionStep]) -> None:
        """Take steps, old or new, before all others in the order of the plan, with all their tries."""
        steps = sorted(steps, key=lambda step: step.number)
        numbers = [step.number for step in steps]
        self._steps |= {step.number: step for step in steps}
        self._open |= set(numbers)
        self._first = [*numbers, *(number for number in self._first if number not in numbers)]
        for number in numbers:
            self._tries[number] = 0
            self._given_up.pop(number, None)

    def _give_up(self, number: int, reason: str) -> None:
        if number not in self._given_up:
            self._in_a_row += 1
        self._given_up[number] = reason
        if number in self._first:
            self._probes.append(number)
        self._forget_first(number)

    def _forget_first(self, number: int) -> None:
        if number in self._first:
            self._first.remove(number)

    def _closed(self) -> int | None:
        """Put a reference behind the plan that closes the last lights; None where none is needed."""
        for kind in self._closing:
            if self._append is not None and kind in self._unclosed:
                self._unclosed.discard(kind)
                return self._appended(self._append, kind)
        return None

    def _between(self, light: int) -> int:
        """Return what is taken now where a light is next: a reference, where too many lights were taken since the last.

        References that will follow are in the plan when this returns.
        """
        if self._append is None:
            return light
        for kind in self._closing:
            if not any(number > light and self._steps[number].kind == kind for number in self._open):
                self._appended(self._append, kind)
            coming = any(self._steps[number].kind == kind for number in self._under_way)
            if self._reference_every and self._lights_since[kind] >= self._reference_every and not coming:
                self._lights_since[kind] = 0
                return self._appended(self._append, kind)
        return light

    def _appended(self, append: Callable[[FrameKind], SessionStep], kind: FrameKind) -> int:
        step = append(kind)
        self._steps[step.number] = step
        self._open.add(step.number)
        return step.number


def unclosed_kinds(taken: Iterable[str]) -> frozenset[str]:
    """Return the kinds of references that are missing behind the last light of accepted frames in taking order.

    Examples
    --------
    >>> sorted(unclosed_kinds(["white", "dark", "light", "white"]))
    ['dark']
    """
    unclosed: set[str] = set()
    for kind in taken:
        if kind == "light":
            unclosed.update(REFERENCES)
        unclosed.discard(kind)
    return frozenset(unclosed)


def step_name(step: SessionStep) -> str:
    """Return what a sentence calls a step."""
    return f"light {step.illumination}" if step.illumination is not None else f"{step.kind} frame {step.number}"


def link_runs(session: Session, at: datetime) -> tuple[int, ...]:
    """Put the frames that link this run to those before into the plan, `at` a moment; return their steps' numbers.

    They are some by which the projector is known, so that a chart, a camera or a lamp that changed between the runs is
    seen before the first light is taken.

    A set that an earlier run left unfinished is voided and taken again: the chart may have been moved since. Nothing is
    added where nothing was taken yet, or the session does not know its projector by frames of its primaries.
    """
    taken = [attempt for attempt in session.journal.attempts() if attempt.verdict == ACCEPTED]
    if not taken or all(step.kind != "response" for step in session.steps):
        return ()
    links = link_steps(session.steps[-1].number + 1)
    unfinished = _unfinished(session.steps[-len(links) :], links, taken)
    if not unfinished:
        return _added(session, links)
    numbers = tuple(step.number for step in unfinished)
    again = [attempt.id for attempt in taken if attempt.step in numbers]
    session.journal.void(again, at, "the frames that link runs are taken again, all of them")
    return numbers


def white_first(session: Session) -> tuple[int, ...]:
    """Put a white and a dark frame into the plan where no white frame was measured; return the numbers of their steps.

    The frames of journals of version 1 were not measured: the judge would have nothing to hold the first lights
    against. Nothing is added where nothing was taken yet.
    """
    measured = any(step.kind == "white" and accepted for step, _, _, accepted in session.journal.measurements())
    if measured or not session.journal.accepted_files():
        return ()
    return _added(session, link_steps(session.steps[-1].number + 1, response=False))


def _added(session: Session, steps: Sequence[SessionStep]) -> tuple[int, ...]:
    session.add_steps(steps)
    return tuple(step.number for step in steps)


def _unfinished(
    tail: Sequence[SessionStep], links: Sequence[SessionStep], taken: Sequence[Attempt]
) -> Sequence[SessionStep]:
    """Return the last steps of the plan where they are links behind which nothing was taken; else nothing."""
    if [(step.kind, step.colour) for step in tail] != [(step.kind, step.colour) for step in links]:
        return ()
    numbers = {step.number for step in tail}
    done = {attempt.step for attempt in taken if attempt.step in numbers}
    return tail if not done or taken[-1].step in numbers else ()
