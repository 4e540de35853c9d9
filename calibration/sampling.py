"""Read the raw samples of every patch, and calculate their statistics.

The samples of a patch are the 5×5 half-size pixels around its rounded centre (Banić et al. 2019, section 3.2). Other
odd windows are possible. Photosites are not interpolated, because interpolation would change the noise. The compiled
loops must not reorder sums, so that a LUT has the same bytes on every processor.
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

# A smaller difference between the rim and the centre of a patch, relative to its mean, is negligible. Chosen by
# judgement.
UNEVEN_SHARE = 0.01

# Number of standard deviations from which this difference is significant. Noise alone exceeds 5 σ once in 1.7 million
# comparisons, and a full chart has 98 304 comparisons.
UNEVEN_SIGMA = 5.0

# A photosite with less than this fraction of the light of its patch is dead. Blur from a dark neighbour reduces the
# light at the rim of a patch less than this.
DEAD_SHARE = 0.5

# Patches with fewer counts are not searched for dead photosites, so that noise is not mistaken for them.
DEAD_LEVEL = 300.0

# Probability that noise alone makes a normal patch count as noisy. With 25 samples, a patch is then noisy from 3.5
# times the variance of the model.
NOISY_PROBABILITY = 1e-8

# Number of groups of patches with similar levels, from which noise is estimated; 1000 patches of a full chart in each.
_NOISE_BINS = 32

_CURVE_BINS = 48  # Largest number of such groups for the photon-transfer curve

# Possible sides of a sampling window, half-size px. They are odd, so that a window has a central pixel.
WINDOWS = (3, 5, 7, 9)

# Negligible fraction of the light of a sample that comes from outside its patch. The limit of the figure `bleed` is 5
# times higher.
SAFE_BLEED = 0.002

MISPLACEMENT_PX = 0.75  # Largest error of a sample's position: rounding 0.5 px, registration 0.25 px

# Largest distance from the true centre of a patch to the edge of its 25 pixels: half of the window 2.5 px, rounding
# 0.5 px, registration 0.25 px.
SAMPLE_REACH_PX = 3.25

_MIN_BLUR_PX = 1e-3  # Avoids division by 0 for a perfectly sharp image

WINDOW = 5  # Default side of the window, px, as in Banić et al. 2019 (section 3.2)

_Array = npt.NDArray[np.float64]
_Float = npt.NDArray[np.float32]
_Count = npt.NDArray[np.uint16]
_Index = npt.NDArray[np.int64]
_Mask = npt.NDArray[np.bool_]


def patch_means(values: npt.NDArray[np.uint16]) -> npt.NDArray[np.float64]:
    """Return the means (N, 3) float64 of values (N, S, 3) uint16."""
    means = np.empty((values.shape[0], 3))
    _patch_means(values, means)
    return means


@inlined
def _rounded(signal: Any, field: Any) -> Any:
    return np.uint16(min(max(np.rint(signal / field), np.float32(0)), np.float32(65535)))


@compiled
def _sample(
    sensor: _Count,
    corner: _Index,
    order: _Index,
    inside: _Mask,
    step: int,
    offsets: _Index,
    window: int,
    black: _Float,
    samples: _Float,
    peak: _Count,
) -> None:
    """Fill `samples` (N, window², 3) with counts above black, and `peak` (N,) with the highest raw counts.

    Patches outside the frame get 0. `sensor`: (photosites,) raw counts. `corner`: (N,) top-left photosite of each
    window. `order`: (N,) patches in the order of their photosites in memory. `inside`: (N,) whether the window is in
    the frame. `step`: photosites from one row of 2×2 blocks to the next. `offsets`: (4,) from the top-left photosite of
    a block to red, both greens and blue. `black`: (3,) counts of red, green and blue.
    """
    red, green, green2, blue = uint64(offsets[0]), uint64(offsets[1]), uint64(offsets[2]), uint64(offsets[3])
    for patch in order:
        highest, number = np.int32(0), uint64(0)
        patch_values = samples[patch]
        if not inside[patch]:
            patch_values[:] = 0
            peak[patch] = 0
            continue
        for row in range(window):
            # Unsigned indices avoid the test for negative ones.
            index = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[index + red]), np.int32(sensor[index + blue])
                g, h = np.int32(sensor[index + green]), np.int32(sensor[index + green2])
                index += uint64(2)
                patch_values[number, 0] = np.float32(r) - black[0]
                patch_values[number, 1] = np.float32(g + h) * np.float32(0.5) - black[1]
                patch_values[number, 2] = np.float32(b) - black[2]
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def _tabulate(samples: _Float, dark: _Float, field: _Float, values: _Count) -> None:
    """Fill `values` (N, S, 3) uint16 with `samples` (N, S, 3) float32, minus `dark`, divided by `field` (N, 3)."""
    for patch in range(samples.shape[0]):
        for number in range(samples.shape[1]):
            for channel in range(3):
                signal = samples[patch, number, channel] - dark[patch, channel]
                values[patch, number, channel] = _rounded(signal, field[patch, channel])


@compiled
def _sample_to_table(
    sensor: _Count,
    corner: _Index,
    order: _Index,
    inside: _Mask,
    step: int,
    offsets: _Index,
    window: int,
    black: _Float,
    dark: _Float,
    field: _Float,
    values: _Count,
    peak: _Count,
) -> None:
    """Do `_sample` and `_tabulate` in one loop, which takes half the time."""
    red, green, green2, blue = uint64(offsets[0]), uint64(offsets[1]), uint64(offsets[2]), uint64(offsets[3])
    for patch in order:
        highest, number = np.int32(0), uint64(0)
        patch_values = values[patch]
        if not inside[patch]:
            patch_values[:] = 0
            peak[patch] = 0
            continue
        for row in range(window):
            index = uint64(corner[patch] + row * step)
            for _ in range(window):
                r, b = np.int32(sensor[index + red]), np.int32(sensor[index + blue])
                g, h = np.int32(sensor[index + green]), np.int32(sensor[index + green2])
                index += uint64(2)
                patch_values[number, 0] = _rounded(np.float32(r) - black[0] - dark[patch, 0], field[patch, 0])
                green_signal = np.float32(g + h) * np.float32(0.5) - black[1] - dark[patch, 1]
                patch_values[number, 1] = _rounded(green_signal, field[patch, 1])
                patch_values[number, 2] = _rounded(np.float32(b) - black[2] - dark[patch, 2], field[patch, 2])
                highest = max(highest, max(max(r, b), max(g, h)))
                number += uint64(1)
        peak[patch] = highest


@compiled
def _count_means(
    sensor: _Count,
    corner: _Index,
    order: _Index,
    inside: _Mask,
    step: int,
    offsets: _Index,
    window: int,
    black: _Float,
    means: _Array,
) -> None:
    red, green, green2, blue = uint64(offsets[0]), uint64(offsets[1]), uint64(offsets[2]), uint64(offsets[3])
    samples = window * window
    for patch in order:
        if not inside[patch]:
            means[patch] = 0
            continue
        r, g, b = np.int64(0), np.int64(0), np.int64(0)
        for row in range(window):
            index = uint64(corner[patch] + row * step)
            for _ in range(window):
                r += sensor[index + red]
                g += np.int64(sensor[index + green]) + np.int64(sensor[index + green2])
                b += sensor[index + blue]
                index += uint64(2)
        means[patch, 0] = r / samples - black[0]
        means[patch, 1] = g / (2 * samples) - black[1]
        means[patch, 2] = b / samples - black[2]


@compiled
def _patch_means(values: _Count, means: _Array) -> None:
    samples = values.shape[1]
    for patch in range(values.shape[0]):
        red, green, blue = np.int64(0), np.int64(0), np.int64(0)
        for number in range(samples):
            red += values[patch, number, 0]
            green += values[patch, number, 1]
            blue += values[patch, number, 2]
        means[patch, 0], means[patch, 1], means[patch, 2] = red / samples, green / samples, blue / samples


def _inner(samples: int) -> npt.NDArray[np.bool_]:
    """Return a mask (S,) of the samples of a window that are not on its rim."""
    window = round(samples**0.5)
    inner = np.zeros((window, window), dtype=bool)
    inner[1:-1, 1:-1] = True
    return inner.ravel()


def rim_difference(
    samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the difference between the mean of the rim and the mean of the centre of each patch, and its error.

    Both are (N, 3) float64 counts. The error is the standard deviation of the difference. `samples`: (N, S, 3) counts
    above black, S = 9, 25, 49 or 81, row by row. `noise`: (N, 3) counts, standard deviation of one sample.
    """
    inner = _inner(samples.shape[1])
    middle = samples[:, inner].mean(axis=1, dtype=np.float64)
    rim = samples[:, ~inner].mean(axis=1, dtype=np.float64)
    return np.abs(rim - middle), noise * np.sqrt(1 / inner.sum() + 1 / (~inner).sum())


