"""AVIF pictures (AV1 Image File Format), which OpenImageIO's wheels do not read: by Pillow, which has libavif.

Pillow makes codes of 8 bits of any depth and does not say which primaries and transfer function they are of. The file
does (ISO/IEC 14496-12, box ``colr`` of type ``nclx``, with the code points of ITU-T H.273); what is not sRGB or BT.709
by them, such as pictures of high dynamic range, is refused: taken as sRGB, its colours would be wrong.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError

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
class AvifPicture:
    """What a file holds.

    - `codes`: (H, W, 3) uint8.
    - `alpha`: (H, W) float64, 0 … 1; None if it is opaque.
    - `orientation`: 1 … 8, as the TIFF tag.
    - `icc`: its colour profile, if it has one.
    """

    codes: npt.NDArray[np.uint8]
    alpha: npt.NDArray[np.float64] | None
    orientation: int
    icc: bytes | None


def read_avif(path: Path, most_pixels: int) -> AvifPicture:
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
    return AvifPicture(np.ascontiguousarray(pixels[..., :3]), alpha, orientation, icc or None)


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
