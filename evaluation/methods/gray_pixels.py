"""Methods that find pixels of grey surfaces by their derivatives, and take the light from their mean colour.

Indices are found in strips; a map has 4 bytes a pixel, its smoothing as many again. Values are taken in parts of white:
of the saturation where one is known, else of the image's largest value. Edges are continued by their last pixel, where
the authors' programs wrap round; saturated pixels are those that the data set calls so. Constants are the authors'.

Grayness index
    Y. Qian, J.-K. Kämäräinen, J. Nikkanen, J. Matas, "On finding gray pixels", CVPR 2019, equations 9 and 10: on grey
    surfaces chromaticity does not change with shading and highlights, so that the index is the norm of the derivatives
    of ln R - ln(R + G + B) and ln B - ln(R + G + B).
The same under several lights
    K.-F. Yang, S.-B. Gao, Y.-J. Li, "Efficient illuminant estimation for color constancy using grey pixels", CVPR 2015,
    section 3.3, equations 15 to 17: the places of gray pixels are clustered, each cluster gives a light, near clusters
    weigh more. A reconstruction in this: k-means starts from evenly spread gray pixels, so that a map is always the
    same.
Mean-shifted gray pixels
    Y. Qian, S. Pertuz, J. Nikkanen, J.-K. Kämäräinen, J. Matas, "Revisiting gray pixel for statistical illumination
    estimation", VISAPP 2019 (and 2020 in its longer form): candidates are the pixels whose derivatives of ln R, ln G,
    ln B point most nearly to grey; they are clustered by mean shift, and the largest cluster gives the light. At most
    `MOST_CANDIDATES` of them are clustered, evenly over their order in the image, since the time grows with the square
    of their number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod, unit
from evaluation.scene import Image

SIGMA = 0.5  # Scale of the derivatives, px, of both methods' programs
SMOOTHING = 7  # Side of the mean filters, px, of both methods' programs
DARK = 8 / 255  # Sum of red, green and blue, in parts of white, up to which the authors' examples leave a pixel out
_KERNEL_REACH = 2  # Of the derivative's kernel: exp(-x² / 2σ²) above 1e-6, as in the authors' program
_HALO = 8  # Rows that a pixel's index comes from on either side: mean filter and derivative, with some to spare
_STRIP = 1 << 20  # Pixels of a strip: 12 MB a float32 colour image
_LEAST = float(np.finfo(np.float64).eps)  # Stands for zero in a logarithm, as in the authors' programs

# From a strip (H, W, 3) float32, parts of white: the index (H, W) float32, and (H, W) bool, True where it has none.
Index = Callable[[npt.NDArray[np.float32]], tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]]


def slope(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the gradient's length of each channel of values (H, W) or (H, W, C) float32, in the same shape.

    By the authors' kernel -x exp(-(x² + y²) / 2σ²) / (π σ²), which gives 0.54 for a ramp of 1 a pixel.
    """
    import cv2

    x = np.arange(-_KERNEL_REACH, _KERNEL_REACH + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * SIGMA**2))
    odd = x * bell / (np.pi * SIGMA**2)
    along_x = cv2.sepFilter2D(values, cv2.CV_32F, odd, bell, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.sepFilter2D(values, cv2.CV_32F, bell, odd, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.magnitude(along_x, along_y), dtype=np.float32).reshape(values.shape)


def smooth(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the means over 7 x 7 px of values (H, W) or (H, W, C) float32, in the same shape."""
    import cv2

    filtered = cv2.blur(values, (SMOOTHING, SMOOTHING), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(filtered, dtype=np.float32).reshape(values.shape)


def logarithm(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return ln of values of any shape, float32, zeros taken as the smallest distinguishable part of 1."""
    return np.log(np.where(values > 0, values, np.float32(_LEAST)))


def index_map(prepared: PreparedImage, index: Index) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return a smoothed index of each pixel, (H, W) float32, and (H, W) bool, True where a pixel may be chosen.

    Pixels that must not be used, are dark, or have no index get the largest index before the map is smoothed, so that
    their neighbours are chosen late.
    """
    found = np.empty((prepared.height, prepared.width), dtype=np.float32)
    usable = prepared.usable(0).copy()
    for rows, inner, strip in _strips(prepared):
        values, missing = index(strip)
        found[rows] = values[inner]
        usable[rows] &= ~missing[inner] & (strip[inner].sum(axis=2) > DARK)
    usable &= np.isfinite(found)
    if not usable.any():
        return found, usable
    found[~usable] = found[usable].max()
    return smooth(found), usable


def greyest(index: npt.NDArray[np.float32], usable: npt.NDArray[np.bool_], share: float) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True at the pixels with the lowest index.

    `index`: (H, W) float32. `usable`: (H, W) bool, True where a pixel may be chosen. `share`: part of all pixels of the
    image that are chosen, 0 … 1; at least one.
    """
    count = min(max(1, int(index.size * share)), int(usable.sum()))
    if not count:
        return np.zeros_like(usable)
    limit = np.partition(index[usable], count - 1)[count - 1]
    return usable & (index <= limit)


def _strips(prepared: PreparedImage) -> Iterator[tuple[slice, slice, npt.NDArray[np.float32]]]:
    """Yield the rows of a strip in the image, where they lie in the strip, and the strip with its halo."""
    height, step = prepared.height, max(1, _STRIP // prepared.width)
    white = prepared.white or 1.0
    for top in range(0, height, step):
        bottom = min(height, top + step)
        first, last = max(0, top - _HALO), min(height, bottom + _HALO)
        strip = (prepared.image[first:last] / np.float64(white)).astype(np.float32)
        yield slice(top, bottom), slice(top - first, bottom - first), strip


LEAST_CONTRAST = 1e-4  # Derivative, parts of white a pixel, up to which all channels count as flat (the authors' δ)


def grayness(strip: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the grayness index of a strip (H, W, 3) float32, parts of white.

    Returns the index (H, W) float32; and (H, W) bool, True where it says nothing: flat or with a channel of zero.
    """
    mean = smooth(strip)
    missing = (mean <= 0).any(axis=2) | (slope(mean) <= LEAST_CONTRAST).all(axis=2)
    log_sum = logarithm(mean.sum(axis=2))
    red, blue = (slope(logarithm(mean[..., channel]) - log_sum) for channel in (0, 2))
    return np.hypot(red, blue), np.asarray(missing, dtype=bool)


@dataclass(frozen=True)
class GraynessIndex(PreparedMethod):
    """Mean colour of the pixels with the lowest grayness index.

    - `name`: its name in tables.
    - `share`: part of the pixels that are taken, 0 … 1; 0.001 is the authors' choice.

    Examples
    --------
    Shades of grey beside a colour, both lit unevenly, under one light:

    >>> shading = np.random.default_rng(0).uniform(0.2, 0.9, (40, 80, 1))
    >>> paint = np.ones((40, 80, 3))
    >>> paint[:, 40:] = np.random.default_rng(1).uniform(0.1, 1, (40, 40, 3))
    >>> GraynessIndex().estimate(shading * paint * [0.5, 1.0, 0.7]).round(2)
    array([0.38, 0.76, 0.53])
    """

    name: str = "Grayness Index"
    share: float = 0.001

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        chosen = self.find(prepared)
        return unit(prepared.image[chosen].mean(axis=0, dtype=np.float64)) if chosen.any() else GREY

    def find(self, prepared: PreparedImage) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True at the gray pixels."""
        return greyest(*index_map(prepared, grayness), self.share)


_WIDTH = 0.2  # σ of a cluster's weight exp(-d / 2σ²), d in parts of the image's diagonal, as in the paper
_ROUNDS = 50  # Rounds of k-means, more than it takes


@dataclass(frozen=True)
class LocalGraynessIndex(GraynessIndex):
    """The grayness index with a map of lights; `estimate` is that of the global method with the same share.

    - `name`: its name in tables.
    - `share`: part of the pixels that are taken, 0 … 1; for several lights the authors take 10 %.
    - `lights`: number of clusters.
    """

    name: str = "Grayness Index, local"
    share: float = 0.1
    lights: int = 2

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1; see `method.LocalMethod.estimate_map`."""
        prepared = PreparedImage(image, saturation, mask)
        height, width = prepared.height, prepared.width
        chosen = self.find(prepared)
        places = np.argwhere(chosen).astype(np.float64)
        colours = prepared.image[chosen].astype(np.float64)
        if not colours.any():
            return np.tile((GREY / GREY.sum()).astype(np.float32), (height, width, 1))
        centres, member = _clusters(places, self.lights)
        sums = np.stack([colours[member == one].sum(axis=0) for one in range(len(centres))])
        kept = sums.sum(axis=1) > 0
        lights, centres = sums[kept] / sums[kept].sum(axis=1, keepdims=True), centres[kept]
        total = np.zeros((height, width, 3), dtype=np.float32)
        weights = np.zeros((height, width, 1), dtype=np.float32)
        rows, columns = np.ogrid[:height, :width]
        for centre, light in zip(centres, lights, strict=True):
            distance = np.hypot(rows - centre[0], columns - centre[1]) / np.hypot(height, width)
            weight = np.exp(-distance / (2 * _WIDTH**2)).astype(np.float32)[..., None]
            total += weight * light.astype(np.float32)
            weights += weight
        return total / weights


def _clusters(places: npt.NDArray[np.float64], count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return the centres (K, 2) of k-means of places (N, 2), and the cluster (N,) of each."""
    count = min(count, len(places))
    along = np.argsort(places @ np.array([1.0, 1.0]), kind="stable")
    centres = places[along[(np.arange(count) * 2 + 1) * len(places) // (2 * count)]]
    member = np.zeros(len(places), dtype=np.int64)
    for _ in range(_ROUNDS):
        distances = np.stack([((places - centre) ** 2).sum(axis=1) for centre in centres])
        nearest = distances.argmin(axis=0)
        centres = np.stack(
            [places[nearest == one].mean(axis=0) if (nearest == one).any() else centres[one] for one in range(count)]
        )
        if (nearest == member).all():
            break
        member = nearest
    return centres, member


MOST_CANDIDATES = 2000  # Candidates that are clustered: as many as a photograph of 0.2 megapixels has
BANDWIDTH = 0.1  # h of the mean shift (the authors' `bandwidth`)
_REACH = 0.01 * BANDWIDTH  # Angle in radians times squared distance below which a colour belongs to a mean
_STILL = 1e-3 * BANDWIDTH  # Distance times angle of a step below which a mean has arrived
_MERGED = BANDWIDTH / 2  # Distance times angle below which two means are one cluster
_MOST_STEPS = 100  # Steps of a mean, many times what it takes
# Derivative of a logarithm up to which a channel counts as flat: rounding to float32 makes as much where nothing
# changes, and a step of one count of 16 bits below white makes 8e-6.
_FLAT = 2e-6


def angle_to_grey(strip: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return the angle of the log derivatives of a strip (H, W, 3) float32 to grey.

    Returns the angle (H, W) float32, radians; and (H, W) bool, True where no channel changes.
    """
    slopes = slope(logarithm(strip))
    red, green, blue = (slopes[..., channel] for channel in range(3))
    # An arc cosine near 1 knows a small angle to 3e-4 only, which rounding then decides, another on each processor.
    across = np.sqrt((green - blue) ** 2 + (blue - red) ** 2 + (red - green) ** 2)
    return np.arctan2(across, slopes.sum(axis=2)), np.asarray((slopes <= _FLAT).all(axis=2), dtype=bool)


@dataclass(frozen=True)
class MeanShiftedGrayPixel(PreparedMethod):
    """Mean colour of the largest cluster of gray pixels.

    - `name`: its name in tables.
    - `share`: part of the pixels that are candidates, 0 … 1; 0.01 is the authors' choice.
    """

    name: str = "Mean-shifted Gray Pixel"
    share: float = 0.01

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        index, usable = index_map(prepared, angle_to_grey)
        chosen = greyest(index, usable, self.share)
        if not chosen.any():
            return GREY
        colours, indices = prepared.image[chosen].astype(np.float64), index[chosen]
        if len(colours) > MOST_CANDIDATES:
            taken = np.arange(MOST_CANDIDATES) * len(colours) // MOST_CANDIDATES
            colours, indices = colours[taken], indices[taken]
        if not colours.any():
            return GREY
        return unit(colours[largest_cluster(colours / colours.max(), indices)].mean(axis=0))


def largest_cluster(colours: npt.NDArray[np.float64], order: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Return (N,) bool, True for the colours of the largest cluster that mean shift finds.

    `colours`: (N, 3) float64, the largest number 1. `order`: (N,) float32; means start from the colours in this order
    that no mean has met yet.

    Examples
    --------
    >>> near = np.array([0.5, 0.8, 0.6]) * np.linspace(0.9, 1, 20)[:, None]
    >>> far = np.array([0.9, 0.3, 0.1]) * np.linspace(0.9, 1, 10)[:, None]
    >>> int(largest_cluster(np.concatenate([near, far]), np.arange(30, dtype=np.float32)).sum())
    20
    """
    directions = colours / np.maximum(np.linalg.norm(colours, axis=1, keepdims=True), np.finfo(float).tiny)
    met = np.zeros(len(colours), dtype=bool)
    centres: list[npt.NDArray[np.float64]] = []
    votes: list[npt.NDArray[np.int64]] = []
    for start in np.argsort(order, kind="stable"):
        if met[start]:
            continue
        mean, counted = _shift(colours, directions, int(start))
        met |= counted > 0
        met[start] = True
        merged = [_step(mean, centre) < _MERGED for centre in centres]
        if any(merged):
            # The authors weigh the two means by their members; the cluster's own members do not move.
            at = merged.index(True)
            shares = np.array([counted.sum(), votes[at].sum()], dtype=np.float64)
            centres[at] = (mean * shares[0] + centres[at] * shares[1]) / shares.sum()
            votes[at] = votes[at] + counted
        else:
            centres.append(mean)
            votes.append(counted)
    member = np.stack(votes).argmax(axis=0)
    return member == np.bincount(member).argmax()


def _shift(
    colours: npt.NDArray[np.float64], directions: npt.NDArray[np.float64], start: int
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """Return where a mean comes to rest, (3,), and how often each colour was in its reach, (N,)."""
    mean, counted = colours[start], np.zeros(len(colours), dtype=np.int64)
    for _ in range(_MOST_STEPS):
        direction = mean / max(float(np.linalg.norm(mean)), np.finfo(float).tiny)
        angles = np.arccos(np.clip(directions @ direction, -1, 1))
        inside = angles * ((colours - mean) ** 2).sum(axis=1) < _REACH
        if not inside.any():
            break
        counted += inside
        following = directions[inside].mean(axis=0)
        following /= np.linalg.norm(following)
        arrived = _step(following, direction) < _STILL
        mean = following
        if arrived:
            break
    return mean, counted


def _step(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> float:
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.linalg.norm(one - other) * np.arccos(np.clip(cosine, -1, 1)))
