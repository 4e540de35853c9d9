"""The simulated lab around the camera: light, lens, print and what is wrong with them, as one frozen value.

**Spectra**, 380 to 780 nm in steps of 5 nm. Parametric models, each with its source; only the camera's sensitivities
are measured data (`sim.data`). All spectra are relative: the exposure's scale is `sim.world.world`'s business. Pure
functions, no state.

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

**Handling.** A stain is a filter on the paper, of one colour, with a soft rim. A fold is a crease that does not lie
flat: the sheet rises towards it on both sides, so that the crease stands off the plane, and either flank is turned a
little towards the light or away from it. Pure functions of places on the print, millimetres from its top-left corner.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.camera import ExposureSettings
from foundation.colorimetry import decode_srgb, observer_cie_1931
from foundation.records import from_settings
from sim.spectral import published_spectra, read_sensitivities

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


ProfileName = Literal["unmanaged", "managed"]
"""What is done to codes before they are inks."""

NODES = 33
"""Nodes a channel of the table, as ICC profiles for output have them."""

_HUE_WEIGHT = 2.0
"""Weight of differences of hue where a colour cannot be printed (chosen)."""

_NEUTRAL = 0.7
"""CIELAB units within which a print counts as neutral when its black point is looked for; the eye sees 1. The smaller,
the paler the black: all inks together are not neutral, and what makes them so is left out."""

_SRGB_TO_D50 = np.array(
    [[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169], [0.0139322, 0.0971045, 0.7141733]]
)
"""Linear sRGB to CIE XYZ under D50, Bradford adapted; its rows' sums are D50."""

_STEPS = 40
"""Iterations of the inversion at most; inside the gamut it ends after five to ten."""

_Array = NDArray[np.float64]


