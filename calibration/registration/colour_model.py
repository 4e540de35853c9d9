"""A model of the camera RGB of printed codes, fitted on the frame itself: neither print nor light need be known.

Counts above black, camera RGB; codes 0 … 255; millimetres on the page.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import code_powers, least_squares
from foundation.robust import huber_weights, sigma_of

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ColourModel:
    """What camera RGB a printed code gives in one frame: a polynomial, times a smooth light over the page.

    - `degree`: of the polynomial in the three codes.
    - `coefficients`: (terms, 3) float64, counts.
    - `light`: (6, 3) float64, polynomial of second order in page coordinates −1 … 1, mean about 1.
    - `page_mm`: width and height of the sheet.
    """

    degree: int
    coefficients: _Array
    light: _Array
    page_mm: tuple[float, float]

    def flat(self, rgb: npt.ArrayLike) -> _Array:
        """Return camera RGB (N, 3) float64, counts, of printed codes (N, 3), 0 … 255, under even light."""
        return _code_terms(rgb, self.degree) @ self.coefficients

    def light_at(self, points_mm: _Array) -> _Array:
        """Return the light (N, 3) float64 at points (N, 2) mm of the page, mean about 1."""
        return _page_terms(points_mm, self.page_mm) @ self.light

    def seen(self, rgb: npt.ArrayLike, points_mm: _Array) -> _Array:
        """Return camera RGB (N, 3) float64, counts, of printed codes (N, 3) at points (N, 2) mm of the page."""
        return self.flat(rgb) * self.light_at(points_mm)


def _code_terms(rgb: npt.ArrayLike, degree: int) -> _Array:
    r, g, b = (np.asarray(rgb, dtype=np.float64) / 255).T
    return np.column_stack([r**i * g**j * b**k for i, j, k in code_powers(degree)])


def _page_terms(points_mm: _Array, page_mm: tuple[float, float]) -> _Array:
    x, y = (2 * np.asarray(points_mm, dtype=np.float64) / page_mm - 1).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def fit_colours(
    rgb: _Array, points_mm: _Array, seen: _Array, page_mm: tuple[float, float], finely: bool = False
) -> ColourModel:
    """Return the colour model through patches, robust against those that are covered or displaced.

    Alternating least squares for polynomial and light, reweighted by Huber's weights.

    `rgb`: (N, 3) printed codes, 0 … 255. `points_mm`: (N, 2) mm, centres. `seen`: (N, 3) float64 camera RGB, counts
    above black. `finely`: whether the steps between neighbouring codes matter: a polynomial of degree 6 or 8 where
    patches suffice, which leaves a third of what one of degree 3 leaves.
    """
    degree = (
        (8 if len(rgb) >= 4000 else 6)
        if finely and len(rgb) >= 2000
        else 3
        if len(rgb) >= 200
        else 2
        if len(rgb) >= 60
        else 1
    )
    terms, page = _code_terms(rgb, degree), _page_terms(points_mm, page_mm)
    coefficients, light = np.zeros((terms.shape[1], 3)), np.zeros((6, 3))
    for channel in range(3):
        field = np.array([1.0, 0, 0, 0, 0, 0])
        weights = np.ones(len(rgb))
        value = seen[:, channel]
        model = np.zeros(terms.shape[1])
        for _ in range(6):
            model = least_squares(terms * (page @ field)[:, None], value, weights)
            flat = terms @ model
            field = least_squares(page * flat[:, None], value, weights)
            residual = np.abs(value - flat * (page @ field))
            spread = max(sigma_of(residual), 1e-9)
            weights = huber_weights(residual, spread)
        level = float((page @ field).mean())
        coefficients[:, channel], light[:, channel] = model * level, field / level
    return ColourModel(degree, coefficients, light, page_mm)
