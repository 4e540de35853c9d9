"""Indices of gray pixels, compared with manual calculation and SciPy, and maps from clusters."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy import ndimage

from evaluation.methods.gray_pixels import (
    LocalGraynessIndex,
    angle_to_grey,
    gradient_length,
    grayness,
    index_map,
    least_indices,
)
from evaluation.methods.prepared import PreparedImage

INNER = np.s_[10:-10, 10:-10]


def test_gradient_of_ramp_matches_authors_kernel() -> None:
    y, x = np.mgrid[:20, :30].astype(np.float32)
    # Σ x² exp(-2 x²) / (0.25 π) along the ramp, Σ exp(-2 x²) across, for x from -2 to 2.
    expected = 2 * (np.exp(-2) + 4 * np.exp(-8)) * 4 / np.pi * (1 + 2 * np.exp(-2) + 2 * np.exp(-8))
    for ramp, factor in ((x, 1), (3 * x + 4 * y, 5)):
        np.testing.assert_allclose(gradient_length(ramp)[2:-2, 2:-2], factor * expected, rtol=1e-5)


def test_grayness_index_follows_equations_9_and_10() -> None:
    image = np.random.default_rng(0).uniform(0.1, 1, (40, 50, 3)).astype(np.float32)
    index_values, missing = grayness(image)
    mean = ndimage.uniform_filter(image.astype(np.float64), (7, 7, 1), mode="nearest")
    x = np.arange(-2, 3)
    bell = np.exp(-2.0 * x**2)

    def gradient(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        sides = [
            ndimage.correlate1d(ndimage.correlate1d(values, x * bell * 4 / np.pi, axis), bell, 1 - axis)
            for axis in (0, 1)
        ]
        return np.hypot(*sides)

    logs = np.log(mean / mean.sum(axis=2, keepdims=True))
    expected = np.hypot(gradient(logs[..., 0]), gradient(logs[..., 2]))
    np.testing.assert_allclose(index_values[INNER], expected[INNER], rtol=1e-3, atol=1e-6)
    assert not missing.any()
    # Flat pixels and pixels with a channel of zero have no index.
    image[:, :25] = 0.5
    image[:, 25:, 1] = 0
    assert grayness(image)[1][:, :20].all()
    assert grayness(image)[1][:, 30:].all()


@pytest.mark.parametrize(
    ("rates", "cosine"),
    [
        ((1, 1, 1), 1),
        ((1, 1, 1.001), 3.001 / (3 * 3.002001) ** 0.5),
        ((1, 0, 0), 3**-0.5),
        ((1, 1, 0), (2 / 3) ** 0.5),
        ((4, 2, 1), 7 / (3 * 21) ** 0.5),
    ],
)
def test_angle_to_grey_of_known_gradients(rates: tuple[float, ...], cosine: float) -> None:
    x = np.linspace(-1, 0, 30)[None, :, None]
    image = np.exp(x * rates).repeat(30, axis=0).astype(np.float32)
    index_values, missing = angle_to_grey(image)
    assert index_values[INNER].size
    np.testing.assert_allclose(index_values[INNER], np.arccos(cosine), atol=2e-5)
    assert not missing.any()
    for flat in (0.5, 0.1, 3 / 7, 1e-3):
        assert angle_to_grey(np.full((9, 9, 3), (flat, flat / 3, flat / 7), np.float32))[1].all()


def test_excludes_dark_and_masked_pixels() -> None:
    image = np.random.default_rng(1).uniform(0.5, 1, (40, 60, 3))
    image[:, :10] *= 4 / 255 / 3 / image[:, :10].max()
    image[:, 10:20] *= 8.5 / 255 / image[:, 10:20].sum(axis=2, keepdims=True)
    image[0, 59] = 1
    mask = np.zeros((40, 60), bool)
    mask[:, 40:50] = True
    _, usable = index_map(PreparedImage(image, None, mask), grayness)
    assert not usable[:, :10].any()
    assert usable[:, 10:20].mean() > 0.2  # some are flat
    assert usable[:, 20:40].all()
    assert not usable[:, 40:50].any()


def test_selects_pixels_with_smallest_index() -> None:
    index = np.random.default_rng(3).permutation(100).reshape(10, 10).astype(np.float32)
    selected = least_indices(index, index != 3, 0.05)
    assert sorted(index[selected].tolist()) == [0, 1, 2, 4, 5]
    assert least_indices(index, index != 3, 1.0).sum() == 99
    assert not least_indices(index, np.zeros((10, 10), bool), 0.05).any()


@pytest.mark.slow
def test_near_clusters_have_more_weight() -> None:
    random = np.random.default_rng(0)
    grey = random.uniform(200, 3000, (60, 160, 1)) * random.uniform(0.99, 1.01, (60, 160, 3))
    image = grey * np.where(np.arange(160)[None, :, None] < 80, [0.5, 0.3, 0.2], [0.2, 0.3, 0.5])
    mask = np.zeros((60, 160), bool)
    mask[:, 40:120] = True
    method = LocalGraynessIndex()
    selected = method.find_gray_pixels(PreparedImage(image, None, mask))
    rows, columns = np.ogrid[:60, :160]
    total, weights = np.zeros((60, 160, 3)), np.zeros((60, 160, 1))
    for side in (np.s_[:80], np.s_[80:]):
        cluster = np.zeros_like(selected)
        cluster[:, side] = selected[:, side]
        centre, colour = np.argwhere(cluster).mean(axis=0), image[cluster].sum(axis=0)
        distance = np.hypot(rows - centre[0], columns - centre[1]) / np.hypot(60, 160)
        weight = np.exp(-distance / (2 * 0.2**2))[..., None]
        total, weights = total + weight * colour / colour.sum(), weights + weight
    np.testing.assert_allclose(method.estimate_map(image, None, mask), total / weights, rtol=1e-4)
