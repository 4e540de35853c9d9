"""Figures of the patches of the print, of differences between frames, and of the camera."""

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

# Remedy for each kind of unfit patch (`calibration.pipeline.collecting`).
_UNFIT_REMEDIES = {
    "outside": "bring the whole chart into the frame",
    "clipped": "expose less",
    "covered": "uncover the chart",
    "hot": "let the camera cool",
    "dead": "have the camera's pixels remapped",
    "stained": "clean the print or print it again, and light it evenly",
    "disturbed": "keep the space between lamp, print and camera free",
    "unlike": "check the patch in the frame of that illuminant",
    "misplaced": "hang the print flatter",
    "lit": "turn the print or the projector until the print mirrors no lamp, window or bright wall",
    "uneven": "focus on the print, and keep the camera still",
}

_KEEP_EXPOSURE = "keep one exposure and ISO speed for the session, and take these frames again"


def _cell_count(table: TableMeasurements) -> int:
    return len(table.registration.mismatched_cells)


def _unfit_detail(table: TableMeasurements) -> tuple[str, str] | None:
    if not table.cells.unfit:
        return None
    kind, count = Counter(cell.kind for cell in table.cells.unfit).most_common(1)[0]
    return f", {count} of them {kind}", _UNFIT_REMEDIES.get(kind, "check the patches in the report")


def _unfit_row(table: TableMeasurements) -> SummaryRow:
    count = len(table.cells.unfit)
    return SummaryRow("Unfit patches", str(count), "listed in lut.json; never interpolated", brief=True)


UNFIT_SHARE = Figure(
    "unfit_share", "Unfit patches", "radiometry", "share", "at most", 0.005, 0.1,
    why="generated images lack the colours of unfit patches", source=JUDGEMENT, remedy="",
    detail=_unfit_detail, measure=lambda table: len(table.cells.unfit) / max(_cell_count(table), 1),
    from_one_frame="beyond",
    cause=Explanation("unfit cells", unfit_evidence, follows=("block_deviation",)), drawing="errors",
    lines=(Line(290, _unfit_row),),
)  # fmt: skip


DOUBTFUL_SHARE = Figure(
    "doubtful_share", "Patches in areas that deviate by 1 % from their predicted colours", "radiometry", "share",
    "at most", 0.0003, None,
    why="the print, or the light on it, differs in these areas; patches that deviate by 2 % are listed as unfit",
    source=SIMULATED + ": 0 on a clean flat print",
    remedy="clean the print, hang it flatter, and look for shadows on it",
    measure=lambda table: float(table.cells.stains.doubtful.mean()) if table.cells.stains.is_known else None,
    from_one_frame="yes", cause=Explanation("spot", spot_evidence), drawing="errors",
)  # fmt: skip


ADDED_LIGHT = Figure(
    "added_light", "Light added to a large part of the print, relative to paper white", "radiometry", "share",
    "at most", 0.004, 0.01,
    why="a reflection adds the same light to dark and bright patches, also to patches that are not listed as unfit",
    source=SIMULATED + ": 0 without faults. Light of 1 % of paper white makes a patch with a reflectance of "
    "10 % brighter by a tenth",
    remedy="turn the print or the projector until the print shows no reflection, or print on matt paper",
    measure=lambda table: added_light(table.cells.stains) if table.cells.stains.is_known else None,
    from_one_frame="yes", cause=Explanation("spot", spot_evidence), drawing="errors",
)  # fmt: skip


def _frames_beyond(value: _FrameValue) -> Callable[[TableMeasurements, float], list[FrameRecord] | None]:
    def retake(table: TableMeasurements, limit: float) -> list[FrameRecord] | None:
        beyond = [frame.record for frame in table.frames if value(table, frame) > limit]
        # If every frame exceeds the limit, the fault does not concern single frames.
        return beyond if len(beyond) < len(table.frames) else None

    return retake


def _most_blurred(table: TableMeasurements) -> FrameMeasurements:
    return max(table.frames, key=lambda frame: frame.blur_px)


def _most_blurred_text(table: TableMeasurements, accepted: float) -> str:
    return f"in {_most_blurred(table).record.file}, with a blur of σ = {_most_blurred(table).blur_px:.2f} px"


