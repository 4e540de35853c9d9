"""The 25 samples of every cell, taken as the sensor gave them.

Laws that hold inside:

- A cell's samples are the 5×5 half-size pixels around its rounded centre (paper, section 3.2). Pixels are taken whole;
  nothing is interpolated, which would alter the noise that the samples are for.
- A cell that is cut off, clipped, or not of one colour is listed with its cause. It is never filled from elsewhere.

Works on the raw photosites under the cells and nowhere else: a frame need not be debayered to be sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.planes import CHANNELS, phases
from drivers.rawfile import Mosaic

WINDOW = 5
SAMPLES = WINDOW * WINDOW

UNEVEN_SHARE = 0.01
UNEVEN_SIGMA = 5.0
"""Noise alone passes 3 σ in one of 370 comparisons, 265 of a whole chart's 98 304; 5 σ in one of 1.7 million."""
_NOISE_BINS = 32

_OFFSETS = np.arange(WINDOW) - WINDOW // 2
_Array = npt.NDArray[np.float64]
_INNER = np.zeros((WINDOW, WINDOW), dtype=bool)
_INNER[1:-1, 1:-1] = True


@dataclass(frozen=True, eq=False)
class Sites:
    """Which half-size pixels patches are sampled at.

    Attributes
    ----------
    rows, columns
        (N,) int64, the pixel in the middle of each patch.
    inside
        (N,) bool, whether all its pixels lie in the frame.
    """

    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]
    inside: npt.NDArray[np.bool_]


def sites_at(places_px: _Array, frame_shape: tuple[int, int]) -> Sites:
    """Return the sites of patches whose centres lie at places (N, 2) half-size px, x then y.

    `frame_shape` is rows and columns of the half-size frame.
    """
    columns, rows = np.rint(places_px).astype(np.int64).T
    reach = WINDOW // 2
    inside = (rows >= reach) & (columns >= reach)
    inside &= (rows < frame_shape[0] - reach) & (columns < frame_shape[1] - reach)
    return Sites(rows, columns, inside)


def gather(
    mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint16]]:
    """Return the samples of patches.

    Parameters
    ----------
    mosaic
        The frame.
    black
        (2, 2) float64, counts, black level of each position of the block.
    sites
        N patches.

    Returns
    -------
    samples
        (N, 25, 3) float32, camera RGB, counts above black, row by row within a patch; 0 for patches outside.
    highest
        (N,) uint16, the highest raw count of a patch's photosites.
    """
    width = mosaic.sensor.shape[1]
    # Index of each pixel's top-left photosite on the whole sensor, which lies in memory without gaps.
    row = mosaic.visible.top + 2 * (np.where(sites.inside, sites.rows, 2)[:, None, None] + _OFFSETS[:, None])
    column = mosaic.visible.left + 2 * (np.where(sites.inside, sites.columns, 2)[:, None, None] + _OFFSETS)
    first = (row * width + column).reshape(-1, SAMPLES)
    sensor = mosaic.sensor.reshape(-1)
    samples = np.empty((*first.shape, 3), dtype=np.float32)
    peak = np.zeros(first.shape, dtype=np.uint16)
    for number, channel in enumerate(CHANNELS):
        places = phases(mosaic)[channel]
        total = np.zeros(first.shape, dtype=np.float32)
        for place in places:
            counts = _taken(sensor[place[0] * width + place[1] :], first)
            np.maximum(peak, counts, out=peak)
            total += counts
        samples[..., number] = total / len(places) - np.float32(np.mean([black[place] for place in places]))
    highest: npt.NDArray[np.uint16] = peak.max(axis=1)
    samples[~sites.inside] = 0
    highest[~sites.inside] = 0
    return samples, highest


def _taken(counts: npt.NDArray[np.uint16], places: npt.NDArray[np.int64]) -> npt.NDArray[np.uint16]:
    # All places lie on the sensor; clipping only spares numpy a buffer.
    return np.take(counts, places, mode="clip")


def table_values(samples: npt.NDArray[np.float32], field: _Array) -> npt.NDArray[np.uint16]:
    """Return samples as the table holds them.

    Divided by the field, rounded, and clipped at 0. Clipping makes the mean of a patch that is as dark as its noise too
    bright: by 0.4 σ where there is no light at all, by less than 0.01 σ from 2 σ of light on (σ one sample's noise).
    The ground truth is not clipped.

    Parameters
    ----------
    samples
        (N, 25, 3) float32, counts above black.
    field
        (N, 3) float64, of each patch.

    Returns
    -------
    ndarray
        (N, 25, 3) uint16.
    """
    values = samples / field[:, None, :].astype(np.float32)
    np.rint(values, out=values)
    return np.clip(values, 0, 65535, out=values).astype(np.uint16)


def uneven(samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return how uneven patches are: the largest significant difference of rim and middle, relative, 0 where none is.

    The 16 outer pixels are compared with the inner 9, channel by channel; a difference counts when it exceeds both 5
    of its standard deviations and 1 % of the patch.

    Parameters
    ----------
    samples
        (N, 25, 3), the mean of one or more frames of equal light.
    noise
        (N, 3), standard deviation of one of these 25 values.

    Returns
    -------
    ndarray
        (N,) float64.
    """
    inner = _INNER.ravel()
    middle = samples[:, inner].mean(axis=1, dtype=np.float64)
    rim = samples[:, ~inner].mean(axis=1, dtype=np.float64)
    difference = np.abs(rim - middle)
    sigma = noise * np.sqrt(1 / inner.sum() + 1 / (~inner).sum())
    level = np.maximum(samples.mean(axis=1, dtype=np.float64), 1e-6)
    significant = (difference > UNEVEN_SIGMA * sigma) & (difference > UNEVEN_SHARE * level)
    return np.where(significant, difference / level, 0.0).max(axis=1)


DEAD_SHARE = 0.5
DEAD_LEVEL = 300.0
"""Counts that a cell must have for a dead photosite to be told from noise: 21 σ there."""


def dead_samples(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Return which patches (N,) hold a photosite that sees less than half of what the others do.

    `samples` (N, 25, 3) are counts above black, the mean of one or more frames. A green sample is the mean of two
    photosites, so that one of them dead halves it.
    """
    middle = np.median(samples, axis=1, keepdims=True)
    allowed = np.array([DEAD_SHARE, 0.5 * (1 + DEAD_SHARE), DEAD_SHARE])
    return np.asarray(((samples < allowed * middle) & (middle > DEAD_LEVEL)).any(axis=(1, 2)))


def noise_of(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the standard deviation of one value of each patch, (N, 3), as usual for patches of its level.

    Measured in the middle nine pixels of all patches and taken as a function of the level, since nine values of one
    patch alone tell it to a quarter only.
    """
    middle = samples[:, _INNER.ravel()].astype(np.float64)
    level, variance = middle.mean(axis=1), middle.var(axis=1, ddof=1)
    noise = np.empty_like(level)
    for channel in range(3):
        order = np.argsort(level[:, channel])
        bins: list[npt.NDArray[np.int64]] = np.array_split(order, max(1, min(_NOISE_BINS, len(order) // 16)))
        at = np.array([float(np.median(level[part, channel])) for part in bins])
        # The median of a variance of nine normal values is 0.918 of its mean (chi-square, 8 degrees of freedom).
        usual = np.array([float(np.median(variance[part, channel])) for part in bins]) / 0.918
        noise[:, channel] = np.interp(level[:, channel], at, np.sqrt(usual))
    return noise
