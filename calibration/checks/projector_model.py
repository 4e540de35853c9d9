"""What the whites of a session say of its projector, and what the other lights predict of each.

White under a light is the sum of what three primaries give, each as strong as a tone curve makes it of its code, and
what is added where two or three overlap (wheels with white, yellow, cyan or magenta segments):

    white(codes) = Σ_p P_p [f_p(code_p) + Σ_S u_Sp(m_S) f_p(m_S) + k_p],   m_S the least code of the primaries in S

with P_p the primary in camera RGB, f_p its tone curve, u_Sp the light added where the primaries S overlap, and k_p a
rest of light at code 0 after the dark frames' is taken off. Nothing of this is known; but all of it is known roughly:
a camera's red channel sees mostly the red primary, and a curve is about a power of 2.2. These priors take the place of
a number of lights from which on something could be said: with two lights they decide, with seven hundred they hardly
count, and each prediction comes with the uncertainty that is left.

The posterior is Gaussian about its mode, found by Gauss and Newton's method (Laplace's approximation). Lights that do
not fit count less, by the weights of Student's t with `_FREEDOM` degrees of freedom on the distance from what the other
lights predict; the noise begins large and is let down to its own (graduated non-convexity), so that a few misnamed
lights do not draw the start to themselves.

Sources: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.22 to 2.26, 5.12
(leaving out); K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t distribution",
JASA 84 (1989) 881; A. Blake, A. Zisserman, "Visual Reconstruction", 1987 (graduated non-convexity).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]

# Share of white's count in channel R, G, B (rows) that each primary has: middles of five cameras' measured
# sensitivities under a mercury lamp and LEDs.
_SEEN = np.array([[0.70, 0.28, 0.015], [0.055, 0.83, 0.11], [0.013, 0.25, 0.70]])

# Prior standard deviations of their logarithms: half as much again as those cameras and lamps differ by.
_SEEN_SD = np.array([[0.25, 0.45, 0.9], [0.6, 0.2, 0.6], [1.0, 0.7, 0.25]])

_CHANNELS = np.array([0.45, 1.0, 0.70])  # White's counts in the channels over green's, of those cameras and lamps

# Prior standard deviations (logarithm) of a channel's level, a primary's, and that of all: projectors of 5000 to 11
# 000 K, and any exposure.
_CHANNEL_SD, _PRIMARY_SD, _SCALE_SD = 0.35, 0.3, 2.0

# Codes at which tone curves are known; between them a curve bends by less than a thousandth.
_NODES = np.array([4, 8, 16, 24, 32, 44, 56, 72, 88, 104, 120, 136, 152, 168, 184, 200, 216, 232, 255.0])

_POWER = 2.2  # Exponent about which tone curves are described: displays have 1.8 to 2.6

# Prior standard deviations of a tone curve's exponent and bends (logarithm), and the bends' length in the logarithm
# of the code: sRGB, S-shaped curves and any exponent from 1.5 to 2.9 lie within two.
_SLOPE, _BEND, _LENGTH = 0.4, 0.2, 0.4

_OWN = 0.2  # How much of that a primary has for itself: the three curves of a projector are much alike, LCDs least

# Codes between which the light added where primaries overlap is interpolated.
_OVERLAP_NODES = np.array([0.0, 64.0, 128.0, 192.0, 255.0])

# Prior standard deviations of the light added where primaries overlap, over the primary's own: of the whole, and of
# its course with the code, and the length in codes of that. White segments add up to half.
_OVERLAP, _OVERLAP_BEND, _OVERLAP_LENGTH = 0.2, 0.15, 120.0

# Primaries that overlap: each pair, and all three.
_SUBSETS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 2), (1, 2), (0, 1, 2))

# Three of each primary.
_TERMS = [(primary, subset) for primary in range(3) for subset in _SUBSETS if primary in subset]


# Prior standard deviation of the light at code 0, of a primary's full light: after the dark frames' is taken off, and
# where there are none. Contrasts of 1 : 500 and more, and a lit room, lie within.
_REST, _REST_UNKNOWN = 5e-4, 0.02

# Error of a channel's white that does not shrink with it, of the brightest white's: black levels and stray light.
_FLOOR = 2e-4

_FREEDOM = 4.0  # Degrees of freedom of Student's t: outliers lose their weight, healthy lights keep nearly all of it

# Noise added to each white in turn, as a share of it: from that of the priors down to none.
_SCHEDULE = (0.5, 0.2, 0.06, 0.015, 0.0, 0.0, 0.0)

_STEPS = 4  # Steps of Gauss and Newton for each of these, at most

_STILL = 1e-6  # Step, in standard deviations of what is known of any projector, after which no other follows

_DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0, 100.0)  # Damping of a step that is tried in turn, over the curvature

_N = 12  # Principal components of a tone curve that are kept: the next ones have standard deviations below .003

_CURVES, _OVERLAPS = 4 * _N, len(_TERMS) * len(_OVERLAP_NODES)


def _x(codes: npt.ArrayLike) -> _Array:
    return np.log(np.maximum(np.asarray(codes, dtype=np.float64), 0.5) / 255)


def _kernel(a: _Array, b: _Array) -> _Array:
    near = np.exp(-0.5 * ((a[:, None] - b[None]) / _LENGTH) ** 2)
    # Bends are conditioned on none at 255, where a curve is 1 by definition.
    full = np.exp(-0.5 * (a / _LENGTH) ** 2)[:, None] * np.exp(-0.5 * (b / _LENGTH) ** 2)[None]
    return _SLOPE**2 * a[:, None] * b[None] + _BEND**2 * (near - full)


@cache
def _curve_basis() -> _Array:
    """Return (256, N): what each of N independent normal numbers adds to the logarithm of a curve at each code."""
    nodes = _x(_NODES)
    variance, across = np.linalg.eigh(_kernel(nodes, nodes))
    variance, across = variance[-_N:], across[:, -_N:]
    return np.asarray(_kernel(_x(np.arange(256)), nodes) @ (across / np.sqrt(variance)), dtype=np.float64)


@cache
def _overlap_basis() -> _Array:
    """Return (256, K): what each of K independent normal numbers adds to the overlap at each code."""
    nodes, codes = _OVERLAP_NODES, np.arange(256.0)
    far = (nodes[:, None] - nodes[None]) / _OVERLAP_LENGTH
    root = np.linalg.cholesky(_OVERLAP**2 + _OVERLAP_BEND**2 * np.exp(-0.5 * far**2) + 1e-8 * np.eye(len(nodes)))
    between: list[_Array] = [np.asarray(np.interp(codes, nodes, row), dtype=np.float64) for row in np.eye(len(nodes))]
    return np.asarray(np.stack(between, axis=-1) @ root, dtype=np.float64)


@cache
def _primary_root() -> _Array:
    """Return (9, 9): the root of the prior covariance of the primaries' logarithms, [channel, primary] flattened."""
    channel, primary = (grid.ravel() for grid in np.indices((3, 3)))
    same_channel, same_primary = channel[:, None] == channel[None], primary[:, None] == primary[None]
    covariance = np.diag(_SEEN_SD.ravel() ** 2) + _SCALE_SD**2
    covariance += _CHANNEL_SD**2 * same_channel + _PRIMARY_SD**2 * same_primary
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Codes:
    """Codes of L lights, with what of the bases they use: computed once.

    Of each primary alone, and of each of its three overlaps, whose code is the least of the primaries that take part:

    - `lit`: (L, 3, 4) bool, whether the code is above 0.
    - `power`: (L, 3, 4) float64, logarithm of the light by the mean tone curve.
    - `curves`: (L, 3, 4, N) float64, what the numbers of a curve add to it.
    - `overlaps`: (L, 3, 3, K) float64, what the numbers of an overlap add to its amount.
    """

    lit: npt.NDArray[np.bool_]
    power: _Array
    curves: _Array
    overlaps: _Array

    @staticmethod
    def of(codes: npt.NDArray[np.integer]) -> _Codes:
        whole = np.asarray(codes, dtype=np.int64)
        least = np.stack([whole[:, subset].min(axis=1) for _, subset in _TERMS], axis=-1).reshape(-1, 3, 3)
        each = np.concatenate([whole[:, :, None], least], axis=2)
        return _Codes(each > 0, _POWER * _x(each), _curve_basis()[each], _overlap_basis()[least])


