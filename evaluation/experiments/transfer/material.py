"""A data set as learners take it: features extracted once, then any part of it to train on or to test."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import (
    FeatureLearner,
    Features,
    LearnedMethod,
    extract,
    fit_extracted,
    truths_of,
)
from evaluation.methods.method import Learner, Method
from evaluation.methods.pixels import GREY
from evaluation.metrics import ErrorKind, recovery_error, reproduction_error
from evaluation.results.result import Result
from evaluation.scene import Scene

Places = npt.NDArray[np.int64]
"""(P,) int64: which scenes of a data set, from 0."""

AnyLearner = Learner | FeatureLearner
"""A learner of either kind: of scenes, or of features."""


@dataclass(frozen=True, eq=False)
class Material:
    """Scenes with all that some learners take from them.

    Attributes
    ----------
    scenes
        N scenes.
    truths
        (N, 3) float64, linear camera RGB of any length.
    features
        For each learner its features of each scene, (...) of its own dtype or None where no pixel is usable; None for a
        learner that reads the scenes itself.
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
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Material:
    """Return the material of scenes for learners; each image is read once for all that extract features.

    Raises
    ------
    InputError
        A ground truth is no light to learn from, or there is no scene.
    FormatError
        An image cannot be read.
    """
    truths = truths_of(scenes)
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
    return learner.fit([material.scenes[place] for place in _list(places)], seed)


def estimate_on(
    method: Method, number: int, material: Material, places: Places
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return the lights (P, 3) float64 of the scenes at `places` (P,) int64, of length 1, and which were guessed.

    The second array, (P,) bool, is True where no pixel was usable and the light is `pixels.GREY`.
    """
    features = material.features[number]
    if isinstance(method, LearnedMethod) and features is not None:
        given = [features[place] for place in _list(places)]
        guessed = np.array([one is None for one in given])
        lights = np.tile(GREY, (len(given), 1))
        seen = [one for one in given if one is not None]
        if seen:
            found = np.asarray(method.model.lights(np.stack(seen)), dtype=np.float64)
            lights[~guessed] = found / np.linalg.norm(found, axis=1, keepdims=True)
        return lights, guessed
    estimates: list[npt.NDArray[np.float64]] = []
    for place in _list(places):
        scene = material.scenes[place]
        image, mask = scene.read()
        estimates.append(method.estimate(image, scene.saturation, mask))
    return np.stack(estimates), np.array([light is GREY for light in estimates])


def result_of(
    name: str, lights: npt.NDArray[np.float64], guessed: npt.NDArray[np.bool_], truths: npt.NDArray[np.float64]
) -> Result:
    """Return the result of estimated lights (N, 3), guessed ones (N,) bool, against truths (N, 3) float64."""
    errors: dict[ErrorKind, npt.NDArray[np.float64]] = {
        "recovery": recovery_error(lights, truths),
        "reproduction": reproduction_error(lights, truths),
    }
    return Result(name, lights, errors, guessed)


def _list(places: Places) -> list[int]:
    return [int(place) for place in places.tolist()]
