"""What each room computes of inputs of many kinds, held to what it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drivers.presenter import Colour
from drivers.raw.rawfile import CHANNELS, Plane, plane_of, strongest_plane
from experiment import lights
from experiment.chart import margins, pdf_x, proof
from experiment.chart.layout import design_chart, paper_chart, smallest_page
from experiment.chart.model import Chart
from experiment.chart.printing import drawing, field_drawing, field_px, label_lines, preview
from experiment.config import parse_lab
from experiment.framing import field, finding, homography, pictures, sharpness
from experiment.measures import least_squares
from experiment.measures.paper import FlatField, PaperReader
from experiment.measures.sensor import deviations
from experiment.measures.stains import find_stains, joined_cells, light_of_spot, spot_colour, spots_of
from experiment.session.records import plan_steps
from experiment.session.repair import lights_text, parse_lights
from sim.world.world import Room
from tests.calibration.lab import hang, hang_chart
from tests.calibration.whole import brief, of_fields
from tests.experiment.measures.test_stains import print_with
from tests.experiment.test_config import MINIMAL
from tests.pinned import Pinned

_Array = npt.NDArray[np.float64]
LOOSE = {"same": 1e-4, "nothing": 1e-6}
"""Of what an iterative fit ends at."""


def of_chart(chart: Chart) -> list[Any]:
    """Return where everything of a chart is, in brief."""
    references = [[*one.centre_mm, *one.rgb] for one in chart.references]
    tags = [[one.id, *np.ravel(one.corners_mm)] for one in chart.tags]
    chart = replace(chart, software=None)
    sizes = [chart.page_mm, chart.cell_mm, len(chart.references), len(chart.white_references), len(chart.tags)]
    return [sizes, brief(chart.centres_mm), brief(chart.rgb), brief(references), brief(tags), chart.sha256]


@pytest.mark.slow
def test_charts(pinned: Pinned) -> None:
    charts = [design_chart(1), design_chart(2, None, 3), design_chart(2, "A4"), design_chart(3, (200.0, 170.0), 4)]
    charts += [paper_chart("A6", 2), paper_chart("A6", 3), paper_chart("A3", 4)]
    sizes = [smallest_page(bits) for bits in range(1, 6)]
    pinned("charts of many layouts", [[of_chart(chart) for chart in charts], sizes])


@pytest.mark.slow
def test_prints(pinned: Pinned) -> None:
    found: list[Any] = []
    for designed in (design_chart(1), design_chart(2, "A5", 3), paper_chart("A6", 3)):
        # What stands in the margin names the software.
        chart = replace(designed, software="CroP of a test")
        whole, part = drawing(chart), field_drawing(chart, (10.0, 20.0, 60.0, 70.0))
        boxes = margins.whole_px(whole.rectangles_mm)
        proven = proof.proof_drawing(chart)
        found.append(
            [*(brief(of_fields(one)) for one in (whole, part, proven)), brief(boxes), brief(field_px(chart)),
             label_lines(chart)[1], [brief(preview(chart, width).astype(float)) for width in (150, 401)]]
        )  # fmt: skip
        found.append(proof.instructions(chart, tiff=chart.bits > 2).splitlines())
    shapes = [brief(one()) for one in (margins.star_boxes, margins.edge_boxes, margins.bar_boxes, margins.target_boxes)]
    text = [brief(margins.text_boxes(text, dot)) for text in ("CroP 1.5 mm", "a-z (0…9)") for dot in (2, 3)]
    lengths = (300, 2000, 9000, 30000)
    ticks = [[brief(margins.ruler_ticks(length)), margins.number_every_mm(length)] for length in lengths]
    pinned("prints of three charts", [found, shapes, text, ticks])
    profiles = [np.frombuffer(one, np.uint8) for one in (pdf_x.srgb_output_profile(), pdf_x.srgb_display_profile())]
    pinned("profiles of prints", [brief(one[128:].astype(float)) for one in profiles])


def test_lights(pinned: Pinned) -> None:
    asked = ((2, ()), (3, (2500, 4500)), (5, (2000, 10000)), (0, (3000, 6504)))
    plans = [lights.plan_illuminations(*one) for one in asked]
    ccts = [lights.parse_ccts(text) for text in ("2000:3000:250", "2500,4500,6500", "5000")]
    codes = [[[light.kind, light.cct_k, *light.colour] for light in plan] for plan in plans]
    shown = [
        list(lights.shown_colour(np.array(one))) for one in ((0, 0.5, 1), (1e-4, 0.0031308, 0.003), (0.2, 0.2, 0.2))
    ]
    steps = [[f"{step.kind} {step.illumination}" for step in plan_steps(plans[1], every)] for every in (2, 25)]
    pinned("plans of lights", [[[" ".join(map(str, one)) for one in plan][:60] for plan in codes], ccts, shown, steps])
    texts = [lights_text(one) for one in ([], [3], [1, 2], [1, 2, 3, 5, 7, 8], range(12))]
    pinned("lights by their numbers", [texts, parse_lights("0-2,5", range(9))])


def test_settings(pinned: Pinned) -> None:
    pinned("settings of a lab, by default", parse_lab(MINIMAL, "LAB.toml"))


@pytest.mark.slow
def test_least_squares(pinned: Pinned) -> None:
    random, found = np.random.default_rng(1), []
    for rows, terms, rounds in ((30, 3, 1), (200, 6, 3), (500, 10, 6)):
        design = random.uniform(-1, 1, (rows, terms))
        values = design @ random.uniform(-1, 1, terms) + random.normal(0, 0.02, rows)
        values[:: max(rows // 12, 2)] += 0.5
        weights = random.uniform(0, 1, rows)
        found.append([brief(one) for one in least_squares.robust_least_squares(design, values, rounds)])
        found.append(brief(least_squares.least_squares(design, values, weights)))
        found.append(least_squares.held_out_squares(design, values, weights, (1, 2, 3)))
        found.append(least_squares.least_absolute_line(design[:, 0], values))
    pairs = [least_squares.light_terms((400.0, 300.0), around) for around in (False, True)]
    terms = [[brief(one), counts] for one, counts in pairs]
    rgb = random.integers(0, 256, (20, 3))
    codes = [brief(least_squares.code_polynomial(rgb, degree)) for degree in (1, 3, 6)]
    pinned("least squares", [found, terms, codes], **LOOSE)


def test_paper(pinned: Pinned) -> None:
    random, page, found = np.random.default_rng(3), (400.0, 300.0), []
    cells = random.random((300, 2)) * page
    for count, noise, base in (
        (12, 2.0, None),
        (40, 10.0, None),
        (120, 10.0, None),
        (400, 60.0, None),
        (400, 10.0, page),
    ):
        places = random.random((count, 2)) * page
        x, y = (2 * places / page - 1).T
        shape = np.stack([1 / (1 + 0.2 * (x * x + y * y)), 1 - 0.1 * (x - 0.2) ** 2, 1 - 0.1 * x], axis=-1)
        seen = np.array([3000.0, 800, 5000]) * shape + random.normal(0, noise, shape.shape)
        seen[:: max(count // 8, 5)] *= 0.9
        known = None if base is None else FlatField.uniform(base)
        paper, left = PaperReader(places, cells, page, known).read(seen)
        found.append([brief(of_fields(paper)), brief(paper.field.at(cells)), brief(left)])
    pinned("paper under three lights", found, **LOOSE)


@pytest.mark.slow
def test_stains(pinned: Pinned) -> None:
    found: list[Any] = []
    for size, added, kept, broad in ((0, 0, 1, False), (40, 0, 0.9, False), (60, 0.03, 1, True), (9, 0.05, 1, False)):
        one = print_with(size, added, kept, broad=broad)
        spots = spots_of(one)[:3]
        told = [[len(spot), spot_colour(one, spot), [light_of_spot(one, spot, n) for n in range(3)]] for spot in spots]
        joined = [len(each) for each in joined_cells(one, one.doubtful.nonzero()[0])]
        found.append([brief(of_fields(one)), told, joined[:9]])
    random = np.random.default_rng(2)
    level = 5000 * random.uniform(0.1, 0.9, (64, 3))
    few = find_stains(level, random.uniform(0, 90, (64, 2)), 2, random.random(64) < 0.9)
    pinned("stains", [found, brief(of_fields(few))], **LOOSE)


def test_a_series_of_exposures(pinned: Pinned) -> None:
    random, found = np.random.default_rng(7), []
    times = np.array([0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    share = times[:, None, None] / 0.7 * np.exp(random.uniform(np.log(0.03), np.log(0.95), (400, 3)))
    for bend in (1.0, 1.02, 0.97):
        seen = share**bend + random.standard_normal(share.shape) * 2e-4
        found.append([brief(one) for one in deviations(seen, times)])
        found.append([brief(one) for one in deviations(seen[2:], times[2:] * 1.02)])
    pinned("series of exposures", found, **LOOSE)


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
    framing = finding.find_chart(mosaic, lab.chart)
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


def test_edges(pinned: Pinned) -> None:
    random, found = np.random.default_rng(5), []
    quad = np.array([(0, 0), (100, 0), (100, 70), (0, 70)], dtype=np.float64)
    seen = np.array([(12, 9), (215, 14), (209, 160), (7, 151)], dtype=np.float64)
    points = random.uniform(0, 100, (30, 2))
    for noise, tolerance in ((0.0, None), (0.1, None), (0.1, 1.0)):
        exact = homography.fit_homography(quad, seen)
        assert exact is not None
        places = homography.project(exact, points) + random.normal(0, noise, (30, 2))
        places[::9] += 8
        fitted = homography.fit_homography(points, places, tolerance)
        found.append([brief(exact), None if fitted is None else brief(homography.project(fitted, points))])
        along = np.linspace(0, 1, 40)
        off = 0.3 * along - along**2 + random.normal(0, noise + 0.01, 40)
        off[::11] += 2
        found.append([brief(one) for order in (1, 2, 3) for one in field.robust_curve(along, off, order)])
    values = np.full((60, 80, 1), 50.0, np.float32)[..., 0]
    values[20:, :] = 400
    edge = Plane("G", values, (0.0, 0.0))
    alike = [field.same_corners(seen, seen + 1, tolerance) for tolerance in (1.0, 1.4, 1.5)]
    told = [field.paper_level(edge), field.corners_text(seen), homography.on_one_line(quad), homography.rms(seen)]
    pinned("edges and corners", [found, alike, told], **LOOSE)
