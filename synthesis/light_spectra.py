"""Lights by their spectra: from a CSV file, or the illuminants that the CIE and others have published.

A file has a column ``wavelength`` (nm) and one for each light, whose head is its name and no number; any even or uneven
grid from 400 to 700 nm or beyond, in proportions that are each light's own. Published spectra are those of
`sim.spectral.published`: CIE A to E, daylights D, fluorescent lamps FL1 to FL12 and FL3.1 to FL3.15, high-pressure
lamps HP1 to HP5, LED-B1 to LED-V2, indoor daylights ID50 and ID65 (CIE 15:2018), the sources of ISO 7589, and measured
light sources by their names there.
``5600K`` is a black body by Planck's law, ``daylight:6000`` the CIE daylight of a correlated colour temperature; ranges
are ``FIRST:LAST:STEP`` with the ``K`` or the word ``daylight`` before them.
"""

from __future__ import annotations

import csv
import difflib
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from experiment.lights import Illumination, parse_ccts, shown_colour
from foundation.colorimetry.observer import linear_srgb, planck, xyz_of
from foundation.errors import FormatError, InputError
from sim.spectral.grids import regridded, require_grid
from sim.spectral.published import PublishedSpectrum, daylight, published_spectra
from sim.world.spectra import WAVELENGTHS_NM

WAVELENGTH: Final = "wavelength"
"""Head of the column of wavelengths."""

DAYLIGHT_K: Final = (4000.0, 25_000.0)
"""Correlated colour temperatures between which CIE daylight is defined (CIE 15:2018)."""

SETS: Final[Mapping[str, str]] = {
    "cie": r"A|B|C|D\d+|E|FL[\d.]+|HP\d|LED-.*|ID\d+",
    "cie-d": r"D\d+|ID\d+",
    "cie-fl": r"FL[\d.]+",
    "cie-hp": r"HP\d",
    "cie-led": r"LED-.*",
    "iso7589": r"ISO 7589 .*",
}
"""Sets of published illuminants by the pattern of their names."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LightSpectrum:
    """A light.

    - `power`: (81,) float64 ≥ 0, relative power per nm at `sim.world.spectra.WAVELENGTHS_NM`.
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
    from foundation.hashing import sha256_of

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
    """Return which of the known spectra a name or the name of a set stands for."""
    pattern = SETS.get(name.lower())
    if pattern is not None:
        return [key for key in known if re.fullmatch(pattern, key)]
    if name in known:
        return [name]
    near = difflib.get_close_matches(name, [*known, *SETS], n=3, cutoff=0.4)
    hint = f"did you mean {' or '.join(map(repr, near))}?" if near else "name such as D65, A, FL2, LED-B3, cie-led"
    raise InputError(f"--lights {given}: there is no file and no published light {name!r}; {hint}")


def _as_light(name: str, spectrum: PublishedSpectrum, cct_k: float | None = None) -> LightSpectrum:
    """Return a published spectrum as a light."""
    require_grid(spectrum.wavelengths_nm, name)
    if spectrum.power.min() < 0:
        raise FormatError(f"{name!r} as published is no light: it has values below 0; name another")
    power = regridded(spectrum.wavelengths_nm, spectrum.power[:, None], WAVELENGTHS_NM)[:, 0]
    return _light(name, power, cct_k, "published spectra")


def _linear_srgb(power: _Array) -> _Array:
    """Return the linear sRGB (3,) float64 of a light for the CIE 1931 2° observer, negative values clipped to 0."""
    return np.maximum(linear_srgb(xyz_of(WAVELENGTHS_NM, power)), 0.0)
