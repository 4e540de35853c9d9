"""Light as colour: spectra to CIE XYZ, XYZ to linear sRGB and its codes, black bodies, and angles between colours.

The colour-matching functions are those of the CIE 1931 2° standard observer at 1 nm (ISO/CIE 11664-1), in
`foundation/data/cie_1931_2_degree.csv`; that folder's README says where they are from. The transfer function is that of
sRGB (IEC 61966-2-1:1999, clauses 5.2 and 5.3).
"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Final

import numpy as np
import numpy.typing as npt

_C1_W_M2: Final = 3.741771e-16  # First radiation constant of Planck's law, W m² (CODATA)

# Second radiation constant as CIE 15:2018 has it for black bodies, m K; CODATA's has more places.
_C2_M_K: Final = 1.4388e-2

# (3, 3) float64, CIE XYZ to linear sRGB (IEC 61966-2-1:1999, equation 7).
XYZ_TO_SRGB: Final = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])

_Array = npt.NDArray[np.float64]


@cache
def observer_cie_1931() -> tuple[_Array, _Array]:
    """Return the wavelengths (471,) float64, 360 … 830 nm by 1, and x̄, ȳ, z̄ there, (471, 3) float64; read-only."""
    with resources.files("foundation").joinpath("data/cie_1931_2_degree.csv").open(encoding="utf-8") as file:
        table = np.loadtxt(file, delimiter=",", skiprows=1)
    table.flags.writeable = False
    return table[:, 0], table[:, 1:]


def planck(wavelengths_nm: npt.ArrayLike, temperature_k: float) -> _Array:
    """Return the spectral radiance of a black body in vacuum, W sr⁻¹ m⁻² nm⁻¹, as the shape given, float64.

    `wavelengths_nm`: of any shape, float64, above 0, nm.
    """
    metres = np.asarray(wavelengths_nm, dtype=np.float64) * 1e-9
    return _C1_W_M2 * metres**-5 / np.pi / np.expm1(_C2_M_K / (metres * temperature_k)) * 1e-9


def xyz_of(wavelengths_nm: _Array, power: _Array) -> _Array:
    """Return CIE XYZ, (3,) float64, of a light of relative power (W,) per nm at wavelengths (W,), ascending; Y is 1.

    Joined by straight lines, and 0 beyond the wavelengths given.
    """
    grid, functions = observer_cie_1931()
    xyz = np.interp(grid, wavelengths_nm, power, left=0, right=0) @ functions
    return xyz / xyz[1]


def linear_srgb(xyz: npt.ArrayLike) -> _Array:
    """Return linear sRGB (..., 3) float64 of CIE XYZ (..., 3), Y 1 white; what lies outside the gamut is below 0."""
    return np.asarray(xyz, dtype=np.float64) @ XYZ_TO_SRGB.T


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


def angles_deg(one: npt.ArrayLike, other: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the angles between colours and others, degrees.

    `one`, `other`: (..., 3) float or int each, broadcast against each other; linear RGB of any length above 0. Returns
    (...) float64, 0 … 180. By W. Kahan's formula of the half angle, which keeps its digits at every angle; the arc
    cosine loses half of them at small ones.
    """
    a, b = _unit(one), _unit(other)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def _unit(vector: npt.ArrayLike) -> npt.NDArray[np.float64]:
    vector = np.asarray(vector, dtype=np.float64)
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
