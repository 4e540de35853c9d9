"""State of the live judge: light of the frames, model of the projector, and how each frame updates them.

**Light of a frame.** The counts of a tile are its counts in the dark, plus the amount of each projector primary times
the counts under this primary alone (`Basis`). The three amounts are fitted to all tiles at once by a robust method, so
that a person in front of a quarter of the chart does not change them. The residuals show tiles that are lit
differently. A session without frames of the primaries has only white: the three colour channels of the camera then
replace the primaries.

**Model of the projector** (`ProjectorModel`). Each amount is 1 at code `TOP`. Its logarithm is the sum of four terms:
a power law of the code, a smooth deviation (the tone curve), the overlap, and the lamp brightness. The overlap is the
additional light of mixed colours, for example by a colour wheel with white, yellow, cyan or magenta segments
("brilliant colour"). All terms form one linear Gaussian state with a covariance. It is learnt from
response frames and refined by every accepted illuminant. The uncertainty of a prediction is large before the response
frames.

**State of a session** (`JudgeState`) is one frozen value. `updated` is the only step to the next state, for new
frames and for frames of an earlier run. A resumed run therefore has the state of an uninterrupted one.

Sources: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.22 to 2.26 (tone
curves are Gaussian processes on nodes); Kalman filter in Joseph form with a linearised overlap (extended). Overlaps
have the form of `calibration.checks.projector_model`: functions of the least of two and of three codes.

Shapes: T tiles, S strips, K entries of the state.
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

# Codes of the nodes of a tone curve; between them a curve bends by less than 0.001.
_NODES = np.array([4, 8, 16, 24, 32, 44, 56, 72, 88, 104, 120, 136, 152, 168, 184, 200, 216, 232, 255.0])

_POWER = 2.2  # Exponent of the mean tone curve: displays have 1.8 to 2.6

# Prior standard deviations of exponent and bends of a tone curve (log), and correlation length of the bends in log
# code: sRGB, S-shaped curves and any exponent from 1.4 to 3 lie within two standard deviations.
_SLOPE, _BEND, _LENGTH = 0.4, 0.12, 0.7

# Share of this deviation that is different for each primary: the three curves are similar, except for LCDs.
_OWN = 0.15

# Prior standard deviation of a primary's frame at `TOP`, relative: 0.5 % by a colour wheel, in addition to the lamp.
_LEVEL = 0.01

_OVERLAP = 0.25  # Prior standard deviation of overlaps, relative: white segments add up to half

# Share by which the added light may deviate from the assumed form: except for white, it need not follow the least code.
# It widens the limits of mixed illuminants only if light does not add.
_OVERLAP_SHAPE = 0.15

# Standard deviation of the drift of log lamp brightness from frame to frame: 1 % in a thousand frames, with reserve.
LAMP_STEP = 3e-4

RESTED = 0.05  # Standard deviation of log lamp brightness after a pause: the lamp may be cold, aged or replaced.

RESTED_COLOUR = 0.01  # Standard deviation of the log level of each primary after a pause

# Standard deviation of an amount in the dark, share of a full primary: drift of black level and stray light.
_ABSOLUTE = 3e-4

# Prior scatter from frame to frame, relative: of each amount, and of all three together. A colour wheel and a shutter
# with a jitter of 0.5 ms give 0.24 % of R/G at 0.5 s, and 0.47 % at 0.25 s.
_CHROMA, _BRIGHTNESS = 0.004, 0.002

_PRIOR_WEIGHT = 12.0  # Weight of this prior scatter, in number of amounts

# Lower limits of the scatter: tiles and tone curves are not more accurate.
_LEAST_CHROMA, _LEAST_BRIGHTNESS = 0.0006, 0.0006

_ITERATIONS = 6  # Iterations of an update: an overlap of 60 % needs four for 0.1 %

# Overlapping primaries: each pair, and all three.
_SUBSETS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 2), (1, 2), (0, 1, 2))

# Primaries to which each overlap adds light.
_TERMS = [(primary, subset) for primary in range(3) for subset in _SUBSETS if primary in subset]

# Number of nodes. The state holds three curves, three levels, the overlaps, and the lamp brightness, in this order.
_N = len(_NODES)

_CURVES = 3 * _N  # Entries of the state for curves

_OVERLAPS = slice(_CURVES + 3, _CURVES + 3 + len(_TERMS))
_LAMP = _CURVES + 3 + len(_TERMS)  # Last entry of the state: log lamp brightness

_SIZE = _LAMP + 1  # Entries of the state

_Array = npt.NDArray[np.float64]
Codes = tuple[int, int, int]


def _x(codes: npt.ArrayLike) -> _Array:
    # Logarithm of codes relative to `TOP`: the abscissa of the tone curves.
    return np.log(np.maximum(np.asarray(codes, dtype=np.float64), 0.5) / TOP)


def _kernel(a: _Array, b: _Array, slope: float, bend: float) -> _Array:
    distance = (a[:, None] - b[None]) / _LENGTH
    near_full = np.exp(-0.5 * (a / _LENGTH) ** 2)[:, None] * np.exp(-0.5 * (b / _LENGTH) ** 2)[None]
    # Bends are conditioned to be 0 at `TOP`, where an amount is 1 by definition.
    return slope**2 * a[:, None] * b[None] + bend**2 * (np.exp(-0.5 * distance**2) - near_full)


@cache
def _node_prior() -> tuple[_Array, _Array]:
    # (N, N) prior covariance of a curve at the nodes, and its inverse.
    x = _x(_NODES)
    prior = _kernel(x, x, _SLOPE, _BEND) + 1e-8 * np.eye(_N)
    return prior, np.asarray(np.linalg.inv(prior), dtype=np.float64)


@cache
def _table() -> _Array:
    # (256, N) weights of the nodes in the value of a curve at each code.
    _, inverse = _node_prior()
    return _kernel(_x(np.arange(256)), _x(_NODES), _SLOPE, _BEND) @ inverse


@dataclass(frozen=True, eq=False)
class Prediction:
    """Amounts (3,) predicted for codes; their covariance (3, 3) without and with the lamp; all float64."""

    amounts: _Array
    covariance: _Array
    with_lamp: _Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Agreement of amounts with codes.

    - `distance`: distance of the amounts from the prediction in standard deviations, at any lamp brightness
      (Mahalanobis, two degrees of freedom).
    - `angle_deg`: angle between measured and predicted amounts, degrees.
    - `brightness`: log of lamp brightness over the predicted one.
    - `brightness_sd`: its standard deviation.
    """

    distance: float
    angle_deg: float
    brightness: float
    brightness_sd: float

    def angle_limit(self, sigmas: float) -> float:
        """Return the angle, degrees, that corresponds to `sigmas` standard deviations in this direction."""
        return self.angle_deg * sigmas / max(self.distance, 1e-3)


