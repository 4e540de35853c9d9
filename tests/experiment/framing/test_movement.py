"""How far a chart has moved between two frames, and how much softer it is: by the outline of its field, or its tags."""

from __future__ import annotations

from dataclasses import astuple, replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from drivers.presenter import WHITE, Colour
from drivers.raw.rawfile import Mosaic, Plane, plane_of, strongest_plane
from experiment.chart.layout import paper_chart
from experiment.framing.finding import Framing, find_chart
from experiment.framing.pictures import gauge_boxes, shift_between
from sim.world.room import Room
from tests.calibration.lab import Lab, hang, hang_chart

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
    return find_chart(white, CHART)


def moved(plane: Plane, dx: float, dy: float) -> Plane:
    values = ndimage.shift(plane.values.astype(np.float64), (dy, dx), order=5, mode="nearest")
    return replace(plane, values=values.astype(np.float32))


@pytest.mark.parametrize("colour", [WHITE, Colour(255, 0, 0), Colour(0, 255, 0), Colour(0, 0, 255), Colour(60, 60, 60)])
def test_a_still_field_does_not_move(white: Mosaic, framing: Framing, tmp_path: Path, colour: Colour) -> None:
    later = strongest_plane(lab_of(FILL).mosaic(tmp_path, colour, key=2))
    shift = shift_between(plane_of(white, later.channel), framing, later)
    assert shift.gauges >= 16
    assert shift.largest_px < 0.03


@pytest.mark.parametrize("by", [(0.3, -0.2), (1.0, 0.6), (-2.2, 1.7), (0.0, 0.04)])
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


@pytest.mark.parametrize("by", [(6.0, 0.0), (0.0, -5.0), (40.0, 0.0)])
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


def test_no_field_is_seen_in_the_dark(white: Mosaic, framing: Framing) -> None:
    plane = plane_of(white, "G")
    noise = np.random.default_rng(0).normal(0, 6, plane.values.shape).astype(np.float32)
    assert astuple(shift_between(plane, framing, replace(plane, values=noise))) == (0, 0, 0, 0, 0)


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


@pytest.mark.parametrize("colour", [WHITE, Colour(0, 0, 255)])
@pytest.mark.parametrize("blur_px", [0.4, 0.5, 0.7, 0.85])
@pytest.mark.parametrize("tags", [True, False])
def test_a_softer_frame_is_measured(tmp_path: Path, colour: Colour, blur_px: float, tags: bool) -> None:
    """Photosites and lens add by their variances, so the difference is that of the lens alone."""
    room = replace(FILL, blur_px=0.5)
    sharp, soft = (
        hang(room=each) if tags else hang_chart(CHART, "Test", each) for each in (room, replace(room, blur_px=blur_px))
    )
    before = sharp.mosaic(tmp_path)
    later = strongest_plane(soft.mosaic(tmp_path, colour, key=2))
    shift = shift_between(plane_of(before, later.channel), find_chart(before, sharp.chart), later)
    true = blur_px**2 - 0.5**2
    assert shift.blur_growth_px2 == pytest.approx(true, rel=0.35, abs=0.05)
