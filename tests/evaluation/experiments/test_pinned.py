"""Numbers of statistics, comparisons, folds, descriptions and figures, to the last digits, with values at limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from evaluation import metrics
from evaluation.experiments import bootstrap, comparing, cross_validation, folds
from evaluation.experiments.describing import description, report
from evaluation.experiments.paper import colour_reduction, material, reporting, table1
from evaluation.experiments.running import evaluate
from evaluation.experiments.transfer import outcome
from evaluation.learning.constant_light import median_light
from evaluation.methods.standard import standard_methods
from evaluation.reports import run_page
from evaluation.results.files import MethodErrors, errors_csv, several_lights_csv
from evaluation.results.result import Result, images_csv, read_light, table_csv
from foundation.errors import CropError
from tests.evaluation.experiments.describing.scenes import Made, MadeMixture, made_set, random_set
from tests.evaluation.experiments.one_sample import intervals
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


def figures_in(compared: Sequence[bootstrap.Compared]) -> Any:
    """Return all numbers of statistics that were compared."""
    return np.array([part for one in compared for part in (one.one, one.other, *one.difference, *one.ratio)])


def errors(count: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).gamma(1.5, 2, count)


SAMPLES: dict[str, list[float]] = {
    "one": [2.5],
    "two": [1.0, 4.0],
    "ties": [1, 1, 1, 2, 2, 3, 3, 3, 3, 9],
    "zeros": [0, 0, 0, 0, 0],
    "zeros and more": [0, 0, 0, 1, 5],
    "at three": [2.9, 3.0, 3.1, 3.0],
    "skewed": errors(23).tolist(),
}


def test_statistics_and_intervals(pinned: Pinned) -> None:
    found: dict[str, Any] = {}
    for name, values in SAMPLES.items():
        given, other = np.array(values), np.array(values)[::-1] * 1.1 + 0.1
        groups = [str(place // 2) for place in range(len(values))]
        sample = bootstrap.ErrorSample.of(given)
        found[name] = {
            "summary": metrics.summarise(given),
            "percentiles": metrics.percentiles(given, (0, 1, 12.5, 50, 99, 100)),
            "left out": np.array(sample.without_each()),
            "groups left out": np.array(sample.without_each(bootstrap.numbered(groups)).ravel().tolist())
            if len(values) > 2
            else None,
            "intervals": intervals(given, seed=3, count=50),
            "paired": figures_in(bootstrap.paired(given, other, seed=1, count=60, level=0.8)),
            "paired by groups": figures_in(bootstrap.paired(given, other, count=40, groups=groups)),
            "independent": figures_in(bootstrap.independent(given, [*other, 3.0], seed=2, count=30)),
            "figures": outcome_of(lambda given=given: bootstrap.bca(2.0, np.sort(given), [given], 0.9)),
        }
    found["refused"] = [
        outcome_of(call)
        for call in (
            lambda: metrics.summarise([]),
            lambda: metrics.summarise([1, np.nan, np.inf]),
            lambda: bootstrap.ErrorSample.of([]),
            lambda: bootstrap.ErrorSample.of([1, np.nan]),
            lambda: bootstrap.ErrorSample.of([1, np.inf]),
            lambda: bootstrap.paired([1, 2], [1]),
            lambda: bootstrap.paired([1, 2], [1, 3], groups=["a"]),
            lambda: bootstrap.paired([1, 2], [1, 3], groups=["a", "a"]),
            lambda: intervals([1, 2], count=0),
            lambda: intervals([1, 2, 4], count=1),
            *(lambda level=level: bootstrap.bca(1, np.ones(3), [], level) for level in (0.0, 1.0, 0.5)),
        )
    ]
    found["resamples"] = np.concatenate(list(bootstrap.resamples(5, 1, 7)))
    found["resamples of groups"] = np.concatenate(list(bootstrap.resamples(5, 1, 7, np.array([0, 1, 1, 2, 0]))))
    pinned("statistics and intervals of errors", found)


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


def method_errors(name: str, images: str, values: Floats, groups: str | None = None, turned: float = 0) -> MethodErrors:
    truths = np.tile([1.0, 2, 1 + turned], (len(values), 1))
    kinds: Any = {"recovery": values / 2, "reproduction": values}
    return MethodErrors(
        name, tuple(images), truths, kinds, np.zeros(len(values), bool), None, None if groups is None else tuple(groups)
    )


def test_comparisons(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = recorded_figures(monkeypatch)
    letters = "abcdefghijklmnop"
    one = method_errors("A", letters, errors(16), "aabbccddeeffgghh")
    two = method_errors("B", letters[2:] + "xyz", errors(17, 1), "aabbccddeeffgghhi")
    steps = np.where(np.arange(16) % 3, 1e-6, 3e-6) * np.tile([1, -1], 8)
    near = method_errors("C", letters, errors(16) + steps)
    turned = [method_errors("E", letters, errors(16), None, by) for by in (0, 3e-4, 6e-4, 0.01)]
    kinds: tuple[metrics.ErrorKind, ...] = ("recovery", "reproduction")
    pairs = [
        comparing.match(one, two, ("A", "B"), kinds[1]),
        comparing.match(one, near, ("A", "C"), kinds[0]),
        comparing.match(replace(one, groups=None), replace(two, groups=None), ("A", "B"), kinds[0]),
        comparing.match(one, method_errors("D", letters, errors(16) * 0.5, "a" * 16), ("A", "D"), kinds[1]),
    ]
    made = comparing.compare(pairs, seed=1, level=0.9)
    points = np.array([0.0, 0.01, 0.02, 1, 1, 1.02, 5, 5, 20]), np.array([0.005, 0.3, 0.31, 1, 0.9, 1.1, 20, 20.1, 4])
    comparing.error_scatter(points[0], points[1], ("one", "other"), {place: f"image {place}" for place in range(9)})
    comparing.error_scatter(np.full(3, 2.0), np.array([2.0, 2.1, 1.9]), ("one", "other"), {0: "a", 1: "b"})
    found: dict[str, Any] = {
        "made": [[pair.images, pair.missing, pair.groups, np.array([*pair.one, *pair.other])] for pair in pairs],
        "tests": [[one.test, one.p_holm, figures_in(one.statistics)] for one in made],
        "cases": [[pair.cases, pair.case_errors()] for pair in pairs],
        "largest": [comparing.largest_differences(pair, count) for pair in pairs for count in (0, 3, 99)],
        "rises": comparing._rises(np.maximum(points[0], 0.01), np.maximum(points[1], 0.01), 0.009, 22.0),
        "holm": [comparing.holm(given) for given in ([], [0.2, 0.2], [0.5, 0.01, 0.04, 0.9])],
        "signed ranks": [
            comparing.signed_rank([1, 2, 3, 4.0], [1, 2, 3, 4.0 + apart]) for apart in (0, 1e-6, 2e-6, 2.1e-6, 1)
        ],
        "refused": [
            outcome_of(lambda other=other: comparing.match(one, other, ("A", "E"), "recovery").missing)
            for other in turned
        ],
        "figures": figures,
    }
    # Of differences near 1e-6 resamples know only that they are small.
    pinned("comparisons of methods", found, nothing=1e-5)


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
                table_csv(results, "recovery"),
                images_csv(scenes, results),
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


def test_forest_plots(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = recorded_figures(monkeypatch)
    bounded = outcome.BoundedFigure
    lines = [
        outcome.ForestLine("head"),
        outcome.ForestLine("whole", (bounded(0.8, 0.5, 1.1), bounded(1.3, 1.0, 30.0)), 0),
        outcome.ForestLine("part", (bounded(np.nan, np.nan, np.nan), bounded(2.0, 0.01, np.nan)), 1, whole=False),
        outcome.ForestLine("zero", (bounded(0.0, 0, 1), bounded(1.0, 1, np.inf)), 2),
    ]
    outcome.forest_plot(lines, ["Median", "Mean"])
    outcome.forest_plot(lines[:1], ["Median"])
    ranges = [outcome._range(lines[:end]) for end in (1, 2, 3, 4)]
    ticks = [outcome.round_numbers(*ends) for ends in ((0.77, 1.3), (0.6, 2.2), (0.01, 40.0), (0.99, 1.01), (0.1, 1.0))]
    pinned("forest plots", [figures, ranges, ticks])


def described() -> list[description.DataDescription]:
    """Return descriptions of three sets: random, with clipped and masked images of odd sizes and a mixture, flat."""
    random = np.random.default_rng(4)
    scenes: list[Made] = []
    for number in range(7):
        height, width = 60 + 13 * number, 140 - 9 * number
        light = np.array([0.6, 1, 0.4 + 0.05 * number])
        signal = np.exp(random.uniform(3, 8, (-(-height // 16), -(-width // 16), 1)))
        flat = signal.repeat(16, axis=0).repeat(16, axis=1)[:height, :width] * light
        image = np.rint(np.maximum(flat + random.normal(0, 1, flat.shape) * np.sqrt(4 + 0.5 * flat), 0)).astype(
            np.uint16
        )
        mask = np.zeros((height, width), bool)
        mask[: 5 * number] = True
        scenes.append(Made(f"noisy {number}", light, image, 2500.0, mask if number else None))
    mixed = MadeMixture(
        "mixed", np.array([1.0, 1, 1]), scenes[2].image, 2500.0, None, np.array([[2.0, 1, 1], [1, 1, 2]])
    )
    grey = [Made(f"grey {at}", np.array([1.0, 1, 1]), np.full((9, 70, 3), 100.0 * at)) for at in range(4)]
    sets = [random_set("random", 9), made_set("noisy", [*scenes, mixed]), made_set("grey", grey)]
    return [description.describe(data, side) for data, side in zip(sets, (64, 10, 4), strict=True)]


def test_descriptions(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = recorded_figures(monkeypatch)
    made = described()
    random = np.random.default_rng(0)
    lights = random.uniform(0.3, 2, (40, 3))
    compared = report.compare_figures(made[0], made[1], 2)
    found: dict[str, Any] = {
        "described": [
            *([one.sizes, one.masked, one.mixed, one.groups, one.luminance, one.chroma] for one in made),
            *([one.noise, one.noise_unit, one.values] for one in made),
        ],
        "figures": [description.figures(one) for one in made],
        "lights": [description.light_distribution(lights[:count]) for count in (1, 2, 3, 40)],
        "energy": [
            description.energy_distance(lights[:20], lights[20:], seed=1),
            description.energy_distance(np.ones((4, 2)), np.ones((3, 2))),
        ],
        "compared": [[one.quantity.name, *one.change, one.scale, one.distance, one.p] for one in compared],
        "drawn": figures,
    }
    pinned("descriptions of data sets", found, same=1e-5, nothing=1e-7)


def test_parts_of_descriptions(pinned: Pinned) -> None:
    random = np.random.default_rng(7)
    blocks = np.empty((900, 2, 3))
    blocks[:, 0] = np.exp(random.uniform(-5, 0, (900, 1)))
    blocks[:, 1] = np.sqrt(1e-6 + 1e-3 * blocks[:, 0]) * random.uniform(1, 1.3, (900, 1))
    image = random.uniform(1, 1000, (70, 45, 3))
    image[10, 10] = np.nan
    mask = random.random((70, 45)) < 0.004
    found = {
        "noise": [
            description.relative_noise(blocks[:count], least) for count in (9, 10, 11, 900) for least in (-1, 0.1)
        ],
        "curves": [description.photon_transfer([blocks[:count]]) for count in (0, 30, 119, 900)],
        "narrow": description.photon_transfer([blocks[np.abs(blocks[:, 0, 0] - 0.3) < 0.2]]),
        "texture": description.photon_transfer(
            [
                blocks
                * [
                    [[1.0]],
                ]
                if False
                else blocks ** [[1.0], [0.1]]
            ]
        ),
        "blocks": [
            description.measure_blocks(image, saturation, hidden, limit)
            for saturation in (None, 999.0)
            for hidden in (None, mask)
            for limit in (3, 256)
        ],
        "usable": [
            [int(part.sum()) for part in description.usable_pixels(image, saturation, hidden)]
            for saturation in (None, 500.0, float(image[3, 3, 0]))
            for hidden in (None, mask)
        ],
        "bands": [
            list(description._bands(np.array([0, 4, 9, 9 + rows]), width))
            for rows, width in ((1, 5), (9, 40_000), (5, 1 << 18))
        ],
    }
    pinned("parts of descriptions", found, nothing=1e-8)


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
