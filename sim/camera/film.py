"""Frames of the simulated camera, and their raw files.

A `Film` makes the frames of a simulated camera and writes their raw files; `sim.camera.eos` simulates settings, file
names and timing. `WorldFilm` photographs the `World` under simulated light, `WatchedFilm` under the picture of a real
screen. Raw files are Adobe DNG 1.4 with one uncompressed 16-bit mosaic of the whole sensor. The tag `Software` marks
frames as simulated.

Sources: DNG 1.4 chapters 2 and 4, Exif 2.32 section 4.6.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from fractions import Fraction
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, Colour
from drivers.raw.rawfile import camera_matrix
from drivers.tiff import CFA, D65, Tags, TiffTag, ValueType, head, rationals, text
from foundation.clock import SIM_START
from foundation.errors import DeviceRefused
from sim.world.disturbances import CALM, Disturbances, Moment
from sim.world.sensors import Body
from sim.world.world import UNDISTURBED, World

SOFTWARE = "CroP simulated camera"

# XYZ to camera RGB under D65, in 1/10000, from dcraw 9.28 `adobe_coeff`. Raw converters need this matrix.
_COLOUR_MATRICES = {
    "Canon_EOS_600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon_EOS_200D": (7377, -742, -998, -4235, 11981, 2549, -673, 1918, 5538),
}

# XYZ to linear sRGB, in 1/10000 (IEC 61966-2-1), for unknown cameras. It keeps neutral colours neutral.
_LINEAR_SRGB = (32406, -15372, -4986, -9689, 18758, 415, 557, -2040, 10570)


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

    `counts`: (rows, columns) uint16, the whole sensor. `taken_at`: date with time zone, written as UTC in whole
    seconds.
    """
    if counts.shape != body.sensor:
        raise ValueError(f"counts are {counts.shape}, expected {body.sensor} as of the sensor of the {body.model}")
    if taken_at.tzinfo is None:
        raise ValueError(f"the date {taken_at} has no time zone, expected a time with one")
    rows, columns = body.sensor
    stamp = text(taken_at.astimezone(UTC).strftime("%Y:%m:%d %H:%M:%S"))
    exif: Tags = {
        TiffTag.EXPOSURE_TIME: rationals(settings.shutter_s),
        TiffTag.F_NUMBER: rationals(settings.aperture or 0),
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
        TiffTag.ORIENTATION: (ValueType.SHORT, [1]),  # not rotated
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
        TiffTag.COLOR_MATRIX_1: (ValueType.SRATIONAL, [number for entry in matrix for number in (entry, 10000)]),
        TiffTag.AS_SHOT_NEUTRAL: rationals(*_neutral(matrix)),
        TiffTag.CAMERA_SERIAL_NUMBER: text(serial),
        TiffTag.CALIBRATION_ILLUMINANT_1: (ValueType.SHORT, [D65]),
        TiffTag.ACTIVE_AREA: (ValueType.LONG, _edges(*body.visible)),
        TiffTag.MASKED_AREAS: (ValueType.LONG, [edge for area in body.masked for edge in _edges(*area)]),
    }
    stream.write(head(main, counts.nbytes, exif))
    stream.write(np.ascontiguousarray(counts, dtype="<u2").data)


def _edges(top: int, left: int, height: int, width: int) -> tuple[int, int, int, int]:
    return top, left, top + height, left + width


def _neutral(matrix: Sequence[int]) -> list[Fraction]:
    # AsShotNeutral: camera RGB of D65, relative to its largest channel.
    white = (Fraction(9505, 10000), Fraction(1), Fraction(10891, 10000))
    responses = [sum(m * w for m, w in zip(matrix[i : i + 3], white, strict=True)) for i in (0, 3, 6)]
    return [Fraction(value) / Fraction(max(responses)) for value in responses]


def _colour_matrix(body: Body) -> tuple[int, ...]:
    # XYZ to camera RGB in 1/10000: from the table, otherwise from LibRaw, otherwise linear sRGB.
    matrix = _COLOUR_MATRICES.get(body.sensitivities)
    if matrix is not None:
        return matrix
    rows = camera_matrix(body.camera)
    return _LINEAR_SRGB if rows is None else tuple(round(10_000 * value) for row in rows for value in row)


# First integer of the noise key of a `WatchedFilm`. It differs from all colour codes, with which the keys of a
# `WorldFilm` start.
_WATCHED_KEY = 256


class Film(Protocol):
    """Source of the frames of a simulated camera."""

    @property
    def suffix(self) -> str:
        """Suffix of the raw files, with dot."""
        ...

    def accept(self, settings: ExposureSettings) -> None:
        """Raise DeviceRefused for impossible settings."""
        ...

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> object:
        """Expose a frame now, and write its raw file."""
        ...


