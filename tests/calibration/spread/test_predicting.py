"""What codes say of levels: smooth colours leave nothing, printers' black does no harm, and noise stays noise."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.spread.predicting import LevelModel, neighbour_residual

_Array = npt.NDArray[np.float64]

CODES = np.stack(np.meshgrid(*[np.arange(8.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
ALL = np.ones(len(CODES), dtype=np.bool_)


def printed(bend: float) -> _Array:
    """Return levels of inks; `bend` is how much black stands in place of what they have in common."""
    ink = 1 - CODES / 7
    root = 0.95 - ink @ [0.5, 0.12, 0.05] - bend * ink.min(axis=1)
    return root**2


def test_neighbours_say_all_of_smooth_colours_and_residuals_are_linear() -> None:
    smooth = (3 + CODES @ [1.0, 0.5, 0.25])[:, None] ** 2
    residual = neighbour_residual(smooth, 3)
    known = LevelModel.of(np.zeros(4096), np.ones(4096, dtype=np.bool_), 4).known
    inner = np.any((CODES > 0) & (CODES < 7), axis=1)
    assert residual[inner] == pytest.approx(0, abs=1e-9)
    assert known.sum() == 16**3 - 8
    random = np.random.default_rng(1).normal(size=(2, 512, 1))
    both = neighbour_residual(random.sum(axis=0), 3)
    assert both == pytest.approx(sum(neighbour_residual(part, 3) for part in random))


@pytest.mark.slow
def test_a_full_chart_s_cell_is_held_against_the_mean_of_both_neighbours_along_each_axis() -> None:
    cube = np.random.default_rng(2).normal(size=(32, 32, 32, 2))
    total, axes = np.zeros_like(cube), np.zeros((32, 32, 32, 1))
    for axis in range(3):
        moved, counted = np.moveaxis(cube, axis, 0), np.moveaxis(axes, axis, 0)
        np.moveaxis(total, axis, 0)[1:-1] += moved[1:-1] - (moved[:-2] + moved[2:]) / 2
        counted[1:-1] += 1
    expected = total / np.maximum(axes, 1)
    np.testing.assert_allclose(neighbour_residual(cube.reshape(-1, 2), 5).reshape(cube.shape), expected, atol=1e-12)


@pytest.mark.parametrize("bend", [0.0, 0.2])
def test_few_cells_leave_little_but_their_noise_where_black_replaces_inks(bend: float) -> None:
    noise = 0.002
    seen = printed(bend) + noise * np.random.default_rng(2).standard_normal(len(CODES))
    model = LevelModel.of(seen, ALL, 3)
    left = model.residual_of(seen)
    assert left.std() == pytest.approx(noise * np.sqrt(model.freedom), rel=0.15)
    assert model.freedom > 0.5
    if bend:
        assert neighbour_residual(seen[:, None], 3)[:, 0].std() > 1.5 * left.std()


@pytest.mark.slow
def test_what_codes_predict_has_nothing_to_do_with_the_noise_that_is_left() -> None:
    level = printed(0.1)
    products: list[float] = []
    for seed in range(8):
        seen = level + 0.002 * np.random.default_rng(seed).standard_normal(len(CODES))
        model = LevelModel.of(seen, ALL, 3)
        left = model.residual_of(seen)
        products.append(float(left @ (model.predicted - level)) / float(left @ left))
    assert abs(np.mean(products)) < 0.05


def test_light_of_the_surroundings_is_left_over() -> None:
    noise, added = np.random.default_rng(3).standard_normal((2, len(CODES)))
    model = LevelModel.of(printed(0.1) + 0.002 * noise, ALL, 3)
    left = model.residual(added[:, None])[:, 0]
    assert float(left @ added) > 0.5 * float(added @ added)


def test_a_cell_that_cannot_be_used_says_nothing_of_others() -> None:
    seen, usable = printed(0.1), ALL.copy()
    spoilt = seen.copy()
    spoilt[100] = 0.9
    usable[100] = False
    left = LevelModel.of(spoilt, usable, 3).residual_of(spoilt)
    assert np.abs(np.delete(left, 100)).max() < 1e-3
    assert left[100] > 0.1


def test_a_small_chart_s_cell_is_held_against_its_neighbours_less_the_curvature_of_the_codes_beside() -> None:
    random = np.random.default_rng(4)
    cube = random.normal(size=(8, 8, 8))
    found = neighbour_residual(cube.reshape(-1, 1), 3).reshape(cube.shape)
    for place in ((0, 0, 0), (7, 0, 3), (3, 3, 3), (1, 6, 7), *random.integers(0, 8, (40, 3)).tolist()):
        left: list[float] = []
        for axis in (axis for axis in range(3) if 0 < place[axis] < 7):
            before, at, after = (np.take(cube, place[axis] + step, axis) for step in (-1, 0, 1))
            # Two codes to each side across the axis; at the cube's faces the last stand for those beyond.
            bend = np.pad(at - (before + after) / 2, 2, mode="edge")
            row, column = np.delete(place, axis).tolist()
            square = bend[row : row + 5, column : column + 5]
            left.append(square[2, 2] - (square.sum() - square[2, 2]) / 24)
        assert found[tuple(place)] == pytest.approx(np.mean(left) if left else 0)
