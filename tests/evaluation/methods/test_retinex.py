"""Methods of the Retinex family, compared with loops over pixels."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods import retinex
from evaluation.methods.retinex import ColorSparrow, ImprovedWhitePatch, SurfaceReflectance

pytestmark = pytest.mark.slow

RANDOM = np.random.default_rng(4)
IMAGE = RANDOM.gamma(2, 500, (33, 47, 3)) * [0.5, 1.0, 0.7] + 1
MASK = RANDOM.random((33, 47)) < 0.2
MASK[:9, :12] = True


def of_length_one(light: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return light / np.linalg.norm(light)


@pytest.mark.parametrize("patches", [1, 4, 40])
def test_surface_reflectance_matches_loop(patches: int) -> None:
    total, normalised = np.zeros(3), np.zeros(3)
    down, across = min(patches, 33), min(patches, 47)
    for row, column in np.ndindex(down, across):
        patch = (
            slice(row * 33 // down, (row + 1) * 33 // down),
            slice(column * 47 // across, (column + 1) * 47 // across),
        )
        pixels = IMAGE[patch][~MASK[patch]]
        if len(pixels):
            total += pixels.sum(axis=0)
            normalised += (pixels / pixels.max(axis=0)).sum(axis=0)
    estimate = SurfaceReflectance(patches=patches).estimate(IMAGE, mask=MASK)
    np.testing.assert_allclose(estimate, of_length_one(total / normalised), rtol=1e-6)


def test_white_patch_matches_expectation() -> None:
    pixels = np.sort(IMAGE[~MASK], axis=0)
    # A maximum of five is at most the k-th of N values with a probability of (k / N) ** 5.
    probabilities = np.diff((np.arange(len(pixels) + 1) / len(pixels)) ** 5)
    estimate = ImprovedWhitePatch(pixels=5, samples=20_000).estimate(IMAGE, mask=MASK)
    np.testing.assert_allclose(estimate, of_length_one(probabilities @ pixels), rtol=0.01)


def test_color_sparrow_matches_loop() -> None:
    step, count = 4, 6
    radius = math.hypot(33, 47)
    offsets = (retinex._draw_sprays(2, count) * radius).astype(int)
    spray_indices = np.random.default_rng((2, 1)).integers(0, retinex.SPRAY_COUNT, (9, 12))
    points, ratios = np.zeros((2, 9 + 2, 12 + 2, 3))
    is_used = np.zeros((9, 12), bool)
    for row, column in np.ndindex(9, 12):
        y, x = row * step, column * step
        around = [(y + down, x + across) for down, across in offsets[spray_indices[row, column]].tolist()]
        values = [IMAGE[patch] for patch in around if 0 <= patch[0] < 33 and 0 <= patch[1] < 47 and not MASK[patch]]
        if values and not MASK[y, x]:
            is_used[row, column] = True
            points[row + 1, column + 1] = IMAGE[y, x]
            ratios[row + 1, column + 1] = np.minimum(IMAGE[y, x] / np.max(values, axis=0), 1)
    lights = [
        points[row : row + 3, column : column + 3].sum(axis=(0, 1))
        / ratios[row : row + 3, column : column + 3].sum(axis=(0, 1))
        for row, column in np.argwhere(is_used)
    ]
    estimate = ColorSparrow(spray=count, step=step, kernel=3, seed=2).estimate(IMAGE, mask=MASK)
    assert 20 < len(lights) < 9 * 12
    np.testing.assert_allclose(estimate, of_length_one(np.mean(lights, axis=0)), rtol=1e-6)


def test_sprays_are_dense_in_the_middle() -> None:
    distances = np.linalg.norm(retinex._draw_sprays(0, 50), axis=2)
    # Uniform along the radius: half of the pixels are in a quarter of the area.
    np.testing.assert_allclose(np.percentile(distances, [25, 50, 75, 100]), [0.25, 0.5, 0.75, 1], atol=0.01)
