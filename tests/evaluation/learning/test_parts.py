"""What is particular to regression trees, Smart Color Cat, Color Beaver, the network, and the working size."""

from __future__ import annotations

import itertools
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.color_beaver import ColorBeaver, bounded
from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees, consensus
from evaluation.learning.smart_color_cat import CHOICES, FINE, SmartColorCat
from evaluation.learning.working_size import reduce
from evaluation.metrics import recovery_error
from foundation.errors import InputError
from tests.evaluation.learning.made_up_world import MadeUp, lights_on_a_line, world

pytestmark = pytest.mark.slow

RED, GREEN, GREY = (0.8, 0.1, 0.1), (0.1, 0.3, 0.1), (0.2, 0.2, 0.2)


def test_the_four_features_are_what_they_are_called() -> None:
    image = np.zeros((8, 10, 3), np.float32)
    image[:, :6], image[:, 6:9], image[:, 9] = GREY, GREEN, RED
    found = RegressionTrees().features(image)
    assert found is not None
    mean = np.average([GREY, GREEN, RED], axis=0, weights=[6, 3, 1])
    expected = [mean[:2] / mean.sum(), [0.8, 0.1], [1 / 3, 1 / 3]]
    np.testing.assert_allclose(found[:6].reshape(3, 2), expected, rtol=1e-5)
    # Three colours in the palette, none within 0.1 of another: all equally dense, the most frequent stands.
    np.testing.assert_allclose(found[6:], [1 / 3, 1 / 3], rtol=1e-5)


def test_the_palette_counts_colours_and_not_pixels() -> None:
    image = np.full((8, 8, 3), 0.5, np.float32)
    image[0, :4] = [(0.6, 0.2, 0.2), (0.65, 0.2, 0.22), (0.7, 0.24, 0.22), (1.0, 0.33, 0.33)]
    found = RegressionTrees().features(image)
    assert found is not None
    np.testing.assert_allclose(found[4:6], 1 / 3, rtol=1e-5)
    assert found[6] > 0.55


def test_estimates_from_arrays_are_those_of_the_trees() -> None:
    sklearn: Any = pytest.importorskip("sklearn.tree", reason="scikit-learn is not installed")
    scenes = world(60)
    learner = RegressionTrees(windows=2)
    found: list[Any] = [learner.features(scene.image) for scene in scenes]
    features: npt.NDArray[np.float32] = np.stack(found)
    truths = np.stack([scene.truth for scene in scenes])
    forest = learner.fit_features(features, truths, seed=1)
    order = np.argsort(truths[:, 0], kind="stable")
    for window, feature, target in itertools.product(range(2), range(4), range(2)):
        weights = np.ones(60)
        weights[order[window * 20 : (window + 2) * 20]] = 20
        tree = sklearn.DecisionTreeRegressor(max_depth=4, random_state=1)
        tree.fit(features[:, 2 * feature : 2 * feature + 2], truths[:, target], weights)
        for place in range(0, 60, 7):
            own = forest.estimates(features[place])[window, feature, target]
            assert own == tree.predict(features[place : place + 1, 2 * feature : 2 * feature + 2])[0]


def test_features_that_disagree_are_outvoted() -> None:
    near, far = [[0.3, 0.4], [0.31, 0.4], [0.3, 0.41]], [0.6, 0.2]
    windows = np.array([[*near, far], [far, [0.9, 0.05], *near[:2]], [far, *near]])
    np.testing.assert_allclose(consensus(windows, 0.025), [0.3, 0.4], atol=1e-12)
    np.testing.assert_allclose(consensus(windows, 0.001), np.median(windows.reshape(-1, 2), axis=0))
    # A chain is no agreement: its ends are too far apart.
    chain = np.array([[[0.30, 0.4], [0.32, 0.4], [0.34, 0.4], [0.9, 0.05]]])
    np.testing.assert_allclose(consensus(chain, 0.025), [0.33, 0.4])


def test_smart_color_cat_is_exact_where_its_assumption_holds() -> None:
    # The histogram tells the place on the line linearly: a share of red pixels that grows with it.
    rng = np.random.default_rng(0)
    truths = lights_on_a_line(60, rng)
    features = np.zeros((60, FINE), np.float32)
    features[:, 100], features[:, 400] = 1 - truths[:, 0], truths[:, 0]
    model = SmartColorCat().fit_features(features[:40], truths[:40])
    assert len(model.weights) in CHOICES
    assert [*CHOICES] == sorted(bins for bins in CHOICES if FINE % bins == 0 and 3 <= bins <= 60)
    assert recovery_error(model.lights(features[40:]), truths[40:]).max() < 0.3


