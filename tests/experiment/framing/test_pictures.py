"""What the picture of a chart shows: how far it moved, how sharp it is, and itself, drawn for people."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from drivers.presenter import WHITE, Colour
from drivers.raw.rawfile import Mosaic, Plane, plane_of, read_raw, strongest_plane
from experiment.chart.layout import design_chart, paper_chart
from experiment.chart.model import Chart
from experiment.framing.field import field_mm
from experiment.framing.finding import Framing, annotated_png, apparent_sizes, find_chart, small_parts_warning
from experiment.framing.pictures import gauge_boxes, preview_jpeg, shift_between
from sim.world.world import Room
from tests.calibration.lab import Lab, hang, hang_chart
from tests.data_files import shipped

pytestmark = pytest.mark.slow

CHART = paper_chart("A6", 3)
FILL = Room(waviness_mm=0.5)


@cache
def lab_of(room: Room) -> Lab:
    return hang_chart(CHART, "Test", room)


@pytest.fixture(scope="module")
def white(tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    return lab_of(FILL).mosaic(tmp_path_factory.mktemp("white"))


@pytest.fixture(scope="module")
def framing(white: Mosaic) -> Framing:
    return find_chart(white, CHART, corners=lab_of(FILL).corners_px(white))


def moved(plane: Plane, dx: float, dy: float) -> Plane:
    values = ndimage.shift(plane.values.astype(np.float64), (dy, dx), order=5, mode="nearest")
    return replace(plane, values=values.astype(np.float32))


@pytest.mark.parametrize("by", [(0.3, -0.2), (-2.2, 1.7), (0.0, 0.04)])
def test_a_movement_is_measured(white: Mosaic, framing: Framing, by: tuple[float, float]) -> None:
    plane = plane_of(white, "G")
    shift = shift_between(plane, framing, moved(plane, *by))
    assert (shift.dx, shift.dy) == pytest.approx(by, abs=0.03)
    assert shift.largest_px == pytest.approx(np.hypot(*by), abs=0.06)


def test_a_turn_shows_though_the_middle_stays(white: Mosaic, framing: Framing, tmp_path: Path) -> None:
    turned = lab_of(replace(FILL, roll_deg=FILL.roll_deg + 0.2)).mosaic(tmp_path, key=2)
    shift = shift_between(plane_of(white, "G"), framing, plane_of(turned, "G"))
    assert framing.field is not None
    middle = framing.field.corners_px.mean(axis=0)
    reach = np.linalg.norm(framing.field.corners_px - middle, axis=1).max()
    assert shift.largest_px == pytest.approx(np.radians(0.2) * reach, abs=0.15)
    assert shift.length_px < 0.15


@pytest.mark.parametrize("by", [(0.0, -5.0), (40.0, 0.0)])
def test_a_leap_is_not_measured_as_a_step(white: Mosaic, framing: Framing, by: tuple[float, float]) -> None:
    plane = plane_of(white, "G")
    shift = shift_between(plane, framing, moved(plane, *by))
    # Not seen, or at least known to be no small step.
    assert shift.gauges == 0 or shift.largest_px > 0.6


def test_a_hand_over_a_fifth_of_the_field_does_not_move_it(white: Mosaic, framing: Framing) -> None:
    plane = plane_of(white, "G")
    values: npt.NDArray[np.float32] = plane.values.copy()
    height, width = values.shape
    values[: height // 3, : width // 3] = 200
    shift = shift_between(plane, framing, replace(plane, values=values))
    assert shift.gauges >= 16
    assert shift.largest_px < 0.05


def test_only_the_boxes_are_looked_at(white: Mosaic, framing: Framing) -> None:
    plane = plane_of(white, "G")
    later = moved(plane, 1.4, -2.1)
    parts: list[Plane] = []
    for whole in (plane, later):
        values = np.zeros_like(whole.values)
        for left, top, right, bottom in gauge_boxes(framing):
            values[top:bottom, left:right] = whole.values[top:bottom, left:right]
        parts.append(replace(whole, values=values))
    one, other = shift_between(parts[0], framing, parts[1]), shift_between(plane, framing, later)
    assert (one.dx, one.dy, one.largest_px, one.gauges) == (other.dx, other.dy, other.largest_px, other.gauges)


SOFT = replace(FILL, blur_px=0.5)


@cache
def hung(tags: bool, blur_px: float) -> Lab:
    room = replace(SOFT, blur_px=blur_px)
    return hang(room=room) if tags else hang_chart(CHART, "Test", room)


@pytest.mark.parametrize(
    ("tags", "blur_px", "colour"),
    [(True, 0.4, WHITE), (True, 0.85, Colour(0, 0, 255)), (False, 0.7, Colour(0, 0, 255))],
)
def test_a_softer_frame_is_measured(tmp_path: Path, tags: bool, blur_px: float, colour: Colour) -> None:
    """Photosites and lens add by their variances, so the difference is that of the lens alone."""
    before = hung(tags, SOFT.blur_px).mosaic(tmp_path)
    later = strongest_plane(hung(tags, blur_px).mosaic(tmp_path, colour, key=2))
    lab = hung(tags, SOFT.blur_px)
    framing = find_chart(before, lab.chart, corners=lab.corners_px(before))
    shift = shift_between(plane_of(before, later.channel), framing, later)
    true = blur_px**2 - SOFT.blur_px**2
    assert shift.blur_growth_px2 == pytest.approx(true, rel=0.35, abs=0.05)


def test_the_paper_s_chart_in_both_cameras(a0: Chart) -> None:
    # 1.94 and 2.34 px a millimetre on A0, hence 10.2 and 12.4 px a cell, and 4.1 px a module.
    small, large = apparent_sizes(a0)
    assert small.camera == "EOS 550D"
    assert small.cell_px == pytest.approx(1732 * 0.94 / 841 * 125 * 25.4 / 600, rel=1e-6)
    assert small.cell_px == pytest.approx(10.2, abs=0.06)
    assert large.cell_px == pytest.approx(12.4, abs=0.06)
    assert small.module_px == pytest.approx(4.1, abs=0.02)
    assert small_parts_warning(a0) is None


def test_long_sheets_are_not_visible_enough() -> None:
    long = design_chart(5, (1200.0, 300.0))
    text = small_parts_warning(long)
    assert text is not None
    assert "EOS 550D" in text
    assert "EOS 6D Mark II" in text
    assert "8 px a cell and 3 px a tag module" in text
    assert f"{apparent_sizes(long)[0].cell_px:.1f} px a cell" in text
    assert "\n" not in text


def picture(data: bytes) -> npt.NDArray[np.int64]:
    return np.asarray(cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)).astype(np.int64)


def test_a_field_found_has_its_outline_drawn(white: Mosaic, framing: Framing) -> None:
    lab, mosaic = lab_of(FILL), white
    seen = picture(annotated_png(mosaic, CHART, framing))
    assert seen.shape[:2] == mosaic.block_planes().shape[2:]
    red = seen[..., 2] - seen[..., 1] > 150
    corners = lab.truth_px(field_mm(CHART), mosaic)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        x, y = np.rint((start + end) / 2).astype(int)
        assert red[y - 3 : y + 4, x - 3 : x + 4].any()
    x, y = np.rint(corners.mean(axis=0)).astype(int)
    assert not red[y - 20 : y + 20, x - 20 : x + 20].any()


@pytest.mark.parametrize("chart", [CHART, design_chart(3)], ids=["plain", "tagged"])
def test_a_photograph_without_the_chart_says_what_was_looked_for(chart: Chart) -> None:
    mosaic = read_raw(shipped("raw/canon_eos_550d_colorchart.dng"))
    seen = picture(annotated_png(mosaic, chart, None))
    assert seen.shape[:2] == mosaic.block_planes().shape[2:]
    # The lines stand in amber on a black strip below.
    strip = seen[-30:]
    assert (strip.max(axis=2) < 30).mean() > 0.5
    assert (strip[..., 1] - strip[..., 0] > 100).sum() > 100


def test_a_preview_is_brightened_to_a_hundredth_of_white_and_marks_what_deviates(white: Mosaic) -> None:
    def preview(share: float, boxes: tuple[tuple[int, int, int, int], ...] = ()) -> npt.NDArray[np.int64]:
        even = replace(white, counts=np.full_like(white.counts, 1000 + round(10_000 * share)))
        return picture(preview_jpeg(even, np.full((2, 2), 1000.0), np.full(3, 10_000.0), (), boxes, ""))

    height, width = white.block_planes().shape[2:]
    assert preview(0.5).shape == (height, width, 3)
    # The picture shows the square root of the signal.
    for share, grey in ((0.5, 255), (0.01, 255), (0.0025, 127), (0.0004, 51)):
        assert np.abs(preview(share) - grey).max() <= 1
    marked = preview(0.0025, ((40, 20, 60, 50),))
    red = marked[..., 2] - marked[..., 1] > 60
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    assert (columns[0], rows[0], columns[-1], rows[-1]) == pytest.approx((40, 20, 59, 49), abs=1)
    assert not red[25:45, 45:55].any()
