"""Robust statistics compared with the normal distribution, and values of the weights."""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.robust import MAD_TO_SIGMA, MEDIAN_ERROR, biweight, huber_weights, robust_sigma


def test_constants_fit_the_normal_distribution() -> None:
    assert pytest.approx(1 / NormalDist().inv_cdf(0.75), abs=5e-5) == MAD_TO_SIGMA
    assert pytest.approx(math.sqrt(math.pi / 2), abs=5e-5) == MEDIAN_ERROR


def test_sigma_ignores_a_few_outliers() -> None:
    residual = np.random.default_rng(1).normal(0, 3.0, (100, 200))
    assert robust_sigma(residual) == pytest.approx(3.0, rel=0.02)
    residual[:10] = 1e6
    assert robust_sigma(residual) == pytest.approx(3.0, rel=0.2)


def test_huber_weights_decrease_beyond_two_sigmas() -> None:
    weights = huber_weights(np.array([0.0, 1.0, 2.0, 4.0, 200.0]), 1.0)
    assert weights.tolist() == [1.0, 1.0, 1.0, 0.5, 0.01]


def test_biweights_are_zero_beyond_the_cut() -> None:
    weights = biweight(np.array([0.0, 3.0, 6.0, 60.0]), 1.0)
    assert weights.tolist() == [1.0, 0.5625, 0.0, 0.0]
    assert biweight(np.array([2.0]), 2.0, cut=2.0).tolist() == [0.5625]


@given(st.lists(st.floats(0, 1e6), min_size=2, max_size=20), st.floats(1e-3, 1e3), st.floats(1e-3, 1e3))
def test_weights_depend_on_relative_size_and_never_increase(sizes: list[float], sigma: float, unit: float) -> None:
    size = np.sort(np.array(sizes))
    for weigh in (huber_weights, biweight):
        weights = weigh(size, sigma)
        assert np.all((weights >= 0) & (weights <= 1))
        assert np.all(np.diff(weights) <= 0)
        np.testing.assert_allclose(weigh(size * unit, sigma * unit), weights, atol=1e-9)
