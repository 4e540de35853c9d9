"""Comparison of images that were moved by known amounts, by blocks and by tiles."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from calibration.registration.tiles import (
    MIN_SCORE,
    LocatedBlocks,
    Raster,
    compare_tiles,
    find_blocks,
)

_Float = npt.NDArray[np.float32]

# one element is 1 mm and, with `to_pixels`, 1 px
RASTER = Raster.of(np.zeros(2), np.ones(2), np.array([240, 160]))

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
def test_measures_small_movement_with_any_gain_and_offset(gain: float, offset: float) -> None:
    image = texture()
    measured = gain * moved(image, 0.3, -0.2) + np.float32(offset)
    weight = np.ones(RASTER.shape, dtype=np.float32)
    result = compare_tiles(RASTER, TILE, image, measured, weight, 8 * TILE, to_pixels, float(TILE))
    assert (result.score > 0.9).all()
    total = np.asarray(np.linalg.solve(result.information.sum(axis=0), result.pull.sum(axis=0)), dtype=np.float64)
    assert total == pytest.approx([0.3, -0.2], abs=0.02)
    remainder = result.after(np.broadcast_to(total, result.pull.shape))
    assert remainder.pull.sum(axis=0) == pytest.approx(0, abs=1e-6 * np.abs(result.pull).sum())


def test_ignores_another_image() -> None:
    image = texture()
    weight = np.ones(RASTER.shape, dtype=np.float32)
    comparison = compare_tiles(
        RASTER, TILE, image, np.ascontiguousarray(image[::-1, ::-1]), weight, 8 * TILE, to_pixels, float(TILE)
    )
    assert (comparison.score < MIN_SCORE).all()
    assert not comparison.information.any()
    assert not comparison.pull.any()


def test_locates_blocks() -> None:
    random = np.random.default_rng(2)
    raster = Raster.of(np.zeros(2), np.array([2.0, 1.5]), np.array([200, 150]))
    expected = random.uniform(100, 9000, (30, 40, 3)).repeat(5, axis=0).repeat(5, axis=1).astype(np.float32)
    measured = np.roll(expected, (3, -4), axis=(0, 1))
    is_inside = np.ones(raster.shape, dtype=np.bool_)
    is_inside[:, 150:] = False
    blocks = find_blocks(raster, expected, measured, is_inside, 40, 8, 64)
    assert 4 <= len(blocks.score) < 20
    assert (blocks.score > 0.99).all()
    assert blocks.moves_mm == pytest.approx(np.broadcast_to([-4 * 2.0, 3 * 1.5], blocks.moves_mm.shape), abs=0.1)
    assert (blocks.centres_mm[:, 0] < 300).all()


def test_ignores_block_that_disagrees_with_neighbours() -> None:
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    centres = 50 * np.stack([x.ravel(), y.ravel()], axis=-1)
    score = np.full(20, 0.9)
    score[3] = 0.2
    moves = np.broadcast_to([2.0, 1.0], (20, 2)).copy()
    moves[7] += [10.0, 0.0]
    blocks = LocatedBlocks(centres, moves, score)
    is_used = blocks.information(moves, np.array([50.0, 50.0]), 10.0)[:, 0, 0] > 0
    assert np.flatnonzero(~is_used).tolist() == [3, 7]


def test_coverage_is_fractional_up_to_border() -> None:
    """A patch of 2.5 × 2 elements with half an element in the first column, and a patch that is cut off."""
    raster = Raster.of(np.zeros(2), np.ones(2), np.array([12, 6]))
    cover = raster.coverage(np.array([[1.75, 2.0], [11.5, 6.0]]), np.array([[2.5, 2.0], [2.0, 2.0]])).toarray()
    first, second = cover[:, 0].reshape(6, 12), cover[:, 1].reshape(6, 12)
    expected = np.zeros((6, 12))
    expected[1:3, :3] = [0.5, 1, 1]
    np.testing.assert_allclose(first, expected)
    assert np.argwhere(second).tolist() == [[5, 10], [5, 11]]
    assert second[5].tolist()[10:] == [0.5, 1]
    # Margin of a fifth of a patch, at least one element.
    for cell_elements, reach in ((10, 2), (2, 1)):
        near = raster.near(raster.coverage(np.array([[6.5, 3.5]]), np.array([[1.0, 1.0]])), cell_elements)
        assert np.argwhere(near).tolist() == [
            [y, x] for y in range(max(0, 3 - reach), min(6, 4 + reach)) for x in range(6 - reach, 7 + reach)
        ]
