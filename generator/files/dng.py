"""Adobe DNG: the image as the Bayer mosaic of a raw file, which raw programs open with the right white balance.

Each photosite of the RGGB pattern takes its own channel of its pixel; two thirds of the values are left out, as by a
sensor. Black is 0, white the table's saturation, AsShotNeutral the ground truth, so that a raw program shows neutral
things as neutral. The colour matrix is the one that LibRaw holds for the table's camera or, for a camera unknown to it,
that of linear sRGB: neutral things stay neutral with both, other colours are right with the first only. The file names
CroP as its maker, so that no program applies facts of the camera's own files to it, such as their black level.

Source: DNG 1.7.1, chapters 2 and 4.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import Matrix, camera_matrix
from drivers.tiff import CFA, D65, Tags, TiffTag, ValueType, head, rationals, text
from foundation.errors import InputError
from generator.files.metadata import ImageMetadata

SMALLEST_SIDE = 22
"""Photosites along a side below which LibRaw takes a file for no raw file."""

_SRGB: Matrix = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
"""From XYZ to linear sRGB, IEC 61966-2-1."""


def encode_dng(image: npt.NDArray[np.uint16], metadata: ImageMetadata) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, uncompressed."""
    height, width, _ = image.shape
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"an image of {width}x{height} px is too small for DNG: raw programs open none below "
            f"{SMALLEST_SIDE}x{SMALLEST_SIDE}; choose png or tiff"
        )
    neutral = _neutral(metadata)
    matrix = camera_matrix(metadata.camera) or _SRGB
    model = f"{metadata.camera} generated".strip()
    tags: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # the picture itself
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [width]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [height]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16]),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [CFA]),
        TiffTag.IMAGE_DESCRIPTION: text(metadata.to_json()),
        TiffTag.MAKE: text("CroP"),
        TiffTag.MODEL: text(model),
        TiffTag.ORIENTATION: (ValueType.SHORT, [1]),  # as it lies
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [1]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [height]),
        TiffTag.PLANAR_CONFIGURATION: (ValueType.SHORT, [1]),
        TiffTag.CFA_REPEAT_PATTERN_DIM: (ValueType.SHORT, [2, 2]),
        TiffTag.CFA_PATTERN: (ValueType.BYTE, [0, 1, 1, 2]),  # red, green, green, blue
        TiffTag.DNG_VERSION: (ValueType.BYTE, [1, 4, 0, 0]),
        TiffTag.DNG_BACKWARD_VERSION: (ValueType.BYTE, [1, 1, 0, 0]),
        TiffTag.UNIQUE_CAMERA_MODEL: text(f"CroP {model}"),
        TiffTag.CFA_PLANE_COLOR: (ValueType.BYTE, [0, 1, 2]),
        TiffTag.CFA_LAYOUT: (ValueType.SHORT, [1]),  # rectangular
        TiffTag.BLACK_LEVEL: (ValueType.SHORT, [0]),
        TiffTag.WHITE_LEVEL: (ValueType.SHORT, [metadata.white_level]),
        TiffTag.COLOR_MATRIX_1: (
            ValueType.SRATIONAL,
            [part for row in matrix for entry in row for part in (round(10000 * entry), 10000)],
        ),
        TiffTag.AS_SHOT_NEUTRAL: rationals(*neutral),
        TiffTag.CALIBRATION_ILLUMINANT_1: (ValueType.SHORT, [D65]),
    }
    try:
        start = head(tags, 2 * height * width)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for DNG: {error}; choose png, or make it smaller"
        ) from error
    return b"".join([start, mosaic_of(image).data])


def mosaic_of(image: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return the RGGB mosaic (H, W) uint16, little-endian, of `image` (H, W, 3) uint16.

    Examples
    --------
    >>> mosaic_of(np.full((2, 4, 3), (10, 20, 30), np.uint16))
    array([[10, 20, 10, 20],
           [20, 30, 20, 30]], dtype=uint16)
    """
    counts = np.empty(image.shape[:2], "<u2")
    counts[0::2, 0::2] = image[0::2, 0::2, 0]
    counts[0::2, 1::2] = image[0::2, 1::2, 1]
    counts[1::2, 0::2] = image[1::2, 0::2, 1]
    counts[1::2, 1::2] = image[1::2, 1::2, 2]
    return counts


def half_size(counts: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return linear RGB (H // 2, W // 2, 3) uint16 of an RGGB mosaic (H, W) uint16.

    Each 2×2 block becomes a pixel: red, the mean of both greens rounded up, blue.

    Examples
    --------
    >>> half_size(np.array([[10, 20], [25, 30]], np.uint16))
    array([[[10, 23, 30]]], dtype=uint16)
    """
    height, width = (size // 2 * 2 for size in counts.shape)
    image = np.empty((height // 2, width // 2, 3), np.uint16)
    image[..., 0] = counts[0:height:2, 0:width:2]
    greens = counts[0:height:2, 1:width:2].astype(np.uint32) + counts[1:height:2, 0:width:2]
    image[..., 1] = (greens + 1) // 2
    image[..., 2] = counts[1:height:2, 1:width:2]
    return image


def _neutral(metadata: ImageMetadata) -> tuple[float, float, float]:
    """Return the light's white over its largest channel, as AsShotNeutral has it."""
    if not 1 <= metadata.white_level <= 65535:
        raise InputError(f"the white level is {metadata.white_level}; DNG expects 1 to 65535")
    largest = max(metadata.white)
    if not all(math.isfinite(part) and part > largest * 1e-5 for part in metadata.white):
        raise InputError(
            f"the light's white is {metadata.white}, DNG expects every channel above 0; choose png, tiff, exr or jxl"
        )
    red, green, blue = (part / largest for part in metadata.white)
    return red, green, blue
