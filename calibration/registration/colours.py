"""The camera RGB of printed codes, fitted on the frame itself, and whether cells have the chart's colours by it.

Neither print nor light need be known for the model. Cells that do not have their colours are covered or damaged, or the
map has slipped. Counts above black, camera RGB; codes 0 … 255; millimetres on the page.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from experiment.chart.model import Chart
from experiment.measures.least_squares import code_powers, least_squares
from foundation.robust import MAD_TO_SIGMA, huber_weights, robust_sigma

MIN_COLOURS = 64  # Colours below which none is called mismatched: a model fitted on fewer is no judge of one of them

# Usual deviations of a cell from its model beyond which it is mismatched: the model's errors are no normal noise.
_MISMATCH_SIGMA = 10.0

_MISMATCH_SHARE = 0.08  # Of paper white: the model's own errors at the gamut's corners stay below

_NEIGHBOURS = 13  # A cell and the twelve within two cells of it

# Share of mismatched neighbours from which on a cell is taken for covered with them (judgement).
_MISMATCH_NEIGHBOURS = 0.35

_SLIP_CELLS = 16  # Cells along a part of the field that is tested for a slip, at most

_SLIP = 0.5  # Cells by which a part must seem to be displaced: half the way to the next

_SLIP_SIGMAS = 6.0  # Standard errors that a slip must have, too

_PART_WORTH = 8  # Independent measurements that a part counts for: the misfit of the colours is alike over many cells

# Of paper white: what the model of the colours leaves, and what noise may add to it at most.
_COLOUR_MISFIT, _MOST_NOISE = 0.003, 0.01

_MOST_MISFIT = 20.0  # Usual errors beyond which a cell's error counts no more

# Standard deviation of normal values over the median size of their neighbours' differences: 1 / (√2 Φ⁻¹(3/4)).
_DIFFERENCE_TO_SIGMA = 1.0484

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


def mismatched(seen: _Array, expected: _Array, paper: _Array, chart: Chart) -> _Mask:
    """Return which cells have not nearly the colour that the model expects: covered, damaged or misprinted ones.

    `seen`, `expected`: (C, 3) colours of the chart's cells, and perhaps (R, 3) of references after them, which set the
    usual error; NaN outside the frame. `paper`: (3,) of bare paper. Returns (C,) bool, in the chart's order, the cells
    amid mismatched ones included.
    """
    count = chart.colour_count
    if count < MIN_COLOURS:
        return np.zeros(count, dtype=np.bool_)
    residual = np.abs(seen - expected)
    usual = MAD_TO_SIGMA * np.nanmedian(residual, axis=0)
    alone = ((residual > _MISMATCH_SIGMA * usual) & (residual > _MISMATCH_SHARE * paper)).any(axis=1)
    return _with_neighbours(np.asarray(alone)[:count], chart.centres_mm / np.array(chart.cell_mm))


def _with_neighbours(cells: _Mask, centres: _Array) -> _Mask:
    """Return mismatched cells (N,) and the cells amid them, which a cover of their own colour would hide.

    `centres` (N, 2) in cells.
    """
    near = cKDTree(centres).query(centres, k=min(_NEIGHBOURS, len(centres)))[1]
    share = cells[np.asarray(near).reshape(len(centres), -1)].mean(axis=1)
    return np.asarray(cells | (share > _MISMATCH_NEIGHBOURS))


def agreement(seen: _Array, expected: _Array) -> float:
    """Return the correlation of colours with those expected, the mean of the channels that carry most light.

    `seen`, `expected`: (N, 3), all finite.
    """
    light = np.median(seen, axis=0)
    used = np.flatnonzero(light >= 0.3 * light.max())
    return float(np.mean([np.corrcoef(seen[:, channel], expected[:, channel])[0, 1] for channel in used]))


def slipped_parts(
    seen: _Array,
    expected: _Array,
    paper: _Array,
    ignored: _Mask,
    place: tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]],
    shape: tuple[int, int],
) -> tuple[_Array, int]:
    """Return which parts of a grid of cells have the colours of their neighbours, and how many parts were compared.

    By the level of the colours, which the matching leaves free: seen less expected colours are fitted, part by part and
    by least squares, by what a displacement to the next cell would change.

    `seen`, `expected`: (C, 3) colours of the chart's cells. `paper`: (3,) of bare paper. `ignored`: (C,) bool, cells
    left out. `place`: row and column of each cell, (C,) each. Returns (B, 2) float64 middles of the parts that have
    slipped, column then row, in cells from the grid's corner.
    """
    rows, columns = shape
    row, column = place
    grid = np.full((2, rows + 2, columns + 2, 3), np.nan)
    for picture, colours in zip(grid, (seen, expected), strict=True):
        picture[row + 1, column + 1] = colours
    grid[0, row[ignored] + 1, column[ignored] + 1] = np.nan
    error = (grid[0] - grid[1])[1:-1, 1:-1]
    # Noise, from neighbour to neighbour, and what a model of colours leaves; a slip must not count as usual.
    noise = _DIFFERENCE_TO_SIGMA * np.nanmedian(np.abs(np.diff(error, axis=1)), axis=(0, 1))
    usual = np.hypot(np.minimum(noise, _MOST_NOISE * paper), _COLOUR_MISFIT * paper) + 1e-9
    steps = (
        (grid[1, 1:-1, 2:] - grid[1, 1:-1, :-2]) / 2 / usual,
        (grid[1, 2:, 1:-1] - grid[1, :-2, 1:-1]) / 2 / usual,
    )
    error = np.clip(error / usual, -_MOST_MISFIT, _MOST_MISFIT)
    places: list[_Array] = []
    compared = 0
    size = int(np.clip(min(rows, columns) // 2, 4, _SLIP_CELLS))
    for top in range(0, rows, size):
        for left in range(0, columns, size):
            part = np.s_[top : top + size, left : left + size]
            values = [picture[part].ravel() for picture in (*steps, error)]
            known = np.isfinite(values).all(axis=0)
            if known.sum() < size**2:
                continue
            compared += 1
            design = np.stack([one[known] for one in values[:2]], axis=1)
            gram = design.T @ design
            slip = np.linalg.solve(gram + 1e-9 * np.eye(2), design.T @ values[2][known])
            sure = np.sqrt(np.diag(gram) * _PART_WORTH / known.sum())
            if ((np.abs(slip) > _SLIP) & (np.abs(slip) * sure > _SLIP_SIGMAS)).any():
                places.append(np.array([left, top]) + size / 2)
    return np.array(places).reshape(-1, 2), compared


@dataclass(frozen=True, eq=False)
class ColourModel:
    """What camera RGB a printed code gives in one frame: a polynomial, times a smooth light over the page.

    - `coefficients`: (terms, 3) float64, counts.
    - `light`: (6, 3) float64, polynomial of second order in page coordinates −1 … 1, mean about 1.
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
            spread = max(robust_sigma(residual), 1e-9)
            weights = huber_weights(residual, spread)
        level = float((page @ field).mean())
        coefficients[:, channel], light[:, channel] = model * level, field / level
    return ColourModel(degree, coefficients, light, page_mm)
