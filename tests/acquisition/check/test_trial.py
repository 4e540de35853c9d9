"""Trial frames: which are taken, and agreement of their figures with the LUT of the same session."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.check.exposure import Saturation
from acquisition.check.trial import measure_trial, series_times, trial_lights, trial_steps
from acquisition.judge.judge import LiveJudge
from benchmarks.sessions import record_session
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.verdict import judged_values
from drivers.presenter import Colour
from experiment.config import LabSettings
from experiment.lights import Illuminant
from experiment.session.records import SessionStep
from sim.world.world import Room
from tests.calibration.lab import hang

DIM = Illuminant(0, "uniform", None, Colour(30, 20, 40))
PLAN = (Illuminant(1, "uniform", None, Colour(255, 0, 0)), DIM)


def test_trial_has_references_primaries_and_darkest_illuminant() -> None:
    lights = trial_lights(PLAN, np.eye(3))
    assert [light.name for light in lights] == ["white", "red", "green", "blue", "grey", "darkest"]
    assert lights[-1].colour == DIM.colour
    assert [light.name for light in trial_lights(PLAN[:1], np.eye(3))] == ["white", "red", "green", "blue", "grey"]
    kinds = [step.kind for step in trial_steps(lights)]
    assert kinds == ["white"] * 3 + ["dark"] + ["light"] * 6 + ["white"] * 3 + ["dark"]


def test_series_covers_6_to_94_percent() -> None:
    times = series_times([0.01 * k for k in range(1, 200)], 0.5, 0.7)
    assert len(times) == 8
    assert 0.7 * times[0] / 0.5 == pytest.approx(0.06, abs=0.02)
    assert 0.7 * times[-1] / 0.5 == pytest.approx(0.94, abs=0.02)
    assert series_times([10.0], 0.5, 0.7) == []


@pytest.mark.parametrize(("red", "darkest"), [(0.3, 70), (1.0, 60)])
def test_darkest_illuminant_has_fewest_counts(red: float, darkest: int) -> None:
    plan = [replace(DIM, colour=Colour(60, 60, 60)), replace(DIM, colour=Colour(70, 0, 0))]
    primaries = 4000 * np.array([[red, 0.0, 0.0], [0.0, 1.0, 0.1], [0.0, 0.1, 0.7]])
    assert trial_lights(plan, primaries)[-1].colour[0] == darkest


@pytest.mark.slow
def test_dark_light_agrees_with_live_judge(tmp_path: Path) -> None:
    lab, lights = hang(3), trial_lights((), np.eye(3))

    def lit(counts: npt.NDArray[np.uint16]) -> None:
        height, width = counts.shape
        counts[: height // 3, : width // 3] += 800

    def frame(step: SessionStep) -> bytes:
        return lab.dng(step.colour, step.number, paint=lit if step.kind == "dark" else None)

    steps = trial_steps(lights)
    with record_session(tmp_path / "session", lab.chart, lights, frame, steps=steps) as session:
        trial = measure_trial(session, Saturation(13584, True, 15831), None, None)
        settings = LabSettings(rig="lab", chart=Path("chart.json"), illuminations=Path("lights.csv"))
        live = LiveJudge(settings, lab.chart, lights)
        files = {record.kind: session.folder / record.file for record in reversed(session.frames())}
        live.judge(files["white"], steps[0])
        (judged,) = [check for check in live.judge(files["dark"], steps[3]).checks if check.name == "leak_share"]
    assert judged.reason
    # Without a dark frame the judge subtracts nothing from white.
    assert judged.value == pytest.approx(trial.dark_percent / (1 + trial.dark_percent / 100), rel=0.05)
    (table,) = [row.value for row in trial.verdict.rows if row.figure.name == "leak_share"]
    assert 100 * table < 5 < trial.dark_percent


@pytest.mark.slow
@pytest.mark.parametrize(
    "room",
    [Room(waviness_mm=0.5), Room(waviness_mm=0.5, ambient=0.02), Room(waviness_mm=0.5, stain_mm=20.0, stain_depth=0.3)],
    ids=["good", "lit", "stained"],
)
def test_trial_figures_agree_with_lut(room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A trial does not measure the lens.
    monkeypatch.setattr("calibration.pipeline.baseline.unsuitable", Mock(return_value="not measured in this test"))
    lab, lights = hang(3, room=room), trial_lights(PLAN, np.eye(3))
    with record_session(
        tmp_path / "session",
        lab.chart,
        lights,
        lambda step: lab.dng(step.colour, step.number),
        steps=trial_steps(lights),
    ) as session:
        trial = measure_trial(session, Saturation(13584, True, 15831), None, None)
        built = judged_values(build(session, tmp_path / "lut").figures)
        empty_folder = tmp_path / "series"
        empty_folder.mkdir()
        repeated = measure_trial(session, Saturation(13584, True, 15831), None, empty_folder)
    assert not trial.series_trouble
    assert "contains 0 files" in repeated.series_trouble
    assert repeated.verdict == trial.verdict
    measured = {row.figure.name: row.value for row in trial.verdict.rows}
    assert measured.keys() == {figure.name for figure in FIGURES if figure.before_session} & built.keys()
    for name, value in measured.items():
        # Saturation was measured for the trial; the frames of the table do not show it.
        assert value == pytest.approx(built[name], rel=0.3 if name == "brightest_share" else 1e-9), name
    assert set(trial.not_known) == {figure.name for figure in FIGURES} - measured.keys()
