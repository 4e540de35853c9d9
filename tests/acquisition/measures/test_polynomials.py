"""Bases of polynomials: their terms, and the order that a number of terms has."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.measures.polynomials import code_polynomial, code_powers, order_of, page_polynomial, page_powers

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
