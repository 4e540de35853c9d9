"""The preview beside an image: the image in camera colours, made small and tone mapped by Flash.

An image of 16 bits has few values, so every logarithm and power is taken once for each value and not once for each
pixel; see `tonemap` for the operator. Nothing here starts threads of its own: the images of a dataset are made by as
many threads as there are processors.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import float32, uint8, uint16, uint32, uint64

from foundation.compiled import compiled
from generator.pictures.tonemap import DARK, flash_from_brightness

PREVIEW_SIDE: Final = 400
"""Longest side of a preview, px: enough to judge content and colours by eye, in some tens of kB, and less than that of
the images of most datasets, of which a preview of the same size would be a copy."""

_GAMMA: Final = 2.2
"""Exponent of a usual display, as in the paper's figure of the generation process."""
_HALF: Final = np.float32(0.5)
"""Added before a number is cut to a whole one, which rounds it."""


@compiled
def _shrink(image: Any, factor: int, out: Any) -> None:
    """Fill `out` with the rounded means of the blocks of `image`, `factor` pixels wide and high, or what is left there.

    `image` is (H, W, 3) uint16, `out` (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16.
    """
    height, width = image.shape[0], image.shape[1]
    sums = np.empty(3 * width, np.int64)
    one, two = uint64(1), uint64(2)
    for y in range(out.shape[0]):
        top, end = factor * y, min(factor * (y + 1), height)
        # Rows are added first, so that the compiler can vectorise what touches every sample.
        first, small = image[top].reshape(-1), out[y].reshape(-1)
        for i in range(3 * width):
            sums[i] = first[i]
        for row in range(top + 1, end):
            samples = image[row].reshape(-1)
            for i in range(3 * width):
                sums[i] += samples[i]
        left, at = uint64(0), uint64(0)
        columns = min(factor, width)
        share = 1.0 / ((end - top) * columns)
        for x in range(out.shape[1]):
            if factor * (x + 1) > width:
                columns = width - factor * x
                share = 1.0 / ((end - top) * columns)
            red, green, blue = sums[left], sums[left + one], sums[left + two]
            for _ in range(columns - 1):
                left += uint64(3)
                red += sums[left]
                green += sums[left + one]
                blue += sums[left + two]
            left += uint64(3)
            small[at] = uint16(red * share + 0.5)
            small[at + one] = uint16(green * share + 0.5)
            small[at + two] = uint16(blue * share + 0.5)
            at += uint64(3)


def _smaller(image: npt.NDArray[np.uint16], factor: int) -> npt.NDArray[np.uint16]:
    """Return the rounded means (⌈H / factor⌉, ⌈W / factor⌉, 3) uint16 of the blocks of `image` (H, W, 3)."""
    height, width = image.shape[:2]
    if factor == 2 and height % 2 == width % 2 == 0:
        # OpenCV's means of two by two are the same, halves rounded up, in a third of the time; of others they are not.
        import cv2

        return cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA).astype(np.uint16, copy=False)
    small = np.empty((-(-height // factor), -(-width // factor), 3), np.uint16)
    _shrink(image, factor, small)
    return small


@compiled
def _brightest(samples: Any, logs: Any) -> Any:
    """Return the largest channel of all pixels, and the sum over pixels of the logarithm of the largest channel.

    `samples` is (3 N,) uint16, `logs` (65536,) float64 the logarithm of each value.
    """
    # Two counters, so that equal values do not wait for each other.
    counts = np.zeros((2, 1 << 16), np.uint32)
    top = uint16(0)
    i = uint64(0)
    for pixel in range(len(samples) // 3):
        brightness = max(samples[i], samples[i + uint64(1)], samples[i + uint64(2)])
        counts[pixel & 1, brightness] += uint32(1)
        top = max(top, brightness)
        i += uint64(3)
    total = 0.0
    for value in range(int(top) + 1):
        total += (uint64(counts[0, value]) + uint64(counts[1, value])) * logs[value]
    return top, total


@compiled
def _map(samples: Any, roots: Any, shades: Any, out: Any) -> None:
    """Fill `out` with the rounded product of each sample's gamma root and the shade of its pixel's largest channel."""
    i = uint64(0)
    for _ in range(len(samples) // 3):
        red, green, blue = samples[i], samples[i + uint64(1)], samples[i + uint64(2)]
        shade = shades[max(red, green, blue)]
        # None is above 255 by more than an error of rounding.
        out[i] = uint8(roots[red] * shade + _HALF)
        out[i + uint64(1)] = uint8(roots[green] * shade + _HALF)
        out[i + uint64(2)] = uint8(roots[blue] * shade + _HALF)
        i += uint64(3)


@lru_cache(maxsize=4)
def _tables(white_level: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return lookup tables (65536,) over the values of 16 bits: brightness, its logarithm, its gamma root.

    Brightness is the value over the white level, at least `DARK`.
    """
    linear = np.arange(1 << 16) / white_level
    brightness = np.maximum(linear, DARK)
    return brightness.astype(np.float32), np.log(brightness), (linear ** (1 / _GAMMA)).astype(np.float32)


def preview_of(image: npt.NDArray[np.uint16], white_level: int, side: int = PREVIEW_SIDE) -> npt.NDArray[np.uint8]:
    """Return the preview of a raw linear image: made small, then tone mapped, colours as the camera saw them.

    `image`: (H, W, 3) uint16, linear camera RGB. `side`: longest side allowed, px. A pixel of the preview is the mean
    of k × k pixels, k the least whole number that makes it fit. Returns (h, w, 3) uint8, codes for a display; h and w
    are H / k and W / k, rounded up.

    Examples
    --------
    >>> wall = np.full((20, 1000, 3), (1000, 2000, 1500), np.uint16)
    >>> preview = preview_of(wall, white_level=4000, side=100)
    >>> preview.shape, preview[0, 0]
    ((2, 100, 3), array([186, 255, 224], dtype=uint8))
    """
    height, width = image.shape[:2]
    factor = -(-max(height, width) // side)
    if factor > 1:
        image = _smaller(np.ascontiguousarray(image), factor)
    brightness, logs, roots = _tables(white_level)
    samples = np.ascontiguousarray(image).reshape(-1)
    top, total = _brightest(samples, logs)
    seen = brightness[: int(top) + 1]
    operator = flash_from_brightness(float(total) / (samples.size // 3), float(seen[-1]), gamma=_GAMMA)
    shades = float32(operator.scale) * (seen + float32(operator.k)) ** float32(-1 / _GAMMA)
    picture = np.empty(image.shape, np.uint8)
    _map(samples, roots, shades, picture.reshape(-1))
    return picture
