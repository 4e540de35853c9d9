"""Scale and weights that a few outliers do not move.

P. J. Huber, E. M. Ronchetti, *Robust Statistics*, 2nd edition, chapters 5 and 7.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

# Standard deviation of a normal distribution over its median absolute deviation: 1 / Φ⁻¹(3/4).
MAD_TO_SIGMA: Final = 1.4826

MEDIAN_ERROR: Final = 1.2533  # Standard error of the median of many normal values over that of their mean: √(π/2)

_HUBER_SIGMAS: Final = 2.0  # Residuals up to twice their usual size keep full weight; 95 % of normal ones do


def robust_sigma(residual: npt.NDArray[np.floating]) -> float:
    """Return the standard deviation of normal residuals about zero, float of any shape, by their median size."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residual)))


def sigma_by_level(
    residual: npt.NDArray[np.float64], level: npt.NDArray[np.float64], groups: int
) -> npt.NDArray[np.float64]:
    """Return `robust_sigma` residuals (N,) in groups of like levels (N,), (N,) float64."""
    found = np.empty(len(residual))
    for part in np.array_split(np.argsort(level, kind="stable"), groups):
        found[part] = robust_sigma(residual[part])
    return found


def huber_weights(size: npt.NDArray[np.float64], sigma: float) -> npt.NDArray[np.float64]:
    """Return Huber's weights 0 … 1, of the shape of `size`.

    `size`: (...) float64, absolute residuals.
    """
    return np.minimum(1, _HUBER_SIGMAS * sigma / np.maximum(size, 1e-12))


def biweight(size: npt.NDArray[np.float64], sigma: float, cut: float = 6.0) -> npt.NDArray[np.float64]:
    """Return Tukey's biweights 0 … 1, of the shape of `size`.

    `size`: (...) float64, absolute residuals.
    """
    return np.asarray(np.maximum(1 - (size / (cut * sigma)) ** 2, 0) ** 2, dtype=np.float64)
