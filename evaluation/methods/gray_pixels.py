"""Detect pixels of grey surfaces by their derivatives, and estimate the illuminant as their mean colour.

Values are fractions of white: of the saturation if known, else of the largest value of the image. Outside the image,
filters use the nearest pixel; the authors' programs repeat the image. Constants are the authors' values.

Grayness index
    Y. Qian, J.-K. Kämäräinen, J. Nikkanen, J. Matas, "On finding gray pixels", CVPR 2019, equations 9 and 10. On grey
    surfaces, shading and highlights do not change the chromaticity. The index is the norm of the derivatives of
    ln R - ln(R + G + B) and ln B - ln(R + G + B).
Grayness index for several illuminants
    K.-F. Yang, S.-B. Gao, Y.-J. Li, "Efficient illuminant estimation for color constancy using grey pixels", CVPR 2015,
    section 3.3, equations 15 to 17. Gray pixels are clustered by position, and each cluster gives an illuminant. The
    estimate at a pixel is a mean of these illuminants, with larger weights for nearer clusters. We start k-means from
    evenly spread gray pixels, so that maps are reproducible.
Mean-shifted gray pixels
    Y. Qian, S. Pertuz, J. Nikkanen, J.-K. Kämäräinen, J. Matas, "Revisiting gray pixel for statistical illumination
    estimation", VISAPP 2019 (and 2020, extended). Candidates are the pixels whose derivatives of ln R, ln G, ln B have
    the smallest angle to (1, 1, 1). Their colours are clustered by mean shift. The largest cluster gives the
    illuminant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod, unit
from evaluation.scene import Image

DERIVATIVE_SIGMA = 0.5  # scale of the derivatives, px, from both programs of Qian et al.
MEAN_SIDE = 7  # side of the mean filters, px, from both programs of Qian et al.
DARK_SUM = 8 / 255  # largest red + green + blue of excluded pixels, fraction of white, from the authors' examples
_KERNEL_RADIUS = 2  # px; as in the authors' program, exp(-x² / 2σ²) is below 1e-6 outside
_HALO = 8  # extra rows above and below a strip, for the mean filter and the derivative
_STRIP = 1 << 20  # pixels of a strip, which is processed at once: 12 MB as float32
_SMALLEST = float(np.finfo(np.float64).eps)  # replaces zero in logarithms, as in the authors' programs

# Function that calculates the index of each pixel, (H, W) float32, from image rows (H, W, 3) float32, fractions of
# white. It also returns (H, W) bool, True for pixels without index.
Index = Callable[[npt.NDArray[np.float32]], tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]]


def gradient_length(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the length of the gradient of each channel of values (H, W) or (H, W, C) float32, in the same shape."""
    # The authors' kernel is -x exp(-(x² + y²) / 2σ²) / (π σ²). The result for a ramp of 1 per pixel is 0.44, not 1.
    import cv2

    x = np.arange(-_KERNEL_RADIUS, _KERNEL_RADIUS + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * DERIVATIVE_SIGMA**2))
    derivative = x * bell / (np.pi * DERIVATIVE_SIGMA**2)
    along_x = cv2.sepFilter2D(values, cv2.CV_32F, derivative, bell, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.sepFilter2D(values, cv2.CV_32F, bell, derivative, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.magnitude(along_x, along_y), dtype=np.float32).reshape(values.shape)


def mean_filter(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the means over 7 x 7 px of values (H, W) or (H, W, C) float32, in the same shape."""
    import cv2

    filtered = cv2.blur(values, (MEAN_SIDE, MEAN_SIDE), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(filtered, dtype=np.float32).reshape(values.shape)


def logarithm(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the natural logarithm of values of any shape, float32; zeros are replaced by `_SMALLEST`."""
    return np.log(np.where(values > 0, values, np.float32(_SMALLEST)))


def index_map(prepared: PreparedImage, index: Index) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the smoothed index of each pixel, (H, W) float32, and (H, W) bool, True if selectable."""
    index_values = np.empty((prepared.height, prepared.width), dtype=np.float32)
    usable = prepared.usable(0).copy()
    for rows, inner, strip in _strips(prepared):
        values, missing = index(strip)
        index_values[rows] = values[inner]
        usable[rows] &= ~missing[inner] & (strip[inner].sum(axis=2) > DARK_SUM)
    usable &= np.isfinite(index_values)
    if not usable.any():
        return index_values, usable
    # Unusable and dark pixels get the largest index, so that their neighbours are selected last.
    index_values[~usable] = index_values[usable].max()
    return mean_filter(index_values), usable


def least_indices(index: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_], share: float) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True for the usable pixels with the smallest index.

    `share`: number of selected pixels as a fraction of all pixels of the image, 0 … 1. At least one is selected.
    """
    count = min(max(1, int(index.size * share)), int(usable.sum()))
    if not count:
        return np.zeros_like(usable)
    limit = np.partition(index[usable], count - 1)[count - 1]
    return usable & (index <= limit)


def _strips(prepared: PreparedImage) -> Iterator[tuple[slice, slice, npt.NDArray[np.float32]]]:
    # Yields the rows of a strip in the image, the same rows in the array, and the array, which has `_HALO` extra rows.
    height, step = prepared.height, max(1, _STRIP // prepared.width)
    white = prepared.white or 1.0
    for top in range(0, height, step):
        bottom = min(height, top + step)
        first, last = max(0, top - _HALO), min(height, bottom + _HALO)
        strip = (prepared.image[first:last] / np.float64(white)).astype(np.float32)
        yield slice(top, bottom), slice(top - first, bottom - first), strip


FLAT_SLOPE = 1e-4  # a channel with at most this derivative is flat, fraction of white per pixel (the authors' δ)


def grayness(strip: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the grayness index of image rows and the pixels without index, see `Index`.

    Pixels without gradient, and pixels with a channel of zero, have no index.
    """
    mean = mean_filter(strip)
    missing = (mean <= 0).any(axis=2) | (gradient_length(mean) <= FLAT_SLOPE).all(axis=2)
    log_sum = logarithm(mean.sum(axis=2))
    red, blue = (gradient_length(logarithm(mean[..., channel]) - log_sum) for channel in (0, 2))
    return np.hypot(red, blue), np.asarray(missing, dtype=bool)


@dataclass(frozen=True)
class GraynessIndex(PreparedMethod):
    """Mean colour of the pixels with the lowest grayness index.

    - `name`: name in tables.
    - `share`: fraction of the pixels that is selected, 0 … 1; the authors use 0.001.

    Examples
    --------
    The left half is unevenly lit grey, the right half has random colours; the illuminant is the same:

    >>> shading = np.random.default_rng(0).uniform(0.2, 0.9, (40, 80, 1))
    >>> paint = np.ones((40, 80, 3))
    >>> paint[:, 40:] = np.random.default_rng(1).uniform(0.1, 1, (40, 40, 3))
    >>> GraynessIndex().estimate(shading * paint * [0.5, 1.0, 0.7]).round(2)
    array([0.38, 0.76, 0.53])
    """

    name: str = "Grayness Index"
    share: float = 0.001

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        gray_pixels = self.find_gray_pixels(prepared)
        return unit(prepared.image[gray_pixels].mean(axis=0, dtype=np.float64)) if gray_pixels.any() else GREY

    def find_gray_pixels(self, prepared: PreparedImage) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True for gray pixels."""
        return least_indices(*index_map(prepared, grayness), self.share)


_WEIGHT_SIGMA = 0.2  # σ of a cluster's weight exp(-d / 2σ²), d as a fraction of the image diagonal, from the paper
_MAX_ROUNDS = 50  # limit for iterations of k-means, which needs fewer


@dataclass(frozen=True)
class LocalGraynessIndex(GraynessIndex):
    """Grayness index with an illuminant map. `estimate` returns the mean colour of all selected pixels.

    - `name`: name in tables.
    - `share`: fraction of the pixels that is selected, 0 … 1; the authors use 0.1 for several illuminants.
    - `lights`: number of clusters.
    """

    name: str = "Grayness Index, local"
    share: float = 0.1
    lights: int = 2

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the estimate for each pixel, (H, W, 3) float32, r + g + b = 1; see `method.LocalMethod`."""
        prepared = PreparedImage(image, saturation, mask)
        height, width = prepared.height, prepared.width
        gray_pixels = self.find_gray_pixels(prepared)
        positions = np.argwhere(gray_pixels).astype(np.float64)
        colours = prepared.image[gray_pixels].astype(np.float64)
        if not colours.any():
            return np.tile((GREY / GREY.sum()).astype(np.float32), (height, width, 1))
        centres, member = _k_means(positions, self.lights)
        sums = np.stack([colours[member == cluster].sum(axis=0) for cluster in range(len(centres))])
        has_light = sums.sum(axis=1) > 0
        lights, centres = sums[has_light] / sums[has_light].sum(axis=1, keepdims=True), centres[has_light]
        total = np.zeros((height, width, 3), dtype=np.float32)
        weights = np.zeros((height, width, 1), dtype=np.float32)
        rows, columns = np.ogrid[:height, :width]
        for centre, light in zip(centres, lights, strict=True):
            distance = np.hypot(rows - centre[0], columns - centre[1]) / np.hypot(height, width)
            weight = np.exp(-distance / (2 * _WEIGHT_SIGMA**2)).astype(np.float32)[..., None]
            total += weight * light.astype(np.float32)
            weights += weight
        return total / weights


def _k_means(positions: npt.NDArray[np.float64], count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return the centres (K, 2) of k-means of positions (N, 2), and the cluster (N,) of each position."""
    count = min(count, len(positions))
    order = np.argsort(positions @ np.array([1.0, 1.0]), kind="stable")
    centres = positions[order[(np.arange(count) * 2 + 1) * len(positions) // (2 * count)]]
    member = np.zeros(len(positions), dtype=np.int64)
    for _ in range(_MAX_ROUNDS):
        distances = np.stack([((positions - centre) ** 2).sum(axis=1) for centre in centres])
        nearest = distances.argmin(axis=0)
        centres = np.stack(
            [positions[nearest == k].mean(axis=0) if (nearest == k).any() else centres[k] for k in range(count)]
        )
        if (nearest == member).all():
            break
        member = nearest
    return centres, member


# Largest number of candidates that are clustered, because the time grows with its square. If an image has more, they
# are sampled evenly in reading order. An image of 0.2 megapixels has this number.
MAX_CANDIDATES = 2000
BANDWIDTH = 0.1  # h of the mean shift (the authors' `bandwidth`)
_LARGEST_DISTANCE = 0.01 * BANDWIDTH  # of a colour near a mean: angle (radians) times squared distance
_SMALLEST_STEP = 1e-3 * BANDWIDTH  # of a mean that still moves: distance times angle (radians)
_MERGING_DISTANCE = BANDWIDTH / 2  # of means that form one cluster: distance times angle (radians)
_MAX_STEPS = 100  # limit for steps of a mean, which needs far fewer
# A channel with at most this derivative of its logarithm is flat. Rounding to float32 can cause this value. A step of
# one 16-bit count near white causes 3e-6.
_FLAT_LOG_SLOPE = 2e-6


def angle_to_grey(strip: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the angle between log derivatives and (1, 1, 1), radians, and the pixels without gradient, see `Index`."""
    slopes = gradient_length(logarithm(strip))
    red, green, blue = (slopes[..., channel] for channel in range(3))
    # arctan2 is used, because an arc cosine near 1 cannot resolve angles below 3e-4.
    distance = np.sqrt((green - blue) ** 2 + (blue - red) ** 2 + (red - green) ** 2)
    return np.arctan2(distance, slopes.sum(axis=2)), np.asarray((slopes <= _FLAT_LOG_SLOPE).all(axis=2), dtype=bool)


@dataclass(frozen=True)
class MeanShiftedGrayPixel(PreparedMethod):
    """Mean colour of the largest cluster of gray pixels.

    - `name`: name in tables.
    - `share`: fraction of the pixels that are candidates, 0 … 1; the authors use 0.01.
    """

    name: str = "Mean-shifted Gray Pixel"
    share: float = 0.01

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        index, usable = index_map(prepared, angle_to_grey)
        candidates = least_indices(index, usable, self.share)
        if not candidates.any():
            return GREY
        colours, indices = prepared.image[candidates].astype(np.float64), index[candidates]
        if len(colours) > MAX_CANDIDATES:
            sampled = np.arange(MAX_CANDIDATES) * len(colours) // MAX_CANDIDATES
            colours, indices = colours[sampled], indices[sampled]
        if not colours.any():
            return GREY
        return unit(colours[largest_cluster(colours / colours.max(), indices)].mean(axis=0))


def largest_cluster(colours: npt.NDArray[np.float64], order: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return (N,) bool, True for the colours of the largest mean-shift cluster.

    `colours`: (N, 3) float64, largest value 1. `order`: (N,) float32. In ascending order of these values, a mean starts
    at each colour, except at colours near an earlier mean.

    Examples
    --------
    >>> near = np.array([0.5, 0.8, 0.6]) * np.linspace(0.9, 1, 20)[:, None]
    >>> far = np.array([0.9, 0.3, 0.1]) * np.linspace(0.9, 1, 10)[:, None]
    >>> int(largest_cluster(np.concatenate([near, far]), np.arange(30, dtype=np.float32)).sum())
    20
    """
    directions = colours / np.maximum(np.linalg.norm(colours, axis=1, keepdims=True), np.finfo(float).tiny)
    was_near = np.zeros(len(colours), dtype=bool)
    centres: list[npt.NDArray[np.float64]] = []
    near_counts_by_centre: list[npt.NDArray[np.int64]] = []
    for start in np.argsort(order, kind="stable"):
        if was_near[start]:
            continue
        mean, near_counts = _shift(colours, directions, int(start))
        was_near |= near_counts > 0
        was_near[start] = True
        is_near = [_distance(mean, centre) < _MERGING_DISTANCE for centre in centres]
        if any(is_near):
            # As in the authors' program, the weights of the two means are their numbers of near colours.
            nearest = is_near.index(True)
            shares = np.array([near_counts.sum(), near_counts_by_centre[nearest].sum()], dtype=np.float64)
            centres[nearest] = (mean * shares[0] + centres[nearest] * shares[1]) / shares.sum()
            near_counts_by_centre[nearest] = near_counts_by_centre[nearest] + near_counts
        else:
            centres.append(mean)
            near_counts_by_centre.append(near_counts)
    member = np.stack(near_counts_by_centre).argmax(axis=0)
    return member == np.bincount(member).argmax()


def _shift(
    colours: npt.NDArray[np.float64], directions: npt.NDArray[np.float64], start: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return the final position of a mean, (3,), and how often each colour was near it, (N,)."""
    mean, near_counts = colours[start], np.zeros(len(colours), dtype=np.int64)
    for _ in range(_MAX_STEPS):
        direction = mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny)
        angles = np.arccos(np.clip(directions @ direction, -1, 1))
        is_near = angles * ((colours - mean) ** 2).sum(axis=1) < _LARGEST_DISTANCE
        if not is_near.any():
            break
        near_counts += is_near
        next_mean = directions[is_near].mean(axis=0)
        next_mean /= np.linalg.norm(next_mean)
        is_at_rest = _distance(next_mean, direction) < _SMALLEST_STEP
        mean = next_mean
        if is_at_rest:
            break
    return mean, near_counts


def _distance(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]) -> float:
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.linalg.norm(first - second) * np.arccos(np.clip(cosine, -1, 1)))
