"""State of the live judge: light of the frames, model of the projector, and how each frame updates them.

**Light of a frame.** A frame is divided into tiles. The counts of a tile are its counts in the dark plus a weighted sum
of its counts under each primary of the projector (`Basis`). The weights are the amounts of the three primaries. They
are fitted to all tiles by a robust method, so a person in front of a quarter of the chart does not change them. Tiles
with large residuals are lit differently from the rest. Without frames of the primaries, the basis consists of the three
camera channels under white.

**Model of the projector** (`ProjectorModel`). The model predicts the amounts from the codes. Each amount is 1 at code
`TOP`, the code of the brightest grey. The logarithm of an amount is the sum of four terms: a power law of the code, a
smooth deviation (tone curve), the overlap, and the lamp brightness. The overlap is additional light of mixed colours,
for example from the white segment of a colour wheel ("brilliant colour"). All terms form one Gaussian state with a
covariance. The response frames determine the state, and every accepted illuminant refines it.

**State of a session** (`JudgeState`). The state is an immutable value, and `updated` returns the next one. Frames of an
earlier run are also passed to `updated`, so a resumed run has the state of an uninterrupted one.

Sources: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.22 to 2.26 (tone
curves are Gaussian processes on nodes); extended Kalman filter in Joseph form. Overlaps are functions of the least of
two and of three codes, as in `calibration.checks.projector_model`.

Shapes: T tiles, S strips (quarters of rows of 2 × 2 blocks), K entries of the state of the projector.
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

# Codes of the nodes of a tone curve. Between two nodes, a curve bends by less than 0.001.
_NODES = np.array([4, 8, 16, 24, 32, 44, 56, 72, 88, 104, 120, 136, 152, 168, 184, 200, 216, 232, 255.0])

_POWER = 2.2  # Exponent of the mean power law; displays have 1.8 to 2.6

# Prior standard deviations of the exponent, and of the bend (deviation of a log amount from the power law). The bend
# has a correlation length in log code. sRGB, S-shaped curves and exponents from 1.4 to 3 are within two deviations.
_EXPONENT_SIGMA, _BEND_SIGMA, _BEND_LENGTH = 0.4, 0.12, 0.7

# Share of these standard deviations that is independent for each primary. The three curves are similar, except for
# LCDs.
_DIFFERENT_SHARE = 0.15

# Prior standard deviation of the level of a primary at `TOP`, relative. A colour wheel contributes 0.5 %.
_LEVEL_SIGMA = 0.01

_OVERLAP_SIGMA = 0.25  # Prior standard deviation of overlaps, relative. A white segment adds at most half of the light.

# Relative error of the assumed form of an overlap, because the added light need not follow the least code.
_OVERLAP_SHAPE = 0.15

# Standard deviation of the change of log lamp brightness from frame to frame; 1 % in a thousand frames.
LAMP_SIGMA = 3e-4

# Standard deviation of log lamp brightness after a pause. The lamp may be cold, aged or replaced.
LAMP_SIGMA_AFTER_PAUSE = 0.05

PRIMARY_SIGMA_AFTER_PAUSE = 0.01  # Standard deviation of the log level of each primary after a pause

# Standard deviation of an amount in the dark, share of a full primary, from drift of black level and stray light.
_DARK_SIGMA = 3e-4

# Prior relative scatter of each amount, and of all three together, from frame to frame. A colour wheel and a shutter
# with a jitter of 0.5 ms change R/G by 0.24 % at 0.5 s.
_PRIOR_CHROMA_SCATTER, _PRIOR_BRIGHTNESS_SCATTER = 0.004, 0.002

_PRIOR_WEIGHT = 12.0  # Weight of this prior scatter: it counts like so many measured amounts

# Lower limits of the scatter, because tiles and tone curves are not more accurate.
_MIN_CHROMA_SCATTER, _MIN_BRIGHTNESS_SCATTER = 0.0006, 0.0006

_ITERATIONS = 6  # Iterations of an update. With an overlap of 60 %, four are accurate to 0.1 %.

# Sets of primaries that overlap: each pair, and all three.
_SUBSETS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 2), (1, 2), (0, 1, 2))

# Entries of the state for overlaps: a primary, and the set of primaries whose overlap adds light to it.
_TERMS = [(primary, subset) for primary in range(3) for subset in _SUBSETS if primary in subset]

# Number of nodes. The state holds three curves, three levels, the overlaps, and the lamp brightness, in this order.
_NODE_COUNT = len(_NODES)

_CURVE_ENTRIES = 3 * _NODE_COUNT  # Entries of the state for curves

_OVERLAPS = slice(_CURVE_ENTRIES + 3, _CURVE_ENTRIES + 3 + len(_TERMS))
_LAMP = _CURVE_ENTRIES + 3 + len(_TERMS)  # Last entry of the state: log lamp brightness

_STATE_SIZE = _LAMP + 1  # Entries of the state

_Array = npt.NDArray[np.float64]
Codes = tuple[int, int, int]


def _log_codes(codes: npt.ArrayLike) -> _Array:
    # Relative to `TOP`; the abscissa of the tone curves.
    return np.log(np.maximum(np.asarray(codes, dtype=np.float64), 0.5) / TOP)


def _kernel(a: _Array, b: _Array, slope: float, bend: float) -> _Array:
    distance = (a[:, None] - b[None]) / _BEND_LENGTH
    near_full = np.exp(-0.5 * (a / _BEND_LENGTH) ** 2)[:, None] * np.exp(-0.5 * (b / _BEND_LENGTH) ** 2)[None]
    # Bends are conditioned to be 0 at `TOP`, where an amount is 1 by definition.
    return slope**2 * a[:, None] * b[None] + bend**2 * (np.exp(-0.5 * distance**2) - near_full)


@cache
def _node_prior() -> tuple[_Array, _Array]:
    # (N, N) prior covariance of a curve at the nodes, and its inverse.
    x = _log_codes(_NODES)
    prior = _kernel(x, x, _EXPONENT_SIGMA, _BEND_SIGMA) + 1e-8 * np.eye(_NODE_COUNT)
    return prior, np.asarray(np.linalg.inv(prior), dtype=np.float64)


@cache
def _curve_weights() -> _Array:
    # (256, N) weights of the nodes in the value of a curve at each code.
    _, inverse = _node_prior()
    return _kernel(_log_codes(np.arange(256)), _log_codes(_NODES), _EXPONENT_SIGMA, _BEND_SIGMA) @ inverse


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted amounts (3,), and their covariance (3, 3) without and with the error of the lamp; all float64."""

    amounts: _Array
    covariance: _Array
    with_lamp: _Array


