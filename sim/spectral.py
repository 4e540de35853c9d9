"""Spectra of cameras, light sources, projectors, inks and papers.

**Camera sensitivities** (ISO 17321-1) are measured. Their files have the format of
AcademySoftwareFoundation/rawtoaces-data, schema 0.1.0: relative responses of R, G and B to equal power, by wavelength
in nm. Cameras in `sim.data` are selected by name, others by the path of their file.

**Published illuminants** are in `sim/data`: illuminants of CIE 15:2018 and ISO 7589, and measured light sources. The
README of that folder names the sources.

**Projectors, inks and papers** are parametric models from 380 to 780 nm in steps of 5 nm. Their spectra are relative;
`sim.world.world` sets the exposure.

Projector ``uhp`` is a mercury arc lamp (200 bar) behind a colour wheel with dichroic red, green and blue segments. Its
spectrum is a continuum with pressure-broadened lines at 405, 436, 546 and 577/579 nm (Derra et al., "UHP lamp systems
for projection applications", J. Phys. D 38 (2005) 2995, figure 4). Projector ``led`` follows a measured projector with
LEDs. Its primaries are asymmetric Gaussians.

The print follows the Yule-Nielsen spectral Neugebauer model (Yule and Nielsen 1951; Viggiano 1985). It takes the
reflectances of the sixteen overprints of cyan, magenta, yellow and black to the power 1/n, and averages them with
Demichel's weights. The reflection of the surface is added. Densities of the solid inks agree within about 0.1 with
measured prints on photo paper.

Papers ``matt`` and ``glossy`` follow prints of an Epson XP-960 without colour management, measured with a ColorMunki
(olemagnp/print_profiles on GitHub; no data are copied). Inks and overprints differ by 2.5 CIEDE2000 on average from the
prints on PermaJet Matt Plus 240 and Ilford Galerie Smooth Pearl. Densities of black agree with that collection, with an
Epson P800 (metebalci/profiling-an-epson-p800-printer) and with a review of more papers (M. McNamee, "The whole range",
swpp.co.uk, 2010). The volumes of printed colours in CIELAB (D50) are near the smallest measured volumes, because the
model has four inks and the measured printers have six or more. Black is constant over wavelength, like measured pigment
blacks (P800, Canon Pro-300).

**Profiles.** With ``unmanaged``, the codes of the file are ink codes, as in Banić et al. 2019. Greys then have the tint
of equal inks. ``managed`` converts like an ICC profile of a print shop, in three steps:

1. sRGB (IEC 61966-2-1) to CIE XYZ under D50 (Bradford, ICC.1:2022 annex E);
2. relative colorimetric rendering with black point compensation (ISO 18619): white is bare paper, black is the darkest
   neutral print, and luminance between them is linear;
3. XYZ to ink codes of the paper.

Colours out of gamut become the nearest printable colour in CIELAB relative to paper. Differences of hue count twice,
because profiles preserve hue rather than chroma. The conversion table is the numerical inverse of the print model.
Interpolation in tetrahedra keeps greys neutral, because grey codes depend on grey nodes only (Kasson and others, J.
Electronic Imaging 4 (1995) 226).
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

from foundation.colorimetry import angles_deg, decode_srgb, fit_white_matrix, linear_srgb, observer_cie_1931
from foundation.errors import FormatError, InputError, nearest_names
from foundation.files import sha256_of
from foundation.records import Record

# Range that a spectrum must cover, nm. A camera with infrared filter gets less than 2 % of its signal outside.
NEEDED_NM: Final = (400.0, 700.0)

# Widest allowed step between wavelengths, nm. Edges of filters rise over about 40 nm.
WIDEST_STEP_NM: Final = 20.0

_Array = npt.NDArray[np.float64]


def require_grid(wavelengths_nm: _Array, where: str) -> None:
    """Raise a FormatError unless ascending wavelengths (W,) float64 cover the visible range without gaps."""
    low, high = NEEDED_NM
    if len(wavelengths_nm) < 2 or wavelengths_nm[0] > low or wavelengths_nm[-1] < high:
        span = "none" if not len(wavelengths_nm) else f"{wavelengths_nm[0]:g} to {wavelengths_nm[-1]:g}"
        raise FormatError(
            f"{where}: its wavelengths are {span}, expected at least {low:g} to {high:g} nm; "
            "convert them to nanometres, or measure the missing ones"
        )
    steps = np.diff(wavelengths_nm)
    if steps.min() <= 0:
        raise FormatError(f"{where}: {wavelengths_nm[int(steps.argmin())]:g} nm occurs twice; delete one")
    is_visible = (wavelengths_nm[:-1] < high) & (wavelengths_nm[1:] > low)
    if steps[is_visible].max() > WIDEST_STEP_NM:
        widest = int(np.flatnonzero(is_visible)[steps[is_visible].argmax()])
        raise FormatError(
            f"{where}: a gap from {wavelengths_nm[widest]:g} to {wavelengths_nm[widest + 1]:g} nm, "
            f"expected at most {WIDEST_STEP_NM:g} nm; measure the wavelengths between"
        )


def resampled(wavelengths_nm: _Array, curves: _Array, onto_nm: _Array) -> _Array:
    """Resample curves to another grid.

    `wavelengths_nm`: (W,) float64, ascending. `curves`: (W, N) float64, per nm. `onto_nm`: (M,) float64, ascending in
    equal steps. Returns (M, N) float64; 0 outside of the wavelengths.

    Curves on a coarser grid are interpolated linearly. Curves on a finer grid are averaged with triangular weights,
    which preserve the integral, because interpolation would lose lamp lines between two new wavelengths.

    Examples
    --------
    >>> line = np.zeros((401, 1)); line[202] = 5.0  # 582 nm, on a grid of 1 nm
    >>> on_5 = resampled(np.arange(380.0, 781.0), line, np.arange(380.0, 781.0, 5.0))
    >>> on_5[40:42, 0].round(3).tolist(), round(float(on_5.sum() * 5), 3)
    ([0.6, 0.4], 5.0)
    """
    step = float(onto_nm[1] - onto_nm[0])
    values = np.zeros((len(onto_nm), curves.shape[1]))
    if float(np.diff(wavelengths_nm).min()) > 0.999 * step:
        for number in range(curves.shape[1]):
            values[:, number] = np.interp(onto_nm, wavelengths_nm, curves[:, number], left=0, right=0)
        return values
    if float(np.diff(wavelengths_nm).max()) > 0.999 * step:
        # On the original grid, new points inside a wide step would be 0, and points at the ends of the step too large.
        wavelengths_nm, curves = _densified(wavelengths_nm, curves, step)
    # Each wavelength represents half the distance to its neighbours.
    edges = np.concatenate([wavelengths_nm[:1], (wavelengths_nm[1:] + wavelengths_nm[:-1]) / 2, wavelengths_nm[-1:]])
    share = np.clip(1 - np.abs(onto_nm[:, None] - wavelengths_nm[None]) / step, 0, None)
    weights = share * np.diff(edges)[None] / step
    return np.asarray(weights @ curves, dtype=np.float64)


def _densified(wavelengths_nm: _Array, curves: _Array, step: float) -> tuple[_Array, _Array]:
    """Interpolate an uneven grid to steps below `step` / 4; return wavelengths (V,) and curves (V, N)."""
    counts = np.maximum(np.ceil(4 * np.diff(wavelengths_nm) / step), 1).astype(np.int64)
    starts = np.repeat(wavelengths_nm[:-1], counts)
    widths = np.repeat(np.diff(wavelengths_nm) / counts, counts)
    within = np.arange(len(starts)) - np.repeat(np.cumsum(counts) - counts, counts)
    filled = np.append(starts + within * widths, wavelengths_nm[-1])
    values = np.empty((len(filled), curves.shape[1]))
    for number in range(curves.shape[1]):
        values[:, number] = np.interp(filled, wavelengths_nm, curves[:, number])
    return filled, values


@dataclass(frozen=True, eq=False)
class PublishedSpectrum:
    """A published spectrum."""

    wavelengths_nm: _Array  # (W,) float64, ascending in equal steps
    power: _Array  # (W,) float64, relative, per nm


@cache
def published_spectra() -> Mapping[str, PublishedSpectrum]:
    """Return all published illuminants by name, such as ``D65``, ``FL2``, ``LED-B3``, ``Kinoton 75P``."""
    return MappingProxyType(_read("published_lights.csv"))


@cache
def published_reflectances() -> Mapping[str, PublishedSpectrum]:
    """Return the reflectances of the 24 patches of a ColorChecker by name, 0 to 1, as `power`."""
    return MappingProxyType(_read("colour_checker.csv"))


def daylight(cct_k: float) -> PublishedSpectrum:
    """Return CIE daylight (CIE 15:2018, 4.1.2) of a correlated colour temperature of 4000 to 25 000 K.

    Computed from S₀, S₁ and S₂ with factors rounded to three decimals, as the CIE does.
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
    # One line per spectrum: name, first wavelength, step, values.
    spectra: dict[str, PublishedSpectrum] = {}
    text = resources.files("sim").joinpath("data", name).read_text("utf-8")
    for line in text.splitlines()[1:]:
        light, first, step, values = line.split(";")
        power = np.array(values.split(), dtype=np.float64)
        spectra[light] = PublishedSpectrum(float(first) + float(step) * np.arange(len(power), dtype=np.float64), power)
    return spectra


