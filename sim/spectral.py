"""Measured spectra: sensitivities of cameras (ISO 17321-1), published lights, and how they come to one grid.

**Sensitivities** are read from files in the layout of rawtoaces. It is that of
AcademySoftwareFoundation/rawtoaces-data, schema 0.1.0: ``spectral_data.units`` is ``relative``,
``spectral_data.index.main`` names the channels, and ``spectral_data.data.main`` has their responses to light of equal
power by wavelength in nanometres. Only proportions matter: exposure is set elsewhere.

Files of some cameras come with the suite (`sim.data`) and are known by name; any other is named by its path.

**Grids.** What stands on a finer grid is not picked at the new grid's wavelengths but gathered: a line of a lamp that
lies between two of them must not be lost. What stands on a coarser or the same grid is joined by straight lines.

**Published lights**, by their names. The tables are in `sim/data`, whose README says where they are from: the
illuminants of CIE 15:2018 and ISO 7589, and measured light sources.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from foundation.errors import FormatError, InputError, nearest_names
from foundation.files import sha256_of
from foundation.records import Record

NEEDED_NM: Final = (400.0, 700.0)
"""Wavelengths that must be covered: beyond them a camera with its infrared filter sees under 2 % of its light."""

WIDEST_STEP_NM: Final = 20.0
"""Distance of two wavelengths that may be bridged by a straight line: filters' edges rise over some 40 nm, and bench
measurements are taken every 5 or 10 nm."""

_Array = npt.NDArray[np.float64]


def require_grid(wavelengths_nm: _Array, where: str) -> None:
    """Refuse wavelengths (W,), ascending, that do not cover the visible range without gaps.

    `wavelengths_nm`: (W,) float64.
    """
    low, high = NEEDED_NM
    if len(wavelengths_nm) < 2 or wavelengths_nm[0] > low or wavelengths_nm[-1] < high:
        span = "none" if not len(wavelengths_nm) else f"{wavelengths_nm[0]:g} to {wavelengths_nm[-1]:g}"
        raise FormatError(
            f"{where}: its wavelengths are {span}, {low:g} to {high:g} nm at least expected; "
            "convert them to nanometres if they are not, or measure the rest"
        )
    steps = np.diff(wavelengths_nm)
    if steps.min() <= 0:
        raise FormatError(f"{where}: {wavelengths_nm[int(steps.argmin())]:g} nm stands there twice; leave one out")
    inside = (wavelengths_nm[:-1] < high) & (wavelengths_nm[1:] > low)
    if steps[inside].max() > WIDEST_STEP_NM:
        at = int(np.flatnonzero(inside)[steps[inside].argmax()])
        raise FormatError(
            f"{where}: there is a gap from {wavelengths_nm[at]:g} to {wavelengths_nm[at + 1]:g} nm, "
            f"{WIDEST_STEP_NM:g} nm at most expected; measure what lies between"
        )


def regridded(wavelengths_nm: _Array, curves: _Array, onto_nm: _Array) -> _Array:
    """Return curves on another grid.

    `wavelengths_nm`: (W,) float64, ascending. `curves`: (W, N) float64, per nanometre. `onto_nm`: (M,) float64,
    ascending in even steps. Returns (M, N) float64; 0 beyond the given wavelengths. If some of these are nearer to each
    other than those of the new grid, each of its values is the mean of the curve weighted by a triangle that reaches to
    the neighbouring wavelengths, which leaves the curve's integral as it is; else the curve's own value.

    Examples
    --------
    >>> line = np.zeros((401, 1)); line[202] = 5.0  # 582 nm, on a grid of 1 nm
    >>> on_5 = regridded(np.arange(380.0, 781.0), line, np.arange(380.0, 781.0, 5.0))
    >>> on_5[40:42, 0].round(3).tolist(), round(float(on_5.sum() * 5), 3)
    ([0.6, 0.4], 5.0)
    """
    step = float(onto_nm[1] - onto_nm[0])
    found = np.zeros((len(onto_nm), curves.shape[1]))
    if float(np.diff(wavelengths_nm).min()) > 0.999 * step:
        for number in range(curves.shape[1]):
            found[:, number] = np.interp(onto_nm, wavelengths_nm, curves[:, number], left=0, right=0)
        return found
    if float(np.diff(wavelengths_nm).max()) > 0.999 * step:
        # Where steps are wider, a wavelength would stand for nodes that lie between it and the next.
        wavelengths_nm, curves = _filled(wavelengths_nm, curves, step)
    # Each wavelength stands for half the way to its neighbours.
    edges = np.concatenate([wavelengths_nm[:1], (wavelengths_nm[1:] + wavelengths_nm[:-1]) / 2, wavelengths_nm[-1:]])
    share = np.clip(1 - np.abs(onto_nm[:, None] - wavelengths_nm[None]) / step, 0, None)
    weights = share * np.diff(edges)[None] / step
    return np.asarray(weights @ curves, dtype=np.float64)


def _filled(wavelengths_nm: _Array, curves: _Array, step: float) -> tuple[_Array, _Array]:
    """Return wavelengths (V,) and curves (V, N) with the gaps of an uneven grid filled to steps below `step` / 4."""
    parts = np.maximum(np.ceil(4 * np.diff(wavelengths_nm) / step), 1).astype(np.int64)
    starts = np.repeat(wavelengths_nm[:-1], parts)
    widths = np.repeat(np.diff(wavelengths_nm) / parts, parts)
    within = np.arange(len(starts)) - np.repeat(np.cumsum(parts) - parts, parts)
    filled = np.append(starts + within * widths, wavelengths_nm[-1])
    found = np.empty((len(filled), curves.shape[1]))
    for number in range(curves.shape[1]):
        found[:, number] = np.interp(filled, wavelengths_nm, curves[:, number])
    return filled, found


@dataclass(frozen=True, eq=False)
class PublishedSpectrum:
    """A spectrum as it was published.

    - `wavelengths_nm`: (W,) float64, ascending in even steps.
    - `power`: (W,) float64, relative, per nm.
    """

    wavelengths_nm: _Array
    power: _Array


@cache
def published_spectra() -> Mapping[str, PublishedSpectrum]:
    """Return every published light by its name, such as ``D65``, ``FL2``, ``LED-B3``, ``Kinoton 75P``."""
    return MappingProxyType(_read("published_lights.csv"))


def daylight(cct_k: float) -> PublishedSpectrum:
    """Return the CIE daylight of a correlated colour temperature (CIE 15:2018, 4.1.2), K, 4000 … 25 000.

    From the components S₀, S₁ and S₂, their factors rounded to three places as the CIE does.
    """
    inverse = 1000 / cct_k
    low = (0.244063, 0.09911, 2.9678, -4.6070)
    high = (0.237040, 0.24748, 1.9018, -2.0064)
    x = sum(factor * inverse**power for power, factor in enumerate(low if cct_k <= 7000 else high))
    y = -3.0 * x**2 + 2.870 * x - 0.275
    scale = 0.0241 + 0.2562 * x - 0.7341 * y
    first = round((-1.3515 - 1.7703 * x + 5.9114 * y) / scale, 3)
    second = round((0.0300 - 31.4424 * x + 30.0717 * y) / scale, 3)
    mean, yellow_blue, pink_green = (_components()[name] for name in ("S0", "S1", "S2"))
    power = mean.power + first * yellow_blue.power + second * pink_green.power
    return PublishedSpectrum(mean.wavelengths_nm, power)


@cache
def _components() -> dict[str, PublishedSpectrum]:
    return _read("daylight_components.csv")


def _read(name: str) -> dict[str, PublishedSpectrum]:
    """Return the spectra of a table in `sim.data`: a line each, name, first wavelength, step, values."""
    found: dict[str, PublishedSpectrum] = {}
    text = resources.files("sim").joinpath("data", name).read_text("utf-8")
    for line in text.splitlines()[1:]:
        light, first, step, values = line.split(";")
        power = np.array(values.split(), dtype=np.float64)
        found[light] = PublishedSpectrum(float(first) + float(step) * np.arange(len(power), dtype=np.float64), power)
    return found


SUFFIX: Final = "_380_780_5.json"
"""What the names of the files in `sim.data` end in: first and last wavelength, and the step (as rawtoaces-data)."""

EDGE_SHARE: Final = 0.05
"""Share of a channel's peak that may be left at the first and the last wavelength of a file, beyond which the channel
is taken to be blind (judgement): what is cut off there is below a hundredth of its light."""

_CHANNELS: Final = ("R", "G", "B")


class _Header(Record):
    manufacturer: str = ""
    model: str = ""


class _Spectra(Record):
    units: str = "relative"
    index: dict[str, list[str]]
    data: dict[str, dict[str, list[float]]]


class _Document(Record):
    header: _Header = _Header()
    spectral_data: _Spectra


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """A camera's spectral sensitivities.

    - `name`: the file's, without its suffix.
    - `maker`, `model`: as the file names the camera; empty where it does not.
    - `wavelengths_nm`: (W,) float64, ascending.
    - `curves`: (W, 3) float64 ≥ 0, R, G, B, response to light of equal power per nm, relative.
    - `sha256`: of the file.
    """

    name: str
    maker: str
    model: str
    wavelengths_nm: _Array
    curves: _Array
    sha256: str

    @property
    def camera(self) -> str:
        """Maker and model as raw files have them, e.g. ``Canon EOS 5DS``; the name where the file states no model."""
        return " ".join(f"{self.maker} {self.model}".split()) if self.model else self.name

    def at(self, wavelengths_nm: _Array) -> _Array:
        """Return the curves (N, 3) float64 on another grid (N,) nm of even steps (`regridded`), 0 beyond their own."""
        return regridded(self.wavelengths_nm, self.curves, wavelengths_nm)


def known_sensitivities() -> tuple[str, ...]:
    """Return the names of the cameras whose sensitivities come with the suite, in alphabetical order.

    Examples
    --------
    >>> "Canon_EOS_5DS" in known_sensitivities()
    True
    """
    files = (entry.name for entry in resources.files("sim").joinpath("data").iterdir())
    return tuple(sorted(name.removesuffix(SUFFIX) for name in files if name.endswith(SUFFIX)))


def read_sensitivities(name: str, more: Sequence[str] = ()) -> Sensitivities:
    """Return the sensitivities that a name or a path stands for; `more` are names that an error lists, too."""
    if name in known_sensitivities():
        data = resources.files("sim").joinpath("data", name + SUFFIX).read_bytes()
        return parse_sensitivities(data, name, name)
    path = Path(name)
    try:
        data = path.read_bytes()
    except OSError as error:
        known = [*known_sensitivities(), *more]
        near = f"{nearest_names(name, known)} ".lstrip()
        raise InputError(
            f"no camera {name!r}: {_unread(error)}; {near}known by name are "
            f"{', '.join(known)}; name one of them, or a file of spectral sensitivities"
        ) from error
    return parse_sensitivities(data, path.name.removesuffix(SUFFIX).removesuffix(".json"), str(path))


def _unread(error: OSError) -> str:
    return "there is no such file" if isinstance(error, FileNotFoundError) else f"cannot read it ({error.strerror})"


def parse_sensitivities(data: bytes, name: str, where: str) -> Sensitivities:
    """Return the sensitivities in the bytes of a file."""
    try:
        document = _Document.model_validate(json.loads(data, object_pairs_hook=_unlike))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise FormatError(f"{where} is no JSON: {error}; expected a file of rawtoaces-data's layout") from error
    except _TwiceError as error:
        raise FormatError(f"{where}: {error.args[0]!r} stands there twice; leave one out") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "document"
        raise FormatError(
            f"{where}: {key}: {first['msg']}; expected rawtoaces-data's layout: spectral_data with units, index.main "
            "and data.main"
        ) from error
    spectra = document.spectral_data
    if spectra.units != "relative":
        raise FormatError(
            f"{where}: spectral_data.units is {spectra.units!r}, 'relative' expected: responses to light of equal "
            "power; multiply a quantum efficiency by the wavelength first"
        )
    if tuple(spectra.index.get("main", ())) != _CHANNELS or "main" not in spectra.data:
        raise FormatError(
            f"{where}: spectral_data.index.main is {spectra.index.get('main')}, with data.main under it; "
            f"{list(_CHANNELS)} expected"
        )
    wavelengths, curves = _sorted(spectra.data["main"], where)
    _require_camera(wavelengths, curves, where)
    header = document.header
    return Sensitivities(name, header.manufacturer, header.model, wavelengths, curves, sha256_of(data))


class _TwiceError(Exception):
    """A key of a JSON object is there twice; its argument is the key."""


def _unlike(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return a JSON object whose keys differ; of two alike `json` would take the last without a word."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise _TwiceError(key)
        found[key] = value
    return found


def _sorted(table: Mapping[str, list[float]], where: str) -> tuple[_Array, _Array]:
    """Return wavelengths (W,), ascending, and curves (W, 3)."""
    rows: list[tuple[float, list[float]]] = []
    for text, values in table.items():
        try:
            wavelength = float(text)
        except ValueError as error:
            raise FormatError(f"{where}: {text!r} is no wavelength; a number of nanometres expected") from error
        if len(values) != len(_CHANNELS) or not all(map(math.isfinite, [wavelength, *values])):
            raise FormatError(f"{where}: at {text} nm stand {values}; three numbers expected, for R, G and B")
        rows.append((wavelength, values))
    rows.sort(key=lambda row: row[0])
    wavelengths = np.array([row[0] for row in rows], dtype=np.float64)
    return wavelengths, np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3)


def _require_camera(wavelengths: _Array, curves: _Array, where: str) -> None:
    """Refuse numbers that cannot be a camera's sensitivities."""
    require_grid(wavelengths, where)
    if curves.min() < 0:
        row, channel = np.unravel_index(int(curves.argmin()), curves.shape)
        raise FormatError(
            f"{where}: {_CHANNELS[channel]} is {curves[row, channel]:g} at {wavelengths[row]:g} nm, 0 or more "
            "expected; set to 0 what is a measurement's noise about 0"
        )
    peak = curves.max(axis=0)
    if peak.min() <= 0:
        raise FormatError(f"{where}: {_CHANNELS[int(peak.argmin())]} is 0 at every wavelength; it sees no light at all")
    for place in (0, -1):
        left = curves[place] / peak
        if left.max() > EDGE_SHARE:
            raise FormatError(
                f"{where}: {_CHANNELS[int(left.argmax())]} still has {left.max():.0%} of its peak at its last "
                f"wavelength, {wavelengths[place]:g} nm; {EDGE_SHARE:.0%} at most expected, so it goes on beyond: add "
                "what is lacking"
            )


def describe_sensitivities(found: Sensitivities) -> dict[str, Any]:
    """Return what a record says of sensitivities: name, camera, and the file's hash."""
    return {"name": found.name, "camera": found.camera, "sha256": found.sha256}
