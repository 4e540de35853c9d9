"""Pictures developed from raw images, scenes rendered in memory, and ground truths from files and data sets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from evaluation.experiments.paper.material import (
    develop_image,
    develop_sources,
    lights_at_random,
    lights_like,
    read_truths,
    render_scenes,
)
from evaluation.scene import SceneSet
from foundation.colorimetry import decode_srgb, srgb_codes
from foundation.errors import InputError
from generator import DatasetOptions, generate_dataset
from generator.lights.choices import nearest_lights
from generator.lights.lighting import RandomLights
from generator.pictures.random_scenes import random_scenes
from generator.rendering.matrices import camera_matrix
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker
from tests.evaluation.made_scenes import Made


@pytest.mark.parametrize("camera", ["Canon EOS 550D", "Canon EOS-1Ds Mark III", "Canon EOS 600D"])
def test_development_inverts_rendering(camera: str) -> None:
    matrix = camera_matrix(camera)
    assert matrix is not None
    rng = np.random.default_rng(7)
    codes = rng.integers(20, 256, (30, 40, 3), dtype=np.uint8)
    codes[:4] = 255  # more than one in a hundred pixels are white, so white is where it was
    light = np.array([0.5, 1.0, 0.7]) * 3000
    raw = decode_srgb(codes / 255) @ matrix.rows.T * light
    assert np.abs(develop_image(raw, light * 17, matrix=matrix).astype(int) - codes).max() <= 1
    assert np.abs(develop_image(raw, light, matrix=None).astype(int) - codes).max() > 10
    # The wrong light leaves a cast.
    assert np.abs(develop_image(raw, light[::-1].copy(), matrix=matrix).astype(int) - codes).max() > 10


def test_clips_one_percent() -> None:
    wedge = np.linspace(0, 1, 10000).reshape(100, 100, 1) * np.array([0.3, 1.0, 0.4])
    picture = develop_image(wedge, np.array([0.3, 1.0, 0.4]))
    assert 0.01 <= (picture == 255).all(axis=2).mean() < 0.015
    # A masked highlight does not darken the picture.
    bright = wedge.copy()
    bright[:50] *= 40
    mask = np.zeros((100, 100), np.bool_)
    mask[:50] = True
    alone = develop_image(bright[50:], np.array([0.3, 1.0, 0.4]))
    np.testing.assert_array_equal(develop_image(bright, np.array([0.3, 1.0, 0.4]), mask)[50:], alone)
    assert develop_image(bright, np.array([0.3, 1.0, 0.4]))[50:].max() < 128


def test_clipped_sky_is_white() -> None:
    light = np.array([0.5, 1.0, 0.7])
    image = np.full((20, 20, 3), 200.0) * light
    image[:10] = 1000.0  # all channels at saturation: under this light as red and blue as no sky is
    pink, white = (develop_image(image, light, saturation=level)[0, 0].tolist() for level in (None, 1000.0))
    assert pink == srgb_codes([1, 0.5, 0.5 / 0.7]).tolist()
    assert white == [255, 255, 255]
    np.testing.assert_array_equal(develop_image(image, light, saturation=5000.0), develop_image(image, light))


def test_masked_chart_is_black() -> None:
    mask = np.zeros((8, 8), np.bool_)
    mask[:3, :3] = True
    scene = Made("photo", np.array([1.0, 1.0, 1.0]), np.full((8, 8, 3), 500.0), None, mask)
    (source,) = develop_sources(SceneSet("made up", "none", "here", (scene,)), camera_matrix("EOS 550D"))
    picture = source.read().picture
    assert not picture[mask].any()
    assert (picture[~mask] == 255).all()
    assert source.name == "photo"
    assert source.to_json() == {"developed": "photo", "matrix": "Canon EOS 550D"}


SOURCES = random_scenes(6, 40, 30, seed=3)
TRUTHS = np.array([[2.0, 3.1, 1.0], [0.3, 0.7, 1.0], [1.5, 3.0, 2.4]])
PLAIN = DatasetOptions(previews=False, rendering="codes")


@pytest.mark.slow
def test_random_illuminants_match_generate(make_table: TableMaker, tmp_path: Path) -> None:
    lut = make_table("Test", noise=0.05)
    scenes = render_scenes(lut, SOURCES, lights_at_random(lut, 6, seed=9), seed=9)
    dataset = generate_dataset(lut, tmp_path / "made", SOURCES, RandomLights(1, len(LIGHTS), 9), seed=9, options=PLAIN)
    assert len({scene.light for scene in scenes}) > 1
    for scene, entry in zip(scenes, dataset.entries, strict=True):
        np.testing.assert_array_equal(scene.read()[0], dataset.read_image(entry))
        np.testing.assert_allclose(scene.truth, entry.truth, atol=1e-9)
        assert Path(entry.image).stem == scene.name
        assert scene.saturation == 9000


@pytest.mark.slow
def test_nearest_illuminants_match_generate(make_table: TableMaker, tmp_path: Path) -> None:
    lut = make_table("Test", noise=0.05)
    nearest = lights_like(lut, TRUTHS, 6)
    assert nearest.numbers == (0, 3, 1, 0, 3, 1)
    assert nearest.how.startswith("nearest by angle to 3 ground truths, 3 different illuminants")
    # The angles are those of the lights that images have.
    few = lights_like(lut, TRUTHS, 1).how
    assert few.startswith("nearest by angle to the first 1 of 3 ground truths, 1 different illuminants")
    assert few.split("median angle")[1] == lights_like(lut, TRUTHS[:1], 1).how.split("median angle")[1]
    scenes = render_scenes(lut, SOURCES, nearest, seed=2)
    lights = nearest_lights(lut, TRUTHS)
    dataset = generate_dataset(lut, tmp_path / "made", SOURCES, lights, seed=2, options=PLAIN)
    for scene, entry in zip(scenes, dataset.entries, strict=True):
        np.testing.assert_array_equal(scene.read()[0], dataset.read_image(entry))


TEXT = "File,GT_R,GT_G,GT_B\nA/1.png,1,2,3\nB/1.png,4,5,6\n\nA/2.png,7,8,9\n"


def test_selects_rows_by_prefix(tmp_path: Path) -> None:
    path = tmp_path / "eight.csv"
    path.write_text(TEXT)
    everything = read_truths(str(path))
    assert everything.name == "eight"
    assert everything.lights.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    truths = read_truths(f"{path}#A/")
    assert truths.name == "A"
    assert truths.lights.tolist() == [[1, 2, 3], [7, 8, 9]]
    assert truths.images == ("A/1.png", "A/2.png")
    assert everything.images == ("A/1.png", "B/1.png", "A/2.png")
    with pytest.raises(InputError, match=r"'C'.*'A/1.png'"):
        read_truths(f"{path}#C")
