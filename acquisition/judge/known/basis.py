"""The picture as a sum of the pictures of the three primaries: amounts of light, and where a frame is none such sum.

A tile's counts are its counts in the dark, plus the amount of each primary times its counts under that primary alone.
The three amounts are fitted to all tiles at once, robustly, so that a person before a quarter of the chart does not
change them; what they leave is a map of places that another light, or none, falls on. Sessions without frames of the
primaries have white alone: the camera's own three colours then stand for them, coarsely.

T tiles, S strips.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from acquisition.judge.measured.measuring import SEGMENTS, Measured, Noise, strip_blocks
from foundation.robust import huber_weights, sigma_of

_LIT = 0.01
"""Share of the median tile's white that a tile must have to be looked at: a black backdrop has 4 %."""

_SYSTEMATIC = 0.003
"""Relative error of a tile's counts besides noise that the fit reckons with."""

BLACK_DN = 0.3
"""Standard deviation of a frame's black level, counts, each channel for itself: the mean of a masked border is good to
0.1, and what lies under it differs from the picture by some tenths. It matters where white has some hundred counts."""

_FAINT = 0.1
"""Share of the median tile's signal below which deviations are measured against that share: a glint on a dark backdrop
is not a fault of the picture."""

_AT_REST_PX = 0.02
"""Movement, half-size px, that no picture is moved for: the error of its measurement on a dark frame."""

_ROUNDS = 6
"""Reweighted solutions in a row."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a fit of the light leaves at tiles or strips.

    - `relative`: (N,) float64, length of the deviation (R, G, B) over that of the signal expected; NaN where nothing is
      lit.
    - `noise`: (N,) float64, its standard deviation by noise alone.
    - `signed`: (N,) float64, relative deviation of the sum of the channels: negative where it is too dark.
    """

    relative: _Array
    noise: _Array
    signed: _Array


@dataclass(frozen=True, eq=False)
class FrameLight:
    """The light of a frame: amounts (3,) float64 of the primaries, their covariance (3, 3), and what they leave."""

    amounts: _Array
    covariance: _Array
    tiles: Residuals


