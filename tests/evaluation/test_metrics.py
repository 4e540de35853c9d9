"""Errors and summaries against angles known from geometry and numbers worked by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics import recovery_error, reproduction_error, summarise
from foundation.errors import InputError

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


def test_the_summary_of_eight_errors() -> None:
    # By MATLAB's prctile the errors stand at 6.25, 18.75, 31.25 ... percent: Q1 = 2.5, Q2 = 4.5, Q3 = 6.5.
    summary = summarise([8, 1, 7, 2, 6, 3, 5, 4])
    assert summary.as_tuple() == pytest.approx((4.5, 4.5, 4.5, 1.5, 7.5, (4.5**3 * 1.5 * 7.5) ** 0.2))


def test_the_summary_of_five_errors() -> None:
    # At 10, 30, 50, 70, 90 percent: Q1 = 1 + 0.75 = 1.75, Q3 = 4 + 0.25 * 6 = 5.5; with 1, 2, 3, 4, 10.
    summary = summarise([1, 2, 3, 4, 10])
    assert summary.as_tuple()[:5] == pytest.approx((4, 3, (1.75 + 6 + 5.5) / 4, 1, 10))


@pytest.mark.parametrize("errors", [[], [1.0, math.nan]])
def test_nothing_to_sum_up_is_said(errors: list[float]) -> None:
    with pytest.raises(InputError, match="nothing to sum up"):
        summarise(errors)
