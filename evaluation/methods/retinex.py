"""Methods of the Retinex family, which take local maxima as white.

Color Sparrow
    N. Banić, S. Lončarić, "Using the Random Sprays Retinex algorithm for global illumination estimation", CCVW 2013. At
    each point of a grid, Random Sprays Retinex divides the pixel by the maximum of a spray. A spray is a set of random
    pixels around the point, denser near the point (E. Provenzi et al., 2009). The illuminant at a point is the smoothed
    pixel divided by the smoothed ratio. The estimate is the mean over all points. Constants are from the authors'
    program, version 0.1. The program rounds the positions in a spray before it scales them to the image. Here, as in
    the paper, they are not rounded.
Improved White-Patch
    N. Banić, S. Lončarić, "Improving the White Patch method by subsampling", ICIP 2014. A sample of few pixels rarely
    includes a highlight or a noisy pixel, and the mean of the maxima of several samples is stable. The paper selects
    the numbers of pixels and samples by cross-validation; here they are fixed.
Local Surface Reflectance statistics
    S.-B. Gao, W. Han, K. Yang, C. Li, Y. Li, "Efficient color constancy with local surface reflectance statistics",
    ECCV 2014. The estimate of a channel is the sum of its values divided by the sum of its locally normalised values:
    the values of each image patch divided by their maximum. The same ratio of surface reflectances is nearly
    achromatic. The paper tunes the number of patches and smooths images; here the number is fixed, and images are not
    smoothed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod, unit
from evaluation.scene import Image
from foundation.compiled import compiled


@compiled
def spray_maxima(
    image: Image,
    usable: npt.NDArray[np.bool_],
    step: int,
    offsets: npt.NDArray[np.int64],
    spray_indices: npt.NDArray[np.int64],
) -> npt.NDArray[np.float64]:
    """Return the maxima of each channel over the spray around each point of a grid, (R, C, 3) float64.

    `usable`: (H, W) bool, or (0, 0) if all pixels are usable. `offsets`: (sprays, N, 2) int64, rows and columns from
    the point; pixels outside the image are ignored. `spray_indices`: (R, C) int64, spray of each point.
    """
    height, width = image.shape[:2]
    maxima = np.zeros((spray_indices.shape[0], spray_indices.shape[1], 3), np.float64)
    for row in range(spray_indices.shape[0]):
        for column in range(spray_indices.shape[1]):
            spray = spray_indices[row, column]
            for i in range(offsets.shape[1]):
                y, x = row * step + offsets[spray, i, 0], column * step + offsets[spray, i, 1]
                if y < 0 or x < 0 or y >= height or x >= width or (usable.size and not usable[y, x]):
                    continue
                for channel in range(3):
                    maxima[row, column, channel] = max(maxima[row, column, channel], image[y, x, channel])
    return maxima


@compiled
def patch_sums(
    image: Image, usable: npt.NDArray[np.bool_], rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return sums and maxima of each channel over the usable pixels of patches, (R, C, 3) float64 each.

    `usable`: (H, W) bool, or (0, 0) if all pixels are usable. `rows`, `columns`: (R + 1,) and (C + 1,) int64, first
    row and column of each patch, and the end of the last patch.
    """
    shape = (rows.size - 1, columns.size - 1, 3)
    sums, maxima = np.zeros(shape, np.float64), np.zeros(shape, np.float64)
    for i in range(shape[0]):
        for y in range(rows[i], rows[i + 1]):
            for j in range(shape[1]):
                for x in range(columns[j], columns[j + 1]):
                    if usable.size and not usable[y, x]:
                        continue
                    for channel in range(3):
                        value = float(image[y, x, channel])
                        sums[i, j, channel] += value
                        maxima[i, j, channel] = max(maxima[i, j, channel], value)
    return sums, maxima


SPRAY_COUNT = 1000  # number of different sprays; each point uses one of them, as in the authors' program


