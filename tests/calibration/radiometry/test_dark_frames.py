"""Dark frames, from made-up counts whose truth is known."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt
import pytest

from calibration.radiometry.dark_frames import (
    DarkFrameFigures,
    DarkLight,
    DarkLightEstimate,
    HotPixels,
    dark_summary,
    measure_dark_frame,
)
from experiment.measures.paper import FlatField, Paper
from experiment.session.records import FrameRecord
from foundation.records import from_plain, to_plain


def samples(count: int, level: tuple[float, float, float], seed: int) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).normal(level, 6.0, (count, 25, 3)).astype(np.float32)


def dark_frame(
    number: int, cells: npt.NDArray[np.float32], paper: npt.NDArray[np.float32], shape: npt.NDArray[np.float64]
) -> tuple[DarkFrameFigures, npt.NDArray[np.int16]]:
    at = datetime(2024, 3, 1, 9, number, tzinfo=UTC)
    record = FrameRecord("dark", None, f"{number}.dng", "00", at, 0.5, "accepted")
    return measure_dark_frame(record, np.full((2, 2), 2048.0 + number), cells, paper, shape)


def test_leak_and_hot_photosites_are_read() -> None:
    shape = np.random.default_rng(1).uniform(0.8, 1.2, (400, 1)) * np.ones(3)
    hot, frames = HotPixels.none(2000, 25), list[DarkFrameFigures]()
    for number in range(3):
        cells, paper = samples(2000, (1, 2, 1), 10 + number), samples(400, (0, 0, 0), 20 + number)
        paper += (shape[:, None] * (4, 7, 5)).astype(np.float32)
        cells[17, 3, 1] += 200
        cells[99 + number, 5, 0] += 900
        figures, excess = dark_frame(number, cells, paper, shape)
        frames.append(from_plain(DarkFrameFigures, to_plain(figures), "a checkpoint", "begin anew"))
        hot = hot.with_frame(excess)
    dark = dark_summary(frames, hot)
    assert dark.light == pytest.approx([4, 7, 5], abs=4 * 6 / np.sqrt(400 * 25))
    assert (dark.error < 0.1).all()
    assert dark.noise == pytest.approx(6, rel=0.06)
    assert np.flatnonzero(dark.hottest).tolist() == [17]
    assert dark.hottest[17] == pytest.approx(200, abs=20)
    assert len(dark.blacks) == 3


def test_the_dark_light_of_two_frames_is_their_mean() -> None:
    paper = Paper(FlatField.uniform((1, 1)), np.array([4.0, 7.0, 5.0]), np.full(3, 0.1), 9, np.zeros(3))
    beyond = np.random.default_rng(3).normal(0, 2, (50, 3))
    estimate = DarkLightEstimate.none(np.full((50, 3), 0.5), np.ones(50, dtype=bool), 25)
    found: list[DarkLight] = []
    for times in (1.0, 3.0):
        means = 0.5 * paper.white + times * beyond
        estimate, light = estimate.with_frame(means, np.zeros(3), paper, np.ones((50, 3)))
        found.append(light)
    # Without noise all that lies beyond the prediction is believed.
    np.testing.assert_allclose(found[0].patches, 0.5 * paper.white + beyond, rtol=1e-5)
    np.testing.assert_allclose(found[1].patches, 0.5 * paper.white + 2 * beyond, rtol=1e-5)


def test_a_hot_photosite_is_remembered_over_a_bump() -> None:
    """Before it, cell 3 lies on the photosite; after it, cell 4; a cosmic ray in one frame of a stretch is none."""
    hot, noise = HotPixels.none(10, 25), np.full(3, 6.0)
    none = np.zeros((10, 25, 3), dtype=np.int16)
    for number in range(4):
        if number == 2:
            hot = hot.restarted(noise)
        excess = none.copy()
        excess[3 if number < 2 else 4, 12, 0] = 150
        excess[number, 1, 1] += 800
        hot = hot.with_frame(excess)
    assert np.flatnonzero(hot.hottest(noise)).tolist() == [3, 4]


def test_a_stretch_without_dark_frames_has_nothing_hot() -> None:
    hot = HotPixels.none(4, 25)
    assert not hot.hottest(np.full(3, np.nan)).any()
    assert not hot.restarted(np.full(3, np.nan)).hottest(np.full(3, 6.0)).any()


def test_without_dark_frames_nothing_is_known() -> None:
    assert np.isnan(dark_summary([], HotPixels.none(2, 25)).light).all()
