"""Fit the point spread of the lens outside of its sharp core, by regression on the light around each patch.

The point spread is modelled as a sum of Gaussian kernels with fixed σ. Such a sum describes any spread that decreases
with distance. Light that the lens spreads uniformly over the frame is veiling glare (ISO 9358); it is treated as the
last kernel. The share of a kernel is the fraction of the light of a point that it spreads.

The colours of a chart are in random order, so the neighbours of a patch are unrelated to its code. The level of a patch
is predicted from similar codes. The residual is regressed on the light that each kernel would add.

- The regressors are calculated from predicted levels, so they do not contain the noise of the patch itself.
- Errors of the flat field and unevenness of the print multiply levels by smooth factors, which are fitted as well.
  Veiling glare differs from them, because it adds equally to dark and bright patches.
- A kernel is proven if its χ² gain is at least `LEAST_GAIN`; other kernels are dropped. If any kernel is proven, far
  kernels and veiling glare get their most likely shares, with usual lenses as prior. These shares are not negative.

Arrays have C patches in the order of colour indices, or T unknowns of a channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls

from calibration.spread.predicting import VARYING_BITS, LevelModel
from experiment.measures.least_squares import page_polynomial, page_powers
from foundation.robust import sigma_by_level

# σ of the near kernels, half-size px. The smallest brings the first light of neighbours to the samples of a patch; the
# largest spreads light over a slot, which is the area of one patch.
NEAR_PX = (1.5, 3.0, 6.0)

# σ of the far kernels, half-size px: one slot, two slots, a tenth of the height of a full chart, and the widest kernel
# that can be separated from veiling glare.
FAR_PX = (12.0, 24.0, 96.0, 384.0)

# Number of terms that describe a near share over the frame: a polynomial, quadratic along both axes (`frame_terms`),
# because aberrations grow with the field angle. The shares of far kernels are constant over the frame.
FRAME_TERMS = 9

_NEAR_TERMS = FRAME_TERMS * len(NEAR_PX)

_CHANNEL_TERMS = _NEAR_TERMS + len(FAR_PX) + 1

# Number of unknown shares: for each channel, all terms of near kernels, then far kernels, then veiling glare.
TERMS = 3 * _CHANNEL_TERMS

# Minimum χ² gain of a proven kernel: its share is then four standard uncertainties. In cross-validation, this is the
# minimum gain of all kernels together.
LEAST_GAIN = 16.0

_Array = npt.NDArray[np.float64]

# Largest misfit (`PointSpread.misfit`) with which veiling glare can be separated from other light. Simulations with
# veiling glare have at most 3.3.
MOST_MISFIT = 5.0

LEAST_COUNTS = 300.0  # minimum counts of paper above black level in a used channel

# Prior standard deviation of the coefficients of the smooth factors, which describe errors of the flat field and
# unevenness of the print. Chosen by judgement.
USUAL_UNEVENNESS = 0.003

# `USUAL_UNEVENNESS` for light of several primaries with different flat fields. Chosen by judgement.
LOOSE_UNEVENNESS = 0.03

FOLDS = 4  # folds of cross-validation over parts of the print

# Number of tiles along the longer page side. Each tile belongs to one fold, and each fold covers the whole print.
_TILES_PER_SIDE = 10

# Orders of polynomials over the page: of light that no kernel explains, of smooth factors of levels, and of changes of
# ink density (level times its logarithm).
_SHAPE_ORDER, _FACTOR_ORDER, _INK_ORDER = 4, 6, 2

DARK_LEVEL = 0.1  # level relative to paper where nonlinearity of the sensor may hide veiling glare

_MIN_BEND = 1e-4  # lower bound of the standard deviation of the sensor's nonlinearity

# Prior standard deviation of shares without other prior. It is wide, and makes the equations solvable for kernels with
# little effect.
_PRIOR_SHARE = 0.1

# Prior standard deviation of veiling glare; lenses have 0.3 to 1.5 % (ISO 9358, ISO 18844). It is reported unchanged if
# the chart cannot show veiling glare.
USUAL_VEIL = 0.01

_WIDE_KERNELS = 2  # number of far kernels that are so wide that they resemble other smooth light

# Prior standard deviation of the share of each far kernel, about its expectation from the previous kernel.
_FAR_STEPS = (0.01, 0.01, 0.004, 0.003)

# Factors of `_FAR_STEPS` for lenses with little, usual and much scatter; their prior probabilities are equal.
_FAR_SIZES = (0.3, 1.0, 3.0)

# Factor of the usual shares for a lens without scatter. It is also the factor of the usual veiling glare for a lens
# without veiling glare.
_CLEAN_SIZE = 0.001

# Prior probability of a lens without scatter, for charts with many and with few colours. With few colours, the first
# value would give several times the actual error as uncertainty. Chosen by judgement.
_CLEAN_ODDS, _CLEAN_ODDS_OF_FEW = 0.3, 0.7

# Prior probability that a lens with scatter has no veiling glare, on charts with few colours. Chosen by judgement.
_CLEAR_ODDS_OF_FEW = 0.3

# Assumed laws of scattered light: exponent of its decrease with distance, and factor of the far kernels. Two laws are
# for polish, scratches and dust (J. E. Harvey, "Light-scattering characteristics of optical surfaces", 1976; I. R.
# King, "The profile of a star image", 1971). The third is for aberrations, which end within a slot.
_LAWS = ((2.0, 1.0), (3.0, 1.0), (3.0, _CLEAN_SIZE))

_POWER_ODDS = 0.5  # prior probability that scattered light follows one of these laws; chosen by judgement

# Prior standard deviation of all scattered light of a lens that follows a law. Chosen by judgement.
_SCATTERED_SD = 0.04

# Prior standard deviation of the difference between a share and the law, relative to the law. Chosen by judgement.
_OFF_LAW_SD = 0.35

# Standard deviation of the difference between a channel's far share and the common share of R, G and B, relative to the
# share. Scatter and coatings vary over the visible spectrum. Chosen by judgement.
CHANNELS_APART = 1 / 3

_LAW_APART = 0.7  # as `CHANNELS_APART`, for differences between shares and the law; chosen by judgement

_SCATTER_APART = 0.5  # as `CHANNELS_APART`, for a lens that follows a law

# Expected share of a far kernel relative to the previous kernel. A decrease of light with r⁻² would give 1, and r⁻³
# would give 0.25.
_FAR_SHARE_RATIO = 0.5

# `CHANNELS_APART` for three kinds of lenses: similar channels, different channels, and coatings for one channel.
_APART = (0.03, CHANNELS_APART, 0.7)

_APART_ODDS = (0.4, 0.4, 0.2)  # prior probabilities of `_APART`; chosen by judgement

# Largest credible veiling glare on charts with few colours. Above it, the light may come from near kernels that grow
# towards the corners, which such charts cannot show.
MOST_VEIL = 0.02

# Lower bound of the misfit for charts with few colours, because the errors of a patch are correlated over channels.
_MIN_MISFIT = 3.0

_LEVEL_GROUPS = 40  # number of groups of similar levels for measuring the scatter

_HUBER_SIGMAS = 3.0  # residual in standard deviations above which the weight of a patch decreases

_ROUNDS = 2  # number of solutions; each solution gets its weights from the residuals of the previous solution

# Stored shares are multiples of this step, so that the bytes of a LUT do not depend on rounding in linear algebra.
_SHARE_STEP = 1e-7

# Prior standard deviation of the change of a share over the frame, if there are too few patches to measure the change.
# Chosen by judgement.
_SHARE_CHANGE_SD = 0.002

_EVEN_TERMS = 3  # number of unknowns of a share that is constant over the frame: one per channel


def frame_terms(positions_px: npt.NDArray[np.floating], frame_px: tuple[int, int]) -> _Array:
    """Return the terms (N, 9) float64 of a near share over the frame: products of Legendre polynomials, constant first.

    `positions_px`: (N, 2) half-size px, x then y.
    """
    unit = 2 * np.clip(positions_px / (np.array(frame_px[::-1]) - 1.0), 0, 1) - 1
    x, y = (np.stack([np.ones_like(t), t, 1.5 * t**2 - 0.5], axis=-1) for t in unit.T)
    return (y[:, :, None] * x[:, None, :]).reshape(-1, FRAME_TERMS)


def channel_terms(channel: int) -> npt.NDArray[np.int64]:
    """Return the indices (T,) int64 of the unknowns of a channel, ordered by kernel and term; veiling glare is last."""
    return np.arange(_CHANNEL_TERMS, dtype=np.int64) + channel * _CHANNEL_TERMS


def kernel_of_terms() -> list[tuple[int, int | None]]:
    """Return kernel and frame term of each unknown of a channel; the term is None for far kernels and veiling glare."""
    near: list[tuple[int, int | None]] = [(k, term) for k in range(len(NEAR_PX)) for term in range(FRAME_TERMS)]
    return near + [(kernel, None) for kernel in range(len(NEAR_PX), len(NEAR_PX) + len(FAR_PX) + 1)]


def groups_of_terms() -> list[npt.NDArray[np.int64]]:
    """Return groups of unknowns (n,) int64 that are kept or dropped together.

    Each kernel has a group for its constant share; a near kernel has another for the change over the frame.
    """
    terms = np.array([(kernel, 0 if place is None else min(place, 1)) for kernel, place in kernel_of_terms()])
    groups: list[npt.NDArray[np.int64]] = []
    for kernel, varying in sorted({(int(kernel), int(varying)) for kernel, varying in terms}):
        indices = np.flatnonzero((terms[:, 0] == kernel) & (terms[:, 1] == varying))
        groups.append(np.concatenate([channel_terms(channel)[indices] for channel in range(3)]))
    return groups


def far_groups() -> list[npt.NDArray[np.int64]]:
    """Return the unknowns (3,) int64 in R, G and B of each far kernel and, last, of veiling glare."""
    return groups_of_terms()[-len(FAR_PX) - 1 :]


def _bend_index(channel: int) -> int:
    # The unknown of nonlinearity follows the unknowns of light that no kernel explains.
    return TERMS + len(page_powers(_SHAPE_ORDER)) - 1 + channel


def free_terms() -> npt.NDArray[np.bool_]:
    """Return the unknowns, (n,) bool, that may be negative: near kernels."""
    return np.arange(TERMS) % _CHANNEL_TERMS < _NEAR_TERMS


@dataclass(frozen=True, eq=False)
class PointSpread:
    """Spread of the lens outside of its sharp core, measured on the chart."""

    # (TERMS,) shares to correct: 0 for near kernels that are not proven; all 0 if no kernel is proven
    shares: _Array
    covariance: _Array  # (TERMS, TERMS) of all unknowns, proven or not
    gain: float  # χ² gain of the proven kernels; by chance, each unknown gains 1
    held_out: float  # χ² gain of the proven kernels in cross-validation
    misfit: float  # χ² gain from smooth light that no kernel explains, per unknown, ≥ 1; factor of the covariance
    likeliest: _Array  # (TERMS,) most likely shares, also if no kernel is proven

    @property
    def unexplained(self) -> _Array:
        """(TERMS, TERMS) float64, mean square error of the shares: covariance plus squares of uncorrected shares."""
        return self.mean_square_error(self.shares)

    def mean_square_error(self, subtracted: _Array) -> _Array:
        """Return the mean square error (TERMS, TERMS) float64 if the shares (TERMS,) are corrected."""
        uncorrected = self.likeliest - subtracted
        return self.covariance + np.outer(uncorrected, uncorrected)

    @property
    def proven(self) -> bool:
        """Whether any kernel is proven, and confirmed by cross-validation."""
        return bool(self.shares.any()) and self.held_out > LEAST_GAIN * self.misfit

    def amounts(self) -> _Array:
        """Return the shares (9, 3, K) float64: terms over the frame, channels, kernels with veiling glare last."""
        return self._by_kernel(self.shares)

    def errors(self) -> _Array:
        """Return the standard uncertainties (9, 3, K) float64 of the shares."""
        return self._by_kernel(np.sqrt(np.diag(self.covariance)))

    def _by_kernel(self, values: _Array) -> _Array:
        array = np.zeros((FRAME_TERMS, 3, len(NEAR_PX) + len(FAR_PX) + 1))
        for channel in range(3):
            for (kernel, term), value in zip(kernel_of_terms(), values[channel_terms(channel)], strict=True):
                array[term or 0, channel, kernel] = value
        return array

    def to_json(self) -> dict[str, Any]:
        """Return the content of `lut.json` and `report.json`."""
        return {
            "sigma_px": [*NEAR_PX, *FAR_PX, None],
            "share": self.amounts().round(7).tolist(),
            "standard_error": self.errors().round(7).tolist(),
            "gain": float(f"{self.gain:.4g}"),
            "gain_held_out": float(f"{self.held_out:.4g}"),
            "misfit": float(f"{self.misfit:.4g}"),
        }


@dataclass(frozen=True, eq=False)
class SpreadData:
    """One channel of a frame: levels of patches, and their changes by the kernels."""

    channel: int
    level: _Array  # (C,) relative to paper, divided by the flat field
    changes: _Array  # (C, T) change of `level` if the share of an unknown is 1
    even: _Array  # (C,) change of `level` by uniform light with the mean level of the frame
    field: _Array  # (C,) flat field, about 1
    usable: npt.NDArray[np.bool_]
    unevenness: float  # prior standard deviation of smooth factors
    bend: float  # standard deviation of the sensor's nonlinearity between dark patches and paper, relative


@dataclass(frozen=True, eq=False)
class ReferenceData:
    """One channel of a frame at references of one colour. Their levels are equal, so no prediction is needed."""

    channel: int
    level: _Array  # (N,) as in `SpreadData`
    changes: _Array  # (N, T) as in `SpreadData`
    field: _Array  # (N,) as in `SpreadData`
    places_mm: _Array  # (N, 2)
    order: int  # order of the polynomial over the page that is removed, because the flat field contains it


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows of the regression, ordered by folds."""

    value: _Array  # (N,)
    design: _Array  # (N, T + M)
    level: _Array  # (N,)
    folds: tuple[slice, ...]  # rows of each fold
    unknowns: npt.NDArray[np.int64]  # (T + M,) index of the unknown of each column
    freedom: float = 1.0  # ratio of residual variance to noise variance


