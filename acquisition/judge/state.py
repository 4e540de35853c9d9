"""What the judge knows of a session: the light of its frames, what codes should give, and what a frame adds to it.

**The light of a frame.** A tile's counts are its counts in the dark, plus the amount of each of the projector's
primaries times its counts under that primary alone (`Basis`). The three amounts are fitted to all tiles at once,
robustly, so that a person before a quarter of the chart does not change them; what they leave is a map of places that
another light, or none, falls on. Sessions without frames of the primaries have white alone: the camera's own three
colours then stand for them, coarsely.

**What codes should give.** Each amount is 1 at its code of `TOP` (`ProjectorModel`). Its logarithm is a power law of
its code, plus a smooth deviation (the tone curve), plus what light is added where primaries overlap (a wheel with
white, yellow, cyan or magenta segments, "brilliant colour"), plus the lamp's level. All of it is one linear Gaussian
state, known with a covariance, learnt from response frames and refined by every light that was accepted; a prediction
therefore has an uncertainty, which is large before the response frames, and honest where light does not add.

**What is known of a session** (`JudgeState`) is one frozen value. Rules that hold inside:

- `after` is the only way on, for a frame just judged and for one of an earlier run, so that a run that is taken up
  again knows what an uninterrupted one would.
- Only accepted frames teach. A refused one is kept as the frame before, and as what may be lasting.
- Until a light is accepted, everything that is known rests on the first frames of the session or of the run, and one of
  them may be the odd one: nothing but those that follow says so.

Sources: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.22 to 2.26 (tone
curves are Gaussian processes on nodes); Kalman's filter in Joseph's form with a linearised overlap (extended). Overlap
as in `calibration.checks.projector_model`: functions of the least of two and of three codes.

T tiles, S strips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, shift

from acquisition.judge import limits
from acquisition.judge.measure import Anchor, Frame
from calibration.figures.light import OFF_BRIGHTNESS
from experiment.measures.frame import SEGMENTS, Measured, Noise, strip_blocks
from experiment.session.records import PRIMARIES, REFERENCES, TOP, SessionStep
from foundation.robust import huber_weights, robust_sigma

# Codes at which tone curves are known; between them a curve bends by less than a thousandth.
_NODES = np.array([4, 8, 16, 24, 32, 44, 56, 72, 88, 104, 120, 136, 152, 168, 184, 200, 216, 232, 255.0])

_POWER = 2.2  # Exponent about which tone curves are described: displays have 1.8 to 2.6

# Prior standard deviations of a tone curve's exponent and bends (logarithm), and the bends' length in the logarithm
# of the code: sRGB, S-shaped curves and any exponent from 1.4 to 3 lie within two.
_SLOPE, _BEND, _LENGTH = 0.4, 0.12, 0.7

# How much of that a primary may have for itself: the three curves of a projector are much alike, LCDs least.
_OWN = 0.15

# Prior standard deviation of a primary's frame at `TOP` about its true level: a colour wheel's ½ %, and the lamp's.
_LEVEL = 0.01

_OVERLAP = 0.25  # Prior standard deviation of the light added where primaries overlap: white segments add up to half

# Share of that added light by which it may differ from the form assumed: unlike white it need not follow the least
# code. It widens the limits of mixed lights by as much where light does not add, and by nothing where it does.
_OVERLAP_SHAPE = 0.15

# Standard deviation of the lamp's drift from frame to frame (logarithm): 1 % in a thousand frames, with room.
LAMP_STEP = 3e-4

RESTED = 0.05  # Standard deviation of the lamp's level after a pause of the run: it is cold, older, or another one

RESTED_COLOUR = 0.01  # Standard deviation of each primary's level after such a pause

# Standard deviation of an amount without any light, of a full primary: drift of black and of stray light.
_ABSOLUTE = 3e-4

# Scatter of an amount against the others, and of all together, from frame to frame, before it is known: a colour
# wheel with a shutter's jitter of 0.5 ms gives 0.24 % of R/G at half a second, 0.47 % at a quarter.
_CHROMA, _BRIGHTNESS = 0.004, 0.002

_TRUST = 12.0  # Amounts that this first guess of the scatter weighs as much as

# Scatter that is reckoned with however steady the lights were: tiles and tone curves are not known better.
_LEAST_CHROMA, _LEAST_BRIGHTNESS = 0.0006, 0.0006

_ITERATIONS = 6  # Solutions of an update in a row; an overlap of 60 % needs four to 0.1 %

# Primaries that overlap: each pair, and all three.
_SUBSETS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 2), (1, 2), (0, 1, 2))

# What each overlap adds to each of its primaries.
_TERMS = [(primary, subset) for primary in range(3) for subset in _SUBSETS if primary in subset]

# Nodes of a curve; the state holds three curves, three levels, the overlaps, and the lamp's level, in this order.
_N = len(_NODES)

_CURVES = 3 * _N  # Entries of the state that are curves

_OVERLAPS = slice(_CURVES + 3, _CURVES + 3 + len(_TERMS))
_LAMP = _CURVES + 3 + len(_TERMS)  # Entry of the state that is the lamp's level, the last one

_SIZE = _LAMP + 1  # Entries of the state

_Array = npt.NDArray[np.float64]
Codes = tuple[int, int, int]


def _x(codes: npt.ArrayLike) -> _Array:
    return np.log(np.maximum(np.asarray(codes, dtype=np.float64), 0.5) / TOP)


def _kernel(a: _Array, b: _Array, slope: float, bend: float) -> _Array:
    far = (a[:, None] - b[None]) / _LENGTH
    near_full = np.exp(-0.5 * (a / _LENGTH) ** 2)[:, None] * np.exp(-0.5 * (b / _LENGTH) ** 2)[None]
    # Bends are conditioned on none at `TOP`, where an amount is 1 by definition.
    return slope**2 * a[:, None] * b[None] + bend**2 * (np.exp(-0.5 * far**2) - near_full)


@cache
def _node_weights() -> tuple[_Array, _Array]:
    """Return (N, N) the prior covariance of a curve at the nodes, shared and own, and its inverse."""
    x = _x(_NODES)
    prior = _kernel(x, x, _SLOPE, _BEND) + 1e-8 * np.eye(_N)
    return prior, np.asarray(np.linalg.inv(prior), dtype=np.float64)


@cache
def _table() -> _Array:
    """Return (256, N): weights of the nodes in a curve's value at each code."""
    _, inverse = _node_weights()
    return _kernel(_x(np.arange(256)), _x(_NODES), _SLOPE, _BEND) @ inverse


