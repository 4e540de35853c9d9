"""Images at the size that learned methods work on: averaged over blocks, without the pixels that must not be used."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

# Share of a block's pixels that must be usable for its mean to be: with less, a masked chart's rim or a clipped sky
# would come in through single pixels.
_LEAST_SHARE = 0.5


def reduce(
    image: Image, saturation: float | None, mask: npt.NDArray[np.bool_] | None, longest: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image reduced by a whole factor, and which of its pixels are usable.

    Each pixel is the mean of the usable pixels of a block; blocks at the right and lower edge may be smaller. Pixels
    are usable as `PreparedImage.usable` has them. The largest usable value becomes 1, so that no
    feature depends on the exposure or on the unit of the image. Memory: a byte a pixel and some rows of the image.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB. `saturation`: value from which a channel is
    clipped; None if none is. `mask`: (H, W) bool, True where a pixel must not be used. `longest`: the most that height
    and width may be, px; a smaller image keeps its size. Returns (h, w, 3) float32, 0 … 1; 0 where it is not usable.
    Returns (h, w) bool, True where it is.

    Examples
    --------
    >>> image = np.full((4, 4, 3), 200.0)
    >>> image[:2, :2] = [[[100] * 3, [300] * 3], [[100] * 3, [900] * 3]]
    >>> small, used = reduce(image, None, image[..., 0] == 900, longest=2)
    >>> small[..., 0].round(3)
    array([[0.833, 1.   ],
           [1.   , 1.   ]], dtype=float32)
    """
    used = PreparedImage(image, saturation, mask).usable()
    factor = -(-max(image.shape[:2]) // longest)
    if factor == 1:
        small = np.where(used[..., None], image, 0).astype(np.float32)
    else:
        small, used = _block_means(image, used, factor)
    peak = float(small.max(initial=0.0))
    return (small / np.float32(peak) if peak > 0 else small), used


def _block_means(
    image: Image, used: npt.NDArray[np.bool_], factor: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    height, width = used.shape
    columns: npt.NDArray[np.int64] = np.arange(0, width, factor, dtype=np.int64)
    shape = (-(-height // factor), len(columns))
    sums, counts, sizes = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
    across: npt.NDArray[np.int64] = np.minimum(width - columns, factor)
    for row, top in enumerate(range(0, height, factor)):
        free = used[top : top + factor]
        strip = np.where(free[..., None], image[top : top + factor], 0).sum(axis=0, dtype=np.float64)
        sums[row] = np.add.reduceat(strip, columns, axis=0)
        counts[row] = np.add.reduceat(free.sum(axis=0), columns)
        sizes[row] = across * len(free)
    enough = counts >= _LEAST_SHARE * sizes
    enough &= counts > 0
    means = np.where(enough[..., None], sums / np.maximum(counts, 1)[..., None], 0)
    return means.astype(np.float32), enough


def chromaticities(pixels: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the chromaticities (r, g), (..., 2) float64, of colours (..., 3) of any float dtype; of black 1/3, 1/3.

    Examples
    --------
    >>> chromaticities(np.array([[1.0, 2.0, 1.0], [0.0, 0.0, 0.0]])).round(3)
    array([[0.25 , 0.5  ],
           [0.333, 0.333]])
    """
    given = pixels.astype(np.float64)
    total = given.sum(axis=-1, keepdims=True)
    return np.where(total > 0, given[..., :2] / np.where(total > 0, total, 1), 1 / 3)


def lights_from_chromaticities(red_green: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the lights (N, 3) float64, r + g + b = 1, of chromaticities (r, g), (N, 2) float64; each channel ≥ 1e-6.

    Examples
    --------
    >>> lights_from_chromaticities(np.array([[0.25, 0.5]]))
    array([[0.25, 0.5 , 0.25]])
    """
    full = np.concatenate([red_green, 1 - red_green.sum(axis=1, keepdims=True)], axis=1)
    bounded = np.maximum(full, _DARKEST)
    return bounded / bounded.sum(axis=1, keepdims=True)


# Least share of a channel in an estimated light: a model that extrapolates must not leave the colours that exist.
_DARKEST = 1e-6
