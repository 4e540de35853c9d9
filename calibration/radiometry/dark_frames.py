"""Dark frames: the light that is there while the projector shows black, read noise, and hot photosites.

Rules that hold inside:

- The projector's leak and ambient light cannot be separated and are one figure, read on bare paper.
- They are part of every light: samples and ground truth contain them alike, so nothing is subtracted unless the user
  asks for it (`calibration.radiometry.dark_subtraction`).
- A photosite is hot when it is an outlier in every dark frame; an outlier in a single one is a cosmic ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import FrameOrigin
from experiment.session.records import FrameRecord
from foundation.robust import MAD_TO_SIGMA, MEDIAN_ERROR

HOT_COUNTS = 32.0
"""Counts above its patch from which a sample is hot: the signal of the darkest cells that are of use, about 30."""

HOT_SIGMA = 10.0
"""Read noise alone passes 6 σ once in 2.5 million samples, a chart's."""

_Array = npt.NDArray[np.float64]


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
