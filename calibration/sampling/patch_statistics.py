"""Statistics of the samples of patches: means, noise, and whether a patch is of one colour and its photosites alive.

A cell that is not of one colour is listed with its cause. It is never filled from elsewhere.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

UNEVEN_SHARE = 0.01
"""Difference of rim and middle, as a share of the patch, that matters (judgement)."""

UNEVEN_SIGMA = 5.0
"""Noise alone passes 3 σ in one of 370 comparisons, 265 of a whole chart's 98 304; 5 σ in one of 1.7 million."""

DEAD_SHARE = 0.5
"""Share of its patch's light below which a photosite is taken for dead: even a rim that a dark neighbour blurs into
sees more."""

DEAD_LEVEL = 300.0
"""Counts that a cell must have for a dead photosite to be distinguished from noise: half of it is 21 σ."""

_NOISE_BINS = 32
"""Levels at which noise is read: a full chart has a thousand patches in each, a chart of 512 colours sixteen."""


def patch_means(values: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    """Return the means (N, 3) float64 of patches' values (N, S, 3) uint16, in an eighth of NumPy's time."""
    from calibration.sampling import kernels

    means = np.empty((values.shape[0], 3))
    kernels.patch_means(values, means)
    return means


def _inner(samples: int) -> npt.NDArray[np.bool_]:
    """Return which of a window's samples (S,) are not on its rim."""
    window = round(samples**0.5)
    inner = np.zeros((window, window), dtype=bool)
    inner[1:-1, 1:-1] = True
    return inner.ravel()


def rim_difference(
    samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return by how much rim and middle of patches differ, and the standard deviation of that difference.

    `samples`: (N, S, 3) float32 or float64 counts above black, S = 9, 25, 49 or 81 row by row. `noise`: (N, 3) float32
    or float64, standard deviation of one of them, counts. Returns (N, 3) float64 counts.
    """
    inner = _inner(samples.shape[1])
    middle = samples[:, inner].mean(axis=1, dtype=np.float64)
    rim = samples[:, ~inner].mean(axis=1, dtype=np.float64)
    return np.abs(rim - middle), noise * np.sqrt(1 / inner.sum() + 1 / (~inner).sum())


def unevenness(samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return how uneven patches are: the largest significant difference of rim and middle, relative, 0 where none is.

    The outer pixels, 16 of 25, are compared with the inner ones, channel by channel; a difference counts when it
    exceeds both 5 of its standard deviations and 1 % of the patch. In a window of 3×3 the inner one is a single pixel,
    and what is found is coarse: 1.06 σ of one sample's noise, against 0.42 σ in 5×5.

    `samples`: (N, S, 3) float32 or float64 counts above black, the mean of one or more frames of equal light. `noise`:
    (N, 3) float32 or float64 counts, standard deviation of one of these values. Returns (N,) float64, a share of the
    patch's level.
    """
    difference, sigma = rim_difference(samples, noise)
    level = np.maximum(samples.mean(axis=1, dtype=np.float64), 1e-6)
    significant = (difference > UNEVEN_SIGMA * sigma) & (difference > UNEVEN_SHARE * level)
    return np.where(significant, difference / level, 0.0).max(axis=1)


def has_dead_photosite(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Return which patches (N,) bool hold a photosite that sees less than half of what the others do.

    `samples` (N, S, 3) are counts above black, the mean of one or more frames. A green sample is the mean of two
    photosites, so that one of them dead halves it.
    """
    middle = np.median(samples, axis=1, keepdims=True)
    allowed = np.array([DEAD_SHARE, 0.5 * (1 + DEAD_SHARE), DEAD_SHARE])
    return np.asarray(((samples < allowed * middle) & (middle > DEAD_LEVEL)).any(axis=(1, 2)))


def sample_noise(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the standard deviation of one sample of each patch, (N, 3) float64 counts, usual for patches of its level.

    Measured in the inner pixels of all patches (in a 3×3 window, in all nine) and taken as a function of the level,
    since nine values of one patch alone give it to a quarter only. `samples` (N, S, 3) are counts above black.
    """
    inner = _inner(samples.shape[1])
    # A rim that another colour bleeds into is no noise; a window too small to do without it keeps it.
    middle = (samples[:, inner] if inner.sum() >= 9 else samples).astype(np.float64)
    level, variance = middle.mean(axis=1), middle.var(axis=1, ddof=1)
    noise = np.empty_like(level)
    degrees = middle.shape[1] - 1
    for channel in range(3):
        order = np.argsort(level[:, channel])
        bins: list[npt.NDArray[np.int64]] = np.array_split(order, max(1, min(_NOISE_BINS, len(order) // 16)))
        at = np.array([float(np.median(level[part, channel])) for part in bins])
        usual = np.array([float(np.median(variance[part, channel])) for part in bins]) / median_of_variance(degrees)
        noise[:, channel] = np.interp(level[:, channel], at, np.sqrt(usual))
    return noise


def median_of_variance(degrees: int) -> float:
    """Return the median of a variance of normal values over its mean, for its degrees of freedom.

    Wilson and Hilferty's cube root (PNAS 1931): 0.919 for eight, where the exact value is 0.918.

    >>> round(median_of_variance(8), 3)
    0.919
    """
    return (1 - 2 / (9 * degrees)) ** 3
