"""How well a registration fits, block of cells by block of cells, and how well each place is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from acquisition.chart.model import Chart
from calibration.registration.displacement import Displacement
from calibration.registration.raster import Raster, box_mean
from calibration.registration.tile_comparison import MIN_SCORE, TileComparison

_LEAST_INFORMATION = 4.0
"""px⁻²: a block whose place has a standard error of half a pixel or more does not count as compared."""

_MEDIAN_CHI2 = 1.386
"""Median of χ² with 2 degrees of freedom."""

_AROUND_CELLS = 3
"""Cells along a neighbourhood whose own movements are averaged: one alone is known to .05 px, its noise."""

_LEAST_SHARE = 0.15
"""Of the usual cell's information, from which on a cell's movement counts as much as others': a curled rim has less."""

_SYSTEMATIC_PX = 0.01
"""Standard error that no number of cells takes away: the print as predicted is not blurred quite as the frame is
(simulated frames, small charts and large)."""

_NOISE = 2.0
"""Times the noise to be expected of such a mean that are taken off its square: what is left is no noise."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Blocks:
    """How well the registration fits block by block, after the last step.

    Attributes
    ----------
    centres_mm
        (B, 2) float64.
    score
        (B,) float64, correlation of the frame with the print as predicted, −1 … 1; 0 where nothing can be compared.
    residual_px
        (B, 2) float64, displacement that the block alone would still need.
    """

    centres_mm: _Array
    score: _Array
    residual_px: _Array

    @property
    def good(self) -> _Mask:
        """(B,) bool, whether a block was used."""
        return self.score >= MIN_SCORE


def fit_blocks(
    comparison: TileComparison, raster: Raster, per_cell: int, chart: Chart, block_cells: int, all_known: bool
) -> Blocks:
    """Return how each block of cells fits, and by how much it alone would move.

    Parameters
    ----------
    comparison
        The raster's tiles of one cell each, as compared after the last step.
    raster, per_cell
        The raster, and its elements along a cell's side.
    chart
        The chart. Blank margins have nothing to compare: only tiles that hold a cell count.
    block_cells
        Cells along a block's side, about.
    all_known
        Whether the score of a block whose place is hardly determined is kept; else it is 0.
    """
    rows, columns = raster.tiles(per_cell)
    across, down = (max(1, count // block_cells) for count in (columns, rows))
    of_column = np.minimum(np.arange(columns) * across // columns, across - 1)
    of_row = np.minimum(np.arange(rows) * down // rows, down - 1)
    block = (of_row[:, None] * across + of_column[None, :]).ravel()
    count = across * down
    matrix, right = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(matrix, block, comparison.information)
    np.add.at(right, block, comparison.pull)
    column, row = np.floor((chart.centres_mm - raster.low_mm) / np.array(chart.cell_mm)).astype(int).T
    occupied = np.zeros((rows, columns))
    occupied[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = 1
    holds = occupied.ravel()
    cells = np.bincount(block, holds, count)
    used = cells > 0
    divisor = np.maximum(cells, 1)
    points = comparison.points_mm
    centres = np.stack([np.bincount(block, points[:, axis] * holds, count) / divisor for axis in (0, 1)], axis=-1)
    mean = np.bincount(block, comparison.score * holds, count) / divisor
    known = np.linalg.eigvalsh(matrix)[:, 0] > _LEAST_INFORMATION
    residual = np.zeros((count, 2))
    residual[known] = np.linalg.solve(matrix[known], right[known, :, None])[..., 0]
    return Blocks(centres[used], np.where(known | all_known, mean, 0.0)[used], residual[used])


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """How well the places of a registration are known.

    Attributes
    ----------
    raster
        A raster on the print whose elements are cells.
    error_px
        (rows, columns) float64, standard error of the place of each element's middle, its length over x and y.
    """

    raster: Raster
    error_px: _Array

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard error (N,) float64 px at points (N, 2) mm; beyond the field, that of its rim."""
        column, row = ((np.asarray(points_mm, dtype=np.float64) - self.raster.low_mm) / self.raster.step_mm - 0.5).T
        return np.asarray(ndimage.map_coordinates(self.error_px, [row, column], order=1, mode="nearest"))


def place_errors(
    comparison: TileComparison,
    raster: Raster,
    per_cell: int,
    displacement: Displacement,
    anchors: tuple[_Array, _Array],
) -> PlaceErrors:
    """Return how well places are known: what scatter leaves open, and what the cells still ask for.

    The first is the error of the smooth displacement's fit, its measurements taken to scatter as they are found to; it
    grows where nothing was compared. The second is what a displacement cannot follow, or has not: folds, a curled edge.
    In simulated rooms with waves, curl and dog-ears 99 % of a whole chart's cells lie within three standard errors,
    98 % of a chart of 512 cells. Too large where a smooth order of colours leaves places open that folds of it fix.

    Parameters
    ----------
    comparison
        The raster's tiles of one cell each, as compared after the last step.
    raster, per_cell
        The raster, and its elements along a cell's side.
    displacement
        As fitted.
    anchors
        (N, 2) mm and (N, 2, 2) px⁻², places that fix the map besides cells, and their information.
    """
    shape, information = raster.tiles(per_cell), comparison.information
    known = np.linalg.eigvalsh(information)[:, 0] > _LEAST_INFORMATION
    own = np.zeros_like(comparison.pull)
    own[known] = np.linalg.solve(information[known], comparison.pull[known, :, None])[..., 0]
    chi2 = (own * comparison.pull).sum(axis=1)[known]
    scatter = max(1.0, float(np.median(chi2)) / _MEDIAN_CHI2) if len(chi2) else 1.0
    points = comparison.points_mm
    fitted = displacement.errors_px(
        np.concatenate([points, anchors[0]]), np.concatenate([information / scatter, anchors[1]]), points
    )
    # Cells whose edges differ strongly would outvote those beside them, those that hardly differ would bring noise.
    strength = np.zeros(len(points))
    strength[known] = np.linalg.eigvalsh(information[known])[:, 0]
    most = _LEAST_SHARE * float(np.median(strength[known])) if len(chi2) else 0.0
    weight = np.minimum(strength, most)

    def around(values: _Array) -> _Array:
        return np.asarray(box_mean(values.reshape(shape), _AROUND_CELLS), dtype=np.float64)

    total = np.maximum(around(weight), 1e-6)
    asked = (around(weight * own[:, 0]) / total) ** 2 + (around(weight * own[:, 1]) / total) ** 2
    noise = 2 * scatter * around(weight**2 / np.maximum(strength, 1e-6)) / (_AROUND_CELLS * total) ** 2
    # In the margin and beside tags it would be one cell's noise.
    asked[total < 0.5 * most] = 0.0
    # What a displacement cannot follow swings about it: next to where it shows it may be hidden.
    asked = ndimage.maximum_filter(np.maximum(asked - _NOISE * noise, 0.0), _AROUND_CELLS)
    cells = Raster(raster.low_mm, raster.step_mm * per_cell, shape)
    return PlaceErrors(cells, np.sqrt(fitted.reshape(shape) ** 2 + asked + _SYSTEMATIC_PX**2))
