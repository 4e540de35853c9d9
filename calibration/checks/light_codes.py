"""Whether each light's white is what its codes give: frames that bear another light's name.

The ground truth is measured and stays true whatever a light is called; its codes and temperature do not. So each white
is held against what its codes give by all the other lights of the session and by what is known of any projector, and
each statement is as certain as these are: from seven hundred lights to hundredths of a degree, from two lights to tens
of degrees. There is no number of lights below which nothing is said. Two questions are asked:

- Is a white off its codes? By how much beyond four standard errors.
- Would two lights fit better if their names were exchanged? By how much more likely that is. This finds neighbours that
  are nearer to each other than any limit on an angle could be; how near two lights may be for their exchange to go
  unnoticed is a figure.

Where names do not fit, the lights that others are held against must not be the misnamed ones. Of many lights the
majority decides; of few, lights are left out, and names exchanged, until the rest agree
(docs/decisions/0015-lights-are-held-against-their-codes.md).

The projector (`fit_projector`). White under a light is the sum of what three primaries give, each as strong as a tone
curve makes it of its code, and what is added where two or three overlap (wheels with white, yellow, cyan or magenta
segments):

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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from foundation.colorimetry import angles_deg

_SEEN = np.array([[0.70, 0.28, 0.015], [0.055, 0.83, 0.11], [0.013, 0.25, 0.70]])
"""Share of white's count in channel R, G, B (rows) that each primary has: middles of five cameras' measured
sensitivities under a mercury lamp and LEDs."""

_SEEN_SD = np.array([[0.25, 0.45, 0.9], [0.6, 0.2, 0.6], [1.0, 0.7, 0.25]])
"""Prior standard deviations of their logarithms: half as much again as those cameras and lamps differ by."""

_CHANNELS = np.array([0.45, 1.0, 0.70])
"""White's counts in the channels over green's, of those cameras and lamps."""

_CHANNEL_SD, _PRIMARY_SD, _SCALE_SD = 0.35, 0.3, 2.0
"""Prior standard deviations (logarithm) of a channel's level, a primary's, and that of all: projectors of 5000 to
11 000 K, and any exposure."""

_NODES = np.array([4, 8, 16, 24, 32, 44, 56, 72, 88, 104, 120, 136, 152, 168, 184, 200, 216, 232, 255.0])
"""Codes at which tone curves are known; between them a curve bends by less than a thousandth."""

_POWER = 2.2
"""Exponent about which tone curves are described: displays have 1.8 to 2.6."""

_SLOPE, _BEND, _LENGTH = 0.4, 0.2, 0.4
"""Prior standard deviations of a tone curve's exponent and bends (logarithm), and the bends' length in the logarithm of
the code: sRGB, S-shaped curves and any exponent from 1.5 to 2.9 lie within two."""

_OWN = 0.2
"""How much of that a primary has for itself: the three curves of a projector are much alike, LCDs least."""

_OVERLAP_NODES = np.array([0.0, 64.0, 128.0, 192.0, 255.0])
"""Codes between which the light added where primaries overlap is interpolated."""

_OVERLAP, _OVERLAP_BEND, _OVERLAP_LENGTH = 0.2, 0.15, 120.0
"""Prior standard deviations of the light added where primaries overlap, over the primary's own: of the whole, and of
its course with the code, and the length in codes of that. White segments add up to half."""

_SUBSETS: tuple[tuple[int, ...], ...] = ((0, 1), (0, 2), (1, 2), (0, 1, 2))
"""Primaries that overlap: each pair, and all three."""

_TERMS = [(primary, subset) for primary in range(3) for subset in _SUBSETS if primary in subset]

_REST, _REST_UNKNOWN = 5e-4, 0.02
"""Prior standard deviation of the light at code 0, of a primary's full light: after the dark frames' is taken off, and
where there are none. Contrasts of 1 : 500 and more, and a lit room, lie within."""

_FLOOR = 2e-4
"""Error of a channel's white that does not shrink with it, of the brightest white's: black levels and stray light."""

_FREEDOM = 4.0
"""Degrees of freedom of Student's t: outliers lose their weight, healthy lights keep nearly all of it."""

_SCHEDULE = (0.5, 0.2, 0.06, 0.015, 0.0, 0.0, 0.0)
"""Noise added to each white in turn, as a share of it: from that of the priors down to none."""

_STEPS = 4
"""Steps of Gauss and Newton for each of these."""

_DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0, 100.0)
"""Damping of a step that is tried in turn, over the curvature."""

_N = 12
"""Principal components of a tone curve that are kept: the next ones have standard deviations below .003."""

