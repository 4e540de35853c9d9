"""Figures that follow from others."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.measurements import GreyMeasurements, direction_error_deg


def test_the_error_of_a_direction_is_an_angle() -> None:
    white, error = np.array([[3000.0, 6000.0, 4000.0]]), np.array([[30.0, 20.0, 50.0]])
    seen = white + np.random.default_rng(3).normal(size=(200_000, 3)) * error
    angle = np.degrees(np.arccos((seen @ white[0]) / np.linalg.norm(seen, axis=1) / np.linalg.norm(white)))
    assert direction_error_deg(white, error)[0] == pytest.approx(np.sqrt((angle**2).mean()), rel=0.01)


def test_tints_are_read_under_the_light_that_has_most_of_every_channel() -> None:
    white = np.array([[9000.0, 0.0, 0.0], [500.0, 500.0, 500.0]])
    values = np.array([[[90.0, 1.0, 80.0]], [[50.0, 50.0, 50.0]]])
    assert GreyMeasurements(("grey",), values, values).tints_deg(white) == pytest.approx([0], abs=1e-5)
    assert GreyMeasurements((), np.zeros((2, 0, 3)), np.zeros((2, 0, 3))).tints_deg(white).shape == (0,)
