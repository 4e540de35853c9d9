"""Train on one data set, test on another: a row of results for each method and each way of training it.

Beside N real images a method is trained on them alone, and on a set first and then adapted to them. The N are drawn
from the training part of each fold of real cross-validation, so that every test image is unseen by what estimates it;
those of a smaller N are among those of a larger one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from evaluation.experiments.cross_validation import (
    AnyLearner,
    Indices,
    Material,
    collect_material,
    cross_fit,
    estimate_on,
    fit_on,
    result_of,
)
from evaluation.experiments.folds import require_groups_together
from evaluation.experiments.running import evaluate
from evaluation.learning.adapting import LearnedAlone, adapt, learn_alone
from evaluation.learning.constant_light import ConstantLight
from evaluation.learning.feature_learner import FeatureLearner, LearnedMethod
from evaluation.methods.method import Method
from evaluation.results.result import Result, SceneAnswer
from evaluation.scene import Scene
from foundation.errors import InputError

# How a method was trained: on other folds of the test set, on generated images, on their naive counterparts, on real
# scenes of another camera under their lights, on a data set that was not generated, on N images of the test set's
# other folds alone, or not at all.
Kind = Literal["cross-validation", "generated", "naive", "naive with matrix", "relit", "other", "real", "none"]

# What was done with N real images: nothing; trained on them alone; trained on a set, and then adapted to them.
Way = Literal["", "alone", "adapted"]

NAIVE: Final[tuple[Kind, ...]] = ("naive", "naive with matrix")  # The kinds of the naive baseline


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
    - `way`, `real`: what was done with how many images of the test set's other folds: a number, or "all"; empty where
      there were none. They are not among `images` but where they were alone.
    """

    method: str
    kind: Kind
    data: str
    images: int
    results: tuple[Result, ...]
    way: Way = ""
    real: str = ""

    @property
    def training(self) -> str:
        """How the method was trained, for a column of tables."""
        match self.way:
            case "alone":
                return f"{self.real} of {self.data} (generated)" if self.data else f"{self.real} real"
            case "adapted":
                return f"{self.material}, adapted to {self.real} real"
            case "":
                return self.material

    @property
    def material(self) -> str:
        """What else than N real images the method was trained on."""
        match self.kind:
            case "cross-validation":
                return f"cross-validated on {self.data} (generated)" if self.data else "real, cross-validated"
            case "generated":
                return f"{self.data}: generated"
            case "naive":
                return f"{self.data}: linear sRGB × light"
            case "naive with matrix":
                return f"{self.data}: matrix × linear sRGB × light"
            case "relit":
                return f"{self.data}: real scenes of another camera, relit"
            case "other":
                return f"{self.data}: as it is"
            case "real":
                return "real images"
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


def draw_images(count: int, wanted: int, seed: int) -> Indices:
    """Return which of `count` images to train on, (P,) int64 in ascending order, P = `wanted`, drawn by a seed.

    Data sets of equal counts get the same places, so that a generated set and its naive counterpart, or one under
    another table, are trained on the same pictures under the same lights.

    Examples
    --------
    >>> draw_images(5, 5, seed=3).tolist()
    [0, 1, 2, 3, 4]
    """
    if not 1 <= wanted <= count:
        raise InputError(f"{wanted} training images of {count} were asked for; expected 1 to {count}")
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
    beside: Sequence[int | None] = (),
) -> tuple[TransferRow, ...]:
    """Return the rows of every learner: cross-validated on the test set, trained on each training set, and beside N.

    Of the learner `ConstantLight` no row is made for naive counterparts, whose lights are those of the generated set,
    and none beside N real images: it looks at none.

    `folds`: one entry for each seed, (N,) int64: the folds of the test images. Seed k is k, from 0: it is handed to
    every fit and draws the training images. `side`: longest side that images are made small to first, px; None leaves
    all as they are. `generated`: name of the test set if it was generated, so that no row calls it real; else empty.
    `beside`: numbers of real images to train beside; None for all that a fold leaves.
    """
    if not learners or not folds:
        raise InputError(f"{len(learners)} learned methods and {len(folds)} seeds: expected at least one of each")
    for each in folds:
        require_groups_together(test, each)
    # All that may be refused is, before the first image is read.
    drawn = [_drawn(some, len(folds), images) for some in training]
    trials = collect_material(test, learners, side, workers, on_scene)
    bench = _Bench(trials, folds)
    parts: list[TransferRow] = []
    for number, learner in enumerate(learners):
        real = tuple(cross_fit(learner, number, trials, each, seed) for seed, each in enumerate(folds))
        parts.append(TransferRow(learner.name, "cross-validation", generated, bench.least, real))
        for count in () if isinstance(learner, ConstantLight) else beside:
            # All that a fold leaves is what cross-validation trains on.
            results = real if count is None else bench.results(number, learner, count, bench.alone)
            name = _name_of(count)
            parts.append(TransferRow(learner.name, "real", generated, count or bench.least, results, "alone", name))
    for some, wanted in zip(training, drawn, strict=True):
        # Of a large set only what some seed wants is read.
        used = _used(wanted)
        lessons = collect_material(
            [some.scenes[int(place)] for place in used.tolist()], learners, side, workers, on_scene
        )
        places = [np.searchsorted(used, each).astype(np.int64) for each in wanted]
        for number, learner in enumerate(learners):
            if isinstance(learner, ConstantLight) and some.kind in NAIVE:
                continue
            taught = [fit_on(learner, number, lessons, each, seed) for seed, each in enumerate(places)]
            results = tuple(
                result_of(learner.name, estimate_on(method, number, trials, trials.all_indices), trials.truths)
                for method in taught
            )
            row = TransferRow(learner.name, some.kind, some.data, images, results)
            parts.append(row)
            if not isinstance(learner, FeatureLearner) or isinstance(learner, ConstantLight):
                continue
            for count in beside:
                results = bench.results(number, learner, count, partial(bench.adapted, taught))
                parts.append(replace(row, results=results, way="adapted", real=_name_of(count)))
    rows = [part for learner in learners for part in parts if part.method == learner.name]
    if methods:
        found = evaluate(trials.scenes, methods, workers)
        rows += [TransferRow(result.method, "none", "", 0, (result,)) for result in found]
    return tuple(rows)


