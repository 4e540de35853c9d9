"""The chart's place in a frame, against the place from which the simulated frame was rendered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks import rooms
from calibration.registration import register as registering
from calibration.registration.register import CLEARANCE_PX, MAX_PLACE_ERROR_PX, Registration, register
from calibration.sampling import SAMPLE_REACH_PX
from drivers.presenter import Colour
from drivers.raw.rawfile import Mosaic, read_raw
from experiment.chart.layout import A_SERIES_MM, design_chart
from foundation.errors import RegistrationError
from sim.world.world import Room
from tests.calibration.lab import QUARTER, Lab, hang, hang_chart
from tests.data_files import shipped

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def white(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    """Return a frame of the lab in white light."""
    return lab.mosaic(tmp_path_factory.mktemp("white"))


@pytest.fixture(scope="module")
def registered(lab: Lab, white: Mosaic) -> Registration:
    return register(white, lab.chart)


def test_a_chart_of_4096_colours_in_the_default_room(tmp_path: Path) -> None:
    """Its cells are as large as a whole chart's on a whole frame, which `benchmarks.rooms` registers."""
    lab = hang_chart(design_chart(4, A_SERIES_MM["A2"]), QUARTER, Room())
    mosaic = lab.mosaic(tmp_path)
    error = lab.miss_px(mosaic)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert error.max() < 0.3


@pytest.mark.parametrize("colour", [Colour(255, 0, 0), Colour(0, 0, 255), Colour(90, 60, 20)])
def test_every_light_registers(lab: Lab, tmp_path: Path, colour: Colour) -> None:
    error = lab.miss_px(lab.mosaic(tmp_path, colour))
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.6


@pytest.mark.parametrize(("bits", "page", "roll"), [(1, "A7", 180.0), (2, "A6", 0.5)])
def test_small_charts_upright_and_upside_down(tmp_path: Path, bits: int, page: str, roll: float) -> None:
    lab = hang(bits, page, room=Room(waviness_mm=0.5, roll_deg=roll))
    error = lab.miss_px(lab.mosaic(tmp_path))
    assert np.sqrt(np.mean(error**2)) < 0.15
    assert error.max() < 0.6


def test_waves_that_tags_cannot_see(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=3.0, seed=5))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    truth = lab.truth_px(lab.chart.centres_mm, mosaic)
    by_tags = np.linalg.norm(registration.lens.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    by_cells = np.linalg.norm(registration.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    assert (by_cells**2).mean() < 0.25 * (by_tags**2).mean()
    assert by_cells.max() < 0.6


def test_the_estimate_of_its_own_error_is_honest(lab: Lab, white: Mosaic, registered: Registration) -> None:
    assert registered.agreement > 0.99
    assert registered.block_rms_px < 0.03
    assert registered.blocks.good.all()
    assert registered.cell_px == pytest.approx(9, abs=1)
    centres = lab.chart.centres_mm
    error = np.linalg.norm(registered.to_pixels(centres) - lab.truth_px(centres, white), axis=1)
    said = registered.uncertainty_px(centres)
    # Of a whole chart it is 99 %; here most cells are at the rim.
    assert np.percentile(error / said, 98) < 3
    assert said.max() < 3 * max(error.max(), 0.1)
    assert not (registered.expanded_px(centres) > MAX_PLACE_ERROR_PX).any()


def test_what_agrees_too_little_is_refused(lab: Lab, white: Mosaic, monkeypatch: pytest.MonkeyPatch) -> None:
    """Charts with tags have a limit of their own."""
    monkeypatch.setattr(registering, "MIN_AGREEMENT", 1.0)
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white, lab.chart)


def test_corners_of_tags_are_known_in_the_channel_in_which_they_are_found(lab: Lab, registered: Registration) -> None:
    known = registering._tag_corners(registered.framing, lab.chart)
    assert len(known.points_mm) == 4 * len(registered.framing.tags)
    # Between the .085 px of white light and the .2 of weak ones.
    own = known.information.any(axis=(1, 2, 3))
    assert own.sum() == 1
    for information in known.information[own][0]:
        np.testing.assert_allclose(information, np.eye(2) / 0.15**2)


def test_shifted_moves_every_point(lab: Lab, registered: Registration) -> None:
    moved = registered.shifted(0.25, -0.5).to_pixels(lab.chart.centres_mm)
    assert moved - registered.to_pixels(lab.chart.centres_mm) == pytest.approx(np.tile([0.25, -0.5], (len(moved), 1)))


def test_another_order_of_colours_is_refused(lab: Lab, white: Mosaic) -> None:
    other = design_chart(3, A_SERIES_MM["A5"], 2)
    assert [tag.id for tag in other.tags] == [tag.id for tag in lab.chart.tags]
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white, other)


