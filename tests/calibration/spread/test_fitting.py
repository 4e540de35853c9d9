"""Algebra of the shares: constrained solutions compared with general solvers."""

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
def test_far_shares_are_non_negative_least_squares(seed: int) -> None:
    design, value, matrix, vector = equations(2 * TERMS, TERMS, seed)
    terms = np.sort(np.random.default_rng(seed).permutation(TERMS)[: TERMS // 2])
    shares, gain = fitting._solve_nonnegative(matrix, vector, terms)
    low = np.where(free_terms()[terms], -np.inf, 0.0)
    expected = np.zeros(TERMS)
    expected[terms] = lsq_linear(design[:, terms], value, (low, np.inf), tol=1e-12).x
    np.testing.assert_allclose(shares, expected, atol=1e-6)
    assert (shares[~free_terms()] >= 0).all()
    assert not shares[~np.isin(np.arange(TERMS), terms)].any()
    assert gain == pytest.approx((value**2).sum() - ((value - design @ shares) ** 2).sum())


def test_drops_kernels_with_small_gain() -> None:
    groups = groups_of_terms()
    matrix = np.eye(TERMS)
    gains = np.zeros(len(groups))
    # The gain of a kernel is the sum of its squares: just above and just below the limit.
    gains[[0, 1, -1]] = [LEAST_GAIN + 3 - 1 + 0.1, LEAST_GAIN + 24 - 1 - 0.1, LEAST_GAIN + 3 - 1 + 0.1]
    vector = np.zeros(TERMS)
    for group, gain in zip(groups, gains, strict=True):
        vector[group] = np.sqrt(gain / len(group))
    for misfit, expected in ((1.0, [0, len(groups) - 1]), (1.1, [])):
        selected = fitting._proven_terms(matrix, vector, misfit, groups)
        assert selected.tolist() == sorted(np.concatenate([np.zeros(0, int), *(groups[k] for k in expected)]).tolist())


def test_nonlinearity_keeps_black_and_white() -> None:
    level = np.array([0.0, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(fitting.nonlinearity_change(level, np.array([1.0, 1.0, 0.8, 1.0])), [0, 3 / 16, 0.2, 0])


@pytest.mark.parametrize("scale", [0.1, 0.7, 3.0])
def test_far_taps_integrate_gaussian(scale: float) -> None:
    taps = far_taps(scale)
    reach = len(taps) // 2
    assert reach == max(1, int(np.ceil(3 * scale)))
    cumulative = stats.norm(0, scale).cdf(np.arange(-reach, reach + 2) - 0.5)
    np.testing.assert_allclose(taps, np.diff(cumulative) / np.diff(cumulative).sum(), rtol=1e-5)
    assert taps.sum() == pytest.approx(1)
