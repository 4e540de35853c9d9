"""Reduce images to the working size of learned methods, as block means of usable pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

# Smallest fraction of usable pixels in a block. A smaller limit would include single pixels at the edge of a masked
# chart or a clipped sky.
_MIN_USABLE_SHARE = 0.5


def reduce_image(
    image: Image, saturation: float | None, mask: npt.NDArray[np.bool_] | None, longest: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image reduced by an integer factor, (h, w, 3) float32, 0 … 1, and its usable pixels, (h, w) bool.

    Each pixel is the mean of the usable pixels of a block, see `PreparedImage.usable`; unusable pixels are 0. `longest`
    is the largest height and width in px; smaller images keep their size. The largest usable value becomes 1, so that
    features do not depend on exposure and unit.

    Examples
    --------
    >>> image = np.full((4, 4, 3), 200.0)
    >>> image[:2, :2] = [[[100] * 3, [300] * 3], [[100] * 3, [900] * 3]]
    >>> small, used = reduce_image(image, None, image[..., 0] == 900, longest=2)
    >>> small[..., 0].round(3)
    array([[0.833, 1.   ],
           [1.   , 1.   ]], dtype=float32)
    """
    usable = PreparedImage(image, saturation, mask).usable()
    factor = -(-max(image.shape[:2]) // longest)
    if factor == 1:
        small = np.where(usable[..., None], image, 0).astype(np.float32)
    else:
        small, usable = _block_means(image, usable, factor)
    peak = float(small.max(initial=0.0))
    return (small / np.float32(peak) if peak > 0 else small), usable


def _block_means(
    image: Image, usable: npt.NDArray[np.bool_], factor: int
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    height, width = usable.shape
    columns: npt.NDArray[np.int64] = np.arange(0, width, factor, dtype=np.int64)
    shape = (-(-height // factor), len(columns))
    sums, counts, sizes = np.zeros((*shape, 3)), np.zeros(shape), np.zeros(shape)
    block_widths: npt.NDArray[np.int64] = np.minimum(width - columns, factor)
    for row, top in enumerate(range(0, height, factor)):
        rows = usable[top : top + factor]
        strip = np.where(rows[..., None], image[top : top + factor], 0).sum(axis=0, dtype=np.float64)
        sums[row] = np.add.reduceat(strip, columns, axis=0)
        counts[row] = np.add.reduceat(rows.sum(axis=0), columns)
        sizes[row] = block_widths * len(rows)
    is_usable = counts >= _MIN_USABLE_SHARE * sizes
    is_usable &= counts > 0
    means = np.where(is_usable[..., None], sums / np.maximum(counts, 1)[..., None], 0)
    return means.astype(np.float32), is_usable


def chromaticities(pixels: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the chromaticities (r, g), (..., 2) float64, of colours (..., 3); 1/3, 1/3 for black.

    Examples
    --------
    >>> chromaticities(np.array([[1.0, 2.0, 1.0], [0.0, 0.0, 0.0]])).round(3)
    array([[0.25 , 0.5  ],
           [0.333, 0.333]])
    """
    values = pixels.astype(np.float64)
    total = values.sum(axis=-1, keepdims=True)
    return np.where(total > 0, values[..., :2] / np.where(total > 0, total, 1), 1 / 3)


def lights_from_chromaticities(red_green: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return illuminants (N, 3) float64, r + g + b = 1, from chromaticities (r, g), (N, 2) float64.

    Channels are clipped to 1e-6 or more.

    Examples
    --------
    >>> lights_from_chromaticities(np.array([[0.25, 0.5]]))
    array([[0.25, 0.5 , 0.25]])
    """
    full = np.concatenate([red_green, 1 - red_green.sum(axis=1, keepdims=True)], axis=1)
    clipped = np.maximum(full, _MIN_CHROMATICITY)
    return clipped / clipped.sum(axis=1, keepdims=True)


# Smallest chromaticity of an estimate, because models that extrapolate may return negative values.
_MIN_CHROMATICITY = 1e-6
