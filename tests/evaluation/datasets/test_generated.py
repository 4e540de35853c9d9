"""Datasets made by `generate` keep the contract in every layout, under one light and several, and in a store."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from fsspec.core import url_to_fs

from calibration.table.lut import open_lut
from evaluation.datasets import open_scenes
from evaluation.scene import MixedScene
from generator.dataset.making import DatasetOptions, generate_dataset
from generator.dataset.records import Layout
from generator.lights.choices import ListedLights, SimultaneousLights
from generator.masks.making import parse_masks
from generator.pictures.sources import random_scenes
from tests.evaluation.datasets import contract

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("layout", get_args(Layout))
@pytest.mark.parametrize("together", [1, 2])
def test_every_layout(made_lut: Path, tmp_path: Path, layout: Layout, together: int) -> None:
    listed = ListedLights((0, 1))
    lights = listed if together == 1 else SimultaneousLights(listed, together, parse_masks("half-plane", together, 5))
    options = DatasetOptions(previews=False, layout=layout)
    generate_dataset(open_lut(made_lut), tmp_path / "made", random_scenes(2, 24, 20), lights, options=options)
    data = open_scenes(tmp_path / "made")
    assert data.layout == "generated"
    contract.check(data)
    assert len(data.scenes) == (4 if together == 1 else 2)
    for scene in data.scenes:
        assert isinstance(scene, MixedScene) == (together == 2)
        assert scene.saturation == 9000
    if together == 2:
        store, top = url_to_fs(f"memory://mixed-{layout}/set")
        for path in (tmp_path / "made").rglob("*"):
            if path.is_file():
                store.pipe_file(f"{top}/{path.relative_to(tmp_path / 'made').as_posix()}", path.read_bytes())
        away = open_scenes(f"memory://mixed-{layout}/set")
        for here, there in zip(data.scenes, away.scenes, strict=True):
            assert isinstance(here, MixedScene)
            assert isinstance(there, MixedScene)
            np.testing.assert_array_equal(here.read_truth_map(), there.read_truth_map())
            np.testing.assert_array_equal(here.read()[0], there.read()[0])
