"""Contract of learned methods that extract features from an image and fit a model to the features.

`FeatureLearner.features` does not use ground truths, so cross-validation reads each image only once. The fitted
`LightModel` consists of arrays, which can be stored in a model file. Classes of users need only `fit(scenes, seed)`,
see `methods.method.Learner`.
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

# Features of one image (...) of any dtype; shape and dtype depend on the learner.
Features = npt.NDArray[Any]


class LightModel(Protocol):
    """Fitted model, which estimates illuminants from features."""

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        """Return the estimates for N images.

        Parameters
        ----------
        features
            (N, ...) of the learner's dtype.

        Returns
        -------
        numpy.ndarray
            (N, 3) float64, linear camera RGB, r + g + b = 1; each estimate depends only on its own image.
        """
        ...

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        """Return the arrays for a model file by name, of any shape and dtype except `object`."""
        ...


class FeatureLearner(ABC):
    """Method that must be fitted. A subclass is a frozen dataclass with settings (numbers or strings) as fields."""

    key: ClassVar[str]  # name on the command line and in model files

    title: ClassVar[str]  # name in tables, if it does not depend on the settings

    # Additional module for training, and the command that installs it; None if no module is required
    needs: ClassVar[tuple[str, str] | None] = None

    @property
    def name(self) -> str:
        """Name in tables."""
        return self.title

    @abstractmethod
    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> Features | None:
        """Return the features of one image.

        Parameters
        ----------
        image
            (H, W, 3), see `methods.method.Method.estimate`.
        saturation
            See `methods.method.Method.estimate`.
        mask
            (H, W) bool, see `methods.method.Method.estimate`.

        Returns
        -------
        numpy.ndarray or None
            Shape and dtype depend on the learner; None if no pixel is usable.
        """

    @abstractmethod
    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> LightModel:
        """Return the model fitted to features and ground truths.

        Parameters
        ----------
        features
            (N, ...) of the learner's dtype, N ≥ 1.
        truths
            (N, 3) float64, linear camera RGB, r + g + b = 1.
        seed
            Seed of all random numbers; equal seeds must result in equal models.
        """

    def tune(
        self, model: LightModel, features: Features, truths: npt.NDArray[np.float64], worth: float, seed: int = 0
    ) -> LightModel:
        """Return a pretrained model tuned to a few images; by default the model itself.

        Parameters
        ----------
        model
            Model from `fit_features`, fitted to other images.
        features
            (N, ...) of the learner's dtype.
        truths
            (N, 3) float64, linear camera RGB, r + g + b = 1.
        worth
            Number of images to which the pretrained model is equivalent.
        seed
            Seed of all random numbers.
        """
        del features, truths, worth, seed
        return model

    @abstractmethod
    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> LightModel:
        """Return the model with these `LightModel.arrays`; raise ValueError or KeyError if they are not valid."""

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> LearnedMethod:
        """Return the method fitted to scenes; see `methods.method.Learner.fit`."""
        (features,) = extract(scenes, [self])
        return fit_extracted(self, features, truths_of(scenes), seed)


@dataclass(frozen=True, eq=False)
class LearnedMethod:
    """Fitted learner, which is a method.

    - `learner`: extracts the features.
    - `model`: estimates the illuminant from the features.
    - `trained_on`: name of the training data for tables; None except for models from a file.
    """

    learner: FeatureLearner
    model: LightModel
    trained_on: str | None = None

    @property
    def name(self) -> str:
        """Name in tables, with the training data if known."""
        return self.learner.name + (f" (trained on {self.trained_on})" if self.trained_on else "")

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimate (3,) float64, camera RGB of length 1; see `methods.method.Method.estimate`."""
        features = self.learner.features(image, saturation, mask)
        return GREY if features is None else unit(self.model.lights(features[None])[0])


def extract(
    scenes: Sequence[Scene],
    learners: Sequence[FeatureLearner],
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[list[Features | None], ...]:
    """Return for each learner the features of each scene, None without usable pixels; each image is read once."""

    def extract_scene(scene: Scene) -> list[Features | None]:
        image, mask = scene.read()
        return [learner.features(image, scene.saturation, mask) for learner in learners]

    rows = list(report_progress(ordered_map(extract_scene, scenes, workers), on_scene))
    return tuple([row[learner_index] for row in rows] for learner_index in range(len(learners)))


def fit_extracted(
    learner: FeatureLearner, features: Sequence[Features | None], truths: npt.NDArray[np.float64], seed: int = 0
) -> LearnedMethod:
    """Return the method fitted to features and ground truths (N, 3) of N images, except images with features None."""
    usable = [index for index, image_features in enumerate(features) if image_features is not None]
    if not usable:
        raise InputError(
            f"{learner.name}: 0 of {len(features)} images have usable pixels, expected at least one; use images that "
            "are not completely clipped or masked"
        )
    stacked: Any = np.stack([image_features for image_features in features if image_features is not None])
    usable_truths = truths[usable]
    usable_truths /= usable_truths.sum(axis=1, keepdims=True)
    return LearnedMethod(learner, learner.fit_features(stacked, usable_truths, seed))


def require_installed(learner: object) -> None:
    """Raise InputError if a library for training is not installed."""
    reason = missing_requirement(learner)
    if reason:
        raise InputError(reason)


def missing_requirement(learner: object) -> str | None:
    """Return a message with a remedy if a library for training is not installed; else None."""
    if not isinstance(learner, FeatureLearner) or learner.needs is None:
        return None
    module, remedy = learner.needs
    try:
        import_module(module)
    except ImportError:
        return f"training {learner.key} requires {module}, which is not installed: {remedy}"
    return None


def truths_of(scenes: Sequence[Scene]) -> npt.NDArray[np.float64]:
    """Return the ground truths (N, 3) float64, linear camera RGB; raise InputError if a value is 0 or less."""
    if not scenes:
        raise InputError("0 training images, expected at least one; add some")
    truths = np.stack([np.asarray(scene.truth, dtype=np.float64) for scene in scenes])
    is_invalid = ~(np.isfinite(truths) & (truths > 0)).all(axis=1)
    if is_invalid.any():
        index = int(np.argmax(is_invalid))
        raise InputError(
            f"the ground truth of {scenes[index].name} is {' '.join(f'{value:g}' for value in truths[index])}, "
            "expected red, green and blue above 0 for training; correct it"
        )
    return truths
