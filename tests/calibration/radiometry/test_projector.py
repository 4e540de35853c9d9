"""The lamp's drift and the sum of the primaries, from made-up whites whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.radiometry.primaries import additivity, drift_gains
from drivers.presenter import Colour
from experiment.lights.illuminations import Illumination

PRIMARIES = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def lights(codes: tuple[tuple[int, int, int], ...]) -> list[Illumination]:
    return [Illumination(number, "uniform", None, Colour(*code)) for number, code in enumerate(codes)]


def test_light_adds_but_for_the_black_that_each_brings_along() -> None:
    black, parts = np.array([3.0, 5.0, 4.0]), np.array([[3000.0, 700, 90], [400, 6000, 500], [80, 900, 4000]])
    white = black + parts.sum(axis=0)
    even = np.ones((3, 3))
    found = additivity(lights(PRIMARIES), parts + black, white, black, even)
    assert found == pytest.approx(np.zeros(3), abs=1e-9)
    boosted = additivity(lights(PRIMARIES), parts + black, 1.25 * white, black, even)
    assert boosted == pytest.approx(np.full(3, -0.2), abs=1e-3)
    dimmed = additivity(lights(PRIMARIES), 0.9 * (parts + black), white, black, 0.9 * even)
    assert dimmed == pytest.approx(np.zeros(3), abs=1e-9)


def test_a_missing_primary_leaves_it_untold() -> None:
    assert additivity(lights(PRIMARIES[:2]), np.ones((2, 3)), np.ones(3), np.zeros(3), np.ones((2, 3))) is None
    assert additivity(lights(PRIMARIES), np.ones((3, 3)), None, np.zeros(3), np.ones((3, 3))) is None


def test_the_drift_is_linear_between_white_frames() -> None:
    gains = drift_gains(
        np.array([0.0, 5, 10, 15, 30]), np.array([0.0, 10, 20]), np.array([[8.0, 4, 2], [4, 4, 2], [4, 4, 1]])
    )
    assert gains[:, 0].tolist() == [1, 0.75, 0.5, 0.5, 0.5]
    assert gains[:, 2].tolist() == [1, 1, 1, 0.75, 0.5]
    assert (drift_gains(np.arange(3.0), np.array([1.0]), np.ones((1, 3))) == 1).all()
