"""Light, ink and colour filters of the simulated room, as spectra from 380 to 780 nm in steps of 5 nm.

Parametric models, each with its source; only the camera's sensitivities are measured data (`sim.data`). All spectra
are relative: the exposure's scale is `sim.world.world`'s business. Pure functions, no state.

Projector. ``uhp``: a short-arc mercury lamp of about 200 bar behind the dichroic red, green and blue segments of a
colour wheel: a continuum, and the lines 405, 436, 546 and 577/579 nm broadened by pressure (Derra et al., "UHP lamp
systems for projection applications", J. Phys. D 38 (2005) 2995, figure 4). ``led``: three light-emitting diodes, each
an asymmetric Gaussian; peaks 633, 515 and 451 nm and full widths of 19, 34 and 22 nm, as three primaries of a measured
LED projector have them (peaks 632, 516, 452 nm; widths at half maximum 19, 34, 21 nm).

Print. Yule-Nielsen spectral Neugebauer model (Yule and Nielsen 1951; Viggiano 1985): the sixteen
overprints of cyan, magenta, yellow and black mixed by Demichel's weights in the power 1/n. A solid ink is a density
band; peak wavelengths, widths and the secondary absorption follow measured ramps on photo paper (yellow: density 1.25
below 480 nm, half at 490; magenta 1.17 at 540, 0.2 at 450; cyan 1.0 at three quarters at 600 nm, half of it left at
700), which our solids match within about 0.1 in density. The surface's own reflection (matte paper) is added after.
What a printer's profile makes of codes: `sim.world.profile`.

Papers. ``poster`` is what stands above. ``matt`` and ``glossy`` follow prints that an Epson XP-960 made without colour
management, measured with a ColorMunki (olemagnp/print_profiles on GitHub, Argyll .ti3 files with spectra; none is
copied): solid inks and their overprints, 400 to 730 nm, on PermaJet Matt Plus 240 and Ilford Galerie Smooth Pearl,
which one set of inks over two surfaces matches within 2.5 CIEDE2000 on average. Over that collection, and an Epson
P800's glossy print (metebalci/profiling-an-epson-p800-printer), the density of black is 1.63 to 1.79 on four matt photo
papers, 2.11 to 2.51 on ten from satin to glossy, 1.46 on an art and 1.28 on an office paper; the convex hulls of
printed colours in CIELAB under D50 have 460 000 to 540 000, 580 000 to 790 000, 402 000 and 245 000 units. A review of
many more papers has 1.6 to 1.7 and 2.0 to 2.2 (M. McNamee, "The whole range", swpp.co.uk, 2010). Ours have hulls of
466 000 and 596 000: four inks, where such printers have six and more. Black is even over wavelength, as pigment blacks
measure (P800, Canon Pro-300); the XP-960's dye black lets red beyond 680 nm through, which is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.spectral.sensitivities import read_sensitivities

WAVELENGTHS_NM: NDArray[np.float64] = np.arange(380.0, 781.0, 5.0)
"""(81,) float64, the wavelengths of every spectrum here."""

LampSpectrum = Literal["uhp", "led"]

PaperName = Literal["poster", "matt", "glossy"]
"""Papers of the simulated print."""

SURFACE_REFLECTANCE = 0.03
"""Light that plain matte paper returns before it meets ink (share of the incident)."""

MATT_SURFACE = 0.0165
"""The same of coated matt photo paper: the measured matt black is 0.016 to 0.026 from 400 to 660 nm."""

GLOSSY_SURFACE = 0.0035
"""The same of glossy paper, lit off the mirror's angle: the measured glossy black falls to 0.0038."""

MATT_BLACK = 1.8
"""Density of solid matt black below the surface, so that the density of black is that of the measured paper."""

GLOSSY_BLACK = 2.0
"""Density of solid photo black below the surface, for the same reason."""

YULE_NIELSEN_N = 2.0
"""Yule-Nielsen factor; 2 is full optical dot gain."""

DOT_GAIN = 0.14
"""Mechanical dot gain: how much a coverage of one half grows."""

_BLACK_GENERATION = 0.9
"""Coverage of black on poster paper where all three inks are full; below 1, so that black never hides them wholly
(chosen, not measured)."""
_UNDERCOLOUR_REMOVAL = 0.4
"""Share of the black by which each of the three inks is reduced; partial, so that dark cells keep their inks
(chosen)."""


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
