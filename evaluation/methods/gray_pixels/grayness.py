"""Gray pixels by the grayness index: on grey surfaces chromaticity does not change with shading and highlights.

Y. Qian, J.-K. Kämäräinen, J. Nikkanen, J. Matas, "On finding gray pixels", CVPR 2019, equations 9 and 10: the index is
the norm of the derivatives of ln R - ln(R + G + B) and ln B - ln(R + G + B). Constants are those of the authors'
program. What differs: edges are continued and not wrapped round; saturated pixels are those that the data set calls so,
not all from 95 % of white.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.gray_pixels.indices import greyest, index_map, logarithm, slope, smooth
from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image

LEAST_CONTRAST = 1e-4
"""Derivative, parts of white a pixel, up to which all channels count as flat (the authors' δ)."""


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
class GraynessIndex:
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

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        chosen = self.find(prepared)
        return unit(prepared.image[chosen].mean(axis=0, dtype=np.float64)) if chosen.any() else GREY

    def find(self, prepared: PreparedImage) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True at the gray pixels."""
        return greyest(*index_map(prepared, grayness), self.share)
