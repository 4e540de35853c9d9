"""TIFF 6.0 as every reader can read it: 16-bit RGB in one uncompressed strip; the fastest of the formats.

The shot is told in ImageDescription. Nothing is compressed: the zstd codec is missing from widespread readers, and
deflate, at the speed of their TIFF writers, costs more time than it saves room.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drivers.tiff.writing import Kind, Tags, head, text
from foundation.errors import InputError
from generator.files.shot import Shot

_RGB = 2


def encode_tiff(image: npt.NDArray[np.uint16], shot: Shot) -> bytes:
    """Return the file of `image` (H, W, 3) uint16.

    Raises
    ------
    InputError
        The file would be larger than 4 GiB.
    """
    height, width, channels = image.shape
    tags: Tags = {
        254: (Kind.LONG, [0]),  # NewSubfileType: the picture itself
        256: (Kind.LONG, [width]),
        257: (Kind.LONG, [height]),
        258: (Kind.SHORT, [16] * channels),  # BitsPerSample
        259: (Kind.SHORT, [1]),  # Compression: none
        262: (Kind.SHORT, [_RGB]),  # PhotometricInterpretation
        270: text(shot.note()),  # ImageDescription
        277: (Kind.SHORT, [channels]),  # SamplesPerPixel
        278: (Kind.LONG, [height]),  # RowsPerStrip
        284: (Kind.SHORT, [1]),  # PlanarConfiguration: pixel by pixel
        339: (Kind.SHORT, [1] * channels),  # SampleFormat: unsigned integers
    }
    try:
        start = head(tags, image.nbytes)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for TIFF: {error}; choose png or exr, or make it smaller"
        ) from error
    return b"".join([start, np.ascontiguousarray(image, dtype="<u2").data])
