"""Light that lies on part of the print and adds as much to dark cells as to bright ones, such as a reflection.

The colours of a chart lie in random order, so that what a cell's neighbours in colour have, elsewhere on the print,
predicts its own level (`calibration.spread.predicting`). What is left of it where cells are dark, and
changes smoothly over the page, was added. How much of it is usual is found from the print itself: the size for which
what is seen is likeliest (empirical Bayes, C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine
Learning", 2006, 5.4.1). Light that is the same all over the page is not seen here; it is the veil of the lens.

C cells in the order of colour indices; levels are those of bare paper 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.spread.predicting import LevelModel
from experiment.measures.least_squares import page_polynomial
from foundation.robust import biweight, sigma_by_level

# Places along the page's longer side at which added light is known; between them it is smooth: a spot of an eighth of
# the page is.
_KNOTS = 9

_FACTOR_ORDER = 4  # Of a smooth factor of all levels, fitted along: an error of the field is no added light

_USUAL_FACTOR = 0.003  # Standard deviation of its coefficients (chosen)

# Standard deviations of added light that are tried.
_SIZES = (1e-5, 1e-4, 2e-4, 4e-4, 8e-4, 1.6e-3, 3.2e-3, 6.4e-3, 0.013, 0.026, 0.05)

MOST_ADDED = 0.05  # Share of a cell's level that may have been added for the cell to be used (judgement)

_CERTAIN = 4.0  # Standard errors that are taken off, so that of some thousand cells none is listed for its noise

LEAST_LEVEL = 1e-3  # Level of a cell below which a relative error is stated as if it had that

_LEAST_CELLS = 200  # Cells from which on something is said

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AddedLight:
    """What lies on each cell.

    - `share`: (C, 3) float64, added light, bare paper's 1; 0 where there is least of it.
    - `error`: (C, 3) float64, its standard error.
    """

    share: _Array
    error: _Array

    @staticmethod
    def none(cells: int) -> AddedLight:
        """Return that nothing is known to be added."""
        return AddedLight(np.zeros((cells, 3)), np.zeros((cells, 3)))

    def certain_share_of(self, level: _Array) -> _Array:
        """Return by how much cells are brighter for certain, (C, 3) float64, relative to their levels (C, 3)."""
        return np.maximum(self.share - _CERTAIN * self.error, 0) / np.maximum(level, LEAST_LEVEL)

    @property
    def mean_square(self) -> _Array:
        """(C, 3) float64, what cells may be off by: what is added, and how well that is known."""
        return self.share**2 + self.error**2


def added_light(
    level: _Array,
    variance: _Array,
    usable: npt.NDArray[np.bool_],
    cells_mm: _Array,
    page_mm: tuple[float, float],
    bits: int,
) -> AddedLight:
    """Return the light that is added to cells.

    `level`, `variance`: (C, 3) float64, levels of cells and the variance of their noise. `usable`: (C,) bool.
    `cells_mm`: (C, 2) float64 mm, the cells' centres.
    """
    if int(usable.sum()) < _LEAST_CELLS:
        return AddedLight.none(len(level))
    bumps = _bumps(cells_mm)
    factor = page_polynomial(cells_mm, page_mm, _FACTOR_ORDER)[:, 1:]
    found = AddedLight.none(len(level))
    for channel in range(3):
        known = np.where(usable, level[:, channel], np.nan)
        known = np.where(usable, known, np.nanmedian(known))
        model = LevelModel.of(known, usable, bits)
        left = model.residual_of(known)
        expected = model.predicted
        rows = model.known & usable
        groups = max(min(20, int(rows.sum()) // 20), 1)
        scatter = sigma_by_level(left[rows], expected[rows], groups)
        sigma = np.sqrt(scatter**2 + variance[rows, channel])
        value = left[rows] / sigma
        design = model.residual(np.column_stack([bumps, factor * expected[:, None]]))[rows] / sigma[:, None]
        solution, covariance = _likeliest(value, design, bumps.shape[1])
        # Dust, a fold or a clipped cell is no light that lies on the cells around it, too.
        trust = biweight(np.abs(value - design[:, : bumps.shape[1]] @ solution), 1.0)
        solution, covariance = _likeliest(value * trust, design * trust[:, None], bumps.shape[1])
        share = bumps @ solution
        found.share[:, channel] = share - np.quantile(share[usable], 0.05)
        found.error[:, channel] = np.sqrt(np.einsum("ck,kl,cl->c", bumps, covariance, bumps))
    return found


def _bumps(places_mm: _Array) -> _Array:
    """Return smooth bumps (C, K) all over the page, each as wide as they are apart."""
    low, high = places_mm.min(axis=0), places_mm.max(axis=0)
    apart = float((high - low).max()) / (_KNOTS - 1)
    axes: list[_Array] = [np.linspace(a, b, max(round((b - a) / apart), 1) + 1) for a, b in zip(low, high, strict=True)]
    x, y = (np.exp(-0.5 * ((places_mm[:, n, None] - axes[n]) / apart) ** 2) for n in range(2))
    return (y[:, :, None] * x[:, None, :]).reshape(len(places_mm), -1)


def _likeliest(value: _Array, design: _Array, bumps: int) -> tuple[_Array, _Array]:
    """Return the bumps' heights (K,) and their covariance for the size of added light that is likeliest."""
    normal, right = design.T @ design, design.T @ value
    best, heights, spread = -np.inf, np.zeros(bumps), np.zeros((bumps, bumps))
    for size in _SIZES:
        prior = np.full(len(right), _USUAL_FACTOR**-2)
        prior[:bumps] = size**-2
        matrix = normal + np.diag(prior)
        covariance: _Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
        solution: _Array = covariance @ right
        evidence = 0.5 * (float(right @ solution) - float(np.linalg.slogdet(matrix)[1]) + float(np.log(prior).sum()))
        if evidence > best:
            best, heights, spread = evidence, solution[:bumps], covariance[:bumps, :bumps]
    return heights, spread