@dataclass(frozen=True, eq=False)
class ProjectorModel:
    """Tone curves, overlaps and lamp of a projector.

    - `state`, `covariance`: (K,) and (K, K) float64: deviations of the curves at the nodes, one primary after another;
      logarithms of the primaries' levels; overlaps; logarithm of lamp brightness.
    - `chroma`, `brightness`: weighted sum of squared deviations and sum of weights, of each amount and of all together.
    """

    state: _Array
    covariance: _Array
    chroma: tuple[float, float] = (_PRIOR_WEIGHT * _CHROMA**2, _PRIOR_WEIGHT)
    brightness: tuple[float, float] = (_PRIOR_WEIGHT * _BRIGHTNESS**2, _PRIOR_WEIGHT)

    @classmethod
    def unknown(cls) -> ProjectorModel:
        """Return the prior model of any projector."""
        prior, _ = _node_prior()
        covariance = np.zeros((_SIZE, _SIZE))
        shared = np.kron(np.full((3, 3), 1 - _OWN**2) + _OWN**2 * np.eye(3), prior)
        covariance[:_CURVES, :_CURVES] = shared
        own = [_LEVEL**2] * 3 + [_OVERLAP**2] * len(_TERMS) + [LAMP_STEP**2]
        covariance[_CURVES:, _CURVES:] = np.diag(own)
        return cls(np.zeros(_SIZE), covariance)

    @property
    def chroma_sd(self) -> float:
        """Scatter of each amount from frame to frame, relative."""
        return max((self.chroma[0] / self.chroma[1]) ** 0.5, _LEAST_CHROMA)

    @property
    def brightness_sd(self) -> float:
        """Scatter of all amounts together from frame to frame, relative."""
        return max((self.brightness[0] / self.brightness[1]) ** 0.5, _LEAST_BRIGHTNESS)

    @property
    def overlap(self) -> float:
        """Relative difference of white from the sum of the primaries, the largest of the three amounts."""
        terms = self.state[_OVERLAPS]
        totals = [sum(terms[k] for k, (p, _) in enumerate(_TERMS) if p == primary) for primary in range(3)]
        return float(max(totals, key=abs))

    def predict(self, codes: Codes) -> Prediction:
        """Return the amounts that codes give now."""
        logs, slopes, extra = self._logs(codes)
        lit = np.array(codes) > 0
        amounts = np.where(lit, np.exp(np.minimum(logs, 5)), 0.0)
        fixed = slopes.copy()
        fixed[:, _LAMP] = 0
        # The variance is bounded: an unknown amount lies between 0 and full.
        scale, own = np.outer(amounts, amounts), np.diag(self.chroma_sd**2 + extra**2)
        without, total = (np.clip(jacobian @ self.covariance @ jacobian.T, -4, 4) + own for jacobian in (fixed, slopes))
        floor = _ABSOLUTE**2 * np.eye(3)
        return Prediction(amounts, without * scale + floor, total * scale + floor)

    def curves(self) -> _Array:
        """Return (3, 256) float64: amount of each primary alone at each code, at the current lamp brightness."""
        curves = self.state[:_CURVES].reshape(3, _N) @ _table().T
        levels = self.state[_CURVES : _CURVES + 3, None] + self.state[_LAMP]
        amounts = np.exp(np.minimum(_POWER * _x(np.arange(256)) + curves + levels, 5))
        amounts[:, 0] = 0
        return np.asarray(amounts, dtype=np.float64)

    def compare(self, amounts: _Array, codes: Codes, added: _Array | None = None) -> Fit:
        """Compare amounts (3,) float64 with the prediction of codes; `added` (3, 3) is their own covariance."""
        expected = self.predict(codes)
        own = np.zeros((3, 3)) if added is None else added
        weight = np.linalg.inv(expected.covariance + own)
        predicted = expected.amounts
        power = max(float(predicted @ weight @ predicted), 1e-12)
        level = float(predicted @ weight @ amounts) / power
        deviation = amounts - level * predicted
        distance = float(np.sqrt(max(deviation @ weight @ deviation, 0)))
        sine = np.linalg.norm(np.cross(amounts, predicted))
        angle = float(np.degrees(np.arctan2(sine, amounts @ predicted))) if predicted.any() else 180.0
        brightness = float(np.log(max(level, 1e-6)))
        share = weight @ predicted / power
        sd = (float(share @ (expected.with_lamp + own) @ share) + self.brightness_sd**2 + LAMP_STEP**2) ** 0.5
        return Fit(distance, angle, brightness, sd)

    def learn(self, amounts: _Array, codes: Codes, added: _Array | None = None) -> ProjectorModel:
        """Return the model updated by a frame of `codes` with measured `amounts` (3,) float64; see `compare`."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += LAMP_STEP**2
        absolute = _ABSOLUTE**2 * np.eye(3) + (0 if added is None else added)
        is_used = (np.array(codes) > 0) & (amounts > 5 * np.sqrt(np.diag(absolute)))
        if not is_used.any():
            return replace(self, covariance=covariance)
        measured_logs, count = np.log(amounts[is_used]), int(is_used.sum())
        iterate, state, first_deviation = self, self.state, np.zeros(count)
        slopes, gain, noise, innovation = (np.zeros((0, 0)) for _ in range(4))
        # The logarithm is not linear in the added light of overlaps: iterated, as in Bell and Cathey, "The iterated
        # Kalman filter update as a Gauss-Newton method", IEEE Trans. Automatic Control 38 (1993) 294.
        for turn in range(_ITERATIONS):
            logs, slopes, extra = iterate._logs(codes)
            slopes, deviation = slopes[is_used], measured_logs - logs[is_used]
            first_deviation = deviation if turn == 0 else first_deviation
            own = np.diag(self.chroma_sd**2 + extra[is_used] ** 2)
            faint = absolute[np.ix_(is_used, is_used)] / np.outer(amounts[is_used], amounts[is_used])
            noise = own + faint + self.brightness_sd**2
            innovation = slopes @ covariance @ slopes.T + noise
            gain = covariance @ slopes.T @ np.asarray(np.linalg.inv(innovation), dtype=np.float64)
            state = self.state + gain @ (deviation - slopes @ (self.state - iterate.state))
            iterate = replace(self, state=state)
        retained = np.eye(_SIZE) - gain @ slopes
        covariance = retained @ covariance @ retained.T + gain @ noise @ gain.T
        chroma, brightness = self._scatter(first_deviation, innovation, count)
        return ProjectorModel(state, (covariance + covariance.T) / 2, chroma, brightness)

    def rested(self) -> ProjectorModel:
        """Return the model after a pause of the run: lamp and primaries may have other levels."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += RESTED**2
        levels = np.arange(_CURVES, _CURVES + 3)
        covariance[levels, levels] += RESTED_COLOUR**2
        return replace(self, covariance=covariance)

    def stepped(self, step: float) -> ProjectorModel:
        """Return the model after a step of log lamp brightness; it increases the scatter of a flickering lamp."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += RESTED**2
        squares, number = self.brightness
        return replace(self, covariance=covariance, brightness=(squares + step**2, number + 1))

    def _scatter(self, logs: _Array, innovation: _Array, count: int) -> tuple[tuple[float, float], tuple[float, float]]:
        mean = float(logs.mean())
        # Uncertainty of the model is no scatter: a frame is weighted by the part of its deviation that is scatter.
        own = self.chroma_sd**2 * (1 - 1 / count) if count > 1 else 0.0
        spread = float(np.mean(np.diag(innovation)) - np.mean(innovation))
        weight = min(1.0, own / max(spread, 1e-12)) * (count - 1)
        chroma = (
            self.chroma[0]
            + weight * min(float(((logs - mean) ** 2).sum()) / max(count - 1, 1), (8 * self.chroma_sd) ** 2),
            self.chroma[1] + weight,
        )
        together = min(1.0, self.brightness_sd**2 / max(float(np.mean(innovation)), 1e-12))
        brightness = (
            self.brightness[0] + together * min(mean**2, (8 * self.brightness_sd) ** 2),
            self.brightness[1] + together,
        )
        return chroma, brightness

    def _logs(self, codes: Codes) -> tuple[_Array, _Array, _Array]:
        """Return log amounts (3,), their derivatives (3, K) by the state, and the error of the assumed form (3,)."""
        curves = self.state[:_CURVES].reshape(3, _N)
        table = _table()
        base = np.array([_POWER * float(_x(code)) + float(table[code] @ curves[p]) for p, code in enumerate(codes)])
        slopes = np.zeros((3, _SIZE))
        shares = np.zeros((3, len(_TERMS)))
        for p, code in enumerate(codes):
            slopes[p, p * _N : (p + 1) * _N] = table[code]
            slopes[p, _CURVES + p] = 1
        for k, (p, subset) in enumerate(_TERMS):
            least_code = min(codes[index] for index in subset)
            if least_code > 0:
                own = _POWER * float(_x(least_code)) + float(table[least_code] @ curves[p]) - base[p]
                shares[p, k] = np.exp(min(own, 0.0))
        terms = self.state[_OVERLAPS]
        total = np.maximum(1 + shares @ terms, 0.2)
        slopes[:, _OVERLAPS] = shares / total[:, None]
        slopes[:, _LAMP] = 1
        extra = _OVERLAP_SHAPE * np.sqrt((4 * (shares * (1 - shares) * terms) ** 2).sum(axis=1)) / total
        levels = self.state[_CURVES : _CURVES + 3]
        return base + levels + np.log(total) + self.state[_LAMP], slopes, extra


_LIT = 0.01  # Least share of the median tile's white for a tile to be used: a black backdrop has 4 %.

_SYSTEMATIC = 0.003  # Relative error of a tile's counts, in addition to noise, in the weights of the fit

# Standard deviation of a frame's black level in each channel, counts. The mean of optical black is accurate to 0.1,
# but the black level of the image differs from it by some tenths. This matters if white has only some hundred counts.
BLACK_DN = 0.3

# Share of the median signal to which deviations of darker tiles are related: a glint on a dark backdrop is harmless.
_FAINT = 0.1

# Movement, half-size px, up to which strips are not shifted: the error of its measurement in a dim frame.
_AT_REST_PX = 0.02

_ROUNDS = 6  # Iterations of the reweighted fit


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a fit of the light, at N tiles or strips.

    - `relative`: (N,) float64, length of the deviation (R, G, B) over the length of the expected signal; NaN if unlit.
    - `noise`: (N,) float64, standard deviation of `relative` by noise.
    - `signed`: (N,) float64, relative deviation of the sum of the channels; negative if too dark.
    """

    relative: _Array
    noise: _Array
    signed: _Array


