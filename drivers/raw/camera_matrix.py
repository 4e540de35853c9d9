"""The colour matrix of a camera, as LibRaw has it by name.

LibRaw holds a table of matrices and gives the entry of whatever raw file it opens, so a raw file of nothing but a
name, made here, is opened and its entry read. No matrix is copied into the suite.
"""

from __future__ import annotations

import io
from functools import lru_cache

from drivers.tiff.tags import CFA, TiffTag
from drivers.tiff.writing import Tags, ValueType, head, text

Matrix = tuple[tuple[float, float, float], ...]
"""Three rows R, G, B of three numbers: from CIE XYZ (D65, Y = 1) to linear camera RGB."""

_SIDE = 32
"""Photosites along a side of the file that is opened; LibRaw opens none below 22."""


@lru_cache(maxsize=64)
def camera_matrix(camera: str) -> Matrix | None:
    """Return the matrix of `camera`, maker and model as ``Canon EOS 550D``; None if LibRaw does not know it."""
    maker, _, model = camera.strip().partition(" ")
    if not model or not camera.isascii():
        return None
    import rawpy

    tags: Tags = {
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [_SIDE]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [_SIDE]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16]),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [CFA]),
        TiffTag.MAKE: text(maker),
        TiffTag.MODEL: text(camera),
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [1]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [_SIDE]),
        TiffTag.CFA_REPEAT_PATTERN_DIM: (ValueType.SHORT, [2, 2]),
        TiffTag.CFA_PATTERN: (ValueType.BYTE, [0, 1, 1, 2]),
        TiffTag.DNG_VERSION: (ValueType.BYTE, [1, 4, 0, 0]),
        TiffTag.UNIQUE_CAMERA_MODEL: text(camera),
    }
    pixels = bytes(2 * _SIDE * _SIDE)
    try:
        with rawpy.imread(io.BytesIO(head(tags, len(pixels)) + pixels)) as raw:
            rows = [tuple(float(number) for number in row) for row in raw.rgb_xyz_matrix[:3]]
    except rawpy.LibRawError:
        return None
    matrix = tuple((row[0], row[1], row[2]) for row in rows)
    return matrix if any(any(row) for row in matrix) else None
