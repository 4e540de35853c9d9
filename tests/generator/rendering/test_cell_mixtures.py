"""Mixtures of cells show what is wanted, in the mean and with cells near to it.

Mixtures are kept for the next time, and damaged ones are as good as none.

Which source nodes a picture has, and what a print makes of them.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from foundation.colorimetry import angles_deg
from generator.kernels.dithering import nearest_nodes
from generator.rendering.cell_mixtures import (
    _AXES,  # pyright: ignore[reportPrivateUsage]  # what differences cost is no part of the result
    BRIGHTNESS_COST,
    GREY_MET_DEG,
    MET_WITHIN,
    SLOTS,
    WIDE_SPREAD_COST,
    CellMixtures,
    cache_folder,
    keep_mixtures,
    load_mixtures,
    mix_cells,
    summarise,
)
from generator.rendering.colorimetric import NODES, node_codes
from generator.rendering.print_profiles import PrintProfile
from tests.generator.rendering.prints import printed


@pytest.fixture
def mixtures() -> CellMixtures:
    rng = np.random.default_rng(4)
    return CellMixtures(
        np.sort(rng.integers(0, 32768, (7, 16)), axis=1).astype(np.uint16),
        rng.random((7, 3)).astype(np.float32),
        rng.random((7, 3)).astype(np.float32),
    )


def test_what_is_kept_is_found(mixtures: CellMixtures, tmp_path: Path) -> None:
    folder = tmp_path / "not yet there"
    assert load_mixtures("ab12", 7, folder) is None
    keep_mixtures("ab12", mixtures, folder)
    found = load_mixtures("ab12", 7, folder)
    assert found is not None
    for name in ("cells", "colours", "wanted"):
        kept, given = getattr(found, name), getattr(mixtures, name)
        assert kept.dtype == given.dtype
        np.testing.assert_array_equal(kept, given)
    assert [path.suffix for path in folder.iterdir()] == [".mixtures"]


@pytest.mark.parametrize("place", [0, 25, 100, -1])
def test_a_damaged_file_is_none(mixtures: CellMixtures, tmp_path: Path, place: int) -> None:
    keep_mixtures("ab12", mixtures, tmp_path)
    path = tmp_path / "ab12.mixtures"
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    assert load_mixtures("ab12", 7, tmp_path) is None
    keep_mixtures("ab12", mixtures, tmp_path)
    assert load_mixtures("ab12", 7, tmp_path) is not None


@pytest.mark.parametrize("content", [b"", b"something else", b"CroP cell mixtures 1\n"])
def test_a_foreign_or_cut_file_is_none(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "ab12.mixtures").write_bytes(content)
    assert load_mixtures("ab12", 7, tmp_path) is None


def test_mixtures_of_another_size_are_none(mixtures: CellMixtures, tmp_path: Path) -> None:
    keep_mixtures("ab12", mixtures, tmp_path)
    assert load_mixtures("ab12", 8, tmp_path) is None


def test_where_nothing_can_be_kept_nothing_is(mixtures: CellMixtures, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    keep_mixtures("ab12", mixtures, tmp_path / "file" / "below")
    assert load_mixtures("ab12", 7, tmp_path / "file" / "below") is None


def test_the_folder_is_the_one_of_the_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "croplab"
    monkeypatch.setenv("XDG_CACHE_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", "linux")
    assert cache_folder() == tmp_path / ".cache" / "croplab"
    monkeypatch.setattr("sys.platform", "darwin")
    assert cache_folder() == tmp_path / "Library" / "Caches" / "croplab"


def test_what_was_kept_first_makes_room(
    mixtures: CellMixtures, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "notes.txt").write_text("not ours")
    for number in range(3):
        keep_mixtures(f"{number}", mixtures, tmp_path)
        os.utime(tmp_path / f"{number}.mixtures", ns=(number, number))
    size = (tmp_path / "0.mixtures").stat().st_size
    monkeypatch.setattr("generator.rendering.cell_mixtures.MOST_BYTES", 3 * size)
    keep_mixtures("3", mixtures, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.mixtures", "2.mixtures", "3.mixtures", "notes.txt"]


def test_every_pixel_counts_as_the_node_nearest_to_it() -> None:
    picture = np.random.default_rng(5).integers(0, 256, (9, 11, 3)).astype(np.uint8)
    nodes = [int(np.square(node_codes() - pixel / 255).sum(axis=1).argmin()) for pixel in picture.reshape(-1, 3)]
    np.testing.assert_array_equal(nearest_nodes(picture), np.bincount(nodes, minlength=NODES))


def test_what_is_missed_counts_by_pixels() -> None:
    rng = np.random.default_rng(6)
    wanted = rng.uniform(0.1, 0.9, (NODES, 3)).astype(np.float32)
    seen = (wanted * rng.uniform(0.9, 1.1, wanted.shape)).astype(np.float32)
    picture = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    counts = nearest_nodes(picture)
    summary = summarise(CellMixtures(np.zeros((NODES, 32), np.uint16), seen, wanted), counts.astype(np.float64))
    each = np.repeat(np.arange(NODES), counts)
    cosines = (seen[each] * wanted[each]).sum(axis=1, dtype=np.float64)
    cosines /= np.linalg.norm(seen[each].astype(float), axis=1) * np.linalg.norm(wanted[each].astype(float), axis=1)
    assert summary.distance_deg == pytest.approx(np.degrees(np.arccos(np.minimum(cosines, 1))).mean(), rel=1e-4)
    off = np.abs(seen[each] / wanted[each] - 1).max(axis=1) > 0.02
    assert summary.outside == pytest.approx(off.mean())
    assert 0 < summary.outside < 1


def profile(bits: int = 4, tint: float = 0.0) -> PrintProfile:
    return PrintProfile(printed(bits, tint), np.ones(1 << 3 * bits, np.bool_))


def inside(of: PrintProfile, count: int = 300) -> npt.NDArray[np.float64]:
    """Return colours between eight cells of the chart that are neighbours by their codes."""
    rng = np.random.default_rng(1)
    levels = 2**of.bits
    corner = rng.integers(levels // 4, levels - 1, (count, 3))
    share = rng.random((count, 3))
    found = np.zeros((count, 3))
    for corner_bits in range(8):
        step = np.array([corner_bits >> 2 & 1, corner_bits >> 1 & 1, corner_bits & 1])
        weight = np.where(step == 1, share, 1 - share).prod(axis=1, keepdims=True)
        code = corner + step
        found += weight * of.colours[(code[:, 0] * levels + code[:, 1]) * levels + code[:, 2]]
    return found


def test_the_mean_of_the_cells_is_what_is_wanted() -> None:
    print_ = profile()
    wanted = inside(print_)
    mixtures = mix_cells(print_, wanted)
    assert mixtures.cells.shape == (len(wanted), SLOTS)
    means = print_.colours[mixtures.cells].mean(axis=1)
    np.testing.assert_allclose(mixtures.colours, means, rtol=1e-6)
    np.testing.assert_allclose(mixtures.distance, angles_deg(means, wanted), atol=1e-4)
    # Cells of a chart of four bits are some 15 % apart; rounding four weights to 16ths alone would err by 1/32 of that
    # and more.
    assert np.median(np.abs(means / wanted - 1).max(axis=1)) < 0.004
    assert not mixtures.outside.any()


def test_the_cells_are_near_to_what_is_wanted() -> None:
    print_ = profile()
    wanted = inside(print_)
    mixtures = mix_cells(print_, wanted)
    nearest = np.array([np.abs(np.log(print_.colours) - np.log(colour)).max(axis=1).min() for colour in wanted])
    widest = np.abs(np.log(print_.colours[mixtures.cells]) - np.log(wanted)[:, None]).max(axis=(1, 2))
    assert np.median(nearest) > 0.03
    # The eight cells around a colour of a grid are up to some steps of the grid from it.
    assert np.percentile(widest, 99) < 0.6


@pytest.mark.parametrize("tint", [0.0, 0.15])
def test_greys_are_grey_on_a_print_whose_greys_are_not(tint: float) -> None:
    print_ = profile(tint=tint)
    levels = 2**print_.bits
    codes = print_.colours[np.arange(levels) * (levels * levels + levels + 1)]
    assert (angles_deg(codes, np.ones(3)).max() > 4) == (tint > 0)
    greys = np.linspace(print_.black, print_.white, 40)[:, None] * np.ones(3)
    assert mix_cells(print_, greys).distance.max() < 0.5


def test_a_dark_grey_that_is_far_from_its_cells_is_tried_with_more_of_them() -> None:
    """A print whose black is red: with the 192 nearest cells alone one of these greys is .57 degrees off."""
    colours = printed(5)
    colours = colours * (1 + 0.04 / colours.mean(axis=1, keepdims=True) * np.array([0.2, 0.0, -0.2]))
    colours = colours * np.exp(0.03 * np.random.default_rng(2).standard_normal(colours.shape))
    print_ = PrintProfile(colours, np.ones(len(colours), np.bool_))
    greys = np.linspace(print_.black, 2 * print_.black, 20)[:, None] * np.ones(3)
    assert mix_cells(print_, greys).distance.max() < 0.4


def test_what_the_print_cannot_show_is_said() -> None:
    print_ = profile()
    wanted = np.array([[0.5, 0.5, 0.5], [0.99, 0.99, 0.99], [0.9, 0.05, 0.05], [0.01, 0.01, 0.01]])
    mixtures = mix_cells(print_, wanted)
    assert mixtures.outside.tolist() == [False, True, True, True]
    # What is too bright or too dark keeps its hue; what is too colourful cannot.
    assert mixtures.distance[1] < 1
    assert mixtures.distance[2] > 5
    for colour, made, outside in zip(wanted, mixtures.colours, mixtures.outside, strict=True):
        assert bool((np.abs(made / colour - 1) > MET_WITHIN).any()) == outside


def test_cells_that_are_not_usable_are_never_taken() -> None:
    colours = printed(3)
    usable = np.ones(len(colours), np.bool_)
    usable[::3] = False
    mixtures = mix_cells(PrintProfile(colours, usable), inside(profile(3)))
    assert usable[mixtures.cells].all()


def test_one_usable_cell_is_all_that_is_taken() -> None:
    usable = np.zeros(8, np.bool_)
    usable[5] = True
    mixtures = mix_cells(PrintProfile(printed(1), usable), np.full((2, 3), 0.3))
    assert (mixtures.cells == 5).all()
    assert mixtures.outside.all()


def test_the_same_every_time() -> None:
    print_ = profile()
    wanted = inside(print_)
    once, again = mix_cells(print_, wanted), mix_cells(print_, wanted[::-1])
    np.testing.assert_array_equal(once.cells, again.cells[::-1])


@pytest.mark.parametrize("bits", [1, 2, 3])
def test_charts_of_fewer_cells_say_how_far_they_are_off(bits: int) -> None:
    print_ = profile(bits)
    wanted = inside(profile(5), 100)
    mixtures = mix_cells(print_, wanted)
    assert mixtures.cells.max() < 8**bits
    np.testing.assert_allclose(
        mixtures.distance, angles_deg(print_.colours[mixtures.cells].mean(axis=1), wanted), atol=1e-4
    )


def test_no_exchange_of_two_cells_brings_a_grey_nearer() -> None:
    # Moves of single cells alone end before that for some of these prints.
    scale = np.array([[BRIGHTNESS_COST**0.5], [1.0], [1.0]]) * _AXES
    for seed in range(10):
        colours = 0.3 * np.exp(0.2 * np.random.default_rng(seed).standard_normal((64, 3)))
        wanted = np.full((1, 3), 0.3)
        cells = mix_cells(PrintProfile(colours, np.ones(64, np.bool_)), wanted).cells[0].astype(np.int64)
        if angles_deg(colours[cells].mean(axis=0), wanted[0]) <= GREY_MET_DEG:
            continue
        places = (colours / wanted - 1) @ scale.T
        single = WIDE_SPREAD_COST * SLOTS * (places**2).sum(axis=1)

        def cost(total: npt.NDArray[np.float64], spread: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            return (total**2).sum(axis=-1) + spread

        now = cost(places[cells].sum(axis=0), single[cells].sum())
        pairs = places[:, None] + places[None]
        spreads = single[:, None] + single[None]
        for i in range(SLOTS):
            for j in range(i):
                others = np.delete(cells, [i, j])
                found = cost(places[others].sum(axis=0) + pairs, single[others].sum() + spreads)
                assert found.min() >= now - 1e-9
