"""The samples of every cell, taken as the sensor gave them.

Rules that hold inside:

- A cell's samples are the 5×5 half-size pixels around its rounded centre (paper, section 3.2), or another odd window.
  Pixels are taken whole; nothing is interpolated, which would alter the noise that the samples are for.
- A cell that is cut off, clipped, or not of one colour is listed with its cause. It is never filled from elsewhere.

Works on the raw photosites under the cells and nowhere else: a frame need not be debayered to be sampled.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from calibration.sampling.windows import WINDOW_PX
from drivers.raw.rawfile import Mosaic
from experiment.framing.planes import CHANNELS, phases

WINDOW = WINDOW_PX
"""Pixels along the side of a cell's window, where the user names no other: the paper's."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sites:
    """Which half-size pixels patches are sampled at.

    - `rows`, `columns`: (N,) int64, the pixel in the middle of each patch.
    - `inside`: (N,) bool, whether all its pixels lie in the frame.
    - `window`: pixels along a patch's side, odd.
    """

    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]
    inside: npt.NDArray[np.bool_]
    window: int = WINDOW

    @cached_property
    def order(self) -> npt.NDArray[np.int64]:
        """(N,) int64, the patches as their photosites lie in memory, roughly: neighbours follow one another."""
        return np.lexsort((self.columns, self.rows // self.window))


def sites_at(places_px: _Array, frame_shape: tuple[int, int], window: int = WINDOW) -> Sites:
    """Return the sites of patches whose centres lie at places (N, 2) half-size px, x then y.

    `frame_shape` is rows and columns of the half-size frame, `window` the pixels along a patch's side, odd.
    """
    columns, rows = np.rint(places_px).astype(np.int64).T
    reach = window // 2
    inside = (rows >= reach) & (columns >= reach)
    inside &= (rows < frame_shape[0] - reach) & (columns < frame_shape[1] - reach)
    return Sites(rows, columns, inside, window)


def gather(
    mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint16]]:
    """Return the samples of patches.

    `black`: (2, 2) float64, counts, black level of each position of the block. Returns (N, S, 3) float32, camera RGB,
    counts above black, row by row within a patch; 0 for patches outside. Returns (N,) uint16, the highest raw count of
    a patch's photosites.
    """
    from calibration.sampling import kernels

    samples = np.empty((len(sites.rows), sites.window**2, 3), dtype=np.float32)
    highest = np.empty(len(sites.rows), dtype=np.uint16)
    kernels.sample(*_photosites(mosaic, black, sites), samples, highest)
    return samples, highest


def gather_means(mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites) -> _Array:
    """Return the means (N, 3) float64 of what `gather` returns, counts above black, without holding the samples.

    Parameters are those of `gather`: `black` (2, 2) float64 counts.
    """
    from calibration.sampling import kernels

    means = np.empty((len(sites.rows), 3))
    kernels.count_means(*_photosites(mosaic, black, sites), means)
    return means


def _photosites(
    mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites
) -> tuple[
    npt.NDArray[np.uint16],
    npt.NDArray[np.int64],
    npt.NDArray[np.int64],
    npt.NDArray[np.bool_],
    int,
    npt.NDArray[np.int64],
    int,
    npt.NDArray[np.float32],
]:
    """Return the sensor, and where on it patches lie, as the kernels expect them."""
    width, reach = mosaic.sensor.shape[1], sites.window // 2
    corner = (mosaic.visible.top + 2 * (sites.rows - reach)) * width + mosaic.visible.left + 2 * (sites.columns - reach)
    found = phases(mosaic)
    places = [row * width + column for channel in CHANNELS for row, column in found[channel]]
    level = [np.mean([black[place] for place in found[channel]]) for channel in CHANNELS]
    return (
        mosaic.sensor.reshape(-1),
        corner,
        sites.order,
        sites.inside,
        2 * width,
        np.array(places, dtype=np.int64),
        sites.window,
        np.array(level, dtype=np.float32),
    )


def table_values(
    samples: npt.NDArray[np.float32], field: _Array, dark: npt.NDArray[np.float32] | None = None
) -> npt.NDArray[np.uint16]:
    """Return samples as the table holds them.

    Divided by the field, rounded, and clipped at 0. Clipping makes the mean of a patch that is as dark as its noise too
    bright: by 0.4 σ where there is no light at all, by less than 0.01 σ from 2 σ of light on (σ one sample's noise).
    The ground truth is not clipped.

    `samples`: (N, S, 3) float32, counts above black. `field`: (N, 3) float64, of each patch. `dark`: (N, 3) float32,
    counts to subtract from each patch's samples; none if not given. Returns (N, S, 3) uint16.
    """
    from calibration.sampling import kernels

    dark = np.zeros(field.shape, dtype=np.float32) if dark is None else dark
    values = np.empty(samples.shape, dtype=np.uint16)
    kernels.tabulate(samples, dark, field.astype(np.float32), values)
    return values


def gather_values(
    mosaic: Mosaic,
    black: npt.NDArray[np.float64],
    sites: Sites,
    field: _Array,
    dark: npt.NDArray[np.float32] | None = None,
) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint16]]:
    """Return `table_values` of what `gather` returns, (N, S, 3) uint16, and the highest counts (N,) uint16.

    In a third of the time of both; parameters as theirs: `black` (2, 2), `field` and `dark` (N, 3).
    """
    from calibration.sampling import kernels

    dark = np.zeros(field.shape, dtype=np.float32) if dark is None else dark
    values = np.empty((len(sites.rows), sites.window**2, 3), dtype=np.uint16)
    highest = np.empty(len(sites.rows), dtype=np.uint16)
    kernels.sample_to_table(*_photosites(mosaic, black, sites), dark, field.astype(np.float32), values, highest)
    return values, highest
