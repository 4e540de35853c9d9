"""Predict the level of a patch from patches with similar codes.

The residual, measured minus predicted level, is noise or light from the surroundings of the patch. The colours of a
chart are in random order, so patches with similar codes are elsewhere on the print.

- Charts with four or five bits per channel: the prediction is the mean of both neighbours along each axis of the code.
- Charts with three bits have too few codes for that. The square root of the level is modelled as a random function of
  the codes (kriging; C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, 2.2), because
  halftones mix almost linearly in the square root (J. A. C. Yule, W. J. Nielsen, "The penetration of light into paper",
  1951). The function also depends on the largest of the three codes: printers replace the common part of three inks by
  black, so the slope of levels changes where another ink becomes the smallest. The ratio of noise to function is the
  most likely of some candidates (Rasmussen and Williams, 5.4.1).

Arrays have C patches in the order of colour indices; levels are relative to paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.ndimage import uniform_filter

from calibration import kernels

# Bits per channel of a full chart. The curvature of levels between its codes is below the noise of a patch.
FULL_BITS = 5

VARYING_BITS = 4  # minimum bits per channel for prediction by neighbours; other charts have few colours

# Side of a square of codes perpendicular to an axis. The curvature along the axis is averaged over this square.
_PLANE_SIDE = 5

# Length scale of the random function, in code steps of a chart with three bits. Chosen by judgement: fitted values are
# 7 to 20.
_LENGTH_SCALE = 16.0

_NOISE_CANDIDATES = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1)  # candidates for the ratio of noise to function

_EQUAL_NOISE_LEVEL = 0.02  # level at which read noise and photon noise are equal; chosen by judgement

_MIN_LEVEL = 1e-3  # lower bound of levels before the square root is taken

# Variance that stands for an unknown value: prior of the linear part of the function, and noise of unusable patches.
_UNKNOWN_VARIANCE = 1e4

_OUTLIER_SIGMAS = 4.0  # a patch with a larger residual, in standard deviations, is not used for predicting others

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LevelModel:
    """Prediction of the levels of patches from other patches."""

    bits: int
    is_predicted: _Mask  # (C,) patches with a prediction from other patches
    freedom: float  # ratio of residual variance to noise variance
    predicted: _Array  # (C,) predicted levels; measured levels if there is no prediction
    _residual_matrix: _Array | None  # (C, C) from square roots to residuals; None: prediction by neighbours

    @staticmethod
    def of(level: _Array, usable: _Mask, bits: int) -> LevelModel:
        """Return the model of levels (C,) float64 with usable patches (C,) bool."""
        if bits >= VARYING_BITS:
            predicted = level - neighbour_residual(level[:, None], bits)[:, 0]
            return LevelModel(bits, _has_neighbours(bits), 1.0, predicted, None)
        root = _root(level)
        matrix, noise = _residual_matrix_of(root, usable, bits)
        freedom = np.diag(matrix)
        # The factor makes the prediction independent of the noise of the patch itself.
        factor = freedom * noise / (matrix**2 @ noise)
        predicted = np.maximum(root - factor * (matrix @ root), _MIN_LEVEL**0.5) ** 2
        return LevelModel(bits, np.ones(len(level), dtype=np.bool_), float(freedom[usable].mean()), predicted, matrix)

    def residual(self, columns: _Array) -> _Array:
        """Return the residuals (C, M) float64 that small changes of levels, (C, M), cause; linear in the changes."""
        if self._residual_matrix is None:
            return neighbour_residual(columns, self.bits)
        slope = 2 * np.sqrt(self.predicted)[:, None]
        return slope * (self._residual_matrix @ (columns / slope))

    def residual_of(self, level: _Array) -> _Array:
        """Return the residuals (C,) float64 of levels (C,): the part that codes do not predict."""
        if self._residual_matrix is None:
            return neighbour_residual(level[:, None], self.bits)[:, 0]
        return 2 * np.sqrt(self.predicted) * (self._residual_matrix @ _root(level))


def _root(level: _Array) -> _Array:
    return np.sqrt(np.maximum(level, _MIN_LEVEL))


def neighbour_residual(columns: npt.NDArray[np.floating], bits: int) -> _Array:
    """Return measured values of patches minus predictions from neighbouring codes; linear in the values.

    The prediction is the mean of both neighbours along each axis of the code. On charts with fewer than 32 codes per
    axis, it is corrected for curvature along the axis, which is averaged over the surrounding codes.

    `columns`: (C, M), values of C = 8**bits patches in the order of colour indices. Returns (C, M) float64; 0 for
    patches that do not have two neighbours along any axis.
    """
    side = 1 << bits
    if bits < FULL_BITS:
        return _residual_without_curvature(columns, side)
    residual = np.empty(columns.shape)
    kernels.colour_differences(np.ascontiguousarray(columns, dtype=np.float64), side, residual)
    return residual


def _has_neighbours(bits: int) -> _Mask:
    side = 1 << bits
    codes = np.arange(side**3)
    # two neighbours along an axis
    inner = [(codes // side**axis % side > 0) & (codes // side**axis % side < side - 1) for axis in range(3)]
    return np.any(inner, axis=0)


def _residual_without_curvature(columns: npt.NDArray[np.floating], side: int) -> _Array:
    cube = np.asarray(columns, dtype=np.float64).reshape(side, side, side, -1)
    total, count = np.zeros_like(cube), np.zeros((side, side, side, 1))
    for axis in range(3):
        inner, previous, following = (
            (*(slice(None),) * axis, indices) for indices in (slice(1, side - 1), slice(0, side - 2), slice(2, side))
        )
        difference = cube[inner] - 0.5 * (cube[previous] + cube[following])
        window = [1 if dimension == axis else _PLANE_SIDE for dimension in range(3)]
        # The mean over the surrounding codes excludes the patch itself.
        total[inner] += (difference - uniform_filter(difference, [*window, 1], mode="nearest")) / (
            1 - 1 / _PLANE_SIDE**2
        )
        count[inner] += 1
    return (total / np.maximum(count, 1)).reshape(columns.shape)


@lru_cache(maxsize=2)
def _covariance(bits: int) -> _Array:
    """Return the covariance (C, C) of the square roots of levels without noise; cached, do not modify."""
    side = 1 << bits
    codes = np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1).astype(np.float64)
    # The largest code is a fourth feature: the slope changes where another ink becomes the smallest.
    features = np.column_stack([codes, codes.max(axis=1)])
    distance = np.sqrt(5 * ((features[:, None] - features) ** 2).sum(axis=-1)) / _LENGTH_SCALE
    linear = np.column_stack([np.ones(len(features)), features - (side - 1) / 2])
    # Matérn's covariance, 5/2 (Rasmussen and Williams, 4.2.1).
    covariance: _Array = (1 + distance + distance**2 / 3) * np.exp(-distance) + _UNKNOWN_VARIANCE * linear @ linear.T
    covariance.flags.writeable = False
    return covariance


def _residual_matrix_of(root: _Array, usable: _Mask, bits: int) -> tuple[_Array, _Array]:
    """Return the matrix (C, C) from square roots (C,) to residuals, and the relative noise variance (C,)."""
    return _cached_residual_matrix(root.tobytes(), usable.tobytes(), bits)


# The results are cached; do not modify them.
@lru_cache(maxsize=6)
def _cached_residual_matrix(root_bytes: bytes, usable_bytes: bytes, bits: int) -> tuple[_Array, _Array]:
    root, usable = np.frombuffer(root_bytes), np.frombuffer(usable_bytes, dtype=np.bool_)
    prior = _covariance(bits)
    noise = (1 + _EQUAL_NOISE_LEVEL / np.maximum(root, 0.1) ** 2) * np.where(usable, 1.0, _UNKNOWN_VARIANCE)
    inverse, noise_share = _invert_likeliest(prior, noise, root)
    precision = np.diag(inverse)
    weighted = inverse @ root
    scale = float(np.sqrt(np.mean(weighted[usable] ** 2 / precision[usable])))
    outliers = np.abs(weighted) > _OUTLIER_SIGMAS * scale * np.sqrt(precision)
    if outliers.any():
        noise = np.where(outliers, _UNKNOWN_VARIANCE, noise)
        inverse, noise_share = _invert_likeliest(prior, noise, root, noise_share)
    matrix = noise_share**2 * noise[:, None] * inverse
    matrix.flags.writeable = noise.flags.writeable = False
    return matrix, noise


def _invert_likeliest(prior: _Array, noise: _Array, root: _Array, *shares: float) -> tuple[_Array, float]:
    """Return the inverse covariance (C, C) with the likeliest noise of `shares` or the candidates, and this noise."""
    candidates: list[tuple[float, float, _Array]] = []
    for share in shares or _NOISE_CANDIDATES:
        # The matrix is symmetric, so the transpose is a copy in LAPACK's order.
        covariance = prior.T.copy(order="F")
        covariance[np.diag_indices_from(covariance)] += share**2 * noise
        factor: _Array = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        inner = solve_triangular(factor, root, lower=True, check_finite=False)
        scale = float(inner @ inner) / len(root)
        candidates.append((0.5 * len(root) * np.log(scale) + float(np.log(np.diag(factor)).sum()), share, factor))
    _, share, factor = min(candidates, key=lambda candidate: candidate[:2])
    # LAPACK's inversion of a factored matrix fills one triangle only.
    inverse: _Array = lapack.dpotri(factor, lower=1)[0]
    inverse += np.tril(inverse, -1).T
    return inverse, share
