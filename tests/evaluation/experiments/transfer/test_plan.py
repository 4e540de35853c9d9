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


def _counterparts(made: list[GeneratedScene], pictures: Path) -> tuple[NaiveScene, ...]:
    found, missing = find_source_pictures(made[0].dataset, pictures)
    assert not missing
    return naive_scenes(made, found)


def test_naive_table_is_reproduced(maker: Maker) -> None:
    made = _generated(maker.make().scenes)
    naive = _counterparts(made, maker.pictures)
    assert [scene.name for scene in naive] == [scene.name for scene in made]
    for one, other in zip(naive, made, strict=True):
        np.testing.assert_array_equal(one.truth, other.truth)
        assert one.saturation == other.saturation
        np.testing.assert_allclose(one.read()[0].astype(int), other.read()[0].astype(int), atol=1)


def test_matrix_table_needs_matrix(tmp_path: Path) -> None:
    save_pictures(tmp_path / "pictures", ["a.png"])
    made = _generated(Maker(tmp_path, write_table(tmp_path / "lut", MATRIX)).make().scenes)
    found, _ = find_source_pictures(made[0].dataset, tmp_path / "pictures")
    (one, _), (plain, _) = (
        naive_scenes(made, found, matrix) for matrix in (ColourMatrix("mine", MATRIX, "test"), None)
    )
    image = made[0].read()[0].astype(int)
    np.testing.assert_allclose(one.read()[0].astype(int), image, atol=1)
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
    found, _ = find_source_pictures(two.dataset, maker.pictures)
    (naive, *_) = naive_scenes([two], found)
    image, expected = naive.read()[0].astype(int), two.read()[0].astype(int)
    np.testing.assert_allclose(image, expected, atol=2)
    whole = naive_image(found["a.png"].codes(), LIGHTS[0], two.saturation).astype(int)
    assert np.abs(whole - expected).max() > 500


RANDOM_CROP = Preparation(crop=(9, 7), crop_at="random", seed=3)


@pytest.mark.parametrize(
    ("how", "away"),
    [
        ({"preparation": Preparation(crop=(8, 8))}, 1),
        ({"preparation": RANDOM_CROP, "seed": 3}, 1),
        # Scenes of another data set are cut where that one cut them.
        ({"preparation": RANDOM_CROP, "seed": 8}, 1),
    ],
)
def test_repeats_preparation_and_illuminants(maker: Maker, how: dict[str, Any], away: int) -> None:
    made = _generated(maker.make(**how).scenes)
    for naive, scene in zip(_counterparts(made, maker.pictures), made, strict=True):
        np.testing.assert_allclose(naive.read()[0].astype(int), scene.read()[0].astype(int), atol=away)


def test_each_crop_has_its_counterpart(maker: Maker) -> None:
    made = _generated(maker.make(preparation=Preparation(crop=(9, 7), crops=3)).scenes)
    naive = [scene.read()[0].astype(int) for scene in _counterparts(made, maker.pictures)]
    for image, scene in zip(naive, made, strict=True):
        np.testing.assert_allclose(image, scene.read()[0].astype(int), atol=1)
    assert any(np.abs(image - naive[0]).max() > 500 for image in naive[2:6:2])


def test_counterpart_has_illuminant_maps(maker: Maker) -> None:
    choice = SimultaneousLights(BOTH, 2, parse_masks("soft-edge:angle=70,width=.6", 2, 0))
    (made, *_) = _generated(maker.make(lights=choice).scenes)
    (naive,) = _counterparts([made], maker.pictures)
    assert isinstance(naive, MixedScene)
    assert isinstance(made, GeneratedMixedScene)
    np.testing.assert_array_equal(naive.lights, made.lights)
    np.testing.assert_array_equal(naive.read_weights(), made.read_weights())
    light = naive.read_weights() @ naive.whites
    np.testing.assert_allclose(naive.read_truth_map(), light / light.sum(axis=2, keepdims=True), atol=1e-4)
    np.testing.assert_allclose(naive.truth, light.mean(axis=(0, 1)) / light.mean(axis=(0, 1)).sum(), atol=1e-4)
    (single, *_) = _generated(maker.make("single").scenes)
    (plain,) = _counterparts([single], maker.pictures)
    assert not isinstance(plain, MixedScene)


