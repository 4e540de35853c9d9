"""Accumulated frames, and the first cause of unfit cells at each limit."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from calibration.checks.frame_consistency import FrameConsistency
from calibration.pipeline.collecting import Accumulator, disturbed_cells
from calibration.pipeline.measuring import MeasuredFrame
from calibration.radiometry.dark_frames import DarkFrameFigures, HotPixels
from calibration.spread.added_light import AddedLight
from drivers.raw.rawfile import CLIPPING_SHARE
from experiment.measures.stains import Stains

CELLS = 64
SATURATION = 10_000
NO_LIGHT = np.zeros((CELLS, 3))


def empty() -> Any:
    """Return the state after two even frames of 500 counts with a noise of 20 counts each."""
    baseline = SimpleNamespace(
        chart=SimpleNamespace(colour_count=CELLS), levels=np.full((CELLS, 3), 0.5), options=SimpleNamespace()
    )
    unknown: Any = None
    return Accumulator(
        session=unknown, selected=unknown, baseline=baseline, figures=(), saturation=SATURATION, registered=unknown,  # pyrefly: ignore[bad-argument-type]
        dark=None, estimate=unknown, hot=HotPixels.start(CELLS, 25), highest=np.full(CELLS, 500, np.uint16),
        highest_at=np.zeros(CELLS, np.int64), outside=np.zeros(CELLS, np.bool_), covered=np.zeros(CELLS, np.bool_),
        place_error=np.zeros(CELLS), even_sum=np.full((CELLS, 25, 3), 1000, np.float32),
        even_noise2=np.full((CELLS, 3), 800.0), even_frames=2,
    )  # fmt: skip


def clean() -> Stains:
    return Stains(NO_LIGHT, NO_LIGHT, NO_LIGHT, np.zeros(CELLS, np.bool_), NO_LIGHT + 1, np.zeros((CELLS, 2)))


def frame(light: int | None, disturbed: dict[int, float], isolated: tuple[int, ...] = ()) -> Any:
    consistency = FrameConsistency(disturbed=tuple(disturbed.items()), isolated=isolated)
    return SimpleNamespace(record=SimpleNamespace(illumination=light), consistency=consistency)


def at(cell: int, value: float, *others: int) -> npt.NDArray[np.float64]:
    result = np.zeros(CELLS)
    result[[cell, *others]] = value
    return result


def causes(
    done: Any, stains: Stains | None = None, frames: tuple[Any, ...] = (), added: AddedLight | None = None
) -> Any:
    result = done.unfit(stains or clean(), frames, added or AddedLight.zero(CELLS))
    return {one.colour: one.cause for one in result}


def test_cell_is_unfit_beyond_each_limit() -> None:
    accumulator, limit = empty(), round(CLIPPING_SHARE * SATURATION)
    assert causes(accumulator) == {}
    highest = np.full(CELLS, 500, np.uint16)
    highest[[3, 4, 5]] = limit, limit - 1, limit
    clipped = causes(replace(accumulator, highest=highest, highest_at=np.where(np.arange(CELLS) == 5, -1, 0)))
    assert {colour: cause.split(",")[0] for colour, cause in clipped.items()} == {
        3: f"clipped: {limit} counts under illuminant 0", 5: f"clipped: {limit} counts under white",
    }  # fmt: skip
    assert list(causes(replace(accumulator, outside=at(7, 1).astype(bool), covered=at(8, 1).astype(bool)))) == [7, 8]
    assert list(causes(replace(accumulator, place_error=at(9, 0.5) + at(10, 0.51)))) == [10]
    # A twentieth of a cell's level of .5, beyond four standard errors.
    lit = AddedLight(NO_LIGHT.copy(), np.full((CELLS, 3), 0.001))
    lit.share[[11, 12], 1] = 0.0289, 0.0291
    assert list(causes(accumulator, added=lit)) == [12]
    assert "5.0%" in causes(accumulator, added=lit)[12]


def test_photosites_and_stains_make_cell_unfit() -> None:
    accumulator = empty()
    stained = replace(clean(), stained=at(3, 1).astype(bool), deviation=np.stack([at(3, -0.04)] * 3, axis=1))
    assert causes(accumulator, stained) == {
        3: "stained: its area is 4.0% darker than the same codes elsewhere on the print"
    }
    hot = HotPixels.start(CELLS, 25)
    hot.least[...] = 0
    hot.least[5, 7, 1] = 900
    noise = np.full(3, 5.0)
    dark: Any = SimpleNamespace(file="dark")
    figures = DarkFrameFigures(dark, np.zeros((2, 2)), np.zeros(3), np.zeros(3), noise)
    assert causes(replace(accumulator, figures=(figures,), hot=hot)) == {
        5: "hot: a photosite exceeds the others by 900 counts in every dark frame"
    }
    even = accumulator.even_sum.copy()
    even[6, 12, 0] = 499
    # A rim that differs by 5 %: the noise of the mean of two frames is 14 counts, and that of the difference 6.
    rim = np.ones((5, 5), np.bool_)
    rim[1:4, 1:4] = False
    even[7, rim.ravel(), 2] += 70
    even[8, rim.ravel(), 2] += 50
    result = causes(replace(accumulator, even_sum=even))
    assert [cause.split(":")[0] for cause in result.values()] == ["dead", "uneven"]
    assert list(result) == [6, 7]
    # Of cells of less than 300 counts, on the mean of the frames, none is told to be dead.
    dim = np.where(even == 499, 240, 500).astype(np.float32)
    assert causes(replace(accumulator, even_sum=dim)) == {}


def test_detects_stains_in_corrected_mean() -> None:
    accumulator = empty()
    field = np.linspace(0.5, 1.5, CELLS)[:, None] * np.ones(3)
    # Of eight colours nothing is known but what was judged.
    accumulator.baseline.chart.bits, accumulator.baseline.points = 1, SimpleNamespace(cells_mm=np.zeros((CELLS, 2)))
    result = accumulator.stains(field)
    assert not result.is_known
    np.testing.assert_allclose(result.level, 500 / field)


def test_covered_cells_are_unfit_with_their_lights() -> None:
    frames = (
        frame(2, {3: -0.1, 4: 0.0}), frame(5, {3: 0.3}), frame(None, {9: 0.5}, (10,)), frame(6, {}, (11,)),
    )  # fmt: skip
    assert disturbed_cells(frames) == {3: [(2, -0.1), (5, 0.3)], 4: [(2, 0.0)]}
    result = causes(empty(), frames=frames)
    assert result[3].startswith("disturbed: under illuminant 5 and 1 more: 30.0% brighter than expected from its code")
    assert result[4].startswith("disturbed: under illuminant 2: too dark to be compared")
    assert result[11].startswith("unlike: ")
    assert result[11].endswith("under illuminant 6")
    assert list(result) == [3, 4, 11]


def test_reports_first_cause() -> None:
    accumulator = replace(
        empty(), outside=at(3, 1).astype(bool), covered=at(3, 1, 4).astype(bool), place_error=at(3, 1, 4, 5)
    )
    assert [cause.split(":")[0] for cause in causes(accumulator).values()] == ["outside", "covered", "misplaced"]


def test_accumulates_highest_counts_and_even_samples() -> None:
    unknown: Any = None

    def measured(light: int | None, saturation: int, samples: float | None) -> MeasuredFrame:
        highest = np.full(CELLS, 500, np.uint16)
        highest[[1, 2]] = 499, 600 + (light or 0)
        figures: Any = SimpleNamespace(record=SimpleNamespace(illumination=light))
        kept = None if samples is None else np.full((CELLS, 25, 3), samples, np.float32)
        noise = None if samples is None else np.full((CELLS, 3), 30.0)
        return MeasuredFrame(figures, unknown, saturation, unknown, highest, np.arange(CELLS) != 7, kept, noise)

    accumulator = empty().with_frame(measured(3, 9000, None)).with_frame(measured(None, 9500, 700.0))
    assert (accumulator.saturation, accumulator.even_frames, len(accumulator.figures)) == (9000, 3, 2)
    assert (accumulator.highest[[0, 1, 2]].tolist(), accumulator.highest_at[[0, 1, 2]].tolist()) == (
        [500, 500, 603],
        [0, 0, 3],
    )
    assert np.flatnonzero(accumulator.outside).tolist() == [7]
    assert (accumulator.even_sum == 1700).all()
    assert (accumulator.even_noise2 == 800 + 900).all()
    # The noise of one sample over the brightest cells' level, both means of three frames.
    assert accumulator.noise() == pytest.approx(np.full(3, np.sqrt(1700 / 3) / (1700 / 3)))
    brighter = empty().with_frame(measured(None, 9500, None))
    assert brighter.highest_at[2] == -1