FRAME_BLUR = Figure(
    "frame_blur", "Light from neighbouring patches, added by blur in the worst frame", "geometry", "share", "at most",
    0.003, 0.012,
    why="a frame is more blurred than the frame registered first, because it is out of focus or shaken",
    source=SIMULATED + ": a blur of 0.9 px instead of 0.5 px adds 0.8 %, and causes errors of 1.2 % in patches",
    remedy="switch off autofocus and stabilisation, and keep the camera free from vibration",
    measure=lambda table: table.added_bleed(_most_blurred(table)), from_one_frame="beyond",
    where=_most_blurred_text, retake=_frames_beyond(lambda table, frame: table.added_bleed(frame)),
    cause=Explanation("frame", blur_evidence), drawing="frames",
)  # fmt: skip


def _largest_of_frames(value: _FrameValue) -> Callable[[TableMeasurements], float | None]:
    def measure(table: TableMeasurements) -> float | None:
        is_comparable = has_enough_cells(_cell_count(table))
        return max(value(table, frame) for frame in table.frames) if is_comparable else None

    return measure


FRAME_SCATTER = Figure(
    "frame_scatter", "Scatter of patches about their predicted colours, worst frame", "radiometry", "share", "at most",
    0.012, 0.03,
    why="the frame's samples do not have the colours of their patches",
    source=SIMULATED + ": up to 0.8 % without faults, 5 % with a blur of 1.5 px, and 50 % with another print",
    remedy="keep everything unchanged during the session",
    measure=_largest_of_frames(lambda table, frame: frame.consistency.scatter), from_one_frame="beyond",
    where=lambda table, accepted: f"in {max(table.frames, key=lambda frame: frame.consistency.scatter).record.file}",
    retake=_frames_beyond(lambda table, frame: frame.consistency.scatter),
    cause=Explanation("frame", scatter_evidence, follows=("block_deviation", "disturbed_cells")), drawing="frames",
)  # fmt: skip


BLOCK_DEVIATION = Figure(
    "block_deviation", "Deviation of the worst block of patches, worst frame", "radiometry", "share", "at most",
    0.01, 0.03,
    why="an object or a light changed the samples of an area in this frame, or in the frame registered first",
    source=SIMULATED + ": up to 0.4 % without faults",
    remedy="keep people out of the space between lamp, print and camera",
    measure=_largest_of_frames(lambda table, frame: frame.consistency.block), from_one_frame="beyond",
    retake=_frames_beyond(lambda table, frame: frame.consistency.block),
    cause=Explanation("block", block_evidence), drawing="frames",
)  # fmt: skip


def _disturbed_count(table: TableMeasurements) -> float | None:
    lights = [frame for frame in table.frames if frame.record.kind == "light"]
    disturbed_cells = {cell for frame in lights for cell, _ in frame.consistency.disturbed}
    return float(len(disturbed_cells)) if has_enough_cells(_cell_count(table)) else None


DISTURBED_CELLS = Figure(
    "disturbed_cells", "Adjacent patches with large deviations in an illuminant's frame", "radiometry", "", "at most",
    0, None,
    why="the samples of these patches are wrong under the illuminant, so that the patches are listed as unfit",
    source=SIMULATED + ": 0 without faults. Two adjacent patches count if they deviate by five standard deviations and "
    "have no hot photosites",
    remedy="keep the space between lamp, print and camera free", measure=_disturbed_count, from_one_frame="beyond",
    cause=Explanation("few cells", disturbed_evidence, follows=("block_deviation",)), drawing="errors",
)  # fmt: skip


def _reregistered_count(table: TableMeasurements) -> int:
    return sum(frame.reregistered for frame in table.frames)


def _movement_row(table: TableMeasurements) -> SummaryRow | None:
    if len(table.frames) < 2:
        return None
    moved, note = (
        f"{table.largest_shift_px:.3f} px at most",
        f"{counted(_reregistered_count(table), 'frame')} registered again",
    )
    return SummaryRow("Movement of the chart", moved, note, brief=True)


REREGISTERED_FRAMES = Figure(
    "reregistered_frames", "Frames registered again", "geometry", "", "at most", 0, None,
    why="the chart or the camera moved between frames; samples were taken at the new positions", source=JUDGEMENT,
    remedy="fasten camera and print, and keep people away",
    measure=lambda table: float(_reregistered_count(table)), from_one_frame="beyond",
    cause=Explanation("movement", movement_evidence), drawing="frames", lines=(Line(120, _movement_row),),
)  # fmt: skip


