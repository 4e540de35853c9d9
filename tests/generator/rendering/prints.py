"""A print with exactly known colours, and the colour matrix of its camera."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import decode_srgb
from generator.kernels.choice import channels_of

Array = npt.NDArray[np.float64]

# White of each illuminant, counts: candle, daylight, blue sky, similar to those of the simulated 550D.
WHITES = np.array([[2200.0, 1900.0, 360.0], [2900.0, 6000.0, 4200.0], [2000.0, 5200.0, 5100.0]])

# Linear sRGB to camera RGB.
MATRIX = np.array([[0.58, 0.34, 0.08], [0.09, 0.67, 0.24], [0.04, 0.21, 0.75]])


def printed(bits: int, tint: float = 0.0, black: float = 0.04, paper: float = 0.92) -> Array:
    """Return camera RGB of the patches of a print, (8**bits, 3) relative to white; `tint` reddens its greys."""
    linear = decode_srgb(channels_of(np.arange(1 << 3 * bits), bits) / (2.0**bits - 1)) @ MATRIX.T
    # Greys have the tint, black and white hardly.
    weight = 4 * linear.mean(axis=1, keepdims=True) * (1 - linear.mean(axis=1, keepdims=True))
    return (black + (paper - black) * linear) * (1 + weight * np.array([tint, 0.0, -tint]))
