"""Estimate light that falls on part of the print and adds equally to dark and bright patches, such as a reflection.

The level of a patch is predicted from patches with similar codes elsewhere on the print (`calibration.spread.
predicting`). Added light is the part of the residual that is smooth over the page and not proportional to the level.
Its prior standard deviation is the candidate with the largest evidence (empirical Bayes, C. E. Rasmussen, C. K. I.
Williams, "Gaussian Processes for Machine Learning", 2006, 5.4.1). Uniform light cannot be detected here; it is measured
as veiling glare.

Arrays have C patches in the order of colour indices; levels are relative to paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.spread.predicting import LevelModel
from experiment.measures.least_squares import page_polynomial
from foundation.robust import biweight, sigma_by_level

# Number of knots along the longer side of the print. The smallest spot that they can model is an eighth of this side.
_KNOTS = 9

_FACTOR_ORDER = 4  # order of the polynomial over the page that multiplies levels, for errors of the flat field

_FACTOR_SIGMA = 0.003  # prior standard deviation of the coefficients of this polynomial; chosen by judgement

# Candidate prior standard deviations of added light, relative to paper.
_CANDIDATE_SIGMAS = (1e-5, 1e-4, 2e-4, 4e-4, 8e-4, 1.6e-3, 3.2e-3, 6.4e-3, 0.013, 0.026, 0.05)

MOST_ADDED = 0.05  # largest added light of a usable patch, relative to its level; chosen by judgement

_CERTAIN_SIGMAS = 4.0  # number of standard uncertainties to subtract, so that noise makes no patch unusable

LEAST_LEVEL = 1e-3  # lower bound of levels as divisors of relative errors

_MIN_CELLS = 200  # minimum number of usable patches for an estimate

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AddedLight:
    """Added light on each patch."""

    share: _Array  # (C, 3) relative to paper; shifted so that the fifth percentile of the patches is 0
    error: _Array  # (C, 3) standard uncertainty of `share`

    @staticmethod
    def zero(cells: int) -> AddedLight:
        """Return added light of 0 with uncertainty 0."""
        return AddedLight(np.zeros((cells, 3)), np.zeros((cells, 3)))

    def certain_share_of(self, level: _Array) -> _Array:
        """Return a lower bound of the added light, (C, 3) float64, relative to levels (C, 3)."""
        return np.maximum(self.share - _CERTAIN_SIGMAS * self.error, 0) / np.maximum(level, LEAST_LEVEL)

    @property
    def mean_square(self) -> _Array:
        """(C, 3) float64, mean square error that added light causes: its square plus its variance."""
        return self.share**2 + self.error**2


def added_light(
    level: _Array,
    variance: _Array,
    usable: npt.NDArray[np.bool_],
    cells_mm: _Array,
    page_mm: tuple[float, float],
    bits: int,
) -> AddedLight:
    """Estimate the light that is added to patches.

    `level`, `variance`: (C, 3) float64, levels of patches and variance of their noise. `usable`: (C,) bool. `cells_mm`:
    (C, 2) float64, centres of the patches.
    """
    if int(usable.sum()) < _MIN_CELLS:
        return AddedLight.zero(len(level))
    bumps = _bumps(cells_mm)
    factor = page_polynomial(cells_mm, page_mm, _FACTOR_ORDER)[:, 1:]
    result = AddedLight.zero(len(level))
    for channel in range(3):
        filled = np.where(usable, level[:, channel], np.nan)
        filled = np.where(usable, filled, np.nanmedian(filled))
        model = LevelModel.of(filled, usable, bits)
        residual = model.residual_of(filled)
        expected = model.predicted
        rows = model.is_predicted & usable
        groups = max(min(20, int(rows.sum()) // 20), 1)
        scatter = sigma_by_level(residual[rows], expected[rows], groups)
        sigma = np.sqrt(scatter**2 + variance[rows, channel])
        value = residual[rows] / sigma
        design = model.residual(np.column_stack([bumps, factor * expected[:, None]]))[rows] / sigma[:, None]
        solution, covariance = _most_likely(value, design, bumps.shape[1])
        # Dust, folds and clipped patches get low weights, so that they are not mistaken for added light.
        weight = biweight(np.abs(value - design[:, : bumps.shape[1]] @ solution), 1.0)
        solution, covariance = _most_likely(value * weight, design * weight[:, None], bumps.shape[1])
        share = bumps @ solution
        result.share[:, channel] = share - np.quantile(share[usable], 0.05)
        result.error[:, channel] = np.sqrt(np.einsum("ck,kl,cl->c", bumps, covariance, bumps))
    return result


def _bumps(centres_mm: _Array) -> _Array:
    low, high = centres_mm.min(axis=0), centres_mm.max(axis=0)
    step = float((high - low).max()) / (_KNOTS - 1)
    axes: list[_Array] = [np.linspace(a, b, max(round((b - a) / step), 1) + 1) for a, b in zip(low, high, strict=True)]
    # Each bump is a Gaussian with σ equal to the distance between knots.
    x, y = (np.exp(-0.5 * ((centres_mm[:, n, None] - axes[n]) / step) ** 2) for n in range(2))
    return (y[:, :, None] * x[:, None, :]).reshape(len(centres_mm), -1)


def _most_likely(value: _Array, design: _Array, bumps: int) -> tuple[_Array, _Array]:
    """Return the heights (K,) of the bumps and their covariance, for the prior with the largest evidence."""
    normal, right = design.T @ design, design.T @ value
    best_evidence, heights, best_covariance = -np.inf, np.zeros(bumps), np.zeros((bumps, bumps))
    for sigma in _CANDIDATE_SIGMAS:
        prior = np.full(len(right), _FACTOR_SIGMA**-2)
        prior[:bumps] = sigma**-2
        matrix = normal + np.diag(prior)
        covariance: _Array = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
        solution: _Array = covariance @ right
        evidence = 0.5 * (float(right @ solution) - float(np.linalg.slogdet(matrix)[1]) + float(np.log(prior).sum()))
        if evidence > best_evidence:
            best_evidence, heights, best_covariance = evidence, solution[:bumps], covariance[:bumps, :bumps]
    return heights, best_covariance
