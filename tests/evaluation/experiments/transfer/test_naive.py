"""The naive baseline: by hand on tiny pictures, and exact where the table is naive itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets.generated import GeneratedMixedScene, GeneratedScene, open_generated
from evaluation.experiments.transfer.plan import find_sources, naive_image, naive_scenes
from evaluation.scene import MixedScene
from foundation.errors import FormatError
from generator.lights.choices import ListedLights, SimultaneousLights
from generator.lights.lighting import mixture_of
from generator.masks.request import parse_masks
from generator.pictures.picture import Preparation
from generator.rendering.matrices import ColourMatrix
from tests.evaluation.experiments.transfer.conftest import BOTH, LIGHTS, Maker, save_pictures, write_table

MATRIX = np.array([[0.6, 0.3, 0.1], [0.1, 0.7, 0.2], [-0.2, 0.4, 0.8]])


def test_arithmetic_by_hand() -> None:
    # 188 is (188 / 255 + .055) / 1.055 to the 2.4 = .502886…, 10 is below the knee: 10 / 255 / 12.92 = .003035.
    codes = np.array([[[188, 10, 255]]], np.uint8)
    light = np.array([1000.0, 2000.0, 3000.0])
    np.testing.assert_array_equal(naive_image(codes, light, 5000), [[[503, 6, 3000]]])
    # .6 · .502886 + .3 · .003035 + .1 = .402642; .1 · .502886 + .7 · .003035 + .2 = .252413; the third .700637.
    np.testing.assert_array_equal(naive_image(codes, light, 5000, MATRIX), [[[403, 505, 2102]]])


def test_white_is_the_light_and_what_is_brighter_is_clipped() -> None:
    white = np.full((2, 2, 3), 255, np.uint8)
    light = np.array([1000.0, 2000.4, 500.0])
    for matrix in (None, MATRIX):
        np.testing.assert_array_equal(naive_image(white, light, 1900.9, matrix)[0, 0], [1000, 1900, 500])


def test_no_colour_is_darker_than_black() -> None:
    red = np.array([[[255, 0, 0]]], np.uint8)
    np.testing.assert_array_equal(naive_image(red, np.ones(3) * 1000, 5000, MATRIX), [[[600, 100, 0]]])


def _generated(maker_scenes: tuple[object, ...]) -> list[GeneratedScene]:
    return [scene for scene in maker_scenes if isinstance(scene, GeneratedScene)]


def test_a_table_that_is_naive_is_reproduced(maker: Maker) -> None:
    made = _generated(maker.make().scenes)
    found, missing = find_sources(made[0].dataset, maker.pictures)
    assert not missing
    naive = naive_scenes(made, found)
    assert [scene.name for scene in naive] == [scene.name for scene in made]
    for one, other in zip(naive, made, strict=True):
        np.testing.assert_array_equal(one.truth, other.truth)
        assert one.saturation == other.saturation
        np.testing.assert_allclose(one.read()[0].astype(int), other.read()[0].astype(int), atol=1)


def test_a_table_behind_a_matrix_is_reproduced_with_it_and_not_without(tmp_path: Path) -> None:
    save_pictures(tmp_path / "pictures", ["a.png"])
    made = _generated(Maker(tmp_path, write_table(tmp_path / "lut", MATRIX)).make().scenes)
    found, _ = find_sources(made[0].dataset, tmp_path / "pictures")
    (one, _), (plain, _) = (
        naive_scenes(made, found, matrix) for matrix in (ColourMatrix("mine", MATRIX, "test"), None)
    )
    image = made[0].read()[0].astype(int)
    np.testing.assert_allclose(one.read()[0].astype(int), image, atol=1)
    assert np.abs(plain.read()[0].astype(int) - image).max() > 500


def test_mixtures_and_masks_of_lights_are_reproduced(maker: Maker) -> None:
    mixed = mixture_of({0: 1, 1: 3})
    (single, *_) = _generated(maker.make("mixed", ListedLights((mixed,))).scenes)
    found, _ = find_sources(single.dataset, maker.pictures)
    (naive, *_) = naive_scenes([single], found)
    np.testing.assert_allclose(naive.whites, [LIGHTS[0] / 4 + LIGHTS[1] * 3 / 4], rtol=1e-6)
    # The mixed table rounds each of its samples once more.
    np.testing.assert_allclose(naive.read()[0].astype(int), single.read()[0].astype(int), atol=2)
    choice = SimultaneousLights(ListedLights((0, 1)), 2, parse_masks("half-plane:angle=30,width=.2", 2, 0))
    (two, *_) = _generated(maker.make("two", choice).scenes)
    assert isinstance(two, GeneratedMixedScene)
    found, _ = find_sources(two.dataset, maker.pictures)
    (naive, *_) = naive_scenes([two], found)
    image, expected = naive.read()[0].astype(int), two.read()[0].astype(int)
    np.testing.assert_allclose(image, expected, atol=2)
    whole = naive_image(found["a.png"].codes(), LIGHTS[0], two.saturation).astype(int)
    assert np.abs(whole - expected).max() > 500


@pytest.mark.parametrize(
    "preparation",
    [Preparation(max_side=12), Preparation(crop=(9, 7), crop_at="random", seed=3), Preparation(crop=(8, 8))],
)
def test_pictures_are_prepared_as_they_were(maker: Maker, preparation: Preparation) -> None:
    made = _generated(maker.make(preparation=preparation, seed=preparation.seed).scenes)
    found, _ = find_sources(made[0].dataset, maker.pictures)
    image = naive_scenes(made, found)[0].read()[0]
    assert image.shape == made[0].read()[0].shape
    if preparation.crop:
        np.testing.assert_allclose(image.astype(int), made[0].read()[0].astype(int), atol=1)


def test_every_crop_has_the_counterpart_of_its_own_place(maker: Maker) -> None:
    made = _generated(maker.make(preparation=Preparation(crop=(9, 7), crops=3)).scenes)
    found, _ = find_sources(made[0].dataset, maker.pictures)
    naive = [scene.read()[0].astype(int) for scene in naive_scenes(made, found)]
    for image, scene in zip(naive, made, strict=True):
        np.testing.assert_allclose(image, scene.read()[0].astype(int), atol=1)
    assert any(np.abs(image - naive[0]).max() > 500 for image in naive[2:6:2])


def test_scenes_of_another_dataset_are_cut_where_that_one_cut_them(maker: Maker) -> None:
    made = _generated(maker.make(preparation=Preparation(crop=(9, 7), crop_at="random", seed=3), seed=8).scenes)
    found, _ = find_sources(made[0].dataset, maker.pictures)
    for naive, scene in zip(naive_scenes(made, found), made, strict=True):
        np.testing.assert_allclose(naive.read()[0].astype(int), scene.read()[0].astype(int), atol=1)


def test_light_that_falls_off_with_a_tint_does_so_in_the_counterpart(maker: Maker) -> None:
    made = _generated(maker.make(gradient="soft-edge:width=.5,stops=2,least=2,colour=.4").scenes)
    found, _ = find_sources(made[0].dataset, maker.pictures)
    for naive, scene in zip(naive_scenes(made, found), made, strict=True):
        np.testing.assert_allclose(naive.read()[0].astype(int), scene.read()[0].astype(int), atol=2)


@pytest.mark.parametrize("lights", ["one", "two"])
@pytest.mark.parametrize("gradient", ["smooth:stops=3,least=2", "half-plane:angle=20,stops=2,least=2"])
def test_light_that_falls_off_without_a_tint_does_so_in_the_counterpart(
    maker: Maker, lights: str, gradient: str
) -> None:
    choice = BOTH
    if lights == "two":
        choice = SimultaneousLights(BOTH, 2, parse_masks("soft-edge:angle=70,width=.6", 2, 0))
    preparation = Preparation(crop=(16, 12), crops=2)
    made = _generated(maker.make(lights=choice, gradient=gradient, preparation=preparation, seed=0).scenes)
    found, _ = find_sources(made[0].dataset, maker.pictures)
    unlike: list[int] = []
    for naive, scene in zip(naive_scenes(made, found), made, strict=True):
        expected = scene.read()[0].astype(int)
        np.testing.assert_allclose(naive.read()[0].astype(int), expected, atol=3)
        weights = scene.dataset.read_weights(scene.entry) if lights == "two" else np.ones((12, 16, 1), np.float32)
        codes = naive.picture.codes(int(scene.dataset.details[scene.name]["crop"]))
        even = naive_image(codes, weights @ naive.whites, naive.saturation).astype(int)
        unlike.append(int(np.abs(even - expected).max()))
    assert min(unlike) > 500


def test_a_counterpart_under_several_lights_has_their_maps(maker: Maker) -> None:
    choice = SimultaneousLights(BOTH, 2, parse_masks("soft-edge:angle=70,width=.6", 2, 0))
    (made, *_) = _generated(maker.make(lights=choice).scenes)
    found, _ = find_sources(made.dataset, maker.pictures)
    (naive,) = naive_scenes([made], found)
    assert isinstance(naive, MixedScene)
    assert isinstance(made, GeneratedMixedScene)
    np.testing.assert_array_equal(naive.lights, made.lights)
    np.testing.assert_array_equal(naive.read_weights(), made.read_weights())
    light = naive.read_weights() @ naive.whites
    np.testing.assert_allclose(naive.read_truth_map(), light / light.sum(axis=2, keepdims=True), atol=1e-4)
    np.testing.assert_allclose(naive.truth, light.mean(axis=(0, 1)) / light.mean(axis=(0, 1)).sum(), atol=1e-4)
    (single, *_) = _generated(maker.make("single").scenes)
    (plain,) = naive_scenes([single], found)
    assert not isinstance(plain, MixedScene)


def test_a_gradient_that_is_described_as_none_is_named(maker: Maker) -> None:
    maker.make(gradient="smooth:stops=2")
    described = maker.folder / "made" / "dataset.json"
    record = json.loads(described.read_text())
    for wrong in ({"gradient": {"masks": "stripes"}}, ["gradient"]):
        record["options"]["variation"] = wrong
        described.write_text(json.dumps(record))
        (made, *_) = _generated(open_generated(maker.folder / "made").scenes)
        (naive,) = naive_scenes([made], find_sources(made.dataset, maker.pictures)[0])
        with pytest.raises(FormatError, match=r"describes its variation as .*; make it again"):
            naive.read()
