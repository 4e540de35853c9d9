"""What the camera sees of a printed code: fitted on the frame itself, so that no print or light need be known.

Counts above black, camera RGB; codes 0 … 255; millimetres on the page.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.radiometry.fitting import least_squares
from foundation.robust import huber_weights, sigma_of

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ColourModel:
    """What camera RGB a printed code gives in one frame: a polynomial, times a smooth light over the page.

    Attributes
    ----------
    degree
        Of the polynomial in the three codes.
    coefficients
        (terms, 3) float64, counts.
    light
        (6, 3) float64, polynomial of second order in page coordinates −1 … 1, mean about 1.
    page_mm
        Width and height of the sheet.
    """

    degree: int
    coefficients: _Array
    light: _Array
    page_mm: tuple[float, float]

    def flat(self, rgb: npt.ArrayLike) -> _Array:
        """Return camera RGB (N, 3), counts, of printed codes (N, 3) under even light."""
        return _code_terms(rgb, self.degree) @ self.coefficients

    def light_at(self, points_mm: _Array) -> _Array:
        """Return the light (N, 3) at points of the page, mean about 1."""
        return _page_terms(points_mm, self.page_mm) @ self.light

    def seen(self, rgb: npt.ArrayLike, points_mm: _Array) -> _Array:
        """Return camera RGB (N, 3), counts, of printed codes at points of the page."""
        return self.flat(rgb) * self.light_at(points_mm)


def code_powers(degree: int) -> list[tuple[int, int, int]]:
    """Return the degrees in red, green and blue of each term of a polynomial in codes of total degree `degree`."""
    return [(i, j, k) for i in range(degree + 1) for j in range(degree + 1 - i) for k in range(degree + 1 - i - j)]


def code_polynomial(rgb: npt.ArrayLike, degree: int) -> _Array:
    """Return the basis (C, terms) of printed codes (C, 3): products of Legendre polynomials as in `code_powers`."""
    unit = 2 * np.asarray(rgb, dtype=np.float64) / 255 - 1
    axes = [np.asarray(np.polynomial.legendre.legvander(unit[:, axis], degree), dtype=np.float64) for axis in range(3)]
    return np.stack([axes[0][:, i] * axes[1][:, j] * axes[2][:, k] for i, j, k in code_powers(degree)], axis=-1)


def _code_terms(rgb: npt.ArrayLike, degree: int) -> _Array:
    r, g, b = (np.asarray(rgb, dtype=np.float64) / 255).T
    return np.column_stack([r**i * g**j * b**k for i, j, k in code_powers(degree)])


def _page_terms(points_mm: _Array, page_mm: tuple[float, float]) -> _Array:
    x, y = (2 * np.asarray(points_mm, dtype=np.float64) / page_mm - 1).T
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def fit_colours(
    rgb: _Array, points_mm: _Array, seen: _Array, page_mm: tuple[float, float], finely: bool = False
) -> ColourModel:
    """Return the colour model through patches, robust against those that are covered or not where they are thought.

    Parameters
    ----------
    rgb
        (N, 3) printed codes.
    points_mm
        (N, 2) centres.
    seen
        (N, 3) camera RGB, counts.
    page_mm
        Width and height of the sheet.
    finely
        Whether the steps between neighbouring codes must be true: a polynomial of degree 6 or 8 where patches suffice,
        which leaves a third of what one of degree 3 leaves.
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
