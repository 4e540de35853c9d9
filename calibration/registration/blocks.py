"""How well a registration fits, block of cells by block of cells, and how well each place is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from calibration.registration.displacement import Displacement
from calibration.registration.raster import Raster, box_mean
from calibration.registration.tile_comparison import MIN_SCORE, TileComparison
from experiment.chart.model import Chart

_LEAST_INFORMATION = 4.0
"""px⁻²: a block whose place has a standard error of half a pixel or more does not count as compared."""

_MEDIAN_CHI2 = 1.386
"""Median of χ² with 2 degrees of freedom."""

_AROUND_CELLS = 3
"""Cells along a neighbourhood whose own movements are averaged: one alone is known to .05 px, its noise."""

_LEAST_SHARE = 0.15
"""Of the usual cell's information, from which on a cell's movement counts as much as others': a curled rim has less."""

SYSTEMATIC_PX = 0.01
"""Standard error that no number of cells takes away: the print as predicted is not blurred quite as the frame is
(simulated frames, small charts and large)."""

_OF_OUTLINE = 4.0
"""Square of a place's error for each square of the outline's residual: two axes for the one across, and twice that, as
the map bends towards the outline's points and not towards places inside."""

_NEAR_MARKS = 24
"""Points of an outline of 640 whose mean square is that of a part of it: known to a third."""

_NOISE = 2.0
"""Times the noise to be expected of such a mean that are taken off its square: what is left is no noise."""

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Blocks:
    """How well the registration fits block by block, after the last step.

    - `centres_mm`: (B, 2) float64.
    - `score`: (B,) float64, correlation of the frame with the print as predicted, −1 … 1; 0 where nothing can be
      compared.
    - `residual_px`: (B, 2) float64, displacement that the block alone would still need.
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

    `chart`: the chart. Blank margins have nothing to compare: only tiles that hold a cell count.
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

    - `raster`: A raster on the print whose elements are cells.
    - `error_px`: (rows, columns) float64, standard error of the place of each element's middle, its length over x and
      y.
    """

    raster: Raster
    error_px: _Array

    def at(self, points_mm: npt.ArrayLike) -> _Array:
        """Return the standard error (N,) float64 px at points (N, 2) mm; beyond the field, that of its rim."""
        column, row = ((np.asarray(points_mm, dtype=np.float64) - self.raster.low_mm) / self.raster.step_mm - 0.5).T
        return np.asarray(ndimage.map_coordinates(self.error_px, [row, column], order=1, mode="nearest"))


def unfollowed_px(
    points_mm: _Array, marks_mm: _Array, residual_px: _Array, departure_px: float, reach_mm: float
) -> _Array:
    """Return the standard error (N,) float64 px of places by what the map does not follow of an outline.

    A sheet is taken to wave as much inside as its outline does, along both axes; near a part of the outline, as much as
    there. Where a part of the outline was not found, a curled corner for instance, it is taken to lie as far from a
    plane seen through a lens as the sheet does elsewhere.

    `points_mm`: (N, 2) float64. `marks_mm`, `residual_px`: (M, 2) float64, points of the outline, a rectangle, and how
    far from the map they are seen, across it.
    """
    off2 = (residual_px**2).sum(axis=1)
    far, near = cKDTree(marks_mm).query(points_mm, k=min(_NEAR_MARKS, len(off2)))
    far, near = np.reshape(far, (len(points_mm), -1)), np.reshape(near, (len(points_mm), -1))
    here = np.where(far[:, 0] <= reach_mm, off2[near].mean(axis=1), 0.0)
    squared = _OF_OUTLINE * np.maximum(here, off2.mean())
    low, high = marks_mm.min(axis=0), marks_mm.max(axis=0)
    # Points at a corner may be of either side, and each tells of one direction alone.
    on = (marks_mm - low < reach_mm / 4) | (high - marks_mm < reach_mm / 4)
    for axis in (0, 1):
        for end in (low[axis], high[axis]):
            side = marks_mm[(np.abs(marks_mm[:, axis] - end) < reach_mm / 4) & ~on[:, 1 - axis]]
            lost = cKDTree(side).query(points_mm)[0] > np.abs(points_mm[:, axis] - end) + reach_mm
            squared = np.where(lost, np.maximum(squared, departure_px**2), squared)
    return np.sqrt(squared)


def place_errors(
    comparison: TileComparison,
    raster: Raster,
    per_cell: int,
    displacement: Displacement,
    anchors: tuple[_Array, _Array],
    systematic_px: _Array | float = SYSTEMATIC_PX,
    alike: bool = False,
) -> PlaceErrors:
    """Return how well places are known: what scatter leaves open, and what the cells still ask for.

    The first is the error of the smooth displacement's fit, its measurements taken to scatter as they are found to; it
    grows where nothing was compared. The second is what a displacement cannot follow, or has not: folds, a curled edge.
    In simulated rooms with waves, curl and dog-ears 99 % of a whole chart's cells lie within three standard errors,
    98 % of a chart of 512 cells.

    `anchors`: (N, 2) mm and (N, 2, 2) px⁻², places that fix the map besides cells, and their information.
    `systematic_px`: standard error besides, at all tiles' middles or (N,) at each.
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
    if alike:
        noise = 2 * scatter * (around(weight / np.sqrt(np.maximum(strength, 1e-6))) / total) ** 2
    else:
        noise = 2 * scatter * around(weight**2 / np.maximum(strength, 1e-6)) / (_AROUND_CELLS * total) ** 2
    # In the margin and beside tags it would be one cell's noise.
    asked[total < 0.5 * most] = 0.0
    # What a displacement cannot follow swings about it: next to where it shows it may be hidden.
    asked = ndimage.maximum_filter(np.maximum(asked - _NOISE * noise, 0.0), _AROUND_CELLS)
    cells = Raster(raster.low_mm, raster.step_mm * per_cell, shape)
    return PlaceErrors(cells, np.sqrt((fitted**2 + np.square(systematic_px)).reshape(shape) + asked))
