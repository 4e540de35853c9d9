"""Train on one data set, test on another: one row of results for each method and each kind of training.

A method can also use N real images. It is trained on these images alone, or on another training set and then adapted
to these images. For each fold of the test set, the N images are drawn from the other folds, so no model is tested on
its training images. The images of a smaller N are a subset of the images of a larger N.
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
from evaluation.learning.adapting import LocalFit, adapt, fit_local
from evaluation.learning.constant_light import ConstantLight
from evaluation.learning.feature_learner import FeatureLearner, LearnedMethod
from evaluation.methods.method import Method
from evaluation.results.result import Result, SceneAnswer
from evaluation.scene import Scene
from foundation.errors import InputError

# Training data of a method:
# - cross-validation: other folds of the test set;
# - generated: a set made by `generate`;
# - naive, naive with matrix: pictures of the generated set times its illuminants, without print and camera (plan.py);
# - relit: real scenes of another camera under the illuminants of the generated set;
# - other: a set that was not generated;
# - real: only N images of other folds of the test set;
# - none: no training.
Training = Literal["cross-validation", "generated", "naive", "naive with matrix", "relit", "other", "real", "none"]

# Use of N real images: no use; training on them alone; adaptation to them after training on another set.
RealUse = Literal["", "alone", "adapted"]

NAIVE: Final[tuple[Training, ...]] = ("naive", "naive with matrix")  # Both naive baselines


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Images for training."""

    data: str  # Name of the data set; for naive and relit images, name of the generated set
    kind: Training
    scenes: tuple[Scene, ...]  # Naive and relit images are in the order of the generated images


@dataclass(frozen=True, eq=False)
class TransferRow:
    """Results of one method with one kind of training, on the test images."""

    method: str
    kind: Training  # Its training data
    data: str  # Name of the training data set; empty for images of a real test set, and without training
    images: int  # Number of training images, 0 without training; for cross-validation, the minimum over folds and seeds
    # One result for each seed, or only one if the seed has no influence
    results: tuple[Result, ...]
    # Use and number ("all" or digits) of real images of the other folds; both are empty if no real images were used.
    # `images` includes real images only if they were used alone.
    real_use: RealUse = ""
    real: str = ""

    @property
    def training(self) -> str:
        """Training of the method, for a column of tables."""
        match self.real_use:
            case "alone":
                return f"{self.real} of {self.data} (generated)" if self.data else f"{self.real} real"
            case "adapted":
                return f"{self.material}, adapted to {self.real} real"
            case "":
                return self.material

    @property
    def material(self) -> str:
        """Training data other than N real images."""
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
        """Return the names of the results in errors.csv: method, training and, with several seeds, the seed.

        Examples
        --------
        >>> TransferRow("Trees", "naive", "made", 9, ()).labels(2)
        ('Trees, made: linear sRGB × light, seed 0', 'Trees, made: linear sRGB × light, seed 1')
        """
        name = self.method if self.kind == "none" else f"{self.method}, {self.training}"
        return (name,) if seeds == 1 else tuple(f"{name}, seed {seed}" for seed in range(seeds))


def draw_images(count: int, drawn_count: int, seed: int) -> Indices:
    """Return the indices of the training images, (P,) int64, ascending, drawn from `count` images by a seed.

    Data sets of equal size get the same indices. A method is then trained on the same pictures and illuminants from a
    generated set, its naive counterpart, or a set made with another look-up table (LUT).

    Examples
    --------
    >>> draw_images(5, 5, seed=3).tolist()
    [0, 1, 2, 3, 4]
    """
    if not 1 <= drawn_count <= count:
        raise InputError(f"{drawn_count} training images requested, expected 1 to {count}; request fewer or add images")
    return np.sort(np.random.default_rng(seed).permutation(count)[:drawn_count])


