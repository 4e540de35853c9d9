"""What the codes of other cells say of a cell's own level: what is left of it is noise, or light of its surroundings.

The colours of a chart lie in random order, so that cells with codes like a cell's own lie elsewhere on the print.

- Of a chart of five or four bits, the mean of both neighbours along each axis of the code predicts a cell's level.
- The 512 codes of a chart of three bits stand too far apart for that: there the level's square root, in which halftones
  mix nearly linearly (J. A. C. Yule, W. J. Nielsen, "The penetration of light into paper", 1951), is a random function
  of the codes (kriging; C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, 2.2),
  and of the largest of the three codes beside, since printers put black in place of what three inks have in common,
  so that colours bend where another ink becomes the least. How rough the function is beside the noise is what makes
  the levels likeliest (5.4.1).

C cells in the order of colour indices; levels are those of bare paper 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg import cholesky, lapack, solve_triangular
from scipy.ndimage import uniform_filter

from calibration import kernels

# Bits of a full chart, whose codes stand so near each other that their curvature is less than the noise of a cell.
FULL_BITS = 5

VARYING_BITS = 4  # Bits of a channel from which on cells are enough to be predicted by their neighbours alone

_BESIDE = 5  # Codes along each side of the square in which the usual curvature across an axis is taken

# Steps of a chart of three bits over which the square root of a level changes: its length scale (chosen; fitted ones
# are 7 to 20).
_REACH = 16.0

_NOISES = (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1)  # Noise over the function's own size that is tried

_DARK = 0.02  # Level at which read noise is as much as that of the light (chosen)

_LEAST_LEVEL = 1e-3  # Least level of which a square root is taken

_UNKNOWN = 1e4  # Variance of the function's linear part and of cells that cannot be used: nothing is known of either

_OUTLIER = 4.0  # Standard deviations beyond which a cell is not believed when others are predicted

_Array = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class LevelModel:
    """What predicts the levels of cells.

    - `known`: (C,) bool, whether others predict a cell.
    - `freedom`: share of the noise's squares that is left in the residuals.
    - `predicted`: (C,) float64, levels as the codes have them; a cell's own where nothing predicts it.
    """

    bits: int
    known: _Mask
    freedom: float
    predicted: _Array
    _left: _Array | None

    @staticmethod
    def of(level: _Array, usable: _Mask, bits: int) -> LevelModel:
        """Return the model of levels (C,) float64, of which some, (C,) bool, can be used."""
        if bits >= VARYING_BITS:
            predicted = level - neighbour_residual(level[:, None], bits)[:, 0]
            return LevelModel(bits, _has_neighbours(bits), 1.0, predicted, None)
        root = _root(level)
        left, noise = _left_by_others(root, usable, bits)
        freedom = np.diag(left)
        # As much of what is left is taken off that the rest has nothing to do with the noise in it.
        taken = freedom * noise / (left**2 @ noise)
        predicted = np.maximum(root - taken * (left @ root), _LEAST_LEVEL**0.5) ** 2
        return LevelModel(bits, np.ones(len(level), dtype=np.bool_), float(freedom[usable].mean()), predicted, left)

    def residual(self, columns: _Array) -> _Array:
        """Return what others do not predict of values (C, M) float64 that are added to levels: linear in them."""
        if self._left is None:
            return neighbour_residual(columns, self.bits)
        slope = 2 * np.sqrt(self.predicted)[:, None]
        return slope * (self._left @ (columns / slope))

    def residual_of(self, level: _Array) -> _Array:
        """Return what others do not predict of levels (C,) float64 themselves."""
        if self._left is None:
            return neighbour_residual(level[:, None], self.bits)[:, 0]
        return 2 * np.sqrt(self.predicted) * (self._left @ _root(level))


def _root(level: _Array) -> _Array:
    return np.sqrt(np.maximum(level, _LEAST_LEVEL))


def neighbour_residual(columns: npt.NDArray[np.floating], bits: int) -> _Array:
    """Return how values of cells differ from what their neighbours in colour predict.

    Linear in the values. The mean of both neighbours along each axis of the code predicts a cell's. Where codes stand
    further apart than the 32 levels of a full chart, it is corrected for the curvature: the mean over the codes beside
    it across that axis.

    `columns`: (C, M) float, values of C = 8**bits cells in the order of colour indices. Returns (C, M) float64, 0 of
    cells without two neighbours along any axis.
    """
    side = 1 << bits
    if bits < FULL_BITS:
        return _less_curvature(columns, side)
    residual = np.empty(columns.shape)
    kernels.colour_differences(np.ascontiguousarray(columns, dtype=np.float64), side, residual)
    return residual


def _has_neighbours(bits: int) -> _Mask:
    """Return whether a cell (C,) has two neighbours along any axis."""
    side = 1 << bits
    codes = np.arange(side**3)
    inner = [(codes // side**axis % side > 0) & (codes // side**axis % side < side - 1) for axis in range(3)]
    return np.any(inner, axis=0)


def _less_curvature(columns: npt.NDArray[np.floating], side: int) -> _Array:
    """Return the residuals (C, M) of a chart of fewer codes."""
    cube = np.asarray(columns, dtype=np.float64).reshape(side, side, side, -1)
    total, count = np.zeros_like(cube), np.zeros((side, side, side, 1))
    for axis in range(3):
        inner, before, after = (
            (*(slice(None),) * axis, part) for part in (slice(1, side - 1), slice(0, side - 2), slice(2, side))
        )
        second = cube[inner] - 0.5 * (cube[before] + cube[after])
        size = [1 if other == axis else _BESIDE for other in range(3)]
        # The mean is that of the codes beside, without the cell's own.
        total[inner] += (second - uniform_filter(second, [*size, 1], mode="nearest")) / (1 - 1 / _BESIDE**2)
        count[inner] += 1
    return (total / np.maximum(count, 1)).reshape(columns.shape)


@lru_cache(maxsize=2)
def _covariance(bits: int) -> _Array:
    """Return the covariance (C, C) of the roots of levels of a chart's codes, without noise; not to be written."""
    side = 1 << bits
    codes = np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1).astype(np.float64)
    # Bends where another ink becomes the least.
    places = np.column_stack([codes, codes.max(axis=1)])
    apart = np.sqrt(5 * ((places[:, None] - places) ** 2).sum(axis=-1)) / _REACH
    linear = np.column_stack([np.ones(len(places)), places - (side - 1) / 2])
    # Matérn's covariance, 5/2 (Rasmussen and Williams, 4.2.1).
    covariance: _Array = (1 + apart + apart**2 / 3) * np.exp(-apart) + _UNKNOWN * linear @ linear.T
    covariance.flags.writeable = False
    return covariance


