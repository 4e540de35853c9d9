"""The tags of TIFF files that are read or written here, under the names that the standards give them.

Sources: TIFF 6.0, sections 8 and 15 and supplement 1 (SubIFDs); TIFF/EP (ISO 12234-2) for the colour filter array;
Exif 2.32, section 4.6; DNG 1.7.1, chapter 4. The one tag of Canon's is known from its CR2 files alone.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class TiffTag(IntEnum):
    """Tag codes of TIFF, TIFF/EP, Exif and DNG, and the one of CR2."""

    # TIFF 6.0
    NEW_SUBFILE_TYPE = 254
    IMAGE_WIDTH = 256
    IMAGE_LENGTH = 257
    BITS_PER_SAMPLE = 258
    COMPRESSION = 259
    PHOTOMETRIC_INTERPRETATION = 262
    IMAGE_DESCRIPTION = 270
    MAKE = 271
    MODEL = 272
    STRIP_OFFSETS = 273
    ORIENTATION = 274
    SAMPLES_PER_PIXEL = 277
    ROWS_PER_STRIP = 278
    STRIP_BYTE_COUNTS = 279
    PLANAR_CONFIGURATION = 284
    SOFTWARE = 305
    DATE_TIME = 306
    TILE_OFFSETS = 324
    TILE_BYTE_COUNTS = 325
    SUB_IFDS = 330
    SAMPLE_FORMAT = 339

    # TIFF/EP
    CFA_REPEAT_PATTERN_DIM = 33421
    CFA_PATTERN = 33422

    # Exif 2.32
    EXPOSURE_TIME = 33434
    F_NUMBER = 33437
    EXIF_IFD_POINTER = 34665
    PHOTOGRAPHIC_SENSITIVITY = 34855
    EXIF_VERSION = 36864
    DATE_TIME_ORIGINAL = 36867
    OFFSET_TIME_ORIGINAL = 36881
    FOCAL_LENGTH = 37386
    FOCAL_PLANE_X_RESOLUTION = 41486
    FOCAL_PLANE_RESOLUTION_UNIT = 41488
    BODY_SERIAL_NUMBER = 42033
    LENS_MODEL = 42036

    # DNG 1.7.1
    DNG_VERSION = 50706
    DNG_BACKWARD_VERSION = 50707
    UNIQUE_CAMERA_MODEL = 50708
    CFA_PLANE_COLOR = 50710
    CFA_LAYOUT = 50711
    LINEARIZATION_TABLE = 50712
    BLACK_LEVEL_REPEAT_DIM = 50713
    BLACK_LEVEL = 50714
    BLACK_LEVEL_DELTA_H = 50715
    BLACK_LEVEL_DELTA_V = 50716
    WHITE_LEVEL = 50717
    COLOR_MATRIX_1 = 50721
    AS_SHOT_NEUTRAL = 50728
    CAMERA_SERIAL_NUMBER = 50735
    CALIBRATION_ILLUMINANT_1 = 50778
    ACTIVE_AREA = 50829
    MASKED_AREAS = 50830

    # Canon CR2: widths of the vertical slices in which the raw pixels are stored
    CR2_SLICES = 50752


RGB: Final = 2
"""PhotometricInterpretation of red, green and blue (TIFF 6.0, section 8)."""

CFA: Final = 32803
"""PhotometricInterpretation of a colour filter array (TIFF/EP)."""

D65: Final = 21
"""LightSource of daylight of 6504 K (Exif 2.32, section 4.6.5), as in DNG's CalibrationIlluminant."""
