"""Results of every room for many kinds of input, compared with pinned numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.presenter import Colour
from drivers.raw.rawfile import CHANNELS, plane_of, strongest_plane
from experiment.chart.layout import design_chart, paper_chart, smallest_page
from experiment.chart.model import Chart
from experiment.config import parse_lab
from experiment.framing import field, finding, pictures, sharpness
from experiment.measures.sensor import deviations
from sim.world.world import Room
from tests.calibration.lab import hang, hang_chart
from tests.calibration.whole import brief, of_fields
from tests.experiment.test_config import MINIMAL
from tests.pinned import Pinned

LOOSE = {"same": 1e-4, "nothing": 1e-6}  # Tolerances of iterative fits


def of_chart(chart: Chart) -> list[Any]:
    """Return all positions and codes of a chart, summarised."""
    references = [[*item.centre_mm, *item.rgb] for item in chart.references]
    tags = [[item.id, *np.ravel(item.corners_mm)] for item in chart.tags]
    chart = replace(chart, software=None)
    sizes = [chart.page_mm, chart.cell_mm, len(chart.references), len(chart.white_references), len(chart.tags)]
    return [sizes, brief(chart.centres_mm), brief(chart.rgb), brief(references), brief(tags), chart.sha256]


@pytest.mark.slow
def test_charts(pinned: Pinned) -> None:
    charts = [design_chart(1), design_chart(2, None, 3), design_chart(2, "A4"), design_chart(3, (200.0, 170.0), 4)]
    charts += [paper_chart("A6", 2), paper_chart("A6", 3), paper_chart("A3", 4)]
    sizes = [smallest_page(bits) for bits in range(1, 6)]
    pinned("charts of many layouts", [[of_chart(chart) for chart in charts], sizes])


def test_settings(pinned: Pinned) -> None:
    pinned("settings of a lab, by default", parse_lab(MINIMAL, "LAB.toml"))


def test_a_series_of_exposures(pinned: Pinned) -> None:
    random, results = np.random.default_rng(7), []
    times = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    share = times[:, None, None] / 0.7 * np.exp(random.uniform(np.log(0.03), np.log(0.95), (400, 3)))
    for bend in (1.0, 1.02, 0.97):
        levels = share**bend + random.standard_normal(share.shape) * 2e-4
        results.append([brief(array) for array in deviations(levels, times)])
        results.append([brief(array) for array in deviations(levels[2:], times[2:] * 1.02)])
    pinned("series of exposures", results, **LOOSE)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tags", "field", "upside down", "soft"])
def test_charts_in_frames(name: str, pinned: Pinned, tmp_path: Path) -> None:
    room = {
        "tags": Room(waviness_mm=0.5), "field": Room(waviness_mm=0.5),
        "upside down": Room(waviness_mm=0.5, roll_deg=179.0, fill=0.7), "soft": Room(blur_px=0.9, fill=0.8, seed=3),
    }[name]  # fmt: skip
    lab = (
        hang_chart(paper_chart("A6", 3), "Test", room) if name in ("field", "upside down") else hang(2, "A6", room=room)
    )
    mosaic = lab.mosaic(tmp_path)
    framing = finding.find_chart(mosaic, lab.chart, corners=lab.corners_px(mosaic))
    plane = plane_of(mosaic, "G")
    moved = replace(plane, values=np.ascontiguousarray(np.roll(plane.values, (1, 2), axis=(0, 1))))
    shifts = [pictures.shift_between(plane, framing, one) for one in (plane, moved)]
    later = strongest_plane(lab.mosaic(tmp_path, Colour(200, 30, 60), key=2))
    shifts.append(pictures.shift_between(plane_of(mosaic, later.channel), framing, later))
    places, blurs = sharpness.edge_blurs(framing)
    sizes = finding.apparent_sizes(lab.chart)
    pinned(
        f"chart in a frame, {name}",
        [brief(of_fields(framing, "plane")), brief(framing.homography), shifts, sharpness.blur_px(framing),
         brief(places), brief(blurs), pictures.gauge_boxes(framing)[:20], brief([of_fields(one) for one in sizes]),
         [field.paper_level(plane_of(mosaic, channel)) for channel in CHANNELS], brief(field.field_mm(lab.chart))],
        same=1e-3,
        nothing=1e-4,
    )  # fmt: skip
