"""Lens, displacement and lateral colour from known positions, and their reported uncertainty."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.registration.geometry import (
    MAX_ROUGHNESS_PX,
    ROUGHNESS_PX,
    Displacement,
    LateralColour,
    Lens,
    fit_lens,
)
from calibration.registration.register import Registration, register
from drivers.raw.rawfile import CHANNELS, Mosaic
from foundation.errors import RegistrationError
from sim.world.world import Room
from tests.calibration.lab import Lab, hang


def test_fits_lens_exactly_without_noise() -> None:
    points = np.stack(np.meshgrid(np.linspace(0, 1189, 8), np.linspace(0, 841, 6)), axis=-1).reshape(-1, 2)
    x, y = ((points - (594, 420)) / 1500 * 2).T
    r2 = x * x + y * y
    radial = 1 - 0.04 * r2 + 0.02 * r2**2
    distorted = np.stack([x * radial + 3e-4 * x * y, y * radial + 1.5e-4 * (r2 + 2 * y * y)], axis=-1)
    positions_px = distorted * 1500 + (1300, 866)
    lens, residual = fit_lens(points, positions_px, (2601, 1733))
    assert np.abs(residual).max() < 0.02
    assert lens.to_pixels(points) == pytest.approx(positions_px, abs=0.02)


LINES = {
    "level": (np.linspace(0, 1000, 12), np.full(12, 300.0)),
    "upright": (np.full(12, 300.0), np.linspace(0, 700, 12)),
    "slanted": (np.linspace(0, 1000, 12), 100 + 0.37 * np.linspace(0, 1000, 12)),
    "one point": (np.full(12, 300.0), np.full(12, 200.0)),
}


@pytest.mark.parametrize("line", LINES.values(), ids=LINES)
def test_refuses_marks_on_one_line(line: tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]) -> None:
    points = np.stack(line, axis=-1)
    # with the error of measured corners
    positions_px = 2 * points + (50, 80) + np.random.default_rng(1).normal(0, 0.1, points.shape)
    with pytest.raises(RegistrationError):
        fit_lens(points, positions_px, (2601, 1733))
    with pytest.raises(RegistrationError):
        fit_lens(positions_px, points, (2601, 1733))


def test_accepts_two_small_tags_at_opposite_corners() -> None:
    square = np.array([(0, 0), (6, 0), (6, 6), (0, 6)], dtype=np.float64)
    points = np.concatenate([square + np.array([10, 10]), square + np.array([1170, 825])])
    positions_px = 2 * points + (50, 80)
    lens, residual = fit_lens(points, positions_px, (2601, 1733))
    assert np.abs(residual).max() < 0.02
    assert lens.to_pixels(points) == pytest.approx(positions_px, abs=0.02)


@pytest.mark.parametrize(("tilt_deg", "pan_deg"), [(0.0, 0.0), (8.0, -5.0)])
def test_parallax_is_direction_of_heights(tilt_deg: float, pan_deg: float) -> None:
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

    def imaged(height_mm: float) -> npt.NDArray[np.float64]:
        raised = np.column_stack([points, np.full(len(points), -height_mm)])
        rays = (camera @ (turned @ raised.T + start[:, None])).T
        return undistorted.to_pixels(rays[:, :2] / rays[:, 2:])

    foot_mm = abs(float(turned[:, 2] @ start))
    moved = (imaged(1.0) - imaged(-1.0)) / 2
    assert lens.parallax(points) == pytest.approx(moved * foot_mm / radius, rel=2e-3, abs=1e-4)
    assert lens.parallax(points[7]) == pytest.approx(lens.parallax(points)[7:8])


@pytest.mark.slow
@settings(max_examples=20)
@given(st.floats(-3, 3), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_follows_linear_displacement_exactly(level: float, slope_x: float, slope_y: float) -> None:
    low, high = np.array([10.0, 20.0]), np.array([110.0, 90.0])
    points = low + np.random.default_rng(1).random((300, 2)) * (high - low)
    moved = np.stack([level + slope_x * points[:, 0], level + slope_y * points[:, 1]], axis=-1)
    information = np.broadcast_to(np.eye(2) * 1e4, (300, 2, 2))
    fitted = Displacement.over(low, high, 12.0).fitted(points, information, 1e4 * moved)
    assert fitted.at(points) == pytest.approx(moved, abs=1e-3)


@pytest.mark.slow
def test_uncertainty_matches_scatter_and_grows_without_measurements() -> None:
    random = np.random.default_rng(4)
    low, high = np.array([0.0, 0.0]), np.array([200.0, 150.0])
    points = low + random.random((4000, 2)) * (high - low)
    points = points[(points[:, 0] < 80) | (points[:, 0] > 130)]
    sigma = 0.2
    information = np.broadcast_to(np.eye(2) / sigma**2, (len(points), 2, 2))
    flat = Displacement.over(low, high, 15.0)
    at = np.array([[40.0, 75.0], [105.0, 75.0]])
    draws = [
        flat.fitted(points, information, information[0, 0, 0] * sigma * random.standard_normal(points.shape)).at(at)
        for _ in range(60)
    ]
    scattered = np.sqrt((np.array(draws) ** 2).sum(axis=2).mean(axis=0))
    reported = flat.errors_px(points, information, at)
    assert reported[0] == pytest.approx(scattered[0], rel=0.4)
    assert reported[1] > 2 * reported[0]
    assert (reported >= 0.6 * scattered).all()


@pytest.mark.slow
@pytest.mark.parametrize("heights", [True, False])
def test_heights_determine_displacement_along_edge(heights: bool) -> None:
    """The left edge of the sheet stands off: its top edge moves left and up, but only the latter is measured."""
    low, high = np.array([0.0, 0.0]), np.array([300.0, 200.0])
    lens = Lens(np.eye(3), np.array([150.0, 100.0]), float(np.hypot(150, 100)), np.zeros(4))
    along = np.linspace(0, 1, 160)
    level, upright = along * 300, along * 200
    points = np.concatenate(
        [np.stack(side, axis=-1) for side in ((level, 0 * level), (level, 0 * level + 200))]
        + [np.stack(side, axis=-1) for side in ((0 * upright, upright), (0 * upright + 300, upright))]
    )
    normals = np.repeat([(0, 1), (0, 1), (1, 0), (1, 0)], len(along), axis=0).astype(np.float64)

    def sheet(at_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        height = 4.0 * np.sin(at_mm[:, :1] / 300 * 4 * np.pi)
        return height * lens.parallax(at_mm)

    information = 1e4 * np.einsum("ni,nj->nij", normals, normals)
    pull = np.einsum("nij,nj->ni", information, sheet(points))
    fitted = Displacement.over(low, high, 10.0, lens if heights else None).fitted(points, information, pull)
    near_edge = np.stack([np.linspace(20, 280, 40), np.full(40, 2.0)], axis=-1)
    error = np.linalg.norm(fitted.at(near_edge) - sheet(near_edge), axis=1)
    if heights:
        assert error.max() < 0.5
        assert (error < 3 * fitted.errors_px(points, information, near_edge)).all()
    else:
        assert error.max() > 1.5


@pytest.mark.slow
def test_estimates_roughness_from_outline() -> None:
    """Only the outline is measured; the inside is taken to bend as much."""
    low, high = np.array([0.0, 0.0]), np.array([160.0, 100.0])
    along = np.linspace(0, 1, 120)[:, None]
    corners = [low, (high[0], 0.0), high, (0.0, high[1]), low]
    points = np.concatenate([np.array(a) + along * (np.array(b) - a) for a, b in itertools.pairwise(corners)])
    information = np.broadcast_to(np.eye(2) * 1e4, (len(points), 2, 2))
    blank = Displacement.over(low, high, 10.0)

    def fitted_roughness(wave_px: float) -> float:
        moved = wave_px * np.sin(2 * np.pi * points / 60.0)
        roughness = ROUGHNESS_PX
        for _ in range(6):
            fit = blank.fitted(points, information, 1e4 * moved, roughness)
            roughness = fit.likely_roughness_px(points, information, roughness)
        return roughness

    # Second differences of a sine with 6 knots are (2 sin(π/6))² = 1 times its amplitude, RMS 1/√2.
    assert fitted_roughness(2.0) == pytest.approx(np.sqrt(2), rel=0.6)
    assert fitted_roughness(0.02) == ROUGHNESS_PX
    assert fitted_roughness(50.0) == MAX_ROUGHNESS_PX


SIZE = (400, 300)


def compared(
    true: npt.NDArray[np.float64], noise_px: float = 0.0
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return positions, information and pull of blocks for channels with terms `true` (2, 2) and a common shift."""
    random = np.random.default_rng(3)
    positions_px = random.uniform((0, 0), SIZE, (600, 2))
    information = np.stack([np.broadcast_to(np.eye(2) * level, (600, 2, 2)) for level in (300.0, 900.0, 200.0)])
    blank = LateralColour.unmeasured(SIZE)
    shifted = LateralColour(blank.centre_px, blank.radius_px, true, blank.covariance_px2)
    moved = np.stack([0.3 + shifted.shift_px(positions_px, channel) for channel in CHANNELS])
    moved = moved + noise_px * random.standard_normal(moved.shape)
    return positions_px, information, np.einsum("cnij,cnj->cni", information, moved)


