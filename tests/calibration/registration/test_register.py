"""The chart's place in a frame, against the place from which the simulated frame was rendered."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from benchmarks import rooms
from calibration.figures.radiometry import UNFIT_SHARE
from calibration.registration import register as registering
from calibration.registration.geometry import Lens
from calibration.registration.matching import Blocks, PlaceErrors
from calibration.registration.register import CLEARANCE_PX, MAX_PLACE_ERROR_PX, Registration, register
from calibration.registration.tiles import Raster
from calibration.sampling import SAMPLE_REACH_PX
from drivers.presenter import Colour
from drivers.raw.rawfile import CHANNELS, Mosaic, read_raw
from experiment.chart.layout import A_SERIES_MM, design_chart, paper_chart
from experiment.framing.field import SIDE_POINTS, DetectedField, field_mm
from foundation.errors import RegistrationError
from sim.world.world import Room
from tests.calibration.lab import QUARTER, Lab, hang, hang_chart
from tests.data_files import shipped


@pytest.fixture(scope="module")
def white(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    """Return a frame of the lab in white light."""
    return lab.mosaic(tmp_path_factory.mktemp("white"))


@pytest.fixture(scope="module")
def registered(lab: Lab, white: Mosaic) -> Registration:
    return register(white, lab.chart)


@pytest.mark.slow
def test_a_chart_of_4096_colours_in_the_default_room(tmp_path: Path) -> None:
    """Its cells are as large as a whole chart's on a whole frame, which `benchmarks.rooms` registers."""
    lab = hang_chart(design_chart(4, A_SERIES_MM["A2"]), QUARTER, Room())
    mosaic = lab.mosaic(tmp_path)
    error = lab.miss_px(mosaic)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert error.max() < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("colour", [Colour(255, 0, 0), Colour(0, 0, 255), Colour(90, 60, 20)])
def test_every_light_registers(lab: Lab, tmp_path: Path, colour: Colour) -> None:
    error = lab.miss_px(lab.mosaic(tmp_path, colour))
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.6


@pytest.mark.slow
@pytest.mark.parametrize(("bits", "page", "roll"), [(1, "A7", 180.0), (2, "A6", 0.5)])
def test_small_charts_upright_and_upside_down(tmp_path: Path, bits: int, page: str, roll: float) -> None:
    lab = hang(bits, page, room=Room(waviness_mm=0.5, roll_deg=roll))
    error = lab.miss_px(lab.mosaic(tmp_path))
    assert np.sqrt(np.mean(error**2)) < 0.15
    assert error.max() < 0.6


@pytest.mark.slow
def test_waves_that_tags_cannot_see(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=3.0, seed=5))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    truth = lab.truth_px(lab.chart.centres_mm, mosaic)
    by_tags = np.linalg.norm(registration.lens.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    by_cells = np.linalg.norm(registration.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    assert (by_cells**2).mean() < 0.25 * (by_tags**2).mean()
    assert by_cells.max() < 0.6


@pytest.mark.slow
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


@pytest.mark.slow
def test_what_agrees_too_little_is_refused(lab: Lab, white: Mosaic, monkeypatch: pytest.MonkeyPatch) -> None:
    """Charts with tags have a limit of their own."""
    monkeypatch.setattr(registering, "MIN_AGREEMENT", 1.0)
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white, lab.chart)


@pytest.mark.slow
def test_corners_of_tags_are_known_in_the_channel_in_which_they_are_found(lab: Lab, registered: Registration) -> None:
    known = registering._tag_corners(registered.framing, lab.chart)
    assert len(known.points_mm) == 4 * len(registered.framing.tags)
    # Between the .085 px of white light and the .2 of weak ones.
    own = known.information.any(axis=(1, 2, 3))
    assert own.sum() == 1
    for information in known.information[own][0]:
        np.testing.assert_allclose(information, np.eye(2) / 0.15**2)


@pytest.mark.slow
def test_shifted_moves_every_point(lab: Lab, registered: Registration) -> None:
    moved = registered.shifted(0.25, -0.5).to_pixels(lab.chart.centres_mm)
    assert moved - registered.to_pixels(lab.chart.centres_mm) == pytest.approx(np.tile([0.25, -0.5], (len(moved), 1)))


@pytest.mark.slow
def test_another_order_of_colours_is_refused(lab: Lab, white: Mosaic) -> None:
    other = design_chart(3, A_SERIES_MM["A5"], 2)
    assert [tag.id for tag in other.tags] == [tag.id for tag in lab.chart.tags]
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white, other)


