"""What is on a simulated camera's pictures, apart from how its body behaves, and the raw files that hold it.

`sim.camera.eos` has settings, names and time; a `Film` makes the picture: the `World` as it is lit now (`WorldFilm`)
or by a real screen (`WatchedFilm`). Raw files are Adobe DNG 1.4, one uncompressed 16-bit mosaic of the whole sensor,
with what raw converters need to read it as a camera's own file; `Software` says that no camera took the picture.

Sources: DNG 1.4 chapter 2 and 4, Exif 2.32 section 4.6.
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

# dcraw 9.28 `adobe_coeff`: XYZ to camera RGB under D65, 1/10000; converters make a viewable picture with it.
_COLOUR_MATRICES = {
    "Canon_EOS_600D": (6461, -907, -882, -4300, 12184, 2378, -819, 1944, 5931),
    "Canon_EOS_200D": (7377, -742, -998, -4235, 11981, 2549, -673, 1918, 5538),
}
# XYZ to linear sRGB (IEC 61966-2-1): neutral things stay neutral for a camera that no converter knows.
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
    rows = camera_matrix(body.camera)
    return _LINEAR_SRGB if rows is None else tuple(round(10_000 * value) for row in rows for value in row)


_WATCHED = 256  # First part of the key of a watched frame's noise: no code, so that it is no other frame's


class Film(Protocol):
    """Where a simulated camera's pictures come from."""

    @property
    def suffix(self) -> str:
        """Suffix of the raw files, with its dot."""
        ...

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse settings that no picture can be had with (DeviceRefused)."""
        ...

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> object:
        """Write the raw file of a picture taken now."""
        ...


class WatchedFilm:
    """Pictures of a `World` lit by what falls on it from outside while the shutter is open, in real time.

    `gather`: called with the number of the exposure, from 0, and its seconds; waits for them and returns the light that
    fell on the chart meanwhile: the projected picture (h, w, 3) float32, 0 … 1 of each primary's full light, and the
    share of the lamp's light.
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
        """Refuse what no such body has."""
        _accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> None:
        """Photograph the world as it is lit from now on, for the exposure's time."""
        seconds = (released_at - self._opened).total_seconds()
        frame = next(self._frames)
        picture, lamp = self._gather(frame, settings.shutter_s)
        lamp *= 1 - self._world.room.lamp_drift_per_hour * seconds / 3600
        situation = replace(UNDISTURBED, picture=picture)
        counts = self._world.expose(BLACK, settings, key=(_WATCHED, frame), lamp=lamp, situation=situation)
        write_dng(into, counts, self._world.body, settings=settings, taken_at=released_at, serial=self._serial)


class WorldFilm:
    """Pictures of a `World` lit by what the projector shows.

    `light`: tells the share of its light that leaves the projector now, 0 … 1.
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
        before: Sequence[tuple[float, Colour]] = (),
    ) -> None:
        self._world = world
        self._look = look
        self._light = light
        self._serial = serial
        self._exposed = Counter(dict(exposed))
        self._disturbances = disturbances
        self._before = list(before)
        self._last: tuple[datetime, NDArray[np.uint16]] | None = None

    def accept(self, settings: ExposureSettings) -> None:
        """Refuse what no such body has."""
        _accept(settings)

    def expose(self, settings: ExposureSettings, released_at: datetime, into: BinaryIO) -> None:
        """Photograph the world as it is lit now."""
        colour = self._look()
        seconds = (released_at - SIM_START).total_seconds()
        moment = Moment(len(self._before), seconds, colour, tuple(self._before))
        lamp = self._light() * (1 - self._world.room.lamp_drift_per_hour * seconds / 3600)
        # The noise is that of the frame that was ordered, whatever there is to see.
        key = (*colour, self._exposed[colour])
        self._exposed[colour] += 1
        self._before.append((seconds, colour))
        if self._disturbances.events:
            taken_at, counts = self._disturbed(settings, released_at, moment, key, lamp)
        else:
            taken_at, counts = released_at, self._world.expose(colour, settings, key=key, lamp=lamp)
        write_dng(into, counts, self._world.body, settings=settings, taken_at=taken_at, serial=self._serial)

    def _disturbed(
        self, settings: ExposureSettings, released_at: datetime, moment: Moment, key: tuple[int, ...], lamp: float
    ) -> tuple[datetime, NDArray[np.uint16]]:
        """Return when the file says that it was taken, and its counts, where something may be wrong at a moment."""
        events, stale = self._disturbances, self._disturbances.stale(moment)
        if stale is None or self._last is None:
            shown, situation = events.shown(moment), events.situation(moment)
            counts = self._world.expose(shown, settings, key=key, lamp=lamp, situation=situation)
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
            raise DeviceRefused(f"the simulated camera offers {name} {low:g} … {high:g}, not {value:g}")
