"""A table to be compared: one that is there, or one made of a session for the comparison and thrown away."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path

from calibration.pipeline.build import build
from calibration.pipeline.options import BuildOptions
from calibration.report.report import report_json
from calibration.table.file_names import REPORT_JSON
from calibration.table.lut import Lut, open_lut
from calibration.verdict import BuildResult
from experiment.chart.model import Chart, load_chart
from experiment.session.folder import Session
from experiment.session.journal import JOURNAL_FILE
from foundation.files import storage_error, write_whole

CHART_FILE = "chart.json"
"""What was photographed, in a session's folder (docs/formats.md)."""

ReportBuild = Callable[[int, int, str], None]
"""Called with frames taken in, frames in all, and what is being done."""


@contextmanager
def table_of(place: Path, options: BuildOptions, progress: ReportBuild | None = None) -> Generator[Lut]:
    """Yield the table of a table's folder as it is, or of a session's, which is built as `build-lut` builds it.

    The table of a session lies in a hidden folder beside the session until the end: it needs 3.5 GB of 707 lights.
    """
    if not (place / JOURNAL_FILE).is_file():
        yield open_lut(place)
        return
    try:
        scratch = tempfile.TemporaryDirectory(prefix=f".{place.name}.compared.", dir=place.resolve().parent)
    except OSError as error:
        raise storage_error(place.parent, error) from error
    with scratch as folder, Session.open(place) as session:
        table = Path(folder) / "table"
        build(session, table, progress, _write_figures, options)
        yield open_lut(table)


def chart_of(places: Sequence[Path]) -> Chart | None:
    """Return the chart of the first session among the places; None where all are tables, which do not hold it."""
    found = (place / CHART_FILE for place in places if (place / JOURNAL_FILE).is_file())
    return next((load_chart(path) for path in found if path.is_file()), None)


def _write_figures(result: BuildResult, session: Session, folder: Path) -> None:
    """Write the figures of a table without its pictures, which nobody sees."""
    write_whole(folder / REPORT_JSON, json.dumps(report_json(result)) + "\n")
