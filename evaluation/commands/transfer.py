"""`evaluate transfer`: what generated images are worth as training data for real ones."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from foundation.console import EXIT_CODES

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

    import numpy as np
    import numpy.typing as npt

    from evaluation.experiments.transfer.material import AnyLearner
    from evaluation.experiments.transfer.plan import TransferPlan
    from evaluation.methods.method import Method
    from evaluation.scene import Scene, SceneSet

_FOLDS = "3"
"""Folds of the field's tables, on NUS and on Cube+."""

_ALIKE = 2.0
"""Ratio of sizes from which the reader is told: learned methods reduce images by up to 2 themselves."""

HELP = f"""Train learned methods on generated images and test them on real ones.

Trains each method on each data set of --train and tests it on --test, beside real cross-validation of the same method,
the constant light (median of the training lights), and statistics methods. With --naive also trained without a table:
the same pictures, linear sRGB times the same lights, with and without the camera's colour matrix. Prints mean, median,
trimean, best and worst quarter, their bootstrap intervals, and their ratios to real cross-validation, paired by image.
Training sets that share pictures with the test set, by name or content, are refused. Writes nothing unless asked with
--out: results.csv, errors.csv (each image), folds, tables.tex, report.html and run.json.

{EXIT_CODES}
"""


def transfer(
    train: Annotated[
        list[str],
        typer.Option(metavar="GENERATED", help="Data set to train on; may be repeated.", show_default=False),
    ],
    test: Annotated[str, typer.Option(metavar="REAL", help="Data set to test on.", show_default=False)],
    layout: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Layout of the test set. \\[default: by what it looks like]", show_default=False
        ),
    ] = None,
    methods: Annotated[str, typer.Option(metavar="LIST", help="Learned methods between commas, or all.")] = "all",
    statistics: Annotated[
        str, typer.Option(metavar="LIST", help="Statistics methods for reference between commas, all or none.")
    ] = "gray-world,shades-of-gray,gray-edge-1",
    folds: Annotated[
        str | None,
        typer.Option(
            metavar="N|FILE",
            help="Folds of real cross-validation: a number, or a CSV file image,fold. \\[default: those of the "
            f"data set's authors, else {_FOLDS}]",
            show_default=False,
        ),
    ] = None,
    naive: Annotated[
        Path | None,
        typer.Option(
            metavar="PICTURES", help="Folder of the pictures that --train was generated from.", show_default=False
        ),
    ] = None,
    matrix: Annotated[
        str | None,
        typer.Option(
            metavar="CAMERA|FILE|none",
            help="Colour matrix of the naive baseline: of a camera, or a file of 3 x 3 numbers, linear sRGB to camera. "
            "\\[default: the camera of the table]",
            show_default=False,
        ),
    ] = None,
    images: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Training images of every generated and naive row. \\[default: all of the smallest set]",
            min=1,
            show_default=False,
        ),
    ] = None,
    seeds: Annotated[
        int, typer.Option(metavar="K", help="Seeds of learners, training images and drawn folds.", min=1)
    ] = 1,
    side: Annotated[
        int | None,
        typer.Option(
            metavar="PX",
            help="Make all images this small first, averaging areas, so that training and test images are alike.",
            min=1,
            show_default=False,
        ),
    ] = None,
    shared: Annotated[
        Literal["refuse", "leave-out", "keep"], typer.Option(help="Training images that share a picture with the test.")
    ] = "refuse",
    error: Annotated[
        Literal["reproduction", "recovery"], typer.Option(help="Angular error to sum up.")
    ] = "reproduction",
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Write the results to this new folder.", show_default=False)
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="Threads. \\[default: one a processor]", min=1, show_default=False),
    ] = None,
) -> None:
    """Train on generated data, test on real data."""
    from evaluation.datasets import open_scenes
    from evaluation.experiments.transfer.figures import figures_of
    from evaluation.experiments.transfer.outcome import TransferOutcome, save_outcome
    from evaluation.experiments.transfer.plan import plan_transfer
    from evaluation.experiments.transfer.rows import transfer as run_transfer
    from evaluation.reports.terminal import print_table
    from foundation.files import require_free
    from foundation.processors import processor_count

    if out is not None:
        require_free(out, "the results")
    threads = workers or processor_count()
    learners = _learners(methods)
    references = _references(statistics)
    tested = open_scenes(test, layout)
    plan = plan_transfer(tested, [open_scenes(place) for place in train], naive, matrix, shared)
    drawn = _folds(folds, tested, seeds)
    smallest = min(len(some.scenes) for some in plan.training)
    wanted = smallest if images is None else images
    with _progress() as step:
        scenes, plan = _alike(tested, plan, side, threads, step)
        rows = run_transfer(scenes, plan.training, learners, drawn, wanted, references, threads, step)
    figures = figures_of(rows, error)
    settings: dict[str, Any] = {
        "methods": [learner.name for learner in learners],
        "statistics": [method.name for method in references],
        "folds": folds or ("the data set's own" if tested.folds is not None else _FOLDS),
        "matrix": matrix,
        "images": wanted,
        "seeds": list(range(seeds)),
        "side": side,
        "shared": shared,
        "error": error,
    }
    outcome = TransferOutcome(tested, scenes, plan, rows, figures, drawn, settings)
    for table in outcome.tables():
        print_table(table)
        print()
    for note in plan.notes:
        print(note)
    if out is not None:
        save_outcome(outcome, out)


