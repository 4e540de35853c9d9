"""Check that the white of each illuminant matches its codes, to detect frames with wrong or exchanged names.

The white of an illuminant is the camera RGB of bare paper under it. It is predicted from the codes of the illuminant,
the whites of all other illuminants and priors for any projector (`calibration.checks.projector_model`). Deviations
count only beyond the uncertainty of the prediction. The two checks:

- Does a white differ from its prediction by more than four standard uncertainties?
- Would two illuminants fit better with exchanged names? `exchange_deg` is the largest angle between two illuminants
  at which an exchange would not be detected.

If there are many illuminants, a few wrong ones have little weight in the fit. If there are few, illuminants are omitted
or exchanged on trial until the others agree (docs/decisions/0015-lights-are-held-against-their-codes.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from calibration.checks.projector_model import ProjectorFit, fit_projector
from foundation.colorimetry import angles_deg

_Array = npt.NDArray[np.float64]

# Number of standard uncertainties subtracted from an angle or a brightness, so that noise is not reported.
CERTAIN_SIGMAS = 4.0

# Two names are reported as exchanged if twice the logarithm of the odds exceeds this value. It is the
# sum of 25 for the 250 000 pairs of 707 illuminants, and 5 for odds of ten to one.
EXCHANGE_EVIDENCE = 30.0

# An illuminant is verified if any exchange with an illuminant at a larger angle would be detected. Errors above this
# angle cause a refusal of the LUT.
VERIFIED_DEG = 8.0

# Largest standard uncertainty of the prediction of a verified illuminant, degrees. Red and blue are 85° apart.
_VERIFIED_SD_DEG = 10.0

_FEW_LIGHTS = 24  # Up to this number of illuminants, each is omitted in turn; with more, robust weights are sufficient

_SUSPECT_COUNT = 8  # Number of illuminants tested for exchanges: those whose omission improves the fit most

# An exchange is preferred to the omission of one illuminant if the misfit of the exchange is at most this much larger.
# The omission removes three values, each of which adds 1 to the misfit on average.
_MISFIT_MARGIN = 9.0

# Relative scatter of a channel against the other channels: usual value, and largest value attributed to the lamp. A
# larger scatter has other causes, for example exposures that end within a turn of the colour wheel.
_CHROMA_SD, _MOST_CHROMA_SD = 0.003, 0.012

# Relative scatter of brightness: of a flickering lamp with known drift, and of a lamp without white frames, whose drift
# is unknown.
_BRIGHTNESS_SD, _UNKNOWN_DRIFT_SD = 0.03, 0.06

# Largest misfit of few illuminants with correct names: constant part, and part per illuminant. In simulated rooms
# without faults, the misfit was below 6 + 1.7 per illuminant. With an exchange at 6° or more, it was above 12 + 3.3 per
# illuminant.
_MAX_MISFIT, _MAX_MISFIT_EACH = 8.0, 2.5

# Largest squared distance (χ² of six values) of two whites from the prediction for their exchanged codes. Noise alone
# exceeds it once in 200 million cases.
_MAX_DISTANCE2 = 50.0

# Relative standard deviation of brightness that is large enough to make brightness irrelevant.
_FREE_BRIGHTNESS_SD = 10.0

# Largest squared distance between the predictions of two illuminants that are tested for an exchange, in units of
# `EXCHANGE_EVIDENCE`. At a larger distance, exchanged illuminants would not fit their codes. Illuminants that do not
# fit their codes are tested at any distance.
_MAX_PAIR_DISTANCE2 = 3.0

_BLOCK_PAIRS = 20_000  # Pairs evaluated at a time: about 100 MB

_Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ExchangedLights:
    """Two illuminants that fit better with exchanged names."""

    one: int
    other: int
    angle_deg: float  # between the predictions for the two codes
    evidence: float  # twice the logarithm of the odds of an exchange, without prior


@dataclass(frozen=True, eq=False)
class CodeAgreement:
    """Agreement of the whites under L illuminants with their codes."""

    angle_deg: _Array  # (L,) between each white and its prediction
    error_deg: _Array  # (L,) largest standard uncertainty of the prediction over all directions
    off_deg: _Array  # (L,) angle beyond four standard uncertainties, or 0
    brightness: _Array  # (L,) relative difference of brightness from the prediction; −0.5 is half as bright
    off_brightness: _Array  # (L,) amount of `brightness` beyond four standard uncertainties, ≥ 0
    seen_as: _Integers  # (L,) illuminant whose codes predict the white, if it deviates; −1: none
    exchanges: tuple[ExchangedLights, ...]  # most likely first
    is_verified: npt.NDArray[np.bool_]  # (L,) whether the white is verified by its codes (`VERIFIED_DEG`)
    exchange_deg: float  # largest angle between illuminants at which an exchange is not detectable; 0: none
    misfit: float  # χ² of the fit to few illuminants, relative to its limit for correct names; 0 with many illuminants

    def rows(self, lights: slice) -> CodeAgreement:
        """Return the result for some illuminants; `seen_as` and `exchanges` keep the original indices."""
        selected = {name: value[lights] for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        return replace(self, **selected)


def code_agreement(
    codes: npt.NDArray[np.integer], white: _Array, error: _Array, *, dark_known: bool, drift_known: bool
) -> CodeAgreement:
    """Compare whites with their codes.

    Parameters
    ----------
    codes : (L, 3) int64
        0 … 255; codes may repeat.
    white : (L, 3) float64
        Counts on paper at equal exposure, without lamp drift and dark light.
    error : (L, 3) float64
        Standard uncertainties of `white`.
    dark_known, drift_known : bool
        Whether dark light and lamp drift were measured.
    """
    # The matrices are small, so that several threads would be slower.
    with threadpool_limits(limits=1, user_api="blas"):
        fit, swap, misfit = _fit_codes(np.asarray(codes), white, error, dark_known=dark_known, drift_known=drift_known)
    count = len(white)
    mean, cov = fit.predicted(np.arange(count)[:, None])
    angle, deviation, error_deg = _directions(mean, cov, white)
    off_deg = angle * np.maximum(1 - CERTAIN_SIGMAS / np.maximum(deviation, 1e-9), 0)
    brightness, off_brightness = _brightness(mean, cov, white)
    pairs, evidence, expected, angles = _pairs(fit, mean, cov, off_deg > 0)
    is_verified, is_undetected = error_deg < _VERIFIED_SD_DEG, expected < EXCHANGE_EVIDENCE
    is_verified[pairs[is_undetected & (angles > VERIFIED_DEG)].ravel()] = False
    detected = np.flatnonzero(evidence > EXCHANGE_EVIDENCE)
    exchanges = [
        ExchangedLights(int(pairs[k, 0]), int(pairs[k, 1]), float(angles[k]), float(evidence[k]))
        for k in detected[np.argsort(-evidence[detected], kind="stable")].tolist()
    ]
    if swap is not None:
        # This exchange was detected by a complete new fit, which is more accurate than the linearised evidence.
        first, second = swap
        k = int(np.flatnonzero((pairs == swap).all(axis=1))[0])
        swap_evidence = max(float(evidence[k]), EXCHANGE_EVIDENCE)
        exchanges = [ExchangedLights(first, second, float(angles[k]), swap_evidence), *exchanges]
    return CodeAgreement(
        angle_deg=angle,
        error_deg=error_deg,
        off_deg=off_deg,
        brightness=brightness,
        off_brightness=off_brightness,
        seen_as=_seen_as(mean, cov, white, off_deg),
        exchanges=_without_repeated_lights(exchanges),
        is_verified=is_verified,
        exchange_deg=float(angles[is_undetected].max(initial=0.0)),
        misfit=misfit,
    )


def _fit_codes(
    codes: npt.NDArray[np.integer], white: _Array, error: _Array, *, dark_known: bool, drift_known: bool
) -> tuple[ProjectorFit, tuple[int, int] | None, float]:
    """Return the fit to illuminants that agree, a detected exchange, and the misfit relative to its limit.

    The misfit is 0 with many illuminants, because some of them may deviate.
    """
    brightness_sd = _BRIGHTNESS_SD if drift_known else _UNKNOWN_DRIFT_SD

    def fit(codes: npt.NDArray[np.integer], chroma_sd: float, used: npt.NDArray[np.bool_] | None) -> ProjectorFit:
        return fit_projector(
            codes, white, error, dark_known=dark_known, chroma_sd=chroma_sd, brightness_sd=brightness_sd, used=used
        )

    count = len(white)
    if count > _FEW_LIGHTS:
        fitted = fit(codes, _CHROMA_SD, None)
        _, deviation, _ = _directions(*fitted.predicted(np.arange(count)[:, None]), white)
        # 1.39 is the median of χ² with two degrees of freedom.
        scatter = _CHROMA_SD * float(np.sqrt(max(np.median(deviation**2) / 1.39, 1.0)))
        if scatter > _CHROMA_SD:
            fitted = fit(codes, min(scatter, _MOST_CHROMA_SD), None)
        return fitted, None, 0.0
    all_used = np.ones(count, dtype=np.bool_)
    fitted = fit(codes, _CHROMA_SD, all_used)
    misfit = fitted.misfit / _max_misfit(count)
    if misfit < 1 or count < 2:
        return fitted, None, misfit
    used = all_used
    for _ in range(count // 2):
        without = {light: used & (np.arange(count) != light) for light in np.flatnonzero(used).tolist()}
        fits = {light: fit(codes, _CHROMA_SD, remaining) for light, remaining in without.items()}
        ranked = sorted(fits, key=lambda light: fits[light].misfit)
        best = fits[ranked[0]]
        is_healthy = best.misfit < _max_misfit(int(used.sum()) - 1)
        if used.all():
            exchange, misfit_left = _best_exchange(fit, codes, fitted.misfit, ranked[:_SUSPECT_COUNT])
            if exchange is not None and misfit_left < best.misfit + _MISFIT_MARGIN:
                remaining = ~np.isin(np.arange(count), exchange)
                return fit(codes, _CHROMA_SD, remaining), exchange, misfit
        used, fitted = without[ranked[0]], best
        if is_healthy:
            break
    return fitted, None, misfit


def _max_misfit(lights: int) -> float:
    return _MAX_MISFIT + _MAX_MISFIT_EACH * lights


def _best_exchange(
    fit: Callable[[npt.NDArray[np.integer], float, npt.NDArray[np.bool_] | None], ProjectorFit],
    codes: npt.NDArray[np.integer],
    misfit: float,
    suspects: Sequence[int],
) -> tuple[tuple[int, int] | None, float]:
    """Return the two suspects that must be exchanged so that all illuminants agree, and the remaining misfit.

    The suspects are None if no exchange is sufficient.
    """
    best, exchange = _max_misfit(len(codes)), None
    for first, second in combinations(sorted(suspects), 2):
        exchanged = codes.copy()
        exchanged[[first, second]] = codes[[second, first]]
        misfit_left = fit(exchanged, _CHROMA_SD, np.ones(len(codes), dtype=np.bool_)).misfit
        if misfit_left < best and misfit - misfit_left > EXCHANGE_EVIDENCE / 2:
            best, exchange = misfit_left, (first, second)
    return exchange, best


def _directions(mean: _Array, cov: _Array, white: _Array) -> tuple[_Array, _Array, _Array]:
    """Return the angle (L,) of each white to its prediction in degrees and in units of σ, and the largest σ in degrees.

    σ is the standard uncertainty of the angle. It is largest for one direction of the error.
    """
    # Brightness is ignored, so that a flickering lamp does not look like a wrong name.
    direction = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    along = np.asarray(_FREE_BRIGHTNESS_SD**2 * (white**2).sum(axis=1), dtype=np.float64)
    free: _Array = cov + along[:, None, None] * direction[:, :, None] * direction[:, None]
    # Scale the prediction to the brightness of the white: the difference is then perpendicular to it, like an angle.
    level = np.maximum((white * direction).sum(axis=1, keepdims=True), 0)
    across = white - level * direction
    deviation = np.sqrt(
        np.maximum(np.einsum("lc,lcd,ld->l", across, np.asarray(np.linalg.inv(free), dtype=np.float64), across), 0)
    )
    projection = np.eye(3) - direction[:, :, None] * direction[:, None]
    largest = np.linalg.eigvalsh(projection @ cov @ projection)[:, -1]
    error = np.degrees(np.sqrt(np.maximum(largest, 0)) / np.maximum(np.linalg.norm(mean, axis=1), 1e-9))
    return angles_deg(mean, white), deviation, np.minimum(error, 180.0)


def _brightness(mean: _Array, cov: _Array, white: _Array) -> tuple[_Array, _Array]:
    predicted = np.maximum(np.linalg.norm(mean, axis=1), 1e-9)
    direction = mean / predicted[:, None]
    excess = (white * direction).sum(axis=1) / predicted - 1
    error = np.sqrt(np.einsum("lc,lcd,ld->l", direction, cov, direction)) / predicted
    return excess, np.maximum(np.abs(excess) - CERTAIN_SIGMAS * error, 0)


def _pairs(
    fit: ProjectorFit, mean: _Array, cov: _Array, is_off: npt.NDArray[np.bool_]
) -> tuple[_Integers, _Array, _Array, _Array]:
    """Return pairs (P, 2) of illuminants, evidence (P,) for an exchange, expected evidence (P,), and angles (P,).

    `mean` (L, 3) and `cov` (L, 3, 3) are predictions. `is_off` (L,): illuminants that deviate from their codes.
    """
    pairs = np.stack(np.triu_indices(len(fit.white), 1), axis=-1)
    if len(fit.white) > _FEW_LIGHTS:
        # With many illuminants, only near pairs and pairs with a deviating illuminant are evaluated. In any other
        # pair, exchanged illuminants would deviate strongly.
        first, second = pairs.T
        difference = mean[first] - mean[second]
        distance2 = np.einsum("pa,pab,pb->p", difference, np.linalg.inv(cov[first] + cov[second]), difference)
        pairs = pairs[(distance2 < _MAX_PAIR_DISTANCE2 * EXCHANGE_EVIDENCE) | is_off[first] | is_off[second]]
    blocks = [pairs[start : start + _BLOCK_PAIRS] for start in range(0, len(pairs), _BLOCK_PAIRS)]
    results = [_evaluate_pairs(fit, block) for block in blocks]
    empty = (np.zeros(0),) * 3
    evidence, expected, angles = (np.concatenate(columns) for columns in zip(empty, *results, strict=True))
    return pairs, evidence, expected, angles


def _evaluate_pairs(fit: ProjectorFit, pairs: _Integers) -> tuple[_Array, _Array, _Array]:
    mean, cov = fit.predicted(pairs)
    inverse = np.linalg.inv(cov)

    def distance2(residual: _Array) -> _Array:
        return np.einsum("pa,pab,pb->p", residual, inverse, residual)

    named, exchanged = (fit.white[lights].reshape(-1, 6) - mean for lights in (pairs, pairs[:, ::-1]))
    difference = mean[:, 3:] - mean[:, :3]
    expected = distance2(np.concatenate([difference, -difference], axis=1))
    exchanged2 = distance2(exchanged)
    # Exchanged names must fit well, not only better.
    evidence = np.where(exchanged2 < _MAX_DISTANCE2, distance2(named) - exchanged2, 0.0)
    return evidence, expected, angles_deg(mean[:, :3], mean[:, 3:])


def _seen_as(mean: _Array, cov: _Array, white: _Array, off_deg: _Array) -> _Integers:
    """Return the index (L,) of the illuminant whose codes predict a deviating white; −1 for the other whites."""
    seen_as = np.full(len(white), -1, dtype=np.int64)
    for light in np.flatnonzero(off_deg > 0).tolist():
        own_white = np.broadcast_to(white[light], mean.shape)
        angle, deviation, _ = _directions(mean, cov, own_white)
        deviation[light] = np.inf
        nearest = int(np.argmin(deviation))
        if deviation[nearest] < CERTAIN_SIGMAS and angle[nearest] < off_deg[light]:
            seen_as[light] = nearest
    return seen_as


def _without_repeated_lights(exchanges: Sequence[ExchangedLights]) -> tuple[ExchangedLights, ...]:
    paired: set[int] = set()
    # Each illuminant is kept only in its first exchange.
    unique: list[ExchangedLights] = []
    for pair in exchanges:
        if paired.isdisjoint({pair.one, pair.other}):
            paired |= {pair.one, pair.other}
            unique.append(pair)
    return tuple(unique)
