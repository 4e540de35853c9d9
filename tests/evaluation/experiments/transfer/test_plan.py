"""What may be trained on: nothing that the test set shows, and all rows the same images."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from evaluation.datasets.thumbnails import Thumbnail
from evaluation.experiments.transfer.plan import plan_transfer, shared_images, trainable_images
from evaluation.scene import SceneSet
from foundation.errors import InputError
from tests.evaluation.experiments.transfer.conftest import Maker, save_pictures, write_table


def _real(*names: str, place: str = "real.npz", seed: int = 0) -> SceneSet:
    random = np.random.default_rng(seed)
    scenes = [Thumbnail(name, np.ones(3), random.uniform(0, 1, (4, 4, 3)).astype(np.float32)) for name in names]
    return SceneSet("real", "thumbnails", place, tuple(scenes))


def test_a_data_set_is_not_tested_on_itself(maker: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    made = maker.make()
    monkeypatch.chdir(maker.folder)
    same = SceneSet("made", "generated", "pictures/../made", made.scenes)
    with pytest.raises(InputError, match=r"both training and test.*evaluate cv"):
        plan_transfer(same, [made])


def test_a_source_that_is_a_test_image_is_found_by_name(maker: Maker) -> None:
    made, test = maker.make(), _real("B.PNG", "other")
    found = shared_images(made, test)
    assert [(one.position, one.name, one.test, one.by) for one in found] == [
        (2, "b.png", "B.PNG", "name"),
        (3, "b.png", "B.PNG", "name"),
    ]
    with pytest.raises(InputError, match=r"2 of 6 images of made are also in the test set, by name: b\.png.*--shared"):
        plan_transfer(test, [made])
    without = plan_transfer(test, [made], shared="leave-out")
    assert [scene.name for scene in without.training[0].scenes] == [
        "000000.png",
        "000001.png",
        "000004.png",
        "000005.png",
    ]
    kept = plan_transfer(test, [made], shared="keep")
    assert len(kept.training[0].scenes) == 6
    assert "not unseen" in kept.notes[0]
    assert not plan_transfer(_real("other"), [made]).notes


def test_generated_sets_are_compared_by_the_content_of_their_pictures(maker: Maker, tmp_path: Path) -> None:
    other = tmp_path / "other"
    save_pictures(other, ["x.png", "a.png"], seed=5)
    shutil.copy(maker.pictures / "c.png", other / "renamed.png")
    test = maker.make("test", pictures=other)
    found = shared_images(maker.make(), test)
    # The two that are called a.png are different pictures.
    assert {(one.name, one.test, one.by) for one in found} == {("c.png", "renamed.png", "content")}


def test_real_sets_are_compared_by_their_pixels() -> None:
    one, other = _real("1", "2", place="one.npz"), _real("3", "4", place="other.npz")
    assert [(shared.name, shared.test, shared.by) for shared in shared_images(one, other)] == [
        ("1", "3", "content"),
        ("2", "4", "content"),
    ]
    assert not shared_images(one, _real("3", "4", place="other.npz", seed=1))


def test_copies_are_kept_only_where_that_is_allowed() -> None:
    one, other = _real("1", "2", place="one.npz"), _real("3", "4", place="other.npz")
    said = "2 of 2 images of real are also in photos, by content: 1, 2"
    assert trainable_images(one, other, "keep", "photos") == (one.scenes, said)
    assert trainable_images(one, other, "leave-out", "photos", copies=False) == ((), said)
    with pytest.raises(InputError, match=f"{said}.*must be unseen: --shared leave-out"):
        trainable_images(one, other, "keep", "photos", copies=False)
    # What shows the same scene by its name is no copy.
    named = _real("3", "5", place="named.npz", seed=1)
    assert trainable_images(named, other, "keep", copies=False)[0] == named.scenes
    assert trainable_images(named, other, "leave-out", copies=False)[0] == named.scenes[1:]


def test_naive_counterparts_are_of_the_same_images(maker: Maker, tmp_path: Path) -> None:
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
    assert "b.png; 2 images of them are left out" in plan.notes[0]
    assert "Canon EOS 550D, ColorMatrix2" in plan.notes[1]
    shutil.rmtree(some)
    save_pictures(some, ["b.png"], seed=8)
    with pytest.raises(InputError, match="none of the 3 pictures of made"):
        plan_transfer(_real("x"), [made], pictures=some)


def test_the_matrix_that_is_asked_for(maker: Maker, tmp_path: Path) -> None:
    made = maker.make()
    kinds = [each.kind for each in plan_transfer(_real("x"), [made], maker.pictures, "none").training]
    assert kinds == ["generated", "naive"]
    plan = plan_transfer(_real("x"), [made], maker.pictures, "EOS 600D")
    assert "Canon EOS 600D" in plan.notes[0]
    save_pictures(tmp_path / "b" / "pictures", ["q.png"])
    unknown = Maker(tmp_path / "b", write_table(tmp_path / "b" / "lut", camera="Pinhole")).make()
    plan = plan_transfer(_real("x"), [unknown], tmp_path / "b" / "pictures")
    assert [each.kind for each in plan.training] == ["generated", "naive"]
    assert "no colour matrix is known for Pinhole" in plan.notes[0]


def test_a_set_that_was_not_generated_stands_beside(maker: Maker) -> None:
    other = _real("y", place="y.npz", seed=1)
    plan = plan_transfer(_real("x"), [maker.make(), other], maker.pictures, "none")
    assert [(each.data, each.kind) for each in plan.training] == [
        ("made", "generated"),
        ("made", "naive"),
        ("real", "other"),
    ]


def test_parts_that_are_set_apart_stay_apart(maker: Maker, tmp_path: Path) -> None:
    save_pictures(tmp_path / "many", [f"{number}.png" for number in range(12)], seed=2)
    made = maker.make("divided", pictures=tmp_path / "many", split=(0.5, 0.0, 0.5))
    plan = plan_transfer(_real("x"), [made])
    kept = [scene.name for scene in plan.training[0].scenes]
    train = (tmp_path / "divided" / "splits" / "train.txt").read_text().split()
    assert kept == train
    assert 0 < len(train) < 24
    assert f"{24 - len(train)} images of its parts validation and test" in plan.notes[0]


def test_what_cannot_be_planned_is_said(maker: Maker) -> None:
    made = maker.make()
    with pytest.raises(InputError, match="no data set to train on"):
        plan_transfer(_real("x"), [])
    with pytest.raises(InputError, match="two training sets are called made"):
        plan_transfer(_real("x"), [made, made])
    with pytest.raises(InputError, match="--naive is for sets made by generate"):
        plan_transfer(_real("x"), [_real("y", place="y.npz", seed=1)], maker.pictures)
    with pytest.raises(InputError, match="made has no image left"):
        plan_transfer(_real("a", "b", "c"), [made], shared="leave-out")
