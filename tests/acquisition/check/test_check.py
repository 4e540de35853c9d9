"""Whole checks in simulated rooms: figures on both sides of their limits, and none beyond them in a good room."""

from __future__ import annotations

import json
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from acquisition.check import check as check_module
from acquisition.check.check import FoundExposure, check_lab
from acquisition.check.exposure import Saturation, Shot, TriedTime
from acquisition.check.findings import CheckReport, Finding
from acquisition.cli import main
from acquisition.run.devices import Devices
from acquisition.run.rig.opening import open_rig
from calibration.figures.all_figures import BY_NAME, FIGURES
from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.chart.layout import paper_chart
from experiment.config import LabSettings, load_lab
from foundation.console import json_value
from foundation.errors import DeviceError, StorageError
from sim.world.world import Room
from tests.acquisition.check.conftest import Check, lab_toml
from tests.acquisition.run.scripted import DEVICES, FAULTY, SAYS, Broken
from tests.calibration.lab import hang_chart

pytestmark = pytest.mark.slow

UNTOLD = {"battery", "card", "noise_reduction"}
"""What a body may not report."""


def of(report: CheckReport, name: str) -> Finding:
    (found,) = [finding for finding in report.findings if finding.name == name]
    return found


def not_good(report: CheckReport) -> set[str]:
    return {finding.name for finding in report.findings if finding.grade in ("fault", "remark")}


def test_a_good_room_has_nothing_to_remark_on_and_names_what_is_not_known_yet(check: Check) -> None:
    report = check(3, seed=13)
    assert not_good(report) == set()
    assert {finding.name for finding in report.of("not checked")} <= UNTOLD
    assert of(report, "brightest_share").details["saturation_counts"] == 13584
    assert of(report, "brightest_share").details["saturation_measured"]
    assert report.forecast == "accept"
    assert {"truth_median_deg", "correction_residual", "primaries_lacking"} <= set(report.not_known)
    assert report.figures.keys() | set(report.not_known) == {figure.name for figure in FIGURES}
    assert "not known before the session: " in report.lines()[-1]
    # What is to be taken is named before the devices that take it.
    assert [line.split()[0] for line in report.devices] == ["lights", "camera", "projector"]
    table = json_value(report.values())["table"]
    assert table["outcome"] == "accept"
    assert table["figures"]["cell_px"] > 8.6


def test_a_figure_has_the_name_and_the_limits_of_a_table(check: Check) -> None:
    report = check(3, ambient=0.02)
    for name, value in report.figures.items():
        found = of(report, name)
        # White is judged at the settings' time before there are trial frames.
        assert found.value == pytest.approx(value, rel=0.1 if name == "brightest_share" else 0)
        if found.grade != "fault":
            assert (found.good, found.tolerable) == BY_NAME[name].ranges
        assert (
            found.grade
            == {"accept": "good", "accept with remarks": "remark", "refuse": "fault"}[BY_NAME[name].outcome(value)]
        )


@pytest.mark.parametrize(("level", "used_s"), [(0.29, 1.0), (0.31, 0.5), (0.89, 0.5), (0.91, 1.0), (1.0, 1.0)])
def test_trial_frames_are_taken_as_the_settings_have_it_where_white_is_neither_dark_nor_clipped(
    level: float, used_s: float
) -> None:
    tried = TriedTime(0.5, (0.1, level, 0.2), level >= 0.98), TriedTime(1.0, (0.1, 0.7, 0.2), False)
    counts = np.full((4, 4), 4000, dtype=np.uint16)
    mosaic = Mosaic(counts, "RGGB", np.full((2, 2), 2048.0), 15831, "a camera", counts, Area(0, 0, 4, 4), ())
    found = FoundExposure(Shot(0.5, mosaic, 1), tried, (0.5, 1.0), Saturation(13584, True, 15831))
    assert found.used_s == used_s


