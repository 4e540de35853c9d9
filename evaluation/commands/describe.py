"""`evaluate describe`: what a data set is made of, beside another."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from evaluation.commands.options import DataReading, argument, image_steps, thread_option
from foundation.console import EXIT_CODES, JsonOutput, grouped, option, with_json

if TYPE_CHECKING:
    from evaluation.experiments.describing.description import DataDescription

HELP = f"""Describe the images and lights of a data set, and hold them beside another's: how real is what was generated.

Reads DATA, a data set of any layout that evaluate run reads, or a STATS.json written by --out. Figures: luminance
percentiles, exposure, clipping, chroma spread, near-grey share, grey-world offsets, edges, noise, and the distribution
of the lights. Scenes are seen at 64 x 64 cells at most and with the light divided out, so sets of different sizes and
units compare. Masked and clipped pixels are left out. The options of reading are DATA's, the --against ones the other
set's; where that needs levels of its own, write its STATS.json first and give that to --against.

Prints tables, and with --against one sentence for each figure: within 25 % or not. Writes nothing unless asked with
--out or --report.

{EXIT_CODES}
"""


@with_json("evaluate describe")
@grouped
def describe(
    data: Annotated[str, argument("DATA", "Folder, file or URL of it, or a STATS.json.")],
    against: Annotated[str | None, option("DATA", "Data set, or STATS.json, to hold it beside.")] = None,
    out: Annotated[Path | None, option("STATS.json", "Write DATA's description to this new file.")] = None,
    report: Annotated[Path | None, option("PAGE.html", "Write a page with figures to this new file.")] = None,
    against_layout: Annotated[str | None, option("NAME", "Layout of the data set beside it.")] = None,
    against_camera: Annotated[str | None, option("NAME", "Camera of the data set beside it.")] = None,
    against_subset: Annotated[str | None, option("NAME", "Part of the data set beside it.")] = None,
    against_truth: Annotated[str | None, option("NAME", "Ground truth of the data set beside it.")] = None,
    against_partial: Annotated[
        bool, typer.Option("--against-partial", help="Take what is there of the data set beside it.")
    ] = False,
    cells: Annotated[int, typer.Option(help="Cells a side that images are reduced to; 0: none.", min=0)] = 64,
    seed: Annotated[int, typer.Option(help="Of the bootstrap.", min=0)] = 0,
    workers: Annotated[int | None, thread_option()] = None,
    *,
    reading: DataReading,
    output: JsonOutput,
) -> None:
    """Describe a data set."""
    from dataclasses import replace

    from evaluation.experiments.describing import report as reporting
    from evaluation.experiments.describing.description import statistics_to_json
    from evaluation.experiments.describing.report import compare_figures, sentence
    from evaluation.reports.table_output import show_notes, show_tables
    from foundation.compiled import processor_count
    from foundation.errors import InputError
    from foundation.files import write_whole
    from foundation.folders import require_free_file

    for path, what in ((out, "the statistics"), (report, "the page")):
        if path is not None:
            require_free_file(path, what)
    threads = workers or processor_count()
    beside = DataReading(against_layout, against_camera, against_subset, against_truth, partial=against_partial)
    if against is None and beside != DataReading():
        raise InputError(
            "options of --against are given, but no data set beside DATA; add --against, or leave them out"
        )
    one = _described(data, reading, cells, threads)
    other = None if against is None else _described(against, beside, cells, threads)
    if other is not None and one.name == other.name:
        one, other = (replace(made, name=f"{made.name} ({place})") for made, place in ((one, data), (other, against)))
    if out is not None:
        write_whole(out, statistics_to_json(one))
    if report is not None:
        write_whole(report, reporting.describe_page(one, other, seed))
    output.add(data_sets=[one.name] if other is None else [one.name, other.name])
    if other is None:
        show_tables(output, [reporting.figures_table(one)])
    show_tables(output, [reporting.lights_table([one] if other is None else [one, other])])
    if other is not None:
        show_notes(output, list(reporting.seen_notes(one, other)))
        compared = compare_figures(one, other, seed)
        show_tables(output, list(reporting.compared_tables(compared, (one.name, other.name))))
        output.add(sentences=[sentence(made, (one.name, other.name)) for made in compared])
        for made in compared:
            print(sentence(made, (one.name, other.name)))


def _described(place: str, reading: DataReading, cells: int, workers: int) -> DataDescription:
    from evaluation.experiments.describing.description import describe, read_statistics
    from foundation.errors import InputError

    if reading.layout is None and place.endswith(".json") and Path(place).is_file():
        if reading != DataReading():
            raise InputError(
                f"{place} is a description, whose images were read already, so --{reading.options.given[0]} has no "
                "meaning for it; leave the option out, or name the data set"
            )
        return read_statistics(place)
    data = reading.open(place)
    with image_steps(len(data.scenes)) as step:
        return describe(data, cells, workers, step)
