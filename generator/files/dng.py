"""Adobe DNG: the image as the Bayer mosaic of a raw file, which raw programs open with the right white balance.

Each photosite of the RGGB pattern takes its own channel of its pixel; two thirds of the values are left out, as by a
sensor. Black is 0, white the table's saturation, AsShotNeutral the ground truth: what a raw program shows is neutral
where the scene is. The colour matrix is the one that LibRaw holds for the table's camera, or, for a camera that it
does not know, that of linear sRGB: neutral things stay neutral with either, colours are only the camera's with the
first. The file names CroP as its maker, so that no program applies to it what it knows of the camera's own files, such
as their black level.

Source: DNG 1.7.1, chapters 2 and 4.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from drivers.raw.camera_matrix import Matrix, camera_matrix
from drivers.tiff.reading import CFA
from drivers.tiff.writing import Kind, Tags, head, rationals, text
from foundation.errors import InputError
from generator.files.shot import Shot

SMALLEST_SIDE = 22
"""Photosites along a side below which LibRaw takes a file for no raw file."""

_D65 = 21
_SRGB: Matrix = ((3.2406, -1.5372, -0.4986), (-0.9689, 1.8758, 0.0415), (0.0557, -0.2040, 1.0570))
"""From XYZ to linear sRGB, IEC 61966-2-1."""


def encode_dng(image: npt.NDArray[np.uint16], shot: Shot) -> bytes:
    """Return the file of `image` (H, W, 3) uint16, uncompressed.

    Raises
    ------
    InputError
        The image is smaller than raw programs open or larger than the format holds, or the shot's white level or
        white cannot be written.
    """
    height, width, _ = image.shape
    if min(height, width) < SMALLEST_SIDE:
        raise InputError(
            f"an image of {width}x{height} px is too small for DNG: raw programs open none below "
            f"{SMALLEST_SIDE}x{SMALLEST_SIDE}; choose png or tiff"
        )
    neutral = _neutral(shot)
    matrix = camera_matrix(shot.camera) or _SRGB
    model = f"{shot.camera} generated".strip()
    tags: Tags = {
        254: (Kind.LONG, [0]),  # NewSubfileType: the picture itself
        256: (Kind.LONG, [width]),
        257: (Kind.LONG, [height]),
        258: (Kind.SHORT, [16]),  # BitsPerSample
        259: (Kind.SHORT, [1]),  # Compression: none
        262: (Kind.SHORT, [CFA]),
        270: text(shot.note()),  # ImageDescription
        271: text("CroP"),  # Make
        272: text(model),
        274: (Kind.SHORT, [1]),  # Orientation: as it lies
        277: (Kind.SHORT, [1]),  # SamplesPerPixel
        278: (Kind.LONG, [height]),  # RowsPerStrip
        284: (Kind.SHORT, [1]),  # PlanarConfiguration
        33421: (Kind.SHORT, [2, 2]),  # CFARepeatPatternDim
        33422: (Kind.BYTE, [0, 1, 1, 2]),  # CFAPattern: red, green, green, blue
        50706: (Kind.BYTE, [1, 4, 0, 0]),  # DNGVersion
        50707: (Kind.BYTE, [1, 1, 0, 0]),  # DNGBackwardVersion
        50708: text(f"CroP {model}"),  # UniqueCameraModel
        50710: (Kind.BYTE, [0, 1, 2]),  # CFAPlaneColor
        50711: (Kind.SHORT, [1]),  # CFALayout: rectangular
        50714: (Kind.SHORT, [0]),  # BlackLevel
        50717: (Kind.SHORT, [shot.white_level]),  # WhiteLevel
        50721: (Kind.SRATIONAL, [part for row in matrix for entry in row for part in (round(10000 * entry), 10000)]),
        50728: rationals(*neutral),  # AsShotNeutral
        50778: (Kind.SHORT, [_D65]),  # CalibrationIlluminant1
    }
    try:
        start = head(tags, 2 * height * width)
    except ValueError as error:
        raise InputError(
            f"an image of {width}x{height} px is too large for DNG: {error}; choose png, or make it smaller"
        ) from error
    return b"".join([start, mosaic_of(image).data])


def mosaic_of(image: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return what an RGGB sensor keeps of `image` (H, W, 3): (H, W) uint16, little-endian."""
    counts = np.empty(image.shape[:2], "<u2")
    counts[0::2, 0::2] = image[0::2, 0::2, 0]
    counts[0::2, 1::2] = image[0::2, 1::2, 1]
    counts[1::2, 0::2] = image[1::2, 0::2, 1]
    counts[1::2, 1::2] = image[1::2, 1::2, 2]
    return counts


def half_size(counts: npt.NDArray[np.uint16]) -> npt.NDArray[np.uint16]:
    """Return linear RGB (H // 2, W // 2, 3) uint16 of an RGGB mosaic: red, mean of both greens rounded up, blue."""
    height, width = (size // 2 * 2 for size in counts.shape)
    image = np.empty((height // 2, width // 2, 3), np.uint16)
    image[..., 0] = counts[0:height:2, 0:width:2]
    greens = counts[0:height:2, 1:width:2].astype(np.uint32) + counts[1:height:2, 0:width:2]
    image[..., 1] = (greens + 1) // 2
    image[..., 2] = counts[1:height:2, 1:width:2]
    return image


def _neutral(shot: Shot) -> tuple[float, float, float]:
    """Return the light's white over its largest channel."""
    if not 1 <= shot.white_level <= 65535:
        raise InputError(f"the white level is {shot.white_level}; DNG expects 1 to 65535")
    largest = max(shot.white)
    if not all(math.isfinite(part) and part > largest * 1e-5 for part in shot.white):
        raise InputError(
            f"the light's white is {shot.white}, DNG expects every channel above 0; choose png, tiff, exr or jxl"
        )
    red, green, blue = (part / largest for part in shot.white)
    return red, green, blue
