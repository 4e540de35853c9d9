"""The constant light: the median of the training lights, and what it comes to on the real lights of Cube+."""

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


def test_the_median_by_hand() -> None:
    # Chromaticities (.5 .25 .25), (.1 .2 .7), (.2 .6 .2): medians .2 .25 .25.
    np.testing.assert_allclose(median_light([[2, 1, 1], [1, 2, 7], [20, 60, 20]]), np.array([4, 5, 5]) / 14)


def test_every_image_gets_it() -> None:
    scenes = world(9, seed=1)
    method = ConstantLight().fit(scenes)
    expected = median_light([scene.truth for scene in scenes])
    estimates = [method.estimate(np.full((2, 2, 3), value)) for value in (0.0, 1.0, np.inf)]
    for estimate in estimates:
        np.testing.assert_allclose(estimate, expected / np.linalg.norm(expected))


KNOWN = {"cubeplus_gt_1707": (1.32, 5.39)}
"""Median and mean recovery error of the constant light on a half of Cube+ by another's reckoning (issue 15)."""
FILES = available("gt/cubeplus_12_rows.csv", "gt/cubeplus_gt_1707.csv")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_on_cube_plus_a_single_statistic_misleads(path: Path) -> None:
    rows = list(csv.DictReader(path.read_text().splitlines()))
    lights = np.array([[float(row[name]) for name in ("GT_R", "GT_G", "GT_B")] for row in rows])
    order, half = np.random.default_rng(0).permutation(len(lights)), len(lights) // 2
    given, tested = lights[order[:half]], lights[order[half:]]
    shares = [[row[channel] / sum(row) for row in given.tolist()] for channel in range(3)]
    expected = [statistics.median(share) for share in shares]
    np.testing.assert_allclose(median_light(given), np.array(expected) / sum(expected))
    summary = summarise(recovery_error(np.tile(median_light(given), (len(tested), 1)), tested))
    found = round(summary.median, 2), round(summary.mean, 2)
    assert found == KNOWN.get(path.stem, found)
    assert summary.mean > 1.5 * summary.median
