"""The plan of a session, limits of checks, and estimated durations."""

from __future__ import annotations

from datetime import datetime

import pytest

from drivers.presenter import BLACK, WHITE, Colour
from experiment.lights import Illuminant
from experiment.session.records import (
    RESPONSE,
    Attempt,
    Check,
    FrameRecord,
    SessionEvent,
    SessionStep,
    TimedAttempt,
    doubts_of,
    duration_text,
    last_frame_time,
    link_steps,
    plan_steps,
    time_left,
)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "unknown"), (0, "0 s"), (59.6, "1 min 00 s"), (200, "3 min 20 s"), (7500, "2 h 05 min")],
)
def test_formats_durations(seconds: float | None, text: str) -> None:
    assert duration_text(seconds) == text


@pytest.mark.parametrize(
    ("value", "low", "high", "is_beyond"),
    [(1, 1, 2, False), (2, 1, 2, False), (0.9, 1, 2, True), (2.1, 1, 2, True), (9, 1, None, False), (0, None, 2, False),
     (0.9, 1, None, True), (2.1, None, 2, True), (None, 1, 2, False), (5, None, None, False)],
)  # fmt: skip
def test_value_beyond_its_limits(value: float | None, low: float | None, high: float | None, is_beyond: bool) -> None:
    assert Check("movement", value, low, high).is_beyond is is_beyond


def test_remaining_time_uses_the_last_fifty_attempts() -> None:
    night = [*[TimedAttempt(1000, is_accepted=False)] * 30, *[TimedAttempt(6, is_accepted=True)] * 25]
    # Half of the fifty gave a frame; the median interval is that of both halves.
    assert time_left(night, 10) == (1000 + 6) / 2 * 2 * 10
    assert time_left(night, 0) == 0
    assert time_left(night[:30], 10) is None
    assert time_left([TimedAttempt(None, is_accepted=True)], 10) is None


def test_attempts_with_frames_and_doubts() -> None:
    moments = [datetime(2026, 1, 1, hour) for hour in range(4)]

    def attempt(ended_at: datetime | None, taken_at: datetime | None) -> Attempt:
        return Attempt(1, 1, "light", 0, "a.cr2", moments[0], ended_at, taken_at, None, "")

    attempts = [attempt(moments[2], moments[1]), attempt(moments[3], None), attempt(None, moments[3])]
    assert [item.has_frame for item in attempts] == [True, False, True]
    assert last_frame_time(attempts) == moments[2]
    assert last_frame_time(attempts[1:]) is None
    events = [SessionEvent(moments[0], what, detail, 1) for what, detail in (("doubt", "b"), ("start", "x"))]
    assert doubts_of([*events, SessionEvent(moments[1], "doubt", "a", 2), *events]) == ["b", "a"]
    for verdict, accepted in (("accepted", True), ("refused: dark", False)):
        assert FrameRecord("light", 0, "a.cr2", "", moments[0], 0.5, verdict).accepted is accepted


LIGHTS = tuple(Illuminant(number, "uniform", None, Colour(255, number, 0)) for number in range(5))


def test_plan_has_regular_white_and_dark_frames() -> None:
    steps = plan_steps(LIGHTS, 2)
    kinds = "".join(step.kind[0] for step in steps)
    assert kinds == "wdllwdllwdlwd"
    assert [step.number for step in steps] == list(range(len(steps)))
    assert {step.colour for step in steps if step.kind == "white"} == {WHITE}
    assert {step.colour for step in steps if step.kind == "dark"} == {BLACK}
    assert [step.illumination for step in steps if step.kind == "light"] == [0, 1, 2, 3, 4]


def test_file_names_sort_in_the_order_of_taking() -> None:
    steps = plan_steps(LIGHTS, 2)
    stems = [step.stem for step in steps]
    assert stems[:3] == ["0000_white", "0001_dark", "0002_light_000"]
    assert stems == sorted(stems)
    assert SessionStep(7, "light", 5, WHITE).stem == "0007_light_005"


def test_seed_shuffles_only_the_illuminants() -> None:
    listed, shuffled = plan_steps(LIGHTS, 2), plan_steps(LIGHTS, 2, seed=1)
    assert [step.kind for step in shuffled] == [step.kind for step in listed]
    # numpy.random.Generator(numpy.random.PCG64(1)).permutation(5) of numpy 2.4.6
    assert [step.illumination for step in shuffled if step.kind == "light"] == [4, 0, 1, 2, 3]
    assert all(step.colour == LIGHTS[step.illumination].colour for step in shuffled if step.illumination is not None)
    assert plan_steps(LIGHTS, 2, seed=1) == shuffled != plan_steps(LIGHTS, 2, seed=2)


def test_response_frames_follow_the_first_pair() -> None:
    steps = plan_steps(LIGHTS, 2, response=RESPONSE)
    assert "".join(step.kind[0] for step in steps) == "wd" + "r" * len(RESPONSE) + "llwdllwdlwd"
    response = [step for step in steps if step.kind == "response"]
    assert tuple(step.colour for step in response) == RESPONSE
    assert all(step.illumination is None and max(step.colour) < 255 for step in response)
    assert response[0].stem == "0002_response"
    assert len(set(RESPONSE)) == len(RESPONSE)
    lit = [sum(code > 0 for code in colour) for colour in RESPONSE]
    assert lit == [1] * 3 + [3] * 12 + [2] * 3 + [1] * 3, "primaries, greys, pairs of primaries, primaries at half code"


def test_link_steps_continue_the_numbers() -> None:
    steps = link_steps(40)
    assert [step.number for step in steps] == [40, 41, 42, 43, 44, 45]
    assert [step.colour for step in steps] == [
        Colour(250, 250, 250),
        Colour(250, 0, 0),
        Colour(0, 250, 0),
        Colour(0, 0, 250),
        Colour(255, 255, 255),
        Colour(0, 0, 0),
    ]
    assert [step.kind for step in steps] == [*["response"] * 4, "white", "dark"]