@dataclass(frozen=True, eq=False)
class ProjectorFit:
    """Whites of L lights, as the other lights of the session and what is known of any projector predict them.

    - `white`: (L, 3) float64, as given: counts, what is there at black taken off.
    - `slopes`: (L, 3, K) float64, of each white by the K numbers of the model, each with a normal prior of variance 1.
    - `covariance`: (K, K) float64 of these numbers.
    - `residual`: (L, 3) float64 counts, white less the fitted one.
    - `noise`: (L, 3, 3) float64, covariance of each white about the model: what is measured and the lamp's scatter.
    - `trust`: (L,) float64, 0 … 1, weight of each light in the fit.
    - `misfit`: sum of the squared distances of the whites from the model and of the model from what is known of any
      projector, in standard deviations: about 3 for each light, or fewer, where all is well.
    """

    white: _Array
    slopes: _Array
    covariance: _Array
    residual: _Array
    noise: _Array
    trust: _Array
    misfit: float = 0.0

    def predicted(self, lights: npt.NDArray[np.int64]) -> tuple[_Array, _Array]:
        """Return the whites that the lights not named predict for those named, and their covariance.

        `lights`: (B, n) int64, B sets of n lights that are left out together. Returns (B, 3 n) float64 counts. Returns
        (B, 3 n, 3 n) float64, of a new white of these codes: of the model, the measurement and the lamp.
        """
        sets, count = lights.shape
        size = 3 * count
        slopes = self.slopes[lights].reshape(sets, size, -1)
        known = slopes @ self.covariance @ slopes.swapaxes(1, 2)
        own, counted = np.zeros((sets, size, size)), np.zeros((sets, size, size))
        for n in range(count):
            at = slice(3 * n, 3 * n + 3)
            own[:, at, at] = self.noise[lights[:, n]]
            counted[:, at, at] = np.linalg.inv(self.noise[lights[:, n]]) * self.trust[lights[:, n], None, None]
        # What a light itself gave to the fit is taken out again (Woodbury's identity).
        freed = np.linalg.inv(np.eye(size) - known @ counted)
        left = (freed @ self.residual[lights].reshape(sets, size, 1))[..., 0]
        covariance = freed @ known
        return self.white[lights].reshape(sets, size) - left, (covariance + covariance.swapaxes(1, 2)) / 2 + own


