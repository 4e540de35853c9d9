"""Command `sim`: the simulated devices of `sim.cli`, and `sim table`, which computes a look-up table (LUT).

`sim table` uses functions of `calibration`, and writes its LUT format. Therefore it is not in `sim.cli`, which may not
import `calibration` (docs/decisions/0020-a-floor-for-computed-tables.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from foundation.compiled import processor_count
from foundation.console import EXIT_CODES, JsonOutput, orderly_end, progress, with_json
from foundation.errors import ConfigurationError, counted
from sim import cli as devices
from sim.cli import app

if TYPE_CHECKING:
    from sim.world.rendering import Print


def main(argv: Sequence[str] | None = None) -> int:
    """Run `sim` with `argv`, by default the arguments of the process, and return the exit code (`EXIT_CODES`)."""
    return devices.main(argv, read_print)


def read_print(chart: Path) -> Print:
    """Return the printed sheet of a chart.json for the simulated room."""
    from experiment.chart.model import load_chart
    from experiment.chart.printing import drawing
    from sim.world.rendering import Print

    sheet = drawing(load_chart(chart))
    return Print(sheet.page_mm, sheet.rectangles_mm, sheet.rgb)


@app.command(epilog=EXIT_CODES)
@with_json("sim table")
def table(
    out: Annotated[
        Path | None, typer.Argument(metavar="OUT", help="New folder for the LUT; omitted for --camera list.")
    ] = None,
    camera: Annotated[
        str,
        typer.Option(
            help="Spectral sensitivities: a name (Canon_EOS_5DS), a JSON file in the format of rawtoaces, or a camera "
            "of the simulated laboratory (EOS 550D); list prints all names and ends."
        ),
    ] = "Canon_EOS_600D",
    lights: Annotated[
        str | None,
        typer.Option(
            help="CSV file with columns of wavelengths and spectra, or published spectra: D65,A,FL2,cie-led,"
            "5600K,2000:10000:200K,daylight:4000:10000:500; by default the 707 illuminants of the simulated projector."
        ),
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="TOML file with settings of camera, exposure, room, chart, seed and citation.")
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Compute a look-up table (LUT) from spectra and the noise model of the sensor, without frames.

    Reads the sensitivities, the spectra of the illuminants and the settings. Writes OUT/samples.npy, illuminations.csv,
    references.csv and lut.json, which records that the LUT was computed. generate can use this LUT like a LUT of
    build-lut. The calculation takes minutes.
    """
    if camera == "list":
        _list_cameras(output)
        return
    if out is None:
        raise ConfigurationError("OUT is missing, expected a new folder for the LUT; run sim table OUT --camera NAME")
    from synthesis.lamps import read_lights
    from synthesis.settings import load_settings, table_task
    from synthesis.table import compute_table

    spectra = None if lights is None else read_lights(lights)
    task = table_task(camera, load_settings(settings), str(settings or "the command line"), spectra)
    with orderly_end(), progress("lights") as report:
        result = compute_table(task, out, processor_count(), report)
    output.add(table=out, lights=result.lights, colours=result.cells, samples=task.window**2, unfit=result.unfit)
    print(
        f"{out}: computed, {result.lights} illuminants, {result.cells} colours, {task.window**2} samples each; "
        f"{counted(result.unfit, 'unfit patch', 'unfit patches')}"
    )


def _list_cameras(output: JsonOutput) -> None:
    from sim.spectral import known_sensitivities, read_sensitivities
    from sim.world.sensors import BODIES

    measured = [(name, read_sensitivities(name).camera, "measured, rawtoaces-data") for name in known_sensitivities()]
    simulated = [(name, body.camera, f"simulated with {body.sensitivities}") for name, body in BODIES.items()]
    rows = [("name", "camera", "source"), *measured, *simulated]
    output.add(cameras=[dict(zip(rows[0], row, strict=True)) for row in rows[1:]])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
    print("A JSON file of spectral sensitivities can be given instead of a name.")


if __name__ == "__main__":
    raise SystemExit(main())
