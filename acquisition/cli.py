"""`acquire`: design the experiment, take it, and show how far it is. Parse, build, call, print; nothing else."""

from __future__ import annotations

import shlex
import sys
from collections import Counter
from collections.abc import Sequence
from datetime import UTC, datetime
from enum import Enum
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from foundation import console
from foundation.console import (
    EXIT_CODES,
    JsonOutput,
    new_app,
    option,
    orderly_end,
    progress,
    with_json,
)
from foundation.errors import DeviceError, InputError, QualityError, StorageError, counted, first_of
from foundation.files import make_folder, write_whole
from foundation.folders import held_folder, require_free, whole_folder

if TYPE_CHECKING:
    from experiment.config import LabSettings

app = new_app(
    "Plan, print and take a session: a chart photographed raw under many known lights.\n\n" + EXIT_CODES,
    no_args_is_help=True,
)


class Arrangement(Enum):
    """How the colours lie on the sheet."""

    TAGGED = "tagged"
    PAPER = "paper"


class Rig(Enum):
    """What a lab that is begun consists of."""

    LAB = "lab"
    SIMULATED = "simulated"


def main(argv: Sequence[str] | None = None) -> int:
    """Run `acquire` with these arguments, or those of the process, and return the exit code (`EXIT_CODES`)."""
    return console.run(lambda: app(args=argv, prog_name="acquire"))


@app.command(epilog=EXIT_CODES)
def init(
    lab: Annotated[Path, typer.Argument(metavar="LAB", help="Folder of the lab; made if it is not there.")],
    rig: Annotated[
        Rig, typer.Option(help="lab: camera and projector, to be named in LAB.toml; simulated: no hardware.")
    ] = Rig.LAB,
) -> None:
    """Begin a lab: a commented LAB.toml, the chart to print and the 707 lights.

    Reads no file. Writes LAB/LAB.toml, chart/ (as acquire chart does, without the TIFF) and illuminations.csv (as
    acquire illuminations does). A chart or lights that are there already stay as they are; a LAB.toml that is there
    is an error.
    """
    settings, print_folder, lights = lab / "LAB.toml", lab / "chart", lab / "illuminations.csv"
    require_free(settings, "the settings")
    make_folder(lab, lab)
    if not (print_folder / "chart.json").exists():
        chart(print_folder, tiff=False)
    if not lights.exists():
        illuminations(lights)
    write_whole(settings, files("acquisition").joinpath("data", f"{rig.value}.toml").read_text("utf-8"))
    then = "name your devices in it" if rig is Rig.LAB else "change it as you like"
    print(f"{settings}: {then}, then: acquire check {shlex.quote(str(settings))}")


@app.command(epilog=EXIT_CODES)
@with_json("acquire chart")
def chart(
    out: Annotated[
        Path, typer.Argument(help="New folder for chart.json, chart.tif, chart.pdf and what goes with them.")
    ],
    bits: Annotated[int, typer.Option(min=1, max=5, help="Bits kept of each channel; 5 gives 32 768 colours.")] = 5,
    page: Annotated[
        str | None,
        typer.Option(help="Paper, landscape: A0 … A8, or WIDTHxHEIGHT in mm; else the smallest that fits."),
    ] = None,
    arrangement: Annotated[
        Arrangement,
        typer.Option(help="tagged: random order, tags and references; paper: the paper's 256 × 128 grid without tags."),
    ] = Arrangement.TAGGED,
    tiff: Annotated[bool, typer.Option(help="Write the 600-dpi TIFF.")] = True,
    tagged_tiff: Annotated[
        bool,
        typer.Option("--tagged-tiff", help="Write chart-srgb.tif too, tagged as sRGB, to print through a profile."),
    ] = False,
    *,
    output: JsonOutput,
) -> None:
    """Make the print: every colour once, AprilTags and achromatic references, at true size.

    Reads no file. Writes OUT/chart.json (what calibration reads), chart.pdf (vector, PDF/X-4), chart.tif (600 dpi),
    preview.png, proof.pdf (an A4 page to try the printer with) and PRINTING.txt. Print the PDF or the TIFF with the
    printer's colour management off, at 100 %, on matte paper. A line on stderr warns when cells are too small for the
    paper's cameras.
    """
    from experiment.chart.layout import design_chart, paper_chart
    from experiment.chart.printing import save_pdf, save_preview, save_tiff
    from experiment.chart.proof import save_instructions, save_proof
    from experiment.framing.finding import small_parts_warning

    design = paper_chart(_page(page), bits) if arrangement is Arrangement.PAPER else design_chart(bits, _page(page))
    with whole_folder(out, "the chart") as folder:
        save_preview(design, folder / "preview.png")
        save_pdf(design, folder / "chart.pdf")
        if tiff:
            save_tiff(design, folder / "chart.tif")
        if tagged_tiff:
            save_tiff(design, folder / "chart-srgb.tif", tagged=True)
        save_proof(design, folder / "proof.pdf")
        save_instructions(design, folder / "PRINTING.txt", tiff)
        design.save(folder / "chart.json")
    width, height = design.page_mm
    cell = " × ".join(dict.fromkeys(f"{side:.2f}" for side in design.cell_mm))
    print(
        f"{out}: {design.colour_count} colours, {len(design.tags)} tags, {len(design.references)} references "
        f"on {width:g} × {height:g} mm, cells of {cell} mm"
    )
    small = small_parts_warning(design)
    output.add(
        folder=out,
        colours=design.colour_count,
        tags=len(design.tags),
        references=len(design.references),
        page_mm=design.page_mm,
        cell_mm=design.cell_mm,
        chart_sha256=design.sha256,
        warning=small,
    )
    if small is not None:
        print(f"warning: {small}", file=sys.stderr)


