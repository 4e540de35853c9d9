"""Dark frames: the light that is there while the projector shows black, read noise, and hot photosites.

Rules that hold inside:

- The projector's leak and ambient light cannot be separated and are one figure, read on bare paper.
- They are part of every light: samples and ground truth contain them alike, so nothing is subtracted unless the user
  asks for it (`calibration.radiometry.dark_frames`).
- A photosite is hot when it is an outlier in every dark frame; an outlier in a single one is a cosmic ray.

The light of the dark frames at every patch, to be subtracted: the projector's leak and the room's light.

A dark frame shows it at each cell, but with the noise of a few samples: 1.2 counts in a single frame, as much as the
light itself often is. So it is predicted, dark paper × field × the cell's reflectance, and what cells show beyond the
prediction is added as far as it is more than noise: the share w = 1 − noise² / variance of what is left over, one for
each channel (empirical Bayes; B. Efron and C. Morris, Journal of the American Statistical Association 68, 1973).

Why so: `docs/decisions/0009-dark-light-is-predicted.md`.

Rules that hold inside:

- A frame's dark light is that of the last dark frame taken before it, or of the first, for frames before that.
- The estimate after a dark frame depends on those before it alone, so that a build that was stopped goes on to the same
  bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.raw.origin import FrameOrigin
from experiment.measures.paper import Paper
from experiment.session.records import FrameRecord
from foundation.robust import MAD_TO_SIGMA, MEDIAN_ERROR

_LEAST_WHITE = 50.0
"""Counts that paper must have in a channel for a cell's reflectance to be read there."""

_MOST_REFLECTANCE = 1.5
"""Of bare paper's: no print reflects more, but noise in a dim channel may seem to."""

_FAR_SIGMA = 6.0
"""Standard deviations from its patch's median up to which a sample is light: read noise alone passes 6 σ once in 2.5
million samples, a chart's."""

_Array = npt.NDArray[np.float64]


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


class DarkLightEstimator:
    """Estimates the dark light from dark frames, one after another.

    `reflectance`: (P, 3) of each patch. `inside`: (P,) whether a patch lies in the frame.
    """

    def __init__(self, reflectance: _Array, inside: npt.NDArray[np.bool_], samples: int) -> None:
        self._reflectance, self._inside, self._samples = reflectance, inside, samples
        self._left = np.zeros_like(reflectance)
        self._noise = np.zeros(3)
        self._frames = 0
        self._current: DarkLight | None = None

    @property
    def current(self) -> DarkLight | None:
        """The dark light of the last dark frame; None before the first."""
        return self._current

    def restart(self) -> None:
        """Drop what cells showed beyond the prediction: they lie on other photosites from now on."""
        self._left[:] = 0
        self._noise[:] = 0
        self._frames = 0

    def add(self, means: _Array, noise: _Array, paper: Paper, field: _Array) -> DarkLight:
        """Take in a dark frame and return what is to be subtracted from those after it.

        `means`: (P, 3) mean counts above black of each patch. `noise`: (3,) standard deviation of one sample. `field`:
        (P, 3) its field at the patches.
        """
        predicted = paper.white * field * self._reflectance
        self._left += means - predicted
        self._noise += noise**2 / self._samples
        self._frames += 1
        left = self._left / self._frames
        spread = MAD_TO_SIGMA * np.median(np.abs(left[self._inside] - np.median(left[self._inside], axis=0)), axis=0)
        chance = self._noise / self._frames**2
        share = np.clip(1 - chance / np.maximum(spread**2, 1e-12), 0, 1)
        self._current = DarkLight(paper.white, (predicted + share * left).astype(np.float32), share)
        return self._current

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that is needed to go on: arrays by name; none before the first frame.

        `dark_left` (P, 3) float64, `dark_noise` (3,) float64, `dark_frames` scalar int64, `dark_paper` (3,) float64,
        `dark_patches` (P, 3) float32, `dark_share` (3,) float64.
        """
        if self._current is None:
            return {}
        return {
            "dark_left": self._left,
            "dark_noise": self._noise,
            "dark_frames": np.array(self._frames),
            "dark_paper": self._current.paper,
            "dark_patches": self._current.patches,
            "dark_share": self._current.share,
        }

    def restore(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Go on from what `to_arrays` returned: (P, 3) and (3,) float arrays by name."""
        if "dark_left" not in arrays:
            return
        self._left, self._noise = arrays["dark_left"], arrays["dark_noise"]
        self._frames = int(arrays["dark_frames"])
        self._current = DarkLight(arrays["dark_paper"], arrays["dark_patches"], arrays["dark_share"])


HOT_COUNTS = 32.0
"""Counts above its patch from which a sample is hot: the signal of the darkest cells that are of use, about 30."""

HOT_SIGMA = 10.0
"""Read noise alone passes 6 σ once in 2.5 million samples, a chart's."""


@dataclass(frozen=True, eq=False)
class DarkSummary:
    """What the dark frames of a session show together.

    - `files`: dark frames read.
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
    - `origin`: camera, lens and exposure as the raw file states them.
    """

    record: FrameRecord
    black: _Array
    light: _Array
    error: _Array
    noise: _Array
    origin: FrameOrigin = field(default_factory=FrameOrigin)

    def to_json(self) -> dict[str, Any]:
        """Return the figures as JSON can hold them; `from_json` restores them to the last bit."""
        figures = {name: getattr(self, name).tolist() for name in ("black", "light", "error", "noise")}
        return figures | {"origin": asdict(self.origin)}

    @staticmethod
    def from_json(record: FrameRecord, data: dict[str, Any]) -> DarkFrameFigures:
        """Return the figures of a frame from what `to_json` returned."""
        figures = (np.array(data[name]) for name in ("black", "light", "error", "noise"))
        return DarkFrameFigures(record, *figures, origin=FrameOrigin(**data["origin"]))


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


class HotPixels:
    """Accumulates, over dark frames, which samples exceed their cells' medians in every one of them."""

    def __init__(self, cells: int, samples: int) -> None:
        self._shape = cells, samples, 3
        self._least: npt.NDArray[np.int16] = np.full(self._shape, 32767, dtype=np.int16)
        self._past = np.zeros(cells)

    def add(self, excess: npt.NDArray[np.int16]) -> None:
        """Take in a frame; `excess` (C, S, 3) counts, as `measure_dark_frame` returned it."""
        np.minimum(self._least, excess, out=self._least)

    def restart(self, noise: _Array) -> None:
        """Begin again, since cells lie on other photosites from now on; cells that were hot so far stay so.

        `noise` (3,) counts is the standard deviation of a sample.
        """
        self._past = self.hottest(noise)
        self._least = np.full(self._shape, 32767, dtype=np.int16)

    def hottest(self, noise: _Array) -> _Array:
        """Return how far the hottest sample of each cell (C,) float64 exceeds its median in every frame, counts.

        0 where none does. `noise` (3,) counts is the standard deviation of a sample.
        """
        hot = np.maximum(HOT_COUNTS, HOT_SIGMA * noise)
        seen = (self._least > hot) & (self._least < 32767)
        return np.maximum(np.where(seen, self._least, 0).max(axis=(1, 2)).astype(np.float64), self._past)

    def to_arrays(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that is needed to go on: int16 (C, S, 3) and float64 (C,) arrays by name."""
        return {"dark_least": self._least, "dark_past": self._past}

    def restore(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Go on from what `to_arrays` returned: int16 (C, S, 3) and float64 (C,) arrays by name."""
        self._least, self._past = arrays["dark_least"].copy(), arrays["dark_past"]


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
