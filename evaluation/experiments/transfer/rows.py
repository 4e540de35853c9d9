"""Train on one data set, test on another: a row of results for each method and each way of training it.

Images made small for learning: training and test images of one size, noise and fine detail averaged alike.

A data set as learners take it: features extracted once, then any part of it to train on or to test.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from evaluation.experiments.folds import require_apart
from evaluation.experiments.running import answer_scenes, evaluate, fit_anew
from evaluation.learning.constant_light import ConstantLight
from evaluation.learning.feature_learner import (
    FeatureLearner,
    Features,
    LearnedMethod,
    extract,
    fit_extracted,
    truths_of,
)
from evaluation.methods.filters.shrinking import shrink
from evaluation.methods.method import Learner, Method
from evaluation.results.result import NO_PIXEL, Result, SceneAnswer, read_light, results_of
from evaluation.scene import Image, Scene
from foundation.errors import InputError
from foundation.processors import ordered_map

_COVERED: Final = 1e-3
"""Share of a pixel's area of which more must be usable; less is rounding of areas rather than a colour."""


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

    made: list[SmallScene] = []
    for scene in ordered_map(small, scenes, workers):
        made.append(scene)
        if on_scene:
            on_scene()
    return tuple(made)


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


Kind = Literal["cross-validation", "generated", "naive", "naive with matrix", "other", "none"]
"""How a method was trained: on other folds of the test set, on generated images, on their naive counterparts, on a data
set that was not generated, or not at all."""

