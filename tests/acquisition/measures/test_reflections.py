"""Light added to a place of the print, against what else makes a place unlike its codes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.measures.reflections import added_light, spots_of
from acquisition.measures.stains import Stains, find_stains

_Array = npt.NDArray[np.float64]
SIDE = 16


def print_with(radius: float, added: float = 0.0, kept: float = 1.0) -> Stains:
    """Return what is found of 4096 cells in random order with a round place in which light is added, or taken."""
    random = np.random.default_rng(3)
    codes = np.stack(np.meshgrid(*[np.linspace(0, 1, SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    level = 6000 * (0.03 + 0.87 * codes**2.2)
    x, y = np.divmod(random.permutation(SIDE**3), SIDE**2 // 4)
    places = np.column_stack([x, y]) * 5.0
    under = np.linalg.norm(places - places.mean(axis=0), axis=1) < radius
    level[under] = kept * level[under] + added * 5400
    level *= random.normal(1, 0.003, level.shape)
    return find_stains(level, places, 4)


@pytest.mark.parametrize("added", [0.008, 0.03, 0.1])
def test_light_that_a_large_reflection_adds_is_measured(added: float) -> None:
    assert added_light(print_with(40, added)) == pytest.approx(added, rel=0.15)


@pytest.mark.parametrize(
    "stains",
    [print_with(0), print_with(40, 0, 0.9), print_with(40, 0.02, 0.6), print_with(40, 0, 1.1), print_with(9, 0.05)],
    ids=["clean", "shadow", "hand", "brighter in proportion", "glint on few cells"],
)
def test_nothing_else_is_a_large_reflection(stains: Stains) -> None:
    assert added_light(stains) < 0.003


def test_the_spots_are_the_places_that_deviate() -> None:
    assert not spots_of(print_with(0))
    (spot, *_) = spots_of(print_with(40, 0.03))
    assert 100 < len(spot) < 400
