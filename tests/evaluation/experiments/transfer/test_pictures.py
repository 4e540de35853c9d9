"""Source pictures are found by name and hash, wherever they lie, and never mistaken."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets.generated import GeneratedScene
from evaluation.experiments.transfer.plan import find_sources
from foundation.errors import FormatError, InputError
from generator.dataset.making import DatasetOptions, generate_dataset
from generator.dataset.reader import Dataset
from generator.pictures.sources import random_scenes
from tests.evaluation.experiments.transfer.conftest import Maker, save_pictures


def _dataset(maker: Maker) -> Dataset:
    scene = maker.make().scenes[0]
    assert isinstance(scene, GeneratedScene)
    return scene.dataset


def test_found_under_another_name_by_its_content(maker: Maker, tmp_path: Path) -> None:
    dataset = _dataset(maker)
    other = tmp_path / "other"
    (other / "deep").mkdir(parents=True)
    shutil.copy(maker.pictures / "a.png", other / "deep" / "renamed.png")
    # The names of the two are exchanged: content decides.
    shutil.copy(maker.pictures / "b.png", other / "c.png")
    shutil.copy(maker.pictures / "c.png", other / "b.png")
    found, missing = find_sources(dataset, other)
    assert not missing
    assert {name: picture.path for name, picture in found.items()} == {
        "a.png": other / "deep" / "renamed.png",
        "b.png": other / "c.png",
        "c.png": other / "b.png",
    }
    np.testing.assert_array_equal(found["b.png"].codes(), find_sources(dataset, maker.pictures)[0]["b.png"].codes())


def test_another_picture_of_that_name_is_missing(maker: Maker, tmp_path: Path) -> None:
    dataset = _dataset(maker)
    other = tmp_path / "other"
    save_pictures(other, ["a.png"], seed=9)
    shutil.copy(maker.pictures / "c.png", other / "c.png")
    found, missing = find_sources(dataset, other)
    assert missing == ("a.png", "b.png")
    assert list(found) == ["c.png"]


def test_random_colours_are_made_again(maker: Maker) -> None:
    place = maker.folder / "random"
    scenes = random_scenes(2, 7, 5, seed=4)
    made = generate_dataset(maker.lut, place, scenes, [0], seed=4, options=DatasetOptions(previews=False))
    found, missing = find_sources(made, maker.pictures)
    assert not missing
    np.testing.assert_array_equal(found["random-000001"].codes(), scenes[1].read().picture)


def test_what_cannot_be_found_is_said(maker: Maker) -> None:
    dataset = _dataset(maker)
    with pytest.raises(InputError, match=r"there is no .*nowhere"):
        find_sources(dataset, maker.folder / "nowhere")
    with pytest.raises(InputError, match="copy the pictures"):
        find_sources(dataset, "s3://bucket/pictures")
    found, _ = find_sources(dataset, maker.pictures)
    save_pictures(maker.pictures, ["a.png"], side=32)
    with pytest.raises(FormatError, match="32x32 px where images of it are 24x24"):
        found["a.png"].codes()