# End of the file names in `sim.data`: first and last wavelength and step, as in rawtoaces-data.
SUFFIX: Final = "_380_780_5.json"

# Highest allowed response at the first and last wavelength of a file, relative to the peak. At this limit, the missing
# light is below 1 %.
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
    """Spectral sensitivities of a camera."""

    name: str  # File name without suffix
    maker: str  # From the file; may be empty
    model: str  # From the file; may be empty
    wavelengths_nm: _Array  # (W,) float64, ascending
    curves: _Array  # (W, 3) float64 ≥ 0, relative response of R, G, B to equal power per nm
    sha256: str  # Hash of the file

    @property
    def camera(self) -> str:
        """Maker and model as in raw files, for example ``Canon EOS 5DS``; the name if the model is empty."""
        return " ".join(f"{self.maker} {self.model}".split()) if self.model else self.name

    def at(self, wavelengths_nm: _Array) -> _Array:
        """Return the curves (N, 3) float64 on a grid (N,) nm with equal steps (`resampled`)."""
        return resampled(self.wavelengths_nm, self.curves, wavelengths_nm)


def known_sensitivities() -> tuple[str, ...]:
    """Return the names of the included sensitivities in alphabetical order.

    Examples
    --------
    >>> "Canon_EOS_5DS" in known_sensitivities()
    True
    """
    files = (entry.name for entry in resources.files("sim").joinpath("data").iterdir())
    return tuple(sorted(name.removesuffix(SUFFIX) for name in files if name.endswith(SUFFIX)))