def _left_by_others(root: _Array, usable: _Mask, bits: int) -> tuple[_Array, _Array]:
    """Return the matrix (C, C) by which roots of levels (C,) become what the function leaves, and their variance."""
    return _left_of(root.tobytes(), usable.tobytes(), bits)


@lru_cache(maxsize=6)
def _left_of(roots: bytes, usables: bytes, bits: int) -> tuple[_Array, _Array]:
    """Return `_left_by_others`, not to be written; three channels are asked for again between others of their own."""
    root, usable = np.frombuffer(roots), np.frombuffer(usables, dtype=np.bool_)
    function = _covariance(bits)
    noise = (1 + _DARK / np.maximum(root, 0.1) ** 2) * np.where(usable, 1.0, _UNKNOWN)
    inverse, share = _likeliest(function, noise, root)
    own = np.diag(inverse)
    left = inverse @ root
    size = float(np.sqrt(np.mean(left[usable] ** 2 / own[usable])))
    outliers = np.abs(left) > _OUTLIER * size * np.sqrt(own)
    if outliers.any():
        noise = np.where(outliers, _UNKNOWN, noise)
        inverse, share = _likeliest(function, noise, root, share)
    matrix = share**2 * noise[:, None] * inverse
    matrix.flags.writeable = noise.flags.writeable = False
    return matrix, noise


def _likeliest(function: _Array, noise: _Array, root: _Array, *shares: float) -> tuple[_Array, float]:
    """Return the inverse (C, C) of the covariance whose noise has the likeliest share of the function, and that."""
    found: list[tuple[float, float, _Array]] = []
    for share in shares or _NOISES:
        # Symmetric, and so in LAPACK's order as well.
        covariance = function.T.copy(order="F")
        covariance[np.diag_indices_from(covariance)] += share**2 * noise
        factor: _Array = cholesky(covariance, lower=True, overwrite_a=True, check_finite=False)
        inner = solve_triangular(factor, root, lower=True, check_finite=False)
        size = float(inner @ inner) / len(root)
        found.append((0.5 * len(root) * np.log(size) + float(np.log(np.diag(factor)).sum()), share, factor))
    _, share, factor = min(found, key=lambda one: one[:2])
    # LAPACK inverts what it factored in a fourth of the time of a general solution, one triangle of it; the other is 0.
    inverse: _Array = lapack.dpotri(factor, lower=1)[0]
    inverse += np.tril(inverse, -1).T
    return inverse, share
