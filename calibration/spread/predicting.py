"""Predict the level of a patch from patches with similar codes; the residual is noise or light from its surroundings.

The colours of a chart are in random order, so patches with similar codes are elsewhere on the print.

- Charts of four or five bits: the mean of both neighbours along each axis of the code predicts the level of a patch.
- Charts of three bits: 512 codes are too few for that. The square root of the level, in which halftones mix almost
  linearly (J. A. C. Yule, W. J. Nielsen, "The penetration of light into paper", 1951), is a random function of the
  codes (kriging; C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, 2.2). It also
  depends on the largest of the three codes: printers replace the common part of three inks by black, so levels bend at
  colours where the least ink changes. The ratio of roughness to noise maximises the likelihood (5.4.1).

C patches in the order of colour indices; levels are relative to paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.ndimage import uniform_filter

from calibration import kernels

# Bits of a full chart: the curvature between its codes is below the noise of a patch.
FULL_BITS = 5

VARYING_BITS = 4  # minimum bits per channel for prediction by neighbours alone

_WIDTH = 5  # width in codes of the square, perpendicular to an axis, for the mean curvature along the axis

# Length scale of the square root of a level, in steps of a chart of three bits (judgement; fitted values are 7 to 20).
_REACH = 16.0

_NOISES = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1)  # noise relative to the function, to choose from

_DARK = 0.02  # level with equal read noise and shot noise (judgement)

_LEAST_LEVEL = 1e-3  # lower bound of levels under the square root

_UNKNOWN = 1e4  # prior variance of the linear part and noise of unusable patches: no information

_OUTLIER = 4.0  # standard deviations beyond which a patch is not used for predicting others

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LevelModel:
    """Prediction of the levels of patches from other patches."""

    bits: int
    known: _Mask  # (C,) patches that are predicted by others
    freedom: float  # ratio of residual variance to noise variance
    predicted: _Array  # (C,) levels from the codes; the patch's own level without a prediction
    _residual_matrix: _Array | None  # (C, C) residual matrix of the random function; None: prediction by neighbours

    @staticmethod
    def of(level: _Array, usable: _Mask, bits: int) -> LevelModel:
        """Return the model of levels (C,) float64 with usable patches (C,) bool."""
        if bits >= VARYING_BITS:
            predicted = level - neighbour_residual(level[:, None], bits)[:, 0]
            return LevelModel(bits, _has_neighbours(bits), 1.0, predicted, None)
        root = _root(level)
        matrix, noise = _residual_matrix_of(root, usable, bits)
        freedom = np.diag(matrix)
        # Subtract as much of the residual as makes the prediction independent of its noise.
        factor = freedom * noise / (matrix**2 @ noise)
        predicted = np.maximum(root - factor * (matrix @ root), _LEAST_LEVEL**0.5) ** 2
        return LevelModel(bits, np.ones(len(level), dtype=np.bool_), float(freedom[usable].mean()), predicted, matrix)

    def residual(self, columns: _Array) -> _Array:
        """Return the unpredicted part of small values (C, M) float64 that are added to levels; linear in them."""
        if self._residual_matrix is None:
            return neighbour_residual(columns, self.bits)
        slope = 2 * np.sqrt(self.predicted)[:, None]
        return slope * (self._residual_matrix @ (columns / slope))

    def residual_of(self, level: _Array) -> _Array:
        """Return the unpredicted part of levels (C,) float64."""
        if self._residual_matrix is None:
            return neighbour_residual(level[:, None], self.bits)[:, 0]
        return 2 * np.sqrt(self.predicted) * (self._residual_matrix @ _root(level))


def _root(level: _Array) -> _Array:
    return np.sqrt(np.maximum(level, _LEAST_LEVEL))


def neighbour_residual(columns: npt.NDArray[np.floating], bits: int) -> _Array:
    """Return the difference of patch values from the prediction by neighbouring codes; linear in the values.

    The prediction is the mean of both neighbours along each axis of the code. With fewer than the 32 levels of a full
    chart, it is corrected for curvature: the mean over the surrounding codes perpendicular to the axis.

    `columns`: (C, M), values of C = 8**bits patches in the order of colour indices. Returns (C, M) float64, 0 for
    patches without two neighbours along any axis.
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
        window = [1 if dimension == axis else _WIDTH for dimension in range(3)]
        # Mean over the surrounding codes without the patch itself.
        total[inner] += (difference - uniform_filter(difference, [*window, 1], mode="nearest")) / (1 - 1 / _WIDTH**2)
        count[inner] += 1
    return (total / np.maximum(count, 1)).reshape(columns.shape)


