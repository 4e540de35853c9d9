"""Hot photosites in a table."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.experiments.paper.table1 import (
    HotPhotosites,
    HotScene,
    hot_photosites,
    hot_rows,
    hot_table,
    settings,
    table1,
)
from foundation.errors import InputError
from generator.pictures.sources import random_scenes
from tests.evaluation.experiments.paper.conftest import TableMaker

PICTURES = random_scenes(4, 24, 16, seed=8)
TRUTHS = np.array([[2.0, 3.1, 1.0], [0.3, 0.7, 1.0]])


def test_values_are_raised_and_cut(make_table: TableMaker) -> None:
    del make_table
    samples = np.array([[[10, 20, 30], [40, 50, 60]]], np.uint16)
    hot = HotPhotosites(np.array([0, 5]), np.array([7.4, 1e5]))
    np.testing.assert_array_equal(hot.raise_in(samples, 100), [[[17, 20, 30], [40, 50, 99]]])
    np.testing.assert_array_equal(samples, [[[10, 20, 30], [40, 50, 60]]])


def test_their_number_and_places(make_table: TableMaker) -> None:
    lut = make_table("Test")
    values = 512 * 25 * 3
    hot = hot_photosites(lut, 1000, seed=4)
    assert len(hot.places) == len(set(hot.places.tolist())) == round(values / 1000)
    assert hot.places.max() < values
    assert hot.signals.max() < 9000
    np.testing.assert_array_equal(hot.places, hot_photosites(lut, 1000, seed=4).places)
    assert set(hot.places.tolist()) != set(hot_photosites(lut, 1000, seed=5).places.tolist())
    # More of them are the same ones and others.
    assert set(hot.places.tolist()) < set(hot_photosites(lut, 2000, seed=4).places.tolist())


def test_without_any_a_scene_is_itself(make_table: TableMaker) -> None:
    lut = make_table("Test", noise=0.1)
    (part, *_) = settings([lut], PICTURES, TRUTHS, side=40)
    none = hot_photosites(lut, 0)
    for scene in part.scenes:
        np.testing.assert_array_equal(HotScene(scene, none).read()[0], scene.read()[0])
    (row, *_) = hot_rows([part], [0])
    (block,) = table1([part])
    np.testing.assert_array_equal(row.result.errors["recovery"], block.results[0].errors["recovery"])


def test_a_few_spoil_the_maximum(make_table: TableMaker) -> None:
    part = settings([make_table("Canon EOS 550D", noise=0.02)], PICTURES, TRUTHS, side=96)[2]
    rows = hot_rows([part], [0, 200])
    errors = [row.result.summary("reproduction").median for row in rows]
    assert errors[0] < 3
    assert errors[1] > 3 * errors[0]
    table = hot_table(rows, "reproduction")
    assert table.rows[1][:4] == (
        "Random scenes, 550D sensor, Given illuminations",
        200,
        8,
        rows[1].result.summary("reproduction").mean,
    )


@pytest.mark.parametrize("share", [-1, 2e6])
def test_a_share_of_all(make_table: TableMaker, share: float) -> None:
    with pytest.raises(InputError, match="expected 0 to a million"):
        hot_photosites(make_table("Test"), share)
