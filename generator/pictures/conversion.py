"""Convert pictures in other colour spaces to sRGB codes.

The chart is printed from sRGB codes. A picture in another space, such as Adobe RGB (1998) or Display P3, would look
dull without conversion. A file states its space in one of three ways:

- ICC profile: LittleCMS converts with relative colorimetric intent (ICC.1:2022, clause 6.3.2) in 8 bits. A profile that
  changes no code by more than 1 is treated as sRGB. A profile of linear light is applied in floating point, because 8
  bits of linear light are too coarse in dark colours.
- Primaries and transfer function: PNG chunks cICP, gAMA and cHRM, and chromaticities in OpenEXR, Radiance and TIFF
  files. They become an `RgbSpace`.
- EXIF data: a camera set to Adobe RGB embeds no profile (DCF 2.0, interoperability index R03).
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import decode_srgb, srgb_codes
from foundation.errors import FormatError

if TYPE_CHECKING:
    from PIL.ImageCms import ImageCmsProfile, ImageCmsTransform


# Number of codes per channel in a test grid of 729 colours. The grid shows whether a profile is sRGB.
_PROBE_STEPS: Final = 9

_ADOBE_GAMMA: Final = 563 / 256  # Adobe RGB (1998) Color Image Encoding, clause 4.3.1.2

# Linear Adobe RGB (1998) to linear sRGB, from the matrices of its clause 4.3.5.3 and of IEC 61966-2-1. Both have the
# white D65.
_ADOBE_TO_SRGB: Final = np.array(
    [[1.39835574, -0.39835574, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04292899, 1.04292899]], np.float32
)

# Steps of the table that encodes linear light as sRGB; a step changes the code by at most 1/20.
_ENCODING_STEPS: Final = 65535

_BAND_ROWS: Final = 256  # Rows that are converted together, which limits the memory for float32

_Array = npt.NDArray[np.float64]

# Chromaticities x, y of red, green, blue and white, by name and code point of ITU-T H.273 (table 2).
_CICP_PRIMARIES: Final[dict[int, tuple[str, tuple[float, ...]]]] = {
    1: ("BT.709", (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, 0.3127, 0.3290)),
    5: ("BT.601 625 lines", (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 0.3127, 0.3290)),
    6: ("BT.601 525 lines", (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, 0.3127, 0.3290)),
    9: ("BT.2020", (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)),
    11: ("DCI-P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3140, 0.3510)),
    12: ("Display P3", (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)),
}
SRGB_PRIMARIES: Final = _CICP_PRIMARIES[1][1]

_Decode = Callable[[_Array], _Array]  # Transfer function from codes to light, both 0 … 1


def _linear(codes: _Array) -> _Array:
    return codes


def _decode_bt709(codes: _Array) -> _Array:
    # Inverse of the curve of ITU-R BT.709-6, item 1.2.
    return np.where(codes < 0.081, codes / 4.5, ((np.maximum(codes, 0.081) + 0.099) / 1.099) ** (1 / 0.45))


def _decode_power(exponent: float) -> _Decode:
    return lambda codes: np.maximum(codes, 0) ** exponent


# Transfer functions by code point of ITU-T H.273 (table 3).
_CICP_DECODERS: Final[dict[int, _Decode]] = {
    **dict.fromkeys((1, 6, 14, 15), _decode_bt709),
    **{4: _decode_power(2.2), 5: _decode_power(2.8), 8: _linear, 13: decode_srgb},
}
_CICP_HDR: Final = {16: "PQ", 18: "HLG"}

# The value of gAMA that encoders write for sRGB. Values within 5 % are taken as sRGB, like libpng does.
_SRGB_FILE_GAMMA: Final = 0.45455
_SRGB_GAMMA_TOLERANCE: Final = 0.05

# Cone responses of the Bradford adaptation (ICC.1:2022, annex E.3).
_BRADFORD: Final = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])

# Largest difference between the identity and the matrix of a space that still counts as sRGB.
_SAME_MATRIX: Final = 0.002

# Largest difference between the greys of a profile and those of linear light, in codes, if the profile is linear.
_LINEAR_TOLERANCE: Final = 2


@dataclass(frozen=True, eq=False)
class RgbSpace:
    """An RGB colour space given by primaries and a transfer function.

    - `name`: such as ``"Display P3 by cICP"``.
    - `matrix`: (3, 3) float64, from its linear light to linear sRGB.
    - `decode`: transfer function from codes to light.
    """

    name: str
    matrix: _Array
    decode: _Decode

    @property
    def is_srgb(self) -> bool:
        """Whether codes of this space are sRGB codes."""
        return self.decode is decode_srgb and bool(np.abs(self.matrix - np.eye(3)).max() < _SAME_MATRIX)

    def srgb_codes(self, values: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """Return the sRGB codes (H, W, 3) uint8 of values (H, W, 3) in this space, 0 … 1."""
        out = np.empty(values.shape, np.uint8)
        for top in range(0, len(values), _BAND_ROWS):
            band = np.asarray(values[top : top + _BAND_ROWS], dtype=np.float64)
            out[top : top + _BAND_ROWS] = srgb_codes(self.decode(band) @ self.matrix.T)
        return out


def space_of_primaries(name: str, chromaticities: Sequence[float], decode: _Decode = _linear) -> RgbSpace:
    """Return the space with the chromaticities x, y of red, green, blue and white (8 values).

    `decode` is the transfer function, by default of linear light. Raises FormatError if the values define no space.
    """
    given = np.asarray(chromaticities, dtype=np.float64).reshape(4, 2)
    matrix: _Array = np.full((3, 3), math.nan)
    with suppress(np.linalg.LinAlgError):
        matrix = _solve(_xyz_of_rgb(np.reshape(SRGB_PRIMARIES, (4, 2))), _xyz_of_rgb(given))
    if not np.isfinite(matrix).all():
        raise FormatError(
            f"its chromaticities {' '.join(f'{value:g}' for value in given.ravel())} define no colour space; convert "
            "it to an sRGB PNG"
        )
    return RgbSpace(name, matrix, decode)


def _xyz_of_rgb(chromaticities: _Array) -> _Array:
    # Matrix from linear RGB to CIE XYZ, adapted from the white of the space to that of sRGB.
    x, y = chromaticities.T
    with np.errstate(all="ignore"):
        xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
        primaries, white = xyz[:, :3], xyz[:, 3]
        matrix = primaries * np.linalg.solve(primaries, white)
        srgb_x, srgb_y = SRGB_PRIMARIES[6:]
        target = np.array([srgb_x / srgb_y, 1.0, (1 - srgb_x - srgb_y) / srgb_y])
        gains = (_BRADFORD @ target) / (_BRADFORD @ white)
        return _solve(_BRADFORD, gains[:, None] * (_BRADFORD @ matrix))


def _solve(matrix: _Array, values: _Array) -> _Array:
    return np.asarray(np.linalg.solve(matrix, values), dtype=np.float64)


def space_of_cicp(codes: Sequence[int]) -> RgbSpace:
    """Return the space of code points of ITU-T H.273: primaries, transfer function, matrix, full range.

    Raises FormatError for HDR pictures, which have no fixed white, and for code points without a definition here.
    """
    primaries, transfer, matrix, is_full = codes[:4]
    if transfer in _CICP_HDR:
        raise FormatError(
            f"it is an HDR picture ({_CICP_HDR[transfer]} by CICP {codes_text(codes)}), expected a picture for print; "
            "convert it to an sRGB PNG"
        )
    if primaries not in _CICP_PRIMARIES or transfer not in _CICP_DECODERS or matrix or not is_full:
        raise FormatError(
            f"its colour space CICP {codes_text(codes)} is not supported, expected RGB of full range in BT.709, "
            "BT.2020 or Display P3; convert it to an sRGB PNG"
        )
    name, chromaticities = _CICP_PRIMARIES[primaries]
    return space_of_primaries(f"{name} by CICP", chromaticities, _CICP_DECODERS[transfer])


def codes_text(codes: Sequence[int]) -> str:
    """Return code points as text, such as ``9/16/0/1``."""
    return "/".join(str(int(code)) for code in codes)


def space_of_gamma(file_gamma: float, chromaticities: Sequence[float] | None) -> RgbSpace:
    """Return the space of the PNG chunks gAMA and cHRM (PNG, third edition, clauses 11.3.2.1 and 11.3.2.2).

    `file_gamma`: exponent from light to codes; 0 without gAMA. `chromaticities`: x, y of white, red, green and blue.
    """
    is_srgb_curve = not file_gamma or abs(file_gamma / _SRGB_FILE_GAMMA - 1) <= _SRGB_GAMMA_TOLERANCE
    decode = decode_srgb if is_srgb_curve else _decode_power(1 / file_gamma)
    chunks = ("gAMA" if file_gamma else "", "cHRM" if chromaticities else "")
    name = f"colours by {' and '.join(filter(None, chunks))}"
    if chromaticities is None:
        return RgbSpace(name, np.eye(3), decode)
    return space_of_primaries(name, (*chromaticities[2:], *chromaticities[:2]), decode)


def to_srgb(codes: npt.NDArray[np.uint8], icc: bytes) -> tuple[npt.NDArray[np.uint8], str]:
    """Return the sRGB codes of a picture (H, W, 3) uint8, and how its profile was treated.

    `codes`: (H, W, 3) uint8 in the space of the profile `icc`. A grey profile is applied only if the three channels are
    equal. The same array is returned if no code changes. The text is, for example, ``"Display P3, converted to sRGB"``.
    """
    transform, mode, remark = _transform(icc)[:3]
    if mode == "L" and (codes != codes[..., :1]).any():
        return codes, f"{remark.rpartition(', ')[0]} of grey, not applied to colours, taken as sRGB"
    if transform is None:
        return codes, remark
    from PIL import Image, ImageCms

    picture = Image.fromarray(codes if mode == "RGB" else np.ascontiguousarray(codes[..., 0]))
    converted = ImageCms.applyTransform(picture, transform)
    return np.array(converted, dtype=np.uint8), remark


def linear_space(icc: bytes) -> RgbSpace | None:
    """Return the space of an ICC profile if its values are linear light; None for all other profiles."""
    return _transform(icc)[3]


def from_adobe_rgb(codes: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the sRGB codes of Adobe RGB (1998) codes, both (H, W, 3) uint8, clipped to the gamut of sRGB."""
    linear = (np.arange(256, dtype=np.float32) / 255) ** _ADOBE_GAMMA
    encoded = srgb_codes(np.arange(_ENCODING_STEPS + 1) / _ENCODING_STEPS)
    out = np.empty_like(codes)
    for top in range(0, len(codes), _BAND_ROWS):
        srgb_light = linear[codes[top : top + _BAND_ROWS]] @ _ADOBE_TO_SRGB.T
        out[top : top + _BAND_ROWS] = encoded[np.rint(np.clip(srgb_light, 0, 1) * _ENCODING_STEPS).astype(np.uint16)]
    return out


