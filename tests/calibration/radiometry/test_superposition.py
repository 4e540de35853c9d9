"""What red, green and blue alone say of a sensor's linearity, on patches whose light is known."""

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
PRIMARIES = np.array([[2600, 450, 60], [900, 6200, 900], [100, 800, 4600]], dtype=np.float64)
"""Paper by primary and channel, counts."""


def proportional(counts: _Array) -> _Array:
    return counts


def compressed(counts: _Array) -> _Array:
    return counts * (1 - 0.04 * counts / FULL)


def short_of_counts(counts: _Array) -> _Array:
    return counts - 12 * (1 - np.exp(-np.maximum(counts, 0) / 12))


def seen(
    sensor: Callable[[_Array], _Array],
    *,
    boost: float = 0.0,
    lamp: tuple[float, float, float] = (1.0, 1.0, 1.0),
    noise: float = 1.0,
    bits: int = 3,
) -> Superposition:
    """Return what the cells of a chart and 100 white references say of a sensor."""
    random = np.random.default_rng(5)
    side = 1 << bits
    codes = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * (255 // (side - 1))
    ink = np.concatenate([0.03 + 0.9 * (codes / 255) ** 2.2, np.full((100, 3), 0.95)])
    uneven = 1 + 0.1 * np.sin(np.arange(len(ink)))[:, None]
    alone = [uneven * (ink * primary) * factor for primary, factor in zip(PRIMARIES, lamp, strict=True)]
    white = uneven * (ink @ np.diag([1, 1, 1])) * PRIMARIES.sum(axis=0) * (1 + boost * np.array([1.0, 1.1, 0.9]))

    def taken(light: _Array) -> _Array:
        return sensor(light) + noise * np.sqrt((36 + light / 1.8) / 25) * random.standard_normal(light.shape)

    known = printed_predictors(codes, np.zeros(100, dtype=np.int64))
    usable = np.ones(len(ink), dtype=np.bool_)
    return superposition([taken(one) for one in alone], taken(white), FULL, usable, known, white=True)


LEVELS = np.array([0.01, 0.03, 0.1, 0.3, 0.6]) * FULL


def relative_to_largest(of: Superposition) -> tuple[_Array, _Array]:
    off, _ = of.relative(LEVELS)
    mean_square = of.errors(LEVELS, np.full(len(LEVELS), LEVELS[-1]))
    return off - off[-1], np.sqrt(mean_square - (off - off[-1]) ** 2)


@pytest.mark.parametrize("lamp", [(1.0, 1.0, 1.0), (0.997, 1.002, 1.0)])
def test_counts_that_are_proportional_deviate_by_no_more_than_is_said(lamp: tuple[float, float, float]) -> None:
    off, error = relative_to_largest(seen(proportional, lamp=lamp))
    assert np.all(np.abs(off) <= 3 * error + 1e-9)
    assert error[1:].max() < 0.005


@pytest.mark.slow
def test_a_full_chart_says_it_more_sharply() -> None:
    small, full = (relative_to_largest(seen(proportional, bits=bits))[1] for bits in (3, 5))
    assert np.all(full[:-1] < small[:-1])


@pytest.mark.slow
@pytest.mark.parametrize("lamp", [(1.0, 1.0, 1.0), (1.022, 1.017, 0.968)], ids=["steady", "wheel"])
@pytest.mark.parametrize("sensor", [compressed, short_of_counts])
def test_what_a_sensor_does_is_found(sensor: Callable[[_Array], _Array], lamp: tuple[float, float, float]) -> None:
    found = seen(sensor, lamp=lamp)
    true = sensor(LEVELS) / LEVELS
    expected = true / true[-1] - 1
    off, error = relative_to_largest(found)
    assert np.all(np.abs(off - expected) <= 3 * error + 0.3 * np.abs(expected) + 0.002)
    # What is not taken out counts in full: the stated error, expanded, covers it but for what the prior takes off.
    stated = np.sqrt(found.errors(LEVELS, np.full(len(LEVELS), LEVELS[-1])))
    assert np.all(2.5 * stated >= np.abs(expected))


def test_a_projector_that_brightens_white_is_no_bend() -> None:
    off, error = relative_to_largest(seen(proportional, boost=0.2))
    assert np.all(np.abs(off) <= 3 * error)


def test_too_few_patches_say_what_is_usual() -> None:
    patches = np.full((20, 3), 500.0)
    known = printed_predictors(np.zeros((20, 3)), np.zeros(0, dtype=np.int64))
    found = superposition([patches] * 3, patches, FULL, np.ones(20, dtype=np.bool_), known, white=True)
    assert not found.measured
    assert found.unmeasured is not None
    assert "20 patches" in found.unmeasured.why
    assert "more colours" in found.unmeasured.remedy
    assert not found.deviation.any()
    assert np.all(np.diag(found.covariance) > 0)


def test_a_factor_common_to_all_counts_is_no_error_of_a_direction() -> None:
    level = np.array(NODES) * FULL
    found = Superposition(FULL, 0.02 * level, np.zeros((len(NODES), len(NODES))), None)
    assert found.white_covariance(np.array([[500.0, 3000.0, 9000.0]])) == pytest.approx(0, abs=1e-12)


def bent(level: npt.ArrayLike) -> Superposition:
    """Return a sensor that lacks 1 % of the square of the share of saturation, known to some counts at each node."""
    nodes = np.array(NODES)
    root = np.random.default_rng(1).normal(0, 2, (len(NODES), len(NODES)))
    return Superposition(FULL, np.asarray(level) * -0.01 * nodes**2, root @ root.T, None)


def between(level: float) -> _Array:
    """Return the weights of the nodes at a level, linear between them and from 0 to the first."""
    hats = np.eye(len(NODES) + 1)[1:]
    values: list[list[float]] = hats.tolist()
    return np.array([float(np.interp(level / FULL, [0, *NODES], hat)) for hat in values])


def test_an_error_is_what_counts_lack_beside_those_of_a_reference() -> None:
    found = bent(FULL)
    for level, reference in ((0.37 * FULL, 0.81 * FULL), (0.3 * NODES[0] * FULL, 0.5 * FULL), (2 * FULL, 0.2 * FULL)):
        one, other = (between(at) / at for at in (level, reference))
        off, variance = found.beside(np.array([level]), np.array([reference]))
        assert off[0] == pytest.approx((one - other) @ found.deviation)
        assert variance[0] == pytest.approx((one - other) @ found.covariance @ (one - other))
        assert found.errors(np.array([level]), np.array([reference]))[0] == pytest.approx(off[0] ** 2 + variance[0])
    white = np.array([4000.0, 9000, 800])
    weights = np.array([between(level) / level for level in white])
    off = weights @ found.deviation - (weights @ found.deviation).mean()
    expected = weights @ found.covariance @ weights.T + np.outer(off, off)
    np.testing.assert_allclose(found.white_covariance(white[None])[0], expected)
    written = found.to_json()
    assert written["deviation"] == pytest.approx((-0.01 * np.array(NODES)).tolist(), rel=1e-3)
    levels = np.array(NODES) * FULL
    assert written["standard_error"] == pytest.approx((np.sqrt(np.diag(found.covariance)) / levels).tolist(), rel=1e-3)
    assert written["measured"]


def test_predictors_are_codes_of_cells_and_one_level_for_references_of_a_colour() -> None:
    rgb = np.random.default_rng(3).integers(0, 256, (80, 3))
    found = printed_predictors(rgb, np.array([1, 0, 1]))
    codes, references = found[:80], found[80:]
    assert found.shape == (83, 35 + 2)
    assert not codes[:, 35:].any()
    assert not references[:, :35].any()
    assert references[:, 35:].tolist() == [[0, 1], [1, 0], [0, 1]]
    # A polynomial of the fourth degree in the codes, and none of the fifth.
    for power, exact in (((1, 2, 1), True), ((0, 0, 4), True), ((0, 3, 2), False)):
        value = np.prod((rgb / 255) ** power, axis=1)
        fitted = np.asarray(codes @ np.linalg.lstsq(codes, value, rcond=None)[0], dtype=np.float64)
        assert np.allclose(fitted, value, atol=1e-9) == exact
