"""A smooth displacement fitted to what was measured."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.registration.geometry import MOST_ROUGHNESS_PX, ROUGHNESS_PX, Displacement, Lens


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_a_displacement_without_bend_is_followed_exactly(level: float, slope_x: float, slope_y: float) -> None:
    low, high = np.array([10.0, 20.0]), np.array([110.0, 90.0])
    points = low + np.random.default_rng(1).random((300, 2)) * (high - low)
    moved = np.stack([level + slope_x * points[:, 0], level + slope_y * points[:, 1]], axis=-1)
    information = np.broadcast_to(np.eye(2) * 1e4, (300, 2, 2))
    found = Displacement.over(low, high, 12.0).fitted(points, information, 1e4 * moved)
    assert found.at(points) == pytest.approx(moved, abs=1e-3)


def test_its_error_is_what_it_scatters_by_and_grows_where_nothing_is_measured() -> None:
    random = np.random.default_rng(4)
    low, high = np.array([0.0, 0.0]), np.array([200.0, 150.0])
    points = low + random.random((4000, 2)) * (high - low)
    points = points[(points[:, 0] < 80) | (points[:, 0] > 130)]
    sigma = 0.2
    information = np.broadcast_to(np.eye(2) / sigma**2, (len(points), 2, 2))
    flat = Displacement.over(low, high, 15.0)
    at = np.array([[40.0, 75.0], [105.0, 75.0]])
    found = [
        flat.fitted(points, information, information[0, 0, 0] * sigma * random.standard_normal(points.shape)).at(at)
        for _ in range(60)
    ]
    scattered = np.sqrt((np.array(found) ** 2).sum(axis=2).mean(axis=0))
    said = flat.errors_px(points, information, at)
    assert said[0] == pytest.approx(scattered[0], rel=0.4)
    assert said[1] > 2 * said[0]
    assert (said >= 0.6 * scattered).all()


@pytest.mark.parametrize("heights", [True, False])
def test_an_edge_known_across_alone_tells_a_height_along_it_as_well(heights: bool) -> None:
    """A sheet whose left edge stands off: its top edge moves left and up, and only the latter is seen."""
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
    found = Displacement.over(low, high, 10.0, lens if heights else None).fitted(points, information, pull)
    beside = np.stack([np.linspace(20, 280, 40), np.full(40, 2.0)], axis=-1)
    off = np.linalg.norm(found.at(beside) - sheet(beside), axis=1)
    if heights:
        assert off.max() < 0.5
        assert (off < 3 * found.errors_px(points, information, beside)).all()
    else:
        assert off.max() > 1.5


def test_a_sheet_that_bends_more_than_usual_is_found_to() -> None:
    """The outline is measured, and inside nothing is: the bends there are those that the outline has."""
    low, high = np.array([0.0, 0.0]), np.array([160.0, 100.0])
    along = np.linspace(0, 1, 120)[:, None]
    corners = [low, (high[0], 0.0), high, (0.0, high[1]), low]
    points = np.concatenate([np.array(a) + along * (np.array(b) - a) for a, b in itertools.pairwise(corners)])
    information = np.broadcast_to(np.eye(2) * 1e4, (len(points), 2, 2))
    blank = Displacement.over(low, high, 10.0)

    def found(wave_px: float) -> float:
        moved = wave_px * np.sin(2 * np.pi * points / 60.0)
        roughness = ROUGHNESS_PX
        for _ in range(6):
            fit = blank.fitted(points, information, 1e4 * moved, roughness)
            roughness = fit.likely_roughness_px(points, information, roughness)
        return roughness

    # Second differences of a sine of 6 knots: (2 sin(π/6))² = 1 times its height, 1/√2 of that usually.
    assert found(2.0) == pytest.approx(np.sqrt(2), rel=0.6)
    assert found(0.02) == ROUGHNESS_PX
    assert found(50.0) == MOST_ROUGHNESS_PX
