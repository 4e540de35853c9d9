"""Compiled loops against plain NumPy and SciPy."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from scipy import integrate, ndimage, stats

from calibration.kernels import (
    ACROSS,
    PARTS,
    add_far,
    blur_rows,
    clipped_to_neighbours,
    light_around,
    moments,
    print_slots,
    weights_around,
    window_shares,
)

_Array = npt.NDArray[np.float64]


def test_clips_values_to_neighbours() -> None:
    random = np.random.default_rng(1)
    values = random.normal(size=400)
    values[random.random(400) < 0.55] = np.nan
    around = np.column_stack([np.arange(400), *(random.permutation(400) for _ in range(5))])
    expected = np.full(400, np.nan)
    counts = np.isfinite(values[around]).sum(axis=1)
    for place in np.flatnonzero(np.isfinite(values) & (counts >= 3)).tolist():
        neighbours_sorted = np.sort(values[around[place]][np.isfinite(values[around[place]])])
        expected[place] = np.clip(values[place], neighbours_sorted[1], neighbours_sorted[-2])
    assert {2, 3, 4} <= set(counts[np.isfinite(values)].tolist())
    result = np.empty(400)
    clipped_to_neighbours(values, around, result)
    np.testing.assert_array_equal(result, expected)


def test_moments_are_exact() -> None:
    values = np.random.default_rng(2).integers(65000, 65536, (40, 9, 3)).astype(np.uint16)
    means, variances = np.empty((40, 3)), np.empty((40, 3))
    moments(values, means, variances)
    np.testing.assert_allclose(means, values.mean(axis=1), rtol=1e-15)
    np.testing.assert_allclose(variances, values.astype(np.float64).var(axis=1, ddof=1), rtol=1e-9)


@pytest.mark.parametrize("count", [1, 7, 9])
def test_blurs_columns_with_repeated_border(count: int) -> None:
    random = np.random.default_rng(3)
    image, taps = random.random((23, 5)).astype(np.float32), random.random(count).astype(np.float32)
    result = np.empty_like(image)
    blur_rows(image, taps, result)
    expected = ndimage.correlate1d(image.astype(np.float64), taps.astype(np.float64), axis=0, mode="nearest")
    np.testing.assert_allclose(result, expected, rtol=1e-5)


def test_prints_slots_in_local_light() -> None:
    random = np.random.default_rng(4)
    shares, light, inks = random.random((40, 3)).astype(np.float32), random.random((40, 3)), random.random((3, 3))
    image = np.empty((40, 3), dtype=np.float32)
    print_slots(shares, light, inks, image)
    lit = np.stack([light * inks[0], light * inks[1], np.broadcast_to(inks[2], light.shape)], axis=1)
    np.testing.assert_allclose(image, np.einsum("nk,nkc->nc", shares, lit), rtol=1e-6)


def test_adds_far_light() -> None:
    random = np.random.default_rng(5)
    image, levels, added = random.random((6, 5, 3)).astype(np.float32), random.random((8, 3)), random.random((8, 3))
    row, column = random.integers(0, 6, 8), random.integers(0, 5, 8)
    share = np.array([0.1, 0.0, -0.2])
    expected = added + share * (image[row, column] - levels)
    add_far(image, row, column, share, levels, added)
    np.testing.assert_allclose(added, expected, rtol=1e-12)


def light_between(low: float, high: float, sigma: float, window: int, offset: float) -> float:
    """Return the fraction of a window's light from between two positions, summed over its pixels."""
    shares = [
        np.diff(stats.norm(offset + pixel, sigma).cdf([low, high]))[0]
        for pixel in range(-(window // 2), window // 2 + 1)
    ]
    return float(np.mean(shares))


@pytest.mark.slow
def test_window_shares_match_integrals() -> None:
    pitches, offsets = np.array([7.0, 11.0]), np.array([-0.6, 0.0, 0.4])
    result = np.empty((2, 3, ACROSS * PARTS))
    window_shares(3.0, pitches, offsets, 3, result)
    # Five slots about the middle one's, each of five parts; the outermost have what is beyond.
    edges = np.arange(1, 25) / 5 - 2.5
    for p, pitch in enumerate(pitches):
        for o, offset in enumerate(offsets):
            borders = [-math.inf, *(edges * pitch), math.inf]
            expected = [light_between(low, high, 3.0, 3, offset) for low, high in pairwise(borders)]
            np.testing.assert_allclose(result[p, o], expected, atol=1e-12)
    # Of a point on the edge between two pixels half lies in either.
    whole, _ = integrate.quad(stats.norm(0, 3.0).pdf, -0.7, 0.7)
    window_shares(3.0, np.array([7.0]), np.array([0.0]), 1, result[:1, :1])
    assert result[0, 0, 12] == pytest.approx(whole)


def test_light_around_matches_sum_of_parts() -> None:
    """Two patches in a print of three by two slots, surrounded by paper, ink and background."""
    random = np.random.default_rng(5)
    count, rows, columns = 2, 6, 7
    row, column = np.array([2, 3]), np.array([2, 3])
    parts = count + random.integers(0, 3, (rows * PARTS, columns * PARTS))
    slots = np.full((rows, columns), -1)
    for patch in range(count):
        slots[row[patch], column[patch]] = patch
    parts = parts.astype(np.int32)
    neighbours = np.array(
        [slots[r - 2 : r + 3, c - 2 : c + 3].ravel() for r, c in zip(row, column, strict=True)], dtype=np.int32
    )
    pitch, offset = np.array([[8.0, 9.0], [8.4, 9.8]]), random.uniform(-0.4, 0.4, (2, 3, 2))
    pitches, offsets, scales = np.array([8.0, 9.0, 10.0]), np.array([-0.5, 0.0, 0.5]), (2.0, 5.0)
    shares = np.empty((2, 3, 3, 25))
    for kernel, scale in enumerate(scales):
        window_shares(scale, pitches, offsets, 3, shares[kernel])
    amount = random.uniform(0.1, 0.5, (2, 3, 2))
    amount[0, 1, 0] = 0
    weights, others = np.empty((2, 25, 3), np.float32), np.empty((2, 3, 3), np.float32)
    grid = np.array([8.0, 1.0, -0.5, 0.5])
    weights_around(row, column, neighbours, parts, offset, pitch, shares, grid, amount, weights, others)

    def along(kernel: int, length: float, at: float) -> _Array:
        """Return the shares (25,), interpolated bilinearly between whole pitches and half offsets."""
        table = shares[kernel]
        whole, rest = divmod(float(np.clip(length - 8, 0, 1.999)), 1)
        left, part = divmod(float(np.clip(at + 0.5, 0, 0.999)) * 2, 1)
        near = table[int(whole) : int(whole) + 2, int(left) : int(left) + 2]
        return np.einsum("p,o,pok->k", [1 - rest, rest], [1 - part, part], near)

    expected_weights, expected_others = np.zeros((2, 25, 3)), np.zeros((2, 3, 3))
    for patch, channel, kernel in np.ndindex(2, 3, 2):
        x, y = (along(kernel, pitch[patch, axis], offset[patch, channel, axis]) for axis in (0, 1))
        both = amount[patch, channel, kernel] * np.outer(y, x)
        for slot in range(25):
            down, across = divmod(slot, 5)
            of_slot = both[down * 5 : down * 5 + 5, across * 5 : across * 5 + 5]
            if neighbours[patch, slot] >= 0:
                expected_weights[patch, slot, channel] += of_slot.sum()
                continue
            top, left = (int(row[patch]) + down - 2) * 5, (int(column[patch]) + across - 2) * 5
            kinds = parts[top : top + 5, left : left + 5] - count
            for kind in range(3):
                expected_others[patch, kind, channel] += of_slot[kinds == kind].sum()
    np.testing.assert_allclose(weights, expected_weights, atol=1e-6)
    np.testing.assert_allclose(others, expected_others, atol=1e-6)
    np.testing.assert_allclose(weights.sum(axis=1) + others.sum(axis=1), amount.sum(axis=2), rtol=1e-5)

    levels, light, inks = random.random((2, 3)), random.random((2, 3)), random.random((3, 3))
    result = np.empty((2, 3))
    light_around(neighbours, weights, others, levels, light, inks, result)
    for patch, channel in np.ndindex(2, 3):
        expected = sum(
            weights[patch, slot, channel] * levels[neighbours[patch, slot], channel]
            for slot in range(25)
            if neighbours[patch, slot] >= 0
        )
        # What lies behind the print has a light of its own.
        expected += others[patch, :2, channel] @ inks[:2, channel] * light[patch, channel]
        expected += others[patch, 2, channel] * inks[2, channel]
        assert result[patch, channel] == pytest.approx(expected, rel=1e-5)
