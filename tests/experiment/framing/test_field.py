"""Detection of a chart without tags, near corners from the user or from another frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from drivers.presenter import BLACK, Colour
from drivers.raw.rawfile import CHANNELS, Mosaic, Plane, plane_of
from experiment.chart.layout import design_chart, paper_chart
from experiment.framing.field import DetectedField, corners_text, field_mm, find_field, parse_corners, refine_edges
from experiment.framing.finding import find_chart
from experiment.framing.sharpness import blur_px
from foundation.errors import CropError, InputError, RegistrationError
from sim.world.world import Room
from tests.calibration.lab import Lab, hang_chart

pytestmark = pytest.mark.slow

CHART = paper_chart("A6", 3)


@cache
def lab_of(room: Room) -> Lab:
    return hang_chart(CHART, "Test", room)


def planes_of(mosaic: Mosaic) -> list[Plane]:
    return [plane_of(mosaic, channel) for channel in CHANNELS]


def true_px(room: Room, mosaic: Mosaic, points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return lab_of(room).truth_px(points_mm, mosaic)


def corners_of(room: Room, mosaic: Mosaic) -> npt.NDArray[np.float64]:
    """Return the corners with errors of some pixels, as a user gives them."""
    return true_px(room, mosaic, field_mm(CHART)) + np.array([(9, -7), (-8, 6), (5, 8), (-9, -6)])


def field_in(room: Room, mosaic: Mosaic) -> DetectedField:
    return find_field(planes_of(mosaic), CHART, "the frame", corners_of(room, mosaic))


def outline_errors(room: Room, mosaic: Mosaic) -> npt.NDArray[np.float64]:
    """Return the distances of the detected outline from the true one, outwards, px."""
    field = field_in(room, mosaic)
    return ((field.outline_px - true_px(room, mosaic, field.outline_mm)) * field.normals).sum(axis=1)


UPRIGHT = Room(waviness_mm=0.5)


@pytest.fixture(scope="module")
def white(tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    return lab_of(UPRIGHT).mosaic(tmp_path_factory.mktemp("white"))


@pytest.mark.parametrize("colour", [Colour(110, 70, 20), Colour(0, 0, 255)])
def test_outline_is_at_the_edge_of_the_patches(tmp_path: Path, colour: Colour) -> None:
    errors = outline_errors(UPRIGHT, lab_of(UPRIGHT).mosaic(tmp_path, colour))
    assert len(errors) > 300
    assert np.abs(np.median(errors)) < 0.1
    # A tenth may be shifted to the rulers and targets in the margin, a third of a pixel from the patches here.
    assert np.percentile(np.abs(errors), 90) < 0.3


@pytest.mark.parametrize("roll", [180.0, 30.0])
def test_given_corners_determine_the_orientation(tmp_path: Path, roll: float) -> None:
    room = Room(waviness_mm=0.5, roll_deg=roll, fill=0.6)
    mosaic = lab_of(room).mosaic(tmp_path)
    framing = find_chart(mosaic, CHART, corners=corners_of(room, mosaic))
    assert framing.field is not None
    assert framing.field.corners_px == pytest.approx(true_px(room, mosaic, field_mm(CHART)), abs=0.7)
    assert abs((framing.rotation_deg - roll + 180) % 360 - 180) < 3
    assert framing.inside
    assert framing.complete


def test_missing_corners_are_explained(white: Mosaic) -> None:
    with pytest.raises(RegistrationError, match=r"--corners 297,90 4866,160 4805,3319 296,3326: x,y in pixels.*ticks"):
        find_chart(white, CHART, "frame 7")


@pytest.mark.parametrize(("moved", "is_found"), [(20.0, True), (60.0, False)])
def test_finds_chart_near_its_position_in_another_frame(tmp_path: Path, moved: float, is_found: bool) -> None:
    """The frame is red, in which the orientation of the chart cannot be detected."""
    mosaic = lab_of(UPRIGHT).mosaic(tmp_path, Colour(255, 0, 0))
    corners = true_px(UPRIGHT, mosaic, field_mm(CHART))
    if is_found:
        field = find_field(planes_of(mosaic), CHART, "the frame", near_px=corners + moved)
        assert field.corners_px == pytest.approx(corners, abs=0.7)
    else:
        with pytest.raises(RegistrationError, match="within 48 pixels"):
            find_field(planes_of(mosaic), CHART, "the frame", near_px=corners + moved)


def test_measures_blur_on_the_outline(tmp_path: Path) -> None:
    room = Room(waviness_mm=0, tilt_deg=0, pan_deg=0, k1=0, k2=0, p1=0, p2=0, blur_px=0.8)
    mosaic = lab_of(room).mosaic(tmp_path)
    # A photosite is half a pixel wide (σ = 0.5/√12) and the two greens lie 0.25 px to either side.
    expected = float(np.sqrt(0.8**2 + 0.25 / 12 + 0.25**2))
    assert blur_px(find_chart(mosaic, CHART, corners=corners_of(room, mosaic))) == pytest.approx(expected, abs=0.06)


def test_refuses_another_order_of_colours(white: Mosaic) -> None:
    shuffled = np.random.default_rng(1).permutation(CHART.colours)
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        find_chart(white, replace(CHART, colours=shuffled), corners=corners_of(UPRIGHT, white))


def test_reports_dark_frame(tmp_path: Path) -> None:
    with pytest.raises(RegistrationError, match="frame 3 is dark"):
        find_chart(lab_of(UPRIGHT).mosaic(tmp_path, BLACK), CHART, "frame 3")


@pytest.mark.parametrize(
    ("given", "fault", "message"),
    [
        ([(10, 10), (120, 120), (230, 230), (340, 340)], InputError, "not a convex quadrilateral"),
        ([(10, 10), (2000, 10), (2000, 1200), (10, 1200)], InputError, r"image of \d+×\d+ pixels"),
        ([(36, 25), (34, 247), (358, 248), (361, 30)], InputError, "counter-clockwise"),
        ([(100, 80), (180, 80), (180, 180), (100, 180)], InputError, "160 pixels"),
        ([(361, 30), (358, 248), (34, 247), (36, 25)], InputError, "72,50 722,60 716,496 68,494"),
        ([(100, 60), (260, 60), (260, 200), (100, 200)], RegistrationError, "corners of the patch area"),
    ],
)
def test_refuses_wrong_corners(
    white: Mosaic, given: Sequence[tuple[float, float]], fault: type[CropError], message: str
) -> None:
    with pytest.raises(fault, match=message) as caught:
        find_chart(white, CHART, corners=np.array(given, dtype=np.float64))
    assert "\n" not in str(caught.value)


def test_refuses_mirrored_chart(white: Mosaic) -> None:
    mirrored = [replace(plane, values=np.ascontiguousarray(plane.values[:, ::-1])) for plane in planes_of(white)]
    width = mirrored[0].values.shape[1]
    corners = true_px(UPRIGHT, white, field_mm(CHART))
    given = np.column_stack([width - 1 - corners[:, 0], corners[:, 1]])[[1, 0, 3, 2]]
    with pytest.raises(RegistrationError):
        find_field(mirrored, CHART, "the frame", given)


def test_refuses_corners_of_a_chart_with_tags(white: Mosaic) -> None:
    with pytest.raises(InputError):
        find_chart(white, design_chart(1), corners=true_px(UPRIGHT, white, field_mm(CHART)))


def test_edges_follow_lateral_chromatic_aberration(tmp_path: Path) -> None:
    room = Room(waviness_mm=0.5, lateral_red_px=1.0, lateral_blue_px=-1.0)
    mosaic = lab_of(room).mosaic(tmp_path)
    field = field_in(room, mosaic)
    places, heights = refine_edges(planes_of(mosaic), field.outline_px, field.normals, 0.58)
    green = true_px(room, mosaic, field.outline_mm)
    for channel_places, height, channel in zip(places, heights, CHANNELS, strict=True):
        shift = lab_of(room).world.project(field.outline_mm, channel) - lab_of(room).world.project(field.outline_mm)
        assert channel == "G" or np.abs((shift * field.normals).sum(axis=1)).max() > 0.3
        errors = ((channel_places - green - shift) * field.normals).sum(axis=1)[height > 0]
        assert len(errors) > 300
        assert np.sqrt((errors**2).mean()) < 0.1


def test_does_not_refine_faint_edges(white: Mosaic) -> None:
    field = field_in(UPRIGHT, white)
    random = np.random.default_rng(0)
    faint = [
        replace(
            plane, values=(4000 + 0.02 * plane.values + random.normal(0, 30, plane.values.shape)).astype(np.float32)
        )
        for plane in planes_of(white)
    ]
    places, heights = refine_edges(faint, field.outline_px, field.normals, 0.58)
    assert not heights.any()
    assert (places == field.outline_px).all()


GOOD = ("101,51", "3000.5,60", "2990,1900", "95,1890")


def test_converts_raw_pixels_to_half_size_pixels() -> None:
    # Raw pixels 0 and 1 make the half-size pixel 0: its middle lies at raw 0.5.
    assert parse_corners(GOOD)[:2] == ((50.25, 25.25), (1500.0, 29.75))
    assert corners_text(parse_corners(GOOD)) == "101,51 3000,60 2990,1900 95,1890"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (GOOD[:3], "3 corners are given"),
        ((*GOOD, "1,1"), "5 corners are given"),
        ((*GOOD[:3], "95,nan"), "'95,nan' is not a corner"),
        ((*GOOD[:3], "1,2,3"), "'1,2,3' is not a corner"),
        ((GOOD[0], GOOD[2], GOOD[1], GOOD[3]), "not a convex quadrilateral"),
        (("0,0", "1000,0", "500,100", "500,1000"), "not a convex quadrilateral"),
        (GOOD[::-1], "counter-clockwise"),
        (("0,0", "1000,0", "1000,100", "0,100"), "expected at least 192 pixels"),
    ],
)
def test_refuses_texts_that_are_no_corners(given: Sequence[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_corners(given)
