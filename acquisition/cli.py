"""`acquire`: design the experiment, take a session, and show its progress."""

from __future__ import annotations

import json
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
from foundation.errors import RUN_AGAIN, DeviceError, InputError, QualityError, StorageError, counted, first_few
from foundation.files import make_folder, write_atomic
from foundation.folders import atomic_folder, locked_folder, require_free

if TYPE_CHECKING:
    from experiment.config import LabSettings

app = new_app(
    "Plan, print and take a session: raw photographs of a chart under many known illuminants.\n\n" + EXIT_CODES,
    no_args_is_help=True,
)


class Arrangement(Enum):
    """Arrangement of the colours on the sheet."""

    TAGGED = "tagged"
    PUBLISHED = "paper"


class Rig(Enum):
    """Devices of a new laboratory."""

    LAB = "lab"
    SIMULATED = "simulated"


def main(argv: Sequence[str] | None = None) -> int:
    """Run `acquire` with arguments (default: `sys.argv`) and return the exit code (`EXIT_CODES`)."""
    return console.run(lambda: app(args=argv, prog_name="acquire"))


@app.command(epilog=EXIT_CODES)
def init(
    lab: Annotated[Path, typer.Argument(metavar="LAB", help="Folder of the lab; created if it does not exist.")],
    rig: Annotated[
        Rig, typer.Option(help="lab: real devices, which you enter in LAB.toml; simulated: no hardware.")
    ] = Rig.LAB,
    page: Annotated[str | None, typer.Option(help="Sheet of the new chart, as in acquire chart.")] = None,
    existing_chart: Annotated[
        Path | None,
        option("CHART", "Existing chart to use instead of a new one: its chart.json, or the folder.", "--chart"),
    ] = None,
) -> None:
    """Create a lab: a commented LAB.toml, the chart to print and the 707 illuminants.

    Reads the chart of --chart. Writes LAB/LAB.toml, chart/ (like acquire chart, without the TIFF) and illuminations.csv
    (like acquire illuminations). A chart or illuminants in LAB stay unchanged; an existing LAB.toml is an error.
    """
    settings, print_folder, lights = lab / "LAB.toml", lab / "chart", lab / "illuminations.csv"
    require_free(settings, "the settings")
    chart_file = print_folder / "chart.json"
    if page is not None and (existing_chart is not None or chart_file.exists()):
        raise InputError(
            f"--page {page} is for a new chart, but {existing_chart or chart_file} exists; omit --page, or use another "
            "folder"
        )
    if existing_chart is not None:
        from experiment.chart.model import load_chart

        chart_file = existing_chart / "chart.json" if existing_chart.is_dir() else existing_chart
        load_chart(chart_file)
    make_folder(lab, lab)
    if not chart_file.exists():
        chart(print_folder, tiff=False, page=page)
    if not lights.exists():
        illuminations(lights)
    text = files("acquisition").joinpath("data", f"{rig.value}.toml").read_text("utf-8")
    location = chart_file.resolve()
    inside = location.is_relative_to(lab.resolve())
    # JSON and TOML quote strings in the same way.
    chart_text = json.dumps(
        (location.relative_to(lab.resolve()) if inside else location).as_posix(), ensure_ascii=False
    )
    write_atomic(settings, text.replace('"chart/chart.json"', chart_text, 1))
    edit = "enter your devices" if rig is Rig.LAB else "change it if necessary"
    print(f"{settings}: {edit}, then run: acquire check {shlex.quote(str(settings))}")