def fit_spread(
    data: Sequence[SpreadData],
    cells_mm: _Array,
    page_mm: tuple[float, float],
    bits: int,
    references: Sequence[ReferenceData] = (),
) -> PointSpread | None:
    """Fit the point spread to the residuals of patches; None if there are no data.

    `cells_mm`: (C, 2) float64, centres of the patches.
    """
    if not data:
        return None
    rows = [_rows(item, number, cells_mm, page_mm, bits) for number, item in enumerate(data)]
    shapes = len(page_powers(_SHAPE_ORDER)) - 1
    size = max(int(item.unknowns.max()) for item in rows) + 1
    factors = np.full(size, 1 / _PRIOR_SHARE**2)
    for item, row in zip(data, rows, strict=True):
        factors[row.unknowns[len(channel_terms(0)) + shapes :]] = 1 / item.unevenness**2
        factors[_bend_index(item.channel)] = 1 / max(item.bend, _MIN_BEND) ** 2
        factors[row.unknowns[-(len(page_powers(_INK_ORDER)) - 1) :]] = 1 / USUAL_UNEVENNESS**2
    prior = np.diag(factors)
    usual = np.asarray(np.linalg.inv(_prior_covariance(bits, _Lens())), dtype=np.float64)
    prior[:TERMS, :TERMS] = usual
    shape = np.arange(TERMS, TERMS + shapes)
    others = np.delete(np.arange(size), shape)
    solution = np.zeros(size)
    normal, right = np.zeros((FOLDS, size, size)), np.zeros((FOLDS, size))
    reference_rows = [_reference_rows(item, page_mm) for item in references]
    for round_index in range(_ROUNDS):
        if round_index and bits < VARYING_BITS:
            lens = [solution[channel_terms(item.channel)] for item in data]
            rows = [_rows(item, n, cells_mm, page_mm, bits, lens[n]) for n, item in enumerate(data)]
        normal, right = _normal_equations([*rows, *reference_rows], solution)
        solution[others] = _solve_all(
            *_at_terms(normal.sum(axis=0), right.sum(axis=0), prior, others), np.arange(TERMS)
        )
    is_few = bits < VARYING_BITS
    misfit = _misfit(normal.sum(axis=0), right.sum(axis=0), prior, shapes)
    normal, right = normal[:, others][:, :, others], right[:, others]
    prior = prior[np.ix_(others, others)]
    matrix, vector = _eliminate_factors(normal.sum(axis=0), right.sum(axis=0), prior)
    # The misfit increases the variance of the data, but not of the prior.
    variance = max(misfit, _MIN_MISFIT) if is_few else misfit
    inflated = _eliminate_factors(normal.sum(axis=0), right.sum(axis=0), variance * prior)
    weakened = inflated[0] / variance - usual, inflated[1] / variance
    lenses = _Lenses.of((matrix - usual, vector), weakened, bits)
    matrix = matrix + lenses.likeliest_prior - usual
    candidates = groups_of_terms()
    if is_few:
        candidates = [group for group in candidates if len(group) <= _EVEN_TERMS]
    far = far_groups()
    veil = far[-1]
    extra = np.zeros((TERMS, TERMS))
    for item in data:
        # If nonlinearity of the sensor reduces the counts of dark patches, it hides veiling glare of the same size.
        hidden = DARK_LEVEL * item.bend / float(np.median(item.even * item.field))
        extra[veil[item.channel], veil[item.channel]] += hidden**2
    apparent_veil = _solve_nonnegative(matrix, vector, _terms(candidates))[0][veil]
    # Apparent veiling glare may be other smooth light. On charts with few colours it may be near spread that grows
    # towards the corners.
    is_ambiguous = misfit > MOST_MISFIT or (is_few and apparent_veil.mean() > MOST_VEIL)
    if is_ambiguous:
        # It is then not corrected, and counted as uncertainty.
        extra[np.ix_(veil, veil)] += np.outer(apparent_veil, apparent_veil)
        candidates.pop()
        far.pop()
    proven = _proven_terms(matrix, vector, misfit, candidates)
    if is_ambiguous:
        extra += _usual_wide_light(bits, scatters=len(proven) > 0)
    _, gain = _solve_nonnegative(matrix, vector, proven)
    # Far shares are corrected even if they are not proven, because every lens has some far spread.
    shares, covariance = lenses.shares(np.union1d(proven, _terms(far)))
    covariance += extra
    held_out = 0.0
    for fold in range(FOLDS):
        training = normal.sum(axis=0) - normal[fold], right.sum(axis=0) - right[fold]
        fitted, plain = (_solve_all(*training, prior, terms) for terms in (proven, proven[:0]))
        held_out += _chi2_gain(normal[fold], right[fold], fitted) - _chi2_gain(normal[fold], right[fold], plain)
    spread = PointSpread(shares, covariance, gain, held_out, misfit, likeliest=shares)
    return spread if spread.proven else replace(spread, shares=np.zeros(TERMS))