def _page(text: str | None) -> str | tuple[float, float] | None:
    try:
        width, height = (float(part) for part in (text or "").lower().split("x"))
    except ValueError:
        return text
    return width, height


@app.command(epilog=EXIT_CODES)
@with_json("acquire illuminations")
def illuminations(
    out: Annotated[Path, typer.Argument(help="New CSV file; a plot of the lights is written beside it as .png.")],
    grid: Annotated[int, typer.Option(min=0, max=200, help="Steps along an edge of the chromaticity triangle.")] = 35,
    blackbodies: Annotated[
        str, typer.Option(help="Black bodies as FIRST:LAST:STEP in kelvin, or a list K,K,…; empty for none.")
    ] = "2000:10000:200",
    *,
    output: JsonOutput,
) -> None:
    """Make the lights: uniformly spread chromaticities and black bodies; 707 by default.

    Reads no file. Writes OUT (index, kind, cct_k, red, green, blue) and a plot of the rb-chromaticities beside it.
    """
    from experiment.lights import parse_ccts, plan_illuminations, plot_illuminations, save_illuminations

    plot = out.with_suffix(".png")
    if plot == out:
        raise InputError(f"{out} is where the plot of the lights goes; name the lights {out.with_suffix('.csv')}")
    require_free(out, "the lights")
    require_free(plot, "the plot of the lights")
    lights = plan_illuminations(grid, parse_ccts(blackbodies))
    if not lights:
        raise InputError("no light is left: grid is 0 and there are no black bodies; name some")
    save_illuminations(lights, out)
    plot_illuminations(lights, plot)
    output.add(file=out, plot=plot, lights=len(lights), kinds=Counter(light.kind for light in lights))
    print(f"{out}: {len(lights)} lights; plot in {plot}")


@app.command(epilog=EXIT_CODES)
@with_json("acquire devices")
def devices(
    identify: Annotated[bool, typer.Option(help="Show on every display its number for ten seconds.")] = False,
    *,
    output: JsonOutput,
) -> None:
    """List what is attached and reachable: cameras, serial ports, displays, projectors on the network.

    Reads and writes no file.
    """
    from acquisition.run.rig.lab import attached_devices, identify_displays

    for attached in attached_devices():
        output.append("devices", attached)
        print(f"{attached.kind}:")
        for name in attached.found:
            print(f"  {name}")
        if not attached.found:
            print(f"  none{': ' + attached.trouble if attached.trouble else ''}")
    if identify:
        identify_displays(10.0)


