"""Complete checks in simulated rooms: figures on both sides of their limits, and no remarks in a good room."""

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
from acquisition.check.check import TriedExposures, check_lab
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

UNREPORTED = {"battery", "card", "noise_reduction"}  # A camera need not report these


def finding_of(report: CheckReport, name: str) -> Finding:
    (finding,) = [finding for finding in report.findings if finding.name == name]
    return finding


def not_good(report: CheckReport) -> set[str]:
    return {finding.name for finding in report.findings if finding.grade in ("fault", "remark")}


def test_accepts_good_room_and_lists_unmeasured_figures(check: Check) -> None:
    report = check(3, seed=13)
    assert not_good(report) == set()
    assert {finding.name for finding in report.with_grade("not checked")} <= UNREPORTED
    assert finding_of(report, "brightest_share").details["saturation_counts"] == 13584
    assert finding_of(report, "brightest_share").details["saturation_measured"]
    assert report.forecast == "accept"
    assert {"truth_median_deg", "correction_residual", "primaries_lacking"} <= set(report.not_known)
    assert report.figures.keys() | set(report.not_known) == {figure.name for figure in FIGURES}
    assert "only a session can measure: " in report.lines()[-1]
    assert [line.split()[0] for line in report.devices] == ["illuminants", "camera", "projector"]
    table = json_value(report.values())["table"]
    assert table["outcome"] == "accept"
    assert table["figures"]["cell_px"] > 8.6


def test_figures_have_limits_of_build_lut(check: Check) -> None:
    report = check(3, ambient=0.02)
    for name, value in report.figures.items():
        finding = finding_of(report, name)
        # White is judged at the settings' time before there are trial frames.
        assert finding.value == pytest.approx(value, rel=0.1 if name == "brightest_share" else 0)
        if finding.grade != "fault":
            assert (finding.good, finding.tolerable) == BY_NAME[name].ranges
        assert (
            finding.grade
            == {"accept": "good", "accept with remarks": "remark", "refuse": "fault"}[BY_NAME[name].outcome(value)]
        )


@pytest.mark.parametrize(("level", "used_s"), [(0.29, 1.0), (0.31, 0.5), (0.89, 0.5), (0.91, 1.0), (1.0, 1.0)])
def test_uses_shutter_time_of_settings_if_suitable(level: float, used_s: float) -> None:
    tried = TriedTime(0.5, (0.1, level, 0.2), level >= 0.98), TriedTime(1.0, (0.1, 0.7, 0.2), False)
    counts = np.full((4, 4), 4000, dtype=np.uint16)
    mosaic = Mosaic(counts, "RGGB", np.full((2, 2), 2048.0), 15831, "a camera", counts, Area(0, 0, 4, 4), ())
    exposures = TriedExposures(Shot(0.5, mosaic, 1), tried, (0.5, 1.0), Saturation(13584, True, 15831))
    assert exposures.used_s == used_s


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
def test_remarks_on_faulty_rooms(check: Check, bits: int, room: dict[str, Any], expected: set[str]) -> None:
    report = check(bits, **room)
    assert not_good(report) >= expected
    assert bool(not_good(report)) == bool(expected)
    assert not report.with_grade("fault")


def test_remarks_on_uneven_light_and_black_level_of_projector(check: Check) -> None:
    report = check(3, projector_falloff=0.8, black_leak=0.01)
    assert not_good(report) >= {"evenness", "leak_share"}
    assert finding_of(report, "evenness").value == pytest.approx(0.85, abs=0.07)


def test_refuses_room_that_always_saturates(check: Check) -> None:
    report = check(2, white_level_share=40.0)
    assert {finding.name for finding in report.with_grade("fault")} == {"brightest_share", "clipping", "chart"}
    assert "even the shortest, 0.01667 s, saturates" in finding_of(report, "brightest_share").remedy
    assert {"figures", "evenness", "turn"} <= {finding.name for finding in report.with_grade("not checked")}


def test_proposes_shorter_time_if_white_clips(check: Check) -> None:
    report = check(2, white_level_share=4.0)
    assert {finding.name for finding in report.with_grade("fault")} == {"brightest_share", "clipping"}
    assert finding_of(report, "brightest_share").details["proposed_shutter_s"] == pytest.approx(0.1)
    assert "exposed for 0.1 s" in report.devices[-1]
    # The figures do not hold for the shutter time of the settings.
    assert report.forecast is None
    assert "no forecast" in report.lines()[-2]
    assert report.values()["table"]["figures"] == report.figures


def test_distinguishes_darkness_from_saturation(check: Check) -> None:
    report = check(2, white_level_share=0.0002)
    assert finding_of(report, "brightest_share").grade == "remark"
    assert not finding_of(report, "brightest_share").details["saturation_measured"]
    assert "lower f-number" in finding_of(report, "brightest_share").remedy
    assert "exposure" in {finding.name for finding in report.with_grade("fault")}
    assert report.forecast is None
    assert finding_of(report, "clipping").grade == "good"


