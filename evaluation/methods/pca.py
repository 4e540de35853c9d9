"""PCA of bright and dark pixels: the light is the main direction of an image's brightest and darkest pixels.

D. Cheng, D. K. Prasad, M. S. Brown, "Illuminant estimation for color constancy: why spatial-domain methods work and
the role of the color distribution", Journal of the Optical Society of America A 31(5), 2014, section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image


@dataclass(frozen=True)
class BrightDark:
    """Principal direction of the brightest and darkest pixels.

    Pixels are projected on the direction of their mean. The light is the first eigenvector of the uncentred
    second-moment matrix of the lowest and the highest `share` of them.

    Attributes
    ----------
    name
        Its name in tables.
    share
        Part of the pixels kept at either end, 0 … 0.5; the authors' value is 0.035.

    Examples
    --------
    >>> shades = np.linspace(10, 1000, 200)[:, None] * np.array([0.5, 1.0, 0.7])
    >>> BrightDark().estimate(shades.reshape(10, 20, 3)).round(3)
    array([0.379, 0.758, 0.531])
    """

    name: str = "PCA bright and dark"
    share: float = 0.035

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64.

        The pixels at either end are found by a histogram of the projections and by sorting its two bins at the limits,
        so nothing of the image's size is made. Of pixels with equal projections those that come first are the lower.
        """
        sums, _, peaks, counts = prepared.moments()
        count = int(counts[0])
        if not sums.any():
            return GREY
        total = self._sum_of_products(prepared, unit(sums), peaks, count)
        return unit(np.abs(np.linalg.eigh(total)[1][:, -1]))

    def _sum_of_products(
        self, prepared: PreparedImage, direction: npt.NDArray[np.float64], peaks: npt.NDArray[np.float64], count: int
    ) -> npt.NDArray[np.float64]:
        """Return the sum of x xᵀ (3, 3) over the pixels at either end."""
        from evaluation.methods.filters.loops import BINS, count_projections, sum_outer_bins

        image: Any = prepared.image
        free = prepared.free()
        step = BINS / float(direction @ peaks)
        below = count_projections(image, free, direction, step).cumsum()
        wanted = max(1, math.ceil(count * self.share))
        # Where both ends together are the whole, every pixel counts once.
        everything = 2 * wanted >= count
        low = 0 if everything else int(np.searchsorted(below, wanted))
        high = BINS - 1 if everything else int(np.searchsorted(below, count - wanted, side="right"))
        inside = sum(int(below[at] - (below[at - 1] if at else 0)) for at in {low, high})
        bordering = np.empty((inside, 4))
        if everything:
            low = high = BINS
        total = sum_outer_bins(image, free, direction, step, low, high, bordering)
        if everything:
            return total
        bins = np.minimum(BINS - 1, (bordering[:, 3] * step).astype(np.int64))
        lower, upper = bordering[bins == low], bordering[bins == high]
        lower = lower[np.argsort(lower[:, 3], kind="stable")][: wanted - (int(below[low - 1]) if low else 0)]
        more = wanted - (count - int(below[high]))
        upper = upper[np.argsort(upper[:, 3], kind="stable")][len(upper) - more :]
        ends = np.concatenate([lower, upper])[:, :3]
        return total + ends.T @ ends
