"""Detection of tags, pose and blur of the chart, on simulated and real frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.presenter import BLACK, Colour
from drivers.raw.rawfile import Mosaic, Plane, channel_offset_px, phases, plane_of, read_raw
from experiment.chart.model import Chart
from experiment.framing.finding import find_chart
from experiment.framing.homography import project, robust_homography
from experiment.framing.sharpness import blur_px
from foundation.errors import RegistrationError
from sim.world.world import Room
from tests.calibration.lab import Lab, hang
from tests.data_files import available

pytestmark = pytest.mark.slow

FLAT = Room(waviness_mm=0.0, tilt_deg=0, pan_deg=0, k1=0, k2=0, p1=0, p2=0)


@pytest.fixture(scope="module")
def lab() -> Lab:
    return hang()


@pytest.fixture(scope="module")
def chart(lab: Lab) -> Chart:
    return lab.chart


@pytest.fixture(scope="module")
def white(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    return lab.mosaic(tmp_path_factory.mktemp("white"))


@pytest.mark.parametrize(
    ("pattern", "red", "blue"),
    [
        ("RGGB", (-0.25, -0.25), (0.25, 0.25)),
        ("BGGR", (0.25, 0.25), (-0.25, -0.25)),
        ("GRBG", (0.25, -0.25), (-0.25, 0.25)),
        ("GBRG", (-0.25, 0.25), (0.25, -0.25)),
    ],
)
def test_red_and_blue_are_offset_by_a_quarter_pixel(
    white: Mosaic, pattern: str, red: tuple[float, float], blue: tuple[float, float]
) -> None:
    positions = phases(replace(white, pattern=pattern))
    assert channel_offset_px(positions["R"]) == red
    assert channel_offset_px(positions["B"]) == blue
    assert channel_offset_px(positions["G"]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("colour", "channel"), [(Colour(255, 0, 0), "R"), (Colour(0, 255, 0), "G"), (Colour(0, 0, 255), "B")]
)
def test_tag_corners_are_accurate_in_every_colour(
    chart: Chart, lab: Lab, tmp_path: Path, colour: Colour, channel: str
) -> None:
    mosaic = lab.mosaic(tmp_path, colour)
    framing = find_chart(mosaic, chart)
    assert framing.plane.channel == channel
    assert framing.complete
    corners_mm = {tag.id: tag.corners_mm for tag in chart.tags}
    error = np.concatenate([tag.corners_px - lab.truth_px(corners_mm[tag.id], mosaic) for tag in framing.tags])
    # A wrong corner order is tens of pixels off, a forgotten half or quarter pixel shows in the mean.
    assert np.abs(error.mean(axis=0)).max() < 0.1
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.3


def test_measures_pose(chart: Chart, tmp_path: Path) -> None:
    mosaic = hang(room=replace(FLAT, fill=0.8, roll_deg=180.0)).mosaic(tmp_path)
    framing = find_chart(mosaic, chart)
    assert framing.fill == pytest.approx(0.8, abs=0.01)
    assert abs(framing.rotation_deg) == pytest.approx(180, abs=0.5)
    assert framing.inside
    assert framing.residual_px < 0.3


@pytest.mark.parametrize(("blur", "roll_deg"), [(0.4, 1.7), (0.9, 180.6)])
def test_measures_blur(chart: Chart, tmp_path: Path, blur: float, roll_deg: float) -> None:
    mosaic = hang(room=replace(FLAT, blur_px=blur, roll_deg=roll_deg)).mosaic(tmp_path)
    # A photosite is half a pixel wide (σ = 0.5/√12) and the two greens lie 0.25 px to either side.
    expected = float(np.sqrt(blur**2 + 0.25 / 12 + 0.25**2))
    assert blur_px(find_chart(mosaic, chart)) == pytest.approx(expected, abs=0.02)


def test_reports_dark_frame(chart: Chart, lab: Lab, tmp_path: Path) -> None:
    mosaic = lab.mosaic(tmp_path, BLACK)
    with pytest.raises(RegistrationError, match="frame 7 is dark"):
        find_chart(mosaic, chart, "frame 7")


def test_refuses_mirrored_frame(chart: Chart, white: Mosaic) -> None:
    plane = plane_of(white, "G")
    mirrored = Plane("G", np.ascontiguousarray(plane.values[:, ::-1]), plane.offset_px)
    with pytest.raises(RegistrationError):
        find_chart(mirrored, chart)


def test_refuses_small_tags(chart: Chart, white: Mosaic) -> None:
    plane = plane_of(white, "G")
    small = np.full_like(plane.values, 100)
    inner = cv2.resize(plane.values, None, fx=0.33, fy=0.33, interpolation=cv2.INTER_AREA)
    small[20 : 20 + inner.shape[0], 30 : 30 + inner.shape[1]] = inner
    with pytest.raises(RegistrationError):
        find_chart(Plane("G", small, plane.offset_px), chart)


def test_refuses_another_chart(chart: Chart, white: Mosaic) -> None:
    other_chart = replace(chart, tags=tuple(replace(tag, id=tag.id + 100) for tag in chart.tags))
    with pytest.raises(RegistrationError, match=r"another chart.*chart\.json"):
        find_chart(white, other_chart)
    # The right ids in positions that no image of the chart could have.
    ids = [tag.id for tag in chart.tags]
    shuffled = [tag.corners_mm for tag in chart.tags[1:] + chart.tags[:1]]
    misplaced_tags = tuple(
        replace(chart.tags[i], id=ids[i], corners_mm=shuffled[i][[2, 0, 3, 1]]) for i in range(len(ids))
    )
    with pytest.raises(RegistrationError):
        find_chart(white, replace(chart, tags=misplaced_tags))


def test_refuses_chart_with_one_tag(chart: Chart, white: Mosaic) -> None:
    with pytest.raises(RegistrationError, match="has 1 tags"):
        find_chart(white, replace(chart, tags=chart.tags[:1]))


def test_names_covered_tags(chart: Chart, white: Mosaic) -> None:
    plane = plane_of(white, "G")
    values = plane.values.copy()
    framing = find_chart(plane, chart)
    for tag in framing.tags[:2]:
        x, y = tag.centre_px.astype(int)
        values[y - 20 : y + 20, x - 20 : x + 20] = 500
    hidden = ", ".join(str(tag.id) for tag in framing.tags[:2])
    with pytest.raises(RegistrationError, match=rf"2 of 4.*{hidden}\); uncover"):
        find_chart(Plane("G", values, plane.offset_px), chart)


@pytest.mark.parametrize("path", available("raw/canon_eos_550d_colorchart.dng"), ids=lambda path: path.name)
def test_refuses_photograph_without_chart(chart: Chart, path: Path) -> None:
    with pytest.raises(RegistrationError, match="tags 36h11") as caught:
        find_chart(read_raw(path), chart, path.name)
    assert "\n" not in str(caught.value)


def test_homography_ignores_outliers() -> None:
    points = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2)
    true = np.array([[20, 3, 5], [-2, 25, 9], [0.01, 0.02, 1]])
    targets = project(true, points)
    # By hand: the point (2, 1) goes to (48, 30) over 1.04.
    assert targets[7] == pytest.approx([48 / 1.04, 30 / 1.04])
    targets[[2, 9]] += [30, -30]
    homography, fits = robust_homography(points, targets, 1.0)
    np.testing.assert_allclose(homography / homography[2, 2], true, atol=1e-6)
    assert np.flatnonzero(~fits).tolist() == [2, 9]
    line = np.stack([np.arange(8.0), np.arange(8.0)], axis=1)
    identity, no_fits = robust_homography(line, line, 1.0)
    assert (identity.tolist(), no_fits.any()) == (np.eye(3).tolist(), False)