@dataclass(frozen=True, eq=False)
class FrameLight:
    """Light of a frame: amounts (3,) float64 of the primaries, their covariance (3, 3), and residuals of the tiles."""

    amounts: _Array
    covariance: _Array
    tiles: Residuals


@dataclass(frozen=True, eq=False)
class Basis:
    """Images of the primaries; a frame is their weighted sum.

    - `dark`: (T, 3) float64, counts above black while the projector shows black.
    - `maps`: (3, T, 3) float64, counts of R, G and B added by each primary.
    - `dark_strips`, `strip_maps`: (S, 3) and (3, S, 3), the same of the strips; None if not measured.
    - `of_primaries`: whether the maps show primaries of the projector; if not, the camera's channels under white.
    - `spread`, `strip_spread`: (4, T, 3) and (4, S, 3), variance of dark and of each map by noise. In dim light it is
      as large as the noise of the frame.
    """

    dark: _Array
    maps: _Array
    dark_strips: _Array | None
    strip_maps: _Array | None
    of_primaries: bool
    spread: _Array
    strip_spread: _Array | None = None

    @classmethod
    def from_white(cls, white: Measured, dark: Measured) -> Basis:
        """Return a coarse basis: each camera channel under white replaces the primary of its colour."""
        added = white.tiles - dark.tiles
        is_channel = [np.arange(3) == channel for channel in range(3)]
        maps = np.stack([np.where(channel, added, 0.0) for channel in is_channel])
        own, dark_own = _tile_variance(white), _tile_variance(dark)
        spread = np.stack([dark_own, *(np.where(channel, own + dark_own, 0.0) for channel in is_channel)])
        return cls(dark.tiles, maps, None, None, of_primaries=False, spread=spread)

    @classmethod
    def from_primaries(cls, primaries: tuple[Measured, Measured, Measured], dark: Measured) -> Basis:
        """Return the basis of three frames, each of one primary."""
        maps = np.stack([frame.tiles - dark.tiles for frame in primaries])
        strips = np.stack([frame.strips - dark.strips for frame in primaries])
        spread, strip_spread = (
            np.stack([of(dark), *(of(frame) + of(dark) for frame in primaries)])
            for of in (_tile_variance, _strip_variance)
        )
        return cls(dark.tiles, maps, dark.strips, strips, True, spread, strip_spread)

    def with_dark(self, dark: Measured) -> Basis:
        """Return the basis with a newer dark frame."""
        strips = None if self.strip_maps is None else dark.strips
        spread = np.concatenate([_tile_variance(dark)[None], self.spread[1:]])
        return replace(self, dark=dark.tiles, dark_strips=strips, spread=spread)

    def light(self, frame: Measured) -> FrameLight:
        """Fit the light of a frame."""
        blocks = frame.places.tile_blocks
        design = self.maps
        white = design.sum(axis=0)
        strength = np.linalg.norm(white, axis=1)
        lit = strength > _LIT * np.median(strength)
        signal = frame.tiles - self.dark
        variance = _mean_variance(frame.tiles, frame.noise, blocks) + (_SYSTEMATIC * np.maximum(signal, 0)) ** 2
        trust, inverse = lit.astype(np.float64), np.eye(3)
        # Start with the median of the solutions of single tiles: a person in front of a third of them cannot change it.
        single = np.moveaxis(design, 0, -1)[lit] + 1e-9 * strength[lit, None, None] * np.eye(3)
        solutions = np.asarray(np.linalg.solve(single, signal[lit][..., None]), dtype=np.float64)[..., 0]
        amounts: _Array = np.median(solutions, axis=0)
        for _ in range(_ROUNDS):
            distance = np.sqrt(((signal - np.einsum("p,ptc->tc", amounts, design)) ** 2 / variance).sum(axis=1))
            trust = lit * huber_weights(distance, max(robust_sigma(distance[lit]), 1e-9)) ** 2
            weights = trust[:, None] / variance
            gram = np.einsum("ptc,tc,qtc->pq", design, weights, design)
            inverse = np.asarray(np.linalg.inv(gram + 1e-12 * np.trace(gram) * np.eye(3)), dtype=np.float64)
            amounts = inverse @ np.einsum("ptc,tc,tc->p", design, weights, signal)
        # Errors of both black levels are the same in all tiles.
        by_black = inverse @ np.einsum("ptc,tc->pc", design, trust[:, None] / variance)
        covariance = inverse + 2 * BLACK_DN**2 * by_black @ by_black.T
        tiles = _residuals(signal, amounts, design, self.dark, frame.noise, blocks, lit, self.spread)
        return FrameLight(amounts, covariance, tiles)

    def strips(self, frame: Measured, amounts: _Array, down_px: float = 0.0, blur_px: float = 0.0) -> Residuals | None:
        """Return the residuals of strips at amounts (3,) of light; None if strips were not measured.

        The maps are first moved down and blurred by the given amounts, half-size px.
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
        signal = frame.strips - self.dark_strips
        return _residuals(signal, amounts, maps, self.dark_strips, frame.noise, blocks, lit, self.strip_spread)


def _mean_variance(level: _Array, noise: Noise, blocks: _Array) -> _Array:
    """Return the variance (N, 3) of means of `blocks` (N, 1) at levels (N, 3); a block has two green photosites."""
    return noise.variance(level) / (blocks * np.array([1.0, 2.0, 1.0]))


def _tile_variance(frame: Measured) -> _Array:
    return _mean_variance(frame.tiles, frame.noise, frame.places.tile_blocks)


def _strip_variance(frame: Measured) -> _Array:
    return _mean_variance(frame.strips, frame.noise, np.full((len(frame.strips), 1), strip_blocks(frame.places)))


def _residuals(
    signal: _Array,
    amounts: _Array,
    maps: _Array,
    dark: _Array,
    noise: Noise,
    blocks: _Array,
    lit: npt.NDArray[np.bool_],
    spread: _Array | None,
) -> Residuals:
    expected = np.einsum("p,ptc->tc", amounts, maps)
    expected_norm = np.linalg.norm(expected + np.maximum(dark, 0), axis=1)
    median_signal = float(np.median(expected_norm[lit])) if lit.any() else 0.0
    reference = np.maximum(expected_norm, max(_FAINT * median_signal, 1e-6))
    deviation = signal - expected
    relative = np.where(lit, np.linalg.norm(deviation, axis=1) / reference, np.nan)
    variance = _mean_variance(expected + np.maximum(dark, 0), noise, blocks).sum(axis=1)
    if spread is not None:
        variance = variance + np.einsum("p,ptc->t", np.array([1.0, *amounts**2]), spread)
    total = (expected + np.maximum(dark, 0)).sum(axis=1)
    median_signal = float(np.median(total[lit])) if lit.any() else 0.0
    signed = deviation.sum(axis=1) / np.maximum(total, max(_FAINT * median_signal, 1e-6))
    return Residuals(relative, np.sqrt(variance) / reference, signed)


RECENT = 6  # Frames whose noise is compared with the next: a memory card returns no older ones

LEANING = 3  # Frames whose small deviations are averaged. More frames would take a drift of the lamp for a step.

# Frames of mixed light needed to predict white without its own frame: value, slope and bend of the tone curve, and one
# frame to test them.
_GREYS = 4


@dataclass(frozen=True, eq=False)
class RecentFrame:
    """A frame of this run: its codes, its measurements, and the amounts of light if a basis exists."""

    codes: Codes
    measured: Measured
    amounts: _Array | None


@dataclass(frozen=True)
class Leaning:
    """Small deviations of accepted frames: not significant in one frame, but in two or three together.

    - `lamp`: log of lamp brightness over the predicted one, newest frame first, each with its standard deviation.
    - `added`: neutral light added, share of white, in the same form. Both have at most `LEANING` frames.
    """

    lamp: tuple[tuple[float, float], ...] = ()
    added: tuple[tuple[float, float], ...] = ()

    def extended(self, newer: Leaning) -> Leaning:
        """Return these deviations with newer ones in front."""
        return Leaning((*newer.lamp, *self.lamp)[:LEANING], (*newer.added, *self.added)[:LEANING])


@dataclass(frozen=True)
class LampState:
    """Lamp as measured in a frame.

    - `brightness`: log of brightness over the predicted one; NaN without a prediction.
    - `stepped`: whether the frame is accepted at another level than predicted.
    - `leaning`: small deviations of its light.
    """

    brightness: float = float("nan")
    stepped: bool = False
    leaning: Leaning = field(default_factory=Leaning)


def weighted_mean(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the weighted mean of (value, standard deviation) pairs, and its standard deviation; (0, inf) if empty."""
    weights = [sd**-2 for _, sd in values]
    total = sum(weights)
    if not total:
        return 0.0, float("inf")
    return sum(value * weight for (value, _), weight in zip(values, weights, strict=True)) / total, total**-0.5