def fit_projector(
    codes: npt.NDArray[np.integer],
    white: _Array,
    error: _Array,
    *,
    dark_known: bool,
    chroma_sd: float,
    brightness_sd: float,
    used: npt.NDArray[np.bool_] | None = None,
) -> ProjectorFit:
    """Return what the whites of a session say of its projector.

    `codes`: (L, 3) int64, 0 … 255. `white`: (L, 3) float64 counts of bare paper, exposed alike, what is there at black
    taken off. `error`: (L, 3) float64 counts, standard errors of them. `used`: (L,) bool, lights to learn from, each
    with its full weight; None where the distance from what others predict decides.
    """
    given = _Codes.of(codes)
    level = np.maximum(np.abs(white), _FLOOR * white.max())
    scale = float(white.max())
    noise = np.zeros((len(white), 3, 3))
    channels = np.arange(3)
    noise[:, channels, channels] = error**2 + (chroma_sd * level) ** 2 + (_FLOOR * scale) ** 2
    noise += brightness_sd**2 * level[:, :, None] * level[:, None, :]
    rest = _REST if dark_known else _REST_UNKNOWN
    state = np.zeros(9 + _CURVES + _OVERLAPS + 3)
    trust = np.ones(len(white)) if used is None else used.astype(np.float64)
    fitted, slopes = _model(state, given, scale, rest)
    for added in _SCHEDULE:
        loose = noise.copy()
        loose[:, channels, channels] += (added * level) ** 2
        weights = np.linalg.inv(loose) * trust[:, None, None]
        for _ in range(_STEPS):
            precision, weighted = _precision(slopes, weights)
            before = _misfit(state, white - fitted, weights)
            downhill = weighted.T @ (white - fitted).ravel() - state
            # The tangent may lead too far: the step is damped until it is one towards the mode (Levenberg, Marquardt).
            for damping in _DAMPINGS:
                by = np.linalg.solve(precision + damping * np.diag(np.diag(precision)), downhill)
                reached, there = _model(state + by, given, scale, rest)
                if _misfit(state + by, white - reached, weights) <= before:
                    state, fitted, slopes = state + by, reached, there
                    break
            else:
                # It is at the mode but for rounding, and would try the same again.
                break
            if np.abs(by).max() < _STILL:
                break
        if used is not None:
            continue
        covariance = _inverse(_precision(slopes, weights)[0])
        fit = ProjectorFit(white, slopes, covariance, white - fitted, loose, trust)
        mean, spread = fit.predicted(np.arange(len(white))[:, None])
        off = white - mean
        distance2 = np.einsum("lc,lcd,ld->l", off, np.linalg.inv(spread), off)
        trust = (_FREEDOM + 3) / (_FREEDOM + np.maximum(distance2, 3))
    weights = np.linalg.inv(noise) * trust[:, None, None]
    covariance = _inverse(_precision(slopes, weights)[0])
    misfit = _misfit(state, white - fitted, weights)
    return ProjectorFit(white, slopes, covariance, white - fitted, noise, trust, misfit)


