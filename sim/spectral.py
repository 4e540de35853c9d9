"""Spectra: of cameras (ISO 17321-1) and published lights as measured, and models of projectors, inks and papers.

**Sensitivities** are read from files in the layout of rawtoaces. It is that of
AcademySoftwareFoundation/rawtoaces-data, schema 0.1.0: ``spectral_data.units`` is ``relative``,
``spectral_data.index.main`` names the channels, and ``spectral_data.data.main`` has their responses to light of equal
power by wavelength in nanometres. Only proportions matter: exposure is set elsewhere.

Files of some cameras come with the suite (`sim.data`) and are known by name; any other is named by its path.

**Grids.** What stands on a finer grid is not picked at the new grid's wavelengths but gathered: a line of a lamp that
lies between two of them must not be lost. What stands on a coarser or the same grid is joined by straight lines.

**Published lights**, by their names. The tables are in `sim/data`, whose README says where they are from: the
illuminants of CIE 15:2018 and ISO 7589, and measured light sources.

**Models**, 380 to 780 nm in steps of 5 nm, of projectors and prints: parametric, each with its source; only the
camera's sensitivities are measured data (`sim.data`). All spectra are relative: the exposure's scale is
`sim.world.world`'s business. Pure functions, no state.

Projector. ``uhp``: a short-arc mercury lamp of about 200 bar behind the dichroic red, green and blue segments of a
colour wheel: a continuum, and the lines 405, 436, 546 and 577/579 nm broadened by pressure (Derra et al., "UHP lamp
systems for projection applications", J. Phys. D 38 (2005) 2995, figure 4). ``led``: three light-emitting diodes, each
an asymmetric Gaussian; peaks 633, 515 and 451 nm and full widths of 19, 34 and 22 nm, as three primaries of a
measured LED projector have them (peaks 632, 516, 452 nm; widths at half maximum 19, 34, 21 nm).

Print. Yule-Nielsen spectral Neugebauer model (Yule and Nielsen 1951; Viggiano 1985): the sixteen overprints of cyan,
magenta, yellow and black mixed by Demichel's weights in the power 1/n. A solid ink is a density band; peak
wavelengths, widths and the secondary absorption follow measured ramps on photo paper (yellow: density 1.25 below 480
nm, half at 490; magenta 1.17 at 540, 0.2 at 450; cyan 1.0 at three quarters at 600 nm, half of it left at 700), which
our solids match within about 0.1 in density. The surface's own reflection (matte paper) is added after.

Papers. ``poster`` is what stands above. ``matt`` and ``glossy`` follow prints that an Epson XP-960 made without
colour management, measured with a ColorMunki (olemagnp/print_profiles on GitHub, Argyll .ti3 files with spectra; none
is copied): solid inks and their overprints, 400 to 730 nm, on PermaJet Matt Plus 240 and Ilford Galerie Smooth Pearl,
which one set of inks over two surfaces matches within 2.5 CIEDE2000 on average. Over that collection, and an Epson
P800's glossy print (metebalci/profiling-an-epson-p800-printer), the density of black is 1.63 to 1.79 on four matt
photo papers, 2.11 to 2.51 on ten from satin to glossy, 1.46 on an art and 1.28 on an office paper; the convex hulls
of printed colours in CIELAB under D50 have 460 000 to 540 000, 580 000 to 790 000, 402 000 and 245 000 units. A
review of many more papers has 1.6 to 1.7 and 2.0 to 2.2 (M. McNamee, "The whole range", swpp.co.uk, 2010). Ours have
hulls of 466 000 and 596 000: four inks, where such printers have six and more. Black is even over wavelength, as
pigment blacks measure (P800, Canon Pro-300); the XP-960's dye black lets red beyond 680 nm through, which is left
out.

**Profile.** Which ink codes print an sRGB file so that its greys are grey: ``unmanaged`` sends the file's codes to
the inks as they are, which is what the publication does: the grey axis then has the tint that equal codes of the inks
give. ``managed`` is what a print shop's ICC profile does: sRGB (IEC 61966-2-1) → CIE XYZ of D50 (Bradford, as in
ICC.1:2022 annex E) → relative colorimetric with black point compensation → ink codes of the paper. White is bare
paper; black is the darkest neutral that the inks reach; in between, luminance over that of paper is linear between
the two, as Adobe's black point compensation has it (ISO 18619). What no ink reaches goes to the nearest colour that
one does, in CIELAB of the CIE 1931 observer under D50 relative to paper, differences of hue counted twice (chosen:
profiles keep hue before chroma).

As in an ICC profile the table has 33 nodes a channel, is found by inverting the model of the print
(Levenberg-Marquardt from the nearest node of a coarse grid) and interpolated in tetrahedra, in
which grey codes depend on grey nodes alone (Kasson and others, J. Electronic Imaging 4 (1995) 226).
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
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from foundation.colorimetry import decode_srgb, observer_cie_1931
from foundation.errors import FormatError, InputError, nearest_names
from foundation.files import sha256_of
from foundation.records import Record

# Wavelengths that must be covered: beyond them a camera with its infrared filter sees under 2 % of its light.
NEEDED_NM: Final = (400.0, 700.0)

# Distance of two wavelengths that may be bridged by a straight line: filters' edges rise over some 40 nm, and bench
# measurements are taken every 5 or 10 nm.
WIDEST_STEP_NM: Final = 20.0

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


# What the names of the files in `sim.data` end in: first and last wavelength, and the step (as rawtoaces-data).
SUFFIX: Final = "_380_780_5.json"

# Share of a channel's peak that may be left at the first and the last wavelength of a file, beyond which the channel
# is taken to be blind (judgement): what is cut off there is below a hundredth of its light.
EDGE_SHARE: Final = 0.05

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


# (81,) float64, the wavelengths of every spectrum here.
WAVELENGTHS_NM: NDArray[np.float64] = np.arange(380.0, 781.0, 5.0)

LampSpectrum = Literal["uhp", "led"]

PaperName = Literal["poster", "matt", "glossy"]  # Papers of the simulated print

SURFACE_REFLECTANCE = 0.03  # Light that plain matte paper returns before it meets ink (share of the incident)

# The same of coated matt photo paper: the measured matt black is 0.016 to 0.026 from 400 to 660 nm.
MATT_SURFACE = 0.0165

# The same of glossy paper, lit off the mirror's angle: the measured glossy black falls to 0.0038.
GLOSSY_SURFACE = 0.0035

# Density of solid matt black below the surface, so that the density of black is that of the measured paper.
MATT_BLACK = 1.8

GLOSSY_BLACK = 2.0  # Density of solid photo black below the surface, for the same reason

YULE_NIELSEN_N = 2.0  # Yule-Nielsen factor; 2 is full optical dot gain

DOT_GAIN = 0.14  # Mechanical dot gain: how much a coverage of one half grows

# Coverage of black on poster paper where all three inks are full; below 1, so that black never hides them wholly
# (chosen, not measured).
_BLACK_GENERATION = 0.9

# Share of the black by which each of the three inks is reduced; partial, so that dark cells keep their inks (chosen).
_UNDERCOLOUR_REMOVAL = 0.4


def _gauss(centre_nm: float, left_nm: float, right_nm: float | None = None) -> NDArray[np.float64]:
    """Return a bell of height 1 with standard deviations left and right of its centre."""
    distance = WAVELENGTHS_NM - centre_nm
    width = np.where(distance < 0, left_nm, left_nm if right_nm is None else right_nm)
    return np.exp(-0.5 * (distance / width) ** 2)


def _rise(centre_nm: float, width_nm: float) -> NDArray[np.float64]:
    """Return an edge from 0 (short waves) to 1 (long waves)."""
    return 1 / (1 + np.exp(-(WAVELENGTHS_NM - centre_nm) / width_nm))


def projector_primaries(lamp: LampSpectrum = "uhp") -> NDArray[np.float64]:
    """Return the light of each primary at full drive.

    Returns (3, 81) float64, red, green, blue; relative power per nm. White is near D65: CIE 1931 x, y within 0.02.
    """
    if lamp == "led":
        power = np.stack([_gauss(633, 8.5, 7.5), _gauss(515, 13, 16), _gauss(451, 9, 10)])
        balance = (1.86, 1.0, 0.775)
    else:
        continuum = 0.55 * _gauss(560, 130) + 0.35 * _gauss(640, 90)
        lines = 0.6 * _gauss(405, 4) + 1.9 * _gauss(437, 5, 8) + 2.1 * _gauss(547, 5, 8) + 1.9 * _gauss(579, 6, 8)
        arc = (continuum + lines) * _rise(412, 4) * (1 - _rise(700, 6))
        # The notch keeps the yellow line out of green and out of red, as such wheels have it for purer primaries.
        power = arc * np.stack([_rise(600, 3), _rise(505, 4) * (1 - _rise(568, 3)), 1 - _rise(493, 4)])
        balance = (1.29, 1.0, 1.12)
    return power * np.array(balance)[:, None]


@dataclass(frozen=True, eq=False)
class InkedPaper:
    """A paper and the inks on it.

    - `white`: (81,) float64, reflectance of the bare paper.
    - `inks`: (4, 81) float64, optical density of solid cyan, magenta, yellow and black over white, surface left out.
    - `surface`: share of the incident light that the surface sends to the camera before it meets ink.
    - `black_generation`: coverage of black where all three inks are full.
    - `undercolour_removal`: share of the black by which each of the three inks is reduced.
    """

    white: NDArray[np.float64]
    inks: NDArray[np.float64]
    surface: float
    black_generation: float
    undercolour_removal: float

    def overprints(self) -> NDArray[np.float64]:
        """Return (16, 81) float64, reflectance below the surface of the overprints, in the order of `shares`."""
        densities = np.zeros((1, len(WAVELENGTHS_NM)))
        for density in self.inks:
            densities = np.concatenate([densities, densities + density], axis=0)
        return (self.white - self.surface) / (1 - self.surface) * 10.0**-densities

    def shares(self, coverage: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 16) float64, Demichel's share of each overprint where inks are set to cover (N, 4)."""
        covered = coverage + 4 * DOT_GAIN * coverage * (1 - coverage)
        weights = np.ones((len(covered), 1))
        for ink in covered.T:
            weights = np.concatenate([weights * (1 - ink)[:, None], weights * ink[:, None]], axis=1)
        return weights


