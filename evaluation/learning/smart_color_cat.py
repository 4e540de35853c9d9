"""Smart Color Cat: estimate a position on a line of illuminants from the histogram of red chromaticities.

N. Banić, S. Lončarić, "Using the red chromaticity for illumination estimation", ISPA 2015. Illuminants of real scenes
are near a line in the rb-chromaticity plane. The histogram of red chromaticities, with a few bins, is mapped linearly
to the position on the line.

The paper was not accessible, so the following is our reconstruction. The line is the first principal axis of the
training illuminants in the plane of r = R / (R + G + B) and b. The map is a least-squares fit with the fractions of the
bins as inputs. The number of bins is selected from `BIN_CHOICES` by five-fold cross-validation of the median recovery
error on the training images. Positions outside the range of the training illuminants are clipped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce_image
from evaluation.metrics import recovery_error
from evaluation.scene import Image

FINE_BINS = 720  # bins of the extracted histograms of r, 0 … 1; a multiple of every number in `BIN_CHOICES`
# Candidate numbers of bins. The smallest cannot separate illuminants; the largest overfit the data of the paper.
BIN_CHOICES = (3, 4, 5, 6, 8, 9, 10, 12, 15, 16, 18, 20, 24, 30, 36, 40, 48, 60)
_FOLDS = 5  # folds of the training images, for the selection of the number of bins
_MIN_IMAGES = 2 * _FOLDS  # smallest number of training images for a selection


@dataclass(frozen=True)
class SmartColorCat(FeatureLearner):
    """Settings of the method.

    - `working_size`: longer side of the reduced image, px.
    - `bins`: number of bins, one of `BIN_CHOICES`; 0 selects it with the training images.
    """

    key: ClassVar[str] = "smart-color-cat"
    title: ClassVar[str] = "Smart Color Cat"

    working_size: int = 256
    bins: int = 0

    def __post_init__(self) -> None:
        if self.bins not in (0, *BIN_CHOICES):
            raise ValueError(f"{self.bins} bins, expected 0 or one of {', '.join(map(str, BIN_CHOICES))}")

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32] | None:
        """Return the histogram of red chromaticities, (720,) float32 with sum 1; see `FeatureLearner.features`.

        Black pixels are excluded.
        """
        small, used = reduce_image(image, saturation, mask, self.working_size)
        pixels = small[used & small.any(axis=2)]
        if not len(pixels):
            return None
        bin_indices = np.minimum((chromaticities(pixels)[:, 0] * FINE_BINS).astype(np.int64), FINE_BINS - 1)
        return (np.bincount(bin_indices, minlength=FINE_BINS) / len(pixels)).astype(np.float32)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LightLine:
        """Return the line and the map fitted to histograms (N, 720) float32 and ground truths (N, 3) float64."""
        bins = self.bins or _select_bins(features, truths, seed)
        return _fit_line(features, truths, bins)

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightLine:
        """Return the model with the arrays of `LightLine`; see `FeatureLearner.restore`."""
        loaded: dict[str, Any] = {name: arrays[name] for name in ("weights", "centre", "direction", "ends")}
        shapes = {name: array.shape for name, array in loaded.items()}
        expected = {"weights": shapes["weights"], "centre": (2,), "direction": (2,), "ends": (2,)}
        if shapes != expected or len(shapes["weights"]) != 1 or shapes["weights"][0] not in BIN_CHOICES:
            raise ValueError(f"arrays have the shapes {shapes}, expected {expected}")
        if not all(np.isfinite(array).all() for array in loaded.values()):
            raise ValueError("arrays have infinite or NaN values, expected finite ones")
        return LightLine(**loaded)


@dataclass(frozen=True, eq=False)
class LightLine:
    """Fitted line.

    - `weights`: (K,) float64, coefficients of the map from the fractions of K bins to a position on the line.
    - `centre`, `direction`: (2,) float64, point of the line in the plane of r and b, and its unit vector.
    - `ends`: (2,) float64, smallest and largest position of a training illuminant.
    """

    weights: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]
    ends: npt.NDArray[np.float64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by name."""
        return {"weights": self.weights, "centre": self.centre, "direction": self.direction, "ends": self.ends}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for histograms (N, 720) float32."""
        shares = _sum_bins(features, len(self.weights))
        positions = np.clip((shares * self.weights).sum(axis=1), *self.ends)
        red_blue = self.centre + positions[:, None] * self.direction
        return lights_from_chromaticities(np.stack([red_blue[:, 0], 1 - red_blue.sum(axis=1)], axis=1))


def _sum_bins(features: Features, bins: int) -> npt.NDArray[np.float64]:
    return features.reshape(len(features), bins, -1).sum(axis=2, dtype=np.float64)


def _fit_line(features: Features, truths: npt.NDArray[np.float64], bins: int) -> LightLine:
    red_blue = truths[:, [0, 2]]
    centre = red_blue.mean(axis=0)
    _, _, axes = np.linalg.svd(red_blue - centre)
    direction = axes[0] * (1 if axes[0, 0] >= 0 else -1)
    positions = (red_blue - centre) @ direction
    # The fractions have the sum 1, so the map needs no separate constant term.
    solve: Any = np.linalg.lstsq
    weights: npt.NDArray[np.float64] = solve(_sum_bins(features, bins), positions)[0]
    return LightLine(weights, centre, direction, np.array([positions.min(), positions.max()]))


def _select_bins(features: Features, truths: npt.NDArray[np.float64], seed: int) -> int:
    if len(features) < _MIN_IMAGES:
        return BIN_CHOICES[0]
    fold_indices = np.random.default_rng(seed).permutation(len(features)) % _FOLDS

    def error(bins: int) -> float:
        estimates = np.empty_like(truths)
        for fold in range(_FOLDS):
            tested = fold_indices == fold
            estimates[tested] = _fit_line(features[~tested], truths[~tested], bins).lights(features[tested])
        return float(np.median(recovery_error(estimates, truths)))

    return min(BIN_CHOICES, key=error)
