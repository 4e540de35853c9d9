"""Light added to a place of the print, against what else makes a place unlike its codes."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from experiment.measures.stains import Stains, added_light, find_stains, light_of_spot, spots_of

pytestmark = pytest.mark.slow

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


def reflected(cells: int, kept: float, added: float) -> Stains:
    """Return 64 × 64 cells, of which so many and two rings about them show `kept` of their light and some more."""
    random = np.random.default_rng(1)
    own = random.uniform(0.2, 1, 4096)
    own[:100] = 1  # Paper white is the 99th percentile.
    places = np.column_stack(np.divmod(np.arange(4096), 64)) * 5.0
    spot = np.zeros(4096, bool)
    spot[30 * 64 + 20 : 30 * 64 + 20 + cells] = True
    away = np.linalg.norm(places[:, None] - places[spot], axis=2).min(axis=1)
    seen = np.where(away < 13, kept * own + added, own)
    alone = np.repeat((seen / own - 1)[:, None], 3, axis=1)
    error = np.full((4096, 3), 1e-3)
    return Stains(np.where(spot[:, None], alone, 0), error, alone, spot, np.repeat(1000 * seen[:, None], 3, 1), places)


@pytest.mark.parametrize(
    ("cells", "kept", "is_counted"), [(20, 1, False), (21, 1, True), (30, 0.86, True), (30, 0.84, False)]
)
def test_a_reflection_is_of_half_a_per_cent_of_the_cells_which_keep_their_own(
    cells: int, kept: float, is_counted: bool
) -> None:
    assert added_light(reflected(cells, kept, 0.2)) == pytest.approx(0.2 if is_counted else 0, abs=1e-6)


def test_a_line_is_through_six_cells_that_are_not_black() -> None:
    stains = reflected(30, 0.9, 0.05)
    there = np.flatnonzero(stains.stained)
    for count, expected in ((6, (0.05, 0.9)), (5, (np.nan, np.nan))):
        assert light_of_spot(stains, there[:count], 2) == pytest.approx(expected, nan_ok=True, abs=1e-6)
    stains.alone[there[:25]] = np.nan
    stains.alone[there[20:25]] = -0.99
    assert np.isnan(light_of_spot(stains, there, 0)).all()
    stains.alone[there[0]] = stains.alone[there[25]]
    stains.level[there[0]] = stains.level[there[25]]
    assert light_of_spot(stains, there, 0) == pytest.approx((0.05, 0.9), abs=1e-6)


def test_what_deviates_is_large_and_significant() -> None:
    deviation = np.array([[0, -0.0101, 0], [0, 0.0099, 0], [0.0101, 0, 0], [0.0101, 0, 0], [np.nan, 0.03, 0]])
    error = np.array([1e-3, 1e-3, 0.0017, 0.00168, 1e-3])[:, None] * np.ones(3)
    made = Stains(deviation, error, 2 * deviation, np.zeros(5, bool), np.ones((5, 3)), np.zeros((5, 2)))
    assert made.doubtful.tolist() == [True, False, False, True, True]
    assert made.largest_deviation().tolist() == [-0.0101, 0.0099, 0.0101, 0.0101, 0.03]
    assert [made.deviation_of(cell) for cell in (0, 4)] == [-0.0202, 0.06]


def test_charts_of_four_levels_are_not_judged() -> None:
    known: list[bool] = []
    for bits in (2, 3):
        codes = np.stack(np.meshgrid(*[np.linspace(0, 1, 1 << bits)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        places = np.column_stack(np.divmod(np.random.default_rng(0).permutation(len(codes)), 8)) * 5.0
        known.append(find_stains(6000 * (0.1 + 0.9 * codes**2.2), places, bits).known)
    assert known == [False, True]
