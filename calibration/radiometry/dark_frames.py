"""Evaluate dark frames: light while the projector shows black, read noise, and hot photosites.

Projector leak and ambient light are measured together, on paper, and are called dark light. Dark light is part of every
illuminant, and is only subtracted on request. A hot photosite is an outlier in every dark frame.

In one dark frame, the noise of a patch is as large as its light. The subtracted light is therefore predicted as light
of paper × field × reflectance of the patch (docs/decisions/0009-dark-light-is-predicted.md). The mean residual of the
patch is added with the weight 1 − n² / v, where n is the noise of mean residuals, and v is their variance over all
patches, per channel (empirical Bayes; B. Efron and C. Morris, Journal of the American Statistical Association 68,
1973).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import FrameOrigin
from experiment.measures.paper import Paper
from experiment.session.records import FrameRecord
from foundation.records import FloatArray
from foundation.robust import MAD_TO_SIGMA, MEDIAN_ERROR

_LEAST_WHITE = 50.0  # minimum counts of paper in a channel for measuring reflectance in it

_MOST_REFLECTANCE = 1.5  # upper bound relative to paper; larger values are noise of a dim channel

# Largest deviation of a sample from the median of its patch, in σ. Read noise alone exceeds it in less than one of a
# hundred charts.
_FAR_SIGMA = 6.0

_Array = npt.NDArray[np.float64]

# Minimum excess of a hot sample over its patch, counts: about the signal of the darkest useful patches.
HOT_COUNTS = 32.0

HOT_SIGMA = 10.0  # minimum excess of a hot sample, in σ of read noise

_NO_FRAME_YET = 32767  # value of `HotPixels.least` before the first dark frame


@dataclass(frozen=True, eq=False)
class DarkLight:
    """Dark light to subtract from frames."""

    paper: _Array  # (3,) counts of paper, divided by the flat field; only recorded
    patches: npt.NDArray[np.float32]  # (P, 3) counts of each patch in the frame, not divided by the flat field
    share: _Array  # (3,) weight of the mean residuals of patches, 0 … 1


def winsorised_means(samples: npt.NDArray[np.float32], noise: _Array) -> _Array:
    """Return winsorised means (P, 3) float64 of dark samples, robust against hot photosites and cosmic rays.

    `samples`: (P, S, 3) float32 counts above black level; values beyond 6 σ of the patch median are clipped to that
    limit. `noise`: (3,) float64 counts, σ of one sample.
    """
    median = np.median(samples, axis=1, keepdims=True)
    limit = (_FAR_SIGMA * noise).astype(np.float32)
    return np.clip(samples, median - limit, median + limit).mean(axis=1, dtype=np.float64)


def reflectances(measured: _Array, field: _Array, white: _Array) -> _Array:
    """Return the reflectance (P, 3) float64 of patches, relative to paper.

    `measured`: (P, 3) mean counts above black level under uniform illumination. `field`: (P, 3) flat field at the
    patches. `white`: (3,) counts of paper. A channel without light gets the reflectances of the brightest channel.
    """
    ratio = np.clip(measured / (field * np.maximum(white, _LEAST_WHITE)), 0, _MOST_REFLECTANCE)
    ratio[:, white < _LEAST_WHITE] = ratio[:, [int(np.argmax(white))]]
    return ratio


@dataclass(frozen=True, eq=False)
class DarkLightEstimate:
    """Estimate of dark light from all dark frames so far; each frame gives a new estimate."""

    reflectance: _Array  # (P, 3) of each patch
    inside: npt.NDArray[np.bool_]  # (P,) patches in the frame
    samples: int  # samples per patch
    residual_sum: _Array  # (P, 3) sum over the dark frames of measured minus predicted means, counts
    variance_sum: _Array  # (3,) sum over the dark frames of the variance of a patch mean, counts²
    frames: int  # number of dark frames

    @staticmethod
    def start(reflectance: _Array, inside: npt.NDArray[np.bool_], samples: int) -> DarkLightEstimate:
        """Return the estimate before the first dark frame, with reflectances (P, 3) and patches inside (P,)."""
        return DarkLightEstimate(reflectance, inside, samples, np.zeros_like(reflectance), np.zeros(3), 0)

    def restarted(self) -> DarkLightEstimate:
        """Return the estimate without residuals, because patches are on other photosites now."""
        return DarkLightEstimate.start(self.reflectance, self.inside, self.samples)

    def with_frame(
        self, means: _Array, noise: _Array, paper: Paper, field: _Array
    ) -> tuple[DarkLightEstimate, DarkLight]:
        """Return the estimate after a dark frame, and the dark light for the frames after it.

        `means`: (P, 3) mean counts above black level of each patch. `noise`: (3,) standard deviation of one sample.
        `field`: (P, 3) field at the patches.
        """
        predicted = paper.white * field * self.reflectance
        updated = replace(
            self,
            residual_sum=self.residual_sum + (means - predicted),
            variance_sum=self.variance_sum + noise**2 / self.samples,
            frames=self.frames + 1,
        )
        mean = updated.residual_sum / updated.frames
        spread = MAD_TO_SIGMA * np.median(np.abs(mean[self.inside] - np.median(mean[self.inside], axis=0)), axis=0)
        noise2 = updated.variance_sum / updated.frames**2
        share = np.clip(1 - noise2 / np.maximum(spread**2, 1e-12), 0, 1)
        return updated, DarkLight(paper.white, (predicted + share * mean).astype(np.float32), share)


@dataclass(frozen=True, eq=False)
class DarkSummary:
    """Summary of all dark frames of a session."""

    files: tuple[str, ...] = ()
    # (3,) dark light on paper, counts, divided by the flat field: median of all frames; NaN without frames
    light: _Array = field(default_factory=lambda: np.full(3, np.nan))
    error: _Array = field(default_factory=lambda: np.full(3, np.nan))  # (3,) its standard uncertainty
    blacks: tuple[_Array, ...] = ()  # (2, 2) counts of each frame
    # (3,) read noise of a sample, counts; green: mean of two photosites
    noise: _Array = field(default_factory=lambda: np.full(3, np.nan))
    # (C,) excess of the hottest sample of each patch in every frame, counts; 0: none
    hottest: _Array = field(default_factory=lambda: np.zeros(0))
    lights: tuple[_Array, ...] = ()  # (3,) counts on paper in each frame


@dataclass(frozen=True, eq=False)
class DarkFrameFigures:
    """Measurements of one dark frame."""

    record: FrameRecord
    black: FloatArray  # (2, 2) counts
    light: FloatArray  # (3,) counts above black level on paper, divided by the flat field
    error: FloatArray  # (3,) its standard uncertainty
    noise: FloatArray  # (3,) standard deviation of a sample, counts
    origin: FrameOrigin = field(default_factory=FrameOrigin)


def measure_dark_frame(
    record: FrameRecord,
    black: _Array,
    cells: npt.NDArray[np.float32],
    paper: npt.NDArray[np.float32],
    shape: _Array,
) -> tuple[DarkFrameFigures, npt.NDArray[np.int16]]:
    """Measure a dark frame: figures, and the excess of each sample over the median of its patch.

    `black`: (2, 2) counts. `cells`: (C, S, 3) float32, samples of the patches, counts above black level. `paper`: (N,
    S, 3) float32, samples of white references inside the frame. `shape`: (N, 3), field at these references. Returns the
    excess as (C, S, 3) int16, whole counts.
    """
    flat: _Array = paper.mean(axis=1, dtype=np.float64) / shape
    count = max(len(flat), 1)
    median: _Array = np.asarray(np.median(flat, axis=0), dtype=np.float64)
    # For normal values, the standard uncertainty of the median is 1.25 times the uncertainty of the mean.
    spread: _Array = MAD_TO_SIGMA * np.median(np.abs(flat - median), axis=0)
    excess: npt.NDArray[np.float32] = cells - np.median(cells, axis=1, keepdims=True)
    # A seventh of the patches is sufficient. Deviations from the median of 25 samples are 2 % too small.
    noise: _Array = (1 + 0.5 / cells.shape[1]) * MAD_TO_SIGMA * np.median(np.abs(excess[::7]), axis=(0, 1))
    figures = DarkFrameFigures(record, black, median, MEDIAN_ERROR * spread / np.sqrt(count), noise)
    return figures, np.clip(np.rint(excess), -32768, 32767).astype(np.int16)


@dataclass(frozen=True, eq=False)
class HotPixels:
    """Least excess of samples over the medians of their patches in all dark frames so far; immutable."""

    least: npt.NDArray[np.int16]  # (C, S, 3) least excess of each sample since the last registration, counts
    past: _Array  # (C,) excess of each patch before the last registration, counts

    @staticmethod
    def start(cells: int, samples: int) -> HotPixels:
        """Return the state before the first dark frame."""
        return HotPixels(np.full((cells, samples, 3), _NO_FRAME_YET, dtype=np.int16), np.zeros(cells))

    def with_frame(self, excess: npt.NDArray[np.int16]) -> HotPixels:
        """Return the state after a frame with `excess` (C, S, 3) from `measure_dark_frame`."""
        return replace(self, least=np.minimum(self.least, excess))

    def restarted(self, noise: _Array) -> HotPixels:
        """Return a new state after patches moved to other photosites; patches that were hot stay hot.

        `noise`: (3,) counts, standard deviation of a sample.
        """
        return HotPixels(np.full_like(self.least, _NO_FRAME_YET), self.hottest(noise))

    def hottest(self, noise: _Array) -> _Array:
        """Return the excess (C,) float64 of the hottest sample of each patch in every frame, counts; 0 if none.

        `noise`: (3,) counts, standard deviation of a sample.
        """
        limit = np.maximum(HOT_COUNTS, HOT_SIGMA * noise)
        is_hot = (self.least > limit) & (self.least < _NO_FRAME_YET)
        return np.maximum(np.where(is_hot, self.least, 0).max(axis=(1, 2)).astype(np.float64), self.past)


def median_noise(frames: Sequence[DarkFrameFigures]) -> _Array:
    """Return the median noise (3,) float64 of a sample in dark frames, counts; NaN without frames."""
    return np.asarray(np.median([dark.noise for dark in frames], axis=0)) if frames else np.full(3, np.nan)


def dark_summary(frames: Sequence[DarkFrameFigures], hot: HotPixels) -> DarkSummary:
    """Summarise all dark frames."""
    if not frames:
        return DarkSummary()
    noise = median_noise(frames)
    return DarkSummary(
        tuple(dark.record.file for dark in frames),
        np.median([dark.light for dark in frames], axis=0),
        np.median([dark.error for dark in frames], axis=0) / np.sqrt(len(frames)),
        tuple(dark.black for dark in frames),
        noise,
        hot.hottest(noise),
        tuple(dark.light for dark in frames),
    )
