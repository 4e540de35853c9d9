"""Contract of all learned methods of the commands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.feature_learner import FeatureLearner, LearnedMethod
from evaluation.learning.model_files import load_model, save_model
from evaluation.methods.prepared import GREY
from evaluation.metrics import recovery_error
from foundation.errors import InputError
from tests.evaluation.learning.made_up_world import LEARNERS, QUICK, constant_light, world
from tests.evaluation.learning.stories import story

pytestmark = pytest.mark.slow

TRAIN, TEST = world(60), world(30, seed=1)
# Methods that use the image; the constant estimate has separate tests.
IMAGE_LEARNERS = {key: learner for key, learner in LEARNERS.items() if key != "constant-light"}


@pytest.fixture(scope="module", params=IMAGE_LEARNERS)
def learner(request: pytest.FixtureRequest) -> FeatureLearner:
    if request.param == "convnet":
        pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    return IMAGE_LEARNERS[request.param]


@pytest.fixture
def quick(learner: FeatureLearner) -> FeatureLearner:
    """Return the same method with less training."""
    return next(QUICK[key] for key, candidate in IMAGE_LEARNERS.items() if candidate is learner)


@pytest.fixture(scope="module")
def fitted(learner: FeatureLearner) -> LearnedMethod:
    return learner.fit(TRAIN, seed=3)


def errors(method: LearnedMethod) -> np.ndarray:
    estimates = np.stack([method.estimate(scene.image) for scene in TEST])
    np.testing.assert_allclose(np.linalg.norm(estimates, axis=1), 1, rtol=1e-9)
    return recovery_error(estimates, np.stack([scene.truth for scene in TEST]))


def test_is_better_than_constant_estimate(fitted: LearnedMethod) -> None:
    truths = np.stack([scene.truth for scene in TEST])
    constant = recovery_error(np.tile(constant_light(TRAIN), (len(TEST), 1)), truths)
    # Illuminants span 15°, and surfaces determine them within about 1°.
    median = np.median(errors(fitted))
    assert median < 0.4 * np.median(constant)
    assert median < 2.5


def test_is_reproducible_with_seed(quick: FeatureLearner) -> None:
    first, second = (quick.fit(TRAIN, seed=3) for _ in range(2))
    for name, array in first.model.arrays().items():
        np.testing.assert_array_equal(array, second.model.arrays()[name], err_msg=name)


def test_saved_model_returns_identical_estimates(fitted: LearnedMethod, tmp_path: Path) -> None:
    save_model(tmp_path / "model.npz", fitted, story(TRAIN))
    loaded = load_model(tmp_path / "model.npz")
    assert loaded.learner == fitted.learner
    for scene in TEST[:10]:
        np.testing.assert_array_equal(loaded.estimate(scene.image), fitted.estimate(scene.image))


def test_estimate_does_not_depend_on_exposure(fitted: LearnedMethod) -> None:
    for scene in TEST[:5]:
        plain = fitted.estimate(scene.image)
        np.testing.assert_allclose(fitted.estimate(scene.image * np.float32(4096)), plain, atol=1e-6)


def test_ignores_masked_and_clipped_pixels(fitted: LearnedMethod) -> None:
    scene = TEST[0]
    spoilt, mask = scene.image.copy(), np.zeros(scene.image.shape[:2], dtype=bool)
    spoilt[8:16, 4:20], mask[8:16, 4:20] = [0.9, 0.01, 0.3], True
    blank = np.where(mask[..., None], 0, scene.image).astype(np.float32)
    under_mask = fitted.estimate(spoilt, None, mask)
    np.testing.assert_array_equal(under_mask, fitted.estimate(blank, None, mask))
    assert recovery_error(under_mask, scene.truth) < 6
    clipped = blank.copy()
    clipped[8:16, 4:20] = 50
    ring = np.zeros_like(mask)
    ring[7:17, 3:21] = True
    np.testing.assert_array_equal(fitted.estimate(clipped, 50), fitted.estimate(blank, None, ring))


def test_image_without_usable_pixel_is_grey_and_excluded_from_training(quick: FeatureLearner) -> None:
    black = replace(TRAIN[0], image=np.zeros_like(TRAIN[0].image))
    method = quick.fit([*TRAIN[:12], black])
    plain = quick.fit(TRAIN[:12])
    assert method.estimate(black.image) is GREY
    for name, array in plain.model.arrays().items():
        np.testing.assert_array_equal(array, method.model.arrays()[name], err_msg=name)
    with pytest.raises(InputError):
        quick.fit([black])


def test_reduces_large_images(fitted: LearnedMethod) -> None:
    rng = np.random.default_rng(0)
    small: list[npt.NDArray[np.float64]] = []
    large: list[npt.NDArray[np.float64]] = []
    for scene in TEST[:8]:
        image = np.kron(scene.image, np.ones((9, 9, 1), np.float32))
        image *= rng.uniform(0.9, 1.1, image.shape).astype(np.float32)
        small.append(recovery_error(fitted.estimate(scene.image), scene.truth))
        large.append(recovery_error(fitted.estimate(image), scene.truth))
    assert np.mean(large) < np.mean(small) + 1.5


def test_fits_one_scene(learner: FeatureLearner) -> None:
    light = learner.fit(TRAIN[:1]).estimate(TRAIN[0].image)
    assert recovery_error(light, TRAIN[0].truth) < 3
