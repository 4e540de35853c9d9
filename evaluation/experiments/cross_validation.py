"""Cross-validation: every image is estimated by a model that has not seen it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from evaluation.experiments.folds import require_apart
from evaluation.experiments.running import answer_scenes, fit_anew
from evaluation.learning.feature_learner import (
    FeatureLearner,
    Features,
    extract,
    fit_extracted,
    require_installed,
    truths_of,
)
from evaluation.methods.method import Learner
from evaluation.methods.prepared import unit
from evaluation.results.answers import NO_PIXEL, SceneAnswer, read_light, results_of
from evaluation.results.result import Result
from evaluation.scene import Scene
from foundation.errors import InputError


def cross_validate(
    scenes: Sequence[Scene],
    learners: Sequence[Learner],
    folds: npt.NDArray[np.int64],
    seed: int = 0,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[Result, ...]:
    """Return the estimates and errors of learned methods, each image by the model trained on the other folds.

    Images are read once for all learners that extract features, and again in each fold by those that only have
    `fit(scenes, seed)`.

    `folds`: (N,) int64, the fold of each image, of at least two kinds.
    """
    truths = truths_of(scenes)
    kinds = sorted(set(folds.tolist()))
    if not learners or len(kinds) < 2:
        raise InputError(f"{len(learners)} methods in {len(kinds)} folds: expected at least one method and two folds")
    for learner in learners:
        require_installed(learner)
    require_apart(scenes, folds)
    extracting = [learner for learner in learners if isinstance(learner, FeatureLearner)]
    features = iter(extract(scenes, extracting, workers, on_scene) if extracting else ())
    answers = [
        _by_features(learner, next(features), truths, folds, seed)
        if isinstance(learner, FeatureLearner)
        else _by_scenes(learner, scenes, folds, seed)
        for learner in learners
    ]
    if on_scene and not extracting:
        for _ in scenes:
            on_scene()
    return results_of([learner.name for learner in learners], truths, list(zip(*answers, strict=True)))


def _by_features(
    learner: FeatureLearner,
    features: Sequence[Features | None],
    truths: npt.NDArray[np.float64],
    folds: npt.NDArray[np.int64],
    seed: int,
) -> list[SceneAnswer]:
    answers = [SceneAnswer(None, NO_PIXEL)] * len(features)
    for fold in sorted(set(folds.tolist())):
        train = folds != fold
        chosen = [given for given, taken in zip(features, train, strict=True) if taken]
        model = fit_extracted(learner, chosen, truths[train], seed).model
        for place, given in enumerate(features):
            if not train[place] and given is not None:
                answers[place] = read_light(unit(model.lights(given[None])[0]))
    return answers


def _by_scenes(learner: Learner, scenes: Sequence[Scene], folds: npt.NDArray[np.int64], seed: int) -> list[SceneAnswer]:
    answers = [SceneAnswer(None, NO_PIXEL)] * len(scenes)
    for fold in sorted(set(folds.tolist())):
        train = [scene for scene, where in zip(scenes, folds, strict=True) if where != fold]
        held = np.flatnonzero(folds == fold).tolist()
        method = fit_anew(learner, train, seed)
        for place, (answer,) in zip(held, answer_scenes([scenes[place] for place in held], [method]), strict=True):
            answers[place] = answer
    return answers
