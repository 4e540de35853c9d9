"""Raw files of the simulated cameras: Adobe DNG 1.4, one uncompressed 16-bit colour-filter mosaic, the whole sensor.

What raw converters need to read it as they read a camera's own file: the visible part (ActiveArea) inside the masked
borders (MaskedAreas), the colour filters counted from the visible part's corner, black and white level, and the
exposure in an Exif directory. `Software` says that no camera took the picture. Written by hand, for the Exif directory
(LibRaw takes the ISO speed from nowhere else) and because it is one header before the counts as they lie in memory.
The same arguments give the same bytes.

Sources: TIFF 6.0 section 2, DNG 1.4 chapter 2 and 4, Exif 2.32 section 4.6.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from fractions import Fraction
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from drivers.camera import ExposureSettings
from sim.bodies import Body

SOFTWARE = "CroP simulated camera"

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_FORMATS = {_BYTE: "B", _ASCII: "B", _SHORT: "H", _LONG: "I", _RATIONAL: "II", _UNDEFINED: "B", _SRATIONAL: "ii"}
_HEADER = struct.pack("<2sHI", b"II", 42, 8)
_ALIGNMENT = 16
_EXIF = 34665
_STRIP_OFFSETS = 273
_CFA = 32803
_D65 = 21

# dcraw 9.28 `adobe_coeff`: XYZ to camera RGB under D65, 1/10000; converters make a viewable picture with it.
_COLOUR_MATRICES = {
    "Canon_EOS_600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon_EOS_200D": (7377, -742, -998, -4235, 11981, 2549, -673, 1918, 5538),
}

_Tags = dict[int, tuple[int, Sequence[int]]]


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
    stamp = _text(taken_at.astimezone(UTC).strftime("%Y:%m:%d %H:%M:%S"))
    exif: _Tags = {
        33434: _rational(settings.shutter_s),  # ExposureTime
        33437: _rational(settings.aperture),  # FNumber
        34855: (_SHORT, [settings.iso]),  # PhotographicSensitivity
        36864: (_UNDEFINED, b"0232"),  # ExifVersion
        36867: stamp,  # DateTimeOriginal
        36881: _text("+00:00"),  # OffsetTimeOriginal
        42033: _text(serial),  # BodySerialNumber
    }
    matrix = _COLOUR_MATRICES[body.sensitivities]
    main: _Tags = {
        254: (_LONG, [0]),  # NewSubfileType: the picture itself
        256: (_LONG, [columns]),
        257: (_LONG, [rows]),
        258: (_SHORT, [16]),  # BitsPerSample
        259: (_SHORT, [1]),  # Compression: none
        262: (_SHORT, [_CFA]),
        271: _text(body.maker),
        272: _text(body.model),
        _STRIP_OFFSETS: (_LONG, [0]),
        274: (_SHORT, [1]),  # Orientation: as it lies
        277: (_SHORT, [1]),  # SamplesPerPixel
        278: (_LONG, [rows]),  # RowsPerStrip
        279: (_LONG, [2 * rows * columns]),  # StripByteCounts
        284: (_SHORT, [1]),  # PlanarConfiguration
        305: _text(SOFTWARE),
        306: stamp,
        33421: (_SHORT, [2, 2]),  # CFARepeatPatternDim
        33422: (_BYTE, ["RGB".index(letter) for letter in body.pattern]),  # CFAPattern
        _EXIF: (_LONG, [0]),
        50706: (_BYTE, [1, 4, 0, 0]),  # DNGVersion
        50707: (_BYTE, [1, 1, 0, 0]),  # DNGBackwardVersion
        50708: _text(body.model),  # UniqueCameraModel
        50710: (_BYTE, [0, 1, 2]),  # CFAPlaneColor
        50711: (_SHORT, [1]),  # CFALayout: rectangular
        50714: (_SHORT, [body.black]),  # BlackLevel
        50717: (_SHORT, [body.saturation]),  # WhiteLevel
        50721: (_SRATIONAL, [part for entry in matrix for part in (entry, 10000)]),  # ColorMatrix1
        50728: _rational(*_neutral(matrix)),  # AsShotNeutral
        50735: _text(serial),  # CameraSerialNumber
        50778: (_SHORT, [_D65]),  # CalibrationIlluminant1
        50829: (_LONG, _edges(*body.visible)),  # ActiveArea
        50830: (_LONG, [edge for area in body.masked for edge in _edges(*area)]),  # MaskedAreas
    }
    exif_at = len(_HEADER) + len(_directory(main, 0))
    main[_EXIF] = (_LONG, [exif_at])
    end = exif_at + len(_directory(exif, 0))
    strip_at = end + -end % _ALIGNMENT
    main[_STRIP_OFFSETS] = (_LONG, [strip_at])
    stream.write(_HEADER + _directory(main, len(_HEADER)) + _directory(exif, exif_at) + bytes(strip_at - end))
    stream.write(np.ascontiguousarray(counts, dtype="<u2").data)


def _directory(tags: _Tags, at: int) -> bytes:
    """Return a TIFF directory that stands at byte `at` of the file, its longer values behind it; of even length."""
    entries = struct.pack("<H", len(tags))
    values = b""
    values_at = at + 2 + 12 * len(tags) + 4
    for code, (kind, numbers) in sorted(tags.items()):
        layout = _FORMATS[kind]
        value = struct.pack(f"<{len(numbers)}{layout[0]}", *numbers)
        entries += struct.pack("<HHI", code, kind, len(numbers) // len(layout))
        if len(value) <= 4:
            entries += value.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", values_at + len(values))
            values += value + bytes(len(value) % 2)
    return entries + struct.pack("<I", 0) + values


def _edges(top: int, left: int, height: int, width: int) -> tuple[int, int, int, int]:
    """Return top, left, bottom, right, as DNG has a rectangle."""
    return top, left, top + height, left + width


def _text(value: str) -> tuple[int, bytes]:
    return _ASCII, value.encode("ascii") + b"\0"


def _rational(*values: float | Fraction) -> tuple[int, list[int]]:
    near: Iterable[Fraction] = (Fraction(value).limit_denominator(100_000) for value in values)
    return _RATIONAL, [part for value in near for part in value.as_integer_ratio()]


def _neutral(matrix: Sequence[int]) -> list[Fraction]:
    """Return the camera RGB of D65 over its largest channel: what the matrix calls neutral."""
    white = (Fraction(9505, 10000), Fraction(1), Fraction(10891, 10000))
    seen = [sum(m * w for m, w in zip(matrix[i : i + 3], white, strict=True)) for i in (0, 3, 6)]
    return [Fraction(value) / Fraction(max(seen)) for value in seen]
