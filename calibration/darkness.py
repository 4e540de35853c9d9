"""What is there when the projector shows black: its leak, the room's light, hot photosites; and whether light adds.

Laws that hold inside:

- Leak and ambient light cannot be told apart and are one figure, read on bare paper in the dark frames.
- They are part of every light: samples and ground truth hold them alike, so nothing is subtracted unless asked for.
- A photosite is hot when it stands out in every dark frame; what stands out once is a cosmic ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from acquisition.illuminations import Illumination

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
    files, sha256
        Dark frames read, with the hashes of their files.
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
    """

    files: tuple[str, ...] = ()
    sha256: tuple[str, ...] = ()
    light: _Array = field(default_factory=lambda: np.full(3, np.nan))
    error: _Array = field(default_factory=lambda: np.full(3, np.nan))
    blacks: tuple[_Array, ...] = ()
    noise: _Array = field(default_factory=lambda: np.full(3, np.nan))
    hottest: _Array = field(default_factory=lambda: np.zeros(0))


class DarkReading:
    """Reads dark frames one by one."""

    def __init__(self) -> None:
        self._files: list[str] = []
        self._sha256: list[str] = []
        self._lights: list[_Array] = []
        self._errors: list[_Array] = []
        self._blacks: list[_Array] = []
        self._noises: list[_Array] = []
        self._aside: npt.NDArray[np.float32] | None = None

    def add(
        self,
        file: str,
        sha256: str,
        black: _Array,
        cells: npt.NDArray[np.float32],
        paper: npt.NDArray[np.float32],
        shape: _Array,
    ) -> None:
        """Read a frame.

        Parameters
        ----------
        file, sha256
            The frame.
        black
            (2, 2) counts.
        cells
            (C, 25, 3) float32 samples of the cells, counts above black.
        paper
            (N, 25, 3) float32 samples of the white references that lie in the frame.
        shape
            (N, 3) field at these references.
        """
        self._files.append(file)
        self._sha256.append(sha256)
        self._blacks.append(black)
        flat: _Array = paper.mean(axis=1, dtype=np.float64) / shape
        count = max(len(flat), 1)
        middle: _Array = np.asarray(np.median(flat, axis=0), dtype=np.float64)
        self._lights.append(middle)
        # The median of normal values has a standard error 1.25 times that of the mean.
        spread: _Array = 1.4826 * np.median(np.abs(flat - middle), axis=0)
        self._errors.append(1.2533 * spread / np.sqrt(count))
        aside: npt.NDArray[np.float32] = cells - np.median(cells, axis=1, keepdims=True)
        # A seventh of the cells tells the noise well enough; about the median of 25 it is read 2 % low.
        noise: _Array = 1.02 * 1.4826 * np.median(np.abs(aside[::7]), axis=(0, 1))
        self._noises.append(noise)
        self._aside = aside if self._aside is None else np.minimum(self._aside, aside)

    def result(self) -> Darkness:
        """Return what the frames read so far say."""
        if self._aside is None:
            return Darkness()
        noise = np.median(self._noises, axis=0)
        hot = np.maximum(HOT_COUNTS, HOT_SIGMA * noise)
        hottest = np.where(self._aside > hot, self._aside, 0).max(axis=(1, 2)).astype(np.float64)
        return Darkness(
            tuple(self._files),
            tuple(self._sha256),
            np.median(self._lights, axis=0),
            np.median(self._errors, axis=0) / np.sqrt(len(self._errors)),
            tuple(self._blacks),
            noise,
            hottest,
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