def _foreign_frames_text(frames: tuple[ForeignFrame, ...]) -> str:
    if not frames:
        return ""
    names = first_few([frame.record.file for frame in frames])
    return f"{counted(len(frames), 'frame')}: {names}, with {frames[0].found} instead of {frames[0].expected}"


OTHER_CAMERA = Figure(
    "other_camera", "Frames of another camera", "radiometry", "", "at most", 0, 0.5,
    why="a LUT belongs to one camera: other bodies and models record other colours", source="by definition",
    remedy="take these frames again with the session's camera",
    foremost=True, measure=lambda table: float(len(table.origins.other_camera)), from_one_frame="beyond",
    where=lambda table, accepted: _foreign_frames_text(table.origins.other_camera),
    retake=lambda table, limit: [frame.record for frame in table.origins.other_camera],
    cause=Explanation("camera", camera_evidence),
)  # fmt: skip

OTHER_LENS = Figure(
    "other_lens", "Frames through another lens", "radiometry", "", "at most", 0, None,
    why="lenses differ in tint, blur and shading", source="by definition",
    remedy="take these frames again with the session's lens",
    measure=lambda table: float(len(table.origins.other_lens)), from_one_frame="beyond",
    where=lambda table, accepted: _foreign_frames_text(table.origins.other_lens),
    cause=Explanation("camera", camera_evidence),
)  # fmt: skip


def _frames_of_other_exposure(table: TableMeasurements, limit: float) -> list[FrameRecord]:
    foreign_frames = table.origins.other_exposure
    return [frame.record for frame in foreign_frames if max(frame.ratio, 1 / frame.ratio) - 1 > limit]


OTHER_EXPOSURE = Figure(
    "other_exposure", "Difference between the recorded exposure of a frame and that of most frames", "radiometry",
    "share", "at most", 0.01, 0.1,
    why="illuminants of equal brightness would differ in brightness, and the noise would change with the ISO speed",
    source="rounding of times in files is smaller; a step of the shutter time is 26 %", remedy=_KEEP_EXPOSURE,
    foremost=True, measure=lambda table: table.origins.exposure_difference, from_one_frame="beyond",
    where=lambda table, accepted: _foreign_frames_text(table.origins.other_exposure), retake=_frames_of_other_exposure,
    cause=Explanation("brightness", light_evidence),
)  # fmt: skip

OTHER_ISO = Figure(
    "other_iso", "Frames of another ISO speed", "radiometry", "", "at most", 0, None,
    why="these frames differ in noise and saturation; their exposure is judged separately",
    source="by definition", remedy=_KEEP_EXPOSURE,
    measure=lambda table: float(len(table.origins.other_iso)), from_one_frame="beyond",
    where=lambda table, accepted: _foreign_frames_text(table.origins.other_iso), cause=Explanation("iso", iso_evidence),
)  # fmt: skip

WHITE_FRAMES = Figure(
    "white_frames", "White frames", "light", "", "at least", 1, None,
    why="without white frames, drift of the lamp, stains and the uniformity of patches cannot be measured",
    source="by definition. Drift needs two white frames",
    remedy="take white frames during the session (sequence.reference_every)",
    before_session=False, measure=lambda table: float(len(table.white_frames)), drawing="frames",
)  # fmt: skip


def _black_row(table: TableMeasurements) -> SummaryRow:
    black = np.mean([frame.black for frame in table.frames], axis=0)
    note = f"drift {table.black_drift:.2f} counts; up to {MAX_BLACK_DRIFT:g} counts is usual"
    return SummaryRow("Black level", f"{black.mean():.2f} counts", note)


BLACK_DRIFT_COUNTS = Figure(
    "black_drift_counts", "Drift of the black level", "radiometry", "counts", "at most", MAX_BLACK_DRIFT, 16.0,
    why="the sensor warmed up; the black level of each frame is subtracted, but its error affects dark patches",
    source=JUDGEMENT, remedy="let the camera run for some minutes before the session, and pause between frames",
    measure=lambda table: table.black_drift, from_one_frame="beyond", drawing="frames", lines=(Line(140, _black_row),),
)  # fmt: skip
