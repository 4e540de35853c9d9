"""`report.html`: verdict, figures, pictures and unfit cells, all in one file that can be mailed."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass

from calibration.causes.findings import ProbableCause
from calibration.report.plots import INK
from calibration.report.summary import summary
from calibration.table.provenance import Unfit
from calibration.verdict.result import BuildResult
from calibration.verdict.retaking import COMMAND, findings, is_mended_by_retaking, retake_command, retaken_frames
from calibration.verdict.verdict import JudgedValue, Outcome, format_value
from calibration.verdict.wording import places_text
from foundation.errors import counted, first_of

MOST_UNFIT = 200
"""Unfit cells that are listed; all of them are in lut.json, and a page of thousands is read by nobody."""

_CLASSES: dict[Outcome, str] = {"accept": "accept", "accept with remarks": "remark", "refuse": "refuse"}
"""Classes of the style sheet, and the words of the table's first column."""

STYLE = f"""
body {{ font: 16px/1.5 system-ui, sans-serif; color: {INK}; max-width: 1100px; margin: 2rem auto; padding: 0 1rem }}
h1 {{ font-size: 1.6rem; margin-bottom: .2rem }} h2 {{ font-size: 1.15rem; margin: 2.2rem 0 .6rem }}
table {{ border-collapse: collapse; font-size: .95rem }} th {{ text-align: left; font-weight: 600 }}
td, th {{ padding: .25rem 1.2rem .25rem 0; border-bottom: 1px solid #e3e6ea; vertical-align: top }}
td {{ font-variant-numeric: tabular-nums }} .note, figcaption {{ color: #5b636d; font-size: .9rem }}
.verdict {{ font-size: 1.15rem; font-weight: 600; padding: .5rem .8rem; margin: 1rem 0; border-left: 6px solid }}
.accept {{ border-color: #2f8f46 }} .remark {{ border-color: #d9a400 }} .refuse {{ border-color: #c8382e }}
td.accept, td.remark, td.refuse {{
  border-color: #e3e6ea; border-left: 4px solid; padding-left: .6rem; white-space: nowrap }}
td.accept {{ border-left-color: #2f8f46 }} td.remark {{ border-left-color: #d9a400 }}
td.refuse {{ border-left-color: #c8382e; font-weight: 600 }}
td.number {{ white-space: nowrap }} figure {{ margin: 0 }} img {{ max-width: 100%; height: auto }}
"""
"""The style sheet of a table's pages."""


@dataclass(frozen=True)
class Picture:
    """A picture of the report, PNG, with its heading and what it shows."""

    heading: str
    caption: str
    png: bytes


def page(result: BuildResult, pictures: Sequence[Picture], places: Sequence[Picture] = ()) -> str:
    """Return the text of `report.html`.

    Parameters
    ----------
    result
        What the build found.
    pictures
        Of the figures.
    places
        Of frames in which something is beyond its limit, shown with its causes.
    """
    session = result.figures.session
    title = f"Table of {session.lights} lights, {session.camera}"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>\n"
        f'<h1>{html.escape(title)}</h1><p class="note">Session {html.escape(session.folder.name)}</p>\n'
        f"{_verdict(result)}{_causes(result)}{_retaking(result)}{''.join(map(picture_html, places))}"
        f"<h2>Figures</h2>{_summary(result)}"
        f"{''.join(map(picture_html, pictures))}{_unfit(result.figures.cells.unfit)}</body></html>\n"
    )


def _verdict(result: BuildResult) -> str:
    """Return the verdict and its table, the worst rows first."""
    verdict, found = result.verdict, findings(result.verdict, result.figures)
    order: tuple[Outcome, ...] = ("refuse", "accept with remarks", "accept")
    rows = "".join(
        _judged(row, _remedy(row, found.get(row.threshold.name)))
        for row in sorted(verdict.rows, key=lambda row: order.index(row.outcome))
    )
    sentence = {
        "accept": "Accepted: every figure is within its limit.",
        "accept with remarks": f"Accepted with remarks on {len(verdict.remarks)} of {len(verdict.rows)} figures.",
        "refuse": f"Refused: {len(verdict.refused)} of {len(verdict.rows)} figures are beyond what can be used.",
    }[verdict.outcome]
    return (
        f"<p class='verdict {_CLASSES[verdict.outcome]}'>{sentence}</p><table><tr><th></th><th>figure</th>"
        f"<th>measured</th><th>accepted</th><th>refused beyond</th><th>what goes wrong beyond</th></tr>{rows}</table>"
    )


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
        "<h2>Probable causes</h2><table><tr><th>figure</th><th>cause</th><th>frames and place</th><th>decided from</th>"
        f"</tr>{''.join(rows)}</table>"
    )


def _judged(row: JudgedValue, helps: str) -> str:
    limit, name = row.threshold, _CLASSES[row.outcome]
    refuse = "" if limit.refuse is None else format_value(limit.refuse, limit.unit)
    remedy = f". <b>{html.escape(helps)}</b>" if helps else ""
    return (
        f"<tr><td class='{name}'>{name}</td><th>{html.escape(limit.title)}</th>"
        f"<td class='number'>{html.escape(format_value(row.value, limit.unit))}</td>"
        f"<td class='number note'>{limit.sense} {html.escape(format_value(limit.accept, limit.unit))}</td>"
        f"<td class='number note'>{html.escape(refuse)}</td>"
        f"<td class='note' title='{html.escape(limit.source, quote=True)}'>{html.escape(limit.why)}{remedy}</td></tr>"
    )


def _summary(result: BuildResult) -> str:
    rows = "".join(
        f"<tr><th>{html.escape(row.name)}</th><td>{html.escape(row.value)}</td>"
        f"<td class='note'>{html.escape(row.note)}</td></tr>"
        for row in summary(result.figures)
    )
    return f"<table>{rows}</table>"


def picture_html(picture: Picture) -> str:
    """Return a picture with its heading and caption as HTML; the file is part of the text."""
    heading = html.escape(picture.heading)
    return (
        f"<figure><h2>{heading}</h2><img alt='{heading}' "
        f"src='data:image/png;base64,{base64.b64encode(picture.png).decode()}'>"
        f"<figcaption>{html.escape(picture.caption)}</figcaption></figure>"
    )


def _unfit(cells: Sequence[Unfit]) -> str:
    if not cells:
        return "<h2>Cells unfit for use</h2><p>None.</p>"
    listed = cells[:MOST_UNFIT]
    rows = "".join(f"<tr><td>{cell.colour}</td><td>{html.escape(cell.cause)}</td></tr>" for cell in listed)
    more = f"<p>and {len(cells) - MOST_UNFIT} more in lut.json</p>" if len(cells) > MOST_UNFIT else ""
    return f"<h2>Cells unfit for use</h2><table><tr><th>colour</th><th>cause</th></tr>{rows}</table>{more}"