@app.command(epilog=EXIT_CODES)
@with_json("acquire chart")
def chart(
    out: Annotated[Path, typer.Argument(help="New folder for chart.json, chart.tif, chart.pdf and related files.")],
    bits: Annotated[int, typer.Option(min=1, max=5, help="Bits per channel; 5 gives 32 768 colours.")] = 5,
    page: Annotated[
        str | None,
        typer.Option(help="Sheet, landscape: A0 … A8, or WIDTHxHEIGHT in mm; by default the smallest that fits."),
    ] = None,
    arrangement: Annotated[
        Arrangement,
        typer.Option(help="tagged: random order, tags and references; paper: published 256 × 128 grid, without tags."),
    ] = Arrangement.TAGGED,
    tiff: Annotated[bool, typer.Option(help="Write the 600-dpi TIFF.")] = True,
    tagged_tiff: Annotated[
        bool,
        typer.Option("--tagged-tiff", help="Also write chart-srgb.tif, tagged as sRGB, to print through a profile."),
    ] = False,
    *,
    output: JsonOutput,
) -> None:
    """Design the chart: every colour once, AprilTags and achromatic references, in true size.

    Reads no file. Writes OUT/chart.json (for calibration), chart.pdf (vector, PDF/X-4), chart.tif (600 dpi),
    preview.png, proof.pdf (an A4 page to test the printer) and PRINTING.txt. Print the PDF or the TIFF on matte paper
    at 100 %, with the printer's colour management off. Prints a warning to stderr if patches are too small for the
    cameras of the publication (Banić et al. 2019).
    """
    from experiment.chart.layout import design_chart, paper_chart
    from experiment.chart.printing import save_pdf, save_preview, save_tiff
    from experiment.chart.proof import save_instructions, save_proof
    from experiment.framing.finding import small_parts_warning

    design = paper_chart(_page(page), bits) if arrangement is Arrangement.PUBLISHED else design_chart(bits, _page(page))
    with atomic_folder(out, "the chart") as folder:
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
        f"on {width:g} × {height:g} mm, patches of {cell} mm"
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
        width, height = (float(side) for side in (text or "").lower().split("x"))
    except ValueError:
        return text
    return width, height


@app.command(epilog=EXIT_CODES)
@with_json("acquire illuminations")
def illuminations(
    out: Annotated[Path, typer.Argument(help="New CSV file; a plot of the illuminants is written next to it as .png.")],
    grid: Annotated[int, typer.Option(min=0, max=200, help="Steps along an edge of the chromaticity triangle.")] = 35,
    blackbodies: Annotated[
        str, typer.Option(help="Black bodies as FIRST:LAST:STEP in kelvin, or as a list K,K,…; empty for none.")
    ] = "2000:10000:200",
    *,
    output: JsonOutput,
) -> None:
    """Plan the illuminants: uniformly spread chromaticities and black bodies; 707 by default.

    Reads no file. Writes OUT (index, kind, cct_k, red, green, blue) and a plot of the chromaticities (r, b) next to it.
    """
    from experiment.lights import parse_ccts, plan_illuminants, plot_illuminants, save_illuminants

    plot = out.with_suffix(".png")
    if plot == out:
        raise InputError(f"OUT is {out}, the name of the plot, expected a CSV file; use {out.with_suffix('.csv')}")
    require_free(out, "the illuminants")
    require_free(plot, "the plot of the illuminants")
    lights = plan_illuminants(grid, parse_ccts(blackbodies))
    if not lights:
        raise InputError("0 illuminants are planned, expected at least 1; set --grid or --blackbodies")
    save_illuminants(lights, out)
    plot_illuminants(lights, plot)
    output.add(file=out, plot=plot, lights=len(lights), kinds=Counter(light.kind for light in lights))
    print(f"{out}: {counted(len(lights), 'illuminant')}; plot in {plot}")


