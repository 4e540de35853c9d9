"""TIFF 6.0 as every reader can read it: 16-bit RGB in one uncompressed strip; the fastest of the formats.

ImageDescription holds the metadata. Nothing is compressed: the zstd codec is missing from widespread readers, and
deflate, at the speed of their TIFF writers, costs more time than it saves room.
"""

from __future__ import annotations

import io

import numpy as np
import numpy.typing as npt

from drivers.tiff import RGB, Tags, TiffTag, ValueType, head, text
from foundation.errors import InputError
from generator.files.metadata import ImageMetadata


def encode_tiff(image: npt.NDArray[np.uint16], metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16."""
    height, width, channels = image.shape
    tags: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # the picture itself
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [width]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [height]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16] * channels),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [RGB]),
        TiffTag.IMAGE_DESCRIPTION: text(metadata.to_json()),
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [channels]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [height]),
        TiffTag.PLANAR_CONFIGURATION: (ValueType.SHORT, [1]),  # pixel by pixel
        TiffTag.SAMPLE_FORMAT: (ValueType.SHORT, [1] * channels),  # unsigned integers
    }
    try:
        start = head(tags, image.nbytes)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for TIFF: {error}; choose png or exr, or make it smaller"
        ) from error
    return b"".join([start, np.ascontiguousarray(image, dtype="<u2").data])


def decode_tiff(data: bytes) -> npt.NDArray[np.generic]:
    """Return the first picture of a TIFF, (H, W) or (H, W, channels), uint8, uint16, float32 or whatever is stored.

    OpenCV's reader is not used: of pictures stored plane by plane, and of files that are cut off, it makes others.
    """
    import tifffile

    with tifffile.TiffFile(io.BytesIO(data)) as file:
        page = file.pages.first
        found = np.asarray(page.asarray())
        # Planes that are stored one after another come as the first axis.
        return np.moveaxis(found, 0, -1) if page.axes.startswith("S") and found.ndim == 3 else found
