"""`build-lut`: makes the table of a session, judges it; describes, verifies, matches, publishes, compares tables.

Parse, call, print; nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from foundation import console
from foundation.console import (
    EXIT_CODES,
    AsJson,
    JsonOutput,
    Licence,
    Note,
    Quiet,
    Verbose,
    Version,
    json_output,
    new_app,
    option,
    shows_progress,
)
from foundation.errors import FormatError, InputError, QualityError, counted
from foundation.secret_texts import masked, printable

if TYPE_CHECKING:
    from calibration.pipeline.frames import BuildOptions
    from calibration.table.lut import Lut
    from calibration.verdict import BuildResult
    from experiment.session.folder import Session

app = new_app()


def main(argv: Sequence[str] | None = None) -> int:
    """Run `build-lut` with arguments, those of the process if None, and return its exit code."""
    return console.run(lambda: app(args=None if argv is None else list(argv), prog_name="build-lut"))


@app.command(
    no_args_is_help=True,
    help="Build the look-up table of a session: samples of every colour under every light, and the ground truth.\n\n"
    "Reads SESSION (chart.json, illuminations.csv, journal.sqlite, frames/) and checks each frame's SHA-256. Finds the "
    "chart once, follows it if it moves, divides the light's unevenness out, and writes LUT: samples.npy, "
    "illuminations.csv with the ground truth, references.csv, lut.json, frames.csv, report.html and report.json. LUT "
    "appears whole or not at all; a build that was stopped goes on when the same command is run again.\n\n"
    "Every figure is compared with its limit: accept, accept with remarks, or refuse. A refused table is not written; "
    "its report is then in LUT.refused/, and the exit code is 4.\n\n"
    "With --check, finds the chart in the session's best frame, judges it, and writes nothing. With --append, takes in "
    "the frames that have come so far of a session that is being taken; LUT appears with the last of them. With "
    "--info, --cite, --verify and --match, reads a table and writes nothing. With --publish and --fetch, copies a "
    "table to a store for others and back.\n\n"
    "With --compare A B, says how far two sessions or tables of one chart differ in the lights' colour and brightness "
    "and in every cell, what noise alone predicts of it, and whether they are the same within noise; --out "
    "writes a page. The exit code is 0 whatever is found, 2 where the charts differ or no light "
    "is in both, 4 where a session makes no table.\n\n" + EXIT_CODES,
)
def build_lut(
    session: Annotated[
        Path | None, typer.Argument(help="Folder of a session, made by acquire run or acquire import.")
    ] = None,
    lut: Annotated[Path | None, typer.Argument(help="New folder for the table; not with --check.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Register and judge only; write nothing.")] = False,
    append: Annotated[
        bool, typer.Option("--append", help="Take in what has come of a session that is being taken.")
    ] = False,
    picture: Annotated[
        Path | None,
        option("PNG", "With --check, save the frame with what of the chart was found on it, or was looked for."),
    ] = None,
    window: Annotated[
        int | None,
        option("N", "Pixels along the side of a cell's window: 3, 5, 7 or 9. \\[default: 5]"),
    ] = None,
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
    corners: Annotated[
        tuple[str, str, str, str] | None,
        option(
            "X,Y X,Y X,Y X,Y",
            "For a chart without tags: the corners of its field of cells in the frame that is registered first, "
            "pixels of the raw file, clockwise from the printed top-left.",
        ),
    ] = None,
    linearity: Annotated[
        Path | None,
        option(
            "FOLDER",
            "Judge the sensor's linearity by raw files of the chart in its place, under one light, with exposure "
            "times from dim to nearly saturated.",
        ),
    ] = None,
    note: Note = None,
    licence: Licence = None,
    author: Annotated[
        list[str] | None,
        option(
            '"FAMILY, GIVEN"',
            "Who made the table; several times for several. As --note, --licence and --serial in place of "
            "\\[citation] in the session's LAB.toml.",
        ),
    ] = None,
    serial: Annotated[
        str | None,
        option("hash|plain|withheld", "How the camera's serial number is told in the table. \\[default: hash]"),
    ] = None,
    info: Annotated[
        Path | None,
        option("LUT", "Print what a table is and what it was made of."),
    ] = None,
    cite: Annotated[
        Path | None,
        option("LUT", "Print a BibTeX entry of a table."),
    ] = None,
    verify: Annotated[
        Path | None,
        option("LUT", "Hash every byte of a table again and name what has changed; with SESSION, its frames too."),
    ] = None,
    match: Annotated[
        tuple[Path, Path] | None,
        option(
            "LUT LUT",
            "Check whether colours and lights of two tables, of two cameras perhaps, correspond number by number.",
        ),
    ] = None,
    compare: Annotated[
        tuple[Path, Path] | None,
        option(
            "A B",
            "Compare two tables, or sessions, of one chart: what differs, and whether noise alone explains it. A "
            "session's table is made for it and thrown away.",
        ),
    ] = None,
    as_json: AsJson = False,
    out: Annotated[
        Path | None,
        option(
            "FOLDER",
            "With --compare, write report.html with its pictures, comparison.json, lights.csv and cells.csv into "
            "a new folder.",
        ),
    ] = None,
    chart: Annotated[
        Path | None,
        option(
            "CHART.json",
            "With --compare of tables and --out, the chart.json of both, so that differences are drawn on the "
            "print; sessions have it.",
        ),
    ] = None,
    publish: Annotated[
        tuple[Path, str] | None,
        option(
            "LUT URL", "Write a table as a sharded Zarr array to a folder or a store that fsspec knows, such as s3://…."
        ),
    ] = None,
    fetch: Annotated[
        tuple[str, Path] | None,
        option("URL LUT", "Copy a published table to a new folder, where it is used, and verify it."),
    ] = None,
    expect: Annotated[
        str | None,
        option(
            "SHA256",
            "With --fetch, the table's hash as --info prints it, told by somebody you trust; another table is refused.",
        ),
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = False,
    version: Version = False,
) -> None:
    """Build, check or read a table; the help text says what the command does."""
    reading = {
        "--info": info,
        "--cite": cite,
        "--verify": verify,
        "--match": match,
        "--publish": publish,
        "--fetch": fetch,
    }
    asked = {"--check": check, "--append": append, "--compare": compare, **reading}
    given = [name for name, value in asked.items() if value]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} are two commands; give one of them")
    made = {
        "--window": window is not None,
        "--subtract-dark": subtract_dark,
        "--correct-drift": correct_drift,
        "--no-lens-correction": no_lens_correction,
        "--corners": corners is not None,
        "--linearity": linearity is not None,
        "--note": note is not None,
        "--licence": licence is not None,
        "--author": bool(author),
        "--serial": serial is not None,
    }
    if any(reading.values()) and any(made.values()):
        raise InputError(
            f"{next(name for name, value in made.items() if value)} is about how a table is made, and {given[0]} reads "
            "one; leave one of them out"
        )
    if expect is not None and fetch is None:
        raise InputError("--expect goes with --fetch; leave it out")
    beside = {"--out": out, "--chart": chart}
    if compare is None and any(beside.values()):
        raise InputError(f"{next(name for name, value in beside.items() if value)} goes with --compare; leave it out")
    if (lut if verify else session if compare or any(reading.values()) else None) is not None:
        raise InputError(f"{given[0]} does not expect {lut or session}; leave it out")
    from calibration.table.demo_table import table_folder

    with json_output("build-lut", as_json) as output:
        if info is not None:
            _print_table(table_folder(info), output)
        elif cite is not None:
            _print_citation(table_folder(cite), output)
        elif verify is not None:
            _verify_table(table_folder(verify), session, output)
        elif match is not None:
            _match_tables(table_folder(match[0]), table_folder(match[1]), output)
        elif publish is not None:
            _publish_table(table_folder(publish[0]), publish[1], output)
        elif fetch is not None:
            _fetch_table(*fetch, expect, output)
        else:
            from calibration.pipeline.frames import BuildOptions
            from calibration.sampling import WINDOW
            from experiment.framing.field import parse_corners

            if picture is not None and not check:
                raise InputError("--picture goes with --check; a table that is built has its report")
            places = None if corners is None else parse_corners(corners)
            samples = WINDOW if window is None else window
            options = BuildOptions(samples, subtract_dark, places, correct_drift, not no_lens_correction)
            stated = {"note": note, "licence": licence, "authors": author or None, "camera_serial": serial}
            changes = {name: value for name, value in stated.items() if value is not None}
            if compare is not None:
                unfit = [name for name in ("--linearity", "--note", "--licence", "--author", "--serial") if made[name]]
                if unfit:
                    raise InputError(f"{unfit[0]} is for the report of one table; leave it out of --compare")
                _compare(table_folder(compare[0]), table_folder(compare[1]), options, output, out, chart)
                return
            _make(session, lut, check, append, options, linearity, picture, changes, output)


def _print_table(folder: Path, output: JsonOutput) -> None:
    """Print what a table is and what it was made of, a line each."""
    from calibration.table.lut import open_lut
    from calibration.table.verification import describe

    lut = open_lut(folder)
    output.add(
        table=folder,
        sha256=lut.sha256,
        lights=len(lut.white),
        colours=8**lut.provenance.bits,
        samples=int(lut.samples.shape[2]),
        provenance=lut.provenance.model_dump(mode="json"),
    )
    for name, value in describe(lut):
        print(f"{name + ':':17}{printable(value)}")


def _print_citation(folder: Path, output: JsonOutput) -> None:
    """Print a BibTeX entry of a table."""
    from calibration.table.lut import open_lut
    from calibration.table.verification import citation_of

    entry = printable(citation_of(open_lut(folder)))
    output.add(table=folder, bibtex=entry)
    print(entry, end="")


def _verify_table(folder: Path, session: Path | None, output: JsonOutput) -> None:
    """Hash every byte of a table again, with a session its frames too; a FormatError where anything changed."""
    from calibration.table.lut import open_lut
    from calibration.table.verification import find_faults

    lut = open_lut(folder, check=False)
    with _progress_bar("reading the samples") as progress:
        faults = find_faults(lut, lambda done, total: progress(done, total, "reading the samples"))
    if session is not None:
        from calibration.pipeline.baseline import frame_faults
        from experiment.session.folder import Session

        with Session.open(session) as opened, _progress_bar("reading the frames") as progress:
            faults += frame_faults(lut, opened, progress)
    output.add(table=folder, sha256=lut.sha256, frames=None if session is None else len(lut.frames), faults=faults)
    for fault in faults:
        print(fault)
    if faults:
        raise FormatError(
            f"{folder} is not as it was built: {len(faults)} faults; restore it from a copy, or build it again"
        )
    frames = "" if session is None else f", and so are its {len(lut.frames)} frames in {session}"
    print(f"{folder}: every byte is as it was built{frames}")


def _match_tables(one: Path, other: Path, output: JsonOutput) -> None:
    """Print that two tables correspond number by number; a FormatError says where they do not."""
    from calibration.table.lut import open_lut
    from calibration.table.verification import require_match

    tables = open_lut(one), open_lut(other)
    require_match(*tables)
    output.add(tables=[one, other], cameras=[table.provenance.camera for table in tables], match=True)
    cameras = " and ".join(table.provenance.camera for table in tables)
    print(f"{one} and {other} ({cameras}): colours and lights correspond number by number")


def _publish_table(folder: Path, url: str, output: JsonOutput) -> None:
    """Copy a table to a store, and print how others get it."""
    from calibration.table.lut import open_lut
    from calibration.table.zarr_store import publish

    lut = open_lut(folder)
    with _progress_bar("writing lights") as progress:
        publish(lut, url, lambda done, total: progress(done, total, "writing lights"))
    output.add(table=folder, url=masked(url), lights=len(lut.samples), sha256=lut.sha256)
    print(f"{masked(url)}: {len(lut.samples)} lights of {folder}; others get them by")
    print(f"build-lut --fetch {masked(url)} LUT --expect {lut.sha256}")


def _fetch_table(url: str, folder: Path, expect: str | None, output: JsonOutput) -> None:
    """Copy a published table from a store, and print what is known of it."""
    from calibration.table.zarr_store import fetch

    with _progress_bar("reading lights") as progress:
        lut = fetch(url, folder, lambda done, total: progress(done, total, "reading lights"), expect)
    output.add(table=folder, url=masked(url), lights=len(lut.samples), sha256=lut.sha256, expected=expect is not None)
    print(f"{folder}: {len(lut.samples)} lights, {printable(lut.provenance.camera)}; {_vouched(lut, expect)}")


def _vouched(lut: Lut, expect: str | None) -> str:
    """Return in words what is known of a table that was fetched."""
    if expect is not None:
        return "it is the table expected, and every file is as it was built"
    return (
        "every file is as its own hashes say; that it is the table you mean shows its hash, "
        f"{lut.sha256}: compare it with the one you were told, or give that with --expect"
    )


def _make(
    session: Path | None,
    lut: Path | None,
    check: bool,
    append: bool,
    options: BuildOptions,
    linearity: Path | None,
    picture: Path | None,
    changes: dict[str, Any],
    output: JsonOutput,
) -> None:
    if check and lut is not None:
        raise InputError(f"--check writes nothing, so a table's folder ({lut}) is not expected; leave one of them out")
    if session is None:
        raise InputError("a session is expected: build-lut SESSION LUT; see build-lut --help")
    if lut is None and not check:
        raise InputError("a folder for the table is expected: build-lut SESSION LUT, or --check to judge only")
    from calibration.citation import with_changes
    from calibration.pipeline.baseline import stated_origin
    from experiment.session.folder import Session

    with Session.open(session) as opened:
        if changes:
            options = replace(options, citation=with_changes(stated_origin(opened).citation, changes))
        if lut is None:
            _check(opened, options, linearity, picture, output)
        else:
            _build(opened, lut, append, options, linearity, output)


def _check(
    session: Session, options: BuildOptions, linearity: Path | None, picture: Path | None, output: JsonOutput
) -> None:
    from calibration.pipeline.build import check
    from calibration.verdict import refusal

    result = check(session, options, linearity, picture)
    _print_result(result, output)
    if result.verdict.refused:
        raise QualityError(f"{session.folder}: {refusal(result.verdict, result.figures)}")
    judged = counted(len(result.verdict.rows), "figure")
    print(
        f"{session.folder}: the chart is found and is the one expected; this frame tells {judged}, the others take all "
        f"frames: build-lut {session.folder} LUT"
    )


def _build(
    session: Session, lut: Path, so_far: bool, options: BuildOptions, linearity: Path | None, output: JsonOutput
) -> None:
    import json

    from calibration.pipeline.build import TableProgress, append, build, refused_folder
    from calibration.report.report import write_report
    from calibration.table.lut import REPORT_JSON, REPORT_PAGE

    kept = refused_folder(lut) / REPORT_JSON
    before = kept.stat().st_mtime_ns if kept.is_file() else None
    make = append if so_far else build
    try:
        with _progress_bar("finding the chart") as progress:
            result = make(session, lut, progress, write_report, options, linearity)
    except QualityError:
        # A report of an earlier build says nothing of this one.
        if output.asked and kept.is_file() and kept.stat().st_mtime_ns != before:
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


def _compare(
    one: Path, other: Path, options: BuildOptions, output: JsonOutput, out: Path | None, chart: Path | None
) -> None:
    from calibration.comparison.comparing import chart_of, compare, table_of
    from calibration.comparison.report import comparison_json, lines
    from experiment.chart.model import load_chart
    from foundation.folders import require_free

    if out is not None:
        require_free(out, "the comparison")
    with (
        _progress_bar("reading") as progress,
        table_of(one, options, progress) as a,
        table_of(other, options, progress) as b,
    ):
        found = compare(a, b, lambda done, total: progress(done, total, "comparing lights"), (one, other))
        drawn = chart_of((one, other)) if chart is None else load_chart(chart)
        if drawn is not None and drawn.sha256 != a.provenance.chart_sha256:
            raise FormatError(f"{chart} is not the chart of {one}; name the chart.json that was printed")
    if output.asked:
        output.add(**comparison_json(found))
    else:
        print("\n".join(lines(found)))
    if out is not None:
        from calibration.comparison.report import write_comparison

        write_comparison(found, out, drawn)


def _print_result(result: BuildResult, output: JsonOutput) -> None:
    """Print the figures that matter most, the remarks, and the verdict; or add all that `report.json` holds."""
    if output.asked:
        from calibration.report.report import report_json

        output.add(**report_json(result))
        return
    from calibration.report.report import summary
    from calibration.verdict import remark

    rows = [row for row in summary(result.figures) if row.brief]
    width = max(len(row.name) for row in rows) + 2
    for row in rows:
        print(f"{row.name + ':':{width}}{row.value}" + (f"  ({row.note})" if row.note else ""))
    for judged in result.verdict.remarks:
        print(f"remark: {remark(judged, result.figures)}")
    print(f"{'Verdict:':{width}}{result.verdict.outcome}")


@contextmanager
def _progress_bar(beginning: str) -> Generator[Callable[[int, int, str], None]]:
    """Show a bar of progress on stderr; yield what is to be called with done, total, and the present work."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not shows_progress()) as bar:
        task = bar.add_task(beginning, total=None)
        yield lambda done, total, what: bar.update(task, completed=done, total=total, description=what)


if __name__ == "__main__":
    raise SystemExit(main())
