"""Measurement of saturation, and the search for a shutter time."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.check.exposure import (
    TRIALS,
    Saturation,
    Shot,
    TriedTime,
    best_trial,
    fitting_times,
    judge_exposure,
    measure_level,
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
    """Return a frame of white paper, `rate` counts/s in its strongest channel, saturated at `full`."""
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
def test_measures_saturation(share: float, spread: float) -> None:
    rate = share * (13584 - BLACK) / 0.5
    saturation = measure_saturation(
        photographed(rate, 0.5, 13584, spread), lambda s: photographed(rate, s, 13584, spread), TIMES
    )
    # At 1 % even 30 s do not saturate the strongest channel: sixty times as much is 60 %.
    assert saturation.measured == (share > 0.01)
    assert saturation.stated == 15831
    assert saturation.counts == (pytest.approx(13584, abs=3 * spread + 1) if saturation.measured else 15831)


def test_distinguishes_darkness_from_saturation() -> None:
    saturation = measure_saturation(photographed(0, 0.5, 13584), lambda s: photographed(0, s, 13584), TIMES)
    assert not saturation.measured


def trials_of(rate: float, start_s: float, times: list[float]) -> tuple[TriedTime, ...]:
    def measure(seconds: float) -> TriedTime:
        level = min(rate * seconds, 1.0)
        return TriedTime(seconds, (0.4 * level, level, 0.7 * level), level >= 0.95)

    return search(measure(start_s), measure, times)


def test_search_ends_at_good_time() -> None:
    random = np.random.default_rng(2)
    for _ in range(400):
        rate = float(10 ** random.uniform(-2.5, 2.5))
        start_s = float(random.choice(TIMES))
        trials = trials_of(rate, start_s, TIMES)
        assert len(trials) <= TRIALS
        assert len({trial.shutter_s for trial in trials}) == len(trials), "no time is tried twice"
        best = best_trial(trials)
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
def test_judges_white_at_time_of_settings(level: float, grade: str) -> None:
    trials = trials_of(level / 0.5, 0.5, TIMES)
    finding = judge_exposure(trials, Saturation(13584, True, 15831), TIMES, PERIOD_S)
    assert finding.grade == grade
    assert (finding.remedy == "") == (grade == "good")
    if grade != "good":
        assert "set camera.shutter_s = " in finding.remedy
        assert finding.details["proposed_shutter_s"] in TIMES


def test_remarks_on_unmeasured_saturation() -> None:
    finding = judge_exposure(trials_of(1.4, 0.5, TIMES), Saturation(15831, False, 15831), TIMES, PERIOD_S)
    assert finding.grade == "remark"
    assert "from the file, not measured" in finding.said


@pytest.mark.parametrize(
    ("trials", "said"),
    [
        ([(0.5, 0.3), (1.0, 0.7)], "set camera.shutter_s = 1 (measured: 70 %)"),
        (
            [(0.5, 0.3), (1.0, 1.0)],
            "camera.shutter_s = 0.5, gives 30 %: set a lower f-number or a higher ISO speed, or use",
        ),
        ([(0.5, 0.9), (0.25, 0.85)], "gives 85 %: set a higher f-number or a lower ISO speed, or dim the projector"),
        ([(0.5, 1.0), (0.25, 1.0)], "even the shortest, 0.25 s, saturates: set a higher f-number"),
    ],
)
def test_proposes_time_aperture_or_speed(trials: list[tuple[float, float]], said: str) -> None:
    trials_of = [TriedTime(time, (0.1, level, 0.2), level >= 0.95) for time, level in trials]
    finding = judge_exposure(trials_of, Saturation(13584, True, 15831), TIMES, PERIOD_S)
    assert said in finding.remedy
    assert ("proposed_shutter_s" in finding.details) == ("measured" in said)
    without = judge_exposure(trials_of, Saturation(13584, True, 15831), [], PERIOD_S)
    assert "lists no shutter times" in without.remedy


def test_measures_level_of_strongest_channel() -> None:
    shot = photographed(1000, 1.0, 13584)
    white = np.array([2000.0, 11536 * 0.985, 300.0])
    for counts, clipped in ((white, True), (white * 0.99, False)):
        trial = measure_level(shot, Saturation(13584, True, 15831), counts)
        assert trial.level == pytest.approx(tuple(counts / (13584 - BLACK)))
        assert (trial.highest, trial.clipped) == (max(trial.level), clipped)


def test_offers_whole_periods_up_to_30_s() -> None:
    offered = [31.0, 30.0, 0.5, 1 / 50, 1 / 60, 1 / 120]
    assert fitting_times(offered, PERIOD_S) == [1 / 60, 0.5, 30.0]
    assert fitting_times(offered, None) == [1 / 120, 1 / 60, 1 / 50, 0.5, 30.0]
