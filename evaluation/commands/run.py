"""`evaluate run`: errors of methods on a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from evaluation.commands.options import (
    Data,
    Figures,
    PrintedError,
    Read,
    choose_estimates,
    choose_methods,
    image_steps,
    open_data,
    require_results_folder,
    split_names,
    thread_option,
)
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, option, with_json

HELP = f"""Estimate the illuminant of every image of a data set and summarise the errors.

Reads DATA: a data set made by generate (folder or URL), or a real data set in its published layout. A method belongs
to this suite, or is your own class, a trained model, or a file with estimates of another program; by default the seven
standard methods are used. Prints mean, median, trimean, best 25 %, worst 25 %, Avg. (their geometric mean) and
worst 5 % in degrees. With several illuminants in an image also prints errors by pixel and region. Prints how the
images were treated. Writes files only with --out.

{EXIT_CODES}
"""


@with_json("evaluate run")
def run(
    data: Data,
    method: Annotated[
        list[str] | None,
        option(
            "LIST",
            "Methods, separated by commas or in repeated options. standard: white-patch, gray-world, "
            "shades-of-gray, general-gray-world, gray-edge-1, gray-edge-2, pca. all: these and improved-white-patch, "
            "color-sparrow, local-surface-reflectance, grayness-index, mean-shifted-gray-pixel, opencv-grayworld; some "
            "take seconds on large images. With parameters: shades-of-gray:p=4, gray-edge-1:p=4:sigma=2. MODEL.npz of "
            "evaluate train. Your own module:Class or file.py:Class. FILE.csv or NAME=FILE.csv: estimates of another "
            "program with the columns image,r,g,b. \\[default: standard]",
        ),
    ] = None,
    error: PrintedError = "reproduction",
    out: Annotated[
        Path | None,
        option("RESULTS", "Write tables, the errors of all images, report.html and LaTeX to this new folder."),
    ] = None,
    figures: Figures = None,
    workers: Annotated[
        int | None, thread_option(", one image each; your own classes run in one thread at a time")
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
    methods = choose_methods(name for name in names if name not in files)
    require_results_folder(out, "the results", figures)
    data_set = open_data(data, read)
    estimates = choose_estimates(files, [scene.name for scene in data_set.scenes])
    threads = workers or processor_count()
    with image_steps(len(data_set.scenes)) as step:
        result_run = run_methods(data_set, [*methods, *estimates], threads, step)
        if out is not None:
            write_run(result_run, data_set.scenes, out, error, threads, figures)
    if output.is_requested:
        table = statistics_rows(result_run.subject, result_run.results)
        output.add(data_set=result_run.subject.name, images=len(result_run.subject.images))
        output.add(errors=[dict(zip(table.columns, row, strict=True)) for row in table.rows])
    else:
        print_table(summary_table(result_run.subject, result_run.results, error))
        for table in lights_tables(result_run.subject, result_run.results, error):
            print_table(table)
    show_notes(output, result_run.notes, result_run.treatment)
