"""Replace unfit colours of a picture by the nearest fit colours, and count the replaced pixels.

A colour is unfit if the look-up table (LUT) excludes its patch from use. The number of replaced pixels is printed and
recorded with the data set.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from numpy import uint32

from foundation.compiled import compiled, inlined
from foundation.errors import QualityError
from generator.kernels.choice import EDGE_BYTES, OFFSETS_BYTES, channels_of, group_address, write_colours
from generator.kernels.vector import GROUP, copy1, offset_at

if TYPE_CHECKING:
    from calibration.table.lut import Provenance


def nearest_fit_colours(unfit: npt.ArrayLike, bits: int) -> npt.NDArray[np.int64]:
    """Return the nearest fit colour of each unfit colour, by Euclidean distance of the codes.

    If several colours are equally near, the lowest index is taken. `unfit`: (N,) int, distinct colour indices
    0 … 8**bits − 1. Returns (N,) int64 colour indices, none of them unfit.
    """
    unfit = np.asarray(unfit, dtype=np.int64)
    is_fit = np.ones(8**bits, dtype=bool)
    is_fit[unfit] = False
    fit = np.flatnonzero(is_fit)
    if not fit.size:
        raise QualityError(f"all {8**bits} colours of the LUT are unfit, expected 1 or more fit; build the LUT again")
    codes = channels_of(fit, bits)
    nearest = [
        fit[np.argmin(((codes - channel) ** 2).sum(axis=1))] for channel in channels_of(unfit, bits).reshape(-1, 3)
    ]
    return np.array(nearest, dtype=np.int64).reshape(unfit.shape)


def replace_unfit_colours(picture: npt.NDArray[np.uint8], provenance: Provenance) -> tuple[npt.NDArray[np.uint8], int]:
    """Return `picture` (H, W, 3) uint8 with unfit colours replaced, and the number of replaced pixels.

    The same array is returned if no colour is unfit.
    """
    bits = provenance.bits
    unfit = tuple(sorted({cell.colour for cell in provenance.unfit}))
    if not unfit or not colours_in(picture, bits)[list(unfit)].any():
        return picture, 0
    is_unfit, replacement_codes = _replacements(unfit, bits)
    replaced = np.array(picture, order="C")
    return replaced, int(_replace(replaced, np.uint32(bits), is_unfit, replacement_codes))


@lru_cache(maxsize=4)
def _replacements(unfit: tuple[int, ...], bits: int) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.uint8]]:
    is_unfit, replacement_codes = np.zeros(8**bits, np.bool_), np.zeros((8**bits, 3), np.uint8)
    is_unfit[list(unfit)] = True
    replacement_codes[list(unfit)] = channels_of(nearest_fit_colours(unfit, bits), bits) << (8 - bits)
    return is_unfit, replacement_codes


def colours_in(picture: npt.NDArray[np.uint8], bits: int) -> npt.NDArray[np.bool_]:
    """Return (8**bits,) bool: the colours that occur in a picture (H, W, 3) uint8."""
    is_present = np.zeros(8**bits, np.bool_)
    pixels = np.ascontiguousarray(picture)
    scratch = np.ones(EDGE_BYTES + 2 * OFFSETS_BYTES + 1, np.uint8)
    _mark_colours(pixels.ctypes.data, pixels.size // 3, np.uint32(bits), is_present.ctypes.data, scratch.ctypes.data)
    return is_present


@compiled
def _mark_colours(pixels: int, count: int, bits: Any, is_present: int, scratch: int) -> None:
    # For each colour that occurs, copies the last byte of scratch memory, a 1, to `is_present`.
    indices, unused = scratch + EDGE_BYTES, scratch + EDGE_BYTES + OFFSETS_BYTES
    one_byte = unused + OFFSETS_BYTES
    for group in range((count + GROUP - 1) // GROUP):
        source = group_address(pixels, count, group, scratch)
        write_colours(source, bits, uint32(1), indices, uint32(0), unused)
        for i in range(min(GROUP, count - GROUP * group)):
            copy1(one_byte, is_present + offset_at(indices + 4 * i))


@inlined
def _colour_at(picture: Any, y: int, x: int, bits: Any) -> Any:
    low = np.uint32(8) - bits
    red, green, blue = picture[y, x, 0] >> low, picture[y, x, 1] >> low, picture[y, x, 2] >> low
    return red << np.uint32(2) * bits | green << bits | blue


@compiled
def _replace(picture: Any, bits: Any, is_unfit: Any, replacement_codes: Any) -> int:
    count = 0
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            colour = _colour_at(picture, y, x, bits)
            if is_unfit[colour]:
                for channel in range(3):
                    picture[y, x, channel] = replacement_codes[colour, channel]
                count += 1
    return count
