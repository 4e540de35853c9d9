"""Noise against the photon-transfer model: variance = read² + level / gain + (response · level)².

The curve is fitted to all cells of the even frames (EMVA 1288, release 4.0, section 2.4, with the photosites' unequal
response as third term, since one frame shows it too). A cell that is noisier than its level allows is not of one
colour, or was moved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.sampling import median_of_variance

NOISY = 1e-8
"""Chance that noise alone lists a cell: a variance 3.5 times the model's for 25 samples."""

_BINS = 48
"""Levels at which the variance is read, at most: seven hundred cells of a full chart in each."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """The sensor's noise as the cells show it, per channel of half-size RGB; green is the mean of two photosites.

    - `gain_e`: (3,) float64 electrons per count.
    - `read_noise`: (3,) float64 counts.
    - `response`: (3,) float64, standard deviation of the photosites' response, a share.
    - `misfit`: (3,) float64, RMS of the levels' variances about the curve, relative.
    - `ratio`: (N,) float64, each cell's variance over the model's, the largest of its channels.
    - `allowed`: the ratio from which a cell is noisier than its level explains.
    """

    gain_e: _Array
    read_noise: _Array
    response: _Array
    misfit: _Array
    ratio: _Array
    allowed: float

    def variance(self, level: _Array) -> _Array:
        """Return the variance (..., 3) float64, counts², of one sample at levels (..., 3), counts above black."""
        lit = np.maximum(level, 0)
        return self.read_noise**2 + lit / self.gain_e + (self.response * lit) ** 2

    @property
    def noisy(self) -> npt.NDArray[np.bool_]:
        """(N,) bool, whether a cell is noisier than its level allows."""
        return self.ratio > self.allowed


def noise_levels(level: _Array, variance: _Array, samples: int) -> tuple[_Array, _Array]:
    """Return the noise of one channel at levels: medians of cells of like levels.

    `level`, `variance`: (N,) float64 mean, counts above black, and variance of one sample, counts², of each cell.
    Returns levels (B,), counts above black, and variances (B,), counts², both float64.
    """
    median = median_of_variance(samples - 1)
    order = np.argsort(level)
    bins: list[npt.NDArray[np.int64]] = np.array_split(order, max(4, min(_BINS, len(order) // 16)))
    at = np.array([float(np.median(level[part])) for part in bins if len(part)])
    return at, np.array([float(np.median(variance[part])) for part in bins if len(part)]) / median


def photon_transfer(level: _Array, variance: _Array, samples: int = 25) -> PhotonTransfer:
    """Return the curve through cells: non-negative least squares on the medians of cells of like levels.

    `level`: (N, 3) float64 mean of each cell, counts above black. `variance`: (N, 3) float64 variance of one sample of
    each, counts².
    """
    from scipy.optimize import nnls
    from scipy.stats import chi2

    terms, misfit = np.zeros((3, 3)), np.zeros(3)
    ratio = np.zeros(len(level))
    for channel in range(3):
        at, seen = noise_levels(level[:, channel], variance[:, channel], samples)
        design = np.column_stack([np.ones_like(at), np.maximum(at, 0), np.maximum(at, 0) ** 2])
        weight = 1 / np.maximum(seen, 1e-9)
        scale = np.maximum(np.abs(design * weight[:, None]).max(axis=0), 1e-30)
        terms[:, channel] = nnls(design * weight[:, None] / scale, seen * weight)[0] / scale
        misfit[channel] = float(np.sqrt(np.mean((design @ terms[:, channel] * weight - 1) ** 2)))
        here = np.maximum(level[:, channel], 0)
        model = terms[0, channel] + terms[1, channel] * here + terms[2, channel] * here**2
        ratio = np.maximum(ratio, variance[:, channel] / np.maximum(model, 1e-9))
    allowed = float(chi2.isf(NOISY, samples - 1)) / (samples - 1)
    with np.errstate(divide="ignore"):
        gain = np.where(terms[1] > 0, 1 / terms[1], np.inf)
    return PhotonTransfer(gain, np.sqrt(terms[0]), np.sqrt(terms[2]), misfit, ratio, allowed)