def paper_white() -> NDArray[np.float64]:
    """Return (81,) float64, the reflectance of bare paper: slightly blue by its brightener, absorbing near ultraviolet.

    The measured photo paper rises from 0.64 at 400 nm to 0.93 at 450 nm and falls to 0.85 at 600 nm; so does this one.
    """
    return (0.45 + 0.405 * _rise(402, 9)) + 0.075 * _gauss(452, 22, 50) + 0.03 * _rise(680, 15)


def _poster_inks() -> NDArray[np.float64]:
    """Return (4, 81) float64: optical density of solid cyan, magenta, yellow and black over white."""
    cyan = 1.40 * _gauss(606, 48, 85) + 0.12 * _gauss(380, 30)
    magenta = 1.17 * _gauss(542, 45, 29) + 0.10 * _gauss(400, 40)
    yellow = 1.27 * (1 - _rise(491, 11))
    black = np.full_like(WAVELENGTHS_NM, 1.9)
    return np.stack([cyan, magenta, yellow, black])


def _photo_inks(black: float) -> NDArray[np.float64]:
    """Return (4, 81) float64: the same of a photo printer, with a black of even density as pigment blacks have it.

    Least squares over cyan, magenta, yellow and their overprints, 400 … 730 nm, on a glossy and a matt paper.
    """
    cyan = 1.85 * (_gauss(596, 37, 81) + 0.14 * _gauss(380, 75))
    magenta = 1.77 * (_gauss(548, 59, 29) + 0.10 * _gauss(397, 20))
    yellow = 1.84 * (1 - _rise(492, 11))
    return np.stack([cyan, magenta, yellow, np.full_like(WAVELENGTHS_NM, black)])


