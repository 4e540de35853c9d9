"""Methods of the Retinex family: local maxima stand for white.

Color Sparrow
    N. Banić, S. Lončarić, "Using the Random Sprays Retinex algorithm for global illumination estimation", CCVW 2013: at
    a point, Random Sprays Retinex gives the pixel over the maximum of a spray of random pixels around it, dense in the
    middle (E. Provenzi et al., 2009). The point's light is the smoothed pixel over the smoothed ratio; the lights of a
    grid are averaged. Constants are those of the authors' program, version 0.1; its sprays are rounded to whole numbers
    before they are scaled to the image, here they are not, as the paper has it.
Improved White-Patch
    N. Banić, S. Lončarić, "Improving the White Patch method by subsampling", ICIP 2014: a maximum over few pixels
    seldom meets a highlight or a noisy pixel, and the mean of many such maxima is steady. The numbers of pixels and
    samples are a reconstruction: the paper gives several, chosen by cross-validation.
Local Surface Reflectance statistics
    S.-B. Gao, W. Han, K. Yang, C. Li, Y. Li, "Efficient color constancy with local surface reflectance statistics",
    ECCV 2014: the sum of an image's true reflectances over that of its locally normalised ones is nearly achromatic, so
    the light is the sum of the values over the sum of the locally normalised values, channel by channel. A
    reconstruction from the paper's text: the number of patches is not the authors' tuned one, and there is no smoothing
    before.
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
    free: npt.NDArray[np.bool_],
    step: int,
    offsets: npt.NDArray[np.int64],
    chosen: npt.NDArray[np.int64],
) -> npt.NDArray[np.float64]:
    """Return the maxima of each channel over the spray around each point of a grid, (R, C, 3) float64.

    `image`: (H, W, 3) uint16, float32 or float64. `free`: (H, W) bool, True where a pixel may be used, or (0, 0) where
    every one may be. `offsets`: (sprays, N, 2) int64, rows and columns from the point; those that lead out of the image
    are left out. `chosen`: (R, C) int64, the spray of each point.
    """
    height, width = image.shape[:2]
    maxima = np.zeros((chosen.shape[0], chosen.shape[1], 3), np.float64)
    for row in range(chosen.shape[0]):
        for column in range(chosen.shape[1]):
            spray = chosen[row, column]
            for at in range(offsets.shape[1]):
                y, x = row * step + offsets[spray, at, 0], column * step + offsets[spray, at, 1]
                if y < 0 or x < 0 or y >= height or x >= width or (free.size and not free[y, x]):
                    continue
                for channel in range(3):
                    maxima[row, column, channel] = max(maxima[row, column, channel], image[y, x, channel])
    return maxima


@compiled
def patch_sums(
    image: Image, free: npt.NDArray[np.bool_], rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the sums and the maxima of each channel over the usable pixels of patches, (R, C, 3) float64 each.

    `image`: (H, W, 3) uint16, float32 or float64. `free`: (H, W) bool, True where a pixel may be used, or (0, 0) where
    every one may be. `rows`, `columns`: (R + 1,) and (C + 1,) int64, where the patches begin, and the end of the last.
    """
    shape = (rows.size - 1, columns.size - 1, 3)
    sums, maxima = np.zeros(shape, np.float64), np.zeros(shape, np.float64)
    for i in range(shape[0]):
        for y in range(rows[i], rows[i + 1]):
            for j in range(shape[1]):
                for x in range(columns[j], columns[j + 1]):
                    if free.size and not free[y, x]:
                        continue
                    for channel in range(3):
                        value = float(image[y, x, channel])
                        sums[i, j, channel] += value
                        maxima[i, j, channel] = max(maxima[i, j, channel], value)
    return sums, maxima


SPRAYS = 1000  # Sprays that a point's is chosen from, as in the authors' program