@pytest.mark.parametrize(
    ("bits", "room", "expected"),
    [
        (3, {"seed": 11, "vignetting": 0.4, "ambient": 0.003, "blur_px": 0.65, "wheel_hz": 60.0}, set()),
        (3, {"blur_px": 0.75}, {"bleed"}),
        (3, {"ambient": 0.02}, {"leak_share"}),
        (2, {"roll_deg": 8.0, "pan_deg": 14.0, "fill": 0.75}, {"turn", "keystone"}),
        (2, {"roll_deg": 180.0}, set()),
        (3, {"hot_per_million": 300.0}, {"unfit_share", "noisy_share"}),
        (3, {"stain_mm": 25.0, "stain_depth": 0.15}, {"unfit_share", "doubtful_share"}),
        (3, {"fold_mm": 5.0}, {"unfit_share", "doubtful_share"}),
    ],
    ids=lambda value: ", ".join(value) if isinstance(value, dict) else "",
)
def test_what_is_wrong_in_a_room_is_remarked_on(
    check: Check, bits: int, room: dict[str, Any], expected: set[str]
) -> None:
    report = check(bits, **room)
    assert not_good(report) >= expected
    assert bool(not_good(report)) == bool(expected)
    assert not report.of("fault")


def test_uneven_light_and_the_projector_s_black(check: Check) -> None:
    report = check(3, projector_falloff=0.8, black_leak=0.01)
    assert not_good(report) >= {"evenness", "leak_share"}
    assert of(report, "evenness").value == pytest.approx(0.85, abs=0.07)


def test_a_room_in_which_white_saturates_at_every_time(check: Check) -> None:
    report = check(2, white_level_share=40.0)
    assert {finding.name for finding in report.of("fault")} == {"brightest_share", "clipping", "chart"}
    assert "even the shortest, 0.01667 s, saturates" in of(report, "brightest_share").remedy
    assert {"figures", "evenness", "turn"} <= {finding.name for finding in report.of("not checked")}


def test_an_exposure_that_clips_is_mended_and_the_rest_is_judged_at_a_better_one(check: Check) -> None:
    report = check(2, white_level_share=4.0)
    assert {finding.name for finding in report.of("fault")} == {"brightest_share", "clipping"}
    assert of(report, "brightest_share").details["proposed_shutter_s"] == pytest.approx(0.1)
    assert "taken at 0.1 s" in report.devices[-1]
    # A table at the settings' time would be another one.
    assert report.forecast is None
    assert report.lines()[-2].endswith("set camera.shutter_s to 0.1 first; these figures hold for 0.1 s")
    assert report.values()["table"]["figures"] == report.figures


def test_a_dark_room_is_not_called_saturated(check: Check) -> None:
    report = check(2, white_level_share=0.0002)
    assert of(report, "brightest_share").grade == "remark"
    assert not of(report, "brightest_share").details["saturation_measured"]
    assert "lower f-number" in of(report, "brightest_share").remedy
    assert "exposure" in {finding.name for finding in report.of("fault")}
    assert report.forecast is None
    assert of(report, "clipping").grade == "good"


def test_partial_turns_of_a_wheel_are_seen_as_drift(check: Check) -> None:
    report = check(2, "shutter_s = 0.01666667", wheel_hz=60.0, white_level_share=20.0)
    assert {"white_drift", "white_drift_deg"} <= not_good(report)
    assert "colour wheel" in of(report, "white_drift_deg").said


def test_linearity_is_measured_by_a_series_of_exposures(check: Check) -> None:
    # Of two colours to a channel the primaries alone show no linearity.
    assert "linearity" not in check(1).figures
    report = check(1, linearity=True)
    assert of(report, "linearity").grade == "good"
    assert 0 < report.figures["linearity"] < 0.01


def test_a_chart_that_is_not_found_is_a_fault_and_what_rests_on_it_is_not_checked(check: Check) -> None:
    report = check(2, fill=0.15)
    assert of(report, "chart").grade == "fault"
    for name in ("figures", "evenness", "turn", "keystone"):
        assert of(report, name).grade == "not checked"
    assert report.forecast is None


