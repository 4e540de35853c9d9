"""The constant light: what a method reaches that looks at no image, from the lights that it was trained with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features
from evaluation.scene import Image


@dataclass(frozen=True)
class ConstantLight(FeatureLearner):
    """Learns the median of the training lights, and gives it for every image.

    Each of the chromaticities r, g and b of sum 1 has its own median over the training images. A learned method that
    does not beat it has learned the distribution of the lights, and nothing of how they show in an image.
    """

    key: ClassVar[str] = "constant-light"
    title: ClassVar[str] = "Constant light"

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return no feature, (0,) float32, of any image (H, W, 3) and mask (H, W)."""
        del image, saturation, mask
        return np.zeros(0, np.float32)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> MedianLight:
        """Return the median of the lights `truths` (N, 3) float64; `features` (N, 0) say nothing, nothing is random."""
        del features, seed
        return MedianLight(median_light(truths))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> MedianLight:
        """Return the constant light whose array (3,) float64 is given; see `FeatureLearner.restore`."""
        light = np.asarray(arrays["light"], dtype=np.float64)
        if light.shape != (3,) or not (np.isfinite(light) & (light > 0)).all():
            raise ValueError(f"a light {light.tolist()}")
        return MedianLight(light)


@dataclass(frozen=True, eq=False)
class MedianLight:
    """The same light for every image.

    `light`: (3,) float64, linear camera RGB, r + g + b = 1.
    """

    light: npt.NDArray[np.float64]

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the light for each of N images, (N, 3) float64, whatever their features (N, 0)."""
        return np.tile(self.light, (len(features), 1))

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the light (3,) float64 under the name `light`."""
        return {"light": self.light}


def median_light(lights: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the median (3,) float64 of lights (N, 3) float: of each chromaticity by itself, scaled to r + g + b = 1.

    Examples
    --------
    >>> median_light([[1, 2, 1], [10, 10, 20], [3, 4, 1]])
    array([0.25, 0.5 , 0.25])
    """
    given = np.asarray(lights, dtype=np.float64)
    middle = np.asarray(np.median(given / given.sum(axis=1, keepdims=True), axis=0), dtype=np.float64)
    return middle / middle.sum()
