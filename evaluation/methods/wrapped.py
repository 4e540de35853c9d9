"""Methods around another method: by patches of an image, or on a smaller image.

By patches a global method gives a map of lights for scenes under several: A. Gijsenij, R. Lu, T. Gevers, "Color
constancy for multiple light sources", IEEE Transactions on Image Processing 21(2), 2012. Here the estimates are
interpolated between the patches' centres instead of grouped into two lights, which the paper does where the number of
lights is known; patches without a usable pixel take the mean of the nearest that have one.

Methods of edges want the size, and the noise, of the images they were tuned on: published numbers of the Gray-Edge
family come from images of some hundred pixels across (van de Weijer et al. had 360 x 240); at the size of a sensor each
pixel's noise is the strongest edge. Shrinking averages it away. Only the mean of usable pixels counts: a smaller pixel
is masked where half or more of what it stands for must not be used.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Method
from evaluation.methods.prepared import GREY, PreparedImage, PreparedMethod, estimate
from evaluation.scene import Image

# Patches along the shorter side: of a photograph of two lights each is small beside a lit region, and has many
# pixels. A judgement; the paper's patches are of 5 to 20 px on images of 300.
PATCHES = 8


@dataclass(frozen=True)
class PatchwiseMethod:
    """A global method that is asked for each patch of a grid; its `estimate` is that of the whole image.

    `patches`: patches along the shorter side; those along the longer side are as nearly square as can be.

    Examples
    --------
    The left half under a red light, the right half under a blue one:

    >>> from evaluation.methods.standard import standard_methods
    >>> image = np.ones((40, 80, 3))
    >>> image[:, :40], image[:, 40:] = [2, 1, 1], [1, 1, 2]
    >>> lights = PatchwiseMethod(standard_methods()["gray-world"], patches=4).estimate_map(image)
    >>> lights[20, [0, 39, 40, 79]].round(2)
    array([[0.5 , 0.25, 0.25],
           [0.39, 0.25, 0.36],
           [0.36, 0.25, 0.39],
           [0.25, 0.25, 0.5 ]], dtype=float32)
    """

    method: Method
    patches: int = PATCHES

    def __post_init__(self) -> None:
        if self.patches < 1:
            raise ValueError(f"{self.patches} patches along the shorter side, expected 1 or more")

    @property
    def name(self) -> str:
        """The method's name in tables, with the patches."""
        return f"{self.method.name} by patches"

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the global method's light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.method.estimate(image, saturation, mask)

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1; see `method.LocalMethod.estimate_map`."""
        height, width = image.shape[:2]
        side = max(1.0, min(height, width) / self.patches)
        rows, columns = (_bounds(size, side) for size in (height, width))
        # Saturated pixels spread to their neighbours, so they are found in the whole image and not patch by patch.
        usable = PreparedImage(image, saturation, mask).usable(0)
        lights = np.full((len(rows) - 1, len(columns) - 1, 3), np.nan)
        for i, (top, bottom) in enumerate(pairwise(rows)):
            for j, (left, right) in enumerate(pairwise(columns)):
                part = np.s_[top:bottom, left:right]
                light = estimate(self.method, PreparedImage(image[part], None, ~usable[part]))
                if light is not GREY:
                    lights[i, j] = light / light.sum()
        return _interpolate(fill_unknown(lights), rows, columns)


def fill_unknown(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return lights (R, C, 3) float64 where those with NaN are the mean of the nearest known ones.

    Nearest in patches; grey where none is known.

    Examples
    --------
    >>> lights = np.array([[[0.5, 0.25, 0.25], [np.nan] * 3, [0.25, 0.25, 0.5]]])
    >>> fill_unknown(lights)[0, 1]
    array([0.375, 0.25 , 0.375])
    """
    known = np.isfinite(lights).all(axis=2)
    if not known.any():
        return np.full(lights.shape, 1 / 3)
    places, values, filled = np.argwhere(known), lights[known], lights.copy()
    for row, column in np.argwhere(~known):
        distances = ((places - (row, column)) ** 2).sum(axis=1)
        filled[row, column] = values[distances == distances.min()].mean(axis=0)
    return filled


def _bounds(size: int, side: float) -> npt.NDArray[np.int64]:
    """Return where patches of about `side` px begin, and the end of the last."""
    count = max(1, min(size, round(size / side)))
    return np.arange(count + 1, dtype=np.int64) * size // count


def _interpolate(
    lights: npt.NDArray[np.float64], rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    """Return the lights (R, C, 3) of patches at every pixel: linear between their centres, constant beyond."""
    values: Any = lights.astype(np.float32)
    for axis, bounds in enumerate((rows, columns)):
        centres = (bounds[:-1] + bounds[1:] - 1) / 2
        places = np.arange(int(bounds[-1]), dtype=np.float64)
        at = np.asarray(np.interp(places, centres, np.arange(len(centres))), dtype=np.float64)
        low = np.minimum(at.astype(np.int64), max(0, len(centres) - 2))
        high = np.minimum(low + 1, len(centres) - 1)
        share = (at - low).astype(np.float32).reshape(-1, *[1] * (2 - axis))
        values = values.take(low, axis) * (1 - share) + values.take(high, axis) * share
    return values


@dataclass(frozen=True)
class ResizedMethod(PreparedMethod):
    """A method that sees images no larger than a given size.

    `longest`: longer side that images are shrunk to, px; smaller images are left as they are.

    Examples
    --------
    >>> from evaluation.methods.standard import standard_methods
    >>> small = ResizedMethod(standard_methods()["gray-edge-2"], longest=512)
    >>> small.name
    '2nd-order Gray-Edge at 512 px'
    """

    method: Method
    longest: int

    def __post_init__(self) -> None:
        if self.longest < 1:
            raise ValueError(f"images of {self.longest} px, expected 1 or more")

    @property
    def name(self) -> str:
        """The method's name in tables, with the size."""
        return f"{self.method.name} at {self.longest} px"

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the light of a prepared image: (3,) float64, camera RGB of length 1."""
        return estimate(self.method, prepared.at_most(self.longest))
