"""Light added to a place of the print, against what else makes a place unlike its codes."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from experiment.measures.stains import Stains, added_light, find_stains, light_of_spot, spots_of

_Array = npt.NDArray[np.float64]
SIDE = 16


@cache
def print_with(radius: float, added: float = 0.0, kept: float = 1.0, *, broad: bool = False) -> Stains:
    """Return what is found of 4096 cells in random order with a place, round or broad, in which light is added."""
    random = np.random.default_rng(3)
    codes = np.stack(np.meshgrid(*[np.linspace(0, 1, SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    level = 6000 * (0.03 + 0.87 * codes**2.2)
    x, y = np.divmod(random.permutation(SIDE**3), SIDE**2 // 4)
    places = np.column_stack([x, y]) * 5.0
    away = np.linalg.norm(places - places.mean(axis=0), axis=1) / max(radius, 1e-9)
    share = (np.exp(-(away**2)) if broad else away < 1)[:, None]
    level = (1 - (1 - kept) * share) * level + added * 5400 * share
    level = np.asarray(level * random.normal(1, 0.003, level.shape), dtype=np.float64)
    return find_stains(level, places, 4)


@pytest.mark.parametrize(("added", "least"), [(0.03, 0.003), (0.1, 0.003)])
def test_a_broad_reflection_goes_on_around_the_cells_that_are_listed(added: float, least: float) -> None:
    found = added_light(print_with(60, added, broad=True))
    assert least < found < added


@pytest.mark.parametrize(
    ("radius", "added", "kept"),
    [(0, 0, 1), (40, 0, 0.9), (40, 0.02, 0.6), (40, 0, 1.1), (9, 0.05, 1), (40, 0.03, 1), (40, 0.1, 1)],
    ids=["clean", "shadow", "hand", "brighter in proportion", "few cells", "sharp rim", "bright, sharp rim"],
)
def test_nothing_else_adds_light_to_cells_that_are_kept(radius: float, added: float, kept: float) -> None:
    assert added_light(print_with(radius, added, kept)) < 0.002


def test_cells_of_codes_with_equal_values_beside_each_other_are_no_stain() -> None:
    # Black ink stands for as much as all inks have in common, so that levels bend where two values are equal.
    codes = np.stack(np.meshgrid(*[np.linspace(0, 1, 8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    tied = np.count_nonzero(codes == codes.max(axis=1, keepdims=True), axis=1) > 1
    level = 6000 * (0.1 + 0.9 * codes**2.2) * np.exp(-0.8 * (1 - codes.max(axis=1, keepdims=True)))
    level = np.asarray(level * np.random.default_rng(4).normal(1, 0.003, level.shape), dtype=np.float64)
    places = np.zeros((len(codes), 2))
    places[np.argsort(tied, kind="stable")] = np.column_stack(np.divmod(np.arange(len(codes)), 16)) * 5.0
    assert not find_stains(level, places, 3).stained.any()
    stained = level * np.where(np.linalg.norm(places - [100, 40], axis=1) < 20, 0.95, 1)[:, None]
    assert find_stains(stained, places, 3).stained.sum() > 20


def test_the_spots_are_the_places_that_deviate() -> None:
    assert not spots_of(print_with(0))
    (spot, *_) = spots_of(print_with(40, 0.03))
    assert 100 < len(spot) < 400


@pytest.mark.parametrize("added", [0.008, 0.03, 0.1])
def test_light_and_what_is_kept_are_told_apart(added: float) -> None:
    stains = print_with(40, added, 0.95)
    found, kept = light_of_spot(stains, spots_of(stains)[0], 1)
    assert found == pytest.approx(added, rel=0.15)
    assert kept == pytest.approx(0.95, abs=0.02)
