"""Convert codes of other colour spaces to sRGB.

The chart is printed from sRGB codes. A picture in another space, such as Adobe RGB (1998) or Display P3, would look
dull without conversion. LittleCMS converts with relative colorimetric intent (ICC.1:2022, clause 6.3.2) in 8 bits. A
profile that changes no code by more than 1 is treated as sRGB. A camera set to Adobe RGB embeds no profile, but
records the space in its EXIF data (DCF 2.0, interoperability index R03).
"""

from __future__ import annotations

import io
from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes

if TYPE_CHECKING:
    from PIL.ImageCms import ImageCmsTransform


# Codes per channel of the test grid, 729 colours, that shows if a profile is sRGB.
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


def to_srgb(codes: npt.NDArray[np.uint8], icc: bytes) -> tuple[npt.NDArray[np.uint8], str]:
    """Return the sRGB codes of a picture (H, W, 3) uint8, and how its profile was treated.

    `codes`: (H, W, 3) uint8 in the space of the profile `icc`. A grey profile is applied only if the three channels are
    equal. The same array is returned if no code changes. The text is, for example, ``"Display P3, converted to sRGB"``.
    """
    transform, mode, remark = _transform(icc)
    if mode == "L" and (codes != codes[..., :1]).any():
        return codes, f"{remark.rpartition(', ')[0]} of grey, not applied to colours, taken as sRGB"
    if transform is None:
        return codes, remark
    from PIL import Image, ImageCms

    picture = Image.fromarray(codes if mode == "RGB" else np.ascontiguousarray(codes[..., 0]))
    converted = ImageCms.applyTransform(picture, transform)
    return np.array(converted, dtype=np.uint8), remark


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
def _transform(icc: bytes) -> tuple[ImageCmsTransform | None, str, str]:
    from PIL import Image, ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        # Clause 7.2.6: the data colour space field.
        space = icc[16:20].decode("latin-1").strip()
        name = " ".join(ImageCms.getProfileDescription(profile).split()) or "unnamed"
        mode = {"RGB": "RGB", "GRAY": "L"}.get(space)
        if mode is None:
            return None, "RGB", f"{name} of {space} colours, not applied, taken as sRGB"
        srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
        transform = ImageCms.buildTransform(profile, srgb, mode, "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, OSError, ValueError) as error:
        return None, "RGB", f"damaged ({' '.join(str(error).split())}), not applied, taken as sRGB"
    codes = np.rint(np.linspace(0, 255, 256 if mode == "L" else _PROBE_STEPS)).astype(np.uint8)
    probe = codes[None] if mode == "L" else np.stack(np.meshgrid(codes, codes, codes), axis=-1).reshape(1, -1, 3)
    converted = np.array(ImageCms.applyTransform(Image.fromarray(probe), transform), dtype=np.int16)
    if np.abs(converted - (probe[..., None] if mode == "L" else probe)).max() <= 1:
        return None, mode, f"{name}, is sRGB"
    return transform, mode, f"{name}, converted to sRGB"
