"""`evaluate run`: the errors of methods on a data set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from foundation.console import EXIT_CODES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from evaluation.methods.method import Method
    from evaluation.metrics import ErrorKind
    from evaluation.results.result import Result

_CAUSES = "too small for it, clipped, black or even"
"""Why an image has no usable pixel for a method."""

_WIDE = 10_000
"""Columns of a terminal that no table of methods fills: the table is measured as wide as it likes to be."""

HELP = f"""Estimate the light of every image of a dataset and sum up the errors.

Reads DATASET, a folder or a URL (made by generate). Prints a table in the paper's order: mean, median, trimean, best
25 %, worst 25 % and Avg., their geometric mean, all in degrees. Writes nothing unless asked with --csv or --images.

{EXIT_CODES}
"""


def run(
    dataset: Annotated[
        str, typer.Argument(metavar="DATASET", help="Folder of the dataset, or its URL.", show_default=False)
    ],
    layout: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Layout of the data set. \\[default: by what it looks like]", show_default=False
        ),
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            metavar="LIST",
            help="Methods between commas, or all: white-patch, gray-world, shades-of-gray, general-gray-world, "
            "gray-edge-1, gray-edge-2, pca.",
        ),
    ] = "all",
    error: Annotated[
        Literal["reproduction", "recovery"], typer.Option(help="Angular error to sum up.")
    ] = "reproduction",
    csv: Annotated[
        Path | None, typer.Option(metavar="OUT.csv", help="Write the table to this new file too.", show_default=False)
    ] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.csv", help="Write each image's estimates and errors to this new file.", show_default=False
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(metavar="N", help="Threads. \\[default: one a processor]", min=1, show_default=False),
    ] = None,
) -> None:
    """Evaluate methods on a data set."""
    from rich.console import Console
    from rich.progress import Progress

    from evaluation.datasets import open_scenes
    from evaluation.experiments.running import evaluate
    from evaluation.results.result import images_csv, table_csv
    from foundation.files import write_whole
    from foundation.processors import processor_count

    chosen = _choose(methods)
    _require_free(csv, images)
    data = open_scenes(dataset, layout)
    scenes = data.scenes
    with Progress(console=Console(stderr=True)) as progress:
        task = progress.add_task("images", total=len(scenes))
        results = evaluate(scenes, chosen, workers or processor_count(), lambda: progress.advance(task))
    print(f"{data.name}: {error} angular error of {len(scenes)} images, degrees")
    _print_table(results, error)
    for result in results:
        if result.guessed.any():
            counted = f"{result.guessed.sum()} of {len(scenes)} images"
            print(f"{result.method}: no usable pixel in {counted} ({_CAUSES}); their light was taken to be grey")
    if csv is not None:
        write_whole(csv, table_csv(results, error))
    if images is not None:
        write_whole(images, images_csv(scenes, results))


def _require_free(csv: Path | None, images: Path | None) -> None:
    from foundation.errors import InputError
    from foundation.files import require_free_file

    for path, what in ((csv, "the table"), (images, "the images' errors")):
        if path is not None:
            require_free_file(path, what)
    if csv is not None and images is not None and os.path.realpath(csv) == os.path.realpath(images):
        raise InputError(f"--csv and --images are both {images}; give each a file of its own")


def _print_table(results: Sequence[Result], error: ErrorKind) -> None:
    """Print the summaries; in a narrow terminal names are folded, numbers never cut."""
    from rich.console import Console
    from rich.table import Table

    longest_word = max(len(word) for result in results for word in result.method.split())
    table = Table()
    table.add_column("Algorithm", min_width=longest_word)
    for column in ("Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg."):
        table.add_column(column, justify="right", no_wrap=True, min_width=len(column))
    for result in results:
        table.add_row(result.method, *(f"{number:.2f}" for number in result.summary(error).as_tuple()))
    console = Console()
    needed = Console(width=_WIDE).measure(table)
    # A file or pipe has no width, but rich would take that of the terminal on stdin or stderr.
    console.width = max(console.width, needed.minimum) if console.is_terminal else needed.maximum
    console.print(table)


def _choose(text: str) -> list[Method]:
    from evaluation.methods.standard import standard_methods
    from foundation.errors import InputError

    known = standard_methods()
    if text.strip().lower() == "all":
        return list(known.values())
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            raise InputError(f"{name!r} is no method; the methods are {', '.join(known)}, or all")
    return [known[name] for name in dict.fromkeys(names)]
