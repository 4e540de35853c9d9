"""A lens fitted to places known on both sides."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.geometry import Lens, fit_lens
from foundation.errors import RegistrationError


def test_the_lens_is_found_exactly_without_noise() -> None:
    points = np.stack(np.meshgrid(np.linspace(0, 1189, 8), np.linspace(0, 841, 6)), axis=-1).reshape(-1, 2)
    x, y = ((points - (594, 420)) / 1500 * 2).T
    r2 = x * x + y * y
    radial = 1 - 0.04 * r2 + 0.02 * r2**2
    bent = np.stack([x * radial + 3e-4 * x * y, y * radial + 1.5e-4 * (r2 + 2 * y * y)], axis=-1)
    places = bent * 1500 + (1300, 866)
    lens, residual = fit_lens(points, places, (2601, 1733))
    assert np.abs(residual).max() < 0.02
    assert lens.to_pixels(points) == pytest.approx(places, abs=0.02)


LINES = {
    "level": (np.linspace(0, 1000, 12), np.full(12, 300.0)),
    "upright": (np.full(12, 300.0), np.linspace(0, 700, 12)),
    "slanted": (np.linspace(0, 1000, 12), 100 + 0.37 * np.linspace(0, 1000, 12)),
    "one point": (np.full(12, 300.0), np.full(12, 200.0)),
}


@pytest.mark.parametrize("line", LINES.values(), ids=LINES)
def test_marks_on_one_line_are_refused(line: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]) -> None:
    points = np.stack(line, axis=-1)
    # Seen by a camera, the line's places are off it by the error of a measured corner.
    places = 2 * points + (50, 80) + np.random.default_rng(1).normal(0, 0.1, points.shape)
    with pytest.raises(RegistrationError, match="lie on one line"):
        fit_lens(points, places, (2601, 1733))
    with pytest.raises(RegistrationError, match="lie on one line"):
        fit_lens(places, points, (2601, 1733))


def test_two_small_tags_at_the_ends_of_a_sheet_are_not_on_one_line() -> None:
    square = np.array([(0, 0), (6, 0), (6, 6), (0, 6)], dtype=np.float64)
    points = np.concatenate([square + np.array([10, 10]), square + np.array([1170, 825])])
    places = 2 * points + (50, 80)
    lens, residual = fit_lens(points, places, (2601, 1733))
    assert np.abs(residual).max() < 0.02
    assert lens.to_pixels(points) == pytest.approx(places, abs=0.02)


@pytest.mark.parametrize(("tilt_deg", "pan_deg"), [(0.0, 0.0), (8.0, -5.0)])
def test_parallax_is_the_way_in_which_heights_are_seen(tilt_deg: float, pan_deg: float) -> None:
    size = np.array([2601, 1733])
    centre, radius = (size - 1) / 2, float(np.hypot(*size)) / 2
    focal, distance = 2.2 * radius, 1500.0
    tilt, pan = np.deg2rad([tilt_deg, pan_deg])
    upright = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    turned = upright @ np.array([[np.cos(pan), 0, np.sin(pan)], [0, 1, 0], [-np.sin(pan), 0, np.cos(pan)]])
    camera = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1.0]])
    start = np.array([-600.0, -420.0, distance])
    homography = camera @ np.column_stack([turned[:, 0], turned[:, 1], start])
    distortion = np.array([-0.05, 0.02, 1e-3, -5e-4])
    lens = Lens(homography / homography[2, 2], centre, radius, distortion)
    undistorted = Lens(np.eye(3), centre, radius, distortion)
    points = np.stack(np.meshgrid(np.linspace(0, 1189, 5), np.linspace(0, 841, 4)), axis=-1).reshape(-1, 2)

    def seen(height_mm: float) -> npt.NDArray[np.float64]:
        raised = np.column_stack([points, np.full(len(points), -height_mm)])
        places = (camera @ (turned @ raised.T + start[:, None])).T
        return undistorted.to_pixels(places[:, :2] / places[:, 2:])

    foot_mm = abs(float(turned[:, 2] @ start))
    moved = (seen(1.0) - seen(-1.0)) / 2
    assert lens.parallax(points) == pytest.approx(moved * foot_mm / radius, rel=2e-3, abs=1e-4)
    assert lens.parallax(points[7]) == pytest.approx(lens.parallax(points)[7:8])