def count_images(test: Sequence[Scene], training: Sequence[TrainingSet], seeds: int, images: int) -> int:
    """Return the number of images that `transfer` reads for its learners; each image is counted once for all seeds."""
    return len(test) + sum(len(_used_indices(_drawn_indices(train_set, seeds, images))) for train_set in training)


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
    generated_name: str = "",
    real_counts: Sequence[int | None] = (),
) -> tuple[TransferRow, ...]:
    """Return the rows of every learner: cross-validated on the test set, trained on each set, and with real images.

    `folds`: for each seed the folds of the test images, (N,) int64. Seeds are 0, 1, …; a seed is passed to every fit
    and draws the training images. `images`: number of training images of each set. `side`: longest side to which images
    are reduced first, px; None keeps their size. `generated_name`: name of the test set if it was generated, so that
    rows do not call it real; else empty. `real_counts`: numbers N of real images; None for all images of the other
    folds.
    """
    if not learners or not folds:
        raise InputError(f"{len(learners)} learned methods and {len(folds)} seeds, expected one each; add some")
    for seed_folds in folds:
        require_groups_together(test, seed_folds)
    # The number of images is checked before the first image is read.
    indices_by_set = [_drawn_indices(train_set, len(folds), images) for train_set in training]
    tests = collect_material(test, learners, side, workers, on_scene)
    subsets = _RealSubsets(tests, folds)
    entries: list[TransferRow] = []
    for number, learner in enumerate(learners):
        crossed = tuple(cross_fit(learner, number, tests, seed_folds, seed) for seed, seed_folds in enumerate(folds))
        fewest = subsets.min_images
        entries.append(TransferRow(learner.name, "cross-validation", generated_name, fewest, crossed))
        # The constant illuminant uses no image content, so it has no rows with N real images.
        for count in () if isinstance(learner, ConstantLight) else real_counts:
            # Training on all images of the other folds is cross-validation.
            results = crossed if count is None else subsets.results(number, learner, count, subsets.fit_alone)
            label = _count_label(count)
            entries.append(TransferRow(learner.name, "real", generated_name, count or fewest, results, "alone", label))
    for train_set, seed_indices in zip(training, indices_by_set, strict=True):
        # Only images that are drawn with at least one seed are read.
        used_indices = _used_indices(seed_indices)
        scenes = [train_set.scenes[int(index)] for index in used_indices.tolist()]
        material = collect_material(scenes, learners, side, workers, on_scene)
        positions = [np.searchsorted(used_indices, indices).astype(np.int64) for indices in seed_indices]
        for number, learner in enumerate(learners):
            # Naive counterparts have the illuminants of the generated set, so the constant illuminant is the same.
            if isinstance(learner, ConstantLight) and train_set.kind in NAIVE:
                continue
            fitted = [fit_on(learner, number, material, indices, seed) for seed, indices in enumerate(positions)]
            results = tuple(
                result_of(learner.name, estimate_on(method, number, tests, tests.all_indices), tests.truths)
                for method in fitted
            )
            row = TransferRow(learner.name, train_set.kind, train_set.data, images, results)
            entries.append(row)
            if not isinstance(learner, FeatureLearner) or isinstance(learner, ConstantLight):
                continue
            for count in real_counts:
                results = subsets.results(number, learner, count, partial(subsets.fit_adapted, fitted))
                entries.append(replace(row, results=results, real_use="adapted", real=_count_label(count)))
    rows = [entry for learner in learners for entry in entries if entry.method == learner.name]
    if methods:
        method_results = evaluate(tests.scenes, methods, workers)
        rows += [TransferRow(result.method, "none", "", 0, (result,)) for result in method_results]
    return tuple(rows)


# Function that fits a learner. Arguments: learner, its index, indices of N real images (N,) int64, seed.
_Fit = Callable[[AnyLearner, int, Indices, int], Method]


@dataclass(frozen=True, eq=False)
class _RealSubsets:
    """Test images, with subsets of N real images for training.

    - `tests`: material of the test images.
    - `folds`: for each seed the fold of each image, (N,) int64.
    - `real_only_fits`: models trained on N images alone, by learner, seed and images; every training set needs them.
    """

    tests: Material
    folds: Sequence[npt.NDArray[np.int64]]
    real_only_fits: dict[tuple[int, int, bytes], LocalFit] = field(default_factory=dict)

    @property
    def min_images(self) -> int:
        """Smallest number of images outside a fold, of all folds and seeds."""
        return min(len(seed_folds) - int(np.bincount(seed_folds).max()) for seed_folds in self.folds)

    def results(self, number: int, learner: AnyLearner, real: int | None, fit: _Fit) -> tuple[Result, ...]:
        """Return a result for each seed; the model that estimates a fold uses `real` images of the other folds."""
        results: list[Result] = []
        for seed, folds in enumerate(self.folds):
            order = np.random.default_rng(seed).permutation(len(folds))
            answers: dict[int, SceneAnswer] = {}
            for fold in np.unique(folds):
                test_indices = np.flatnonzero(folds == fold)
                indices = np.sort(order[folds[order] != fold][:real])
                method = fit(learner, number, indices, seed)
                estimates = estimate_on(method, number, self.tests, test_indices)
                answers |= zip(test_indices.tolist(), estimates, strict=True)
            ordered = [answers[index] for index in range(len(folds))]
            results.append(result_of(learner.name, ordered, self.tests.truths))
        return tuple(results)

    def fit_alone(self, learner: AnyLearner, number: int, indices: Indices, seed: int) -> Method:
        """Return the method fitted to real images alone, with indices (N,) int64."""
        if isinstance(learner, FeatureLearner):
            return self._fit_real_only_once(learner, number, indices, seed).method
        return fit_on(learner, number, self.tests, indices, seed)

    def fit_adapted(
        self, fitted: Sequence[Method], learner: AnyLearner, number: int, indices: Indices, seed: int
    ) -> LearnedMethod:
        """Return the method of `fitted` for this seed, adapted to real images with indices (N,) int64."""
        method = fitted[seed]
        if not isinstance(learner, FeatureLearner) or not isinstance(method, LearnedMethod):
            raise TypeError(f"{learner.name} cannot be adapted, expected a method with features")
        return adapt(method, self._fit_real_only_once(learner, number, indices, seed))

    def _fit_real_only_once(self, learner: FeatureLearner, number: int, indices: Indices, seed: int) -> LocalFit:
        key = number, seed, indices.tobytes()
        if key not in self.real_only_fits:
            features = self.tests.features[number]
            drawn_features = [] if features is None else [features[int(index)] for index in indices]
            self.real_only_fits[key] = fit_local(learner, drawn_features, self.tests.truths[indices], seed)
        return self.real_only_fits[key]


def _count_label(count: int | None) -> str:
    return "all" if count is None else str(count)


def _drawn_indices(train_set: TrainingSet, seeds: int, images: int) -> list[Indices]:
    return [draw_images(len(train_set.scenes), images, seed) for seed in range(seeds)]


def _used_indices(seed_indices: Sequence[Indices]) -> Indices:
    return np.unique(np.concatenate(seed_indices))
