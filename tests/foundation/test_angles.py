"""Angles between colours: properties that no formula may break."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.colorimetry import angles_deg

Colour = tuple[float, float, float]
COLOURS = st.tuples(*[st.floats(1e-3, 1e3)] * 3)


def test_known_angles() -> None:
    assert angles_deg([1, 0, 0], [0, 1, 0]) == pytest.approx(90)
    assert angles_deg([1, 0, 0], [1, 1, 0]) == pytest.approx(45)
    assert angles_deg([1, 1, 1], [-1, -1, -1]) == pytest.approx(180)


@pytest.mark.parametrize("degrees", [1e-9, 1e-6, 1e-3, 1.0, 179.999])
def test_no_angle_loses_its_digits(degrees: float) -> None:
    angle = np.radians(degrees)
    other = np.array([np.cos(angle), np.sin(angle), 0])
    assert float(angles_deg([1, 0, 0], other)) == pytest.approx(degrees, rel=1e-9)


@given(COLOURS, COLOURS, st.floats(1e-3, 1e3))
def test_neither_order_nor_brightness_matters(one: Colour, other: Colour, times: float) -> None:
    angle = float(angles_deg(one, other))
    assert 0 <= angle <= 90 + 1e-9
    assert float(angles_deg(other, one)) == pytest.approx(angle, abs=1e-9)
    assert float(angles_deg(np.array(one) * times, other)) == pytest.approx(angle, abs=1e-9)


@given(COLOURS)
def test_a_colour_makes_no_angle_with_itself(colour: Colour) -> None:
    assert float(angles_deg(colour, colour)) == 0


@given(COLOURS, COLOURS, COLOURS)
def test_no_detour_is_shorter(one: Colour, between: Colour, other: Colour) -> None:
    assert float(angles_deg(one, other)) <= float(angles_deg(one, between) + angles_deg(between, other)) + 1e-9


def test_shapes_are_broadcast() -> None:
    angles = angles_deg(np.ones((4, 1, 3)), np.eye(3))
    assert angles.shape == (4, 3)
    np.testing.assert_allclose(angles, np.degrees(np.arccos(1 / np.sqrt(3))))
