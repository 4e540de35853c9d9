"""Adaptation of all learned methods to local images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.adapting import adapt, fit_local
from evaluation.learning.feature_learner import FeatureLearner, LearnedMethod, extract, truths_of
from evaluation.learning.model_files import load_model, save_model
from evaluation.metrics import recovery_error
from tests.evaluation.learning.made_up_world import LEARNERS, QUICK, world
from tests.evaluation.learning.stories import story
from tests.evaluation.made_scenes import Made

DISTANT, LOCAL, TEST = world(40, cast=0.4), world(8, seed=2), world(8, seed=1)


def estimates_of(scenes: list[Made], method: LearnedMethod) -> npt.NDArray[np.float64]:
    return np.stack([method.estimate(scene.image) for scene in scenes])


@pytest.fixture(scope="module", params=QUICK)
def learner(request: pytest.FixtureRequest) -> FeatureLearner:
    if request.param == "convnet":
        pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    return QUICK[request.param]


@pytest.fixture(scope="module")
def pretrained(learner: FeatureLearner) -> LearnedMethod:
    return learner.fit(DISTANT)


def adapted(pretrained: LearnedMethod, scenes: list[Made], worth: float | None = None) -> LearnedMethod:
    (features,) = extract(scenes, [pretrained.learner])
    local_fit = fit_local(pretrained.learner, features, truths_of(scenes))
    return adapt(pretrained, local_fit) if worth is None else adapt(pretrained, local_fit, worth)


@pytest.mark.slow
def test_returns_local_method_with_worth_zero(pretrained: LearnedMethod) -> None:
    expected = estimates_of(TEST, pretrained.learner.fit(LOCAL))
    np.testing.assert_array_equal(estimates_of(TEST, adapted(pretrained, LOCAL, worth=0)), expected)


@pytest.mark.slow
def test_is_reproducible_stored_exactly_and_adaptable_again(pretrained: LearnedMethod, tmp_path: Path) -> None:
    first = adapted(pretrained, LOCAL)
    expected = estimates_of(TEST, first)
    # A model from a file is adapted like the saved one.
    save_model(tmp_path / "pretrained.npz", pretrained, story(DISTANT))
    np.testing.assert_array_equal(estimates_of(TEST, adapted(load_model(tmp_path / "pretrained.npz"), LOCAL)), expected)
    save_model(tmp_path / "model.npz", first, story(LOCAL))
    loaded = load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(estimates_of(TEST, loaded), expected)
    again = adapted(loaded, LOCAL[:4])
    assert np.isfinite(estimates_of(TEST[:3], again)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kernel-ridge", "log-chroma"])
def test_tuning_follows_images_more_with_smaller_worth(name: str) -> None:
    learner = LEARNERS[name]
    (features,) = extract(LOCAL, [learner])
    stacked, truths = np.stack([image for image in features if image is not None]), truths_of(LOCAL)
    model = learner.fit(DISTANT).model
    tuned = [learner.tune(model, stacked, truths, worth) for worth in (60, 6, 1)]
    errors = [np.mean(recovery_error(candidate.lights(stacked), truths)) for candidate in (model, *tuned)]
    assert errors[0] > errors[1] > errors[2] > errors[3]


@pytest.mark.slow
def test_one_image_changes_little(pretrained: LearnedMethod) -> None:
    changes = recovery_error(estimates_of(TEST, adapted(pretrained, LOCAL[:1])), estimates_of(TEST, pretrained))
    local_changes = recovery_error(
        estimates_of(TEST, pretrained.learner.fit(LOCAL[:1])), estimates_of(TEST, pretrained)
    )
    assert np.mean(changes) <= 0.5 * np.mean(local_changes) + 1e-9


@pytest.mark.slow
def test_many_images_outweigh_wrong_pretraining() -> None:
    learner = LEARNERS["kernel-ridge"]
    wrong_method = learner.fit([Made(scene.name, scene.truth[::-1].copy(), scene.image) for scene in world(60)])
    scenes = world(200, seed=3)
    truths = np.stack([scene.truth for scene in TEST])
    error = np.mean(recovery_error(estimates_of(TEST, adapted(wrong_method, scenes)), truths))
    local_error = np.mean(recovery_error(estimates_of(TEST, learner.fit(scenes)), truths))
    wrong_error = np.mean(recovery_error(estimates_of(TEST, wrong_method), truths))
    assert error < 1.15 * local_error < 0.5 * wrong_error
