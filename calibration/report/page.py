"""`report.html`: verdict, figures, pictures and unfit cells, all in one file that can be mailed.

How the pages look: light or dark as the reader's system is, one column on a phone, no file beside the page.

The figures that say how good a table is, as rows for people: name, value, and what the value means or is usual.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from calibration.verdict import ProbableCause
from calibration.checks.stray_light import CERTAIN
from calibration.citation.record import OriginRecord, origin_lines
from calibration.measurements import LightMeasurements, TableMeasurements
from calibration.report.groups import GROUPS, OF_THRESHOLDS, QUESTIONS, Group, group_of_row
from calibration.report.worsts import Worst
from calibration.sampling.windows import SAFE_BLEED, bleed, largest_window
from calibration.table.provenance import Unfit
from calibration.verdict import BuildResult
from calibration.verdict import COMMAND, findings, is_mended_by_retaking, retake_command, retaken_frames
from calibration.figures.figure import Outcome, format_value
from calibration.verdict import JudgedValue
from calibration.verdict import places_text
from experiment.framing.visibility import MIN_CELL_PX
from experiment.measures.sensor_range import MAX_BLACK_DRIFT
from foundation.errors import counted, first_of

STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #22262b; --soft: #5b636d; --line: #e3e6ea; --panel: #f6f7f9;
  --good: #2f8f46; --remark: #b88600; --bad: #c8382e; --link: #1b5fb8 }
@media (prefers-color-scheme: dark) { :root { --paper: #15181c; --ink: #e4e7eb; --soft: #a0a8b2; --line: #343a42;
  --panel: #1e2227; --good: #55b56c; --remark: #e0b03a; --bad: #ef6a5e; --link: #79b0f5 } }
* { box-sizing: border-box }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 1100px;
  margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .2rem } h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem }
a { color: var(--link) }
table { border-collapse: collapse; font-size: .95rem; width: 100% } th { text-align: left; font-weight: 600 }
td, th { padding: .25rem 1.2rem .25rem 0; border-bottom: 1px solid var(--line); vertical-align: top }
td { font-variant-numeric: tabular-nums } .note, figcaption { color: var(--soft); font-size: .9rem }
code { font-size: .9em; overflow-wrap: anywhere; background: var(--panel); padding: 0 .25em; border-radius: 3px }
.verdict { font-size: 1.15rem; font-weight: 600; padding: .5rem .8rem; margin: 1rem 0; border-left: 6px solid;
  background: var(--panel) }
.accept { border-color: var(--good) } .remark { border-color: var(--remark) } .refuse { border-color: var(--bad) }
td.accept, td.remark, td.refuse { border-color: var(--line); border-left: 4px solid; padding-left: .6rem;
  white-space: nowrap }
td.accept { border-left-color: var(--good) } td.remark { border-left-color: var(--remark) }
td.refuse { border-left-color: var(--bad); font-weight: 600 }
td.number { white-space: nowrap } figure { margin: 0 }
img { display: block; max-width: 100%; height: auto; background: #fff; border-radius: 4px; margin-bottom: .4rem }
@media (prefers-color-scheme: dark) { img { filter: brightness(.9); padding: 2px } }
details { border: 1px solid var(--line); border-radius: 6px; margin: .8rem 0; padding: 0 .9rem }
details[open] { padding-bottom: .9rem }
summary { cursor: pointer; font-weight: 600; font-size: 1.05rem; padding: .55rem 0 }
summary .note { font-weight: 400; margin-left: .6rem }
details h2 { font-size: 1.02rem; margin: 1.6rem 0 .4rem }
ul.todo { padding-left: 1.2rem; margin: .4rem 0 }
@media (max-width: 700px) {
  body { margin: 1rem auto; font-size: 15px } details { padding: 0 .6rem }
  table, tbody { display: block } tr { display: block; padding: .5rem 0; border-bottom: 1px solid var(--line) }
  tr.head { display: none }
  td, th { display: block; border: 0; padding: .05rem 0; white-space: normal }
  td[data-name]:not(:empty)::before { content: attr(data-name) ": "; color: var(--soft); font-size: .85rem }
  td:empty { display: none } td.number { white-space: normal } td.accept, td.remark, td.refuse { white-space: normal }
  figure.picture { overflow-x: auto } figure.picture img { min-width: 560px }
}
"""
"""The style sheet of a table's and a comparison's pages. Pictures keep a white ground in the dark: their colours are a
scale, which inverting would turn round."""


