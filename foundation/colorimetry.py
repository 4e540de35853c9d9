"""Conversions between spectra, CIE XYZ, linear sRGB and sRGB codes; black bodies; angles between colours.

Colour-matching functions: CIE 1931 2° standard observer at 1 nm (ISO/CIE 11664-1). Their source is given in
`foundation/data/README.md`. Transfer function: sRGB (IEC 61966-2-1:1999, clauses 5.2 and 5.3).
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Final

import numpy as np
import numpy.typing as npt

_C1_W_M2: Final = 3.741771e-16  # First radiation constant of Planck's law, W m² (CODATA)

# Second radiation constant of Planck's law, m K, as rounded in CIE 15:2018.
_C2_M_K: Final = 1.4388e-2

# Matrix from CIE XYZ to linear sRGB, (3, 3) float64 (IEC 61966-2-1:1999, equation 7).
XYZ_TO_SRGB: Final = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])

_Array = npt.NDArray[np.float64]


@cache
def observer_cie_1931() -> tuple[_Array, _Array]:
    """Return wavelengths (471,) float64, 360 to 830 nm, and x̄, ȳ, z̄ (471, 3) float64. Both arrays are read-only."""
    with resources.files("foundation").joinpath("data/cie_1931_2_degree.csv").open(encoding="utf-8") as file:
        table = np.loadtxt(file, delimiter=",", skiprows=1)
    table.flags.writeable = False
    return table[:, 0], table[:, 1:]


def planck(wavelengths_nm: npt.ArrayLike, temperature_k: float) -> _Array:
    """Return the spectral radiance of a black body in vacuum (Planck's law), W sr⁻¹ m⁻² nm⁻¹, float64.

    `wavelengths_nm`: positive numbers in any shape; the result has the same shape.
    """
    metres = np.asarray(wavelengths_nm, dtype=np.float64) * 1e-9
    return _C1_W_M2 * metres**-5 / np.pi / np.expm1(_C2_M_K / (metres * temperature_k)) * 1e-9


def xyz_of(wavelengths_nm: _Array, power: _Array) -> _Array:
    """Return CIE XYZ (3,) float64 of a spectrum, scaled to Y = 1.

    `power` (W,) is the relative power per nm at ascending wavelengths (W,). It is interpolated linearly, and is 0
    outside their range.
    """
    grid, functions = observer_cie_1931()
    xyz = np.interp(grid, wavelengths_nm, power, left=0, right=0) @ functions
    return xyz / xyz[1]


def linear_srgb(xyz: npt.ArrayLike) -> _Array:
    """Return linear sRGB (..., 3) float64 of CIE XYZ (..., 3), with Y = 1 for white; negative outside the gamut."""
    return np.asarray(xyz, dtype=np.float64) @ XYZ_TO_SRGB.T


def encode_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return sRGB code values 0 to 1, float64, of linear values 0 to 1 of any shape."""
    linear = np.asarray(linear, dtype=np.float64)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055)


def decode_srgb(code: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return linear values 0 to 1, float64, of sRGB code values 0 to 1 of any shape."""
    code = np.asarray(code, dtype=np.float64)
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_codes(linear: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """Return sRGB codes 0 to 255, uint8, of linear values of any shape, clipped to 0 to 1."""
    return np.rint(255 * encode_srgb(np.clip(linear, 0.0, 1.0))).astype(np.uint8)


def fit_white_matrix(linear: _Array, responses: _Array) -> _Array:
    """Return the matrix (3, 3) that maps linear sRGB (N, 3) to responses (N, 3). White is 1 in all channels of both.

    For a response a, least squares fit a - G = c_r (R - G) + c_b (B - G), so every row sums to 1.
    """
    differences, green = linear[:, [0, 2]] - linear[:, [1]], linear[:, [1]]
    coefficients = np.asarray(np.linalg.lstsq(differences, responses - green, rcond=None)[0], np.float64).T
    return np.stack([coefficients[:, 0], 1 - coefficients.sum(axis=1), coefficients[:, 1]], axis=1)


def angles_deg(first: npt.ArrayLike, second: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angles (...) float64 between pairs of colours, 0 to 180 degrees.

    `first`, `second`: linear RGB (..., 3), not zero, broadcast against each other.
    """
    # Half-angle formula by W. Kahan: accurate at every angle. The arc cosine loses half of the digits at small angles.
    a, b = _unit(first), _unit(second)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _unit(vector: npt.ArrayLike) -> npt.NDArray[np.float64]:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
