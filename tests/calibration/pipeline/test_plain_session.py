"""Sessions of a chart without tags: what moves between frames is followed, and reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.causes.rules import BUMP
from calibration.cli import main
from calibration.pipeline.build import build
from calibration.report.report import write_report
from calibration.table.lut import open_lut
from calibration.verdict import findings
from drivers.presenter import Colour
from experiment.chart.layout import A_SERIES_MM, design_chart, paper_chart
from experiment.framing.field import field_mm
from experiment.lights import Illumination
from experiment.session.records import ACCEPTED, SessionStep
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, blank_pictures, figures_alone, hang_chart, renumbered, take

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds")]

SMALL = paper_chart("A6", 3)
ROOM = Room(waviness_mm=0.5)
RED = Illumination(0, "uniform", None, Colour(255, 0, 0))


@pytest.fixture(scope="module")
def plain() -> Lab:
    return hang_chart(SMALL, "Test", ROOM)


def moved_by(dx: float, dy: float, roll_deg: float = 0.0) -> Lab:
    """Return the lab with the camera shifted so that the chart lies (dx, dy) half-size pixels further."""
    lab = hang_chart(SMALL, "Test", replace(ROOM, roll_deg=ROOM.roll_deg + roll_deg))
    x, y = lab.world.view.centre_px
    lab.world.view = replace(lab.world.view, centre_px=(x + dx, y + dy))
    return lab


def worst_error(lab: Lab, folder: Path) -> float:
    """Return how far the means of cells lie from the room's truth, as a share of white, the worst of all lights."""
    table = open_lut(folder)
    codes = lab.chart.rgb[lab.chart.cell_of_colour]
    worst = 0.0
    for light in table.illuminations:
        white = lab.world.white(light.colour, SETTINGS)
        true = lab.world.reflected(codes, light.colour, SETTINGS) / white
        mean = table.samples[light.index].mean(axis=1) / table.white[light.index]
        lit = int(np.argmax(white))
        worst = max(worst, float(np.abs(mean - true)[:, lit].max()))
    return worst


@pytest.mark.parametrize(("by", "anew"), [((0.3, -0.2), []), ((4.0, -2.5), [2])])
def test_a_bump_is_followed_and_reported(plain: Lab, tmp_path: Path, by: tuple[float, float], anew: list[int]) -> None:
    bumped = moved_by(*by)
    lights = renumbered([*LIGHTS[4:8], RED])

    def frame(step: SessionStep) -> bytes:
        return (bumped if step.number >= 4 else plain).dng(step.colour, step.number)

    with take(plain, tmp_path / "session", lights, frame=frame) as session, blank_pictures():
        result = build(session, tmp_path / "lut", report=write_report if anew else None)
    assert [figures.record.illumination for figures in result.figures.frames if figures.reregistered] == anew
    first = next(figures for figures in result.figures.frames if figures.record.illumination == 2)
    assert (first.shift.dx, first.shift.dy) == pytest.approx(by, abs=0.05)
    assert result.figures.largest_shift_px == pytest.approx(np.hypot(*by), abs=0.07)
    # A grid left behind by 4 px reads the next cell: 0.15 of white here.
    assert worst_error(plain, tmp_path / "lut") < 0.05
    assert min(figures.shift.gauges for figures in result.figures.frames) >= 16
    if anew:
        assert "1 frames registered again" in (tmp_path / "lut" / "report.html").read_text()
    remarks = [row.figure.name for row in result.verdict.remarks]
    assert ("reregistered_frames" in remarks) == bool(anew)
    if anew:
        found = findings(result.verdict, result.figures)["reregistered_frames"]
        assert found.decision.cause is BUMP
        assert [frame.illumination for frame in found.frames] == anew


Command = Callable[..., tuple[int, str]]


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    def run(*arguments: object) -> tuple[int, str]:
        code = main([*map(str, arguments)])
        said = capsys.readouterr()
        return code, said.out + said.err

    return run


def test_corners_by_hand_stand_in_for_light_that_shows_nothing(
    plain: Lab, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of red light alone nobody can say which way up the chart hangs; white frames are all refused here."""
    monkeypatch.setattr("calibration.report.report.write_report", figures_alone)
    lights = renumbered([RED])
    with take(
        plain, tmp_path / "session", lights, verdict=lambda step: "refused" if step.kind == "white" else ACCEPTED
    ):
        pass
    code, said = command("check", tmp_path / "session")
    assert code == 4
    assert "which way up it hangs" in said
    raw = 2 * plain.truth_px(field_mm(plain.chart), plain.mosaic(tmp_path)) + 0.5
    corners = [f"{x:.0f},{y:.0f}" for x, y in raw + np.array([(9, -7), (-8, 6), (5, 8), (-9, -6)])]
    code, said = command(tmp_path / "session", tmp_path / "lut", "--corners", *corners)
    assert code == 0, said
    assert worst_error(plain, tmp_path / "lut") < 0.05


def test_a_check_that_fails_shows_what_was_looked_for(plain: Lab, tmp_path: Path, command: Command) -> None:
    with take(plain, tmp_path / "session", renumbered(LIGHTS[4:6])):
        pass
    found = tmp_path / "found.png"
    assert command("check", tmp_path / "session", "--picture", found)[0] == 0
    assert found.read_bytes().startswith(b"\x89PNG")
    design_chart(3, A_SERIES_MM["A5"]).save(tmp_path / "session" / "chart.json")
    missed = tmp_path / "missed.png"
    code, said = command("check", tmp_path / "session", "--picture", missed)
    assert code == 4
    assert f"see {missed}" in said
    assert missed.read_bytes().startswith(b"\x89PNG")
    code, said = command(tmp_path / "session", tmp_path / "lut", "--picture", missed)
    assert code == 2
    assert "--picture goes with --check" in said
