"""Movement and blur of the chart between frames, and drawings of frames."""

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
from experiment.framing.finding import ChartPose, annotated_png, apparent_sizes, find_chart, small_parts_warning
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
def framing(white: Mosaic) -> ChartPose:
    return find_chart(white, CHART, corners=lab_of(FILL).corners_px(white))


def moved(plane: Plane, dx: float, dy: float) -> Plane:
    values = ndimage.shift(plane.values.astype(np.float64), (dy, dx), order=5, mode="nearest")
    return replace(plane, values=values.astype(np.float32))


@pytest.mark.parametrize("by", [(0.3, -0.2), (-2.2, 1.7), (0.0, 0.04)])
def test_measures_movement(white: Mosaic, framing: ChartPose, by: tuple[float, float]) -> None:
    plane = plane_of(white, "G")
    shift = shift_between(plane, framing, moved(plane, *by))
    assert (shift.dx, shift.dy) == pytest.approx(by, abs=0.03)
    assert shift.largest_px == pytest.approx(np.hypot(*by), abs=0.06)


def test_measures_rotation_around_the_centre(white: Mosaic, framing: ChartPose, tmp_path: Path) -> None:
    turned = lab_of(replace(FILL, roll_deg=FILL.roll_deg + 0.2)).mosaic(tmp_path, key=2)
    shift = shift_between(plane_of(white, "G"), framing, plane_of(turned, "G"))
    assert framing.field is not None
    middle = framing.field.corners_px.mean(axis=0)
    reach = np.linalg.norm(framing.field.corners_px - middle, axis=1).max()
    assert shift.largest_px == pytest.approx(np.radians(0.2) * reach, abs=0.15)
    assert shift.length_px < 0.15


@pytest.mark.parametrize("by", [(0.0, -5.0), (40.0, 0.0)])
def test_large_movement_is_not_reported_as_small(white: Mosaic, framing: ChartPose, by: tuple[float, float]) -> None:
    plane = plane_of(white, "G")
    shift = shift_between(plane, framing, moved(plane, *by))
    # Unknown, or at least not a small step.
    assert shift.gauges == 0 or shift.largest_px > 0.6


def test_ignores_a_covered_corner(white: Mosaic, framing: ChartPose) -> None:
    plane = plane_of(white, "G")
    values: npt.NDArray[np.float32] = plane.values.copy()
    height, width = values.shape
    values[: height // 3, : width // 3] = 200
    shift = shift_between(plane, framing, replace(plane, values=values))
    assert shift.gauges >= 16
    assert shift.largest_px < 0.05


def test_reads_only_the_gauge_boxes(white: Mosaic, framing: ChartPose) -> None:
    plane = plane_of(white, "G")
    later = moved(plane, 1.4, -2.1)
    cropped: list[Plane] = []
    for full in (plane, later):
        values = np.zeros_like(full.values)
        for left, top, right, bottom in gauge_boxes(framing):
            values[top:bottom, left:right] = full.values[top:bottom, left:right]
        cropped.append(replace(full, values=values))
    from_boxes, expected = shift_between(cropped[0], framing, cropped[1]), shift_between(plane, framing, later)
    assert (from_boxes.dx, from_boxes.dy, from_boxes.largest_px, from_boxes.gauges) == (
        expected.dx,
        expected.dy,
        expected.largest_px,
        expected.gauges,
    )


SOFT = replace(FILL, blur_px=0.5)


@cache
def lab_with_blur(tags: bool, blur_px: float) -> Lab:
    room = replace(SOFT, blur_px=blur_px)
    return hang(room=room) if tags else hang_chart(CHART, "Test", room)


@pytest.mark.parametrize(
    ("tags", "blur_px", "colour"),
    [(True, 0.4, WHITE), (True, 0.85, Colour(0, 0, 255)), (False, 0.7, Colour(0, 0, 255))],
)
def test_measures_growth_of_blur(tmp_path: Path, tags: bool, blur_px: float, colour: Colour) -> None:
    """The variances of photosites and lens add, so the difference is that of the lens alone."""
    earlier = lab_with_blur(tags, SOFT.blur_px).mosaic(tmp_path)
    later = strongest_plane(lab_with_blur(tags, blur_px).mosaic(tmp_path, colour, key=2))
    lab = lab_with_blur(tags, SOFT.blur_px)
    framing = find_chart(earlier, lab.chart, corners=lab.corners_px(earlier))
    shift = shift_between(plane_of(earlier, later.channel), framing, later)
    true = blur_px**2 - SOFT.blur_px**2
    assert shift.blur_growth_px2 == pytest.approx(true, rel=0.35, abs=0.05)


def test_apparent_size_of_the_a0_chart(a0: Chart) -> None:
    # 1.94 and 2.34 px a millimetre on A0, hence 10.2 and 12.4 px a cell, and 4.1 px a module.
    small, large = apparent_sizes(a0)
    assert small.camera == "EOS 550D"
    assert small.cell_px == pytest.approx(1732 * 0.94 / 841 * 125 * 25.4 / 600, rel=1e-6)
    assert small.cell_px == pytest.approx(10.2, abs=0.06)
    assert large.cell_px == pytest.approx(12.4, abs=0.06)
    assert small.module_px == pytest.approx(4.1, abs=0.02)
    assert small_parts_warning(a0) is None


def test_warns_of_small_patches_on_long_sheets() -> None:
    long = design_chart(5, (1200.0, 300.0))
    text = small_parts_warning(long)
    assert text is not None
    assert "EOS 550D" in text
    assert "EOS 6D Mark II" in text
    assert "8 px a patch and 3 px a tag module" in text
    assert f"{apparent_sizes(long)[0].cell_px:.1f} px a patch" in text
    assert "\n" not in text


def decoded_png(data: bytes) -> npt.NDArray[np.int64]:
    return np.asarray(cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)).astype(np.int64)


