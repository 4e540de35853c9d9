"""Registration of simulated frames, compared with the rendered positions."""

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
    """Return a frame of the laboratory under white."""
    return lab.mosaic(tmp_path_factory.mktemp("white"))


@pytest.fixture(scope="module")
def registered(lab: Lab, white: Mosaic) -> Registration:
    return register(white, lab.chart)


@pytest.mark.slow
def test_registers_4096_colours_in_default_room(tmp_path: Path) -> None:
    """Patches are as large as on a full chart in a full frame, which `benchmarks.rooms` registers."""
    lab = hang_chart(design_chart(4, A_SERIES_MM["A2"]), QUARTER, Room())
    mosaic = lab.mosaic(tmp_path)
    error = lab.miss_px(mosaic)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert error.max() < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("colour", [Colour(255, 0, 0), Colour(0, 0, 255), Colour(90, 60, 20)])
def test_registers_coloured_illuminants(lab: Lab, tmp_path: Path, colour: Colour) -> None:
    error = lab.miss_px(lab.mosaic(tmp_path, colour))
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.6


@pytest.mark.slow
@pytest.mark.parametrize(("bits", "page", "roll"), [(1, "A7", 180.0), (2, "A6", 0.5)])
def test_registers_small_charts_upright_and_upside_down(tmp_path: Path, bits: int, page: str, roll: float) -> None:
    lab = hang(bits, page, room=Room(waviness_mm=0.5, roll_deg=roll))
    error = lab.miss_px(lab.mosaic(tmp_path))
    assert np.sqrt(np.mean(error**2)) < 0.15
    assert error.max() < 0.6


@pytest.mark.slow
def test_follows_waves_between_tags(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=3.0, seed=5))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    truth = lab.truth_px(lab.chart.centres_mm, mosaic)
    error_of_tags = np.linalg.norm(registration.lens.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    error_of_patches = np.linalg.norm(registration.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    assert (error_of_patches**2).mean() < 0.25 * (error_of_tags**2).mean()
    assert error_of_patches.max() < 0.6


@pytest.mark.slow
def test_reported_uncertainty_covers_errors(lab: Lab, white: Mosaic, registered: Registration) -> None:
    assert registered.agreement > 0.99
    assert registered.block_rms_px < 0.03
    assert registered.blocks.good.all()
    assert registered.cell_px == pytest.approx(9, abs=1)
    centres = lab.chart.centres_mm
    error = np.linalg.norm(registered.to_pixels(centres) - lab.truth_px(centres, white), axis=1)
    uncertainty = registered.uncertainty_px(centres)
    # 99 % on a full chart; here most patches are at the rim.
    assert np.percentile(error / uncertainty, 98) < 3
    assert uncertainty.max() < 3 * max(error.max(), 0.1)
    assert not (registered.expanded_px(centres) > MAX_PLACE_ERROR_PX).any()


@pytest.mark.slow
def test_refuses_low_agreement(lab: Lab, white: Mosaic, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registering, "MIN_AGREEMENT", 1.0)
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white, lab.chart)


@pytest.mark.slow
def test_tag_corners_have_information_in_their_channel(lab: Lab, registered: Registration) -> None:
    anchors = registering._tag_corners(registered.framing, lab.chart)
    assert len(anchors.points_mm) == 4 * len(registered.framing.tags)
    # between 0.085 px under white and 0.2 px under dim illuminants
    has_information = anchors.information.any(axis=(1, 2, 3))
    assert has_information.sum() == 1
    for information in anchors.information[has_information][0]:
        np.testing.assert_allclose(information, np.eye(2) / 0.15**2)


@pytest.mark.slow
def test_shifted_moves_every_point(lab: Lab, registered: Registration) -> None:
    moved = registered.shifted(0.25, -0.5).to_pixels(lab.chart.centres_mm)
    assert moved - registered.to_pixels(lab.chart.centres_mm) == pytest.approx(np.tile([0.25, -0.5], (len(moved), 1)))


@pytest.mark.slow
def test_refuses_another_order_of_colours(lab: Lab, white: Mosaic) -> None:
    other_chart = design_chart(3, A_SERIES_MM["A5"], 2)
    assert [tag.id for tag in other_chart.tags] == [tag.id for tag in lab.chart.tags]
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white, other_chart)


