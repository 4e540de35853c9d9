"""Improved White-Patch: maxima over small random samples, averaged.

N. Banić, S. Lončarić, "Improving the White Patch method by subsampling", ICIP 2014: a maximum over few pixels seldom
meets a highlight or a noisy pixel, and the mean of many such maxima is steady. The numbers of pixels and samples are a
reconstruction: the paper gives several, chosen by cross-validation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.methods.pixels import GREY, unit
from evaluation.methods.prepared import PreparedImage
from evaluation.scene import Image


@dataclass(frozen=True)
class ImprovedWhitePatch:
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

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the same of a prepared image: (3,) float64."""
        free = prepared.free()
        flat = prepared.image.reshape(-1, 3)
        places = np.flatnonzero(free) if free.size else None
        count = len(flat) if places is None else len(places)
        if not count:
            return GREY
        drawn = np.random.default_rng(self.seed).integers(0, count, (self.samples, self.pixels))
        values = flat[drawn if places is None else places[drawn]]
        return unit(values.max(axis=1).mean(axis=0, dtype=np.float64))
