"""The command `build-lut`, with its subcommands `check`, `info`, `verify`, `match`, `compare`, `publish` and `fetch`.

Each function reads the options of one command, calls the library and prints the result. Modules that load numpy are
imported inside the functions, because this import would delay `--help` and error messages (docs/architecture.md).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibration.table.demo_table import table_folder
from foundation import console
from foundation.console import EXIT_CODES, JsonOutput, MainCommand, new_app, option, progress, with_json
from foundation.errors import FormatError, QualityError, counted
from foundation.folders import require_free
from foundation.secret_texts import masked, printable

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from calibration.verdict import BuildResult

app = new_app()
_subcommands = new_app()


class _BuildLut(MainCommand):
    subcommands = _subcommands


Corners = Annotated[
    tuple[str, str, str, str] | None,
    option(
        "X,Y X,Y X,Y X,Y",
        "For a chart without tags: the four corners of its patch area, clockwise from the top left corner of the "
        "print, in pixels of the raw file that is registered first, usually the first white frame.",
    ),
]
Linearity = Annotated[
    Path | None,
    option(
        "FOLDER",
        "Measure the linearity of the sensor with the raw files in FOLDER. They show the chart as in the session and "
        "differ only in exposure time, from dim to almost saturated.",
    ),
]
SessionFolder = Annotated[Path, typer.Argument(help="Folder of a session from acquire run or acquire import.")]
Table = Annotated[Path, typer.Argument(metavar="LUT", help="Folder of a LUT; demo: for a small example.")]
NewTable = Annotated[Path, typer.Argument(metavar="LUT", help="New folder for the LUT.")]


def main(argv: Sequence[str] | None = None) -> int:
    """Run `build-lut` with the given arguments, or the arguments of the process, and return its exit code."""
    return console.run(lambda: app(args=argv, prog_name="build-lut"))


@app.command(
    cls=_BuildLut,
    no_args_is_help=True,
    help="Build the look-up table (LUT) of a session: samples of all colours under all illuminants, and ground "
    "truth.\n\nReads SESSION (chart.json, illuminations.csv, journal.sqlite, frames/) and checks the SHA-256 of each "
    "frame. Registers the chart, follows its movements, corrects the flat field, and writes LUT: samples.npy, "
    "illuminations.csv with the ground truth, references.csv, lut.json, frames.csv, report.html and report.json. LUT "
    "appears completely or not at all. Run the same command again to resume an interrupted build.\n\n"
    "Every figure (measured property) is compared with its limits. The verdict is accept, accept with remarks, or "
    "refuse. A refused LUT is not written: its report is in LUT.refused/, and the exit code is 4.\n\n"
    "--append adds the available frames of a session in progress. LUT appears after the last frame.",
    epilog=EXIT_CODES,
)
@with_json("build-lut")
def build_lut(
    session: SessionFolder,
    lut: NewTable,
    append: Annotated[
        bool, typer.Option("--append", help="Add the available frames of a session in progress.")
    ] = False,
    window: Annotated[int, option("N", "Side of a patch's sampling window in pixels: 3, 5, 7 or 9.")] = 5,
    subtract_dark: Annotated[
        bool,
        typer.Option(
            "--subtract-dark",
            help="Subtract the light of the dark frames (projector leak and room light) from samples and ground truth.",
        ),
    ] = False,
    correct_drift: Annotated[
        bool,
        typer.Option(
            "--correct-drift",
            help="Correct samples and ground truth for lamp drift between white frames. The gains are recorded, so "
            "that the correction can be undone. The LUT is refused if the white frames do not determine the drift.",
        ),
    ] = False,
    no_lens_correction: Annotated[
        bool,
        typer.Option(
            "--no-lens-correction",
            help="Do not correct the samples for light that the lens spreads between patches and over the frame. This "
            "light is still measured.",
        ),
    ] = False,
    corners: Corners = None,
    linearity: Linearity = None,
    *,
    output: JsonOutput,
) -> None:
    """Build the LUT of a session."""
    from calibration.pipeline.build import TableProgress, build, refused_folder
    from calibration.pipeline.build import append as append_frames
    from calibration.pipeline.frames import BuildOptions
    from calibration.report.report import write_report
    from calibration.table.lut import REPORT_JSON, REPORT_PAGE
    from experiment.framing.field import parse_corners
    from experiment.session.folder import Session

    corner_points = None if corners is None else parse_corners(corners)
    options = BuildOptions(window, subtract_dark, corner_points, correct_drift, not no_lens_correction)
    report_path = refused_folder(lut) / REPORT_JSON
    previous_mtime = report_path.stat().st_mtime_ns if report_path.is_file() else None
    build_or_append = append_frames if append else build
    try:
        with Session.open(session) as opened, progress("registering the chart") as show:
            result = build_or_append(opened, lut, show, write_report, options, linearity)
    except QualityError:
        # The report may be from an earlier build.
        if output.is_requested and report_path.is_file() and report_path.stat().st_mtime_ns != previous_mtime:
            output.add(**json.loads(report_path.read_text(encoding="utf-8")))
        raise
    if isinstance(result, TableProgress):
        output.add(table=lut, progress=result)
        print(
            f"{lut}: {result.lights} of {result.lights_planned} illuminants, "
            f"{counted(result.new_frames, 'new frame')}, "
            f"{result.frames} in total; when more frames are available, run the same command again"
        )
        return
    output.add(table=lut)
    _print_result(result, output)
    print(
        f"{lut}: {result.figures.session.lights} illuminants, {result.figures.session.camera}; see {lut / REPORT_PAGE}"
    )


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut check")
def check(
    session: SessionFolder,
    picture: Annotated[
        Path | None,
        option("PNG", "Save the frame with the outline of the chart, or with the detected tags if it is not found."),
    ] = None,
    corners: Corners = None,
    linearity: Linearity = None,
    *,
    output: JsonOutput,
) -> None:
    """Register the chart in the best frame of a session and judge this frame.

    Reads the first white frame of SESSION and a dark frame. Without white frames, reads the frame of the illuminant
    that is closest to white. Writes only the file of --picture. Figures that need all frames are judged only by
    build-lut SESSION LUT. Exit code 4 if a figure is refused.
    """
    from calibration.pipeline.build import check as check_session
    from calibration.pipeline.frames import BuildOptions
    from calibration.verdict import refusal
    from experiment.framing.field import parse_corners
    from experiment.session.folder import Session

    options = BuildOptions(corners=None if corners is None else parse_corners(corners))
    with Session.open(session) as opened:
        result = check_session(opened, options, linearity, picture)
    _print_result(result, output)
    if result.verdict.refused:
        raise QualityError(f"{session}: {refusal(result.verdict, result.figures)}")
    judged = counted(len(result.verdict.rows), "figure")
    print(
        f"{session}: the expected chart is registered; {judged} judged from this frame. Run build-lut {session} LUT to "
        "judge all figures"
    )


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut info")
def info(
    lut: Table,
    cite: Annotated[bool, typer.Option("--cite", help="Print only the BibTeX entry of the LUT.")] = False,
    *,
    output: JsonOutput,
) -> None:
    """Print the properties and the origin of a LUT.

    Reads LUT; writes nothing.
    """
    from calibration.table.lut import open_lut
    from calibration.table.verification import citation_of, describe

    folder = table_folder(lut)
    table = open_lut(folder)
    entry = printable(citation_of(table))
    output.add(
        table=folder,
        sha256=table.sha256,
        lights=len(table.white),
        colours=8**table.provenance.bits,
        samples=int(table.samples.shape[2]),
        provenance=table.provenance.model_dump(mode="json"),
        bibtex=entry,
    )
    if cite:
        print(entry, end="")
        return
    for name, value in describe(table):
        print(f"{name + ':':17}{printable(value)}")


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut verify")
def verify(
    lut: Table,
    session: Annotated[Path | None, typer.Argument(help="Folder of the session, to check its frames as well.")] = None,
    *,
    output: JsonOutput,
) -> None:
    """Check the hashes of all files of a LUT, and list the changed files.

    Checks the hashes of the frames as well if SESSION is given. Reads LUT and SESSION; writes nothing. Exit code 2 if
    anything has changed.
    """
    from calibration.pipeline.frames import frame_faults
    from calibration.table.lut import open_lut
    from calibration.table.verification import find_faults
    from experiment.session.folder import Session

    folder = table_folder(lut)
    table = open_lut(folder, check=False)
    with progress("reading the samples") as show:
        faults = find_faults(table, show)
    if session is not None:
        with Session.open(session) as opened, progress("reading the frames") as show:
            faults += frame_faults(table, opened, show)
    output.add(table=folder, sha256=table.sha256, frames=None if session is None else len(table.frames), faults=faults)
    for fault in faults:
        print(fault)
    if faults:
        raise FormatError(
            f"{folder} has changed: {counted(len(faults), 'fault')}, expected 0; restore it from a copy, or build the "
            "LUT again"
        )
    frames = "" if session is None else f" and of {len(table.frames)} frames in {session}"
    print(f"{folder}: the hashes of all files{frames} are correct")


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut match")
def match(
    first_lut: Annotated[Path, typer.Argument(metavar="LUT1", help="Folder of a LUT.")],
    second_lut: Annotated[Path, typer.Argument(metavar="LUT2", help="Folder of another LUT.")],
    *,
    output: JsonOutput,
) -> None:
    """Check that equal indices in two LUTs mean the same colour and the same illuminant.

    The LUTs may belong to different cameras. Reads both; writes nothing. Exit code 2 if the indices differ in meaning.
    """
    from calibration.table.lut import open_lut
    from calibration.table.verification import require_match

    folders = table_folder(first_lut), table_folder(second_lut)
    tables = open_lut(folders[0]), open_lut(folders[1])
    require_match(*tables)
    output.add(tables=folders, cameras=[table.provenance.camera for table in tables], match=True)
    cameras = " and ".join(table.provenance.camera for table in tables)
    print(f"{folders[0]} and {folders[1]} ({cameras}): colours and illuminants correspond by index")


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut compare")
def compare(
    a_folder: Annotated[Path, typer.Argument(metavar="A", help="Folder of a LUT or a session.")],
    b_folder: Annotated[Path, typer.Argument(metavar="B", help="Folder of another LUT or session of the same chart.")],
    out: Annotated[
        Path | None,
        option("FOLDER", "Write report.html with its plots, comparison.json, lights.csv and cells.csv to this folder."),
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Compare two LUTs or sessions of one chart, and report whether noise alone explains their differences.

    Reads A and B. The LUT of a session is built temporarily with default options. Writes FOLDER if --out is given.
    Compares colour and brightness of the illuminants, and every patch. Exit code 0 after a comparison, 2 if the charts
    differ or have no common illuminant, 4 if the LUT of a session is refused.
    """
    from calibration.comparison.comparing import chart_of, table_of
    from calibration.comparison.comparing import compare as compare_tables
    from calibration.comparison.report import comparison_json, lines, write_comparison

    if out is not None:
        require_free(out, "the comparison")
    folders = table_folder(a_folder), table_folder(b_folder)
    with (
        progress("reading") as show,
        table_of(folders[0], show) as a,
        table_of(folders[1], show) as b,
    ):
        comparison = compare_tables(a, b, show, folders)
    if output.is_requested:
        output.add(**comparison_json(comparison))
    else:
        print("\n".join(lines(comparison)))
    if out is not None:
        write_comparison(comparison, out, chart_of(folders))


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut publish")
def publish(
    lut: Table,
    url: Annotated[str, typer.Argument(help="New folder, or URL of a store supported by fsspec, such as s3://….")],
    *,
    output: JsonOutput,
) -> None:
    """Publish a LUT as a sharded Zarr array, in a folder or a store.

    Reads LUT; writes URL.
    """
    from calibration.table.lut import open_lut
    from calibration.table.zarr_store import publish as publish_table

    folder = table_folder(lut)
    table = open_lut(folder)
    with progress("writing illuminants") as show:
        publish_table(table, url, show)
    output.add(table=folder, url=masked(url), lights=len(table.samples), sha256=table.sha256)
    print(f"{masked(url)}: {counted(len(table.samples), 'illuminant')} of {folder}. Others can copy the LUT with")
    print(f"build-lut fetch {masked(url)} LUT --expect {table.sha256}")


