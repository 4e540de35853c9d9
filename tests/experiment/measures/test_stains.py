"""Light added to a place of the print, against what else makes a place unlike its codes."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.register import register
from calibration.sampling import gather, sites_at
from drivers.raw.rawfile import frame_black
from experiment.measures.paper import PaperReader
from experiment.measures.stains import Stains, added_light, find_stains, light_of_spot, spots_of
from sim.world.world import Room
from tests.calibration.lab import Lab, hang

pytestmark = pytest.mark.slow
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


def test_charts_of_four_levels_are_not_judged() -> None:
    known: list[bool] = []
    for bits in (2, 3):
        codes = np.stack(np.meshgrid(*[np.linspace(0, 1, 1 << bits)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        places = np.column_stack(np.divmod(np.random.default_rng(0).permutation(len(codes)), 8)) * 5.0
        known.append(find_stains(6000 * (0.1 + 0.9 * codes**2.2), places, bits).known)
    assert known == [False, True]


# Cells that are not of their codes' colours, found by their neighbourhoods.


def cells_mm(lab: Lab) -> npt.NDArray[np.float64]:
    return lab.chart.centres_mm[lab.chart.cell_of_colour]


def read(room: Room, folder: Path) -> tuple[Lab, Stains]:
    """Return a lab and what one white frame shows of its print."""
    lab = hang(room=room)
    mosaic = lab.mosaic(folder)
    found = register(mosaic, lab.chart)
    whites = np.array([reference.centre_mm for reference in lab.chart.white_references])
    cells = cells_mm(lab)
    height, width = mosaic.block_planes().shape[2:]
    sites = sites_at(found.to_pixels(np.concatenate([cells, whites])), (height, width))
    level = gather(mosaic, frame_black(mosaic), sites)[0].mean(axis=1, dtype=np.float64)
    _, field = PaperReader(whites, cells, lab.chart.page_mm).read(level[len(cells) :])
    return lab, find_stains(level[: len(cells)] / field, cells, lab.chart.bits)


def test_a_clean_print_has_none(tmp_path: Path) -> None:
    _, stains = read(Room(waviness_mm=0.5, seed=5), tmp_path)
    assert not stains.stained.any()
    assert not stains.doubtful.any()
    assert (np.isfinite(stains.deviation)).mean() > 0.95
    assert (stains.largest_deviation() == 0).mean() < 0.05


def test_a_thumb_s_stain_is_found_cell_by_cell(tmp_path: Path) -> None:
    depth = 0.15
    lab, stains = read(Room(waviness_mm=0.5, seed=0, stain_mm=25, stain_depth=depth), tmp_path)
    stain = lab.world.stain
    assert stain is not None
    away = np.linalg.norm(cells_mm(lab) - stain.centre_mm, axis=1)
    cell = max(lab.chart.cell_mm)
    inside, outside = away < 12.5 - 0.4 * cell, away > 12.5 + 1.6 * cell
    assert inside.sum() >= 5
    assert stains.stained[inside].all()
    assert not stains.stained[outside].any()
    # So few cells fit that every neighbourhood reaches beyond the rim.
    assert -1.15 * depth < stains.deviation[inside, 2].min() < -0.6 * depth
    assert (stains.largest_deviation()[inside] < 0).all()


def drawn(bits: int, seed: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return counts and places of a chart's colours, at random over a lattice of 5 mm, with a few frames' noise."""
    random = np.random.default_rng(seed)
    side = 1 << bits
    codes = np.stack(np.meshgrid(*[np.arange(side) / (side - 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    # Inks that overlap, so that every channel hangs on all three codes.
    mixed = codes @ np.array([[0.85, 0.1, 0.02], [0.1, 0.8, 0.15], [0.05, 0.1, 0.83]])
    level = 9000 * (0.04 + 0.9 * mixed**2.2) * (1 + 0.004 * random.standard_normal(codes.shape))
    columns = round(np.sqrt(1.4 * len(level)))
    place = random.permutation(len(level))
    return level, 5.0 * np.stack([place % columns, place // columns], axis=-1)


def test_a_shadow_counts_as_doubtful_and_no_more() -> None:
    """A broad flank of 1.5 %, as a fold throws it, is shown and not listed."""
    level, places = drawn(4, 3)
    away = np.abs(places[:, 0] - places[:, 0].mean())
    stains = find_stains(level * np.where(away < 25, 0.985, 1.0)[:, None], places, 4)
    assert not stains.stained.any()
    assert stains.doubtful[away < 15].mean() > 0.6
    assert not stains.doubtful[away > 36].any()
    assert stains.deviation[away < 15].mean() == pytest.approx(-0.015, abs=0.003)


def test_cells_that_cannot_be_used_are_no_evidence() -> None:
    """A covered corner, which is listed otherwise, stains nobody beside it."""
    level, places = drawn(4, 5)
    covered = np.linalg.norm(places, axis=1) < 60
    level[covered] = 400
    assert find_stains(level, places, 4).stained[covered].mean() > 0.5
    assert not find_stains(level, places, 4, usable=~covered).stained.any()


def test_what_is_dark_says_nothing() -> None:
    level, places = drawn(3, 6)
    stains = find_stains(level / 9000 * 20, places, 3)
    assert np.isnan(stains.deviation).all()
    assert not stains.stained.any()
    assert not stains.largest_deviation().any()
