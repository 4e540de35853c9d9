"""Samples are the sensor's own counts at the right places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibration.report.plots import half_size
from calibration.sampling import gather, gather_values, sites_at, table_values
from tests.calibration.lab import Lab


def test_samples_are_pixels_of_the_half_size_picture(lab: Lab, tmp_path: Path) -> None:
    mosaic = lab.mosaic(tmp_path)
    black = np.array([[2048.25, 2047.5], [2049.0, 2048.0]])
    picture = half_size(mosaic, black)
    height, width = picture.shape[:2]
    places = np.random.default_rng(1).random((200, 2)) * (width - 1, height - 1)
    sites = sites_at(places, (height, width))
    samples, highest = gather(mosaic, black, sites)
    for patch, (x, y) in enumerate(places):
        column, row = round(float(x)), round(float(y))
        if not (2 <= column < width - 2 and 2 <= row < height - 2):
            assert not sites.inside[patch]
            assert not samples[patch].any()
            continue
        window = picture[row - 2 : row + 3, column - 2 : column + 3].reshape(25, 3)
        assert samples[patch] == pytest.approx(window, abs=2e-3)
        raw = mosaic.counts[2 * (row - 2) : 2 * (row + 3), 2 * (column - 2) : 2 * (column + 3)]
        assert highest[patch] == raw.max()


@given(st.floats(-10, 60), st.floats(-10, 60))
def test_a_patch_is_inside_when_all_its_pixels_are(x: float, y: float) -> None:
    sites = sites_at(np.array([[x, y]]), (40, 50))
    column, row = int(np.rint(x)), int(np.rint(y))
    assert bool(sites.inside[0]) == (column - 2 >= 0 and row - 2 >= 0 and column + 2 <= 49 and row + 2 <= 39)


def test_the_table_rounds_and_clips_at_zero() -> None:
    samples = np.array([[[-3.0, 0.4, 0.6]] * 25, [[100.0, 200.0, 300.0]] * 25], dtype=np.float32)
    values = table_values(samples, np.array([[1.0, 1.0, 1.0], [0.8, 1.0, 1.25]]))
    assert values.dtype == np.uint16
    assert values[0, 0].tolist() == [0, 0, 1]
    assert values[1, 0].tolist() == [125, 200, 240]


@pytest.mark.parametrize("window", [3, 5, 7])
def test_one_pass_and_two_give_the_same_values(lab: Lab, tmp_path: Path, window: int) -> None:
    mosaic = lab.mosaic(tmp_path)
    black = np.array([[2048.25, 2047.5], [2049.0, 2048.0]])
    random = np.random.default_rng(3)
    height, width = half_size(mosaic, black).shape[:2]
    sites = sites_at(random.random((300, 2)) * (width - 1, height - 1), (height, width), window)
    field, dark = random.uniform(0.7, 1.3, (300, 3)), random.uniform(0, 40, (300, 3)).astype(np.float32)
    samples, highest = gather(mosaic, black, sites)
    assert samples.shape == (300, window**2, 3)
    values, highest_too = gather_values(mosaic, black, sites, field, dark)
    inside = sites.inside
    assert np.array_equal(values[inside], table_values(samples, field, dark)[inside])
    assert not values[~inside].any()
    assert np.array_equal(highest, highest_too)
    # By NumPy alone, in double precision: equal but where a value lies on the edge between two counts.
    plain = np.rint((samples[inside].astype(np.float64) - dark[inside, None]) / field[inside, None])
    assert np.abs(values[inside] - np.clip(plain, 0, None)).max() <= 1
