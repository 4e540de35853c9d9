"""The numbers of an image are what can be reckoned by hand, and do not depend on light, unit or size."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.describing.description import measure_scene
from tests.evaluation.experiments.describing.scenes import Made, MadeMixture

LIGHT = np.array([0.5, 1.0, 0.75])


def numbers(reflectances: npt.NDArray[np.float64], light: npt.NDArray[np.float64] = LIGHT) -> dict[str, float]:
    return dict(measure_scene(Made("a", light, reflectances * light)).values)


def test_two_colours_by_hand() -> None:
    image = np.empty((32, 32, 3))
    image[:, :16] = 0.5
    image[:, 16:] = [0.6, 0.3, 0.1]
    found = numbers(image)
    # Chromaticities 1/3 each, and .6 .3 .1: half of each difference is the standard deviation.
    half = np.array([0.6 - 1 / 3, 1 / 3 - 0.3, 1 / 3 - 0.1]) / 2
    assert found["chroma_spread"] == pytest.approx(np.sqrt((half**2).mean()))
    assert found["log_red_spread"] == pytest.approx(np.log(2) / 2)
    assert found["log_blue_spread"] == pytest.approx(np.log(3) / 2)
    assert found["grey_red"] == pytest.approx(np.log(0.55 / 0.4))
    assert found["grey_blue"] == pytest.approx(np.log(0.3 / 0.4))
    assert found["near_grey"] == 0.5
    # Luminance is .5 and 1/3; one step in 31 side by side, none in 31 above one another.
    assert found["luminance_25"] == pytest.approx(2 / 3)
    assert found["luminance_75"] == pytest.approx(1)
    assert found["edges"] == pytest.approx(np.log(1.5) / 62)
    assert found["edges_95"] == 0
    assert np.isnan([found["exposure"], found["clipped"]]).all()


def test_luminance_percentiles_of_a_ramp() -> None:
    ramp = np.repeat(np.linspace(0, 1, 4096).astype(np.float64), 3).reshape(64, 64, 3)
    found = numbers(ramp)
    for percent in (1, 5, 25, 50, 75, 95):
        assert found[f"luminance_{percent}"] == pytest.approx(percent / 99, abs=0.001)


def test_light_unit_and_size_do_not_matter() -> None:
    image = np.exp(np.random.default_rng(1).normal(-2, 0.7, (64, 64, 3)))
    first = numbers(image)
    repeated = np.repeat(np.repeat(image, 5, axis=0), 3, axis=1)
    larger = numbers(repeated * 1000, np.array([3.0, 1, 7]))
    for name in first.keys() - {"noise", "exposure", "clipped"}:
        assert larger[name] == pytest.approx(first[name]), name


def test_exposure_and_clipping_leave_masked_pixels_out() -> None:
    image = np.full((50, 40, 3), 200, np.uint16)
    image[:10] = [100, 4000, 100]
    image[10:20, :20] = [100, 900, 100]
    mask = np.zeros((50, 40), bool)
    mask[:5] = True
    found = measure_scene(Made("a", LIGHT, image, 1000.0, mask))
    assert found.values["clipped"] == pytest.approx(200 / 1800)
    assert found.values["exposure"] > 0.99
    assert found.masked == pytest.approx(0.1)
    assert found.size == (40, 50)
    mask[:10] = True
    found = measure_scene(Made("a", LIGHT, image, 1000.0, mask))
    assert found.values["clipped"] == 0
    assert found.values["exposure"] == pytest.approx(0.9, abs=0.001)


def test_histograms_hold_every_cell_once() -> None:
    image = np.exp(np.random.default_rng(2).normal(-2, 1.5, (64, 64, 3)))
    found = measure_scene(Made("a", LIGHT, image * LIGHT))
    assert found.luminance.sum() == pytest.approx(1)
    assert found.chroma.sum() == pytest.approx(1)


@pytest.mark.parametrize("image", [np.zeros((20, 20, 3)), np.full((20, 20, 3), 50.0)])
def test_nothing_to_measure_is_not_a_number(image: npt.NDArray[np.float64]) -> None:
    found = measure_scene(Made("a", LIGHT, image, 40.0))
    assert np.isnan([found.values[name] for name in ("chroma_spread", "luminance_50", "edges", "noise")]).all()
    assert found.chroma.sum() == 0
    np.testing.assert_allclose(found.lights, [LIGHT / LIGHT.sum()])


def test_all_lights_of_a_mixture_are_kept() -> None:
    lights = np.array([[0.6, 1.0, 0.3], [0.3, 1.0, 0.8]])
    found = measure_scene(MadeMixture("m", lights.mean(axis=0), np.ones((20, 20, 3)), lights=lights))
    np.testing.assert_allclose(found.lights, lights / lights.sum(axis=1, keepdims=True))
