"""The compiled fits and sums against NumPy's plain answers."""

from __future__ import annotations

import numpy as np
import pytest

from experiment.measures.least_squares import (
    held_out_squares,
    least_squares,
    linear_combinations,
    robust_least_squares,
)


@pytest.mark.parametrize("unknowns", [1, 3, 10, 28])
def test_without_outliers_the_fit_is_least_squares(unknowns: int) -> None:
    random = np.random.default_rng(unknowns)
    design = random.uniform(-1, 1, (500, unknowns))
    values = design @ random.uniform(-1, 1, unknowns) + random.normal(0, 0.01, 500)
    solution, weights, residual = robust_least_squares(design, values, 1)
    plain = np.linalg.lstsq(design, values)[0]
    assert solution == pytest.approx(plain, abs=1e-8)
    assert residual == pytest.approx(values - design @ plain, abs=1e-8)
    assert weights.max() <= 1


def test_weights_count_as_repetitions() -> None:
    random = np.random.default_rng(4)
    design, values = random.uniform(-1, 1, (40, 3)), random.uniform(-1, 1, 40)
    times = random.integers(0, 4, 40)
    plain = np.linalg.lstsq(np.repeat(design, times, axis=0), np.repeat(values, times))[0]
    assert least_squares(design, values, times.astype(np.float64)) == pytest.approx(plain, abs=1e-8)


def test_a_tenth_of_outliers_does_not_move_the_fit() -> None:
    random = np.random.default_rng(9)
    design, truth = random.uniform(-1, 1, (500, 6)), random.uniform(-1, 1, 6)
    values = design @ truth + random.normal(0, 0.01, 500)
    values[:50] += random.uniform(1, 3, 50)
    solution, weights, _ = robust_least_squares(design, values, 6)
    # Six standard errors of 450 values about lines of RMS 0.58.
    assert solution == pytest.approx(truth, abs=6 * 0.01 / 0.58 / np.sqrt(450))
    assert not weights[:50].any()
    assert (weights[50:] > 0.3).mean() > 0.95


def test_columns_that_are_equal_are_solved_all_the_same() -> None:
    line = np.linspace(-1, 1, 50)
    design = np.column_stack([np.ones(50), line, line])
    solution, _, residual = robust_least_squares(design, 2 + 3 * line, 1)
    assert solution[1] + solution[2] == pytest.approx(3, rel=1e-6)
    assert np.abs(residual).max() < 1e-6


def test_terms_are_combined_point_by_point() -> None:
    random = np.random.default_rng(2)
    basis, factors = random.random((28, 5000)), random.random((3, 28))
    factors[1, 5:] = 0
    assert linear_combinations(basis, factors) == pytest.approx(factors @ basis, rel=1e-12)


def test_errors_at_points_left_out_are_those_of_fits_without_them() -> None:
    random = np.random.default_rng(6)
    design, weights = random.uniform(-1, 1, (30, 6)), random.uniform(0, 1, 30)
    weights[3] = 0
    values = design @ random.uniform(-1, 1, 6) + random.normal(0, 0.3, 30)
    counts = (1, 3, 4, 6)
    plain: list[float] = []
    for count in counts:
        root, squares = np.sqrt(weights)[:, None], 0.0
        for left_out in np.flatnonzero(weights):
            others = np.arange(30) != left_out
            rooted = (design[:, :count] * root)[others]
            solution = np.asarray(np.linalg.lstsq(rooted, (values * root[:, 0])[others])[0], dtype=np.float64)
            squares += float(weights[left_out] * (values[left_out] - design[left_out, :count] @ solution) ** 2)
        plain.append(squares / weights.sum())
    assert held_out_squares(design, values, weights, counts) == pytest.approx(plain, rel=1e-6)