# Remedy for an unknown camera
OTHER_CAMERA: Final = (
    "sim table --camera list shows all names. For another camera, give the path of a JSON file of sensitivities; "
    "https://github.com/AcademySoftwareFoundation/rawtoaces-data has more, in data/camera"
)


def read_sensitivities(name: str, other_names: Sequence[str] = ()) -> Sensitivities:
    """Return the sensitivities of an included camera or of a file; error messages also suggest `other_names`."""
    if name in known_sensitivities():
        data = resources.files("sim").joinpath("data", name + SUFFIX).read_bytes()
        return parse_sensitivities(data, name, name)
    path = Path(name)
    try:
        data = path.read_bytes()
    except OSError as error:
        near = f"{nearest_names(name, [*known_sensitivities(), *other_names], 3)} ".lstrip()
        raise InputError(f"no camera {name!r}: {_reading_problem(error)}; {near}{OTHER_CAMERA}") from error
    return parse_sensitivities(data, path.name.removesuffix(SUFFIX).removesuffix(".json"), str(path))


def _reading_problem(error: OSError) -> str:
    return "no such file" if isinstance(error, FileNotFoundError) else f"cannot read it ({error.strerror})"


def parse_sensitivities(data: bytes, name: str, where: str) -> Sensitivities:
    """Return the sensitivities of a file from its bytes; `where` is its name in messages."""
    try:
        document = _Document.model_validate(json.loads(data, object_pairs_hook=_unique_keys))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise FormatError(
            f"{where} is not JSON: {error}, expected the format of rawtoaces-data; give another file"
        ) from error
    except _DuplicateKeyError as error:
        raise FormatError(f"{where}: {error.args[0]!r} occurs twice, expected once; delete one") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "document"
        raise FormatError(
            f"{where}: {key}: {first['msg']}, expected the format of rawtoaces-data; correct spectral_data with units, "
            "index.main and data.main"
        ) from error
    spectra = document.spectral_data
    if spectra.units != "relative":
        raise FormatError(
            f"{where}: spectral_data.units is {spectra.units!r}, expected 'relative', the response to equal "
            "power; multiply quantum efficiencies by the wavelength"
        )
    if tuple(spectra.index.get("main", ())) != _CHANNELS or "main" not in spectra.data:
        raise FormatError(
            f"{where}: spectral_data.index.main is {spectra.index.get('main')}, expected "
            f"{list(_CHANNELS)} and data.main; correct it"
        )
    wavelengths, curves = _sorted(spectra.data["main"], where)
    _require_camera(wavelengths, curves, where)
    header = document.header
    return Sensitivities(name, header.manufacturer, header.model, wavelengths, curves, sha256_of(data))


