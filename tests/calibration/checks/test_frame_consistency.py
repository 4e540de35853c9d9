"""Frames compared with the frame that was registered, on colours that are made up.

A healthy frame passes half of either limit; noise alone would need five standard errors, one frame in a million.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial import cKDTree

from calibration.checks.frame_consistency import (
    ConsistencyCheck,
    ForeignFrame,
    FrameConsistency,
    OriginFigures,
    has_enough_cells,
    origin_figures,
)
from calibration.figures.all_figures import FIGURES
from drivers.raw.rawfile import FrameOrigin
from foundation.records import from_json, to_plain

LIMITS = {limit.name: limit for limit in FIGURES}
_Array = npt.NDArray[np.float64]


class Sheet:
    """4096 colours at random over a sheet, or another cube of them, and what two lights give of them."""

    def __init__(self, seed: int = 1, step: int = 16) -> None:
        self.random = np.random.default_rng(seed)
        self.rgb = np.stack(np.meshgrid(*[np.arange(0, 256, step)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        place = self.random.permutation(len(self.rgb))
        self.columns = round(1.19 * len(self.rgb) ** 0.5)
        self.places: _Array = 5.0 * np.stack([place % self.columns, place // self.columns], axis=-1).astype(np.float64)
        inks = (self.rgb / 255) @ np.array([[0.85, 0.1, 0.02], [0.1, 0.8, 0.15], [0.05, 0.1, 0.83]])
        self.paint = 0.04 + 0.9 * inks**2.2
        self.white = 8000 * self.paint
        # Another light is other mixtures of what the three inks leave.
        self.other = 5000 * self.paint @ np.array([[0.9, 0.2, 0.0], [0.1, 0.6, 0.1], [0.0, 0.2, 0.3]])

    def seen(self, true: _Array) -> tuple[_Array, _Array]:
        """Return the means of 25 samples and their variance."""
        variance = (true / 1.8 + 36) / 25
        return true + np.sqrt(variance) * self.random.standard_normal(true.shape), variance

    def compared(self, true: _Array, usable: npt.NDArray[np.bool_] | None = None) -> FrameConsistency:
        there = np.ones(len(true), dtype=np.bool_) if usable is None else usable
        expected = ConsistencyCheck(self.rgb, self.places, *self.seen(self.white), there)
        return expected.compare(*self.seen(true))


@cache
def checked_sheet(step: int) -> tuple[Sheet, ConsistencyCheck]:
    """Return a sheet, and the check that its first frame makes."""
    sheet = Sheet(3, step)
    there = np.ones(len(sheet.rgb), dtype=np.bool_)
    return sheet, ConsistencyCheck(sheet.rgb, sheet.places, *sheet.seen(sheet.white), there)


@pytest.fixture(scope="module")
def sheet() -> Sheet:
    return Sheet()


@pytest.mark.slow
@pytest.mark.parametrize("level", [1.0, 0.3])
def test_another_light_is_no_other_print(sheet: Sheet, level: float) -> None:
    like = sheet.compared(level * sheet.other)
    assert like.scatter < LIMITS["frame_scatter"].accept
    assert like.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
def test_another_order_of_the_colours_is(sheet: Sheet) -> None:
    like = sheet.compared(sheet.random.permutation(sheet.other))
    assert like.scatter > 10 * (LIMITS["frame_scatter"].refuse or np.inf)


@pytest.mark.slow
def test_a_neighbour_s_light_is_scatter(sheet: Sheet) -> None:
    """4 % of a cell's light from another, as a lens out of focus gives."""
    like = sheet.compared(0.96 * sheet.other + 0.04 * sheet.random.permutation(sheet.other))
    assert like.scatter > 1.5 * LIMITS["frame_scatter"].accept


@pytest.mark.slow
@pytest.mark.parametrize("left", [0.0, 0.3, 0.9])
def test_a_shadow_is_found_where_it_lies(sheet: Sheet, left: float) -> None:
    middle = np.array([260.0, 90.0])
    under = np.abs(sheet.places - middle).max(axis=1) < 45
    like = sheet.compared(sheet.other * np.where(under, left, 1.0)[:, None])
    assert like.block > (LIMITS["block_deviation"].refuse or np.inf)
    assert np.abs(np.array(like.at_mm) - middle).max() < 45


