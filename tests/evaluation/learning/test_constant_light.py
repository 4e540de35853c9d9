"""Constant estimate: median of the training illuminants, and its errors on Cube+."""

from __future__ import annotations

import csv
import statistics
from pathlib import Path

import numpy as np
import pytest

from evaluation.learning.constant_light import ConstantLight, median_light
from evaluation.metrics import recovery_error, summarise
from tests.data_files import available
from tests.evaluation.experiments.transfer.worlds import world


def test_median_of_three_illuminants() -> None:
    # Chromaticities (0.5 0.25 0.25), (0.1 0.2 0.7), (0.2 0.6 0.2): medians 0.2 0.25 0.25.
    np.testing.assert_allclose(median_light([[2, 1, 1], [1, 2, 7], [20, 60, 20]]), np.array([4, 5, 5]) / 14)


def test_returns_median_for_every_image() -> None:
    scenes = world(9, seed=1)
    method = ConstantLight().fit(scenes)
    expected = median_light([scene.truth for scene in scenes])
    estimates = [method.estimate(np.full((2, 2, 3), value)) for value in (0.0, 1.0, np.inf)]
    for estimate in estimates:
        np.testing.assert_allclose(estimate, expected / np.linalg.norm(expected))


# Median and mean recovery error of the constant estimate on half of Cube+, computed independently (issue 15).
EXPECTED = {"cubeplus_gt_1707": (1.32, 5.39)}
FILES = available("gt/cubeplus_12_rows.csv", "gt/cubeplus_gt_1707.csv")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_errors_on_cube_plus(path: Path) -> None:
    rows = list(csv.DictReader(path.read_text().splitlines()))
    lights = np.array([[float(row[name]) for name in ("GT_R", "GT_G", "GT_B")] for row in rows])
    order, half = np.random.default_rng(0).permutation(len(lights)), len(lights) // 2
    train, test = lights[order[:half]], lights[order[half:]]
    shares = [[row[channel] / sum(row) for row in train.tolist()] for channel in range(3)]
    expected = [statistics.median(share) for share in shares]
    np.testing.assert_allclose(median_light(train), np.array(expected) / sum(expected))
    summary = summarise(recovery_error(np.tile(median_light(train), (len(test), 1)), test))
    errors = round(summary.median, 2), round(summary.mean, 2)
    assert errors == EXPECTED.get(path.stem, errors)
    assert summary.mean > 1.5 * summary.median
