"""Gaussian derivatives of images of any size, in tiles.

Filters follow the program of the authors of the Gray-Edge framework (J. van de Weijer et al., 2007): Gaussian kernels
cut at 3σ, normalised on the grid of pixels, edges continued by their last pixel, order 2 as √(f_xx² + 4 f_xy² + f_yy²).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image

TILE_WIDTH = 256
"""Pixels of a tile's width at most, a multiple of 16: narrower, and more of a row is neighbours of the tile."""
TILE_ROWS = 64
"""Rows of a tile, a multiple of 16: with the widest standard kernels a tile's intermediate results take 0.8 MB at most,
which a core's cache holds."""

_ALIGNMENT = 64
"""Bytes of a cache line: aligned buffers make a third of the difference between two loads and three."""


def gaussian_kernel(sigma: float, order: int) -> npt.NDArray[np.float64]:
    """Return the kernel (N,) float64 of a Gaussian's derivative, to be correlated with; N = 2⌊3σ + ½⌋ + 1.

    Normalised on the grid of pixels: order 0 sums to 1; order 1 gives 1 for the ramp x; order 2 gives 1 for x²/2 and 0
    for a constant.

    `sigma`: standard deviation of the Gaussian, px, above 0.

    Examples
    --------
    >>> gaussian_kernel(0.5, 1).round(3)
    array([-0.002, -0.495,  0.   ,  0.495,  0.002])
    """
    reach = math.floor(3 * sigma + 0.5)
    x = np.arange(-reach, reach + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * sigma**2))
    if order == 0:
        return bell / bell.sum()
    if order == 1:
        slope = x * bell
        return slope / (x * slope).sum()
    bend = (x**2 / sigma**4 - 1 / sigma**2) * bell
    bend -= bend.mean()
    return bend / (0.5 * x**2 * bend).sum()


def differentiate(image: Image, order: int, sigma: float) -> npt.NDArray[np.float32]:
    """Return the size of an image's Gaussian derivative, (H, W, 3) float32, channel by channel.

    Order 0 is the smoothed image, order 1 the gradient's length, order 2 √(f_xx² + 4 f_xy² + f_yy²).

    `image`: (H, W, 3) uint16, float32 or float64, not below 0. `sigma`: scale of the Gaussian, px; 0 for none, which
    only order 0 allows.

    Examples
    --------
    >>> ramp = np.full((1, 40, 3), 2, np.float32).cumsum(axis=1)
    >>> differentiate(ramp, order=1, sigma=1.0)[0, 20].round(3)
    array([2., 2., 2.], dtype=float32)
    """
    if not sigma:
        return np.asarray(image, dtype=np.float32)
    height, width = image.shape[:2]
    found = np.empty((height, width, 3), dtype=np.float32)
    for top, left, rows in differentiated_tiles(image, order, sigma, 1.0):
        put_tile(found, top, left, rows)
    return found


def put_tile(found: npt.NDArray[np.float32], top: int, left: int, tile: npt.NDArray[np.float32]) -> None:
    """Write a tile of `differentiated_tiles`, (rows, Q) float32, to its place in an image (H, W, 3) float32."""
    wide = min(tile.shape[1] // 3, found.shape[1] - left)
    found[top : top + len(tile), left : left + wide] = tile[:, : 3 * wide].reshape(len(tile), wide, 3)


def differentiated_tiles(
    image: Image, order: int, sigma: float, scale: float
) -> Iterator[tuple[int, int, npt.NDArray[np.float32]]]:
    """Yield the Gaussian derivative of an image times `scale` in tiles, from top to bottom and then from left to right.

    `image`: (H, W, 3) uint16, float32 or float64, not below 0. `order`, `sigma`: of the derivative, 0 to 2, and its
    scale, px, above 0. `scale`: factor for values that float32 does not hold. Yields the tile's first row and pixel;
    (rows, Q) float32, interleaved pixels, of which those within the image count. The array is written anew for the next
    tile.
    """
    from evaluation.methods.filters.convolution import CHUNK, GROUP, LANES, STRETCH, filter_columns, filter_rows

    height, width = image.shape[:2]
    flat: Any = image.reshape(height, -1)
    kernels = [gaussian_kernel(sigma, one) for one in range(3)]
    reach = len(kernels[0]) // 2
    weights = np.stack([kernel[reach:] for kernel in kernels]).astype(np.float32)
    across = -(-width // TILE_WIDTH)  # tiles of equal width
    wide = -(-width // (across * CHUNK)) * CHUNK
    pitch = 3 * wide
    most = min(TILE_ROWS, -(-height // GROUP) * GROUP)
    lines, turned = np.zeros((GROUP, STRETCH), np.float32), _aligned((pitch + 6 * reach + LANES, LANES))
    chunk = _aligned((order + 1, 3 * CHUNK, LANES))
    columns = _aligned((order + 1, pitch // LANES, most + 2 * reach + GROUP, LANES))
    out = _aligned((most, pitch))
    for left in range(0, width, wide):
        done = 0
        for top in range(0, height, most):
            done = filter_rows(flat, scale, top, left, most, done, weights, order, lines, turned, chunk, columns)
            filter_columns(columns, weights, order, most, out)
            yield top, left, out[: height - top]


def _aligned(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return an array of float32 that begins at a cache line."""
    spare = _ALIGNMENT // 4
    memory = np.empty(math.prod(shape) + spare, dtype=np.float32)
    start = -memory.ctypes.data // 4 % spare
    return memory[start : start + math.prod(shape)].reshape(shape)