@dataclass(frozen=True, eq=False)
class _Lenses:
    """Equations and probability of each assumed lens; the assumptions are the priors of the shares."""

    matrices: _Array  # (L, TERMS, TERMS)
    vector: _Array  # (TERMS,) right-hand side, the same for all lenses
    covariances: _Array  # (L, TERMS, TERMS) of all shares
    weights: _Array  # (L,) posterior probability, sum 1
    likeliest_prior: _Array  # (TERMS, TERMS) inverse prior covariance of the most likely lens

    @staticmethod
    def of(equations: tuple[_Array, _Array], weakened: tuple[_Array, _Array], bits: int) -> _Lenses:
        """Combine the equations of the print, (TERMS, TERMS) and (TERMS,), with the prior of each assumed lens.

        `weakened`: the same equations, divided by the misfit.
        """
        matrix, vector = weakened
        lenses = _assumed_lenses(bits < VARYING_BITS)
        priors = np.array([np.linalg.inv(_prior_covariance(bits, lens)) for lens in lenses])
        # Twice the logarithm of the evidence (D. MacKay, Bayesian interpolation, 1992). Veiling glare is restricted to
        # values ≥ 0, because a negative value is no evidence of veiling glare.
        gains = np.array([_solve_nonnegative(matrix + prior, vector, np.arange(TERMS))[1] for prior in priors])
        evidence = gains + np.linalg.slogdet(priors)[1] - np.linalg.slogdet(matrix + priors)[1]
        odds = np.array([lens.odds for lens in lenses])
        weights = odds * np.exp(0.5 * (evidence - evidence.max()))
        return _Lenses(
            equations[0] + priors,
            equations[1],
            np.asarray(np.linalg.inv(matrix + priors), dtype=np.float64),
            weights / weights.sum(),
            priors[int(np.argmax(weights))],
        )

    def shares(self, terms: npt.NDArray[np.int64]) -> tuple[_Array, _Array]:
        """Return the mean shares (TERMS,) over all lenses, 0 except for `terms`, and their covariance."""
        lens_shares = np.array([_solve_nonnegative(matrix, self.vector, terms)[0] for matrix in self.matrices])
        mean = np.round(self.weights @ lens_shares / _SHARE_STEP) * _SHARE_STEP
        difference = (lens_shares - mean) * np.sqrt(self.weights)[:, None]
        return mean, np.tensordot(self.weights, self.covariances, axes=1) + difference.T @ difference


