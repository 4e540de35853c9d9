"""Cross-validation of learned methods, and tuning of statistics-based methods without ground truth.

In cross-validation, the model that estimates an image was not trained on this image. Images may be reduced first, so
that training and test images have the same size, noise and detail.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import numpy.typing as npt

from evaluation.experiments.folds import require_groups_together
from evaluation.experiments.running import answer_scenes, fit_copy, require_truths
from evaluation.learning.feature_learner import (
    FeatureLearner,
    Features,
    LearnedMethod,
    extract,
    fit_extracted,
    require_installed,
    truths_of,
)
from evaluation.methods.green_stability import family_names, tune
from evaluation.methods.method import Learner, Method
from evaluation.methods.naming import find_method
from evaluation.methods.prepared import shrink, unit
from evaluation.metrics import ErrorKind, Summary, recovery_error, reproduction_error, summarise
from evaluation.results.result import NO_PIXEL, Result, SceneAnswer, collect_results, read_estimate
from evaluation.results.tables import ERROR_COLUMNS, Cell, Table
from evaluation.scene import Image, Scene, report_progress
from foundation.compiled import ordered_map
from foundation.errors import InputError

# Smallest usable fraction of the area of a reduced pixel. With less area, rounding errors dominate its colour.
_MIN_USABLE_AREA: Final = 1e-3


@dataclass(frozen=True, eq=False)
class SmallScene:
    """A scene in memory, reduced in size if it was larger than requested."""

    name: str
    truth: npt.NDArray[np.float64]  # (3,) float64, ground truth, linear camera RGB of any scale
    image: Image  # (H, W, 3), linear camera RGB, in the unit of the original image; float32 if reduced
    mask: npt.NDArray[np.bool_] | None  # (H, W) bool, True for pixels that must not be used; None if all may be used
    saturation: float | None  # level of the original image; None if reduced, because averages exclude clipped pixels

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3) and its mask (H, W) bool."""
        return self.image, self.mask


def shrink_scenes(
    scenes: Sequence[Scene], side: int, workers: int = 1, on_scene: Callable[[], None] | None = None
) -> tuple[SmallScene, ...]:
    """Return the scenes with a longest side of at most `side` px; see `shrink_image`."""

    def shrink_scene(scene: Scene) -> SmallScene:
        image, mask = scene.read()
        if max(image.shape[:2]) <= side:
            return SmallScene(scene.name, scene.truth, image, mask, scene.saturation)
        return SmallScene(scene.name, scene.truth, *shrink_image(image, side, scene.saturation, mask), None)

    return tuple(report_progress(ordered_map(shrink_scene, scenes, workers), on_scene))


