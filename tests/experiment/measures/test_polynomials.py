"""Bases of polynomials: their terms, and the order that a number of terms has."""

from __future__ import annotations

import numpy as np
import pytest

from experiment.measures.least_squares import (
    code_polynomial,
    code_powers,
    light_terms,
    order_of,
    page_polynomial,
    page_powers,
)

PAGE = (400.0, 300.0)
PLACES = np.random.default_rng(3).random((400, 2)) * PAGE


@pytest.mark.parametrize("order", range(8))
def test_terms_and_orders_agree(order: int) -> None:
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
def test_shapes_of_light_are_nested_and_orthogonal_over_the_page(around: bool) -> None:
    terms, counts = light_terms(PAGE, around)
    assert counts[:3] == (1, 3, 6)
    assert counts[-1] == terms.shape[1] == (10 if around else 31)
    norm = np.array([1 / ((2 * i + 1) * (2 * j + 1)) for i, j in page_powers(8)])
    assert terms.T @ (terms * norm[:, None]) == pytest.approx(np.eye(terms.shape[1]), abs=1e-9)
    # Each count holds all of a lower one, and the highest order is as it is said.
    assert np.abs(terms[len(page_powers(3 if around else 8)) :]).max(initial=0) < 1e-9


@pytest.mark.parametrize(("power", "count"), [(1, 6), (2, 9), (3, 12)])
def test_a_fall_off_about_a_centre_a_little_aside_needs_few_terms(power: int, count: int) -> None:
    terms, counts = light_terms(PAGE)
    assert count in counts
    basis = page_polynomial(PLACES, PAGE, 8) @ terms[:, :count]
    aside = (PLACES - (205, 148)) / np.hypot(*PAGE) * 2
    wanted = (aside**2).sum(axis=1) ** power
    left = wanted - basis @ np.asarray(np.linalg.lstsq(basis, wanted)[0], dtype=np.float64)
    # Second order of 6 of 250 mm, which four more terms hold.
    assert np.abs(left).max() < 0.002
