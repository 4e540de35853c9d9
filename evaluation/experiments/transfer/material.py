"""A data set as learners take it: features extracted once, then any part of it to train on or to test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.experiments.running import answer_scenes, fit_anew
from evaluation.experiments.transfer.thumbnails import make_small
from evaluation.learning.feature_learner import (
    FeatureLearner,
    Features,
    LearnedMethod,
    extract,
    fit_extracted,
    truths_of,
)
from evaluation.methods.method import Learner, Method
from evaluation.results.answers import NO_PIXEL, SceneAnswer, read_light, results_of
from evaluation.results.result import Result
from evaluation.scene import Scene

Places = npt.NDArray[np.int64]
"""(P,) int64: which scenes of a data set, from 0."""

AnyLearner = Learner | FeatureLearner
"""A learner of either kind: of scenes, or of features."""


@dataclass(frozen=True, eq=False)
class Material:
    """Scenes with all that some learners take from them.

    - `scenes`: N scenes.
    - `truths`: (N, 3) float64, linear camera RGB of any length.
    - `features`: for each learner its features of each scene, (...) of its own dtype or None where no pixel is usable;
      None for a learner that reads the scenes itself.
    """

    scenes: tuple[Scene, ...]
    truths: npt.NDArray[np.float64]
    features: tuple[Sequence[Features | None] | None, ...]

    @property
    def everything(self) -> Places:
        """All places, (N,) int64."""
        return np.arange(len(self.scenes))


def gather(
    scenes: Sequence[Scene],
    learners: Sequence[AnyLearner],
    side: int | None = None,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Material:
    """Return the material of scenes for learners; each image is read once for all that extract features.

    `side`: longest side that images are made small to first, px, in memory; None leaves them as they are.
    """
    truths = truths_of(scenes)
    if side is not None:
        scenes, on_scene = make_small(scenes, side, workers, on_scene), None
    extracting = [learner for learner in learners if isinstance(learner, FeatureLearner)]
    given = iter(extract(scenes, extracting, workers, on_scene) if extracting else ())
    features = tuple(next(given) if isinstance(learner, FeatureLearner) else None for learner in learners)
    if on_scene and not extracting:
        for _ in scenes:
            on_scene()
    return Material(tuple(scenes), truths, features)


def fit_on(learner: AnyLearner, number: int, material: Material, places: Places, seed: int) -> Method:
    """Return the learner fitted to the scenes at `places` (P,) int64; `number` is its place among the learners."""
    features = material.features[number]
    if isinstance(learner, FeatureLearner) and features is not None:
        return fit_extracted(learner, [features[place] for place in _list(places)], material.truths[places], seed)
    scenes = [material.scenes[place] for place in _list(places)]
    return fit_anew(learner, scenes, seed)


def estimate_on(method: Method, number: int, material: Material, places: Places) -> list[SceneAnswer]:
    """Return what a fitted method answers for the scenes at `places` (P,) int64, P answers."""
    features = material.features[number]
    if not isinstance(method, LearnedMethod) or features is None:
        scenes = [material.scenes[place] for place in _list(places)]
        return [answer for (answer,) in answer_scenes(scenes, [method])]
    given = [features[place] for place in _list(places)]
    seen = [one for one in given if one is not None]
    lights = iter(method.model.lights(np.stack(seen)) if seen else ())
    return [SceneAnswer(None, NO_PIXEL) if one is None else read_light(next(lights)) for one in given]


def result_of(name: str, answers: Sequence[SceneAnswer], truths: npt.NDArray[np.float64]) -> Result:
    """Return the result that N answers make, held to truths (N, 3) float64."""
    (result,) = results_of([name], truths, [[answer] for answer in answers])
    return result


def _list(places: Places) -> list[int]:
    return [int(place) for place in places.tolist()]