def shrink_image(
    image: Image, side: int, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return a reduced image: averages of areas, without clipped and masked pixels.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB. `side`: longest side of the result, px.
    `saturation`: value from which a channel is clipped; None for no clipping. `mask`: (H, W) bool, True for pixels that
    must not be used. Returns the image (h, w, 3) float32 and its mask (h, w) bool. If too few pixels of an
    area are usable, the mask is True and the image is 0.

    Examples
    --------
    >>> image = np.zeros((2, 4, 3), np.float32)
    >>> image[:, 0], image[:, 1], image[0, 2] = 10, 30, 900
    >>> shrunk, mask = shrink_image(image, side=2, saturation=900)
    >>> shrunk[..., 0], mask
    (array([[20.,  0.]], dtype=float32), array([[False, False]]))
    """
    is_usable = np.ones(image.shape[:2], dtype=bool)
    if saturation is not None:
        is_usable &= (image < saturation).all(axis=2)
    if mask is not None:
        is_usable &= ~mask
    shrunk, is_empty = shrink(image, is_usable, side, _MIN_USABLE_AREA)
    shrunk[is_empty] = 0
    return shrunk, is_empty


Indices = npt.NDArray[np.int64]  # (P,) int64: indices of scenes in a data set, from 0

AnyLearner = Learner | FeatureLearner  # A learner is fitted to scenes, a feature learner to their features


@dataclass(frozen=True, eq=False)
class Material:
    """Scenes, with their features for the learners that use features."""

    scenes: tuple[Scene, ...]
    truths: npt.NDArray[np.float64]  # (N, 3) float64, linear camera RGB of any scale
    # One entry for each learner: the features of each scene, or None if the learner reads images itself. A scene
    # without usable pixel has the features None.
    features: tuple[Sequence[Features | None] | None, ...]

    @property
    def all_indices(self) -> Indices:
        """Indices of all scenes, (N,) int64."""
        return np.arange(len(self.scenes))


def collect_material(
    scenes: Sequence[Scene],
    learners: Sequence[AnyLearner],
    side: int | None = None,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Material:
    """Return the material for learners; each image is read once for all learners that extract features.

    `side`: longest side to which images are reduced first, px; None keeps their size.
    """
    truths = truths_of(scenes)
    if side is not None:
        scenes, on_scene = shrink_scenes(scenes, side, workers, on_scene), None
    feature_learners = [learner for learner in learners if isinstance(learner, FeatureLearner)]
    extracted = iter(extract(scenes, feature_learners, workers, on_scene) if feature_learners else ())
    features = tuple(next(extracted) if isinstance(learner, FeatureLearner) else None for learner in learners)
    if on_scene and not feature_learners:
        for _ in scenes:
            on_scene()
    return Material(tuple(scenes), truths, features)


def fit_on(learner: AnyLearner, number: int, material: Material, indices: Indices, seed: int) -> Method:
    """Return the method fitted to the scenes with these indices (P,) int64; `number` is the index of the learner."""
    features, scene_indices = material.features[number], [int(index) for index in indices.tolist()]
    if isinstance(learner, FeatureLearner) and features is not None:
        return fit_extracted(learner, [features[index] for index in scene_indices], material.truths[indices], seed)
    return fit_copy(learner, [material.scenes[index] for index in scene_indices], seed)


def estimate_on(method: Method, number: int, material: Material, indices: Indices) -> list[SceneAnswer]:
    """Return the P answers of a fitted method for the scenes with these indices (P,) int64."""
    features, scene_indices = material.features[number], [int(index) for index in indices.tolist()]
    if not isinstance(method, LearnedMethod) or features is None:
        return [answer for (answer,) in answer_scenes([material.scenes[index] for index in scene_indices], [method])]
    usable = [item for item in (features[index] for index in scene_indices) if item is not None]
    lights = iter(method.model.lights(np.stack(usable)) if usable else ())
    return [
        read_estimate(unit(next(lights))) if features[index] is not None else SceneAnswer(None, NO_PIXEL)
        for index in scene_indices
    ]


def result_of(name: str, answers: Sequence[SceneAnswer], truths: npt.NDArray[np.float64]) -> Result:
    """Return the result of the method `name` from its N answers; `truths`: (N, 3) float64."""
    (result,) = collect_results([name], truths, [[answer] for answer in answers])
    return result


def cross_validate(
    scenes: Sequence[Scene],
    learners: Sequence[Learner],
    folds: npt.NDArray[np.int64],
    seed: int = 0,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[Result, ...]:
    """Return estimates and errors of learned methods; each image is estimated by a model trained on the other folds.

    Images are read once for all learners that extract features. Learners that only have `fit(scenes, seed)` read them
    again in each fold. `folds`: (N,) int64, fold of each image, at least two different folds.
    """
    truths_of(scenes)
    fold_count = len(np.unique(folds))
    if not learners or fold_count < 2:
        raise InputError(
            f"{len(learners)} methods in {fold_count} folds, expected at least 1 method and 2 folds; add some"
        )
    for learner in learners:
        require_installed(learner)
    require_groups_together(scenes, folds)
    material = collect_material(scenes, learners, workers=workers, on_scene=on_scene)
    return tuple(cross_fit(learner, index, material, folds, seed) for index, learner in enumerate(learners))


def cross_fit(learner: AnyLearner, number: int, material: Material, folds: npt.NDArray[np.int64], seed: int) -> Result:
    """Return the result of one learner, with a new model for each fold; `folds`: (N,) int64, fold of each scene."""
    answers: dict[int, SceneAnswer] = {}
    for fold in np.unique(folds):
        test_indices = np.flatnonzero(folds == fold)
        method = fit_on(learner, number, material, np.flatnonzero(folds != fold), seed)
        answers |= zip(test_indices.tolist(), estimate_on(method, number, material, test_indices), strict=True)
    return result_of(learner.name, [answers[index] for index in range(len(folds))], material.truths)


@dataclass(frozen=True)
class FamilySetting:
    """One set of parameters of a family of methods, with its results."""

    text: str  # Value of `--method` for this set: "gray-edge-1:p=4:sigma=2"
    name: str  # Name of the method in tables
    spread: float  # Standard deviation of the green chromaticity g / (r + g + b) of its estimates
    errors: Summary | None  # Its errors on the images of `Tuning.counted`, degrees; None if not requested


@dataclass(frozen=True)
class Tuning:
    """Result of tuning a family on a data set.

    - `family`: name of the family: "gray-edge-1", or "gray-edge-1@360".
    - `data`: name of the data set.
    - `settings`: all sets of parameters in ascending order of spread; the first is selected.
    - `images`: number of images.
    - `counted`: number of images for which every setting gives an estimate.
    - `metric`: kind of errors shown for comparison; None for no errors.
    """

    family: str
    data: str
    settings: tuple[FamilySetting, ...]
    images: int
    counted: int
    metric: ErrorKind | None


def family_settings(family: str) -> tuple[tuple[str, Method], ...]:
    """Return for each set of parameters of a family the value of `--method`, and the method.

    Examples
    --------
    >>> [(text, method.name) for text, method in family_settings("shades-of-gray@90")][1]
    ('shades-of-gray:p=2@90', 'Shades-of-Gray (p=2) at 90 px')
    """
    name, separator, pixels = family.strip().partition("@")
    texts = (f"{text}{separator}{pixels}" for text in family_names(name))
    return tuple((text, cast("Method", find_method(text))) for text in texts)


def tune_family(
    family: str,
    data: str,
    scenes: Sequence[Scene],
    metric: ErrorKind | None = None,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Tuning:
    """Return the sets of parameters of a family, sorted by the spread of their estimates in green chromaticity.

    `metric`: kind of errors to add for comparison; if None, ground truths are not read.
    """
    texts, methods = zip(*family_settings(family), strict=True)
    tuned = tune(methods, scenes, on_scene, workers)
    errors: list[Summary | None] = [None] * len(methods)
    if metric is not None:
        truths = require_truths(scenes, methods)[tuned.has_estimates]
        measure = recovery_error if metric == "recovery" else reproduction_error
        errors = [summarise(measure(tuned.lights[:, index], truths)) for index in range(len(methods))]
    settings = [
        FamilySetting(text, method.name, spread, error)
        for text, method, spread, error in zip(texts, methods, tuned.spreads, errors, strict=True)
    ]
    ordered = tuple(sorted(settings, key=lambda setting: setting.spread))
    return Tuning(family, data, ordered, len(scenes), len(tuned.lights), metric)


def tuning_table(tuning: Tuning) -> Table:
    """Return the table of settings: spreads × 1000, errors in degrees."""
    error_columns = ERROR_COLUMNS[1:] if tuning.metric else ()
    errors_text = f"; {tuning.metric} angular error, degrees" if tuning.metric else ""
    notes: list[str] = []
    if tuning.counted < tuning.images:
        notes.append(
            f"{tuning.images - tuning.counted} of {tuning.images} images are excluded for all settings, because at "
            "least one setting gives no estimate for them."
        )
    return Table(
        f"{tuning.data}: {tuning.family} by the spread of green chromaticity on {tuning.counted} images, "
        f"× 1000{errors_text}",
        ("Setting", "Spread", *error_columns),
        tuple((setting.text, 1000 * setting.spread, *_errors(setting)) for setting in tuning.settings),
        digits=2,
        notes=tuple(notes),
    )


def _errors(setting: FamilySetting) -> tuple[Cell, ...]:
    return () if setting.errors is None else setting.errors.as_tuple()