@dataclass(frozen=True)
class _Lens:
    """Assumptions about a lens; near and far spread is independent of veiling glare."""

    near: float = 1.0  # factor of the usual shares of near kernels
    far: float = 1.0  # factor of the usual shares of far kernels
    far_apart: float = CHANNELS_APART  # as `CHANNELS_APART`
    power: float = 0.0  # exponent of the scatter law; 0: independent shares
    veil: float = 1.0  # factor of the usual veiling glare
    veil_apart: float = CHANNELS_APART  # as `CHANNELS_APART`
    odds: float = 1.0  # prior probability


def _assumed_lenses(few: bool) -> list[_Lens]:
    clean, clear = (_CLEAN_ODDS_OF_FEW, _CLEAR_ODDS_OF_FEW) if few else (_CLEAN_ODDS, 0.0)
    apart_odds = list(zip(_APART, _APART_ODDS, strict=True))
    scatter = [(_Lens(near=_CLEAN_SIZE, far=_CLEAN_SIZE, odds=clean), clean)]
    law = (1 - clean) * _POWER_ODDS / len(_LAWS)
    scatter += [(_Lens(power=power, far=far, far_apart=_SCATTER_APART, odds=law), clear) for power, far in _LAWS]
    independent = (1 - clean) * (1 - _POWER_ODDS) / len(_FAR_SIZES)
    scatter += [
        (_Lens(far=size, far_apart=apart, odds=independent * odds), clear)
        for size, (apart, odds) in product(_FAR_SIZES, apart_odds)
    ]
    lenses = [
        replace(lens, veil=_CLEAN_SIZE, odds=lens.odds * clear_odds) for lens, clear_odds in scatter if clear_odds
    ]
    return lenses + [
        replace(lens, veil_apart=veil_apart, odds=lens.odds * (1 - clear_odds) * odds)
        for (lens, clear_odds), (veil_apart, odds) in product(scatter, apart_odds)
    ]