@dataclass(frozen=True, eq=False)
class Prediction:
    """The amounts (3,) expected of codes, their covariance (3, 3) without the lamp's, and with it, all float64."""

    amounts: _Array
    covariance: _Array
    with_lamp: _Array


@dataclass(frozen=True, eq=False)
class Fit:
    """How well amounts agree with codes.

    - `distance`: of the amounts from the prediction, the lamp's level free, in standard deviations (Mahalanobis, two
      degrees of freedom).
    - `angle_deg`: between the two.
    - `brightness`: level of the lamp over the one expected (logarithm).
    - `brightness_sd`: standard deviation expected of it.
    """

    distance: float
    angle_deg: float
    brightness: float
    brightness_sd: float

    def angle_limit(self, sigmas: float) -> float:
        """Return the angle, degrees, at which this deviation would be as many standard deviations off."""
        return self.angle_deg * sigmas / max(self.distance, 1e-3)


@dataclass(frozen=True, eq=False)
class ProjectorModel:
    """Tone curves, overlaps and lamp of a projector as known so far.

    - `state`, `covariance`: (K,) and (K, K) float64: deviations of the curves at the nodes, one primary after another;
      logarithms of the primaries' levels; overlaps; logarithm of the lamp's level.
    - `chroma`, `brightness`: sum of squares, and number, of the scatter seen of amounts against each other, and of all
      together.
    """

    state: _Array
    covariance: _Array
    chroma: tuple[float, float] = (_TRUST * _CHROMA**2, _TRUST)
    brightness: tuple[float, float] = (_TRUST * _BRIGHTNESS**2, _TRUST)

    @classmethod
    def unknown(cls) -> ProjectorModel:
        """Return what is known of any projector."""
        prior, _ = _node_weights()
        covariance = np.zeros((_SIZE, _SIZE))
        shared = np.kron(np.full((3, 3), 1 - _OWN**2) + _OWN**2 * np.eye(3), prior)
        covariance[:_CURVES, :_CURVES] = shared
        own = [_LEVEL**2] * 3 + [_OVERLAP**2] * len(_TERMS) + [LAMP_STEP**2]
        covariance[_CURVES:, _CURVES:] = np.diag(own)
        return cls(np.zeros(_SIZE), covariance)

    @property
    def chroma_sd(self) -> float:
        """Scatter of an amount against the others from frame to frame, relative."""
        return max((self.chroma[0] / self.chroma[1]) ** 0.5, _LEAST_CHROMA)

    @property
    def brightness_sd(self) -> float:
        """Scatter of all amounts together from frame to frame, relative."""
        return max((self.brightness[0] / self.brightness[1]) ** 0.5, _LEAST_BRIGHTNESS)

    @property
    def overlap(self) -> float:
        """The light by which white differs from the sum of the primaries, the largest of the three, relative."""
        terms = self.state[_OVERLAPS]
        totals = [sum(terms[k] for k, (p, _) in enumerate(_TERMS) if p == primary) for primary in range(3)]
        return float(max(totals, key=abs))

    def predict(self, codes: Codes) -> Prediction:
        """Return the amounts that codes should give now."""
        logs, slopes, extra = self._logs(codes)
        lit = np.array(codes) > 0
        amounts = np.where(lit, np.exp(np.minimum(logs, 5)), 0.0)
        fixed = slopes.copy()
        fixed[:, _LAMP] = 0
        # A frame that is far from anything known could be anything between nothing and full.
        scale, own = np.outer(amounts, amounts), np.diag(self.chroma_sd**2 + extra**2)
        without, total = (np.clip(part @ self.covariance @ part.T, -4, 4) + own for part in (fixed, slopes))
        floor = _ABSOLUTE**2 * np.eye(3)
        return Prediction(amounts, without * scale + floor, total * scale + floor)

    def curves(self) -> _Array:
        """Return (3, 256) float64: the amount of each primary alone at each code, the lamp as it is."""
        curves = self.state[:_CURVES].reshape(3, _N) @ _table().T
        levels = self.state[_CURVES : _CURVES + 3, None] + self.state[_LAMP]
        amounts = np.exp(np.minimum(_POWER * _x(np.arange(256)) + curves + levels, 5))
        amounts[:, 0] = 0
        return np.asarray(amounts, dtype=np.float64)

    def compare(self, amounts: _Array, codes: Codes, added: _Array | None = None) -> Fit:
        """Return how well amounts (3,) float64 agree with codes; `added` (3, 3) is their own covariance."""
        expected = self.predict(codes)
        own = np.zeros((3, 3)) if added is None else added
        weight = np.linalg.inv(expected.covariance + own)
        h = expected.amounts
        power = max(float(h @ weight @ h), 1e-12)
        level = float(h @ weight @ amounts) / power
        off = amounts - level * h
        distance = float(np.sqrt(max(off @ weight @ off, 0)))
        sine = np.linalg.norm(np.cross(amounts, h))
        angle = float(np.degrees(np.arctan2(sine, amounts @ h))) if h.any() else 180.0
        brightness = float(np.log(max(level, 1e-6)))
        share = weight @ h / power
        sd = (float(share @ (expected.with_lamp + own) @ share) + self.brightness_sd**2 + LAMP_STEP**2) ** 0.5
        return Fit(distance, angle, brightness, sd)

    def learn(self, amounts: _Array, codes: Codes, added: _Array | None = None) -> ProjectorModel:
        """Return what is known after a frame of `codes` that showed `amounts` (3,) float64; see `compare`."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += LAMP_STEP**2
        absolute = _ABSOLUTE**2 * np.eye(3) + (0 if added is None else added)
        used = (np.array(codes) > 0) & (amounts > 5 * np.sqrt(np.diag(absolute)))
        if not used.any():
            return replace(self, covariance=covariance)
        seen, count = np.log(amounts[used]), int(used.sum())
        at, state, before = self, self.state, np.zeros(count)
        slopes, gain, noise, innovation = (np.zeros((0, 0)) for _ in range(4))
        # Light that is added where primaries overlap is no linear part of a logarithm: iterated, as in Bell and Cathey,
        # "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans. Automatic Control 38 (1993) 294.
        for turn in range(_ITERATIONS):
            logs, slopes, extra = at._logs(codes)
            slopes, off = slopes[used], seen - logs[used]
            before = off if turn == 0 else before
            own = np.diag(self.chroma_sd**2 + extra[used] ** 2)
            faint = absolute[np.ix_(used, used)] / np.outer(amounts[used], amounts[used])
            noise = own + faint + self.brightness_sd**2
            innovation = slopes @ covariance @ slopes.T + noise
            gain = covariance @ slopes.T @ np.asarray(np.linalg.inv(innovation), dtype=np.float64)
            state = self.state + gain @ (off - slopes @ (self.state - at.state))
            at = replace(self, state=state)
        kept = np.eye(_SIZE) - gain @ slopes
        covariance = kept @ covariance @ kept.T + gain @ noise @ gain.T
        chroma, brightness = self._scatter(before, innovation, count)
        return ProjectorModel(state, (covariance + covariance.T) / 2, chroma, brightness)

    def rested(self) -> ProjectorModel:
        """Return what is known after a pause of the run: lamp and primaries may be at other levels."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += RESTED**2
        levels = np.arange(_CURVES, _CURVES + 3)
        covariance[levels, levels] += RESTED_COLOUR**2
        return replace(self, covariance=covariance)

    def stepped(self, by: float) -> ProjectorModel:
        """Return what is known after the lamp has jumped by a step (logarithm); a lamp that does so often flickers."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += RESTED**2
        squares, number = self.brightness
        return replace(self, covariance=covariance, brightness=(squares + by**2, number + 1))

    def _scatter(self, off: _Array, innovation: _Array, count: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the sums of squares and numbers of scatter after a frame whose logarithms are `off` (count,)."""
        mean = float(off.mean())
        # What the model does not know yet is no scatter: each frame weighs by how much of its deviation that is.
        own = self.chroma_sd**2 * (1 - 1 / count) if count > 1 else 0.0
        spread = float(np.mean(np.diag(innovation)) - np.mean(innovation))
        weight = min(1.0, own / max(spread, 1e-12)) * (count - 1)
        chroma = (
            self.chroma[0]
            + weight * min(float(((off - mean) ** 2).sum()) / max(count - 1, 1), (8 * self.chroma_sd) ** 2),
            self.chroma[1] + weight,
        )
        together = min(1.0, self.brightness_sd**2 / max(float(np.mean(innovation)), 1e-12))
        brightness = (
            self.brightness[0] + together * min(mean**2, (8 * self.brightness_sd) ** 2),
            self.brightness[1] + together,
        )
        return chroma, brightness

    def _logs(self, codes: Codes) -> tuple[_Array, _Array, _Array]:
        """Return the logarithms (3,) of the amounts, their slopes (3, K) by the state, and what the form lacks (3,)."""
        curves = self.state[:_CURVES].reshape(3, _N)
        table = _table()
        base = np.array([_POWER * float(_x(code)) + float(table[code] @ curves[p]) for p, code in enumerate(codes)])
        slopes = np.zeros((3, _SIZE))
        shares = np.zeros((3, len(_TERMS)))
        for p, code in enumerate(codes):
            slopes[p, p * _N : (p + 1) * _N] = table[code]
            slopes[p, _CURVES + p] = 1
        for k, (p, subset) in enumerate(_TERMS):
            least = min(codes[other] for other in subset)
            if least > 0:
                own = _POWER * float(_x(least)) + float(table[least] @ curves[p]) - base[p]
                shares[p, k] = np.exp(min(own, 0.0))
        terms = self.state[_OVERLAPS]
        total = np.maximum(1 + shares @ terms, 0.2)
        slopes[:, _OVERLAPS] = shares / total[:, None]
        slopes[:, _LAMP] = 1
        extra = _OVERLAP_SHAPE * np.sqrt((4 * (shares * (1 - shares) * terms) ** 2).sum(axis=1)) / total
        levels = self.state[_CURVES : _CURVES + 3]
        return base + levels + np.log(total) + self.state[_LAMP], slopes, extra


