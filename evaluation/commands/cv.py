"""`evaluate cv`: learned methods on a data set, each image estimated by a model that has not seen it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evaluation.commands.options import (
    Data,
    PrintedError,
    Read,
    argument,
    choose_beside_constant,
    image_steps,
    open_data,
    split_names,
    thread_option,
)
from evaluation.commands.train import LEARNERS_HELP
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, orderly_end, with_json
from foundation.errors import counted, first_of
from foundation.folders import require_free

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from evaluation.scene import SceneSet

HELP = f"""Cross-validate methods that learn: train on all folds but one and estimate the images of that one, for each.

METHOD is {LEARNERS_HELP}, all, or a class of your own with fit(scenes, seed), as module:Class or file.py:Class; several
stand between commas. The constant light, the median of the training lights, always stands beside them: a method that
does not beat it has learned nothing from images. Images of one group, such as one picture under several lights, stay
in one fold.

Reads DATA, a data set of any layout that evaluate run reads. Folds are the data set's own where its authors made some,
else three that --seed draws; --folds takes a number of folds to draw, or a CSV file with the columns image,fold. Prints
the table of evaluate run; writes nothing unless asked: --out writes the results folder of evaluate run with folds.csv.

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
            "Number of folds to draw, or a file with the columns image,fold. \\[default: the data's own, or 3]",
        ),
    ] = None,
    seed: Annotated[int, option("N", "Of the folds and of all that is random in the training.", min=0)] = 0,
    error: PrintedError = "reproduction",
    out: Annotated[Path | None, option("RESULTS", "Write everything to this new folder.")] = None,
    workers: Annotated[int | None, thread_option(" that read images; no number depends on it")] = None,
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

    others, left_out = choose_beside_constant(split_names([method]))
    learners = [ConstantLight(), *others]
    if out is not None:
        require_free(out, "the results")
    found = open_data(data, read)
    parts, origin = choose_folds(found, folds, seed)
    count, threads = len(found.scenes), workers or processor_count()
    with orderly_end():
        with image_steps(count) as step:
            results = cross_validate(found.scenes, learners, parts, seed, threads, step)
        notes = (
            f"cross-validated in {len(set(parts.tolist()))} folds, {origin}; seed {seed}",
            *left_out,
            *_parted_copies(found, parts),
            *indistinct_methods(results, found.truth_uncertainty_deg),
        )
        described = [describe_method(learner) for learner in learners]
        made = describe_run(found, results, described, {"seed": seed, "folds": origin}, parts, notes)
        if out is not None:
            write_run(made, found.scenes, out, error, threads)
    output.add(data_set=found.name, images=count, folds=len(set(parts.tolist())), seed=seed, error=error)
    show_tables(output, [summary_table(made.subject, results, error, output.asked)])
    show_notes(output, made.notes, made.treatment)


def _parted_copies(data: SceneSet, folds: npt.NDArray[np.int64]) -> list[str]:
    """Return a sentence where images (N,) int64 by their folds are copies of images of other folds."""
    from evaluation.datasets.identity import first_copies

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