@dataclass(frozen=True)
class SummaryRow:
    """A figure in words.

    - `name`: what was measured.
    - `value`: the figure with its unit.
    - `note`: what it means, or what is usual; may be "".
    - `brief`: whether it is among the few that a command prints.
    """

    name: str
    value: str
    note: str
    brief: bool = False


def summary(figures: TableMeasurements) -> list[SummaryRow]:
    """Return the figures that say how good a table is, in the order of the report."""
    return [
        *_registration_rows(figures),
        *_course_rows(figures),
        *_sensor_rows(figures),
        *_light_rows(figures),
        SummaryRow(
            "Cells unfit for use", str(len(figures.cells.unfit)), "listed in lut.json, never filled", brief=True
        ),
    ]


def _registration_rows(figures: TableMeasurements) -> list[SummaryRow]:
    """Return where and how well the chart was found."""
    registration, window = figures.registration, figures.cells.window
    plain = registration.framing.field is not None
    tags = len(registration.framing.tags)
    found = "the chart has none" if plain else f"{tags} of {tags + len(registration.framing.missing)}"
    marks = "outline of the field, across" if plain else "corners of the tags"
    usual = "" if plain else "; the detector's own error is 0.09"
    return [
        SummaryRow("Lights", str(figures.session.lights), "with an accepted frame"),
        SummaryRow("Frame registered", figures.session.registered_file, ""),
        SummaryRow("Tags found", found, "", brief=True),
        SummaryRow(
            "Shorter side of a cell",
            f"{registration.cell_px:.1f} px",
            f"of the half-size frame; {MIN_CELL_PX:g} or more for 25 pixels inside it",
        ),
        SummaryRow("Window", f"{window}×{window} samples", _window_note(figures)),
        SummaryRow("Blur", f"σ {registration.blur_px:.2f} px", "about 0.6 is sharp"),
        SummaryRow("Spread of the lens", *_lens(figures)),
        SummaryRow(
            "Residual of the outline" if plain else "Residual of tags",
            f"{registration.marks_rms_px:.3f} px RMS",
            f"{marks} against the final map{usual}",
        ),
        SummaryRow(
            "Residual of plane and lens",
            f"{registration.lens_residual_px:.2f} px RMS",
            f"{marks} against a plane seen through a lens: the waviness of the sheet",
        ),
        SummaryRow(
            "Residual of cell blocks",
            f"{registration.block_rms_px:.3f} px RMS",
            "displacement of blocks of cells that the final map leaves",
            brief=True,
        ),
        SummaryRow(
            "Correlation with the chart",
            f"{registration.agreement:.4f}",
            "of the cells' colours with the chart's; with another chart's about 0",
            brief=True,
        ),
    ]


def _lens(figures: TableMeasurements) -> tuple[str, str]:
    """Return what the lens spreads beside its sharp core, and what is done about it."""
    lens = figures.lens
    if not lens.measured:
        return "not measured", lens.why_not
    veil = f"a veil of {100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    dark = f"{100 * lens.left_worst:.2g} % in cells of {100 * lens.worst_level:.2g} % of paper"
    left = f"{100 * lens.left:.2g} % RMS, {dark},"
    if not lens.corrected and not lens.beyond_cell:
        return "none", f"{lens.why_not}; {veil} is likeliest, and {left} is what may be in cells' means"
    done = f"subtracted, {left} may be left" if lens.corrected else f"not subtracted: {lens.why_not}"
    size = f"{100 * lens.rms:.2g} % RMS, {100 * lens.worst:.2g} % at most"
    return size, f"of cells' means above 300 counts, relative to paper, {veil} in it; {done}"


