"""Robust scale estimates and weights (P. J. Huber, E. M. Ronchetti, *Robust Statistics*, 2nd edition, 2009)."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

# Standard deviation of a normal distribution divided by its median absolute deviation: 1 / Φ⁻¹(3/4).
MAD_TO_SIGMA: Final = 1.4826

# Standard error of the median divided by the standard error of the mean, for many normal values: √(π/2).
MEDIAN_ERROR: Final = 1.2533

# Residuals up to this number of standard deviations have weight 1: 95 % of normally distributed residuals.
_HUBER_SIGMAS: Final = 2.0


def robust_sigma(residual: npt.NDArray[np.floating]) -> float:
    """Estimate the standard deviation of residuals of any shape, with mean 0, from their median absolute value."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residual)))


def sigma_by_level(
    residual: npt.NDArray[np.float64], level: npt.NDArray[np.float64], groups: int
) -> npt.NDArray[np.float64]:
    """Return, for each residual, the robust standard deviation of the residuals with a similar level, (N,) float64.

    `residual`, `level`: (N,). Residuals are sorted by level and divided into `groups` equal groups.
    """
    sigma = np.empty(len(residual))
    for members in np.array_split(np.argsort(level, kind="stable"), groups):
        sigma[members] = robust_sigma(residual[members])
    return sigma


def huber_weights(size: npt.NDArray[np.float64], sigma: float) -> npt.NDArray[np.float64]:
    """Return Huber's weights, 0 to 1, of absolute residuals `size` (...) float64 (chapter 7 of the book)."""
    return np.minimum(1, _HUBER_SIGMAS * sigma / np.maximum(size, 1e-12))


def biweight(size: npt.NDArray[np.float64], sigma: float, cut: float = 6.0) -> npt.NDArray[np.float64]:
    """Return Tukey's biweights, 0 to 1, of absolute residuals `size` (...) float64; 0 above `cut` * `sigma`."""
    return np.asarray(np.maximum(1 - (size / (cut * sigma)) ** 2, 0) ** 2, dtype=np.float64)
