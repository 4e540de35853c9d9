"""Measure the linearity of the sensor by flux superposition: compare an illuminant with red, green and blue alone.

The light of a patch under several primaries is a weighted sum: the light under each primary alone is multiplied by the
amount of this primary. Counts of a linear sensor add in the same way. They do not add if there is compression near
saturation, loss near black or a wrong black level. The patches cover all levels from black ink to paper, so four frames
show the whole curve. Chart, lens and photosite response do not matter, because the same photosites are compared. Lamp
changes between frames do not matter, because the amounts of the primaries are fitted as well. This is the superposition
or flux-addition method of detector calibration (C. L. Sanders, Applied Optics 1, 1962).

A factor common to all counts cannot be measured, and has no effect on chromaticities.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from experiment.measures.least_squares import code_polynomial
from foundation.robust import huber_weights, sigma_by_level

# Levels, relative to saturation, at which the deviation is fitted. It is interpolated between them, and 0 at black.
NODES = (0.001, 0.003, 0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 1.0)

# Prior standard deviation of the relative deviation at saturation: EMVA 1288 linearity errors of raw files are below
# 1 %.
_USUAL_BEND = 0.01

# Prior standard deviation of the counts lost or gained near black, relative to saturation: some counts of 14 bits.
_USUAL_LOSS = 0.0005

_LOSS_SCALES = (0.0005, 0.002)  # levels at which this loss reaches 63 %, relative to saturation

_USUAL_REST = 0.0003  # prior standard deviation of deviations of any other shape, relative to the level

_PRIOR_SCALES = (0.03, 0.3, 1.0, 3.0, 10.0)  # candidate factors of these priors, with equal prior odds

_LEAST_PATCHES = 100  # minimum number of patches; chosen by judgement

_CODE_DEGREE = 4  # degree of the polynomial in the codes that predicts patches without noise

_FREE_SD = 10.0  # prior standard deviation of the amount of a primary, if nothing is known about it

# Prior standard deviation of the difference between channels in the amount of a primary, whose spectrum hardly changes.
_CHANNEL_SD = 0.001

# Models of full white: standard deviation of the amounts of the primaries, of their differences between channels, and
# prior odds. First model: white is the sum of the primaries. Second: the exposures are no whole number of turns of a
# colour wheel. Third: a projector that boosts white adds light of another spectrum. Chosen by judgement.
_WHITE_MODELS = (
    (0.003, _CHANNEL_SD, 0.6),
    (0.05, _CHANNEL_SD, 0.3),
    (_FREE_SD, _FREE_SD, 0.1),
)

_GROUPS = 12  # number of groups of similar levels for measuring the scatter

_ROUNDS = 3  # number of solutions, each weighted and linearised by the previous one

_AMOUNT_COUNT = 12  # number of unknowns before the nodes: amount of each primary, and its difference in each channel

_Array = npt.NDArray[np.float64]


_GIVE_SERIES = "give a series of exposures of the chart with --linearity"


@dataclass(frozen=True)
class Unmeasured:
    """Reason for a missing linearity measurement, and the remedy."""

    why: str
    remedy: str


NO_PRIMARIES = Unmeasured(
    "the session has no illuminants of each primary alone",
    f"plan red, green and blue each alone, as acquire illuminations does, or {_GIVE_SERIES}",
)
MOVED = Unmeasured(
    "the chart moved between the frames of the primaries and the first registered frame",
    f"keep chart and camera in place, or {_GIVE_SERIES}",
)


@dataclass(frozen=True, eq=False)
class Superposition:
    """Deviation of counts from proportionality to light, with its uncertainty."""

    full: float  # counts above black level at saturation
    deviation: _Array  # (K,) counts at `NODES`, measured minus proportional
    covariance: _Array  # (K, K) counts²
    unmeasured: Unmeasured | None  # reason for assuming usual deviations; None: measured

    @staticmethod
    def usual(full: float, unmeasured: Unmeasured = NO_PRIMARIES) -> Superposition:
        """Return usual deviations of cameras, for a session without a measurement."""
        return Superposition(full, np.zeros(len(NODES)), _usual_covariance(full), unmeasured)

    @property
    def measured(self) -> bool:
        """Whether frames show the deviation."""
        return self.unmeasured is None

    def relative(self, level: _Array) -> tuple[_Array, _Array]:
        """Return the relative deviation (...) at levels (...), counts above black level, and its weights (..., K)."""
        weights = _hats(level / self.full) / np.maximum(level, 1e-9)[..., None]
        return weights @ self.deviation, weights

    def errors(self, level: _Array, reference: _Array) -> _Array:
        """Return the mean square (...) of the relative error of levels (...) against references; shapes broadcast."""
        # Counts are not corrected for the deviation, so its full size is an error.
        deviation, variance = self.difference(level, reference)
        return deviation**2 + variance

    def difference(self, level: _Array, reference: _Array) -> tuple[_Array, _Array]:
        """Return the relative deviation (...) of levels minus references, and its variance."""
        (deviation, weights), (reference_deviation, reference_weights) = self.relative(level), self.relative(reference)
        weights = weights - reference_weights
        return deviation - reference_deviation, np.einsum("...k,kl,...l->...", weights, self.covariance, weights)

    def white_covariance(self, white: _Array) -> _Array:
        """Return the mean square (L, 3, 3) float64 of the relative error of whites (L, 3), counts."""
        deviation, weights = self.relative(white)
        chromatic = deviation - deviation.mean(axis=1, keepdims=True)
        return weights @ self.covariance @ np.swapaxes(weights, 1, 2) + chromatic[:, :, None] * chromatic[:, None, :]

    def to_json(self) -> dict[str, Any]:
        """Return the values for `report.json`, each divided by the level of its node."""
        level = np.array(NODES) * self.full
        shares = {"deviation": self.deviation / level, "standard_error": np.sqrt(np.diag(self.covariance)) / level}
        rounded = {name: [float(f"{value:.4g}") for value in values.tolist()] for name, values in shares.items()}
        return {"measured": self.measured, "level_share": list(NODES), **rounded}


def superposition(
    alone: Sequence[_Array],
    together: _Array,
    full: float,
    usable: npt.NDArray[np.bool_],
    predictors: _Array,
    white: bool,
) -> Superposition:
    """Measure the linearity from an illuminant and its primaries; usual deviations if there are too few patches.

    Parameters
    ----------
    alone : three (P, 3) float64
        Counts above black level of patches under red, green and blue alone, not corrected for dark light.
    together : (P, 3) float64
        The same under the illuminant.
    full : float
        Counts above black level at saturation.
    usable : (P,) bool
        Patches inside the frames that are not clipped or covered.
    predictors : (P, M) float64
        Functions of the printed codes that predict levels without noise (`printed_predictors`).
    white : bool
        Whether the illuminant is full white.
    """
    patches, needed = int(usable.sum()), max(_LEAST_PATCHES, 2 * predictors.shape[1])
    if patches < needed:
        why = f"the chart has {patches} usable patches, {needed} or more expected"
        return Superposition.usual(full, Unmeasured(why, f"use a chart with more colours, or {_GIVE_SERIES}"))
    levels, predictors = np.stack([together, *alone])[:, usable], predictors[usable]
    hats, size = _hats(levels / full), _AMOUNT_COUNT + len(NODES)
    whites = _WHITE_MODELS if white else ((_FREE_SD, _FREE_SD, 1.0),)
    priors = [(_prior(full, scale, *sigmas), odds) for scale, (*sigmas, odds) in product(_PRIOR_SCALES, whites)]
    # The unknowns are small differences from this start. With the full amounts, rounding errors would hide the
    # differences of the evidence between priors.
    start = np.zeros(size)
    start[:3] = 1.0 if white else np.linalg.lstsq(levels[1:].reshape(3, -1).T, levels[0].ravel(), rcond=None)[0]
    solution, covariance = start, np.zeros((size, size))
    for _ in range(_ROUNDS):
        matrix, right, misfit = np.zeros((size, size)), np.zeros(size), 1.0
        for channel in range(3):
            own = slice(3 + 3 * channel, 6 + 3 * channel)
            amounts = solution[:3] + solution[own]
            value, primaries = levels[0, :, channel], levels[1:, :, channel].T
            # Corrected counts are proportional: value - m(value) = sum of amount (primary - m(primary)).
            bend = hats[0, :, channel] - np.einsum("k,kpn->pn", amounts, hats[1:, :, channel])
            design = np.zeros((len(value), size))
            design[:, :3], design[:, own], design[:, _AMOUNT_COUNT:] = primaries, primaries, bend
            residual = value - design @ solution
            sigma = sigma_by_level(residual, value, _GROUPS) + 1e-9
            root = huber_weights(np.abs(residual) / sigma, 1.0) / sigma
            # The frames of primaries have noise; their prediction from the codes has none (two-stage least squares).
            rows, weighted = root[:, None] * predictors, root[:, None] * design
            projected = rows @ np.linalg.lstsq(rows, weighted, rcond=None)[0]
            matrix += projected.T @ projected
            right += projected.T @ (root * (value - design @ start))
            misfit = max(misfit, _misfit(rows, root * residual))
        difference, covariance = _posterior(matrix / misfit, right / misfit, priors)
        solution = start + difference
    return Superposition(full, solution[_AMOUNT_COUNT:], covariance[_AMOUNT_COUNT:, _AMOUNT_COUNT:], None)


def _posterior(matrix: _Array, right: _Array, priors: Sequence[tuple[_Array, float]]) -> tuple[_Array, _Array]:
    """Return mean (U,) and covariance (U, U) of the unknowns, averaged over priors weighted by evidence."""
    # Bayesian model averaging (J. A. Hoeting and others, Statistical Science 14, 1999). The usual prior has most weight
    # if the deviation is small, and wide priors have most weight if the patches show a large deviation.
    covariances: list[_Array] = []
    means: list[_Array] = []
    evidence = np.zeros(len(priors))
    for number, (prior, odds) in enumerate(priors):
        # Scale the diagonal to 1: amounts and counts near black differ by ten orders of magnitude.
        size = np.sqrt(np.diag(matrix + prior))
        scaled = (matrix + prior) / np.outer(size, size)
        covariance: _Array = np.linalg.inv(scaled) / np.outer(size, size)
        mean: _Array = np.linalg.solve(scaled, right / size) / size
        log_determinant = np.linalg.slogdet(scaled)[1] + 2 * np.log(size).sum()
        evidence[number] = 0.5 * (right @ mean - log_determinant + np.linalg.slogdet(prior)[1]) + np.log(odds)
        covariances.append(covariance)
        means.append(mean)
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    mean = np.einsum("m,mu->u", weights, means)
    delta = np.array(means) - mean
    return mean, np.einsum("m,muv->uv", weights, covariances) + np.einsum("m,mu,mv->uv", weights, delta, delta)


def printed_predictors(codes: npt.ArrayLike, references: npt.NDArray[np.integer]) -> _Array:
    """Return predictors (C + N, M) float64 of patches and references, for `superposition`.

    `codes`: (C, 3) int, 0 … 255. `references`: (N,) int, index of the colour of each reference, from 0.
    """
    patches = code_polynomial(codes, _CODE_DEGREE)
    reference_colours = np.eye(int(references.max(initial=-1)) + 1)[references]
    zeros = np.zeros((len(patches), reference_colours.shape[1])), np.zeros((len(reference_colours), patches.shape[1]))
    return np.block([[patches, zeros[0]], [zeros[1], reference_colours]])


def _prior(full: float, scale: float, amount_sd: float, channel_sd: float) -> _Array:
    # Inverse of the prior covariance of all unknowns; arguments as in `_WHITE_MODELS`.
    prior = np.zeros((_AMOUNT_COUNT + len(NODES), _AMOUNT_COUNT + len(NODES)))
    prior[:3, :3] = np.linalg.inv(_FREE_SD**2 * np.ones((3, 3)) + amount_sd**2 * np.eye(3))
    prior[3:_AMOUNT_COUNT, 3:_AMOUNT_COUNT] = np.eye(_AMOUNT_COUNT - 3) / channel_sd**2
    prior[_AMOUNT_COUNT:, _AMOUNT_COUNT:] = np.linalg.inv(scale**2 * _usual_covariance(full))
    return prior


def _usual_covariance(full: float) -> _Array:
    """Return the prior covariance (K, K) float64 counts²: curvature of all counts, and loss near black."""
    level = np.array(NODES)
    bends = [_USUAL_BEND * level**2, _USUAL_BEND * level**3]
    losses = [_USUAL_LOSS * (1 - np.exp(-level / scale)) for scale in _LOSS_SCALES]
    # The straight part of a shape cannot be distinguished from the amounts of the primaries, so it is removed.
    shapes = [shape - level * float((shape / level).mean()) for shape in (*bends, *losses)]
    covariance: _Array = full**2 * (
        np.sum([np.outer(shape, shape) for shape in shapes], axis=0) + np.diag(_USUAL_REST * level) ** 2
    )
    return covariance


def _hats(share: _Array) -> _Array:
    # weights (..., K) of linear interpolation between the nodes, 0 at black
    nodes = np.array([0.0, *NODES])
    inside = np.clip(share, 0, nodes[-1])
    right = np.clip(np.searchsorted(nodes, inside, side="right"), 1, len(nodes) - 1)
    fraction = (inside - nodes[right - 1]) / (nodes[right] - nodes[right - 1])
    weights = np.zeros((*share.shape, len(nodes)))
    np.put_along_axis(weights, right[..., None], fraction[..., None], axis=-1)
    np.put_along_axis(weights, right[..., None] - 1, 1 - fraction[..., None], axis=-1)
    return weights[..., 1:]


def _misfit(predictors: _Array, residual: _Array) -> float:
    # χ² per predictor of the part of the residual that the predictors explain, at least 1.
    explained = predictors @ np.linalg.lstsq(predictors, residual, rcond=None)[0]
    return max(1.0, float(explained @ explained) / predictors.shape[1])