def _learners(text: str) -> list[AnyLearner]:
    """Return the learned methods of a list, built-in ones or classes of the user's own, and the constant light."""
    from evaluation.learning.constant_light import ConstantLight
    from evaluation.learning.feature_learner import FeatureLearner
    from evaluation.learning.standard import standard_learners
    from evaluation.methods.method import Learner
    from evaluation.methods.naming import find_method
    from foundation.errors import InputError

    known = standard_learners()
    names = list(known) if text.strip().lower() == "all" else [name.strip() for name in text.split(",")]
    found: list[AnyLearner] = []
    for name in dict.fromkeys(names):
        if name in known or name == ConstantLight().key:
            found += [] if name == ConstantLight().key else [known[name]]
            continue
        if ":" not in name:
            raise InputError(
                f"{name!r} is no learned method; they are {', '.join(known)}, or all; one of your own is named as "
                "module:Class or file.py:Class"
            )
        learner = find_method(name)
        if not isinstance(learner, FeatureLearner | Learner):
            raise InputError(f"{name} learns nothing: it has no fit(scenes, seed); evaluate run takes it")
        found.append(learner)
    found.append(ConstantLight())
    titles = [learner.name for learner in found]
    for title in titles:
        if titles.count(title) > 1:
            raise InputError(f"two methods are called {title}; give one another name: names head the rows")
    return found


def _references(text: str) -> list[Method]:
    from evaluation.methods.standard import standard_methods
    from foundation.errors import InputError

    known = standard_methods()
    if text.strip().lower() == "none":
        return []
    names = list(known) if text.strip().lower() == "all" else [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            raise InputError(f"{name!r} is no statistics method; they are {', '.join(known)}, all or none")
    return [known[name] for name in dict.fromkeys(names)]


def _folds(text: str | None, test: SceneSet, seeds: int) -> tuple[npt.NDArray[np.int64], ...]:
    """Return the folds of each seed: drawn by it, or the same for all where they are given."""
    import numpy as np

    from evaluation.experiments.folds import draw_folds, group_of, read_folds

    if text is None and test.folds is not None:
        return (np.array(test.folds, dtype=np.int64),) * seeds
    wanted = text or _FOLDS
    if wanted.isdecimal():
        groups = [group_of(scene) for scene in test.scenes]
        return tuple(draw_folds(len(groups), int(wanted), seed, groups) for seed in range(seeds))
    return (read_folds(Path(wanted), [scene.name for scene in test.scenes]),) * seeds


def _alike(
    test: SceneSet, plan: TransferPlan, side: int | None, workers: int, on_scene: Callable[[], None]
) -> tuple[tuple[Scene, ...], TransferPlan]:
    """Return test images and plan with all images made small, or with a word of caution where they are not alike."""
    from dataclasses import replace

    from evaluation.experiments.transfer.thumbnails import make_small

    if side is not None:
        training = tuple(
            replace(some, scenes=make_small(some.scenes, side, workers, on_scene)) for some in plan.training
        )
        note = f"All images were made small to at most {side} px by averaging areas without clipped and masked pixels"
        small = make_small(test.scenes, side, workers, on_scene)
        return small, replace(plan, training=training, notes=(*plan.notes, note))
    sizes = [max(scenes[0].read()[0].shape) for scenes in (test.scenes, plan.training[0].scenes)]
    if max(sizes) <= _ALIKE * min(sizes):
        return test.scenes, plan
    note = (
        f"Training images have sides of up to {sizes[1]} px and test images of up to {sizes[0]} px: methods see detail "
        f"and noise in one that the other lacks; --side {min(sizes)} makes them alike"
    )
    return test.scenes, replace(plan, notes=(*plan.notes, note))


@contextmanager
def _progress() -> Generator[Callable[[], None]]:
    """Show how many images have been read; their number depends on what seeds draw."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.completed} images read"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("images", total=None)
        yield lambda: progress.advance(task)
