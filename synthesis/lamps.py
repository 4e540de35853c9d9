"""What lights the chart (the projector under its codes, or any spectra), and the frames of patches that come of it.

Light adds: a frame under a projector's light is the weighted sum of the same frame under each of its three primaries.
A luminaire has one spectrum a light, and so one frame of its own for each. Its spectra are a file's, on any grid from
400 to 700 nm or beyond, or published ones by name (`sim.spectral`; `--lights` of docs/how-to/table-without-a-lab.md).

**Frames** hold nothing but the middle of each patch: the 10 by 10 photosites in the middle of each cell (25 half-size
pixels), and those of the references, patch below patch in a frame as wide as one patch. Their light is what the
simulated room would let fall on them without the lens's blur; their counts come from the simulated sensor itself
(`sim.world.sensors.counts`), and calibration's own functions sample them as they do any other frame.

What differs from a photographed frame: nothing is blurred, so no light leaks between neighbouring cells; all of a
patch has the light of its middle; the chart lies exactly where it is looked for.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from calibration.radiometry.primaries import pure_lights
from calibration.sampling import Sites
from drivers.camera import ExposureSettings
from drivers.presenter import WHITE
from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.lights import Illumination, parse_ccts, shown_colour
from foundation.colorimetry import linear_srgb, planck, xyz_of
from foundation.errors import FormatError, InputError, nearest_names
from foundation.files import sha256_of
from sim.spectral import (
    WAVELENGTHS_NM,
    PublishedSpectrum,
    daylight,
    printed_reflectance,
    published_spectra,
    regridded,
    require_grid,
    sensitivities,
)
from sim.world.rendering import PAPER
from sim.world.sensors import Body, HotPattern, counts
from sim.world.world import Room, World

WAVELENGTH: Final = "wavelength"  # Head of the column of wavelengths

# Correlated colour temperatures between which CIE daylight is defined (CIE 15:2018).
DAYLIGHT_K: Final = (4000.0, 25_000.0)

# Sets of published illuminants by the pattern of their names.
SETS: Final[Mapping[str, str]] = {
    "cie": r"A|B|C|D\d+|E|FL[\d.]+|HP\d|LED-.*|ID\d+",
    "cie-d": r"D\d+|ID\d+",
    "cie-fl": r"FL[\d.]+",
    "cie-hp": r"HP\d",
    "cie-led": r"LED-.*",
    "iso7589": r"ISO 7589 .*",
}

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LightSpectrum:
    """A light.

    - `power`: (81,) float64 ≥ 0, relative power per nm at `sim.spectral.WAVELENGTHS_NM`.
    - `cct_k`: its temperature if a black body, K; None otherwise.
    """

    name: str
    power: _Array
    cct_k: float | None = None


@dataclass(frozen=True, eq=False)
class LightSpectra:
    """Lights, each once, and where they are from.

    `source`: what a record says of them: the file and its hash, or the names.
    """

    lights: tuple[LightSpectrum, ...]
    source: dict[str, Any]


def read_lights(given: str) -> LightSpectra:
    """Return the lights that a text names: a CSV file's, or published ones."""
    path = Path(given)
    if path.is_file() or path.suffix.lower() == ".csv":
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(
                f"cannot read spectra {path}: {error.strerror}; name a CSV file or published lights"
            ) from error
        lights = parse_spectra(data, str(path))
        source: dict[str, Any] = {"from": "file", "file": path.name, "sha256": sha256_of(data)}
    else:
        lights = tuple(light for part in given.split(",") for light in _published(part.strip(), given))
        source = {"from": "published spectra", "named": given}
    names = [light.name for light in lights]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"--lights {given}: {twice!r} is there twice; name each light once")
    return LightSpectra(lights, source)


