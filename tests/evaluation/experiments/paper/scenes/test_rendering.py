"""Scenes in memory are those that `generate` writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.experiments.paper.material import ScaledSource, lights_at_random, lights_like, rendered
from foundation.errors import InputError
from generator import DatasetOptions, generate_dataset
from generator.lights.choices import RandomLights, nearest_lights
from generator.pictures.sources import random_scenes
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker

SOURCES = random_scenes(6, 40, 30, seed=3)
TRUTHS = np.array([[2.0, 3.1, 1.0], [0.3, 0.7, 1.0], [1.5, 3.0, 2.4]])
PLAIN = DatasetOptions(previews=False)


def test_random_lights_are_those_of_the_command(make_table: TableMaker, tmp_path: Path) -> None:
    lut = make_table("Test", noise=0.05)
    scenes = rendered(lut, SOURCES, lights_at_random(lut, 6, seed=9), seed=9)
    made = generate_dataset(lut, tmp_path / "made", SOURCES, RandomLights(1, len(LIGHTS), 9), seed=9, options=PLAIN)
    assert len({scene.light for scene in scenes}) > 1
    for scene, entry in zip(scenes, made.entries, strict=True):
        np.testing.assert_array_equal(scene.read()[0], made.read_image(entry))
        np.testing.assert_allclose(scene.truth, entry.truth, atol=1e-9)
        assert Path(entry.image).stem == scene.name
        assert scene.saturation == 9000


def test_near_lights_are_those_of_the_command(make_table: TableMaker, tmp_path: Path) -> None:
    lut = make_table("Test", noise=0.05)
    chosen = lights_like(lut, TRUTHS, 6)
    assert chosen.numbers == (0, 3, 1, 0, 3, 1)
    assert chosen.how.startswith("nearest by angle to 3 ground truths, 3 different lights")
    # The angles are those of the lights that images have.
    few = lights_like(lut, TRUTHS, 1).how
    assert few.startswith("nearest by angle to the first 1 of 3 ground truths, 1 different lights")
    assert few.split("angle to them")[1] == lights_like(lut, TRUTHS[:1], 1).how.split("angle to them")[1]
    scenes = rendered(lut, SOURCES, chosen, seed=2)
    lights = nearest_lights(lut, TRUTHS)
    made = generate_dataset(lut, tmp_path / "made", SOURCES, lights, seed=2, options=PLAIN)
    for scene, entry in zip(scenes, made.entries, strict=True):
        np.testing.assert_array_equal(scene.read()[0], made.read_image(entry))


def test_pictures_are_scaled_both_ways() -> None:
    (scene, *_) = SOURCES
    small, large = ScaledSource(scene, 20), ScaledSource(scene, 80)
    assert small.read().picture.shape == (15, 20, 3)
    assert large.read().picture.shape == (60, 80, 3)
    assert small.name == scene.name
    assert large.to_json() == {**scene.to_json(), "side": 80}
    np.testing.assert_array_equal(ScaledSource(scene, 40).read().picture, scene.read().picture)


def test_every_picture_needs_a_light(make_table: TableMaker) -> None:
    lut = make_table("Test")
    with pytest.raises(InputError, match="6 pictures have 5 lights"):
        rendered(lut, SOURCES, lights_at_random(lut, 5, seed=0))
