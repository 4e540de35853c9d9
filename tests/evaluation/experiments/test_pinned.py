"""Numbers of statistics, comparisons, folds, descriptions and figures, to the last digits, with values at limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from evaluation import metrics
from evaluation.experiments import cross_validation, folds
from evaluation.experiments.paper import colour_reduction, material, reporting, table1
from evaluation.experiments.running import evaluate
from evaluation.learning.constant_light import median_light
from evaluation.methods.standard import standard_methods
from evaluation.reports import run_page
from evaluation.results.files import errors_csv, several_lights_csv
from evaluation.results.result import Result, read_light
from foundation.errors import CropError
from tests.evaluation.made_scenes import Made
from tests.evaluation.made_up import MixedWall, walls
from tests.evaluation.shown import recorded_figures, table
from tests.pinned import Pinned

# Parts are pinned as well, since what is made of them may not show them.

pytestmark = pytest.mark.slow

Floats = npt.NDArray[np.float64]


def outcome_of(call: Callable[[], Any]) -> Any:
    """Return the result of a call, or that it was refused."""
    try:
        return call()
    except (CropError, ValueError):
        return {"refused": 1}


def errors(count: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).gamma(1.5, 2, count)


def test_errors_of_lights_and_maps(pinned: Pinned) -> None:
    random = np.random.default_rng(3)
    estimates, truths = random.uniform(0, 1, (2, 30, 3))
    estimates[0], estimates[1], truths[2], estimates[3] = [0, 0, 1], [1, 0, 0], [1, 0, 0], truths[3]
    lights = np.array([[2.0, 1, 1], [1, 1, 3], [1, 2, 1]])
    weights = random.dirichlet([0.4] * 3, (9, 7))
    weights[0, 0], weights[0, 1] = [0.5, 0.5, 0], np.nan
    lit = weights @ (lights / lights.sum(axis=1, keepdims=True))
    image = 900 * lit * random.random((9, 7, 1))
    image[3, 3] = 0
    mask = random.random((9, 7)) < 0.2
    found = {
        "recovery": metrics.recovery_error(estimates, truths),
        "reproduction": metrics.reproduction_error(estimates, truths),
        "maps": [
            metrics.measure_map(estimate, lit, weights, lights, np.nan_to_num(image), saturation, hidden)
            for estimate in (np.array([0.3, 0.4, 0.3]), np.array([1.0, 0, 0.5]), random.uniform(0, 1, (9, 7, 3)))
            for saturation in (None, 200.0)
            for hidden in (None, mask, np.ones((9, 7), bool))
        ],
        "read": [
            outcome_of(lambda one=one: read_light(one))
            for one in (
                [0, 0, 0],
                [0, 0, 1],
                [-1e-9, 1, 1],
                [1, 2],
                [1, np.inf, 1],
                "abc",
                [True] * 3,
                None,
                [1j, 1, 1],
            )
        ],
        "median": median_light(np.abs(estimates) + 0.1),
    }
    pinned("errors of lights and maps", found)


def test_folds_and_small_scenes(pinned: Pinned) -> None:
    random = np.random.default_rng(1)
    image = random.uniform(0, 1000, (13, 9, 3))
    image[2, 2], image[5:9, 4:], image[12, 8] = 900, 950, (899.999, 0, 0)
    mask = random.random((13, 9)) < 0.3
    mask[:4, :3] = True
    found = {
        "drawn": [
            outcome_of(lambda count=count, parts=parts, seed=seed: folds.draw_folds(count, parts, seed))
            for count, parts in ((7, 2), (7, 3), (7, 7), (7, 8), (7, 1), (1, 1), (2, 3))
            for seed in (0, 5)
        ],
        "grouped": [
            outcome_of(lambda names=names, parts=parts: folds.draw_folds(len(names), parts, 2, list(names)))
            for names in ("aabbbc", "aaaaab", "abcabcabcd", "aaaa")
            for parts in (2, 3, 4)
        ],
        "small": [
            list(map(np.asarray, cross_validation.shrink_image(image, side, saturation, hidden)))
            for side in (4, 6, 12)
            for saturation in (None, 900.0)
            for hidden in (None, mask)
        ],
    }
    pinned("folds and small images", found, same=1e-5, nothing=1e-5)


class Says:
    """Says lights in their order."""

    def __init__(self, name: str, *lights: Any) -> None:
        self.name, self._lights = name, iter(lights)

    def estimate(self, image: Any, saturation: float | None = None, mask: Any = None) -> Any:
        return next(self._lights, (1, 2, 1))


def test_results_and_their_page(
    pinned: Pinned, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = recorded_figures(monkeypatch)
    lights = np.array([[2.0, 1, 1], [1, 1, 3]])
    scenes = (*walls(5), MixedWall("mixed", lights), MixedWall("masked", lights, 20.0, True))
    methods: list[Any] = [
        Says("A", None, (1, 0, 0), (np.nan, 1, 1), (-1, 1, 1)),
        standard_methods()["gray-world"],
        Says("B <b>", (3, 2, 1), (3, 2, 1)),
        Says("C & d", *[(1, 1, 1)] * 7),
    ]
    names, truths = [scene.name for scene in scenes], np.array([scene.truth for scene in scenes])
    results = evaluate(scenes, methods)
    found = {
        "results": results,
        "chosen": [run_page.chosen_images(result, "reproduction") for result in results],
        "csv": [
            table(text)
            for text in (
                errors_csv(names, truths, results, ["g"] * 7),
                *several_lights_csv(names, results),
            )
        ],
        "figures": figures,
    }
    pinned("results and their page", found, nothing=1e-6)


def test_pictures_of_a_page(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(run_page, "_jpeg", seen.append)
    lights = np.array([[2.0, 1, 1], [1, 1, 3]])
    wide = Made("wide", np.array([1.0, 2, 1]), np.random.default_rng(0).uniform(0, 1, (20, 90, 3)))
    large = Made("large", np.array([1.0, 2, 0.5]), np.random.default_rng(1).uniform(0, 9, (400, 210, 3)))
    for scene in (walls(1)[0], MixedWall("a", lights), MixedWall("b", lights, None, True), wide, large):
        run_page.developed(scene, [np.array([0.2, 0.5, 0.3]), np.array([1.0, 0, 0])])
    pinned("pictures of a page", [[one.shape, one[::3, ::3].astype(np.int64)] for one in seen], same=1e-3)


def test_figures_of_many_methods(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = recorded_figures(monkeypatch)
    truths = np.random.default_rng(0).uniform(0.2, 2, (31, 3))
    for count in (1, 4, 13):
        kinds: list[Any] = [{"recovery": errors(31, at), "reproduction": errors(31, at + 50)} for at in range(count)]
        results = [Result(f"method {at}", truths, kind, truths[:, 0] > 9) for at, kind in enumerate(kinds)]
        if count == 4:
            run_page.error_curves(results, "recovery")
        run_page.error_planes(results, truths, "reproduction")
    pinned("figures of many methods", figures)


def test_parts_of_the_paper(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = recorded_figures(monkeypatch)
    random = np.random.default_rng(2)
    image = np.exp(random.normal(5, 1.5, (14, 11, 3)))
    image[0, 0] = 0
    mask = random.random((14, 11)) < 0.2
    picture = random.integers(0, 256, (23, 210, 3)).astype(np.uint8)
    light = np.array([0.4, 1.0, 0.7])
    rows = [
        table1.SizeRow(cast("Any", cell), side, {"White-Patch": side / 7})
        for cell in (("C1", "6D", "Random"), ("Random", "550D", "C1"))
        for side in (8, 64, 512)
    ]
    reporting.sizes_figure(rows, "White-Patch")
    fitted = [colour_reduction.fitted_codes(image, hidden) for hidden in (None, mask, np.ones((14, 11), bool))]
    found = {
        "codes": [[one.codes.astype(float), one.operator, one.largest] for one in fitted],
        "reduced": colour_reduction.reduce_colours(image, tuple(range(9)), mask),
        "strips": [colour_reduction.reduction_strip(picture, range(count)).astype(float)[::2] for count in (1, 3, 8)],
        "left": colour_reduction.reduction_table(picture),
        "developed": [
            material.develop(image, light, hidden, None, saturation).astype(float)
            for hidden in (None, mask)
            for saturation in (None, 300.0)
        ],
        "refused": [
            outcome_of(lambda given=given: material.develop(image, np.array([given, 1, 1]))) for given in (0.0, np.nan)
        ],
        "thinned": [list(table1.thinned(range(count), most)) for count, most in ((7, 3), (3, 7), (64, 64), (65, 64))],
        "sizes": table1.size_table(rows),
        "figures": figures,
    }
    pinned("parts of the paper's experiments", found, same=1e-5)
