"""JPEG XL (ISO/IEC 18181), lossless at its lowest effort: small for smooth pictures; PNG is smaller for photographs.

libjxl writes it; other versions may give other bytes. The file has no place for the image's metadata.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError


def encode_jxl(image: npt.NDArray[np.uint16]) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, all 16 bits kept.

    Raises
    ------
    InputError
        libjxl cannot write the image.
    """
    import imagecodecs

    try:
        return bytes(imagecodecs.jpegxl_encode(np.ascontiguousarray(image), effort=1, lossless=True, numthreads=1))
    except imagecodecs.JpegxlError as error:
        raise InputError(
            f"an image of {image.shape[1]}x{image.shape[0]} px cannot be written as JPEG XL: {error}; choose png"
        ) from error
