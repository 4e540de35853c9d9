"""The transfer function of sRGB (IEC 61966-2-1:1999, clauses 5.2 and 5.3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def encode_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return sRGB code values 0 … 1 of linear light 0 … 1, of any shape; float64."""
    linear = np.asarray(linear, dtype=np.float64)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(code: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return linear light 0 … 1 of sRGB code values 0 … 1, of any shape; float64."""
    code = np.asarray(code, dtype=np.float64)
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_codes(linear: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """Return sRGB codes 0 … 255 of linear light, clipped to 0 … 1, of any shape; uint8."""
    return np.rint(255 * encode_srgb(np.clip(linear, 0.0, 1.0))).astype(np.uint8)
