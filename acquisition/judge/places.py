"""Where a frame is measured: tiles over all of it, strips of its rows, and a sample of its photosites.

Rules that hold inside:

- Every photosite of the visible area counts towards one tile and one strip, so that nothing escapes between places.
- Positions are 2×2 blocks of the mosaic ("half-size pixels"); the four sums of a place are kept apart by the position
  in the block, which is its colour.
- Nothing here knows black, light or chart: sums of counts, as the camera stored them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

TILE_COLUMNS, TILE_ROWS = 24, 16
"""Tiles over a frame of 3 : 2: 384 squares of 108 px on an EOS 550D, each about a hundred cells of the chart, so that
their mean is known to 0.1 % and a hand covers several."""

SEGMENTS = 4
"""Strips along a row: 650 px on an EOS 550D, 65 cells, whose mean differs from row of cells to row of cells."""

SAMPLES = 8192
"""Blocks whose photosites are kept to compare the noise of two frames: correlations are then known to 1 %."""


@dataclass(frozen=True)
class Places:
    """The places of a frame of `rows` × `columns` blocks."""

    rows: int
    columns: int

    @cached_property
    def x_edges(self) -> npt.NDArray[np.int64]:
        """(25,) columns of blocks at which the tiles begin, and the end."""
        return np.linspace(0, self.columns, TILE_COLUMNS + 1).round().astype(np.int64)

    @cached_property
    def y_edges(self) -> npt.NDArray[np.int64]:
        """(17,) rows of blocks at which the tiles begin, and the end."""
        return np.linspace(0, self.rows, TILE_ROWS + 1).round().astype(np.int64)

    @cached_property
    def tile_blocks(self) -> npt.NDArray[np.float64]:
        """(384, 1) float64, blocks in each tile, row by row."""
        return np.outer(np.diff(self.y_edges), np.diff(self.x_edges)).reshape(-1, 1).astype(np.float64)

    @cached_property
    def sampled(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Rows and columns (`SAMPLES`,) of blocks spread evenly, and without a lattice, over the frame."""
        chosen = np.random.default_rng(7).choice(self.rows * self.columns, min(SAMPLES, self.rows * self.columns))
        chosen.sort()
        return chosen // self.columns, chosen % self.columns

    def tile_box(self, tile: int) -> tuple[int, int, int, int]:
        """Return left, top, right, bottom (exclusive) of a tile, in blocks."""
        row, column = divmod(tile, TILE_COLUMNS)
        x, y = self.x_edges, self.y_edges
        return int(x[column]), int(y[row]), int(x[column + 1]), int(y[row + 1])


@dataclass(frozen=True, eq=False)
class Sums:
    """Mean counts at the places of a frame.

    Attributes
    ----------
    tiles
        (384, 4) float64, mean count of each tile, row by row, for the four positions of the block, row by row.
    strips
        (rows, 4, 4) float64, of each row of blocks and segment, likewise.
    clipped, empty
        Photosites at or above the clipping level, and those that no light and no darkness gives.
    """

    tiles: npt.NDArray[np.float64]
    strips: npt.NDArray[np.float64]
    clipped: int
    empty: int


def sum_counts(counts: npt.NDArray[np.uint16], places: Places, clipping: float, floor: float) -> Sums:
    """Return the mean counts at all places, in one pass.

    Parameters
    ----------
    counts
        (H, W) uint16, the visible area.
    places
        Of a frame of H // 2 × W // 2 blocks.
    clipping
        Counts from here on are clipped.
    floor
        Counts below are none that a sensor gives: a frame's missing part is filled with zeros.
    """
    sums = np.zeros((places.rows, TILE_COLUMNS, 4), dtype=np.int64)
    top = min(int(np.ceil(clipping)), 65535)
    tallies = np.zeros(2, dtype=np.int64)
    _sum_rows(counts, places.x_edges, top, max(int(floor), 0), sums, tallies)
    tiles = np.add.reduceat(sums, places.y_edges[:-1], axis=0).reshape(-1, 4) / places.tile_blocks
    ends = np.arange(0, TILE_COLUMNS, TILE_COLUMNS // SEGMENTS)
    widths = np.add.reduceat(np.diff(places.x_edges), ends)
    strips = np.add.reduceat(sums, ends, axis=1) / widths[:, None]
    return Sums(tiles, strips, int(tallies[0]), int(tallies[1]))


@compiled
def _sum_rows(
    counts: npt.NDArray[np.uint16],
    x_edges: npt.NDArray[np.int64],
    top: int,
    floor: int,
    sums: npt.NDArray[np.int64],
    tallies: npt.NDArray[np.int64],
) -> None:
    """Write sums (rows, tiles, 4) int64 of counts (H, W) between column edges; tally (2,) clipped and empty."""
    clipped, empty = 0, 0
    for row in range(sums.shape[0]):
        for part in range(2):
            line = counts[2 * row + part]
            for tile in range(sums.shape[1]):
                left, right = np.uint32(0), np.uint32(0)
                high, low = np.uint32(0), np.uint32(0)
                for block in range(x_edges[tile], x_edges[tile + 1]):
                    one, two = line[2 * block], line[2 * block + 1]
                    left += np.uint32(one)
                    right += np.uint32(two)
                    high += np.uint32(one >= top) + np.uint32(two >= top)
                    low += np.uint32(one < floor) + np.uint32(two < floor)
                sums[row, tile, 2 * part] = left
                sums[row, tile, 2 * part + 1] = right
                clipped += high
                empty += low
    tallies[0] = clipped
    tallies[1] = empty