@dataclass(frozen=True, eq=False)
class ExaminedFrame:
    """A judged frame: measurements, its light if a basis exists, the verdict, and the check that refused it."""

    frame: Frame
    light: FrameLight | None
    accepted: bool
    cause: str = ""
    lamp: LampState = field(default_factory=LampState)


@dataclass(frozen=True, eq=False)
class JudgeState:
    """State of a session.

    Until an illuminant is accepted, the state depends on the first frames of the session or run. One of them may be
    wrong, and only later frames can show it.

    - `anchor`: position of the chart.
    - `first`: first accepted frame of the session, for camera, size and serial number.
    - `first_white`, `white`, `first_dark`, `dark`: accepted references.
    - `first_grey`: first frame of the brightest grey; its paper is compared with the same grey of a resumed run.
    - `primaries`: frames of the three primaries at `experiment.session.records.TOP`.
    - `basis`, `model`: decomposition of a frame into primaries, and prediction of their amounts from codes.
    - `moved_px`: (2,) rest position of the chart, half-size px from the anchor: (0, 0) until it is moved.
    - `recent`: last frames, the newest last.
    - `digests`: digests of all frames.
    - `unmeasured`: names of checks for which an accepted frame since the last good reference was too dark.
    - `refusals`: cause and number of consecutive refusals.
    - `leaning`: small deviations of the last illuminants.
    - `candidate`: log lamp brightness and position (px) of the chart in the last refused frame; NaN if the refusal had
      another cause.
    - `rested`: whether no lit frame has been accepted since the run was resumed.
    - `moved_on`: whether the chart has moved since the last white frame.
    - `primary_shown`: whether this run has shown a primary alone, with any verdict.
    - `witness`: newest white or grey frame before the primaries, with which their sum is compared.
    - `lost`: whether the measurement of an accepted reference of an earlier run cannot be read.
    - `founding`: whether no illuminant has been accepted since the start, the resumption or the pause of the run.
    - `first_frames`: frames accepted during this time.
    - `contradicted`: numbers of the steps that contradicted these frames once.
    - `restarts`: number of repetitions of these frames for this reason.
    - `first_step`: number of the step of the first of these frames; None before it.
    - `restart_step`: number of the step that a restart takes first; None after it. A frame of another step was already
      exposed when the restart was decided.
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
    recent: tuple[RecentFrame, ...] = ()
    digests: frozenset[bytes] = frozenset()
    unmeasured: frozenset[str] = frozenset()
    refusals: tuple[str, int] = ("", 0)
    leaning: Leaning = field(default_factory=Leaning)
    candidate: tuple[float, float, float] = (float("nan"), float("nan"), float("nan"))
    rested: bool = False
    moved_on: bool = False
    primary_shown: bool = False
    witness: Measured | None = None
    lost: bool = False
    founding: bool = True
    first_frames: tuple[RecentFrame, ...] = ()
    contradicted: frozenset[int] = frozenset()
    restarts: int = 0
    first_step: int | None = None
    restart_step: int | None = None

    @property
    def modelled(self) -> bool:
        """Whether the basis consists of the projector's primaries, so that the model can predict the amounts."""
        return self.basis is not None and self.basis.of_primaries

    @property
    def awaits_primaries(self) -> bool:
        """Whether illuminants cannot be predicted only because frames of this run were refused."""
        return self.primary_shown and not self.modelled and not self.lost

    def paused(self) -> JudgeState:
        """Return the state after a pause of the run: lamp brightness and chart position may have changed."""
        if self.rested or not self.digests:
            return self
        return replace(
            self,
            model=self.model.rested(),
            rested=True,
            recent=(),
            refusals=("", 0),
            primary_shown=False,
            founding=True,
            first_frames=(),
            contradicted=frozenset(),
            first_step=None,
        )

    def restarted(self, base: JudgeState) -> JudgeState:
        """Return the state for a repetition of the first frames: `base`, the state before them, and their digests."""
        return replace(
            base,
            first=base.first or self.first,
            recent=self.recent,
            digests=self.digests,
            refusals=self.refusals,
            restarts=self.restarts + 1,
            restart_step=self.first_step,
        )

    def updated(self, step: SessionStep, examined: ExaminedFrame) -> JudgeState:
        """Return the state after a frame of a step. Only accepted frames change the model."""
        frame, codes = examined.frame, step.colour
        recent = RecentFrame(codes, frame.measured, None if examined.light is None else examined.light.amounts)
        state = replace(
            self,
            recent=(*self.recent, recent)[-RECENT:],
            digests=self.digests | {frame.measured.digest},
            primary_shown=self.primary_shown or (step.kind == "response" and primary_of(codes) is not None),
        )
        if not examined.accepted:
            count = self.refusals[1] + 1 if examined.cause == self.refusals[0] else 1
            lamp = examined.lamp.brightness if examined.cause == OFF_BRIGHTNESS.name else float("nan")
            x, y = frame.moved_px.tolist() if examined.cause == "movement" else (float("nan"), float("nan"))
            contradicted = self.contradicted | {step.number}
            return replace(state, refusals=(examined.cause, count), candidate=(lamp, x, y), contradicted=contradicted)
        state = replace(state, refusals=("", 0), candidate=(float("nan"),) * 3, first=self.first or frame.measured)
        if state.founding:
            first_step = step.number if state.first_step is None else state.first_step
            contradicted, first_frames = state.contradicted - {step.number}, (*state.first_frames, recent)
            state = replace(state, contradicted=contradicted, first_step=first_step, first_frames=first_frames)
        if step.kind == "light" and not state.contradicted:
            state = replace(state, founding=False, first_frames=(), restarts=0)
        if step.kind != "dark":
            # After a step of the lamp, earlier deviations do not count.
            is_new = examined.lamp.stepped or state.rested
            leaning = Leaning() if is_new else state.leaning.extended(examined.lamp.leaning)
            state = replace(state, rested=False, leaning=leaning)
        steady = float(np.hypot(*(frame.moved_px - np.array(self.candidate[1:])))) <= limits.STEADY_PX
        if not np.isnan(frame.moved_px).any() and (self.rested or steady):
            state = replace(state, moved_px=frame.moved_px)
        if frame.anchor is not None:
            state = state._with_anchor(frame.anchor)  # noqa: SLF001 - its own class
        state = state._with_reference(step, frame)  # noqa: SLF001 - its own class
        # `_with_basis` has already learnt from the frame that completes the basis.
        if examined.light is not None and self.modelled and state.modelled and step.kind != "dark":
            model = state.model.stepped(examined.lamp.brightness) if examined.lamp.stepped else state.model
            state = replace(state, model=model.learn(examined.light.amounts, codes, examined.light.covariance))
        return state

    def model_without_white(self) -> ProjectorModel | None:
        """Return the model of the first frames without the white one; None if there are too few."""
        frames = [frame for frame in self.first_frames if any(frame.codes) and min(frame.codes) < 255]
        if self.basis is None or sum(min(frame.codes) > 0 for frame in frames) < _GREYS:
            return None
        model = ProjectorModel.unknown()
        for frame in frames:
            light = self.basis.light(frame.measured)
            model = model.learn(light.amounts, frame.codes, light.covariance)
        return model

    def _with_anchor(self, anchor: Anchor) -> JudgeState:
        # Frames of another chart position cannot form a basis.
        has_moved = self.anchor is not None
        return replace(
            self,
            anchor=anchor,
            moved_px=np.zeros(2),
            moved_on=has_moved,
            basis=None if has_moved else self.basis,
            primaries=(None, None, None) if has_moved else self.primaries,
        )

    def _with_reference(self, step: SessionStep, frame: Frame) -> JudgeState:
        measured = frame.measured
        state = self
        if step.kind in REFERENCES:
            state = replace(state, unmeasured=frozenset())
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
            frames: list[Measured | None] = list(state.primaries)
            frames[primary] = measured
            state = replace(state, primaries=(frames[0], frames[1], frames[2]))
        return state._with_basis(step)  # noqa: SLF001 - its own class

    def _with_basis(self, step: SessionStep) -> JudgeState:
        red, green, blue = self.primaries
        if self.dark is None:
            return self
        if self.basis is None or not self.basis.of_primaries:
            if red is not None and green is not None and blue is not None:
                basis = Basis.from_primaries((red, green, blue), self.dark)
                model = self.model
                for number, frame in enumerate((red, green, blue)):
                    light = basis.light(frame)
                    model = model.learn(light.amounts, PRIMARIES[number], light.covariance)
                if self.white is not None and not self.moved_on:
                    light = basis.light(self.white)
                    model = model.learn(light.amounts, (255, 255, 255), light.covariance)
                return replace(self, basis=basis, model=model)
            if self.white is not None and step.kind in REFERENCES:
                return replace(self, basis=Basis.from_white(self.white, self.dark))
        return self


def is_brightest_grey(step: SessionStep) -> bool:
    """Return whether a step shows grey at `TOP`, with which a resumed run starts."""
    return step.kind == "response" and step.colour == (TOP, TOP, TOP)


def primary_of(codes: Codes) -> int | None:
    """Return the index of the primary that codes show alone at `TOP`; None for other codes."""
    return next((number for number in range(3) if codes == PRIMARIES[number]), None)