def _usual_wide_light(bits: int, scatters: bool) -> _Array:
    """Return the prior mean squares (TERMS, TERMS) of wide kernels and veiling glare.

    `scatters`: only for lenses with scatter.
    """
    wide = _terms(far_groups()[-_WIDE_KERNELS - 1 :])
    lenses = [lens for lens in _assumed_lenses(bits < VARYING_BITS) if lens.near == 1 or not scatters]
    mean_squares = np.zeros((TERMS, TERMS))
    for lens in lenses:
        probability = lens.odds / sum(lens.odds for lens in lenses)
        mean_squares[np.ix_(wide, wide)] += probability * _prior_covariance(bits, lens)[np.ix_(wide, wide)]
    return mean_squares


def _prior_covariance(bits: int, lens: _Lens) -> _Array:
    usual = np.diag(np.full(TERMS, (lens.near * _PRIOR_SHARE) ** 2))
    if bits < VARYING_BITS:
        varying = np.concatenate([group for group in groups_of_terms() if len(group) > _EVEN_TERMS])
        usual[varying, varying] = (lens.near * _SHARE_CHANGE_SD) ** 2
    *kernels, veil = (group for group in groups_of_terms() if len(group) <= _EVEN_TERMS)
    if lens.power:
        law = _law_shares(lens.power)
        law[len(NEAR_PX) :] *= lens.far
        sizes = _SCATTERED_SD**2 * np.outer(law, law)
        off_law = np.diag(_OFF_LAW_SD**2 * np.diag(sizes))
    else:
        kernels = kernels[len(NEAR_PX) :]
        transfer = np.eye(len(FAR_PX))
        # The second share does not depend on the first, because the first far kernel also describes near spread.
        for kernel in range(2, len(FAR_PX)):
            transfer[kernel] += _FAR_SHARE_RATIO * transfer[kernel - 1]
        sizes = (transfer * (lens.far * np.array(_FAR_STEPS)) ** 2) @ transfer.T
        off_law = np.zeros_like(sizes)
    for first, row, off_row in zip(kernels, sizes, off_law, strict=True):
        for second, shared, own in zip(kernels, row, off_row, strict=True):
            usual[np.ix_(first, second)] = shared * channels_alike(lens.far_apart) + own * channels_alike(_LAW_APART)
    usual[np.ix_(veil, veil)] = (lens.veil * USUAL_VEIL) ** 2 * channels_alike(lens.veil_apart)
    return usual


