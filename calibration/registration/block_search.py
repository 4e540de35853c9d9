"""Blocks of cells found where they are, by correlation, up to one and a half cells away from where a map has them.

Without this first step the fine comparison (`calibration.registration.tile_comparison`) locks onto the neighbouring
cell where the sheet waves: 15 px off for a wave of 6 mm, in simulated frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from calibration.registration.raster import Raster, tiles

_LEAST_SCORE, _LEAST_SCORE_OF_FEW = 0.3, 0.5
"""Correlation below which a block does not count; other cells than the chart's give about 0, but for chance, which in
blocks of few cells reaches .4."""

_FEW_CELLS = 64
"""Cells from which on a block has not few."""

_NEIGHBOUR_BLOCKS = 1.6
"""Blocks that are nearer, in units of their spacing, are neighbours: the eight around."""

_MOST_DISAGREEMENT = 0.6
"""Cells that a block may move otherwise than its neighbours: more is the neighbouring cell."""

_MOVE_SIGMA_CELLS = 0.02
"""Standard error of a block's place, in cells: a tenth of an element of the coarse raster, 0.2 px of cells of 10 px
(simulated frames)."""

_Float = npt.NDArray[np.float32]
_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FoundBlocks:
    """Where blocks of cells were found.

    - `centres_mm`: (B, 2) float64, where the map has them, on the print.
    - `moves_mm`: (B, 2) float64, how far from there they were found, on the print.
    - `score`: (B,) float64, correlation with the print, −1 … 1.
    - `least_score`: below it a block does not count.
    """

    centres_mm: _Array
    moves_mm: _Array
    score: _Array
    least_score: float = _LEAST_SCORE

    def information(self, moves_px: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
        """Return the inverse covariance (B, 2, 2) float64 px⁻² of the blocks' places.

        `moves_px`: (B, 2) the moves in the frame. `spacing_mm`: (2,) distance of blocks in x and y.
        """
        score = np.where(self.score > self.least_score, self.score, 0.0)
        weight = _weights(self.centres_mm, moves_px, score, spacing_mm, cell_px)
        return (weight / (_MOVE_SIGMA_CELLS * cell_px) ** 2)[:, None, None] * np.eye(2)


def find_blocks(
    raster: Raster, expected: _Float, seen: _Float, there: _Mask, size: int, reach: int, cells: int
) -> FoundBlocks:
    """Return where square blocks of the print are found in a rectified frame, by normalised correlation.

    `raster`: the raster (H, W). `expected`, `seen`: (H, W, 3) float32 counts, the print as it should be seen and the
    frame. `there`: (H, W) bool, where the frame exists; blocks beyond are left out.
    """
    # Square roots keep a bright light's gradient from deciding; noise is even after it too (Anscombe 1948).
    expected, seen = (np.sqrt(np.maximum(picture, 0)) for picture in (expected, seen))
    centres: list[_Array] = []
    moves: list[_Array] = []
    scores: list[float] = []
    for rows, columns in tiles(raster.shape, size, reach):
        if not there[rows, columns].all():
            continue
        wide = np.s_[rows.start - reach : rows.stop + reach, columns.start - reach : columns.stop + reach]
        match = cv2.matchTemplate(seen[wide], expected[rows, columns], cv2.TM_CCOEFF_NORMED)
        score, move = _peak(np.nan_to_num(np.asarray(match, dtype=np.float64)))
        centres.append(raster.point(0.5 * (columns.start + columns.stop), 0.5 * (rows.start + rows.stop)))
        moves.append(move - reach)
        scores.append(score)
    return FoundBlocks(
        np.array(centres).reshape(-1, 2),
        np.array(moves).reshape(-1, 2) * raster.step_mm,
        np.array(scores),
        _LEAST_SCORE if cells >= _FEW_CELLS else _LEAST_SCORE_OF_FEW,
    )


def _peak(match: _Array) -> tuple[float, _Array]:
    """Return the height and place (x, y) of a correlation's peak, by a parabola through its neighbours."""
    row, column = np.unravel_index(int(np.argmax(match)), match.shape)
    place = np.array([column, row], dtype=np.float64)
    for axis, (at, length) in enumerate(((int(column), match.shape[1]), (int(row), match.shape[0]))):
        if 0 < at < length - 1:
            line = match[row, at - 1 : at + 2] if axis == 0 else match[at - 1 : at + 2, column]
            bend = line[0] - 2 * line[1] + line[2]
            if bend < 0:
                place[axis] += 0.5 * (line[0] - line[2]) / bend
    return float(match[row, column]), place


def _weights(centres_mm: _Array, moves_px: _Array, score: _Array, spacing_mm: _Array, cell_px: float) -> _Array:
    """Return the weight (B,) of each block: its score squared, 0 where it is 0 or the neighbours disagree."""
    apart = np.abs(centres_mm[:, None] - centres_mm[None]) / spacing_mm
    near = np.asarray((apart < _NEIGHBOUR_BLOCKS).all(axis=-1))
    weight = score**2
    for index in range(len(score)):
        around = near[index] & (score > 0)
        usual = np.median(moves_px[around], axis=0) if around.sum() >= 3 else moves_px[index]
        if np.linalg.norm(moves_px[index] - usual) > _MOST_DISAGREEMENT * cell_px:
            weight[index] = 0.0
    return weight