def _precision(slopes: _Array, weights: _Array) -> tuple[_Array, _Array]:
    """Return the inverse covariance (K, K) of the model's numbers, and the weighted slopes (3 L, K)."""
    size = slopes.shape[2]
    weighted = (weights @ slopes).reshape(-1, size)
    return np.eye(size) + slopes.reshape(-1, size).T @ weighted, weighted


def _inverse(matrix: _Array) -> _Array:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _misfit(state: _Array, residual: _Array, weights: _Array) -> float:
    """Return twice the negative logarithm of the posterior, but for a constant."""
    return float(state @ state + np.einsum("lc,lcd,ld->", residual, weights, residual))


def _model(state: _Array, given: _Codes, scale: float, rest: float) -> tuple[_Array, _Array]:
    """Return the whites (L, 3) that a state gives, and their slopes (L, 3, K)."""
    count, nodes = len(given.lit), len(_OVERLAP_NODES)
    root = _primary_root()
    prior = np.log(_SEEN * _CHANNELS[:, None] * scale)
    primaries = np.exp(np.clip(prior + (root @ state[:9]).reshape(3, 3), -40, 40))
    parts = state[9 : 9 + _CURVES].reshape(4, _N)
    curves = np.sqrt(1 - _OWN**2) * parts[0] + _OWN * parts[1:]
    overlaps = state[9 + _CURVES : 9 + _CURVES + _OVERLAPS].reshape(3, 3, nodes)
    bent = np.einsum("lpjn,pn->lpj", given.curves, curves)
    light = np.where(given.lit, np.exp(np.clip(given.power + bent, -30, 3)), 0.0)
    part = light.copy()
    part[:, :, 1:] *= np.einsum("lpjm,pjm->lpj", given.overlaps, overlaps)
    by_curve = np.einsum("lpj,lpjn->lpn", part, given.curves)
    by_overlap = (light[:, :, 1:, None] * given.overlaps).reshape(count, 3, -1)
    by_state = np.zeros((count, 3, len(state)))
    by_state[:, :, 9 : 9 + _N] = np.sqrt(1 - _OWN**2) * by_curve
    rests = 9 + _CURVES + _OVERLAPS
    for primary in range(3):
        own, shared = 9 + _N * (1 + primary), 9 + _CURVES + 3 * nodes * primary
        by_state[:, primary, own : own + _N] = _OWN * by_curve[:, primary]
        by_state[:, primary, shared : shared + 3 * nodes] = by_overlap[:, primary]
        by_state[:, primary, rests + primary] = rest
    amounts = part.sum(axis=2) + rest * state[rests:]
    slopes = primaries @ by_state
    each = amounts[:, None, :] * primaries[None]
    slopes[:, :, :9] += np.einsum("lcp,cpk->lck", each, root.reshape(3, 3, 9))
    return each.sum(axis=2), slopes
