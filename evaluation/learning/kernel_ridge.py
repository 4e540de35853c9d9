"""Kernel ridge regression of the illuminant on a histogram of chromaticities.

C. Saunders, A. Gammerman, V. Vovk, "Ridge regression learning algorithm in dual variables", ICML 1998. The estimate is
a weighted sum of kernels between an image and each training image. The weights a are the solution of (K + λ I) a = y.
Here K has the kernels between training images, and y their chromaticities (r, g) minus the mean of all. V. Agarwal, A.
V. Gribok, A. Koschan, M. A. Abidi, "Estimating illumination chromaticity via kernel regression", ICIP 2006, use kernel
regression on chromaticity histograms.

The kernel is exp(-d² / 2). Here d² = Σ (√p - √q)² ≤ 2, p and q are the bin fractions of two images, and d is
proportional to the Hellinger distance. Pixels are weighted by brightness, because the chromaticity of dark pixels is
mostly noise. *Not from these papers:* the 64 × 64 bins of (r, g), the square root, the width of the kernel, and
λ. They were not tuned on generated images, see docs/decisions/0056-settings-of-learned-methods.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LightModel
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce_image
from evaluation.scene import Image

BINS = 64  # bins of r and of g, each 0 … 1; near usual illuminants a bin is 2° to 4° wide
_LARGEST_SIZE = 255  # largest working size for which unweighted counts fit into 16 bits, px
_PENALTY_IMAGES = 900  # number of training images for which λ is `penalty`
_LARGEST_COUNT = 65535  # sum of the weighted counts of an image, the largest 16-bit number


@dataclass(frozen=True)
class KernelRidge(FeatureLearner):
    """Settings of the method.

    - `working_size`: longer side of the reduced image, px.
    - `penalty`: λ for 900 training images, above 0; λ is proportional to the number of training images.
    - `brightness`: exponent of the brightness in the weight of a pixel, 0 or more; 0 for equal weights.
    """

    key: ClassVar[str] = "kernel-ridge"
    title: ClassVar[str] = "Kernel ridge (chromaticity histograms)"

    working_size: int = 64
    penalty: float = 0.3
    brightness: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.working_size <= _LARGEST_SIZE:
            raise ValueError(f"the working size is {self.working_size} px, expected 1 to {_LARGEST_SIZE}")
        if not self.penalty > 0:
            raise ValueError(f"the penalty is {self.penalty}, expected a number above 0")
        if not 0 <= self.brightness < float("inf"):
            raise ValueError(f"the exponent of brightness is {self.brightness}, expected 0 or more")

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.uint16] | None:
        """Return the counts of (r, g), (64, 64) uint16, r along the first axis; see `FeatureLearner.features`.

        Black pixels are excluded. If pixels are weighted by brightness, the sum of the counts is 65535 before rounding.
        """
        small, used = reduce_image(image, saturation, mask, self.working_size)
        pixels = small[used & small.any(axis=2)]
        if not len(pixels):
            return None
        bin_indices = np.minimum((chromaticities(pixels) * BINS).astype(np.int64), BINS - 1) @ np.array([BINS, 1])
        weights = pixels.sum(axis=1, dtype=np.float64) ** self.brightness
        counts = np.bincount(bin_indices, weights, minlength=BINS * BINS).reshape(BINS, BINS)
        if self.brightness:
            counts *= _LARGEST_COUNT / counts.sum()
        return np.rint(counts).astype(np.uint16)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> KernelRidgeModel:
        """Return the model fitted to counts (N, 64, 64) and ground truths (N, 3); `seed` is not used."""
        roots = _square_roots(features)
        centre = truths[:, :2].mean(axis=0)
        penalty = self.penalty * len(roots) / _PENALTY_IMAGES
        solve: Any = np.linalg.solve
        weights = solve(_kernel(roots, roots) + penalty * np.eye(len(roots)), truths[:, :2] - centre)
        return KernelRidgeModel(features.reshape(len(features), -1), weights, centre)

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> KernelRidgeModel:
        """Return the model fitted to its own M images and N new images, which have the weight max(1, M / `worth`)."""
        if not isinstance(model, KernelRidgeModel):
            raise TypeError(f"the model is {type(model).__name__}, expected KernelRidgeModel")
        old, new = _square_roots(model.counts), _square_roots(features)
        count, kernel = len(old), _kernel(old, old)
        penalty = self.penalty * count / _PENALTY_IMAGES
        # The targets of the old images are recovered from (K + λ I) a = y.
        old_targets = kernel @ model.weights + penalty * model.weights
        cross = _kernel(old, new)
        joint: npt.NDArray[np.float64] = np.block([[kernel, cross], [cross.T, _kernel(new, new)]])
        penalties = penalty * np.concatenate([np.ones(count), np.full(len(new), worth / max(worth, count))])
        solve: Any = np.linalg.solve
        weights = solve(joint + np.diag(penalties), np.concatenate([old_targets, truths[:, :2] - model.centre]))
        counts = np.concatenate([model.counts, features.reshape(len(features), -1)])
        return KernelRidgeModel(counts, weights, model.centre)

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> KernelRidgeModel:
        """Return the model with the arrays of `KernelRidgeModel`; see `FeatureLearner.restore`."""
        loaded: dict[str, Any] = {name: arrays[name] for name in ("counts", "weights", "centre")}
        shapes = {name: array.shape for name, array in loaded.items()}
        count = len(loaded["counts"]) if loaded["counts"].ndim else 0
        if not count or shapes != {"counts": (count, BINS * BINS), "weights": (count, 2), "centre": (2,)}:
            raise ValueError(f"arrays have the shapes {shapes}, expected counts (N, {BINS * BINS}) for N weights")
        if loaded["counts"].dtype.kind not in "iu" or (loaded["counts"].sum(axis=1, dtype=np.int64) <= 0).any():
            raise ValueError("counts are negative, empty or not whole, expected numbers of pixels")
        if not (np.isfinite(loaded["weights"]).all() and np.isfinite(loaded["centre"]).all()):
            raise ValueError("arrays have infinite or NaN values, expected finite ones")
        return KernelRidgeModel(**loaded)


@dataclass(frozen=True, eq=False)
class KernelRidgeModel:
    """Fitted model.

    - `counts`: (N, 4096) uint16, counts of the training images.
    - `weights`: (N, 2) float64, weight of each training image for r and g.
    - `centre`: (2,) float64, mean r and g of the training illuminants.
    """

    counts: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by name."""
        return {"counts": self.counts, "weights": self.weights, "centre": self.centre}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for counts (N, 64, 64) uint16."""
        roots = _square_roots(self.counts)
        # One by one, because the rounding of a matrix product depends on the number of images.
        estimates = [self.centre + _kernel(_square_roots(image[None]), roots)[0] @ self.weights for image in features]
        return lights_from_chromaticities(np.stack(estimates))


def _square_roots(counts: Features) -> npt.NDArray[np.float64]:
    flat = counts.reshape(len(counts), -1).astype(np.float64)
    return np.sqrt(flat / flat.sum(axis=1, keepdims=True))


def _kernel(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    # exp(-d² / 2), with d² = 2 - 2 x · y, because the vectors have the length 1.
    return np.exp(first @ second.T - 1)
