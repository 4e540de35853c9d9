"""Cross-validation, reduction of images, and tuning without ground truths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.cross_validation import (
    cross_validate,
    shrink_image,
    tune_family,
    tuning_table,
)
from evaluation.experiments.folds import draw_folds
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.methods.prepared import GREY, unit
from evaluation.scene import Image, Scene
from foundation.errors import InputError
from tests.evaluation.learning.made_up_world import world
from tests.evaluation.made_scenes import Made


def test_shrinking_averages_areas() -> None:
    image = np.arange(48, dtype=np.uint16).reshape(4, 4, 3)
    small, mask = shrink_image(image, side=2)
    assert not mask.any()
    np.testing.assert_array_equal(small[0, 0], [7.5, 8.5, 9.5])
    np.testing.assert_array_equal(small[1, 1], [37.5, 38.5, 39.5])
    # Pixels that are cut count by their shares.
    image = np.repeat(np.array([[[10.0], [20.0], [60.0]]]), 3, axis=2)
    small, _ = shrink_image(image, side=2)
    # 1.5 px each: 10 and half of 20, half of 20 and 60.
    np.testing.assert_allclose(small[0, :, 0], [20 / 1.5, 70 / 1.5], rtol=1e-5)


def test_shrinking_excludes_clipped_and_masked_pixels() -> None:
    light = np.array([3.0, 4.0, 2.0])
    image = np.random.default_rng(0).uniform(1, 100, (32, 48, 1)) * light
    image[3:9, 5:20] = 900, 100, 5
    mask = np.zeros((32, 48), dtype=bool)
    mask[20:, 30:] = True
    image[mask] = 100, 900, 5
    mask[:4, :4] = True
    small, empty = shrink_image(image, 12, saturation=900, mask=mask)
    assert small.shape == (8, 12, 3)
    assert empty[0, 0]
    assert empty[6, 9]
    assert not empty[3:5].any()
    values = small[~empty]
    np.testing.assert_allclose(
        values / values.sum(axis=1, keepdims=True), np.tile(light / 9, (len(values), 1)), rtol=1e-5
    )
    assert not small[empty].any()


pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Memory:
    """User class that knows the illuminants of its training images, and no others."""

    name: str = "Memory"
    lights: dict[bytes, npt.NDArray[np.float64]] = field(default_factory=dict[bytes, Any])

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Memory:
        return Memory(lights={np.asarray(scene.read()[0]).tobytes(): scene.truth for scene in scenes})

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> npt.NDArray[np.float64]:
        lights = self.lights.get(np.asarray(image).tobytes())
        return GREY if lights is None else unit(lights)


@dataclass(frozen=True, eq=False)
class ReadCounter(Made):
    """A scene that records when it is read."""

    log: list[str] = field(default_factory=list[str])

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_] | None]:
        self.log.append(self.name)
        return super().read()


SCENES = world(24)
FOLDS = draw_folds(24, 3)


def test_estimates_only_unseen_images() -> None:
    (result,) = cross_validate(SCENES, [Memory()], FOLDS)
    assert result.guessed.all()
    # The same scenes twice under other names: now the memory helps wherever the folds part the two.
    double = [*SCENES, *(replace(scene, name=f"{scene.name} again") for scene in SCENES)]
    (leaking,) = cross_validate(double, [Memory()], np.concatenate([FOLDS, (FOLDS + 1) % 3]))
    assert not leaking.guessed.any()
    assert leaking.errors["recovery"].max() < 1e-5


def test_trains_on_other_folds() -> None:
    learner = RegressionTrees(windows=2)
    (result,) = cross_validate(SCENES, [learner], FOLDS, seed=5)
    for fold in range(3):
        method = learner.fit([scene for scene, where in zip(SCENES, FOLDS, strict=True) if where != fold], seed=5)
        for index in np.flatnonzero(fold == FOLDS):
            np.testing.assert_allclose(result.estimates[index], method.estimate(SCENES[index].image), rtol=1e-14)


def test_reads_each_image_once() -> None:
    log: list[str] = []
    scenes = [ReadCounter(scene.name, scene.truth, scene.image, log=log) for scene in SCENES]
    steps: list[int] = []
    learners = [RegressionTrees(windows=1), RegressionTrees(windows=2)]
    results = cross_validate(scenes, learners, FOLDS, on_scene=lambda: steps.append(1))
    assert sorted(log) == sorted(scene.name for scene in SCENES)
    assert len(steps) == len(SCENES)
    parallel = cross_validate(SCENES, learners, FOLDS, workers=3)
    for first, second in zip(results, parallel, strict=True):
        np.testing.assert_array_equal(first.estimates, second.estimates)


def test_marks_image_without_usable_pixel() -> None:
    black = replace(SCENES[3], image=np.zeros_like(SCENES[3].image))
    (result,) = cross_validate([*SCENES[:3], black, *SCENES[4:]], [RegressionTrees(windows=1)], FOLDS)
    assert result.guessed.tolist() == [index == 3 for index in range(24)]
    np.testing.assert_allclose(result.estimates[3], 3**-0.5)
    assert result.errors["recovery"][3] > 1


def test_refuses_impossible_validation() -> None:
    with pytest.raises(InputError, match="0 methods in 3 folds"):
        cross_validate(SCENES, [], FOLDS)
    with pytest.raises(InputError, match="1 methods in 1 folds"):
        cross_validate(SCENES, [Memory()], np.zeros(24, np.int64))
    with pytest.raises(InputError, match="scene 0 are in the folds"):
        cross_validate([SCENES[0], *SCENES[:1], *SCENES[2:]], [Memory()], np.arange(24) % 2)
    dark = replace(SCENES[7], truth=np.array([0.0, 1, 1]))
    with pytest.raises(InputError, match="scene 7 is 0 1 1"):
        cross_validate([*SCENES[:7], dark, *SCENES[8:]], [Memory()], FOLDS)


class Hoarder:
    """User class that accumulates its training images and returns itself from `fit`."""

    name = "Hoarder"

    def __init__(self) -> None:
        self.known: dict[bytes, Any] = {}

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Hoarder:
        self.known |= {np.asarray(scene.read()[0]).tobytes(): scene.truth for scene in scenes}
        return self

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> Any:
        return self.known.get(np.asarray(image).tobytes())


def test_each_fold_starts_from_fresh_copy() -> None:
    hoarder = Hoarder()
    (result,) = cross_validate(SCENES, [hoarder], FOLDS)
    assert result.guessed.all()
    assert not hoarder.known


class FixedAnswer:
    """User class that always returns the given value."""

    name = "Answers"

    def __init__(self, value: object) -> None:
        self.value = value

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Any:
        if isinstance(self.value, BaseException):
            raise self.value
        return None if self.value == "no method" else self

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> Any:
        image[:] = 0
        return self.value


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (1.0, "Answers failed on .*returned an array of shape"),
        ("no method", "Answers.fit returned NoneType, expected a method"),
        (RuntimeError("no data"), "Answers failed in training on 16 images: RuntimeError: no data"),
        (SystemExit(0), "Answers failed in training on 16 images: SystemExit: 0"),
    ],
)
def test_reports_faulty_class_by_name(value: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        cross_validate(SCENES, [FixedAnswer(value)], FOLDS)


def test_missing_estimate_becomes_grey_and_images_are_unchanged() -> None:
    (result,) = cross_validate(SCENES, [FixedAnswer((-1, 1, 1))], FOLDS)
    assert result.guessed.all()
    assert SCENES[0].image.any()


@dataclass(frozen=True, eq=False)
class Shop:
    """Tiles with a greenish cast next to a brightest grey one, under an illuminant that differs in red and blue only.

    `told` is the ground truth of the data set, which may be wrong; None raises an error if it is read.
    """

    number: int
    told: tuple[float, float, float] | None = None
    black: bool = False
    saturation: float | None = None

    @property
    def name(self) -> str:
        return f"shop {self.number}"

    @property
    def light(self) -> npt.NDArray[np.float64]:
        return np.array([0.15 + 0.03 * self.number, 0.4, 0.45 - 0.03 * self.number])

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        assert self.told is not None, "the ground truth was looked at"
        return np.array(self.told)

    def read(self) -> tuple[Image, None]:
        random = np.random.default_rng(self.number)
        tiles = random.uniform(0.2, 0.5, (24, 24, 3)) * (not self.black)
        tiles[..., 1] *= random.uniform(1, 3)
        tiles[:4] = not self.black
        return tiles * self.light, None


BLIND = [Shop(number) for number in range(8)]


def test_tuning_does_not_read_ground_truths() -> None:
    tuned = tune_family("shades-of-gray", "shops", BLIND)
    assert tuned.settings[0].text == "shades-of-gray:p=15"
    assert [unread.spread for unread in tuned.settings] == sorted(unread.spread for unread in tuned.settings)
    assert {unread.errors for unread in tuned.settings} == {None}
    assert (tuned.images, tuned.counted) == (8, 8)


def test_wrong_ground_truths_do_not_change_choice() -> None:
    right = [Shop(scene.number, tuple(scene.light.tolist())) for scene in BLIND]
    wrong_scenes = [Shop(scene.number, (1, 0.1, 0.1)) for scene in BLIND]
    blind = tune_family("shades-of-gray", "shops", BLIND)
    good, bad = (tune_family("shades-of-gray", "shops", scenes, "recovery") for scenes in (right, wrong_scenes))
    for wrong_tuning in (good, bad):
        assert [(right_tuning.text, right_tuning.spread) for right_tuning in wrong_tuning.settings] == [
            (right_tuning.text, right_tuning.spread) for right_tuning in blind.settings
        ]
    assert good.settings[0].errors is not None
    assert bad.settings[0].errors is not None
    assert good.settings[0].errors.median < bad.settings[0].errors.median - 20


def test_tuning_excludes_and_reports_images_without_estimate() -> None:
    scenes = [*BLIND, Shop(8, black=True)]
    tuned = tune_family("shades-of-gray", "shops", scenes)
    assert tuned.settings == tune_family("shades-of-gray", "shops", BLIND).settings
    assert tuning_table(tuned).notes[0].startswith("1 of 9 images are excluded")
    with pytest.raises(InputError, match="1 of 2 images"):
        tune_family("shades-of-gray", "shops", scenes[-2:])