@dataclass(frozen=True, eq=False)
class Fit:
    """Agreement of measured amounts with the prediction from codes.

    - `distance`: distance of the measured from the predicted colour in standard deviations (Mahalanobis distance, two
      degrees of freedom). It does not depend on lamp brightness.
    - `angle_deg`: angle between measured and predicted amounts, degrees.
    - `brightness`: logarithm of measured over predicted lamp brightness.
    - `brightness_sd`: standard deviation of `brightness`.
    """

    distance: float
    angle_deg: float
    brightness: float
    brightness_sd: float

    def angle_limit(self, sigmas: float) -> float:
        """Return the angle, degrees, of a deviation in the same direction with `sigmas` standard deviations."""
        return self.angle_deg * sigmas / max(self.distance, 1e-3)


@dataclass(frozen=True, eq=False)
class ProjectorModel:
    """Tone curves, overlaps and lamp of a projector.

    - `state`, `covariance`: (K,) and (K, K) float64: tone curves at the nodes, one primary after another; logarithms of
      the levels of the primaries; overlaps; logarithm of lamp brightness.
    - `chroma`, `brightness`: scatter of each amount, and of all three together, as the weighted sum of squared
      deviations and the sum of weights.
    """

    state: _Array
    covariance: _Array
    chroma: tuple[float, float] = (_PRIOR_WEIGHT * _PRIOR_CHROMA_SCATTER**2, _PRIOR_WEIGHT)
    brightness: tuple[float, float] = (_PRIOR_WEIGHT * _PRIOR_BRIGHTNESS_SCATTER**2, _PRIOR_WEIGHT)

    @classmethod
    def unknown(cls) -> ProjectorModel:
        """Return the prior model of any projector."""
        prior, _ = _node_prior()
        covariance = np.zeros((_STATE_SIZE, _STATE_SIZE))
        shared = np.kron(np.full((3, 3), 1 - _DIFFERENT_SHARE**2) + _DIFFERENT_SHARE**2 * np.eye(3), prior)
        covariance[:_CURVE_ENTRIES, :_CURVE_ENTRIES] = shared
        own = [_LEVEL_SIGMA**2] * 3 + [_OVERLAP_SIGMA**2] * len(_TERMS) + [LAMP_SIGMA**2]
        covariance[_CURVE_ENTRIES:, _CURVE_ENTRIES:] = np.diag(own)
        return cls(np.zeros(_STATE_SIZE), covariance)

    @property
    def chroma_sd(self) -> float:
        """Scatter of each amount from frame to frame, relative."""
        return max((self.chroma[0] / self.chroma[1]) ** 0.5, _MIN_CHROMA_SCATTER)

    @property
    def brightness_sd(self) -> float:
        """Scatter of all amounts together from frame to frame, relative."""
        return max((self.brightness[0] / self.brightness[1]) ** 0.5, _MIN_BRIGHTNESS_SCATTER)

    @property
    def overlap(self) -> float:
        """Relative difference of white from the sum of the primaries, for the primary with the largest difference."""
        terms = self.state[_OVERLAPS]
        totals = [sum(terms[k] for k, (p, _) in enumerate(_TERMS) if p == primary) for primary in range(3)]
        return float(max(totals, key=abs))

    def predict(self, codes: Codes) -> Prediction:
        """Predict the amounts of the next frame from its codes."""
        logs, slopes, extra = self._logs(codes)
        lit = np.array(codes) > 0
        amounts = np.where(lit, np.exp(np.minimum(logs, 5)), 0.0)
        fixed = slopes.copy()
        fixed[:, _LAMP] = 0
        # The variance is limited, because an unknown amount is between 0 and 1.
        scale, own = np.outer(amounts, amounts), np.diag(self.chroma_sd**2 + extra**2)
        without, total = (np.clip(jacobian @ self.covariance @ jacobian.T, -4, 4) + own for jacobian in (fixed, slopes))
        floor = _DARK_SIGMA**2 * np.eye(3)
        return Prediction(amounts, without * scale + floor, total * scale + floor)

    def curves(self) -> _Array:
        """Return (3, 256) float64: amount of each primary alone at each code, at the current lamp brightness."""
        curves = self.state[:_CURVE_ENTRIES].reshape(3, _NODE_COUNT) @ _curve_weights().T
        levels = self.state[_CURVE_ENTRIES : _CURVE_ENTRIES + 3, None] + self.state[_LAMP]
        amounts = np.exp(np.minimum(_POWER * _log_codes(np.arange(256)) + curves + levels, 5))
        amounts[:, 0] = 0
        return np.asarray(amounts, dtype=np.float64)

    def compare(self, amounts: _Array, codes: Codes, own_covariance: _Array | None = None) -> Fit:
        """Compare amounts (3,) float64, measured with `own_covariance` (3, 3), with the prediction from codes."""
        expected = self.predict(codes)
        own = np.zeros((3, 3)) if own_covariance is None else own_covariance
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
        sd = (float(share @ (expected.with_lamp + own) @ share) + self.brightness_sd**2 + LAMP_SIGMA**2) ** 0.5
        return Fit(distance, angle, brightness, sd)

    def learn(self, amounts: _Array, codes: Codes, own_covariance: _Array | None = None) -> ProjectorModel:
        """Return the model updated by a frame of `codes` with measured `amounts` (3,) float64; see `compare`."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += LAMP_SIGMA**2
        absolute = _DARK_SIGMA**2 * np.eye(3) + (0 if own_covariance is None else own_covariance)
        is_used = (np.array(codes) > 0) & (amounts > 5 * np.sqrt(np.diag(absolute)))
        if not is_used.any():
            return replace(self, covariance=covariance)
        measured_logs, count = np.log(amounts[is_used]), int(is_used.sum())
        iterate, state, first_deviation = self, self.state, np.zeros(count)
        slopes, gain, noise, innovation = (np.zeros((0, 0)) for _ in range(4))
        # Iterated, because the logarithm is not linear in the light of overlaps (Bell and Cathey, "The iterated Kalman
        # filter update as a Gauss-Newton method", IEEE Trans. Automatic Control 38 (1993) 294).
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
        retained = np.eye(_STATE_SIZE) - gain @ slopes
        covariance = retained @ covariance @ retained.T + gain @ noise @ gain.T
        chroma, brightness = self._scatter(first_deviation, innovation, count)
        return ProjectorModel(state, (covariance + covariance.T) / 2, chroma, brightness)

    def paused(self) -> ProjectorModel:
        """Return the model after a pause of the run, in which lamp and primaries may have changed."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += LAMP_SIGMA_AFTER_PAUSE**2
        levels = np.arange(_CURVE_ENTRIES, _CURVE_ENTRIES + 3)
        covariance[levels, levels] += PRIMARY_SIGMA_AFTER_PAUSE**2
        return replace(self, covariance=covariance)

    def stepped(self, step: float) -> ProjectorModel:
        """Return the model after a step of log lamp brightness, which also counts as scatter of the lamp."""
        covariance = self.covariance.copy()
        covariance[_LAMP, _LAMP] += LAMP_SIGMA_AFTER_PAUSE**2
        squares, number = self.brightness
        return replace(self, covariance=covariance, brightness=(squares + step**2, number + 1))

    def _scatter(self, logs: _Array, innovation: _Array, count: int) -> tuple[tuple[float, float], tuple[float, float]]:
        mean = float(logs.mean())
        # The deviation contains scatter and errors of the model. Its weight is the expected share of scatter.
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
        """Return log amounts (3,), their derivatives (3, K) by the state, and the error of the overlaps (3,)."""
        curves = self.state[:_CURVE_ENTRIES].reshape(3, _NODE_COUNT)
        table = _curve_weights()
        base = np.array(
            [_POWER * float(_log_codes(code)) + float(table[code] @ curves[p]) for p, code in enumerate(codes)]
        )
        slopes = np.zeros((3, _STATE_SIZE))
        shares = np.zeros((3, len(_TERMS)))
        for p, code in enumerate(codes):
            slopes[p, p * _NODE_COUNT : (p + 1) * _NODE_COUNT] = table[code]
            slopes[p, _CURVE_ENTRIES + p] = 1
        for k, (p, subset) in enumerate(_TERMS):
            least_code = min(codes[index] for index in subset)
            if least_code > 0:
                own = _POWER * float(_log_codes(least_code)) + float(table[least_code] @ curves[p]) - base[p]
                shares[p, k] = np.exp(min(own, 0.0))
        terms = self.state[_OVERLAPS]
        total = np.maximum(1 + shares @ terms, 0.2)
        slopes[:, _OVERLAPS] = shares / total[:, None]
        slopes[:, _LAMP] = 1
        extra = _OVERLAP_SHAPE * np.sqrt((4 * (shares * (1 - shares) * terms) ** 2).sum(axis=1)) / total
        levels = self.state[_CURVE_ENTRIES : _CURVE_ENTRIES + 3]
        return base + levels + np.log(total) + self.state[_LAMP], slopes, extra