@pytest.mark.slow
@pytest.mark.parametrize("left", [0.05, 0.7, 0.85])
@pytest.mark.parametrize("cells", [4, 6])
@pytest.mark.parametrize("place", [(0, 0), (17, 11), (33, 29), (52, 8), (70, 48)])
def test_a_shadow_that_covers_a_part_of_each_block_is_found(
    sheet: Sheet, place: tuple[int, int], cells: int, left: float
) -> None:
    """A third or a sixth of what a block holds, wherever the blocks' borders run."""
    column, row = (sheet.places / 5.0).T
    under = (np.abs(column - place[0] - 1) < cells / 2) & (np.abs(row - place[1] - 1) < cells / 2)
    like = sheet.compared(sheet.other * np.where(under, left, 1.0)[:, None])
    limit = LIMITS["block_deviation"]
    assert like.block > ((limit.refuse or np.inf) if left == 0.05 else 0.5 * limit.accept)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("added", "kept"), [(0.0, 0.7), (0.25, 0.0), (0.03, 1.0)], ids=["shadow", "hand", "reflection"]
)
def test_it_is_told_whether_light_was_added_or_taken(sheet: Sheet, added: float, kept: float) -> None:
    under = np.linalg.norm(sheet.places - (200, 130), axis=1) < 45
    top = np.percentile(sheet.other, 99, axis=0)
    like = sheet.compared(np.where(under[:, None], added * top + kept * sheet.other, sheet.other))
    assert like.block > LIMITS["block_deviation"].accept
    # Blocks at its rim are half under it.
    assert like.added == pytest.approx(added, abs=0.01 + 0.3 * added)
    assert like.kept == pytest.approx(kept, abs=0.3 * abs(1 - kept) + 0.02)
    assert 0.6 * 80 < like.extent_mm < 2 * 80
    assert like.share < 0.3


