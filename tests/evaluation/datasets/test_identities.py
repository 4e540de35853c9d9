"""Images are known again without their pixels, and no others are taken for them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from evaluation.datasets.identity import identities, known_again
from evaluation.scene import Scene
from tests.evaluation.experiments.transfer.conftest import Maker, save_pictures, write_table
from tests.evaluation.made_up import Wall

WALL = Wall("Set/IMG_0001.png", np.array([2.0, 4.0, 1.0]))


def is_known(scene: Scene, *trained: Scene) -> bool:
    return known_again([scene], identities(trained)) == (scene.name,)


def test_a_name_and_a_light_make_an_image() -> None:
    assert is_known(WALL, WALL)
    assert is_known(replace(WALL, name="img_0001.tif", truth=WALL.truth / 7 * (1 + 1e-7)), WALL)
    # Cameras count from 1: a name alone says nothing.
    assert not is_known(replace(WALL, truth=np.array([2.0, 4.1, 1.0])), WALL)
    assert not is_known(replace(WALL, name="IMG_0002.png"), WALL)
    assert not is_known(WALL)


def test_a_generated_image_is_its_picture(tmp_path: Path) -> None:
    save_pictures(tmp_path / "pictures", ["a.png", "b.png"])
    save_pictures(tmp_path / "others", ["a.png", "b.png"], seed=1)
    maker = Maker(tmp_path, write_table(tmp_path / "lut"))
    made = maker.make("made").scenes
    # Every set counts its images from the same number, under the same lights.
    other = maker.make("other", pictures=tmp_path / "others").scenes
    again = maker.make("again", seed=3).scenes
    assert known_again(other, identities(made)) == ()
    assert known_again(again, identities(made)) == tuple(scene.name for scene in again)
    # A photograph and what was generated from it find each other, either way.
    photograph = replace(WALL, name="A.NEF")
    assert is_known(photograph, *made)
    assert len(known_again(made, identities([photograph]))) == len(made) // 2
    assert not is_known(replace(WALL, name="c.NEF"), *made)
