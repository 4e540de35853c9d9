"""Plan of a transfer: exclusion of test images, the naive baseline, and identification of source pictures."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.datasets.generated import GeneratedMixedScene, GeneratedScene
from evaluation.datasets.thumbnails import Thumbnail
from evaluation.experiments.transfer.plan import (
    NaiveScene,
    find_source_pictures,
    naive_image,
    naive_scenes,
    plan_transfer,
    relit_scenes,
    shared_images,
    trainable_images,
)
from evaluation.scene import MixedScene, SceneSet
from foundation.errors import FormatError, InputError
from generator.dataset.making import generate_dataset
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights, mixture_of
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import Preparation
from generator.rendering.matrices import ColourMatrix
from tests.evaluation.experiments.transfer.conftest import BOTH, LIGHTS, Maker, save_pictures, write_table

pytestmark = pytest.mark.slow

MATRIX = np.array([[0.6, 0.3, 0.1], [0.1, 0.7, 0.2], [-0.2, 0.4, 0.8]])


def test_naive_image_matches_hand_calculation() -> None:
    # 188 is (188 / 255 + .055) / 1.055 to the 2.4 = .502886…, 10 is below the knee: 10 / 255 / 12.92 = .003035.
    codes = np.array([[[188, 10, 255]]], np.uint8)
    light = np.array([1000.0, 2000.0, 3000.0])
    np.testing.assert_array_equal(naive_image(codes, light, 5000), [[[503, 6, 3000]]])
    # .6 · .502886 + .3 · .003035 + .1 = .402642; .1 · .502886 + .7 · .003035 + .2 = .252413; the third .700637.
    np.testing.assert_array_equal(naive_image(codes, light, 5000, MATRIX), [[[403, 505, 2102]]])


def test_white_is_illuminant_and_clips() -> None:
    white = np.full((2, 2, 3), 255, np.uint8)
    light = np.array([1000.0, 2000.4, 500.0])
    for matrix in (None, MATRIX):
        np.testing.assert_array_equal(naive_image(white, light, 1900.9, matrix)[0, 0], [1000, 1900, 500])


def _generated(maker_scenes: tuple[object, ...]) -> list[GeneratedScene]:
    return [scene for scene in maker_scenes if isinstance(scene, GeneratedScene)]


def _counterparts(scenes: list[GeneratedScene], pictures: Path) -> tuple[NaiveScene, ...]:
    sources, missing = find_source_pictures(scenes[0].dataset, pictures)
    assert not missing
    return naive_scenes(scenes, sources)


def test_naive_table_is_reproduced(maker: Maker) -> None:
    scenes = _generated(maker.make().scenes)
    naive = _counterparts(scenes, maker.pictures)
    assert [scene.name for scene in naive] == [scene.name for scene in scenes]
    for generated, counterpart in zip(naive, scenes, strict=True):
        np.testing.assert_array_equal(generated.truth, counterpart.truth)
        assert generated.saturation == counterpart.saturation
        np.testing.assert_allclose(generated.read()[0].astype(int), counterpart.read()[0].astype(int), atol=1)


def test_matrix_table_needs_matrix(tmp_path: Path) -> None:
    save_pictures(tmp_path / "pictures", ["a.png"])
    scenes = _generated(Maker(tmp_path, write_table(tmp_path / "lut", MATRIX)).make().scenes)
    sources, _ = find_source_pictures(scenes[0].dataset, tmp_path / "pictures")
    (scene, _), (plain, _) = (
        naive_scenes(scenes, sources, matrix) for matrix in (ColourMatrix("mine", MATRIX, "test"), None)
    )
    image = scenes[0].read()[0].astype(int)
    np.testing.assert_allclose(scene.read()[0].astype(int), image, atol=1)
    assert np.abs(plain.read()[0].astype(int) - image).max() > 500


def test_mixtures_and_masks_are_reproduced(maker: Maker) -> None:
    mixed = mixture_of({0: 1, 1: 3})
    (single, *_) = _generated(maker.make("mixed", ListedLights((mixed,))).scenes)
    (naive,) = _counterparts([single], maker.pictures)
    np.testing.assert_allclose(naive.whites, [LIGHTS[0] / 4 + LIGHTS[1] * 3 / 4], rtol=1e-6)
    # The mixed table rounds each of its samples once more.
    np.testing.assert_allclose(naive.read()[0].astype(int), single.read()[0].astype(int), atol=2)
    choice = SimultaneousLights(ListedLights((0, 1)), 2, parse_masks("half-plane:angle=30,width=.2", 2, 0))
    (two, *_) = _generated(maker.make("two", choice).scenes)
    assert isinstance(two, GeneratedMixedScene)
    counterparts, _ = find_source_pictures(two.dataset, maker.pictures)
    (naive, *_) = naive_scenes([two], counterparts)
    image, expected = naive.read()[0].astype(int), two.read()[0].astype(int)
    np.testing.assert_allclose(image, expected, atol=2)
    counterpart = naive_image(counterparts["a.png"].codes(), LIGHTS[0], two.saturation).astype(int)
    assert np.abs(counterpart - expected).max() > 500


RANDOM_CROP = Preparation(crop=(9, 7), crop_at="random", seed=3)


@pytest.mark.parametrize(
    ("options", "away"),
    [
        ({"preparation": Preparation(crop=(8, 8))}, 1),
        ({"preparation": RANDOM_CROP, "seed": 3}, 1),
        # Scenes of another data set are cut where that one cut them.
        ({"preparation": RANDOM_CROP, "seed": 8}, 1),
    ],
)
def test_repeats_preparation_and_illuminants(maker: Maker, options: dict[str, Any], away: int) -> None:
    scenes = _generated(maker.make(**options).scenes)
    for naive, scene in zip(_counterparts(scenes, maker.pictures), scenes, strict=True):
        np.testing.assert_allclose(naive.read()[0].astype(int), scene.read()[0].astype(int), atol=away)


def test_each_crop_has_its_counterpart(maker: Maker) -> None:
    scenes = _generated(maker.make(preparation=Preparation(crop=(9, 7), crops=3)).scenes)
    naive = [scene.read()[0].astype(int) for scene in _counterparts(scenes, maker.pictures)]
    for image, scene in zip(naive, scenes, strict=True):
        np.testing.assert_allclose(image, scene.read()[0].astype(int), atol=1)
    assert any(np.abs(image - naive[0]).max() > 500 for image in naive[2:6:2])


def test_counterpart_has_illuminant_maps(maker: Maker) -> None:
    choice = SimultaneousLights(BOTH, 2, parse_masks("soft-edge:angle=70,width=.6", 2, 0))
    (scenes, *_) = _generated(maker.make(lights=choice).scenes)
    (naive,) = _counterparts([scenes], maker.pictures)
    assert isinstance(naive, MixedScene)
    assert isinstance(scenes, GeneratedMixedScene)
    np.testing.assert_array_equal(naive.lights, scenes.lights)
    np.testing.assert_array_equal(naive.read_weights(), scenes.read_weights())
    light = naive.read_weights() @ naive.whites
    np.testing.assert_allclose(naive.read_truth_map(), light / light.sum(axis=2, keepdims=True), atol=1e-4)
    np.testing.assert_allclose(naive.truth, light.mean(axis=(0, 1)) / light.mean(axis=(0, 1)).sum(), atol=1e-4)
    (single, *_) = _generated(maker.make("single").scenes)
    (plain,) = _counterparts([single], maker.pictures)
    assert not isinstance(plain, MixedScene)


def test_refuses_set_with_gradient(maker: Maker) -> None:
    scenes = maker.make(gradient="smooth:stops=2")
    with pytest.raises(InputError):
        plan_transfer(_real("x"), [scenes], maker.pictures)


def _dataset(maker: Maker) -> Dataset:
    scene = maker.make().scenes[0]
    assert isinstance(scene, GeneratedScene)
    return scene.dataset


def test_identifies_renamed_picture_by_content(maker: Maker, tmp_path: Path) -> None:
    dataset = _dataset(maker)
    copies = tmp_path / "other"
    (copies / "deep").mkdir(parents=True)
    shutil.copy(maker.pictures / "a.png", copies / "deep" / "renamed.png")
    # The names of the two are exchanged: content decides.
    shutil.copy(maker.pictures / "b.png", copies / "c.png")
    shutil.copy(maker.pictures / "c.png", copies / "b.png")
    sources, missing = find_source_pictures(dataset, copies)
    assert not missing
    assert {name: picture.path for name, picture in sources.items()} == {
        "a.png": copies / "deep" / "renamed.png",
        "b.png": copies / "c.png",
        "c.png": copies / "b.png",
    }
    np.testing.assert_array_equal(
        sources["b.png"].codes(), find_source_pictures(dataset, maker.pictures)[0]["b.png"].codes()
    )


def test_reports_replaced_picture_as_missing(maker: Maker, tmp_path: Path) -> None:
    dataset = _dataset(maker)
    copies = tmp_path / "other"
    save_pictures(copies, ["a.png"], seed=9)
    shutil.copy(maker.pictures / "c.png", copies / "c.png")
    sources, missing = find_source_pictures(dataset, copies)
    assert missing == ("a.png", "b.png")
    assert list(sources) == ["c.png"]


def test_generates_random_colours_again(maker: Maker) -> None:
    name = maker.folder / "random"
    scenes = random_scenes(2, 7, 5, seed=4)
    dataset = generate_dataset(maker.lut, name, scenes, [0], seed=4, options=DatasetOptions(previews=False))
    sources, missing = find_source_pictures(dataset, maker.pictures)
    assert not missing
    np.testing.assert_array_equal(sources["random-000001"].codes(), scenes[1].read().picture)


def test_refuses_missing_sources(maker: Maker) -> None:
    dataset = _dataset(maker)
    with pytest.raises(InputError):
        find_source_pictures(dataset, maker.folder / "nowhere")
    with pytest.raises(InputError):
        find_source_pictures(dataset, "s3://bucket/pictures")
    sources, _ = find_source_pictures(dataset, maker.pictures)
    save_pictures(maker.pictures, ["a.png"], side=32)
    with pytest.raises(FormatError, match=r"32x32 px.*24x24"):
        sources["a.png"].codes()


def _real(*names: str, location: str = "real.npz", seed: int = 0) -> SceneSet:
    random = np.random.default_rng(seed)
    scenes = [Thumbnail(name, np.ones(3), random.uniform(0, 1, (4, 4, 3)).astype(np.float32)) for name in names]
    return SceneSet("real", "thumbnails", location, tuple(scenes))


def test_refuses_test_on_training_set(maker: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    generated = maker.make()
    monkeypatch.chdir(maker.folder)
    same = SceneSet("made", "generated", "pictures/../made", generated.scenes)
    with pytest.raises(InputError, match=r"both training and test.*evaluate cv"):
        plan_transfer(same, [generated])


def test_identifies_test_image_by_source_name(maker: Maker) -> None:
    generated, test = maker.make(), _real("B.PNG", "other")
    shared = shared_images(generated, test)
    assert [(image.position, image.name, image.test, image.by) for image in shared] == [
        (2, "b.png", "B.PNG", "name"),
        (3, "b.png", "B.PNG", "name"),
    ]
    plan = plan_transfer(test, [generated])
    assert [scene.name for scene in plan.training[0].scenes] == [
        "000000.png",
        "000001.png",
        "000004.png",
        "000005.png",
    ]
    assert plan.notes == ("2 of 6 images of made are also in the test set, by name: b.png, b.png; excluded",)
    assert not plan_transfer(_real("other"), [generated]).notes


def test_compares_generated_sets_by_picture_content(maker: Maker, tmp_path: Path) -> None:
    second = tmp_path / "other"
    save_pictures(second, ["x.png", "a.png"], seed=5)
    shutil.copy(maker.pictures / "c.png", second / "renamed.png")
    test = maker.make("test", pictures=second)
    shared = shared_images(maker.make(), test)
    # The two that are called a.png are different pictures.
    assert {(first.name, first.test, first.by) for first in shared} == {("c.png", "renamed.png", "content")}


def test_compares_real_sets_by_pixels() -> None:
    first, second = _real("1", "2", location="one.npz"), _real("3", "4", location="other.npz")
    assert [(shared.name, shared.test, shared.by) for shared in shared_images(first, second)] == [
        ("1", "3", "content"),
        ("2", "4", "content"),
    ]
    assert not shared_images(first, _real("3", "4", location="other.npz", seed=1))


def test_keeps_copies_only_if_allowed() -> None:
    first, second = _real("1", "2", location="one.npz"), _real("3", "4", location="other.npz")
    note = "2 of 2 images of real are also in photos, by content: 1, 2"
    assert trainable_images(first, second, test_name="photos") == ((), note)
    with pytest.raises(InputError, match=f"{note}.*--unseen"):
        trainable_images(first, second, leave_out=False, test_name="photos")
    # What shows the same scene by its name is no copy.
    same_names = _real("3", "5", location="named.npz", seed=1)
    assert trainable_images(same_names, second, leave_out=False)[0] == same_names.scenes
    assert trainable_images(same_names, second)[0] == same_names.scenes[1:]


def test_naive_counterparts_match_images(maker: Maker, tmp_path: Path) -> None:
    generated, training_set = maker.make(), tmp_path / "some"
    training_set.mkdir()
    for name in ("a.png", "c.png"):
        shutil.copy(maker.pictures / name, training_set)
    plan = plan_transfer(_real("x"), [generated], pictures=training_set)
    assert [(training.data, training.kind) for training in plan.training] == [
        ("made", "generated"),
        ("made", "naive"),
        ("made", "naive with matrix"),
    ]
    for training in plan.training:
        assert [scene.name for scene in training.scenes] == ["000000.png", "000001.png", "000004.png", "000005.png"]
        np.testing.assert_array_equal(training.scenes[2].truth, generated.scenes[4].truth)
    assert "1 of 3 pictures are not in" in plan.notes[0]
    assert "b.png; 2 images of these are excluded" in plan.notes[0]
    assert "Canon EOS 550D, ColorMatrix2" in plan.notes[1]
    shutil.rmtree(training_set)
    save_pictures(training_set, ["b.png"], seed=8)
    with pytest.raises(InputError, match="0 of 3 pictures of made"):
        plan_transfer(_real("x"), [generated], pictures=training_set)


def test_excludes_validation_and_test_parts(maker: Maker, tmp_path: Path) -> None:
    save_pictures(tmp_path / "many", [f"{number}.png" for number in range(12)], seed=2)
    generated = maker.make("divided", pictures=tmp_path / "many", split=(0.5, 0.0, 0.5))
    plan = plan_transfer(_real("x"), [generated])
    remaining = [scene.name for scene in plan.training[0].scenes]
    train = (tmp_path / "divided" / "splits" / "train.txt").read_text().split()
    assert remaining == train
    assert 0 < len(train) < 24
    assert f"{24 - len(train)} images of its validation and test parts" in plan.notes[0]


def test_refuses_impossible_plans(maker: Maker) -> None:
    generated = maker.make()
    with pytest.raises(InputError):
        plan_transfer(_real("x"), [generated, generated])
    with pytest.raises(InputError, match=r"--naive.*generate"):
        plan_transfer(_real("x"), [_real("y", location="y.npz", seed=1)], maker.pictures)
    with pytest.raises(InputError):
        plan_transfer(_real("a", "b", "c"), [generated])


def test_relit_scenes_have_generated_illuminants(maker: Maker) -> None:
    generated = maker.make()
    pixels = np.full((2, 2, 3), [80, 20, 20], np.float32)
    pixels[1, 1] = 79, 20, 20
    relit = Thumbnail("other", np.array([0.5, 0.25, 0.25]), pixels, 80.0)
    scenes = relit_scenes([relit], [scene.truth for scene in generated.scenes])
    assert [scene.truth.tolist() for scene in scenes] == [scene.truth.tolist() for scene in generated.scenes]
    image, mask = scenes[0].read()
    light = scenes[0].truth / scenes[0].truth.sum()
    np.testing.assert_allclose(
        image[0, 0], [80 * light[0] / 0.5, 20 * light[1] / 0.25, 20 * light[2] / 0.25], rtol=1e-6
    )
    # What was clipped is known by its own values, not by those under the other light.
    assert mask is not None
    assert mask.tolist() == [[True, True], [True, False]]
    assert scenes[0].saturation is None
    assert len({scene.name for scene in scenes}) == len(scenes)
