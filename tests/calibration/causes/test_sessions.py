"""Sessions with one thing wrong: the frame, the place and the cause are named, and a clean one has no remark on it.

A wrong cause is worse than none: wherever the evidence does not decide, the cause must be unknown.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.causes.rules import (
    DEFOCUS,
    OBJECT_IN_FRAME,
    OTHER_EXPOSURE,
    REFLECTION,
    REFLECTION_IN_FRAME,
    STAIN,
    UNKNOWN,
    Cause,
)
from calibration.figures.all_figures import FIGURES
from calibration.pipeline.build import build
from calibration.verdict import BuildResult, ProbableCause, findings, remark, retaken_frames
from drivers.presenter import Colour
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from sim.world.world import Blob, Room, Situation
from tests.calibration.causes.rooms import BRIGHT, HAND, Counts, glare, half, nth_white, taken
from tests.calibration.lab import Lab, hang

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("pinned_builds", "lens_unmeasured")]

REMARKING = tuple(replace(limit, refuse=None) for limit in FIGURES)
"""The limits, none of which refuses: a table is made, and all that is wrong is a remark."""


def measured(session: Session, folder: Path) -> tuple[BuildResult, dict[str, ProbableCause]]:
    with session:
        result = build(session, folder / "lut", judged_by=REMARKING)
    return result, findings(result.verdict, result.figures)


def causes(found: dict[str, ProbableCause]) -> set[Cause]:
    return {finding.decision.cause for finding in found.values()} - {UNKNOWN}


def hand_in(which: str, lab: Lab, folder: Path) -> Session:
    if which.startswith("white"):
        return taken(lab, folder, nth_white(int(which[-1])), situation=HAND)
    return taken(lab, folder, lambda step: step.kind == "light" and step.illumination == 1, situation=HAND)


@pytest.mark.parametrize(
    ("which", "file"),
    [("white 0", "0000_white"), ("light 1", "0003_light_001")],
)
def test_a_hand_in_one_frame_is_that_frame_s(which: str, file: str, lab: Lab, tmp_path: Path) -> None:
    result, found = measured(hand_in(which, lab, tmp_path / "session"), tmp_path)
    assert causes(found) == {OBJECT_IN_FRAME}
    assert [frame.file for frame in retaken_frames(result.verdict, result.figures)] == [f"frames/{file}.dng"]
    # Cells under a hand in the first frame do not look like the chart's and are not compared; references tell of it.
    finding = found["reference_spread" if which == "white 0" else "block_deviation"]
    page = np.array(lab.chart.page_mm)
    (place,) = finding.places
    assert place.file == f"frames/{file}.dng"
    left, top, right, bottom = HAND.blobs[0].place
    assert left - 0.05 < place.x_mm / page[0] < right + 0.05
    assert top - 0.05 < place.y_mm / page[1] < bottom + 0.05
    row = next(row for row in result.verdict.remarks if row.figure.name == finding.figure)
    told = remark(row, result.figures)
    assert f"in frames/{file}.dng, about" in told
    assert "probably a hand, a person or an object before the print" in told
    assert told.endswith(
        "take 1 frame again: acquire run LAB.toml SESSION --retake " + ("bad" if "w" in which else "1")
    )


def test_what_covers_few_cells_costs_these_cells_and_not_the_table(lab: Lab, tmp_path: Path) -> None:
    """A fly of two cells' size in one light: with the limits as they are."""
    fly = Situation(blobs=(Blob((0.5, 0.5, 0.54, 0.56), left=0.4),))
    light = next(light.index for light in BRIGHT if min(light.colour) > 80)
    with taken(lab, tmp_path / "session", lambda step: step.illumination == light, situation=fly) as session:
        result = build(session, tmp_path / "lut")
    (row,) = (row for row in result.verdict.remarks if row.figure.name == "disturbed_cells")
    assert 2 <= row.value <= 12
    unfit = {cell.colour for cell in result.figures.cells.unfit if cell.cause.startswith("disturbed")}
    assert len(unfit) == row.value
    page = np.array(lab.chart.page_mm)
    places = lab.chart.centres_mm[lab.chart.cell_of_colour]
    half = np.array(lab.chart.cell_mm) / 2
    low, high = np.array([0.5, 0.5]) * page, np.array([0.54, 0.56]) * page
    covered = np.flatnonzero(((places + half > low) & (places - half < high)).all(axis=1))
    middle = np.flatnonzero(((places > low) & (places < high)).all(axis=1))
    assert set(middle.tolist()) <= unfit <= set(covered.tolist())
    finding = findings(result.verdict, result.figures)["disturbed_cells"]
    assert finding.decision.cause is OBJECT_IN_FRAME
    assert remark(row, result.figures).endswith(f"acquire run LAB.toml SESSION --retake {light}")