@cache
def paper(name: PaperName) -> InkedPaper:
    """Return a paper with its inks."""
    if name == "poster":
        return InkedPaper(paper_white(), _poster_inks(), SURFACE_REFLECTANCE, _BLACK_GENERATION, _UNDERCOLOUR_REMOVAL)
    if name == "matt":
        white = (0.45 + 0.43 * _rise(402, 9)) + 0.045 * _gauss(452, 22, 50) + 0.035 * _rise(640, 15)
        return InkedPaper(white, _photo_inks(MATT_BLACK), MATT_SURFACE, 1.0, 0.5)
    if name == "glossy":
        return InkedPaper(paper_white(), _photo_inks(GLOSSY_BLACK), GLOSSY_SURFACE, 1.0, 0.5)
    raise ValueError(f"paper {name!r}: known are {', '.join(get_args(PaperName))}")


def ink_coverage(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the share of the paper that each ink is set to cover.

    Returns (..., 4) float64 in 0 … 1, cyan, magenta, yellow, black: the complement of the code, with grey component
    replacement: black grows with the square of the least of the three, which lose a share of it.
    """
    chosen = paper(on)
    cmy = 1 - np.asarray(rgb, dtype=np.float64) / 255
    black = chosen.black_generation * cmy.min(axis=-1, keepdims=True) ** 2
    return np.concatenate([cmy - chosen.undercolour_removal * black, black], axis=-1)


def print_reflectance(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the reflectance of printed ink codes; (255, 255, 255) is bare paper.

    `rgb`: (N, 3) float or int codes 0 … 255. Returns (N, 81) float64, 0 … 1, never below the reflectance of the paper's
    surface.
    """
    chosen = paper(on)
    weights = chosen.shares(ink_coverage(rgb, on))
    mixed = (weights @ chosen.overprints() ** (1 / YULE_NIELSEN_N)) ** YULE_NIELSEN_N
    return chosen.surface + (1 - chosen.surface) * mixed


@cache
def sensitivities(name: str) -> NDArray[np.float64]:
    """Return a camera's measured spectral sensitivities.

    Returns (81, 3) float64, R, G, B, relative; read-only. Those of `sim.data` are relative to the peak of G.
    """
    curves = read_sensitivities(name).at(WAVELENGTHS_NM)
    curves.setflags(write=False)
    return curves


ProfileName = Literal["unmanaged", "managed"]  # What is done to codes before they are inks

NODES = 33  # Nodes a channel of the table, as ICC profiles for output have them

_HUE_WEIGHT = 2.0  # Weight of differences of hue where a colour cannot be printed (chosen)

# CIELAB units within which a print counts as neutral when its black point is looked for; the eye sees 1. The smaller,
# the paler the black: all inks together are not neutral, and what makes them so is left out.
_NEUTRAL = 0.7

# Linear sRGB to CIE XYZ under D50, Bradford adapted; its rows' sums are D50.
_SRGB_TO_D50 = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)