NAIVE: Final[tuple[Kind, ...]] = ("naive", "naive with matrix")
"""The kinds of the naive baseline."""


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Images to train on.

    - `data`: name of the data set that they are, or are the counterparts of.
    - `kind`: what they are.
    - `scenes`: the images; counterparts in the order of the generated ones.
    """

    data: str
    kind: Kind
    scenes: tuple[Scene, ...]


@dataclass(frozen=True, eq=False)
class TransferRow:
    """Results of one method, trained in one way, on the test images.

    - `method`: the method's name.
    - `kind`: how it was trained.
    - `data`: name of the data set that it was trained on; of cross-validation only where the test set was generated.
    - `images`: training images: of cross-validation those of the smallest training part; 0 where nothing is learned.
    - `results`: one a seed, or one where nothing depends on it; rows in the order of the test images.
    """

    method: str
    kind: Kind
    data: str
    images: int
    results: tuple[Result, ...]

    @property
    def training(self) -> str:
        """How the method was trained, for a column of tables."""
        match self.kind:
            case "cross-validation":
                return f"cross-validated on {self.data} (generated)" if self.data else "real, cross-validated"
            case "generated":
                return f"{self.data}: generated"
            case "naive":
                return f"{self.data}: linear sRGB × light"
            case "naive with matrix":
                return f"{self.data}: matrix × linear sRGB × light"
            case "other":
                return f"{self.data}: as it is"
            case "none":
                return "none"

    def labels(self, seeds: int) -> tuple[str, ...]:
        """Return the names of its results in errors.csv: method, training and, of several seeds, the seed.

        Examples
        --------
        >>> TransferRow("Trees", "naive", "made", 9, ()).labels(2)
        ('Trees, made: linear sRGB × light, seed 0', 'Trees, made: linear sRGB × light, seed 1')
        """
        name = self.method if self.kind == "none" else f"{self.method}, {self.training}"
        return (name,) if seeds == 1 else tuple(f"{name}, seed {seed}" for seed in range(seeds))


def draw_images(count: int, wanted: int, seed: int) -> Places:
    """Return which of `count` images to train on, (P,) int64 in ascending order, P = `wanted`, drawn by a seed.

    Data sets of equal counts get the same places, so that a generated set and its naive counterpart, or one under
    another table, are trained on the same pictures under the same lights.

    Examples
    --------
    >>> draw_images(5, 5, seed=3).tolist()
    [0, 1, 2, 3, 4]
    """
    if not 1 <= wanted <= count:
        raise InputError(f"{wanted} training images of {count} were asked for; expected 1 to {count}: --images")
    return np.sort(np.random.default_rng(seed).permutation(count)[:wanted])


def count_images(test: Sequence[Scene], training: Sequence[TrainingSet], seeds: int, images: int) -> int:
    """Return how many images `transfer` reads for its learners, all seeds together: each image once."""
    return len(test) + sum(len(_used(_drawn(some, seeds, images))) for some in training)


def transfer(
    test: Sequence[Scene],
    training: Sequence[TrainingSet],
    learners: Sequence[AnyLearner],
    folds: Sequence[npt.NDArray[np.int64]],
    images: int,
    methods: Sequence[Method] = (),
    side: int | None = None,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
    generated: str = "",
) -> tuple[TransferRow, ...]:
    """Return the rows of every learner: cross-validated on the test set, and trained on each training set.

    Of the learner `ConstantLight` no row is made for naive counterparts, whose lights are those of the generated set.

    `folds`: one entry for each seed, (N,) int64: the folds of the test images. Seed k is k, from 0: it is handed to
    every fit and draws the training images. `side`: longest side that images are made small to first, px; None leaves
    all as they are. `generated`: name of the test set if it was generated, so that no row calls it real; else empty.
    """
    if not learners or not folds:
        raise InputError(f"{len(learners)} learned methods and {len(folds)} seeds: expected at least one of each")
    for each in folds:
        require_apart(test, each)
    # All that may be refused is, before the first image is read.
    drawn = [_drawn(some, len(folds), images) for some in training]
    trials = gather(test, learners, side, workers, on_scene)
    parts = [
        TransferRow(
            *(learner.name, "cross-validation", generated, _least(folds)), _crossed(learner, number, trials, folds)
        )
        for number, learner in enumerate(learners)
    ]
    for some, wanted in zip(training, drawn, strict=True):
        # Of a large set only what some seed wants is read.
        used = _used(wanted)
        lessons = gather([some.scenes[int(place)] for place in used.tolist()], learners, side, workers, on_scene)
        for number, learner in enumerate(learners):
            if isinstance(learner, ConstantLight) and some.kind in NAIVE:
                continue
            results = tuple(
                _tested(learner, number, lessons, np.searchsorted(used, places), trials, seed)
                for seed, places in enumerate(wanted)
            )
            parts.append(TransferRow(learner.name, some.kind, some.data, images, results))
    rows = [part for learner in learners for part in parts if part.method == learner.name]
    if methods:
        found = evaluate(trials.scenes, methods, workers)
        rows += [TransferRow(result.method, "none", "", 0, (result,)) for result in found]
    return tuple(rows)


def _drawn(some: TrainingSet, seeds: int, images: int) -> list[Places]:
    return [draw_images(len(some.scenes), images, seed) for seed in range(seeds)]


def _used(drawn: Sequence[Places]) -> Places:
    return np.unique(np.concatenate(drawn))


def _least(folds: Sequence[npt.NDArray[np.int64]]) -> int:
    """Return the images of the smallest part that is trained on."""
    return min(len(each) - int(np.bincount(each).max()) for each in folds)


def _crossed(
    learner: AnyLearner, number: int, trials: Material, folds: Sequence[npt.NDArray[np.int64]]
) -> tuple[Result, ...]:
    results: list[Result] = []
    for seed, each in enumerate(folds):
        answers: dict[int, SceneAnswer] = {}
        for fold in np.unique(each):
            inside = np.flatnonzero(each == fold)
            method = fit_on(learner, number, trials, np.flatnonzero(each != fold), seed)
            answers |= zip(inside.tolist(), estimate_on(method, number, trials, inside), strict=True)
        results.append(result_of(learner.name, [answers[place] for place in range(len(each))], trials.truths))
    return tuple(results)


def _tested(learner: AnyLearner, number: int, lessons: Material, places: Places, trials: Material, seed: int) -> Result:
    method = fit_on(learner, number, lessons, places.astype(np.int64), seed)
    return result_of(learner.name, estimate_on(method, number, trials, trials.everything), trials.truths)
