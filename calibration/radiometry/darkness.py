"""What is there when the projector shows black: its leak, the room's light, hot photosites; and whether light adds.

Laws that hold inside:

- Leak and ambient light cannot be told apart and are one figure, read on bare paper in the dark frames.
- They are part of every light: samples and ground truth hold them alike, so nothing is subtracted unless asked for
  (`calibration.radiometry.dark_light`).
- A photosite is hot when it stands out in every dark frame; what stands out once is a cosmic ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from acquisition.lights.illuminations import Illumination
from acquisition.session.folder import FrameRecord
from foundation.robust import MAD_TO_SIGMA, MEDIAN_ERROR

HOT_COUNTS = 32.0
"""Counts above its patch from which a sample is hot: the signal of the darkest cells that are of use, about 30."""

HOT_SIGMA = 10.0
"""Read noise alone passes 6 σ once in 2.5 million samples, a chart's."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Darkness:
    """What the dark frames say.

    Attributes
    ----------
    files
        Dark frames read.
    light
        (3,) float64 counts above black on bare paper, field divided out: leak and ambient light, the median of the
        frames; NaN without dark frames.
    error
        (3,) float64, standard error of `light`.
    blacks
        (2, 2) float64 counts of each frame.
    noise
        (3,) float64 counts, standard deviation of a sample: read noise, of green that of the mean of two photosites.
    hottest
        (C,) float64 counts, how far the hottest sample of each cell stands out in every frame; 0 where it does not.
    lights
        (3,) float64 counts on bare paper, of each frame.
    """

    files: tuple[str, ...] = ()
    light: _Array = field(default_factory=lambda: np.full(3, np.nan))
    error: _Array = field(default_factory=lambda: np.full(3, np.nan))
    blacks: tuple[_Array, ...] = ()
    noise: _Array = field(default_factory=lambda: np.full(3, np.nan))
    hottest: _Array = field(default_factory=lambda: np.zeros(0))
    lights: tuple[_Array, ...] = ()


@dataclass(frozen=True, eq=False)
class DarkFigures:
    """What was measured on one dark frame.

    Attributes
    ----------
    record
        The frame.
    black
        (2, 2) float64 counts.
    light, error
        (3,) float64 counts above black on bare paper, field divided out, and their standard error.
    noise
        (3,) float64 counts, standard deviation of a sample.
    """

    record: FrameRecord
    black: _Array
    light: _Array
    error: _Array
    noise: _Array

    def told(self) -> dict[str, Any]:
        """Return the figures as JSON holds them; `recall` makes them again to the last bit."""
        return {name: getattr(self, name).tolist() for name in ("black", "light", "error", "noise")}

    @staticmethod
    def recall(record: FrameRecord, told: dict[str, Any]) -> DarkFigures:
        """Return the figures of a frame from what `told` returned."""
        return DarkFigures(record, *(np.array(told[name]) for name in ("black", "light", "error", "noise")))


def read_dark(
    record: FrameRecord,
    black: _Array,
    cells: npt.NDArray[np.float32],
    paper: npt.NDArray[np.float32],
    shape: _Array,
) -> tuple[DarkFigures, npt.NDArray[np.int16]]:
    """Return what a dark frame says, and how far each sample (C, S, 3) stands above its cell, whole counts.

    Parameters
    ----------
    record
        The frame.
    black
        (2, 2) counts.
    cells
        (C, S, 3) float32 samples of the cells, counts above black.
    paper
        (N, S, 3) float32 samples of the white references that lie in the frame.
    shape
        (N, 3) field at these references.
    """
    flat: _Array = paper.mean(axis=1, dtype=np.float64) / shape
    count = max(len(flat), 1)
    middle: _Array = np.asarray(np.median(flat, axis=0), dtype=np.float64)
    # The median of normal values has a standard error 1.25 times that of the mean.
    spread: _Array = MAD_TO_SIGMA * np.median(np.abs(flat - middle), axis=0)
    aside: npt.NDArray[np.float32] = cells - np.median(cells, axis=1, keepdims=True)
    # A seventh of the cells tells the noise well enough; about the median of 25 it is read 2 % low.
    noise: _Array = (1 + 0.5 / cells.shape[1]) * MAD_TO_SIGMA * np.median(np.abs(aside[::7]), axis=(0, 1))
    figures = DarkFigures(record, black, middle, MEDIAN_ERROR * spread / np.sqrt(count), noise)
    return figures, np.clip(np.rint(aside), -32768, 32767).astype(np.int16)


