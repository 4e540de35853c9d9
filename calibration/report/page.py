"""`report.html`: verdict, what to do, figures in their groups, pictures and unfit cells, in one file to be mailed.

The page is `templates/report.html`; here stands what it shows. Each figure's row comes from the figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calibration.citation import origin_lines
from calibration.figures.all_figures import BY_NAME, FIGURES
from calibration.figures.figure import QUESTIONS, Drawing, Group, Outcome, SummaryRow, Worst
from calibration.measurements import TableMeasurements
from calibration.verdict import (
    COMMAND,
    BuildResult,
    JudgedValue,
    ProbableCause,
    detail_and_remedy,
    findings,
    is_mended_by_retaking,
    places_text,
    retake_command,
    retaken_frames,
)
from foundation.errors import counted, first_of
from foundation.pages import render

MOST_UNFIT = 200
"""Unfit cells that are listed; all of them are in lut.json, and a page of thousands is read by nobody."""

_WORDS: dict[Outcome, str] = {"refuse": "refuse", "accept with remarks": "remark", "accept": "accept"}
"""Outcomes, the worst first, as the page says them."""

_ORDER: tuple[Outcome, ...] = tuple(_WORDS)


@dataclass(frozen=True)
class Picture:
    """A picture of the report, PNG, with its heading and what it shows.

    `group` is the one it is folded with; None for those that stand open on top. `name` is what figures say of it.
    """

    heading: str
    caption: str
    png: bytes
    group: Group | None = None
    name: Drawing | None = None


@dataclass(frozen=True)
class _Row:
    """A judged value with what helps and where its worst is, as far as these are to be said."""

    judged: JudgedValue
    remedy: str
    worst: str


def page(
    result: BuildResult,
    pictures: Sequence[Picture],
    places: Sequence[Picture] = (),
    worsts: Mapping[str, Worst] | None = None,
) -> str:
    """Return the text of `report.html`: verdict, what to do, what to look at first, then all figures in groups.

    `places` are pictures of what is beyond a limit, `worsts` where the worst of figures is, by name.
    """
    table, verdict = result.figures, result.verdict
    found, beyond = findings(verdict, table), len(verdict.refused) + len(verdict.remarks)
    rows = [
        _Row(row, _remedy(row, found.get(row.figure.name), table), "" if worst is None else worst.where)
        for row in sorted(verdict.rows, key=lambda row: _ORDER.index(row.outcome))
        for worst in [(worsts or {}).get(row.figure.name)]
    ]
    simulated = ", taken in the simulated laboratory" if table.origin.rig == "simulated" else ""
    return render(
        "calibration.report",
        "report.html",
        title=f"Table of {table.session.lights} lights, {table.session.camera}",
        taken=f"Session {table.session.folder.name}{simulated}",
        words=_WORDS,
        outcome=verdict.outcome,
        sentence={
            "accept": "Accepted: every figure is within its limit.",
            "accept with remarks": f"Accepted with remarks on {len(verdict.remarks)} of {len(verdict.rows)} figures.",
            "refuse": f"Refused: {len(verdict.refused)} of {len(verdict.rows)} figures are beyond what can be used.",
        }[verdict.outcome],
        usable=not verdict.refused,
        todo=rows[:beyond],
        again=_again(result),
        causes=[_cause(each) for each in found.values()],
        first=[*places, *(picture for picture in pictures if picture.group is None)],
        drawn={picture.name for picture in pictures if picture.name is not None},
        groups=[_group(group, rows, table, pictures) for group in QUESTIONS],
        origin=origin_lines(table.origin),
        unfit=table.cells.unfit,
        most_unfit=MOST_UNFIT,
    ).text


def summary(table: TableMeasurements, group: Group | None = None) -> list[SummaryRow]:
    """Return the lines that say how good a table is, in their order: of all figures, or of a group's."""
    session = table.session
    lines = (line for one in FIGURES if group in (None, one.group) for line in one.lines)
    found = (line.row(table) for line in sorted(lines, key=lambda line: line.place))
    rows = [row for row in found if row is not None]
    if group not in (None, "geometry"):
        return rows
    return [
        SummaryRow("Lights", str(session.lights), "with an accepted frame"),
        SummaryRow("Frame registered", session.registered_file, ""),
        *rows,
    ]


def _group(group: Group, rows: Sequence[_Row], table: TableMeasurements, pictures: Sequence[Picture]) -> dict[str, Any]:
    """Return a group of figures, folded unless something in it is beyond its limit."""
    own = [row for row in rows if row.judged.figure.group == group]
    beyond = sum(row.judged.outcome != "accept" for row in own)
    within = f"{beyond} beyond their limits" if beyond else "all within their limits"
    return {
        "name": group,
        "question": QUESTIONS[group],
        "beyond": beyond,
        "summary": f"{counted(len(own), 'figure')}, {within}",
        "rows": own,
        "lines": summary(table, group),
        "pictures": [picture for picture in pictures if picture.group == group],
    }


def _again(result: BuildResult) -> dict[str, Any] | None:
    """Return which frames are to be taken again and how; None where taking frames again does not help."""
    records = retaken_frames(result.verdict, result.figures)
    if not records:
        return None
    return {
        "count": counted(len(records), "frame"),
        "files": first_of([record.file for record in records]),
        "command": COMMAND,
        "mends": is_mended_by_retaking(result.verdict, result.figures),
    }


def _remedy(row: JudgedValue, found: ProbableCause | None, table: TableMeasurements) -> str:
    """Return what helps against what is beyond a limit; "" where nothing is."""
    if row.outcome == "accept":
        return ""
    _, remedy = detail_and_remedy(row.figure, table)
    if found is None or not remedy:
        return remedy
    return found.decision.cause.remedy if found.is_known else f"it may help to {remedy}"


def _cause(found: ProbableCause) -> dict[str, Any]:
    """Return a finding with its probable cause, frames, place and command."""
    return {
        "title": BY_NAME[found.figure].title,
        "cause": found.decision.cause.name,
        "rule": found.decision.rule,
        "command": retake_command(found.frames) if found.is_of_frames else "",
        "places": places_text(found),
        "evidence": found.evidence.in_words(),
    }
