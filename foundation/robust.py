"""Robust scale estimates and weights (P. J. Huber, E. M. Ronchetti, *Robust Statistics*, 2nd edition, 2009)."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

# Ratio of standard deviation and median absolute deviation of a normal distribution: 1 / Φ⁻¹(3/4).
MAD_TO_SIGMA: Final = 1.4826

# Ratio of the standard errors of median and mean of many normal values: √(π/2).
MEDIAN_ERROR: Final = 1.2533

# Residuals up to this many standard deviations have weight 1; 95 % of normal residuals do.
_HUBER_SIGMAS: Final = 2.0


def robust_sigma(residual: npt.NDArray[np.floating]) -> float:
    """Return the standard deviation of normal residuals about 0, of any shape, from their median absolute value."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residual)))


def sigma_by_level(
    residual: npt.NDArray[np.float64], level: npt.NDArray[np.float64], groups: int
) -> npt.NDArray[np.float64]:
    """Return the robust standard deviation (N,) float64 of residuals (N,) among residuals of similar level (N,).

    `groups`: number of groups of equal size.
    """
    sigma = np.empty(len(residual))
    for members in np.array_split(np.argsort(level, kind="stable"), groups):
        sigma[members] = robust_sigma(residual[members])
    return sigma


def huber_weights(size: npt.NDArray[np.float64], sigma: float) -> npt.NDArray[np.float64]:
    """Return Huber's weights 0 to 1 of absolute residuals `size` (...) float64 (chapter 7)."""
    return np.minimum(1, _HUBER_SIGMAS * sigma / np.maximum(size, 1e-12))


def biweight(size: npt.NDArray[np.float64], sigma: float, cut: float = 6.0) -> npt.NDArray[np.float64]:
    """Return Tukey's biweights 0 to 1 of absolute residuals `size` (...) float64; 0 from `cut` standard deviations."""
    return np.asarray(np.maximum(1 - (size / (cut * sigma)) ** 2, 0) ** 2, dtype=np.float64)
