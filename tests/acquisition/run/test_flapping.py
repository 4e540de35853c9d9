"""Causes that come and go: a run ends or goes on within its patience and its disk, and wakes nobody twice."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest

from acquisition.run.run import QUIET_S, PauseNotices, RunOutcome, take_session
from drivers.presenter import Colour
from experiment.config import LabSettings
from experiment.lights import Illumination
from experiment.session.records import ACCEPTED, REFUSED, Check, Judgement, SessionStep
from foundation.clock import SimulatedClock
from foundation.errors import QualityError
from tests.acquisition.run.scripted import SETTINGS, WELL, Lab

pytestmark = pytest.mark.slow

LIGHTS = tuple(Illumination(n, "uniform", None, Colour(255, 6 * n, 0)) for n in range(40))
PATIENCE_S = 120.0


def settings(**changes: object) -> LabSettings:
    sequence = {"patience_s": PATIENCE_S, **changes}
    return SETTINGS.model_copy(update={"sequence": SETTINGS.sequence.model_copy(update=sequence)})


@dataclass
class Seen:
    """Sees the colours that the camera exposed, those of `late` exposures one exposure late.

    As the judge does: the same cause in three frames in a row is lasting, and a wrong white voids.
    """

    lab: Lab
    late: range = range(0)
    judged: int = 0
    in_a_row: int = 0

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        number, self.judged = self.judged, self.judged + 1
        exposed = self.lab.camera.exposed
        seen = exposed[number - (number in self.late)] if number else exposed[0]
        assert exposed[number] == step.colour
        good = seen == step.colour
        self.in_a_row = 0 if good else self.in_a_row + 1
        reason = "" if good else f"{seen} is seen, {step.colour} was ordered"
        voids = not good and step.kind == "white"
        return Judgement((Check("light", reason=reason),), voids=voids, lasting=self.in_a_row >= 3)

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None: ...


@dataclass
class Night:
    """A session of forty lights, and what was said of it."""

    lab: Lab
    said: list[str] = field(default_factory=list[str])

    def run(self, judge: Seen, **changes: object) -> RunOutcome:
        return take_session(self.lab.session, self.lab.devices, settings(**changes), judge, announce=self.said.append)

    def of(self, word: str) -> list[str]:
        return [sentence for sentence in self.said if sentence.startswith(f"{word}: ")]

    def require_each_step_once(self) -> None:
        accepted = [attempt.step for attempt in self.lab.session.journal.attempts() if attempt.verdict == ACCEPTED]
        assert sorted(accepted) == [step.number for step in self.lab.session.steps]


@pytest.fixture
def night(tmp_path: Path) -> Night:
    return Night(Lab(tmp_path / "session", lights=LIGHTS, reference_every=10))


def test_a_picture_that_stays_one_frame_late_ends_the_run_within_its_patience(night: Night) -> None:
    with pytest.raises(QualityError):
        night.run(Seen(night.lab, range(8, 10_000)))
    clock = night.lab.clock
    assert clock.monotonic() < 2 * PATIENCE_S
    assert night.lab.verdicts().count(REFUSED) < 15
    assert len(night.of("paused")) == 1
    assert not night.of("resumed"), "a frame that follows itself shows nothing"
    assert night.run(Seen(night.lab, judged=len(night.lab.camera.exposed))).complete
    night.require_each_step_once()


@pytest.mark.parametrize("until", [12, 13, 14, 15])
def test_a_picture_that_was_late_for_a_while_lets_the_run_go_on(night: Night, until: int) -> None:
    assert night.run(Seen(night.lab, range(8, until))).complete
    assert len(night.of("paused")) == len(night.of("resumed"))
    night.require_each_step_once()


class Flapping(Seen):
    """Refuses three frames of each light for something lasting, and then accepts `good` frames."""

    good = 0

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        self.judged += 1
        if self.judged > 8 and (self.judged - 8) % (self.good + 4) < 4:
            return Judgement((Check("light", reason=f"flash {self.judged}"),), lasting=True)
        return Judgement((Check("light"),))


def test_refused_files_have_a_budget_of_disk(night: Night) -> None:
    class EachSecond(Flapping):
        def judge(self, file: Path, step: SessionStep) -> Judgement:
            self.judged += 1
            return Judgement((Check("light", reason="dust" if self.judged % 2 else ""),))

    with pytest.raises(QualityError, match="refused_gb"):
        night.run(EachSecond(night.lab), refused_gb=5.5 * len(WELL) / 1e9)
    assert night.lab.verdicts().count(REFUSED) in (6, 7), "and the one that was under way"
    assert night.lab.session.journal.events()[-1].what == "ended"
    assert night.run(Seen(night.lab, judged=len(night.lab.camera.exposed)), refused_gb=1e-9).complete
    night.require_each_step_once()


class TestNotices:
    def test_a_flapping_cause_is_told_once_an_hour(self) -> None:
        clock, told = SimulatedClock(), list[tuple[str, str]]()
        notices = PauseNotices(lambda event, sentence: told.append((event, sentence)), clock)
        for minute in range(0, 180, 2):
            sentence = f"the camera: USB {minute} is gone (the run waits up to 9 min {minute % 60:02d} s)"
            notices.paused(sentence)
            notices.resumed("the camera is ready again")
            clock.sleep(120)
        assert [event for event, _ in told] == ["paused", "resumed"] * 3

    def test_another_cause_is_told_at_once_and_all_frames_have_one(self) -> None:
        clock, told = SimulatedClock(), list[str]()
        notices = PauseNotices(lambda event, sentence: told.append(sentence), clock)
        for sentence in (
            "the camera: its battery is empty (the run waits up to 10 min 00 s)",
            "the camera: its card is full (the run waits up to 10 min 00 s)",
            "the frames: light 3: another light is seen (the run waits up to 10 min 00 s)",
            "the frames: dark frame 4: the dark frame has 80 % of white (the run waits up to 10 min 00 s)",
        ):
            notices.paused(sentence)
            notices.resumed("")
        assert [sentence for sentence in told if sentence] == [
            sentence for sentence in told if sentence and "dark frame" not in sentence
        ]
        assert len(told) == 6

    def test_a_pause_that_was_not_told_is_told_when_it_lasts(self) -> None:
        clock, told = SimulatedClock(), list[str]()
        notices = PauseNotices(lambda event, sentence: told.append(event), clock)
        sentence = "the camera: gone (paused for 3 s; goes on by itself, waits for as long as it takes)"
        notices.paused(sentence)
        notices.resumed("")
        clock.sleep(60)
        notices.paused(sentence)
        assert told == ["paused", "resumed"]
        clock.sleep(QUIET_S - 61)
        notices.paused(sentence)
        assert told == ["paused", "resumed"]
        clock.sleep(1)
        notices.paused(sentence)
        notices.paused(sentence)
        assert told == ["paused", "resumed", "paused"]
