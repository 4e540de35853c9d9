"""The samples of every cell, taken as the sensor gave them, and their statistics.

A cell's samples are the 5×5 half-size pixels around its rounded centre (paper, section 3.2), or another odd window.
Pixels are taken whole, from the raw photosites: nothing is interpolated, which would alter the noise that the samples
are for. The inner loops are compiled without licence to reorder sums: a table's bytes depend on neither processor nor
thread.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy import uint64
from scipy.optimize import nnls
from scipy.special import ndtr

from drivers.raw.rawfile import CHANNELS, Mosaic, phases
from experiment.framing.sharpness import MAX_BLUR_PX
from foundation.compiled import compiled, inlined

UNEVEN_SHARE = 0.01  # Difference of rim and middle, as a share of the patch, that matters (judgement)

# Noise alone passes 3 σ in one of 370 comparisons, 265 of a whole chart's 98 304; 5 σ in one of 1.7 million.
UNEVEN_SIGMA = 5.0

# Share of its patch's light below which a photosite is taken for dead: even a rim that a dark neighbour blurs into
# sees more.
DEAD_SHARE = 0.5

# Counts that a cell must have for a dead photosite to be distinguished from noise: half of it is 21 σ.
DEAD_LEVEL = 300.0

NOISY = 1e-8  # Chance that noise alone lists a cell: a variance 3.5 times the model's for 25 samples

# Levels at which noise is read: a full chart has a thousand patches in each, a chart of 512 colours sixteen.
_NOISE_BINS = 32

_CURVE_BINS = 48  # The same for the photon-transfer curve: seven hundred cells of a full chart in each

# Sides of windows, half-size px: odd, so that a cell has a middle pixel; a cell is about 10 px wide.
WINDOWS = (3, 5, 7, 9)

# Share of a sample's light from beyond its cell that counts as none: less than half of what the verdict remarks on.
SAFE_BLEED = 0.002

MISPLACEMENT_PX = 0.75  # How far a sample may lie from its place: 0.5 px of rounding and 0.25 px of registration

# From a cell's true centre to the outer edge of its 25 pixels: 2.5, rounding 0.5, registration 0.25.
SAMPLE_REACH_PX = 3.25

_LEAST_BLUR_PX = 1e-3  # Keeps a perfectly sharp picture from dividing by 0

WINDOW = 5  # Pixels along the side of a cell's window, where the user names no other: the paper's (section 3.2)

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Count = npt.NDArray[np.uint16]
_Place = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


def patch_means(values: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    """Return the means (N, 3) float64 of patches' values (N, S, 3) uint16, in an eighth of NumPy's time."""
    means = np.empty((values.shape[0], 3))
    _patch_means(values, means)
    return means


@inlined
def _rounded(above: Any, field: Any) -> Any:
    """Return a sample as the table holds it, uint16."""
    return np.uint16(min(max(np.rint(above / field), np.float32(0)), np.float32(65535)))


@compiled
def _sample(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    samples: _Float,
    peak: _Count,
) -> None:
    """Fill samples (N, window², 3) float32 and their highest counts `peak` (N,); patches that are not inside get 0.

    `sensor`: (photosites,) uint16. `corner`: (N,) the top-left photosite of each patch's first pixel. `order`: (N,) the
    patches as they are best visited: neighbours on the sensor one after another, for the memory's sake. `inside`: (N,)
    whether a patch lies on the sensor. `places`: (4,) photosites from a block's top-left one to its red, its two greens
    and its blue. `black`: (3,) float32 counts, of red, green and blue.
    """
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    for patch in order:
        highest, number = np.int32(0), uint64(0)
        of_patch = samples[patch]
        if not inside[patch]:
            of_patch[:] = 0
            peak[patch] = 0
            continue
        for row in range(window):
            # Unsigned places spare the test for one before the array's beginning.
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[at + red]), np.int32(sensor[at + blue])
                g, h = np.int32(sensor[at + green]), np.int32(sensor[at + other])
                at += uint64(2)
                of_patch[number, 0] = np.float32(r) - black[0]
                of_patch[number, 1] = np.float32(g + h) * np.float32(0.5) - black[1]
                of_patch[number, 2] = np.float32(b) - black[2]
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def _tabulate(samples: _Float, dark: _Float, field: _Float, values: _Count) -> None:
    """Fill values (N, S, 3) uint16 from samples (N, S, 3) float32, less `dark` (N, 3), over `field` (N, 3)."""
    for patch in range(samples.shape[0]):
        for number in range(samples.shape[1]):
            for channel in range(3):
                above = samples[patch, number, channel] - dark[patch, channel]
                values[patch, number, channel] = _rounded(above, field[patch, channel])


@compiled
def _sample_to_table(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    dark: _Float,
    field: _Float,
    values: _Count,
    peak: _Count,
) -> None:
    """Do `_sample` and `_tabulate` in one loop, without the samples (N, window², 3) between them.

    The loop is that of `_sample` once more: two shared steps, with a patch's samples between, take twice as long.

    `values` (N, window², 3) uint16 and `peak` (N,) uint16 are filled; `dark` and `field` are (N, 3) float32, the rest
    as for `_sample`.
    """
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    for patch in order:
        highest, number = np.int32(0), uint64(0)
        of_patch = values[patch]
        if not inside[patch]:
            of_patch[:] = 0
            peak[patch] = 0
            continue
        for row in range(window):
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[at + red]), np.int32(sensor[at + blue])
                g, h = np.int32(sensor[at + green]), np.int32(sensor[at + other])
                at += uint64(2)
                of_patch[number, 0] = _rounded(np.float32(r) - black[0] - dark[patch, 0], field[patch, 0])
                above = np.float32(g + h) * np.float32(0.5) - black[1] - dark[patch, 1]
                of_patch[number, 1] = _rounded(above, field[patch, 1])
                of_patch[number, 2] = _rounded(np.float32(b) - black[2] - dark[patch, 2], field[patch, 2])
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def _count_means(
    sensor: _Count,
    corner: _Place,
    order: _Place,
    inside: _Mask,
    step: int,
    places: _Place,
    window: int,
    black: _Float,
    means: _Array,
) -> None:
    """Fill means (N, 3) float64, counts above black; patches that are not inside get 0. Parameters as for `_sample`."""
    red, green, other, blue = uint64(places[0]), uint64(places[1]), uint64(places[2]), uint64(places[3])
    samples = window * window
    for patch in order:
        if not inside[patch]:
            means[patch] = 0
            continue
        r, g, b = np.int64(0), np.int64(0), np.int64(0)
        for row in range(window):
            at = uint64(corner[patch] + row * step)
            for _ in range(window):
                r += sensor[at + red]
                g += np.int64(sensor[at + green]) + np.int64(sensor[at + other])
                b += sensor[at + blue]
                at += uint64(2)
        means[patch, 0] = r / samples - black[0]
        means[patch, 1] = g / (2 * samples) - black[1]
        means[patch, 2] = b / samples - black[2]


@compiled
def _patch_means(values: _Count, means: _Array) -> None:
    """Fill means (N, 3) float64 of values (N, S, 3) uint16."""
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        red, green, blue = np.int64(0), np.int64(0), np.int64(0)
        for number in range(samples):
            red += values[patch, number, 0]
            green += values[patch, number, 1]
            blue += values[patch, number, 2]
        means[patch, 0], means[patch, 1], means[patch, 2] = red / samples, green / samples, blue / samples


def _inner(samples: int) -> npt.NDArray[np.bool_]:
    """Return which of a window's samples (S,) are not on its rim."""
    window = round(samples**0.5)
    inner = np.zeros((window, window), dtype=bool)
    inner[1:-1, 1:-1] = True
    return inner.ravel()