@app.command(epilog=EXIT_CODES)
@with_json("acquire check")
def check(
    lab: Annotated[Path, typer.Argument(help="LAB.toml: the settings.")],
    picture: Annotated[
        Path | None,
        typer.Option(help="Save as PNG the frame with what was found on it, maps of light, blur and print, verdicts."),
    ] = None,
    corners: Annotated[
        tuple[str, str, str, str] | None,
        option(
            "X,Y X,Y X,Y X,Y",
            "As in build-lut: the corners of the field of a chart without tags.",
        ),
    ] = None,
    linearity: Annotated[
        bool, typer.Option("--linearity", help="Take a series of exposures too, which shows the sensor's linearity.")
    ] = False,
    *,
    output: JsonOutput,
) -> None:
    """Say whether the lab is ready: a verdict on exposure, light, sharpness, print, sensor, supplies; record nothing.

    Reads LAB.toml, the chart and the lights it names. Takes some 25 frames and keeps none; tries shutter times until
    one suits, then judges white, dark, the primaries and grey by the figures of build-lut. Each verdict is good, a
    remark, a fault, or not checked, with its number, limit, reason and remedy.
    Writes nothing unless asked with --picture. Ends with 4 when there is a fault. Devices that cannot be used are all
    named at once, each with its remedy, and end it with 3, or with 2 if LAB.toml or a language file is at fault.
    """
    from acquisition.check.check import check_lab
    from experiment.config import load_lab

    settings = load_lab(lab)
    given = None
    if corners is not None:
        from experiment.framing.field import parse_corners

        given = parse_corners(corners)
    with orderly_end():
        report = check_lab(
            settings,
            lambda sentence: print(sentence, file=sys.stderr),
            picture=picture,
            corners=given,
            linearity=linearity,
        )
    if output.asked:
        output.add(**report.values())
    else:
        for line in report.lines():
            print(line)
        if picture is not None:
            print(f"picture     {picture}")
    if faults := [finding.name for finding in report.with_grade("fault")]:
        raise QualityError(
            f"{counted(len(faults), 'fault')}: {', '.join(faults)}", remedy="the verdicts say what mends it"
        )


@app.command(epilog=EXIT_CODES)
@with_json("acquire run")
def run(
    lab: Annotated[Path, typer.Argument(help="LAB.toml: the settings.")],
    session: Annotated[Path, typer.Argument(help="Session folder: new, or one that was interrupted.")],
    retake: Annotated[
        str | None,
        option(
            "LIGHTS",
            "Take lights again, as in 12,40-44; bad: the frames that build-lut refused, by the newest report "
            "beside SESSION. What was taken of them before is kept and not used.",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Open and ask every device, print what the run would take, need and find, and what would end it; "
            "nothing is lit, released, shown or written.",
        ),
    ] = False,
    *,
    output: JsonOutput,
) -> None:
    """Take the session, or take up one that was interrupted.

    What a dry run prints is checked before anything moves. Reads LAB.toml, the chart and the lights it names. Writes
    SESSION: session.toml, chart.json, illuminations.csv, frames/, previews/, journal.sqlite, frames.csv, report.html.
    Interrupt it as you like and run it again. Ends with 4 when frames were refused; the next run tries those again.
    """
    from acquisition.run.run import Terminal, run_session
    from experiment.config import load_lab

    settings = load_lab(lab)
    if dry_run:
        _print_plan(settings, session, retake, output)
        return
    with orderly_end() as ending, Terminal() as shown:
        outcome = run_session(
            settings, session, shown.progress, shown.announce, retake, ending, shown.taken, shown.state
        )
    output.add(session=session, frames=outcome.total, left=outcome.left, refused=outcome.refused, doubts=outcome.doubts)
    for doubt in outcome.doubts:
        print(f"doubt: {doubt}")
    if not outcome.complete:
        raise QualityError(
            f"{outcome.left} of {outcome.total} frames are without an accepted frame; " + "; ".join(outcome.refused)
        )
    print(f"{session}: complete, {outcome.total} frames; next: build-lut {shlex.quote(str(session))} LUT/")


def _print_plan(settings: LabSettings, session: Path, retake: str | None, output: JsonOutput) -> None:
    from acquisition.run.plan import dry_run, plan_lines

    with orderly_end():
        plan = dry_run(settings, session, retake)
    output.add(
        session=session,
        frames=plan.work.left,
        frame_s=plan.frame_s.value,
        warm_up_s=plan.warm_up_s,
        time_s=plan.time_s,
        needed_bytes=plan.needed_bytes,
        free_bytes=plan.free_bytes,
        doubts=plan.doubts,
        faults=[str(fault) for fault in plan.faults],
    )
    for line in plan_lines(plan):
        print(line)
    plan.require()