_CURVES, _OVERLAPS = 4 * _N, len(_TERMS) * len(_OVERLAP_NODES)
_Array = npt.NDArray[np.float64]

CERTAIN = 4.0
"""Standard errors that are taken off an angle, or a brightness, so that noise is not taken for a wrong name."""

EXCHANGED = 30.0
"""Twice the logarithm of the odds from which two names are called exchanged: a quarter of a million pairs are asked
about in a session of 707 lights, for which 25 are taken off; what remains are odds of ten to one."""

HELD_DEG = 8.0
"""A light counts as held against its codes if no light further than this from it could bear its name unnoticed: the
angle from which a table is refused."""

_HELD_SD_DEG = 10.0
"""Largest standard error, degrees, of what codes predict for a light to count as held: blue for red is 85° off."""

_FEW = 24
"""Lights up to which each is left out in turn where names do not fit; of more, the majority decides."""

_SUSPECTS = 8
"""Lights among which exchanged names are looked for then: those whose absence helps most."""

_AS_GOOD = 9.0
"""Misfit by which exchanged names may be worse than leaving a light out, to be believed: that takes three numbers away,
which each have 1 on average."""

_CHROMA_SD, _MOST_CHROMA_SD = 0.003, 0.012
"""Scatter of a channel against the others, relative: what healthy lamps have, and up to where that of the session at
hand is believed to be its own. Beyond, a colour wheel is cut, or names are wrong; both are to be said."""

_BRIGHTNESS_SD, _UNTIED_SD = 0.03, 0.06
"""Scatter of a light's brightness, relative: lamps that flicker, and where no white frames show the lamp's drift."""

_HEALTHY, _HEALTHY_EACH = 8.0, 2.5
"""Misfit up to which the names of few lights are believed, and what each light adds. In 360 random healthy rooms it was
below 6 + 1.7 a light, and with any two names exchanged that are 6° apart above 12 + 3.3."""

_FITS = 50.0
"""Squared distance of two whites from what their exchanged codes give, above which these are none of theirs: six
dimensions have 6 on average and once in ten million times this."""

_FREE = 10.0
"""Standard deviation of a light's brightness, relative, where only its direction counts."""

_FAR = 3.0
"""Squared distance of two predictions, over `EXCHANGED`, up to which an exchange is weighed whole: both lights would be
off, so that twice this distance is to be expected of one."""

_BLOCK_PAIRS = 20_000
"""Pairs whose exchange is weighed at a time: a hundred megabytes."""

_Whole = npt.NDArray[np.int64]


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
    """Codes of lights, with what of the bases they use: computed once."""

    codes: npt.NDArray[np.int64]
    least: npt.NDArray[np.int64]
    curves: _Array
    least_curves: _Array
    least_overlaps: _Array

    @staticmethod
    def of(codes: npt.NDArray[np.integer]) -> _Codes:
        whole = np.asarray(codes, dtype=np.int64)
        least = np.stack([whole[:, subset].min(axis=1) for _, subset in _TERMS], axis=-1)
        curve, overlap = _curve_basis(), _overlap_basis()
        return _Codes(whole, least, curve[whole], curve[least], overlap[least])


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
    count, nodes = len(given.codes), len(_OVERLAP_NODES)
    root = _primary_root()
    prior = np.log(_SEEN * _CHANNELS[:, None] * scale)
    primaries = np.exp(np.clip(prior + (root @ state[:9]).reshape(3, 3), -40, 40))
    parts = state[9 : 9 + _CURVES].reshape(4, _N)
    curves = np.sqrt(1 - _OWN**2) * parts[0] + _OWN * parts[1:]
    overlaps = state[9 + _CURVES : 9 + _CURVES + _OVERLAPS].reshape(len(_TERMS), nodes)
    amounts, by_state = np.zeros((count, 3)), np.zeros((count, 3, len(state)))

    def curve(primary: int, codes: npt.NDArray[np.int64], basis: _Array) -> _Array:
        return np.where(codes > 0, np.exp(np.clip(_POWER * _x(codes) + basis @ curves[primary], -30, 3)), 0.0)

    def add(primary: int, part: _Array, basis: _Array) -> None:
        """Add light `part` (L,) of a primary, and what it changes by with that primary's curve."""
        amounts[:, primary] += part
        slope = part[:, None] * basis
        by_state[:, primary, 9 : 9 + _N] += np.sqrt(1 - _OWN**2) * slope
        own = 9 + _N * (1 + primary)
        by_state[:, primary, own : own + _N] += _OWN * slope

    for primary in range(3):
        add(primary, curve(primary, given.codes[:, primary], given.curves[:, primary]), given.curves[:, primary])
    for term, (primary, _) in enumerate(_TERMS):
        light = curve(primary, given.least[:, term], given.least_curves[:, term])
        add(primary, (given.least_overlaps[:, term] @ overlaps[term]) * light, given.least_curves[:, term])
        at = 9 + _CURVES + nodes * term
        by_state[:, primary, at : at + nodes] += light[:, None] * given.least_overlaps[:, term]
    at = 9 + _CURVES + _OVERLAPS
    amounts += rest * state[at:]
    for primary in range(3):
        by_state[:, primary, at + primary] = rest
    slopes = np.einsum("cp,lpk->lck", primaries, by_state)
    each = amounts[:, None, :] * primaries[None]
    slopes[:, :, :9] += np.einsum("lcp,cpk->lck", each, root.reshape(3, 3, 9))
    return each.sum(axis=2), slopes


