"""The contract of every learned method that the commands offer."""

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
LOOKING = {key: learner for key, learner in LEARNERS.items() if key != "constant-light"}
"""All that look at images; the constant light has tests of its own."""


@pytest.fixture(scope="module", params=LOOKING)
def learner(request: pytest.FixtureRequest) -> FeatureLearner:
    if request.param == "convnet":
        pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    return LOOKING[request.param]


@pytest.fixture
def quick(learner: FeatureLearner) -> FeatureLearner:
    """Return the same method, trained for less."""
    return next(QUICK[key] for key, one in LOOKING.items() if one is learner)


@pytest.fixture(scope="module")
def fitted(learner: FeatureLearner) -> LearnedMethod:
    return learner.fit(TRAIN, seed=3)


def errors(method: LearnedMethod) -> np.ndarray:
    estimates = np.stack([method.estimate(scene.image) for scene in TEST])
    np.testing.assert_allclose(np.linalg.norm(estimates, axis=1), 1, rtol=1e-9)
    return recovery_error(estimates, np.stack([scene.truth for scene in TEST]))


def test_it_learns_what_a_constant_light_does_not(fitted: LearnedMethod) -> None:
    truths = np.stack([scene.truth for scene in TEST])
    constant = recovery_error(np.tile(constant_light(TRAIN), (len(TEST), 1)), truths)
    found = errors(fitted)
    # The lights reach 15 degrees from end to end; surfaces give them away to about a degree.
    assert np.median(found) < 0.4 * np.median(constant)
    assert np.median(found) < 2.5


def test_the_seed_alone_decides(quick: FeatureLearner) -> None:
    once, again = (quick.fit(TRAIN, seed=3) for _ in range(2))
    for name, array in once.model.arrays().items():
        np.testing.assert_array_equal(array, again.model.arrays()[name], err_msg=name)


def test_a_saved_model_gives_the_same_bits(fitted: LearnedMethod, tmp_path: Path) -> None:
    save_model(tmp_path / "model.npz", fitted, story(TRAIN))
    loaded = load_model(tmp_path / "model.npz")
    assert loaded.learner == fitted.learner
    for scene in TEST[:10]:
        np.testing.assert_array_equal(loaded.estimate(scene.image), fitted.estimate(scene.image))


def test_neither_exposure_nor_unit_matters(fitted: LearnedMethod) -> None:
    for scene in TEST[:5]:
        plain = fitted.estimate(scene.image)
        np.testing.assert_allclose(fitted.estimate(scene.image * np.float32(4096)), plain, atol=1e-6)


def test_masked_and_clipped_pixels_do_not_count(fitted: LearnedMethod) -> None:
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


def test_an_image_without_a_usable_pixel_is_marked_and_not_learned_from(quick: FeatureLearner) -> None:
    black = replace(TRAIN[0], image=np.zeros_like(TRAIN[0].image))
    method = quick.fit([*TRAIN[:12], black])
    plain = quick.fit(TRAIN[:12])
    assert method.estimate(black.image) is GREY
    for name, array in plain.model.arrays().items():
        np.testing.assert_array_equal(array, method.model.arrays()[name], err_msg=name)
    with pytest.raises(InputError):
        quick.fit([black])


def test_large_images_are_reduced(fitted: LearnedMethod) -> None:
    rng = np.random.default_rng(0)
    small: list[npt.NDArray[np.float64]] = []
    large: list[npt.NDArray[np.float64]] = []
    for scene in TEST[:8]:
        image = np.kron(scene.image, np.ones((9, 9, 1), np.float32))
        image *= rng.uniform(0.9, 1.1, image.shape).astype(np.float32)
        small.append(recovery_error(fitted.estimate(scene.image), scene.truth))
        large.append(recovery_error(fitted.estimate(image), scene.truth))
    assert np.mean(large) < np.mean(small) + 1.5


def test_one_scene_is_enough_to_fit(learner: FeatureLearner) -> None:
    light = learner.fit(TRAIN[:1]).estimate(TRAIN[0].image)
    assert recovery_error(light, TRAIN[0].truth) < 3