def rim_difference(
    samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return by how much rim and middle of patches differ, and the standard deviation of that difference.

    `samples`: (N, S, 3) float32 or float64 counts above black, S = 9, 25, 49 or 81 row by row. `noise`: (N, 3) float32
    or float64, standard deviation of one of them, counts. Returns (N, 3) float64 counts.
    """
    inner = _inner(samples.shape[1])
    middle = samples[:, inner].mean(axis=1, dtype=np.float64)
    rim = samples[:, ~inner].mean(axis=1, dtype=np.float64)
    return np.abs(rim - middle), noise * np.sqrt(1 / inner.sum() + 1 / (~inner).sum())


def unevenness(samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return how uneven patches are: the largest significant difference of rim and middle, relative, 0 where none is.

    The outer pixels, 16 of 25, are compared with the inner ones, channel by channel; a difference counts when it
    exceeds both 5 of its standard deviations and 1 % of the patch. In a window of 3×3 the inner one is a single pixel,
    and what is found is coarse: 1.06 σ of one sample's noise, against 0.42 σ in 5×5.

    `samples`: (N, S, 3) float32 or float64 counts above black, the mean of one or more frames of equal light. `noise`:
    (N, 3) float32 or float64 counts, standard deviation of one of these values. Returns (N,) float64, a share of the
    patch's level.
    """
    difference, sigma = rim_difference(samples, noise)
    level = np.maximum(samples.mean(axis=1, dtype=np.float64), 1e-6)
    significant = (difference > UNEVEN_SIGMA * sigma) & (difference > UNEVEN_SHARE * level)
    return np.where(significant, difference / level, 0.0).max(axis=1)


def has_dead_photosite(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Return which patches (N,) bool hold a photosite that sees less than half of what the others do.

    `samples` (N, S, 3) are counts above black, the mean of one or more frames. A green sample is the mean of two
    photosites, so that one of them dead halves it.
    """
    middle = np.median(samples, axis=1, keepdims=True)
    allowed = np.array([DEAD_SHARE, 0.5 * (1 + DEAD_SHARE), DEAD_SHARE])
    return np.asarray(((samples < allowed * middle) & (middle > DEAD_LEVEL)).any(axis=(1, 2)))


def sample_noise(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the standard deviation of one sample of each patch, (N, 3) float64 counts, usual for patches of its level.

    Measured in the inner pixels of all patches (in a 3×3 window, in all nine) and taken as a function of the level,
    since nine values of one patch alone give it to a quarter only. `samples` (N, S, 3) are counts above black.
    """
    inner = _inner(samples.shape[1])
    # A rim that another colour bleeds into is no noise; a window too small to do without it keeps it.
    middle = (samples[:, inner] if inner.sum() >= 9 else samples).astype(np.float64)
    level, variance = middle.mean(axis=1), middle.var(axis=1, ddof=1)
    noise = np.empty_like(level)
    for channel in range(3):
        at, usual = noise_levels(level[:, channel], variance[:, channel], middle.shape[1], 1, _NOISE_BINS)
        noise[:, channel] = np.interp(level[:, channel], at, np.sqrt(usual))
    return noise


def median_of_variance(degrees: int) -> float:
    """Return the median of a variance of normal values over its mean, for its degrees of freedom.

    Wilson and Hilferty's cube root (PNAS 1931): 0.919 for eight, where the exact value is 0.918.

    >>> round(median_of_variance(8), 3)
    0.919
    """
    return (1 - 2 / (9 * degrees)) ** 3


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


def noise_levels(
    level: _Array, variance: _Array, samples: int, least: int = 4, most: int = _CURVE_BINS
) -> tuple[_Array, _Array]:
    """Return the noise of one channel at levels, between `least` and `most` of them: medians of cells of like levels.

    `level`, `variance`: (N,) float64 mean, counts above black, and variance of one sample, counts², of each cell.
    Returns levels (B,), counts above black, and variances (B,), counts², both float64.
    """
    median = median_of_variance(samples - 1)
    order = np.argsort(level)
    bins: list[npt.NDArray[np.int64]] = np.array_split(order, max(least, min(most, len(order) // 16)))
    at = np.array([float(np.median(level[part])) for part in bins if len(part)])
    return at, np.array([float(np.median(variance[part])) for part in bins if len(part)]) / median


def photon_transfer(level: _Array, variance: _Array, samples: int = 25) -> PhotonTransfer:
    """Return the curve through cells: non-negative least squares on the medians of cells of like levels.

    `level`: (N, 3) float64 mean of each cell, counts above black. `variance`: (N, 3) float64 variance of one sample of
    each, counts².
    """
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


def bleed(cell_px: float, blur_px: float, window: int = WINDOW) -> float:
    """Return the share, 0 … 1, of the worst sample's light that comes from beyond its cell.

    The normal integral (a Gaussian of σ `blur_px`) beyond the cell's nearest edge, for the outermost of `window` pixels
    (2 px from the middle one of 5), misplaced by `MISPLACEMENT_PX` towards that edge.

    `cell_px`: shorter side of a cell, half-size px. `blur_px`: σ of the blur, half-size px.
    """
    return float(ndtr(-(cell_px / 2 - window // 2 - MISPLACEMENT_PX) / max(blur_px, _LEAST_BLUR_PX)))


def mean_bleed(cell_px: float, blur_px: npt.NDArray[np.float64], window: int = WINDOW) -> npt.NDArray[np.float64]:
    """Return the share (N,), 0 … 1, of the light of a window's mean from beyond its cell, at blurs (N,) float64.

    Units and sources are those of `bleed`.
    """
    at = np.arange(-(window // 2), window // 2 + 1)
    inside = 1 - 2 * ndtr(-(cell_px / 2 - at) / np.maximum(blur_px, _LEAST_BLUR_PX)[:, None]).mean(axis=1)
    return np.asarray(1 - inside**2, dtype=np.float64)


def largest_blur_px(cell_px: float) -> float:
    """Return the σ of the blur, half-size px, up to which a chart with cells of so many px is registered.

    Up to `MAX_BLUR_PX` cells of any size are found to a few hundredths of a pixel. What such a blur mixes into their
    samples depends on the cells' size; the verdict judges it as bleed.
    """
    return max(MAX_BLUR_PX, (cell_px / 2 - SAMPLE_REACH_PX) / 2)


def largest_window(cell_px: float, blur_px: float) -> int:
    """Return the largest of `WINDOWS` in which no sample exceeds `SAFE_BLEED`; 0 if there is none.

    5 on the EOS 550D and 7 on the 6D Mark II, whose cells have 10.2 and 12.4 px, at a blur of σ = 0.7 px.

    `cell_px`: shorter side of a cell, half-size px. `blur_px`: σ of the blur, half-size px.
    """
    return max((window for window in WINDOWS if bleed(cell_px, blur_px, window) <= SAFE_BLEED), default=0)


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
    samples = np.empty((len(sites.rows), sites.window**2, 3), dtype=np.float32)
    highest = np.empty(len(sites.rows), dtype=np.uint16)
    _sample(*_photosites(mosaic, black, sites), samples, highest)
    return samples, highest


def gather_means(mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites) -> _Array:
    """Return the means (N, 3) float64 of what `gather` returns, counts above black, without holding the samples.

    Parameters are those of `gather`: `black` (2, 2) float64 counts.
    """
    means = np.empty((len(sites.rows), 3))
    _count_means(*_photosites(mosaic, black, sites), means)
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
    dark = np.zeros(field.shape, dtype=np.float32) if dark is None else dark
    values = np.empty(samples.shape, dtype=np.uint16)
    _tabulate(samples, dark, field.astype(np.float32), values)
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
    dark = np.zeros(field.shape, dtype=np.float32) if dark is None else dark
    values = np.empty((len(sites.rows), sites.window**2, 3), dtype=np.uint16)
    highest = np.empty(len(sites.rows), dtype=np.uint16)
    _sample_to_table(*_photosites(mosaic, black, sites), dark, field.astype(np.float32), values, highest)
    return values, highest