def printed_reflectance(
    rgb: ArrayLike, profile: ProfileName = "unmanaged", on: PaperName = "poster"
) -> NDArray[np.float64]:
    """Return the reflectance of an sRGB file's codes as printed.

    `rgb`: (N, 3) float or int codes 0 … 255 of the file. Returns (N, 81) float64, 0 … 1, at
    `sim.world.room.WAVELENGTHS_NM`; (255, 255, 255) is bare paper.
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


def intended_lab(rgb: ArrayLike, on: PaperName = "poster") -> NDArray[np.float64]:
    """Return (N, 3) float64: CIELAB under D50, relative to paper, that the managed profile wants of codes (N, 3)."""
    return _lab(_wanted(np.asarray(rgb, dtype=np.float64) / 255, _black(on)))


def relative_lab(reflectance: NDArray[np.float64], on: PaperName = "poster") -> NDArray[np.float64]:
    """Return (N, 3) float64: CIELAB of the CIE 1931 observer under D50 of reflectances (N, 81), relative to paper."""
    observer = _observer()
    return _lab(reflectance @ observer / (paper(on).white @ observer))


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
        axis = np.linspace(0, 1, 9)
        grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
        seen = _lab(self.xyz(grid))
        share = np.concatenate(
            [grid[((part[:, None] - seen) ** 2).sum(axis=2).argmin(axis=1)] for part in np.array_split(lab, 32)]
        )
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
    """Return the luminance over paper of the darkest neutral that the inks reach."""
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


REFERENCE_APERTURE: Final = 8.0
"""Also what a lens without contacts is set to by hand in the simulated room."""
REFERENCE_EXPOSURE: Final = ExposureSettings(iso=100, aperture=REFERENCE_APERTURE, shutter_s=0.5)
"""The exposure at which `Room.white_level_share` holds."""


@dataclass(frozen=True)
class Room:
    """Everything about the lab that is not the chart's drawing and not the camera's body.

    - `seed`: of the paper's shape, the photosites' response and the noise; 0 or more.
    - `fill`: the print's extent over the frame's, along whichever axis is the tighter.
    - `focal_diagonals`: focal length over the frame's diagonal; 1.3 is 35 mm on APS-C. With `fill` it gives the
      distance.
    - `tilt_deg`, `pan_deg`, `roll_deg`: how the print is turned against the camera.
    - `k1`, `k2`, `p1`, `p2`: brown's distortion in normalised coordinates, as OpenCV has it.
    - `waviness_mm`: peak-to-valley height of the paper's surface on an A0 sheet; on another in proportion to its
      diagonal, so that small charts look like large ones.
    - `wave_mm`: wavelength of the paper's waves on an A0 sheet, in proportion as above: short ones, as paper gets in
      damp air; 150 is plausible. 0: long ones, up to three over the sheet's longer side.
    - `curl_mm`: how far the sheet's left and right edges stand off its middle, towards the camera, as paper from a roll
      does; on an A0 sheet, in proportion as above. Negative: away from the camera.
    - `blur_px`: standard deviation of the lens's blur, half-size pixels; the photosite's aperture is added to it.
    - `shoulder_share`, `shoulder_px`: share of the light that lies in the wide part of the lens's point spread, and
      that part's standard deviation along each axis, half-size pixels: an exponential (`sim.optics`,
      with the MTF and two lenses).
    - `veil`: veiling glare: share of the frame's mean light, backdrop included, that lies evenly on all of it.
    - `lateral_red_px`, `lateral_blue_px`: lateral chromatic aberration: how far out the channel sees the frame's corner
      against green, half-size pixels; towards the axis it falls off as `sim.optics` says. Negative:
      inwards.
    - `vignetting`: share of the light that the lens loses at the frame's corner.
    - `projector_falloff`: share of the projector's light that is missing a page's half diagonal from its brightest
      point.
    - `primary_difference`: how differently the primaries fall off: their `projector_falloff` spreads by this share of
      itself, and their brightest points by as much of the page's half diagonal.
    - `lamp_spectrum`: ``uhp`` (mercury lamp and colour wheel) or ``led``.
    - `transfer`: from code to light: ``srgb`` (IEC 61966-2-1) or the exponent of a power law.
    - `black_leak`: share of a primary's full light that is there at code 0: 1 / contrast.
    - `ambient`: light from elsewhere, as a share of the projector's white; of its colour, for it is taken to be stray
      light.
    - `white_level_share`: signal of bare paper in full white at `REFERENCE_EXPOSURE`, strongest channel, over
      saturation − black.
    - `lamp_drift_per_hour`: share of its light that the lamp loses in an hour; the room has no time, so whoever does
      applies it as `lamp`.
    - `response_spread`: standard deviation of the photosites' response (PRNU).
    - `wheel_hz`: turns of the projector's colour wheel per second, each a third red, green and blue; 0 for steady
      light. With a wheel, an exposure that is no whole number of turns, or starts and ends unsteadily, gets more of one
      primary than of another, and frames differ from `signal` and `white` by that.
    - `shutter_jitter_s`: standard deviation of the exposure time; matters with a wheel only.
    - `stain_mm`, `stain_depth`: diameter of a stain somewhere on the print, 0 for none, and the share of blue light
      that it takes; of green it takes six tenths of that, of red three. A thumb's is 25 mm across.
    - `fold_mm`: how far a crease across the print stands off its plane, 0 for none.
    - `hot_per_million`: photosites of a million whose dark current is out of proportion, the same in all frames, 0 for
      none. 20 is plausible for an EOS 550D of ten years, 2 for an EOS 6D Mark II of three (chosen: several times what
      `sim.world.sensors.HotPattern` has from the literature, as bodies are not delivered without any). Where a session
      has dark frames, `build-lut` lists the cells in which one stands out by 30 counts and more as unfit, and
      `generate` replaces their colours; a table computed by `sim table` has none, and keeps them in its images.
    - `hot_dn_per_s`: mean excess of such a photosite, DN per second at ISO 100; exponentially distributed. Chosen: at
      half a second the hottest of a hundred is nearly saturated.
    - `profile`: ``unmanaged``: the file's codes are ink codes. ``managed``: a print shop's profile makes ink codes of
      them, so that greys are grey (`sim.world.room`).
    - `paper`: ``poster``, ``matt`` or ``glossy`` (`sim.world.room.paper`).
    """

    seed: int = 0
    fill: float = 0.94
    focal_diagonals: float = 1.3
    tilt_deg: float = 2.0
    pan_deg: float = -3.0
    roll_deg: float = 0.5
    k1: float = -0.03
    k2: float = 0.01
    p1: float = 2e-4
    p2: float = -3e-4
    waviness_mm: float = 3.0
    wave_mm: float = 0.0
    curl_mm: float = 0.0
    blur_px: float = 0.5
    shoulder_share: float = 0.0
    shoulder_px: float = 3.0
    veil: float = 0.0
    lateral_red_px: float = 0.0
    lateral_blue_px: float = 0.0
    vignetting: float = 0.25
    projector_falloff: float = 0.15
    primary_difference: float = 0.1
    lamp_spectrum: LampSpectrum = "uhp"
    transfer: Literal["srgb"] | float = "srgb"
    black_leak: float = 1 / 1500
    ambient: float = 0.0
    white_level_share: float = 0.70
    lamp_drift_per_hour: float = 0.004
    response_spread: float = 0.003
    wheel_hz: float = 0.0
    shutter_jitter_s: float = 0.0005
    stain_mm: float = 0.0
    stain_depth: float = 0.5
    fold_mm: float = 0.0
    hot_per_million: float = 0.0
    hot_dn_per_s: float = 4000.0
    profile: ProfileName = "unmanaged"
    paper: PaperName = "poster"

    def light_of(self, codes: NDArray[np.integer[Any]]) -> NDArray[np.float64]:
        """Return the light of primaries, any shape, 0 … 1 of the full, that codes 0 … 255 of any integer dtype give."""
        share = codes / 255
        return decode_srgb(share) if self.transfer == "srgb" else share**self.transfer

    def wheel_light(self, shutter_s: float, random: np.random.Generator) -> NDArray[np.float64]:
        """Return (3,) float64, the light of each primary that the wheel lets through over that of steady light.

        `shutter_s`: exposure time, seconds.
        """
        if self.wheel_hz == 0:
            return np.ones(3)
        start = random.uniform()
        time = max(shutter_s + self.shutter_jitter_s * random.standard_normal(), 0)
        turns = np.array([start, start + time * self.wheel_hz])[:, None]
        segment = np.arange(3) / 3
        shone = np.floor(turns) / 3 + np.clip(turns - np.floor(turns) - segment, 0, 1 / 3)
        return 3 * (shone[1] - shone[0]) / (shutter_s * self.wheel_hz)

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; 0 or more is expected")
        for name in ("fill", "focal_diagonals", "white_level_share", "shoulder_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; more than 0 is expected")
        for name in (
            "vignetting", "projector_falloff", "black_leak", "ambient", "stain_depth", "shoulder_share", "veil",
        ):  # fmt: skip
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 … below 1 is expected")
        for name in (
            "waviness_mm", "wave_mm", "blur_px", "response_spread", "primary_difference", "wheel_hz",
            "shutter_jitter_s", "stain_mm", "fold_mm", "hot_per_million", "hot_dn_per_s",
        ):  # fmt: skip
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; 0 or more is expected")


def read_room(seed: int, changes: Mapping[str, Any], where: str, key: str) -> Room:
    """Return the default room with a seed and the changes of a settings file or a command line."""
    known = [field.name for field in fields(Room) if field.name != "seed"]
    return from_settings(Room, changes, where, key, known, seed=seed)


_SLANT: Final = 0.36
"""Tangent of 20°: a projector beside the camera."""

RIM_MM = 1.0
"""Over which a stain's edge fades."""