def test_a_chart_without_tags_is_judged_where_its_corners_are_given(check: Check, folder: Path, tmp_path: Path) -> None:
    chart = paper_chart("A5", 2)
    chart.save(folder / "paper.json")
    lab = hang_chart(chart, "Test", Room(seed=1))
    half = np.array(chart.cell_mm) / 2
    (left, top), (right, bottom) = chart.centres_mm.min(axis=0) - half, chart.centres_mm.max(axis=0) + half
    outline = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    corners = lab.truth_px(outline, lab.mosaic(tmp_path))
    report = check(chart="paper.json", corners=tuple((x, y) for x, y in corners.tolist()))
    assert not report.of("fault")
    assert {"agreement", "bleed", "additivity"} <= report.figures.keys()
    assert "tags_found" in report.not_known


def test_the_run_s_own_limit_makes_dark_light_a_fault(check: Check) -> None:
    grades = [
        of(check(2, more=f"[judge]\ndark_percent = {limit}\n", ambient=0.03), "leak_share").grade
        for limit in (2.5, 3.5)
    ]
    assert grades == ["fault", "remark"]


def test_frames_lie_beside_lab_toml_and_are_removed_in_any_case(
    check: Check, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(folder.iterdir())
    seen = list[set[Path]]()

    def free(place: Path) -> int:
        seen.append(set(place.iterdir()) - before)
        return 10_000

    monkeypatch.setattr(check_module, "free_bytes_at", free)
    with pytest.raises(StorageError, match=r"0\.0 MB free at .* needed for the frames of a check") as told:
        check(1)
    assert told.value.exit_code == 5
    (hidden,) = seen[-1] - {folder / "LAB.toml"}
    assert hidden.name.startswith(".")
    assert set(folder.iterdir()) - before <= {folder / "LAB.toml"}


def test_the_command_prints_faults_first_draws_them_and_ends_with_4(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = folder / "command.toml"
    lab.write_text(lab_toml("chart2.json", ambient=0.07, black_leak=0.0))
    picture = tmp_path / "check.png"
    assert main(["check", str(lab), "--picture", str(picture)]) == 4
    printed = capsys.readouterr()
    told = [line for line in printed.out.splitlines() if line.startswith(("fault", "remark", "not checked", "good"))]
    assert told[0].startswith("fault       leak_share")
    assert told[-1].startswith("good")
    assert "1 fault: leak_share" in printed.err
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert "stays on" in printed.out


def test_the_command_says_it_in_json(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = CheckReport((), (Finding("disk", "good", "seen"), Finding("turn", "remark", "seen")))

    monkeypatch.setattr(check_module, "check_lab", Mock(return_value=found))
    lab = folder / "json.toml"
    lab.write_text(lab_toml("chart2.json"))
    assert main(["check", str(lab), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["faults"] == 0
    assert [finding["name"] for finding in document["findings"]] == ["disk", "turn"]


@pytest.mark.parametrize("faulty", FAULTY, ids="+".join)
def test_every_fault_of_simulated_devices_is_told_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, faulty: tuple[str, ...]
) -> None:
    @contextmanager
    def opening(settings: LabSettings, *others: Any) -> Generator[Devices]:
        with open_rig(settings, *others) as devices:
            places = {"camera": "camera", "display": "presenter", "projector": "projector"}
            broken: dict[str, Any] = {places[name]: Broken(SAYS[name]) for name in faulty}
            yield replace(devices, **broken)

    monkeypatch.setattr(check_module, "open_rig", opening)
    (folder / "LAB.toml").write_text(lab_toml("chart1.json"))
    with pytest.raises(DeviceError) as told:
        check_lab(load_lab(folder / "LAB.toml"))
    for name in DEVICES:
        assert (SAYS[name] in str(told.value)) == (name in faulty)
    assert told.value.exit_code == 3
    if len(faulty) == 1:
        assert str(told.value).removeprefix("the ").startswith(faulty[0])
    else:
        assert str(told.value).startswith(f"{len(faulty)} of 3 devices cannot be used:")