# Tiles with less white than this share of the median are not used. A black backdrop has 4 %.
_MIN_LIT_SHARE = 0.01

_SYSTEMATIC = 0.003  # Relative error of the counts of a tile, which is added to their noise.

# Standard deviation of the black level of a frame in each channel, counts. The black level of the image differs from
# the mean of optical black by some tenths of a count, which matters in dim frames.
BLACK_DN = 0.3

# Least signal, as a share of the median, by which deviations are divided. A glint on a dark backdrop is harmless.
_MIN_REFERENCE_SHARE = 0.1

# Smaller movements, half-size px, are ignored for strips. This is the error of a measured movement in a dim frame.
_AT_REST_PX = 0.02

_FIT_ITERATIONS = 6  # Iterations of the reweighted fit


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a fit of the light, at N tiles or strips.

    - `relative`: (N,) float64, length of the deviation (R, G, B) relative to the length of the expected signal; NaN if
      unlit.
    - `noise`: (N,) float64, standard deviation of `relative` from noise.
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
    - `dark_strips`, `strip_maps`: (S, 3) and (3, S, 3), the same for strips; None if not measured.
    - `shows_primaries`: whether the maps show primaries of the projector; if not, they show camera channels under
      white.
    - `spread`, `strip_spread`: (4, T, 3) and (4, S, 3), variance of the dark frame and of each map from noise.
    """

    dark: _Array
    maps: _Array
    dark_strips: _Array | None
    strip_maps: _Array | None
    shows_primaries: bool
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
        return cls(dark.tiles, maps, None, None, shows_primaries=False, spread=spread)

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
        lit = strength > _MIN_LIT_SHARE * np.median(strength)
        signal = frame.tiles - self.dark
        variance = _mean_variance(frame.tiles, frame.noise, blocks) + (_SYSTEMATIC * np.maximum(signal, 0)) ** 2
        trust, inverse = lit.astype(np.float64), np.eye(3)
        # The fit starts with the median over single tiles, which a person in front of a third of them does not change.
        single = np.moveaxis(design, 0, -1)[lit] + 1e-9 * strength[lit, None, None] * np.eye(3)
        solutions = np.asarray(np.linalg.solve(single, signal[lit][..., None]), dtype=np.float64)[..., 0]
        amounts: _Array = np.median(solutions, axis=0)
        for _ in range(_FIT_ITERATIONS):
            distance = np.sqrt(((signal - np.einsum("p,ptc->tc", amounts, design)) ** 2 / variance).sum(axis=1))
            trust = lit * huber_weights(distance, max(robust_sigma(distance[lit]), 1e-9)) ** 2
            weights = trust[:, None] / variance
            gram = np.einsum("ptc,tc,qtc->pq", design, weights, design)
            inverse = np.asarray(np.linalg.inv(gram + 1e-12 * np.trace(gram) * np.eye(3)), dtype=np.float64)
            amounts = inverse @ np.einsum("ptc,tc,tc->p", design, weights, signal)
        # The black levels of the frame and of the dark frame have the same error in all tiles.
        by_black = inverse @ np.einsum("ptc,tc->pc", design, trust[:, None] / variance)
        covariance = inverse + 2 * BLACK_DN**2 * by_black @ by_black.T
        tiles = _residuals(signal, amounts, design, self.dark, frame.noise, blocks, lit, self.spread)
        return FrameLight(amounts, covariance, tiles)

    def strips(self, frame: Measured, amounts: _Array, down_px: float = 0.0, blur_px: float = 0.0) -> Residuals | None:
        """Return the residuals of strips for the amounts (3,) of light; None if strips were not measured.

        `down_px`, `blur_px`: movement and blur of the frame, half-size px, which are first applied to the maps.
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
        lit = strength > _MIN_LIT_SHARE * np.median(strength)
        signal = frame.strips - self.dark_strips
        return _residuals(signal, amounts, maps, self.dark_strips, frame.noise, blocks, lit, self.strip_spread)


