"""Whole checks in simulated rooms: each verdict on both sides of its limit, and none of them wrong in a good room."""

from __future__ import annotations

import json
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from acquisition.check import check as check_module
from acquisition.check.check import check_lab
from acquisition.check.findings import GRADES, CheckReport, Finding
from acquisition.cli import main
from benchmarks.sessions import record_session
from drivers.presenter import BLACK, WHITE
from experiment.chart.layout import paper_chart
from experiment.chart.model import Chart, load_chart
from experiment.config import load_lab
from experiment.lights import load_illuminations
from experiment.session.journal import Journal
from experiment.session.records import plan_steps
from foundation.console import plain
from sim.world import world
from sim.world.world import Room, Stain, worn
from tests.acquisition.check.conftest import Check, lab_toml
from tests.calibration.lab import hang_chart

pytestmark = pytest.mark.slow

UNTOLD = {"battery", "card", "noise reduction"}
"""What a body may keep to itself."""


def of(report: CheckReport, name: str) -> Finding:
    (found,) = [finding for finding in report.findings if finding.name == name]
    return found


def not_good(report: CheckReport) -> set[str]:
    return {finding.name for finding in report.findings if finding.grade in ("fault", "remark")}


def test_a_good_room_has_nothing_to_remark_on_and_names_what_is_not_known_yet(check: Check) -> None:
    report = check(3, seed=13)
    assert not_good(report) == set()
    assert {finding.name for finding in report.of("not checked")} <= UNTOLD
    assert of(report, "exposure").details["saturation_counts"] == 13584
    assert of(report, "exposure").details["saturation_measured"]
    assert report.forecast == "accept"
    assert {"white_drift", "off_codes_deg", "agreement"} <= set(report.not_known)
    assert "not known before the session: " in report.lines()[-1]
    assert ", white drift, " in report.lines()[-1]
    # What is to be taken stands before the devices that take it.
    assert [line.split()[0] for line in report.devices] == ["lights", "camera", "projector"]
    table = plain(report.values())["table"]
    assert table["outcome"] == "accept"
    assert table["figures"]["cell_px"] > 8.6


def test_the_right_side_of_four_limits(check: Check) -> None:
    assert not_good(check(1, seed=11, vignetting=0.4, ambient=0.003, blur_px=0.65, wheel_hz=60.0)) == set()


def test_a_camera_turned_and_tilted(check: Check) -> None:
    report = check(2, roll_deg=8.0, pan_deg=14.0, fill=0.75)
    assert not_good(report) == {"turn", "tilt"}
    assert "its rows +8." in of(report, "turn").said
    assert "right and top nearer" in of(report, "tilt").said
    assert of(report, "tilt").details["pan_deg"] == pytest.approx(14, abs=1)


def test_uneven_light_the_projector_s_black_and_hot_photosites(check: Check) -> None:
    report = check(3, projector_falloff=0.8, black_leak=0.01, hot_per_million=300.0)
    # The primaries fall off differently, so that the light's colour changes, too.
    assert not_good(report) - {"stains"} == {"evenness", "colour evenness", "room light", "hot photosites"}
    assert not report.of("fault")
    assert "lens and projector together" in of(report, "evenness").said
    assert of(report, "evenness").value == pytest.approx(0.85, abs=0.07)
    stains = of(report, "stains")
    assert stains.grade == "good" or "may be an edge of the light" in stains.said
    assert "the projector's black" in of(report, "room light").said


def test_a_room_in_which_white_saturates_at_every_time(check: Check) -> None:
    report = check(2, white_level_share=40.0)
    assert of(report, "exposure").grade == "fault"
    assert "even the shortest, 0.01667 s, saturates" in of(report, "exposure").remedy
    for name in ("evenness", "stains", "room light", "flicker", "additivity", "hot photosites"):
        assert of(report, name).grade == "not checked", name


def test_a_dark_room_is_not_called_saturated(check: Check) -> None:
    report = check(2, white_level_share=0.0002)
    assert of(report, "exposure").grade == "remark"
    assert of(report, "darkest light").grade == "fault"
    assert not of(report, "exposure").details["saturation_measured"]
    assert "lower f-number" in of(report, "exposure").remedy
    assert of(report, "clipping").grade == "good"


def test_a_stain_on_half_of_a_small_chart_is_told(check: Check) -> None:
    found = of(check(1, stain_mm=60.0), "stains")
    assert found.grade == "remark"
    assert found.details["spots"][0]["size_mm"] == pytest.approx(65, abs=18)


