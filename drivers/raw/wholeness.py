"""Whether a decoded frame is one that a sensor gives: its levels, and no part that was filled up where bytes were lost.

Rules that hold inside:

- Pure functions of counts and numbers that return a reason in words, or None. Nothing is repaired.
- LibRaw reads behind a file's end as zeros or ones without a word, and so does whoever copies a file from a bad card.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_LEAST_BLACK = 16
"""Counts of black from which on a photosite that is far below it is none; cameras without such a level cut at zero."""

_TILE = (32, 256)
"""Rows and columns of the smallest part that is looked at: the least that is stored by itself."""


_LARGEST = 65535
"""The largest count: what ones are read as."""


def levels_fault(black: NDArray[np.float64], white_level: float, bits: int) -> str | None:
    """Return why black and white level are none of a sensor of so many `bits`; None where they are.

    `black`: (2, 2) counts. A mean of deltas may take a black level of zero below it, by a part of a count.
    """
    if not 0 < white_level <= 1 << bits:
        return f"its white level is {white_level:g}, 1 to {1 << bits} expected of {bits} bits"
    if not -1 < black.min() <= black.max() < white_level:
        return (
            f"its black level is {black.min():g} to {black.max():g}, 0 to its white level of {white_level:g} expected"
        )
    return None


def filled_fault(counts: NDArray[np.uint16], black: NDArray[np.float64], white_level: int) -> str | None:
    """Return which part of a frame is no exposure, as of a file that was cut and filled up; None if none is.

    `counts`: (H, W) of the visible area; `black`: (2, 2) counts. A row, or a tile of 32×256, in which no photosite
    reaches half of the black level is none that a sensor gives, whose dark is that level and noise about it; where it
    has no such level, one of nothing but zeros. Nor is one of nothing but ones, where white is far below them.
    """
    level = float(black.min())
    floor = level / 2 if level >= _LEAST_BLACK else 1
    reached = f"half of its black level of {level:g} counts" if level >= _LEAST_BLACK else "one count"
    brightest = counts.max(axis=1)
    low = _part(np.flatnonzero(brightest < floor), counts.shape)
    if low is None:
        low = _part(np.argwhere(_tiles(np.maximum, counts) < floor), counts.shape)
    if low is not None:
        return f"{low} do not reach {reached}, as where a cut file was filled with zeros"
    if white_level > _LARGEST // 2 or brightest.max() < _LARGEST:
        return None
    high = _part(np.flatnonzero(counts.min(axis=1) == _LARGEST), counts.shape)
    if high is None:
        high = _part(np.argwhere(_tiles(np.minimum, counts) == _LARGEST), counts.shape)
    return None if high is None else f"{high} have nothing but the count {_LARGEST}, as where lost bytes are all ones"


def _tile_size(shape: tuple[int, ...]) -> tuple[int, int]:
    return min(_TILE[0], shape[0]), min(_TILE[1], shape[1])


def _tiles(extreme: np.ufunc, counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the largest or least count of each tile; what is left at the edges belongs to the last."""
    height, width = _tile_size(counts.shape)
    bands = extreme.reduceat(counts, range(0, counts.shape[0] - height + 1, height), axis=0)
    return extreme.reduceat(bands, range(0, counts.shape[1] - width + 1, width), axis=1)


def _part(found: NDArray[np.intp], shape: tuple[int, ...]) -> str | None:
    """Return in words which rows, or which tiles, were found; None where none was."""
    if not len(found):
        return None
    if found.ndim == 1:
        return f"{len(found)} of its {shape[0]} rows, from row {found[0]},"
    height, width = _tile_size(shape)
    return f"{len(found)} parts of {height}×{width}, from row {found[0][0] * height}, column {found[0][1] * width},"
