"""Uncertainty of positions from the outline of a chart without tags."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from calibration.registration.matching import (
    unfollowed_wave_sigma_px,
)
from calibration.registration.tiles import Raster, TileComparison
from experiment.chart.layout import paper_chart

WIDTH, HEIGHT, REACH = 200.0, 100.0, 20.0


def outline(step: float = 1.0) -> npt.NDArray[np.float64]:
    x, y = np.arange(0, WIDTH + step, step), np.arange(0, HEIGHT + step, step)
    sides = [(x, 0 * x), (x, 0 * x + HEIGHT), (0 * y, y), (0 * y + WIDTH, y)]
    return np.concatenate([np.stack(side, axis=-1) for side in sides])


def test_uncertainty_follows_outline_and_rises_near_waves() -> None:
    marks = outline()
    residual = np.full_like(marks, 0.01 / np.sqrt(2))
    is_wave = (marks[:, 1] == 0) & (np.abs(marks[:, 0] - 100) < 20)
    residual[is_wave] = 0.3 / np.sqrt(2)
    inside, wavy, elsewhere = unfollowed_wave_sigma_px(
        np.array([(100, 50), (100, 5), (30, 95.0)]), marks, residual, 5.0, REACH
    )
    outline_rms = np.sqrt((residual**2).sum(axis=1).mean())
    assert inside == elsewhere == pytest.approx(2 * outline_rms)
    assert wavy == pytest.approx(0.6)


def test_missing_corner_has_departure_from_plane() -> None:
    marks = outline()
    is_missing = (marks[:, 1] == 0) & (marks[:, 0] < 60)
    marks = marks[~is_missing]
    points = np.array([(5, 5), (30, 5), (55, 5), (30, 95), (150, 5), (100, 50.0)])
    uncertainty = unfollowed_wave_sigma_px(points, marks, np.full_like(marks, 0.01), 0.8, REACH)
    assert uncertainty == pytest.approx([0.8, 0.8, 0.02 * np.sqrt(2), 0.02 * np.sqrt(2), *[0.02 * np.sqrt(2)] * 2])


# 4096 patches without gaps, one tile each
CHART = paper_chart("A4", 4)
RASTER = Raster(
    CHART.centres_mm.min(axis=0) - np.array(CHART.cell_mm) / 2,
    np.array(CHART.cell_mm),
    (len(np.unique(CHART.centres_mm[:, 1].round(3))), len(np.unique(CHART.centres_mm[:, 0].round(3)))),
)


def compared(residual: npt.NDArray[np.float64], strength: float, seed: int = 1) -> TileComparison:
    """Return the comparison for residuals (rows, columns, 2) px, with random information of given strength."""
    rows, columns = RASTER.shape
    y, x = np.mgrid[:rows, :columns]
    points = RASTER.low_mm + (np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * RASTER.step_mm
    root = np.random.default_rng(seed).standard_normal((len(points), 2, 2)) + 2 * np.eye(2)
    information = strength * root @ root.swapaxes(1, 2)
    pull = np.einsum("nij,nj->ni", information, residual.reshape(-1, 2))
    score = np.linspace(0.5, 1.0, len(points))
    return TileComparison.of(
        points, information[None] / 3 * np.ones((3, 1, 1, 1)), pull[None] / 3 * np.ones((3, 1, 1)), score
    )
