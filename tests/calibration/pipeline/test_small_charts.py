"""Charts of 8 and 64 colours, as `acquire chart` makes them: fewer cells than some figures of larger ones need."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration.pipeline.build import build
from calibration.registration.register import register
from calibration.report.report import write_report
from calibration.table.lut import open_lut
from calibration.verdict import judged_values, remark
from experiment.chart.layout import design_chart
from experiment.lights import plan_illuminations
from sim.world.world import Room
from tests.calibration.lab import LIGHTS, QUARTER, SETTINGS, blank_pictures, hang_chart, renumbered, take

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds")]

LIGHT = renumbered(LIGHTS[5:6])


@pytest.mark.parametrize(("bits", "seed"), [(1, 1), (2, 3)])
def test_a_small_chart_becomes_a_table(bits: int, seed: int, tmp_path: Path) -> None:
    lab = hang_chart(design_chart(bits, seed=seed), "Test", Room(projector_falloff=0.3))
    with take(lab, tmp_path / "session", LIGHT) as session:
        result = build(session, tmp_path / "lut")
        if bits == 1:
            with blank_pictures():
                write_report(result, session, tmp_path)
    # One light alone does not show how linear the sensor is.
    assert {row.figure.name for row in result.verdict.remarks} == {"linearity_known"}
    assert not result.verdict.refused
    assert not result.figures.cells.unfit
    assert judged_values(result.figures).keys().isdisjoint({"frame_scatter", "block_deviation", "doubtful_share"})
    if bits == 1:
        report = (tmp_path / "report.html").read_text()
        assert "The course of the session" in report
        assert "The table can be used" in report
    table = open_lut(tmp_path / "lut")
    codes = lab.chart.rgb[lab.chart.cell_of_colour]
    true = lab.world.reflected(codes, LIGHT[0].colour, SETTINGS) / lab.world.white(LIGHT[0].colour, SETTINGS)
    assert table.samples[0].mean(axis=1) / table.white[0] == pytest.approx(true, abs=0.02)


def test_large_cells_are_found_well_enough(tmp_path: Path) -> None:
    lab = hang_chart(design_chart(1), QUARTER, Room())
    mosaic = lab.mosaic(tmp_path)
    found = register(mosaic, lab.chart)
    error = found.to_pixels(lab.chart.centres_mm) - lab.truth_px(lab.chart.centres_mm, mosaic)
    assert found.cell_px > 50
    assert found.clearance > 14
    assert np.linalg.norm(error, axis=1).max() < 0.05 * found.cell_px


def test_a_small_chart_is_not_told_to_plan_lights_that_were_planned(tmp_path: Path) -> None:
    lab = hang_chart(design_chart(2), "Test", Room())
    with take(lab, tmp_path / "session", plan_illuminations(1, ())) as session:
        result = build(session, tmp_path / "lut")
    unknown = next(row for row in result.verdict.remarks if row.figure.name == "linearity_known")
    said = remark(unknown, result.figures)
    assert "are needed" in said
    assert "plan red" not in said
    (source,) = (one.source for one in result.figures.budget.components if one.name == "linearity")
    assert "are needed" in source
    assert "no lights" not in source