ROUND_MM = 4.0
"""Paper bends; a crease is no sharper than this."""

FLANK_MM = 40.0
"""From the crease to where the sheet lies flat again, to 1 / e."""


@dataclass(frozen=True)
class Stain:
    """A round stain.

    - `centre_mm`: its middle on the print.
    - `transmittance`: share of red, green and blue light that comes back through it, over that of clean paper.
    """

    centre_mm: tuple[float, float]
    diameter_mm: float
    transmittance: tuple[float, float, float]

    def passed(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share (..., 3) of red, green and blue light that comes back from points (..., 2)."""
        away = np.linalg.norm(points_mm - np.array(self.centre_mm), axis=-1) - self.diameter_mm / 2
        cover = 1 / (1 + np.exp(np.clip(4 * away / RIM_MM, -40, 40)))
        return 1 - cover[..., None] * (1 - np.array(self.transmittance))


@dataclass(frozen=True)
class Fold:
    """A crease across the sheet, from its upper to its lower edge.

    - `at_mm`: A point of the crease.
    - `along`: its direction, a unit vector.
    - `height_mm`: how far the crease stands off the plane, towards the camera.
    - `slant`: change of the light with a flank's slope: the tangent of the angle under which the light falls in.
    """

    at_mm: tuple[float, float]
    along: tuple[float, float]
    height_mm: float
    slant: float

    def _away(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (...) of points from the crease, positive on its right."""
        x, y = np.moveaxis(points_mm - np.array(self.at_mm), -1, 0)
        return x * self.along[1] - y * self.along[0]

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm of points (..., 2)."""
        rounded = np.hypot(self._away(points_mm), ROUND_MM) - ROUND_MM
        return self.height_mm * np.exp(-rounded / FLANK_MM)

    def shade(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light (...) on points (..., 2) over that on a flat sheet."""
        away = self._away(points_mm)
        slope = -self.height(points_mm) * away / np.hypot(away, ROUND_MM) / FLANK_MM
        return 1 + self.slant * slope


def worn(room: Room, page_mm: tuple[float, float], random: np.random.Generator) -> tuple[Stain | None, Fold | None]:
    """Return a room's stain and fold, somewhere on a sheet of a size, clear of its edges; None where it has none."""
    page = np.array(page_mm)
    x, y = (page * random.uniform(0.25, 0.75, 2)).tolist()
    taken = room.stain_depth * np.array([0.3, 0.6, 1.0])
    red, green, blue = (1 - taken).tolist()
    stain = Stain((x, y), room.stain_mm, (red, green, blue)) if room.stain_mm else None
    along = math.radians(random.uniform(-6, 6))
    crease = float(page[0] * random.uniform(0.3, 0.7)), float(page[1] / 2)
    direction = math.sin(along), math.cos(along)
    return stain, Fold(crease, direction, room.fold_mm, _SLANT) if room.fold_mm else None
