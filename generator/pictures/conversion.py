"""Codes of other colour spaces become those of sRGB.

A chart is printed from sRGB codes, so a picture in another space, such as Adobe RGB (1998) or Display P3, has to be
converted or its colours come out dull. LittleCMS converts, by relative colorimetry (ICC.1:2022, clause 6.3.2), in 8
bits; a profile that moves no code by more than one is sRGB under another name and is left alone.

A camera set to Adobe RGB embeds no profile, but says so in its EXIF data (DCF 2.0, interoperability index R03).
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


# Codes of each channel, every 32nd, of the grid of 729 colours that shows whether a profile is sRGB.
_PROBE_STEPS: Final = 9

_ADOBE_GAMMA: Final = 563 / 256  # Adobe RGB (1998) Color Image Encoding, clause 4.3.1.2

# Of linear light: the matrices of Adobe RGB (1998), clause 4.3.5.3, and IEC 61966-2-1; both have the white D65.
_ADOBE_TO_SRGB: Final = np.array(
    [[1.39835574, -0.39835574, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04292899, 1.04292899]], np.float32
)

# Steps of the table of encoded linear light: where the curve is steepest a step is a twentieth of a code.
_STEPS: Final = 65535

_ROWS: Final = 256  # Rows that are converted together, so that their float32 take little memory beside the picture


def to_srgb(codes: npt.NDArray[np.uint8], icc: bytes) -> tuple[npt.NDArray[np.uint8], str]:
    """Return the sRGB codes of a picture, and how its profile was treated.

    `codes`: (H, W, 3) uint8 in the space of the profile; a grey profile is applied where the channels are alike. `icc`:
    the embedded profile. Returns (H, W, 3) uint8, the same array if no code changes; and a
    remark, such as ``"Display P3, converted to sRGB"``.
    """
    transform, mode, word = _transform(icc)
    if mode == "L" and (codes != codes[..., :1]).any():
        return codes, f"{word.rpartition(', ')[0]} of grey, not applied to colours, taken as sRGB"
    if transform is None:
        return codes, word
    from PIL import Image, ImageCms

    picture = Image.fromarray(codes if mode == "RGB" else np.ascontiguousarray(codes[..., 0]))
    converted = ImageCms.applyTransform(picture, transform)
    return np.array(converted, dtype=np.uint8), word


def from_adobe_rgb(codes: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return the sRGB codes (H, W, 3) uint8 of Adobe RGB (1998) codes (H, W, 3) uint8, clipped to the gamut of sRGB."""
    linear = (np.arange(256, dtype=np.float32) / 255) ** _ADOBE_GAMMA
    encoded = srgb_codes(np.arange(_STEPS + 1) / _STEPS)
    out = np.empty_like(codes)
    for top in range(0, len(codes), _ROWS):
        wanted = linear[codes[top : top + _ROWS]] @ _ADOBE_TO_SRGB.T
        out[top : top + _ROWS] = encoded[np.rint(np.clip(wanted, 0, 1) * _STEPS).astype(np.uint16)]
    return out


@lru_cache(maxsize=16)
def _transform(icc: bytes) -> tuple[ImageCmsTransform | None, str, str]:
    """Return the transform of a profile or None, the mode of its pictures, and the remark."""
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
    steps = np.rint(np.linspace(0, 255, 256 if mode == "L" else _PROBE_STEPS)).astype(np.uint8)
    probe = steps[None] if mode == "L" else np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
    seen = np.array(ImageCms.applyTransform(Image.fromarray(probe), transform), dtype=np.int16)
    if np.abs(seen - (probe[..., None] if mode == "L" else probe)).max() <= 1:
        return None, mode, f"{name}, is sRGB"
    return transform, mode, f"{name}, converted to sRGB"
