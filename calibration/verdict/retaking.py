"""Which frames, taken again, would mend a table: those beyond a limit by themselves, and those that are a cause.

What all frames share (focus from the first on, a stained print, too little light) is not mended by taking frames again;
nothing is named for it. A hand in one white frame looks like a stain to the mean of the white frames: its cause names
the frame (`calibration.causes`). `report.json` names the frames in the form that `acquire run --retake bad` reads.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from calibration.causes.findings import ProbableCause, explain
from calibration.figures.frame_figures import FrameFigures
from calibration.figures.table_figures import TableFigures
from calibration.registration.register import Registration
from calibration.sampling import bleed
from calibration.verdict.verdict import JudgedValue, Verdict
from experiment.session.mending.retaking import lights_text
from experiment.session.records import FrameRecord

COMMAND = "acquire run LAB.toml SESSION --retake bad"
"""What takes them again, as the report names them."""


def retake_command(records: Sequence[FrameRecord]) -> str:
    """Return the command that takes frames again: by the lights' numbers, or by the report where one is a reference."""
    lights = [record.illumination for record in records if record.kind == "light"]
    numbers = [light for light in lights if light is not None]
    return COMMAND if len(numbers) < len(records) else COMMAND.replace("bad", lights_text(numbers))


def retaken_frames(verdict: Verdict, figures: TableFigures) -> tuple[FrameRecord, ...]:
    """Return the frames to be taken again, in the order taken.

    Those beyond a refusing limit by themselves, and those that are the cause of a refusal or a remark.
    """
    named = {frame.sha256 for row in verdict.refused for frame in _frames_of(row, figures) or ()}
    for finding in findings(verdict, figures).values():
        if finding.is_of_frames:
            named |= {frame.sha256 for frame in finding.frames}
    # Dark frames have no figures among the others; only where they come from can be refused.
    foreign = [frame.record for frame in (*figures.origins.other_camera, *figures.origins.other_exposure)]
    records = [*(frame.record for frame in figures.frames), *(record for record in foreign if record.kind == "dark")]
    return tuple(sorted((record for record in records if record.sha256 in named), key=lambda record: record.attempt))


def is_mended_by_retaking(verdict: Verdict, figures: TableFigures) -> bool:
    """Return whether each refusal is of single frames, so that a table could be made once these are taken again."""
    found = findings(verdict, figures)
    return bool(verdict.refused) and all(
        _frames_of(row, figures) or (row.threshold.name in found and found[row.threshold.name].is_of_frames)
        for row in verdict.refused
    )


def findings(verdict: Verdict, figures: TableFigures) -> dict[str, ProbableCause]:
    """Return what each row beyond its limit is probably caused by, by the name of the limit."""
    rows = (*verdict.refused, *verdict.remarks)
    explained = ((row.threshold.name, explain(row.threshold.name, row.threshold.accept, figures)) for row in rows)
    return {name: finding for name, finding in explained if finding is not None}


def retake_json(records: tuple[FrameRecord, ...], registered_sha256: str, newest_sha256: str) -> dict[str, Any]:
    """Return what `acquire run --retake bad` reads of a report (docs/formats.md)."""
    return {
        "retake": lights_text([record.illumination for record in records if record.illumination is not None]),
        "retake_sha256": [record.sha256 for record in records],
        "registered_sha256": registered_sha256,
        "newest_sha256": newest_sha256,
    }


def _frames_of(row: JudgedValue, figures: TableFigures) -> list[FrameRecord] | None:
    """Return the frames that are beyond a row's refusing limit; None where its value is not of single frames."""
    limit = row.threshold.refuse
    if limit is None:
        return None
    if row.threshold.name == "off_codes_deg":
        lights = set(figures.lights.lights_off_codes(limit))
        return [frame.record for frame in figures.frames if frame.record.illumination in lights]
    if row.threshold.name == "off_brightness" and figures.lights.codes is not None:
        off = figures.lights.codes.off_brightness
        return [frame.record for frame in figures.frames if _index(frame) < len(off) and off[_index(frame)] > limit]
    if row.threshold.name in ("white_frame_deg", "white_frame_brightness"):
        return white_frames_beyond(limit, row, figures)
    if row.threshold.name == "other_camera":
        return [frame.record for frame in figures.origins.other_camera]
    if row.threshold.name == "other_exposure":
        others = figures.origins.other_exposure
        return [frame.record for frame in others if max(frame.ratio, 1 / frame.ratio) - 1 > limit]
    value = _VALUES.get(row.threshold.name)
    if value is None:
        return None
    beyond = [frame.record for frame in figures.frames if value(frame, figures) > limit]
    # Where every frame is beyond, the fault is not one of single frames.
    return beyond if len(beyond) < len(figures.frames) else None


def white_frames_beyond(limit: float, row: JudgedValue, figures: TableFigures) -> list[FrameRecord]:
    """Return the white frames that are further than a limit from what the lights predict, by the row's value."""
    white = figures.lights.white_frames
    if white is None:
        return []
    off = white.off_deg if row.threshold.name == "white_frame_deg" else white.off_brightness
    return [frame.record for frame, value in zip(figures.white_frames, off, strict=False) if value > limit]


def _index(frame: FrameFigures) -> int:
    """Return a frame's light; beyond any light for a white frame."""
    return sys.maxsize if frame.record.illumination is None else frame.record.illumination


def added_bleed(registration: Registration, blur_px: float, window: int) -> float:
    """Return how much more light a frame's worst sample has from beyond its cell than that of the registered frame."""
    return bleed(registration.cell_px, blur_px, window) - bleed(registration.cell_px, registration.blur_px, window)


_VALUES: dict[str, Callable[[FrameFigures, TableFigures], float]] = {
    "softer_bleed": lambda frame, figures: added_bleed(figures.registration, frame.blur_px, figures.cells.window),
    "unlike_scatter": lambda frame, figures: frame.consistency.scatter,
    "unlike_block": lambda frame, figures: frame.consistency.block,
}
