"""Linearity of a sensor from red, green and blue alone, on patches with known light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from calibration.radiometry.superposition import (
    NODES,
    Superposition,
    printed_predictors,
    superposition,
)

_Array = npt.NDArray[np.float64]

FULL = 12000.0
# counts of paper by primary and channel
PRIMARIES = np.array([[2600, 450, 60], [900, 6200, 900], [100, 800, 4600]], dtype=np.float64)


def proportional(counts: _Array) -> _Array:
    return counts


def compressed(counts: _Array) -> _Array:
    return counts * (1 - 0.04 * counts / FULL)


def short_of_counts(counts: _Array) -> _Array:
    return counts - 12 * (1 - np.exp(-np.maximum(counts, 0) / 12))


def measured(
    sensor: Callable[[_Array], _Array],
    *,
    boost: float = 0.0,
    lamp: tuple[float, float, float] = (1.0, 1.0, 1.0),
    noise: float = 1.0,
    bits: int = 3,
) -> Superposition:
    """Return the linearity from the patches of a chart and 100 white references."""
    random = np.random.default_rng(5)
    side = 1 << bits
    codes = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * (255 // (side - 1))
    ink = np.concatenate([0.03 + 0.9 * (codes / 255) ** 2.2, np.full((100, 3), 0.95)])
    uneven = 1 + 0.1 * np.sin(np.arange(len(ink)))[:, None]
    alone = [uneven * (ink * primary) * factor for primary, factor in zip(PRIMARIES, lamp, strict=True)]
    white = uneven * (ink @ np.diag([1, 1, 1])) * PRIMARIES.sum(axis=0) * (1 + boost * np.array([1.0, 1.1, 0.9]))

    def photographed(light: _Array) -> _Array:
        return sensor(light) + noise * np.sqrt((36 + light / 1.8) / 25) * random.standard_normal(light.shape)

    terms = printed_predictors(codes, np.zeros(100, dtype=np.int64))
    usable = np.ones(len(ink), dtype=np.bool_)
    return superposition([photographed(light) for light in alone], photographed(white), FULL, usable, terms, white=True)


LEVELS = np.array([0.01, 0.03, 0.1, 0.3, 0.6]) * FULL


def relative_to_largest(result: Superposition) -> tuple[_Array, _Array]:
    deviation, _ = result.relative(LEVELS)
    mean_square = result.errors(LEVELS, np.full(len(LEVELS), LEVELS[-1]))
    return deviation - deviation[-1], np.sqrt(mean_square - (deviation - deviation[-1]) ** 2)


@pytest.mark.parametrize("lamp", [(1.0, 1.0, 1.0), (0.997, 1.002, 1.0)])
def test_linear_sensor_is_within_uncertainty(lamp: tuple[float, float, float]) -> None:
    deviation, error = relative_to_largest(measured(proportional, lamp=lamp))
    assert np.all(np.abs(deviation) <= 3 * error + 1e-9)
    assert error[1:].max() < 0.005


@pytest.mark.slow
def test_full_chart_has_smaller_uncertainty() -> None:
    small, full = (relative_to_largest(measured(proportional, bits=bits))[1] for bits in (3, 5))
    assert np.all(full[:-1] < small[:-1])


@pytest.mark.slow
@pytest.mark.parametrize("lamp", [(1.0, 1.0, 1.0), (1.022, 1.017, 0.968)], ids=["steady", "wheel"])
@pytest.mark.parametrize("sensor", [compressed, short_of_counts])
def test_measures_nonlinear_sensor(sensor: Callable[[_Array], _Array], lamp: tuple[float, float, float]) -> None:
    result = measured(sensor, lamp=lamp)
    true = sensor(LEVELS) / LEVELS
    expected = true / true[-1] - 1
    deviation, error = relative_to_largest(result)
    assert np.all(np.abs(deviation - expected) <= 3 * error + 0.3 * np.abs(expected) + 0.002)
    # The deviation is not corrected: the expanded error covers it, except for the shrinkage by the prior.
    reported = np.sqrt(result.errors(LEVELS, np.full(len(LEVELS), LEVELS[-1])))
    assert np.all(2.5 * reported >= np.abs(expected))


def test_ignores_white_boost() -> None:
    deviation, error = relative_to_largest(measured(proportional, boost=0.2))
    assert np.all(np.abs(deviation) <= 3 * error)


def test_returns_usual_values_with_few_patches() -> None:
    patches = np.full((20, 3), 500.0)
    predictors = printed_predictors(np.zeros((20, 3)), np.zeros(0, dtype=np.int64))
    result = superposition([patches] * 3, patches, FULL, np.ones(20, dtype=np.bool_), predictors, white=True)
    assert not result.measured
    assert result.unmeasured is not None
    assert "20 usable patches" in result.unmeasured.why
    assert "more colours" in result.unmeasured.remedy
    assert not result.deviation.any()
    assert np.all(np.diag(result.covariance) > 0)


def test_common_factor_is_no_chromatic_error() -> None:
    level = np.array(NODES) * FULL
    sensor = Superposition(FULL, 0.02 * level, np.zeros((len(NODES), len(NODES))), None)
    assert sensor.white_covariance(np.array([[500.0, 3000.0, 9000.0]])) == pytest.approx(0, abs=1e-12)


def compressed_sensor(level: npt.ArrayLike) -> Superposition:
    """Return a sensor that lacks 1 % of the square of the level, with an uncertainty of some counts."""
    nodes = np.array(NODES)
    root = np.random.default_rng(1).normal(0, 2, (len(NODES), len(NODES)))
    return Superposition(FULL, np.asarray(level) * -0.01 * nodes**2, root @ root.T, None)


def node_weights(level: float) -> _Array:
    """Return the weights of linear interpolation between nodes, and from 0 to the first."""
    hats = np.eye(len(NODES) + 1)[1:]
    values: list[list[float]] = hats.tolist()
    return np.array([float(np.interp(level / FULL, [0, *NODES], hat)) for hat in values])


def test_errors_match_interpolated_nodes() -> None:
    sensor = compressed_sensor(FULL)
    for level, reference in ((0.37 * FULL, 0.81 * FULL), (0.3 * NODES[0] * FULL, 0.5 * FULL), (2 * FULL, 0.2 * FULL)):
        first, second = (node_weights(count) / count for count in (level, reference))
        bias, variance = sensor.difference(np.array([level]), np.array([reference]))
        assert bias[0] == pytest.approx((first - second) @ sensor.deviation)
        assert variance[0] == pytest.approx((first - second) @ sensor.covariance @ (first - second))
        assert sensor.errors(np.array([level]), np.array([reference]))[0] == pytest.approx(bias[0] ** 2 + variance[0])
    white = np.array([4000.0, 9000, 800])
    weights = np.array([node_weights(level) / level for level in white])
    bias = weights @ sensor.deviation - (weights @ sensor.deviation).mean()
    expected = weights @ sensor.covariance @ weights.T + np.outer(bias, bias)
    np.testing.assert_allclose(sensor.white_covariance(white[None])[0], expected)
    written = sensor.to_json()
    assert written["deviation"] == pytest.approx((-0.01 * np.array(NODES)).tolist(), rel=1e-3)
    levels = np.array(NODES) * FULL
    assert written["standard_error"] == pytest.approx((np.sqrt(np.diag(sensor.covariance)) / levels).tolist(), rel=1e-3)
    assert written["measured"]


def test_predictors_are_polynomials_and_reference_levels() -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (80, 3))
    predictors = printed_predictors(rgb, np.array([1, 0, 1]))
    codes, references = predictors[:80], predictors[80:]
    assert predictors.shape == (83, 35 + 2)
    assert not codes[:, 35:].any()
    assert not references[:, :35].any()
    assert references[:, 35:].tolist() == [[0, 1], [1, 0], [0, 1]]
    # polynomials of degree 4 in the codes, not 5
    for power, exact in (((1, 2, 1), True), ((0, 0, 4), True), ((0, 3, 2), False)):
        value = np.prod((rgb / 255) ** power, axis=1)
        fitted = np.asarray(codes @ np.linalg.lstsq(codes, value, rcond=None)[0], dtype=np.float64)
        assert np.allclose(fitted, value, atol=1e-9) == exact