def parse_spectra(data: bytes, where: str) -> tuple[LightSpectrum, ...]:
    """Return the lights in the bytes of a CSV file; `where` names it in messages."""
    try:
        rows = list(csv.reader(io.StringIO(data.decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FormatError(f"{where} is no CSV in UTF-8: {error}") from error
    rows = [row for row in rows if any(cell.strip() for cell in row)]
    heads = [head.strip() for head in rows[0]] if rows else []
    if len(heads) < 2 or heads[0].lower().split(" ")[0].split("_")[0] != WAVELENGTH or not all(heads):
        raise FormatError(
            f"{where}: its first line is {','.join(heads)[:80]!r}; {WAVELENGTH!r} expected, then the name of each light"
        )
    numbered = [name for name in heads[1:] if re.fullmatch(r"[\d.:+]+", name)]
    if numbered:
        raise FormatError(
            f"{where}: a light is called {numbered[0]!r}, which generate --light would take for a number in the table; "
            f"call it lamp {numbered[0]} or the like"
        )
    table = np.empty((len(rows) - 1, len(heads)))
    for number, row in enumerate(rows[1:]):
        try:
            values = [float(cell) for cell in row]
            if len(values) != len(heads):
                # One number alone would be taken for each of the row.
                raise ValueError(f"{len(values)} numbers")
        except ValueError as error:
            raise FormatError(
                f"{where}, line {number + 2}: {len(heads)} numbers expected, as the first line has heads"
            ) from error
        table[number] = values
    if not np.isfinite(table).all():
        raise FormatError(f"{where}: a number is not finite; leave its wavelength out, or measure it")
    table = table[np.argsort(table[:, 0], kind="stable")]
    require_grid(table[:, 0], where)
    for column, name in enumerate(heads[1:], 1):
        if table[:, column].min() < 0:
            at = int(table[:, column].argmin())
            raise FormatError(
                f"{where}: {name!r} is {table[at, column]:g} at {table[at, 0]:g} nm, 0 or more expected; "
                "set to 0 what is a measurement's noise about 0"
            )
    powers = regridded(table[:, 0], table[:, 1:], WAVELENGTHS_NM)
    return tuple(_light(name, power, None, where) for name, power in zip(heads[1:], powers.T, strict=True))


def illuminations_of(lights: Sequence[LightSpectrum]) -> tuple[Illumination, ...]:
    """Return lights as a table lists them: with their names, and the codes that would show their colours."""
    return tuple(
        Illumination(
            index,
            "spectrum" if light.cct_k is None else "blackbody",
            light.cct_k,
            shown_colour(_linear_srgb(light.power)),
            light.name,
        )
        for index, light in enumerate(lights)
    )


def _light(name: str, power: _Array, cct_k: float | None, where: str) -> LightSpectrum:
    low, high = np.searchsorted(WAVELENGTHS_NM, [400, 700])
    if not power[low : high + 1].max() > 0:
        raise FormatError(f"{where}: {name!r} is dark from 400 to 700 nm; a light has power there")
    return LightSpectrum(name, power / power.max(), cct_k)


def _published(name: str, given: str) -> Iterable[LightSpectrum]:
    """Yield the lights of one entry: a published one, a set of them, black bodies, or daylights."""
    if black_bodies := re.fullmatch(r"([\d.:]+)\s*K", name, re.IGNORECASE):
        # Planck's law may be had on any grid; on a fine one its integral is kept as that of all others is.
        wavelengths = np.arange(380.0, 781.0)
        for cct_k in parse_ccts(black_bodies[1]):
            yield _as_light(f"{cct_k:g}K", PublishedSpectrum(wavelengths, planck(wavelengths, cct_k)), cct_k)
    elif daylights := re.fullmatch(r"daylight:(.+)", name, re.IGNORECASE):
        for cct_k in parse_ccts(daylights[1].rstrip("kK")):
            if not DAYLIGHT_K[0] <= cct_k <= DAYLIGHT_K[1]:
                raise InputError(
                    f"--lights {given}: daylight of {cct_k:g} K; the CIE defines it from {DAYLIGHT_K[0]:g} to "
                    f"{DAYLIGHT_K[1]:g} K, so name a black body, {cct_k:g}K, beyond"
                )
            yield _as_light(f"daylight {cct_k:g}K", daylight(cct_k))
    else:
        known = published_spectra()
        for key in _named(name, list(known), given):
            yield _as_light(key, known[key])


def _named(name: str, known: list[str], given: str) -> list[str]:
    pattern = SETS.get(name.lower())
    if pattern is not None:
        return [key for key in known if re.fullmatch(pattern, key)]
    if name in known:
        return [name]
    if re.fullmatch(r"[\d.:]+", name):
        hint = f"temperatures in kelvin end in K: {name}K for a black body, daylight:{name} for daylight"
    elif span := re.fullmatch(r"(\d+)K?\s*-\s*(\d+)K?", name, re.ASCII | re.IGNORECASE):
        hint = f"a range of black bodies has a step: {span[1]}:{span[2]}:500K"
    else:
        hint = nearest_names(name, [*known, *SETS], 3) or "name such as D65, A, FL2, LED-B3, cie-led"
    raise InputError(f"--lights {given}: there is no file and no published light {name!r}; {hint}")


def _as_light(name: str, spectrum: PublishedSpectrum, cct_k: float | None = None) -> LightSpectrum:
    require_grid(spectrum.wavelengths_nm, name)
    if spectrum.power.min() < 0:
        raise FormatError(f"{name!r} as published is no light: it has values below 0; name another")
    power = regridded(spectrum.wavelengths_nm, spectrum.power[:, None], WAVELENGTHS_NM)[:, 0]
    return _light(name, power, cct_k, "published spectra")


def _linear_srgb(power: _Array) -> _Array:
    """Return the linear sRGB (3,) float64 of a light for the CIE 1931 2° observer, negative values clipped to 0."""
    return np.maximum(linear_srgb(xyz_of(WAVELENGTHS_NM, power)), 0.0)


_CHANNELS: Final = "RGB"

# Purposes of the random streams, so that none is drawn from twice; those of `sim.world.world` are below 10.
_RESPONSE, _NOISE, _BLACK, _HOT = 11, 12, 13, 14

# Columns of a masked area that its black level is not read from, as `drivers.raw.rawfile` leaves them out.
_SKIPPED_COLUMNS: Final = 4
_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PatchSensor:
    """The photosites under the patches of a chart, with their response.

    - `body`: the camera's body.
    - `patches`: N, how many patches there are.
    - `window`: half-size pixels along a patch's side.
    - `seed`: of response and noise.
    - `response`: (N · 2 · window, 2 · window) float32, what each photosite gives over what it should: the fixed
      pattern.
    - `hot`: the photosites whose dark current is out of proportion.
    - `shutter_s`: exposure time of every frame, seconds: their excess grows with it.
    """

    body: Body
    patches: int
    window: int
    seed: int
    response: _Float
    hot: HotPattern
    shutter_s: float

    @staticmethod
    def of(body: Body, patches: int, window: int, room: Room, shutter_s: float) -> PatchSensor:
        """Return the sensor of a body under so many patches, with what a room says of its photosites."""
        seed, response_spread = room.seed, room.response_spread
        shape = (patches * 2 * window, 2 * window)
        response = _random(seed, _RESPONSE).standard_normal(shape, dtype=np.float32)
        response *= np.float32(response_spread)
        response += np.float32(1)
        response.setflags(write=False)
        hot = HotPattern.drawn(_random(seed, _HOT), shape, room.hot_per_million, room.hot_dn_per_s)
        return PatchSensor(body, patches, window, seed, response, hot, shutter_s)

    @property
    def sites(self) -> Sites:
        """Where the patches lie in a frame."""
        reach = self.window // 2
        rows = np.arange(self.patches, dtype=np.int64) * self.window + reach
        columns = np.full(self.patches, reach, dtype=np.int64)
        return Sites(rows, columns, np.ones(self.patches, dtype=np.bool_), self.window)

    def light(self, signals: _Array) -> _Float:
        """Return the light on every photosite.

        `signals`: (N, 3, P) float64, DN above black of each patch by channel under each of P ≤ 3 primaries. Returns (3,
        N · 2 · window, 2 · window) float32, response included; 0 for primaries that are not given.
        """
        side = 2 * self.window
        found = np.zeros((3, *self.response.shape), dtype=np.float32)
        by_patch = self.response.reshape(self.patches, side, side)
        for primary in range(signals.shape[2]):
            out = found[primary].reshape(self.patches, side, side)
            for place, letter in enumerate(self.body.pattern):
                level = signals[:, _CHANNELS.index(letter), primary].astype(np.float32)
                part = np.s_[:, place // 2 :: 2, place % 2 :: 2]
                np.multiply(by_patch[part], level[:, None, None], out=out[part])
        return found

    def expose(self, light: _Float, weights: _Array, iso: int, frame: int) -> tuple[Mosaic, _Array]:
        """Return a frame, and its black level as a masked border would show it.

        `light`: (3, N · 2 · window, 2 · window) float32, what `light` returned. `weights`: (3,) float64, how much of
        each primary the frame collects. `iso`: ISO speed, which sets gain and read noise. Returns (N · 2 · window, 2 ·
        window) counts, without borders. Returns (2, 2) float64 counts, the estimate for each position of the block: the
        mean of as many dark counts as the body has masked photosites there, or its true black where it has none.
        """
        body = self.body
        noise = _random(self.seed, _NOISE, frame).standard_normal(self.response.shape, dtype=np.float32)
        found = np.empty(self.response.shape, dtype=np.uint16)
        noise_dn, gain_e = body.noise_dn(iso), body.gain_e(iso)
        counts(light, weights.astype(np.float32), noise, 0, float(body.black), noise_dn, gain_e, body.saturation, found)
        lit = weights @ light[:, self.hot.rows, self.hot.columns]
        self.hot.raise_counts(found, noise, lit, body, iso, self.shutter_s)
        found.setflags(write=False)
        black = np.full((2, 2), float(body.black))
        masked = sum(area.height * max(area.width - _SKIPPED_COLUMNS, 0) for area in body.masked) // 4
        if masked:
            # Rounding to whole counts adds the variance of an even distribution one count wide.
            error = ((noise_dn**2 + 1 / 12) / masked) ** 0.5
            black += error * _random(self.seed, _BLACK, frame).standard_normal((2, 2))
        side = 2 * self.window
        mosaic = Mosaic(
            counts=found,
            pattern=body.pattern,
            black=np.full((2, 2), float(body.black)),
            white_level=body.saturation,
            camera=body.camera,
            sensor=found,
            visible=Area(0, 0, self.patches * side, side),
            masked=(),
            iso=iso,
        )
        return mosaic, black


def _random(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(key))


@dataclass(frozen=True, eq=False)
class ProjectorLamp:
    """The simulated projector.

    - `world`: room, body and page.
    - `settings`: the exposure of every frame.
    - `illuminations`: the lights and their codes.
    - `light`: (3, rows, columns) float32, the light on every photosite under each primary at full drive.
    """

    world: World
    settings: ExposureSettings
    illuminations: tuple[Illumination, ...]
    light: _Float

    def lit(self, light: int) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of a light's frame; see `PatchSensor.expose`."""
        return self.light, self.world.drive(self.illuminations[light].colour, self.settings)

    def even(self) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of a white frame, which the field is read from."""
        return self.light, self.world.drive(WHITE, self.settings)

    def pure(self) -> tuple[int, int, int] | None:
        """Return the lights of red, green and blue alone; None where one is not planned."""
        return pure_lights(self.illuminations)


@dataclass(frozen=True, eq=False)
class SpectralLamp:
    """A luminaire of one spectrum a light, all from one place, so that one field holds for every wavelength.

    Each light is exposed so that bare paper's strongest channel reaches the room's `white_level_share`, as a
    photographer would: a table of spectra has no brightness of its own.

    - `world`: body, print and room; the field is that of its projector's green.
    - `powers`: (L, 81) float64, relative power of each per nm.
    - `sensor`: the photosites under the patches.
    - `reflectance`: (N, 81) float64, of each patch's print.
    - `field`: (N,) float64, the light on each patch over that in the brightest place.
    """

    world: World
    powers: _Array
    sensor: PatchSensor
    reflectance: _Array
    field: _Array

    def signals(self, light: int) -> _Array:
        """Return what each patch gives under a light, (N, 3) float64 DN above black, where nothing is blurred."""
        room, body = self.world.room, self.world.body
        seen = self.powers[light][:, None] * sensitivities(body.sensitivities)
        paper = printed_reflectance([PAPER], room.profile, room.paper)[0] @ seen
        level = room.white_level_share * (body.saturation - body.black) / float(paper.max())
        return (self.reflectance @ seen) * level * self.field[:, None]

    def lit(self, light: int) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of a light's frame; see `PatchSensor.expose`."""
        return self.sensor.light(self.signals(light)[:, :, None]), np.array([1.0, 0.0, 0.0])

    def even(self) -> tuple[_Float, _Array]:
        """Return light (3, rows, columns) float32 and weights (3,) of the frame of the whitest light."""
        whites = self.powers @ sensitivities(self.world.body.sensitivities)
        # The light whose weakest channel is the strongest shows the field best in all three.
        return self.lit(int((whites.min(axis=1) / whites.max(axis=1)).argmax()))

    def pure(self) -> tuple[int, int, int] | None:
        """Return None: one field holds for all wavelengths, so that a coloured cell's is that of paper."""
        return None


ChartLamp = ProjectorLamp | SpectralLamp  # What lights the chart