def test_smart_color_cat_stays_between_the_lights_it_knows() -> None:
    scenes = world(40)
    method = SmartColorCat().fit(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    for image in (np.full((8, 8, 3), RED), np.full((8, 8, 3), GREEN)):
        light = method.estimate(image.astype(np.float32))
        share = light / light.sum()
        assert truths[:, 0].min() - 1e-6 <= share[0] <= truths[:, 0].max() + 1e-6


def test_points_are_moved_to_the_nearest_of_the_band() -> None:
    rng = np.random.default_rng(0)
    corners, width = np.array([[0.0, 0.0], [1.0, 0.2], [2.0, -0.3]]), 0.15
    points = rng.uniform(-1, 3, (50, 2))
    moved = bounded(points, corners[None], np.array([[width, width]]))[0]
    shares = np.linspace(0, 1, 4000)[:, None]
    line = np.concatenate([first * (1 - shares) + last * shares for first, last in itertools.pairwise(corners)])
    gaps = np.linalg.norm(points[:, None] - line, axis=2).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved - points, axis=1), np.maximum(gaps - width, 0), atol=1e-3)


def test_color_beaver_finds_the_line_of_lights() -> None:
    # Estimates beside the line, by a random way across it: bounded to the line they are right.
    rng = np.random.default_rng(0)
    truths = lights_on_a_line(80, rng)
    across = np.array([1, 1]) / np.sqrt(2)
    estimates = (truths[:, [0, 2]] + rng.normal(0, 0.03, (80, 1)) * across)[:, None]
    model = ColorBeaver().fit_features(estimates[:60], truths[:60], seed=0)
    raw = np.stack([estimates[60:, 0, 0], 1 - estimates[60:, 0].sum(axis=1), estimates[60:, 0, 1]], axis=1)
    before, after = recovery_error(raw, truths[60:]), recovery_error(model.lights(estimates[60:]), truths[60:])
    assert np.median(before) > 1.5
    assert np.median(after) < 0.3


def test_color_beaver_chooses_the_better_base() -> None:
    rng = np.random.default_rng(1)
    truths = lights_on_a_line(80, rng)
    good, bad = truths[:, [0, 2]], rng.permutation(truths[:, [0, 2]])
    model = ColorBeaver(norms="1 2", generations=20).fit_features(np.stack([bad, good], axis=1), truths)
    assert int(model.base) == 1


def counts_of(scenes: list[MadeUp]) -> npt.NDArray[np.uint16]:
    found: list[Any] = [KernelRidge().features(scene.image) for scene in scenes]
    return np.stack(found)


