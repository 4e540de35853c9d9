"""The grey references under each light compared with bare paper, and their noise (photon transfer).

Rules that hold inside:

- A level is the mean of its patches after the field is divided out, without outliers; its standard error is that of
  the mean.
- White is the ground truth; a grey has the light's chromaticity only as far as the print is neutral. How far it is not
  is the print's tint, an angle between camera RGB of grey and white.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.sampling import median_of_variance
from experiment.chart.model import Reference
from foundation.colorimetry import angles_deg
from foundation.robust import MAD_TO_SIGMA

COLUMNS = ("light", "name", "r", "g", "b", "r_error", "g_error", "b_error")
"""Columns of `references.csv` (docs/formats.md)."""

_OUTLIER_SIGMAS = 6.0
"""Robust standard deviations from the median beyond which a patch is covered or dirty."""

_FEW_PATCHES = 4
"""Patches up to which none is left out: of so few, none is surely the one that is wrong."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class GreyLevels:
    """The printed levels of grey of a chart.

    - `names`: one for each level, brightest first.
    - `level`: (N,) int64, the level of each grey reference.
    """

    names: tuple[str, ...]
    level: npt.NDArray[np.int64]

    @classmethod
    def of(cls, references: Sequence[Reference]) -> GreyLevels:
        """Return the levels among references, one for each printed code."""
        codes = sorted({reference.rgb for reference in references}, reverse=True)
        first = {reference.rgb: reference.name for reference in reversed(references)}
        return cls(
            tuple(first[code] for code in codes),
            np.array([codes.index(reference.rgb) for reference in references], dtype=np.int64),
        )

    def read(self, seen: _Array, field: _Array) -> tuple[_Array, _Array]:
        """Return the value and standard error (G, 3) float64 of each level, counts, NaN where no patch can be used.

        `seen`: (N, 3) mean counts above black of each patch, NaN where it cannot be used. `field`: (N, 3) the field at
        each patch.
        """
        flat = seen / field
        value, error = np.full((len(self.names), 3), np.nan), np.full((len(self.names), 3), np.nan)
        for number in range(len(self.names)):
            patches = flat[self.level == number]
            patches = patches[np.isfinite(patches).all(axis=1)]
            if len(patches) == 0:
                continue
            middle = np.median(patches, axis=0)
            scale = MAD_TO_SIGMA * np.median(np.abs(patches - middle), axis=0) + 1e-9
            near = (np.abs(patches - middle) < _OUTLIER_SIGMAS * scale).all(axis=1)
            kept = patches[near] if len(patches) > _FEW_PATCHES else patches
            value[number] = kept.mean(axis=0)
            error[number] = kept.std(axis=0, ddof=1) / np.sqrt(len(kept)) if len(kept) > 1 else np.nan
        return value, error


def references_csv(names: Sequence[str], white: _Array, white_error: _Array, greys: _Array, errors: _Array) -> str:
    """Return the text of `references.csv`: every light's white, then its greys.

    `white`, `white_error`: (L, 3), units of the samples. `greys`, `errors`: (L, G, 3), the same units; NaN is left
    empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)

    def row(light: int, name: str, value: _Array, error: _Array) -> None:
        writer.writerow([light, name, *("" if np.isnan(v) else f"{v:.6f}" for v in (*value.tolist(), *error.tolist()))])

    for light in range(len(white)):
        row(light, "white", white[light], white_error[light])
        for number, name in enumerate(names):
            row(light, name, greys[light, number], errors[light, number])
    return text.getvalue()


def tint_deg(white: _Array, greys: _Array) -> _Array:
    """Return the angle (..., G) float64, degrees, between camera RGB of greys (..., G, 3) and of white (..., 3)."""
    return angles_deg(np.broadcast_to(white[..., None, :], greys.shape), greys)


NOISY = 1e-8
"""Chance that noise alone lists a cell: a variance 3.5 times the model's for 25 samples."""

_BINS = 48
"""Levels at which the variance is read, at most: seven hundred cells of a full chart in each."""


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
