"""`evaluate tune`: parameters of a statistics-based method from the images of a data set, without ground truths."""

from __future__ import annotations

from typing import Annotated

import typer

from evaluation.commands.options import AngularError, Data, Read, image_steps, open_data, thread_option
from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, with_json

FAMILIES_HELP = "shades-of-gray, general-gray-world, gray-edge-1 or gray-edge-2"  # Names for help texts

HELP = f"""Choose parameters of a method without ground truths, by the green stability assumption.

Reads DATA in any layout of evaluate run: images of one camera under many illuminants. Illuminants differ much in red
and blue chromaticity and little in green; the chosen parameters give estimates with the smallest spread in green
(Banić, Lončarić 2018; reconstructed from the publication). FAMILY is {FAMILIES_HELP}.
FAMILY@PIXELS first reduces the longer side of images to this size, for example gray-edge-2@360.

Ground truths do not influence the choice; --errors prints errors for comparison. Prints every setting, the chosen one
first. To evaluate a setting, use evaluate run DATA --method SETTING. Writes no files.

{EXIT_CODES}
"""


@with_json("evaluate tune")
def tune(
    family: Annotated[str, typer.Argument(metavar="FAMILY", help=f"{FAMILIES_HELP}, or one of these with @PIXELS.")],
    data: Data,
    *,
    errors: Annotated[
        AngularError | None,
        typer.Option(help="Print these errors for comparison; they do not influence the choice.", show_default=False),
    ] = None,
    workers: Annotated[int | None, thread_option(", one image each; results do not depend on it")] = None,
    read: Read = None,
    output: JsonOutput,
) -> None:
    """Choose a method's parameters on a data set."""
    from evaluation.experiments.cross_validation import family_settings, tune_family, tuning_table
    from evaluation.reports.table_output import show_notes, show_tables

    family_settings(family)  # An unknown family is refused before a data set is opened.
    data_set = open_data(data, read)
    count, threads = len(data_set.scenes), workers or processor_count()
    with image_steps(count) as step:
        tuned = tune_family(family, data_set.name, data_set.scenes, errors, threads, step)
    show_tables(output, [tuning_table(tuned)])
    best = tuned.settings[0]
    output.add(data_set=data_set.name, images=count, family=family, chosen=best.text, spread=best.spread)
    print(f"chosen: {best.text}, with the smallest spread of estimates in green chromaticity ({best.spread:.5f})")
    print(
        "ground truths: not used for the choice"
        + (", only for the printed errors" if errors else "")
        + "; to evaluate the setting on other images, use --method "
        + best.text
    )
    show_notes(output, [], data_set.treatment)
