"""Tiles of a rectified frame, compared with the print, measure how far the map is off."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from calibration.registration.tiles import MIN_SCORE, Raster, compare_tiles

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