@_subcommands.command(epilog=EXIT_CODES)
@with_json("build-lut fetch")
def fetch(
    url: Annotated[str, typer.Argument(help="Folder or URL of a published LUT.")],
    lut: NewTable,
    expect: Annotated[
        str | None,
        option(
            "SHA256",
            "Expected hash as printed by build-lut info, from a source that you trust; other LUTs are refused.",
        ),
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Copy a published LUT to a new folder and verify it.

    Reads URL; writes LUT.
    """
    from calibration.table.zarr_store import fetch as fetch_table

    with progress("reading illuminants") as show:
        table = fetch_table(url, lut, show, expect)
    output.add(table=lut, url=masked(url), lights=len(table.samples), sha256=table.sha256, expected=expect is not None)
    print(f"{lut}: {len(table.samples)} illuminants, {printable(table.provenance.camera)}; {_hash_text(table, expect)}")


def _hash_text(lut: Lut, expect: str | None) -> str:
    if expect is not None:
        return "it is the expected LUT, and all hashes are correct"
    return (
        f"all files match the hashes in the LUT. Compare its hash, {lut.sha256}, with the expected hash, or repeat "
        "the command with --expect"
    )


def _print_result(result: BuildResult, output: JsonOutput) -> None:
    from calibration.report.report import report_json, summary
    from calibration.verdict import remark

    if output.is_requested:
        output.add(**report_json(result))
        return
    rows = [row for row in summary(result.figures) if row.brief]
    width = max(len(row.name) for row in rows) + 2
    for row in rows:
        print(f"{row.name + ':':{width}}{row.value}" + (f"  ({row.note})" if row.note else ""))
    for judged in result.verdict.remarks:
        print(f"remark: {remark(judged, result.figures)}")
    print(f"{'Verdict:':{width}}{result.verdict.outcome}")


if __name__ == "__main__":
    raise SystemExit(main())