_LIT = 0.01  # Share of the median tile's white that a tile must have to be looked at: a black backdrop has 4 %

_SYSTEMATIC = 0.003  # Relative error of a tile's counts besides noise that the fit reckons with

# Standard deviation of a frame's black level, counts, each channel for itself: the mean of a masked border is good to
# 0.1, and what lies under it differs from the picture by some tenths. It matters where white has some hundred counts.
BLACK_DN = 0.3

# Share of the median tile's signal below which deviations are measured against that share: a glint on a dark backdrop
# is not a fault of the picture.
_FAINT = 0.1

_AT_REST_PX = 0.02  # Movement, half-size px, that no picture is moved for: the error of its measurement on a dark frame

_ROUNDS = 6  # Reweighted solutions in a row


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
            trust = lit * huber_weights(off, max(robust_sigma(off[lit]), 1e-9)) ** 2
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


RECENT = 6  # Frames whose noise is compared with the next one's: a camera's memory card hands out none older

LEANING = 3  # Frames whose small deviations are taken together; more would take a drift that is followed for a step

# Frames of mixed light from which on white is predicted without its own: the tone curve's value, slope and bend, and
# one that tells whether they agree.
_GREYS = 4


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame that was taken: its codes, what was measured, the amounts of light if they are known."""

    codes: Codes
    measured: Measured
    amounts: _Array | None


@dataclass(frozen=True)
class Leaning:
    """By how much lights were off that were accepted: deviations too small for one frame show in two or three.

    `lamp`, `added`: level of the lamp over the one expected (logarithm), and neutral light added (of white), of the
    newest frame first, each with its standard deviation; at most `LEANING` frames.
    """

    lamp: tuple[tuple[float, float], ...] = ()
    added: tuple[tuple[float, float], ...] = ()

    def then(self, newer: Leaning) -> Leaning:
        """Return both, the newer first."""
        return Leaning((*newer.lamp, *self.lamp)[:LEANING], (*newer.added, *self.added)[:LEANING])


@dataclass(frozen=True)
class LampSeen:
    """What a frame shows of the lamp.

    - `brightness`: its level over the one expected (logarithm); NaN where that is not known.
    - `stepped`: whether the frame is accepted at another level than expected.
    - `leaning`: how its light was off, however little.
    """

    brightness: float = float("nan")
    stepped: bool = False
    leaning: Leaning = field(default_factory=Leaning)


def combined(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the weighted mean of values with standard deviations, and its own; (0, inf) of none."""
    weights = [sd**-2 for _, sd in values]
    total = sum(weights)
    if not total:
        return 0.0, float("inf")
    return sum(value * weight for (value, _), weight in zip(values, weights, strict=True)) / total, total**-0.5


