"""Fewer bits of a picture's codes: what printing costs, and the paper's experiment on it (section 4.2)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError


def clear_bits(codes: npt.NDArray[np.uint8], bits: int) -> npt.NDArray[np.uint8]:
    """Return codes (...) uint8 with their lowest `bits` bits, 0 … 8, set to zero.

    Examples
    --------
    >>> clear_bits(np.array([7, 8, 200, 255], np.uint8), 3)
    array([  0,   8, 200, 248], dtype=uint8)
    """
    if not 0 <= bits <= 8:
        raise InputError(f"{bits} bits of a code of 8 were to be set to zero, expected 0 to 8")
    return codes & np.uint8(0xFF << bits & 0xFF)


def keep_bits(codes: npt.NDArray[np.uint8], bits: int | None) -> npt.NDArray[np.uint8]:
    """Return codes (...) uint8 of which the highest `bits` bits, 0 … 8, are kept.

    All of them, the same array, if None.
    """
    return codes if bits is None else clear_bits(codes, 8 - bits)
