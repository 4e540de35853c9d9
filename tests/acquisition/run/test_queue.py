"""What is taken next: plain values, without a device."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import pytest

from acquisition.run.pipeline import GIVEN_UP_IN_A_ROW, StepQueue, unclosed_kinds
from drivers.presenter import BLACK, WHITE, Colour
from experiment.lights import Illumination
from experiment.session.records import FrameKind, SessionStep, plan_steps

STEPS = plan_steps([Illumination(n, "uniform", None, Colour(255, n, 0)) for n in range(4)], 2)
"""white 0, dark 1, light 2, 3, white 4, dark 5, light 6, 7, white 8, dark 9."""


def queue_of(done: Collection[int], attempts: int = 3, **more: Any) -> StepQueue:
    """Return a queue of `STEPS` that puts closing references behind them, from 10 on."""
    behind: list[SessionStep] = []

    def append(kind: FrameKind) -> SessionStep:
        behind.append(SessionStep(len(STEPS) + len(behind), kind, None, WHITE if kind == "white" else BLACK))
        return behind[-1]

    return StepQueue(STEPS, done, attempts, append=append, **more)


def take(queue: StepQueue, refused: dict[int, int] | None = None) -> list[int]:
    """Take all that is listed, one after another; `refused` maps steps to how often they are. Return the steps."""
    left, taken = dict(refused or {}), list[int]()
    while (step := queue.next()) is not None:
        queue.begin(step)
        taken.append(step.number)
        if left.get(step.number, 0):
            left[step.number] -= 1
            queue.refuse(step, "dark")
        else:
            queue.accept(step)
    return taken


def test_what_is_under_way_is_not_taken_twice() -> None:
    queue = queue_of(set(), 3)
    first = begun(queue)
    assert begun(queue).number == 1
    queue.refuse(first, "too dark")
    assert begun(queue).number == 0, "a refused step comes before those behind it"
    assert begun(queue).number == 2


def begun(queue: StepQueue) -> SessionStep:
    """Return the next step, begun."""
    step = queue.next()
    assert step is not None
    queue.begin(step)
    return step


def test_lights_of_an_earlier_run_are_closed_too() -> None:
    assert unclosed_kinds(["white", "dark", "light", "white", "dark"]) == frozenset()
    unclosed = unclosed_kinds(["white", "dark", "white", "dark", "light"])
    queue = queue_of({step.number for step in STEPS} - {1}, unclosed=unclosed)
    assert take(queue) == [1, 10], "the dark frame that is open closes them as well"


def test_a_reference_that_voids_is_probed_before_what_it_voids() -> None:
    queue = queue_of({0, 1, 2, 3}, 3)
    white = begun(queue)
    assert white.number == 4
    queue.refuse(white, "the picture is stuck", before_others=True)
    queue.void([2, 3], "voided")
    assert take(queue) == [4, 2, 3, 5, 6, 7, 8, 9]


def test_first_frames_that_are_voided_come_before_all_others_with_all_their_tries() -> None:
    queue = queue_of({0, 1, 2, 8, 9}, 2, first=(8,))
    queue.accept(begun(queue))
    queue.refuse(begun(queue), "somebody passed")
    queue.begin_with([STEPS[9], STEPS[8], STEPS[3]])
    assert take(queue, {3: 1}) == [3, 3, 8, 9, 4, 5, 6, 7, 10, 11]
    assert not queue.given_up


def test_a_kill_among_lights_that_are_taken_again_leaves_their_closing_frames_open() -> None:
    queue = queue_of({step.number for step in STEPS} - {6})
    queue.accept(begun(queue))
    assert len(queue) == 2, "the white and the dark frame are in the plan before the light is accepted"


def test_many_lights_taken_again_in_a_row_have_references_between_them() -> None:
    queue = queue_of({0, 1, 4, 5, 8, 9}, reference_every=2)
    assert take(queue) == [2, 3, 12, 13, 6, 7, 10, 11], "a refused one voids two of them at most"
    whole = queue_of(set(), reference_every=2)
    assert take(whole) == list(range(10)), "the plan has its own"
    ahead = queue_of(set(), reference_every=2)
    before, order = begun(ahead), [0]
    while (step := ahead.next()) is not None or len(ahead):
        if step is not None:
            ahead.begin(step)
            order.append(step.number)
        ahead.accept(before)
        before = step or before
    assert order == list(range(10)), "also while the verdict on one of them is awaited"


def test_frames_are_not_voided_for_ever() -> None:
    queue = queue_of(set(), 2)
    for _ in range(2):
        for _ in range(4):
            queue.accept(begun(queue))
        queue.void([0, 1, 2, 3], "voided")
    assert queue.is_stuck
    assert len(queue.given_up) == 4


def test_some_steps_given_up_in_a_row_are_a_lasting_cause() -> None:
    queue = queue_of(set(), 1)
    for number in range(GIVEN_UP_IN_A_ROW):
        assert not queue.is_stuck
        queue.refuse(begun(queue), f"{number}")
    assert queue.is_stuck
    queue.retry()
    assert not queue.is_stuck
    assert take(queue) == list(range(10))


@pytest.mark.parametrize(("kind", "stuck"), [("dark", True), ("white", False)])
def test_a_dark_frame_shows_nothing_of_the_light(kind: str, stuck: bool) -> None:
    queue = queue_of({0, 1, 2, 3, 6, 7, 8, 9}, 1)
    steps = {step.kind: step for step in (begun(queue), begun(queue))}
    for step in STEPS[2:4]:
        queue.void([step.number], "")
        queue.begin(step)
        queue.refuse(step, "dark")
    good, other = (steps["dark"], steps["white"]) if kind == "dark" else (steps["white"], steps["dark"])
    queue.accept(good)
    queue.refuse(other, "dark")
    assert queue.is_stuck == stuck
