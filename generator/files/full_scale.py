"""Counts stretched over all 16 bits, for programs that take the largest number of a type for white.

A raw image of 0 … 11 536 looks nearly black in a reader that expects 0 … 65 535. With white level w a count v is stored
as ⌊65535 v / w⌉. That grows by more than 1 from count to count, so that no two counts become the same, and
⌊w s / 65535⌉ is v again: nothing is lost.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint16]

FULL: Final = 65535
"""Largest number of 16 bits, which saturation becomes."""


def to_full_scale(image: Image, white_level: int) -> Image:
    """Return an image (...) uint16 of counts with saturation at 65535; what is above the white level is cut at it.

    `image`: (...) uint16, counts, 0 at black.

    Examples
    --------
    >>> to_full_scale(np.array([0, 1, 1000, 11536], np.uint16), 11536)
    array([    0,     6,  5681, 65535], dtype=uint16)
    """
    white = np.uint32(white_level)
    counts = np.minimum(image, np.uint16(white_level)).astype(np.uint32)
    return ((counts * np.uint32(FULL) + white // np.uint32(2)) // white).astype(np.uint16)


def from_full_scale(image: Image, white_level: int) -> Image:
    """Return the counts (...) uint16 that `to_full_scale` stretched.

    `image`: (...) uint16, saturation at 65535. `white_level`: saturation of the counts, 1 … 65535.
    """
    stretched = image.astype(np.uint32) * np.uint32(white_level)
    return ((stretched + np.uint32(FULL // 2)) // np.uint32(FULL)).astype(np.uint16)