@lru_cache(maxsize=16)
def _transform(icc: bytes) -> tuple[ImageCmsTransform | None, str, str, RgbSpace | None]:
    # Transform to sRGB, or None; Pillow mode of the profile; how the profile is treated; its space if it is linear.
    from PIL import Image, ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        # Clause 7.2.6: the data colour space field.
        space = icc[16:20].decode("latin-1").strip()
        name = " ".join(ImageCms.getProfileDescription(profile).split()) or "unnamed"
        mode = {"RGB": "RGB", "GRAY": "L"}.get(space)
        if mode is None:
            return None, "RGB", f"{name} of {space} colours, not applied, taken as sRGB", None
        srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
        transform = ImageCms.buildTransform(profile, srgb, mode, "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        return None, "RGB", f"damaged ({' '.join(str(error).split())}), not applied, taken as sRGB", None
    codes = np.rint(np.linspace(0, 255, 256 if mode == "L" else _PROBE_STEPS)).astype(np.uint8)
    probe = codes[None] if mode == "L" else np.stack(np.meshgrid(codes, codes, codes), axis=-1).reshape(1, -1, 3)
    converted = np.array(ImageCms.applyTransform(Image.fromarray(probe), transform), dtype=np.int16)
    if np.abs(converted - (probe[..., None] if mode == "L" else probe)).max() <= 1:
        return None, mode, f"{name}, is sRGB", None
    greys = np.arange(256, dtype=np.uint8)[None]
    grey_picture = Image.fromarray(greys if mode == "L" else np.stack([greys] * 3, axis=-1))
    grey_codes = np.array(ImageCms.applyTransform(grey_picture, transform), dtype=np.int16)
    space = None
    if np.abs(grey_codes - srgb_codes(greys / 255)[..., None]).max() <= _LINEAR_TOLERANCE:
        colorants, srgb_colorants = _colorants(profile), _colorants(srgb)
        if mode == "L":
            space = RgbSpace(name, np.eye(3), _linear)
        elif colorants is not None and srgb_colorants is not None:
            space = RgbSpace(name, _solve(srgb_colorants, colorants), _linear)
    return transform, mode, f"{name}, converted to sRGB", space


def _colorants(profile: ImageCmsProfile) -> _Array | None:
    # Matrix from linear RGB to CIE XYZ of the profile connection space; None for a profile of tables.
    core = profile.profile
    colorants = [colorant[0] for colorant in (core.red_colorant, core.green_colorant, core.blue_colorant) if colorant]
    return np.array(colorants).T if len(colorants) == 3 else None
