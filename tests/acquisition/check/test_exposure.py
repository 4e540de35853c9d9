"""Saturation is measured, and the search ends at a time that suits wherever there is one."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.check.exposure import (
    TRIALS,
    Saturation,
    Shot,
    TriedTime,
    best_of,
    fitting_times,
    judge_exposure,
    level_of,
    measure_saturation,
    search,
)
from acquisition.run.devices import ENGRAVED_S
from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area

PERIOD_S = 1 / 60
TIMES = fitting_times(ENGRAVED_S, PERIOD_S)
BLACK = 2048


def photographed(rate: float, shutter_s: float, full: int, spread: float = 0.0, stated: int = 15831) -> Shot:
    """Return white paper of so many counts a second in the strongest of three channels, on a sensor that saturates."""
    random = np.random.default_rng(1)
    light = rate * shutter_s * np.array([[0.4, 1.0], [1.0, 0.7]])
    signal = np.tile(light, (40, 60)) * random.uniform(0.9, 1.0, (80, 120))
    top = full + spread * random.standard_normal(signal.shape)
    noisy = BLACK + signal + 6 * random.standard_normal(signal.shape)
    counts = np.clip(np.minimum(noisy, top), 0, 16383).astype(np.uint16)
    mosaic = Mosaic(
        counts, "RGGB", np.full((2, 2), float(BLACK)), stated, "a camera", counts, Area(0, 0, 80, 120), ()
    )  # fmt: skip
    return Shot(shutter_s, mosaic, 1)


@pytest.mark.parametrize("share", [0.01, 0.1, 0.7, 1.5, 40.0])
@pytest.mark.parametrize("spread", [0.0, 40.0])
def test_saturation_is_measured_whatever_the_file_states(share: float, spread: float) -> None:
    rate = share * (13584 - BLACK) / 0.5
    found = measure_saturation(
        photographed(rate, 0.5, 13584, spread), lambda s: photographed(rate, s, 13584, spread), TIMES
    )
    # At 1 % even 30 s do not saturate the strongest channel: sixty times as much is 60 %.
    assert found.measured == (share > 0.01)
    assert found.stated == 15831
    assert found.counts == (pytest.approx(13584, abs=3 * spread + 1) if found.measured else 15831)


def test_darkness_is_no_saturation() -> None:
    found = measure_saturation(photographed(0, 0.5, 13584), lambda s: photographed(0, s, 13584), TIMES)
    assert not found.measured


def tried(rate: float, start_s: float, times: list[float]) -> tuple[TriedTime, ...]:
    def measure(seconds: float) -> TriedTime:
        level = min(rate * seconds, 1.0)
        return TriedTime(seconds, (0.4 * level, level, 0.7 * level), level >= 0.95)

    return search(measure(start_s), measure, times)


def test_the_search_ends_at_a_good_time_wherever_there_is_one() -> None:
    random = np.random.default_rng(2)
    for _ in range(400):
        rate = float(10 ** random.uniform(-2.5, 2.5))
        start_s = float(random.choice(TIMES))
        trials = tried(rate, start_s, TIMES)
        assert len(trials) <= TRIALS
        assert len({trial.shutter_s for trial in trials}) == len(trials), "no time is tried twice"
        best = best_of(trials)
        if any(0.6 <= rate * time <= 0.8 for time in TIMES):
            assert 0.6 <= best.highest <= 0.8, (rate, start_s, trials)
        else:
            able = [time for time in TIMES if rate * time < 0.95] or TIMES[:1]
            nearest = min(able, key=lambda time: abs(np.log(rate * time / 0.7)))
            assert best.shutter_s == pytest.approx(nearest), (rate, start_s, trials)


@pytest.mark.parametrize(
    ("level", "grade"),
    [(0.02, "remark"), (0.29, "remark"), (0.31, "remark"), (0.59, "remark"), (0.61, "good"), (0.79, "good"),
     (0.81, "remark"), (0.93, "remark"), (1.0, "fault")],
)  # fmt: skip
def test_white_is_judged_at_the_settings_time(level: float, grade: str) -> None:
    trials = tried(level / 0.5, 0.5, TIMES)
    found = judge_exposure(trials, Saturation(13584, True, 15831), TIMES, PERIOD_S)
    assert found.grade == grade
    assert (found.remedy == "") == (grade == "good")
    if grade != "good":
        assert "set camera.shutter_s = " in found.remedy
        assert found.details["proposed_shutter_s"] in TIMES


def test_a_share_of_a_stated_saturation_is_not_called_good() -> None:
    found = judge_exposure(tried(1.4, 0.5, TIMES), Saturation(15831, False, 15831), TIMES, PERIOD_S)
    assert found.grade == "remark"
    assert "as the file states, not measured" in found.said


@pytest.mark.parametrize(
    ("trials", "said"),
    [
        ([(0.5, 0.3), (1.0, 0.7)], "set camera.shutter_s = 1 (tried: 70 %)"),
        (
            [(0.5, 0.3), (1.0, 1.0)],
            "camera.shutter_s = 0.5, gives 30 %: set a lower f-number or a higher ISO speed, or a",
        ),
        ([(0.5, 0.9), (0.25, 0.85)], "gives 85 %: set a higher f-number or a lower ISO speed, or dim the projector"),
        ([(0.5, 1.0), (0.25, 1.0)], "even the shortest, 0.25 s, saturates: set a higher f-number"),
    ],
)
def test_where_no_time_suits_lens_or_speed_are_named(trials: list[tuple[float, float]], said: str) -> None:
    tried = [TriedTime(time, (0.1, level, 0.2), level >= 0.95) for time, level in trials]
    found = judge_exposure(tried, Saturation(13584, True, 15831), TIMES, PERIOD_S)
    assert said in found.remedy
    assert ("proposed_shutter_s" in found.details) == ("tried" in said)
    without = judge_exposure(tried, Saturation(13584, True, 15831), [], PERIOD_S)
    assert "lists no shutter times" in without.remedy


def test_a_trial_is_of_the_strongest_channel_above_black() -> None:
    shot = photographed(1000, 1.0, 13584)
    white = np.array([2000.0, 11536 * 0.985, 300.0])
    for counts, clipped in ((white, True), (white * 0.99, False)):
        trial = level_of(shot, Saturation(13584, True, 15831), counts)
        assert trial.level == pytest.approx(tuple(counts / (13584 - BLACK)))
        assert (trial.highest, trial.clipped) == (max(trial.level), clipped)


def test_times_that_hold_whole_turns_up_to_half_a_minute_are_offered() -> None:
    offered = [31.0, 30.0, 0.5, 1 / 50, 1 / 60, 1 / 120]
    assert fitting_times(offered, PERIOD_S) == [1 / 60, 0.5, 30.0]
    assert fitting_times(offered, None) == [1 / 120, 1 / 60, 1 / 50, 0.5, 30.0]
