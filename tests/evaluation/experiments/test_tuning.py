"""Tuning on a data set: what is chosen, on what it depends, and what stands beside it."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.cross_validation import settings_of, tune_family, tuning_table
from evaluation.experiments.running import evaluate
from evaluation.methods.green_stability import tune
from evaluation.methods.method import Method
from evaluation.scene import Image
from foundation.errors import InputError

pytestmark = pytest.mark.slow


@dataclass(frozen=True, eq=False)
class Shop:
    """Tiles with a greenish cast under a light that differs in red and blue only, beside a grey one that is brightest.

    `told` is the ground truth that the data set states, which may be wrong; None where asking for it is an error.
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


def test_ground_truths_are_not_looked_at() -> None:
    tuned = tune_family("shades-of-gray", "shops", BLIND)
    assert tuned.settings[0].text == "shades-of-gray:p=15"
    assert [one.spread for one in tuned.settings] == sorted(one.spread for one in tuned.settings)
    assert {one.errors for one in tuned.settings} == {None}
    assert (tuned.images, tuned.counted) == (8, 8)


def test_wrong_ground_truths_change_the_errors_and_not_the_choice() -> None:
    right = [Shop(scene.number, tuple(scene.light.tolist())) for scene in BLIND]
    wrong = [Shop(scene.number, (1, 0.1, 0.1)) for scene in BLIND]
    blind = tune_family("shades-of-gray", "shops", BLIND)
    good, bad = (tune_family("shades-of-gray", "shops", scenes, "recovery") for scenes in (right, wrong))
    for other in (good, bad):
        assert [(one.text, one.spread) for one in other.settings] == [(one.text, one.spread) for one in blind.settings]
    assert good.settings[0].errors is not None
    assert bad.settings[0].errors is not None
    assert good.settings[0].errors.median < bad.settings[0].errors.median - 20


def methods_of(family: str) -> list[Method]:
    return [method for _, method in settings_of(family)]


def test_errors_are_those_of_a_run() -> None:
    scenes = [Shop(scene.number, tuple(scene.light.tolist())) for scene in BLIND]
    tuned = tune_family("shades-of-gray", "shops", scenes, "reproduction", workers=2)
    runs = {result.method: result.summary("reproduction") for result in evaluate(scenes, methods_of("shades-of-gray"))}
    for one in tuned.settings:
        assert one.errors is not None
        np.testing.assert_allclose(one.errors.as_tuple(), runs[one.name].as_tuple(), rtol=1e-9)


def test_workers_change_no_number() -> None:
    assert tune_family("general-gray-world", "shops", BLIND, workers=3) == tune_family(
        "general-gray-world", "shops", BLIND
    )


@dataclass(frozen=True, eq=False)
class Pair(Shop):
    """One of two shops that are read at the same time, or not at all."""

    both: threading.Barrier = field(kw_only=True)

    def read(self) -> tuple[Image, None]:
        self.both.wait()
        return super().read()


def test_as_many_images_are_read_at_once_as_there_are_workers() -> None:
    both = threading.Barrier(2, timeout=30)
    scenes = [Pair(number, both=both) for number in range(4)]
    assert tune_family("shades-of-gray", "shops", scenes, workers=2).counted == 4


def test_images_without_a_light_are_left_out_and_told() -> None:
    scenes = [*BLIND, Shop(8, black=True)]
    tuned = tune_family("shades-of-gray", "shops", scenes)
    assert tuned.settings == tune_family("shades-of-gray", "shops", BLIND).settings
    assert tuning_table(tuned).notes == ("1 of 9 images give no light with some setting and do not count for any.",)
    with pytest.raises(InputError, match="1 of 2 images"):
        tune_family("shades-of-gray", "shops", scenes[-2:])


def test_a_family_that_is_none() -> None:
    with pytest.raises(InputError, match="'gray-world' is no family"):
        tune_family("gray-world", "shops", BLIND)
    with pytest.raises(InputError, match="'sigma=1@large' is no parameter"):
        tune_family("gray-edge-1@large", "shops", BLIND)


def test_too_little_to_tune_with_is_refused() -> None:
    with pytest.raises(InputError, match="1 sets of parameters on 8 images"):
        tune(methods_of("gray-edge-1")[:1], BLIND)
    with pytest.raises(InputError, match="30 sets of parameters on 1 images"):
        tune(methods_of("gray-edge-1"), BLIND[:1])
