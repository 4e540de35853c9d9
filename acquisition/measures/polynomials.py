"""Polynomial bases: Legendre polynomials over the page and over the cube of printed codes.

On their ranges Legendre polynomials are orthogonal and of order unity, which the normal equations of
`acquisition.measures.least_squares` need.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

_CACHED_ORDER: Final = 6
"""The highest order that flat fields are fitted with: a basis of a lower one is the beginning of this one's."""

_Array = npt.NDArray[np.float64]


def page_powers(order: int) -> list[tuple[int, int]]:
    """Return the degrees (i, j) in x and y of the terms of a polynomial of total order `order`, lower totals first.

    >>> page_powers(2)
    [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]
    """
    return [(total - j, j) for total in range(order + 1) for j in range(total + 1)]


def order_of(count: int) -> int:
    """Return the total order of a polynomial of `count` terms: the inverse of the number of `page_powers`.

    >>> order_of(6)
    2
    """
    return round((np.sqrt(8 * count + 1) - 3) / 2)


def page_polynomial(points_mm: npt.ArrayLike, page_mm: tuple[float, float], order: int) -> _Array:
    """Return the basis at points of the page: products P_i(x) P_j(y) of Legendre polynomials, x, y −1 … 1 on the page.

    Parameters
    ----------
    points_mm
        (N, 2) float mm on the print.
    page_mm
        Width and height of the page.
    order
        Total order, i + j ≤ order.

    Returns
    -------
    ndarray
        (N, terms) float64, read-only, terms as in `page_powers`.
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 2)
    # Terms stand in rising order, so a lower order's basis is the beginning of a higher one's.
    return _page_basis(points.tobytes(), page_mm, max(order, _CACHED_ORDER))[:, : len(page_powers(order))]


@lru_cache(maxsize=8)
def _page_basis(points: bytes, page_mm: tuple[float, float], order: int) -> _Array:
    """Return the basis at points (N, 2) float64, read-only; the same cells and references come with every frame."""
    unit = 2 * np.frombuffer(points).reshape(-1, 2) / np.asarray(page_mm, dtype=np.float64) - 1
    x, y = (np.polynomial.legendre.legvander(unit[:, axis], order) for axis in (0, 1))
    basis = np.stack([x[:, i] * y[:, j] for i, j in page_powers(order)], axis=1)
    basis.setflags(write=False)
    return basis


def code_powers(degree: int) -> list[tuple[int, int, int]]:
    """Return the degrees in red, green and blue of each term of a polynomial in codes of total degree `degree`.

    >>> code_powers(1)
    [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)]
    """
    return [(i, j, k) for i in range(degree + 1) for j in range(degree + 1 - i) for k in range(degree + 1 - i - j)]


def code_polynomial(rgb: npt.ArrayLike, degree: int) -> _Array:
    """Return the basis of printed codes: products of three Legendre polynomials, codes 0 … 255 taken to −1 … 1.

    Parameters
    ----------
    rgb
        (C, 3) int printed codes, 0 … 255.
    degree
        Total degree.

    Returns
    -------
    ndarray
        (C, terms) float64, terms as in `code_powers`.
    """
    unit = 2 * np.asarray(rgb, dtype=np.float64) / 255 - 1
    axes = [np.asarray(np.polynomial.legendre.legvander(unit[:, axis], degree), dtype=np.float64) for axis in range(3)]
    return np.stack([axes[0][:, i] * axes[1][:, j] * axes[2][:, k] for i, j, k in code_powers(degree)], axis=-1)
