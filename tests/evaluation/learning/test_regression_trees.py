"""Regression trees: features, and estimates from arrays."""

from __future__ import annotations

import itertools
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.regression_trees import RegressionTrees, consensus
from foundation.errors import InputError
from tests.evaluation.learning.made_up_world import world

pytestmark = pytest.mark.slow

RED, GREEN, GREY = (0.8, 0.1, 0.1), (0.1, 0.3, 0.1), (0.2, 0.2, 0.2)


def test_extracts_four_features() -> None:
    image = np.zeros((8, 10, 3), np.float32)
    image[:, :6], image[:, 6:9], image[:, 9] = GREY, GREEN, RED
    features = RegressionTrees().features(image)
    assert features is not None
    mean = np.average([GREY, GREEN, RED], axis=0, weights=[6, 3, 1])
    expected = [mean[:2] / mean.sum(), [0.8, 0.1], [1 / 3, 1 / 3]]
    np.testing.assert_allclose(features[:6].reshape(3, 2), expected, rtol=1e-5)
    # Three colours in the palette with distances above 0.1: equal densities, so the most frequent is the mode.
    np.testing.assert_allclose(features[6:], [1 / 3, 1 / 3], rtol=1e-5)


def test_palette_mode_counts_colours_not_pixels() -> None:
    image = np.full((8, 8, 3), 0.5, np.float32)
    image[0, :4] = [(0.6, 0.2, 0.2), (0.65, 0.2, 0.22), (0.7, 0.24, 0.22), (1.0, 0.33, 0.33)]
    features = RegressionTrees().features(image)
    assert features is not None
    np.testing.assert_allclose(features[4:6], 1 / 3, rtol=1e-5)
    assert features[6] > 0.55


def test_estimates_from_arrays_agree_with_scikit_learn() -> None:
    sklearn: Any = pytest.importorskip("sklearn.tree", reason="scikit-learn is not installed")
    scenes = world(60)
    learner = RegressionTrees(windows=2)
    rows: list[Any] = [learner.features(scene.image) for scene in scenes]
    features: npt.NDArray[np.float32] = np.stack(rows)
    truths = np.stack([scene.truth for scene in scenes])
    forest = learner.fit_features(features, truths, seed=1)
    order = np.argsort(truths[:, 0], kind="stable")
    for window, feature, target in itertools.product(range(2), range(4), range(2)):
        weights = np.ones(60)
        weights[order[window * 20 : (window + 2) * 20]] = 20
        tree = sklearn.DecisionTreeRegressor(max_depth=4, random_state=1)
        tree.fit(features[:, 2 * feature : 2 * feature + 2], truths[:, target], weights)
        for index in range(0, 60, 7):
            estimate = forest.estimates(features[index])[window, feature, target]
            assert estimate == tree.predict(features[index : index + 1, 2 * feature : 2 * feature + 2])[0]


def test_excludes_features_that_disagree() -> None:
    near, far = [[0.3, 0.4], [0.31, 0.4], [0.3, 0.41]], [0.6, 0.2]
    windows = np.array([[*near, far], [far, [0.9, 0.05], *near[:2]], [far, *near]])
    np.testing.assert_allclose(consensus(windows, 0.025), [0.3, 0.4], atol=1e-12)
    np.testing.assert_allclose(consensus(windows, 0.001), np.median(windows.reshape(-1, 2), axis=0))
    # A chain does not agree, because its ends are too far apart.
    chain = np.array([[[0.30, 0.4], [0.32, 0.4], [0.34, 0.4], [0.9, 0.05]]])
    np.testing.assert_allclose(consensus(chain, 0.025), [0.33, 0.4])


@pytest.mark.parametrize(
    ("learner", "module", "package"),
    [(RegressionTrees(), "sklearn", "scikit-learn"), (ConvNet(), "torch", "torch")],
)
def test_names_missing_package_and_remedy(
    learner: FeatureLearner, module: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"{module}.*pip install {package}"):
        learner.fit(world(3))


def test_restored_forest_does_not_require_scikit_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = world(12)
    learner = RegressionTrees(windows=2)
    arrays = learner.fit(scenes).model.arrays()
    monkeypatch.setitem(sys.modules, "sklearn", None)
    features: Any = learner.features(scenes[0].image)
    assert np.isfinite(learner.restore(arrays).lights(features[None])).all()
