"""Smart Color Cat: the light's place on a line of lights from the histogram of red chromaticities.

N. Banić, S. Lončarić, "Using the red chromaticity for illumination estimation", ISPA 2015. Lights of real scenes lie
near a line in the rb-chromaticity plane; the histogram of the image's red chromaticities, a few bins, is mapped
linearly to the place on it.

*Reconstruction*, from the abstract and from what this house recollects of the paper: the line is the first principal
axis of the training lights in the plane of r = R / (R + G + B) and b; the map is a least-squares fit of the place on
it with the shares of the bins as inputs; the number of bins is chosen on the training images alone, by five-fold
cross-validation of the median recovery error among `CHOICES`; places beyond the training lights are moved to the
outermost of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce
from evaluation.metrics import recovery_error
from evaluation.scene import Image

FINE = 720  # Bins that are extracted, 0 … 1; divisible by each of `CHOICES`
# Numbers of bins to choose among: from fewer than can tell lights apart to more than the paper's data could fill.
CHOICES = (3, 4, 5, 6, 8, 9, 10, 12, 15, 16, 18, 20, 24, 30, 36, 40, 48, 60)
_PARTS = 5  # Parts of the training images in the choice of the number of bins
_LEAST = 2 * _PARTS  # Training images from which on there is something to choose by


@dataclass(frozen=True)
class SmartColorCat(FeatureLearner):
    """The method with its settings.

    - `working_size`: largest side of the image whose chromaticities are counted, px.
    - `bins`: bins of the histogram, one of `CHOICES`; 0 to choose by the training images.
    """

    key: ClassVar[str] = "smart-color-cat"
    title: ClassVar[str] = "Smart Color Cat"

    working_size: int = 256
    bins: int = 0

    def __post_init__(self) -> None:
        if self.bins not in (0, *CHOICES):
            raise ValueError(f"{self.bins} bins; expected 0 or one of {', '.join(map(str, CHOICES))}")

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32] | None:
        """Return the histogram of red chromaticities, (720,) float32 of sum 1; see `FeatureLearner.features`.

        The image is (H, W, 3), the mask (H, W) bool. Black pixels have no chromaticity and are not counted.
        """
        small, used = reduce(image, saturation, mask, self.working_size)
        pixels = small[used & small.any(axis=2)]
        if not len(pixels):
            return None
        places = np.minimum((chromaticities(pixels)[:, 0] * FINE).astype(np.int64), FINE - 1)
        return (np.bincount(places, minlength=FINE) / len(pixels)).astype(np.float32)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LightLine:
        """Return the line and the map fitted to histograms (N, 720) float32 and lights (N, 3) float64."""
        bins = self.bins or _chosen(features, truths, seed)
        return _fitted(features, truths, bins)

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightLine:
        """Return the model whose arrays are given, (K,) float64 and so on as `LightLine` has them."""
        found: dict[str, Any] = {name: arrays[name] for name in ("weights", "centre", "direction", "ends")}
        shapes = {name: array.shape for name, array in found.items()}
        expected = {"weights": shapes["weights"], "centre": (2,), "direction": (2,), "ends": (2,)}
        if shapes != expected or len(shapes["weights"]) != 1 or shapes["weights"][0] not in CHOICES:
            raise ValueError(f"arrays of the shapes {shapes}")
        if not all(np.isfinite(array).all() for array in found.values()):
            raise ValueError("numbers that are not finite")
        return LightLine(**found)


@dataclass(frozen=True, eq=False)
class LightLine:
    """What was learned.

    - `weights`: (K,) float64, the place on the line as a linear function of the shares of K bins.
    - `centre`, `direction`: (2,) float64, a point of the line in the plane of r and b, and its unit vector.
    - `ends`: (2,) float64, the least and greatest place of a training light.
    """

    weights: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]
    ends: npt.NDArray[np.float64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays, (K,) and (2,) float64, by their names."""
        return {"weights": self.weights, "centre": self.centre, "direction": self.direction, "ends": self.ends}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of histograms (N, 720) float32."""
        shares = _joined(features, len(self.weights))
        places = np.clip((shares * self.weights).sum(axis=1), *self.ends)
        red_blue = self.centre + places[:, None] * self.direction
        return lights_from_chromaticities(np.stack([red_blue[:, 0], 1 - red_blue.sum(axis=1)], axis=1))


def _joined(features: Features, bins: int) -> npt.NDArray[np.float64]:
    return features.reshape(len(features), bins, -1).sum(axis=2, dtype=np.float64)


def _fitted(features: Features, truths: npt.NDArray[np.float64], bins: int) -> LightLine:
    red_blue = truths[:, [0, 2]]
    centre = red_blue.mean(axis=0)
    _, _, axes = np.linalg.svd(red_blue - centre)
    direction = axes[0] * (1 if axes[0, 0] >= 0 else -1)
    places = (red_blue - centre) @ direction
    # The shares sum to 1, so that their weights hold the constant too.
    solve: Any = np.linalg.lstsq
    weights: npt.NDArray[np.float64] = solve(_joined(features, bins), places)[0]
    return LightLine(weights, centre, direction, np.array([places.min(), places.max()]))


def _chosen(features: Features, truths: npt.NDArray[np.float64], seed: int) -> int:
    if len(features) < _LEAST:
        return CHOICES[0]
    parts = np.random.default_rng(seed).permutation(len(features)) % _PARTS

    def error(bins: int) -> float:
        estimates = np.empty_like(truths)
        for part in range(_PARTS):
            held = parts == part
            estimates[held] = _fitted(features[~held], truths[~held], bins).lights(features[held])
        return float(np.median(recovery_error(estimates, truths)))

    return min(CHOICES, key=error)