def _mean_variance(level: _Array, noise: Noise, blocks: _Array) -> _Array:
    """Return the variance (N, 3) of means over `blocks` (N, 1) 2×2 blocks at levels (N, 3); a block has two greens."""
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
    reference = np.maximum(expected_norm, max(_MIN_REFERENCE_SHARE * median_signal, 1e-6))
    deviation = signal - expected
    relative = np.where(lit, np.linalg.norm(deviation, axis=1) / reference, np.nan)
    variance = _mean_variance(expected + np.maximum(dark, 0), noise, blocks).sum(axis=1)
    if spread is not None:
        variance = variance + np.einsum("p,ptc->t", np.array([1.0, *amounts**2]), spread)
    total = (expected + np.maximum(dark, 0)).sum(axis=1)
    median_signal = float(np.median(total[lit])) if lit.any() else 0.0
    signed = deviation.sum(axis=1) / np.maximum(total, max(_MIN_REFERENCE_SHARE * median_signal, 1e-6))
    return Residuals(relative, np.sqrt(variance) / reference, signed)


RECENT_FRAMES = 6  # Number of earlier frames with which a frame is compared, to detect a repeated file.

# Largest number of frames whose small deviations are averaged. Over more frames, the drift of a lamp looks like a step.
AVERAGED_FRAMES = 3

