"""Printed levels of grey and their tint."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

from calibration.measurements import GreyMeasurements
from calibration.pipeline.measuring import GreyLevels
from calibration.table.writing import references_csv
from experiment.chart.model import Reference

GREYS = [
    Reference(f"grey {code}", (code, code, code), (float(n), 0.0), (5.0, 5.0)) for n, code in enumerate([71, 188] * 20)
]


def test_level_mean_excludes_stained_patch() -> None:
    levels = GreyLevels.of(GREYS)
    assert levels.names == ("grey 188", "grey 71")
    random = np.random.default_rng(2)
    field = random.uniform(0.8, 1.2, (40, 3))
    true = np.where(levels.level[:, None] == 0, [4000.0, 5000, 3000], [500.0, 700, 400])
    means = field * (true + random.normal(0, 10, (40, 3)))
    means[1] *= 0.7
    means[4] = np.nan
    value, error = levels.read(means, field)
    assert value == pytest.approx(np.array([[4000, 5000, 3000], [500, 700, 400]]), abs=10)
    assert error == pytest.approx(np.full((2, 3), 10 / np.sqrt(20)), rel=0.5)


def test_level_without_patches_is_empty_in_file() -> None:
    levels = GreyLevels.of(GREYS)
    means = np.where(levels.level[:, None] == 1, np.nan, 100.0) * np.ones(3)
    value, error = levels.read(means, np.ones((40, 3)))
    text = references_csv(levels.names, np.full((1, 3), 200.0), np.ones((1, 3)), value[None], error[None])
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["name"] for row in rows] == ["white", "grey 188", "grey 71"]
    assert float(rows[1]["g"]) == 100
    assert rows[2]["g"] == ""


def test_neutral_grey_has_no_tint() -> None:
    white = np.array([[3000.0, 5000, 4000]])
    values = np.stack([0.3 * white[0], white[0] * [0.3, 0.3, 0.33]])[None]
    tint = GreyMeasurements(("neutral", "bluish"), values, np.zeros_like(values)).tints_deg(white)
    assert tint[0] == pytest.approx(0, abs=1e-6)
    assert 1 < tint[1] < 4
