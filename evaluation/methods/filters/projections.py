"""Compiled loops that find the pixels of an image with the least and the greatest projections on a direction.

Projections are counted in `BINS` equal bins from 0 to the greatest possible one. What is sought is first bracketed by
bins, then summed and collected in one pass, in which a chunk of projections is found before any of them is judged:
both loops then have no branch, the first is made of vectors, and only the few pixels at either end are looked at one
by one. An image is (H, W, 3) uint16, float32 or float64; `free` is (H, W) bool, True where a pixel may be used, or
(0, 0) where every one may be.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled

if TYPE_CHECKING:
    from evaluation.scene import Image

BINS = 4096
"""Of the histogram of projections: one that holds a limit has some thousand pixels of 18 million."""
CHUNK = 256
"""Pixels whose bins are found at a time, in the nearest cache."""
_STRIDE = 5
"""Pixels by which the counted ones move on from row to row: no column is preferred where every 16th pixel counts."""


@compiled
def count_projections(
    image: Image, free: npt.NDArray[np.bool_], direction: npt.NDArray[np.float64], step: float, every: int
) -> npt.NDArray[np.int64]:
    """Return (BINS,) int64, the histogram of the projections of every so manieth pixel on a direction (3,) float64.

    `step` is bins a unit of projection.
    """
    counts = np.zeros(BINS, np.int64)
    for y in range(image.shape[0]):
        for x in range(_STRIDE * y % every, image.shape[1], every):
            if free.size and not free[y, x]:
                continue
            along = image[y, x, 0] * direction[0] + image[y, x, 1] * direction[1] + image[y, x, 2] * direction[2]
            counts[min(BINS - 1, int(along * step))] += 1
    return counts


@compiled
def sum_outer_bins(
    image: Image,
    free: npt.NDArray[np.bool_],
    direction: npt.NDArray[np.float64],
    step: float,
    brackets: npt.NDArray[np.int64],
    bordering: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], int, int, int]:
    """Sum and count the pixels of bins outside of two brackets, and collect those of bins within.

    `image`, `free`: (H, W, 3) uint16, float32 or float64; (H, W) or (0, 0) bool, see above. `direction`, `step`: (3,)
    float64, and bins a unit of projection; as for `count_projections`. `brackets`: (4,) int64: the first and the last
    bin of the lower bracket, then of the upper one; they may overlap. `bordering`: (N, 4) float64, written: red, green,
    blue and the projection of pixels of the brackets, in reading order. Returns (3, 3) float64, the sum of x xᵀ over
    the pixels below the lower bracket and above the upper one; how many these are below and above; how many lie within
    the brackets, of which the first N are written.
    """
    total = np.zeros((3, 3), np.float64)
    bins, kept = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    first, low, high, last = brackets
    below, above, inside = 0, 0, 0
    width = image.shape[1]
    flat = image.reshape(-1)
    for y in range(image.shape[0]):
        a, b, c, ab, ac, bc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for left in range(0, width, CHUNK):
            length = min(CHUNK, width - left)
            row = flat[3 * (y * width + left) : 3 * (y * width + left + length)]
            for j in range(length):
                along = row[3 * j] * direction[0] + row[3 * j + 1] * direction[1] + row[3 * j + 2] * direction[2]
                bins[j] = min(BINS - 1, np.int32(along * step))
            found = 0
            for j in range(length):
                kept[found] = j
                found += (bins[j] <= low) | (bins[j] >= high)
            for at in range(found):
                j = kept[at]
                if free.size and not free[y, left + j]:
                    continue
                red, green, blue = np.float64(row[3 * j]), np.float64(row[3 * j + 1]), np.float64(row[3 * j + 2])
                if first <= bins[j] <= last:
                    if inside < bordering.shape[0]:
                        bordering[inside, 0] = red
                        bordering[inside, 1] = green
                        bordering[inside, 2] = blue
                        bordering[inside, 3] = red * direction[0] + green * direction[1] + blue * direction[2]
                    inside += 1
                    continue
                a += red * red
                b += green * green
                c += blue * blue
                ab += red * green
                ac += red * blue
                bc += green * blue
                if bins[j] < first:
                    below += 1
                else:
                    above += 1
        total += np.array([[a, ab, ac], [ab, b, bc], [ac, bc, c]])
    return total, below, above, inside
