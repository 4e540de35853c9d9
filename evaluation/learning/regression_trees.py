"""Regression trees on four simple features of the colours of an image.

D. Cheng, B. Price, S. Cohen, M. S. Brown, "Effective learning-based illuminant estimation using simple features", CVPR
2015. Features are the chromaticities (r, g) of the mean colour, the brightest colour, the dominant colour (mode of an
RGB histogram) and the mode of the colour palette. Each feature has an ensemble of trees. Training images are sorted
by the r of their illuminant. For each tree, a window of consecutive images has a higher weight in training. Estimates
on which features agree are used (section 3).

Constants are from OpenCV (`xphoto::LearningBasedWB` and its training script): 64³ bins, a palette of 300 colours, the
kernel max(0, 1 − d² / 0.1²), trees of depth 4, 20 windows of 2⌈N / 21⌉ of the N images with weight 20, and agreement
within 0.025. The paper does not define agreement. Here, three of four features agree if each two of their estimates are
within this distance. The result is the median of the estimates that agree. If none agree, it is the median of all
estimates. The histogram is scaled to the largest usable value of the image; OpenCV scales it to the white level.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, require_installed
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce_image
from evaluation.scene import Image

_FEATURES = 4  # mean, brightest, dominant and palette mode (section 3.1)
_TARGETS = 2  # one tree for r and one for g (section 3.2)
_WINDOW_WEIGHT = 20  # weight of images in a window; OpenCV's training script repeats them 20 times
_MIN_AGREEING = 3  # number of the four features that must agree


@dataclass(frozen=True)
class RegressionTrees(FeatureLearner):
    """Settings of the method; the defaults are from OpenCV.

    - `working_size`: longer side of the reduced image, px.
    - `bins`: bins of the histogram along each channel.
    - `palette`: number of colours in the palette, which has the most frequent colours.
    - `bandwidth`: radius of the kernel for the mode of the palette, in chromaticity.
    - `windows`: number of windows of sorted training images, each with its own trees.
    - `depth`: depth of each tree.
    - `agreement`: largest distance between the estimates of features that agree, in chromaticity.
    """

    key: ClassVar[str] = "regression-trees"
    title: ClassVar[str] = "Regression trees (simple features)"
    needs: ClassVar[tuple[str, str] | None] = (
        "sklearn",
        "pip install scikit-learn; a trained model does not require it",
    )

    working_size: int = 256
    bins: int = 64
    palette: int = 300
    bandwidth: float = 0.1
    windows: int = 20
    depth: int = 4
    agreement: float = 0.025

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float32] | None:
        """Return four chromaticities (r, g), (8,) float32; see `FeatureLearner.features`."""
        small, used = reduce_image(image, saturation, mask, self.working_size)
        pixels = small[used]
        if not pixels.any():
            return None
        brightest = pixels[np.argmax(pixels.sum(axis=1))]
        frequent = _frequent_colours(pixels, self.bins, self.palette)
        palette = chromaticities(frequent)
        distances = ((palette[:, None] - palette[None]) ** 2).sum(axis=-1)
        density = np.maximum(0, 1 - distances / self.bandwidth**2).sum(axis=1)
        other_features = chromaticities(np.stack([pixels.mean(axis=0, dtype=np.float64), brightest, frequent[0]]))
        return np.concatenate([other_features.ravel(), palette[np.argmax(density)]]).astype(np.float32)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> Forest:
        """Return the trees fitted to features (N, 8) and ground truths (N, 3); requires scikit-learn."""
        require_installed(self)
        import sklearn.tree

        make_tree: Any = sklearn.tree.DecisionTreeRegressor
        reshaped = features.reshape(len(features), _FEATURES, 2)
        lights = truths[:, :_TARGETS]
        order = np.argsort(lights[:, 0], kind="stable")
        step = -(-len(order) // (self.windows + 1))
        trees: list[Any] = []
        for window in range(self.windows):
            weights = np.ones(len(order))
            weights[order[window * step : (window + 2) * step]] = _WINDOW_WEIGHT
            for feature, target in itertools.product(range(_FEATURES), range(_TARGETS)):
                tree = make_tree(max_depth=self.depth, random_state=seed)
                trees.append(tree.fit(reshaped[:, feature], lights[:, target], weights).tree_)
        node_count = max(tree.node_count for tree in trees)

        def stack_nodes(attribute: str, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
            full: npt.NDArray[Any] = np.zeros((len(trees), node_count), dtype)
            for row, tree in zip(full, trees, strict=True):
                row[: tree.node_count] = getattr(tree, attribute).ravel()
            return full.reshape(self.windows, _FEATURES, _TARGETS, node_count)

        return Forest(
            split=stack_nodes("feature", np.int8),
            threshold=stack_nodes("threshold", np.float64),
            left=stack_nodes("children_left", np.int16),
            right=stack_nodes("children_right", np.int16),
            value=stack_nodes("value", np.float64),
            depth=self.depth,
            agreement=self.agreement,
        )

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> Forest:
        """Return the trees with the arrays of `Forest`; see `FeatureLearner.restore`."""
        names = ("split", "threshold", "left", "right", "value")
        loaded: dict[str, Any] = {name: arrays[name] for name in names}
        shape = loaded["split"].shape
        if len(shape) != 4 or shape[1:3] != (_FEATURES, _TARGETS) or any(a.shape != shape for a in loaded.values()):
            raise ValueError(f"trees have the shapes {[a.shape for a in loaded.values()]}, expected (W, 4, 2, N)")
        if any(loaded[name].dtype.kind != "i" for name in ("split", "left", "right")):
            raise ValueError("branches of trees are not integers, expected integers")
        is_valid = all(((loaded[name] >= -2) & (loaded[name] < shape[3])).all() for name in ("left", "right"))
        if not is_valid or not ((loaded["split"] >= -2) & (loaded["split"] < 2)).all():
            raise ValueError("branches of trees have wrong indices, expected indices of nodes and features")
        if not (np.isfinite(loaded["value"]).all() and np.isfinite(loaded["threshold"]).all()):
            raise ValueError("trees have infinite or NaN values, expected finite ones")
        return Forest(**loaded, depth=self.depth, agreement=self.agreement)


@dataclass(frozen=True, eq=False)
class Forest:
    """Trees as arrays, so that estimates require only NumPy.

    - `split`: (windows, 4, 2, nodes) int8, component of the feature (0 or 1) at a node; negative for a leaf.
    - `threshold`: same shape, float64; values up to the threshold go to the left child.
    - `left`, `right`: same shape, int16, children of a node.
    - `value`: same shape, float64, r or g of a leaf.
    - `depth`: largest number of levels below the root.
    - `agreement`: see `RegressionTrees`.
    """

    split: npt.NDArray[np.int8]
    threshold: npt.NDArray[np.float64]
    left: npt.NDArray[np.int16]
    right: npt.NDArray[np.int16]
    value: npt.NDArray[np.float64]
    depth: int
    agreement: float

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays by name."""
        return {name: getattr(self, name) for name in ("split", "threshold", "left", "right", "value")}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates (N, 3) float64, r + g + b = 1, for features (N, 8) float32."""
        all_estimates = np.stack([self.estimates(feature) for feature in features])
        return lights_from_chromaticities(np.stack([consensus(feature, self.agreement) for feature in all_estimates]))

    def estimates(self, feature: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return the estimate of each tree, (windows, 4, 2) float64, r and g, for features (8,) float32."""
        windows, _, _, nodes = self.split.shape
        starts: npt.NDArray[np.int64] = np.arange(windows * _FEATURES * _TARGETS, dtype=np.int64) * nodes
        feature_indices = np.tile(np.repeat(np.arange(_FEATURES), _TARGETS), windows)
        node_indices = np.zeros(len(starts), dtype=np.int64)
        for _ in range(self.depth):
            nodes_at: npt.NDArray[np.int64] = starts + node_indices
            split_feature = self.split.ravel()[nodes_at]
            is_lower = feature[2 * feature_indices + np.maximum(split_feature, 0)] <= self.threshold.ravel()[nodes_at]
            child = np.where(is_lower, self.left.ravel()[nodes_at], self.right.ravel()[nodes_at])
            node_indices = np.where(split_feature < 0, node_indices, child)
        return self.value.ravel()[starts + node_indices].reshape(windows, _FEATURES, _TARGETS)