class WatchedFilm:
    """Frames of a `World` under measured light, in real time.

    `gather(number, seconds)` measures the light of an exposure with a number, from 0, and a duration. It waits until
    the exposure has ended, and returns two values: the mean projected picture (h, w, 3) float32, 0 to 1 of the full
    light of each primary, and the relative lamp brightness. `opened`: time from which lamp drift counts.
    """

    suffix = ".dng"

    def __init__(
        self,
        world: World,
        gather: Callable[[int, float], tuple[NDArray[np.float32], float]],
        serial: str,
        opened: datetime,
    ) -> None:
        self._world = world
        self._gather = gather
        self._serial = serial
        self._opened = opened
        self._frames = itertools.count()

    def accept(self, settings: ExposureSettings) -> None:
        """Raise DeviceRefused for impossible settings."""
        _accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> None:
        """Expose a frame now, for the exposure time, and write its raw file."""
        seconds = (released_at - self._opened).total_seconds()
        frame = next(self._frames)
        picture, lamp = self._gather(frame, settings.shutter_s)
        lamp *= 1 - self._world.room.lamp_drift_per_hour * seconds / 3600
        situation = replace(UNDISTURBED, picture=picture)
        counts = self._world.expose(BLACK, settings, key=(_WATCHED_KEY, frame), lamp=lamp, situation=situation)
        write_dng(into, counts, self._world.body, settings=settings, taken_at=released_at, serial=self._serial)


class WorldFilm:
    """Frames of a `World` under the light of the simulated projector.

    `look` returns the displayed colour, `light` the relative light output of the projector, 0 to 1. `exposed`: number
    of earlier frames by colour. `earlier_frames`: time in seconds and colour of each earlier frame.
    """

    suffix = ".dng"

    def __init__(
        self,
        world: World,
        look: Callable[[], Colour],
        light: Callable[[], float],
        serial: str,
        exposed: Mapping[Colour, int],
        disturbances: Disturbances = CALM,
        earlier_frames: Sequence[tuple[float, Colour]] = (),
    ) -> None:
        self._world = world
        self._look = look
        self._light = light
        self._serial = serial
        self._exposed = Counter(dict(exposed))
        self._disturbances = disturbances
        self._earlier_frames = list(earlier_frames)
        self._last: tuple[datetime, NDArray[np.uint16]] | None = None

    def accept(self, settings: ExposureSettings) -> None:
        """Raise DeviceRefused for impossible settings."""
        _accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> None:
        """Expose a frame now, and write its raw file."""
        colour = self._look()
        seconds = (released_at - SIM_START).total_seconds()
        moment = Moment(len(self._earlier_frames), seconds, colour, tuple(self._earlier_frames))
        lamp = self._light() * (1 - self._world.room.lamp_drift_per_hour * seconds / 3600)
        # The noise depends on the colour that the computer sent, even if a disturbance changes the displayed colour.
        key = (*colour, self._exposed[colour])
        self._exposed[colour] += 1
        self._earlier_frames.append((seconds, colour))
        if self._disturbances.events:
            taken_at, counts = self._disturbed(settings, released_at, moment, key, lamp)
        else:
            taken_at, counts = released_at, self._world.expose(colour, settings, key=key, lamp=lamp)
        write_dng(into, counts, self._world.body, settings=settings, taken_at=taken_at, serial=self._serial)

    def _disturbed(
        self, settings: ExposureSettings, released_at: datetime, moment: Moment, key: tuple[int, ...], lamp: float
    ) -> tuple[datetime, NDArray[np.uint16]]:
        """Return the date of the file and its counts, with the disturbances of the moment."""
        events, stale = self._disturbances, self._disturbances.stale(moment)
        if stale is None or self._last is None:
            colour, situation = events.shown(moment), events.situation(moment)
            counts = self._world.expose(colour, settings, key=key, lamp=lamp, situation=situation)
            taken_at, counts = released_at, events.counted(counts, moment)
        else:
            taken_at, counts = self._last
            taken_at = released_at if stale.new_header else taken_at
        if events.repeats_files:
            self._last = taken_at, counts
        return taken_at, counts


def _accept(settings: ExposureSettings) -> None:
    for name, value, low, high in (
        ("iso", settings.iso, 100, 6400),
        ("aperture", settings.aperture, 1.0, 32.0),
        ("shutter_s", settings.shutter_s, 1 / 8000, 30.0),
    ):
        if value is not None and not low <= value <= high:
            raise DeviceRefused(
                f"{name} is {value:g}, expected {low:g} to {high:g} on the simulated camera; correct it"
            )
