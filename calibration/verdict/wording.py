"""A verdict's rows in words, with the frame, the lights or the place on the print where the worst of each is."""

from __future__ import annotations

from collections import Counter

from calibration.figures.table_figures import TableFigures
from calibration.verdict.retaking import COMMAND, is_mended_by_retaking, retaken_frames
from calibration.verdict.verdict import JudgedValue, Verdict
from foundation.errors import counted, first_of

_THEN = "what else is refused may follow from these, else take the session anew"

_REMEDIES = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less",
    "covered": "uncover the chart",
    "hot": "let the camera cool",
    "dead": "have the camera's pixels remapped",
    "stained": "clean the print or print it anew, and light it evenly",
    "uneven": "focus on the print and keep the camera still",
}
"""What helps against each cause of unfit cells (`calibration.pipeline.cell_statistics`)."""


def refusal(verdict: Verdict, figures: TableFigures, *, reported: bool = False) -> str:
    """Return why there is no table and what helps, in a line; of the first of the verdict's refused rows.

    Parameters
    ----------
    verdict, figures
        Of the table.
    reported
        Whether a report was written, so that the frames it names can be taken again by it.
    """
    worst = verdict.refused[0]
    remedy = worst.threshold.remedy
    more = f" (and {len(verdict.refused) - 1} more)" if len(verdict.refused) > 1 else ""
    detail = ""
    if worst.threshold.name == "unfit_share":
        cause, count = Counter(cell.cause.split(":")[0] for cell in figures.cells.unfit).most_common(1)[0]
        detail, remedy = f", {count} of them {cause}", _REMEDIES.get(cause, "look at the report")
    what, frames = "take the session anew", retaken_frames(verdict, figures)
    if reported and frames:
        again = f"take {counted(len(frames), 'frame')} again"
        what = (
            f"{again}: {COMMAND}" if is_mended_by_retaking(verdict, figures) else f"{again} first ({COMMAND}); {_THEN}"
        )
    return f"{_with_place(worst, figures)}{detail}{more}; {remedy}, and {what}"


def remark(row: JudgedValue, figures: TableFigures) -> str:
    """Return a row that is remarked on: value, expectation, place and remedy, in a line."""
    return f"{_with_place(row, figures)}; {row.threshold.remedy}"


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
        case "unlike_block":
            frame = max(figures.frames, key=lambda frame: frame.consistency.block)
            x_mm, y_mm = frame.consistency.at_mm
            return f"in {frame.record.file}, about {x_mm:.0f}, {y_mm:.0f} mm from the sheet's top-left corner"
        case "off_codes_deg":
            lights = figures.lights.lights_off_codes(row.threshold.accept)
            return f"{len(lights)} lights: {first_of(lights)}"
        case _:
            return ""
