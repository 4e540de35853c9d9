"""`evaluate transfer`: benefit of generated images as training data for real images."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from pathlib import Path
from statistics import median_low
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evaluation.commands.options import (
    AngularError,
    Figures,
    Read,
    argument,
    choose_methods,
    choose_without_constant,
    image_steps,
    is_learner,
    open_data,
    require_results_folder,
    split_names,
    thread_option,
)
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

    from evaluation.experiments.cross_validation import AnyLearner
    from evaluation.experiments.transfer.plan import TransferPlan
    from evaluation.scene import Scene

# If the longest sides of two sets differ by more than this ratio, all images are reduced to one size. Smaller ratios
# occur anyway, because learned methods reduce images by whole factors.
_MAX_SIZE_RATIO = 2.0
_MAX_MEASURED = 25  # Largest number of images of a set that are read to measure its size

HELP = f"""Train learned methods on generated images and test them on real ones.

Reads data sets in any layout of evaluate run. Trains each method on each TRAIN and tests it on TEST. For comparison:
cross-validation of the same method on TEST, the constant illuminant (median of the training illuminants), and methods
without training. --naive adds training without a look-up table: linear sRGB of the same pictures times the same
illuminants, with and without the camera's colour matrix. --real adds two trainings with N real images of the other
folds: on these images alone, and on each TRAIN with adaptation to these images. Prints mean, median, trimean, best and
worst 25 %, worst 5 %, bootstrap intervals, and ratios to the cross-validation, paired by image. Training images that
share a picture with the test set, by name or content, are excluded. Writes files only with --out.

