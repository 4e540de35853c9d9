"""How grey a pixel is by its derivatives, in strips; a map has 4 bytes a pixel, its smoothing as many again.

Values are taken in parts of white: of the saturation where one is known, else of the image's largest value. Edges are
continued by their last pixel, where the authors' programs wrap round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import PreparedImage

SIGMA = 0.5
"""Scale of the derivatives, px, of both methods' programs."""
SMOOTHING = 7
"""Side of the mean filters, px, of both methods' programs."""
DARK = 8 / 255
"""Sum of red, green and blue, in parts of white, up to which the authors' examples leave a pixel out."""
_REACH = 2
"""Of the derivative's kernel: exp(-x² / 2σ²) above 1e-6, as in the authors' program."""
_HALO = 8
"""Rows that a pixel's index comes from on either side: mean filter and derivative, with some to spare."""
_STRIP = 1 << 20
"""Pixels of a strip: 12 MB a float32 colour image."""
_LEAST = float(np.finfo(np.float64).eps)
"""Stands for zero in a logarithm, as in the authors' programs."""

Index = Callable[[npt.NDArray[np.float32]], tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]]
"""From a strip (H, W, 3) float32, parts of white: the index (H, W) float32, and (H, W) bool, True where it has none."""


def slope(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the gradient's length of each channel of values (H, W) or (H, W, C) float32, in the same shape.

    By the authors' kernel -x exp(-(x² + y²) / 2σ²) / (π σ²), which gives 0.54 for a ramp of 1 a pixel.
    """
    import cv2

    x = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * SIGMA**2))
    odd = x * bell / (np.pi * SIGMA**2)
    along_x = cv2.sepFilter2D(values, cv2.CV_32F, odd, bell, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.sepFilter2D(values, cv2.CV_32F, bell, odd, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.magnitude(along_x, along_y), dtype=np.float32).reshape(values.shape)


def smooth(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the means over 7 x 7 px of values (H, W) or (H, W, C) float32, in the same shape."""
    import cv2

    filtered = cv2.blur(values, (SMOOTHING, SMOOTHING), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(filtered, dtype=np.float32).reshape(values.shape)


def logarithm(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return ln of values of any shape, float32, zeros taken as the smallest distinguishable part of 1."""
    return np.log(np.where(values > 0, values, np.float32(_LEAST)))


def index_map(prepared: PreparedImage, index: Index) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return a smoothed index of each pixel, (H, W) float32, and (H, W) bool, True where a pixel may be chosen.

    Pixels that must not be used, are dark, or have no index get the largest index before the map is smoothed, so that
    their neighbours are chosen late.
    """
    found = np.empty((prepared.height, prepared.width), dtype=np.float32)
    usable = prepared.usable(0).copy()
    for rows, inner, strip in _strips(prepared):
        values, missing = index(strip)
        found[rows] = values[inner]
        usable[rows] &= ~missing[inner] & (strip[inner].sum(axis=2) > DARK)
    usable &= np.isfinite(found)
    if not usable.any():
        return found, usable
    found[~usable] = found[usable].max()
    return smooth(found), usable


def greyest(index: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_], share: float) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True at the pixels with the lowest index.

    `index`: (H, W) float32. `usable`: (H, W) bool, True where a pixel may be chosen. `share`: part of all pixels of the
    image that are chosen, 0 … 1; at least one.
    """
    count = min(max(1, int(index.size * share)), int(usable.sum()))
    if not count:
        return np.zeros_like(usable)
    limit = np.partition(index[usable], count - 1)[count - 1]
    return usable & (index <= limit)


def _strips(prepared: PreparedImage) -> Iterator[tuple[slice, slice, npt.NDArray[np.float32]]]:
    """Yield the rows of a strip in the image, where they lie in the strip, and the strip with its halo."""
    height, step = prepared.height, max(1, _STRIP // prepared.width)
    white = prepared.white or 1.0
    for top in range(0, height, step):
        bottom = min(height, top + step)
        first, last = max(0, top - _HALO), min(height, bottom + _HALO)
        strip = (prepared.image[first:last] / np.float64(white)).astype(np.float32)
        yield slice(top, bottom), slice(top - first, bottom - first), strip
