"""JPEG XL (ISO/IEC 18181), lossless at its lowest effort: small for smooth pictures; PNG is smaller for photographs.

libjxl writes it; other versions may give other bytes. The file has no place for the image's metadata.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError


def encode_jxl(image: npt.NDArray[np.uint16]) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, all 16 bits kept."""
    codecs = imagecodecs()
    try:
        return bytes(codecs.jpegxl_encode(np.ascontiguousarray(image), effort=1, lossless=True, numthreads=1))
    except codecs.JpegxlError as error:
        raise InputError(
            f"an image of {image.shape[1]}x{image.shape[0]} px cannot be written as JPEG XL: {error}; choose png"
        ) from error


def decode_jxl(data: bytes) -> npt.NDArray[np.generic]:
    """Return what a JPEG XL file holds, (H, W, channels) or (H, W), uint8, uint16 or float32 as it is stored."""
    return np.asarray(imagecodecs().jpegxl_decode(data, numthreads=1))


def imagecodecs() -> Any:
    """Return the module that has libjxl; a plain installation does without its 90 MB."""
    try:
        import imagecodecs as module
    except ImportError as error:
        raise InputError("JPEG XL needs imagecodecs: pip install imagecodecs; or choose png") from error
    return module
