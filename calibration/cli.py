"""`build-lut`: makes the table of a session, or only judges it. Parse, build, call, print; nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drivers import console
from drivers.console import EXIT_CODES
from drivers.errors import InputError

if TYPE_CHECKING:
    from acquisition.session import Session
    from calibration.build import BuildResult

app = typer.Typer(add_completion=False, rich_markup_mode=None)


def main() -> int:
    """Run `build-lut` and return its exit code."""
    return console.run(app)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        print(f"croplab {version('croplab')}")
        raise typer.Exit


@app.command(
    no_args_is_help=True,
    help="Build the look-up table of a session: 25 samples of every colour under every light, and the ground truth.\n\n"
    "Reads SESSION (chart.json, illuminations.csv, journal.sqlite, frames/) and checks each frame's SHA-256. Finds the "
    "chart once, follows it if it moves, divides the light's unevenness out, and writes LUT: samples.npy, "
    "illuminations.csv with the ground truth, lut.json, report.html. LUT appears whole or not at all.\n\n"
    "Every figure is held against its limit: accept, accept with remarks, or refuse. A refused table is not written; "
    "its report is then in LUT.refused/, and the exit code 4.\n\n"
    "With --check, finds the chart in the session's best frame, judges it, and writes nothing.\n\n" + EXIT_CODES,
)
def build_lut(
    session: Annotated[Path, typer.Argument(help="Folder of a session, made by acquire run or acquire import.")],
    lut: Annotated[Path | None, typer.Argument(help="New folder for the table; not with --check.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Register and judge only; write nothing.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """Build or check; what the command does is told by its help text."""
    if check and lut is not None:
        raise InputError(f"--check writes nothing, so a table's folder ({lut}) is not expected; leave one of them out")
    if not check and lut is None:
        raise InputError("a folder for the table is expected: build-lut SESSION LUT, or --check to judge only")
    from acquisition.session import Session

    with Session.open(session) as opened:
        if lut is None:
            from calibration.build import check as judge

            result = judge(opened)
        else:
            result = _build(opened, lut)
    _tell(result)
    if lut is None and (verdict := result.verdict).refused:
        from calibration.verdict import refusal
        from drivers.errors import QualityError

        raise QualityError(f"{result.session}: {refusal(verdict, result)}")


def _build(opened: Session, lut: Path) -> BuildResult:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from calibration.build import build
    from calibration.report import write_report

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("finding the chart", total=None)

        def told(done: int, total: int, what: str) -> None:
            progress.update(task, completed=done, total=total, description=what)

        return build(opened, lut, told, write_report)


def _tell(result: BuildResult) -> None:
    from calibration.report import summary

    names = {
        "Tags found",
        "Blocks of cells",
        "Colours agree",
        "Chart moved",
        "White drift",
        "Ground truth",
        "Cells unfit",
    }
    for name, value, note in summary(result):
        if name in names:
            print(f"{name + ':':17}{value}" + (f"  ({note})" if note else ""))
    verdict = result.verdict
    for row in verdict.remarks:
        print(f"remark: {row.text()}; {row.threshold.remedy}")
    print(f"{'Verdict:':17}{verdict.outcome}")
    if verdict.refused:
        return
    if result.lut is None:
        print(f"{result.session}: the chart is found and is the one expected; a table can be built")
    else:
        print(f"{result.lut}: {result.lights} lights, {result.camera}; see {result.lut / 'report.html'}")