# Number of frames of mixed light that is needed to predict white: three for value, slope and bend of the tone curve,
# and one to test them.
_MIN_MIXED_FRAMES = 4


@dataclass(frozen=True, eq=False)
class RecentFrame:
    """A frame of this run: its codes, its measurements, and its amounts (None without a basis)."""

    codes: Codes
    measured: Measured
    amounts: _Array | None


@dataclass(frozen=True)
class Deviations:
    """Small deviations of accepted frames, which may be significant in two or three frames together.

    Each deviation is a value and its standard deviation. Both lists have the newest frame first, and at most
    `AVERAGED_FRAMES` frames.

    - `lamp`: logarithm of measured over predicted lamp brightness.
    - `added`: added neutral light, share of white.
    """

    lamp: tuple[tuple[float, float], ...] = ()
    added: tuple[tuple[float, float], ...] = ()

    def extended(self, newer: Deviations) -> Deviations:
        """Return these deviations with newer ones in front."""
        return Deviations((*newer.lamp, *self.lamp)[:AVERAGED_FRAMES], (*newer.added, *self.added)[:AVERAGED_FRAMES])


@dataclass(frozen=True)
class LampState:
    """State of the lamp in a frame.

    - `brightness`: logarithm of measured over predicted brightness; NaN without a prediction.
    - `stepped`: whether the frame is accepted although its brightness differs from the prediction.
    - `deviations`: small deviations of the frame.
    """

    brightness: float = float("nan")
    stepped: bool = False
    deviations: Deviations = field(default_factory=Deviations)