def test_refuses_set_with_gradient(maker: Maker) -> None:
    made = maker.make(gradient="smooth:stops=2")
    with pytest.raises(InputError):
        plan_transfer(_real("x"), [made], maker.pictures)


def _dataset(maker: Maker) -> Dataset:
    scene = maker.make().scenes[0]
    assert isinstance(scene, GeneratedScene)
    return scene.dataset


def test_identifies_renamed_picture_by_content(maker: Maker, tmp_path: Path) -> None:
    dataset = _dataset(maker)
    other = tmp_path / "other"
    (other / "deep").mkdir(parents=True)
    shutil.copy(maker.pictures / "a.png", other / "deep" / "renamed.png")
    # The names of the two are exchanged: content decides.
    shutil.copy(maker.pictures / "b.png", other / "c.png")
    shutil.copy(maker.pictures / "c.png", other / "b.png")
    found, missing = find_source_pictures(dataset, other)
    assert not missing
    assert {name: picture.path for name, picture in found.items()} == {
        "a.png": other / "deep" / "renamed.png",
        "b.png": other / "c.png",
        "c.png": other / "b.png",
    }
    np.testing.assert_array_equal(
        found["b.png"].codes(), find_source_pictures(dataset, maker.pictures)[0]["b.png"].codes()
    )


def test_reports_replaced_picture_as_missing(maker: Maker, tmp_path: Path) -> None:
    dataset = _dataset(maker)
    other = tmp_path / "other"
    save_pictures(other, ["a.png"], seed=9)
    shutil.copy(maker.pictures / "c.png", other / "c.png")
    found, missing = find_source_pictures(dataset, other)
    assert missing == ("a.png", "b.png")
    assert list(found) == ["c.png"]


def test_generates_random_colours_again(maker: Maker) -> None:
    place = maker.folder / "random"
    scenes = random_scenes(2, 7, 5, seed=4)
    made = generate_dataset(maker.lut, place, scenes, [0], seed=4, options=DatasetOptions(previews=False))
    found, missing = find_source_pictures(made, maker.pictures)
    assert not missing
    np.testing.assert_array_equal(found["random-000001"].codes(), scenes[1].read().picture)


def test_refuses_missing_sources(maker: Maker) -> None:
    dataset = _dataset(maker)
    with pytest.raises(InputError):
        find_source_pictures(dataset, maker.folder / "nowhere")
    with pytest.raises(InputError):
        find_source_pictures(dataset, "s3://bucket/pictures")
    found, _ = find_source_pictures(dataset, maker.pictures)
    save_pictures(maker.pictures, ["a.png"], side=32)
    with pytest.raises(FormatError, match=r"32x32 px.*24x24"):
        found["a.png"].codes()


def _real(*names: str, place: str = "real.npz", seed: int = 0) -> SceneSet:
    random = np.random.default_rng(seed)
    scenes = [Thumbnail(name, np.ones(3), random.uniform(0, 1, (4, 4, 3)).astype(np.float32)) for name in names]
    return SceneSet("real", "thumbnails", place, tuple(scenes))


