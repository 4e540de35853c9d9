"""`evaluate cv`: cross-validation of learned methods on a data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evaluation.commands.options import (
    Data,
    Figures,
    PrintedError,
    Read,
    argument,
    choose_without_constant,
    image_steps,
    open_data,
    require_results_folder,
    split_names,
    thread_option,
)
from evaluation.commands.train import LEARNERS_HELP
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, orderly_end, with_json
from foundation.errors import counted, first_few

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from evaluation.scene import SceneSet

HELP = f"""Cross-validate learned methods: train on all folds but one and estimate the images of that fold, in turn.

METHOD is {LEARNERS_HELP}, all, or your own class with fit(scenes, seed), as module:Class or file.py:Class. Separate
several methods by commas. The constant illuminant (median of the training illuminants) is always added: a method that
is not better has learned nothing from the images. Images of one group, such as one picture under several illuminants,
stay in one fold.

Reads DATA in any layout of evaluate run. Uses the folds published with the data set, otherwise three folds drawn with
--seed; --folds sets their number or reads them from a CSV file with the columns image,fold. Prints the table of
evaluate run. Writes files only with --out: the results folder of evaluate run with folds.csv.

{EXIT_CODES}
"""


@with_json("evaluate cv")
def cv(
    method: Annotated[str, argument("METHOD", f"{LEARNERS_HELP}, all, module:Class or file.py:Class.")],
    data: Data,
    *,
    folds: Annotated[
        str | None,
        option(
            "N|FILE.csv",
            "Number of folds to draw, or a file with the columns image,fold. \\[default: published folds, or 3]",
        ),
    ] = None,
    seed: Annotated[int, option("N", "Seed of the folds and of the training.", min=0)] = 0,
    error: PrintedError = "reproduction",
    out: Annotated[Path | None, option("RESULTS", "Write all results to this new folder.")] = None,
    figures: Figures = None,
    workers: Annotated[int | None, thread_option(" that read images; results do not depend on it")] = None,
    read: Read = None,
    output: JsonOutput,
) -> None:
    """Cross-validate methods on a data set."""
    from evaluation.experiments.cross_validation import cross_validate
    from evaluation.experiments.folds import choose_folds
    from evaluation.experiments.run_folder import describe_run, write_run
    from evaluation.learning.constant_light import ConstantLight
    from evaluation.reports.table_output import show_notes, show_tables
    from evaluation.results.method_records import describe_method
    from evaluation.results.result import indistinct_methods
    from evaluation.results.tables import summary_table

    trained_learners, left_out = choose_without_constant(split_names([method]))
    learners = [ConstantLight(), *trained_learners]
    require_results_folder(out, "the results", figures)
    data_set = open_data(data, read)
    image_folds, origin = choose_folds(data_set, folds, seed)
    count, threads = len(data_set.scenes), workers or processor_count()
    with orderly_end():
        with image_steps(count) as step:
            results = cross_validate(data_set.scenes, learners, image_folds, seed, threads, step)
        notes = (
            f"cross-validated in {len(set(image_folds.tolist()))} folds, {origin}; seed {seed}",
            *left_out,
            *_separated_copies(data_set, image_folds),
            *indistinct_methods(results, data_set.truth_uncertainty_deg),
        )
        records = [describe_method(learner) for learner in learners]
        result_run = describe_run(data_set, results, records, {"seed": seed, "folds": origin}, image_folds, notes)
        if out is not None:
            write_run(result_run, data_set.scenes, out, error, threads, figures)
    output.add(data_set=data_set.name, images=count, folds=len(set(image_folds.tolist())), seed=seed, error=error)
    show_tables(output, [summary_table(result_run.subject, results, error, output.is_requested)])
    show_notes(output, result_run.notes, result_run.treatment)


def _separated_copies(data: SceneSet, folds: npt.NDArray[np.int64]) -> list[str]:
    """Return a note if images are copies of images in other folds; `folds`: (N,) int64."""
    from evaluation.datasets.identity import first_copies

    names = [scene.name for scene in data.scenes]
    separated = [
        f"{names[index]} of {names[original]}"
        for index, original in enumerate(first_copies(data.scenes))
        if folds[index] != folds[original]
    ]
    if not separated:
        return []
    return [
        f"{counted(len(separated), 'image is a copy', 'images are copies')} of images in other folds "
        f"({first_few(separated)}): they are tested on their own training data"
    ]
