"""Gaussian derivatives of images of any size, in strips.

Filters follow the program of the authors of the Gray-Edge framework (J. van de Weijer et al., 2007): Gaussian kernels
cut at 3σ, normalised on the grid of pixels, edges continued by their last pixel, order 2 as √(f_xx² + 4 f_xy² + f_yy²).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from evaluation.scene import Image

STRIP_NUMBERS = 1 << 22
"""Numbers of a strip, 16 MB of float32: a whole image of 1 megapixel, 128 rows and more of one of 45."""
_TILE_ROWS = 500
"""Rows of intermediate results, of all that an order needs, that fit a core's cache beside each other (0.8 MB)."""
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
    from evaluation.methods.filters.convolution import BLOCK, TILE, filter_strip

    height, width = image.shape[:2]
    kernels = [gaussian_kernel(sigma, one) for one in range(3)]
    reach = len(kernels[0]) // 2
    weights = np.stack([kernel[reach:] for kernel in kernels]).astype(np.float32)
    pitch = -(-3 * width // BLOCK) * BLOCK
    most = min(_TILE_ROWS // (order + 1) - 2 * reach, STRIP_NUMBERS // (3 * width))
    most = min(max(most, _FEWEST_ROWS), height)
    strip = np.zeros((most + 2 * reach, pitch + 6 * reach), dtype=np.float32)
    scratch = _aligned((order + 1, most + 2 * reach, TILE))
    out = _aligned((most, pitch))
    for top in range(0, height, most):
        rows = min(most, height - top)
        first, last = max(0, top - reach), min(height, top + rows + reach)
        body = strip[: rows + 2 * reach, 3 * reach : 3 * (reach + width)].reshape(rows + 2 * reach, width, 3)
        above = first - (top - reach)
        below = above + last - first
        body[above:below] = image[first:last] if scale == 1 else image[first:last] * image.dtype.type(scale)
        body[:above] = body[above]
        body[below:] = body[below - 1]
        strip[: rows + 2 * reach, : 3 * reach].reshape(rows + 2 * reach, reach, 3)[:] = body[:, :1]
        right = strip[: rows + 2 * reach, 3 * (reach + width) : 3 * (2 * reach + width)]
        right.reshape(rows + 2 * reach, reach, 3)[:] = body[:, -1:]
        filter_strip(strip, weights, order, reach, rows, scratch, out)
        yield top, out[:rows]


def _aligned(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return an array of float32 that begins at a cache line."""
    spare = _ALIGNMENT // 4
    memory = np.empty(math.prod(shape) + spare, dtype=np.float32)
    start = -memory.ctypes.data // 4 % spare
    return memory[start : start + math.prod(shape)].reshape(shape)