_STEPS = 40  # Iterations of the inversion at most; inside the gamut it ends after five to ten


def printed_reflectance(
    rgb: ArrayLike, profile: ProfileName = "unmanaged", on: PaperName = "poster"
) -> NDArray[np.float64]:
    """Return the reflectance of an sRGB file's codes as printed.

    `rgb`: (N, 3) float or int codes 0 … 255 of the file. Returns (N, 81) float64, 0 … 1, at
    `sim.spectral.WAVELENGTHS_NM`; (255, 255, 255) is bare paper.
    """
    if profile not in get_args(ProfileName):
        raise ValueError(f"profile {profile!r}: known are {', '.join(get_args(ProfileName))}")
    return print_reflectance(ink_codes(rgb, on) if profile == "managed" else rgb, on)


def ink_codes(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the ink codes (N, 3) float64, 0 … 255, that the managed profile of a paper makes of sRGB codes (N, 3)."""
    table = _table(on)
    place = np.clip(np.asarray(rgb, dtype=np.float64), 0, 255) / 255 * (NODES - 1)
    corner = np.minimum(place.astype(np.int64), NODES - 2)
    share = place - corner
    # From the corner to its opposite, one channel after another, that with the largest share first: a tetrahedron.
    order = np.argsort(-share, axis=1, kind="stable")
    sorted_share = np.take_along_axis(share, order, axis=1)
    weights = -np.diff(np.concatenate([np.ones((len(place), 1)), sorted_share, np.zeros((len(place), 1))], axis=1))
    at = corner.copy()
    codes = weights[:, :1] * table[at[:, 0], at[:, 1], at[:, 2]]
    for step in range(3):
        np.put_along_axis(at, order[:, step, None], np.take_along_axis(at, order[:, step, None], axis=1) + 1, axis=1)
        codes = codes + weights[:, step + 1, None] * table[at[:, 0], at[:, 1], at[:, 2]]
    return codes


@cache
def _observer() -> _Array:
    """Return (81, 3): CIE 1931 colour-matching functions times D50."""
    wavelengths, functions = observer_cie_1931()
    light = published_spectra()["D50"]
    matching = functions[np.searchsorted(wavelengths, WAVELENGTHS_NM)]
    return matching * light.power[np.searchsorted(light.wavelengths_nm, WAVELENGTHS_NM), None]


def _lab(xyz: _Array) -> _Array:
    """Return CIELAB (CIE 15:2018, 8.2.1) of XYZ over white."""
    root = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _wanted(share: _Array, black: float) -> _Array:
    """Return XYZ over white of sRGB codes 0 … 1, black point compensated."""
    linear = decode_srgb(share)
    return black + (1 - black) * (linear @ _SRGB_TO_D50.T) / _SRGB_TO_D50.sum(axis=1)


class _Inks:
    """What ink codes of a paper look like, exact for a Yule-Nielsen factor of 2: XYZ is a square form of the shares."""

    def __init__(self, on: PaperName) -> None:
        if YULE_NIELSEN_N != 2:
            raise ValueError(f"the Yule-Nielsen factor is {YULE_NIELSEN_N}; the square form holds for 2 alone")
        chosen, observer = paper(on), _observer()
        roots = np.sqrt(chosen.overprints())
        white = chosen.white @ observer
        self._on: PaperName = on
        self._paper = chosen
        self._floor = chosen.surface * observer.sum(axis=0) / white
        forms = np.einsum("il,lc,jl->cij", roots, observer, roots) * (1 - chosen.surface)
        self._forms = forms / white[:, None, None]

    def xyz(self, share: _Array) -> _Array:
        """Return (N, 3) XYZ over paper of ink codes (N, 3), 0 … 1."""
        weights = self._paper.shares(ink_coverage(share * 255, self._on))
        return self._floor + np.stack([((weights @ form) * weights).sum(axis=1) for form in self._forms], axis=1)

    def matching(self, lab: _Array) -> _Array:
        """Return the ink codes (N, 3), 0 … 1, that look most like CIELAB (N, 3)."""
        from scipy.spatial import cKDTree

        axis = np.linspace(0, 1, 9)
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        seen = _lab(self.xyz(grid))
        share = grid[cKDTree(seen).query(lab)[1]]
        chroma = np.hypot(lab[:, 1], lab[:, 2])
        along = np.where(chroma[:, None] > 1e-6, lab[:, 1:] / np.maximum(chroma, 1e-6)[:, None], [1.0, 0.0])
        turn = np.zeros((len(lab), 3, 3))
        turn[:, 0, 0] = 1
        turn[:, 1, 1:] = along
        turn[:, 2, 1:] = _HUE_WEIGHT * along[:, ::-1] * [-1, 1]
        damping = np.full(len(lab), 1e-2)
        error = self._off(share, lab, turn)
        going = np.arange(len(lab))
        for _ in range(_STEPS):
            here, off, matrix = share[going], error[going], turn[going]
            slope = np.empty((len(going), 3, 3))
            for channel in range(3):
                # Away from the border that is nearer, so that no code leaves 0 … 1.
                nudge = np.where(here[:, channel] < 0.5, 1e-5, -1e-5)
                moved = here.copy()
                moved[:, channel] += nudge
                slope[:, :, channel] = (self._off(moved, lab[going], matrix) - off) / nudge[:, None]
            downhill = (off[:, None] @ slope)[:, 0]
            # A code at its border that wants beyond it stays there.
            held = ((here <= 0) & (downhill > 0)) | ((here >= 1) & (downhill < 0))
            slope = np.where(held[:, None], 0, slope)
            curvature = slope.swapaxes(1, 2) @ slope
            scale = damping[going] * (1 + np.trace(curvature, axis1=1, axis2=2))
            curvature += scale[:, None, None] * np.eye(3)
            wish = np.where(held, 0, downhill)[..., None]
            step: _Array = np.asarray(-np.linalg.solve(curvature, wish)[..., 0], dtype=np.float64)
            tried: _Array = np.clip(here + step, 0, 1)
            found = self._off(tried, lab[going], matrix)
            gain = (off**2).sum(axis=1) - (found**2).sum(axis=1)
            better = gain > 0
            share[going[better]], error[going[better]] = tried[better], found[better]
            damping[going] *= np.where(better, 0.2, 8)
            done = ((found**2).sum(axis=1) < 1e-6) | (better & (gain < 1e-7)) | (damping[going] > 1e6)
            going = going[~done]
            if len(going) == 0:
                break
        return share

    def _off(self, share: _Array, lab: _Array, turn: _Array) -> _Array:
        """Return (N, 3) differences in lightness, chroma and weighted hue."""
        return (turn @ (_lab(self.xyz(share)) - lab)[..., None])[..., 0]


@cache
def _black(on: PaperName) -> float:
    inks = _Inks(on)
    darkest = float(inks.xyz(np.zeros((1, 3)))[0, 1])
    tried = darkest * np.geomspace(1, 2, 41)
    lab = _lab(np.repeat(tried[:, None], 3, axis=1))
    off = np.linalg.norm(_lab(inks.xyz(inks.matching(lab))) - lab, axis=1)
    return float(tried[np.argmax(off < _NEUTRAL)])


@cache
def _table(on: PaperName) -> _Array:
    """Return (33, 33, 33, 3) ink codes 0 … 255 by the codes of the file."""
    axis = np.linspace(0, 1, NODES)
    codes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    share = _Inks(on).matching(_lab(_wanted(codes.reshape(-1, 3), _black(on))))
    table = 255 * share.reshape(codes.shape)
    table[-1, -1, -1] = 255
    table.setflags(write=False)
    return table