def _course_rows(figures: TableMeasurements) -> list[SummaryRow]:
    """Return how chart and lamp changed from frame to frame; of one frame alone, as a check reads, nothing."""
    rows: list[SummaryRow] = []
    if len(figures.frames) > 1:
        again = sum(frame.reregistered for frame in figures.frames)
        rows.append(
            SummaryRow(
                "Movement of the chart",
                f"{figures.largest_shift_px:.3f} px at most",
                f"{again} frames registered again",
                brief=True,
            )
        )
    if len(figures.white_frames) > 1:
        rows.append(
            SummaryRow(
                "Drift of white", _percent(figures.white_drift), "between white frames; 1 % is usual", brief=True
            )
        )
    black = np.mean([frame.black for frame in figures.frames], axis=0)
    drift = f"drift {figures.black_drift:.2f} counts, up to {MAX_BLACK_DRIFT:g} is usual"
    return [*rows, SummaryRow("Black level", f"{black.mean():.2f} counts", drift)]


def _sensor_rows(figures: TableMeasurements) -> list[SummaryRow]:
    """Return how the sensor answers to light."""
    sensor, white = figures.sensor, figures.lights.white.max(axis=1)
    gain = " / ".join(f"{value:.2f}" for value in sensor.transfer.gain_e.tolist())
    read = " / ".join(f"{value:.1f}" for value in sensor.transfer.read_noise.tolist())
    source = (
        "measured in cells"
        if sensor.saturation_measured
        else "as the raw files state it, which may be too high; no photosite of a cell reached it"
    )
    return [
        SummaryRow(
            "Saturation", f"{sensor.white_level} counts above black", f"{source}; bare paper reaches {white.max():.0f}"
        ),
        SummaryRow("Darkest light", f"{white.min():.0f} counts", "its strongest channel on bare paper"),
        SummaryRow("Noise of a sample", _percents(sensor.noise), "R, G, B, of paper under white"),
        SummaryRow(
            "Photon transfer",
            f"{gain} e⁻ per count, {read} counts of read noise",
            f"R, G, B of half-size pixels; {int(sensor.transfer.noisy.sum())} cells are noisier than the curve",
        ),
        _linearity_row(figures),
    ]


def _linearity_row(figures: TableMeasurements) -> SummaryRow:
    linearity = figures.sensor.linearity
    if linearity is None:
        return SummaryRow("Linearity", "not measured", "give a series of exposures of the chart with --linearity")
    low, high = linearity.range
    return SummaryRow(
        "Linearity",
        f"{_percent(linearity.worst)} from a straight line at most",
        f"{len(linearity.files)} exposures, {low:.0%} to {high:.0%} of saturation; 1 % is usual",
    )