class _DuplicateKeyError(Exception):
    """A key occurs twice in a JSON object; the argument is the key."""


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    # json would silently use the last of two equal keys.
    document: dict[str, Any] = {}
    for key, value in pairs:
        if key in document:
            raise _DuplicateKeyError(key)
        document[key] = value
    return document


def _sorted(table: Mapping[str, list[float]], where: str) -> tuple[_Array, _Array]:
    # Wavelengths (W,), ascending, and curves (W, 3).
    rows: list[tuple[float, list[float]]] = []
    for text, values in table.items():
        try:
            wavelength = float(text)
        except ValueError as error:
            raise FormatError(f"{where}: the wavelength is {text!r}, expected a number in nm; correct it") from error
        if len(values) != len(_CHANNELS) or not all(map(math.isfinite, [wavelength, *values])):
            raise FormatError(f"{where}: at {text} nm are {values}, expected three numbers for R, G and B; correct it")
        rows.append((wavelength, values))
    rows.sort(key=lambda row: row[0])
    wavelengths = np.array([row[0] for row in rows], dtype=np.float64)
    return wavelengths, np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3)


def _require_camera(wavelengths: _Array, curves: _Array, where: str) -> None:
    require_grid(wavelengths, where)
    if curves.min() < 0:
        row, channel = np.unravel_index(int(curves.argmin()), curves.shape)
        raise FormatError(
            f"{where}: {_CHANNELS[channel]} is {curves[row, channel]:g} at {wavelengths[row]:g} nm, expected 0 or "
            "more; replace negative values of measurement noise by 0"
        )
    peak = curves.max(axis=0)
    if peak.min() <= 0:
        raise FormatError(f"{where}: {_CHANNELS[int(peak.argmin())]} is always 0, values above 0 expected; correct it")
    for edge in (0, -1):
        edge_share = curves[edge] / peak
        if edge_share.max() > EDGE_SHARE:
            raise FormatError(
                f"{where}: {_CHANNELS[int(edge_share.argmax())]} has {edge_share.max():.0%} of its peak at the end of "
                f"its range, {wavelengths[edge]:g} nm, expected at most {EDGE_SHARE:.0%}; add the missing wavelengths"
            )


def describe_sensitivities(source: Sensitivities) -> dict[str, Any]:
    """Return name, camera and hash for a record."""
    return {"name": source.name, "camera": source.camera, "sha256": source.sha256}


# Wavelengths of all spectra of the models, (81,) float64.
WAVELENGTHS_NM: NDArray[np.float64] = np.arange(380.0, 781.0, 5.0)


