"""Trial frames: what is taken, and that they show what a table of the same session shows."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import pytest

from acquisition.check.exposure import Saturation
from acquisition.check.trial import at_settings, measure_trial, series_times, trial_lights, trial_steps
from benchmarks.sessions import record_session
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.verdict import judge, judged_values
from drivers.presenter import Colour
from experiment.lights import Illumination
from sim.world.world import Room
from tests.calibration.lab import hang

DIM = Illumination(0, "uniform", None, Colour(30, 20, 40))
PLAN = (Illumination(1, "uniform", None, Colour(255, 0, 0)), DIM)


def test_a_trial_is_of_white_dark_primaries_grey_and_the_darkest_light() -> None:
    lights = trial_lights(PLAN)
    assert [one.name for one in lights] == ["white", "red", "green", "blue", "grey", "darkest"]
    assert lights[-1].colour == DIM.colour
    assert [one.name for one in trial_lights(PLAN[:1])] == ["white", "red", "green", "blue", "grey"]
    kinds = [step.kind for step in trial_steps(lights, recorded=False)]
    assert kinds == ["white"] * 3 + ["dark"] + ["light"] * 6 + ["white"] * 3 + ["dark"]
    assert [step.kind for step in trial_steps(lights, recorded=True)] == ["white", "dark"]


def test_a_series_goes_from_dim_to_nearly_saturated() -> None:
    times = series_times([0.01 * k for k in range(1, 200)], 0.5, 0.7)
    assert len(times) == 8
    assert 0.7 * times[0] / 0.5 == pytest.approx(0.06, abs=0.02)
    assert 0.7 * times[-1] / 0.5 == pytest.approx(0.94, abs=0.02)
    assert series_times([10.0], 0.5, 0.7) == []


def test_figures_are_those_at_the_shutter_time_of_the_settings() -> None:
    verdict = judge({"brightest_share": 0.7, "darkest_counts": 1000.0, "cell_px": 10.0})
    values = {row.figure.name: row.value for row in at_settings(verdict, 0.14, 0.2).rows}
    assert values == {"brightest_share": 0.14, "darkest_counts": pytest.approx(200.0), "cell_px": 10.0}
    assert at_settings(verdict, 0.14, 0.2).outcome == "accept with remarks"


@pytest.mark.slow
@pytest.mark.parametrize(
    "room",
    [Room(waviness_mm=0.5), Room(waviness_mm=0.5, ambient=0.02), Room(waviness_mm=0.5, stain_mm=20.0, stain_depth=0.3)],
    ids=["good", "lit", "stained"],
)
def test_trial_frames_show_what_a_table_of_them_shows(
    room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A trial does not measure the lens.
    monkeypatch.setattr("calibration.pipeline.baseline.unsuitable", Mock(return_value="not measured in this test"))
    lab, lights = hang(3, room=room), trial_lights(PLAN)
    with record_session(
        tmp_path / "session",
        lab.chart,
        lights,
        lambda step: lab.dng(step.colour, step.number),
        steps=trial_steps(lights, recorded=False),
    ) as session:
        trial = measure_trial(session, Saturation(13584, True, 15831), None, None, recorded=False)
        built = judged_values(build(session, tmp_path / "lut").figures)
        without = tmp_path / "series"
        without.mkdir()
        again = measure_trial(session, Saturation(13584, True, 15831), None, without, recorded=False)
    assert not trial.series_trouble
    assert "holds 0 files" in again.series_trouble
    assert again.verdict == trial.verdict
    shown = {row.figure.name: row.value for row in trial.verdict.rows}
    assert shown.keys() == {figure.name for figure in FIGURES if figure.before_session} & built.keys()
    for name, value in shown.items():
        # Saturation was measured for the trial; the frames of the table do not show it.
        assert value == pytest.approx(built[name], rel=0.3 if name == "brightest_share" else 1e-9), name
    assert set(trial.not_known) == {figure.name for figure in FIGURES} - shown.keys()
