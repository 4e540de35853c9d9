"""How well a registration fits, block of cells by block of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.chart.model import Chart
from calibration.registration.raster import Raster
from calibration.registration.tile_comparison import MIN_SCORE, TileComparison

_LEAST_INFORMATION = 4.0
"""px⁻²: a block whose place has a standard error of half a pixel or more does not count as compared."""

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
