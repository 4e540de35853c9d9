"""`evaluate pool`: the results of several transfers as one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from evaluation.commands.options import AngularError, argument
from foundation.console import EXIT_CODES, JsonOutput, option, with_json

HELP = f"""Pool the results of several transfers, such as one for each of several cameras.

Reads results folders that evaluate transfer --out has written. A row of the pool has the errors of one method, trained
in one way, on the test images of all folders, each image once and with the same weight; seed k is seed k of each
folder. Rows are matched by method, kind of training and name of the training set; by the first two alone where each
folder has one training set. Prints the tables of evaluate transfer, and the ratios of each test set by itself; with
--base also every row in parts of one of them, such as the naive images of pictures that nobody chose. Folders that
share a test image are refused. Writes nothing unless asked with --out: results.csv, errors.csv, by_test_set.csv,
tables.tex, report.html with forest plots, and run.json.

{EXIT_CODES}
"""


@with_json("evaluate pool")
def pool(
    results: Annotated[list[str], argument("RESULTS", "Results folders of transfers.")],
    error: Annotated[
        AngularError | None,
        typer.Option(help="Angular error to sum up. \\[default: that of the transfers]", show_default=False),
    ] = None,
    base: Annotated[
        str | None,
        option("TRAINED_ON", "Also hold every row to the one trained on this, named as in the column, with x for ×."),
    ] = None,
    out: Annotated[Path | None, option("FOLDER", "Write the results to this new folder.")] = None,
    *,
    output: JsonOutput,
) -> None:
    """Pool the results of several transfers."""
    from evaluation.experiments.pool import make_tables, pool_transfers, read_transfer, save_pool
    from evaluation.reports.table_output import show_notes, show_tables
    from foundation.errors import InputError
    from foundation.folders import require_free

    if out is not None:
        require_free(out, "the results")
    parts = [read_transfer(place) for place in results]
    kinds = {part.error for part in parts}
    if error is None and len(kinds) > 1:
        raise InputError("the transfers were summed up by different errors; say which with --error")
    chosen = error or parts[0].error
    made = pool_transfers(parts)
    tables = make_tables(made, chosen, base)
    if out is not None:
        save_pool(made, tables, [part.place for part in parts], chosen, out)
    output.add(results=results, error=chosen, base=base)
    show_tables(output, tables.shown, "")
    show_notes(output, made.notes)