def test_a_reflection_in_one_frame_is_no_hand(lab: Lab, tmp_path: Path) -> None:
    light = next(light.index for light in BRIGHT if min(light.colour) > 80)
    session = taken(lab, tmp_path / "session", lambda step: step.illumination == light, paint=glare(lab, 0.05, 0.2))
    result, found = measured(session, tmp_path)
    assert causes(found) == {REFLECTION_IN_FRAME}
    assert all(finding.is_known for finding in found.values())
    assert [frame.illumination for frame in retaken_frames(result.verdict, result.figures)] == [light]


def test_a_broad_glare_is_no_stain(lab: Lab, tmp_path: Path) -> None:
    """3 % of paper's light, as a projector mirrored in a glossy print gives it."""
    result, found = measured(taken(lab, tmp_path / "session", paint=glare(lab, 0.03, 0.3)), tmp_path)
    assert causes(found) == {REFLECTION}
    assert not retaken_frames(result.verdict, result.figures)
    row = next(row for row in result.verdict.remarks if row.figure.name == "unfit_share")
    assert "probably a reflection on the print in all frames" in remark(row, result.figures)
    assert "clean the print" not in remark(row, result.figures)


def test_a_stain_is_one(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=0.5, stain_mm=25, stain_depth=0.3))
    result, found = measured(taken(lab, tmp_path / "session"), tmp_path)
    assert causes(found) == {STAIN}
    stain = lab.world.stain
    assert stain is not None
    place = found["doubtful_share"].places[0]
    assert np.hypot(place.x_mm - stain.centre_mm[0], place.y_mm - stain.centre_mm[1]) < 8
    assert 18 < place.size_mm < 40
    assert not retaken_frames(result.verdict, result.figures)


def test_one_hot_photosite_in_a_dark_cell_needs_no_word(lab: Lab, tmp_path: Path) -> None:
    """3000 counts in every frame, dark ones too: the cell is listed, and no block is off for it."""
    dark = int(np.argmin(lab.chart.rgb[lab.chart.cell_of_colour].sum(axis=1)))
    x, y = np.rint(2 * lab.world.project(lab.chart.centres_mm[lab.chart.cell_of_colour][[dark]])[0] + 0.5).astype(int)
    visible = lab.world.body.visible

    def heat(counts: Counts, colour: Colour) -> None:
        counts[visible.top + y, visible.left + x] += 3000

    result, found = measured(taken(lab, tmp_path / "session", paint=heat), tmp_path)
    assert [cell.colour for cell in result.figures.cells.unfit] == [dark]
    assert result.figures.cells.unfit[0].cause.startswith("hot")
    assert "block_deviation" not in found
    assert not causes(found)


def test_a_white_frame_of_half_the_exposure_is_told_by_its_file(lab: Lab, tmp_path: Path) -> None:
    _, found = measured(taken(lab, tmp_path / "session", nth_white(1), settings=half()), tmp_path)
    assert causes(found) == {OTHER_EXPOSURE}
    (frame,) = next(finding for finding in found.values() if finding.is_known).frames
    assert "white" in frame.file


def test_a_frame_out_of_focus_is_called_that(lab: Lab, tmp_path: Path) -> None:
    def one(step: SessionStep) -> bool:
        return step.kind == "light" and step.illumination == 2

    _, found = measured(taken(lab, tmp_path / "session", one, situation=Situation(defocus_px=0.9)), tmp_path)
    assert causes(found) == {DEFOCUS}
    assert found["frame_blur"].decision.cause is DEFOCUS


def test_dark_corners_are_no_dirt(tmp_path: Path) -> None:
    """Corners at 42 to 52 % of the centre's light: the field follows them, and nothing is to be said."""
    lab = hang(room=Room(waviness_mm=0.5, vignetting=0.45, projector_falloff=0.25))
    _, found = measured(taken(lab, tmp_path / "session"), tmp_path)
    assert not {"reference_spread", "doubtful_share", "block_deviation"} & found.keys()
    assert not causes(found)


def test_a_clean_room_has_no_cause(tmp_path: Path) -> None:
    room = Room(seed=2, waviness_mm=0.8, vignetting=0.3, projector_falloff=0.1, primary_difference=0.2, blur_px=0.45)
    _, found = measured(taken(hang(room=room), tmp_path / "session", lambda step: False), tmp_path)
    assert not found
