"""`build-lut`: builds the table of a session; `check`, `info`, `verify`, `match`, `compare`, `publish` and `fetch`.

One function for each command: parse, call, print. Modules that load numpy are imported when a command begins, so that
help and a wrong option are answered at once (docs/architecture.md).
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
_others = new_app()


class _BuildLut(MainCommand):
    subcommands = _others


Corners = Annotated[
    tuple[str, str, str, str] | None,
    option(
        "X,Y X,Y X,Y X,Y",
        "For a chart without tags: the corners of its field of cells in the frame that is registered first, pixels "
        "of the raw file, clockwise from the printed top-left.",
    ),
]
Linearity = Annotated[
    Path | None,
    option(
        "FOLDER",
        "Judge the sensor's linearity by raw files of the chart in its place, under one light, with exposure times "
        "from dim to nearly saturated.",
    ),
]
SessionFolder = Annotated[Path, typer.Argument(help="Folder of a session, made by acquire run or acquire import.")]
Table = Annotated[Path, typer.Argument(metavar="LUT", help="Folder of a table; demo: for a small one.")]
NewTable = Annotated[Path, typer.Argument(metavar="LUT", help="New folder for the table.")]


def main(argv: Sequence[str] | None = None) -> int:
    """Run `build-lut` with arguments, those of the process if None, and return its exit code."""
    return console.run(lambda: app(args=argv, prog_name="build-lut"))


@app.command(
    cls=_BuildLut,
    no_args_is_help=True,
    help="Build the look-up table of a session: samples of every colour under every light, and the ground truth.\n\n"
    "Reads SESSION (chart.json, illuminations.csv, journal.sqlite, frames/) and checks each frame's SHA-256. Finds the "
    "chart once, follows it if it moves, divides the light's unevenness out, and writes LUT: samples.npy, "
    "illuminations.csv with the ground truth, references.csv, lut.json, frames.csv, report.html and report.json. LUT "
    "appears whole or not at all; a build that was stopped goes on when the same command is run again.\n\n"
    "Every figure is compared with its limit: accept, accept with remarks, or refuse. A refused table is not written; "
    "its report is then in LUT.refused/, and the exit code is 4.\n\n"
    "With --append, takes in the frames that have come so far of a session that is being taken; LUT appears with the "
    "last of them.",
    epilog=EXIT_CODES,
)
@with_json("build-lut")
def build_lut(
    session: SessionFolder,
    lut: NewTable,
    append: Annotated[
        bool, typer.Option("--append", help="Take in what has come of a session that is being taken.")
    ] = False,
    window: Annotated[int, option("N", "Pixels along the side of a cell's window: 3, 5, 7 or 9.")] = 5,
    subtract_dark: Annotated[
        bool,
        typer.Option(
            "--subtract-dark",
            help="Subtract the light of the dark frames, the projector's leak and the room's, from every sample and "
            "from the ground truth.",
        ),
    ] = False,
    correct_drift: Annotated[
        bool,
        typer.Option(
            "--correct-drift",
            help="Take the lamp's drift between white frames out of samples and ground truth, so that all lights are "
            "of one lamp; recorded, and undone by its numbers. Refused where white frames leave it open.",
        ),
    ] = False,
    no_lens_correction: Annotated[
        bool,
        typer.Option(
            "--no-lens-correction",
            help="Leave in the samples what the lens spreads from cell to cell and over the frame, where the print "
            "proves that it does; measured it is all the same.",
        ),
    ] = False,
    corners: Corners = None,
    linearity: Linearity = None,
    *,
    output: JsonOutput,
) -> None:
    """Build the table of a session."""
    from calibration.pipeline.build import TableProgress, build, refused_folder
    from calibration.pipeline.build import append as append_frames
    from calibration.pipeline.frames import BuildOptions
    from calibration.report.report import write_report
    from calibration.table.lut import REPORT_JSON, REPORT_PAGE
    from experiment.framing.field import parse_corners
    from experiment.session.folder import Session

    places = None if corners is None else parse_corners(corners)
    options = BuildOptions(window, subtract_dark, places, correct_drift, not no_lens_correction)
    kept = refused_folder(lut) / REPORT_JSON
    before = kept.stat().st_mtime_ns if kept.is_file() else None
    make = append_frames if append else build
    try:
        with Session.open(session) as opened, progress("finding the chart") as shown:
            result = make(opened, lut, shown, write_report, options, linearity)
    except QualityError:
        # A report of an earlier build says nothing of this one.
        if output.is_requested and kept.is_file() and kept.stat().st_mtime_ns != before:
            output.add(**json.loads(kept.read_text(encoding="utf-8")))
        raise
    if isinstance(result, TableProgress):
        output.add(table=lut, progress=result)
        print(
            f"{lut}: {result.lights} of {result.lights_planned} lights, {result.new_frames} frames taken in now, "
            f"{result.frames} in all; run the same command again when more have come"
        )
        return
    output.add(table=lut)
    _print_result(result, output)
    print(f"{lut}: {result.figures.session.lights} lights, {result.figures.session.camera}; see {lut / REPORT_PAGE}")


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut check")
def check(
    session: SessionFolder,
    picture: Annotated[
        Path | None,
        option("PNG", "Save the frame with what of the chart was found on it, or was looked for."),
    ] = None,
    corners: Corners = None,
    linearity: Linearity = None,
    *,
    output: JsonOutput,
) -> None:
    """Find the chart in a session's best frame and judge it.

    Reads SESSION: the best light or white frame and a dark one. Writes nothing but the picture. Figures that take all
    frames are judged by a build alone. Ends with 4 where a figure is refused.
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
        f"{session}: the chart is found and is the one expected; this frame tells {judged}, the others take all "
        f"frames: build-lut {session} LUT"
    )


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut info")
def info(
    lut: Table,
    cite: Annotated[bool, typer.Option("--cite", help="Print its BibTeX entry alone.")] = False,
    *,
    output: JsonOutput,
) -> None:
    """Print what a table is and what it was made of.

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


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut verify")
def verify(
    lut: Table,
    session: Annotated[
        Path | None, typer.Argument(help="Folder of its session, to hash the frames too; else the table alone.")
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Hash every byte of a table again and name what has changed; with SESSION, its frames too.

    Reads LUT and SESSION; writes nothing. Ends with 2 where anything has changed.
    """
    from calibration.pipeline.frames import frame_faults
    from calibration.table.lut import open_lut
    from calibration.table.verification import find_faults
    from experiment.session.folder import Session

    folder = table_folder(lut)
    table = open_lut(folder, check=False)
    with progress("reading the samples") as shown:
        faults = find_faults(table, shown)
    if session is not None:
        with Session.open(session) as opened, progress("reading the frames") as shown:
            faults += frame_faults(table, opened, shown)
    output.add(table=folder, sha256=table.sha256, frames=None if session is None else len(table.frames), faults=faults)
    for fault in faults:
        print(fault)
    if faults:
        raise FormatError(
            f"{folder} is not as it was built: {len(faults)} faults; restore it from a copy, or build it again"
        )
    frames = "" if session is None else f", and so are its {len(table.frames)} frames in {session}"
    print(f"{folder}: every byte is as it was built{frames}")


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut match")
def match(
    one: Annotated[Path, typer.Argument(metavar="LUT1", help="Folder of a table.")],
    other: Annotated[Path, typer.Argument(metavar="LUT2", help="Folder of another.")],
    *,
    output: JsonOutput,
) -> None:
    """Check whether colours and lights of two tables, of two cameras perhaps, correspond number by number.

    Reads both; writes nothing. Ends with 2 where they do not correspond.
    """
    from calibration.table.lut import open_lut
    from calibration.table.verification import require_match

    folders = table_folder(one), table_folder(other)
    tables = open_lut(folders[0]), open_lut(folders[1])
    require_match(*tables)
    output.add(tables=folders, cameras=[table.provenance.camera for table in tables], match=True)
    cameras = " and ".join(table.provenance.camera for table in tables)
    print(f"{folders[0]} and {folders[1]} ({cameras}): colours and lights correspond number by number")


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut compare")
def compare(
    one: Annotated[Path, typer.Argument(metavar="A", help="Folder of a table or a session.")],
    other: Annotated[Path, typer.Argument(metavar="B", help="Folder of another of the same chart.")],
    out: Annotated[
        Path | None,
        option("FOLDER", "Write report.html with its pictures, comparison.json, lights.csv and cells.csv there."),
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Compare two tables, or sessions, of one chart: what differs, and whether noise alone explains it.

    Reads A and B. A session's table is made for the comparison, with the usual options, and thrown away. Writes FOLDER
    if --out names it. The lights' colour and brightness and every cell are compared. Ends with 0 whatever is found,
    with 2 where the charts differ or no light is in both, with 4 where a session makes no table.
    """
    from calibration.comparison.comparing import chart_of, table_of
    from calibration.comparison.comparing import compare as compare_tables
    from calibration.comparison.report import comparison_json, lines, write_comparison

    if out is not None:
        require_free(out, "the comparison")
    places = table_folder(one), table_folder(other)
    with (
        progress("reading") as shown,
        table_of(places[0], shown) as a,
        table_of(places[1], shown) as b,
    ):
        found = compare_tables(a, b, shown, places)
    if output.is_requested:
        output.add(**comparison_json(found))
    else:
        print("\n".join(lines(found)))
    if out is not None:
        write_comparison(found, out, chart_of(places))


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut publish")
def publish(
    lut: Table,
    url: Annotated[str, typer.Argument(help="New folder, or place in a store that fsspec knows, such as s3://….")],
    *,
    output: JsonOutput,
) -> None:
    """Write a table as a sharded Zarr array to a folder or a store for others.

    Reads LUT; writes URL.
    """
    from calibration.table.lut import open_lut
    from calibration.table.zarr_store import publish as publish_table

    folder = table_folder(lut)
    table = open_lut(folder)
    with progress("writing lights") as shown:
        publish_table(table, url, shown)
    output.add(table=folder, url=masked(url), lights=len(table.samples), sha256=table.sha256)
    print(f"{masked(url)}: {len(table.samples)} lights of {folder}; others get them by")
    print(f"build-lut fetch {masked(url)} LUT --expect {table.sha256}")


@_others.command(epilog=EXIT_CODES)
@with_json("build-lut fetch")
def fetch(
    url: Annotated[str, typer.Argument(help="Folder or place in a store where a table was published.")],
    lut: NewTable,
    expect: Annotated[
        str | None,
        option(
            "SHA256",
            "The table's hash as build-lut info prints it, told by somebody you trust; another table is refused.",
        ),
    ] = None,
    *,
    output: JsonOutput,
) -> None:
    """Copy a published table to a new folder, where it is used, and verify it.

    Reads URL; writes LUT.
    """
    from calibration.table.zarr_store import fetch as fetch_table

    with progress("reading lights") as shown:
        table = fetch_table(url, lut, shown, expect)
    output.add(table=lut, url=masked(url), lights=len(table.samples), sha256=table.sha256, expected=expect is not None)
    print(f"{lut}: {len(table.samples)} lights, {printable(table.provenance.camera)}; {_vouched(table, expect)}")


def _vouched(lut: Lut, expect: str | None) -> str:
    if expect is not None:
        return "it is the table expected, and every file is as it was built"
    return (
        f"every file is as its own hashes say; that it is the table you mean shows its hash, {lut.sha256}: compare it "
        "with the one you were told, or give that with --expect"
    )


def _print_result(result: BuildResult, output: JsonOutput) -> None:
    """Print the figures that matter most, the remarks, and the verdict; or add all that `report.json` holds."""
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