def weighted_mean(values: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the weighted mean of (value, standard deviation) pairs, and its standard deviation; (0, inf) if empty."""
    weights = [sd**-2 for _, sd in values]
    total = sum(weights)
    if not total:
        return 0.0, float("inf")
    return sum(value * weight for (value, _), weight in zip(values, weights, strict=True)) / total, total**-0.5


@dataclass(frozen=True, eq=False)
class ExaminedFrame:
    """A judged frame: measurements, light (None without a basis), verdict, and the check that refused the frame."""

    frame: Frame
    light: FrameLight | None
    accepted: bool
    cause: str = ""
    lamp: LampState = field(default_factory=LampState)


@dataclass(frozen=True, eq=False)
class JudgeState:
    """State of a session.

    The judge learns from the first frames of a session or run. Only later frames can show that
    one of them is wrong. Then all first frames are repeated (a restart).

    - `anchor`: position of the chart.
    - `first`: first accepted frame of the session, for camera, size and serial number.
    - `first_white`, `white`, `first_dark`, `dark`: first and newest accepted white and dark frames (references).
    - `first_grey`: first frame of the brightest grey, with which the same grey of a resumed run is compared.
    - `primaries`: frames of the three primaries at `experiment.session.records.TOP`.
    - `basis`, `model`: decomposition of a frame into primaries, and prediction of their amounts from codes.
    - `moved_px`: (2,) rest position of the chart relative to `anchor`, half-size px; None before it is measured.
    - `recent`: last frames, the newest last.
    - `digests`: digests of all frames.
    - `unmeasured`: names of checks that were impossible in an accepted frame since the last good reference, because the
      frame was too dark.
    - `refusals`: cause and number of consecutive refusals.
    - `deviations`: small deviations of the last illuminants.
    - `to_confirm`: log lamp brightness and position (px) of the chart in the last refused frame, which the repeated
      frame may confirm; NaN if the refusal had another cause.
    - `resumed`: whether no lit frame has been accepted since the run was resumed.
    - `has_moved_since_white`: whether the chart has moved since the last white frame.
    - `primary_shown`: whether this run has shown a primary alone, with any verdict.
    - `white_or_grey`: newest white or grey frame before the primaries, with which their sum is compared.
    - `has_lost_reference`: whether the measurement of an accepted reference of an earlier run cannot be read.
    - `is_starting`: whether no illuminant has been accepted since the start, the resumption or the pause of the run.
    - `first_frames`: frames accepted while `is_starting`.
    - `contradicted`: numbers of refused steps; a step is removed if it is accepted while `is_starting`.
    - `restarts`: number of restarts.
    - `first_step`: number of the step of the first accepted frame while `is_starting`; None before.
    - `restart_step`: number of the step with which a restart begins; None after that step. Frames of other steps were
      already exposed when the restart was decided.
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
    deviations: Deviations = field(default_factory=Deviations)
    to_confirm: tuple[float, float, float] = (float("nan"), float("nan"), float("nan"))
    resumed: bool = False
    has_moved_since_white: bool = False
    primary_shown: bool = False
    white_or_grey: Measured | None = None
    has_lost_reference: bool = False
    is_starting: bool = True
    first_frames: tuple[RecentFrame, ...] = ()
    contradicted: frozenset[int] = frozenset()
    restarts: int = 0
    first_step: int | None = None
    restart_step: int | None = None

    @property
    def has_primaries(self) -> bool:
        """Whether the basis consists of primaries of the projector, so that the model can predict amounts."""
        return self.basis is not None and self.basis.shows_primaries

    @property
    def awaits_primaries(self) -> bool:
        """Whether illuminants cannot be predicted because frames of the primaries were refused in this run."""
        return self.primary_shown and not self.has_primaries and not self.has_lost_reference

    def paused(self) -> JudgeState:
        """Return the state after a pause of the run: lamp brightness and chart position may have changed."""
        if self.resumed or not self.digests:
            return self
        return replace(
            self,
            model=self.model.paused(),
            resumed=True,
            recent=(),
            refusals=("", 0),
            primary_shown=False,
            is_starting=True,
            first_frames=(),
            contradicted=frozenset(),
            first_step=None,
        )

    def restarted(self, base: JudgeState) -> JudgeState:
        """Return the state for a repetition of the first frames; `base`: the state before the first frames."""
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
        """Return the state after a judged frame. Only accepted frames change the model."""
        frame, codes = examined.frame, step.colour
        recent = RecentFrame(codes, frame.measured, None if examined.light is None else examined.light.amounts)
        state = replace(
            self,
            recent=(*self.recent, recent)[-RECENT_FRAMES:],
            digests=self.digests | {frame.measured.digest},
            primary_shown=self.primary_shown or (step.kind == "response" and primary_of(codes) is not None),
        )
        if not examined.accepted:
            count = self.refusals[1] + 1 if examined.cause == self.refusals[0] else 1
            lamp = examined.lamp.brightness if examined.cause == OFF_BRIGHTNESS.name else float("nan")
            x, y = frame.moved_px.tolist() if examined.cause == "movement" else (float("nan"), float("nan"))
            contradicted = self.contradicted | {step.number}
            return replace(state, refusals=(examined.cause, count), to_confirm=(lamp, x, y), contradicted=contradicted)
        state = replace(state, refusals=("", 0), to_confirm=(float("nan"),) * 3, first=self.first or frame.measured)
        if state.is_starting:
            first_step = step.number if state.first_step is None else state.first_step
            contradicted, first_frames = state.contradicted - {step.number}, (*state.first_frames, recent)
            state = replace(state, contradicted=contradicted, first_step=first_step, first_frames=first_frames)
        if step.kind == "light" and not state.contradicted:
            state = replace(state, is_starting=False, first_frames=(), restarts=0)
        if step.kind != "dark":
            # After a step of the lamp, earlier deviations do not count.
            is_new = examined.lamp.stepped or state.resumed
            deviations = Deviations() if is_new else state.deviations.extended(examined.lamp.deviations)
            state = replace(state, resumed=False, deviations=deviations)
        steady = float(np.hypot(*(frame.moved_px - np.array(self.to_confirm[1:])))) <= limits.SAME_POSITION_PX
        if not np.isnan(frame.moved_px).any() and (self.resumed or steady):
            state = replace(state, moved_px=frame.moved_px)
        if frame.anchor is not None:
            state = state._with_anchor(frame.anchor)  # noqa: SLF001 - its own class
        state = state._with_reference(step, frame)  # noqa: SLF001 - its own class
        # `_with_basis` has already learnt from the frame that completes the basis.
        if examined.light is not None and self.has_primaries and state.has_primaries and step.kind != "dark":
            model = state.model.stepped(examined.lamp.brightness) if examined.lamp.stepped else state.model
            state = replace(state, model=model.learn(examined.light.amounts, codes, examined.light.covariance))
        return state

    def model_without_white(self) -> ProjectorModel | None:
        """Return a model that is learnt from the first frames except white; None if they are too few."""
        frames = [frame for frame in self.first_frames if any(frame.codes) and min(frame.codes) < 255]
        if self.basis is None or sum(min(frame.codes) > 0 for frame in frames) < _MIN_MIXED_FRAMES:
            return None
        model = ProjectorModel.unknown()
        for frame in frames:
            light = self.basis.light(frame.measured)
            model = model.learn(light.amounts, frame.codes, light.covariance)
        return model

    def _with_anchor(self, anchor: Anchor) -> JudgeState:
        # Frames from before and after a movement of the chart cannot form one basis.
        has_moved = self.anchor is not None
        return replace(
            self,
            anchor=anchor,
            moved_px=np.zeros(2),
            has_moved_since_white=has_moved,
            basis=None if has_moved else self.basis,
            primaries=(None, None, None) if has_moved else self.primaries,
        )

    def _with_reference(self, step: SessionStep, frame: Frame) -> JudgeState:
        measured = frame.measured
        state = self
        if step.kind in REFERENCES:
            state = replace(state, unmeasured=frozenset())
        if step.kind == "white":
            state = replace(state, white=measured, first_white=self.first_white or frame, has_moved_since_white=False)
        if step.kind == "dark":
            state = replace(state, dark=measured, first_dark=self.first_dark or measured)
            if state.basis is not None and state.basis.shows_primaries:
                state = replace(state, basis=state.basis.with_dark(measured))
        primary = primary_of(step.colour)
        if is_brightest_grey(step):
            state = replace(state, first_grey=self.first_grey or frame)
        if not self.has_primaries and (step.kind == "white" or (step.kind == "response" and primary is None)):
            state = replace(state, white_or_grey=measured)
        if step.kind == "response" and primary is not None and len(measured.strips):
            frames: list[Measured | None] = list(state.primaries)
            frames[primary] = measured
            state = replace(state, primaries=(frames[0], frames[1], frames[2]))
        return state._with_basis(step)  # noqa: SLF001 - its own class

    def _with_basis(self, step: SessionStep) -> JudgeState:
        red, green, blue = self.primaries
        if self.dark is None:
            return self
        if self.basis is None or not self.basis.shows_primaries:
            if red is not None and green is not None and blue is not None:
                basis = Basis.from_primaries((red, green, blue), self.dark)
                model = self.model
                for number, frame in enumerate((red, green, blue)):
                    light = basis.light(frame)
                    model = model.learn(light.amounts, PRIMARIES[number], light.covariance)
                if self.white is not None and not self.has_moved_since_white:
                    light = basis.light(self.white)
                    model = model.learn(light.amounts, (255, 255, 255), light.covariance)
                return replace(self, basis=basis, model=model)
            if self.white is not None and step.kind in REFERENCES:
                return replace(self, basis=Basis.from_white(self.white, self.dark))
        return self


def is_brightest_grey(step: SessionStep) -> bool:
    """Return whether a step shows the grey (`TOP`, `TOP`, `TOP`), with which a resumed run starts."""
    return step.kind == "response" and step.colour == (TOP, TOP, TOP)


def primary_of(codes: Codes) -> int | None:
    """Return the index of the primary that codes show alone at `TOP`; None for other codes."""
    return next((number for number in range(3) if codes == PRIMARIES[number]), None)
