"""Dark frames: the light that is there while the projector shows black, read noise, and hot photosites.

The projector's leak and ambient light are one figure, read on bare paper, and part of every light: nothing is
subtracted unless the user asks for it. A photosite is hot when it is an outlier in every dark frame. What a dark frame
adds depends on those before it alone, so that a build that was stopped goes on to the same bits.

What is subtracted is predicted (docs/decisions/0009-dark-light-is-predicted.md), since a single dark frame shows each
cell's light with as much noise: it is dark paper × field × the cell's reflectance, and what cells show beyond that is
added as far as it is more than noise: the share w = 1 − noise² / variance of what is left over, one for each channel
(empirical Bayes; B. Efron and C. Morris, Journal of the American Statistical Association 68, 1973).
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

_LEAST_WHITE = 50.0  # Counts that paper must have in a channel for a cell's reflectance to be read there

_MOST_REFLECTANCE = 1.5  # Of bare paper's: no print reflects more, but noise in a dim channel may seem to

# Standard deviations from its patch's median up to which a sample is light: read noise alone passes 6 σ once in 2.5
# million samples, a chart's.
_FAR_SIGMA = 6.0

_Array = npt.NDArray[np.float64]

# Counts above its patch from which a sample is hot: the signal of the darkest cells that are of use, about 30.
HOT_COUNTS = 32.0

HOT_SIGMA = 10.0  # Read noise alone passes 6 σ once in 2.5 million samples, a chart's

_NEVER = 32767  # The excess of a sample that no dark frame has shown yet


@dataclass(frozen=True, eq=False)
class DarkLight:
    """What is to be subtracted from frames.

    - `paper`: (3,) float64 counts, of bare paper with the field divided out: for the record.
    - `patches`: (P, 3) float32 counts, of each patch as the camera sees it, field and all.
    - `share`: (3,) float64, 0 … 1, how much of what cells show beyond the prediction was added.
    """

    paper: _Array
    patches: npt.NDArray[np.float32]
    share: _Array


def winsorised_means(samples: npt.NDArray[np.float32], noise: _Array) -> _Array:
    """Return the winsorised means of dark samples, since a hot photosite or a cosmic ray is no light.

    `samples`: (P, S, 3) float32 counts above black; those beyond 6 σ of their patch's median count as if they were
    there. `noise`: (3,) float64 counts, σ of one sample. Returns (P, 3) float64 counts.
    """
    middle = np.median(samples, axis=1, keepdims=True)
    far = (_FAR_SIGMA * noise).astype(np.float32)
    return np.clip(samples, middle - far, middle + far).mean(axis=1, dtype=np.float64)


def reflectances(seen: _Array, field: _Array, white: _Array) -> _Array:
    """Return the reflectance (P, 3) float64 of patches, 1 = bare paper.

    `seen`: (P, 3) mean counts above black in a frame of even light. `field`: (P, 3) its flat field at the patches.
    `white`: (3,) counts of bare paper in it. A channel without light has the reflectances of the brightest one.
    """
    found = np.clip(seen / (field * np.maximum(white, _LEAST_WHITE)), 0, _MOST_REFLECTANCE)
    found[:, white < _LEAST_WHITE] = found[:, [int(np.argmax(white))]]
    return found


@dataclass(frozen=True, eq=False)
class DarkLightEstimate:
    """What dark frames, one after another, have shown of the dark light; each makes a new one.

    - `reflectance`: (P, 3) float64 of each patch. `inside`: (P,) bool, whether a patch lies in the frame.
    - `left`: (P, 3) float64 counts, sum of what patches showed beyond the prediction.
    - `noise`: (3,) float64 counts², sum of the variances of a patch's mean.
    """

    reflectance: _Array
    inside: npt.NDArray[np.bool_]
    samples: int
    left: _Array
    noise: _Array
    frames: int

    @staticmethod
    def none(reflectance: _Array, inside: npt.NDArray[np.bool_], samples: int) -> DarkLightEstimate:
        """Return the estimate before any dark frame, of patches with reflectances (P, 3) that are inside (P,)."""
        return DarkLightEstimate(reflectance, inside, samples, np.zeros_like(reflectance), np.zeros(3), 0)

    def restarted(self) -> DarkLightEstimate:
        """Return it without what cells showed beyond the prediction: they lie on other photosites from now on."""
        return DarkLightEstimate.none(self.reflectance, self.inside, self.samples)

    def with_frame(
        self, means: _Array, noise: _Array, paper: Paper, field: _Array
    ) -> tuple[DarkLightEstimate, DarkLight]:
        """Return the estimate after a dark frame, and what is to be subtracted from the frames after it.

        `means`: (P, 3) mean counts above black of each patch. `noise`: (3,) standard deviation of one sample. `field`:
        (P, 3) its field at the patches.
        """
        predicted = paper.white * field * self.reflectance
        after = replace(
            self,
            left=self.left + (means - predicted),
            noise=self.noise + noise**2 / self.samples,
            frames=self.frames + 1,
        )
        left = after.left / after.frames
        spread = MAD_TO_SIGMA * np.median(np.abs(left[self.inside] - np.median(left[self.inside], axis=0)), axis=0)
        chance = after.noise / after.frames**2
        share = np.clip(1 - chance / np.maximum(spread**2, 1e-12), 0, 1)
        return after, DarkLight(paper.white, (predicted + share * left).astype(np.float32), share)


@dataclass(frozen=True, eq=False)
class DarkSummary:
    """What the dark frames of a session show together.

    - `light`: (3,) float64 counts above black on bare paper, field divided out: leak and ambient light, the median of
      the frames; NaN without dark frames.
    - `error`: (3,) float64, standard error of `light`.
    - `blacks`: (2, 2) float64 counts of each frame.
    - `noise`: (3,) float64 counts, standard deviation of a sample: read noise, of green that of the mean of two
      photosites.
    - `hottest`: (C,) float64 counts, by how much the hottest sample of each cell exceeds its median in every frame; 0
      where none does.
    - `lights`: (3,) float64 counts on bare paper, of each frame.
    """

    files: tuple[str, ...] = ()
    light: _Array = field(default_factory=lambda: np.full(3, np.nan))
    error: _Array = field(default_factory=lambda: np.full(3, np.nan))
    blacks: tuple[_Array, ...] = ()
    noise: _Array = field(default_factory=lambda: np.full(3, np.nan))
    hottest: _Array = field(default_factory=lambda: np.zeros(0))
    lights: tuple[_Array, ...] = ()


@dataclass(frozen=True, eq=False)
class DarkFrameFigures:
    """What was measured on one dark frame.

    - `black`: (2, 2) float64 counts.
    - `light`, `error`: (3,) float64 counts above black on bare paper, field divided out, and their standard error.
    - `noise`: (3,) float64 counts, standard deviation of a sample.
    """

    record: FrameRecord
    black: FloatArray
    light: FloatArray
    error: FloatArray
    noise: FloatArray
    origin: FrameOrigin = field(default_factory=FrameOrigin)


def measure_dark_frame(
    record: FrameRecord,
    black: _Array,
    cells: npt.NDArray[np.float32],
    paper: npt.NDArray[np.float32],
    shape: _Array,
) -> tuple[DarkFrameFigures, npt.NDArray[np.int16]]:
    """Return the figures of a dark frame, and how far each sample is above the median of its cell.

    `black`: (2, 2) counts. `cells`: (C, S, 3) float32 samples of the cells, counts above black. `paper`: (N, S, 3)
    float32 samples of the white references that lie in the frame. `shape`: (N, 3) field at these references. Returns
    (C, S, 3) int16, whole counts above the cell's median.
    """
    flat: _Array = paper.mean(axis=1, dtype=np.float64) / shape
    count = max(len(flat), 1)
    middle: _Array = np.asarray(np.median(flat, axis=0), dtype=np.float64)
    # The median of normal values has a standard error 1.25 times that of the mean.
    spread: _Array = MAD_TO_SIGMA * np.median(np.abs(flat - middle), axis=0)
    excess: npt.NDArray[np.float32] = cells - np.median(cells, axis=1, keepdims=True)
    # A seventh of the cells gives the noise well enough; about the median of 25 it is read 2 % low.
    noise: _Array = (1 + 0.5 / cells.shape[1]) * MAD_TO_SIGMA * np.median(np.abs(excess[::7]), axis=(0, 1))
    figures = DarkFrameFigures(record, black, middle, MEDIAN_ERROR * spread / np.sqrt(count), noise)
    return figures, np.clip(np.rint(excess), -32768, 32767).astype(np.int16)


@dataclass(frozen=True, eq=False)
class HotPixels:
    """Which samples exceed their cells' medians in every dark frame so far; each frame makes a new one.

    - `least`: (C, S, 3) int16 counts, the least excess of each sample since the chart was registered last.
    - `past`: (C,) float64 counts, by how much a cell was hot before that.
    """

    least: npt.NDArray[np.int16]
    past: _Array

    @staticmethod
    def none(cells: int, samples: int) -> HotPixels:
        """Return what is known before any dark frame."""
        return HotPixels(np.full((cells, samples, 3), _NEVER, dtype=np.int16), np.zeros(cells))

    def with_frame(self, excess: npt.NDArray[np.int16]) -> HotPixels:
        """Return it after a frame; `excess` (C, S, 3) counts, as `measure_dark_frame` returned it."""
        return replace(self, least=np.minimum(self.least, excess))

    def restarted(self, noise: _Array) -> HotPixels:
        """Return it begun again, since cells lie on other photosites from now on; cells that were hot so far stay so.

        `noise` (3,) counts is the standard deviation of a sample.
        """
        return HotPixels(np.full_like(self.least, _NEVER), self.hottest(noise))

    def hottest(self, noise: _Array) -> _Array:
        """Return how far the hottest sample of each cell (C,) float64 exceeds its median in every frame, counts.

        0 where none does. `noise` (3,) counts is the standard deviation of a sample.
        """
        hot = np.maximum(HOT_COUNTS, HOT_SIGMA * noise)
        seen = (self.least > hot) & (self.least < _NEVER)
        return np.maximum(np.where(seen, self.least, 0).max(axis=(1, 2)).astype(np.float64), self.past)


def median_noise(frames: Sequence[DarkFrameFigures]) -> _Array:
    """Return the noise (3,) float64 counts of a sample, the median of dark frames; NaN without one."""
    return np.asarray(np.median([dark.noise for dark in frames], axis=0)) if frames else np.full(3, np.nan)


def dark_summary(frames: Sequence[DarkFrameFigures], hot: HotPixels) -> DarkSummary:
    """Return what dark frames show together."""
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
