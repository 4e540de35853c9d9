"""Errors against angles known from geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics import recovery_error, reproduction_error

lights = st.tuples(*[st.floats(0.01, 100)] * 3)


def test_recovery_is_the_angle_between_the_lights() -> None:
    assert recovery_error([1, 0, 0], [0, 2, 0]) == pytest.approx(90)
    assert recovery_error([1, 1, 0], [1, 0, 0]) == pytest.approx(45)
    assert recovery_error([1, 1, 1], [1, 0, 0]) == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))))


def test_reproduction_is_the_angle_of_the_corrected_white() -> None:
    # White (2, 1, 1) under an estimate of grey stays (2, 1, 1): cos = 4 / (sqrt 6 sqrt 3).
    assert reproduction_error([1, 1, 1], [2, 1, 1]) == pytest.approx(math.degrees(math.acos(4 / math.sqrt(18))))
    # One channel of the estimate at zero: the corrected white is that channel alone.
    assert reproduction_error([0, 1, 1], [1, 1, 1]) == pytest.approx(math.degrees(math.acos(1 / math.sqrt(3))))


@settings(deadline=None)
@given(lights, lights, st.floats(0.001, 1000))
def test_brightness_does_not_matter(estimate: tuple[float, ...], truth: tuple[float, ...], scale: float) -> None:
    for error in (recovery_error, reproduction_error):
        angle = error(estimate, truth)
        assert error(np.multiply(estimate, scale), truth) == pytest.approx(float(angle), abs=1e-6)
        assert 0 <= angle <= 90
        assert error(estimate, estimate) == pytest.approx(0, abs=1e-6)


@settings(deadline=None)
@given(lights, lights)
def test_reproduction_does_not_change_with_the_light(estimate: tuple[float, ...], truth: tuple[float, ...]) -> None:
    # Finlayson's argument for it: a change of light scales estimate and truth alike.
    light = np.array([3.0, 0.5, 1.7])
    moved = reproduction_error(np.multiply(estimate, light), np.multiply(truth, light))
    assert moved == pytest.approx(float(reproduction_error(estimate, truth)), abs=1e-6)


def test_small_angles_keep_their_digits() -> None:
    assert recovery_error([1, 1e-9, 0], [1, 0, 0]) == pytest.approx(math.degrees(1e-9), rel=1e-6)