@app.command(epilog=EXIT_CODES)
@with_json("acquire devices")
def devices(
    identify: Annotated[bool, typer.Option(help="Show the number of every display on it for 10 s.")] = False,
    *,
    output: JsonOutput,
) -> None:
    """List available devices: cameras, serial ports, displays, projectors on the network.

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
        typer.Option(help="Save a PNG: the frame with detected tags, maps of light, blur and print, and the verdicts."),
    ] = None,
    corners: Annotated[
        tuple[str, str, str, str] | None,
        option(
            "X,Y X,Y X,Y X,Y",
            "Corners of the patch area of a chart without tags, as in build-lut.",
        ),
    ] = None,
    linearity: Annotated[
        bool, typer.Option("--linearity", help="Also take a series of exposures, to measure the sensor's linearity.")
    ] = False,
    *,
    output: JsonOutput,
) -> None:
    """Check whether the lab is ready: exposure, light, sharpness, print, sensor and supplies; record nothing.

    Reads LAB.toml, its chart and its illuminants. Takes about 25 frames and deletes them. Tries shutter times until one
    is suitable, then judges white, dark, primary and grey frames by the same figures as build-lut. Each quantity is
    good, a remark, a fault, or not checked, and has a value, a limit, a reason and a remedy. Writes only the file of
    --picture. Ends with 4 if there is a fault. Ends with 3 if devices cannot be used, and reports all of them with
    remedies. Ends with 2 if LAB.toml or a language file is wrong.
    """
    from acquisition.check.check import check_lab
    from experiment.config import load_lab

    settings = load_lab(lab)
    field_corners = None
    if corners is not None:
        from experiment.framing.field import parse_corners

        field_corners = parse_corners(corners)
    with orderly_end():
        report = check_lab(
            settings,
            lambda sentence: print(sentence, file=sys.stderr),
            picture=picture,
            corners=field_corners,
            linearity=linearity,
        )
    if output.is_requested:
        output.add(**report.values())
    else:
        for line in report.lines():
            print(line)
        if picture is not None:
            print(f"picture     {picture}")
    if faults := [finding.name for finding in report.with_grade("fault")]:
        raise QualityError(
            f"{counted(len(faults), 'fault')}: {', '.join(faults)}", remedy="the verdicts give the remedies"
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
            "Illuminants to repeat, such as 12,40-44, or the word bad for the frames that build-lut refused in the "
            "newest report next to SESSION. The earlier frames are kept, but not used.",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Query every device, then print frames, time and space of the run, and faults that would end it. "
            "No lamp is switched on, no frame is taken, nothing is shown or written.",
        ),
    ] = False,
    *,
    output: JsonOutput,
) -> None:
    """Take the session, or resume an interrupted one.

    First checks everything that a dry run prints. Reads LAB.toml, its chart and its illuminants. Writes SESSION:
    session.toml, chart.json, illuminations.csv, frames/, previews/, journal.sqlite, frames.csv, report.html. To resume
    an interrupted run, run the same command again. Ends with 4 if frames were refused; the next run repeats them.
    """
    from acquisition.run.run import Terminal, run_session
    from experiment.config import load_lab

    settings = load_lab(lab)
    if dry_run:
        _print_plan(settings, session, retake, output)
        return
    with orderly_end() as ending, Terminal() as terminal:
        outcome = run_session(
            settings, session, terminal.progress, terminal.announce, retake, ending, terminal.show_frame, terminal.state
        )
    missing, refused, doubts = outcome.remaining, outcome.refused, outcome.doubts
    output.add(session=session, frames=outcome.total, left=missing, refused=refused, doubts=doubts)
    for doubt in outcome.doubts:
        print(f"doubt: {doubt}")
    if not outcome.complete:
        raise QualityError(
            f"{outcome.total - missing} of {outcome.total} planned frames are complete, {missing} are missing; remove "
            f"the causes, {RUN_AGAIN}: " + "; ".join(refused)
        )
    print(f"{session}: complete, {outcome.total} frames; next: build-lut {shlex.quote(str(session))} LUT/")


def _print_plan(settings: LabSettings, session: Path, retake: str | None, output: JsonOutput) -> None:
    from acquisition.run.plan import dry_run, plan_lines

    with orderly_end():
        plan = dry_run(settings, session, retake)
    output.add(
        session=session,
        frames=plan.work.remaining,
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
    """Show the progress of a session: state, remaining time, last measurements, and refused frames.

    Reads SESSION, also during a run; writes nothing. Ends with 0 if a run is active or the session is complete. Ends
    with 3 if a device delays, pauses or ended the run, or if the run hangs or was killed. Ends with 4 if refused frames
    pause the run, if frames are missing at its end, or if files, chart or illuminants are lost. Ends with 5 if the disk
    is full or faulty.
    """
    from acquisition.status import read_status, status_json, status_lines
    from experiment.session.folder import journal_path

    journal_path(session)
    now = datetime.now(UTC)
    view = read_status(session, now)
    if output.is_requested:
        output.add(**status_json(view, now))
    else:
        print("\n".join(status_lines(view, now)))
    head = view.head(now)
    if head.state in ("late", "silent", "paused", "stopped", "incomplete"):
        default = QualityError if head.state == "incomplete" else DeviceError
        errors = {"": default, "the disk": StorageError, "the frames": QualityError}
        raise errors.get(head.cause, DeviceError)(head.sentence)


@app.command(epilog=EXIT_CODES)
def rebuild(session: Annotated[Path, typer.Argument(help="Session folder.")]) -> None:
    """Restore the journal of a session after it was deleted, overwritten or damaged.

    Reads SESSION/ledger.jsonl, the second copy of the journal. Writes SESSION/journal.sqlite; an existing file is
    renamed, not deleted. Frames stay unchanged.
    """
    from experiment.session.folder import busy_message, rebuild_journal
    from experiment.session.journal import JOURNAL_FILE

    with locked_folder(session, busy_message(session)):
        attempts = rebuild_journal(session)
    print(f"{session / JOURNAL_FILE}: restored with {counted(attempts, 'attempt')}; next: acquire status {session}")


@app.command(epilog=EXIT_CODES)
def monitor(
    session: Annotated[Path, typer.Argument(help="Session folder; if it does not exist, the page waits for it.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 for any free port.")] = 8707,
    host: Annotated[
        str,
        typer.Option(help="Address to listen on; 0.0.0.0 for access from other computers and phones."),
    ] = "127.0.0.1",
) -> None:
    """Show a session as a live web page, until interrupted.

    Reads SESSION, also during a run; writes nothing and never delays a run. With --host, the address contains a new
    secret token. Everybody who has the address can view the session, but nobody can change anything. The address is
    also printed as a QR code.
    """
    from acquisition.monitor.serving import open_monitor

    with open_monitor(session, port, host) as server:
        if not server.has_session:
            print(f"{session} has no session yet; the page waits until acquire run starts one")
        server.serve(str(session), "can view the session")


@app.command(epilog=EXIT_CODES)
def report(
    session: Annotated[Path, typer.Argument(help="Session folder.")],
    out: Annotated[
        Path | None, typer.Argument(help="HTML file, replaced if it exists; SESSION/report.html by default.")
    ] = None,
) -> None:
    """Write the page of acquire monitor with its pictures as one HTML file.

    Reads SESSION, also during a run. acquire run writes the same file when it ends.
    """
    from acquisition.monitor.view import write_session_report

    path = write_session_report(session, out)
    print(f"{path}: written")


@app.command("import", epilog=EXIT_CODES)
@with_json("acquire import")
def import_(
    frames: Annotated[
        Path, typer.Argument(help="CSV of raw files, columns as in frames.csv; illuminations.csv must be next to it.")
    ],
    chart: Annotated[Path, typer.Argument(help="chart.json of the printed chart.")],
    session: Annotated[Path, typer.Argument(help="New session folder.")],
    *,
    output: JsonOutput,
) -> None:
    """Make a session from raw files taken by other means; every file is copied and judged.

    Reads FRAMES, illuminations.csv next to it, CHART and the raw files. Writes SESSION, like acquire run. Ends with 4
    if an illuminant has no accepted frame, or if no white or no dark frame was accepted; SESSION is written anyway.
    """
    from acquisition.run.importing import import_session

    with progress("files") as advance:
        imported = import_session(frames, chart, session, advance)
    output.add(session=session, refused=imported.refused, left=imported.missing)
    print(f"{session}: imported; {counted(len(imported.refused), 'frame')} refused")
    if imported.unchecked:
        print(
            f"{', '.join(imported.unchecked)}: the completeness of files of this format cannot be checked; convert "
            "them to DNG to check it"
        )
    for line in imported.refused:
        print(f"  {line}")
    if imported.missing:
        raise QualityError(
            f"{session} lacks accepted frames: {first_few(imported.missing)}; expected 1 or more of each: list other "
            "files, and import them into a new folder"
        )


if __name__ == "__main__":
    raise SystemExit(main())