def test_a_faint_thumb_s_stain_has_place_and_size(check: Check) -> None:
    found = of(check(3, stain_mm=25.0, stain_depth=0.15), "stains")
    (spot,) = found.details["spots"]
    assert spot["size_mm"] == pytest.approx(25, abs=5)
    # 15 % of blue; cells that the stain covers in part, and codes predicted from stained ones, take some of it away.
    assert -0.17 < spot["deviation"] < -0.06


def test_a_stained_corner_is_no_falloff(check: Check, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = worn

    def stained(room: Room, page_mm: tuple[float, float], random: np.random.Generator) -> Any:
        width, height = page_mm
        return Stain((width - 36, height - 30), 26.0, (0.8, 0.7, 0.5)), whole(room, page_mm, random)[1]

    monkeypatch.setattr(world, "worn", stained)
    report = check(3)
    (spot,) = of(report, "stains").details["spots"]
    width, height = load_chart(folder / "chart3.json").page_mm
    assert spot["centre_mm"] == pytest.approx((width - 36, height - 30), abs=6)
    assert of(report, "evenness").grade == "good"


def test_a_fold_is_told(check: Check) -> None:
    assert of(check(3, fold_mm=5.0), "stains").grade == "remark"


def test_partial_turns_of_a_wheel_are_told(check: Check) -> None:
    report = check(2, "shutter_s = 0.01666667", wheel_hz=60.0, white_level_share=20.0)
    assert of(report, "flicker").grade in ("remark", "fault")
    assert "expose for 0.5 s or more" in of(report, "flicker").remedy


def test_a_chart_without_references_has_no_light_and_no_stains(check: Check, folder: Path) -> None:
    chart = load_chart(folder / "chart2.json")
    replace(chart, references=chart.references[:2]).save(folder / "few.json")
    report = check(chart="few.json", stain_mm=30.0)
    for name in ("evenness", "colour evenness", "stains"):
        assert of(report, name).grade == "not checked"
        assert "white references" in of(report, name).said
    assert of(report, "room light").grade == "good"


def test_a_chart_without_tags(check: Check, folder: Path, tmp_path: Path) -> None:
    chart = paper_chart("A5", 2)
    chart.save(folder / "paper.json")
    lab = hang_chart(chart, "Test", Room(stain_mm=20.0))
    corners = lab.corners_px(lab.mosaic(tmp_path))
    assert corners is not None
    report = check(chart="paper.json", stain_mm=20.0, corners=tuple(map(tuple, corners.tolist())))
    assert not_good(report) == set()
    for name in ("evenness", "colour evenness", "stains"):
        assert of(report, name).grade == "not checked"
        assert "bare paper in its margin only" in of(report, name).said
    assert of(report, "chart").said == "no tags, the field of cells was found"


def test_linearity_and_noise_are_those_of_the_sensor(check: Check) -> None:
    report = check(3, linearity=True)
    assert of(report, "linearity").grade == "good"
    noise = of(report, "photon transfer").details
    assert noise["gain_e"] == pytest.approx([1.8] * 3, rel=0.1)
    assert noise["read_noise_counts"] == pytest.approx([6.0] * 3, rel=0.3)


def test_another_chart_is_a_fault_and_what_hangs_on_it_is_not_checked(check: Check) -> None:
    report = check(2, fill=0.15)
    assert of(report, "chart").grade == "fault"
    for name in ("evenness", "sharpness", "turn", "tilt", "size", "stains", "room light"):
        assert of(report, name).grade == "not checked"
    for name in ("references", "unfit cells", "grey tint", "darkest light"):
        assert of(report, name).said == "the chart was not found"
    assert report.forecast is None


def test_the_command_prints_faults_first_draws_them_and_ends_with_4(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reports, drawn = list[CheckReport](), list[Figure]()
    save = cast(Any, Figure).savefig

    def checked(*given: Any, **named: Any) -> CheckReport:
        reports.append(check_lab(*given, **named))
        return reports[-1]

    def saved(figure: Figure, *given: Any, **more: Any) -> None:
        drawn.append(figure)
        save(figure, *given, **more)

    monkeypatch.setattr(check_module, "check_lab", checked)
    monkeypatch.setattr(Figure, "savefig", saved)
    lab = folder / "command.toml"
    lab.write_text(lab_toml("chart2.json", ambient=0.07, black_leak=0.0, stain_mm=30.0))
    picture = tmp_path / "check.png"
    assert main(["check", str(lab), "--picture", str(picture)]) == 4
    printed = capsys.readouterr()
    told = [line for line in printed.out.splitlines() if line.startswith(("fault", "remark", "not checked", "good"))]
    of_fault, *_ = told
    assert of_fault.startswith("fault       room light")
    assert told[-1].startswith("good")
    assert "with the picture muted: the room's light" in of_fault
    assert "2 faults: room light, references" in printed.err
    assert (printed.out + printed.err).count(of_fault.split(maxsplit=3)[3]) == 1
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert "stays on" in printed.out
    ((report,), (figure,)) = reports, drawn
    assert_drawn(figure, report, load_chart(folder / "chart2.json"))


def assert_drawn(figure: Figure, report: CheckReport, chart: Chart) -> None:
    """Require that a check's picture shows the light, every tag's blur, every reference and spot, and each verdict."""
    frame, light, blur, print_, verdicts = (axes for axes in figure.axes if axes.get_label() != "<colorbar>")
    width, height = chart.page_mm
    for axes in (light, blur, print_):
        assert (axes.get_xlim(), axes.get_ylim()) == ((0, width), (height, 0))
    shares = np.concatenate(
        [np.concatenate([path.vertices for path in part.get_paths()]) for part in light.collections]
    )
    np.testing.assert_allclose([shares.min(axis=0), shares.max(axis=0)], [(0, 0), (width, height)])
    (tags,) = blur.collections
    assert isinstance(tags, PathCollection)
    assert len(np.asarray(tags.get_offsets())) == len(chart.tags)
    assert [text.get_text() for text in blur.texts] == [f"{sigma:.2f}" for sigma in np.asarray(tags.get_array())]
    (patches,) = print_.collections
    assert isinstance(patches, PathCollection)
    centres = np.array([reference.centre_mm for reference in chart.references])
    np.testing.assert_allclose(np.asarray(patches.get_offsets()), centres)
    low, high = patches.get_clim()
    assert low == -(high or 0) < 0
    spots = of(report, "stains").details["spots"]
    assert len(spots) == len(print_.patches) == len(frame.patches) == len(print_.texts)
    for spot, outline in zip(spots, print_.patches, strict=True):
        assert isinstance(outline, Polygon)
        rim = outline.get_xy()[:-1]
        np.testing.assert_allclose(rim.mean(axis=0), spot["centre_mm"])
        away = np.linalg.norm(rim - spot["centre_mm"], axis=1)
        np.testing.assert_allclose(away, max(spot["size_mm"] / 2, 3.0))
    lines = [text.get_text() for text in verdicts.texts]
    assert sum(line.startswith(GRADES) for line in lines) == len(report.findings)
    assert lines[0].startswith("fault")


def test_the_command_says_it_in_json(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = CheckReport((), (Finding("disk", "good", "seen"), Finding("exposure", "remark", "seen")))

    def checked(*_: object, **named: object) -> CheckReport:
        return found

    monkeypatch.setattr(check_module, "check_lab", checked)
    lab = folder / "json.toml"
    lab.write_text(lab_toml("chart2.json"))
    assert main(["check", str(lab), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["faults"] == 0
    assert [finding["name"] for finding in document["findings"]] == ["disk", "exposure"]


def test_a_recording_is_judged_as_it_was_taken(folder: Path, tmp_path: Path) -> None:
    chart = load_chart(folder / "chart2.json")
    lab = hang_chart(chart, "Test", Room(white_level_share=0.3))
    shown = {"white": lab.dng(WHITE, 1), "dark": lab.dng(BLACK, 2)}
    lights = load_illuminations(folder / "illuminations.csv")
    record_session(tmp_path / "session", chart, lights, lambda step: shown.get(step.kind, b"unread")).close()
    with closing(Journal.open_for_run(tmp_path / "session" / "journal.sqlite")) as journal:
        journal.add_steps(plan_steps(lights, 25))
    replay = folder / "replay.toml"
    replay.write_text(
        'rig = "replay"\nchart = "chart2.json"\nilluminations = "illuminations.csv"\n'
        f"[replay]\nsession = {json.dumps(str(tmp_path / 'session'))}\n"
    )
    report = check_lab(load_lab(replay))
    assert of(report, "exposure").grade == "remark"
    assert "cannot be exposed anew" in of(report, "exposure").remedy
    for name in ("brightest light", "additivity", "flicker", "brightness"):
        assert of(report, name).grade == "not checked", name
    assert of(report, "evenness").grade == of(report, "sharpness").grade == "good"
