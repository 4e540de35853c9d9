"""Blocks of cells are found where they are, and a block that disagrees with its neighbours does not count."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.registration.tiles import FoundBlocks, Raster, find_blocks


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
