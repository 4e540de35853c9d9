"""`evaluate transfer`: what generated images are worth as training data for real ones."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from evaluation.commands.options import (
    AngularError,
    DataReading,
    choose_beside_constant,
    choose_methods,
    image_steps,
    thread_option,
)
from foundation.console import EXIT_CODES, JsonOutput, grouped, option, with_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

    from evaluation.experiments.cross_validation import AnyLearner
    from evaluation.experiments.transfer.plan import TransferPlan
    from evaluation.experiments.transfer.rows import BesideReal, TransferRow, Way
    from evaluation.methods.method import Method
    from evaluation.scene import SceneSet

_ALIKE = 2.0
"""Ratio of sizes from which the reader is told: learned methods reduce images by up to 2 themselves."""

HELP = f"""Train learned methods on generated images and test them on real ones.

Reads data sets of any layout that evaluate run reads; trains each method on each one of --train and tests it on
--test, beside real cross-validation of the same method, the constant light (median of the training lights), and
statistics methods. With --naive also trained without a table: the same pictures, linear sRGB times the same lights,
with and without the camera's colour matrix. With --real also beside N real images of the other folds: on them alone,
on them pooled with each set, and on each set first and then adapted to them. Prints mean, median, trimean, best and
worst quarter, their bootstrap intervals, and their ratios to real cross-validation, paired by image. Training sets
that share pictures with the test set, by name or content, are refused. Writes nothing unless asked with --out:
results.csv, errors.csv (each image), folds, tables.tex, report.html and run.json.

