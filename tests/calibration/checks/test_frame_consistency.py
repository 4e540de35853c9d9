"""Frames compared with the registered frame, on synthetic colours.

A healthy frame is below half of either limit; noise alone would need five standard uncertainties, one frame in a
million.
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
    """4096 random colours on a sheet, or another cube of colours, under two illuminants."""

    def __init__(self, seed: int = 1, step: int = 16) -> None:
        self.random = np.random.default_rng(seed)
        self.rgb = np.stack(np.meshgrid(*[np.arange(0, 256, step)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        slot = self.random.permutation(len(self.rgb))
        self.columns = round(1.19 * len(self.rgb) ** 0.5)
        self.places: _Array = 5.0 * np.stack([slot % self.columns, slot // self.columns], axis=-1).astype(np.float64)
        inks = (self.rgb / 255) @ np.array([[0.85, 0.1, 0.02], [0.1, 0.8, 0.15], [0.05, 0.1, 0.83]])
        self.paint = 0.04 + 0.9 * inks**2.2
        self.white = 8000 * self.paint
        # another illuminant: other mixtures of the three ink colours
        self.other = 5000 * self.paint @ np.array([[0.9, 0.2, 0.0], [0.1, 0.6, 0.1], [0.0, 0.2, 0.3]])

    def sample(self, true: _Array) -> tuple[_Array, _Array]:
        """Return the means of 25 noisy samples and their variance."""
        variance = (true / 1.8 + 36) / 25
        return true + np.sqrt(variance) * self.random.standard_normal(true.shape), variance

    def compare(self, true: _Array, usable: npt.NDArray[np.bool_] | None = None) -> FrameConsistency:
        is_usable = np.ones(len(true), dtype=np.bool_) if usable is None else usable
        check = ConsistencyCheck(self.rgb, self.places, *self.sample(self.white), is_usable)
        return check.compare(*self.sample(true))


@cache
def checked_sheet(step: int) -> tuple[Sheet, ConsistencyCheck]:
    """Return a sheet and the check from its first frame."""
    sheet = Sheet(3, step)
    is_usable = np.ones(len(sheet.rgb), dtype=np.bool_)
    return sheet, ConsistencyCheck(sheet.rgb, sheet.places, *sheet.sample(sheet.white), is_usable)


@pytest.fixture(scope="module")
def sheet() -> Sheet:
    return Sheet()


@pytest.mark.slow
@pytest.mark.parametrize("level", [1.0, 0.3])
def test_accepts_another_illuminant(sheet: Sheet, level: float) -> None:
    result = sheet.compare(level * sheet.other)
    assert result.scatter < LIMITS["frame_scatter"].accept
    assert result.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
def test_detects_another_order_of_colours(sheet: Sheet) -> None:
    result = sheet.compare(sheet.random.permutation(sheet.other))
    assert result.scatter > 10 * (LIMITS["frame_scatter"].refuse or np.inf)


@pytest.mark.slow
def test_light_of_neighbours_is_scatter(sheet: Sheet) -> None:
    """A lens out of focus adds 4 % of the light of other patches."""
    result = sheet.compare(0.96 * sheet.other + 0.04 * sheet.random.permutation(sheet.other))
    assert result.scatter > 1.5 * LIMITS["frame_scatter"].accept


@pytest.mark.slow
@pytest.mark.parametrize("transmission", [0.0, 0.3, 0.9])
def test_locates_shadow(sheet: Sheet, transmission: float) -> None:
    middle = np.array([260.0, 90.0])
    is_covered = np.abs(sheet.places - middle).max(axis=1) < 45
    result = sheet.compare(sheet.other * np.where(is_covered, transmission, 1.0)[:, None])
    assert result.block > (LIMITS["block_deviation"].refuse or np.inf)
    assert np.abs(np.array(result.at_mm) - middle).max() < 45


@pytest.mark.slow
@pytest.mark.parametrize("transmission", [0.05, 0.7, 0.85])
@pytest.mark.parametrize("cells", [4, 6])
@pytest.mark.parametrize("slot", [(0, 0), (17, 11), (33, 29), (52, 8), (70, 48)])
def test_detects_shadow_over_parts_of_blocks(
    sheet: Sheet, slot: tuple[int, int], cells: int, transmission: float
) -> None:
    """It covers a third or a sixth of a block, at any position relative to the blocks."""
    column, row = (sheet.places / 5.0).T
    is_covered = (np.abs(column - slot[0] - 1) < cells / 2) & (np.abs(row - slot[1] - 1) < cells / 2)
    result = sheet.compare(sheet.other * np.where(is_covered, transmission, 1.0)[:, None])
    limit = LIMITS["block_deviation"]
    assert result.block > ((limit.refuse or np.inf) if transmission == 0.05 else 0.5 * limit.accept)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("added", "kept"), [(0.0, 0.7), (0.25, 0.0), (0.03, 1.0)], ids=["shadow", "hand", "reflection"]
)
def test_separates_added_and_blocked_light(sheet: Sheet, added: float, kept: float) -> None:
    under = np.linalg.norm(sheet.places - (200, 130), axis=1) < 45
    brightest = np.percentile(sheet.other, 99, axis=0)
    result = sheet.compare(np.where(under[:, None], added * brightest + kept * sheet.other, sheet.other))
    assert result.block > LIMITS["block_deviation"].accept
    # Blocks at the rim are half covered.
    assert result.added == pytest.approx(added, abs=0.01 + 0.3 * added)
    assert result.kept == pytest.approx(kept, abs=0.3 * abs(1 - kept) + 0.02)
    assert 0.6 * 80 < result.extent_mm < 2 * 80
    assert result.share < 0.3


@pytest.mark.slow
def test_measures_colour_of_stain(sheet: Sheet) -> None:
    is_covered = np.linalg.norm(sheet.places - (200, 130), axis=1) < 45
    result = sheet.compare(sheet.other * np.where(is_covered[:, None], [0.97, 0.94, 0.9], 1.0))
    assert result.colour == pytest.approx((-0.03, -0.06, -0.1), abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("excess", [120.0, 3000.0])
def test_ignores_hot_photosites(excess: float) -> None:
    """3000 counts in one of 25 samples of a dark patch, and in all of them."""
    sheet = Sheet(2)
    counts = sheet.other.copy()
    dark = np.argsort(counts[:, 0])[sheet.random.integers(300, 600, 3)]
    counts[dark, 0] += excess
    result = sheet.compare(counts)
    assert result.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
@pytest.mark.parametrize("percentile", [50.0, 60.0, 65.0])
def test_ignores_hot_photosites_among_dark_patches(percentile: float) -> None:
    """Most patches are too dark to be compared, so few have compared neighbours."""
    sheet = Sheet(2)
    counts = 70 * sheet.other / np.percentile(sheet.other, percentile, axis=0)
    bright = counts[:, 2] > 60
    neighbours = cKDTree(sheet.places).query(sheet.places, k=9)[1]
    isolated = np.flatnonzero(bright & (counts[:, 2] < 90) & (bright[neighbours].sum(axis=1) <= 2))
    counts[sheet.random.choice(isolated, 3, replace=False), 2] += 160
    result = sheet.compare(counts)
    assert result.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
@pytest.mark.parametrize("transmission", [0.05, 0.8])
@pytest.mark.parametrize("size", [(2, 1), (2, 2), (3, 2)])
@pytest.mark.parametrize("step", [32, 16, 8])
def test_lists_few_covered_patches(step: int, size: tuple[int, int], transmission: float) -> None:
    """In charts of 512, 4096 and 32768 colours; in the last, the block mean hardly changes."""
    sheet, check = checked_sheet(step)
    column, row = (sheet.places / 5.0).T
    for slot in [(3, 4), (9, 2), (11, 12)]:
        under = (column >= slot[0]) & (column < slot[0] + size[0]) & (row >= slot[1]) & (row < slot[1] + size[1])
        disturbed = check.compare(*sheet.sample(sheet.other * np.where(under, transmission, 1.0)[:, None])).disturbed
        assert set(np.flatnonzero(under).tolist()) <= {cell for cell, _ in disturbed}
        # Adjacent patches with random deviations of three standard deviations are included.
        assert len(disturbed) <= under.sum() + 6
        assert all(deviation < -0.5 * (1 - transmission) for cell, deviation in disturbed if under[cell])


@pytest.mark.slow
def test_lists_dark_patches_inside_cover() -> None:
    sheet = Sheet(4)
    column, row = (sheet.places / 5.0).T
    is_covered = (column >= 20) & (column < 22) & (row >= 30) & (row < 32)
    darkest = np.flatnonzero(is_covered)[0]
    sheet.white[darkest] = sheet.other[darkest] = 5.0
    assert (int(darkest), 0.0) in sheet.compare(sheet.other * np.where(is_covered, 0.3, 1.0)[:, None]).disturbed


@pytest.mark.slow
@pytest.mark.parametrize("step", [32, 16, 8])
def test_lists_nothing_in_clean_frames(step: int) -> None:
    sheet, check = checked_sheet(step)
    for level in (1.0, 0.5, 0.2):
        result = check.compare(*sheet.sample(level * sheet.other))
        assert not result.disturbed
        assert not result.isolated


@pytest.mark.slow
def test_ignores_colours_that_polynomial_misses() -> None:
    """A step in the ink colours: hundreds of patches deviate by 6 %, and so do patches with similar codes."""
    sheet = Sheet(7)
    is_missed = (sheet.rgb[:, 0] > 176) & (sheet.rgb[:, 2] < 64)
    result = sheet.compare(sheet.other * np.where(is_missed, 0.9, 1.0)[:, None])
    assert is_missed.sum() > 200
    assert not result.disturbed
    assert not result.isolated


@pytest.mark.slow
def test_reports_isolated_patches_as_alone() -> None:
    sheet = Sheet(8)
    counts = sheet.other.copy()
    column, row = (sheet.places / 5.0).T
    is_isolated = (column % 9 == 4) & (row % 13 == 6)
    counts[is_isolated] *= 0.7
    result = sheet.compare(counts)
    assert not result.disturbed
    assert set(result.isolated) == set(np.flatnonzero(is_isolated).tolist())


@pytest.mark.slow
def test_dim_channel_does_not_increase_scatter() -> None:
    """About 150 compared patches with 3 % noise, in 30 frames."""
    sheet = Sheet(30, 8)
    usable = np.ones(len(sheet.rgb), dtype=np.bool_)
    check = ConsistencyCheck(sheet.rgb, sheet.places, *sheet.sample(sheet.white), usable)
    in_order = np.sort(sheet.other[::4], axis=0)
    dim = 60 * sheet.other / in_order[[-4000, -4000, -160], [0, 1, 2]]
    assert max(check.compare(*sheet.sample(dim)).scatter for _ in range(30)) < 0.5 * LIMITS["frame_scatter"].accept
    # Another order of colours is detected with as few patches.
    assert check.compare(*sheet.sample(sheet.random.permutation(dim))).scatter > 0.3


@pytest.mark.slow
def test_ignores_channel_without_adjacent_bright_patches() -> None:
    """Almost no blue light, and a shadow in green; the unknown channel raises no warning."""
    sheet = Sheet(9)
    column, row = (sheet.places / 5.0).T
    is_bright = (column % 5 == 2) & (row % 5 == 2)
    sheet.white[~is_bright, 2] = 50.0
    counts = sheet.other * np.array([0.1, 0.1, 0.1])
    counts[:, 2] = np.where(is_bright, 90.0 * sheet.white[:, 2] / sheet.white[is_bright, 2].mean(), 45.0)
    is_covered = np.linalg.norm(sheet.places - (200, 130), axis=1) < 45
    result = sheet.compare(counts * np.where(is_covered, 0.7, 1.0)[:, None])
    assert result.block > LIMITS["block_deviation"].accept
    assert result.kept == pytest.approx(0.7, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, 1, 2])
def test_removes_adjacent_hot_photosites(count: int) -> None:
    """Two adjacent hot patches, next to up to two covered ones."""
    sheet, check = checked_sheet(8)
    at = {(int(column), int(row)): cell for cell, (column, row) in enumerate((sheet.places / 5.0).tolist())}
    hot = np.zeros(len(sheet.rgb), dtype=np.bool_)
    hot[[at[40, 40], at[41, 41]]] = True
    covered = [at[42, 40], at[42, 42]][:count] if count < 2 else [at[42, 41], at[42, 42]]
    counts = sheet.other + 2000.0 * hot[:, None]
    counts[covered] *= 0.3
    result = check.compare(*sheet.sample(counts))
    assert {*np.flatnonzero(hot).tolist(), *covered} <= {cell for cell, _ in result.disturbed}
    cleaned = result.without_hot(hot, sheet.places)
    disturbed = {cell for cell, _ in cleaned.disturbed}
    assert not disturbed & set(np.flatnonzero(hot).tolist())
    assert set(covered) <= disturbed if count > 1 else not disturbed
    # a single covered patch is isolated now
    assert set(cleaned.isolated) == (set(covered) if count == 1 else set())
    assert cleaned.without_hot(hot, sheet.places) == cleaned


@pytest.mark.slow
def test_restores_result_from_checkpoint(sheet: Sheet) -> None:
    result = sheet.compare(sheet.other * np.where(sheet.places[:, :1] < 60, 0.9, 1.0))
    stored = json.dumps(to_plain(result))
    assert from_json(FrameConsistency, stored, "a checkpoint", "start again") == result


@pytest.mark.slow
def test_ignores_patches_covered_in_reference(sheet: Sheet) -> None:
    is_covered = np.abs(sheet.places - [260.0, 90.0]).max(axis=1) < 45
    result = sheet.compare(sheet.other * np.where(is_covered, 0.2, 1.0)[:, None], usable=~is_covered)
    assert result.block < 0.5 * LIMITS["block_deviation"].accept


@pytest.mark.slow
def test_needs_enough_patches() -> None:
    """64 patches of two inks are too few for a plane through their codes."""
    sheet = Sheet()
    few = np.flatnonzero((sheet.rgb % 80 == 0).all(axis=1))
    check = ConsistencyCheck(
        sheet.rgb[few], sheet.places[few], *sheet.sample(sheet.white[few]), np.ones(len(few), dtype=np.bool_)
    )
    assert len(few) == 64
    assert not has_enough_cells(64)
    assert check.compare(*sheet.sample(sheet.other[few])) == FrameConsistency()


@pytest.mark.slow
def test_ignores_dark_frame(sheet: Sheet) -> None:
    assert sheet.compare(0.001 * sheet.other) == FrameConsistency()


# Frames with different metadata.


def frames(*origins: FrameOrigin) -> list[tuple[Any, FrameOrigin]]:
    return [(number, origin) for number, origin in enumerate(origins)]


def origin(shutter_s: float | None = 0.5, iso: int | None = 100, aperture: float | None = 8.0) -> FrameOrigin:
    return FrameOrigin(iso=iso, aperture=aperture, shutter_s=shutter_s)


@pytest.mark.parametrize(
    ("other", "ratio"),
    [
        (origin(0.504), None),
        (origin(0.506), 1.012),
        (origin(0.496), None),
        (origin(0.4), 0.8),
        (origin(iso=200), 2),
        (origin(aperture=5.6), (8 / 5.6) ** 2),
        # without an f-number, it is taken to be equal
        (origin(aperture=None), None),
        (origin(0.25, 400, None), 2),
        (origin(None), None),
        (origin(iso=None), None),
    ],
)
def test_reports_exposures_that_differ_by_one_per_cent(other: FrameOrigin, ratio: float | None) -> None:
    foreign = origin_figures(frames(origin(), other, origin())).other_exposure
    assert [frame.ratio for frame in foreign] == ([] if ratio is None else [pytest.approx(ratio)])
    if foreign:
        assert (foreign[0].found, foreign[0].expected) == (other.exposure_text, origin().exposure_text)


def test_exposure_difference_is_largest_ratio() -> None:
    record: Any = None
    foreign = tuple(ForeignFrame(record, "", "", ratio) for ratio in (1.2, 0.8, 1.1))
    assert OriginFigures(other_exposure=foreign).exposure_difference == pytest.approx(0.25)
    assert OriginFigures().exposure_difference == 0


def test_compares_bodies_and_lenses_with_majority() -> None:
    first, second = FrameOrigin("EOS", "1", "50 mm"), FrameOrigin("EOS", "2", "50 mm")
    figures = origin_figures(frames(first, second, first, FrameOrigin("EOS M", "1", "35 mm"), FrameOrigin()))
    assert [(frame.record, frame.found, frame.expected) for frame in figures.other_camera] == [
        (1, "EOS no. 2", "EOS no. 1"), (3, "EOS M no. 1", "EOS no. 1"),
    ]  # fmt: skip
    assert [(frame.record, frame.found) for frame in figures.other_lens] == [(3, "35 mm")]
    unnumbered = origin_figures(frames(first, FrameOrigin("EOS"), second, FrameOrigin("EOS M", "1")))
    assert [(frame.record, frame.found, frame.expected) for frame in unnumbered.other_camera] == [
        (3, "EOS M no. 1", "EOS")
    ]
