"""Raw files of the simulated cameras: Adobe DNG 1.4, one uncompressed 16-bit colour-filter mosaic, the whole sensor.

What raw converters need to read it as they read a camera's own file: the visible part (ActiveArea) inside the masked
borders (MaskedAreas), the colour filters counted from the visible part's corner, black and white level, and the
exposure in an Exif directory. `Software` says that no camera took the picture. Laid out by
`drivers.tiff.writing`, for the Exif directory (LibRaw takes the ISO speed from nowhere else) and because it is one head
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
from drivers.tiff.reading import CFA
from drivers.tiff.writing import Kind, Tags, head, rationals, text
from sim.camera.sensors import Body

SOFTWARE = "CroP simulated camera"

_D65 = 21

# dcraw 9.28 `adobe_coeff`: XYZ to camera RGB under D65, 1/10000; converters make a viewable picture with it.
_COLOUR_MATRICES = {
    "Canon_EOS_600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon_EOS_200D": (7377, -742, -998, -4235, 11981, 2549, -673, 1918, 5538),
}


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

    Parameters
    ----------
    stream
        Receives the whole file, from where it stands; need not seek.
    counts
        (rows, columns) uint16, the whole sensor's counts.
    body
        Whose file it is.
    settings
        How the frame was exposed.
    taken_at
        When, timezone-aware; written as UTC, to the second.
    serial
        Serial number of the body.

    Raises
    ------
    ValueError
        The counts do not have the body's shape, or the time has no timezone.
    """
    if counts.shape != body.sensor:
        raise ValueError(f"counts are {counts.shape}; the sensor of the {body.model} is {body.sensor}")
    if taken_at.tzinfo is None:
        raise ValueError(f"{taken_at} has no timezone")
    rows, columns = body.sensor
    stamp = text(taken_at.astimezone(UTC).strftime("%Y:%m:%d %H:%M:%S"))
    exif: Tags = {
        33434: rationals(settings.shutter_s),  # ExposureTime
        33437: rationals(settings.aperture),  # FNumber
        34855: (Kind.SHORT, [settings.iso]),  # PhotographicSensitivity
        36864: (Kind.UNDEFINED, b"0232"),  # ExifVersion
        36867: stamp,  # DateTimeOriginal
        36881: text("+00:00"),  # OffsetTimeOriginal
        42033: text(serial),  # BodySerialNumber
    }
    matrix = _COLOUR_MATRICES[body.sensitivities]
    main: Tags = {
        254: (Kind.LONG, [0]),  # NewSubfileType: the picture itself
        256: (Kind.LONG, [columns]),
        257: (Kind.LONG, [rows]),
        258: (Kind.SHORT, [16]),  # BitsPerSample
        259: (Kind.SHORT, [1]),  # Compression: none
        262: (Kind.SHORT, [CFA]),
        271: text(body.maker),
        272: text(body.model),
        274: (Kind.SHORT, [1]),  # Orientation: as it lies
        277: (Kind.SHORT, [1]),  # SamplesPerPixel
        278: (Kind.LONG, [rows]),  # RowsPerStrip
        284: (Kind.SHORT, [1]),  # PlanarConfiguration
        305: text(SOFTWARE),
        306: stamp,
        33421: (Kind.SHORT, [2, 2]),  # CFARepeatPatternDim
        33422: (Kind.BYTE, ["RGB".index(letter) for letter in body.pattern]),  # CFAPattern
        50706: (Kind.BYTE, [1, 4, 0, 0]),  # DNGVersion
        50707: (Kind.BYTE, [1, 1, 0, 0]),  # DNGBackwardVersion
        50708: text(body.model),  # UniqueCameraModel
        50710: (Kind.BYTE, [0, 1, 2]),  # CFAPlaneColor
        50711: (Kind.SHORT, [1]),  # CFALayout: rectangular
        50714: (Kind.SHORT, [body.black]),  # BlackLevel
        50717: (Kind.SHORT, [body.saturation]),  # WhiteLevel
        50721: (Kind.SRATIONAL, [part for entry in matrix for part in (entry, 10000)]),  # ColorMatrix1
        50728: rationals(*_neutral(matrix)),  # AsShotNeutral
        50735: text(serial),  # CameraSerialNumber
        50778: (Kind.SHORT, [_D65]),  # CalibrationIlluminant1
        50829: (Kind.LONG, _edges(*body.visible)),  # ActiveArea
        50830: (Kind.LONG, [edge for area in body.masked for edge in _edges(*area)]),  # MaskedAreas
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
