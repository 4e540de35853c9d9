"""Methods over a generated dataset, in Python."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets import open_scenes
from evaluation.experiments import evaluate
from evaluation.methods import GrayEdge
from evaluation.results import images_csv, table_csv
from foundation.errors import InputError


def test_grey_on_average_is_what_gray_world_finds(dataset: Path) -> None:
    scenes = open_scenes(dataset).scenes
    assert [scene.name for scene in scenes] == [f"{number:06d}.png" for number in range(16)]
    assert {scene.saturation for scene in scenes} == {9000.0}
    methods = [GrayEdge("Gray-world", 0, 1, 0), GrayEdge("White-Patch", 0, np.inf, 0)]
    results = evaluate(scenes, methods)
    # 5828 pixels of uniform codes: each channel's mean is off by 0.8 %, an angle of well below a degree.
    assert results[0].summary("recovery").worst25 < 1.5
    assert results[1].summary("reproduction").worst25 < 1e-6
    parallel = evaluate(scenes, methods, workers=3)
    for one, other in zip(results, parallel, strict=True):
        np.testing.assert_array_equal(one.estimates, other.estimates)


def test_the_tables_as_text(dataset: Path) -> None:
    scenes = open_scenes(dataset).scenes
    results = evaluate(scenes, [GrayEdge("Gray-world", 0, 1, 0)])
    rows = list(csv.DictReader(table_csv(results, "recovery").splitlines()))
    assert list(rows[0]) == ["method", "mean", "median", "trimean", "best25", "worst25", "avg", "no_estimate"]
    assert float(rows[0]["mean"]) == pytest.approx(results[0].errors["recovery"].mean(), abs=1e-6)
    images = list(csv.DictReader(images_csv(scenes, results).splitlines()))
    assert len(images) == 16
    assert float(images[3]["reproduction"]) == pytest.approx(results[0].errors["reproduction"][3], abs=1e-6)


def test_nothing_to_evaluate_is_said(dataset: Path) -> None:
    with pytest.raises(InputError, match="0 methods on 16 images"):
        evaluate(open_scenes(dataset).scenes, [])


@dataclass(frozen=True)
class Flat:
    """A scene of one colour that says when it is read."""

    name: str
    truth: npt.NDArray[np.float64]
    log: list[str]
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float32], None]:
        self.log.append(self.name)
        return np.ones((8, 8, 3), np.float32), None


@pytest.mark.parametrize("light", [(0, 0, 0), (np.nan, 1, 1), (np.inf, 1, 1), (1, 1, -1)])
def test_a_scene_without_a_light_is_named_before_the_work(light: tuple[float, ...]) -> None:
    read: list[str] = []
    good, dark = Flat("good.png", np.ones(3), read), Flat("dark.png", np.array(light), read)
    methods = [GrayEdge("Gray-world", 0, 1, 0)]
    evaluate([good], methods)
    with pytest.raises(InputError, match=r"the ground truth of dark\.png is .*, expected red, green and blue"):
        evaluate([good, dark], methods)
    assert read == ["good.png"]


def test_images_without_a_usable_pixel_are_marked() -> None:
    truth = np.array([1.0, 2.0, 1.0])
    scenes = [Flat("grey.png", truth, []), Flat("clipped.png", truth, [], 1.0), Flat("grey.png", truth, [])]
    (flat, edges) = evaluate(scenes, [GrayEdge("Gray-world", 0, 1, 0), GrayEdge("Gray-Edge", 1, 1, 1)])
    assert flat.guessed.tolist() == [False, True, False]
    assert edges.guessed.all()
    np.testing.assert_allclose(np.stack([*flat.estimates, *edges.estimates]), 3**-0.5)
