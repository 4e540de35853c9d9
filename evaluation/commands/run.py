"""`evaluate run`: the errors of methods on a data set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from evaluation.commands.options import (
    METHOD_HELP,
    Data,
    DataReading,
    PrintedError,
    PrintedStatistics,
    choose_estimates,
    choose_methods,
    thread_option,
)
from foundation.console import EXIT_CODES, JsonOutput, grouped, option, with_json

HELP = f"""Estimate the light of every image of a data set and sum up the errors.

Reads DATA: a dataset made by generate (folder or URL), or a real data set in the layout of its authors. Methods are the
suite's own, classes of yours, trained models, and estimates that any other program has made; with none named, the
seven standard ones. Prints a table in the paper's order: mean, median, trimean, best 25 %, worst 25 % and Avg., their
geometric mean, all in degrees; where several lights fall on images, the errors by pixel and region too; and what was
done to the images. Writes nothing unless asked with --out, --csv or --images.

A run with --out that was stopped goes on when the same command is given again.

{EXIT_CODES}
"""


@with_json("evaluate run")
@grouped
def run(
    data: Data,
    method: Annotated[list[str] | None, option("METHOD", METHOD_HELP)] = None,
    methods: Annotated[
        str | None,
        option(
            "LIST",
            "Methods between commas. standard: white-patch, gray-world, shades-of-gray, general-gray-world, "
            "gray-edge-1, gray-edge-2, pca. all: these and improved-white-patch, color-sparrow, "
            "local-surface-reflectance, grayness-index, mean-shifted-gray-pixel, opencv-grayworld, of which some take "
            "seconds on large images. \\[default: standard, unless --method or --estimates is given]",
        ),
    ] = None,
    estimates: Annotated[
        list[str] | None,
        option(
            "FILE.csv",
            "Estimates of another program: columns image,r,g,b, a line an image. NAME=FILE.csv names them in the "
            "tables. Give it more than once for several.",
        ),
    ] = None,
    error: PrintedError = "reproduction",
    statistics: PrintedStatistics = "paper",
    out: Annotated[
        Path | None,
        option("RESULTS", "Write everything to this new folder: tables, each image's errors, report.html, LaTeX."),
    ] = None,
    csv: Annotated[Path | None, option("OUT.csv", "Write the table to this new file too.")] = None,
    images: Annotated[
        Path | None, option("OUT.csv", "Write each image's estimates and errors to this new file.")
    ] = None,
    workers: Annotated[
        int | None, thread_option(", one image each; classes of yours are called by one at a time")
    ] = None,
    *,
    reading: DataReading,
    output: JsonOutput,
) -> None:
    """Evaluate methods on a data set."""
    from evaluation.experiments.run_folder import run_methods
    from evaluation.reports.table_output import print_table, show_notes
    from evaluation.results.result import images_csv, table_csv
    from evaluation.results.tables import lights_tables, statistics_rows, summary_table
    from foundation.compiled import processor_count
    from foundation.console import orderly_end, progress
    from foundation.files import write_whole

    listed = [text.strip() for text in methods.split(",")] if methods is not None else []
    if methods is None and not method and not estimates:
        listed = ["standard"]
    chosen = choose_methods([*listed, *(method or [])])
    _require_free(csv, images, out)
    found = reading.open(data)
    given = choose_estimates(estimates or [], [scene.name for scene in found.scenes])
    with orderly_end(), progress("images") as advance:
        made = run_methods(found, [*chosen, *given], out, error, workers or processor_count(), advance)
    if csv is not None:
        write_whole(csv, table_csv(made.results, error))
    if images is not None:
        write_whole(images, images_csv(found.scenes, made.results))
    if output.asked:
        table = statistics_rows(made.subject, made.results)
        output.add(data_set=made.subject.name, images=len(made.subject.images))
        output.add(errors=[dict(zip(table.columns, row, strict=True)) for row in table.rows])
    else:
        print_table(summary_table(made.subject, made.results, error, statistics == "all"))
        for table in lights_tables(made.subject, made.results, error):
            print_table(table)
    show_notes(output, made.notes, made.treatment)


def _require_free(csv: Path | None, images: Path | None, out: Path | None) -> None:
    from foundation.errors import InputError
    from foundation.folders import require_free, require_free_file

    for path, what in ((csv, "the table"), (images, "the images' errors")):
        if path is not None:
            require_free_file(path, what)
    if csv is not None and images is not None and os.path.realpath(csv) == os.path.realpath(images):
        raise InputError(f"--csv and --images are both {images}; give each a file of its own")
    if out is not None:
        require_free(out, "the results")
        for path in (csv, images):
            if path is not None and Path(os.path.realpath(path)).is_relative_to(os.path.realpath(out)):
                raise InputError(f"{path} lies in {out}, which --out makes and fills; name a place outside")
