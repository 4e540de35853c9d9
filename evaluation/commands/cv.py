"""`evaluate cv`: learned methods on a data set, each image estimated by a model that has not seen it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evaluation.commands.options import DataReading, PrintedError, PrintedStatistics, with_data_options
from evaluation.commands.train import LEARNERS_HELP
from foundation.console import EXIT_CODES
from foundation.json_output import JsonOutput, with_json

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from evaluation.methods.method import Learner
    from evaluation.scene import SceneSet

HELP = f"""Cross-validate methods that learn: train on all folds but one and estimate the images of that one, for each.

METHOD is {LEARNERS_HELP}, all, or a class of your own with fit(scenes, seed), as module:Class or file.py:Class; several
stand between commas. The constant light, the median of the training lights, always stands beside them: a method that
does not beat it has learned nothing from images. Images of one group, such as one picture under several lights, stay
in one fold.

Reads DATA, a data set of any layout that evaluate run reads. Folds are the data set's own where its authors made some,
else three that --seed draws; --folds takes a number of folds to draw, or a CSV file with the columns image,fold. Prints
the table of evaluate run; writes nothing unless asked: --out writes the results folder of evaluate run with folds.csv,
--save-folds the folds alone.

{EXIT_CODES}
"""


@with_json("evaluate cv")
@with_data_options
def cv(
    method: Annotated[
        str,
        typer.Argument(
            metavar="METHOD", help=f"{LEARNERS_HELP}, all, module:Class or file.py:Class.", show_default=False
        ),
    ],
    data: Annotated[
        str, typer.Argument(metavar="DATA", help="Folder or file of the data set, or its URL.", show_default=False)
    ],
    *,
    folds: Annotated[
        str | None,
        typer.Option(
            metavar="N|FILE.csv",
            help="Number of folds to draw, or a file with the columns image,fold. \\[default: the data's own, or 3]",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(metavar="N", help="Of the folds and of all that is random in the training.", min=0)
    ] = 0,
    error: PrintedError = "reproduction",
    statistics: PrintedStatistics = "paper",
    out: Annotated[
        Path | None,
        typer.Option(metavar="RESULTS", help="Write everything to this new folder.", show_default=False),
    ] = None,
    save_folds: Annotated[
        Path | None,
        typer.Option(metavar="OUT.csv", help="Write the folds to this new file.", show_default=False),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Threads that read images; no number depends on it. \\[default: one a processor]",
            min=1,
            show_default=False,
        ),
    ] = None,
    reading: DataReading,
    told: JsonOutput,
) -> None:
    """Cross-validate methods on a data set."""
    from evaluation.commands.options import require_order
    from evaluation.experiments.folds import choose_folds, folds_to_csv
    from evaluation.experiments.run_folder import describe_run, write_run
    from evaluation.experiments.running import cross_validate
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.method_records import describe_method
    from evaluation.results.tables import summary_table
    from foundation.console import orderly_end, progress
    from foundation.files import require_free, require_free_file, write_whole
    from foundation.processors import processor_count

    require_order("cv", method, data)
    learners, left_out = _chosen(method)
    if out is not None:
        require_free(out, "the results")
    if save_folds is not None:
        require_free_file(save_folds, "the folds")
    found = reading.open(data)
    parts, origin = choose_folds(found, folds, seed)
    count, threads = len(found.scenes), workers or processor_count()
    with orderly_end():
        with progress("images") as advance:
            steps = iter(range(1, count + 1))
            results = cross_validate(found.scenes, learners, parts, seed, threads, lambda: advance(next(steps), count))
        notes = (
            f"cross-validated in {len(set(parts.tolist()))} folds, {origin}; seed {seed}",
            *left_out,
            *_parted_copies(found, parts),
        )
        described = [describe_method(learner) for learner in learners]
        made = describe_run(found, results, described, {"seed": seed, "folds": origin}, parts, notes)
        if out is not None:
            write_run(made, found.scenes, out, error, threads)
        if save_folds is not None:
            write_whole(save_folds, folds_to_csv(made.subject.images, parts))
    told.add(data_set=found.name, images=count, folds=len(set(parts.tolist())), seed=seed, error=error)
    show_tables(told, [summary_table(made.subject, results, error, statistics == "all" or told.asked)])
    show_notes(told, made.notes, made.treatment)


def _parted_copies(data: SceneSet, folds: npt.NDArray[np.int64]) -> list[str]:
    """Return a sentence where images (N,) int64 by their folds are copies of images of other folds."""
    from evaluation.datasets.states import first_copies
    from foundation.errors import counted, first_of

    names = [scene.name for scene in data.scenes]
    apart = [
        f"{names[place]} of {names[first]}"
        for place, first in enumerate(first_copies(data.scenes))
        if folds[place] != folds[first]
    ]
    if not apart:
        return []
    return [
        f"{counted(len(apart), 'image is a copy', 'images are copies')} of images of other folds ({first_of(apart)}): "
        "tested on what was trained on"
    ]


def _chosen(text: str) -> tuple[list[Learner], list[str]]:
    """Return the learners that a text names, after the constant light, and why some of `all` are left out."""
    from evaluation.commands.options import choose_learners
    from evaluation.learning.constant_light import ConstantLight
    from evaluation.learning.feature_learner import what_is_missing

    texts = [part.strip() for part in text.split(",")]
    explicit = {learner.name for learner in choose_learners(part for part in texts if part.lower() != "all")}
    constant = ConstantLight()
    others = [learner for learner in choose_learners(texts) if learner.name != constant.name]
    chosen: list[Learner] = [constant]
    left_out: list[str] = []
    for learner in others:
        missing = what_is_missing(learner)
        if missing and learner.name not in explicit:
            left_out.append(f"{learner.name} is left out: {missing}")
        else:
            chosen.append(learner)
    return chosen, left_out