@dataclass(frozen=True)
class ColorSparrow(PreparedMethod):
    """Mean of local estimates from random sprays.

    - `name`: name in tables.
    - `spray`: n, pixels per spray.
    - `step`: r and c, distance between grid points, px.
    - `kernel`: k, side of the mean filter over the grid, points.
    - `seed`: seed of the random sprays.

    Examples
    --------
    >>> shades = np.random.default_rng(0).uniform(1, 1000, (60, 80, 1)) * np.array([0.5, 1.0, 0.7])
    >>> ColorSparrow().estimate(shades).round(3)
    array([0.379, 0.758, 0.531])
    """

    name: str = "Color Sparrow"
    spray: int = 225
    step: int = 10
    kernel: int = 5
    seed: int = 0

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        import cv2

        rows, columns = np.arange(0, prepared.height, self.step), np.arange(0, prepared.width, self.step)
        radius = math.hypot(prepared.height, prepared.width)
        offsets = (_draw_sprays(self.seed, self.spray) * radius).astype(np.int64)
        spray_indices = np.random.default_rng((self.seed, 1)).integers(0, SPRAY_COUNT, (len(rows), len(columns)))
        image: Any = prepared.image
        maxima = spray_maxima(image, prepared.usable_or_empty(), self.step, offsets, spray_indices)
        points = prepared.image[:: self.step, :: self.step].astype(np.float64)
        is_used = prepared.usable(0)[:: self.step, :: self.step] & (points > 0).all(axis=2) & (maxima > 0).all(axis=2)
        if not is_used.any():
            return GREY
        ratios = np.where(is_used[..., None], np.minimum(points / np.where(maxima > 0, maxima, 1), 1), 0)
        size = (self.kernel, self.kernel)
        # Both filters include the same points, so the number of used points cancels in the ratio.
        sums = cv2.blur(np.where(is_used[..., None], points, 0), size, borderType=cv2.BORDER_CONSTANT)
        divisors = cv2.blur(ratios, size, borderType=cv2.BORDER_CONSTANT)
        lights = np.asarray(sums).reshape(points.shape)[is_used] / np.asarray(divisors).reshape(points.shape)[is_used]
        return unit(lights.mean(axis=0))


@cache
def _draw_sprays(seed: int, count: int) -> npt.NDArray[np.float64]:
    # Rows and columns from the middle of the spray, (SPRAY_COUNT, count, 2), as fractions of its radius.
    random = np.random.default_rng((seed, 0))
    angle, distance = random.uniform(0, 2 * np.pi, (SPRAY_COUNT, count)), random.uniform(0, 1, (SPRAY_COUNT, count))
    sprays = distance[..., None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    sprays.setflags(write=False)
    return sprays


@dataclass(frozen=True)
class ImprovedWhitePatch(PreparedMethod):
    """Mean of the maxima of each channel over random samples of pixels.

    - `name`: name in tables.
    - `pixels`: N, pixels of a sample, drawn with repetition from the usable pixels.
    - `samples`: M, number of samples.
    - `seed`: seed of the random samples.

    Examples
    --------
    >>> shades = np.linspace(10, 1000, 200)[:, None] * np.array([0.5, 1.0, 0.7])
    >>> ImprovedWhitePatch().estimate(shades.reshape(10, 20, 3)).round(3)
    array([0.379, 0.758, 0.531])
    """

    name: str = "Improved White-Patch"
    pixels: int = 60
    samples: int = 20
    seed: int = 0

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        usable = prepared.usable_or_empty()
        flat = prepared.image.reshape(-1, 3)
        positions = np.flatnonzero(usable) if usable.size else None
        count = len(flat) if positions is None else len(positions)
        if not count:
            return GREY
        drawn = np.random.default_rng(self.seed).integers(0, count, (self.samples, self.pixels))
        values = flat[drawn if positions is None else positions[drawn]]
        return unit(values.max(axis=1).mean(axis=0, dtype=np.float64))


@dataclass(frozen=True)
class SurfaceReflectance(PreparedMethod):
    """Ratio of the sum of values to the sum of locally normalised values.

    - `name`: name in tables.
    - `patches`: number of patches along each side of the image; limited by the number of pixels.

    Examples
    --------
    The dark coloured half of this image has less weight than the grey half:

    >>> image = np.ones((20, 40, 3)) * np.linspace(0.2, 1, 20)[:, None, None]
    >>> image[:, 20:] *= [0.3, 0.1, 0.1]
    >>> SurfaceReflectance(patches=2).estimate(image).round(2)
    array([0.64, 0.54, 0.54])
    """

    name: str = "Local Surface Reflectance"
    patches: int = 10

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        rows, columns = (
            np.arange(min(self.patches, size) + 1) * size // min(self.patches, size)
            for size in (prepared.height, prepared.width)
        )
        image: Any = prepared.image
        sums, maxima = patch_sums(image, prepared.usable_or_empty(), rows, columns)
        normalised = np.divide(sums, maxima, out=np.zeros_like(sums), where=maxima > 0).sum(axis=(0, 1))
        total = sums.sum(axis=(0, 1))
        if not total.any():
            return GREY
        return unit(np.divide(total, normalised, out=np.zeros(3), where=normalised > 0))
