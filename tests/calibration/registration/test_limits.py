"""What registrations are refused for, at each limit and beyond it, and how well places are said to be known."""

from __future__ import annotations

import re
from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration import register as registering
from calibration.registration.geometry import Lens
from calibration.registration.matching import Blocks, PlaceErrors
from calibration.registration.register import MAX_PLACE_ERROR_PX, Registration
from calibration.registration.tiles import Raster
from experiment.chart.layout import design_chart, paper_chart
from experiment.framing.field import SIDE_POINTS, FoundField, field_mm
from foundation.errors import RegistrationError

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
    field = FoundField(np.zeros((4, 2)), np.eye(3), known, np.zeros_like(known), np.zeros_like(known), 1.0)
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
