"""A verdict's rows in words, with the frame, the lights or the place on the print where the worst of each is."""

from __future__ import annotations

from collections import Counter

from calibration.causes.findings import ProbableCause, explain
from calibration.checks.frame_origins import ForeignFrame
from calibration.figures.table_figures import TableFigures
from calibration.verdict.retaking import (
    COMMAND,
    findings,
    is_mended_by_retaking,
    retake_command,
    retaken_frames,
    white_frames_beyond,
)
from calibration.verdict.verdict import JudgedValue, Verdict
from foundation.errors import counted, first_of

_THEN = "what else is refused may follow from these, else take the session anew"

_PAIRS = 4
"""Pairs of exchanged lights that a remark names; the report has all."""

_FIRST = ("other_camera", "other_exposure", "off_codes_deg", "white_frame_deg")
"""Refusals that others follow from: a frame of something else has no drift, focus or brightness of its own."""

_REMEDIES = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less",
    "covered": "uncover the chart",
    "hot": "let the camera cool",
    "dead": "have the camera's pixels remapped",
    "stained": "clean the print or print it anew, and light it evenly",
    "disturbed": "see that nothing comes between lamp, print and camera",
    "unlike": "look at the cell in the frame of that light",
    "misplaced": "hang the print flatter",
    "uneven": "focus on the print and keep the camera still",
}
"""What helps against each cause of unfit cells (`calibration.pipeline.accumulator`)."""


def refusal(verdict: Verdict, figures: TableFigures, *, reported: bool = False) -> str:
    """Return why there is no table and what helps, in a line; of the first of the verdict's refused rows."""
    found = findings(verdict, figures)
    # What is explained explains more than what comes first.
    known = [row for row in verdict.refused if row.threshold.name in found and found[row.threshold.name].is_known]
    first = [row for row in verdict.refused if row.threshold.name in _FIRST]
    worst = (*first, *known, *verdict.refused)[0]
    remedy = worst.threshold.remedy
    more = f" (and {len(verdict.refused) - 1} more)" if len(verdict.refused) > 1 else ""
    detail = ""
    if worst.threshold.name == "unfit_share":
        kind, count = Counter(cell.cause.split(":")[0] for cell in figures.cells.unfit).most_common(1)[0]
        detail, remedy = f", {count} of them {kind}", _REMEDIES.get(kind, "look at the report")
    finding = found.get(worst.threshold.name)
    if finding is not None and finding.is_known:
        remedy = finding.decision.cause.remedy
    what, frames = "take the session anew", retaken_frames(verdict, figures)
    command = COMMAND if reported else retake_command(frames)
    if frames and (reported or command != COMMAND):
        again = f"take {counted(len(frames), 'frame')} again"
        mended = is_mended_by_retaking(verdict, figures)
        what = f"{again}: {command}" if mended else f"{again} first ({command}); {_THEN}"
    probably = cause_text(finding)
    return f"{_with_place(worst, figures)}{detail}{more}; {probably}{remedy}, and {what}"


def remark(row: JudgedValue, figures: TableFigures) -> str:
    """Return a row that is remarked on: value, expectation, place, cause, remedy and command, in a line."""
    finding = explain(row.threshold.name, row.threshold.accept, figures)
    remedy, again = row.threshold.remedy, ""
    if finding is not None and finding.is_known:
        remedy = finding.decision.cause.remedy
        if finding.is_of_frames:
            again = f", and take {counted(len(finding.frames), 'frame')} again: {retake_command(finding.frames)}"
    elif row.threshold.name == "unfit_share" and figures.cells.unfit:
        kind = Counter(cell.cause.split(":")[0] for cell in figures.cells.unfit).most_common(1)[0][0]
        remedy = _REMEDIES.get(kind, "look at the report")
    return f"{_with_place(row, figures)}; {cause_text(finding)}{remedy}{again}"


def cause_text(finding: ProbableCause | None) -> str:
    """Return the probable cause and why, before a remedy; that it is unknown, where it was asked for."""
    if finding is None:
        return ""
    if finding.decision.rule is None:
        return "the cause is not known from what was measured; it may help to "
    decision = finding.decision
    # What it goes with says why.
    why = "" if decision.follows else f" ({finding.decision.rule.why})"
    return f"probably {decision.cause.says}{why}; "


def _with_place(row: JudgedValue, figures: TableFigures) -> str:
    """Return a value against its limit, and where the worst of it is."""
    place = _place(row, figures)
    return f"{row.text()}, {place}" if place else row.text()