def test_refuses_test_on_training_set(maker: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    made = maker.make()
    monkeypatch.chdir(maker.folder)
    same = SceneSet("made", "generated", "pictures/../made", made.scenes)
    with pytest.raises(InputError, match=r"both training and test.*evaluate cv"):
        plan_transfer(same, [made])


def test_identifies_test_image_by_source_name(maker: Maker) -> None:
    made, test = maker.make(), _real("B.PNG", "other")
    found = shared_images(made, test)
    assert [(one.position, one.name, one.test, one.by) for one in found] == [
        (2, "b.png", "B.PNG", "name"),
        (3, "b.png", "B.PNG", "name"),
    ]
    plan = plan_transfer(test, [made])
    assert [scene.name for scene in plan.training[0].scenes] == [
        "000000.png",
        "000001.png",
        "000004.png",
        "000005.png",
    ]
    assert plan.notes == ("2 of 6 images of made are also in the test set, by name: b.png, b.png; excluded",)
    assert not plan_transfer(_real("other"), [made]).notes


def test_compares_generated_sets_by_picture_content(maker: Maker, tmp_path: Path) -> None:
    other = tmp_path / "other"
    save_pictures(other, ["x.png", "a.png"], seed=5)
    shutil.copy(maker.pictures / "c.png", other / "renamed.png")
    test = maker.make("test", pictures=other)
    found = shared_images(maker.make(), test)
    # The two that are called a.png are different pictures.
    assert {(one.name, one.test, one.by) for one in found} == {("c.png", "renamed.png", "content")}


def test_compares_real_sets_by_pixels() -> None:
    one, other = _real("1", "2", place="one.npz"), _real("3", "4", place="other.npz")
    assert [(shared.name, shared.test, shared.by) for shared in shared_images(one, other)] == [
        ("1", "3", "content"),
        ("2", "4", "content"),
    ]
    assert not shared_images(one, _real("3", "4", place="other.npz", seed=1))


def test_keeps_copies_only_if_allowed() -> None:
    one, other = _real("1", "2", place="one.npz"), _real("3", "4", place="other.npz")
    said = "2 of 2 images of real are also in photos, by content: 1, 2"
    assert trainable_images(one, other, test_name="photos") == ((), said)
    with pytest.raises(InputError, match=f"{said}.*--unseen"):
        trainable_images(one, other, leave_out=False, test_name="photos")
    # What shows the same scene by its name is no copy.
    named = _real("3", "5", place="named.npz", seed=1)
    assert trainable_images(named, other, leave_out=False)[0] == named.scenes
    assert trainable_images(named, other)[0] == named.scenes[1:]


def test_naive_counterparts_match_images(maker: Maker, tmp_path: Path) -> None:
    made, some = maker.make(), tmp_path / "some"
    some.mkdir()
    for name in ("a.png", "c.png"):
        shutil.copy(maker.pictures / name, some)
    plan = plan_transfer(_real("x"), [made], pictures=some)
    assert [(each.data, each.kind) for each in plan.training] == [
        ("made", "generated"),
        ("made", "naive"),
        ("made", "naive with matrix"),
    ]
    for each in plan.training:
        assert [scene.name for scene in each.scenes] == ["000000.png", "000001.png", "000004.png", "000005.png"]
        np.testing.assert_array_equal(each.scenes[2].truth, made.scenes[4].truth)
    assert "1 of 3 pictures are not in" in plan.notes[0]
    assert "b.png; 2 images of them are excluded" in plan.notes[0]
    assert "Canon EOS 550D, ColorMatrix2" in plan.notes[1]
    shutil.rmtree(some)
    save_pictures(some, ["b.png"], seed=8)
    with pytest.raises(InputError, match="0 of 3 pictures of made"):
        plan_transfer(_real("x"), [made], pictures=some)


def test_excludes_validation_and_test_parts(maker: Maker, tmp_path: Path) -> None:
    save_pictures(tmp_path / "many", [f"{number}.png" for number in range(12)], seed=2)
    made = maker.make("divided", pictures=tmp_path / "many", split=(0.5, 0.0, 0.5))
    plan = plan_transfer(_real("x"), [made])
    kept = [scene.name for scene in plan.training[0].scenes]
    train = (tmp_path / "divided" / "splits" / "train.txt").read_text().split()
    assert kept == train
    assert 0 < len(train) < 24
    assert f"{24 - len(train)} images of its parts validation and test" in plan.notes[0]


def test_refuses_impossible_plans(maker: Maker) -> None:
    made = maker.make()
    with pytest.raises(InputError):
        plan_transfer(_real("x"), [made, made])
    with pytest.raises(InputError, match=r"--naive.*generate"):
        plan_transfer(_real("x"), [_real("y", place="y.npz", seed=1)], maker.pictures)
    with pytest.raises(InputError):
        plan_transfer(_real("a", "b", "c"), [made])


def test_relit_scenes_have_generated_illuminants(maker: Maker) -> None:
    made = maker.make()
    pixels = np.full((2, 2, 3), [80, 20, 20], np.float32)
    pixels[1, 1] = 79, 20, 20
    other = Thumbnail("other", np.array([0.5, 0.25, 0.25]), pixels, 80.0)
    scenes = relit_scenes([other], [scene.truth for scene in made.scenes])
    assert [scene.truth.tolist() for scene in scenes] == [scene.truth.tolist() for scene in made.scenes]
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
