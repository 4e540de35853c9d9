"""Local Surface Reflectance statistics: what is summed over what is summed after each patch is divided by its maximum.

S.-B. Gao, W. Han, K. Yang, C. Li, Y. Li, "Efficient color constancy with local surface reflectance statistics", ECCV
2014: the sum of an image's true reflectances over that of its locally normalised ones is nearly achromatic, so the
light is the sum of the values over the sum of the locally normalised values, channel by channel. A reconstruction from
the paper's text: the number of patches is not the authors' tuned one, and there is no smoothing before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image


@dataclass(frozen=True)
class SurfaceReflectance:
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

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        from evaluation.methods.retinex.sprays import patch_sums

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
