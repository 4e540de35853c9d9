"""Kernel ridge regression of the light on a histogram of chromaticities.

C. Saunders, A. Gammerman, V. Vovk, "Ridge regression learning algorithm in dual variables", ICML 1998: the light is a
weighted sum of kernels between an image and each training image, and the weights a solve the linear equations
(K + λ I) a = y. V. Agarwal, A. V. Gribok, A. Koschan, M. A. Abidi, "Estimating illumination chromaticity via kernel
regression", ICIP 2006, estimate the light's chromaticities by kernel regression on chromaticity histograms.

Features are the square roots of the shares of bins, so that the distance of two images is Hellinger's up to a factor:
K = exp(-d² / 2), d² = Σ (√p - √q)² ≤ 2. A pixel counts by its brightness: the variance of a chromaticity is inverse to
the light that was counted, and what is dark in a photograph has the colour of its noise and of the black that was taken
out rather than that of the scene. *Chosen, not from these papers:* the 64 × 64 bins of (r, g), the square root, the
width of the kernel, and λ, which is 0.3 for 900 training images and grows in proportion to their number. Nothing of it
was chosen by results on generated images; see docs/reference/learned-methods.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, LightModel
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce
from evaluation.scene import Image

BINS = 64  # Bins of r and of g, each 0 … 1: one is 2 to 4 degrees wide about usual lights, the grain of what is counted
_LARGEST = 255  # Working size up to which the counts of a histogram fit in 16 bits where each pixel counts alike
_IMAGES = 900  # Training images of which `penalty` is the λ
_WHOLE = 65535  # What the share of a bin that holds all of an image is kept as: the largest that 16 bits hold


@dataclass(frozen=True)
class KernelRidge(FeatureLearner):
    """The method with its settings.

    - `working_size`: largest side of the image whose chromaticities are counted, px.
    - `penalty`: λ for 900 training images, above 0; it grows in proportion to their number.
    - `brightness`: power of a pixel's brightness by which it counts, 0 or more; 0: each pixel counts alike.
    """

    key: ClassVar[str] = "kernel-ridge"
    title: ClassVar[str] = "Kernel ridge (chromaticity histograms)"

    working_size: int = 64
    penalty: float = 0.3
    brightness: float = 1.0

    def __post_init__(self) -> None:
        if not 1 <= self.working_size <= _LARGEST:
            raise ValueError(f"a working size of {self.working_size} px; expected 1 to {_LARGEST}")
        if not self.penalty > 0:
            raise ValueError(f"a penalty of {self.penalty}; expected a number above 0")
        if not 0 <= self.brightness < float("inf"):
            raise ValueError(f"a power of {self.brightness} of brightness; expected 0 or more")

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.uint16] | None:
        """Return the counts of (r, g), (64, 64) uint16, r along the first axis; see `FeatureLearner.features`.

        The image is (H, W, 3), the mask (H, W) bool. Black pixels have no chromaticity and are not counted. Pixels that
        count by their brightness are kept as shares of 65535.
        """
        small, used = reduce(image, saturation, mask, self.working_size)
        pixels = small[used & small.any(axis=2)]
        if not len(pixels):
            return None
        places = np.minimum((chromaticities(pixels) * BINS).astype(np.int64), BINS - 1) @ np.array([BINS, 1])
        weights = pixels.sum(axis=1, dtype=np.float64) ** self.brightness
        counts = np.bincount(places, weights, minlength=BINS * BINS).reshape(BINS, BINS)
        if self.brightness:
            counts *= _WHOLE / counts.sum()
        return np.rint(counts).astype(np.uint16)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> KernelRidgeModel:
        """Return the weights fitted to counts (N, 64, 64) uint16 and lights (N, 3) float64; nothing in it is random."""
        roots = _roots(features)
        centre = truths[:, :2].mean(axis=0)
        penalty = self.penalty * len(roots) / _IMAGES
        solve: Any = np.linalg.solve
        weights = solve(_kernel(roots, roots) + penalty * np.eye(len(roots)), truths[:, :2] - centre)
        return KernelRidgeModel(features.reshape(len(features), -1), weights, centre)

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> KernelRidgeModel:
        """Return the kernel ridge of the model's M images and of counts (N, 64, 64) uint16, lights (N, 3) float64.

        Each of the N weighs as much as M / worth of the others: its penalty is so many times smaller.
        """
        if not isinstance(model, KernelRidgeModel):
            raise TypeError(f"{type(model).__name__} is no model of {self.key}")
        known, new = _roots(model.counts), _roots(features)
        number, kernel = len(known), _kernel(known, known)
        penalty = self.penalty * number / _IMAGES
        # What the weights solve: (K + λ I) a is what was learned of each image.
        learned = kernel @ model.weights + penalty * model.weights
        across = _kernel(known, new)
        both: npt.NDArray[np.float64] = np.block([[kernel, across], [across.T, _kernel(new, new)]])
        penalties = penalty * np.concatenate([np.ones(number), np.full(len(new), worth / max(worth, number))])
        solve: Any = np.linalg.solve
        weights = solve(both + np.diag(penalties), np.concatenate([learned, truths[:, :2] - model.centre]))
        counts = np.concatenate([model.counts, features.reshape(len(features), -1)])
        return KernelRidgeModel(counts, weights, model.centre)

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> KernelRidgeModel:
        """Return the model whose arrays are given: counts (N, 4096) uint16, weights (N, 2) and centre (2,) float64."""
        found: dict[str, Any] = {name: arrays[name] for name in ("counts", "weights", "centre")}
        shapes = {name: array.shape for name, array in found.items()}
        count = len(found["counts"]) if found["counts"].ndim else 0
        if not count or shapes != {"counts": (count, BINS * BINS), "weights": (count, 2), "centre": (2,)}:
            raise ValueError(f"arrays of the shapes {shapes}")
        if found["counts"].dtype.kind not in "iu" or (found["counts"].sum(axis=1, dtype=np.int64) <= 0).any():
            raise ValueError("counts that are no counts of pixels")
        if not (np.isfinite(found["weights"]).all() and np.isfinite(found["centre"]).all()):
            raise ValueError("numbers that are not finite")
        return KernelRidgeModel(**found)


@dataclass(frozen=True, eq=False)
class KernelRidgeModel:
    """What was learned.

    - `counts`: (N, 4096) uint16, the counts of the training images.
    - `weights`: (N, 2) float64, of each training image for r and g.
    - `centre`: (2,) float64, mean r and g of the training lights: what an image that is like none would get.
    """

    counts: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays, (N, 4096) uint16, (N, 2) and (2,) float64, by their names."""
        return {"counts": self.counts, "weights": self.weights, "centre": self.centre}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of counts (N, 64, 64) uint16."""
        known = _roots(self.counts)
        # One by one: a product of matrices would round an image's number by the images beside it.
        found = [self.centre + _kernel(_roots(one[None]), known)[0] @ self.weights for one in features]
        return lights_from_chromaticities(np.stack(found))


def _roots(counts: Features) -> npt.NDArray[np.float64]:
    """Return the square roots (N, 4096) float64 of the shares of counts (N, 64, 64) or (N, 4096)."""
    flat = counts.reshape(len(counts), -1).astype(np.float64)
    return np.sqrt(flat / flat.sum(axis=1, keepdims=True))


def _kernel(one: npt.NDArray[np.float64], other: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return exp(-d² / 2), (N, M) float64, of vectors (N, K) and (M, K) of length 1, for which d² = 2 - 2 x · y."""
    return np.exp(one @ other.T - 1)