def test_a_slip_by_one_cell_is_refused_or_mended(lab: Lab, white: Mosaic) -> None:
    """A chart file whose cells stand one cell beside the print must not give a table one cell off."""
    slipped = replace(lab.chart, centres_mm=lab.chart.centres_mm + np.array([lab.chart.cell_mm[0], 0]))
    try:
        places = register(white, slipped).to_pixels(slipped.centres_mm)
    except RegistrationError:
        return
    assert np.abs(places - lab.truth_px(lab.chart.centres_mm, white)).max() < 1


def test_a_covered_half_is_refused(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[top + height // 4 : top + 3 * height // 4, left + width // 6 : left + 5 * width // 6] = 2600

    with pytest.raises(RegistrationError, match="uncover"):
        register(lab.mosaic(tmp_path, paint=cover), lab.chart)


def test_a_covered_part_does_not_pull_its_neighbours(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible
    rows, columns = slice(top + height // 2, top + height // 2 + 120), slice(left + width // 2, left + width // 2 + 120)

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[rows, columns] = 3000

    mosaic = lab.mosaic(tmp_path, paint=cover)
    registration = register(mosaic, lab.chart)
    truth = lab.truth_px(lab.chart.centres_mm, mosaic)
    middle = np.array([width / 4 + 30, height / 4 + 30])
    free = (np.abs(truth - middle) > 48).any(axis=1)
    error = np.linalg.norm(registration.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    assert error[free].max() < 0.6
    hidden = (np.abs(truth - middle) < 25).all(axis=1)
    assert hidden.sum() > 15
    assert registration.mismatched_cells[hidden].all()
    assert not registration.mismatched_cells[free].any()


def test_too_far_away_is_refused(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=0.5, fill=0.78))
    with pytest.raises(RegistrationError, match="nearer"):
        register(lab.mosaic(tmp_path), lab.chart)


def test_a_real_photograph_without_the_chart_is_refused(lab: Lab) -> None:
    path = shipped("raw/canon_eos_550d_colorchart.dng")
    with pytest.raises(RegistrationError, match="none found") as caught:
        register(read_raw(path), lab.chart, path.name)
    assert "\n" not in str(caught.value)


def test_a_mirrored_frame_is_called_mirrored(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible

    def mirror(counts: npt.NDArray[np.uint16]) -> None:
        seen = counts[top : top + height, left : left + width // 2 * 2]
        # Whole blocks change places, so that every photosite keeps its colour.
        seen[:] = seen.reshape(height, -1, 2)[:, ::-1].reshape(height, -1).copy()

    with pytest.raises(RegistrationError, match="is mirrored"):
        register(lab.mosaic(tmp_path, paint=mirror), lab.chart)


def test_a_turned_camera_sees_the_same_chart(tmp_path: Path) -> None:
    roll = 37.0
    lab = hang(1, "A7", room=Room(waviness_mm=0.5, roll_deg=roll, fill=0.55))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    error = registration.to_pixels(lab.chart.centres_mm) - lab.truth_px(lab.chart.centres_mm, mosaic)
    assert np.linalg.norm(error, axis=1).max() < 0.6
    turned = registration.framing.rotation_deg - roll
    assert abs((turned + 180) % 360 - 180) < 5


def test_a_room_that_nothing_was_tuned_for() -> None:
    """More of them, on whole charts, are in `benchmarks.rooms`."""
    case = rooms.random_case(102)
    error = rooms.miss(replace(case, body="Test", room=replace(case.room, blur_px=0.7)), 2, "A6")
    assert error.max() < rooms.SILENT_PX / 2
    assert np.sqrt((error**2).mean()) < 0.1


@pytest.mark.parametrize(("clearance", "uncertain"), [(3, True), (5, False)])
def test_places_matter_less_in_large_cells(lab: Lab, registered: Registration, clearance: int, uncertain: bool) -> None:
    found = registered
    known_to_a_pixel = replace(found.place_errors, error_px=np.ones_like(found.place_errors.error_px))
    large = replace(found, place_errors=known_to_a_pixel, cell_px=2 * (SAMPLE_REACH_PX + clearance * CLEARANCE_PX))
    assert large.clearance == pytest.approx(clearance)
    np.testing.assert_allclose(large.uncertainty_px(lab.chart.centres_mm), 1)
    # Two pixels, of half a pixel for each clearance of a cell of 10 px.
    assert ((large.expanded_px(lab.chart.centres_mm) > MAX_PLACE_ERROR_PX) == uncertain).all()
