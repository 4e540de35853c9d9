"""Prediction of levels from codes: smooth colours, black ink, and noise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.spread.predicting import LevelModel, neighbour_residual

_Array = npt.NDArray[np.float64]

CODES = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
ALL = np.ones(len(CODES), dtype=np.bool_)


def printed_levels(bend: float) -> _Array:
    """Return levels of inks; `bend` is the amount of black that replaces the common part of three inks."""
    ink = 1 - CODES / 7
    root = 0.95 - ink @ [0.5, 0.12, 0.05] - bend * ink.min(axis=1)
    return root**2


def test_residuals_are_linear_and_zero_for_smooth_colours() -> None:
    smooth = (3 + CODES @ [1.0, 0.5, 0.25])[:, None] ** 2
    residual = neighbour_residual(smooth, 3)
    is_predicted = LevelModel.of(np.zeros(4096), np.ones(4096, dtype=np.bool_), 4).is_predicted
    inner = np.any((CODES > 0) & (CODES < 7), axis=1)
    assert residual[inner] == pytest.approx(0, abs=1e-9)
    assert is_predicted.sum() == 16**3 - 8
    random = np.random.default_rng(1).normal(size=(2, 512, 1))
    summed = neighbour_residual(random.sum(axis=0), 3)
    assert summed == pytest.approx(sum(neighbour_residual(values, 3) for values in random))


@pytest.mark.slow
def test_full_chart_uses_mean_of_neighbours() -> None:
    cube = np.random.default_rng(2).normal(size=(32, 32, 32, 2))
    total, axes = np.zeros_like(cube), np.zeros((32, 32, 32, 1))
    for axis in range(3):
        moved, counted = np.moveaxis(cube, axis, 0), np.moveaxis(axes, axis, 0)
        np.moveaxis(total, axis, 0)[1:-1] += moved[1:-1] - (moved[:-2] + moved[2:]) / 2
        counted[1:-1] += 1
    expected = total / np.maximum(axes, 1)
    np.testing.assert_allclose(neighbour_residual(cube.reshape(-1, 2), 5).reshape(cube.shape), expected, atol=1e-12)


@pytest.mark.parametrize("bend", [0.0, 0.2])
def test_three_bits_leave_only_noise_with_black_ink(bend: float) -> None:
    noise = 0.002
    measured = printed_levels(bend) + noise * np.random.default_rng(2).standard_normal(len(CODES))
    model = LevelModel.of(measured, ALL, 3)
    residual = model.residual_of(measured)
    assert residual.std() == pytest.approx(noise * np.sqrt(model.freedom), rel=0.15)
    assert model.freedom > 0.5
    if bend:
        assert neighbour_residual(measured[:, None], 3)[:, 0].std() > 1.5 * residual.std()


@pytest.mark.slow
def test_prediction_is_independent_of_residual_noise() -> None:
    level = printed_levels(0.1)
    products: list[float] = []
    for seed in range(8):
        measured = level + 0.002 * np.random.default_rng(seed).standard_normal(len(CODES))
        model = LevelModel.of(measured, ALL, 3)
        residual = model.residual_of(measured)
        products.append(float(residual @ (model.predicted - level)) / float(residual @ residual))
    assert abs(np.mean(products)) < 0.05


def test_added_light_remains_in_residual() -> None:
    noise, added = np.random.default_rng(3).standard_normal((2, len(CODES)))
    model = LevelModel.of(printed_levels(0.1) + 0.002 * noise, ALL, 3)
    residual = model.residual(added[:, None])[:, 0]
    assert float(residual @ added) > 0.5 * float(added @ added)


def test_unusable_patch_does_not_influence_others() -> None:
    clean, usable = printed_levels(0.1), ALL.copy()
    measured = clean.copy()
    measured[100] = 0.9
    usable[100] = False
    residual = LevelModel.of(measured, usable, 3).residual_of(measured)
    assert np.abs(np.delete(residual, 100)).max() < 1e-3
    assert residual[100] > 0.1


def test_small_chart_corrects_curvature() -> None:
    random = np.random.default_rng(4)
    cube = random.normal(size=(8, 8, 8))
    residuals = neighbour_residual(cube.reshape(-1, 1), 3).reshape(cube.shape)
    for code in ((0, 0, 0), (7, 0, 3), (3, 3, 3), (1, 6, 7), *random.integers(0, 8, (40, 3)).tolist()):
        expected: list[float] = []
        for axis in (axis for axis in range(3) if 0 < code[axis] < 7):
            previous, centre, following = (np.take(cube, code[axis] + step, axis) for step in (-1, 0, 1))
            # two codes on each side perpendicular to the axis; values at the faces of the cube are repeated
            bend = np.pad(centre - (previous + following) / 2, 2, mode="edge")
            row, column = np.delete(code, axis).tolist()
            square = bend[row : row + 5, column : column + 5]
            expected.append(square[2, 2] - (square.sum() - square[2, 2]) / 24)
        assert residuals[tuple(code)] == pytest.approx(np.mean(expected) if expected else 0)
