"""Learned methods on parts of data sets, and parameters of methods tuned without ground truth.

Cross-validation estimates every image by a model that has not seen it. Images may be made small first, so that
training and test images are of one size, noise and fine detail averaged alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
import numpy.typing as npt

from evaluation.experiments.folds import require_apart
from evaluation.experiments.running import answer_scenes, fit_anew, require_truths
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
from evaluation.results.result import NO_PIXEL, Result, SceneAnswer, read_light, results_of
from evaluation.results.tables import PAPER_COLUMNS, Cell, Table
from evaluation.scene import Image, Scene, told_of
from foundation.compiled import ordered_map
from foundation.errors import InputError

# Share of a pixel's area of which more must be usable; less is rounding of areas rather than a colour.
_COVERED: Final = 1e-3


@dataclass(frozen=True, eq=False)
class SmallScene:
    """A scene made small, in memory.

    - `name`: the image's name.
    - `truth`: (3,) float64, linear camera RGB of the light, of any length.
    - `image`: (H, W, 3) float32, linear camera RGB, in the unit of the image that it was.
    - `mask`: (H, W) bool, True where no pixel was usable; None if every one was.
    - `saturation`: none where clipped pixels were left out; that of the image where it was small already.
    """

    name: str
    truth: npt.NDArray[np.float64]
    image: Image
    mask: npt.NDArray[np.bool_] | None
    saturation: float | None

    def read(self) -> tuple[Image, npt.NDArray[np.bool_] | None]:
        """Return the image (H, W, 3) and its mask (H, W) bool."""
        return self.image, self.mask


def make_small(
    scenes: Sequence[Scene], side: int, workers: int = 1, on_scene: Callable[[], None] | None = None
) -> tuple[SmallScene, ...]:
    """Return scenes of which no side is longer than `side`, px; see `shrink_image`.

    `side`: longest side allowed, px.
    """

    def small(scene: Scene) -> SmallScene:
        image, mask = scene.read()
        if max(image.shape[:2]) <= side:
            return SmallScene(scene.name, scene.truth, image, mask, scene.saturation)
        return SmallScene(scene.name, scene.truth, *shrink_image(image, side, scene.saturation, mask), None)

    return tuple(told_of(ordered_map(small, scenes, workers), on_scene))


def shrink_image(
    image: Image, side: int, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image made small by averaging areas, without clipped and masked pixels.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB. `side`: longest side of the result, px.
    `saturation`: value from which a channel is clipped; None if none is. `mask`: (H, W) bool, True where a pixel must
    not be used, or None. Returns the image (h, w, 3) float32, and (h, w) bool, True where no pixel was usable; the
    image is 0 there.

    Examples
    --------
    >>> image = np.zeros((2, 4, 3), np.float32)
    >>> image[:, 0], image[:, 1], image[0, 2] = 10, 30, 900
    >>> small, mask = shrink_image(image, side=2, saturation=900)
    >>> small[..., 0], mask
    (array([[20.,  0.]], dtype=float32), array([[False, False]]))
    """
    usable = np.ones(image.shape[:2], dtype=bool)
    if saturation is not None:
        usable &= (image < saturation).all(axis=2)
    if mask is not None:
        usable &= ~mask
    small, empty = shrink(image, usable, side, _COVERED)
    small[empty] = 0
    return small, empty


Places = npt.NDArray[np.int64]  # (P,) int64: which scenes of a data set, from 0

AnyLearner = Learner | FeatureLearner  # A learner of either kind: of scenes, or of features


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
    features, chosen = material.features[number], [int(place) for place in places.tolist()]
    if isinstance(learner, FeatureLearner) and features is not None:
        return fit_extracted(learner, [features[place] for place in chosen], material.truths[places], seed)
    return fit_anew(learner, [material.scenes[place] for place in chosen], seed)


def estimate_on(method: Method, number: int, material: Material, places: Places) -> list[SceneAnswer]:
    """Return what a fitted method answers for the scenes at `places` (P,) int64, P answers."""
    features, chosen = material.features[number], [int(place) for place in places.tolist()]
    if not isinstance(method, LearnedMethod) or features is None:
        return [answer for (answer,) in answer_scenes([material.scenes[place] for place in chosen], [method])]
    usable = [given for given in (features[place] for place in chosen) if given is not None]
    lights = iter(method.model.lights(np.stack(usable)) if usable else ())
    return [
        SceneAnswer(None, NO_PIXEL) if features[place] is None else read_light(unit(next(lights))) for place in chosen
    ]


