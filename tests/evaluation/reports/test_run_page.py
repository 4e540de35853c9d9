"""Report of a run: its figures and pictures."""

from __future__ import annotations

import re
from html import unescape
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.comparing import MatchedErrors, error_scatter
from evaluation.experiments.run_folder import describe_run
from evaluation.experiments.running import evaluate
from evaluation.methods import GrayEdge
from evaluation.reports.run_page import chosen_images, developed_pictures, error_curves, error_planes, run_page
from evaluation.results.result import Result
from tests.evaluation.made_up import MixedWall, Wall, as_set, walls
from tests.foundation.test_pages import checked

NAMES = ["a $\\bad{x$ b", "$y_1$", "_mine"]


def texts(svg: bytes) -> list[str]:
    """Return the texts of an SVG in their order."""
    return [
        unescape(re.sub("<[^>]+>", "", element)).strip() for element in re.findall(r"(?s)<text.*?</text>", svg.decode())
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("error")
def test_figures_show_names_literally() -> None:
    random = np.random.default_rng(0)
    results = [
        Result(
            name, np.ones((5, 3)), {"recovery": random.random(5), "reproduction": random.random(5)}, np.zeros(5, bool)
        )
        for name in NAMES
    ]
    curves = texts(error_curves(results, "recovery"))
    planes = texts(error_planes(results, random.random((5, 3)) + 0.1, "recovery"))
    matched = MatchedErrors(("$a$", "_b"), "recovery", tuple("abcde"), random.random(5), random.random(5))
    scatter = texts(error_scatter(matched))
    assert all(name in curves and name in planes for name in NAMES)
    assert {"$a$: error, degrees", "_b: error, degrees"} <= set(scatter)


METHODS = [GrayEdge("Gray-world", 0, 1, 0, 0), GrayEdge("White <Patch>", 0, np.inf, 0, 0)]


def panels(jpeg: bytes) -> list[npt.NDArray[Any]]:
    """Return the pictures of a row as (H, W, 3) RGB, without the gaps between them."""
    row = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert row is not None
    side = (row.shape[1] - 12) // 3
    return [row[:, start : start + side, ::-1].astype(int) for start in (0, side + 6, 2 * side + 12)]


def cast(picture: npt.NDArray[Any]) -> float:
    """Return the largest mean difference between two channels, in codes."""
    means = picture.reshape(-1, 3).mean(axis=0)
    return float(means.max() - means.min())


def test_only_correct_estimate_removes_cast() -> None:
    scene = Wall("wall", np.array([2.0, 1.0, 0.5]))
    (wrong_picture, right) = developed_pictures(scene, [np.array([0.5, 1.0, 2.0]), scene.truth])
    raw, by_wrong, by_truth = panels(wrong_picture)
    assert cast(by_truth) < 3 < 40 < cast(raw) < cast(by_wrong)
    assert raw[..., 0].mean() > raw[..., 2].mean()
    np.testing.assert_allclose(panels(right)[1], by_truth, atol=12)


def test_corrects_several_illuminants_by_pixel() -> None:
    scene = MixedWall("mixed", np.array([[3.0, 1, 1], [1, 1, 3]]))
    (jpeg,) = developed_pictures(scene, [scene.truth])
    _, by_mean, by_pixel = panels(jpeg)
    outer = np.s_[:, [4, -5]]
    assert cast(by_pixel[outer]) < 6
    assert cast(by_mean[:, 4]) > 20


def test_masked_pixels_are_grey_and_ignored_in_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = MixedWall("masked", np.array([[1.0, 1, 1], [1, 1, 1]]), masked=True)
    read = MixedWall.read

    def glaring(self: MixedWall) -> Any:
        image, mask = read(self)
        image[:, :4] *= 1000
        return image, mask

    monkeypatch.setattr(MixedWall, "read", glaring)
    (jpeg,) = developed_pictures(scene, [np.ones(3)])
    raw = panels(jpeg)[0]
    assert raw[:, 5] == pytest.approx(118, abs=8)  # 0.18 in the curve of sRGB.
    assert raw[:, -5].min() > 240


@pytest.mark.parametrize("value", [0.0, 1e-9])
def test_black_image_and_estimate_with_zero_channel(value: float) -> None:
    class Black(Wall):
        def read(self) -> tuple[npt.NDArray[np.float32], None]:
            return np.full((5, 5, 3), value, np.float32), None

    assert len(developed_pictures(Black("black", np.array([1.0, 1, 0])), [np.array([0.0, 1, 1])])) == 1


def test_white_percentile_and_half_masked_pixels() -> None:
    class Ramp(Wall):
        def read(self) -> Any:
            image = np.repeat(np.linspace(0, 1, 200, dtype=np.float32)[None, :, None], 170, axis=0)
            mask = np.zeros((170, 200), bool)
            mask[:20] = True
            return np.repeat(image, 3, axis=2) * np.array([2, 1, 0.5], np.float32), mask

    (jpeg,) = developed_pictures(Ramp("ramp", np.array([2, 1, 0.5])), [np.array([1, 1, 0.5])])
    raw, codes, right = panels(jpeg)
    middle = right[100, :, 1]
    # sRGB of half of white is 188 (IEC 61966-2-1); white is reached two hundredths before the end.
    assert middle[round(0.98 * 199 / 2)] == pytest.approx(188, abs=3)
    assert middle[round(0.94 * 199)] < 252 <= middle[round(0.98 * 199)]
    # By an estimate with half the red, red stays twice as bright: a quarter of white, 137, is then a half.
    at = round(0.98 * 199 / 4)
    assert right[100, at] == pytest.approx([137] * 3, abs=4)
    assert codes[100, at] == pytest.approx([188, 137, 137], abs=5)
    assert raw[100, at] == pytest.approx([188, 137, 99], abs=5)
    assert right[4, 20:180] == pytest.approx(np.full((160, 3), 118), abs=3)


def test_chooses_worst_and_median_images() -> None:
    def chosen(*errors: float) -> tuple[tuple[int, ...], tuple[int, ...]]:
        values, count = np.array(errors), len(errors)
        return chosen_images(Result("M", np.ones((count, 3)), {"recovery": values}, values < 0), "recovery")

    assert chosen(5, 1, 9, 3, 2, 8, 4) == ((2, 5, 0), (6, 3))  # The median is 4; 5 is shown already.
    assert chosen(1.0) == ((0,), ())
    # The median is 0.4, from which 0.7 is less far in binary numbers.
    assert chosen(0.1, 0.7, 5, 6, 7, 0, 0, 0)[1] == (0, 1)


@pytest.mark.slow
def test_page_of_many_methods_is_closed() -> None:
    data = as_set((*walls(6), MixedWall("mixed & <odd>", np.array([[2.0, 1, 1], [1, 1, 1]]))))
    results = evaluate(data.scenes, METHODS)
    run = describe_run(data, results, [{"name": "A", "settings": {"p": [1] * 99}}, {"name": "B", "class": "x:Y"}])
    pictures = {
        (number, index): developed_pictures(data.scenes[index], [result.estimates[index]])[0]
        for number, result in enumerate(results)
        for index in sum(chosen_images(result, "recovery"), ())
    }
    text = run_page(run, "recovery", pictures)
    page = checked(text)
    assert text.count("<details") == len(METHODS)
    assert len(re.findall(r"src='data:image/jpeg", text)) == len(pictures)
    for words in ("White <Patch>", "as it was drawn", "MAE_illum", "1 under several illuminants", "mixed & <odd>"):
        assert words in page.text
    assert "methods are shown" not in page.text
