"""The shape of a learned method that looks at an image once: features first, then a model of features.

A `FeatureLearner` turns an image into features without knowing any light, so that cross-validation reads each image
once however many folds there are; what it fits is a `LightModel`, arrays and nothing else, which a model file can hold.
A class of a user's own need not have this shape: `methods.method.Learner` with its `fit(scenes, seed)` is enough.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from evaluation.methods.prepared import GREY, unit
from evaluation.scene import Image, Scene, report_progress
from foundation.compiled import ordered_map
from foundation.errors import InputError

# Features of one image (...) of any dtype; each learner says which shape and dtype its own have.
Features = npt.NDArray[Any]


class LightModel(Protocol):
    """What was learned: the light as a function of features."""

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the lights (N, 3) float64, camera RGB, r + g + b = 1, of the features (N, ...) of N images.

        The light of an image does not depend on the images beside it.
        """
        ...

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return what a model file holds: arrays of any shape and dtype but `object`, by their names."""
        ...


class FeatureLearner(ABC):
    """A method yet to be fitted: a frozen dataclass whose fields, plain numbers and words, are its settings."""

    key: ClassVar[str]  # Its name on the command line and in model files

    title: ClassVar[str]  # Its name in tables, where that does not depend on its settings

    needs: ClassVar[tuple[str, str] | None] = None
    """What training needs beside NumPy and SciPy: the module, and the command that installs it; None if nothing."""

    @property
    def name(self) -> str:
        """Its name in tables."""
        return self.title

    @abstractmethod
    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> Features | None:
        """Return the features (...) of one image, its dtype the learner's own; None where no pixel is usable.

        See `methods.method.Method.estimate` for what is given: image (H, W, 3), mask (H, W) bool.
        """

    @abstractmethod
    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LightModel:
        """Return the model that was fitted to features and lights; the same for the same seed.

        `features`: (N, ...) of the learner's dtype, N ≥ 1. `truths`: (N, 3) float64, lights in linear camera RGB, r + g
        + b = 1.
        """

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> LightModel:
        """Return a model that `fit_features` made elsewhere, tuned to few images; most have nothing to tune.

        `features`: (N, ...) of the learner's dtype. `truths`: (N, 3) float64. `worth`: images of the few that what was
        learned elsewhere is worth together.
        """
        del features, truths, worth, seed
        return model

    @abstractmethod
    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightModel:
        """Return the model whose `arrays` (of any shape and dtype, see there) are given."""

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> LearnedMethod:
        """Return the method fitted to scenes; see `methods.method.Learner.fit`."""
        (given,) = extract(scenes, [self])
        return fit_extracted(self, given, truths_of(scenes), seed)


@dataclass(frozen=True, eq=False)
class LearnedMethod:
    """A learner with what it has learned: a method like any other.

    - `learner`: what extracts the features.
    - `model`: what estimates the light from them.
    - `trained_on`: name of the data set, where it is to stand in the tables beside the method's name: a model from a
      file.
    """

    learner: FeatureLearner
    model: LightModel
    trained_on: str | None = None

    @property
    def name(self) -> str:
        """The method's name in tables; of a model from a file also what it was trained on."""
        return self.learner.name + (f" (trained on {self.trained_on})" if self.trained_on else "")

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `methods.method.Method.estimate`.

        The image is (H, W, 3), the mask (H, W) bool.
        """
        features = self.learner.features(image, saturation, mask)
        return GREY if features is None else unit(self.model.lights(features[None])[0])


def extract(
    scenes: Sequence[Scene],
    learners: Sequence[FeatureLearner],
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[list[Features | None], ...]:
    """Return the features of every scene for every learner; each image is read once.

    Returns for each learner, in their order, the features (...) of each scene, of the learner's dtype, or None.
    """

    def of_one(scene: Scene) -> list[Features | None]:
        image, mask = scene.read()
        return [learner.features(image, scene.saturation, mask) for learner in learners]

    rows = list(report_progress(ordered_map(of_one, scenes, workers), on_scene))
    return tuple([row[place] for row in rows] for place in range(len(learners)))


def fit_extracted(
    learner: FeatureLearner, features: Sequence[Features | None], truths: npt.NDArray[np.float64], seed: int = 0
) -> LearnedMethod:
    """Return the method fitted to extracted features; images without a usable pixel are left out.

    `features`: N entries, each (...) of the learner's dtype, or None. `truths`: (N, 3) float64, lights in linear camera
    RGB of any length.
    """
    usable = [place for place, given in enumerate(features) if given is not None]
    if not usable:
        raise InputError(
            f"{learner.name} cannot be trained: none of {len(features)} images has a usable pixel; give it images that "
            "are not wholly clipped or masked"
        )
    stacked: Any = np.stack([given for given in features if given is not None])
    chosen = truths[usable]
    return LearnedMethod(learner, learner.fit_features(stacked, chosen / chosen.sum(axis=1, keepdims=True), seed))


def require_installed(learner: object) -> None:
    """Refuse a learner whose training needs a library that is not installed."""
    reason = what_is_missing(learner)
    if reason:
        raise InputError(reason)


def what_is_missing(learner: object) -> str | None:
    """Return why a learner cannot be trained here, with the remedy; None if it can, or is not one of the house's."""
    if not isinstance(learner, FeatureLearner) or learner.needs is None:
        return None
    module, remedy = learner.needs
    try:
        import_module(module)
    except ImportError:
        return f"training {learner.key} needs {module}, which is not installed: {remedy}"
    return None


def truths_of(scenes: Sequence[Scene]) -> npt.NDArray[np.float64]:
    """Return the ground truths (N, 3) float64, linear camera RGB, of N scenes."""
    if not scenes:
        raise InputError("0 images: expected at least one to learn from")
    truths = np.stack([np.asarray(scene.truth, dtype=np.float64) for scene in scenes])
    bad = ~(np.isfinite(truths) & (truths > 0)).all(axis=1)
    if bad.any():
        place = int(np.argmax(bad))
        raise InputError(
            f"the ground truth of {scenes[place].name} is {' '.join(f'{part:g}' for part in truths[place])}, expected "
            "red, green and blue of a light, each above 0, to learn from; correct it"
        )
    return truths
