"""A machine that sleeps, a process that is stopped: the journal says so, and the frame in between is taken again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from acquisition.judge.measure import ExposureJudge
from acquisition.monitor.view import Head, read_session
from acquisition.run import devices, run
from acquisition.run.devices import RunWatch
from acquisition.run.run import take_session
from drivers.presenter import Colour
from tests.acquisition.run.scripted import SETTINGS, Lab


class Time:
    """Stands still but where it jumps."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_jump_is_told_once() -> None:
    time = Time()
    watch = RunWatch(elapsed=time)
    assert watch.gap_s() == 0
    time.now += 10
    assert watch.gap_s() == 0, "a busy machine"
    time.now += 11
    assert watch.gap_s() == 11
    assert watch.gap_s() == 0


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    one = Time()
    monkeypatch.setattr(devices, "elapsed_s", one)
    return one


def events(lab: Lab) -> list[str]:
    return [event.detail for event in lab.session.journal.events() if event.what == "gap"]


def test_a_frame_that_was_exposed_across_a_gap_is_taken_again(tmp_path: Path, time: Time) -> None:
    lab = Lab(tmp_path / "session")

    def stopped() -> None:
        time.now += 343

    lab.camera.after[3] = stopped
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    refused = [frame.verdict for frame in lab.session.frames() if not frame.accepted]
    assert len(refused) == 1
    assert "5 min 43 s" in refused[0]
    assert len(events(lab)) == 1


def test_a_gap_between_frames_is_in_the_journal_and_costs_none(tmp_path: Path, time: Time) -> None:
    lab = Lab(tmp_path / "session")
    show = lab.screen.show

    def stopped(colour: Colour) -> None:
        show(colour)
        time.now += 60 * (len(lab.screen.shown) == 3)

    lab.screen.show = stopped  # type: ignore[method-assign]
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    assert lab.verdicts() == ["accepted"] * 6
    assert len(events(lab)) == 1


def test_a_step_that_takes_too_long_is_told_once_with_its_device() -> None:
    time, told = Time(), list[str]()
    watch = RunWatch(lambda sentence, begun: told.append(sentence), time)

    def pass_s(seconds: float) -> None:
        """Let time pass in pieces that are no gap."""
        for _ in range(round(seconds)):
            time.now += 1
            watch.look()

    with watch.step("the camera", "exposes light 3", 4.0, "expose"):
        pass_s(3 * 4 + 10)
        assert not told
        pass_s(1)
        assert len(told) == 1
        pass_s(300)
        assert len(told) == 1
    assert "the camera exposes light 3, for which 4 s is expected" in told[0]
    pass_s(300)
    with watch.step("the camera", "exposes light 4", 4.0, "expose"):
        pass_s(3 * 4 + 10 + 1)
    assert len(told) == 2, "what was late tells nothing of how long it takes"
    with watch.step("the camera", "sends light 4", 4.0, "download"):
        pass_s(20)
    with watch.step("the camera", "sends light 5", 4.0, "download"):
        pass_s(3 * 20 + 10)
    assert len(told) == 2, "a slow cable stays slow"
    with watch.step("the screen", "shows light 6", 0.5, "show"):
        pass_s(12)
    assert "for which 0.5 s is expected" in told[2]


def test_a_machine_that_slept_makes_no_step_late() -> None:
    time, told = Time(), list[str]()
    watch = RunWatch(lambda sentence, begun: told.append(sentence), time)
    with watch.step("the screen", "shows light 3", 1.0, "show"):
        time.now += 3600
        watch.look()
    assert not told


@pytest.mark.slow
@pytest.mark.parametrize(("hangs", "cause"), [("expose", "the camera"), ("show", "the screen"), ("judge", "the disk")])
def test_what_hangs_is_named_while_it_hangs(
    tmp_path: Path, time: Time, hangs: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab, heads = Lab(tmp_path / "session"), list[Head]()
    owner = ExposureJudge if hangs == "judge" else type(lab.camera) if hangs == "expose" else type(lab.screen)
    real, calls = getattr(owner, hangs), [0]
    watches, kinds, entered, expected = list[RunWatch](), list[str](), threading.Condition(), dict[str, float]()

    class Watched(RunWatch):
        def __init__(self, on_late: Callable[[str, datetime], object]) -> None:
            super().__init__(on_late, time)
            watches.append(self)

        @contextmanager
        def step(self, device: str, doing: str, expected_s: float, kind: str) -> Generator[None]:
            expected[kind] = expected_s
            with super().step(device, doing, expected_s, kind):
                with entered:
                    kinds[:] = [kind]
                    entered.notify_all()
                try:
                    yield
                finally:
                    kinds.clear()

    def hanging(*given: object) -> object:
        calls[0] += 1
        if calls[0] == 4:
            # Frames are judged beside the run, which comes to wait for the verdict.
            with entered:
                assert entered.wait_for(lambda: kinds == [hangs], timeout=60)
            for _ in range(60):
                time.now += 1
                watches[0].look()
            heads.append(read_session(lab.session.folder).head(datetime.now(UTC)))
        return real(*given)

    monkeypatch.setattr(owner, hangs, hanging)
    monkeypatch.setattr(run, "RunWatch", Watched)
    assert take_session(lab.session, lab.devices, SETTINGS).complete
    (head,) = heads
    assert (head.state, head.cause) == ("late", cause)
    assert head.sentence.startswith("late since")
    assert not events(lab)
    # Of half a second the camera's own dark frame takes as much again.
    assert SETTINGS.camera.shutter_s == 0.5
    assert expected.items() >= {"expose": 1 + 3.0, "download": 10.0, "judge": 5.0, "show": 2.0}.items()
