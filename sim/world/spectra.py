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
"""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.world.sensitivities import read_sensitivities

WAVELENGTHS_NM: NDArray[np.float64] = np.arange(380.0, 781.0, 5.0)
"""(81,) float64, the wavelengths of every spectrum here."""

LampSpectrum = Literal["uhp", "led"]

SURFACE_REFLECTANCE = 0.03
"""Light that matte paper returns before it meets ink (share of the incident)."""

YULE_NIELSEN_N = 2.0
"""Yule-Nielsen factor; 2 is full optical dot gain."""

DOT_GAIN = 0.14
"""Mechanical dot gain: how much a coverage of one half grows."""

_BLACK_GENERATION = 0.9
"""Coverage of black where all three inks are full; below 1, so that black never hides them wholly (chosen, not
measured)."""
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

    Parameters
    ----------
    lamp
        ``uhp`` (mercury lamp and colour wheel) or ``led``.

    Returns
    -------
    ndarray
        (3, 81) float64, red, green, blue; relative power per nm. White is near D65: CIE 1931 x, y within 0.02.
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


def paper_white() -> NDArray[np.float64]:
    """Return (81,) float64, the reflectance of bare paper: slightly blue by its brightener, absorbing near ultraviolet.

    The measured photo paper rises from 0.64 at 400 nm to 0.93 at 450 nm and falls to 0.85 at 600 nm; so does this one.
    """
    return (0.45 + 0.405 * _rise(402, 9)) + 0.075 * _gauss(452, 22, 50) + 0.03 * _rise(680, 15)


def _ink_densities() -> NDArray[np.float64]:
    """Return (4, 81) float64: optical density of solid cyan, magenta, yellow and black over white."""
    cyan = 1.40 * _gauss(606, 48, 85) + 0.12 * _gauss(380, 30)
    magenta = 1.17 * _gauss(542, 45, 29) + 0.10 * _gauss(400, 40)
    yellow = 1.27 * (1 - _rise(491, 11))
    black = np.full_like(WAVELENGTHS_NM, 1.9)
    return np.stack([cyan, magenta, yellow, black])


def ink_coverage(rgb: ArrayLike) -> NDArray[np.float64]:
    """Return the share of the paper that each ink is set to cover.

    Parameters
    ----------
    rgb
        (..., 3) float or int codes 0 … 255.

    Returns
    -------
    ndarray
        (..., 4) float64 in 0 … 1, cyan, magenta, yellow, black: the complement of the code, with grey component
        replacement: black grows with the square of the least of the three, which lose 0.4 of it.
    """
    cmy = 1 - np.asarray(rgb, dtype=np.float64) / 255
    black = _BLACK_GENERATION * cmy.min(axis=-1, keepdims=True) ** 2
    return np.concatenate([cmy - _UNDERCOLOUR_REMOVAL * black, black], axis=-1)


def print_reflectance(rgb: ArrayLike) -> NDArray[np.float64]:
    """Return the reflectance of printed codes; (255, 255, 255) is bare paper.

    Parameters
    ----------
    rgb
        (N, 3) float or int codes 0 … 255.

    Returns
    -------
    ndarray
        (N, 81) float64, 0 … 1, never below `SURFACE_REFLECTANCE`.
    """
    asked = ink_coverage(rgb)
    covered = asked + 4 * DOT_GAIN * asked * (1 - asked)
    weights = np.ones((len(covered), 1))
    densities = np.zeros((1, len(WAVELENGTHS_NM)))
    for ink, density in zip(covered.T, _ink_densities(), strict=True):
        weights = np.concatenate([weights * (1 - ink)[:, None], weights * ink[:, None]], axis=1)
        densities = np.concatenate([densities, densities + density], axis=0)
    body = (paper_white() - SURFACE_REFLECTANCE) / (1 - SURFACE_REFLECTANCE)
    overprints = body * 10.0**-densities
    mixed = (weights @ overprints ** (1 / YULE_NIELSEN_N)) ** YULE_NIELSEN_N
    return SURFACE_REFLECTANCE + (1 - SURFACE_REFLECTANCE) * mixed


@cache
def sensitivities(name: str) -> NDArray[np.float64]:
    """Return a camera's measured spectral sensitivities.

    Parameters
    ----------
    name
        ``Canon_EOS_600D`` (the sensor generation of the EOS 550D), ``Canon_EOS_200D`` (that of the EOS 6D Mark II),
        another of `sim.world.sensitivities.known_sensitivities`, or the path of a file.

    Returns
    -------
    ndarray
        (81, 3) float64, R, G, B, relative; read-only. Those of `sim.data` are relative to the peak of G.

    Raises
    ------
    InputError, FormatError
        See `sim.world.sensitivities.read_sensitivities`.
    """
    curves = read_sensitivities(name).at(WAVELENGTHS_NM)
    curves.setflags(write=False)
    return curves