{EXIT_CODES}
"""


@with_json("evaluate transfer")
def transfer(
    test: Annotated[str, argument("TEST", "Real data set for the test; --read applies to it.")],
    train: Annotated[list[str], argument("TRAIN", "Data sets for training, made by generate.")],
    method: Annotated[
        list[str] | None,
        option(
            "LIST",
            "Methods, separated by commas: names of evaluate cv (all: all of them), and of evaluate run for reference. "
            "\\[default: all, gray-world, shades-of-gray, gray-edge-1]",
        ),
    ] = None,
    naive: Annotated[Path | None, option("PICTURES", "Folder of the source pictures of TRAIN.")] = None,
    relit: Annotated[
        str | None,
        option("DATA", "Real images of another camera, relit to the illuminants of each TRAIN, for comparison."),
    ] = None,
    real: Annotated[
        str | None, option("LIST", "Numbers of real images used for training, separated by commas: 0,20,100,all.")
    ] = None,
    seeds: Annotated[int, option("K", "Number of seeds of learners, training images and folds.", min=1)] = 1,
    error: Annotated[AngularError, typer.Option(help="Angular error of the statistics.")] = "reproduction",
    out: Annotated[Path | None, option("FOLDER", "Write tables, errors and a report to this new folder.")] = None,
    figures: Figures = None,
    workers: Annotated[int | None, thread_option()] = None,
    read: Read = None,
    *,
    output: JsonOutput,
) -> None:
    """Train on generated data, test on real data."""
    from evaluation.datasets import open_scenes
    from evaluation.experiments.folds import choose_folds, groups_of
    from evaluation.experiments.transfer.outcome import TransferOutcome, figures_of, harm_notes, save_outcome
    from evaluation.experiments.transfer.plan import is_generated, plan_transfer
    from evaluation.experiments.transfer.rows import count_images
    from evaluation.experiments.transfer.rows import transfer as run_transfer
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.method_records import describe_method

    require_results_folder(out, "the results", figures)
    threads = workers or processor_count()
    names = split_names(method or ["all", "gray-world", "shades-of-gray", "gray-edge-1"])
    learned = [name for name in names if name.lower() == "all" or is_learner(name)]
    learners, left_out = _choose_learners(learned)
    references = choose_methods(name for name in names if name not in learned)
    requested_counts = _parse_counts(real)
    test_set = open_data(test, read)
    relit_set = None if relit is None else open_scenes(relit)
    plan = plan_transfer(test_set, [open_scenes(location) for location in train], naive, relit_set)
    folds = tuple(choose_folds(test_set, None, seed)[0] for seed in range(seeds))
    counts, count_notes = _possible_counts(requested_counts, folds)
    side, size_notes = _common_side(test_set.scenes, plan)
    notes = [*plan.notes, *size_notes, *left_out, *count_notes]
    images = min(len(training_set.scenes) for training_set in plan.training)
    with image_steps(count_images(test_set.scenes, plan.training, len(folds), images)) as step:
        rows = run_transfer(
            *(test_set.scenes, plan.training, learners, folds, images, references),
            *(side, threads, step),
            generated_name=test_set.name if is_generated(test_set) else "",
            real_counts=counts,
        )
    row_figures = figures_of(rows, error, groups=groups_of(test_set.scenes))
    plan = replace(plan, notes=(*notes, *harm_notes(row_figures)))
    settings: dict[str, Any] = {
        "methods": [describe_method(method_or_learner) for method_or_learner in (*learners, *references)],
        "images": images,
        "seeds": list(range(seeds)),
        "real": real,
        "relit": None if relit_set is None else relit_set.name,
        "side": side,
        "error": error,
        "read": list(read or ()),
    }
    outcome = TransferOutcome(test_set, plan, rows, row_figures, folds, settings)
    if out is not None:
        save_outcome(outcome, out, figures)
    output.add(test=test_set.name, error=error, settings=settings)
    show_tables(output, list(outcome.tables()), "")
    show_notes(output, plan.notes)


def _choose_learners(names: Sequence[str]) -> tuple[list[AnyLearner], list[str]]:
    from evaluation.learning.constant_light import ConstantLight

    learners, left_out = choose_without_constant(names)
    titles = [learner.name for learner in learners]
    for title in titles:
        if titles.count(title) > 1:
            raise InputError(f"two methods have the name {title}, expected different names; rename or omit one")
    # The constant illuminant is always added as the baseline.
    return [*learners, ConstantLight()], left_out


def _parse_counts(real: str | None) -> tuple[int | None, ...]:
    """Return the numbers of --real; None stands for all, and 0 is omitted, because its rows always exist."""
    words = [] if real is None else [word.strip().lower() for word in real.split(",")]
    if not all(word == "all" or (word.isascii() and word.isdigit()) for word in words):
        raise InputError(f"--real is {real!r}, expected numbers of real images, such as 0,20,100,all; correct it")
    return tuple(None if word == "all" else int(word) for word in dict.fromkeys(words) if word != "0")


def _possible_counts(
    counts: Sequence[int | None], folds: Sequence[npt.NDArray[np.int64]]
) -> tuple[tuple[int | None, ...], list[str]]:
    """Return the numbers of real images that exist outside each fold, and notes on omitted ones; folds: (N,) int64."""
    import numpy as np

    max_count = min(len(fold_numbers) - int(np.bincount(fold_numbers).max()) for fold_numbers in folds)
    left_out = [count for count in counts if count is not None and count > max_count]
    notes = [f"No rows with {n} real images: the other folds have only {max_count}; reduce --real" for n in left_out]
    return tuple(count for count in counts if count not in left_out), notes


def _common_side(test: Sequence[Scene], plan: TransferPlan) -> tuple[int | None, list[str]]:
    """Return the longest side to which all images are reduced, and a note; None if sizes are similar."""
    test_side = _median_side(test)
    training_sides = [_median_side(training_set.scenes) for training_set in plan.training]
    side = min(test_side, *training_sides)
    if max(test_side, *training_sides) <= _MAX_SIZE_RATIO * side:
        return None, []
    return side, [
        f"Longest sides (median): test images {test_side} px, training sets "
        f"{', '.join(map(str, dict.fromkeys(training_sides)))} px. All images were reduced to at most {side} px by "
        "area averages without clipped and masked pixels"
    ]


def _median_side(scenes: Sequence[Scene]) -> int:
    # At most `_MAX_MEASURED` images of the set are read, at equal steps.
    return median_low(max(scene.read()[0].shape) for scene in scenes[:: ceil(len(scenes) / _MAX_MEASURED)])
