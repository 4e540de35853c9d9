"""The preview beside an image: the image in camera colours, made small and tone mapped by Flash.

An image of 16 bits has few values, so every logarithm and power is taken once for each value and not once for each
pixel; see `tonemap` for the operator.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint8, uint16, uint64

from foundation.compiled import compiled
from generator.pictures.tonemap import DARK, flash_from_brightness

PREVIEW_SIDE: Final = 512
"""Longest side of a preview, px: enough to judge content and colours by eye, in some tens of kB."""

_GAMMA: Final = 2.2
"""Exponent of a usual display, as in the paper's figure of the generation process."""
_HALF: Final = np.float32(0.5)
"""Added before a number is cut to a whole one, which rounds it."""


@compiled
def _brightest(samples: Any, counts: Any) -> Any:
    """Add to `counts` how often each value is the largest channel of a pixel; return the largest value of all."""
    top = uint16(0)
    i = uint64(0)
    # Two counters, so that equal values do not wait for each other.
    for pixel in range(len(samples) // 3):
        brightness = max(samples[i], samples[i + uint64(1)], samples[i + uint64(2)])
        counts[pixel & 1, brightness] += 1
        top = max(top, brightness)
        i += uint64(3)
    return top


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
def _tables(white_level: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float32]]:
    """Return lookup tables (65536,) over the values of 16 bits: brightness, its logarithm, its gamma root.

    Brightness is the value over the white level, at least `DARK`.
    """
    linear = np.arange(1 << 16) / white_level
    brightness = np.maximum(linear, DARK)
    return brightness, np.log(brightness), (linear ** (1 / _GAMMA)).astype(np.float32)


def preview_of(image: npt.NDArray[np.uint16], white_level: int, side: int = PREVIEW_SIDE) -> npt.NDArray[np.uint8]:
    """Return the preview of a raw linear image: made small, then tone mapped, colours as the camera saw them.

    Parameters
    ----------
    image
        (H, W, 3) uint16, linear camera RGB.
    white_level
        Value of saturation, in the units of the image.
    side
        Longest side allowed, px.

    Returns
    -------
    ndarray
        (h, w, 3) uint8, codes for a display.

    Examples
    --------
    >>> wall = np.full((20, 1000, 3), (1000, 2000, 1500), np.uint16)
    >>> preview = preview_of(wall, white_level=4000, side=100)
    >>> preview.shape, preview[0, 0]
    ((2, 100, 3), array([186, 255, 224], dtype=uint8))
    """
    import cv2

    height, width = image.shape[:2]
    scale = side / max(height, width)
    if scale < 1:
        # In whole numbers: floats of the full size would take more memory than all else.
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint16)
    brightness, logs, roots = _tables(white_level)
    samples = np.ascontiguousarray(image).reshape(-1)
    counts = np.zeros((2, 1 << 16), np.int64)
    seen = slice(0, int(_brightest(samples, counts)) + 1)
    # Not a dot product: the library behind it may start threads of its own.
    mean = float((counts[:, seen] * logs[seen]).sum()) / (samples.size // 3)
    operator = flash_from_brightness(mean, float(brightness[seen][-1]), gamma=_GAMMA)
    shades = operator.scale * (brightness[seen] + operator.k) ** (-1 / _GAMMA)
    picture = np.empty(image.shape, np.uint8)
    _map(samples, roots, shades.astype(np.float32), picture.reshape(-1))
    return picture