@dataclass(frozen=True)
class ExchangedLights:
    """Two lights that fit better with their names exchanged.

    - `angle_deg`: angle between what the two codes give.
    - `evidence`: twice the logarithm of the odds that they are exchanged, all else left aside.
    """

    one: int
    other: int
    angle_deg: float
    evidence: float


@dataclass(frozen=True, eq=False)
class CodeAgreement:
    """How the whites of L lights agree with their codes.

    - `angle_deg`: (L,) float64 degrees between each white and the one that its codes give.
    - `error_deg`: (L,) float64 degrees, standard error of that, in the direction in which it is largest.
    - `off_deg`: (L,) float64 degrees, the angle beyond four standard errors; 0 where it is within.
    - `brightness`: (L,) float64, how much brighter a white is than its codes give, relative; −0.5 is half as bright.
    - `off_brightness`: (L,) float64, the same beyond four standard errors, ≥ 0.
    - `seen_as`: (L,) int64, for a light that is off its codes the one whose codes would give its white; −1 for none.
    - `exchanges`: lights that fit better with their names exchanged, the surest first.
    - `held`: (L,) bool, whether a light is held against its codes (`HELD_DEG`).
    - `exchange_deg`: largest angle between two lights whose exchange would go unnoticed; 0 where none would.
    - `misfit`: by how much whites and codes of few lights disagree, all taken together, over what healthy rooms have; 0
      of many.
    """

    angle_deg: _Array
    error_deg: _Array
    off_deg: _Array
    brightness: _Array
    off_brightness: _Array
    seen_as: _Whole
    exchanges: tuple[ExchangedLights, ...]
    held: npt.NDArray[np.bool_]
    exchange_deg: float
    misfit: float

    def rows(self, lights: slice) -> CodeAgreement:
        """Return the same of some lights alone; `seen_as` and `exchanges` name lights by the numbers they had."""
        return replace(
            self,
            angle_deg=self.angle_deg[lights],
            error_deg=self.error_deg[lights],
            off_deg=self.off_deg[lights],
            brightness=self.brightness[lights],
            off_brightness=self.off_brightness[lights],
            seen_as=self.seen_as[lights],
            held=self.held[lights],
        )


def code_agreement(
    codes: npt.NDArray[np.integer], white: _Array, error: _Array, *, dark_known: bool, drift_known: bool
) -> CodeAgreement:
    """Return how whites agree with their codes.

    `codes`: (L, 3) int64, 0 … 255, of different lights or of the same. `white`: (L, 3) float64 counts of bare paper,
    exposed alike, the lamp's drift and what is there at black taken off. `error`: (L, 3) float64 counts, standard
    errors.
    """
    # Its matrices are small: threads of the linear algebra wait for each other longer than they work.
    with threadpool_limits(limits=1, user_api="blas"):
        fit, swapped, misfit = _fitted(np.asarray(codes), white, error, dark_known=dark_known, drift_known=drift_known)
    count = len(white)
    mean, spread = fit.predicted(np.arange(count)[:, None])
    angle, deviation, error_deg = _directions(mean, spread, white)
    off_deg = angle * np.maximum(1 - CERTAIN / np.maximum(deviation, 1e-9), 0)
    brightness, off_brightness = _brightness(mean, spread, white)
    pairs, evidence, expected, apart = _pairs(fit, mean, spread, off_deg > 0)
    held, unnoticed = error_deg < _HELD_SD_DEG, expected < EXCHANGED
    held[pairs[unnoticed & (apart > HELD_DEG)].ravel()] = False
    found = np.flatnonzero(evidence > EXCHANGED)
    exchanges = [
        ExchangedLights(int(pairs[k, 0]), int(pairs[k, 1]), float(apart[k]), float(evidence[k]))
        for k in found[np.argsort(-evidence[found], kind="stable")].tolist()
    ]
    if swapped is not None:
        # Found by whole fits, which reach further than the tangent at this one.
        one, other = swapped
        k = int(np.flatnonzero((pairs == swapped).all(axis=1))[0])
        exchanges = [ExchangedLights(one, other, float(apart[k]), max(float(evidence[k]), EXCHANGED)), *exchanges]
    return CodeAgreement(
        angle_deg=angle,
        error_deg=error_deg,
        off_deg=off_deg,
        brightness=brightness,
        off_brightness=off_brightness,
        seen_as=_seen_as(mean, spread, white, off_deg),
        exchanges=_each_once(exchanges),
        held=held,
        exchange_deg=float(apart[unnoticed].max(initial=0.0)),
        misfit=misfit,
    )