def matrix_record(camera: Sensitivities) -> dict[str, Any]:
    """Return the colour matrix of a camera under D65 for a record: rows, linear sRGB to camera RGB, and source.

    Least squares over the 24 reflectances of a ColorChecker. It keeps white, and is rounded to four decimals.
    """
    grid, functions = observer_cie_1931()
    d65, patches = published_spectra()["D65"], published_reflectances().values()
    power = resampled(d65.wavelengths_nm, d65.power[:, None], WAVELENGTHS_NM)
    reflectances = np.stack([patch.power for patch in patches])
    observer, sensor = power * resampled(grid, functions, WAVELENGTHS_NM), power * camera.at(WAVELENGTHS_NM)
    linear = linear_srgb(reflectances @ observer) / linear_srgb(observer.sum(axis=0))
    responses = reflectances @ sensor / sensor.sum(axis=0)
    rows = fit_white_matrix(linear, responses)
    residual = float(np.median(angles_deg(linear @ rows.T, responses)))
    source = "least squares over the sensitivities and 24 reflectances under D65"
    return {"rows": rows.round(4).tolist(), "source": f"{source}; median residual {residual:.1f} degrees"}


LampSpectrum = Literal["uhp", "led"]

PaperName = Literal["poster", "matt", "glossy"]  # Papers of the simulated print.

SURFACE_REFLECTANCE = 0.03  # Share of the light that the surface of plain matt paper reflects.

MATT_SURFACE = 0.0165  # This share for coated matt photo paper, whose measured black reflects 0.016 to 0.026.

# This share for glossy paper outside of the mirror direction. Measured black on glossy paper reflects at least 0.0038.
GLOSSY_SURFACE = 0.0035

# Density of solid matt black without the reflection of the surface. With this reflection, it equals the measured
# density.
MATT_BLACK = 1.8

GLOSSY_BLACK = 2.0  # Density of solid photo black on glossy paper, also without the reflection.

YULE_NIELSEN_N = 2.0  # Yule-Nielsen factor; 2 is full optical dot gain.

DOT_GAIN = 0.14  # Mechanical dot gain: increase of a coverage of 0.5.

# Coverage of black on poster paper at full coverage of the other inks. Chosen below 1, so that the other inks stay
# visible.
_BLACK_GENERATION = 0.9

# The other inks are reduced by this share of black. Chosen small enough that dark patches keep these inks.
_UNDERCOLOUR_REMOVAL = 0.4


def _gauss(centre_nm: float, left_nm: float, right_nm: float | None = None) -> NDArray[np.float64]:
    # Height 1, with different standard deviations on both sides.
    distance = WAVELENGTHS_NM - centre_nm
    width = np.where(distance < 0, left_nm, left_nm if right_nm is None else right_nm)
    return np.exp(-0.5 * (distance / width) ** 2)


def _rise(centre_nm: float, width_nm: float) -> NDArray[np.float64]:
    # From 0 at short to 1 at long wavelengths.
    return 1 / (1 + np.exp(-(WAVELENGTHS_NM - centre_nm) / width_nm))


def projector_primaries(lamp: LampSpectrum = "uhp") -> NDArray[np.float64]:
    """Return the spectra (3, 81) float64 of red, green and blue at full brightness, relative power per nm.

    White is near D65: CIE 1931 x, y within 0.02.
    """
    if lamp == "led":
        power = np.stack([_gauss(633, 8.5, 7.5), _gauss(515, 13, 16), _gauss(451, 9, 10)])
        balance = (1.86, 1.0, 0.775)
    else:
        continuum = 0.55 * _gauss(560, 130) + 0.35 * _gauss(640, 90)
        lines = 0.6 * _gauss(405, 4) + 1.9 * _gauss(437, 5, 8) + 2.1 * _gauss(547, 5, 8) + 1.9 * _gauss(579, 6, 8)
        arc = (continuum + lines) * _rise(412, 4) * (1 - _rise(700, 6))
        # A notch removes the yellow line from green and red, as in real colour wheels, for purer primaries.
        power = arc * np.stack([_rise(600, 3), _rise(505, 4) * (1 - _rise(568, 3)), 1 - _rise(493, 4)])
        balance = (1.29, 1.0, 1.12)
    return power * np.array(balance)[:, None]


