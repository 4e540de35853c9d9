"""Blocks are found where they are, and tiles say how the map must move, on pictures moved by known amounts."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from calibration.registration.tiles import (
    MIN_SCORE,
    FoundBlocks,
    Raster,
    _peak,
    compare_tiles,
    find_blocks,
    jacobians,
    tiles,
    to_pixel_units,
)
from experiment.chart.model import TAG_MODULES, Tag

_Float = npt.NDArray[np.float32]

RASTER = Raster.of(np.zeros(2), np.ones(2), np.array([240, 160]))
"""One element is a millimetre and, by the map of these tests, a pixel."""

TILE = 10


def to_pixels(points_mm: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return points_mm


def texture() -> _Float:
    random = np.random.default_rng(1)
    cells = random.uniform(500, 8000, (16, 24, 3)).repeat(10, axis=0).repeat(10, axis=1)
    return ndimage.gaussian_filter(cells, (1.2, 1.2, 0)).astype(np.float32)


def moved(image: _Float, dx: float, dy: float) -> _Float:
    return np.asarray(ndimage.shift(image, (dy, dx, 0), order=3, mode="nearest"), dtype=np.float32)


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.6, 300.0)])
def test_a_small_movement_is_measured_whatever_gain_and_offset(gain: float, offset: float) -> None:
    image = texture()
    seen = gain * moved(image, 0.3, -0.2) + np.float32(offset)
    weight = np.ones(RASTER.shape, dtype=np.float32)
    found = compare_tiles(RASTER, TILE, image, seen, weight, 8 * TILE, to_pixels, float(TILE))
    assert (found.score > 0.9).all()
    total = np.asarray(np.linalg.solve(found.information.sum(axis=0), found.pull.sum(axis=0)), dtype=np.float64)
    assert total == pytest.approx([0.3, -0.2], abs=0.02)
    left = found.after(np.broadcast_to(total, found.pull.shape))
    assert left.pull.sum(axis=0) == pytest.approx(0, abs=1e-6 * np.abs(found.pull).sum())


def test_another_picture_moves_nothing() -> None:
    image = texture()
    weight = np.ones(RASTER.shape, dtype=np.float32)
    found = compare_tiles(
        RASTER, TILE, image, np.ascontiguousarray(image[::-1, ::-1]), weight, 8 * TILE, to_pixels, float(TILE)
    )
    assert (found.score < MIN_SCORE).all()
    assert not found.information.any()
    assert not found.pull.any()


def test_what_cannot_be_compared_scores_nothing() -> None:
    image = texture()
    weight = np.zeros(RASTER.shape, dtype=np.float32)
    weight[:, :80] = 1
    found = compare_tiles(RASTER, TILE, image, image, weight, 4 * TILE, to_pixels, float(TILE))
    score = found.score.reshape(RASTER.tiles(TILE))
    assert (score[:, :7] > 0.9).all()
    assert not score[:, 11:].any()
    assert found.weakened(4).information == pytest.approx(found.information / 4)


def test_blocks_are_found_where_they_are() -> None:
    random = np.random.default_rng(2)
    raster = Raster.of(np.zeros(2), np.array([2.0, 1.5]), np.array([200, 150]))
    expected = random.uniform(100, 9000, (30, 40, 3)).repeat(5, axis=0).repeat(5, axis=1).astype(np.float32)
    seen = np.roll(expected, (3, -4), axis=(0, 1))
    there = np.ones(raster.shape, dtype=np.bool_)
    there[:, 150:] = False
    found = find_blocks(raster, expected, seen, there, 40, 8, 64)
    assert 4 <= len(found.score) < 20
    assert (found.score > 0.99).all()
    assert found.moves_mm == pytest.approx(np.broadcast_to([-4 * 2.0, 3 * 1.5], found.moves_mm.shape), abs=0.1)
    assert (found.centres_mm[:, 0] < 300).all()


def test_a_block_that_moves_otherwise_than_its_neighbours_does_not_count() -> None:
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    centres = 50 * np.stack([x.ravel(), y.ravel()], axis=-1)
    score = np.full(20, 0.9)
    score[3] = 0.2
    moves = np.broadcast_to([2.0, 1.0], (20, 2)).copy()
    moves[7] += [10.0, 0.0]
    found = FoundBlocks(centres, moves, score)
    counted = found.information(moves, np.array([50.0, 50.0]), 10.0)[:, 0, 0] > 0
    assert np.flatnonzero(~counted).tolist() == [3, 7]


def test_patches_cover_elements_by_their_shares_up_to_the_border() -> None:
    """A patch of 2.5 × 2 elements whose left half element lies in the first column, and one that is cut off."""
    raster = Raster.of(np.zeros(2), np.ones(2), np.array([12, 6]))
    cover = raster.coverage(np.array([[1.75, 2.0], [11.5, 6.0]]), np.array([[2.5, 2.0], [2.0, 2.0]])).toarray()
    first, second = cover[:, 0].reshape(6, 12), cover[:, 1].reshape(6, 12)
    expected = np.zeros((6, 12))
    expected[1:3, :3] = [0.5, 1, 1]
    np.testing.assert_allclose(first, expected)
    assert np.argwhere(second).tolist() == [[5, 10], [5, 11]]
    assert second[5].tolist()[10:] == [0.5, 1]
    # A fifth of a cell of ten elements about both, at least one.
    for per_cell, reach in ((10, 2), (2, 1)):
        near = raster.near(raster.coverage(np.array([[6.5, 3.5]]), np.array([[1.0, 1.0]])), per_cell)
        assert np.argwhere(near).tolist() == [
            [y, x] for y in range(max(0, 3 - reach), min(6, 4 + reach)) for x in range(6 - reach, 7 + reach)
        ]


def test_rasters_say_where_their_elements_and_tiles_lie() -> None:
    raster = Raster.of(np.array([10.0, 20.0]), np.array([0.5, 0.25]), np.array([46, 35]))
    assert raster.shape == (35, 46)
    assert raster.tiles(8) == (4, 5)
    middles = raster.points_of_tiles(8).reshape(4, 5, 2)
    assert middles[0, 0] == pytest.approx([12, 21])
    assert middles[3, 4] == pytest.approx([10 + 36 * 0.5, 20 + 28 * 0.25])
    assert raster.point(3, 4) == pytest.approx([11.5, 21])
    # What is linear over the print comes back exactly between nodes, up to the last element.
    y, x = np.mgrid[:35, :46]
    mm = np.stack([10 + (x + 0.5) * 0.5, 20 + (y + 0.5) * 0.25], axis=-1)

    def linear(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.stack([2 * points[:, 0] - 3 * points[:, 1], points[:, 0] + points[:, 1] + 7], axis=1)

    expected = linear(mm.reshape(-1, 2)).reshape(35, 46, 2)
    np.testing.assert_allclose(raster.element_places(linear), expected, atol=1e-4)
    # What is interpolated in steps of a 32nd is exact where elements are such steps.
    raster = Raster.of(raster.low_mm, raster.step_mm, np.array([33, 17]))
    np.testing.assert_allclose(raster.smooth(linear), expected[:17, :33], atol=1e-4)


def test_elements_of_tags_and_their_white_rims_are_left_out() -> None:
    raster = Raster.of(np.array([100.0, 0.0]), np.array([1.0, 2.0]), np.array([40, 20]))
    # A rim is one and a half modules: of 16 mm with eight modules 3 mm.
    side = 2.0 * TAG_MODULES
    corners = np.array([(0, 0), (side, 0), (side, side), (0, side)])
    inside, outside = np.array([110, 10]), np.array([96 - side, 10])
    free = raster.outside_tags((Tag("", 1, corners + inside), Tag("", 2, corners + outside)))
    expected = np.ones((20, 40), np.bool_)
    expected[3 : int(np.ceil((13 + side) / 2)), 7 : int(13 + side)] = False
    assert np.array_equal(free, expected)


def test_blocks_are_spread_evenly_within_a_margin() -> None:
    found = [(rows.start, columns.start) for rows, columns in tiles((50, 83), 20, 4)]
    assert found == [(row, column) for row in (4, 26) for column in (4, 22, 40, 59)]
    assert list(tiles((27, 28), 20, 4)) == []
    assert list(tiles((28, 28), 20, 4)) == [(slice(4, 24), slice(4, 24))]


def test_slopes_in_elements_become_information_in_pixels() -> None:
    turn = np.array([[3.0, -1.0], [0.5, 2.0]])
    found = jacobians(lambda points: points @ turn.T, np.zeros((2, 2)), np.array([0.5, 0.25]))
    np.testing.assert_allclose(found, [turn * [0.5, 0.25]] * 2)
    random = np.random.default_rng(4)
    slopes, error = random.normal(size=(50, 2)), random.normal(size=50)
    x, y = slopes.T
    sums = np.array([[x @ x, x @ y, y @ y, x @ error, y @ error]])
    information, pull = to_pixel_units(sums, found[:1])
    # Of a movement in pixels the error changes by less by as much as an element is pixels long.
    per_px = slopes @ np.asarray(np.linalg.inv(found[0]), dtype=np.float64)
    np.testing.assert_allclose(information[0], per_px.T @ per_px)
    np.testing.assert_allclose(pull[0], -per_px.T @ error)


def test_a_peak_is_a_parabola_s_and_at_the_rim_an_element_s() -> None:
    y, x = np.mgrid[:7, :9]
    height, place = _peak(5 - 0.5 * (x - 4.3) ** 2 - 0.25 * (y - 2.8) ** 2)
    assert place == pytest.approx([4.3, 2.8])
    assert height == pytest.approx(5 - 0.5 * 0.3**2 - 0.25 * 0.2**2)
    assert _peak(np.asarray(-((x - 0.2) ** 2) - (y - 5.9) ** 2))[1] == pytest.approx([0, 6])
    # A ridge has no peak along it.
    assert _peak(np.asarray(-((x - 4.3) ** 2)))[1] == pytest.approx([4.3, 0])


def test_a_block_s_place_is_known_as_well_as_it_scores_and_to_two_hundredths_of_a_cell() -> None:
    random = np.random.default_rng(2)
    raster, there = Raster.of(np.zeros(2), np.ones(2), np.array([90, 90])), np.ones((90, 90), np.bool_)
    expected = random.uniform(100, 9000, (18, 18, 3)).repeat(5, axis=0).repeat(5, axis=1).astype(np.float32)
    for cells, least in ((63, 0.5), (64, 0.3)):
        found = find_blocks(raster, expected, expected, there, 40, 4, cells)
        assert found.least_score == least
    score = np.array([0.3, 0.31, 0.8])
    spread = FoundBlocks(np.array([[0.0, 0], [500, 0], [0, 500]]), np.zeros((3, 2)), score)
    information = spread.information(np.array([[0.0, 0], [40, 0], [0, -40]]), np.array([50.0, 50]), 10.0)
    # Blocks without neighbours are believed; the standard error of one that scores 1 is 0.2 px of 10.
    np.testing.assert_allclose(information, [share * np.eye(2) / 0.2**2 for share in (0, 0.31**2, 0.8**2)])


@pytest.mark.slow
def test_a_tile_counts_once_however_fine_its_elements() -> None:
    image = texture()
    seen, weight = moved(image, 0.2, 0.1), np.ones(RASTER.shape, dtype=np.float32)
    once, twice = (
        compare_tiles(RASTER, TILE, image, seen, weight, 8 * TILE, to_pixels, cell_px) for cell_px in (TILE, TILE / 2)
    )
    np.testing.assert_allclose(once.information, 4 * twice.information)
    np.testing.assert_allclose(once.pull, 4 * twice.pull)
    coarse = compare_tiles(RASTER, TILE, image, seen, weight, 8 * TILE, to_pixels, 3.0 * TILE)
    np.testing.assert_allclose(coarse.information, once.information)
    np.testing.assert_allclose(once.of_channels[0].sum(axis=0), once.information)
