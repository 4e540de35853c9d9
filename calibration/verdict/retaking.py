"""Which frames, taken again, would mend a refused table: those that are beyond a limit by themselves.

What all frames share (focus from the first on, a stained print, too little light) is not mended by taking frames again;
nothing is named for it. `report.json` names the frames in the form that `acquire run --retake bad` reads.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from acquisition.session.mending.retaking import lights_text
from acquisition.session.records import FrameRecord
from calibration.figures.frame_figures import FrameFigures
from calibration.figures.table_figures import TableFigures
from calibration.registration.registration import Registration
from calibration.sampling.windows import bleed
from calibration.verdict.verdict import JudgedValue, Verdict

COMMAND = "acquire run LAB.toml SESSION --retake bad"
"""What takes them again."""


def retaken_frames(verdict: Verdict, figures: TableFigures) -> tuple[FrameRecord, ...]:
    """Return the frames that are beyond a refusing limit by themselves, in the order taken."""
    refused = {frame.sha256 for row in verdict.refused for frame in _frames_of(row, figures) or ()}
    return tuple(frame.record for frame in figures.frames if frame.record.sha256 in refused)


def is_mended_by_retaking(verdict: Verdict, figures: TableFigures) -> bool:
    """Return whether each refusal is of single frames, so that a table could be made once these are taken again."""
    return bool(verdict.refused) and all(_frames_of(row, figures) for row in verdict.refused)


def retake_json(records: tuple[FrameRecord, ...], registered_sha256: str) -> dict[str, Any]:
    """Return what `acquire run --retake bad` reads of a report (docs/formats.md).

    Parameters
    ----------
    records
        The frames to be taken again.
    registered_sha256
        Hash of a frame of the session, by which the report is known to be on it.
    """
    return {
        "retake": lights_text([record.illumination for record in records if record.illumination is not None]),
        "retake_sha256": [record.sha256 for record in records],
        "registered_sha256": registered_sha256,
    }


def _frames_of(row: JudgedValue, figures: TableFigures) -> list[FrameRecord] | None:
    """Return the frames that are beyond a row's refusing limit; None where its value is not of single frames."""
    limit = row.threshold.refuse
    if limit is None:
        return None
    if row.threshold.name == "off_codes_deg":
        lights = set(figures.lights.lights_off_codes(limit))
        return [frame.record for frame in figures.frames if frame.record.illumination in lights]
    value = _VALUES.get(row.threshold.name)
    if value is None:
        return None
    beyond = [frame.record for frame in figures.frames if value(frame, figures) > limit]
    # Where every frame is beyond, the fault is not one of single frames.
    return beyond if len(beyond) < len(figures.frames) else None


def added_bleed(registration: Registration, blur_px: float, window: int) -> float:
    """Return how much more light a frame's worst sample has from beyond its cell than that of the registered frame."""
    return bleed(registration.cell_px, blur_px, window) - bleed(registration.cell_px, registration.blur_px, window)


_VALUES: dict[str, Callable[[FrameFigures, TableFigures], float]] = {
    "softer_bleed": lambda frame, figures: added_bleed(figures.registration, frame.blur_px, figures.cells.window),
    "unlike_scatter": lambda frame, figures: frame.consistency.scatter,
    "unlike_block": lambda frame, figures: frame.consistency.block,
}