@dataclass(frozen=True, eq=False)
class InkedPaper:
    """A paper and its inks."""

    white: NDArray[np.float64]  # (81,) float64, reflectance of bare paper
    # (4, 81) float64, optical density of solid cyan, magenta, yellow and black, without the surface
    inks: NDArray[np.float64]
    surface: float  # Share of the light that the surface reflects to the camera
    black_generation: float  # Coverage of black at full coverage of the other inks
    undercolour_removal: float  # Share of black by which the other inks are reduced

    def overprints(self) -> NDArray[np.float64]:
        """Return the reflectance (16, 81) float64 of the overprints below the surface, in the order of `shares`."""
        densities = np.zeros((1, len(WAVELENGTHS_NM)))
        for density in self.inks:
            densities = np.concatenate([densities, densities + density], axis=0)
        return (self.white - self.surface) / (1 - self.surface) * 10.0**-densities

    def shares(self, coverage: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Demichel's weights (N, 16) float64 of the overprints for nominal coverages (N, 4)."""
        covered = coverage + 4 * DOT_GAIN * coverage * (1 - coverage)
        weights = np.ones((len(covered), 1))
        for ink in covered.T:
            weights = np.concatenate([weights * (1 - ink)[:, None], weights * ink[:, None]], axis=1)
        return weights


def paper_white() -> NDArray[np.float64]:
    """Return the reflectance (81,) float64 of bare paper, slightly blue because of its brightener.

    Measured photo paper rises from 0.64 at 400 nm to 0.93 at 450 nm and falls to 0.85 at 600 nm, like this curve.
    """
    return (0.45 + 0.405 * _rise(402, 9)) + 0.075 * _gauss(452, 22, 50) + 0.03 * _rise(680, 15)


def _poster_inks() -> NDArray[np.float64]:
    # (4, 81), optical density of solid cyan, magenta, yellow and black.
    cyan = 1.40 * _gauss(606, 48, 85) + 0.12 * _gauss(380, 30)
    magenta = 1.17 * _gauss(542, 45, 29) + 0.10 * _gauss(400, 40)
    yellow = 1.27 * (1 - _rise(491, 11))
    black = np.full_like(WAVELENGTHS_NM, 1.9)
    return np.stack([cyan, magenta, yellow, black])


def _photo_inks(black: float) -> NDArray[np.float64]:
    # Fitted by least squares to measured inks and overprints on a glossy and a matt paper.
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
    raise ValueError(f"the paper is {name!r}, expected one of {', '.join(get_args(PaperName))}")


def ink_coverage(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the nominal coverage (..., 4) float64, 0 to 1, of cyan, magenta, yellow and black for ink codes (..., 3).

    Coverage is the complement of the code, with grey component replacement. Black is proportional to the square of the
    smallest of the three inks. All three are reduced by a share of black.
    """
    inked = paper(on)
    cmy = 1 - np.asarray(rgb, dtype=np.float64) / 255
    black = inked.black_generation * cmy.min(axis=-1, keepdims=True) ** 2
    return np.concatenate([cmy - inked.undercolour_removal * black, black], axis=-1)


def print_reflectance(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the reflectance (N, 81) float64 of printed ink codes (N, 3), 0 to 255; (255, 255, 255) is bare paper."""
    inked = paper(on)
    weights = inked.shares(ink_coverage(rgb, on))
    mixed = (weights @ inked.overprints() ** (1 / YULE_NIELSEN_N)) ** YULE_NIELSEN_N
    return inked.surface + (1 - inked.surface) * mixed


@cache
def sensitivities(name: str) -> NDArray[np.float64]:
    """Return the measured sensitivities (81, 3) float64 of a camera, relative; read-only.

    Included sensitivities are relative to the maximum of G.
    """
    curves = read_sensitivities(name).at(WAVELENGTHS_NM)
    curves.setflags(write=False)
    return curves


ProfileName = Literal["unmanaged", "managed"]  # Conversion of codes of the file to ink codes.

NODES = 33  # Nodes per channel of the table, as in ICC output profiles.

_HUE_WEIGHT = 2.0  # Weight of hue differences for colours out of gamut, relative to lightness and chroma.

# Largest CIELAB distance of the black point from neutral; a distance of 1 is visible. A smaller limit gives a paler
# black, because the darkest mix of inks is not neutral.
_MAX_BLACK_TINT = 0.7

# Linear sRGB to CIE XYZ under D50, Bradford adapted; sums of rows are D50.
_SRGB_TO_D50 = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)

_MAX_ITERATIONS = 40  # Iterations of the inversion; inside the gamut, five to ten are enough.


def printed_reflectance(
    rgb: ArrayLike, profile: ProfileName = "unmanaged", on: PaperName = "poster"
) -> NDArray[np.float64]:
    """Return the reflectance (N, 81) float64 of printed sRGB codes (N, 3), 0 to 255, at `WAVELENGTHS_NM`."""
    if profile not in get_args(ProfileName):
        raise ValueError(f"the profile is {profile!r}, expected one of {', '.join(get_args(ProfileName))}")
    return print_reflectance(ink_codes(rgb, on) if profile == "managed" else rgb, on)


def ink_codes(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return the ink codes (N, 3) float64, 0 to 255, of the managed profile of a paper for sRGB codes (N, 3)."""
    table = _profile_table(on)
    nodes = np.clip(np.asarray(rgb, dtype=np.float64), 0, 255) / 255 * (NODES - 1)
    corner = np.minimum(nodes.astype(np.int64), NODES - 2)
    fractions = nodes - corner
    # The four nodes of the tetrahedron: the lower corner of the cell, then one step along each channel. Channels follow
    # in descending order of their fractions.
    order = np.argsort(-fractions, axis=1, kind="stable")
    sorted_share = np.take_along_axis(fractions, order, axis=1)
    weights = -np.diff(np.concatenate([np.ones((len(nodes), 1)), sorted_share, np.zeros((len(nodes), 1))], axis=1))
    node = corner.copy()
    codes = weights[:, :1] * table[node[:, 0], node[:, 1], node[:, 2]]
    for step in range(3):
        channel = order[:, step, None]
        np.put_along_axis(node, channel, np.take_along_axis(node, channel, axis=1) + 1, axis=1)
        codes = codes + weights[:, step + 1, None] * table[node[:, 0], node[:, 1], node[:, 2]]
    return codes


@cache
def _observer() -> _Array:
    # (81, 3), CIE 1931 colour-matching functions times D50.
    wavelengths, functions = observer_cie_1931()
    light = published_spectra()["D50"]
    matching = functions[np.searchsorted(wavelengths, WAVELENGTHS_NM)]
    return matching * light.power[np.searchsorted(light.wavelengths_nm, WAVELENGTHS_NM), None]


def _lab(xyz: _Array) -> _Array:
    # CIELAB (CIE 15:2018, 8.2.1) of XYZ relative to white.
    root = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(root, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def _target_xyz(codes: _Array, black: float) -> _Array:
    # XYZ relative to white for sRGB codes 0 to 1, with black point compensation.
    linear = decode_srgb(codes)
    return black + (1 - black) * (linear @ _SRGB_TO_D50.T) / _SRGB_TO_D50.sum(axis=1)


class _Inks:
    """Colours of ink codes on a paper. With a Yule-Nielsen factor of 2, XYZ is a quadratic form of the weights."""

    def __init__(self, on: PaperName) -> None:
        if YULE_NIELSEN_N != 2:
            raise ValueError(f"the Yule-Nielsen factor is {YULE_NIELSEN_N}; the quadratic form needs 2")
        inked, observer = paper(on), _observer()
        roots = np.sqrt(inked.overprints())
        white = inked.white @ observer
        self._on: PaperName = on
        self._paper = inked
        self._floor = inked.surface * observer.sum(axis=0) / white
        forms = np.einsum("il,lc,jl->cij", roots, observer, roots) * (1 - inked.surface)
        self._forms = forms / white[:, None, None]

    def xyz(self, codes: _Array) -> _Array:
        """Return XYZ (N, 3) relative to paper of ink codes (N, 3), 0 to 1."""
        weights = self._paper.shares(ink_coverage(codes * 255, self._on))
        return self._floor + np.stack([((weights @ form) * weights).sum(axis=1) for form in self._forms], axis=1)

    def codes_of_lab(self, lab: _Array) -> _Array:
        """Return the ink codes (N, 3), 0 to 1, that are nearest to CIELAB (N, 3)."""
        from scipy.spatial import cKDTree

        axis = np.linspace(0, 1, 9)
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        grid_lab = _lab(self.xyz(grid))
        codes = grid[cKDTree(grid_lab).query(lab)[1]]
        chroma = np.hypot(lab[:, 1], lab[:, 2])
        chroma_axis = np.where(chroma[:, None] > 1e-6, lab[:, 1:] / np.maximum(chroma, 1e-6)[:, None], [1.0, 0.0])
        axes = np.zeros((len(lab), 3, 3))
        axes[:, 0, 0] = 1
        axes[:, 1, 1:] = chroma_axis
        axes[:, 2, 1:] = _HUE_WEIGHT * chroma_axis[:, ::-1] * [-1, 1]
        damping = np.full(len(lab), 1e-2)
        differences = self._difference(codes, lab, axes)
        active = np.arange(len(lab))
        for _ in range(_MAX_ITERATIONS):
            active_codes, difference, matrix = codes[active], differences[active], axes[active]
            slope = np.empty((len(active), 3, 3))
            for channel in range(3):
                # The small change for the derivative leads away from the nearer bound, so that codes stay between 0 and
                # 1.
                nudge = np.where(active_codes[:, channel] < 0.5, 1e-5, -1e-5)
                shifted = active_codes.copy()
                shifted[:, channel] += nudge
                slope[:, :, channel] = (self._difference(shifted, lab[active], matrix) - difference) / nudge[:, None]
            downhill = (difference[:, None] @ slope)[:, 0]
            # A code at a bound is fixed if the descent leads outside.
            fixed = ((active_codes <= 0) & (downhill > 0)) | ((active_codes >= 1) & (downhill < 0))
            slope = np.where(fixed[:, None], 0, slope)
            curvature = slope.swapaxes(1, 2) @ slope
            scale = damping[active] * (1 + np.trace(curvature, axis1=1, axis2=2))
            curvature += scale[:, None, None] * np.eye(3)
            gradient = np.where(fixed, 0, downhill)[..., None]
            step: _Array = np.asarray(-np.linalg.solve(curvature, gradient)[..., 0], dtype=np.float64)
            candidates: _Array = np.clip(active_codes + step, 0, 1)
            new_difference = self._difference(candidates, lab[active], matrix)
            gain = (difference**2).sum(axis=1) - (new_difference**2).sum(axis=1)
            is_better = gain > 0
            codes[active[is_better]], differences[active[is_better]] = candidates[is_better], new_difference[is_better]
            damping[active] *= np.where(is_better, 0.2, 8)
            is_done = ((new_difference**2).sum(axis=1) < 1e-6) | (is_better & (gain < 1e-7)) | (damping[active] > 1e6)
            active = active[~is_done]
            if len(active) == 0:
                break
        return codes

    def _difference(self, codes: _Array, lab: _Array, axes: _Array) -> _Array:
        # Differences (N, 3) in lightness, chroma and weighted hue.
        return (axes @ (_lab(self.xyz(codes)) - lab)[..., None])[..., 0]


@cache
def _black_point(on: PaperName) -> float:
    # Luminance of the darkest neutral print, relative to paper.
    inks = _Inks(on)
    darkest = float(inks.xyz(np.zeros((1, 3)))[0, 1])
    candidates = darkest * np.geomspace(1, 2, 41)
    lab = _lab(np.repeat(candidates[:, None], 3, axis=1))
    difference = np.linalg.norm(_lab(inks.xyz(inks.codes_of_lab(lab))) - lab, axis=1)
    return float(candidates[np.argmax(difference < _MAX_BLACK_TINT)])


@cache
def _profile_table(on: PaperName) -> _Array:
    # (33, 33, 33, 3) ink codes 0 to 255 by sRGB codes.
    axis = np.linspace(0, 1, NODES)
    codes = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    ink = _Inks(on).codes_of_lab(_lab(_target_xyz(codes.reshape(-1, 3), _black_point(on))))
    table = 255 * ink.reshape(codes.shape)
    table[-1, -1, -1] = 255
    table.setflags(write=False)
    return table
