"""Regression trees on four simple features of an image's colours.

D. Cheng, B. Price, S. Cohen, M. S. Brown, "Effective learning-based illuminant estimation using simple features", CVPR
2015: the chromaticities (r, g) of the mean colour, the brightest colour, the dominant colour (mode of an RGB histogram)
and the mode of the colour palette; ensembles of trees for each feature, of which each is trained with stress on one
window of the training lights sorted by r; the estimates on which features agree are kept (section 3).

The numbers are those of OpenCV's adaptation (`xphoto::LearningBasedWB` and its training script): 64³ bins, a palette of
300 colours, the kernel max(0, 1 − d² / 0.1²), trees of depth 4, 20 windows of 2⌈N / 21⌉ images whose weight is 20, and
agreement within 0.025. *Reconstruction*: the paper does not define agreement; here three of the four features whose
estimates lie pairwise within that distance agree, and the median of all estimates that agree is the light, of all
estimates where none do. The scale of the histogram is the image's brightest usable value, where OpenCV has the white
level; saturated pixels are left out as everywhere in this house.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features, require_installed
from evaluation.learning.working_size import chromaticities, lights_from_chromaticities, reduce
from evaluation.scene import Image

_FEATURES = 4  # Mean, brightest, dominant and palette mode (section 3.1)
_TARGETS = 2  # A tree for r and one for g (section 3.2)
_WINDOW_WEIGHT = 20  # How often a training script of OpenCV repeats the images of a window
_AGREEING = 3  # Features of four that must agree for their estimates to count


@dataclass(frozen=True)
class RegressionTrees(FeatureLearner):
    """The method with its settings; the defaults are OpenCV's.

    - `working_size`: largest side of the image whose colours are counted, px.
    - `bins`: bins of the histogram along each channel.
    - `palette`: the most frequent colours that make the palette.
    - `bandwidth`: radius of the kernel that finds the palette's mode, in chromaticity.
    - `windows`: windows of the sorted training lights, one ensemble of trees each.
    - `depth`: of each tree.
    - `agreement`: distance in chromaticity within which features agree.
    """

    key: ClassVar[str] = "regression-trees"
    title: ClassVar[str] = "Regression trees (simple features)"
    needs: ClassVar[tuple[str, str] | None] = (
        "sklearn",
        "pip install scikit-learn; a model that is trained already does without",
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
        """Return the four chromaticities (r, g), (8,) float32, of an image; see `FeatureLearner.features`.

        The image is (H, W, 3), the mask (H, W) bool.
        """
        small, used = reduce(image, saturation, mask, self.working_size)
        pixels = small[used]
        if not pixels.any():
            return None
        brightest = pixels[np.argmax(pixels.sum(axis=1))]
        frequent = _frequent_colours(pixels, self.bins, self.palette)
        palette = chromaticities(frequent)
        apart = ((palette[:, None] - palette[None]) ** 2).sum(axis=-1)
        density = np.maximum(0, 1 - apart / self.bandwidth**2).sum(axis=1)
        plain = chromaticities(np.stack([pixels.mean(axis=0, dtype=np.float64), brightest, frequent[0]]))
        return np.concatenate([plain.ravel(), palette[np.argmax(density)]]).astype(np.float32)

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> Forest:
        """Return the trees fitted to features (N, 8) float32 and lights (N, 3) float64; needs scikit-learn."""
        require_installed(self)
        import sklearn.tree

        make: Any = sklearn.tree.DecisionTreeRegressor
        given = features.reshape(len(features), _FEATURES, 2)
        lights = truths[:, :_TARGETS]
        order = np.argsort(lights[:, 0], kind="stable")
        step = -(-len(order) // (self.windows + 1))
        trees: list[Any] = []
        for window in range(self.windows):
            weights = np.ones(len(order))
            weights[order[window * step : (window + 2) * step]] = _WINDOW_WEIGHT
            for feature, target in itertools.product(range(_FEATURES), range(_TARGETS)):
                tree = make(max_depth=self.depth, random_state=seed)
                trees.append(tree.fit(given[:, feature], lights[:, target], weights).tree_)
        most = max(tree.node_count for tree in trees)

        def gather(what: str, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
            full: npt.NDArray[Any] = np.zeros((len(trees), most), dtype)
            for row, tree in zip(full, trees, strict=True):
                row[: tree.node_count] = getattr(tree, what).ravel()
            return full.reshape(self.windows, _FEATURES, _TARGETS, most)

        return Forest(
            split=gather("feature", np.int8),
            threshold=gather("threshold", np.float64),
            left=gather("children_left", np.int16),
            right=gather("children_right", np.int16),
            value=gather("value", np.float64),
            depth=self.depth,
            agreement=self.agreement,
        )

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> Forest:
        """Return the trees whose arrays are given: (windows, 4, 2, nodes), the dtype of each as `Forest` has it.

        See `FeatureLearner.restore`.
        """
        names = ("split", "threshold", "left", "right", "value")
        found: dict[str, Any] = {name: arrays[name] for name in names}
        shape = found["split"].shape
        if len(shape) != 4 or shape[1:3] != (_FEATURES, _TARGETS) or any(a.shape != shape for a in found.values()):
            raise ValueError(f"trees of the shapes {[a.shape for a in found.values()]}")
        if any(found[name].dtype.kind != "i" for name in ("split", "left", "right")):
            raise ValueError("trees with branches that are no whole numbers")
        inside = all(((found[name] >= -2) & (found[name] < shape[3])).all() for name in ("left", "right"))
        if not inside or not ((found["split"] >= -2) & (found["split"] < 2)).all():
            raise ValueError("trees with branches that lead nowhere")
        if not (np.isfinite(found["value"]).all() and np.isfinite(found["threshold"]).all()):
            raise ValueError("trees with values that are not finite")
        return Forest(**found, depth=self.depth, agreement=self.agreement)


@dataclass(frozen=True, eq=False)
class Forest:
    """Trees as arrays: estimating needs nothing but NumPy.

    - `split`: (windows, 4, 2, nodes) int8, the feature's part, 0 or 1, that a node looks at; below 0 for a leaf.
    - `threshold`: the same shape, float64: parts up to it go left.
    - `left`, `right`: the same shape, int16: a node's children.
    - `value`: the same shape, float64: r or g at a leaf.
    - `depth`: levels below the root, at most.
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
        """Return the arrays by their names, each (windows, 4, 2, nodes) of the dtype that stands above."""
        return {name: getattr(self, name) for name in ("split", "threshold", "left", "right", "value")}

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, r + g + b = 1, of features (N, 8) float32."""
        every = np.stack([self.estimates(one) for one in features])
        return lights_from_chromaticities(np.stack([consensus(one, self.agreement) for one in every]))

    def estimates(self, feature: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        """Return what each tree estimates, (windows, 4, 2) float64, r and g, from features (8,) float32."""
        windows, _, _, nodes = self.split.shape
        start: npt.NDArray[np.int64] = np.arange(windows * _FEATURES * _TARGETS, dtype=np.int64) * nodes
        which = np.tile(np.repeat(np.arange(_FEATURES), _TARGETS), windows)
        at = np.zeros(len(start), dtype=np.int64)
        for _ in range(self.depth):
            place: npt.NDArray[np.int64] = start + at
            part = self.split.ravel()[place]
            lower = feature[2 * which + np.maximum(part, 0)] <= self.threshold.ravel()[place]
            child = np.where(lower, self.left.ravel()[place], self.right.ravel()[place])
            at = np.where(part < 0, at, child)
        return self.value.ravel()[start + at].reshape(windows, _FEATURES, _TARGETS)


def _frequent_colours(pixels: npt.NDArray[np.float32], bins: int, most: int) -> npt.NDArray[np.float64]:
    """Return the mean colours (up to `most`, 3) float64 of the fullest bins of a histogram of (M, 3), fullest first."""
    codes = np.minimum((pixels * bins).astype(np.int64), bins - 1) @ np.array([bins * bins, bins, 1])
    filled, member, counts = np.unique(codes, return_inverse=True, return_counts=True)
    fullest = np.argsort(-counts, kind="stable")[:most]
    sums = np.stack([np.bincount(member, pixels[:, channel], len(filled)) for channel in range(3)], axis=1)
    return sums[fullest] / counts[fullest, None]


def consensus(estimates: npt.NDArray[np.float64], agreement: float) -> npt.NDArray[np.float64]:
    """Return the median (2,) float64 of the estimates on which three features agree; of all where none do.

    `estimates`: (windows, 4, 2) float64, r and g by each window's trees of each feature.

    Examples
    --------
    The fourth feature is outvoted:

    >>> consensus(np.array([[[0.30, 0.4], [0.31, 0.4], [0.32, 0.4], [0.60, 0.2]]]), 0.025)
    array([0.31, 0.4 ])
    """
    apart = np.linalg.norm(estimates[:, :, None] - estimates[:, None], axis=-1) <= agreement
    agreed = np.zeros(estimates.shape[:2], dtype=bool)
    for members in itertools.combinations(range(_FEATURES), _AGREEING):
        together = np.all([apart[:, one, other] for one, other in itertools.combinations(members, 2)], axis=0)
        agreed[:, list(members)] |= together[:, None]
    chosen = estimates[agreed] if agreed.any() else estimates.reshape(-1, _TARGETS)
    return np.median(chosen, axis=0)
