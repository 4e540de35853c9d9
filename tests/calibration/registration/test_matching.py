"""How well places are known: what an outline tells of places beside it and inside."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.matching import (
    SYSTEMATIC_PX,
    Anchors,
    PlaceErrors,
    fit_blocks,
    place_errors,
    unfollowed_px,
)
from calibration.registration.tiles import MIN_SCORE, Raster, TileComparison
from experiment.chart.layout import paper_chart

WIDTH, HEIGHT, REACH = 200.0, 100.0, 20.0


def outline(step: float = 1.0) -> npt.NDArray[np.float64]:
    x, y = np.arange(0, WIDTH + step, step), np.arange(0, HEIGHT + step, step)
    sides = [(x, 0 * x), (x, 0 * x + HEIGHT), (0 * y, y), (0 * y + WIDTH, y)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def test_inside_it_is_what_the_outline_shows_and_more_beside_a_part_that_waves() -> None:
    marks = outline()
    residual = np.full_like(marks, 0.01 / np.sqrt(2))
    waves = (marks[:, 1] == 0) & (np.abs(marks[:, 0] - 100) < 20)
    residual[waves] = 0.3 / np.sqrt(2)
    inside, beside, elsewhere = unfollowed_px(np.array([(100, 50), (100, 5), (30, 95.0)]), marks, residual, 5.0, REACH)
    usual = np.sqrt((residual**2).sum(axis=1).mean())
    assert inside == elsewhere == pytest.approx(2 * usual)
    assert beside == pytest.approx(0.6)


def test_at_a_corner_that_was_not_found_it_is_how_far_the_sheet_is_off_a_plane() -> None:
    marks = outline()
    lost = (marks[:, 1] == 0) & (marks[:, 0] < 60)
    marks = marks[~lost]
    places = np.array([(5, 5), (30, 5), (55, 5), (30, 95), (150, 5), (100, 50.0)])
    found = unfollowed_px(places, marks, np.full_like(marks, 0.01), 0.8, REACH)
    assert found == pytest.approx([0.8, 0.8, 0.02 * np.sqrt(2), 0.02 * np.sqrt(2), *[0.02 * np.sqrt(2)] * 2])


CHART = paper_chart("A4", 4)
"""4096 cells without a gap: a tile each."""
RASTER = Raster(
    CHART.centres_mm.min(axis=0) - np.array(CHART.cell_mm) / 2,
    np.array(CHART.cell_mm),
    (len(np.unique(CHART.centres_mm[:, 1].round(3))), len(np.unique(CHART.centres_mm[:, 0].round(3)))),
)


def compared(residual: npt.NDArray[np.float64], strength: float, seed: int = 1) -> TileComparison:
    """Return what tiles measure of residuals (rows, columns, 2) px, each with as much information, never even."""
    rows, columns = RASTER.shape
    y, x = np.mgrid[:rows, :columns]
    points = RASTER.low_mm + (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * RASTER.step_mm
    root = np.random.default_rng(seed).standard_normal((len(points), 2, 2)) + 2 * np.eye(2)
    information = strength * root @ root.swapaxes(1, 2)
    pull = np.einsum("nij,nj->ni", information, residual.reshape(-1, 2))
    score = np.linspace(0.5, 1.0, len(points))
    return TileComparison.of(
        points, information[None] / 3 * np.ones((3, 1, 1, 1)), pull[None] / 3 * np.ones((3, 1, 1)), score
    )


def test_a_block_moves_by_what_its_tiles_measure_and_scores_what_they_do() -> None:
    rows, columns = RASTER.shape
    size = 8
    across, down = columns // size, rows // size
    block = (np.arange(rows) * down // rows)[:, None] * across + np.arange(columns) * across // columns
    planted = np.random.default_rng(2).standard_normal((across * down, 2))
    comparison = compared(planted[block], 1.0)
    found = fit_blocks(comparison, RASTER, 1, CHART, size, all_known=False)
    np.testing.assert_allclose(found.residual_px, planted)
    number = block.ravel()
    count = np.bincount(number)
    np.testing.assert_allclose(found.score, np.bincount(number, comparison.score) / count)
    for axis in (0, 1):
        expected = np.bincount(number, comparison.points_mm[:, axis]) / count
        np.testing.assert_allclose(found.centres_mm[:, axis], expected)
    np.testing.assert_array_equal(found.good, found.score >= MIN_SCORE)
    # Of blocks that show less than half a pixel nothing is said, unless it is asked for.
    weak = compared(planted[block], 1e-4)
    assert not fit_blocks(weak, RASTER, 1, CHART, size, all_known=False).score.any()
    assert not fit_blocks(weak, RASTER, 1, CHART, size, all_known=True).residual_px.any()
    np.testing.assert_allclose(fit_blocks(weak, RASTER, 1, CHART, size, all_known=True).score, found.score)


def test_errors_lie_between_the_middles_of_elements_and_beyond_them_as_at_the_rim() -> None:
    error = np.arange(12.0).reshape(3, 4)
    errors = PlaceErrors(Raster(np.array([10.0, 20.0]), np.array([2.0, 4.0]), (3, 4)), error)
    places = [(11, 22), (13, 22), (12, 22), (11, 26), (11, 24), (17, 30), (-50, -50), (99, 99)]
    np.testing.assert_allclose(errors.at(places), [0, 1, 0.5, 4, 2, 11, 0, 11])


class Followed:
    """A displacement whose fit leaves an error of its own, wherever one asks."""

    def __init__(self, error_px: float) -> None:
        self.error_px = error_px
        self.asked: list[npt.NDArray[np.float64]] = []

    def errors_px(
        self, points: npt.NDArray[np.float64], information: npt.NDArray[np.float64], at: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        self.asked = [points, information]
        return np.full(len(at), self.error_px)


def test_the_error_of_a_place_is_the_fit_s_the_systematic_one_and_what_cells_still_ask_for() -> None:
    rows, columns = RASTER.shape
    none = np.zeros((rows, columns, 2))
    anchors = np.array([[1.0, 2.0]]), np.eye(2)[None]
    followed = Followed(0.03)
    still = place_errors(compared(none, 100.0), RASTER, 1, followed, anchors)  # pyrefly: ignore[bad-argument-type]
    np.testing.assert_allclose(still.error_px, np.hypot(0.03, SYSTEMATIC_PX))
    assert [len(given) for given in followed.asked] == [rows * columns + 1] * 2
    np.testing.assert_array_equal(followed.asked[0][-1], [1, 2])
    # A part that moved by a third of a pixel and is not followed shows, there and beside it, and nowhere else.
    moved = none.copy()
    moved[5:15, 20:30] = [0.3, -0.4]
    asks = place_errors(compared(moved, 1e4), RASTER, 1, followed, anchors)  # pyrefly: ignore[bad-argument-type]
    assert asks.error_px[10, 25] == pytest.approx(0.5, abs=0.02)
    assert asks.error_px[10, 25 + 12] == pytest.approx(still.error_px[0, 0], abs=0.01)
    # Measurements that scatter more than they say weigh less.
    noisy = compared(np.random.default_rng(3).normal(0, 0.5, (rows, columns, 2)), 100.0)
    place_errors(noisy, RASTER, 1, followed, anchors)  # pyrefly: ignore[bad-argument-type]
    weight = followed.asked[1][:-1] / noisy.information
    assert float(np.median(weight)) < 0.1
    assert float(np.ptp(weight)) < 1e-9


@pytest.mark.parametrize("strength", [1e3, 3e4])
def test_where_nothing_was_compared_nothing_is_asked_for(strength: float) -> None:
    """What sums over a grid round by is no displacement, though it is divided by no information."""
    rows, columns = RASTER.shape
    moved = np.random.default_rng(6).normal(0, 0.1, (rows, columns, 2))
    moved[10:30, 10:30] = 0
    tiles = compared(moved, strength)
    seen = np.ones((rows, columns))
    seen[8:32, 8:32] = 0
    bare = TileComparison.of(
        tiles.points_mm,
        tiles.information * seen.ravel()[:, None, None] / 3 * np.ones((3, 1, 1, 1)),
        tiles.pull * seen.ravel()[:, None] / 3 * np.ones((3, 1, 1)),
        tiles.score,
    )
    found = place_errors(bare, RASTER, 1, Followed(0.03), (np.zeros((0, 2)), np.zeros((0, 2, 2))))  # pyrefly: ignore[bad-argument-type]
    np.testing.assert_allclose(found.error_px[11:29, 11:29], np.hypot(0.03, SYSTEMATIC_PX))


def test_anchors_pull_by_their_information_and_colours_that_were_not_measured_do_not() -> None:
    random = np.random.default_rng(4)
    root = random.standard_normal((3, 5, 2, 2))
    information = root @ root.swapaxes(2, 3)
    information[1] = 0
    places = random.standard_normal((3, 5, 2))
    anchors = Anchors(random.standard_normal((5, 2)), places, information)
    off = random.standard_normal((5, 2))
    np.testing.assert_allclose(anchors.residual_px(places - off), off)
    np.testing.assert_allclose(anchors.pull(places - off), np.einsum("cnij,nj->cni", information, off))
    np.testing.assert_allclose(anchors.known_to(2).information, information / 4)
    chosen = np.array([True, False, True, False, False])
    np.testing.assert_array_equal(anchors.of(chosen).places_px, places[:, [0, 2]])
