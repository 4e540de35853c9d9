"""`evaluate tune`: parameters of a statistics method for the images of a data set, without their ground truths."""

from __future__ import annotations

from typing import Annotated

import typer

from evaluation.commands.options import AngularError, Data, Read, image_steps, open_data, thread_option
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, with_json

FAMILIES_HELP = "shades-of-gray, general-gray-world, gray-edge-1 or gray-edge-2"  # The families, for the help

HELP = f"""Choose a method's parameters on images whose lights nobody knows, by the green stability assumption.

Reads DATA, a data set of any layout that evaluate run reads: images of one camera under many lights. Lights differ much
in red and blue chromaticity and little in green, so the parameters are taken whose estimates spread least in green
(Banić, Lončarić 2018; a reconstruction). FAMILY is {FAMILIES_HELP}; with @PIXELS behind it on images shrunk to that
size: gray-edge-2@360.

Ground truths have no part in the choice; --errors shows errors beside it. Prints every setting, the chosen one first;
evaluate run DATA --method SETTING evaluates one. Writes nothing.

{EXIT_CODES}
"""


@with_json("evaluate tune")
def tune(
    family: Annotated[str, typer.Argument(metavar="FAMILY", help=f"{FAMILIES_HELP}, or one of these with @PIXELS.")],
    data: Data,
    *,
    errors: Annotated[
        AngularError | None,
        typer.Option(help="Show these errors beside the criterion; the choice stays without them.", show_default=False),
    ] = None,
    workers: Annotated[int | None, thread_option(", one image each; no number depends on it")] = None,
    read: Read = None,
    output: JsonOutput,
) -> None:
    """Choose a method's parameters on a data set."""
    from evaluation.experiments.cross_validation import family_settings, tune_family, tuning_table
    from evaluation.reports.table_output import show_notes, show_tables

    family_settings(family)  # A family that is none is told before a data set is opened.
    found = open_data(data, read)
    count, threads = len(found.scenes), workers or processor_count()
    with image_steps(count) as step:
        tuned = tune_family(family, found.name, found.scenes, errors, threads, step)
    show_tables(output, [tuning_table(tuned)])
    best = tuned.settings[0]
    output.add(data_set=found.name, images=count, family=family, chosen=best.text, spread=best.spread)
    print(f"chosen: {best.text}, whose estimates spread least in green chromaticity ({best.spread:.5f})")
    print(
        "ground truths: not used for the choice"
        + (", shown beside it only" if errors else "")
        + "; on other images the setting is evaluated as --method "
        + best.text
    )
    show_notes(output, [], found.treatment)
