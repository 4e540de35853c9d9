"""Constant estimate, as a baseline that does not use the image."""

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
    """Returns the median of the training illuminants for every image.

    The median is calculated for each of the chromaticities r, g and b. A learned method that is not better than
    this median has learned only the distribution of illuminants.
    """

    key: ClassVar[str] = "constant-light"
    title: ClassVar[str] = "Constant light"

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32]:
        """Return an empty array, (0,) float32."""
        del image, saturation, mask
        return np.zeros(0, np.float32)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> MedianLight:
        """Return the median of the ground truths (N, 3) float64."""
        del features, seed
        return MedianLight(median_light(truths))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> MedianLight:
        """Return the model with the array `light`; see `FeatureLearner.restore`."""
        light = np.asarray(arrays["light"], dtype=np.float64)
        if light.shape != (3,) or not (np.isfinite(light) & (light > 0)).all():
            raise ValueError(f"the illuminant is {light.tolist()}, expected three numbers above 0")
        return MedianLight(light)


@dataclass(frozen=True, eq=False)
class MedianLight:
    """The same estimate for every image: `light`, (3,) float64, linear camera RGB, r + g + b = 1."""

    light: npt.NDArray[np.float64]

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the constant estimate for N images, (N, 3) float64."""
        return np.tile(self.light, (len(features), 1))

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the array `light`."""
        return {"light": self.light}


def median_light(lights: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the median (3,) float64 of each chromaticity of illuminants (N, 3), scaled to r + g + b = 1.

    Examples
    --------
    >>> median_light([[1, 2, 1], [10, 10, 20], [3, 4, 1]])
    array([0.25, 0.5 , 0.25])
    """
    chromaticities = np.asarray(lights, dtype=np.float64)
    middle = np.asarray(np.median(chromaticities / chromaticities.sum(axis=1, keepdims=True), axis=0), dtype=np.float64)
    return middle / middle.sum()
