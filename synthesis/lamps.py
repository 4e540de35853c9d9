"""Illuminate the chart with the simulated projector or with arbitrary spectra, and compute frames of its patches.

Light is additive: the light on a photosite under the projector is a weighted sum of its light under the three
primaries. With spectra, the light of each illuminant is computed separately. Spectra are read from a file, or published
spectra are selected by name (`sim.spectral`; `--lights` in docs/how-to/table-without-a-lab.md).

A computed frame contains only the centres of patches and references, one below the other. By default, each centre has
10 × 10 photosites (25 half-size pixels). The simulated room provides their light, and the simulated sensor their counts
(`sim.world.sensors.counts`).

Computed frames differ from photographs in three ways. There is no blur, so no light leaks between neighbouring patches.
A whole patch has the light of its centre. The position of the chart is exact.
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
from experiment.lights import Illuminant, parse_ccts, shown_colour
from foundation.colorimetry import linear_srgb, planck, xyz_of
from foundation.errors import FormatError, InputError, nearest_names
from foundation.files import sha256_of
from sim.spectral import (
    WAVELENGTHS_NM,
    PublishedSpectrum,
    daylight,
    printed_reflectance,
    published_spectra,
    require_grid,
    resampled,
    sensitivities,
)
from sim.world.rendering import PAPER
from sim.world.sensors import Body, HotPattern, counts
from sim.world.world import Room, World

WAVELENGTH: Final = "wavelength"  # Heading of the first column

# Range of correlated colour temperatures, K, for which CIE daylight is defined (CIE 15:2018).
DAYLIGHT_K: Final = (4000.0, 25_000.0)

# Sets of published illuminants: name of the set, and pattern of the names in it.
ILLUMINANT_SETS: Final[Mapping[str, str]] = {
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
    """Spectrum of an illuminant."""

    name: str
    power: _Array  # (81,) float64 ≥ 0, relative power per nm at `sim.spectral.WAVELENGTHS_NM`
    cct_k: float | None = None  # Temperature of a black body, K; None for other spectra


@dataclass(frozen=True, eq=False)
class LightSpectra:
    """Spectra of illuminants, each with its own name."""

    lights: tuple[LightSpectrum, ...]
    source: dict[str, Any]  # Origin for the record of the LUT: file and hash, or names


def read_lights(text: str) -> LightSpectra:
    """Return the spectra of a CSV file, or published spectra; `text` is the value of `--lights`."""
    path = Path(text)
    if path.is_file() or path.suffix.lower() == ".csv":
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(
                f"cannot read spectra {path}: {error.strerror}; give a CSV file or published illuminants"
            ) from error
        lights = parse_spectra(data, str(path))
        source: dict[str, Any] = {"from": "file", "file": path.name, "sha256": sha256_of(data)}
    else:
        lights = tuple(light for name in text.split(",") for light in _published_lights(name.strip(), text))
        source = {"from": "published spectra", "named": text}
    names = [light.name for light in lights]
    duplicate = next((name for name in names if names.count(name) > 1), None)
    if duplicate is not None:
        raise InputError(f"--lights {text}: {duplicate!r} occurs more than once; give each illuminant once")
    return LightSpectra(lights, source)


def parse_spectra(data: bytes, where: str) -> tuple[LightSpectrum, ...]:
    """Return the spectra of a CSV file from its bytes; messages name it `where`."""
    try:
        rows = list(csv.reader(io.StringIO(data.decode("utf-8-sig"))))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FormatError(f"{where} is not a CSV file in UTF-8: {error}; save it as CSV in UTF-8") from error
    rows = [row for row in rows if any(cell.strip() for cell in row)]
    headings = [heading.strip() for heading in rows[0]] if rows else []
    if len(headings) < 2 or headings[0].lower().split(" ")[0].split("_")[0] != WAVELENGTH or not all(headings):
        raise FormatError(
            f"{where}: its first line is {','.join(headings)[:80]!r}, expected {WAVELENGTH!r} and names; correct it"
        )
    numeric = [name for name in headings[1:] if re.fullmatch(r"[\d.:+]+", name)]
    if numeric:
        # `generate --light` reads a number as an index of the LUT.
        raise FormatError(
            f"{where}: the name of an illuminant is {numeric[0]!r}, expected a name with a letter; rename it, for "
            f"example to lamp {numeric[0]}"
        )
    table = np.empty((len(rows) - 1, len(headings)))
    for number, row in enumerate(rows[1:]):
        try:
            values = [float(cell) for cell in row]
            if len(values) != len(headings):
                # numpy would copy a single number into the whole row.
                raise ValueError(f"{len(values)} numbers")
        except ValueError as error:
            raise FormatError(
                f"{where}, line {number + 2}: expected {len(headings)} numbers, one for each heading; correct it"
            ) from error
        table[number] = values
    if not np.isfinite(table).all():
        raise FormatError(f"{where}: a value is NaN or infinite, expected a number; delete its line, or measure it")
    table = table[np.argsort(table[:, 0], kind="stable")]
    require_grid(table[:, 0], where)
    for column, name in enumerate(headings[1:], 1):
        if table[:, column].min() < 0:
            row = int(table[:, column].argmin())
            raise FormatError(
                f"{where}: {name!r} is {table[row, column]:g} at {table[row, 0]:g} nm, expected 0 or more; "
                "replace negative values of measurement noise by 0"
            )
    powers = resampled(table[:, 0], table[:, 1:], WAVELENGTHS_NM)
    return tuple(_scaled_light(name, power, None, where) for name, power in zip(headings[1:], powers.T, strict=True))


def table_illuminants(lights: Sequence[LightSpectrum]) -> tuple[Illuminant, ...]:
    """Return illuminants for the list of a LUT, with names, and sRGB codes that show their colours."""
    return tuple(
        Illuminant(
            index,
            "spectrum" if light.cct_k is None else "blackbody",
            light.cct_k,
            shown_colour(_linear_srgb(light.power)),
            light.name,
        )
        for index, light in enumerate(lights)
    )


def _scaled_light(name: str, power: _Array, cct_k: float | None, where: str) -> LightSpectrum:
    low, high = np.searchsorted(WAVELENGTHS_NM, [400, 700])
    if not power[low : high + 1].max() > 0:
        raise FormatError(f"{where}: {name!r} has no power from 400 to 700 nm; correct or omit it")
    return LightSpectrum(name, power / power.max(), cct_k)


def _published_lights(name: str, text: str) -> Iterable[LightSpectrum]:
    """Yield the spectra of one item of `--lights`: published illuminant, set of them, black bodies, or daylights."""
    if black_bodies := re.fullmatch(r"([\d.:]+)\s*K", name, re.IGNORECASE):
        # Computed at 1 nm and resampled like the other spectra, so that integrals are preserved.
        wavelengths = np.arange(380.0, 781.0)
        for cct_k in parse_ccts(black_bodies[1]):
            yield _resampled_light(f"{cct_k:g}K", PublishedSpectrum(wavelengths, planck(wavelengths, cct_k)), cct_k)
    elif daylights := re.fullmatch(r"daylight:(.+)", name, re.IGNORECASE):
        for cct_k in parse_ccts(daylights[1].rstrip("kK")):
            if not DAYLIGHT_K[0] <= cct_k <= DAYLIGHT_K[1]:
                raise InputError(
                    f"--lights {text}: daylight of {cct_k:g} K, expected {DAYLIGHT_K[0]:g} to "
                    f"{DAYLIGHT_K[1]:g} K, as the CIE defines it; give a black body, {cct_k:g}K"
                )
            yield _resampled_light(f"daylight {cct_k:g}K", daylight(cct_k))
    else:
        spectra = published_spectra()
        for key in _matching_names(name, list(spectra), text):
            yield _resampled_light(key, spectra[key])


def _matching_names(name: str, published: list[str], text: str) -> list[str]:
    pattern = ILLUMINANT_SETS.get(name.lower())
    if pattern is not None:
        return [key for key in published if re.fullmatch(pattern, key)]
    if name in published:
        return [name]
    if re.fullmatch(r"[\d.:]+", name):
        hint = f"temperatures in kelvin end in K: {name}K for a black body, daylight:{name} for daylight"
    elif span := re.fullmatch(r"(\d+)K?\s*-\s*(\d+)K?", name, re.ASCII | re.IGNORECASE):
        hint = f"a range of black bodies needs a step: {span[1]}:{span[2]}:500K"
    else:
        hint = nearest_names(name, [*published, *ILLUMINANT_SETS], 3) or "use a name such as D65, FL2, LED-B3, cie-led"
    raise InputError(f"--lights {text}: {name!r} is not a file or a published illuminant; {hint}")


def _resampled_light(name: str, spectrum: PublishedSpectrum, cct_k: float | None = None) -> LightSpectrum:
    require_grid(spectrum.wavelengths_nm, name)
    if spectrum.power.min() < 0:
        raise FormatError(f"{name!r} has published values below 0, expected 0 or more; give another illuminant")
    power = resampled(spectrum.wavelengths_nm, spectrum.power[:, None], WAVELENGTHS_NM)[:, 0]
    return _scaled_light(name, power, cct_k, "published spectra")


def _linear_srgb(power: _Array) -> _Array:
    return np.maximum(linear_srgb(xyz_of(WAVELENGTHS_NM, power)), 0.0)


_CHANNELS: Final = "RGB"

# Keys of independent random streams; `sim.world.world` uses keys below 10.
_RESPONSE, _NOISE, _BLACK, _HOT = 11, 12, 13, 14

# Columns of a masked area that `drivers.raw.rawfile` does not use for the black level.
_SKIPPED_COLUMNS: Final = 4
_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PatchSensor:
    """The photosites that record the patches of a chart: (N · 2 · window, 2 · window) photosites for N patches."""

    body: Body
    patches: int  # N
    window: int  # Side of a patch, in half-size pixels
    seed: int  # Seed of response and noise
    response: _Float  # float32, shape of a frame: relative response of each photosite, the fixed pattern
    hot: HotPattern  # Photosites with high dark current
    shutter_s: float  # Exposure time of all frames, s; dark current grows with it

    @staticmethod
    def of(body: Body, patches: int, window: int, room: Room, shutter_s: float) -> PatchSensor:
        """Make the sensor of a camera; the room has the parameters of the photosites."""
        seed, response_spread = room.seed, room.response_spread
        shape = (patches * 2 * window, 2 * window)
        response = _generator(seed, _RESPONSE).standard_normal(shape, dtype=np.float32)
        response *= np.float32(response_spread)
        response += np.float32(1)
        response.setflags(write=False)
        hot = HotPattern.drawn(_generator(seed, _HOT), shape, room.hot_per_million, room.hot_dn_per_s)
        return PatchSensor(body, patches, window, seed, response, hot, shutter_s)

    @property
    def sites(self) -> Sites:
        """Positions of the patches in a frame."""
        half = self.window // 2
        rows = np.arange(self.patches, dtype=np.int64) * self.window + half
        columns = np.full(self.patches, half, dtype=np.int64)
        return Sites(rows, columns, np.ones(self.patches, dtype=np.bool_), self.window)

    def light(self, signals: _Array) -> _Float:
        """Return the light on each photosite, with its response: (3, rows, columns) float32, DN above black.

        `signals`: (N, 3, P) float64, DN above black of each patch and channel under each of P ≤ 3 primaries. The light
        of missing primaries is 0.
        """
        side = 2 * self.window
        light = np.zeros((3, *self.response.shape), dtype=np.float32)
        patch_response = self.response.reshape(self.patches, side, side)
        for primary in range(signals.shape[2]):
            patch_light = light[primary].reshape(self.patches, side, side)
            for position, letter in enumerate(self.body.pattern):
                level = signals[:, _CHANNELS.index(letter), primary].astype(np.float32)
                sites = np.s_[:, position // 2 :: 2, position % 2 :: 2]
                np.multiply(patch_response[sites], level[:, None, None], out=patch_light[sites])
        return light

    def expose(self, light: _Float, weights: _Array, iso: int, frame: int) -> tuple[Mosaic, _Array]:
        """Compute a frame and its measured black level (2, 2) float64 counts.

        Parameters
        ----------
        light
            (3, rows, columns) float32 from `PatchSensor.light`.
        weights
            (3,) float64, exposure to each primary: factor of the light of this primary.
        iso
            ISO speed, which sets gain and read noise.
        frame
            Number of the frame, which selects its noise.
        """
        body = self.body
        noise = _generator(self.seed, _NOISE, frame).standard_normal(self.response.shape, dtype=np.float32)
        raw = np.empty(self.response.shape, dtype=np.uint16)
        noise_dn, gain_e = body.noise_dn(iso), body.gain_e(iso)
        counts(light, weights.astype(np.float32), noise, 0, float(body.black), noise_dn, gain_e, body.saturation, raw)
        hot_light = weights @ light[:, self.hot.rows, self.hot.columns]
        self.hot.raise_counts(raw, noise, hot_light, body, iso, self.shutter_s)
        raw.setflags(write=False)
        # Mean of the masked photosites of each position in the Bayer block; the exact level if there are none.
        black = np.full((2, 2), float(body.black))
        masked = sum(area.height * max(area.width - _SKIPPED_COLUMNS, 0) for area in body.masked) // 4
        if masked:
            # Rounding to integers adds a variance of 1/12 counts².
            error = ((noise_dn**2 + 1 / 12) / masked) ** 0.5
            black += error * _generator(self.seed, _BLACK, frame).standard_normal((2, 2))
        side = 2 * self.window
        mosaic = Mosaic(
            counts=raw,
            pattern=body.pattern,
            black=np.full((2, 2), float(body.black)),
            white_level=body.saturation,
            camera=body.camera,
            sensor=raw,
            visible=Area(0, 0, self.patches * side, side),
            masked=(),
            iso=iso,
        )
        return mosaic, black


def _generator(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(key))


@dataclass(frozen=True, eq=False)
class ProjectorLamp:
    """The simulated projector."""

    world: World  # Room, camera and page
    settings: ExposureSettings  # Exposure of all frames
    illuminations: tuple[Illuminant, ...]
    light: _Float  # (3, rows, columns) float32, light on each photosite under each primary at full brightness

    def illuminate(self, light: int) -> tuple[_Float, _Array]:
        """Return light and weights of the frame under an illuminant, for `PatchSensor.expose`."""
        return self.light, self.world.drive(self.illuminations[light].colour, self.settings)

    def illuminate_evenly(self) -> tuple[_Float, _Array]:
        """Return light and weights of the white frame, from which the flat field is measured."""
        return self.light, self.world.drive(WHITE, self.settings)

    def primary_indices(self) -> tuple[int, int, int] | None:
        """Return the indices of the red, green and blue primary; None if one of them is missing."""
        return pure_lights(self.illuminations)


@dataclass(frozen=True, eq=False)
class SpectralLamp:
    """A luminaire at a fixed position that emits one spectrum per illuminant. All illuminants have one flat field.

    Spectra have no absolute brightness. Each exposure is set so that the strongest channel of bare paper reaches
    the fraction `Room.white_level_share` of saturation.
    """

    world: World  # Camera, print and room
    powers: _Array  # (L, 81) float64, relative power per nm of each illuminant
    sensor: PatchSensor
    reflectance: _Array  # (N, 81) float64, reflectance of each patch
    field: _Array  # (N,) float64, relative illumination of each patch; that of the simulated projector in green

    def signals(self, light: int) -> _Array:
        """Return the signal of each patch under an illuminant, (N, 3) float64, DN above black."""
        room, body = self.world.room, self.world.body
        curves = self.powers[light][:, None] * sensitivities(body.sensitivities)
        paper = printed_reflectance([PAPER], room.profile, room.paper)[0] @ curves
        level = room.white_level_share * (body.saturation - body.black) / float(paper.max())
        return (self.reflectance @ curves) * level * self.field[:, None]

    def illuminate(self, light: int) -> tuple[_Float, _Array]:
        """Return light and weights of the frame under an illuminant, for `PatchSensor.expose`."""
        return self.sensor.light(self.signals(light)[:, :, None]), np.array([1.0, 0.0, 0.0])

    def illuminate_evenly(self) -> tuple[_Float, _Array]:
        """Return light and weights of the frame under the most neutral illuminant."""
        whites = self.powers @ sensitivities(self.world.body.sensitivities)
        # The flat field is measured best if the weakest channel is as strong as possible.
        return self.illuminate(int((whites.min(axis=1) / whites.max(axis=1)).argmax()))

    def primary_indices(self) -> tuple[int, int, int] | None:
        """Return None: all wavelengths have the same flat field, so coloured patches need no correction."""
        return None


ChartLamp = ProjectorLamp | SpectralLamp
