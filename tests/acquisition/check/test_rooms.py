"""Whole checks in simulated rooms: each verdict on both sides of its limit, and none of them wrong in a good room."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.check.check import CheckOptions, check_lab
from acquisition.check.findings import CheckReport, Finding
from acquisition.cli import main
from experiment.chart.layout import paper_chart
from experiment.chart.model import load_chart
from experiment.config import load_lab
from foundation.console import plain
from sim.world import world
from sim.world.world import Room, Stain, worn
from tests.acquisition.check.conftest import Check, lab_toml

pytestmark = pytest.mark.slow

UNTOLD = {"battery", "card", "noise reduction"}
"""What a body may keep to itself."""


def of(report: CheckReport, name: str) -> Finding:
    (found,) = [finding for finding in report.findings if finding.name == name]
    return found


def not_good(report: CheckReport) -> set[str]:
    return {finding.name for finding in report.findings if finding.grade in ("fault", "remark")}


@pytest.mark.parametrize(("bits", "seed"), [(1, 11), (3, 13)])
def test_a_good_room_has_nothing_to_remark_on(check: Check, bits: int, seed: int) -> None:
    report = check(bits, seed=seed)
    assert not_good(report) == set()
    assert {finding.name for finding in report.of("not checked")} <= UNTOLD
    assert of(report, "exposure").details["saturation_counts"] == 13584
    assert of(report, "exposure").details["saturation_measured"]


@pytest.mark.parametrize(
    ("room", "bad", "grade", "said"),
    [
        ({"white_level_share": 0.02}, "exposure", "remark", "set camera.shutter_s = "),
        ({"white_level_share": 0.93}, "exposure", "remark", "set camera.shutter_s = 0.4 (tried: 7"),
        ({"ambient": 0.07}, "room light", "fault", "with the picture muted: the room's light"),
        ({"black_leak": 0.01}, "room light", "remark", "the projector's black"),
        ({"vignetting": 0.7, "projector_falloff": 0.5}, "evenness", "remark", "lens and projector together"),
        ({"roll_deg": 180.0}, "turn", "remark", "upside down, turned by 180°"),
        ({"roll_deg": 8.0, "fill": 0.8}, "turn", "remark", "its rows +8.0°"),
        ({"pan_deg": 14.0, "fill": 0.8}, "tilt", "remark", "right and top nearer"),
        ({"hot_per_million": 300.0}, "hot photosites", "remark", "of a million"),
    ],
)
def test_a_room_with_one_thing_wrong(check: Check, room: dict[str, Any], bad: str, grade: str, said: str) -> None:
    report = check(2, **room)
    found = of(report, bad)
    assert found.grade == grade
    assert said in found.sentence()
    # A field that falls off so far leaves more of the references beside it, which the verdict remarks on as well.
    # So does the darkest light of a plan where white is dim.
    also = {
        "evenness": {"references"},
        "exposure": {"darkest light"} if "darkest light" in not_good(report) else set[str](),
    }
    assert not_good(report) == {bad} | also.get(bad, set())


def test_blur_is_judged_by_what_it_does_to_cells_of_their_size(check: Check) -> None:
    small, large = (of(check(bits, blur_px=1.05), "sharpness") for bits in (3, 2))
    assert (small.grade, large.grade) == ("fault", "good")
    assert "focus the lens" in small.remedy
    assert small.details["cell_px"] < large.details["cell_px"]


def test_what_is_not_known_yet_is_named(check: Check) -> None:
    report = check(3)
    assert report.forecast == "accept"
    assert {"white_drift", "off_codes_deg", "agreement"} <= set(report.not_known)
    assert "not known before the session: " in report.lines()[-1]
    assert ", white drift, " in report.lines()[-1]
    table = plain(report.values())["table"]
    assert table["outcome"] == "accept"
    assert table["figures"]["cell_px"] > 8.6


def test_the_right_side_of_four_limits(check: Check) -> None:
    assert not_good(check(2, vignetting=0.4, ambient=0.003, blur_px=0.65, wheel_hz=60.0)) == set()


def test_a_light_that_falls_off_by_80_per_cent(check: Check) -> None:
    report = check(3, projector_falloff=0.8)
    found = of(report, "evenness")
    assert found.grade == "remark"
    assert found.value == pytest.approx(0.85, abs=0.07)
    stains = of(report, "stains")
    assert stains.grade == "good" or "may be an edge of the light" in stains.said


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


def test_a_dim_projector_with_stray_light(check: Check) -> None:
    report = check(2, white_level_share=0.02, ambient=0.025)
    assert of(report, "exposure").details["proposed_shutter_s"] > 10
    assert of(report, "room light").grade == "remark"


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_a_stain_of_60_mm_is_told(check: Check, bits: int) -> None:
    found = of(check(bits, stain_mm=60.0), "stains")
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


def test_a_chart_without_tags(check: Check, folder: Path) -> None:
    paper_chart("A5", 2).save(folder / "paper.json")
    report = check(chart="paper.json", stain_mm=20.0)
    assert not_good(report) == set()
    for name in ("evenness", "colour evenness", "stains"):
        assert of(report, name).grade == "not checked"
        assert "bare paper in its margin only" in of(report, name).said
    assert of(report, "chart").said == "no tags, the field of cells was found"


def test_linearity_and_noise_are_those_of_the_sensor(check: Check) -> None:
    report = check(3, options=CheckOptions(linearity=True))
    assert of(report, "linearity").grade == "good"
    noise = of(report, "photon transfer").details
    assert noise["gain_e"] == pytest.approx([1.8] * 3, rel=0.1)
    assert noise["read_noise_counts"] == pytest.approx([6.0] * 3, rel=0.3)


def test_another_chart_is_a_fault_and_what_hangs_on_it_is_not_checked(check: Check, folder: Path) -> None:
    report = check(2, fill=0.15)
    assert of(report, "chart").grade == "fault"
    for name in ("evenness", "sharpness", "turn", "tilt", "size", "stains", "room light"):
        assert of(report, name).grade == "not checked"


def test_the_command_prints_faults_first_and_ends_with_4(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = folder / "command.toml"
    lab.write_text(lab_toml("chart2.json", ambient=0.07, black_leak=0.0))
    picture = tmp_path / "check.png"
    assert main(["check", str(lab), "--picture", str(picture)]) == 4
    printed = capsys.readouterr()
    told = [line for line in printed.out.splitlines() if line.startswith(("fault", "remark", "not checked", "good"))]
    of_fault, *_ = told
    assert of_fault.startswith("fault       room light")
    assert told[-1].startswith("good")
    assert "1 fault: room light" in printed.err
    assert (printed.out + printed.err).count(of_fault.split(maxsplit=3)[3]) == 1
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert "stays on" in printed.out


def test_the_command_says_it_in_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = folder / "json.toml"
    lab.write_text(lab_toml("chart2.json"))
    assert main(["check", str(lab), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["faults"] == 0
    assert {"exposure", "evenness", "stains", "disk"} <= {finding["name"] for finding in document["findings"]}


def test_a_recording_is_judged_as_it_was_taken(folder: Path, tmp_path: Path) -> None:
    lab = folder / "recorded.toml"
    lab.write_text(lab_toml("chart2.json", white_level_share=0.3))
    assert main(["run", str(lab), str(tmp_path / "session")]) == 0
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