@pytest.mark.slow
def test_refuses_or_corrects_displacement_by_one_patch(lab: Lab, white: Mosaic) -> None:
    """A chart file that is displaced by one patch must not give a displaced LUT."""
    slipped = replace(lab.chart, centres_mm=lab.chart.centres_mm + np.array([lab.chart.cell_mm[0], 0]))
    try:
        positions_px = register(white, slipped).to_pixels(slipped.centres_mm)
    except RegistrationError:
        return
    assert np.abs(positions_px - lab.truth_px(lab.chart.centres_mm, white)).max() < 1


@pytest.mark.slow
def test_refuses_half_covered_chart(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[top + height // 4 : top + 3 * height // 4, left + width // 6 : left + 5 * width // 6] = 2600

    with pytest.raises(RegistrationError, match="uncover"):
        register(lab.mosaic(tmp_path, paint=cover), lab.chart)


@pytest.mark.slow
def test_small_cover_does_not_move_neighbours(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible
    rows, columns = slice(top + height // 2, top + height // 2 + 120), slice(left + width // 2, left + width // 2 + 120)

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[rows, columns] = 3000

    mosaic = lab.mosaic(tmp_path, paint=cover)
    registration = register(mosaic, lab.chart)
    truth = lab.truth_px(lab.chart.centres_mm, mosaic)
    middle = np.array([width / 4 + 30, height / 4 + 30])
    is_uncovered = (np.abs(truth - middle) > 48).any(axis=1)
    error = np.linalg.norm(registration.to_pixels(lab.chart.centres_mm) - truth, axis=1)
    assert error[is_uncovered].max() < 0.6
    is_covered = (np.abs(truth - middle) < 25).all(axis=1)
    assert is_covered.sum() > 15
    assert registration.mismatched_cells[is_covered].all()
    assert not registration.mismatched_cells[is_uncovered].any()


@pytest.mark.slow
def test_refuses_small_chart(tmp_path: Path) -> None:
    lab = hang(room=Room(waviness_mm=0.5, fill=0.78))
    with pytest.raises(RegistrationError, match="closer"):
        register(lab.mosaic(tmp_path), lab.chart)


@pytest.mark.slow
def test_refuses_photograph_without_chart(lab: Lab) -> None:
    path = shipped("raw/canon_eos_550d_colorchart.dng")
    with pytest.raises(RegistrationError) as caught:
        register(read_raw(path), lab.chart, path.name)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_reports_mirrored_frame(lab: Lab, tmp_path: Path) -> None:
    top, left, height, width = lab.world.body.visible

    def mirror(counts: npt.NDArray[np.uint16]) -> None:
        visible_counts = counts[top : top + height, left : left + width // 2 * 2]
        # Blocks are swapped as a whole, so that every photosite keeps its colour filter.
        visible_counts[:] = visible_counts.reshape(height, -1, 2)[:, ::-1].reshape(height, -1).copy()

    with pytest.raises(RegistrationError, match="is mirrored"):
        register(lab.mosaic(tmp_path, paint=mirror), lab.chart)


@pytest.mark.slow
def test_registers_rotated_camera(tmp_path: Path) -> None:
    roll = 37.0
    lab = hang(1, "A7", room=Room(waviness_mm=0.5, roll_deg=roll, fill=0.55))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, lab.chart)
    error = registration.to_pixels(lab.chart.centres_mm) - lab.truth_px(lab.chart.centres_mm, mosaic)
    assert np.linalg.norm(error, axis=1).max() < 0.6
    turned = registration.framing.rotation_deg - roll
    assert abs((turned + 180) % 360 - 180) < 5


@pytest.mark.slow
def test_registers_random_room() -> None:
    """`benchmarks.rooms` has more of them, with full charts."""
    case = rooms.random_case(102)
    error = rooms.miss(replace(case, body="Test", room=replace(case.room, blur_px=0.7)), 2, "A6")
    assert error.max() < rooms.SILENT_PX / 2
    assert np.sqrt((error**2).mean()) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("clearance", "fails"), [(3, True), (5, False)])
def test_large_patches_tolerate_errors(lab: Lab, registered: Registration, clearance: int, fails: bool) -> None:
    errors = registered.place_errors
    one_pixel = replace(errors, error_px=np.ones_like(errors.error_px))
    large = replace(registered, place_errors=one_pixel, cell_px=2 * (SAMPLE_REACH_PX + clearance * CLEARANCE_PX))
    assert large.clearance == pytest.approx(clearance)
    np.testing.assert_allclose(large.uncertainty_px(lab.chart.centres_mm), 1)
    # 2 px; the limit is 0.5 px times the clearance
    assert ((large.expanded_px(lab.chart.centres_mm) > MAX_PLACE_ERROR_PX) == fails).all()


# Limits of a registration, at and beyond each limit, and uncertainty of positions.


CHART = design_chart(2, "A7", 1)


def registration(
    scores: npt.ArrayLike = (0.9,) * 8, residual: float = 0.05, cell_px: float = 10.0, agreement: float = 0.99,
    error: float = 0.1, has_tags: bool = True,
) -> Any:  # fmt: skip
    """Return a registration with given scores of blocks and the same residual for all blocks."""
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


def expect_refusal(text: str) -> AbstractContextManager[object]:
    """Expect a `RegistrationError` with a text, or no error if it is empty."""
    return pytest.raises(RegistrationError, match=re.escape(text)) if text else nullcontext()


@pytest.mark.parametrize(
    ("values", "minimum_agreement", "message"),
    [
        ({"agreement": 0.8}, 0.8, ""),
        ({"agreement": 0.79}, 0.8, "correlation is 0.79, expected at least 0.8"),
        # Blocks need a correlation of 0.5, and three of four blocks are needed.
        ({"scores": [0.5] * 6 + [0.49] * 2}, 0.8, ""),
        ({"scores": [0.5] * 5 + [0.49] * 3}, 0.8, "62% of the blocks"),
        ({"residual": 0.499}, 0.8, ""),
        ({"residual": 0.51}, 0.8, "0.51 px RMS, expected at most 0.5"),
        # Samples of patches of 17 px are three times as far from the edges.
        ({"residual": 1.49, "cell_px": 17.0}, 0.8, ""),
        ({"residual": 1.51, "cell_px": 17.0}, 0.8, "at most 1.5"),
    ],
)
def test_refuses_registration_beyond_limits(values: dict[str, Any], minimum_agreement: float, message: str) -> None:
    with expect_refusal(message):
        registering._require_match(registration(**values), minimum_agreement, "it")


@pytest.mark.parametrize(
    ("cell_px", "blur", "message"), [(10.0, 1.0, ""), (10.0, 1.01, "focus"), (30.0, 5.8, ""), (30.0, 5.9, "focus")]
)
def test_refuses_blur_and_size_beyond_limits(cell_px: float, blur: float, message: str) -> None:
    with expect_refusal(message):
        registering._require_size_and_focus(cell_px, blur, "it")
    minimum = registering.MIN_CELL_PX
    with expect_refusal(f"at least {minimum:g} px"):
        registering._require_size_and_focus(minimum - 0.01, 0.5, "it")
    registering._require_size_and_focus(minimum, 0.5, "it")


@pytest.mark.parametrize(
    ("slipped", "area_count", "is_refused"), [(1, 10, False), (2, 133, True), (2, 134, False), (3, 200, True)]
)
def test_refuses_several_displaced_areas(slipped: int, area_count: int, is_refused: bool) -> None:
    matcher: Any = SimpleNamespace(find_displaced_areas=lambda cells: (np.full((slipped, 2), 7.0), area_count))  # pyrefly: ignore[implicit-any-lambda]
    with expect_refusal("colours of the neighbouring patches" if is_refused else ""):
        registering._refuse_displaced_areas(matcher, np.zeros(9, np.bool_), "it")


def test_coverage_factor_is_two_or_three_without_tags() -> None:
    points = np.array([[1.5, 2.5], [4.0, 4.0]])
    for has_tags, factor in ((True, 2), (False, 3)):
        for error, is_uncertain in ((0.49 / factor, False), (0.51 / factor, True)):
            result = registration(error=error, has_tags=has_tags)
            np.testing.assert_allclose(result.expanded_px(points), factor * error)
            assert (result.expanded_px(points) > MAX_PLACE_ERROR_PX).tolist() == [is_uncertain] * 2
    assert registration().clearance == 1
    assert registration(cell_px=13.5).clearance == pytest.approx(2)
    result = registration()
    assert result.marks_rms_px == pytest.approx(np.sqrt(12.5))
    error = np.arange(63.0).reshape(7, 9)
    result.place_errors.error_px[...] = error
    # The outermost ring but one, which has neighbours on all sides.
    rim = np.concatenate([error[1], error[5], error[:, 1], error[:, 7]])
    assert result.position_uncertainty_px == pytest.approx((31, np.percentile(rim, 99)))


def test_mismatched_patches_reduce_score_of_block() -> None:
    centres = np.array([CHART.centres_mm.min(axis=0), CHART.centres_mm.max(axis=0)])
    blocks = Blocks(centres, np.array([0.8, 0.9]), np.zeros((2, 2)))
    in_first_block = np.linalg.norm(CHART.centres_mm - centres[0], axis=1) < np.linalg.norm(
        CHART.centres_mm - centres[1], axis=1
    )
    mismatched = np.flatnonzero(in_first_block)[::4]
    is_mismatched = np.zeros(CHART.colour_count, np.bool_)
    is_mismatched[mismatched] = True
    reduced = registering._reduce_scores_of_mismatched(blocks, is_mismatched, CHART)
    assert reduced.score == pytest.approx([0.8 * (1 - len(mismatched) / in_first_block.sum()), 0.9])


def test_completes_outline_with_outward_normals() -> None:
    chart = paper_chart("A4", 4)
    corners = field_mm(chart)
    lens = Lens(np.array([[2.0, 0, 30], [0, 3.0, 40], [0, 0, 1]]), np.zeros(2), 1000.0, np.zeros(4))
    fraction = (np.arange(SIDE_POINTS) + 0.5)[:, None] / SIDE_POINTS
    sides = [start + fraction * (end - start) for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    # The second side (right) and half of the third (bottom) are missing.
    traced = np.concatenate([sides[0], sides[2][: SIDE_POINTS // 2], sides[3]])
    field = DetectedField(np.zeros((4, 2)), np.eye(3), traced, np.zeros_like(traced), np.zeros_like(traced), 1.0)
    completed = registering._add_missing_outline(field, lens, chart)
    added, normals = completed.outline_mm[len(traced) :], completed.normals[len(traced) :]
    np.testing.assert_array_equal(completed.outline_mm[: len(traced)], traced)
    np.testing.assert_allclose(completed.outline_px[len(traced) :], lens.to_pixels(added))
    is_right = np.isclose(added[:, 0], corners[:, 0].max())
    np.testing.assert_allclose(normals[is_right], np.tile([1.0, 0], (is_right.sum(), 1)), atol=1e-9)
    np.testing.assert_allclose(normals[~is_right], np.tile([0, 1.0], ((~is_right).sum(), 1)), atol=1e-9)
    # except for points within two steps of the traced ones, at both ends
    assert is_right.sum() == pytest.approx(SIDE_POINTS, abs=4)
    assert (~is_right).sum() == pytest.approx(SIDE_POINTS // 2, abs=4)


# Charts without tags, registered by manual corners and patches, compared with the rendered positions.


SMALL = paper_chart("A6", 3)


@pytest.fixture(scope="module")
def plain() -> Lab:
    return hang_chart(SMALL, "Test", Room(waviness_mm=0.5))


@pytest.fixture(scope="module")
def white_without_tags(plain: Lab, tmp_path_factory: pytest.TempPathFactory) -> Mosaic:
    """Return a frame of the chart without tags under white."""
    return plain.mosaic(tmp_path_factory.mktemp("white_without_tags"))


@pytest.fixture(scope="module")
def registered_without_tags(plain: Lab, white_without_tags: Mosaic) -> Registration:
    return register(white_without_tags, plain.chart, corners=plain.corners_px(white_without_tags))


@pytest.mark.slow
def test_registers_blue_without_tags(plain: Lab, tmp_path: Path) -> None:
    error = plain.miss_px(plain.mosaic(tmp_path, Colour(0, 0, 255)))
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert error.max() < 0.4


@pytest.mark.slow
def test_measures_lateral_colour_without_tags(tmp_path: Path) -> None:
    """The outline is clear in all channels, at different positions."""
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
def test_reports_uncertainty_of_unfollowed_waves(tmp_path: Path) -> None:
    """With waves shorter than the knot distance, patches are off by up to 1 px, and the outline shows it.

    So many patches are uncertain that the LUT is refused, because nothing shows which inner patches are off.
    """
    lab = hang_chart(SMALL, "Test", replace(WAVES, seed=2))
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, SMALL, corners=lab.corners_px(mosaic))
    error = np.linalg.norm(registration.to_pixels(SMALL.centres_mm) - lab.truth_px(SMALL.centres_mm, mosaic), axis=1)
    assert error.max() > 0.5, "this room needs errors above 0.5 px"
    is_uncertain = registration.expanded_px(SMALL.centres_mm) > MAX_PLACE_ERROR_PX
    assert is_uncertain[error > 0.5].all()
    assert is_uncertain.mean() > (UNFIT_SHARE.refuse or 1)


@pytest.mark.slow
def test_separates_curl_from_distortion(tmp_path: Path) -> None:
    """With the outline alone, patches were off by 0.2 px RMS and 0.7 px at most, without a warning."""
    room = Room(seed=2, curl_mm=60.0, focal_diagonals=0.8, lateral_red_px=1.0, lateral_blue_px=-1.0)
    lab = hang_chart(SMALL, "Test", room)
    mosaic = lab.mosaic(tmp_path)
    registration = register(mosaic, SMALL, corners=lab.corners_px(mosaic))
    error = np.linalg.norm(registration.to_pixels(SMALL.centres_mm) - lab.truth_px(SMALL.centres_mm, mosaic), axis=1)
    assert np.sqrt((error**2).mean()) < 0.12
    assert error.max() < 0.3
    assert not (registration.expanded_px(SMALL.centres_mm) > MAX_PLACE_ERROR_PX).any()


@pytest.mark.slow
def test_flat_sheet_has_no_uncertain_patch(
    plain: Lab, white_without_tags: Mosaic, registered_without_tags: Registration
) -> None:
    assert not (registered_without_tags.expanded_px(SMALL.centres_mm) > MAX_PLACE_ERROR_PX).any()
    error = np.linalg.norm(
        registered_without_tags.to_pixels(SMALL.centres_mm) - plain.truth_px(SMALL.centres_mm, white_without_tags),
        axis=1,
    )
    assert (error < 3 * registered_without_tags.uncertainty_px(SMALL.centres_mm)).all()


@pytest.mark.slow
def test_registers_large_grid_with_waves_of_six_millimetres(tmp_path: Path) -> None:
    """`benchmarks.plain` has the full grid of the paper."""
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
def test_refuses_another_order_of_colours_without_tags(plain: Lab, white_without_tags: Mosaic) -> None:
    shuffled = replace(plain.chart, colours=np.random.default_rng(1).permutation(plain.chart.colours))
    with pytest.raises(RegistrationError, match=r"chart\.json"):
        register(white_without_tags, shuffled, corners=plain.corners_px(white_without_tags))


@pytest.mark.slow
def test_refuses_field_displaced_by_one_patch(plain: Lab, white_without_tags: Mosaic) -> None:
    """The outline fits and all blocks look smooth: only the colour levels show the displacement.

    A displacement along y is only detected on large charts: with two rows of blocks it resembles an ink that varies
    with blue.
    """
    columns = len(np.unique(plain.chart.centres_mm[:, 0].round(3)))
    grid = plain.chart.colours.reshape(-1, columns)
    displaced = replace(plain.chart, colours=np.roll(grid, 1, axis=1).reshape(-1))
    with pytest.raises(RegistrationError):
        register(white_without_tags, displaced, corners=plain.corners_px(white_without_tags))


@pytest.mark.slow
def test_reports_cover_without_tags(plain: Lab, tmp_path: Path) -> None:
    top, left, height, width = plain.world.body.visible
    rows, columns = slice(top + height // 2, top + height // 2 + 80), slice(left + width // 3, left + width // 3 + 80)

    def cover(counts: npt.NDArray[np.uint16]) -> None:
        counts[rows, columns] = 7000

    mosaic = plain.mosaic(tmp_path, paint=cover)
    registration = register(mosaic, plain.chart, corners=plain.corners_px(mosaic))
    truth = plain.truth_px(plain.chart.centres_mm, mosaic)
    middle = np.array([width / 6 + 20, height / 4 + 20])
    is_covered = (np.abs(truth - middle) < 14).all(axis=1)
    is_uncovered = (np.abs(truth - middle) > 35).any(axis=1)
    assert is_covered.sum() >= 4
    assert registration.mismatched_cells[is_covered].all()
    assert not registration.mismatched_cells[is_uncovered].any()
    error = np.linalg.norm(registration.to_pixels(plain.chart.centres_mm) - truth, axis=1)
    assert error[is_uncovered].max() < 0.6


@pytest.mark.slow
def test_refuses_out_of_focus_frame(tmp_path: Path) -> None:
    lab = hang_chart(SMALL, "Test", Room(waviness_mm=0.5, blur_px=1.6))
    mosaic = lab.mosaic(tmp_path)
    with pytest.raises(RegistrationError):
        register(mosaic, lab.chart, corners=lab.corners_px(mosaic))
