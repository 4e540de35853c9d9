"""The camera bodies that the simulated room can be photographed with: sensors, colour filters, noise, light to counts.

A body is a table of facts, without behaviour; `counts` is what all sensors do. Photosites count from the sensor's
top-left corner, masked borders included, unless said; a count is what the raw file holds (DN).

Sizes and margins: dcraw 9.28 (`adobe_coeff` and the Canon table in `identify`), masked rectangles: rawspeed's
cameras.xml. Saturation: RawTherapee's camconst.json. Conversion gain and read noise: of the order that EMVA 1288
photon transfer gives for sensors of these generations; plausible, not measured on these bodies.

**Bodies for any sensitivities** have known facts by name and plausible ones for the rest. Sizes are the makers'
numbers of recorded pixels. Borders, black, saturation, conversion gain and read noise are of the order that such
sensors have: plausible, not measured on these bodies. Whoever knows better says so in a settings file.
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

from foundation.compiled import compiled
from foundation.errors import ConfigurationError
from foundation.records import from_settings
from sim.spectral import Sensitivities, read_sensitivities


class Rectangle(NamedTuple):
    """A rectangle of photosites: first row and column, then the number of rows and columns."""

    top: int
    left: int
    height: int
    width: int


@dataclass(frozen=True)
class Body:
    """A camera body.

    - `maker`, `model`: as the body writes them into its files, e.g. ``Canon`` and ``Canon EOS 550D``.
    - `sensor`: rows and columns of the raw frame, masked borders included.
    - `visible`: the photosites that see light, as the raw converters have them.
    - `pattern`: colour filters of the 2×2 block at the top-left of `visible`, row by row, e.g. ``RGGB``.
    - `black`: count of a photosite without light, DN.
    - `saturation`: count that no photosite exceeds, DN.
    - `bits`: bits of a count.
    - `electrons_per_dn`: electrons that raise the count by one at ISO 100; at another speed ×100/ISO.
    - `read_noise_dn`: standard deviation of a dark count at ISO 100, DN.
    - `sensor_noise_e`: the share of the read noise that arises before the amplifier, electrons: it grows with the ISO
      speed in DN, the rest does not.
    - `sensitivities`: name of the spectral sensitivities in `sim.data`, see `sim.spectral.sensitivities`.
    - `masked`: rectangles of the sensor that are covered and measure black.
    """

    maker: str
    model: str
    sensor: tuple[int, int]
    visible: Rectangle
    pattern: str
    black: int
    saturation: int
    bits: int
    electrons_per_dn: float
    read_noise_dn: float
    sensor_noise_e: float
    sensitivities: str
    masked: tuple[Rectangle, ...]

    def __post_init__(self) -> None:
        rows, columns = self.sensor
        for area in (self.visible, *self.masked):
            if min(area) < 0 or area.top + area.height > rows or area.left + area.width > columns:
                raise ValueError(f"{self.model}: {area} lies outside the sensor of {columns}×{rows} photosites")
        if sorted(self.pattern) != ["B", "G", "G", "R"]:
            raise ValueError(f"{self.model}: pattern is {self.pattern!r}; one R, two G and one B are expected")

    @property
    def camera(self) -> str:
        """Maker and model, the maker once, as `drivers.raw.rawfile` reads them from the body's files."""
        words = self.model.split(" ")
        known = not self.maker or words[0].casefold() == self.maker.split(" ")[0].casefold()
        return self.model if known else f"{self.maker} {self.model}"

    @property
    def half_size(self) -> tuple[int, int]:
        """Rows and columns of the half-size image, whole 2×2 blocks of the visible mosaic."""
        return self.visible.height // 2, self.visible.width // 2

    def gain_e(self, iso: int) -> float:
        """Return electrons per DN at an ISO speed."""
        return self.electrons_per_dn * 100 / iso

    def noise_dn(self, iso: int) -> float:
        """Return the standard deviation of a dark count at an ISO speed, DN."""
        late = self.read_noise_dn**2 - (self.sensor_noise_e / self.electrons_per_dn) ** 2
        return (late + (self.sensor_noise_e / self.gain_e(iso)) ** 2) ** 0.5


