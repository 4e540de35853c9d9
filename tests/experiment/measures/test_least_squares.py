"""Compiled fits and sums against NumPy, and the terms of polynomial bases."""

from __future__ import annotations

import numpy as np
import pytest

from experiment.measures.least_squares import (
    code_polynomial,
    code_powers,
    held_out_squares,
    least_absolute_line,
    least_squares,
    light_terms,
    linear_combinations,
    order_of,
    page_polynomial,
    page_powers,
    robust_least_squares,
)

PAGE = (400.0, 300.0)
PLACES = np.random.default_rng(3).random((400, 2)) * PAGE


@pytest.mark.parametrize("order", range(8))
def test_numbers_of_terms_and_orders_agree(order: int) -> None:
    assert len(page_powers(order)) == (order + 1) * (order + 2) // 2
    assert order_of(len(page_powers(order))) == order
    assert page_polynomial(PLACES, PAGE, order).shape == (len(PLACES), len(page_powers(order)))


def test_terms_are_products_of_legendre_polynomials() -> None:
    x, y = (2 * PLACES / PAGE - 1).T
    term = page_powers(4).index((2, 1))
    assert page_polynomial(PLACES, PAGE, 4)[:, term] == pytest.approx(0.5 * (3 * x**2 - 1) * y)
    codes = np.array([[0, 255, 51], [127.5, 0, 255]])
    term = code_powers(3).index((1, 0, 2))
    assert code_polynomial(codes, 3)[:, term] == pytest.approx([-1 * 0.5 * (3 * 0.36 - 1), 0])


@pytest.mark.parametrize("around", [False, True])
def test_light_terms_are_nested_and_orthogonal(around: bool) -> None:
    terms, counts = light_terms(PAGE, around)
    # A constant, a slope, a bend; then powers of the distance from a free centre, before the other terms.
    assert counts == ((1, 3, 6, 10) if around else (1, 3, 6, 9, 12, 14, 18, 21, 31))
    assert terms.shape[1] == counts[-1]
    norm = np.array([1 / ((2 * i + 1) * (2 * j + 1)) for i, j in page_powers(8)])
    assert terms.T @ (terms * norm[:, None]) == pytest.approx(np.eye(terms.shape[1]), abs=1e-9)
    # Each count includes all terms of lower order, and no term is above the highest order.
    assert np.abs(terms[len(page_powers(3 if around else 8)) :]).max(initial=0) < 1e-9


@pytest.mark.parametrize(("power", "count"), [(1, 6), (2, 9), (3, 12)])
def test_decentred_fall_off_needs_few_terms(power: int, count: int) -> None:
    terms, counts = light_terms(PAGE)
    assert count in counts
    basis = page_polynomial(PLACES, PAGE, 8) @ terms[:, :count]
    offsets = (PLACES - (205, 148)) / np.hypot(*PAGE) * 2
    expected = (offsets**2).sum(axis=1) ** power
    residual = expected - basis @ np.asarray(np.linalg.lstsq(basis, expected)[0], dtype=np.float64)
    # The decentring of 6 mm of 250 mm has an effect of second order, for which there are four more terms.
    assert np.abs(residual).max() < 0.002


@pytest.mark.parametrize("unknowns", [1, 3, 10, 28])
def test_fit_without_outliers_is_least_squares(unknowns: int) -> None:
    random = np.random.default_rng(unknowns)
    design = random.uniform(-1, 1, (500, unknowns))
    values = design @ random.uniform(-1, 1, unknowns) + random.normal(0, 0.01, 500)
    solution, weights, residual = robust_least_squares(design, values, 1)
    plain = np.linalg.lstsq(design, values)[0]
    assert solution == pytest.approx(plain, abs=1e-8)
    assert residual == pytest.approx(values - design @ plain, abs=1e-8)
    # Tukey's biweight, cut at six robust standard deviations.
    sigma = float(np.median(np.abs(residual))) / 0.674490
    assert weights == pytest.approx(np.maximum(1 - (residual / (6 * sigma)) ** 2, 0) ** 2, abs=1e-5)


def test_line_ignores_outliers() -> None:
    x = np.linspace(0, 1, 40)
    y = 0.25 + 0.5 * x
    y[::5] += np.linspace(0.1, 3, 8)
    assert least_absolute_line(x, y) == pytest.approx((0.25, 0.5), abs=2e-4)
    # Two points determine the line.
    assert least_absolute_line(x[:2], np.array([1.0, 3.0])) == pytest.approx((1, 78))


def test_weights_count_as_repetitions() -> None:
    random = np.random.default_rng(4)
    design, values = random.uniform(-1, 1, (40, 3)), random.uniform(-1, 1, 40)
    times = random.integers(0, 4, 40)
    plain = np.linalg.lstsq(np.repeat(design, times, axis=0), np.repeat(values, times))[0]
    assert least_squares(design, values, times.astype(np.float64)) == pytest.approx(plain, abs=1e-8)


def test_fit_ignores_outliers() -> None:
    random = np.random.default_rng(9)
    design, truth = random.uniform(-1, 1, (500, 6)), random.uniform(-1, 1, 6)
    values = design @ truth + random.normal(0, 0.01, 500)
    values[:50] += random.uniform(1, 3, 50)
    solution, weights, _ = robust_least_squares(design, values, 6)
    # Six standard errors of 450 values, for columns of RMS 0.58.
    assert solution == pytest.approx(truth, abs=6 * 0.01 / 0.58 / np.sqrt(450))
    assert not weights[:50].any()
    assert (weights[50:] > 0.3).mean() > 0.95


def test_solves_equal_columns() -> None:
    line = np.linspace(-1, 1, 50)
    design = np.column_stack([np.ones(50), line, line])
    solution, _, residual = robust_least_squares(design, 2 + 3 * line, 1)
    assert solution[1] + solution[2] == pytest.approx(3, rel=1e-6)
    assert np.abs(residual).max() < 1e-6


@pytest.mark.slow
def test_linear_combinations_match_matrix_product() -> None:
    random = np.random.default_rng(2)
    basis, factors = random.random((28, 5000)), random.random((3, 28))
    factors[1, 5:] = 0
    assert linear_combinations(basis, factors) == pytest.approx(factors @ basis, rel=1e-12)


def test_held_out_errors_match_repeated_fits() -> None:
    random = np.random.default_rng(6)
    design, weights = random.uniform(-1, 1, (30, 6)), random.uniform(0, 1, 30)
    weights[3] = 0
    values = design @ random.uniform(-1, 1, 6) + random.normal(0, 0.3, 30)
    counts = (1, 3, 4, 6)
    expected: list[float] = []
    for count in counts:
        root, squares = np.sqrt(weights)[:, None], 0.0
        for left_out in np.flatnonzero(weights):
            kept = np.arange(30) != left_out
            rooted = (design[:, :count] * root)[kept]
            solution = np.asarray(np.linalg.lstsq(rooted, (values * root[:, 0])[kept])[0], dtype=np.float64)
            squares += float(weights[left_out] * (values[left_out] - design[left_out, :count] @ solution) ** 2)
        expected.append(squares / weights.sum())
    assert held_out_squares(design, values, weights, counts) == pytest.approx(expected, rel=1e-6)
