"""Predict the level of a patch from patches with similar codes; the residual is noise or light from its surroundings.

The colours of a chart are in random order, so patches with similar codes are elsewhere on the print.

- Charts of four or five bits: the mean of both neighbours along each axis of the code predicts the level of a patch.
- Charts of three bits: 512 codes are too few for that. The square root of the level, in which halftones mix almost
  linearly (J. A. C. Yule, W. J. Nielsen, "The penetration of light into paper", 1951), is modelled as a random function
  of the codes (kriging; C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, 2.2). It
  also depends on the largest of the three codes: printers replace the common part of three inks by black, so the slope
  of levels changes where another ink becomes the smallest. The ratio of noise to function is the likeliest (5.4.1).

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

# Bits of a full chart: the curvature between its codes is below the noise of a patch.
FULL_BITS = 5

VARYING_BITS = 4  # minimum bits per channel for prediction by neighbours alone

_WIDTH = 5  # side of the square, in codes, perpendicular to an axis, over which curvature along the axis is averaged

# Length scale of the square root of a level, in steps of a chart of three bits (judgement; fitted values are 7 to 20).
_REACH = 16.0

_NOISES = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1)  # candidates of the noise relative to the function

_DARK = 0.02  # level at which read noise and photon noise are equal (judgement)

_LEAST_LEVEL = 1e-3  # lower bound of levels under the square root

_UNKNOWN = 1e4  # prior variance of the linear part, and noise of unusable patches: so large that both are unknown

_OUTLIER = 4.0  # standard deviations beyond which a patch is not used for predicting others

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LevelModel:
    """Prediction of the levels of patches from other patches."""

    bits: int
    is_predicted: _Mask  # (C,) patches with a prediction from other patches
    freedom: float  # ratio of residual variance to noise variance
    predicted: _Array  # (C,) levels predicted from the codes; the measured level if there is no prediction
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
        # Subtract so much of the residual that the prediction is independent of the patch's own noise.
        factor = freedom * noise / (matrix**2 @ noise)
        predicted = np.maximum(root - factor * (matrix @ root), _LEAST_LEVEL**0.5) ** 2
        return LevelModel(bits, np.ones(len(level), dtype=np.bool_), float(freedom[usable].mean()), predicted, matrix)

    def residual(self, columns: _Array) -> _Array:
        """Return the part of small additions to levels, (C, M) float64, that codes do not predict; linear in them."""
        if self._residual_matrix is None:
            return neighbour_residual(columns, self.bits)
        slope = 2 * np.sqrt(self.predicted)[:, None]
        return slope * (self._residual_matrix @ (columns / slope))

    def residual_of(self, level: _Array) -> _Array:
        """Return the part of levels (C,) float64 that codes do not predict."""
        if self._residual_matrix is None:
            return neighbour_residual(level[:, None], self.bits)[:, 0]
        return 2 * np.sqrt(self.predicted) * (self._residual_matrix @ _root(level))


def _root(level: _Array) -> _Array:
    return np.sqrt(np.maximum(level, _LEAST_LEVEL))


def neighbour_residual(columns: npt.NDArray[np.floating], bits: int) -> _Array:
    """Return the difference of patch values from the prediction by neighbouring codes; linear in the values.

    The prediction is the mean of both neighbours along each axis of the code. If the chart has fewer than 32 codes per
    axis, it is corrected by the mean curvature of the surrounding codes perpendicular to the axis.

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
    # The largest code adds changes of slope where another ink becomes the smallest.
    features = np.column_stack([codes, codes.max(axis=1)])
    distance = np.sqrt(5 * ((features[:, None] - features) ** 2).sum(axis=-1)) / _REACH
    linear = np.column_stack([np.ones(len(features)), features - (side - 1) / 2])
    # Matérn's covariance, 5/2 (Rasmussen and Williams, 4.2.1).
    covariance: _Array = (1 + distance + distance**2 / 3) * np.exp(-distance) + _UNKNOWN * linear @ linear.T
    covariance.flags.writeable = False
    return covariance


def _residual_matrix_of(root: _Array, usable: _Mask, bits: int) -> tuple[_Array, _Array]:
    """Return the matrix (C, C) that multiplies square roots (C,) to residuals, and the noise variance (C,)."""
    return _cached_residual_matrix(root.tobytes(), usable.tobytes(), bits)


# Cached: the same three channels are requested repeatedly. Do not modify the result.
@lru_cache(maxsize=6)
def _cached_residual_matrix(root_bytes: bytes, usable_bytes: bytes, bits: int) -> tuple[_Array, _Array]:
    root, usable = np.frombuffer(root_bytes), np.frombuffer(usable_bytes, dtype=np.bool_)
    prior = _covariance(bits)
    noise = (1 + _DARK / np.maximum(root, 0.1) ** 2) * np.where(usable, 1.0, _UNKNOWN)
    inverse, noise_share = _invert_likeliest(prior, noise, root)
    precision = np.diag(inverse)
    weighted = inverse @ root
    scale = float(np.sqrt(np.mean(weighted[usable] ** 2 / precision[usable])))
    outliers = np.abs(weighted) > _OUTLIER * scale * np.sqrt(precision)
    if outliers.any():
        noise = np.where(outliers, _UNKNOWN, noise)
        inverse, noise_share = _invert_likeliest(prior, noise, root, noise_share)
    matrix = noise_share**2 * noise[:, None] * inverse
    matrix.flags.writeable = noise.flags.writeable = False
    return matrix, noise


def _invert_likeliest(prior: _Array, noise: _Array, root: _Array, *shares: float) -> tuple[_Array, float]:
    """Return the inverse covariance (C, C) for the likeliest noise share of `shares` or `_NOISES`, and this share."""
    candidates: list[tuple[float, float, _Array]] = []
    for share in shares or _NOISES:
        # The matrix is symmetric, so the transpose is a copy in LAPACK's order.
        covariance = prior.T.copy(order="F")
        covariance[np.diag_indices_from(covariance)] += share**2 * noise
        factor: _Array = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        inner = solve_triangular(factor, root, lower=True, check_finite=False)
        scale = float(inner @ inner) / len(root)
        candidates.append((0.5 * len(root) * np.log(scale) + float(np.log(np.diag(factor)).sum()), share, factor))
    _, share, factor = min(candidates, key=lambda candidate: candidate[:2])
    # LAPACK inverts a factored matrix in a quarter of the time of a general solution; the other triangle stays 0.
    inverse: _Array = lapack.dpotri(factor, lower=1)[0]
    inverse += np.tril(inverse, -1).T
    return inverse, share