def _law_shares(power: float) -> _Array:
    """Return the fraction (K,) of each near and far kernel in light that decreases with a power of the distance."""
    # The law is a mixture of Gaussians with weights σ^(1 − power) dσ. Each kernel represents the nearest range of σ.
    scale = np.array(NEAR_PX + FAR_PX)
    between = np.sqrt(scale[1:] * scale[:-1])
    edges = np.array([scale[0] ** 2 / between[0], *between, scale[-1] ** 2 / between[-1]])
    amount = np.log(edges) if power == 2 else edges ** (2 - power) / (2 - power)
    share: _Array = np.diff(amount) / (amount[-1] - amount[0])
    return share


def channels_alike(apart: float = CHANNELS_APART) -> _Array:
    """Return the prior correlation (3, 3) float64 of far shares of R, G and B."""
    return (1 - apart**2) + apart**2 * np.eye(3)


def _at_terms(
    normal: _Array, right: _Array, prior: _Array, terms: npt.NDArray[np.int64]
) -> tuple[_Array, _Array, _Array]:
    return normal[np.ix_(terms, terms)], right[terms], prior[np.ix_(terms, terms)]


def _misfit(normal: _Array, right: _Array, prior: _Array, shapes: int) -> float:
    """Return the χ² gain from smooth light that no kernel explains, per unknown; at least 1, the value by chance."""
    with_shape = _eliminate_factors(normal, right, prior, TERMS + shapes)
    others = np.delete(np.arange(len(prior)), np.arange(TERMS, TERMS + shapes))
    plain = _eliminate_factors(*_at_terms(normal, right, prior, others))
    gains = [_chi2_gain(*pair, np.asarray(np.linalg.solve(*pair), dtype=np.float64)) for pair in (with_shape, plain)]
    return max(1.0, (gains[0] - gains[1]) / shapes)


