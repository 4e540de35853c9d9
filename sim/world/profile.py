"""A printer's profile: which ink codes print an sRGB file so that its greys are grey, and what the print reflects.

``unmanaged`` sends the file's codes to the inks as they are, which is what the publication does: the grey axis then has
the tint that equal codes of the inks give. ``managed`` is what a print shop's ICC profile does: sRGB (IEC 61966-2-1) →
CIE XYZ of D50 (Bradford, as in ICC.1:2022 annex E) → relative colorimetric with black point compensation → ink codes
of the paper. White is bare paper; black is the darkest neutral that the inks reach; in between, luminance over that
of paper is linear between the two, as Adobe's black point compensation has it (ISO 18619). What no ink reaches goes to
the nearest colour that one does, in CIELAB of the CIE 1931 observer under D50 relative to paper, differences of hue
counted twice (chosen: profiles keep hue before chroma).

As in an ICC profile the table has 33 nodes a channel, is found by inverting the model of the print
(`sim.world.spectra`; Levenberg-Marquardt from the nearest node of a coarse grid) and interpolated in tetrahedra, in
which grey codes depend on grey nodes alone (Kasson and others, J. Electronic Imaging 4 (1995) 226).
"""

from __future__ import annotations

from functools import cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from foundation.colorimetry import decode_srgb, observer_cie_1931
from sim.spectral.published import published_spectra
from sim.world.spectra import WAVELENGTHS_NM, YULE_NIELSEN_N, PaperName, ink_coverage, paper, print_reflectance

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
    `sim.world.spectra.WAVELENGTHS_NM`; (255, 255, 255) is bare paper.
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