def test_kernel_ridge_solves_its_equations() -> None:
    scenes = world(12)
    counts = counts_of(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    model = KernelRidge(penalty=3.0).fit_features(counts, truths)
    # Written down a second time, from the distances: the equations (K + λ I) a = y - mean y with λ = 3 · 12 / 900.
    roots = np.sqrt(counts.reshape(12, -1) / counts.reshape(12, -1).sum(axis=1, keepdims=True))
    distances = ((roots[:, None] - roots[None]) ** 2).sum(axis=2)
    kernel = np.exp(-distances / 2)
    left = (kernel + 3 * 12 / 900 * np.eye(12)) @ model.weights
    np.testing.assert_allclose(left, truths[:, :2] - truths[:, :2].mean(axis=0), atol=1e-12)
    expected = truths[:, :2].mean(axis=0) + kernel @ model.weights
    np.testing.assert_allclose(model.lights(counts)[:, :2], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("brightness", "red", "green"),
    # Four pixels of red, brightness 1, and twelve of green, .5; or 4 over 4 + 6 and 4 over 4 + 3 of 65535.
    [(0.0, 4, 12), (1.0, 26214, 39321), (2.0, 37449, 28086)],
)
def test_kernel_ridge_counts_chromaticities_where_they_lie(brightness: float, red: int, green: int) -> None:
    image = np.zeros((8, 8, 3), np.float32)
    image[0, :4], image[1:2], image[2, :4] = RED, (0.05, 0.4, 0.05), (0.05, 0.4, 0.05)
    counts: Any = KernelRidge(brightness=brightness).features(image)
    assert counts.shape == (64, 64)
    assert (counts[51, 6], counts[6, 51]) == (red, green)
    # Black pixels, most of the image, have no chromaticity.
    assert counts.sum() == red + green


def test_what_is_dark_hardly_counts_for_kernel_ridge() -> None:
    # Half of the image at a hundredth of the brightness, in a colour of its own, as noise and black leave it.
    image = np.full((8, 8, 3), GREY, np.float32)
    image[:4] = np.array(RED) / 200
    found: list[Any] = [KernelRidge().features(one) for one in (image[4:], image)]
    plain, dirty = (np.sqrt(counts / 65535) for counts in found)
    assert 0 < ((plain - dirty) ** 2).sum() < 0.02


def test_the_penalty_of_kernel_ridge_grows_with_the_images() -> None:
    # Twice the same images are the same problem: with a fixed penalty they would be fitted more closely.
    scenes = world(20)
    learner = KernelRidge()
    counts = counts_of(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    once = learner.fit_features(counts, truths)
    twice = learner.fit_features(np.concatenate([counts, counts]), np.concatenate([truths, truths]))
    other = counts_of(world(5, seed=1))
    np.testing.assert_allclose(once.lights(other), twice.lights(other), atol=1e-10)


@pytest.mark.parametrize("learner", [KernelRidge, LogChroma])
def test_counts_of_the_largest_working_size_are_not_cut(learner: type[KernelRidge | LogChroma]) -> None:
    image = np.full((255, 255, 3), RED, np.float32)
    own: dict[str, Any] = {"brightness": 0.0} if learner is KernelRidge else {}
    counts: Any = learner(working_size=255, **own).features(image)
    assert counts.max() == 255 * 255
    with pytest.raises(ValueError, match=r"256 px.*1 to 255"):
        learner(working_size=256)


@pytest.mark.parametrize(
    ("learner", "module", "package"),
    [(RegressionTrees(), "sklearn", "scikit-learn"), (ConvNet(), "torch", "torch")],
)
def test_what_is_not_installed_is_named_with_its_remedy(
    learner: FeatureLearner, module: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=f"{module}.*pip install {package}"):
        learner.fit(world(3))


def test_a_saved_forest_needs_no_scikit_learn(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = world(12)
    learner = RegressionTrees(windows=2)
    arrays = learner.fit(scenes).model.arrays()
    monkeypatch.setitem(sys.modules, "sklearn", None)
    features: Any = learner.features(scenes[0].image)
    assert np.isfinite(learner.restore(arrays).lights(features[None])).all()


def test_blocks_are_means_of_usable_pixels() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(1, 60000, (37, 50, 3)).astype(np.uint16)
    mask = rng.random((37, 50)) < 0.3
    small, used = reduce(image, None, mask, 13)
    assert small.shape == (10, 13, 3)
    means = np.zeros((10, 13, 3))
    for row, column in itertools.product(range(10), range(13)):
        block = np.s_[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        free = ~mask[block]
        if free.mean() >= 0.5:
            means[row, column] = image[block][free].mean(axis=0)
        assert used[row, column] == (free.mean() >= 0.5)
    np.testing.assert_allclose(small, means / means.max(), rtol=1e-5, atol=1e-7)
    # Whatever the unit; an image that is no larger keeps its pixels, and one without a usable pixel is black.
    np.testing.assert_allclose(reduce(image * 2.0**-40, None, mask, 13)[0], small, rtol=1e-6)
    kept, free = reduce(image, None, mask, 50)
    np.testing.assert_array_equal(free, ~mask)
    np.testing.assert_allclose(kept, np.where(free[..., None], image, 0) / image[free].max(), rtol=1e-6)
    for longest in (13, 50):
        black, none = reduce(image, None, np.ones_like(mask), longest)
        assert not none.any()
        assert not black.any()


def test_a_band_of_a_file_that_cannot_be_is_refused() -> None:
    learner = ColorBeaver(norms="1 2", corners=2)
    arrays: dict[str, Any] = {"corners": np.zeros((2, 2)), "widths": np.zeros(2), "base": np.array(1)}
    assert learner.restore(arrays).base == 1
    with pytest.raises(ValueError, match="shapes"):
        learner.restore({**arrays, "base": np.array(2)})
    assert learner.restore({**arrays, "base": np.array(0)}).base == 0