def result_of(name: str, answers: Sequence[SceneAnswer], truths: npt.NDArray[np.float64]) -> Result:
    """Return the result that N answers make, held to truths (N, 3) float64."""
    (result,) = results_of([name], truths, [[answer] for answer in answers])
    return result


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
    truths_of(scenes)
    kinds = len(np.unique(folds))
    if not learners or kinds < 2:
        raise InputError(f"{len(learners)} methods in {kinds} folds: expected at least one method and two folds")
    for learner in learners:
        require_installed(learner)
    require_apart(scenes, folds)
    material = gather(scenes, learners, workers=workers, on_scene=on_scene)
    return tuple(cross_fit(learner, number, material, folds, seed) for number, learner in enumerate(learners))


def cross_fit(learner: AnyLearner, number: int, material: Material, folds: npt.NDArray[np.int64], seed: int) -> Result:
    """Return what a learner makes of scenes, each estimated after a fit to those of the other folds, (N,) int64."""
    answers: dict[int, SceneAnswer] = {}
    for fold in np.unique(folds):
        held = np.flatnonzero(folds == fold)
        method = fit_on(learner, number, material, np.flatnonzero(folds != fold), seed)
        answers |= zip(held.tolist(), estimate_on(method, number, material, held), strict=True)
    return result_of(learner.name, [answers[place] for place in range(len(folds))], material.truths)


@dataclass(frozen=True)
class FamilySetting:
    """One set of parameters of a family, and how it did.

    - `text`: what `--method` takes for it: "gray-edge-1:p=4:sigma=2".
    - `name`: the method's name in tables.
    - `spread`: standard deviation of the green chromaticity g / (r + g + b) of its estimates.
    - `errors`: its errors on the images that count, degrees; None where nobody asked.
    """

    text: str
    name: str
    spread: float
    errors: Summary | None


@dataclass(frozen=True)
class Tuning:
    """What tuning a family on a data set found.

    - `family`: what was asked for: "gray-edge-1", or "gray-edge-1@360".
    - `data`: the data set's name.
    - `settings`: all sets of parameters, the chosen one first, by rising spread.
    - `images`, `counted`: number of images, and of those for which every setting gives a light: the others do not
      count.
    - `kind`: which errors stand beside; None if none do.
    """

    family: str
    data: str
    settings: tuple[FamilySetting, ...]
    images: int
    counted: int
    kind: ErrorKind | None


def settings_of(family: str) -> tuple[tuple[str, Method], ...]:
    """Return what `--method` takes for each set of parameters of a family, and its method.

    Examples
    --------
    >>> [(text, method.name) for text, method in settings_of("shades-of-gray@90")][1]
    ('shades-of-gray:p=2@90', 'Shades-of-Gray (p=2) at 90 px')
    """
    name, at, around = family.strip().partition("@")
    texts = (f"{text}{at}{around}" for text in family_names(name))
    return tuple((text, cast("Method", find_method(text))) for text in texts)


def tune_family(
    family: str,
    data: str,
    scenes: Sequence[Scene],
    kind: ErrorKind | None = None,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Tuning:
    """Return the sets of parameters of a family by how much their estimates spread in green chromaticity.

    `kind`: which errors to state beside; None reads no ground truth.
    """
    texts, methods = zip(*settings_of(family), strict=True)
    tuned = tune(methods, scenes, on_scene, workers)
    errors: list[Summary | None] = [None] * len(methods)
    if kind is not None:
        truths = require_truths(scenes, methods)[tuned.counted]
        measure = recovery_error if kind == "recovery" else reproduction_error
        errors = [summarise(measure(tuned.lights[:, place], truths)) for place in range(len(methods))]
    settings = [
        FamilySetting(text, method.name, spread, error)
        for text, method, spread, error in zip(texts, methods, tuned.spreads, errors, strict=True)
    ]
    ordered = tuple(sorted(settings, key=lambda setting: setting.spread))
    return Tuning(family, data, ordered, len(scenes), len(tuned.lights), kind)


def tuning_table(tuning: Tuning) -> Table:
    """Return the table of settings for people: spreads in thousandths, errors in degrees."""
    heads = PAPER_COLUMNS[1:] if tuning.kind else ()
    what = f"; {tuning.kind} angular error, degrees" if tuning.kind else ""
    notes: list[str] = []
    if tuning.counted < tuning.images:
        notes.append(
            f"{tuning.images - tuning.counted} of {tuning.images} images give no light with some setting and do not "
            "count for any."
        )
    return Table(
        f"{tuning.data}: {tuning.family} by the spread of green chromaticity on {tuning.counted} images, "
        f"thousandths{what}",
        ("Setting", "Spread", *heads),
        tuple((one.text, 1000 * one.spread, *_errors(one)) for one in tuning.settings),
        digits=2,
        notes=tuple(notes),
    )


def _errors(setting: FamilySetting) -> tuple[Cell, ...]:
    return () if setting.errors is None else setting.errors.as_tuple()
