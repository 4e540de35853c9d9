"""Methods that apply another method to patches of an image, or to a reduced image. A patch is a rectangle of the image.

With patches, a global method estimates an illuminant map: A. Gijsenij, R. Lu, T. Gevers, "Color constancy for multiple
light sources", IEEE Transactions on Image Processing 21(2), 2012. The paper groups the estimates into two illuminants.
Here, the number of illuminants is unknown, so estimates are interpolated between patch centres.

Edge-based methods depend on image size and noise. Published results of the Gray-Edge family are for images with a few
hundred pixels per side (360 x 240 in van de Weijer et al.). At full sensor resolution, the strongest edges are noise.
Reducing the image averages this noise.
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

# Number of patches along the shorter side (our choice). A patch must be smaller than a region of one illuminant, but
# have many pixels. The paper uses patches of 5 to 20 px in images of 300 px.
PATCHES = 8


@dataclass(frozen=True)
class PatchwiseMethod:
    """A global method that is applied to each patch of a grid; `estimate` uses the whole image.

    - `method`: the global method.
    - `patches`: number of patches along the shorter side; they are nearly square.

    Examples
    --------
    The left half under a red illuminant, the right half under a blue one:

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
            raise ValueError(f"{self.patches} patches along the shorter side, expected 1 or more; correct the number")

    @property
    def name(self) -> str:
        """Name in tables."""
        return f"{self.method.name} by patches"

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimate of the global method, (3,) float64, camera RGB of length 1; see `method.Method`."""
        return self.method.estimate(image, saturation, mask)

    def estimate_map(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return the estimate for each pixel, (H, W, 3) float32, r + g + b = 1; see `method.LocalMethod`."""
        height, width = image.shape[:2]
        side = max(1.0, min(height, width) / self.patches)
        rows, columns = (_patch_bounds(size, side) for size in (height, width))
        # Calculated for the whole image, because a saturated pixel also excludes its neighbours in the next patch.
        usable = PreparedImage(image, saturation, mask).usable(0)
        lights = np.full((len(rows) - 1, len(columns) - 1, 3), np.nan)
        for i, (top, bottom) in enumerate(pairwise(rows)):
            for j, (left, right) in enumerate(pairwise(columns)):
                patch = np.s_[top:bottom, left:right]
                light = estimate(self.method, PreparedImage(image[patch], None, ~usable[patch]))
                if light is not GREY:
                    lights[i, j] = light / light.sum()
        return _interpolate(fill_unknown(lights), rows, columns)


def fill_unknown(lights: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return illuminants (R, C, 3) float64 with every NaN replaced by the mean of the nearest patches with values.

    If all are NaN, all patches become grey.

    Examples
    --------
    >>> lights = np.array([[[0.5, 0.25, 0.25], [np.nan] * 3, [0.25, 0.25, 0.5]]])
    >>> fill_unknown(lights)[0, 1]
    array([0.375, 0.25 , 0.375])
    """
    is_known = np.isfinite(lights).all(axis=2)
    if not is_known.any():
        return np.full(lights.shape, 1 / 3)
    positions, values, filled = np.argwhere(is_known), lights[is_known], lights.copy()
    for row, column in np.argwhere(~is_known):
        distances = ((positions - (row, column)) ** 2).sum(axis=1)
        filled[row, column] = values[distances == distances.min()].mean(axis=0)
    return filled


def _patch_bounds(size: int, side: float) -> npt.NDArray[np.int64]:
    # First pixels of patches of about `side` px, and the end of the last patch.
    count = max(1, min(size, round(size / side)))
    return np.arange(count + 1, dtype=np.int64) * size // count


def _interpolate(
    lights: npt.NDArray[np.float64], rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64]
) -> npt.NDArray[np.float32]:
    # Linear between patch centres, constant outside the outermost centres.
    values: Any = lights.astype(np.float32)
    for axis, bounds in enumerate((rows, columns)):
        centres = (bounds[:-1] + bounds[1:] - 1) / 2
        pixels = np.arange(int(bounds[-1]), dtype=np.float64)
        patch_position = np.asarray(np.interp(pixels, centres, np.arange(len(centres))), dtype=np.float64)
        low = np.minimum(patch_position.astype(np.int64), max(0, len(centres) - 2))
        high = np.minimum(low + 1, len(centres) - 1)
        share = (patch_position - low).astype(np.float32).reshape(-1, *[1] * (2 - axis))
        values = values.take(low, axis) * (1 - share) + values.take(high, axis) * share
    return values


@dataclass(frozen=True)
class ResizedMethod(PreparedMethod):
    """A method that is applied to images reduced to a given size.

    - `method`: the method.
    - `longest`: length of the longer side after reduction, px; smaller images are not changed.

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
            raise ValueError(f"the longer side is {self.longest} px, expected 1 px or more; correct the length")

    @property
    def name(self) -> str:
        """Name in tables, with the size."""
        return f"{self.method.name} at {self.longest} px"

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate for a prepared image, (3,) float64, camera RGB of length 1."""
        return estimate(self.method, prepared.shrunk(self.longest))
