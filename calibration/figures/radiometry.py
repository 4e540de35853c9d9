"""Figures of the print's cells, of frames against each other, and of the camera that took them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from calibration.causes.gathering import (
    block_evidence,
    blur_evidence,
    camera_evidence,
    disturbed_evidence,
    iso_evidence,
    light_evidence,
    movement_evidence,
    scatter_evidence,
    spot_evidence,
    unfit_evidence,
)
from calibration.checks.frame_consistency import has_enough_cells
from calibration.figures.figure import (
    JUDGEMENT,
    SIMULATED,
    Explanation,
    Figure,
    Line,
    SummaryRow,
)
from experiment.measures.sensor import MAX_BLACK_DRIFT
from experiment.measures.stains import added_light
from foundation.errors import counted, first_few

if TYPE_CHECKING:
    from calibration.checks.frame_consistency import ForeignFrame
    from calibration.measurements import FrameMeasurements, TableMeasurements
    from experiment.session.records import FrameRecord

_FrameValue = Callable[["TableMeasurements", "FrameMeasurements"], float]

# What helps against each cause of unfit cells (`calibration.pipeline.collecting`).
_UNFIT_REMEDIES = {
    "outside": "bring all of the chart into the picture",
    "clipped": "expose less",
    "covered": "uncover the chart",
    "hot": "let the camera cool",
    "dead": "have the camera's pixels remapped",
    "stained": "clean the print or print it anew, and light it evenly",
    "disturbed": "see that nothing comes between lamp, print and camera",
    "unlike": "look at the cell in the frame of that light",
    "misplaced": "hang the print flatter",
    "lit": "turn print or projector until no lamp, window or bright wall is mirrored on the print",
    "uneven": "focus on the print and keep the camera still",
}

_SAME_EXPOSURE = "keep one exposure and ISO speed for the session, and take these frames again"


def _cell_count(table: TableMeasurements) -> int:
    return len(table.registration.mismatched_cells)


def _most_unfit(table: TableMeasurements) -> tuple[str, str] | None:
    """Return how many unfit cells are of the commonest kind, and what helps against that."""
    if not table.cells.unfit:
        return None
    kind, count = Counter(cell.kind for cell in table.cells.unfit).most_common(1)[0]
    return f", {count} of them {kind}", _UNFIT_REMEDIES.get(kind, "look at the report")


def _unfit_row(table: TableMeasurements) -> SummaryRow:
    count = len(table.cells.unfit)
    return SummaryRow("Cells unfit for use", str(count), "listed in lut.json, never filled", brief=True)


UNFIT_SHARE = Figure(
    "unfit_share", "Cells unfit for use", "radiometry", "share", "at most", 0.005, 0.1,
    why="colours without samples are missing from every picture", source=JUDGEMENT, remedy="",
    found=_most_unfit, measure=lambda table: len(table.cells.unfit) / max(_cell_count(table), 1),
    of_one_frame="bounded",
    cause=Explanation("unfit cells", unfit_evidence, follows=("block_deviation",)), drawing="errors",
    lines=(Line(290, _unfit_row),),
)  # fmt: skip


DOUBTFUL_SHARE = Figure(
    "doubtful_share", "Cells in surroundings 1 % off their codes' colours", "radiometry", "share", "at most", 0.0003,
    None,
    why="the print, or the light on it, is not the same there as elsewhere; from 2 % on its cells are listed as unfit",
    source=SIMULATED + ": none on a clean flat print",
    remedy="clean the print, hang it flatter, and look for shadows on it",
    measure=lambda table: float(table.cells.stains.doubtful.mean()) if table.cells.stains.known else None,
    of_one_frame="known",
    cause=Explanation("spot", spot_evidence), drawing="errors",
)  # fmt: skip


ADDED_LIGHT = Figure(
    "added_light", "Light added to a large part of the print, of paper white", "radiometry", "share", "at most", 0.004,
    0.01,
    why="it is the same on dark cells as on bright ones, and goes on beyond those that are listed as unfit",
    source=SIMULATED + ": 0 in healthy rooms; 1 % of paper makes cells of a tenth of paper 10 % brighter, and those "
    "of a thirtieth 30 %; a reflection of 3 % leaves a table with cells 57 % off",
    remedy="turn print or projector until nothing is mirrored on it, or print on matt paper",
    measure=lambda table: added_light(table.cells.stains) if table.cells.stains.known else None,
    of_one_frame="known", cause=Explanation("spot", spot_evidence), drawing="errors",
)  # fmt: skip


def _frames_beyond(value: _FrameValue) -> Callable[[TableMeasurements, float], list[FrameRecord] | None]:
    """Return what tells the frames beyond a limit by themselves; of all of them none is told."""

    def retake(table: TableMeasurements, limit: float) -> list[FrameRecord] | None:
        beyond = [frame.record for frame in table.frames if value(table, frame) > limit]
        # Where every frame is beyond, the fault is not one of single frames.
        return beyond if len(beyond) < len(table.frames) else None

    return retake


def _softest(table: TableMeasurements) -> FrameMeasurements:
    return max(table.frames, key=lambda frame: frame.blur_px)


def _softest_text(table: TableMeasurements, accepted: float) -> str:
    return f"in {_softest(table).record.file}, whose blur is σ = {_softest(table).blur_px:.2f} px"


FRAME_BLUR = Figure(
    "frame_blur", "Light of neighbouring cells added in the most blurred frame", "geometry", "share", "at most",
    0.003, 0.012,
    why="a frame is out of focus, or was shaken; only white frames are checked cell by cell for such light",
    source=SIMULATED + ": 0.9 px of blur in one frame of a session with 0.5 px give 0.8 % and cells 1.2 % off, "
    "1.1 px 2 % and cells 4 % off",
    remedy="switch off autofocus and stabilisation, see that nothing shakes the camera",
    measure=lambda table: table.added_bleed(_softest(table)), of_one_frame="bounded",
    where=_softest_text, retake=_frames_beyond(lambda table, frame: table.added_bleed(frame)),
    cause=Explanation("frame", blur_evidence), drawing="course",
)  # fmt: skip


def _of_alike_frames(value: _FrameValue) -> Callable[[TableMeasurements], float | None]:
    """Return what measures the largest value of a frame, on charts of enough cells to compare frames by."""

    def measure(table: TableMeasurements) -> float | None:
        known = has_enough_cells(_cell_count(table))
        return max(value(table, frame) for frame in table.frames) if known else None

    return measure


FRAME_SCATTER = Figure(
    "frame_scatter", "Scatter of cells about their codes' colours, worst frame", "radiometry", "share", "at most",
    0.012, 0.03,
    why="the frame's samples are not of their cells' colours",
    source=SIMULATED + ": to 0.8 % beyond noise; a blur of 1.1 px gives 1.4 %, 1.5 px 5 %, another print 50 %",
    remedy="see that nothing changes during the session",
    measure=_of_alike_frames(lambda table, frame: frame.consistency.scatter), of_one_frame="bounded",
    where=lambda table, accepted: f"in {max(table.frames, key=lambda one: one.consistency.scatter).record.file}",
    retake=_frames_beyond(lambda table, frame: frame.consistency.scatter),
    cause=Explanation("frame", scatter_evidence, follows=("block_deviation", "disturbed_cells")), drawing="course",
)  # fmt: skip


BLOCK_DEVIATION = Figure(
    "block_deviation", "Deviation of the worst block of cells, worst frame", "radiometry", "share", "at most",
    0.01, 0.03,
    why="something lay, or shone, on the print in that frame or in the one compared with, and its samples contain it",
    source=SIMULATED + ": to 0.4 % beyond noise", remedy="see that nobody comes between lamp, print and camera",
    measure=_of_alike_frames(lambda table, frame: frame.consistency.block), of_one_frame="bounded",
    retake=_frames_beyond(lambda table, frame: frame.consistency.block),
    cause=Explanation("block", block_evidence), drawing="course",
)  # fmt: skip


def _disturbed(table: TableMeasurements) -> float | None:
    lights = [frame for frame in table.frames if frame.record.kind == "light"]
    found = {cell for frame in lights for cell, _ in frame.consistency.disturbed}
    return float(len(found)) if has_enough_cells(_cell_count(table)) else None


DISTURBED_CELLS = Figure(
    "disturbed_cells", "Cells next to each other that are far off in a light's frame", "radiometry", "", "at most", 0,
    None,
    why="their samples under that light are not of their own colours; they are listed as unfit, and the other cells "
    "are not touched",
    source=SIMULATED + ": none in healthy rooms; two cells next to each other, five standard deviations off, are one, "
    "unless the dark frames show them to be hot",
    remedy="see that nothing comes between lamp, print and camera",
    measure=_disturbed, of_one_frame="bounded",
    cause=Explanation("few cells", disturbed_evidence, follows=("block_deviation",)), drawing="errors",
)  # fmt: skip


def _reregistered(table: TableMeasurements) -> int:
    return sum(frame.reregistered for frame in table.frames)


def _movement_row(table: TableMeasurements) -> SummaryRow | None:
    if len(table.frames) < 2:
        return None
    moved, note = f"{table.largest_shift_px:.3f} px at most", f"{_reregistered(table)} frames registered again"
    return SummaryRow("Movement of the chart", moved, note, brief=True)


REREGISTERED_FRAMES = Figure(
    "reregistered_frames", "Frames registered again", "geometry", "", "at most", 0, None,
    why="the chart or the camera moved between frames; the sampling grid followed", source=JUDGEMENT,
    remedy="fix camera and print, and let nobody walk about",
    measure=lambda table: float(_reregistered(table)), of_one_frame="bounded",
    cause=Explanation("movement", movement_evidence), drawing="course", lines=(Line(120, _movement_row),),
)  # fmt: skip


def _foreign(frames: tuple[ForeignFrame, ...]) -> str:
    if not frames:
        return ""
    names = first_few([frame.record.file for frame in frames])
    return f"{counted(len(frames), 'frame')}: {names}, with {frames[0].found} instead of {frames[0].expected}"


OTHER_CAMERA = Figure(
    "other_camera", "Frames of another camera", "radiometry", "", "at most", 0, 0.5,
    why="a table is of one camera: another body sees other colours, and another model others yet",
    source="by definition",
    remedy="take these frames again with the session's camera",
    foremost=True, measure=lambda table: float(len(table.origins.other_camera)), of_one_frame="bounded",
    where=lambda table, accepted: _foreign(table.origins.other_camera),
    retake=lambda table, limit: [frame.record for frame in table.origins.other_camera],
    cause=Explanation("camera", camera_evidence),
)  # fmt: skip

OTHER_LENS = Figure(
    "other_lens", "Frames through another lens", "radiometry", "", "at most", 0, None,
    why="lenses tint, blur and shade each in its own way", source="by definition",
    remedy="take these frames again through the session's lens",
    measure=lambda table: float(len(table.origins.other_lens)), of_one_frame="bounded",
    where=lambda table, accepted: _foreign(table.origins.other_lens), cause=Explanation("camera", camera_evidence),
)  # fmt: skip


def _otherwise_exposed(table: TableMeasurements, limit: float) -> list[FrameRecord]:
    others = table.origins.other_exposure
    return [frame.record for frame in others if max(frame.ratio, 1 / frame.ratio) - 1 > limit]


OTHER_EXPOSURE = Figure(
    "other_exposure", "Exposure of a frame against that of most, as the files state it", "radiometry", "share",
    "at most", 0.01, 0.1,
    why="brightness would differ between lights that should be alike, and the noise with the ISO speed",
    source="shutter times are steps of 26 % apart, and are written rounded",
    remedy=_SAME_EXPOSURE,
    foremost=True, measure=lambda table: table.origins.exposure_difference, of_one_frame="bounded",
    where=lambda table, accepted: _foreign(table.origins.other_exposure), retake=_otherwise_exposed,
    cause=Explanation("brightness", light_evidence),
)  # fmt: skip

OTHER_ISO = Figure(
    "other_iso", "Frames of another ISO speed", "radiometry", "", "at most", 0, None,
    why="their noise is another, and so is the count at which they saturate; their exposure is judged apart",
    source="by definition", remedy=_SAME_EXPOSURE,
    measure=lambda table: float(len(table.origins.other_iso)), of_one_frame="bounded",
    where=lambda table, accepted: _foreign(table.origins.other_iso), cause=Explanation("iso", iso_evidence),
)  # fmt: skip

WHITE_FRAMES = Figure(
    "white_frames", "White frames", "light", "", "at least", 1, None,
    why="nothing says how the lamp drifted, whether the print has stains, or whether cells are of one colour",
    source="by definition; from two on a drift is seen",
    remedy="take white frames along with the lights (sequence.reference_every)",
    before_session=False, measure=lambda table: float(len(table.white_frames)), drawing="course",
)  # fmt: skip


def _black_row(table: TableMeasurements) -> SummaryRow:
    black = np.mean([frame.black for frame in table.frames], axis=0)
    note = f"drift {table.black_drift:.2f} counts, up to {MAX_BLACK_DRIFT:g} is usual"
    return SummaryRow("Black level", f"{black.mean():.2f} counts", note)


BLACK_DRIFT_COUNTS = Figure(
    "black_drift_counts", "Drift of the black level", "radiometry", "counts", "at most", MAX_BLACK_DRIFT, 16.0,
    why="the sensor warmed up; each frame's own black is subtracted, but an error of it shows in dark cells of about "
    "30 counts",
    source=JUDGEMENT, remedy="let the camera run for some minutes before the session, and rest between frames",
    measure=lambda table: table.black_drift, of_one_frame="bounded", drawing="course", lines=(Line(140, _black_row),),
)  # fmt: skip
