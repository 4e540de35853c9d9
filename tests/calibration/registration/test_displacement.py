"""A smooth displacement fitted to what was measured."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.registration.displacement import Displacement


@settings(max_examples=20, deadline=None)
@given(st.floats(-3, 3), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_a_displacement_without_bend_is_followed_exactly(level: float, slope_x: float, slope_y: float) -> None:
    low, high = np.array([10.0, 20.0]), np.array([110.0, 90.0])
    points = low + np.random.default_rng(1).random((300, 2)) * (high - low)
    moved = np.stack([level + slope_x * points[:, 0], level + slope_y * points[:, 1]], axis=-1)
    information = np.broadcast_to(np.eye(2) * 1e4, (300, 2, 2))
    found = Displacement.over(low, high, 12.0).fitted(points, information, 1e4 * moved)
    assert found.at(points) == pytest.approx(moved, abs=1e-3)