def _rows(
    data: SpreadData, number: int, cells_mm: _Array, page_mm: tuple[float, float], bits: int, lens: _Array | None = None
) -> _Rows:
    """Return the rows of one channel of a frame; `number` identifies its smooth factors.

    `lens`: (T,), shares for correcting the levels from which other levels are predicted.
    """
    level = np.where(data.usable, data.level, np.nan)
    # An unusable patch gets the level of the usable patch with the next code.
    usable = np.flatnonzero(data.usable)
    nearest = usable[np.clip(np.searchsorted(usable, np.arange(len(level))), 0, len(usable) - 1)]
    level = np.where(data.usable, level, data.level[nearest])
    model = LevelModel.of(level if lens is None else level - data.changes @ lens, data.usable, bits)
    residual = model.residual_of(level)
    expected = model.predicted
    factor = page_polynomial(cells_mm, page_mm, _FACTOR_ORDER)[:, 1:]
    shape = page_polynomial(cells_mm, page_mm, _SHAPE_ORDER)[:, 1:]
    ink = factor[:, : len(page_powers(_INK_ORDER)) - 1]
    dense = expected * np.log(np.clip(expected, 0.01, None))
    even = shape * data.even[:, None]
    smooth = np.column_stack([factor * expected[:, None], ink * dense[:, None]])
    columns = np.column_stack([data.changes, even, nonlinearity_change(expected, data.field), smooth])
    selected, folds = _by_fold(np.flatnonzero(model.is_predicted & data.usable), cells_mm, page_mm)
    common = TERMS + even.shape[1] + 3
    smooth_count = smooth.shape[1]
    shapes: npt.NDArray[np.int64] = np.arange(TERMS, common - 3, dtype=np.int64)
    return _Rows(
        value=residual[selected],
        design=model.residual(columns)[selected],
        level=expected[selected],
        folds=folds,
        unknowns=np.concatenate(
            [
                channel_terms(data.channel),
                shapes,
                np.array([common - 3 + data.channel]),
                np.arange(smooth_count, dtype=np.int64) + common + number * smooth_count,
            ]
        ),
        freedom=model.freedom,
    )


def nonlinearity_change(level: _Array, field: _Array) -> _Array:
    """Return the change of levels (N,) by nonlinearity of the sensor; 0 at white, to which the flat field is fitted."""
    return level * (1 - level) * field


def _by_fold(
    points: npt.NDArray[np.int64], places_mm: _Array, page_mm: tuple[float, float]
) -> tuple[npt.NDArray[np.int64], tuple[slice, ...]]:
    tile = np.floor(places_mm[points] / (max(page_mm) / _TILES_PER_SIDE)).astype(np.int64)
    fold = (tile[:, 0] + 2 * tile[:, 1]) % FOLDS
    order = np.argsort(fold, kind="stable")
    ends = np.searchsorted(fold[order], np.arange(FOLDS + 1)).tolist()
    return points[order], tuple(slice(start, end) for start, end in pairwise(ends))


def _reference_rows(data: ReferenceData, page_mm: tuple[float, float]) -> _Rows:
    # Smooth components are removed from values and changes, because they are part of the flat field.
    smooth = page_polynomial(data.places_mm, page_mm, data.order)
    columns = np.column_stack([data.level, data.changes, nonlinearity_change(data.level, data.field)])
    rough = columns - smooth @ np.linalg.lstsq(smooth, columns, rcond=None)[0]
    selected, folds = _by_fold(np.arange(len(rough)), data.places_mm, page_mm)
    return _Rows(
        value=rough[selected, 0],
        design=rough[selected, 1:],
        level=np.full(len(data.level), float(data.level.mean())),
        folds=folds,
        unknowns=np.append(channel_terms(data.channel), _bend_index(data.channel)),
    )