@dataclass(frozen=True, eq=False)
class Examined:
    """What was found of a frame, its light where a basis is known, and the check that refused it, if any did."""

    frame: Frame
    light: FrameLight | None
    accepted: bool
    cause: str = ""
    lamp: LampSeen = field(default_factory=LampSeen)


@dataclass(frozen=True, eq=False)
class JudgeState:
    """All that is known.

    - `anchor`: the chart's place.
    - `first`: the session's first accepted frame: camera, size, serial number.
    - `first_white`, `white`, `first_dark`, `dark`: accepted references.
    - `first_grey`: the first frame of the brightest grey, whose paper that of a run taken up again is held against.
    - `primaries`: frames of the three primaries at `experiment.session.records.TOP`.
    - `basis`, `model`: how a frame is a sum of primaries, and which amounts codes give.
    - `moved_px`: (2,) where the chart lies at rest, from its place in the anchor: (0, 0), or where a bump has left it.
    - `recent`: the last frames, the newest last.
    - `digests`: of all frames.
    - `untold`: names of checks that some accepted frame since the last good reference was too dark for.
    - `refused`: cause, and number, of the refusals in a row.
    - `leaning`: by how much the last lights were off.
    - `candidate`: level of the lamp (logarithm) and place of the chart (px) of the frame refused last; NaN where it was
      not that.
    - `rested`: whether the run was taken up again and no lit frame has been accepted since.
    - `moved_on`: whether the chart lies elsewhere than in the white frame that is known.
    - `asked`: whether this run has shown a primary alone, whatever the frame was like.
    - `witness`: the newest white or grey frame from before the primaries were known, by which they are held against it.
    - `lost`: whether a reference of an earlier run is accepted and its measurement cannot be read.
    - `founding`: whether no light was accepted yet in this session, or since the run was taken up again or paused.
    - `first_frames`: frames that were accepted meanwhile.
    - `doubted`: numbers of the steps whose frames these contradicted once.
    - `restarts`: how often these were taken again for that.
    - `begun_with`: number of the step of the first of them; None before it.
    - `expected`: the step that comes next unless a frame was under way when that was found; None once it is there.
    """

    anchor: Anchor | None = None
    first: Measured | None = None
    first_white: Frame | None = None
    first_grey: Frame | None = None
    white: Measured | None = None
    first_dark: Measured | None = None
    dark: Measured | None = None
    primaries: tuple[Measured | None, Measured | None, Measured | None] = (None, None, None)
    basis: Basis | None = None
    model: ProjectorModel = field(default_factory=ProjectorModel.unknown)
    moved_px: _Array | None = None
    recent: tuple[Seen, ...] = ()
    digests: frozenset[bytes] = frozenset()
    untold: frozenset[str] = frozenset()
    refused: tuple[str, int] = ("", 0)
    leaning: Leaning = field(default_factory=Leaning)
    candidate: tuple[float, float, float] = (float("nan"), float("nan"), float("nan"))
    rested: bool = False
    moved_on: bool = False
    asked: bool = False
    witness: Measured | None = None
    lost: bool = False
    founding: bool = True
    first_frames: tuple[Seen, ...] = ()
    doubted: frozenset[int] = frozenset()
    restarts: int = 0
    begun_with: int | None = None
    expected: int | None = None

    @property
    def modelled(self) -> bool:
        """Whether amounts are those of the projector's primaries, so that codes predict them."""
        return self.basis is not None and self.basis.of_primaries

    @property
    def awaits_primaries(self) -> bool:
        """Whether lights cannot be predicted only because frames that this run asked for were refused."""
        return self.asked and not self.modelled and not self.lost

    def paused(self) -> JudgeState:
        """Return what is known after a pause of the run: the lamp may be at another level, the chart elsewhere."""
        if self.rested or not self.digests:
            return self
        return replace(
            self,
            model=self.model.rested(),
            rested=True,
            recent=(),
            refused=("", 0),
            asked=False,
            founding=True,
            first_frames=(),
            doubted=frozenset(),
            begun_with=None,
        )

    def begun_anew(self, base: JudgeState) -> JudgeState:
        """Return what is known where the first frames cannot be trusted: no more than `base`, before them."""
        return replace(
            base,
            first=base.first or self.first,
            recent=self.recent,
            digests=self.digests,
            refused=self.refused,
            restarts=self.restarts + 1,
            expected=self.begun_with,
        )

    def after(self, step: SessionStep, found: Examined) -> JudgeState:
        """Return what is known after a frame of a step."""
        frame, codes = found.frame, step.colour
        seen = Seen(codes, frame.measured, None if found.light is None else found.light.amounts)
        state = replace(
            self,
            recent=(*self.recent, seen)[-RECENT:],
            digests=self.digests | {frame.measured.digest},
            asked=self.asked or (step.kind == "response" and primary_of(codes) is not None),
        )
        if not found.accepted:
            count = self.refused[1] + 1 if found.cause == self.refused[0] else 1
            lamp = found.lamp.brightness if found.cause == OFF_BRIGHTNESS.name else float("nan")
            x, y = frame.moved_px.tolist() if found.cause == "movement" else (float("nan"), float("nan"))
            doubted = self.doubted | {step.number}
            return replace(state, refused=(found.cause, count), candidate=(lamp, x, y), doubted=doubted)
        state = replace(state, refused=("", 0), candidate=(float("nan"),) * 3, first=self.first or frame.measured)
        if state.founding:
            begun_with = step.number if state.begun_with is None else state.begun_with
            doubted = state.doubted - {step.number}
            state = replace(state, doubted=doubted, begun_with=begun_with, first_frames=(*state.first_frames, seen))
        if step.kind == "light" and not state.doubted:
            state = replace(state, founding=False, first_frames=(), restarts=0)
        if step.kind != "dark":
            # After a step of the lamp nothing before it counts any more.
            leaning = Leaning() if found.lamp.stepped or state.rested else state.leaning.then(found.lamp.leaning)
            state = replace(state, rested=False, leaning=leaning)
        steady = float(np.hypot(*(frame.moved_px - np.array(self.candidate[1:])))) <= limits.STEADY_PX
        if not np.isnan(frame.moved_px).any() and (self.rested or steady):
            state = replace(state, moved_px=frame.moved_px)
        if frame.anchor is not None:
            state = state._anchored(frame.anchor)  # noqa: SLF001 - its own class
        state = state._referenced(step, frame)  # noqa: SLF001 - its own class
        # A frame that makes the basis has been learnt from with it.
        if found.light is not None and self.modelled and state.modelled and step.kind != "dark":
            model = state.model.stepped(found.lamp.brightness) if found.lamp.stepped else state.model
            state = replace(state, model=model.learn(found.light.amounts, codes, found.light.covariance))
        return state

    def without_white(self) -> ProjectorModel | None:
        """Return what the first frames say of the projector without the white one; None where they are too few."""
        others = [one for one in self.first_frames if any(one.codes) and min(one.codes) < 255]
        if self.basis is None or sum(min(one.codes) > 0 for one in others) < _GREYS:
            return None
        model = ProjectorModel.unknown()
        for one in others:
            light = self.basis.light(one.measured)
            model = model.learn(light.amounts, one.codes, light.covariance)
        return model

    def _anchored(self, anchor: Anchor) -> JudgeState:
        """Return what is known where the chart lies elsewhere: pictures of another place are no basis any more."""
        again = self.anchor is not None
        return replace(
            self,
            anchor=anchor,
            moved_px=np.zeros(2),
            moved_on=again,
            basis=None if again else self.basis,
            primaries=(None, None, None) if again else self.primaries,
        )

    def _referenced(self, step: SessionStep, frame: Frame) -> JudgeState:
        measured = frame.measured
        state = self
        if step.kind in REFERENCES:
            state = replace(state, untold=frozenset())
        if step.kind == "white":
            state = replace(state, white=measured, first_white=self.first_white or frame, moved_on=False)
        if step.kind == "dark":
            state = replace(state, dark=measured, first_dark=self.first_dark or measured)
            if state.basis is not None and state.basis.of_primaries:
                state = replace(state, basis=state.basis.with_dark(measured))
        primary = primary_of(step.colour)
        if is_brightest_grey(step):
            state = replace(state, first_grey=self.first_grey or frame)
        if not self.modelled and (step.kind == "white" or (step.kind == "response" and primary is None)):
            state = replace(state, witness=measured)
        if step.kind == "response" and primary is not None and len(measured.strips):
            of: list[Measured | None] = list(state.primaries)
            of[primary] = measured
            state = replace(state, primaries=(of[0], of[1], of[2]))
        return state._based(step)  # noqa: SLF001 - its own class

    def _based(self, step: SessionStep) -> JudgeState:
        red, green, blue = self.primaries
        if self.dark is None:
            return self
        if self.basis is None or not self.basis.of_primaries:
            if red is not None and green is not None and blue is not None:
                basis = Basis.between((red, green, blue), self.dark)
                model = self.model
                for number, frame in enumerate((red, green, blue)):
                    light = basis.light(frame)
                    model = model.learn(light.amounts, PRIMARIES[number], light.covariance)
                if self.white is not None and not self.moved_on:
                    light = basis.light(self.white)
                    model = model.learn(light.amounts, (255, 255, 255), light.covariance)
                return replace(self, basis=basis, model=model)
            if self.white is not None and step.kind in REFERENCES:
                return replace(self, basis=Basis.of_white(self.white, self.dark))
        return self


def is_brightest_grey(step: SessionStep) -> bool:
    """Return whether a step shows grey at `TOP`, with which a run that is taken up again begins."""
    return step.kind == "response" and step.colour == (TOP, TOP, TOP)


def primary_of(codes: Codes) -> int | None:
    """Return which primary codes show alone at `TOP`; None if they show anything else."""
    return next((number for number in range(3) if codes == PRIMARIES[number]), None)