@dataclass(frozen=True, eq=False)
class HotPattern:
    """Photosites whose dark current is out of proportion, the same ones in every frame.

    Their excess is proportional to the exposure time and to the gain, and has the shot noise of its electrons. How many
    a body has grows with its age and falls with the size of its photosites: some 128 on a sensor of 20 million of
    4 µm after 3.2 years, as they show at ISO 3200, in proportion to size⁻³ and √ISO (G. Chapman and others, DFT 2022,
    doi 10.1109/DFT56152.2022.9962368; size⁻²·⁵ in Proc. SPIE 7875 (2011)). That makes for ISO 100 some 3 a million on
    an EOS 550D (4.3 µm) of ten years and 0.4 on an EOS 6D Mark II (5.7 µm) of three, besides those that a body is
    delivered with, which we did not find counted. Exponential distribution: chosen.

    - `rows`, `columns`: (H,) int64, photosites of the sensor, by rising row.
    - `dn_per_s`: (H,) float64, excess at ISO 100, DN per second.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    dn_per_s: NDArray[np.float64]

    @classmethod
    def drawn(cls, random: np.random.Generator, sensor: tuple[int, int], per_million: float, dn_per_s: float) -> Self:
        """Return hot photosites anywhere on a sensor, their excess exponentially distributed about a mean.

        `per_million`: how many of a million photosites; rounded to whole photosites on the sensor. `dn_per_s`: mean
        excess at ISO 100, DN per second.
        """
        count = round(per_million * sensor[0] * sensor[1] / 1e6)
        place = np.sort(random.choice(sensor[0] * sensor[1], count, replace=False))
        return cls(place // sensor[1], place % sensor[1], random.exponential(dn_per_s, count))

    def within(self, first: int, last: int) -> HotPattern:
        """Return those in rows first … last − 1, their rows counted from the first."""
        some = slice(*np.searchsorted(self.rows, [first, last]).tolist())
        return HotPattern(self.rows[some] - first, self.columns[some], self.dn_per_s[some])

    def raise_counts(
        self,
        frame: NDArray[np.uint16],
        noise: NDArray[np.float32],
        light_dn: NDArray[np.float64],
        body: Body,
        iso: int,
        shutter_s: float,
    ) -> None:
        """Write the counts of hot photosites into a frame, by the photon transfer that ordinary ones have.

        `frame`: (rows, columns) uint16 counts, changed where a photosite is hot. `noise`: (rows, columns) float32, the
        standard normal deviates that the frame was made with. `light_dn`: (H,) float64, what light alone gives each of
        them, DN above black. `iso`, `shutter_s`: ISO speed, and exposure time in seconds.
        """
        signal = light_dn + self.excess_dn(iso, shutter_s)
        spread = np.sqrt(signal / body.gain_e(iso) + body.noise_dn(iso) ** 2)
        count = body.black + 0.5 + signal + spread * noise[self.rows, self.columns]
        frame[self.rows, self.columns] = np.clip(count, 0, body.saturation).astype(np.uint16)

    def excess_dn(self, iso: int, shutter_s: float) -> NDArray[np.float64]:
        """Return (H,) float64: DN above an ordinary photosite at an ISO speed and exposure time in seconds."""
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

# Every body by the name that settings use. ``Test`` is a small frame with the colours and noise of the EOS 550D.
BODIES: Mapping[str, Body] = MappingProxyType({"EOS 550D": _EOS_550D, "EOS 6D Mark II": _EOS_6D_MARK_II, "Test": _TEST})


# Masked rows above and masked columns left of the picture, as Canon's sensors have about as many.
_BORDER: Final = (50, 140)


def _areas(width: int, height: int) -> dict[str, Any]:
    top, left = _BORDER
    sensor = height + top, width + left
    return {
        "sensor": sensor,
        "visible": Rectangle(top, left, height, width),
        "masked": (Rectangle(0, 0, sensor[0], left - 2),),
    }


def _body(
    name: str, size: tuple[int, int], black: int, saturation: int, gain_e: float, noise_dn: float, early_e: float
) -> Body:
    """Return a Canon of `size` columns and rows that see light; the rest as `Body` has it."""
    return replace(
        _EOS_550D,
        model=name.replace("_", " "),
        black=black,
        saturation=saturation,
        electrons_per_dn=gain_e,
        read_noise_dn=noise_dn,
        sensor_noise_e=early_e,
        sensitivities=name,
        **_areas(*size),
    )


# Bodies by the name of their sensitivities; the EOS 600D has the sensor generation of the EOS 550D, and its facts.
FACTS: Final[Mapping[str, Body]] = MappingProxyType(
    {
        "Canon_EOS_600D": replace(BODIES["EOS 550D"], model="Canon EOS 600D"),
        "Canon_EOS_200D": _body("Canon_EOS_200D", (6000, 4000), 2048, 16383, 2.3, 5.2, 2.4),
        "Canon_EOS-1Ds_Mark_III": _body("Canon_EOS-1Ds_Mark_III", (5616, 3744), 1024, 15600, 3.6, 6.0, 3.2),
        "Canon_EOS_5D_Mark_II": _body("Canon_EOS_5D_Mark_II", (5616, 3744), 1024, 15760, 4.2, 6.4, 2.5),
        "Canon_EOS_5DS": _body("Canon_EOS_5DS", (8688, 5792), 2048, 15500, 2.4, 5.6, 2.5),
    }
)


def find_body(
    camera: str, changes: Mapping[str, Any] = MappingProxyType({}), where: str = "--settings", key: str = "camera"
) -> Body:
    """Return the body that a name or a file of sensitivities stands for."""
    body = BODIES.get(camera) or _of_sensitivities(camera, read_sensitivities(camera, tuple(BODIES)))
    given = dict(changes)
    pixels = given.pop("pixels", None)
    if pixels is not None:
        given = _areas(*_checked_pixels(pixels, where, key)) | given
    facts = {field.name: getattr(body, field.name) for field in fields(Body)}
    changed = from_settings(Body, given, where, key, [*facts, "pixels"], **facts)
    _require_sensor(changed, where, key)
    return changed


def _of_sensitivities(camera: str, found: Sensitivities) -> Body:
    if camera in FACTS:
        return FACTS[camera]
    usual = BODIES["EOS 550D"]
    return replace(usual, maker=found.maker or "unknown", model=found.camera, sensitivities=camera)


def _checked_pixels(pixels: Any, where: str, key: str) -> tuple[int, int]:
    try:
        width, height = TypeAdapter(tuple[int, int]).validate_python(pixels)
    except ValidationError as error:
        raise ConfigurationError(
            f"{where}: {key}.pixels = {pixels!r}: two whole numbers expected, columns and rows, such as [5184, 3456]"
        ) from error
    if min(width, height) < 16:
        raise ConfigurationError(f"{where}: {key}.pixels = {pixels!r}: at least 16 columns and rows expected")
    return width, height


def _require_sensor(body: Body, where: str, key: str) -> None:
    top = 2**body.bits - 1
    limits = (
        ("bits", body.bits, 8 <= body.bits <= 16, "8 to 16"),
        ("black", body.black, 0 <= body.black < body.saturation, f"0 to below saturation, {body.saturation}"),
        ("saturation", body.saturation, body.saturation <= top, f"{top} at most with {body.bits} bits"),
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
            raise ConfigurationError(f"{where}: {key}.{name} is {value:g}; {expected} expected")


@compiled
def counts(
    light: NDArray[np.float32],
    weights: NDArray[np.float32],
    noise: NDArray[np.float32],
    left: int,
    black: float,
    read_noise: float,
    gain_e: float,
    saturation: int,
    out: NDArray[np.uint16],
) -> None:
    """Write the counts of some rows of the sensor.

    Shot noise is taken as normal, of variance signal / gain; with the read noise that makes one normal deviate of
    variance signal / gain + read noise²: the photon transfer of EMVA 1288 (release 4.0 linear, section 2.2).

    `light`: (3, rows, visible columns) float32, from `light`; no columns at all for rows of the masked border.
    `weights`: (3,) float32, drive of each primary. `noise`: (rows, sensor columns) float32, standard normal deviates.
    `black`, `read_noise`: mean and standard deviation of a dark count, DN. `gain_e`: electrons per DN. `saturation`:
    largest count. `out`: (rows, sensor columns) uint16, written.
    """
    rows, columns = out.shape
    right = left + light.shape[2]
    top = np.float32(saturation)
    half = np.float32(black + 0.5)
    per_dn = np.float32(1 / gain_e)
    floor = np.float32(read_noise * read_noise)
    dark = np.float32(read_noise)
    red, green, blue = weights[0], weights[1], weights[2]
    nothing = np.float32(0)
    for row in range(rows):
        for x in range(left):
            out[row, x] = np.uint16(min(max(half + dark * noise[row, x], nothing), top))
        for x in range(left, right):
            i = x - left
            signal = red * light[0, row, i] + green * light[1, row, i] + blue * light[2, row, i]
            count = half + signal + math.sqrt(signal * per_dn + floor) * noise[row, x]
            out[row, x] = np.uint16(min(max(count, nothing), top))
        for x in range(right, columns):
            out[row, x] = np.uint16(min(max(half + dark * noise[row, x], nothing), top))
