"""Cameras of the simulated room: sensor, colour filters, noise, and conversion of light to counts.

A `Body` describes a sensor; `counts` calculates the counts of any sensor. Photosites are numbered from the top left of
the sensor, including masked borders. Counts (DN) are the values in the raw file.

Sources: sizes and margins from dcraw 9.28 (`adobe_coeff` and the Canon table in `identify`), masked rectangles from
cameras.xml of rawspeed, saturation from camconst.json of RawTherapee. Gain and read noise were not measured on these
bodies, but are typical of EMVA 1288 measurements of such sensors.

Bodies in `SENSITIVITY_BODIES` are selected by the name of their sensitivities. Their sizes are the makers' numbers of
recorded pixels; the other values are typical of such sensors. A settings file can replace all these values.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from drivers.camera import camera_name
from foundation.compiled import compiled
from foundation.errors import ConfigurationError
from foundation.records import from_settings
from sim.spectral import Sensitivities, read_sensitivities


class Rectangle(NamedTuple):
    """Rectangle of photosites: first row and column, number of rows and columns."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True)
class Body:
    """Sensor, colour filters and noise of a camera."""

    maker: str  # As in raw files, for example ``Canon``
    model: str  # As in raw files, for example ``Canon EOS 550D``
    sensor: tuple[int, int]  # Rows and columns of the raw frame, including masked borders
    visible: Rectangle  # Photosites that receive light, as defined by raw converters
    pattern: str  # Colour filters of the 2×2 block at the top left of `visible`, by rows, for example ``RGGB``
    black: int  # Count without light, DN
    saturation: int  # Highest count, DN
    bits: int  # Bits per count
    electrons_per_dn: float  # Electrons per count at ISO 100; proportional to 100/ISO
    read_noise_dn: float  # Standard deviation of dark counts at ISO 100, DN
    # Part of the read noise that arises before the amplifier, electrons. In DN, it is proportional to the ISO speed.
    sensor_noise_e: float
    sensitivities: str  # Name in `sim.data`, or a file; see `sim.spectral.sensitivities`
    masked: tuple[Rectangle, ...]  # Rectangles covered from light, from which the black level is measured

    def __post_init__(self) -> None:
        rows, columns = self.sensor
        for area in (self.visible, *self.masked):
            if min(area) < 0 or area.top + area.height > rows or area.left + area.width > columns:
                raise ValueError(f"{self.model}: {area} is outside the sensor of {columns}×{rows} photosites")
        if sorted(self.pattern) != ["B", "G", "G", "R"]:
            raise ValueError(f"{self.model}: the pattern is {self.pattern!r}, expected one R, two G and one B")

    @property
    def camera(self) -> str:
        """Maker and model as in all messages."""
        return camera_name(self.maker, self.model)

    @property
    def half_size(self) -> tuple[int, int]:
        """Rows and columns of the half-size image."""
        return self.visible.height // 2, self.visible.width // 2

    def gain_e(self, iso: int) -> float:
        """Return electrons per DN at an ISO speed."""
        return self.electrons_per_dn * 100 / iso

    def noise_dn(self, iso: int) -> float:
        """Return the standard deviation of a dark count at an ISO speed, DN."""
        later_variance = self.read_noise_dn**2 - (self.sensor_noise_e / self.electrons_per_dn) ** 2
        return (later_variance + (self.sensor_noise_e / self.gain_e(iso)) ** 2) ** 0.5


