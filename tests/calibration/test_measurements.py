"""Figures that follow from others."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.measurements import GreyMeasurements


def test_tints_are_read_under_the_light_that_has_most_of_every_channel() -> None:
    white = np.array([[9000.0, 0.0, 0.0], [500.0, 500.0, 500.0]])
    values = np.array([[[90.0, 1.0, 80.0]], [[50.0, 50.0, 50.0]]])
    assert GreyMeasurements(("grey",), values, values).tints_deg(white) == pytest.approx([0], abs=1e-5)
    assert GreyMeasurements((), np.zeros((2, 0, 3)), np.zeros((2, 0, 3))).tints_deg(white).shape == (0,)