def unevenness(samples: npt.NDArray[np.floating], noise: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the relative difference of rim and centre of each patch in its worst channel, (N,) float64.

    The result is 0 if no channel differs by more than 5 standard deviations and 1 % of the patch.

    `samples`: (N, S, 3) counts above black, the mean of evenly lit frames. `noise`: (N, 3) counts, standard deviation
    of one of these values.
    """
    difference, sigma = rim_difference(samples, noise)
    level = np.maximum(samples.mean(axis=1, dtype=np.float64), 1e-6)
    significant = (difference > UNEVEN_SIGMA * sigma) & (difference > UNEVEN_SHARE * level)
    return np.where(significant, difference / level, 0.0).max(axis=1)


def has_dead_photosite(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.bool_]:
    """Return a mask (N,) bool of the patches with a photosite that has less than half of the light of the others.

    `samples`: (N, S, 3) counts above black, the mean of frames with equal light.
    """
    # A green sample is the mean of two photosites; one dead photosite halves it.
    median = np.median(samples, axis=1, keepdims=True)
    lowest = np.array([DEAD_SHARE, 0.5 * (1 + DEAD_SHARE), DEAD_SHARE])
    return np.asarray(((samples < lowest * median) & (median > DEAD_LEVEL)).any(axis=(1, 2)))


def sample_noise(samples: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return the standard deviation of one sample of each patch, (N, 3) float64 counts.

    It is estimated from all patches of a similar level, because a single patch has an error of 25 %. `samples`:
    (N, S, 3) counts above black.
    """
    inner = _inner(samples.shape[1])
    # The rim contains light of neighbouring patches. It is excluded if the window has enough other pixels.
    middle = (samples[:, inner] if inner.sum() >= 9 else samples).astype(np.float64)
    level, variance = middle.mean(axis=1), middle.var(axis=1, ddof=1)
    noise = np.empty_like(level)
    for channel in range(3):
        levels, variances = noise_levels(level[:, channel], variance[:, channel], middle.shape[1], 1, _NOISE_BINS)
        noise[:, channel] = np.interp(level[:, channel], levels, np.sqrt(variances))
    return noise


def median_of_variance(degrees: int) -> float:
    """Return the ratio of median and mean of the sample variance of normal values, with `degrees` of freedom.

    Approximation of Wilson and Hilferty (PNAS 1931); the exact value for 8 degrees is 0.918.

    >>> round(median_of_variance(8), 3)
    0.919
    """
    return (1 - 2 / (9 * degrees)) ** 3


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """Noise of the sensor by channel of half-size RGB; green is the mean of two photosites."""

    gain_e: _Array  # (3,) electrons per count
    read_noise: _Array  # (3,) counts
    response: _Array  # (3,), relative standard deviation of photosite response (PRNU)
    misfit: _Array  # (3,), RMS of the relative deviations of measured variances from the curve
    ratio: _Array  # (N,), measured variance of each patch divided by the variance of the curve, in the worst channel
    allowed: float  # Value of `ratio` above which a patch is noisier than expected

    def variance(self, level: _Array) -> _Array:
        """Return the variance (..., 3) float64, counts², of one sample at `level` (..., 3), counts above black."""
        lit = np.maximum(level, 0)
        return self.read_noise**2 + lit / self.gain_e + (self.response * lit) ** 2

    @property
    def noisy(self) -> npt.NDArray[np.bool_]:
        """(N,) bool, patches noisier than expected for their level."""
        return self.ratio > self.allowed


def noise_levels(
    level: _Array, variance: _Array, samples: int, min_levels: int = 4, max_levels: int = _CURVE_BINS
) -> tuple[_Array, _Array]:
    """Return the variance of one channel as a function of its level, from medians of patches with similar levels.

    `level`, `variance`: (N,) float64 mean, counts above black, and variance of one sample, counts², of each patch. The
    patches are divided into `min_levels` to `max_levels` groups. Returns the medians of the groups: levels (B,), counts
    above black, and variances (B,), counts², both float64.
    """
    median = median_of_variance(samples - 1)
    order = np.argsort(level)
    bins: list[npt.NDArray[np.int64]] = np.array_split(order, max(min_levels, min(max_levels, len(order) // 16)))
    levels = np.array([float(np.median(level[indices])) for indices in bins if len(indices)])
    return levels, np.array([float(np.median(variance[indices])) for indices in bins if len(indices)]) / median


def photon_transfer(level: _Array, variance: _Array, samples: int = 25) -> PhotonTransfer:
    """Fit the photon-transfer curve to the results of `noise_levels` by non-negative least squares.

    `level`: (N, 3) float64 mean of each patch, counts above black. `variance`: (N, 3) float64 variance of one sample,
    counts².
    """
    from scipy.stats import chi2

    terms, misfit = np.zeros((3, 3)), np.zeros(3)
    ratio = np.zeros(len(level))
    for channel in range(3):
        levels, variances = noise_levels(level[:, channel], variance[:, channel], samples)
        design = np.column_stack([np.ones_like(levels), np.maximum(levels, 0), np.maximum(levels, 0) ** 2])
        weight = 1 / np.maximum(variances, 1e-9)
        scale = np.maximum(np.abs(design * weight[:, None]).max(axis=0), 1e-30)
        terms[:, channel] = nnls(design * weight[:, None] / scale, variances * weight)[0] / scale
        misfit[channel] = float(np.sqrt(np.mean((design @ terms[:, channel] * weight - 1) ** 2)))
        lit_level = np.maximum(level[:, channel], 0)
        model = terms[0, channel] + terms[1, channel] * lit_level + terms[2, channel] * lit_level**2
        ratio = np.maximum(ratio, variance[:, channel] / np.maximum(model, 1e-9))
    allowed = float(chi2.isf(NOISY_PROBABILITY, samples - 1)) / (samples - 1)
    with np.errstate(divide="ignore"):
        gain = np.where(terms[1] > 0, 1 / terms[1], np.inf)
    return PhotonTransfer(gain, np.sqrt(terms[0]), np.sqrt(terms[2]), misfit, ratio, allowed)


def bleed(cell_px: float, blur_px: float, window: int = WINDOW) -> float:
    """Return the fraction, 0 … 1, of the worst sample's light that comes from outside its patch.

    The worst sample is the outermost pixel of the window, misplaced by `MISPLACEMENT_PX` towards the edge of the patch.
    The Gaussian blur is integrated beyond this edge.

    `cell_px`: shorter side of a patch, half-size px. `blur_px`: σ of the blur, half-size px.
    """
    return float(ndtr(-(cell_px / 2 - window // 2 - MISPLACEMENT_PX) / max(blur_px, _MIN_BLUR_PX)))


def mean_bleed(cell_px: float, blur_px: npt.NDArray[np.float64], window: int = WINDOW) -> npt.NDArray[np.float64]:
    """Return the fraction (N,), 0 … 1, of light from outside the patch in the mean of its window.

    `blur_px`: (N,); other arguments as in `bleed`.
    """
    offsets = np.arange(-(window // 2), window // 2 + 1)
    inside = 1 - 2 * ndtr(-(cell_px / 2 - offsets) / np.maximum(blur_px, _MIN_BLUR_PX)[:, None]).mean(axis=1)
    return np.asarray(1 - inside**2, dtype=np.float64)


def largest_blur_px(cell_px: float) -> float:
    """Return the largest blur σ, half-size px, at which a chart with patches of `cell_px` is registered.

    Up to `MAX_BLUR_PX`, patches of any size are located to a few hundredths of a pixel. Light from neighbouring patches
    is judged separately (`bleed`).
    """
    return max(MAX_BLUR_PX, (cell_px / 2 - SAMPLE_REACH_PX) / 2)


def largest_window(cell_px: float, blur_px: float) -> int:
    """Return the largest of `WINDOWS` in which no sample exceeds `SAFE_BLEED`; 0 if there is none.

    `cell_px`: shorter side of a patch, half-size px. `blur_px`: σ of the blur, half-size px.
    """
    return max((window for window in WINDOWS if bleed(cell_px, blur_px, window) <= SAFE_BLEED), default=0)


@dataclass(frozen=True, eq=False)
class Sites:
    """Half-size pixels at which patches are sampled."""

    rows: npt.NDArray[np.int64]  # (N,), row of the central pixel of each patch
    columns: npt.NDArray[np.int64]  # (N,), column of the central pixel
    inside: npt.NDArray[np.bool_]  # (N,), all pixels of the patch are inside the frame
    window: int = WINDOW  # Side of the sampling window, px, odd

    @cached_property
    def order(self) -> npt.NDArray[np.int64]:
        """(N,) int64, indices of the patches, approximately in the order of their photosites in memory."""
        return np.lexsort((self.columns, self.rows // self.window))


def sites_at(centres_px: _Array, frame_shape: tuple[int, int], window: int = WINDOW) -> Sites:
    """Return the sites of patches with centres (N, 2) half-size px, x then y.

    `frame_shape`: rows and columns of the half-size frame. `window`: side of the window, px, odd.
    """
    columns, rows = np.rint(centres_px).astype(np.int64).T
    reach = window // 2
    inside = (rows >= reach) & (columns >= reach)
    inside &= (rows < frame_shape[0] - reach) & (columns < frame_shape[1] - reach)
    return Sites(rows, columns, inside, window)


def gather(
    mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint16]]:
    """Return the samples of patches, and the highest raw count of each, (N,) uint16.

    `black`: (2, 2) float64 counts, black level of each position of the Bayer block. Samples: (N, S, 3) float32, camera
    RGB, counts above black, row by row; 0 for patches outside the frame.
    """
    samples = np.empty((len(sites.rows), sites.window**2, 3), dtype=np.float32)
    highest = np.empty(len(sites.rows), dtype=np.uint16)
    _sample(*_photosites(mosaic, black, sites), samples, highest)
    return samples, highest


def gather_means(mosaic: Mosaic, black: npt.NDArray[np.float64], sites: Sites) -> _Array:
    """Return the means (N, 3) float64 of the samples of `gather`, counts above black, without storing samples."""
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
    positions = phases(mosaic)
    offsets = [row * width + column for channel in CHANNELS for row, column in positions[channel]]
    level = [np.mean([black[position] for position in positions[channel]]) for channel in CHANNELS]
    return (
        mosaic.sensor.reshape(-1),
        corner,
        sites.order,
        sites.inside,
        2 * width,
        np.array(offsets, dtype=np.int64),
        sites.window,
        np.array(level, dtype=np.float32),
    )


def table_values(
    samples: npt.NDArray[np.float32], field: _Array, dark: npt.NDArray[np.float32] | None = None
) -> npt.NDArray[np.uint16]:
    """Return samples as stored in a LUT, (N, S, 3) uint16: divided by the flat field, rounded, and clipped at 0.

    Clipping raises the mean of a patch without light by 0.4 standard deviations of one sample. The ground truth is not
    clipped.

    `samples`: (N, S, 3) float32 counts above black. `field`: (N, 3) float64 of each patch. `dark`: (N, 3) float32
    counts to subtract.
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
    """Return `table_values` of the samples of `gather`, (N, S, 3) uint16, and the highest raw counts (N,) uint16.

    `black`: (2, 2). `field`, `dark`: (N, 3).
    """
    dark = np.zeros(field.shape, dtype=np.float32) if dark is None else dark
    values = np.empty((len(sites.rows), sites.window**2, 3), dtype=np.uint16)
    highest = np.empty(len(sites.rows), dtype=np.uint16)
    _sample_to_table(*_photosites(mosaic, black, sites), dark, field.astype(np.float32), values, highest)
    return values, highest
