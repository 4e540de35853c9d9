"""Patches that are not of one colour are found, and noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from calibration.sampling import has_dead_photosite, patch_means, sample_noise, unevenness


def patches(level: float, sigma: float, count: int = 3000) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.random.default_rng(2).normal(level, sigma, (count, 25, 3))


def test_noise_alone_is_even() -> None:
    samples = patches(800, 30)
    assert not unevenness(samples, np.full((len(samples), 3), 30.0)).any()


def test_a_rim_of_another_colour_is_found() -> None:
    samples = patches(8000, 60)
    rim = np.ones((5, 5), dtype=bool)
    rim[1:-1, 1:-1] = False
    samples[7, rim.ravel(), 1] += 400
    found = unevenness(samples, np.full((len(samples), 3), 60.0))
    assert np.flatnonzero(found).tolist() == [7]
    assert found[7] == pytest.approx(400 / (8000 + 400 * 16 / 25), rel=0.15)


def test_less_than_a_percent_is_let_be() -> None:
    samples = patches(8000, 1)
    rim = np.ones((5, 5), dtype=bool)
    rim[1:-1, 1:-1] = False
    samples[:, rim.ravel()] += 70
    assert not unevenness(samples, np.full((len(samples), 3), 1.0)).any()


@pytest.mark.parametrize("window", [3, 7, 9])
def test_a_rim_is_found_in_other_windows(window: int) -> None:
    """Noise of 0.4 %, a rim 8 % brighter: beyond 5 σ even of the single inner pixel of 3×3."""
    samples = np.random.default_rng(6).normal(8000, 30, (3000, window**2, 3))
    rim = np.ones((window, window), dtype=bool)
    rim[1:-1, 1:-1] = False
    samples[7, rim.ravel(), 1] += 640
    assert np.flatnonzero(unevenness(samples, sample_noise(samples))).tolist() == [7]


def test_noise_is_known_as_a_function_of_the_level() -> None:
    random = np.random.default_rng(5)
    level = random.uniform(50, 8000, 4000)
    sigma = np.sqrt(36 + level / 1.8)
    samples = level[:, None, None] + sigma[:, None, None] * random.standard_normal((4000, 25, 3))
    ratio = sample_noise(samples) / sigma[:, None]
    assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert np.abs(ratio[level > 500] - 1).max() < 0.15


def test_a_photosite_that_sees_a_third_is_dead() -> None:
    samples = patches(2000, 30, 50)
    samples[9, 4, 0] *= 0.3
    samples[11, 4, 2] *= 0.7
    assert np.flatnonzero(has_dead_photosite(samples)).tolist() == [9]
    assert not has_dead_photosite(samples / 10).any()


def test_patch_means_are_numpys() -> None:
    values = np.random.default_rng(4).integers(0, 65536, (50, 25, 3)).astype(np.uint16)
    np.testing.assert_allclose(patch_means(values), values.mean(axis=1), rtol=1e-14)
    np.testing.assert_allclose(patch_means(values[::3]), values[::3].mean(axis=1), rtol=1e-14)