def test_separates_lateral_colour_from_common_displacement() -> None:
    true = np.array([[0.4, 0.7], [-0.2, -0.3]])
    lateral = LateralColour.unmeasured(SIZE).remeasured(*compared(true))
    assert lateral.terms_px == pytest.approx(true, abs=0.01)
    assert lateral.corner_px("R") == pytest.approx(1.1, abs=0.01)
    assert lateral.corner_px("B") == pytest.approx(-0.5, abs=0.01)
    assert lateral.corner_px("G") == 0 == lateral.corner_error_px("G")


def channel_errors(registration: Registration, lab: Lab, mosaic: Mosaic) -> dict[str, float]:
    """Return the RMS position error of each channel, px."""
    visible = lab.world.body.visible
    offset = np.array([mosaic.visible.left - visible.left, mosaic.visible.top - visible.top]) / 2
    errors: dict[str, float] = {}
    for channel in CHANNELS:
        true = lab.world.project(lab.chart.centres_mm, channel) - offset
        difference = registration.to_pixels(lab.chart.centres_mm, channel) - true
        errors[channel] = float(np.sqrt((difference**2).sum(axis=1).mean()))
    return errors


@pytest.mark.slow
def test_registers_channels_with_lateral_colour(tmp_path: Path) -> None:
    room = Room(waviness_mm=1.0, lateral_red_px=1.0, lateral_blue_px=-0.6)
    lab = hang(room=room)
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    assert max(channel_errors(registration, lab, mosaic).values()) < 0.04
    lateral = registration.lateral
    assert lateral.corner_px("R") == pytest.approx(1.0, abs=4 * lateral.corner_error_px("R"))
    assert lateral.corner_px("B") == pytest.approx(-0.6, abs=4 * lateral.corner_error_px("B"))
    assert lateral.corner_error_px("R") < 0.1


@pytest.mark.slow
def test_reports_no_lateral_colour_without_any(lab: Lab, tmp_path: Path) -> None:
    lateral = register(lab.mosaic(tmp_path), lab.chart).lateral
    for channel in ("R", "B"):
        assert abs(lateral.corner_px(channel)) < 4 * lateral.corner_error_px(channel) < 0.5


def test_distortion_matches_opencv() -> None:
    radius, centre, terms = 1500.0, np.array([1300.0, 866.0]), np.array([-0.04, 0.02, 3e-3, -2e-3])
    points = np.random.default_rng(2).uniform(-0.8, 0.8, (20, 2))
    camera = np.array([[radius, 0, centre[0]], [0, radius, centre[1]], [0, 0, 1]])
    lens = Lens(camera, centre, radius, terms)
    rays = np.column_stack([points, np.ones(len(points))])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera, terms)
    np.testing.assert_allclose(lens.to_pixels(points), expected.reshape(-1, 2), atol=1e-9)