@pytest.mark.slow
def test_a_stain_s_colour_is_told(sheet: Sheet) -> None:
    under = np.linalg.norm(sheet.places - (200, 130), axis=1) < 45
    like = sheet.compared(sheet.other * np.where(under[:, None], [0.97, 0.94, 0.9], 1.0))
    assert like.colour == pytest.approx((-0.03, -0.06, -0.1), abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("excess", [120.0, 3000.0])
def test_one_hot_photosite_is_no_hand(excess: float) -> None:
    """3000 counts in one of 25 samples of a dark cell, and in all of them."""
    sheet = Sheet(2)
    seen = sheet.other.copy()
    dark = np.argsort(seen[:, 0])[sheet.random.integers(300, 600, 3)]
    seen[dark, 0] += excess
    like = sheet.compared(seen)
    assert like.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
@pytest.mark.parametrize("percentile", [50.0, 60.0, 65.0])
def test_one_hot_photosite_among_dark_cells_is_no_hand(percentile: float) -> None:
    """Under a light in which most cells are too dark to be compared, so that few have a neighbour that is."""
    sheet = Sheet(2)
    seen = 70 * sheet.other / np.percentile(sheet.other, percentile, axis=0)
    bright = seen[:, 2] > 60
    around = cKDTree(sheet.places).query(sheet.places, k=9)[1]
    lone = np.flatnonzero(bright & (seen[:, 2] < 90) & (bright[around].sum(axis=1) <= 2))
    seen[sheet.random.choice(lone, 3, replace=False), 2] += 160
    like = sheet.compared(seen)
    assert like.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
@pytest.mark.parametrize("left", [0.05, 0.8])
@pytest.mark.parametrize("size", [(2, 1), (2, 2), (3, 2)])
@pytest.mark.parametrize("step", [32, 16, 8])
def test_what_covers_few_cells_is_listed(step: int, size: tuple[int, int], left: float) -> None:
    """Of a chart of 512, of 4096 and of 32768 colours; the block's mean says hardly anything of the last."""
    sheet, check = checked_sheet(step)
    column, row = (sheet.places / 5.0).T
    for at in [(3, 4), (9, 2), (11, 12)]:
        under = (column >= at[0]) & (column < at[0] + size[0]) & (row >= at[1]) & (row < at[1] + size[1])
        found = check.compare(*sheet.seen(sheet.other * np.where(under, left, 1.0)[:, None])).disturbed
        assert set(np.flatnonzero(under).tolist()) <= {cell for cell, _ in found}
        # Cells beside it that are three standard deviations off are not told from those that it touches.
        assert len(found) <= under.sum() + 6
        assert all(off < -0.5 * (1 - left) for cell, off in found if under[cell])


@pytest.mark.slow
def test_cells_too_dark_to_compare_are_listed_with_those_that_cover_them() -> None:
    sheet = Sheet(4)
    column, row = (sheet.places / 5.0).T
    under = (column >= 20) & (column < 22) & (row >= 30) & (row < 32)
    darkest = np.flatnonzero(under)[0]
    sheet.white[darkest] = sheet.other[darkest] = 5.0
    assert (int(darkest), 0.0) in sheet.compared(sheet.other * np.where(under, 0.3, 1.0)[:, None]).disturbed


@pytest.mark.slow
@pytest.mark.parametrize("step", [32, 16, 8])
def test_a_frame_without_anything_has_no_disturbed_cells(step: int) -> None:
    sheet, check = checked_sheet(step)
    for level in (1.0, 0.5, 0.2):
        found = check.compare(*sheet.seen(level * sheet.other))
        assert not found.disturbed
        assert not found.alone


@pytest.mark.slow
def test_colours_that_the_polynomial_misses_are_no_place() -> None:
    """A fold in what the inks give: hundreds of cells are 6 % off, and so are those of codes next to theirs."""
    sheet = Sheet(7)
    missed = (sheet.rgb[:, 0] > 176) & (sheet.rgb[:, 2] < 64)
    like = sheet.compared(sheet.other * np.where(missed, 0.9, 1.0)[:, None])
    assert missed.sum() > 200
    assert not like.disturbed
    assert not like.alone


@pytest.mark.slow
def test_cells_that_stand_alone_are_no_place() -> None:
    sheet = Sheet(8)
    seen = sheet.other.copy()
    column, row = (sheet.places / 5.0).T
    strewn = (column % 9 == 4) & (row % 13 == 6)
    seen[strewn] *= 0.7
    found = sheet.compared(seen)
    assert not found.disturbed
    assert set(found.alone) == set(np.flatnonzero(strewn).tolist())


@pytest.mark.slow
def test_a_dim_channel_of_few_bright_cells_does_not_scatter() -> None:
    """Some 150 compared cells with noise of 3 %, in 30 frames: what the noise is by chance is no other print."""
    sheet = Sheet(30, 8)
    check = ConsistencyCheck(sheet.rgb, sheet.places, *sheet.seen(sheet.white), np.ones(len(sheet.rgb), dtype=np.bool_))
    in_order = np.sort(sheet.other[::4], axis=0)
    dim = 60 * sheet.other / in_order[[-4000, -4000, -160], [0, 1, 2]]
    assert max(check.compare(*sheet.seen(dim)).scatter for _ in range(30)) < 0.5 * LIMITS["frame_scatter"].accept
    # Of as few cells another print is one.
    assert check.compare(*sheet.seen(sheet.random.permutation(dim))).scatter > 0.3


@pytest.mark.slow
def test_a_channel_whose_bright_cells_lie_apart_says_nothing_of_a_place() -> None:
    """Under a light of hardly any blue, with a shadow that green shows; what is not known raises no warning."""
    sheet = Sheet(9)
    column, row = (sheet.places / 5.0).T
    apart = (column % 5 == 2) & (row % 5 == 2)
    sheet.white[~apart, 2] = 50.0
    seen = sheet.other * np.array([0.1, 0.1, 0.1])
    seen[:, 2] = np.where(apart, 90.0 * sheet.white[:, 2] / sheet.white[apart, 2].mean(), 45.0)
    under = np.linalg.norm(sheet.places - (200, 130), axis=1) < 45
    like = sheet.compared(seen * np.where(under, 0.7, 1.0)[:, None])
    assert like.block > LIMITS["block_deviation"].accept
    assert like.kept == pytest.approx(0.7, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("beside", [0, 1, 2])
def test_hot_photosites_side_by_side_are_nothing_that_lies_there(beside: int) -> None:
    """Two hot cells that touch, and as many beside them that something covers indeed."""
    sheet, check = checked_sheet(8)
    at = {(int(column), int(row)): cell for cell, (column, row) in enumerate((sheet.places / 5.0).tolist())}
    hot = np.zeros(len(sheet.rgb), dtype=np.bool_)
    hot[[at[40, 40], at[41, 41]]] = True
    covered = [at[42, 40], at[42, 42]][:beside] if beside < 2 else [at[42, 41], at[42, 42]]
    seen = sheet.other + 2000.0 * hot[:, None]
    seen[covered] *= 0.3
    found = check.compare(*sheet.seen(seen))
    assert {*np.flatnonzero(hot).tolist(), *covered} <= {cell for cell, _ in found.disturbed}
    told = found.without_hot(hot, sheet.places)
    disturbed = {cell for cell, _ in told.disturbed}
    assert not disturbed & set(np.flatnonzero(hot).tolist())
    assert set(covered) <= disturbed if beside > 1 else not disturbed
    # What stands alone now is not its colour, whatever the reason.
    assert set(told.alone) == (set(covered) if beside == 1 else set())
    assert told.without_hot(hot, sheet.places) == told


@pytest.mark.slow
def test_what_is_found_is_restored_from_a_checkpoint(sheet: Sheet) -> None:
    like = sheet.compared(sheet.other * np.where(sheet.places[:, :1] < 60, 0.9, 1.0))
    stored = json.dumps(to_plain(like))
    assert from_json(FrameConsistency, stored, "a checkpoint", "begin anew") == like


@pytest.mark.slow
def test_cells_that_were_covered_from_the_start_do_not_count(sheet: Sheet) -> None:
    under = np.abs(sheet.places - [260.0, 90.0]).max(axis=1) < 45
    like = sheet.compared(sheet.other * np.where(under, 0.2, 1.0)[:, None], usable=~under)
    assert like.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
def test_too_few_cells_say_nothing() -> None:
    """64 cells of two inks that a plane through their codes cannot describe."""
    sheet = Sheet()
    few = np.flatnonzero((sheet.rgb % 80 == 0).all(axis=1))
    expected = ConsistencyCheck(
        sheet.rgb[few], sheet.places[few], *sheet.seen(sheet.white[few]), np.ones(len(few), dtype=np.bool_)
    )
    assert len(few) == 64
    assert not has_enough_cells(64)
    assert expected.compare(*sheet.seen(sheet.other[few])) == FrameConsistency()


@pytest.mark.slow
def test_a_dark_frame_says_nothing(sheet: Sheet) -> None:
    assert sheet.compared(0.001 * sheet.other) == FrameConsistency()


# What is told of the light of blocks; which frames' files state otherwise than most.


def frames(*origins: FrameOrigin) -> list[tuple[Any, FrameOrigin]]:
    return [(number, origin) for number, origin in enumerate(origins)]


def shot(shutter_s: float | None = 0.5, iso: int | None = 100, aperture: float | None = 8.0) -> FrameOrigin:
    return FrameOrigin(iso=iso, aperture=aperture, shutter_s=shutter_s)


@pytest.mark.parametrize(
    ("other", "ratio"),
    [
        (shot(0.504), None),
        (shot(0.506), 1.012),
        (shot(0.496), None),
        (shot(0.4), 0.8),
        (shot(iso=200), 2),
        (shot(aperture=5.6), (8 / 5.6) ** 2),
        # Without an f-number of its own the lens is as in the others.
        (shot(aperture=None), None),
        (shot(0.25, 400, None), 2),
        (shot(None), None),
        (shot(iso=None), None),
    ],
)
def test_frames_are_exposed_otherwise_from_a_hundredth_on(other: FrameOrigin, ratio: float | None) -> None:
    found = origin_figures(frames(shot(), other, shot())).other_exposure
    assert [one.ratio for one in found] == ([] if ratio is None else [pytest.approx(ratio)])
    if found:
        assert (found[0].found, found[0].expected) == (other.exposure_text, shot().exposure_text)


def test_a_difference_of_exposure_is_the_largest_up_or_down() -> None:
    record: Any = None
    found = tuple(ForeignFrame(record, "", "", ratio) for ratio in (1.2, 0.8, 1.1))
    assert OriginFigures(other_exposure=found).exposure_difference == pytest.approx(0.25)
    assert OriginFigures().exposure_difference == 0


def test_bodies_and_lenses_are_held_against_most_and_a_model_without_number_is_no_other() -> None:
    one, two = FrameOrigin("EOS", "1", "50 mm"), FrameOrigin("EOS", "2", "50 mm")
    found = origin_figures(frames(one, two, one, FrameOrigin("EOS M", "1", "35 mm"), FrameOrigin()))
    assert [(frame.record, frame.found, frame.expected) for frame in found.other_camera] == [
        (1, "EOS no. 2", "EOS no. 1"), (3, "EOS M no. 1", "EOS no. 1"),
    ]  # fmt: skip
    assert [(frame.record, frame.found) for frame in found.other_lens] == [(3, "35 mm")]
    unnumbered = origin_figures(frames(one, FrameOrigin("EOS"), two, FrameOrigin("EOS M", "1")))
    assert [(frame.record, frame.found, frame.expected) for frame in unnumbered.other_camera] == [
        (3, "EOS M no. 1", "EOS")
    ]
