"""Dark frames, the lamp's drift and the sum of the primaries, from made-up counts whose truth is known."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt
import pytest

from acquisition.lights.illuminations import Illumination
from acquisition.session.folder import FrameRecord
from calibration.radiometry.darkness import DarkFigures, HotSamples, additivity, darkness, drift_gains, read_dark
from drivers.presenter import Colour

PRIMARIES = ((255, 0, 0), (0, 255, 0), (0, 0, 255))


def samples(count: int, level: tuple[float, float, float], seed: int) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).normal(level, 6.0, (count, 25, 3)).astype(np.float32)


def dark_frame(
    number: int, cells: npt.NDArray[np.float32], paper: npt.NDArray[np.float32], shape: npt.NDArray[np.float64]
) -> tuple[DarkFigures, npt.NDArray[np.int16]]:
    at = datetime(2024, 3, 1, 9, number, tzinfo=UTC)
    record = FrameRecord("dark", None, f"{number}.dng", "00", at, 0.5, "accepted")
    return read_dark(record, np.full((2, 2), 2048.0 + number), cells, paper, shape)


def test_leak_and_hot_photosites_are_read() -> None:
    shape = np.random.default_rng(1).uniform(0.8, 1.2, (400, 1)) * np.ones(3)
    hot, frames = HotSamples(2000, 25), list[DarkFigures]()
    for number in range(3):
        cells, paper = samples(2000, (1, 2, 1), 10 + number), samples(400, (0, 0, 0), 20 + number)
        paper += (shape[:, None] * (4, 7, 5)).astype(np.float32)
        cells[17, 3, 1] += 200
        cells[99 + number, 5, 0] += 900
        figures, aside = dark_frame(number, cells, paper, shape)
        frames.append(DarkFigures.recall(figures.record, figures.told()))
        hot.add(aside)
    dark = darkness(frames, hot)
    assert dark.light == pytest.approx([4, 7, 5], abs=4 * 6 / np.sqrt(400 * 25))
    assert (dark.error < 0.1).all()
    assert dark.noise == pytest.approx(6, rel=0.06)
    assert np.flatnonzero(dark.hottest).tolist() == [17]
    assert dark.hottest[17] == pytest.approx(200, abs=20)
    assert len(dark.blacks) == 3


def test_a_hot_photosite_is_remembered_over_a_bump() -> None:
    """Before it, cell 3 lies on the photosite; after it, cell 4; a cosmic ray in one frame of a stretch is none."""
    hot, noise = HotSamples(10, 25), np.full(3, 6.0)
    none = np.zeros((10, 25, 3), dtype=np.int16)
    for number in range(4):
        if number == 2:
            hot.move(noise)
        aside = none.copy()
        aside[3 if number < 2 else 4, 12, 0] = 150
        aside[number, 1, 1] += 800
        hot.add(aside)
    copy = HotSamples(10, 25)
    copy.restore(hot.state())
    for one in (hot, copy):
        assert np.flatnonzero(one.hottest(noise)).tolist() == [3, 4]


def test_a_stretch_without_dark_frames_has_nothing_hot() -> None:
    hot = HotSamples(4, 25)
    assert not hot.hottest(np.full(3, np.nan)).any()
    hot.move(np.full(3, np.nan))
    assert not hot.hottest(np.full(3, 6.0)).any()


def test_without_dark_frames_nothing_is_known() -> None:
    assert np.isnan(darkness([], HotSamples(2, 25)).light).all()


def lights(codes: tuple[tuple[int, int, int], ...]) -> list[Illumination]:
    return [Illumination(number, "uniform", None, Colour(*code)) for number, code in enumerate(codes)]


def test_light_adds_but_for_the_black_that_each_brings_along() -> None:
    black, parts = np.array([3.0, 5.0, 4.0]), np.array([[3000.0, 700, 90], [400, 6000, 500], [80, 900, 4000]])
    white = black + parts.sum(axis=0)
    even = np.ones((3, 3))
    found = additivity(lights(PRIMARIES), parts + black, white, black, even)
    assert found == pytest.approx(np.zeros(3), abs=1e-9)
    boosted = additivity(lights(PRIMARIES), parts + black, 1.25 * white, black, even)
    assert boosted == pytest.approx(np.full(3, -0.2), abs=1e-3)
    dimmed = additivity(lights(PRIMARIES), 0.9 * (parts + black), white, black, 0.9 * even)
    assert dimmed == pytest.approx(np.zeros(3), abs=1e-9)


def test_a_missing_primary_leaves_it_untold() -> None:
    assert additivity(lights(PRIMARIES[:2]), np.ones((2, 3)), np.ones(3), np.zeros(3), np.ones((2, 3))) is None
    assert additivity(lights(PRIMARIES), np.ones((3, 3)), None, np.zeros(3), np.ones((3, 3))) is None


def test_the_drift_is_linear_between_white_frames() -> None:
    gains = drift_gains(
        np.array([0.0, 5, 10, 15, 30]), np.array([0.0, 10, 20]), np.array([[8.0, 4, 2], [4, 4, 2], [4, 4, 1]])
    )
    assert gains[:, 0].tolist() == [1, 0.75, 0.5, 0.5, 0.5]
    assert gains[:, 2].tolist() == [1, 1, 1, 0.75, 0.5]
    assert (drift_gains(np.arange(3.0), np.array([1.0]), np.ones((1, 3))) == 1).all()