@app.command(epilog=EXIT_CODES)
@with_json("acquire status")
def status(
    session: Annotated[Path, typer.Argument(help="Session folder.")],
    *,
    output: JsonOutput,
) -> None:
    """Show how far a session is, how long it will take, what was measured last, and what was refused.

    Reads SESSION, also while it is being taken; writes nothing. Ends with 0 when a run is at work, or the session is
    complete. Ends with 3 when a step of the run is late, no sign of life came in its time, it is paused for a device or
    ended for one, or it was killed; with 4 when it is paused for its frames, or ended with frames left, or its files,
    chart or lights are lost; with 5 when its disk is full or at fault.
    """
    from acquisition.status import read_status, status_json, status_lines
    from experiment.session.folder import journal_path

    journal_path(session)
    now = datetime.now(UTC)
    view = read_status(session, now)
    if output.asked:
        output.add(**status_json(view, now))
    else:
        print("\n".join(status_lines(view, now)))
    head = view.head(now)
    if head.state in ("late", "silent", "paused", "stopped", "incomplete"):
        of_none = QualityError if head.state == "incomplete" else DeviceError
        kinds = {"": of_none, "the disk": StorageError, "the frames": QualityError}
        raise kinds.get(head.cause, DeviceError)(head.sentence)


@app.command(epilog=EXIT_CODES)
def rebuild(session: Annotated[Path, typer.Argument(help="Session folder.")]) -> None:
    """Make the journal of a session anew that was deleted, overwritten or damaged.

    Reads SESSION/ledger.jsonl, where each run writes what the journal holds a second time. Writes
    SESSION/journal.sqlite; what stands in its place is renamed, not deleted. Frames stay as they are.
    """
    from experiment.session.folder import busy_sentence, rebuild_journal
    from experiment.session.journal import JOURNAL_FILE

    with held_folder(session, busy_sentence(session)):
        attempts = rebuild_journal(session)
    print(f"{session / JOURNAL_FILE}: made anew, {attempts} attempts; next: acquire status {session}")


@app.command(epilog=EXIT_CODES)
def monitor(
    session: Annotated[Path, typer.Argument(help="Session folder; one that is not there yet is waited for.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 takes a free one.")] = 8707,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on; 0.0.0.0 lets other machines in the house look, a phone for one."),
    ] = "127.0.0.1",
) -> None:
    """Show a session as a live web page, until interrupted.

    Reads SESSION, also while it is being taken; writes nothing and never holds a run up. With --host the address holds
    a token, new at each start: whoever has the address can look, and nobody can change anything. It is printed as a QR
    code, too.
    """
    from acquisition.monitor.serving import open_monitor

    with open_monitor(session, port, host) as server:
        if not server.has_session:
            print(f"{session} holds no session yet; the page waits until acquire run begins one there")
        server.serve(str(session), "can look at the session")


@app.command(epilog=EXIT_CODES)
def report(
    session: Annotated[Path, typer.Argument(help="Session folder.")],
    out: Annotated[
        Path | None, typer.Argument(help="HTML file, replaced if it is there; SESSION/report.html by default.")
    ] = None,
) -> None:
    """Write what the monitor's page shows as one HTML file, pictures and all, to be kept or mailed.

    Reads SESSION, also while it is being taken. acquire run writes the same file when it ends.
    """
    from acquisition.monitor.view import write_session_report

    path = write_session_report(session, out)
    print(f"{path}: written")


@app.command("import", epilog=EXIT_CODES)
@with_json("acquire import")
def import_(
    frames: Annotated[
        Path, typer.Argument(help="CSV of raw files, columns as frames.csv; with illuminations.csv beside.")
    ],
    chart: Annotated[Path, typer.Argument(help="chart.json of the print.")],
    session: Annotated[Path, typer.Argument(help="New session folder.")],
    *,
    output: JsonOutput,
) -> None:
    """Make a session from raw files taken by other means; every file is copied and judged.

    Reads FRAMES, illuminations.csv beside it, CHART and the raw files. Writes SESSION, as acquire run does. Ends with 4
    when a light, or every white or dark frame, is without an accepted frame; the session is there all the same.
    """
    from acquisition.run.importing import import_session

    with progress("files") as advance:
        imported = import_session(frames, chart, session, advance)
    output.add(session=session, refused=imported.refused, left=imported.left)
    print(f"{session}: imported; {len(imported.refused)} frames refused")
    if imported.unchecked:
        print(
            f"{', '.join(imported.unchecked)}: whether files of this format are complete cannot be checked; convert "
            "them to DNG to have it checked"
        )
    for line in imported.refused:
        print(f"  {line}")
    if imported.left:
        raise QualityError(
            f"{session}: {len(imported.left)} are without an accepted frame: {first_of(imported.left)}; list other "
            "files and import them into a new folder"
        )


if __name__ == "__main__":
    raise SystemExit(main())
