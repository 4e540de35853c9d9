"""Train on one data set, test on another: a row of results for each method and each way of training it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from evaluation.experiments.cross_validation import (
    AnyLearner,
    Material,
    Places,
    cross_fit,
    estimate_on,
    fit_on,
    gather,
    result_of,
)
from evaluation.experiments.folds import require_apart
from evaluation.experiments.running import evaluate
from evaluation.learning.constant_light import ConstantLight
from evaluation.methods.method import Method
from evaluation.results.result import Result
from evaluation.scene import Scene
from foundation.errors import InputError

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
            *(learner.name, "cross-validation", generated, _least(folds)),
            tuple(cross_fit(learner, number, trials, each, seed) for seed, each in enumerate(folds)),
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


def _tested(learner: AnyLearner, number: int, lessons: Material, places: Places, trials: Material, seed: int) -> Result:
    method = fit_on(learner, number, lessons, places.astype(np.int64), seed)
    return result_of(learner.name, estimate_on(method, number, trials, trials.everything), trials.truths)
