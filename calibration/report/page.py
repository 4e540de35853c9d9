"""`report.html`: verdict, figures, pictures and unfit cells, all in one file that can be mailed."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from calibration.causes.findings import ProbableCause
from calibration.citation import OriginRecord, origin_lines
from calibration.report.groups import GROUPS, OF_THRESHOLDS, QUESTIONS, Group, group_of_row
from calibration.report.style import STYLE
from calibration.report.summary import summary
from calibration.report.worsts import Worst
from calibration.table.lut import Unfit
from calibration.verdict.result import BuildResult
from calibration.verdict.retaking import COMMAND, findings, is_mended_by_retaking, retake_command, retaken_frames
from calibration.verdict.verdict import JudgedValue, Outcome, format_value
from calibration.verdict.wording import places_text
from foundation.errors import counted, first_of

MOST_UNFIT = 200
"""Unfit cells that are listed; all of them are in lut.json, and a page of thousands is read by nobody."""

_CLASSES: dict[Outcome, str] = {"accept": "accept", "accept with remarks": "remark", "refuse": "refuse"}
"""Classes of the style sheet, and the words of the table's first column."""

PictureGroup = Group | Literal["first"]

_ORDER: tuple[Outcome, ...] = ("refuse", "accept with remarks", "accept")
"""Outcomes, the worst first."""


@dataclass(frozen=True)
class Picture:
    """A picture of the report, PNG, with its heading and what it shows.

    `group` is the one it is folded with, or ``first`` for those that stand open on top.
    """

    heading: str
    caption: str
    png: bytes
    group: PictureGroup = "first"


def page(
    result: BuildResult, pictures: Sequence[Picture], places: Sequence[Picture] = (), worsts: Sequence[Worst] = ()
) -> str:
    """Return the text of `report.html`: verdict, what to do, what to look at first, then all figures in groups."""
    session = result.figures.session
    title = f"Table of {session.lights} lights, {session.camera}"
    first = "".join(picture_html(picture) for picture in pictures if picture.group == "first")
    groups = "".join(_group(group, result, pictures, worsts) for group in GROUPS)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>\n"
        f'<h1>{html.escape(title)}</h1><p class="note">Session {html.escape(session.folder.name)}'
        f"{html.escape(_rig_note(result))}</p>\n"
        f"{_verdict(result)}{_what_to_do(result)}{_causes(result)}{''.join(map(picture_html, places))}{first}"
        f"<h2>All figures</h2>{groups}"
        f"{_origin(result.figures.origin)}{_unfit(result.figures.cells.unfit)}</body></html>\n"
    )


def _rig_note(result: BuildResult) -> str:
    """Return what a reader must not overlook of where the frames come from."""
    return ", taken in the simulated laboratory" if result.figures.origin.rig == "simulated" else ""


def _verdict(result: BuildResult) -> str:
    """Return the verdict in one sentence."""
    verdict = result.verdict
    sentence = {
        "accept": "Accepted: every figure is within its limit.",
        "accept with remarks": f"Accepted with remarks on {len(verdict.remarks)} of {len(verdict.rows)} figures.",
        "refuse": f"Refused: {len(verdict.refused)} of {len(verdict.rows)} figures are beyond what can be used.",
    }[verdict.outcome]
    return f"<p class='verdict {_CLASSES[verdict.outcome]}'>{sentence}</p>"


def _what_to_do(result: BuildResult) -> str:
    """Return what to do about the verdict: each figure beyond its limit with its remedy, and frames to take again."""
    verdict, found = result.verdict, findings(result.verdict, result.figures)
    beyond = sorted((*verdict.refused, *verdict.remarks), key=lambda row: _ORDER.index(row.outcome))
    if not beyond:
        return "<h2>What to do</h2><p>Nothing: the table can be used. Look at the pictures once.</p>"
    rows = "".join(
        f"<li><b>{html.escape(row.threshold.title)}</b>, {html.escape(format_value(row.value, row.threshold.unit))} "
        f"({html.escape(f'{row.threshold.sense} {format_value(row.threshold.accept, row.threshold.unit)}')} expected): "
        f"{html.escape(_remedy(row, found.get(row.threshold.name)) or row.threshold.why)}</li>"
        for row in beyond
    )
    use = "" if verdict.refused else "<p>The table can be used; know these when you use it, or mend them:</p>"
    return f"<h2>What to do</h2>{use}<ul class='todo'>{rows}</ul>{_retaking(result)}"


def _group(group: Group, result: BuildResult, pictures: Sequence[Picture], worsts: Sequence[Worst]) -> str:
    """Return a group of figures, folded unless something in it is beyond its limit."""
    found = findings(result.verdict, result.figures)
    judged = [row for row in result.verdict.rows if OF_THRESHOLDS[row.threshold.name] == group]
    judged.sort(key=lambda row: _ORDER.index(row.outcome))
    where = {worst.figure: worst.where for worst in worsts if worst.group == group}
    rows = "".join(
        _judged(row, _remedy(row, found.get(row.threshold.name)), where.get(row.threshold.name, "")) for row in judged
    )
    beyond = [row for row in judged if row.outcome != "accept"]
    within = "all within their limits" if not beyond else f"{len(beyond)} beyond their limits"
    table = (
        "<table><tr class='head'><th></th><th>figure</th><th>measured</th><th>accepted</th><th>refused beyond</th>"
        f"<th>what goes wrong beyond, and where the worst is</th></tr>{rows}</table>"
        if judged
        else ""
    )
    shown = "".join(picture_html(picture) for picture in pictures if picture.group == group)
    return (
        f"<details id='{group}'{' open' if beyond else ''}><summary>{group.capitalize()}<span class='note'>"
        f"{counted(len(judged), 'figure')}, {within}</span></summary><p class='note'>{html.escape(QUESTIONS[group])}"
        f"</p>{table}{_summary(result, group)}{shown}</details>"
    )