# From learner, its number, places of N real images (N,) int64 and seed to a method.
_Fit = Callable[[AnyLearner, int, Indices, int], Method]


@dataclass(frozen=True, eq=False)
class _Bench:
    """The test images, and how N of them are drawn that others are tested by.

    - `trials`: their material.
    - `folds`: for each seed the fold of each, (N,) int64.
    - `known`: what N teach alone, by learner, seed and images: the same for every set.
    """

    trials: Material
    folds: Sequence[npt.NDArray[np.int64]]
    known: dict[tuple[int, int, bytes], LearnedAlone] = field(default_factory=dict)

    @property
    def least(self) -> int:
        """The images of the smallest part that is trained on."""
        return min(len(each) - int(np.bincount(each).max()) for each in self.folds)

    def results(self, number: int, learner: AnyLearner, real: int | None, fit: _Fit) -> tuple[Result, ...]:
        """Return for each seed the result of a learner, each fold estimated by `real` images of the others."""
        made: list[Result] = []
        for seed, folds in enumerate(self.folds):
            order = np.random.default_rng(seed).permutation(len(folds))
            answers: dict[int, SceneAnswer] = {}
            for fold in np.unique(folds):
                held = np.flatnonzero(folds == fold)
                drawn = np.sort(order[folds[order] != fold][:real])
                method = fit(learner, number, drawn, seed)
                answers |= zip(held.tolist(), estimate_on(method, number, self.trials, held), strict=True)
            listed = [answers[place] for place in range(len(folds))]
            made.append(result_of(learner.name, listed, self.trials.truths))
        return tuple(made)

    def alone(self, learner: AnyLearner, number: int, drawn: Indices, seed: int) -> Method:
        """Return what a learner learns of real images alone, at `drawn` (N,) int64."""
        if isinstance(learner, FeatureLearner):
            return self._learned(learner, number, drawn, seed).method
        return fit_on(learner, number, self.trials, drawn, seed)

    def adapted(
        self, taught: Sequence[Method], learner: AnyLearner, number: int, drawn: Indices, seed: int
    ) -> LearnedMethod:
        """Return what was learned elsewhere, for each seed, adapted to real images at `drawn` (N,) int64."""
        method = taught[seed]
        if not isinstance(learner, FeatureLearner) or not isinstance(method, LearnedMethod):
            raise TypeError(f"{learner.name} has no features to adapt by")
        return adapt(method, self._learned(learner, number, drawn, seed))

    def _learned(self, learner: FeatureLearner, number: int, drawn: Indices, seed: int) -> LearnedAlone:
        key = number, seed, drawn.tobytes()
        if key not in self.known:
            features = self.trials.features[number]
            given = [] if features is None else [features[int(place)] for place in drawn]
            self.known[key] = learn_alone(learner, given, self.trials.truths[drawn], seed)
        return self.known[key]


def _name_of(count: int | None) -> str:
    return "all" if count is None else str(count)


def _drawn(some: TrainingSet, seeds: int, images: int) -> list[Indices]:
    return [draw_images(len(some.scenes), images, seed) for seed in range(seeds)]


def _used(drawn: Sequence[Indices]) -> Indices:
    return np.unique(np.concatenate(drawn))