@dataclass(frozen=True, eq=False)
class HotPattern:
    """Hot photosites: photosites with high dark current, the same in all frames.

    The excess is their dark signal. It is proportional to exposure time and ISO speed, and has the shot noise of its
    electrons.

    The number of hot photosites increases with age. It is proportional to size⁻³ of the photosites and to √ISO, by G.
    Chapman and others (DFT 2022, doi 10.1109/DFT56152.2022.9962368; size⁻²·⁵ in Proc. SPIE 7875 (2011)). At ISO 100,
    about 3 per million are hot on an EOS 550D (4.3 µm) after ten years. On an EOS 6D Mark II (5.7 µm), 0.4 per million
    are hot after three years. Hot photosites of new bodies are not included. The exponential distribution is an
    assumption.
    """

    rows: NDArray[np.int64]  # (H,) int64, ascending rows of the sensor
    columns: NDArray[np.int64]  # (H,) int64
    dn_per_s: NDArray[np.float64]  # (H,) float64, excess at ISO 100, DN per second

    @classmethod
    def drawn(cls, random: np.random.Generator, sensor: tuple[int, int], per_million: float, dn_per_s: float) -> Self:
        """Draw hot photosites at random positions, with exponentially distributed excess.

        `per_million`: number per million photosites. `dn_per_s`: mean excess at ISO 100, DN per second.
        """
        count = round(per_million * sensor[0] * sensor[1] / 1e6)
        index = np.sort(random.choice(sensor[0] * sensor[1], count, replace=False))
        return cls(index // sensor[1], index % sensor[1], random.exponential(dn_per_s, count))

    def within(self, first: int, last: int) -> HotPattern:
        """Return the hot photosites in the rows `first` to `last` − 1, with row numbers relative to `first`."""
        selected = slice(*np.searchsorted(self.rows, [first, last]).tolist())
        return HotPattern(self.rows[selected] - first, self.columns[selected], self.dn_per_s[selected])

    def raise_counts(
        self,
        frame: NDArray[np.uint16],
        noise: NDArray[np.float32],
        light_dn: NDArray[np.float64],
        body: Body,
        iso: int,
        shutter_s: float,
    ) -> None:
        """Write the counts of hot photosites into a frame.

        Parameters
        ----------
        frame
            (rows, columns) uint16, changed at hot photosites.
        noise
            (rows, columns) float32, standard normal values from which the noise of the frame was calculated.
        light_dn
            (H,) float64, signal of the light alone, DN above black.
        iso, shutter_s
            ISO speed, and exposure time in seconds.
        """
        signal = light_dn + self.excess_dn(iso, shutter_s)
        spread = np.sqrt(signal / body.gain_e(iso) + body.noise_dn(iso) ** 2)
        count = body.black + 0.5 + signal + spread * noise[self.rows, self.columns]
        frame[self.rows, self.columns] = np.clip(count, 0, body.saturation).astype(np.uint16)

    def excess_dn(self, iso: int, shutter_s: float) -> NDArray[np.float64]:
        """Return the excess (H,) float64 over ordinary photosites, DN, at an ISO speed and exposure time in seconds."""
        return self.dn_per_s * shutter_s * iso / 100


_EOS_550D = Body(
    maker="Canon",
    model="Canon EOS 550D",
    sensor=(3516, 5344),
    visible=Rectangle(51, 142, 3465, 5202),
    pattern="RGGB",
    black=2048,
    saturation=13584,
    bits=14,
    electrons_per_dn=1.8,
    read_noise_dn=6.0,
    sensor_noise_e=2.8,
    sensitivities="Canon_EOS_600D",
    masked=(Rectangle(0, 0, 3516, 140),),
)

_EOS_6D_MARK_II = Body(
    maker="Canon",
    model="Canon EOS 6D Mark II",
    sensor=(4224, 6384),
    visible=Rectangle(44, 120, 4180, 6264),
    pattern="RGGB",
    black=2048,
    saturation=16383,
    bits=14,
    electrons_per_dn=5.2,
    read_noise_dn=4.6,
    sensor_noise_e=2.4,
    sensitivities="Canon_EOS_200D",
    masked=(Rectangle(0, 0, 4224, 118),),
)

_TEST = replace(
    _EOS_550D,
    model="CroP Test",
    sensor=(609, 846),
    visible=Rectangle(51, 46, 557, 800),
    masked=(Rectangle(0, 0, 609, 44),),
)

# Cameras by the name in settings. ``Test`` has a small frame with the colours and noise of the EOS 550D.
BODIES: Mapping[str, Body] = MappingProxyType({"EOS 550D": _EOS_550D, "EOS 6D Mark II": _EOS_6D_MARK_II, "Test": _TEST})


# Typical numbers of masked rows above the image, and of masked columns to its left, on Canon sensors.
_BORDER: Final = (50, 140)


def _sensor_areas(width: int, height: int) -> dict[str, Any]:
    # Values of the fields `sensor`, `visible` and `masked` of `Body` for an image size.
    rows, columns = _BORDER
    sensor = height + rows, width + columns
    return {
        "sensor": sensor,
        "visible": Rectangle(rows, columns, height, width),
        "masked": (Rectangle(0, 0, sensor[0], columns - 2),),
    }


def _canon(
    name: str, size: tuple[int, int], black: int, saturation: int, gain_e: float, noise_dn: float, sensor_noise_e: float
) -> Body:
    # `size`: columns and rows of visible photosites.
    return replace(
        _EOS_550D,
        model=name.replace("_", " "),
        black=black,
        saturation=saturation,
        electrons_per_dn=gain_e,
        read_noise_dn=noise_dn,
        sensor_noise_e=sensor_noise_e,
        sensitivities=name,
        **_sensor_areas(*size),
    )


# The EOS 600D has a sensor of the same generation as the EOS 550D.
SENSITIVITY_BODIES: Final[Mapping[str, Body]] = MappingProxyType(
    {
        "Canon_EOS_600D": replace(BODIES["EOS 550D"], model="Canon EOS 600D"),
        "Canon_EOS_200D": _canon("Canon_EOS_200D", (6000, 4000), 2048, 16383, 2.3, 5.2, 2.4),
        "Canon_EOS-1Ds_Mark_III": _canon("Canon_EOS-1Ds_Mark_III", (5616, 3744), 1024, 15600, 3.6, 6.0, 3.2),
        "Canon_EOS_5D_Mark_II": _canon("Canon_EOS_5D_Mark_II", (5616, 3744), 1024, 15760, 4.2, 6.4, 2.5),
        "Canon_EOS_5DS": _canon("Canon_EOS_5DS", (8688, 5792), 2048, 15500, 2.4, 5.6, 2.5),
    }
)


def find_body(
    camera: str, changes: Mapping[str, Any] = MappingProxyType({}), where: str = "--settings", key: str = "camera"
) -> Body:
    """Return the camera with a name, or a camera with the sensitivities of a file, with changed properties.

    `where`, `key`: file or option that contains the changes, and the name of their table, for messages.
    """
    body = BODIES.get(camera) or _body_of_sensitivities(camera, read_sensitivities(camera, tuple(BODIES)))
    values = dict(changes)
    pixels = values.pop("pixels", None)
    if pixels is not None:
        values = _sensor_areas(*_checked_pixels(pixels, where, key)) | values
    properties = {field.name: getattr(body, field.name) for field in fields(Body)}
    changed = from_settings(Body, values, where, key, [*properties, "pixels"], **properties)
    _require_sensor(changed, where, key)
    return changed


def _body_of_sensitivities(camera: str, sensitivities: Sensitivities) -> Body:
    if camera in SENSITIVITY_BODIES:
        return SENSITIVITY_BODIES[camera]
    default = BODIES["EOS 550D"]
    return replace(default, maker=sensitivities.maker or "unknown", model=sensitivities.camera, sensitivities=camera)


def _checked_pixels(pixels: Any, where: str, key: str) -> tuple[int, int]:
    try:
        width, height = TypeAdapter(tuple[int, int]).validate_python(pixels)
    except ValidationError as error:
        raise ConfigurationError(
            f"{where}: {key}.pixels = {pixels!r}: expected two whole numbers, columns and rows, such as [5184, 3456]; "
            "correct it"
        ) from error
    if min(width, height) < 16:
        raise ConfigurationError(
            f"{where}: {key}.pixels = {pixels!r}: expected at least 16 columns and rows; correct it"
        )
    return width, height


def _require_sensor(body: Body, where: str, key: str) -> None:
    top = 2**body.bits - 1
    limits = (
        ("bits", body.bits, 8 <= body.bits <= 16, "8 to 16"),
        ("black", body.black, 0 <= body.black < body.saturation, f"0 to below saturation, {body.saturation}"),
        ("saturation", body.saturation, body.saturation <= top, f"at most {top} with {body.bits} bits"),
        ("electrons_per_dn", body.electrons_per_dn, body.electrons_per_dn > 0, "more than 0"),
        ("read_noise_dn", body.read_noise_dn, body.read_noise_dn >= 0, "0 or more"),
        (
            "sensor_noise_e",
            body.sensor_noise_e,
            0 <= body.sensor_noise_e <= body.read_noise_dn * body.electrons_per_dn,
            f"0 to the whole read noise, {body.read_noise_dn * body.electrons_per_dn:g} electrons",
        ),
    )
    for name, value, allowed, expected in limits:
        if not allowed:
            raise ConfigurationError(f"{where}: {key}.{name} is {value:g}, expected {expected}; correct it")


@compiled
def counts(
    light: NDArray[np.float32],
    weights: NDArray[np.float32],
    noise: NDArray[np.float32],
    first_column: int,
    black: float,
    read_noise: float,
    gain_e: float,
    saturation: int,
    out: NDArray[np.uint16],
) -> None:
    """Write the counts of some rows of the sensor.

    Counts are normally distributed with the variance signal / `gain_e` + read noise² (EMVA 1288 release 4.0 linear,
    section 2.2).

    Parameters
    ----------
    light
        (3, rows, visible columns) float32, from `sim.world.rendering.light`. For masked rows, an array with 0 columns.
    weights
        (3,) float32, exposure to each primary.
    noise
        (rows, sensor columns) float32, standard normal values.
    first_column
        First visible column.
    black, read_noise
        Mean and standard deviation of a dark count, DN.
    gain_e
        Electrons per DN.
    saturation
        Highest count.
    out
        (rows, sensor columns) uint16, written.
    """
    rows, columns = out.shape
    right = first_column + light.shape[2]
    top = np.float32(saturation)
    half = np.float32(black + 0.5)
    per_dn = np.float32(1 / gain_e)
    floor = np.float32(read_noise * read_noise)
    dark = np.float32(read_noise)
    red, green, blue = weights[0], weights[1], weights[2]
    zero = np.float32(0)
    for row in range(rows):
        for x in range(first_column):
            out[row, x] = np.uint16(min(max(half + dark * noise[row, x], zero), top))
        for x in range(first_column, right):
            i = x - first_column
            signal = red * light[0, row, i] + green * light[1, row, i] + blue * light[2, row, i]
            count = half + signal + math.sqrt(signal * per_dn + floor) * noise[row, x]
            out[row, x] = np.uint16(min(max(count, zero), top))
        for x in range(right, columns):
            out[row, x] = np.uint16(min(max(half + dark * noise[row, x], zero), top))
