"""`evaluate run`: the errors of methods on a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from evaluation.commands.options import (
    Data,
    PrintedError,
    Read,
    choose_estimates,
    choose_methods,
    image_steps,
    open_data,
    split_names,
    thread_option,
)
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json
from foundation.folders import require_free

HELP = f"""Estimate the light of every image of a data set and sum up the errors.

Reads DATA: a dataset made by generate (folder or URL), or a real data set in the layout of its authors. Methods are the
suite's own, classes of yours, trained models, and estimates that any other program has made; with none named, the
seven standard ones. Prints a table in the paper's order: mean, median, trimean, best 25 %, worst 25 % and Avg., their
geometric mean, all in degrees; where several lights fall on images, the errors by pixel and region too; and what was
done to the images. Writes nothing unless asked with --out.

{EXIT_CODES}
"""


@with_json("evaluate run")
def run(
    data: Data,
    method: Annotated[
        list[str] | None,
        option(
            "LIST",
            "Methods, between commas or by giving it more than once. standard: white-patch, gray-world, "
            "shades-of-gray, general-gray-world, gray-edge-1, gray-edge-2, pca. all: these and improved-white-patch, "
            "color-sparrow, local-surface-reflectance, grayness-index, mean-shifted-gray-pixel, opencv-grayworld, of "
            "which some take seconds on large images. With parameters: shades-of-gray:p=4, gray-edge-1:p=4:sigma=2. "
            "MODEL.npz of evaluate train. module:Class, or file.py:Class, of your own. FILE.csv or NAME=FILE.csv: "
            "estimates of another program, columns image,r,g,b. \\[default: standard]",
        ),
    ] = None,
    error: PrintedError = "reproduction",
    out: Annotated[
        Path | None,
        option("RESULTS", "Write everything to this new folder: tables, each image's errors, report.html, LaTeX."),
    ] = None,
    workers: Annotated[
        int | None, thread_option(", one image each; classes of yours are called by one at a time")
    ] = None,
    read: Read = None,
    *,
    output: JsonOutput,
) -> None:
    """Evaluate methods on a data set."""
    from evaluation.experiments.run_folder import run_methods, write_run
    from evaluation.reports.table_output import print_table, show_notes
    from evaluation.results.tables import lights_tables, statistics_rows, summary_table

    names = split_names(method or ["standard"])
    files = [name for name in names if name.endswith(".csv")]
    chosen = choose_methods(name for name in names if name not in files)
    if out is not None:
        require_free(out, "the results")
    found = open_data(data, read)
    given = choose_estimates(files, [scene.name for scene in found.scenes])
    threads = workers or processor_count()
    with image_steps(len(found.scenes)) as step:
        made = run_methods(found, [*chosen, *given], threads, step)
        if out is not None:
            write_run(made, found.scenes, out, error, threads)
    if output.is_requested:
        table = statistics_rows(made.subject, made.results)
        output.add(data_set=made.subject.name, images=len(made.subject.images))
        output.add(errors=[dict(zip(table.columns, row, strict=True)) for row in table.rows])
    else:
        print_table(summary_table(made.subject, made.results, error))
        for table in lights_tables(made.subject, made.results, error):
            print_table(table)
    show_notes(output, made.notes, made.treatment)