@pytest.mark.slow
def test_a_slip_by_one_cell_is_refused_or_mended(lab: Lab, white: Mosaic) -> None:
    """A chart file whose cells stand one cell beside the print must not give a table one cell off."""
    slipped = replace(lab.chart, centres_mm=lab.chart.centres_mm + np.array([lab.chart.cell_mm[0], 0]))
    try:
        places = register(white, slipped).to_pixels(slipped.centres_mm)
    except RegistrationError:
        return
    assert np.abs(places - lab.truth_px(lab.chart.centres_mm, white)).max() < 1


@pytest.mark.slow
def test_a_covered_half_is_refused(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[top + height // 4 : top + 3 * height // 4, left + width // 6 : left + 5 * width // 6] = 2600

    with pytest.raises(RegistrationError, match="uncover"):
        register(lab.mosaic(tmp_path, paint=cover), lab.chart)


@pytest.mark.slow
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


@pytest.mark.slow
def test_too_far_away_is_refused(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=0.5, fill=0.78))
    with pytest.raises(RegistrationError, match="nearer"):
        register(lab.mosaic(tmp_path), lab.chart)


@pytest.mark.slow
def test_a_real_photograph_without_the_chart_is_refused(lab: Lab) -> None:
    path = shipped("raw/canon_eos_550d_colorchart.dng")
    with pytest.raises(RegistrationError) as caught:
        register(read_raw(path), lab.chart, path.name)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_mirrored_frame_is_called_mirrored(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible

    def mirror(counts: npt.NDArray[np.uint16]) -> None:
        seen = counts[top : top + height, left : left + width // 2 * 2]
        # Whole blocks change places, so that every photosite keeps its colour.
        seen[:] = seen.reshape(height, -1, 2)[:, ::-1].reshape(height, -1).copy()

    with pytest.raises(RegistrationError, match="is mirrored"):
        register(lab.mosaic(tmp_path, paint=mirror), lab.chart)


@pytest.mark.slow
def test_a_turned_camera_sees_the_same_chart(tmp_path: Path) -> None:
    roll = 37.0
    lab = hang(1, "A7", room=Room(waviness_mm=0.5, roll_deg=roll, fill=0.55))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    error = registration.to_pixels(lab.chart.centres_mm) - lab.truth_px(lab.chart.centres_mm, mosaic)
    assert np.linalg.norm(error, axis=1).max() < 0.6
    turned = registration.framing.rotation_deg - roll
    assert abs((turned + 180) % 360 - 180) < 5


@pytest.mark.slow
def test_a_room_that_nothing_was_tuned_for() -> None:
    """More of them, on whole charts, are in `benchmarks.rooms`."""
    case = rooms.random_case(102)
    error = rooms.miss(replace(case, body="Test", room=replace(case.room, blur_px=0.7)), 2, "A6")
    assert error.max() < rooms.SILENT_PX / 2
    assert np.sqrt((error**2).mean()) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("clearance", "uncertain"), [(3, True), (5, False)])
def test_places_matter_less_in_large_cells(lab: Lab, registered: Registration, clearance: int, uncertain: bool) -> None:
    found = registered
    known_to_a_pixel = replace(found.place_errors, error_px=np.ones_like(found.place_errors.error_px))
    large = replace(found, place_errors=known_to_a_pixel, cell_px=2 * (SAMPLE_REACH_PX + clearance * CLEARANCE_PX))
    assert large.clearance == pytest.approx(clearance)
    np.testing.assert_allclose(large.uncertainty_px(lab.chart.centres_mm), 1)
    # Two pixels, of half a pixel for each clearance of a cell of 10 px.
    assert ((large.expanded_px(lab.chart.centres_mm) > MAX_PLACE_ERROR_PX) == uncertain).all()


# What registrations are refused for, at each limit and beyond it, and how well places are said to be known.


CHART = design_chart(2, "A7", 1)


def registration(
    scores: npt.ArrayLike = (0.9,) * 8, residual: float = 0.05, cell_px: float = 10.0, agreement: float = 0.99,
    error: float = 0.1, has_tags: bool = True,
) -> Any:  # fmt: skip
    """Return a registration with blocks of given scores, all of which would move by so much."""
    count = len(np.asarray(scores))
    blocks = Blocks(
        np.zeros((count, 2)), np.asarray(scores, dtype=np.float64), np.full((count, 2), residual / np.sqrt(2))
    )
    errors = PlaceErrors(Raster(np.zeros(2), np.ones(2), (7, 9)), np.full((7, 9), error))
    return Registration(
        framing=SimpleNamespace(field=None if has_tags else "outline"), lens=None, displacement=None, lateral=None,  # pyrefly: ignore[bad-argument-type]
        marks_residual_px=np.array([[3.0, 4.0], [0.0, 0.0]]), lens_residual_px=1.0, blocks=blocks, place_errors=errors,
        colours=None, mismatched_cells=np.zeros(64, np.bool_), agreement=agreement, blur_px=0.6, cell_px=cell_px,  # pyrefly: ignore[bad-argument-type]
    )  # fmt: skip


def refused(said: str) -> AbstractContextManager[object]:
    """Return what requires a refusal that says so; nothing is refused where it is ""."""
    return pytest.raises(RegistrationError, match=re.escape(said)) if said else nullcontext()


@pytest.mark.parametrize(
    ("given", "least", "said"),
    [
        ({"agreement": 0.8}, 0.8, ""),
        ({"agreement": 0.79}, 0.8, "correlate by 0.79"),
        # A block counts from a correlation of a half on, and three of four are needed.
        ({"scores": [0.5] * 6 + [0.49] * 2}, 0.8, ""),
        ({"scores": [0.5] * 5 + [0.49] * 3}, 0.8, "62% of the blocks"),
        ({"residual": 0.499}, 0.8, ""),
        ({"residual": 0.51}, 0.8, "0.51 px RMS, at most 0.5"),
        # Samples of cells of 17 px lie three times as far from their cells' edges.
        ({"residual": 1.49, "cell_px": 17.0}, 0.8, ""),
        ({"residual": 1.51, "cell_px": 17.0}, 0.8, "at most 1.5"),
    ],
)
def test_a_registration_is_refused_beyond_its_limits(given: dict[str, Any], least: float, said: str) -> None:
    with refused(said):
        registering._judge(registration(**given), least, "it")


@pytest.mark.parametrize(
    ("cell_px", "blur", "said"), [(10.0, 1.0, ""), (10.0, 1.01, "focus"), (30.0, 5.8, ""), (30.0, 5.9, "focus")]
)
def test_a_blur_is_refused_that_cells_are_too_small_for(cell_px: float, blur: float, said: str) -> None:
    with refused(said):
        registering._require_size_and_focus(cell_px, blur, "it")
    least = registering.MIN_CELL_PX
    with refused(f"at least {least:g}"):
        registering._require_size_and_focus(least - 0.01, 0.5, "it")
    registering._require_size_and_focus(least, 0.5, "it")


@pytest.mark.parametrize(
    ("slipped", "parts", "fails"), [(1, 10, False), (2, 133, True), (2, 134, False), (3, 200, True)]
)
def test_a_field_is_refused_of_which_two_parts_and_one_and_a_half_per_cent_have_slipped(
    slipped: int, parts: int, fails: bool
) -> None:
    matcher: Any = SimpleNamespace(slipped=lambda cells: (np.full((slipped, 2), 7.0), parts))  # pyrefly: ignore[implicit-any-lambda]
    with refused("colours of the cells beside them" if fails else ""):
        registering._require_own_cells(matcher, np.zeros(9, np.bool_), "it")


def test_places_may_be_off_by_two_errors_or_three_of_a_chart_without_tags() -> None:
    points = np.array([[1.5, 2.5], [4.0, 4.0]])
    for has_tags, errors in ((True, 2), (False, 3)):
        for error, is_uncertain in ((0.49 / errors, False), (0.51 / errors, True)):
            found = registration(error=error, has_tags=has_tags)
            np.testing.assert_allclose(found.expanded_px(points), errors * error)
            assert (found.expanded_px(points) > MAX_PLACE_ERROR_PX).tolist() == [is_uncertain] * 2
    assert registration().clearance == 1
    assert registration(cell_px=13.5).clearance == pytest.approx(2)
    found = registration()
    assert found.marks_rms_px == pytest.approx(np.sqrt(12.5))
    error = np.arange(63.0).reshape(7, 9)
    found.place_errors.error_px[...] = error
    # The outermost but one, which have the neighbours that they are told by.
    rim = np.concatenate([error[1], error[5], error[:, 1], error[:, 7]])
    assert found.places_known_px == pytest.approx((31, np.percentile(rim, 99)))


def test_a_block_s_score_sinks_with_its_mismatched_cells() -> None:
    centres = np.array([CHART.centres_mm.min(axis=0), CHART.centres_mm.max(axis=0)])
    blocks = Blocks(centres, np.array([0.8, 0.9]), np.zeros((2, 2)))
    first = np.linalg.norm(CHART.centres_mm - centres[0], axis=1) < np.linalg.norm(
        CHART.centres_mm - centres[1], axis=1
    )
    cells = np.flatnonzero(first)[::4]
    bad = np.zeros(CHART.colour_count, np.bool_)
    bad[cells] = True
    found = registering._without_mismatched_cells(blocks, bad, CHART)
    assert found.score == pytest.approx([0.8 * (1 - len(cells) / first.sum()), 0.9])


def test_an_outline_is_completed_where_it_was_not_found_with_normals_that_point_outwards() -> None:
    chart = paper_chart("A4", 4)
    corners = field_mm(chart)
    lens = Lens(np.array([[2.0, 0, 30], [0, 3.0, 40], [0, 0, 1]]), np.zeros(2), 1000.0, np.zeros(4))
    share = (np.arange(SIDE_POINTS) + 0.5)[:, None] / SIDE_POINTS
    sides = [start + share * (end - start) for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    # The second side, at the right, was not found; nor was half of the third, below.
    known = np.concatenate([sides[0], sides[2][: SIDE_POINTS // 2], sides[3]])
    field = DetectedField(np.zeros((4, 2)), np.eye(3), known, np.zeros_like(known), np.zeros_like(known), 1.0)
    found = registering._completed(field, lens, chart)
    added, normals = found.outline_mm[len(known) :], found.normals[len(known) :]
    np.testing.assert_array_equal(found.outline_mm[: len(known)], known)
    np.testing.assert_allclose(found.outline_px[len(known) :], lens.to_pixels(added))
    right = np.isclose(added[:, 0], corners[:, 0].max())
    np.testing.assert_allclose(normals[right], np.tile([1.0, 0], (right.sum(), 1)), atol=1e-9)
    np.testing.assert_allclose(normals[~right], np.tile([0, 1.0], ((~right).sum(), 1)), atol=1e-9)
    # But for points within two steps of those that were found, at either end.
    assert right.sum() == pytest.approx(SIDE_POINTS, abs=4)
    assert (~right).sum() == pytest.approx(SIDE_POINTS // 2, abs=4)


# A chart without tags registered by corners by hand and by its cells, against the place it was rendered from.


SMALL = paper_chart("A6", 3)


@pytest.fixture(scope="module")
def plain() -> Lab:
    return hang_chart(SMALL, "Test", Room(waviness_mm=0.5))


@pytest.fixture(scope="module")
def white_without_tags(plain: Lab, tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    """Return a frame of the lab in white_without_tags light."""
    return plain.mosaic(tmp_path_factory.mktemp("white_without_tags"))


@pytest.fixture(scope="module")
def registered_without_tags(plain: Lab, white_without_tags: Mosaic) -> Registration:
    return register(white_without_tags, plain.chart, corners=plain.corners_px(white_without_tags))


@pytest.mark.slow
def test_blue_light_registers(plain: Lab, tmp_path: Path) -> None:
    error = plain.miss_px(plain.mosaic(tmp_path, Colour(0, 0, 255)))
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.4


@pytest.mark.slow
def test_every_colour_is_where_a_lens_with_lateral_colour_shows_it(tmp_path: Path) -> None:
    """The outline is clear in all colours, and in each it lies elsewhere."""
    lab = hang_chart(SMALL, "Test", Room(waviness_mm=0.5, seed=4, lateral_red_px=1.0, lateral_blue_px=-1.0))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, SMALL, corners=lab.corners_px(mosaic))
    green = lab.truth_px(SMALL.centres_mm, mosaic)
    for channel in CHANNELS:
        shift = lab.world.project(SMALL.centres_mm, channel) - lab.world.project(SMALL.centres_mm)
        error = np.linalg.norm(registration.to_pixels(SMALL.centres_mm, channel) - green - shift, axis=1)
        assert np.sqrt((error**2).mean()) < 0.04
        assert error.max() < 0.1
    assert registration.lateral.corner_px("R") == pytest.approx(1.0, abs=0.15)
    assert registration.lateral.corner_px("B") == pytest.approx(-1.0, abs=0.15)


WAVES = Room(waviness_mm=6.0, wave_mm=150.0, curl_mm=25.0, focal_diagonals=0.8)


@pytest.mark.slow
def test_cells_that_the_map_does_not_follow_are_known_to_be_uncertain(tmp_path: Path) -> None:
    """Waves shorter than the displacement's knots: cells are up to a pixel off, and the outline shows that they may be.

    As many as to refuse the table: nothing tells which cells inside the field are off.
    """
    lab = hang_chart(SMALL, "Test", replace(WAVES, seed=2))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, SMALL, corners=lab.corners_px(mosaic))
    error = np.linalg.norm(registration.to_pixels(SMALL.centres_mm) - lab.truth_px(SMALL.centres_mm, mosaic), axis=1)
    assert error.max() > 0.5, "a room in which it matters"
    uncertain = registration.expanded_px(SMALL.centres_mm) > MAX_PLACE_ERROR_PX
    assert uncertain[error > 0.5].all()
    assert uncertain.mean() > (UNFIT_SHARE.refuse or 1)


@pytest.mark.slow
def test_a_curl_is_not_taken_for_distortion(tmp_path: Path) -> None:
    """By its outline alone it is: cells were .2 px RMS and up to .7 px off, and none was listed."""
    room = Room(seed=2, curl_mm=60.0, focal_diagonals=0.8, lateral_red_px=1.0, lateral_blue_px=-1.0)
    lab = hang_chart(SMALL, "Test", room)
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, SMALL, corners=lab.corners_px(mosaic))
    error = np.linalg.norm(registration.to_pixels(SMALL.centres_mm) - lab.truth_px(SMALL.centres_mm, mosaic), axis=1)
    assert np.sqrt((error**2).mean()) < 0.12
    assert error.max() < 0.3
    assert not (registration.expanded_px(SMALL.centres_mm) > MAX_PLACE_ERROR_PX).any()


@pytest.mark.slow
def test_a_flat_sheet_has_no_uncertain_cell(
    plain: Lab, white_without_tags: Mosaic, registered_without_tags: Registration
) -> None:
    assert not (registered_without_tags.expanded_px(SMALL.centres_mm) > MAX_PLACE_ERROR_PX).any()
    error = np.linalg.norm(
        registered_without_tags.to_pixels(SMALL.centres_mm) - plain.truth_px(SMALL.centres_mm, white_without_tags),
        axis=1,
    )
    assert (error < 3 * registered_without_tags.uncertainty_px(SMALL.centres_mm)).all()


@pytest.mark.slow
def test_a_large_grid_on_a_sheet_that_waves_by_six_millimetres(tmp_path: Path) -> None:
    """The paper's whole grid is in `benchmarks.plain`."""
    lab = hang_chart(paper_chart("A3", 4), QUARTER, Room(waviness_mm=6.0, seed=3))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart, corners=lab.corners_px(mosaic))
    truth = lab.truth_px(lab.chart.centres_mm, mosaic)
    error = np.asarray(np.linalg.norm(registration.to_pixels(lab.chart.centres_mm) - truth, axis=1), dtype=np.float64)
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.7
    assert registration.blocks.good.all()
    assert not registration.mismatched_cells.any()
    assert registration.agreement > 0.999


@pytest.mark.slow
def test_another_order_of_colours_is_refused_without_tags(plain: Lab, white_without_tags: Mosaic) -> None:
    shuffled = replace(plain.chart, colours=np.random.default_rng(1).permutation(plain.chart.colours))
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white_without_tags, shuffled, corners=plain.corners_px(white_without_tags))


@pytest.mark.slow
def test_a_field_displaced_by_one_cell_is_refused(plain: Lab, white_without_tags: Mosaic) -> None:
    """The outline fits, and every block of cells looks smooth as it should: only the colours' level shows it.

    A slip along y is found on large charts alone: with two rows of blocks it looks like an ink that reacts to blue.
    """
    columns = len(np.unique(plain.chart.centres_mm[:, 0].round(3)))
    grid = plain.chart.colours.reshape(-1, columns)
    other = replace(plain.chart, colours=np.roll(grid, 1, axis=1).reshape(-1))
    with pytest.raises(RegistrationError):
        register(white_without_tags, other, corners=plain.corners_px(white_without_tags))


@pytest.mark.slow
def test_a_covered_part_is_named_and_does_not_pull_its_neighbours(plain: Lab, tmp_path: Path) -> None:
    top, left, height, width = plain.world.body.visible
    rows, columns = slice(top + height // 2, top + height // 2 + 80), slice(left + width // 3, left + width // 3 + 80)

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[rows, columns] = 7000

    mosaic = plain.mosaic(tmp_path, paint=cover)
    registration = register(mosaic, plain.chart, corners=plain.corners_px(mosaic))
    truth = plain.truth_px(plain.chart.centres_mm, mosaic)
    middle = np.array([width / 6 + 20, height / 4 + 20])
    hidden = (np.abs(truth - middle) < 14).all(axis=1)
    free = (np.abs(truth - middle) > 35).any(axis=1)
    assert hidden.sum() >= 4
    assert registration.mismatched_cells[hidden].all()
    assert not registration.mismatched_cells[free].any()
    error = np.linalg.norm(registration.to_pixels(plain.chart.centres_mm) - truth, axis=1)
    assert error[free].max() < 0.6


@pytest.mark.slow
def test_out_of_focus_is_refused(tmp_path: Path) -> None:
    lab = hang_chart(SMALL, "Test", Room(waviness_mm=0.5, blur_px=1.6))
    mosaic = lab.mosaic(tmp_path)
    with pytest.raises(RegistrationError):
        register(mosaic, lab.chart, corners=lab.corners_px(mosaic))