def test_reports_partial_turns_of_colour_wheel(check: Check) -> None:
    report = check(2, "shutter_s = 0.01666667", wheel_hz=60.0, white_level_share=20.0)
    assert {"white_drift", "white_drift_deg"} <= not_good(report)
    assert "colour wheel" in finding_of(report, "white_drift_deg").said


def test_measures_linearity_by_exposure_series(check: Check) -> None:
    # With two colours per channel the primaries cannot show linearity.
    assert "linearity" not in check(1).figures
    report = check(1, linearity=True)
    assert finding_of(report, "linearity").grade == "good"
    assert 0 < report.figures["linearity"] < 0.01


def test_reports_undetected_chart(check: Check) -> None:
    report = check(2, fill=0.15)
    assert finding_of(report, "chart").grade == "fault"
    for name in ("figures", "evenness", "turn", "keystone"):
        assert finding_of(report, name).grade == "not checked"
    assert report.forecast is None


def test_checks_chart_without_tags_by_its_corners(check: Check, folder: Path, tmp_path: Path) -> None:
    chart = paper_chart("A5", 2)
    chart.save(folder / "paper.json")
    lab = hang_chart(chart, "Test", Room(seed=1))
    half = np.array(chart.cell_mm) / 2
    (left, top), (right, bottom) = chart.centres_mm.min(axis=0) - half, chart.centres_mm.max(axis=0) + half
    outline = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    corners = lab.truth_px(outline, lab.mosaic(tmp_path))
    report = check(chart="paper.json", corners=tuple((x, y) for x, y in corners.tolist()))
    assert not report.with_grade("fault")
    assert {"agreement", "bleed", "additivity"} <= report.figures.keys()
    assert "tags_found" in report.not_known


def test_applies_dark_limit_of_run(check: Check) -> None:
    grades = [
        finding_of(check(2, more=f"[judge]\ndark_percent = {limit}\n", ambient=0.03), "leak_share").grade
        for limit in (2.5, 3.5)
    ]
    assert grades == ["fault", "remark"]


def test_removes_trial_frames_after_error(check: Check, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    earlier_files = set(folder.iterdir())
    new_files = list[set[Path]]()

    def free(path: Path) -> int:
        new_files.append(set(path.iterdir()) - earlier_files)
        return 10_000

    monkeypatch.setattr(check_module, "free_bytes_at", free)
    with pytest.raises(StorageError, match=r"0\.0 MB free at .* for the frames of a check") as caught:
        check(1)
    assert caught.value.exit_code == 5
    (hidden,) = new_files[-1] - {folder / "LAB.toml"}
    assert hidden.name.startswith(".")
    assert set(folder.iterdir()) - earlier_files <= {folder / "LAB.toml"}


def test_command_prints_faults_first_and_ends_with_4(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = folder / "command.toml"
    lab.write_text(lab_toml("chart2.json", ambient=0.07, black_leak=0.0))
    picture = tmp_path / "check.png"
    assert main(["check", str(lab), "--picture", str(picture)]) == 4
    printed = capsys.readouterr()
    findings = [
        line for line in printed.out.splitlines() if line.startswith(("fault", "remark", "not checked", "good"))
    ]
    assert findings[0].startswith("fault       leak_share")
    assert findings[-1].startswith("good")
    assert "1 fault: leak_share" in printed.err
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert "stays on" in printed.out


def test_command_prints_json(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    report = CheckReport((), (Finding("disk", "good", "seen"), Finding("turn", "remark", "seen")))

    monkeypatch.setattr(check_module, "check_lab", Mock(return_value=report))
    lab = folder / "json.toml"
    lab.write_text(lab_toml("chart2.json"))
    assert main(["check", str(lab), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["faults"] == 0
    assert [finding["name"] for finding in document["findings"]] == ["disk", "turn"]


@pytest.mark.parametrize("faulty", FAULTY, ids="+".join)
def test_reports_all_device_faults_at_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch, faulty: tuple[str, ...]
) -> None:
    @contextmanager
    def opening(settings: LabSettings, *others: Any) -> Generator[Devices]:
        with open_rig(settings, *others) as devices:
            attributes = {"camera": "camera", "display": "presenter", "projector": "projector"}
            broken: dict[str, Any] = {attributes[name]: Broken(SAYS[name]) for name in faulty}
            yield replace(devices, **broken)

    monkeypatch.setattr(check_module, "open_rig", opening)
    (folder / "LAB.toml").write_text(lab_toml("chart1.json"))
    with pytest.raises(DeviceError) as caught:
        check_lab(load_lab(folder / "LAB.toml"))
    for name in DEVICES:
        assert (SAYS[name] in str(caught.value)) == (name in faulty)
    assert caught.value.exit_code == 3
    if len(faulty) == 1:
        assert str(caught.value).removeprefix("the ").startswith(faulty[0])
    else:
        assert str(caught.value).startswith(f"{len(faulty)} of 3 devices cannot be used:")