@dataclass(frozen=True, eq=False)
class Basis:
    """The pictures that a frame is a sum of.

    - `dark`: (T, 3) float64, counts above black where the projector shows black.
    - `maps`: (3, T, 3) float64, what each primary adds, of channel R, G, B.
    - `dark_strips`, `strip_maps`: (S, 3) and (3, S, 3), likewise of the strips; None where they are not known.
    - `of_primaries`: whether the maps are of the projector's primaries; else of the camera's colours under white.
    - `spread`, `strip_spread`: (4, T, 3) and (4, S, 3), variance of the darkness and of each map by noise: in dim light
      as much as the frame's.
    """

    dark: _Array
    maps: _Array
    dark_strips: _Array | None
    strip_maps: _Array | None
    of_primaries: bool
    spread: _Array
    strip_spread: _Array | None = None

    @classmethod
    def of_white(cls, white: Measured, dark: Measured) -> Basis:
        """Return the coarse one: what a camera's colour shows under white stands for the primary of that colour."""
        added = white.tiles - dark.tiles
        of = [np.arange(3) == channel for channel in range(3)]
        maps = np.stack([np.where(channel, added, 0.0) for channel in of])
        own, dark_own = _tile_variance(white), _tile_variance(dark)
        spread = np.stack([dark_own, *(np.where(channel, own + dark_own, 0.0) for channel in of)])
        return cls(dark.tiles, maps, None, None, of_primaries=False, spread=spread)

    @classmethod
    def between(cls, primaries: tuple[Measured, Measured, Measured], dark: Measured) -> Basis:
        """Return that of three frames, each of one primary."""
        maps = np.stack([frame.tiles - dark.tiles for frame in primaries])
        strips = np.stack([frame.strips - dark.strips for frame in primaries])
        spread, strip_spread = (
            np.stack([of(dark), *(of(frame) + of(dark) for frame in primaries)])
            for of in (_tile_variance, _strip_variance)
        )
        return cls(dark.tiles, maps, dark.strips, strips, True, spread, strip_spread)

    def with_dark(self, dark: Measured) -> Basis:
        """Return the same with the darkness of a newer frame."""
        strips = None if self.strip_maps is None else dark.strips
        spread = np.concatenate([_tile_variance(dark)[None], self.spread[1:]])
        return replace(self, dark=dark.tiles, dark_strips=strips, spread=spread)

    def light(self, frame: Measured) -> FrameLight:
        """Return the light of a frame."""
        blocks = frame.places.tile_blocks
        design = self.maps
        white = design.sum(axis=0)
        strength = np.linalg.norm(white, axis=1)
        lit = strength > _LIT * np.median(strength)
        seen = frame.tiles - self.dark
        variance = _mean_variance(frame.tiles, frame.noise, blocks) + (_SYSTEMATIC * np.maximum(seen, 0)) ** 2
        trust, inverse = lit.astype(np.float64), np.eye(3)
        # From the median of what each tile says by itself, which a person before a third of them does not move.
        alone = np.moveaxis(design, 0, -1)[lit] + 1e-9 * strength[lit, None, None] * np.eye(3)
        each = np.asarray(np.linalg.solve(alone, seen[lit][..., None]), dtype=np.float64)[..., 0]
        amounts: _Array = np.median(each, axis=0)
        for _ in range(_ROUNDS):
            off = np.sqrt(((seen - np.einsum("p,ptc->tc", amounts, design)) ** 2 / variance).sum(axis=1))
            trust = lit * huber_weights(off, max(sigma_of(off[lit]), 1e-9)) ** 2
            weights = trust[:, None] / variance
            gram = np.einsum("ptc,tc,qtc->pq", design, weights, design)
            inverse = np.asarray(np.linalg.inv(gram + 1e-12 * np.trace(gram) * np.eye(3)), dtype=np.float64)
            amounts = inverse @ np.einsum("ptc,tc,tc->p", design, weights, seen)
        # What both frames' black levels are off by is in all tiles alike.
        by_black = inverse @ np.einsum("ptc,tc->pc", design, trust[:, None] / variance)
        covariance = inverse + 2 * BLACK_DN**2 * by_black @ by_black.T
        tiles = _residuals(seen, amounts, design, self.dark, frame.noise, blocks, lit, self.spread)
        return FrameLight(amounts, covariance, tiles)

    def strips(self, frame: Measured, amounts: _Array, down_px: float = 0.0, blur_px: float = 0.0) -> Residuals | None:
        """Return what amounts (3,) of light leave at the strips; None where these are not known.

        The pictures are moved down, and blurred, first if that is asked for, half-size px.
        """
        if self.strip_maps is None or self.dark_strips is None:
            return None
        maps = self.strip_maps
        if blur_px > 0 or abs(down_px) > _AT_REST_PX:
            from scipy.ndimage import gaussian_filter1d, shift

            rows = maps.reshape(3, -1, SEGMENTS, 3)
            rows = shift(rows, (0, down_px, 0, 0), order=1, mode="nearest")
            rows = rows if blur_px == 0 else gaussian_filter1d(rows, blur_px, axis=1, mode="nearest")
            maps = np.asarray(rows, dtype=np.float64).reshape(maps.shape)
        strength = np.linalg.norm(maps.sum(axis=0), axis=1)
        blocks = np.full((len(strength), 1), strip_blocks(frame.places))
        lit = strength > _LIT * np.median(strength)
        seen = frame.strips - self.dark_strips
        return _residuals(seen, amounts, maps, self.dark_strips, frame.noise, blocks, lit, self.strip_spread)


def _mean_variance(level: _Array, noise: Noise, blocks: _Array) -> _Array:
    """Return the variance (N, 3) of means over blocks (N, 1) at levels (N, 3); of green there are two a block."""
    return noise.variance(level) / (blocks * np.array([1.0, 2.0, 1.0]))


def _tile_variance(frame: Measured) -> _Array:
    """Return the variance (T, 3) of a frame's tiles by noise."""
    return _mean_variance(frame.tiles, frame.noise, frame.places.tile_blocks)


def _strip_variance(frame: Measured) -> _Array:
    """Return the variance (S, 3) of a frame's strips by noise."""
    return _mean_variance(frame.strips, frame.noise, np.full((len(frame.strips), 1), strip_blocks(frame.places)))


def _residuals(
    seen: _Array,
    amounts: _Array,
    maps: _Array,
    dark: _Array,
    noise: Noise,
    blocks: _Array,
    lit: npt.NDArray[np.bool_],
    spread: _Array | None,
) -> Residuals:
    expected = np.einsum("p,ptc->tc", amounts, maps)
    signal = np.linalg.norm(expected + np.maximum(dark, 0), axis=1)
    usual = float(np.median(signal[lit])) if lit.any() else 0.0
    against = np.maximum(signal, max(_FAINT * usual, 1e-6))
    off = seen - expected
    relative = np.where(lit, np.linalg.norm(off, axis=1) / against, np.nan)
    variance = _mean_variance(expected + np.maximum(dark, 0), noise, blocks).sum(axis=1)
    if spread is not None:
        variance = variance + np.einsum("p,ptc->t", np.array([1.0, *amounts**2]), spread)
    total = (expected + np.maximum(dark, 0)).sum(axis=1)
    usual = float(np.median(total[lit])) if lit.any() else 0.0
    signed = off.sum(axis=1) / np.maximum(total, max(_FAINT * usual, 1e-6))
    return Residuals(relative, np.sqrt(variance) / against, signed)
