"""Lights in their plane, and how far two sets of them are apart."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.describing.description import energy_distance, light_distribution
from generator.statistics.image_numbers import log_chroma


def lights_at(points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return lights whose ln(R/G) and ln(B/G) are given."""
    return np.exp(np.stack([points[:, 0], np.zeros(len(points)), points[:, 1]], axis=1)) * 5


def test_a_rectangle() -> None:
    corners = np.array([[0, 0], [3, 0], [3, 1], [0, 1.0]]) @ np.array([[0.6, -0.8], [0.8, 0.6]])
    found = light_distribution(lights_at(corners))
    np.testing.assert_allclose(log_chroma(lights_at(corners)), corners, atol=1e-12)
    assert found.hull_area == pytest.approx(3)
    assert (found.along, found.across) == pytest.approx((1.5, 0.5))
    assert found.axis_deg == pytest.approx(np.degrees(np.arctan2(-0.8, 0.6)))
    assert found.mean == pytest.approx(tuple(corners.mean(axis=0)))
    np.testing.assert_allclose(found.covariance, np.cov(corners.T, bias=True)[[0, 0, 1], [0, 1, 1]])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_lights_on_a_line_have_no_area(count: int) -> None:
    found = light_distribution(lights_at(np.outer(np.arange(float(count)), np.array([0.1, -0.1]))))
    assert found.hull_area == 0
    assert found.across == pytest.approx(0, abs=1e-7)


def test_energy_distance_of_normals() -> None:
    random = np.random.default_rng(0)
    # For points a and b on a line, 2|a - b| against nothing within: the whole of it.
    assert energy_distance([[0.0]] * 4, [[2.0]] * 3)[0] == pytest.approx(1)
    # N(0, 1) and N(m, 1): E|X - Y| of normals with deviation √2; E|X - X'| = 2/√π.
    one, other = random.normal(0, 1, (900, 1)), random.normal(1, 1, (900, 1))
    apart = 2 / np.sqrt(np.pi) * np.exp(-1 / 4) + 0.5204999  # m erf(m / 2), m = 1
    share, p = energy_distance(one, other)
    assert share == pytest.approx(1 - 2 / np.sqrt(np.pi) / apart, rel=0.15)
    assert p == pytest.approx(1 / 200)


def test_false_alarms_of_the_permutation_test() -> None:
    random = np.random.default_rng(1)
    found = [energy_distance(*random.normal(0, 1, (2, 25, 2)))[1] for _ in range(150)]
    assert np.mean(np.array(found) <= 0.1) == pytest.approx(0.1, abs=0.075)
    assert 0.3 < np.mean(found) < 0.7


def test_many_lights_are_thinned() -> None:
    random = np.random.default_rng(2)
    share, p = energy_distance(random.normal(0, 1, (3000, 2)), random.normal(0, 1, (1500, 2)))
    assert share < 0.01
    assert p > 0.01