def _place(row: JudgedValue, figures: TableFigures) -> str:
    """Return in which frame or lights the worst of a value is, and where on the print; "" where it has no place."""
    match row.threshold.name:
        case "softer_bleed":
            softest = max(figures.frames, key=lambda frame: frame.blur_px)
            return f"in {softest.record.file}, whose blur is σ = {softest.blur_px:.2f} px"
        case "unlike_scatter":
            return f"in {max(figures.frames, key=lambda frame: frame.consistency.scatter).record.file}"
        case "off_codes_deg":
            lights = figures.lights.lights_off_codes(row.threshold.accept)
            return f"{len(lights)} lights: {first_of(lights)}{_exchanges(figures)}"
        case "exchanged_lights":
            return _exchanges(figures).removeprefix("; ")
        case "off_brightness":
            return _brightness(row.threshold.accept, figures)
        case "white_frame_brightness" | "white_frame_deg":
            return first_of([record.file for record in white_frames_beyond(row.threshold.accept, row, figures)])
        case "held_share":
            codes = figures.lights.codes
            return "" if codes is None else f"{int(codes.held.sum())} of {len(codes.held)}"
        case "correction_residual" | "correction_worst":
            return _left_by_lens(figures)
        case "other_camera":
            return _foreign(figures.origins.other_camera)
        case "other_lens":
            return _foreign(figures.origins.other_lens)
        case "other_iso":
            return _foreign(figures.origins.other_iso)
        case "other_exposure":
            return _foreign(figures.origins.other_exposure)
        case _:
            return places_text(explain(row.threshold.name, row.threshold.accept, figures))


def _left_by_lens(figures: TableFigures) -> str:
    """Return how large a veil may be, and which cells are furthest off by what the lens may have left."""
    lens = figures.lens
    found = f"{100 * lens.veil:.2f} ± {100 * lens.veil_error:.2f} % of the mean light"
    return (
        f"a veil of {found} was found, so that up to {100 * lens.veil_at_most:.2g} % is not excluded; cells of "
        f"{100 * lens.worst_level:.2g} % of paper may be off by {100 * lens.left_worst:.2g} %"
    )


def _exchanges(figures: TableFigures) -> str:
    """Return which lights bear each other's names, behind a semicolon; "" where none do."""
    codes = figures.lights.codes
    if codes is None or not codes.exchanges:
        return ""
    count = figures.session.lights
    pairs = [f"{_light(pair.one, count)} and {_light(pair.other, count)}" for pair in codes.exchanges]
    apart = f"{codes.exchanges[0].angle_deg:.2g}° apart"
    more = f" (and {len(pairs) - _PAIRS} pairs more)" if len(pairs) > _PAIRS else ""
    return f"; exchanged names: {', '.join(pairs[:_PAIRS])}{more}, {apart} in the first pair"


def _light(index: int, count: int) -> str:
    return f"light {index}" if index < count else f"white frame {index - count}"


def _brightness(accepted: float, figures: TableFigures) -> str:
    """Return which lights are brighter or darker than their codes predict, the furthest off first."""
    codes = figures.lights.codes
    if codes is None:
        return ""
    order = sorted(range(len(codes.off_brightness)), key=lambda light: -codes.off_brightness[light])
    found = [f"light {k} by {100 * codes.brightness[k]:+.0f} %" for k in order if codes.off_brightness[k] > accepted]
    return first_of(found)


def _foreign(frames: tuple[ForeignFrame, ...]) -> str:
    """Return which frames state otherwise than most, and what."""
    if not frames:
        return ""
    names = first_of([frame.record.file for frame in frames])
    return f"{counted(len(frames), 'frame')}: {names}, with {frames[0].found} instead of {frames[0].expected}"


def places_text(finding: ProbableCause | None) -> str:
    """Return the frames and the place on the print of a finding; "" where it has neither."""
    if finding is None:
        return ""
    files = [frame.file for frame in finding.frames]
    told = [f"in {first_of(files)}"] if files else []
    if finding.places:
        place = finding.places[0]
        told.append(f"about {place.x_mm:.0f}, {place.y_mm:.0f} mm from the sheet's top-left corner")
        if place.size_mm > 0:
            told.append(f"{place.size_mm:.0f} mm across")
        if not files:
            told[0] = f"seen in {place.file} {told[0]}"
    return ", ".join(told)
