"""Generated data sets fulfil the contract in every layout, with one illuminant or several, and in a store."""

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


def test_reports_methods_within_ground_truth_uncertainty(
    made_lut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    generate_dataset(open_lut(made_lut), tmp_path / "made", random_scenes(3, 24, 20), [0, 1])
    assert open_scenes(tmp_path / "made").truth_uncertainty_deg is None
    command = ("run", str(tmp_path / "made"), "--method", "gray-world", "--method", "gray-edge-1")
    description = json.loads((tmp_path / "made" / "dataset.json").read_text())
    for uncertainty, out, is_reported in ((1e-9, (), False), (170.0, ("--out", str(tmp_path / "out")), True)):
        for light in description["lights"]:
            light["uncertainty_deg"] = uncertainty
        (tmp_path / "made" / "dataset.json").write_text(json.dumps(description))
        assert open_scenes(tmp_path / "made").truth_uncertainty_deg == uncertainty
        assert main((*command, *out)) == 0
        printed = capsys.readouterr().out
        assert ("medians of Gray-world and 1st-order Gray-Edge differ" in printed) is is_reported
        assert f"largest uncertainty {uncertainty:.2g}°" in printed
    # If it is unknown for one illuminant, it is unknown for the data set.
    del description["lights"][0]["uncertainty_deg"]
    (tmp_path / "made" / "dataset.json").write_text(json.dumps(description))
    assert open_scenes(tmp_path / "made").truth_uncertainty_deg is None


@pytest.mark.parametrize("layout", get_args(Layout))
@pytest.mark.parametrize("light_count", [1, 2])
def test_opens_every_layout(made_lut: Path, tmp_path: Path, layout: Layout, light_count: int) -> None:
    listed_lights = ListedLights((0, 1))
    masks = parse_masks("half-plane", 2, 5)
    lights = listed_lights if light_count == 1 else SimultaneousLights(listed_lights, 2, masks)
    options = DatasetOptions(previews=False, layout=layout)
    generate_dataset(open_lut(made_lut), tmp_path / "made", random_scenes(2, 24, 20), lights, options=options)
    data = open_scenes(tmp_path / "made")
    assert data.layout == "generated"
    contract.check(data)
    assert len(data.scenes) == (4 if light_count == 1 else 2)
    for scene in data.scenes:
        assert isinstance(scene, MixedScene) == (light_count == 2)
        assert scene.saturation == 9000
    if light_count == 2:
        store, top = url_to_fs(f"memory://mixed-{layout}/set")
        for path in (tmp_path / "made").rglob("*"):
            if path.is_file():
                store.pipe_file(f"{top}/{path.relative_to(tmp_path / 'made').as_posix()}", path.read_bytes())
        stored = open_scenes(f"memory://mixed-{layout}/set")
        for local, remote in zip(data.scenes, stored.scenes, strict=True):
            assert isinstance(local, MixedScene)
            assert isinstance(remote, MixedScene)
            np.testing.assert_array_equal(local.read_truth_map(), remote.read_truth_map())
            np.testing.assert_array_equal(local.read()[0], remote.read()[0])


@pytest.mark.parametrize("layout", get_args(Layout))
def test_subsets_share_no_source_picture(made_lut: Path, tmp_path: Path, layout: Layout) -> None:
    options = DatasetOptions(previews=False, layout=layout, split=(0.5, 0, 0.5))
    generate_dataset(open_lut(made_lut), tmp_path / "made", random_scenes(6, 24, 20), [0, 1], options=options)
    subsets = {
        subset: open_scenes(tmp_path / "made", options=DataOptions(subset=subset)) for subset in ("train", "test")
    }
    assert [data.name for data in subsets.values()] == ["made train", "made test"]
    pictures = {subset: {group_of(scene) for scene in data.scenes} for subset, data in subsets.items()}
    assert all(len(names) == 3 for names in pictures.values())
    assert not pictures["train"] & pictures["test"]
    complete = open_scenes(tmp_path / "made")
    assert sum(len(data.scenes) for data in subsets.values()) == len(complete.scenes) == 12
    assert subsets["train"].scenes[0].read()[0].shape == (20, 24, 3)
    with pytest.raises(InputError, match=r"'validation'.*train, test"):
        open_scenes(tmp_path / "made", options=DataOptions(subset="validation"))
