"""Datasets made by `generate` keep the contract in every layout, under one light and several, and in a store."""

from __future__ import annotations

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from fsspec.core import url_to_fs

from calibration.table.lut import open_lut
from evaluation.cli import main
from evaluation.datasets import open_scenes
from evaluation.datasets.options import DataOptions
from evaluation.experiments.folds import group_of
from evaluation.scene import MixedScene
from foundation.errors import InputError
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.records import Layout
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import random_scenes
from tests.evaluation.datasets import contract

pytestmark = pytest.mark.slow


def test_methods_that_ground_truths_do_not_tell_apart_are_named(
    made_lut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generate_dataset(open_lut(made_lut), tmp_path / "made", random_scenes(3, 24, 20), [0, 1])
    assert open_scenes(tmp_path / "made").truth_uncertainty_deg is None
    wish = ("run", str(tmp_path / "made"), "--method", "gray-world", "--method", "gray-edge-1")
    described = json.loads((tmp_path / "made" / "dataset.json").read_text())
    for uncertainty, out, said in ((1e-9, (), False), (170.0, ("--out", str(tmp_path / "out")), True)):
        for light in described["lights"]:
            light["uncertainty_deg"] = uncertainty
        (tmp_path / "made" / "dataset.json").write_text(json.dumps(described))
        assert open_scenes(tmp_path / "made").truth_uncertainty_deg == uncertainty
        assert main((*wish, *out)) == 0
        printed = capsys.readouterr().out
        assert ("medians of Gray-world and 1st-order Gray-Edge differ by less than" in printed) is said
        assert f"is known to {uncertainty:.2g} degrees" in printed
    # One light of which it is not stated, and nothing is said of any.
    del described["lights"][0]["uncertainty_deg"]
    (tmp_path / "made" / "dataset.json").write_text(json.dumps(described))
    assert open_scenes(tmp_path / "made").truth_uncertainty_deg is None


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


@pytest.mark.parametrize("layout", get_args(Layout))
def test_parts_are_those_of_generate_and_share_no_picture(made_lut: Path, tmp_path: Path, layout: Layout) -> None:
    options = DatasetOptions(previews=False, layout=layout, split=(0.5, 0, 0.5))
    generate_dataset(open_lut(made_lut), tmp_path / "made", random_scenes(6, 24, 20), [0, 1], options=options)
    parts = {part: open_scenes(tmp_path / "made", options=DataOptions(subset=part)) for part in ("train", "test")}
    assert [data.name for data in parts.values()] == ["made train", "made test"]
    pictures = {part: {group_of(scene) for scene in data.scenes} for part, data in parts.items()}
    assert all(len(own) == 3 for own in pictures.values())
    assert not pictures["train"] & pictures["test"]
    whole = open_scenes(tmp_path / "made")
    assert sum(len(data.scenes) for data in parts.values()) == len(whole.scenes) == 12
    assert parts["train"].scenes[0].read()[0].shape == (20, 24, 3)
    with pytest.raises(InputError, match=r"'validation'.*train, test"):
        open_scenes(tmp_path / "made", options=DataOptions(subset="validation"))
