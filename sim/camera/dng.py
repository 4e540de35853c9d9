"""Raw files of the simulated cameras: Adobe DNG 1.4, one uncompressed 16-bit colour-filter mosaic, the whole sensor.

What raw converters need to read it as they read a camera's own file: the visible part (ActiveArea) inside the masked
borders (MaskedAreas), the colour filters counted from the visible part's corner, black and white level, and the
exposure in an Exif directory. `Software` says that no camera took the picture. Laid out by
`drivers.tiff`, for the Exif directory (LibRaw takes the ISO speed from nowhere else) and because it is one head
before the counts as they lie in memory. The same arguments give the same bytes.

Sources: DNG 1.4 chapter 2 and 4, Exif 2.32 section 4.6.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from fractions import Fraction
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from drivers.camera import ExposureSettings
from drivers.tiff import CFA, D65, Tags, TiffTag, ValueType, head, rationals, text
from sim.world.sensors import Body

SOFTWARE = "CroP simulated camera"

# dcraw 9.28 `adobe_coeff`: XYZ to camera RGB under D65, 1/10000; converters make a viewable picture with it.
_COLOUR_MATRICES = {
    "Canon_EOS_600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon_EOS_200D": (7377, -742, -998, -4235, 11981, 2549, -673, 1918, 5538),
}
_LINEAR_SRGB = (32406, -15372, -4986, -9689, 18758, 415, 557, -2040, 10570)
"""XYZ to linear sRGB (IEC 61966-2-1): neutral things stay neutral for a camera that no converter knows."""


def write_dng(
    stream: BinaryIO,
    counts: NDArray[np.uint16],
    body: Body,
    *,
    settings: ExposureSettings,
    taken_at: datetime,
    serial: str = "000000000000",
) -> None:
    """Write one raw file.

    `counts`: (rows, columns) uint16, the whole sensor's counts. `taken_at`: when, timezone-aware; written as UTC, to
    the second.
    """
    if counts.shape != body.sensor:
        raise ValueError(f"counts are {counts.shape}; the sensor of the {body.model} is {body.sensor}")
    if taken_at.tzinfo is None:
        raise ValueError(f"{taken_at} has no timezone")
    rows, columns = body.sensor
    stamp = text(taken_at.astimezone(UTC).strftime("%Y:%m:%d %H:%M:%S"))
    exif: Tags = {
        TiffTag.EXPOSURE_TIME: rationals(settings.shutter_s),
        TiffTag.F_NUMBER: rationals(settings.aperture),
        TiffTag.PHOTOGRAPHIC_SENSITIVITY: (ValueType.SHORT, [settings.iso]),
        TiffTag.EXIF_VERSION: (ValueType.UNDEFINED, b"0232"),
        TiffTag.DATE_TIME_ORIGINAL: stamp,
        TiffTag.OFFSET_TIME_ORIGINAL: text("+00:00"),
        TiffTag.BODY_SERIAL_NUMBER: text(serial),
    }
    matrix = _colour_matrix(body)
    main: Tags = {
        TiffTag.NEW_SUBFILE_TYPE: (ValueType.LONG, [0]),  # the picture itself
        TiffTag.IMAGE_WIDTH: (ValueType.LONG, [columns]),
        TiffTag.IMAGE_LENGTH: (ValueType.LONG, [rows]),
        TiffTag.BITS_PER_SAMPLE: (ValueType.SHORT, [16]),
        TiffTag.COMPRESSION: (ValueType.SHORT, [1]),  # none
        TiffTag.PHOTOMETRIC_INTERPRETATION: (ValueType.SHORT, [CFA]),
        TiffTag.MAKE: text(body.maker),
        TiffTag.MODEL: text(body.model),
        TiffTag.ORIENTATION: (ValueType.SHORT, [1]),  # as it lies
        TiffTag.SAMPLES_PER_PIXEL: (ValueType.SHORT, [1]),
        TiffTag.ROWS_PER_STRIP: (ValueType.LONG, [rows]),
        TiffTag.PLANAR_CONFIGURATION: (ValueType.SHORT, [1]),
        TiffTag.SOFTWARE: text(SOFTWARE),
        TiffTag.DATE_TIME: stamp,
        TiffTag.CFA_REPEAT_PATTERN_DIM: (ValueType.SHORT, [2, 2]),
        TiffTag.CFA_PATTERN: (ValueType.BYTE, ["RGB".index(letter) for letter in body.pattern]),
        TiffTag.DNG_VERSION: (ValueType.BYTE, [1, 4, 0, 0]),
        TiffTag.DNG_BACKWARD_VERSION: (ValueType.BYTE, [1, 1, 0, 0]),
        TiffTag.UNIQUE_CAMERA_MODEL: text(body.model),
        TiffTag.CFA_PLANE_COLOR: (ValueType.BYTE, [0, 1, 2]),
        TiffTag.CFA_LAYOUT: (ValueType.SHORT, [1]),  # rectangular
        TiffTag.BLACK_LEVEL: (ValueType.SHORT, [body.black]),
        TiffTag.WHITE_LEVEL: (ValueType.SHORT, [body.saturation]),
        TiffTag.COLOR_MATRIX_1: (ValueType.SRATIONAL, [part for entry in matrix for part in (entry, 10000)]),
        TiffTag.AS_SHOT_NEUTRAL: rationals(*_neutral(matrix)),
        TiffTag.CAMERA_SERIAL_NUMBER: text(serial),
        TiffTag.CALIBRATION_ILLUMINANT_1: (ValueType.SHORT, [D65]),
        TiffTag.ACTIVE_AREA: (ValueType.LONG, _edges(*body.visible)),
        TiffTag.MASKED_AREAS: (ValueType.LONG, [edge for area in body.masked for edge in _edges(*area)]),
    }
    stream.write(head(main, counts.nbytes, exif))
    stream.write(np.ascontiguousarray(counts, dtype="<u2").data)


def _edges(top: int, left: int, height: int, width: int) -> tuple[int, int, int, int]:
    """Return top, left, bottom, right, as DNG has a rectangle."""
    return top, left, top + height, left + width


def _neutral(matrix: Sequence[int]) -> list[Fraction]:
    """Return the camera RGB of D65 over its largest channel: what the matrix calls neutral."""
    white = (Fraction(9505, 10000), Fraction(1), Fraction(10891, 10000))
    seen = [sum(m * w for m, w in zip(matrix[i : i + 3], white, strict=True)) for i in (0, 3, 6)]
    return [Fraction(value) / Fraction(max(seen)) for value in seen]


def _colour_matrix(body: Body) -> tuple[int, ...]:
    """Return XYZ to camera RGB in ten-thousandths: of the known bodies, as LibRaw has it, or that of linear sRGB."""
    known = _COLOUR_MATRICES.get(body.sensitivities)
    if known is not None:
        return known
    from drivers.raw.rawfile import camera_matrix

    rows = camera_matrix(body.camera)
    return _LINEAR_SRGB if rows is None else tuple(round(10_000 * value) for row in rows for value in row)