def _origin(origin: OriginRecord) -> str:
    """Return with what, when and by whom the frames were taken."""
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>" for name, value in origin_lines(origin)
    )
    return f"<details id='origin'><summary>Where the table comes from</summary><table>{rows}</table></details>"


def _retaking(result: BuildResult) -> str:
    """Return which frames are to be taken again and how; nothing where taking frames again does not help."""
    records = retaken_frames(result.verdict, result.figures)
    if not records:
        return ""
    also = " What else is refused may follow from these; if not, take the session anew."
    if is_mended_by_retaking(result.verdict, result.figures):
        also = ""
    names = html.escape(first_of([record.file for record in records]))
    return f"<p>To be taken again ({counted(len(records), 'frame')}): {names}; <code>{COMMAND}</code>.{also}</p>"


def _remedy(row: JudgedValue, found: ProbableCause | None) -> str:
    """Return what helps against what is beyond a limit; "" where nothing is."""
    if row.outcome == "accept" or not row.threshold.remedy:
        return ""
    if found is None:
        return row.threshold.remedy
    return found.decision.cause.remedy if found.is_known else f"it may help to {row.threshold.remedy}"


def _causes(result: BuildResult) -> str:
    """Return what is beyond its limit with its probable cause, frames, place and command; nothing where nothing is."""
    rows: list[str] = []
    for name, found in findings(result.verdict, result.figures).items():
        title = next(row.threshold.title for row in result.verdict.rows if row.threshold.name == name)
        cause, rule = found.decision.cause, found.decision.rule
        probably = (
            "not known from what was measured" if rule is None else f"<b>{html.escape(cause.name)}</b>: {rule.why}"
        )
        again = f"<br><code>{retake_command(found.frames)}</code>" if found.is_of_frames else ""
        known = ", ".join(f"{key} {value:.3g}" for key, value in found.evidence.known().items())
        rows.append(
            f"<tr><th>{html.escape(title)}</th><td>{probably}{again}</td><td>{html.escape(places_text(found))}</td>"
            f"<td class='note'>{html.escape(known)}</td></tr>"
        )
    if not rows:
        return ""
    return (
        "<h2>Probable causes</h2><table><tr class='head'><th>figure</th><th>cause</th><th>frames and place</th>"
        f"<th>decided from</th></tr>{''.join(rows)}</table>"
    )


def _judged(row: JudgedValue, helps: str, where: str) -> str:
    limit, name = row.threshold, _CLASSES[row.outcome]
    refuse = "" if limit.refuse is None else format_value(limit.refuse, limit.unit)
    remedy = f". <b>{html.escape(helps)}</b>" if helps else ""
    worst = f"<br>worst: {html.escape(where)}" if where else ""
    return (
        f"<tr><td class='{name}'>{name}</td><th>{html.escape(limit.title)}</th>"
        f"<td class='number' data-name='measured'>{html.escape(format_value(row.value, limit.unit))}</td>"
        f"<td class='number note' data-name='accepted'>{limit.sense} "
        f"{html.escape(format_value(limit.accept, limit.unit))}</td>"
        f"<td class='number note' data-name='refused beyond'>{html.escape(refuse)}</td>"
        f"<td class='note' title='{html.escape(limit.source, quote=True)}'>{html.escape(limit.why)}{remedy}{worst}"
        "</td></tr>"
    )


def _summary(result: BuildResult, group: Group) -> str:
    rows = "".join(
        f"<tr><th>{html.escape(row.name)}</th><td>{html.escape(row.value)}</td>"
        f"<td class='note'>{html.escape(row.note)}</td></tr>"
        for row in summary(result.figures)
        if group_of_row(row.name) == group
    )
    return f"<h2>What was measured</h2><table>{rows}</table>" if rows else ""


def picture_html(picture: Picture) -> str:
    """Return a picture with its heading and caption as HTML; the file is part of the text."""
    heading = html.escape(picture.heading)
    return (
        f"<figure class='picture'><h2>{heading}</h2><img alt='{heading}' "
        f"src='data:image/png;base64,{base64.b64encode(picture.png).decode()}'>"
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )


def _unfit(cells: Sequence[Unfit]) -> str:
    if not cells:
        return "<h2>Cells unfit for use</h2><p>None.</p>"
    listed = cells[:MOST_UNFIT]
    rows = "".join(f"<tr><td>{cell.colour}</td><td>{html.escape(cell.cause)}</td></tr>" for cell in listed)
    more = f"<p>and {len(cells) - MOST_UNFIT} more in lut.json</p>" if len(cells) > MOST_UNFIT else ""
    return f"<h2>Cells unfit for use</h2><table><tr class='head'><th>colour</th><th>cause</th></tr>{rows}</table>{more}"
