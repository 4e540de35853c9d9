"""`sim`: simulated devices on real cables, and tables computed without any. Parse, build, call, print; nothing else.

The devices are `sim.cli`'s; a table needs calibration's functions and format besides, so the command stands above both
(docs/decisions/0020-a-floor-for-computed-tables.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from foundation import console
from foundation.console import EXIT_CODES, orderly_end
from sim.cli import app


def main(argv: Sequence[str] | None = None) -> int:
    """Run `sim` with these arguments, or those of the process, and return the exit code (`EXIT_CODES`)."""
    return console.run(lambda: app(args=argv, prog_name="sim"))


@app.command(epilog=EXIT_CODES)
def table(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="New folder for the table.")],
    camera: Annotated[
        str,
        typer.Option(
            help="Spectral sensitivities: a name (Canon_EOS_5DS) or a JSON file of rawtoaces' layout; or a body of the "
            "simulated lab (EOS 550D)."
        ),
    ] = "Canon_EOS_600D",
    settings: Annotated[
        Path | None, typer.Option(help="TOML file with facts of the body, exposure, room, chart; defaults else.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of response and noise, in place of the settings'.")] = None,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Lights computed at a time; by default one a processor.")
    ] = None,
) -> None:
    """Compute a whole table from spectra and the sensor's noise model, without a frame.

    Reads the sensitivities and the settings. Writes OUT/samples.npy, illuminations.csv, references.csv and lut.json,
    which says that the table was computed: a table for generate like one that build-lut makes of a session in the
    simulated lab, in minutes.
    """
    from foundation.processors import processor_count
    from synthesis.settings import load_settings
    from synthesis.table import compute_table
    from synthesis.tasks import table_task

    given = load_settings(settings)
    if seed is not None:
        given = given.model_copy(update={"seed": seed})
    task = table_task(camera, given, str(settings or "the settings"))
    with orderly_end():
        done = compute_table(task, out, threads or processor_count())
    print(
        f"{out}: computed, {done.lights} lights, {done.cells} colours, {task.window**2} samples each; "
        f"{done.unfit} cells unfit for use"
    )


if __name__ == "__main__":
    raise SystemExit(main())
