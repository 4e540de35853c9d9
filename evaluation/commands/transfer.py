"""`evaluate transfer`: what generated images are worth as training data for real ones."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from pathlib import Path
from statistics import median_low
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evaluation.commands.options import (
    AngularError,
    Read,
    argument,
    choose_methods,
    choose_without_constant,
    image_steps,
    is_learner,
    open_data,
    split_names,
    thread_option,
)
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.errors import InputError
from foundation.folders import require_free

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

    from evaluation.experiments.cross_validation import AnyLearner
    from evaluation.experiments.transfer.plan import TransferPlan
    from evaluation.scene import Scene

# Ratio of sizes from which all images are made small: learned methods reduce images by up to 2 themselves.
_ALIKE = 2.0
_LOOKED_AT = 25  # Images of a set whose sizes are read at most

HELP = f"""Train learned methods on generated images and test them on real ones.

Reads data sets of any layout that evaluate run reads; trains each method on each TRAIN and tests it on TEST, beside
real cross-validation of the same method, the constant light (median of the training lights), and methods that learn
nothing. With --naive also trained without a table: the same pictures, linear sRGB times the same lights, with and
without the camera's colour matrix. With --real also beside N real images of the other folds: on them alone, and on each
set first and then adapted to them. Prints mean, median, trimean, best and worst quarter, their bootstrap intervals,
and their ratios to real cross-validation, paired by image. Training images that share a picture with the test set, by
name or content, are left out. Writes nothing unless asked with --out.

{EXIT_CODES}
"""


@with_json("evaluate transfer")
def transfer(
    test: Annotated[str, argument("TEST", "Real data set to test on; --read is about it.")],
    train: Annotated[list[str], argument("TRAIN", "Data sets to train on, made by generate.")],
    method: Annotated[
        list[str] | None,
        option(
            "LIST",
            "Methods between commas: names of evaluate cv (all: all of them), and of evaluate run for reference. "
            "\\[default: all, gray-world, shades-of-gray, gray-edge-1]",
        ),
    ] = None,
    naive: Annotated[Path | None, option("PICTURES", "Folder of the pictures that TRAIN was generated from.")] = None,
    relit: Annotated[
        str | None,
        option("DATA", "Real images of another camera, to train on under the lights of each TRAIN, as a yardstick."),
    ] = None,
    real: Annotated[
        str | None,
        option("LIST", "Numbers of real images to train beside, between commas, as 0,20,100,all."),
    ] = None,
    seeds: Annotated[int, option("K", "Seeds of learners, training images and folds.", min=1)] = 1,
    error: Annotated[AngularError, typer.Option(help="Angular error to sum up.")] = "reproduction",
    out: Annotated[Path | None, option("FOLDER", "Write tables, errors and a report to this new folder.")] = None,
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

    if out is not None:
        require_free(out, "the results")
    threads = workers or processor_count()
    names = split_names(method or ["all", "gray-world", "shades-of-gray", "gray-edge-1"])
    learned = [name for name in names if name.lower() == "all" or is_learner(name)]
    learners, left_out = _learners(learned)
    references = choose_methods(name for name in names if name not in learned)
    asked = _counts(real)
    tested = open_data(test, read)
    others = None if relit is None else open_scenes(relit)
    plan = plan_transfer(tested, [open_scenes(place) for place in train], naive, others)
    drawn = tuple(choose_folds(tested, None, seed)[0] for seed in range(seeds))
    counts, too_many = _within(asked, drawn)
    side, made_small = _side(tested.scenes, plan)
    notes = [*plan.notes, *made_small, *left_out, *too_many]
    images = min(len(some.scenes) for some in plan.training)
    with image_steps(count_images(tested.scenes, plan.training, len(drawn), images)) as step:
        rows = run_transfer(
            *(tested.scenes, plan.training, learners, drawn, images, references),
            *(side, threads, step),
            generated_name=tested.name if is_generated(tested) else "",
            real_counts=counts,
        )
    figures = figures_of(rows, error, groups=groups_of(tested.scenes))
    plan = replace(plan, notes=(*notes, *harm_notes(figures)))
    settings: dict[str, Any] = {
        "methods": [describe_method(each) for each in (*learners, *references)],
        "images": images,
        "seeds": list(range(seeds)),
        "real": real,
        "relit": None if others is None else others.name,
        "side": side,
        "error": error,
        "read": list(read or ()),
    }
    outcome = TransferOutcome(tested, plan, rows, figures, drawn, settings)
    if out is not None:
        save_outcome(outcome, out)
    output.add(test=tested.name, error=error, settings=settings)
    show_tables(output, list(outcome.tables()), "")
    show_notes(output, plan.notes)


def _learners(names: Sequence[str]) -> tuple[list[AnyLearner], list[str]]:
    """Return the learned methods of a list and the constant light, and why some of `all` are left out."""
    from evaluation.learning.constant_light import ConstantLight

    chosen, left_out = choose_without_constant(names)
    titles = [each.name for each in chosen]
    for title in titles:
        if titles.count(title) > 1:
            raise InputError(f"two methods are called {title}; give one another name: names head the rows")
    return [*chosen, ConstantLight()], left_out


def _counts(real: str | None) -> tuple[int | None, ...]:
    """Return the numbers of --real; None for all, without 0: of no real images there are rows in any case."""
    words = [] if real is None else [word.strip().lower() for word in real.split(",")]
    if not all(word == "all" or (word.isascii() and word.isdigit()) for word in words):
        raise InputError(f"--real is {real!r}, expected numbers of real images between commas, or all: 0,20,100,all")
    return tuple(None if word == "all" else int(word) for word in dict.fromkeys(words) if word != "0")


def _within(
    counts: Sequence[int | None], folds: Sequence[npt.NDArray[np.int64]]
) -> tuple[tuple[int | None, ...], list[str]]:
    """Return the numbers of real images that every fold (N,) int64 leaves, and why others are left out."""
    import numpy as np

    least = min(len(each) - int(np.bincount(each).max()) for each in folds)
    left_out = [count for count in counts if count is not None and count > least]
    notes = [f"No rows beside {count} real images: a fold that is tested leaves {least}" for count in left_out]
    return tuple(count for count in counts if count not in left_out), notes


def _side(test: Sequence[Scene], plan: TransferPlan) -> tuple[int | None, list[str]]:
    """Return the longest side that all images are made small to, and why; None if their sizes are alike."""
    tested, *trained = [_median_side(scenes) for scenes in (test, *(some.scenes for some in plan.training))]
    side = min(tested, *trained)
    if max(tested, *trained) <= _ALIKE * side:
        return None, []
    return side, [
        f"Half of the test images have sides of up to {tested} px, half of the images of each training set up to "
        f"{', '.join(map(str, dict.fromkeys(trained)))} px: all were made small to at most {side} px by averaging "
        "areas without clipped and masked pixels"
    ]


def _median_side(scenes: Sequence[Scene]) -> int:
    """Return the median of the longest sides of up to `_LOOKED_AT` images of a set, evenly spaced in its order, px."""
    return median_low(max(scene.read()[0].shape) for scene in scenes[:: ceil(len(scenes) / _LOOKED_AT)])
