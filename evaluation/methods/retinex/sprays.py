"""Compiled loops over random sprays and over patches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

if TYPE_CHECKING:
    from evaluation.scene import Image


@compiled
def spray_maxima(
    image: Image,
    free: npt.NDArray[np.bool_],
    step: int,
    offsets: npt.NDArray[np.int64],
    chosen: npt.NDArray[np.int64],
) -> npt.NDArray[np.float64]:
    """Return the maxima of each channel over the spray around each point of a grid, (R, C, 3) float64.

    `image`: (H, W, 3) uint16, float32 or float64. `free`: (H, W) bool, True where a pixel may be used, or (0, 0) where
    every one may be. `offsets`: (sprays, N, 2) int64, rows and columns from the point; those that lead out of the image
    are left out. `chosen`: (R, C) int64, the spray of each point.
    """
    height, width = image.shape[:2]
    maxima = np.zeros((chosen.shape[0], chosen.shape[1], 3), np.float64)
    for row in range(chosen.shape[0]):
        for column in range(chosen.shape[1]):
            spray = chosen[row, column]
            for at in range(offsets.shape[1]):
                y, x = row * step + offsets[spray, at, 0], column * step + offsets[spray, at, 1]
                if y < 0 or x < 0 or y >= height or x >= width or (free.size and not free[y, x]):
                    continue
                for channel in range(3):
                    maxima[row, column, channel] = max(maxima[row, column, channel], image[y, x, channel])
    return maxima


@compiled
def patch_sums(
    image: Image, free: npt.NDArray[np.bool_], rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the sums and the maxima of each channel over the usable pixels of patches, (R, C, 3) float64 each.

    `image`: (H, W, 3) uint16, float32 or float64. `free`: (H, W) bool, True where a pixel may be used, or (0, 0) where
    every one may be. `rows`, `columns`: (R + 1,) and (C + 1,) int64, where the patches begin, and the end of the last.
    """
    shape = (rows.size - 1, columns.size - 1, 3)
    sums, maxima = np.zeros(shape, np.float64), np.zeros(shape, np.float64)
    for i in range(shape[0]):
        for y in range(rows[i], rows[i + 1]):
            for j in range(shape[1]):
                for x in range(columns[j], columns[j + 1]):
                    if free.size and not free[y, x]:
                        continue
                    for channel in range(3):
                        value = float(image[y, x, channel])
                        sums[i, j, channel] += value
                        maxima[i, j, channel] = max(maxima[i, j, channel], value)
    return sums, maxima