def _fitted(
    codes: npt.NDArray[np.integer], white: _Array, error: _Array, *, dark_known: bool, drift_known: bool
) -> tuple[ProjectorFit, tuple[int, int] | None, float]:
    """Return the fit to lights that agree, the exchange of names that makes them agree, and the misfit of all.

    The misfit is over that of healthy rooms; 0 of many lights, among which some may be off.
    """
    brightness_sd = _BRIGHTNESS_SD if drift_known else _UNTIED_SD

    def fit(codes: npt.NDArray[np.integer], chroma_sd: float, used: npt.NDArray[np.bool_] | None) -> ProjectorFit:
        return fit_projector(
            codes, white, error, dark_known=dark_known, chroma_sd=chroma_sd, brightness_sd=brightness_sd, used=used
        )

    count = len(white)
    if count > _FEW:
        found = fit(codes, _CHROMA_SD, None)
        _, deviation, _ = _directions(*found.predicted(np.arange(count)[:, None]), white)
        # The median of the square of a distance of two dimensions is 1.39.
        scatter = _CHROMA_SD * float(np.sqrt(max(np.median(deviation**2) / 1.39, 1.0)))
        if scatter > _CHROMA_SD:
            found = fit(codes, min(scatter, _MOST_CHROMA_SD), None)
        return found, None, 0.0
    every = np.ones(count, dtype=np.bool_)
    found = fit(codes, _CHROMA_SD, every)
    misfit = found.misfit / _healthy(count)
    if misfit < 1 or count < 2:
        return found, None, misfit
    used = every
    for _ in range(count // 2):
        without = {light: used & (np.arange(count) != light) for light in np.flatnonzero(used).tolist()}
        fits = {light: fit(codes, _CHROMA_SD, rest) for light, rest in without.items()}
        ranked = sorted(fits, key=lambda light: fits[light].misfit)
        nearest = fits[ranked[0]]
        healed = nearest.misfit < _healthy(int(used.sum()) - 1)
        if used.all():
            swap, left = _healing_exchange(fit, codes, found.misfit, ranked[:_SUSPECTS])
            if swap is not None and left < nearest.misfit + _AS_GOOD:
                rest = ~np.isin(np.arange(count), swap)
                return fit(codes, _CHROMA_SD, rest), swap, misfit
        used, found = without[ranked[0]], nearest
        if healed:
            break
    return found, None, misfit


def _healthy(lights: int) -> float:
    """Return the misfit up to which whites agree: measured on random healthy rooms, with 2 to 20 lights."""
    return _HEALTHY + _HEALTHY_EACH * lights


def _healing_exchange(
    fit: Callable[[npt.NDArray[np.integer], float, npt.NDArray[np.bool_] | None], ProjectorFit],
    codes: npt.NDArray[np.integer],
    misfit: float,
    suspects: Sequence[int],
) -> tuple[tuple[int, int] | None, float]:
    """Return the two of some lights whose exchanged names make all lights agree, None without, and the misfit left."""
    best, found = _healthy(len(codes)), None
    for one, other in combinations(sorted(suspects), 2):
        exchanged = codes.copy()
        exchanged[[one, other]] = codes[[other, one]]
        left = fit(exchanged, _CHROMA_SD, np.ones(len(codes), dtype=np.bool_)).misfit
        if left < best and misfit - left > EXCHANGED / 2:
            best, found = left, (one, other)
    return found, best


def _directions(mean: _Array, spread: _Array, white: _Array) -> tuple[_Array, _Array, _Array]:
    """Return the angle (L,) degrees between whites and predictions, it in standard errors, and the largest of these.

    Brightness is left free: a lamp that flickers is no wrong name.
    """
    toward = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    along = np.asarray(_FREE**2 * (white**2).sum(axis=1), dtype=np.float64)
    free: _Array = spread + along[:, None, None] * toward[:, :, None] * toward[:, None]
    # The prediction as bright as the white: what is off is then across it, as an angle is.
    level = np.maximum((white * toward).sum(axis=1, keepdims=True), 0)
    off = white - level * toward
    deviation = np.sqrt(
        np.maximum(np.einsum("lc,lcd,ld->l", off, np.asarray(np.linalg.inv(free), dtype=np.float64), off), 0)
    )
    across = np.eye(3) - toward[:, :, None] * toward[:, None]
    largest = np.linalg.eigvalsh(across @ spread @ across)[:, -1]
    error = np.degrees(np.sqrt(np.maximum(largest, 0)) / np.maximum(np.linalg.norm(mean, axis=1), 1e-9))
    return angles_deg(mean, white), deviation, np.minimum(error, 180.0)


def _brightness(mean: _Array, spread: _Array, white: _Array) -> tuple[_Array, _Array]:
    """Return how much brighter whites (L,) are than predicted, relative, and that beyond four standard errors."""
    length = np.maximum(np.linalg.norm(mean, axis=1), 1e-9)
    toward = mean / length[:, None]
    more = (white * toward).sum(axis=1) / length - 1
    error = np.sqrt(np.einsum("lc,lcd,ld->l", toward, spread, toward)) / length
    return more, np.maximum(np.abs(more) - CERTAIN * error, 0)


def _pairs(
    fit: ProjectorFit, mean: _Array, spread: _Array, off: npt.NDArray[np.bool_]
) -> tuple[_Whole, _Array, _Array, _Array]:
    """Return pairs of lights (P, 2), the evidence (P,) for an exchange, that to expect of one, and degrees apart.

    All pairs of few lights; of many those that are near each other, and those of which one is `off` its codes: others
    would be far off if they were exchanged. `mean` (L, 3) and `spread` (L, 3, 3) are the predictions.
    """
    pairs = np.stack(np.triu_indices(len(fit.white), 1), axis=-1)
    if len(fit.white) > _FEW:
        one, other = pairs.T
        between = mean[one] - mean[other]
        far2 = np.einsum("pa,pab,pb->p", between, np.linalg.inv(spread[one] + spread[other]), between)
        pairs = pairs[(far2 < _FAR * EXCHANGED) | off[one] | off[other]]
    blocks = [pairs[at : at + _BLOCK_PAIRS] for at in range(0, len(pairs), _BLOCK_PAIRS)]
    found = [_weighed(fit, block) for block in blocks]
    none = (np.zeros(0),) * 3
    evidence, expected, apart = (np.concatenate(parts) for parts in zip(none, *found, strict=True))
    return pairs, evidence, expected, apart


def _weighed(fit: ProjectorFit, pairs: _Whole) -> tuple[_Array, _Array, _Array]:
    mean, spread = fit.predicted(pairs)
    inverse = np.linalg.inv(spread)

    def distance2(off: _Array) -> _Array:
        return np.einsum("pa,pab,pb->p", off, inverse, off)

    named, exchanged = (fit.white[lights].reshape(-1, 6) - mean for lights in (pairs, pairs[:, ::-1]))
    between = mean[:, 3:] - mean[:, :3]
    expected = distance2(np.concatenate([between, -between], axis=1))
    left = distance2(exchanged)
    # Exchanged names must not only fit better, they must fit.
    evidence = np.where(left < _FITS, distance2(named) - left, 0.0)
    return evidence, expected, angles_deg(mean[:, :3], mean[:, 3:])


def _seen_as(mean: _Array, spread: _Array, white: _Array, off_deg: _Array) -> _Whole:
    """Return for each light that is off its codes the light (L,) whose codes would give its white, −1 for none."""
    seen_as = np.full(len(white), -1, dtype=np.int64)
    for light in np.flatnonzero(off_deg > 0).tolist():
        given = np.broadcast_to(white[light], mean.shape)
        angle, deviation, _ = _directions(mean, spread, given)
        deviation[light] = np.inf
        like = int(np.argmin(deviation))
        if deviation[like] < CERTAIN and angle[like] < off_deg[light]:
            seen_as[light] = like
    return seen_as


def _each_once(exchanges: Sequence[ExchangedLights]) -> tuple[ExchangedLights, ...]:
    """Return exchanges with each light in one of them, the first that names it."""
    named: set[int] = set()
    kept: list[ExchangedLights] = []
    for pair in exchanges:
        if named.isdisjoint({pair.one, pair.other}):
            named |= {pair.one, pair.other}
            kept.append(pair)
    return tuple(kept)