def _weights(residual: _Array, level: _Array) -> _Array:
    groups = min(_LEVEL_GROUPS, len(residual) // 8) if float(np.ptp(level)) > 0 else 1
    variance = sigma_by_level(residual, level, groups) ** 2 + 1e-12
    normalised = np.abs(residual) / np.sqrt(variance)
    weights: _Array = np.minimum(1.0, _HUBER_SIGMAS / np.maximum(normalised, 1e-9)) / variance
    return weights


def _normal_equations(rows: Sequence[_Rows], solution: _Array) -> tuple[_Array, _Array]:
    size = len(solution)
    normal, right = np.zeros((FOLDS, size, size)), np.zeros((FOLDS, size))
    for block in rows:
        root = np.sqrt(block.freedom * _weights(block.value - block.design @ solution[block.unknowns], block.level))
        weighted, value = block.design * root[:, None], block.value * root
        for fold, fold_rows in enumerate(block.folds):
            normal[fold][np.ix_(block.unknowns, block.unknowns)] += weighted[fold_rows].T @ weighted[fold_rows]
            right[fold][block.unknowns] += weighted[fold_rows].T @ value[fold_rows]
    return normal, right


def _eliminate_factors(normal: _Array, right: _Array, prior: _Array, count: int = TERMS) -> tuple[_Array, _Array]:
    full = normal + prior
    # The Schur complement eliminates all unknowns after the first `count`.
    elimination = np.linalg.solve(full[count:, count:], full[count:, :count]).T
    matrix = full[:count, :count] - elimination @ full[count:, :count]
    return 0.5 * (matrix + matrix.T), right[:count] - elimination @ right[count:]


def _solve_all(normal: _Array, right: _Array, prior: _Array, terms: npt.NDArray[np.int64]) -> _Array:
    # Solve for all unknowns; shares are 0 except for `terms`.
    shares, _ = _solve_nonnegative(*_eliminate_factors(normal, right, prior), terms)
    full = normal + prior
    solution = np.empty(len(right))
    solution[:TERMS] = shares
    solution[TERMS:] = np.linalg.solve(full[TERMS:, TERMS:], right[TERMS:] - full[TERMS:, :TERMS] @ shares)
    return solution


def _chi2_gain(matrix: _Array, vector: _Array, solution: _Array) -> float:
    return float(2 * vector @ solution - solution @ matrix @ solution)


def _solve_nonnegative(matrix: _Array, vector: _Array, terms: npt.NDArray[np.int64]) -> tuple[_Array, float]:
    """Return the least-squares shares (TERMS,), 0 except for `terms`, and the χ² gain."""
    # Far kernels and veiling glare are ≥ 0: non-negative least squares of the Cholesky factor (C. Lawson and R. Hanson,
    # Solving Least Squares Problems, 1974), after elimination of the unconstrained shares.
    shares = np.zeros(TERMS)
    signed, positive = (terms[free_terms()[terms] == is_free] for is_free in (True, False))
    inner, across = matrix[np.ix_(signed, signed)], matrix[np.ix_(signed, positive)]
    if len(positive):
        reduced = matrix[np.ix_(positive, positive)] - across.T @ np.linalg.solve(inner, across)
        right = vector[positive] - across.T @ np.linalg.solve(inner, vector[signed])
        factor = np.linalg.cholesky(0.5 * (reduced + reduced.T))
        shares[positive] = nnls(factor.T, np.linalg.solve(factor, right))[0]
    if len(signed):
        shares[signed] = np.linalg.solve(inner, vector[signed] - across @ shares[positive])
    return shares, _chi2_gain(matrix, vector, shares)


def _proven_terms(
    matrix: _Array, vector: _Array, misfit: float, candidates: list[npt.NDArray[np.int64]]
) -> npt.NDArray[np.int64]:
    """Return the unknowns of the proven kernels: the weakest kernel is dropped until all others gain enough."""
    kernels = list(candidates)
    _, gain = _solve_nonnegative(matrix, vector, _terms(kernels))
    while kernels:
        without = [
            np.concatenate([*kernels[:k], *kernels[k + 1 :], np.zeros(0, dtype=np.int64)]) for k in range(len(kernels))
        ]
        gains = [_solve_nonnegative(matrix, vector, np.sort(remaining))[1] for remaining in without]
        # By chance, each unknown gains 1 times the misfit.
        excess = [gain - less - misfit * (LEAST_GAIN + len(own) - 1) for less, own in zip(gains, kernels, strict=True)]
        weakest = int(np.argmin(excess))
        if excess[weakest] > 0:
            break
        gain = gains[weakest]
        kernels.pop(weakest)
    return _terms(kernels)


def _terms(kernels: Sequence[npt.NDArray[np.int64]]) -> npt.NDArray[np.int64]:
    return np.sort(np.concatenate([*kernels, np.zeros(0, dtype=np.int64)]))
