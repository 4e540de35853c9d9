"""The contract of adapting, which every learned method keeps, and the rule by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.adapting import adapt, learn_alone
from evaluation.learning.feature_learner import FeatureLearner, LearnedMethod, extract, truths_of
from evaluation.learning.model_files import load_model, save_model
from evaluation.metrics import recovery_error
from tests.evaluation.learning.made_up_world import LEARNERS, QUICK, world
from tests.evaluation.learning.stories import story
from tests.evaluation.made_scenes import Made

ELSEWHERE, HERE, TEST = world(40, cast=0.4), world(8, seed=2), world(8, seed=1)


def of(scenes: list[Made], method: LearnedMethod) -> npt.NDArray[np.float64]:
    return np.stack([method.estimate(scene.image) for scene in scenes])


@pytest.fixture(scope="module", params=QUICK)
def learner(request: pytest.FixtureRequest) -> FeatureLearner:
    if request.param == "convnet":
        pytest.importorskip("torch", reason="PyTorch is not installed: pip install torch")
    return QUICK[request.param]


@pytest.fixture(scope="module")
def taught(learner: FeatureLearner) -> LearnedMethod:
    return learner.fit(ELSEWHERE)


def adapted(taught: LearnedMethod, scenes: list[Made], worth: float | None = None) -> LearnedMethod:
    (features,) = extract(scenes, [taught.learner])
    alone = learn_alone(taught.learner, features, truths_of(scenes))
    return adapt(taught, alone) if worth is None else adapt(taught, alone, worth)


@pytest.mark.slow
def test_worth_nothing_it_is_what_the_images_teach_alone(taught: LearnedMethod) -> None:
    alone = of(TEST, taught.learner.fit(HERE))
    np.testing.assert_array_equal(of(TEST, adapted(taught, HERE, worth=0)), alone)


@pytest.mark.slow
def test_it_is_repeated_and_kept_to_the_bit_and_adapted_again(taught: LearnedMethod, tmp_path: Path) -> None:
    once = adapted(taught, HERE)
    found = of(TEST, once)
    # What is repeated begins with a file: a model from one is adapted as the one that was saved.
    save_model(tmp_path / "taught.npz", taught, story(ELSEWHERE))
    np.testing.assert_array_equal(of(TEST, adapted(load_model(tmp_path / "taught.npz"), HERE)), found)
    save_model(tmp_path / "model.npz", once, story(HERE))
    loaded = load_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(of(TEST, loaded), found)
    again = adapted(loaded, HERE[:4])
    assert np.isfinite(of(TEST[:3], again)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["kernel-ridge", "log-chroma"])
def test_what_learns_of_both_follows_the_images_more_the_less_the_other_is_worth(name: str) -> None:
    learner = LEARNERS[name]
    (features,) = extract(HERE, [learner])
    given, truths = np.stack([one for one in features if one is not None]), truths_of(HERE)
    model = learner.fit(ELSEWHERE).model
    tuned = [learner.tune(model, given, truths, worth) for worth in (60, 6, 1)]
    before, *after = (np.mean(recovery_error(one.lights(given), truths)) for one in (model, *tuned))
    assert before > after[0] > after[1] > after[2]


@pytest.mark.slow
def test_one_image_leaves_it_near_what_it_was(taught: LearnedMethod) -> None:
    moved = recovery_error(of(TEST, adapted(taught, HERE[:1])), of(TEST, taught))
    alone = recovery_error(of(TEST, taught.learner.fit(HERE[:1])), of(TEST, taught))
    assert np.mean(moved) <= 0.5 * np.mean(alone) + 1e-9


@pytest.mark.slow
def test_many_images_overrule_what_was_learned_wrongly() -> None:
    learner = LEARNERS["kernel-ridge"]
    wrong = learner.fit([Made(one.name, one.truth[::-1].copy(), one.image) for one in world(60)])
    many = world(200, seed=3)
    truths = np.stack([scene.truth for scene in TEST])
    found = np.mean(recovery_error(of(TEST, adapted(wrong, many)), truths))
    alone = np.mean(recovery_error(of(TEST, learner.fit(many)), truths))
    before = np.mean(recovery_error(of(TEST, wrong), truths))
    assert found < 1.15 * alone < 0.5 * before