{EXIT_CODES}
"""


@with_json("evaluate transfer")
@grouped
def transfer(
    train: Annotated[list[str], option("GENERATED", "Data set to train on; may be repeated.")],
    test: Annotated[str, option("REAL", "Data set to test on.")],
    methods: Annotated[str, option("LIST", "Learned methods between commas, or all.")] = "all",
    statistics: Annotated[
        str,
        option(
            "LIST",
            "Statistics methods for reference between commas, all or none. "
            "\\[default: gray-world, shades-of-gray, gray-edge-1]",
            show_default=False,
        ),
    ] = "gray-world,shades-of-gray,gray-edge-1",
    folds: Annotated[
        str | None,
        option(
            "N|FILE",
            "Folds of real cross-validation: a number, or a CSV file image,fold. \\[default: those of the "
            "data set's authors, else 3]",
        ),
    ] = None,
    naive: Annotated[Path | None, option("PICTURES", "Folder of the pictures that --train was generated from.")] = None,
    matrix: Annotated[
        str | None,
        option(
            "CAMERA|FILE|none",
            "Colour matrix of the naive baseline: of a camera, or a file of 3 x 3 numbers, linear sRGB to camera. "
            "\\[default: the camera of the table]",
        ),
    ] = None,
    only: Annotated[
        Path | None,
        option(
            "FILE", "CSV file with a column image: only these are tested; cross-validation still trains on all others."
        ),
    ] = None,
    real: Annotated[
        str | None,
        option(
            "LIST",
            "Numbers of real images to train beside, between commas, as 0,20,100,400,all; drawn from the folds that "
            "are not tested.",
        ),
    ] = None,
    beside: Annotated[
        str, option("LIST", "What is done with a set and N real images: pooled, adapted or both.")
    ] = "pooled,adapted",
    relit: Annotated[
        str | None,
        option(
            "DATA", "Real images of another camera, to train on under the lights of each generated set, as a yardstick."
        ),
    ] = None,
    images: Annotated[
        int | None,
        option("N", "Training images of every generated and naive row. \\[default: all of the smallest set]", min=1),
    ] = None,
    seeds: Annotated[int, option("K", "Seeds of learners, training images and drawn folds.", min=1)] = 1,
    side: Annotated[
        int | None,
        option(
            "PX",
            "Make all images this small first, averaging areas, so that training and test images are alike.",
            min=1,
        ),
    ] = None,
    shared: Annotated[
        Literal["refuse", "leave-out", "keep"], typer.Option(help="Training images that share a picture with the test.")
    ] = "refuse",
    error: Annotated[AngularError, typer.Option(help="Angular error to sum up.")] = "reproduction",
    out: Annotated[Path | None, option("FOLDER", "Write the results to this new folder.")] = None,
    workers: Annotated[int | None, thread_option()] = None,
    *,
    reading: DataReading,
    output: JsonOutput,
) -> None:
    """Train on generated data, test on real data; options of reading are those of the test set."""
    from dataclasses import asdict, replace

    from evaluation.datasets import open_scenes
    from evaluation.experiments.folds import FOLDS, choose_folds, groups_of
    from evaluation.experiments.transfer.outcome import TransferOutcome, figures_of, harm_notes, save_outcome
    from evaluation.experiments.transfer.plan import is_generated, plan_transfer
    from evaluation.experiments.transfer.rows import count_images
    from evaluation.experiments.transfer.rows import transfer as run_transfer
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.method_records import describe_method
    from foundation.compiled import processor_count
    from foundation.errors import InputError
    from foundation.folders import require_free

    if out is not None:
        require_free(out, "the results")
    if matrix is not None and naive is None:
        raise InputError(f"--matrix {matrix} is for the naive baseline; expected --naive PICTURES beside it")
    threads = workers or processor_count()
    learners, left_out = _learners(methods)
    references = _references(statistics)
    wished = _beside(real, beside)
    tested = reading.open(test)
    others = None if relit is None else open_scenes(relit)
    plan = plan_transfer(tested, [open_scenes(place) for place in train], naive, matrix, shared, others)
    counted, places, partly = _only(only, tested)
    drawn = tuple(choose_folds(tested, folds, seed)[0] for seed in range(seeds))
    wished, too_many = _within(wished, drawn)
    notes = [*plan.notes, *_sizes(tested, plan, side), *left_out, *partly, *too_many, *_not_adapted(learners, wished)]
    smallest = min(len(some.scenes) for some in plan.training)
    wanted = smallest if images is None else images
    count = count_images(tested.scenes, plan.training, len(drawn), wanted)
    with image_steps(count) as step:
        rows = run_transfer(
            *(tested.scenes, plan.training, learners, drawn, wanted, references),
            *(side, threads, step),
            generated=tested.name if is_generated(tested) else "",
            beside=wished,
            counted=places,
        )
    figures = figures_of(rows, error, groups=groups_of(counted.scenes))
    plan = replace(plan, notes=(*notes, *_suspicions(counted, rows), *harm_notes(figures)))
    settings: dict[str, Any] = {
        "methods": [describe_method(learner) for learner in learners],
        "statistics": [describe_method(method) for method in references],
        "folds": folds or ("the data set's own" if tested.folds is not None else str(FOLDS)),
        "only": None if only is None else only.name,
        "matrix": matrix,
        "images": wanted,
        "seeds": list(range(seeds)),
        "real": real,
        "beside": None if real is None else list(wished.ways),
        "relit": None if others is None else others.name,
        "side": side,
        "shared": shared,
        "error": error,
        "reading": asdict(reading),
    }
    outcome = TransferOutcome(counted, tested, plan, rows, figures, drawn, settings)
    if out is not None:
        save_outcome(outcome, out)
    output.add(test=counted.name, error=error, settings=settings)
    show_tables(output, list(outcome.tables()), "")
    show_notes(output, plan.notes)


def _learners(text: str) -> tuple[list[AnyLearner], list[str]]:
    """Return the learned methods of a list and the constant light, and why some of `all` are left out."""
    from evaluation.learning.constant_light import ConstantLight
    from foundation.errors import InputError

    chosen, left_out = choose_beside_constant(text)
    titles = [each.name for each in chosen]
    for title in titles:
        if titles.count(title) > 1:
            raise InputError(f"two methods are called {title}; give one another name: names head the rows")
    return [*chosen, ConstantLight()], left_out


def _beside(real: str | None, ways: str) -> BesideReal:
    """Return what --real and --beside ask for."""
    from evaluation.experiments.transfer.rows import BesideReal
    from foundation.errors import InputError

    words = [] if real is None else [word.strip().lower() for word in real.split(",")]
    if not all(word == "all" or (word.isascii() and word.isdigit()) for word in words):
        raise InputError(
            f"--real is {real!r}, expected numbers of real images between commas, or all: 0,20,100,400,all"
        )
    counts = [None if word == "all" else int(word) for word in dict.fromkeys(words)]
    known: dict[str, Way] = {"pooled": "pooled", "adapted": "adapted"}
    asked = [word.strip().lower() for word in ways.split(",")]
    if not all(word in known for word in asked):
        raise InputError(f"--beside is {ways!r}, expected pooled, adapted, or both between commas")
    # Of no real images there are rows in any case: those of the sets alone.
    return BesideReal(
        tuple(count for count in counts if count != 0), tuple(known[word] for word in dict.fromkeys(asked))
    )


def _within(beside: BesideReal, folds: Sequence[npt.NDArray[np.int64]]) -> tuple[BesideReal, list[str]]:
    """Return the numbers of real images that every fold (N,) int64 leaves, and why others are left out."""
    from dataclasses import replace

    import numpy as np

    least = min(len(each) - int(np.bincount(each).max()) for each in folds)
    left_out = [count for count in beside.counts if count is not None and count > least]
    asked = ", ".join(map(str, left_out))
    all_of_them = "all are those" if None in beside.counts else "--real all has a row beside those"
    notes = (
        [f"No rows beside {asked} real images: a fold that is tested leaves {least}; {all_of_them}"] if left_out else []
    )
    return replace(beside, counts=tuple(count for count in beside.counts if count not in left_out)), notes


def _not_adapted(learners: Sequence[AnyLearner], beside: BesideReal) -> list[str]:
    from evaluation.learning.feature_learner import FeatureLearner

    if not beside.counts or "adapted" not in beside.ways:
        return []
    return [
        f"{learner.name} is a class of your own, which is not adapted: it has rows alone and pooled"
        for learner in learners
        if not isinstance(learner, FeatureLearner)
    ]


def _references(text: str) -> list[Method]:
    return [] if text.strip().lower() == "none" else choose_methods(text.split(","))


def _only(file: Path | None, test: SceneSet) -> tuple[SceneSet, npt.NDArray[np.int64], tuple[str, ...]]:
    """Return the test set without the images that do not count, the places (P,) of those that do, and notes."""
    from dataclasses import replace

    import numpy as np

    from evaluation.experiments.folds import read_names

    if file is None:
        return test, np.arange(len(test.scenes), dtype=np.int64), ()
    names = read_names(file, [scene.name for scene in test.scenes])
    places = np.array([place for place, scene in enumerate(test.scenes) if scene.name in names], dtype=np.int64)
    note = (
        f"{len(places)} of the {len(test.scenes)} images of {test.name} count, those of {file.name}; cross-validation "
        "trained on the others of all"
    )
    return (
        replace(test, scenes=tuple(scene for scene in test.scenes if scene.name in names), folds=None),
        places,
        (note,),
    )


def _suspicions(test: SceneSet, rows: Sequence[TransferRow]) -> tuple[str, ...]:
    """Return what the reader is told where training and test images have their channels in another order."""
    from dataclasses import replace

    import numpy as np

    from evaluation.experiments.suspicions import suspicions

    results = [replace(row.results[0], method=f"{row.method}, {row.training}") for row in rows]
    return suspicions([scene.name for scene in test.scenes], np.stack([scene.truth for scene in test.scenes]), results)


def _sizes(test: SceneSet, plan: TransferPlan, side: int | None) -> list[str]:
    """Return what the reader is told of the sizes of images; nothing where they are alike."""
    if side is not None:
        return [f"All images were made small to at most {side} px by averaging areas without clipped and masked pixels"]
    sizes = [max(scenes[0].read()[0].shape) for scenes in (test.scenes, plan.training[0].scenes)]
    if max(sizes) <= _ALIKE * min(sizes):
        return []
    return [
        f"Training images have sides of up to {sizes[1]} px and test images of up to {sizes[0]} px: methods see detail "
        f"and noise in one that the other lacks; --side {min(sizes)} makes them alike"
    ]
