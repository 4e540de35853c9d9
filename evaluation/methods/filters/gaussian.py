"""Gaussian derivatives of images of any size, in strips.

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

STRIP_NUMBERS = 1 << 22
"""Numbers of a strip, 16 MB of float32: a whole image of 1 megapixel, 128 rows and more of one of 45."""
_FEWEST_ROWS = 64
"""Rows of a strip at least, for images that are wider than any."""

_ALIGNMENT = 64
"""Bytes of a cache line: aligned buffers make a third of the difference between two loads and three."""


def gaussian_kernel(sigma: float, order: int) -> npt.NDArray[np.float64]:
    """Return the kernel (N,) float64 of a Gaussian's derivative, to be correlated with; N = 2⌊3σ + ½⌋ + 1.

    Normalised on the grid of pixels: order 0 sums to 1; order 1 gives 1 for the ramp x; order 2 gives 1 for x²/2 and 0
    for a constant.

    Parameters
    ----------
    sigma
        Standard deviation of the Gaussian, px, above 0.
    order
        Order of the derivative, 0, 1 or 2.

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

    Parameters
    ----------
    image
        (H, W, 3) uint16, float32 or float64, not below 0.
    order
        0, 1 or 2.
    sigma
        Scale of the Gaussian, px; 0 for none, which only order 0 allows.

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
    for top, rows in differentiated_strips(image, order, sigma, 1.0):
        found[top : top + len(rows)] = rows[:, : 3 * width].reshape(len(rows), width, 3)
    return found


def differentiated_strips(
    image: Image, order: int, sigma: float, scale: float
) -> Iterator[tuple[int, npt.NDArray[np.float32]]]:
    """Yield the Gaussian derivative of an image times `scale` in strips from top to bottom.

    Parameters
    ----------
    image
        (H, W, 3) uint16, float32 or float64, not below 0.
    order, sigma
        Of the derivative, 0 to 2, and its scale, px, above 0.
    scale
        Factor for values that float32 does not hold.

    Yields
    ------
    tuple of int and ndarray
        The number of the strip's first row; (rows, Q) float32, interleaved pixels, of which the first 3 W numbers of a
        row count. The array is written anew for the next strip.
    """
    from evaluation.methods.filters.convolution import CHUNK, GROUP, LANES, OUTPUTS, filter_columns, filter_rows

    height, width = image.shape[:2]
    flat: Any = image.reshape(height, -1)
    kernels = [gaussian_kernel(sigma, one) for one in range(3)]
    reach = len(kernels[0]) // 2
    weights = np.stack([kernel[reach:] for kernel in kernels]).astype(np.float32)
    pitch = -(-width // CHUNK) * 3 * CHUNK
    most = min(max(STRIP_NUMBERS // pitch // (order + 2), _FEWEST_ROWS), height)
    most = -(-most // GROUP) * GROUP
    lines, turned = _aligned((GROUP, pitch)), _aligned((pitch + 6 * reach, LANES))
    chunk = _aligned((order + 1, 3 * CHUNK, LANES))
    columns = _aligned((order + 1, pitch // LANES, most + 2 * reach + GROUP, LANES))
    out = _aligned((most, pitch))
    lines[:, 3 * width :] = 0
    done = 0  # rows of the image that are filtered along x
    for top in range(0, height, most):
        rows = min(most, height - top)
        start = top - reach  # row of the image that row 0 of `columns` holds
        if top:
            kept = done - start
            columns[:, :, :kept] = columns[:, :, most : most + kept].copy()
        last = min(height, top + rows + reach)
        if done < last:
            done = filter_rows(flat, scale, done, last, weights, order, lines, turned, chunk, columns, done - start)
        if not top:
            columns[:, :, :reach] = columns[:, :, reach : reach + 1]
        # Beyond the last row there are copies of it, down to what the last four rows need.
        below = -(-rows // OUTPUTS) * OUTPUTS + 2 * reach
        if done - start < below:
            columns[:, :, done - start : below] = columns[:, :, done - start - 1, None]
        filter_columns(columns, weights, order, rows, out)
        yield top, out[:rows]


def _aligned(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return an array of float32 that begins at a cache line."""
    spare = _ALIGNMENT // 4
    memory = np.empty(math.prod(shape) + spare, dtype=np.float32)
    start = -memory.ctypes.data // 4 % spare
    return memory[start : start + math.prod(shape)].reshape(shape)
