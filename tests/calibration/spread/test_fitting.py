"""The algebra behind a lens's shares: which unknown is whose, and solutions against those of general solvers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats
from scipy.optimize import lsq_linear

from calibration.spread import fitting
from calibration.spread.fitting import (
    LEAST_GAIN,
    TERMS,
    free_terms,
    groups_of_terms,
)
from calibration.spread.surroundings import far_taps


def equations(rows: int, size: int, seed: int) -> tuple[npt.NDArray[np.float64], ...]:
    """Return a design, values, and their normal equations."""
    random = np.random.default_rng(seed)
    design, value = random.standard_normal((rows, size)), random.standard_normal(rows)
    return design, value, design.T @ design, design.T @ value


@pytest.mark.parametrize("seed", range(3))
def test_far_light_is_never_negative_and_the_rest_is_least_squares(seed: int) -> None:
    design, value, matrix, vector = equations(2 * TERMS, TERMS, seed)
    kept = np.sort(np.random.default_rng(seed).permutation(TERMS)[: TERMS // 2])
    shares, gain = fitting._positive(matrix, vector, kept)
    low = np.where(free_terms()[kept], -np.inf, 0.0)
    expected = np.zeros(TERMS)
    expected[kept] = lsq_linear(design[:, kept], value, (low, np.inf), tol=1e-12).x
    np.testing.assert_allclose(shares, expected, atol=1e-6)
    assert (shares[~free_terms()] >= 0).all()
    assert not shares[~np.isin(np.arange(TERMS), kept)].any()
    assert gain == pytest.approx((value**2).sum() - ((value - design @ shares) ** 2).sum())


def test_kernels_that_gain_less_than_chance_and_four_standard_errors_are_left_out() -> None:
    groups = groups_of_terms()
    matrix = np.eye(TERMS)
    worth = np.zeros(len(groups))
    # A kernel gains the sum of its squares here: just enough, and just not.
    worth[[0, 1, -1]] = [LEAST_GAIN + 3 - 1 + 0.1, LEAST_GAIN + 24 - 1 - 0.1, LEAST_GAIN + 3 - 1 + 0.1]
    vector = np.zeros(TERMS)
    for group, gain in zip(groups, worth, strict=True):
        vector[group] = np.sqrt(gain / len(group))
    for misfit, kept in ((1.0, [0, len(groups) - 1]), (1.1, [])):
        found = fitting._selected(matrix, vector, misfit, groups)
        assert found.tolist() == sorted(np.concatenate([np.zeros(0, int), *(groups[k] for k in kept)]).tolist())


def test_a_sensor_that_falls_short_bends_neither_black_nor_white() -> None:
    level = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(fitting.bent(level, np.array([1.0, 1.0, 0.8, 1.0])), [0, 3 / 16, 0.2, 0])


@pytest.mark.parametrize("scale", [0.1, 0.7, 3.0])
def test_far_light_is_shared_among_slots_as_a_gaussian_lies_over_them(scale: float) -> None:
    taps = far_taps(scale)
    reach = len(taps) // 2
    assert reach == max(1, int(np.ceil(3 * scale)))
    between = stats.norm(0, scale).cdf(np.arange(-reach, reach + 2) - 0.5)
    np.testing.assert_allclose(taps, np.diff(between) / np.diff(between).sum(), rtol=1e-5)
    assert taps.sum() == pytest.approx(1)