@lru_cache(maxsize=2)
def _covariance(bits: int) -> _Array:
    """Return the covariance (C, C) of the square roots of levels without noise; cached, do not modify."""
    side = 1 << bits
    codes = np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1).astype(np.float64)
    # The largest code adds bends where the least ink changes.
    features = np.column_stack([codes, codes.max(axis=1)])
    distance = np.sqrt(5 * ((features[:, None] - features) ** 2).sum(axis=-1)) / _REACH
    linear = np.column_stack([np.ones(len(features)), features - (side - 1) / 2])
    # Matérn's covariance, 5/2 (Rasmussen and Williams, 4.2.1).
    covariance: _Array = (1 + distance + distance**2 / 3) * np.exp(-distance) + _UNKNOWN * linear @ linear.T
    covariance.flags.writeable = False
    return covariance


def _residual_matrix_of(root: _Array, usable: _Mask, bits: int) -> tuple[_Array, _Array]:
    """Return the matrix (C, C) from square roots (C,) to residuals of the function, and the noise variance."""
    return _cached_residual_matrix(root.tobytes(), usable.tobytes(), bits)


# Cached: the same three channels are requested repeatedly. Do not modify the result.
@lru_cache(maxsize=6)
def _cached_residual_matrix(roots: bytes, usables: bytes, bits: int) -> tuple[_Array, _Array]:
    root, usable = np.frombuffer(roots), np.frombuffer(usables, dtype=np.bool_)
    function = _covariance(bits)
    noise = (1 + _DARK / np.maximum(root, 0.1) ** 2) * np.where(usable, 1.0, _UNKNOWN)
    inverse, noise_share = _likeliest(function, noise, root)
    precision = np.diag(inverse)
    weighted = inverse @ root
    size = float(np.sqrt(np.mean(weighted[usable] ** 2 / precision[usable])))
    outliers = np.abs(weighted) > _OUTLIER * size * np.sqrt(precision)
    if outliers.any():
        noise = np.where(outliers, _UNKNOWN, noise)
        inverse, noise_share = _likeliest(function, noise, root, noise_share)
    matrix = noise_share**2 * noise[:, None] * inverse
    matrix.flags.writeable = noise.flags.writeable = False
    return matrix, noise


def _likeliest(function: _Array, noise: _Array, root: _Array, *shares: float) -> tuple[_Array, float]:
    """Return the inverse (C, C) of the covariance with the most likely noise share, and this share."""
    candidates: list[tuple[float, float, _Array]] = []
    for share in shares or _NOISES:
        # The matrix is symmetric, so the transpose is a copy in LAPACK's order.
        covariance = function.T.copy(order="F")
        covariance[np.diag_indices_from(covariance)] += share**2 * noise
        factor: _Array = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        inner = solve_triangular(factor, root, lower=True, check_finite=False)
        size = float(inner @ inner) / len(root)
        candidates.append((0.5 * len(root) * np.log(size) + float(np.log(np.diag(factor)).sum()), share, factor))
    _, share, factor = min(candidates, key=lambda candidate: candidate[:2])
    # LAPACK inverts a factored matrix in a quarter of the time of a general solution; the other triangle stays 0.
    inverse: _Array = lapack.dpotri(factor, lower=1)[0]
    inverse += np.tril(inverse, -1).T
    return inverse, share