def test_draws_the_outline(white: Mosaic, framing: ChartPose) -> None:
    lab, mosaic = lab_of(FILL), white
    seen = decoded_png(annotated_png(mosaic, CHART, framing))
    assert seen.shape[:2] == mosaic.block_planes().shape[2:]
    red = seen[..., 2] - seen[..., 1] > 150
    corners = lab.truth_px(field_mm(CHART), mosaic)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        x, y = np.rint((start + end) / 2).astype(int)
        assert red[y - 3 : y + 4, x - 3 : x + 4].any()
    x, y = np.rint(corners.mean(axis=0)).astype(int)
    assert not red[y - 20 : y + 20, x - 20 : x + 20].any()


@pytest.mark.parametrize("chart", [CHART, design_chart(3)], ids=["plain", "tagged"])
def test_draws_a_hint_if_no_chart_is_detected(chart: Chart) -> None:
    mosaic = read_raw(shipped("raw/canon_eos_550d_colorchart.dng"))
    seen = decoded_png(annotated_png(mosaic, chart, None))
    assert seen.shape[:2] == mosaic.block_planes().shape[2:]
    # The text is amber on a black strip at the bottom.
    strip = seen[-30:]
    assert (strip.max(axis=2) < 30).mean() > 0.5
    assert (strip[..., 1] - strip[..., 0] > 100).sum() > 100


def test_preview_is_brightened_and_marks_deviations(white: Mosaic) -> None:
    def preview(share: float, boxes: tuple[tuple[int, int, int, int], ...] = ()) -> npt.NDArray[np.int64]:
        even = replace(white, counts=np.full_like(white.counts, 1000 + round(10_000 * share)))
        return decoded_png(preview_jpeg(even, np.full((2, 2), 1000.0), np.full(3, 10_000.0), (), boxes, ""))

    height, width = white.block_planes().shape[2:]
    assert preview(0.5).shape == (height, width, 3)
    # The preview shows the square root of the signal.
    for share, grey in ((0.5, 255), (0.01, 255), (0.0025, 127), (0.0004, 51)):
        assert np.abs(preview(share) - grey).max() <= 1
    marked = preview(0.0025, ((40, 20, 60, 50),))
    red = marked[..., 2] - marked[..., 1] > 60
    rows, columns = np.flatnonzero(red.any(axis=1)), np.flatnonzero(red.any(axis=0))
    assert (columns[0], rows[0], columns[-1], rows[-1]) == pytest.approx((40, 20, 59, 49), abs=1)
    assert not red[25:45, 45:55].any()
