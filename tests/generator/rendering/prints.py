"""A print that is known to the last digit, and the colour matrix of the camera that looks at it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import decode_srgb
from generator.kernels.choice import channels_of

Array = npt.NDArray[np.float64]

WHITES = np.array([[2200.0, 1900.0, 360.0], [2900.0, 6000.0, 4200.0], [2000.0, 5200.0, 5100.0]])
"""Whites of the lights of a table: a candle, daylight, blue sky, about as the simulated 550D sees them."""

MATRIX = np.array([[0.58, 0.34, 0.08], [0.09, 0.67, 0.24], [0.04, 0.21, 0.75]])
"""Of the camera of these tables."""


def printed(bits: int, tint: float = 0.0, black: float = 0.04, paper: float = 0.92) -> Array:
    """Return what the camera sees of the cells of a print, (8**bits, 3) over white; `tint` reddens its greys."""
    seen = decode_srgb(channels_of(np.arange(1 << 3 * bits), bits) / (2.0**bits - 1)) @ MATRIX.T
    # Greys between black and white have the tint, the ends hardly.
    middle = 4 * seen.mean(axis=1, keepdims=True) * (1 - seen.mean(axis=1, keepdims=True))
    return (black + (paper - black) * seen) * (1 + middle * np.array([tint, 0.0, -tint]))