def _light_rows(figures: TableMeasurements) -> list[SummaryRow]:
    """Return what whites, dark frames, primaries and greys show."""
    lights = figures.lights
    share = lights.white_error / np.maximum(lights.white, 1e-9)
    rows = [
        SummaryRow(
            "Standard error of the ground truth",
            f"{_percent(float(np.median(share)))} of a channel, median",
            "of the mean of the white references",
            brief=True,
        )
    ]
    if len(lights.share_at_zero):
        worst = int(np.argmax(lights.share_at_zero))
        rows.append(
            SummaryRow(
                "Samples at 0",
                f"{100 * lights.share_at_zero.mean():.3f} %, {_percent(lights.share_at_zero[worst])} under light "
                f"{worst}",
                "no light within the noise; negative values are cut to 0, which lifts the mean of such cells a little",
            )
        )
    rows += _dark_rows(figures)
    if lights.off_codes_deg is not None:
        worst = int(np.argmax(lights.off_codes_deg))
        rows.append(
            SummaryRow(
                "Lights against their codes",
                f"{lights.off_codes_deg[worst]:.2f}° at most, light {worst}",
                "angle between a white and what all other lights predict from its codes, beyond four standard errors",
            )
        )
    if lights.codes is not None:
        held, down_to = int(lights.codes.held.sum()), lights.codes.exchange_deg
        rows.append(
            SummaryRow(
                "Lights held against their codes",
                f"{held} of {len(lights.codes.held)}; exchanged names excluded down to {down_to:.2g}°",
                "the others are too few, or too dim, for a wrong name to be noticed",
            )
        )
    if figures.primaries is None and lights.codes is not None:
        rows.append(
            SummaryRow(
                "Fields of the primaries",
                "not measured",
                "no frames of red, green and blue, each alone and bright enough; coloured cells are evened by paper's",
            )
        )
    if lights.codes is not None:
        rows.append(_stray_row(lights))
    if lights.additivity is not None:
        rows.append(
            SummaryRow("Red + green + blue − white", _percents(lights.additivity), "R, G, B, of white; 0 is additive")
        )
    if figures.greys.names:
        tints = zip(figures.greys.names, figures.greys.tints_deg(lights.white).tolist(), strict=True)
        rows.append(
            SummaryRow(
                "Tint of the greys",
                ", ".join(f"{name}: {angle:.2f}°" for name, angle in tints),
                "angle to bare paper's camera RGB; a print through the printer's profile has 1° to 2.5°, for it is "
                "neutral to the eye and not to the camera, one of plain ink codes 4° to 8°",
            )
        )
    return rows


def _stray_row(lights: LightMeasurements) -> SummaryRow:
    """Return what light single frames have beyond the dark ones, and how many lights could be asked."""
    stray = lights.stray
    if stray is None:
        return SummaryRow(
            "Light that no dark frame shows",
            "not measured",
            "red, green and blue alone and a dark frame show it",
        )
    return SummaryRow(
        "Light that no dark frame shows",
        f"{_percent(stray.share)} of white",
        f"beyond {CERTAIN:g} standard errors; {int(stray.checked.sum())} of {len(stray.certain)} lights are checked by "
        "a code of 0, the primaries against white; of the others it is not known",
    )


def _dark_rows(figures: TableMeasurements) -> list[SummaryRow]:
    """Return what light there is while the projector shows black."""
    dark, white = figures.dark_frames, [frame.paper.white for frame in figures.white_frames]
    if not dark.files or not white:
        return []
    counts = " / ".join(f"{value:.2f}" for value in dark.light.tolist())
    done = "not subtracted" if figures.lights.subtracted is None else "subtracted from samples and ground truth"
    return [
        SummaryRow(
            "Light while the projector shows black",
            f"{counts} counts, {_percents(dark.light / np.mean(white, axis=0))} of white",
            f"R, G, B of leak and ambient light on bare paper, {len(dark.files)} dark frames; {done}",
        )
    ]


def _window_note(figures: TableMeasurements) -> str:
    """Return what windows the cells allow."""
    registration, window = figures.registration, figures.cells.window
    largest = largest_window(registration.cell_px, registration.blur_px)
    safe = f"{100 * SAFE_BLEED:g} %"
    if window > largest:
        share = bleed(registration.cell_px, registration.blur_px, window)
        allowed = f"{largest}×{largest} has less than {safe}" if largest else f"no window has less than {safe}"
        return f"too large: {100 * share:.2g} % of the worst sample's light is from beyond its cell; {allowed}"
    return f"up to {largest}×{largest}, at most {safe} of a sample's light is from beyond its cell"


def _percent(value: float) -> str:
    return f"{100 * value:.2f} %"


def _percents(values: npt.NDArray[np.floating]) -> str:
    """Return values of R, G and B (3,) float64, shares, as per cent."""
    return " / ".join(f"{100 * value:.2f}" for value in values.tolist()) + " %"


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
