"""Codes of other colour spaces become those of sRGB, and AVIF pictures codes.

A chart is printed from sRGB codes, so a picture in another space, such as Adobe RGB (1998) or Display P3, has to be
converted or its colours come out dull. LittleCMS converts, by relative colorimetry (ICC.1:2022, clause 6.3.2), in 8
bits; a profile that moves no code by more than one is sRGB under another name and is left alone.

A camera set to Adobe RGB embeds no profile, but says so in its EXIF data (DCF 2.0, interoperability index R03).

AVIF pictures (AV1 Image File Format), which OpenImageIO's wheels do not read, come from Pillow, which has libavif. It
makes codes of 8 bits of any depth and does not say which primaries and transfer function they are of. The file does
(ISO/IEC 14496-12, box ``colr`` of type ``nclx``, with the code points of ITU-T H.273); what is not sRGB or BT.709 by
them, such as pictures of high dynamic range, is refused: taken as sRGB, its colours would be wrong.
"""

from __future__ import annotations

import io
import struct
import warnings
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes
from foundation.errors import FormatError

if TYPE_CHECKING:
    from PIL.ImageCms import ImageCmsTransform


_PRIMARIES: Final = frozenset({1, 2, 5, 6})
"""Code points (H.273, table 2) that are sRGB's primaries, unspecified, or those of standard video, whose difference
programs ignore as this one does."""

_TRANSFERS: Final = frozenset({1, 2, 6, 13, 14, 15})
"""Code points (H.273, table 3) that are sRGB's transfer function, unspecified, or BT.709's, written for it."""

_ORIENTATION: Final = 0x0112
"""The tag Orientation (TIFF 6.0)."""

_HEAD: Final = 1 << 20
"""Bytes in which the boxes before the pixels are looked for; they are some hundred."""


@dataclass(frozen=True, eq=False, slots=True)
class FileValues:
    """Values of a file: `light` (H, W, 3) uint8 or float64, 0 … 255 or linear 0 … 1; `alpha` (H, W) float64 0 … 1."""

    light: npt.NDArray[Any]
    alpha: npt.NDArray[np.float64] | None
    associated: bool
    linear: bool
    orientation: int
    icc: bytes | None
    adobe_rgb: bool = False


def read_avif(path: Path, most_pixels: int) -> FileValues:
    """Return the picture in an AVIF file."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path, formats=["AVIF"]) as picture:
                if picture.width * picture.height > most_pixels:
                    raise FormatError(
                        f"cannot read {path}: {picture.width}x{picture.height} px are more than {most_pixels}; "
                        "make it smaller"
                    )
                icc = picture.info.get("icc_profile")
                orientation = int(picture.getexif().get(_ORIENTATION, 1))
                has_alpha = picture.mode in ("RGBA", "LA")
                pixels = np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = " ".join(str(error).replace(str(path), "").split()).rstrip(".") or type(error).__name__
        raise FormatError(f"cannot read {path}: {reason}; use another copy, or convert it to PNG") from error
    if not icc:
        _require_srgb(path)
    alpha = pixels[..., 3].astype(np.float64) / 255 if has_alpha and pixels[..., 3].min() < 255 else None
    codes = np.ascontiguousarray(pixels[..., :3])
    return FileValues(codes, alpha, associated=False, linear=False, orientation=orientation, icc=icc or None)


def _require_srgb(path: Path) -> None:
    """Refuse a file whose codes are of another colour space."""
    with path.open("rb") as stream:
        head = stream.read(_HEAD)
    place = head.find(b"colrnclx")
    if place < 0 or place + 12 > len(head):
        return
    primaries, transfer = struct.unpack(">HH", head[place + 8 : place + 12])
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        raise FormatError(
            f"cannot read {path}: its colours have primaries {primaries} and transfer function {transfer} of ITU-T "
            "H.273, not those of sRGB; convert it to PNG in sRGB"
        )


_PROBE_STEPS: Final = 9
"""Codes of each channel, every 32nd, of the grid of 729 colours that shows whether a profile is sRGB."""

_ADOBE_GAMMA: Final = 563 / 256
"""Adobe RGB (1998) Color Image Encoding, clause 4.3.1.2."""

_ADOBE_TO_SRGB: Final = np.array(
    [[1.39835574, -0.39835574, 0.0], [0.0, 1.0, 0.0], [0.0, -0.04292899, 1.04292899]], np.float32
)
"""Of linear light: the matrices of Adobe RGB (1998), clause 4.3.5.3, and IEC 61966-2-1; both have the white D65."""

_STEPS: Final = 65535
"""Steps of the table of encoded linear light: where the curve is steepest a step is a twentieth of a code."""

_ROWS: Final = 256
"""Rows that are converted together, so that their float32 take little memory beside the picture."""


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