def _frequent_colours(pixels: npt.NDArray[np.float32], bins: int, colour_count: int) -> npt.NDArray[np.float64]:
    # Mean colours of the bins with most pixels, in descending order of their counts.
    codes = np.minimum((pixels * bins).astype(np.int64), bins - 1) @ np.array([bins * bins, bins, 1])
    filled_codes, membership, counts = np.unique(codes, return_inverse=True, return_counts=True)
    fullest = np.argsort(-counts, kind="stable")[:colour_count]
    sums = np.stack([np.bincount(membership, pixels[:, channel], len(filled_codes)) for channel in range(3)], axis=1)
    return sums[fullest] / counts[fullest, None]


def consensus(estimates: npt.NDArray[np.float64], agreement: float) -> npt.NDArray[np.float64]:
    """Return the median (2,) float64 of the estimates on which three features agree, or of all if no three agree.

    `estimates`: (windows, 4, 2) float64, r and g for each window and feature.

    Examples
    --------
    The fourth feature does not agree:

    >>> consensus(np.array([[[0.30, 0.4], [0.31, 0.4], [0.32, 0.4], [0.60, 0.2]]]), 0.025)
    array([0.31, 0.4 ])
    """
    is_near = np.linalg.norm(estimates[:, :, None] - estimates[:, None], axis=-1) <= agreement
    agrees = np.zeros(estimates.shape[:2], dtype=bool)
    for members in itertools.combinations(range(_FEATURES), _MIN_AGREEING):
        is_group = np.all([is_near[:, first, second] for first, second in itertools.combinations(members, 2)], axis=0)
        agrees[:, list(members)] |= is_group[:, None]
    selected = estimates[agrees] if agrees.any() else estimates.reshape(-1, _TARGETS)
    return np.median(selected, axis=0)
