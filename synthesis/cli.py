"""`sim`: simulated devices on real cables, and tables computed without any. Parse, build, call, print; nothing else.

The devices are `sim.cli`'s; a table needs calibration's functions and format besides, so the command stands above both
(docs/decisions/0020-a-floor-for-computed-tables.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from foundation.console import EXIT_CODES, JsonOutput, Licence, Note, option, orderly_end, progress, with_json
from sim import cli as devices
from sim.cli import app

if TYPE_CHECKING:
    from sim.world.rendering import Print


def main(argv: Sequence[str] | None = None) -> int:
    """Run `sim` with these arguments, or those of the process, and return the exit code (`EXIT_CODES`)."""
    return devices.main(argv, read_print)


def read_print(chart: Path) -> Print:
    """Return the print of a chart.json, as the simulated room hangs it up."""
    from experiment.chart.model import load_chart
    from experiment.chart.printing import drawing
    from sim.world.rendering import Print

    drawn = drawing(load_chart(chart))
    return Print(drawn.page_mm, drawn.rectangles_mm, drawn.rgb)


@app.command(epilog=EXIT_CODES)
@with_json("sim table")
def table(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the table.")],
    camera: Annotated[
        str,
        typer.Option(
            help="Spectral sensitivities: a name (Canon_EOS_5DS) or a JSON file of rawtoaces' layout; or a body of the "
            "simulated lab (EOS 550D)."
        ),
    ] = "Canon_EOS_600D",
    lights: Annotated[
        str | None,
        typer.Option(
            help="CSV of spectra (wavelength, then a column each), or published ones: D65,A,FL2,cie-led,5600K,"
            "2000:10000:200K,daylight:4000:10000:500; else the 707 lights of the simulated projector."
        ),
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="TOML file with facts of the body, exposure, room, chart; defaults else.")
    ] = None,
    profile: Annotated[
        str | None,
        typer.Option("--print", help="The print: unmanaged (codes are ink codes) or managed (a shop's profile)."),
    ] = None,
    paper: Annotated[str | None, typer.Option(help="Paper and its inks: poster, matt or glossy.")] = None,
    hot: Annotated[
        float | None, typer.Option(min=0, help="Hot photosites of a million, which every frame has; none else.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of response and noise, in place of the settings'.")] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Lights computed at a time; by default one a processor.")
    ] = None,
    note: Note = None,
    licence: Licence = None,
    author: Annotated[
        list[str] | None,
        option('"FAMILY, GIVEN"', "Who made the table; several times for several."),
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Compute a whole table from spectra and the sensor's noise model, without a frame.

    Reads the sensitivities, the spectra of lights and the settings. Writes OUT/samples.npy, illuminations.csv,
    references.csv and lut.json, which says that the table was computed, and what is given of note, licence and authors.
    It is a table for generate like one that build-lut makes of a session in the simulated lab, in minutes. Options come
    before what the settings say.
    """
    from foundation.compiled import processor_count
    from synthesis.lamps import read_lights
    from synthesis.settings import load_settings, stated_by_hand, table_task
    from synthesis.table import compute_table

    changes = {"profile": profile, "paper": paper, "hot_per_million": hot}
    given = load_settings(settings).changed(seed, {name: value for name, value in changes.items() if value is not None})
    origin = stated_by_hand(note, licence, author or [])
    spectra = None if lights is None else read_lights(lights)
    task = replace(table_task(camera, given, str(settings or "the command line"), spectra), origin=origin)
    with orderly_end(), progress("lights") as shown:
        done = compute_table(task, out, threads or processor_count(), shown)
    output.add(table=out, lights=done.lights, colours=done.cells, samples=task.window**2, unfit=done.unfit)
    print(
        f"{out}: computed, {done.lights} lights, {done.cells} colours, {task.window**2} samples each; "
        f"{done.unfit} cells unfit for use"
    )


if __name__ == "__main__":
    raise SystemExit(main())
