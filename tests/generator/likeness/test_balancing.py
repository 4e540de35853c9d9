"""Entropy balancing, on made-up numbers whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from generator.likeness.real_data import balance, effective_size


def normal(count: int, mean: float, spread: float, seed: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.random.default_rng(seed).normal(mean, spread, count)


@pytest.mark.slow
def test_mean_and_spread_are_met_and_weights_are_a_ratio_of_densities() -> None:
    """Between normal distributions the density ratio is the exponential of a parabola, which has these two moments."""
    values = normal(20000, 0.0, 1.0, 1)
    wanted = np.array([0.3, 0.3**2 + 0.7**2])
    found = balance(np.stack([values, values**2], axis=1), wanted, np.inf)
    assert found.sum() == pytest.approx(1)
    assert found @ values == pytest.approx(0.3, abs=1e-4)
    assert found @ values**2 == pytest.approx(wanted[1], abs=1e-4)
    ratio = np.exp(-((values - 0.3) ** 2) / (2 * 0.7**2) + values**2 / 2) / 0.7
    near = np.abs(values) < 2
    # 20 000 values: the fitted parabola is that of the densities within some hundredths.
    assert found[near] * 20000 == pytest.approx(ratio[near], rel=0.1)


def test_few_real_images_move_weights_less_than_many() -> None:
    values = normal(2000, 0.0, 1.0, 2)[:, None]
    means = [float((found @ values)[0]) for found in (balance(values, np.array([0.5]), real) for real in (5, 50, 5000))]
    assert means == sorted(means)
    # Between normal distributions of spread 1 the multiplier is the shift: what is missing of .5 is a fifth of it.
    assert means[0] == pytest.approx(0.5 / 1.2, abs=0.04)
    assert means[2] == pytest.approx(0.5, abs=0.01)


def test_what_no_image_has_does_not_take_the_weights() -> None:
    """One moment is out of reach, the other is not: the floor holds, and the second is still met."""
    random = np.random.default_rng(3)
    moments = np.stack([(random.random(1000) < 0.01).astype(float), random.normal(0, 1, 1000)], axis=1)
    found = balance(moments, np.array([0.9, 0.4]), 1e4, least_effective=0.5)
    assert effective_size(found) >= 500
    assert found @ moments[:, 1] == pytest.approx(0.4, abs=0.03)
    assert found @ moments[:, 0] < 0.2


def test_equal_sets_leave_weights_equal() -> None:
    values = normal(500, 0.0, 1.0, 4)[:, None]
    found = balance(values, values.mean(axis=0), 400)
    assert found == pytest.approx(np.full(500, 1 / 500))
    assert effective_size(found) == pytest.approx(500)


def test_variants_of_an_image_count_as_one() -> None:
    """Of ten variants of each image one is wanted: a tenth of all, and yet every image is of the same use."""
    values = np.tile(np.arange(10.0) == 3, 200)[:, None].astype(float)
    together = balance(values, np.array([0.999]), np.inf, 0.5, variants=10)
    assert float(together @ values[:, 0]) == pytest.approx(0.999, abs=1e-3)
    alone = balance(values, np.array([0.999]), np.inf, 0.5)
    assert float(alone @ values[:, 0]) < 0.5


def test_effective_size_of_weights_that_are_not_normalised() -> None:
    assert effective_size(np.array([2.0, 2.0, 0.0, 0.0])) == 2
