"""Recognise images without decoding them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets import open_scenes
from evaluation.datasets.identity import find_training_images, first_copies, identities
from evaluation.experiments.folds import draw_scene_folds
from evaluation.scene import Scene
from tests.evaluation.experiments.transfer.conftest import Maker, save_pictures, write_table
from tests.evaluation.made_up import Wall

WALL = Wall("Set/IMG_0001.png", np.array([2.0, 4.0, 1.0]))


def is_recognised(scene: Scene, *trained: Scene) -> bool:
    return find_training_images([scene], identities(trained)) == (scene.name,)


def test_recognises_name_with_ground_truth() -> None:
    assert is_recognised(WALL, WALL)
    assert is_recognised(replace(WALL, name="img_0001.tif", truth=WALL.truth / 7 * (1 + 1e-7)), WALL)
    # All cameras number files from 1, so a name alone is not sufficient.
    assert not is_recognised(replace(WALL, truth=np.array([2.0, 4.1, 1.0])), WALL)
    assert not is_recognised(replace(WALL, name="IMG_0002.png"), WALL)
    assert not is_recognised(WALL)


@pytest.mark.slow
def test_recognises_generated_image_by_source_picture(tmp_path: Path) -> None:
    save_pictures(tmp_path / "pictures", ["a.png", "b.png"])
    save_pictures(tmp_path / "others", ["a.png", "b.png"], seed=1)
    maker = Maker(tmp_path, write_table(tmp_path / "lut"))
    scenes = maker.make("made").scenes
    # All sets number their images from the same number and have the same illuminants.
    other_scenes = maker.make("other", pictures=tmp_path / "others").scenes
    scenes_again = maker.make("again", seed=3).scenes
    assert find_training_images(other_scenes, identities(scenes)) == ()
    assert find_training_images(scenes_again, identities(scenes)) == tuple(scene.name for scene in scenes_again)
    # A photograph and an image generated from it recognise each other.
    photograph = replace(WALL, name="A.NEF")
    assert is_recognised(photograph, *scenes)
    assert len(find_training_images(scenes, identities([photograph]))) == len(scenes) // 2
    assert not is_recognised(replace(WALL, name="c.NEF"), *scenes)


def test_detects_copies_among_thumbnails_and_files(tmp_path: Path) -> None:
    images = np.random.default_rng(0).random((4, 4, 5, 3), np.float32)
    images[2] = images[0]
    np.savez(tmp_path / "one.npz", images=images, gt=np.ones((4, 3)), names=np.array(list("abcd")))
    assert first_copies(open_scenes(tmp_path / "one.npz").scenes) == [0, 1, 0, 3]
    folder = tmp_path / "files"
    folder.mkdir()
    for name, image in zip("abcd", images, strict=True):
        np.save(folder / f"{name}.npy", image)
    (folder / "gt.csv").write_text("image,r,g,b\n" + "".join(f"{name},1,1,1\n" for name in "abcd"))
    assert first_copies(open_scenes(folder).scenes) == [0, 1, 0, 3]
    folds = [draw_scene_folds(open_scenes(folder).scenes, 3, seed) for seed in range(20)]
    assert all(fold[0] == fold[2] for fold in folds)
    assert any(fold[0] != fold[1] for fold in folds)