@dataclass(frozen=True)
class ColorSparrow(PreparedMethod):
    """Mean of local lights by random sprays.

    - `name`: its name in tables.
    - `spray`: n, pixels of a spray.
    - `step`: r and c, px between points of the grid.
    - `kernel`: k, side of the mean filter over the grid, points.
    - `seed`: of the sprays; the same image gives the same estimate.

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
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        import cv2

        rows, columns = np.arange(0, prepared.height, self.step), np.arange(0, prepared.width, self.step)
        radius = math.hypot(prepared.height, prepared.width)
        offsets = (_sprays(self.seed, self.spray) * radius).astype(np.int64)
        chosen = np.random.default_rng((self.seed, 1)).integers(0, SPRAYS, (len(rows), len(columns)))
        image: Any = prepared.image
        maxima = spray_maxima(image, prepared.free(), self.step, offsets, chosen)
        points = prepared.image[:: self.step, :: self.step].astype(np.float64)
        used = prepared.usable(0)[:: self.step, :: self.step] & (points > 0).all(axis=2) & (maxima > 0).all(axis=2)
        if not used.any():
            return GREY
        ratios = np.where(used[..., None], np.minimum(points / np.where(maxima > 0, maxima, 1), 1), 0)
        size = (self.kernel, self.kernel)
        # Both are means over the same points, so their number cancels.
        above = cv2.blur(np.where(used[..., None], points, 0), size, borderType=cv2.BORDER_CONSTANT)
        below = cv2.blur(ratios, size, borderType=cv2.BORDER_CONSTANT)
        lights = np.asarray(above).reshape(points.shape)[used] / np.asarray(below).reshape(points.shape)[used]
        return unit(lights.mean(axis=0))


@cache
def _sprays(seed: int, count: int) -> npt.NDArray[np.float64]:
    """Return sprays (SPRAYS, count, 2): rows and columns from the middle, in parts of the radius."""
    random = np.random.default_rng((seed, 0))
    angle, distance = random.uniform(0, 2 * np.pi, (SPRAYS, count)), random.uniform(0, 1, (SPRAYS, count))
    sprays = distance[..., None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    sprays.setflags(write=False)
    return sprays


@dataclass(frozen=True)
class ImprovedWhitePatch(PreparedMethod):
    """Mean of the maxima of each channel over random samples of pixels.

    - `name`: its name in tables.
    - `pixels`: N, pixels of a sample, drawn with repetition from the usable ones.
    - `samples`: M, samples.
    - `seed`: of the draws; the same image gives the same estimate.

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
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        free = prepared.free()
        flat = prepared.image.reshape(-1, 3)
        places = np.flatnonzero(free) if free.size else None
        count = len(flat) if places is None else len(places)
        if not count:
            return GREY
        drawn = np.random.default_rng(self.seed).integers(0, count, (self.samples, self.pixels))
        values = flat[drawn if places is None else places[drawn]]
        return unit(values.max(axis=1).mean(axis=0, dtype=np.float64))


@dataclass(frozen=True)
class SurfaceReflectance(PreparedMethod):
    """Ratio of the sum of values to the sum of locally normalised values.

    - `name`: its name in tables.
    - `patches`: patches along either side of the image; at least one pixel each.

    Examples
    --------
    A dark colourful half counts less than the grey half that it stands beside:

    >>> image = np.ones((20, 40, 3)) * np.linspace(0.2, 1, 20)[:, None, None]
    >>> image[:, 20:] *= [0.3, 0.1, 0.1]
    >>> SurfaceReflectance(patches=2).estimate(image).round(2)
    array([0.64, 0.54, 0.54])
    """

    name: str = "Local Surface Reflectance"
    patches: int = 10

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        rows, columns = (
            np.arange(min(self.patches, size) + 1) * size // min(self.patches, size)
            for size in (prepared.height, prepared.width)
        )
        image: Any = prepared.image
        sums, maxima = patch_sums(image, prepared.free(), rows, columns)
        normalised = np.divide(sums, maxima, out=np.zeros_like(sums), where=maxima > 0).sum(axis=(0, 1))
        total = sums.sum(axis=(0, 1))
        if not total.any():
            return GREY
        return unit(np.divide(total, normalised, out=np.zeros(3), where=normalised > 0))
