"""Color Sparrow: local lights from random sprays around the points of a grid, averaged.

N. Banić, S. Lončarić, "Using the Random Sprays Retinex algorithm for global illumination estimation", CCVW 2013: at a
point, Random Sprays Retinex gives the pixel over the maximum of a spray of random pixels around it, dense in the middle
(E. Provenzi et al., 2009). The point's light is the smoothed pixel over the smoothed ratio. Constants are those of the
authors' program, version 0.1; its sprays are rounded to whole numbers before they are scaled to the image, here they
are not, as the paper has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

SPRAYS = 1000
"""Sprays that a point's is chosen from, as in the authors' program."""


@dataclass(frozen=True)
class ColorSparrow:
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

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        import cv2

        from evaluation.methods.retinex.sprays import spray_maxima

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
