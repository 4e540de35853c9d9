"""What `build-lut` does with tables that are there: it describes, cites, verifies, matches and publishes."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from foundation.console import shows_progress
from foundation.errors import FormatError
from foundation.secret_texts import masked, printable

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from foundation.console import JsonOutput


def print_table(folder: Path, told: JsonOutput) -> None:
    """Print what a table is and what it was made of, a line each."""
    from calibration.table.description import describe
    from calibration.table.lut import open_lut

    lut = open_lut(folder)
    told.add(
        table=folder,
        sha256=lut.sha256,
        lights=len(lut.white),
        colours=8**lut.provenance.bits,
        samples=int(lut.samples.shape[2]),
        provenance=lut.provenance.model_dump(mode="json"),
    )
    for name, value in describe(lut):
        print(f"{name + ':':17}{printable(value)}")


def print_citation(folder: Path, told: JsonOutput) -> None:
    """Print a BibTeX entry of a table."""
    from calibration.table.description import citation_of
    from calibration.table.lut import open_lut

    entry = printable(citation_of(open_lut(folder)))
    told.add(table=folder, bibtex=entry)
    print(entry, end="")


def verify_table(folder: Path, session: Path | None, told: JsonOutput) -> None:
    """Hash every byte of a table again, with a session its frames too; a FormatError where anything changed."""
    from calibration.table.lut import open_lut
    from calibration.table.verification import find_faults

    lut = open_lut(folder, check=False)
    with progress_bar("reading the samples") as progress:
        faults = find_faults(lut, lambda done, total: progress(done, total, "reading the samples"))
    if session is not None:
        from calibration.pipeline.frames import frame_faults
        from experiment.session.folder import Session

        with Session.open(session) as opened, progress_bar("reading the frames") as progress:
            faults += frame_faults(lut, opened, progress)
    told.add(table=folder, sha256=lut.sha256, frames=None if session is None else len(lut.frames), faults=faults)
    for fault in faults:
        print(fault)
    if faults:
        raise FormatError(
            f"{folder} is not as it was built: {len(faults)} faults; restore it from a copy, or build it again"
        )
    frames = "" if session is None else f", and so are its {len(lut.frames)} frames in {session}"
    print(f"{folder}: every byte is as it was built{frames}")


def match_tables(one: Path, other: Path, told: JsonOutput) -> None:
    """Print that two tables correspond number by number; a FormatError says where they do not."""
    from calibration.table.lut import open_lut
    from calibration.table.verification import require_match

    tables = open_lut(one), open_lut(other)
    require_match(*tables)
    told.add(tables=[one, other], cameras=[table.provenance.camera for table in tables], match=True)
    cameras = " and ".join(table.provenance.camera for table in tables)
    print(f"{one} and {other} ({cameras}): colours and lights correspond number by number")


def publish_table(folder: Path, url: str, told: JsonOutput) -> None:
    """Copy a table to a store, and print how others get it."""
    from calibration.table.lut import open_lut
    from calibration.table.zarr_store import publish

    lut = open_lut(folder)
    with progress_bar("writing lights") as progress:
        publish(lut, url, lambda done, total: progress(done, total, "writing lights"))
    told.add(table=folder, url=masked(url), lights=len(lut.samples), sha256=lut.sha256)
    print(f"{masked(url)}: {len(lut.samples)} lights of {folder}; others get them by")
    print(f"build-lut --fetch {masked(url)} LUT --expect {lut.sha256}")


def fetch_table(url: str, folder: Path, expect: str | None, told: JsonOutput) -> None:
    """Copy a published table from a store, and print what is known of it."""
    from calibration.table.zarr_store import fetch

    with progress_bar("reading lights") as progress:
        lut = fetch(url, folder, lambda done, total: progress(done, total, "reading lights"), expect)
    told.add(table=folder, url=masked(url), lights=len(lut.samples), sha256=lut.sha256, expected=expect is not None)
    print(f"{folder}: {len(lut.samples)} lights, {printable(lut.provenance.camera)}; {_vouched(lut, expect)}")


def _vouched(lut: Lut, expect: str | None) -> str:
    """Return in words what is known of a table that was fetched."""
    if not lut.provenance.lights_sha256:
        return "it has no hashes, so that nobody can say whether it is as it was built"
    covered = "every file is" if lut.provenance.has_sums else "ground truth and samples are (it is an older table)"
    if expect is not None:
        return f"it is the table expected, and {covered} as it was built"
    return (
        f"{covered} as its own hashes say; that it is the table you mean shows its hash, {lut.sha256}: compare it with "
        "the one you were told, or give that with --expect"
    )


@contextmanager
def progress_bar(beginning: str) -> Generator[Callable[[int, int, str], None]]:
    """Show a bar of progress on stderr; yield what is to be called with done, total, and the present work."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not shows_progress()) as bar:
        task = bar.add_task(beginning, total=None)
        yield lambda done, total, what: bar.update(task, completed=done, total=total, description=what)
