"""`sim`: simulated devices on real cables, and tables computed without any. Parse, build, call, print; nothing else.

The devices are `sim.cli`'s; a table needs calibration's functions and format besides, so the command stands above both
(docs/decisions/0020-a-floor-for-computed-tables.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, orderly_end, progress, with_json
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
        Path | None, typer.Option(help="TOML file: body, exposure, room with paper and print, chart, seed, citation.")
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Compute a whole table from spectra and the sensor's noise model, without a frame.

    Reads the sensitivities, the spectra of lights and the settings. Writes OUT/samples.npy, illuminations.csv,
    references.csv and lut.json, which records that the table was computed. It is a table for generate like one that
    build-lut makes of a session in the simulated lab, in minutes.
    """
    from synthesis.lamps import read_lights
    from synthesis.settings import load_settings, table_task
    from synthesis.table import compute_table

    spectra = None if lights is None else read_lights(lights)
    task = table_task(camera, load_settings(settings), str(settings or "the command line"), spectra)
    with orderly_end(), progress("lights") as shown:
        done = compute_table(task, out, processor_count(), shown)
    output.add(table=out, lights=done.lights, colours=done.cells, samples=task.window**2, unfit=done.unfit)
    print(
        f"{out}: computed, {done.lights} lights, {done.cells} colours, {task.window**2} samples each; "
        f"{done.unfit} cells unfit for use"
    )


if __name__ == "__main__":
    raise SystemExit(main())
