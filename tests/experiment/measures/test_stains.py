"""Detection of stains, shadows and reflections on the print."""

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
def stains_with_spot(radius: float, added: float = 0.0, kept: float = 1.0, *, broad: bool = False) -> Stains:
    """Return the stains of 4096 patches in random order with a spot, round or broad, in which light is added."""
    random = np.random.default_rng(3)
    codes = np.stack(np.meshgrid(*[np.linspace(0, 1, SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    level = 6000 * (0.03 + 0.87 * codes**2.2)
    x, y = np.divmod(random.permutation(SIDE**3), SIDE**2 // 4)
    places = np.column_stack([x, y]) * 5.0
    distance = np.linalg.norm(places - places.mean(axis=0), axis=1) / max(radius, 1e-9)
    share = (np.exp(-(distance**2)) if broad else distance < 1)[:, None]
    level = (1 - (1 - kept) * share) * level + added * 5400 * share
    level = np.asarray(level * random.normal(1, 0.003, level.shape), dtype=np.float64)
    return find_stains(level, places, 4)


@pytest.mark.parametrize(("added", "least"), [(0.03, 0.003), (0.1, 0.003)])
def test_measures_broad_reflection_around_listed_patches(added: float, least: float) -> None:
    measured = added_light(stains_with_spot(60, added, broad=True))
    assert least < measured < added


@pytest.mark.parametrize(
    ("radius", "added", "kept"),
    [(0, 0, 1), (40, 0, 0.9), (40, 0.02, 0.6), (40, 0, 1.1), (9, 0.05, 1), (40, 0.03, 1), (40, 0.1, 1)],
    ids=["clean", "shadow", "hand", "brighter in proportion", "few cells", "sharp rim", "bright, sharp rim"],
)
def test_other_faults_add_no_light(radius: float, added: float, kept: float) -> None:
    assert added_light(stains_with_spot(radius, added, kept)) < 0.002


def test_adjacent_codes_with_equal_values_are_no_stain() -> None:
    # Black ink replaces the common part of all inks, so levels have a bend at equal values.
    codes = np.stack(np.meshgrid(*[np.linspace(0, 1, 8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    tied = np.count_nonzero(codes == codes.max(axis=1, keepdims=True), axis=1) > 1
    level = 6000 * (0.1 + 0.9 * codes**2.2) * np.exp(-0.8 * (1 - codes.max(axis=1, keepdims=True)))
    level = np.asarray(level * np.random.default_rng(4).normal(1, 0.003, level.shape), dtype=np.float64)
    places = np.zeros((len(codes), 2))
    places[np.argsort(tied, kind="stable")] = np.column_stack(np.divmod(np.arange(len(codes)), 16)) * 5.0
    assert not find_stains(level, places, 3).stained.any()
    stained = level * np.where(np.linalg.norm(places - [100, 40], axis=1) < 20, 0.95, 1)[:, None]
    assert find_stains(stained, places, 3).stained.sum() > 20


def test_spots_are_groups_of_deviating_patches() -> None:
    assert not spots_of(stains_with_spot(0))
    (spot, *_) = spots_of(stains_with_spot(40, 0.03))
    assert 100 < len(spot) < 400


@pytest.mark.parametrize("added", [0.008, 0.03, 0.1])
def test_separates_added_and_kept_light(added: float) -> None:
    stains = stains_with_spot(40, added, 0.95)
    measured, kept = light_of_spot(stains, spots_of(stains)[0], 1)
    assert measured == pytest.approx(added, rel=0.15)
    assert kept == pytest.approx(0.95, abs=0.02)


def test_ignores_charts_of_four_levels() -> None:
    has_result: list[bool] = []
    for bits in (2, 3):
        codes = np.stack(np.meshgrid(*[np.linspace(0, 1, 1 << bits)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        places = np.column_stack(np.divmod(np.random.default_rng(0).permutation(len(codes)), 8)) * 5.0
        has_result.append(find_stains(6000 * (0.1 + 0.9 * codes**2.2), places, bits).is_known)
    assert has_result == [False, True]


def cells_mm(lab: Lab) -> npt.NDArray[np.float64]:
    return lab.chart.centres_mm[lab.chart.cell_of_colour]


def stains_in_frame(room: Room, folder: Path) -> tuple[Lab, Stains]:
    """Return a laboratory and the stains in one white frame of its print."""
    lab = hang(room=room)
    mosaic = lab.mosaic(folder)
    registration = register(mosaic, lab.chart)
    whites = np.array([reference.centre_mm for reference in lab.chart.white_references])
    cells = cells_mm(lab)
    height, width = mosaic.block_planes().shape[2:]
    sites = sites_at(registration.to_pixels(np.concatenate([cells, whites])), (height, width))
    level = gather(mosaic, frame_black(mosaic), sites)[0].mean(axis=1, dtype=np.float64)
    _, field = PaperReader(whites, cells, lab.chart.page_mm).read(level[len(cells) :])
    return lab, find_stains(level[: len(cells)] / field, cells, lab.chart.bits)


def test_clean_print_has_no_stains(tmp_path: Path) -> None:
    _, stains = stains_in_frame(Room(waviness_mm=0.5, seed=5), tmp_path)
    assert not stains.stained.any()
    assert not stains.doubtful.any()
    assert (np.isfinite(stains.deviation)).mean() > 0.95
    assert (stains.largest_deviation() == 0).mean() < 0.05


def test_lists_the_patches_of_a_thumb_sized_stain(tmp_path: Path) -> None:
    depth = 0.15
    lab, stains = stains_in_frame(Room(waviness_mm=0.5, seed=0, stain_mm=25, stain_depth=depth), tmp_path)
    stain = lab.world.stain
    assert stain is not None
    distance = np.linalg.norm(cells_mm(lab) - stain.centre_mm, axis=1)
    cell = max(lab.chart.cell_mm)
    inside, outside = distance < 12.5 - 0.4 * cell, distance > 12.5 + 1.6 * cell
    assert inside.sum() >= 5
    assert stains.stained[inside].all()
    assert not stains.stained[outside].any()
    # The stain has so few patches that every neighbourhood extends beyond its edge.
    assert -1.15 * depth < stains.deviation[inside, 2].min() < -0.6 * depth
    assert (stains.largest_deviation()[inside] < 0).all()


def random_patches(bits: int, seed: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return counts and positions of a chart's colours, at random on a grid of 5 mm, with the noise of a few frames."""
    random = np.random.default_rng(seed)
    side = 1 << bits
    codes = np.stack(np.meshgrid(*[np.arange(side) / (side - 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    # Overlapping inks: every channel depends on all three codes.
    mixed = codes @ np.array([[0.85, 0.1, 0.02], [0.1, 0.8, 0.15], [0.05, 0.1, 0.83]])
    level = 9000 * (0.04 + 0.9 * mixed**2.2) * (1 + 0.004 * random.standard_normal(codes.shape))
    columns = round(np.sqrt(1.4 * len(level)))
    place = random.permutation(len(level))
    return level, 5.0 * np.stack([place % columns, place // columns], axis=-1)


def test_shadow_is_doubtful_only() -> None:
    """A broad shadow of 1.5 %, as a fold causes it, is shown and not listed."""
    level, places = random_patches(4, 3)
    distance = np.abs(places[:, 0] - places[:, 0].mean())
    stains = find_stains(level * np.where(distance < 25, 0.985, 1.0)[:, None], places, 4)
    assert not stains.stained.any()
    assert stains.doubtful[distance < 15].mean() > 0.6
    assert not stains.doubtful[distance > 36].any()
    assert stains.deviation[distance < 15].mean() == pytest.approx(-0.015, abs=0.003)


def test_ignores_unusable_patches() -> None:
    """A covered corner does not affect its neighbours."""
    level, places = random_patches(4, 5)
    covered = np.linalg.norm(places, axis=1) < 60
    level[covered] = 400
    assert find_stains(level, places, 4).stained[covered].mean() > 0.5
    assert not find_stains(level, places, 4, usable=~covered).stained.any()


def test_ignores_dark_patches() -> None:
    level, places = random_patches(3, 6)
    stains = find_stains(level / 9000 * 20, places, 3)
    assert np.isnan(stains.deviation).all()
    assert not stains.stained.any()
    assert not stains.largest_deviation().any()
