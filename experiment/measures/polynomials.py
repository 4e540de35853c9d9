"""Polynomial bases: Legendre polynomials over the page and over the cube of printed codes.

On their ranges Legendre polynomials are orthogonal and of order unity, which the normal equations of
`experiment.measures.least_squares` need.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

_CACHED_ORDER: Final = 8
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

    `points_mm`: (N, 2) float mm on the print. Returns (N, terms) float64, read-only, terms as in `page_powers`.
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


def light_terms(page_mm: tuple[float, float], around: bool = False) -> tuple[_Array, tuple[int, ...]]:
    """Return what light on a page may look like, from its simplest shapes on.

    A lens's fall-off is a sum of even powers of the distance from its axis (cos⁴ of the angle to it, and less where the
    mount shades the rim), a projector's is smooth about another point. So after a slope and a bend come the fourth and
    the sixth power of the distance from a centre, before the terms of third and fourth order that no axis explains, and
    the eighth before those of fifth and sixth. A centre that is free is the page's middle and, to first order of where
    it lies, the slopes of the power: x r², y r² with r⁴.

    Returns (legendre, T) float64, each column a polynomial over the page in the terms of `page_powers`; orthogonal to
    those before it over the page, of mean square 1.
    """
    half = float(np.hypot(*page_mm)) / 2
    node, _ = np.polynomial.legendre.leggauss(_CACHED_ORDER + 2)
    u, v = (np.asarray(axis, dtype=np.float64).ravel() for axis in np.meshgrid(node, node))
    x, y = u * page_mm[0] / 2 / half, v * page_mm[1] / 2 / half
    r2 = x * x + y * y

    def power(order: int) -> list[_Array]:
        return [x ** (order - j) * y**j for j in range(order + 1)]

    def radial(half_power: int) -> list[_Array]:
        return [x * r2 ** (half_power - 1), y * r2 ** (half_power - 1), r2**half_power]

    # Of third order two terms besides x r² and y r², of fourth four besides r⁴, and so on.
    groups = (
        [power(0), power(1), power(2), power(3)]
        if around
        else [
            power(0), power(1), power(2), radial(2), radial(3), power(3)[:2], power(4)[:4], radial(4),
            [*power(5)[:4], *power(6)[:6]],
        ]
    )  # fmt: skip
    columns = np.stack([column for group in groups for column in group], axis=1)
    powers = page_powers(_CACHED_ORDER)
    along, across = (
        np.asarray(np.polynomial.legendre.legvander(axis, _CACHED_ORDER), dtype=np.float64) for axis in (u, v)
    )
    basis = np.stack([along[:, i] * across[:, j] for i, j in powers], axis=1)
    norm = np.sqrt([1 / ((2 * i + 1) * (2 * j + 1)) for i, j in powers])
    exact = np.asarray(np.linalg.lstsq(basis, columns, rcond=None)[0], dtype=np.float64)
    orthogonal, triangle = np.linalg.qr(exact * norm[:, None])
    terms = orthogonal * np.sign(np.diag(triangle)) / norm[:, None]
    return np.ascontiguousarray(terms), tuple(np.cumsum([len(group) for group in groups]).tolist())


def code_powers(degree: int) -> list[tuple[int, int, int]]:
    """Return the degrees in red, green and blue of each term of a polynomial in codes of total degree `degree`.

    >>> code_powers(1)
    [(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 0)]
    """
    return [(i, j, k) for i in range(degree + 1) for j in range(degree + 1 - i) for k in range(degree + 1 - i - j)]


def code_polynomial(rgb: npt.ArrayLike, degree: int) -> _Array:
    """Return the basis of printed codes: products of three Legendre polynomials, codes 0 … 255 taken to −1 … 1.

    `rgb`: (C, 3) int printed codes, 0 … 255. `degree`: total degree. Returns (C, terms) float64, terms as in
    `code_powers`.
    """
    unit = 2 * np.asarray(rgb, dtype=np.float64) / 255 - 1
    axes = [np.asarray(np.polynomial.legendre.legvander(unit[:, axis], degree), dtype=np.float64) for axis in range(3)]
    return np.stack([axes[0][:, i] * axes[1][:, j] * axes[2][:, k] for i, j, k in code_powers(degree)], axis=-1)