class HotSamples:
    """Remembers, over dark frames, which samples stand out of their cells in every one of them.

    Parameters
    ----------
    cells, samples
        C cells of S samples.
    """

    def __init__(self, cells: int, samples: int) -> None:
        self._shape = cells, samples, 3
        self._least: npt.NDArray[np.int16] = np.full(self._shape, 32767, dtype=np.int16)
        self._past = np.zeros(cells)

    def add(self, aside: npt.NDArray[np.int16]) -> None:
        """Take a frame in; `aside` as `read_dark` returned it."""
        np.minimum(self._least, aside, out=self._least)

    def move(self, noise: _Array) -> None:
        """Begin anew, since cells lie on other photosites from now on; what was hot so far stays hot."""
        self._past = self.hottest(noise)
        self._least = np.full(self._shape, 32767, dtype=np.int16)

    def hottest(self, noise: _Array) -> _Array:
        """Return how far the hottest sample of each cell (C,) stands out in every frame, 0 where it does not.

        `noise` (3,) is a sample's.
        """
        hot = np.maximum(HOT_COUNTS, HOT_SIGMA * noise)
        seen = (self._least > hot) & (self._least < 32767)
        return np.maximum(np.where(seen, self._least, 0).max(axis=(1, 2)).astype(np.float64), self._past)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Return all that is remembered."""
        return {"dark_least": self._least, "dark_past": self._past}

    def restore(self, state: dict[str, npt.NDArray[Any]]) -> None:
        """Go on from what `state` returned."""
        self._least, self._past = state["dark_least"].copy(), state["dark_past"]


def usual_noise(frames: Sequence[DarkFigures]) -> _Array:
    """Return the noise (3,) of a sample, the median of dark frames; NaN without one."""
    return np.asarray(np.median([dark.noise for dark in frames], axis=0)) if frames else np.full(3, np.nan)


def darkness(frames: Sequence[DarkFigures], hot: HotSamples) -> Darkness:
    """Return what dark frames say together."""
    if not frames:
        return Darkness()
    noise = usual_noise(frames)
    return Darkness(
        tuple(dark.record.file for dark in frames),
        np.median([dark.light for dark in frames], axis=0),
        np.median([dark.error for dark in frames], axis=0) / np.sqrt(len(frames)),
        tuple(dark.black for dark in frames),
        noise,
        hot.hottest(noise),
        tuple(dark.light for dark in frames),
    )


def additivity(
    lights: Sequence[Illumination], white: _Array, full_white: _Array | None, dark: _Array, gains: _Array
) -> _Array | None:
    """Return by how much the primaries together differ from white, per channel, relative to white.

    red + green + blue − 2 black = white where light adds: each of the three brings the projector's black along. A
    projector with a white segment on its wheel, or one that processes colours, gives more or less. It harms no table,
    since each light's ground truth is measured; it means that a light cannot be predicted from its codes.

    Parameters
    ----------
    lights
        L lights; used are the three with one full primary, and full white if `full_white` is None.
    white
        (L, 3) their ground truths.
    full_white
        (3,) paper under full white from the white frames, None without.
    dark
        (3,) paper in the dark frames; zeros where already subtracted.
    gains
        (L, 3) the lamp's drift at each light, of which white frames are free; `drift_gains`.

    Returns
    -------
    ndarray or None
        (3,) float64; None when a primary or white is missing.
    """
    found: dict[tuple[int, int, int], _Array] = {}
    for light in lights:
        code = (light.colour.red, light.colour.green, light.colour.blue)
        found[code] = white[light.index] / gains[light.index]
    total = full_white if full_white is not None else found.get((255, 255, 255))
    primaries = [found.get(code) for code in ((255, 0, 0), (0, 255, 0), (0, 0, 255))]
    red, green, blue = primaries
    if total is None or red is None or green is None or blue is None or not np.isfinite(dark).all():
        return None
    return (red + green + blue - 2 * dark) / total - 1


def drift_gains(at_s: _Array, white_at_s: _Array, white: _Array) -> _Array:
    """Return the lamp's light at times over that of the first white frame, linear between white frames.

    Parameters
    ----------
    at_s
        (L,) when each light was taken.
    white_at_s, white
        (W,) and (W, 3) when the white frames were taken, rising, and paper in them.

    Returns
    -------
    ndarray
        (L, 3) float64; ones where there are fewer than two white frames.
    """
    if len(white) < 2:
        return np.ones((len(at_s), 3))
    gains = np.ones((len(at_s), 3))
    for channel in range(3):
        gains[:, channel] = np.interp(at_s, white_at_s, white[:, channel] / white[0, channel])
    return gains
