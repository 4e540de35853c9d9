"""How a session stands: what is said when it runs, pauses, ends, or is killed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from acquisition.monitor.view import AttemptView, Head, SessionView, head_of, with_seconds
from experiment.session.heartbeat import Heartbeat, Process, RunState, SessionPlace
from experiment.session.records import plan_steps
from tests.acquisition.monitor.made_up import LIGHTS

NOW = datetime(2026, 3, 1, 23, 0, tzinfo=UTC)
STEPS = plan_steps(LIGHTS, 25)
HERE = Process.own()
ELSEWHERE = Process(7, "1", "another-machine", "boot")


def attempts(count: int, verdict: str | None = "accepted", seconds: float = 5.0) -> tuple[AttemptView, ...]:
    """Return attempts at the first steps, the newest a moment ago."""
    begun = [NOW - timedelta(seconds=seconds * (count - number)) for number in range(count)]
    views = [
        AttemptView(number + 1, number, "white", None, f"frames/{number}.cr2", at, at, at, verdict, "")
        for number, at in enumerate(begun)
    ]
    return with_seconds(views, [])


def heartbeat(state: RunState, *, ago: float = 2.0, within: float = 10.0, process: Process = HERE) -> Heartbeat:
    at = NOW - timedelta(seconds=ago)
    return Heartbeat(at, process, state, f"{state} as it should", at + timedelta(seconds=within))


def head(
    views: Sequence[AttemptView],
    beat: Heartbeat | None,
    alive: bool | None = True,
    now: datetime = NOW,
    here: SessionPlace | None = None,
) -> Head:
    return head_of(SessionView("night", "night", STEPS, (), {}, tuple(views), (), beat, here), now, alive)


@pytest.mark.parametrize(
    ("ago", "state"), [(0.0, "running"), (49.0, "running"), (51.0, "late"), (329.0, "late"), (331.0, "silent")]
)
def test_a_run_that_hangs_is_late_and_then_silent(ago: float, state: str) -> None:
    """Frames of five seconds: three of them, the five of a sign of life, and thirty; the sign was due within 300 s."""
    beat = heartbeat("running", ago=ago, within=300.0)
    stands = head(attempts(3), beat)
    assert stands.state == state
    assert stands.alive == (state != "silent")
    if state != "running":
        since = "late since" if state == "late" else "no sign since"
        assert stands.sentence.startswith(f"{since} {beat.at.astimezone():%Y-%m-%d %H:%M:%S}")
        assert stands.eta is None, "no time of arrival rolls on"


def test_a_step_that_hangs_is_late_by_what_the_run_says_of_it_and_then_silent() -> None:
    beat = replace(heartbeat("late", within=300.0), sentence="late since 23:00: the camera exposes light 3")
    view = SessionView("night", "night", STEPS, (), {}, attempts(3), (), beat, None)
    stands = head_of(view, NOW, True)
    assert (stands.state, stands.sentence, stands.cause) == ("late", beat.sentence, "the camera")
    after = head_of(view, NOW + timedelta(seconds=329), True)
    assert after.state == "silent"
    assert "then: late since 23:00: the camera exposes light 3" in after.sentence


@pytest.mark.parametrize(
    ("state", "sentence", "free_mb", "expected"),
    [
        ("running", "frames are taken", 20, ("late", "the disk")),
        ("running", "frames are taken", 30, ("running", "")),
        ("paused", "the projector: it is in standby", 20, ("late", "the disk")),
        ("paused", "the disk: No space left on device", 20, ("paused", "the disk")),
        ("paused", "the frames: light 3: the disk of the sun is seen", 30, ("paused", "the frames")),
        ("ended", "interrupted", 20, ("incomplete", "")),
    ],
)
def test_a_full_disk_is_said_as_such(state: RunState, sentence: str, free_mb: float, expected: tuple[str, str]) -> None:
    beat = replace(heartbeat(state), sentence=sentence)
    view = SessionView("night", "night", STEPS, (), {}, attempts(3), (), beat, None, frame_bytes=25_000_000)
    stands = head_of(view, NOW, True, free_bytes=round(free_mb * 1e6))
    assert (stands.state, stands.cause) == expected


@pytest.mark.parametrize("alive", [True, False, None])
def test_a_copy_of_a_session_is_no_run(alive: bool | None) -> None:
    there, here = SessionPlace("/data/night", 5, 10, 11, 0), SessionPlace("/backup/night", 5, 20, 21, 0)
    beat = replace(heartbeat("running"), place=there)
    stands = head(attempts(3), beat, alive, here=here)
    assert (stands.state, stands.alive, stands.eta) == ("copy", False, None)
    assert "/data/night" in stands.sentence
    stands = head(attempts(8), beat, alive, here=here)
    assert stands.state == "complete", "all frames are in the copy, too"
    ended = replace(beat, state="ended")
    assert head(attempts(3), ended, alive, here=here).state == "incomplete"
    where_it_is = head(attempts(3), beat, here=there)
    assert where_it_is.state == "running"


def test_all_frames_there_and_nobody_at_work_is_complete_and_says_what_comes_next() -> None:
    for beat, alive in ((heartbeat("ended"), True), (heartbeat("running"), False), (None, None)):
        stands = head(attempts(8), beat, alive=alive)
        assert stands.state == "complete"
        assert stands.sentence == "complete, 8 frames; next: build-lut night LUT/"
    assert head(attempts(8), heartbeat("running")).state == "running"


def test_a_frame_of_a_step_that_the_plan_does_not_have_does_not_count() -> None:
    stray = replace(attempts(1)[0], step=99)
    assert head([stray], heartbeat("running")).done == 0


def test_a_clock_that_was_set_back_makes_no_time() -> None:
    views = [*attempts(4), replace(attempts(1)[0], id=5, step=4, started_at=NOW - timedelta(hours=1))]
    timed = with_seconds([replace(view, seconds=None) for view in views], [])
    assert [one.seconds for one in timed] == [None, 5.0, 5.0, 5.0, None]
    stands = head(timed, heartbeat("running"))
    assert stands.remaining_s == 15.0
    assert stands.eta is None, "the lab's clock is not the wall's"


def test_the_time_between_two_runs_is_no_frames() -> None:
    first, second, third = attempts(3)
    timed = with_seconds([first, second, third], [second.started_at])
    assert [one.seconds for one in timed] == [None, None, 5.0]
