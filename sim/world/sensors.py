"""The camera bodies that the simulated room can be photographed with: their sensors, colour filters and noise.

A body is a table of facts, without behaviour. Photosites count from the sensor's top-left corner, masked borders
included, unless said; a count is what the raw file holds (DN).

Sizes and margins: dcraw 9.28 (`adobe_coeff` and the Canon table in `identify`), masked rectangles: rawspeed's
cameras.xml. Saturation: RawTherapee's camconst.json. Conversion gain and read noise: of the order that EMVA 1288 photon
transfer gives for sensors of these generations; plausible, not measured on these bodies.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray


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
    - `sensitivities`: name of the spectral sensitivities in `sim.data`, see `sim.world.spectra.sensitivities`.
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

_TEST = Body(
    maker="Canon",
    model="CroP Test",
    sensor=(609, 846),
    visible=Rectangle(51, 46, 557, 800),
    pattern="RGGB",
    black=2048,
    saturation=13584,
    bits=14,
    electrons_per_dn=1.8,
    read_noise_dn=6.0,
    sensor_noise_e=2.8,
    sensitivities="Canon_EOS_600D",
    masked=(Rectangle(0, 0, 609, 44),),
)

BODIES: Mapping[str, Body] = MappingProxyType({"EOS 550D": _EOS_550D, "EOS 6D Mark II": _EOS_6D_MARK_II, "Test": _TEST})
"""Every body by the name that settings use. ``Test`` is a small frame with the colours and noise of the EOS 550D."""
