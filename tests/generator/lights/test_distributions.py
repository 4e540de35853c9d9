"""Distributions of illuminants, files of ground truths, and drawn illuminants."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.special import chdtrc, kolmogorov, ndtr

from foundation.errors import FormatError, InputError
from generator.lights.choices import DrawnLights
from generator.lights.distributions import (
    Distribution,
    Fitted,
    Gaussian,
    Uniform,
    is_ground_truth,
    load_ground_truths,
    parse_distribution,
)
from generator.lights.gamut import Gamut, rb_of
from generator.lights.lighting import LightChoice
from generator.philox import CHROMATICITIES, words
from tests.data_files import available

CUBEPLUS = [0.16238344, 0.45326359, 0.38435297]
NUS = [0.507292583011997, 0.809736795789161, 0.294924662865143]
# Number of ground truths and the first of them, by file.
REAL = {
    "gt/cubeplus_12_rows.csv": (12, CUBEPLUS),
    "gt/nus_18_rows.csv": (18, NUS),
    "gt/cubeplus_gt_1707.csv": (1707, CUBEPLUS),
    "gt/nus8_gt_1853.csv": (1853, NUS),
}


@pytest.mark.parametrize(
    "text",
    [
        "File,GT_R,GT_G,GT_B\na.png,1,2,3\n\nb.png,0.5,0,1e-3\n",
        'image,source,illumination,r,g,b\n0.png,"a,b",7,1,2,3\n1.png,c,8,0.5,0,0.001\n',
        "1 2 3\n0.5 0 0.001\n",
        "\ufeff 1,2,3\r\n0.5;0;0.001\r\n",
    ],
)
def test_reads_every_layout_of_ground_truths(tmp_path: Path, text: str) -> None:
    path = tmp_path / "gt"
    path.write_bytes(text.encode())
    np.testing.assert_array_equal(load_ground_truths(path), [[1, 2, 3], [0.5, 0, 0.001]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("1 2 3\n\n1 x 3\n", "line 3: '1 x 3' is not a ground truth"),
        ("1 2 -3\n", "expected numbers ≥ 0"),
        ("nan 2 3\n", "expected numbers ≥ 0"),
    ],
)
def test_reports_line_of_invalid_ground_truth(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "gt.csv"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        load_ground_truths(path)


@pytest.mark.parametrize("path", available(*REAL), ids=lambda path: path.name)
def test_reads_published_ground_truths(path: Path) -> None:
    lights = load_ground_truths(path)
    number, first = REAL[f"gt/{path.name}"]
    assert lights.shape == (number, 3)
    assert lights[0].tolist() == first


CORNERS = np.array([[0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8]])
GAMUT = Gamut(np.array([*CORNERS, [0.3, 0.4, 0.3]]))


def draws(distribution: Distribution, count: int) -> npt.NDArray[np.float64]:
    return distribution.draw(words(3, np.arange(count), 0, 0, CHROMATICITIES))


def drawn_chromaticities(choice: DrawnLights, pictures: int) -> npt.NDArray[np.float64]:
    mixtures = [lighting.mixtures[0] for position in range(pictures) for lighting in choice.lightings_of(position)]
    return rb_of(np.array([np.asarray(mixture.weights) @ GAMUT.white[list(mixture.lights)] for mixture in mixtures]))


def uniformity_probability(values: npt.NDArray[np.float64]) -> float:
    """Return the p-value of the Kolmogorov test that values (N,) are uniform in 0 … 1."""
    steps = np.arange(len(values) + 1) / len(values)
    deviation = np.maximum(steps[1:] - np.sort(values), np.sort(values) - steps[:-1]).max()
    return float(np.asarray(kolmogorov(np.sqrt(len(values)) * deviation), dtype=np.float64))


def test_uniform_is_uniform_over_triangle() -> None:
    rb = draws(Uniform(), 40_000)
    assert (rb > 0).all()
    assert (rb.sum(axis=1) < 1).all()
    # Sixteen congruent triangles; a true sampler fails one time in 10⁵.
    i, j = (np.floor(4 * rb)).astype(int).T
    upper = (4 * rb - np.stack([i, j], axis=1)).sum(axis=1) > 1
    counts = np.bincount((i * 4 + j) * 2 + upper, minlength=32)
    expected = len(rb) / 16
    assert chdtrc(15, ((counts[counts > 0] - expected) ** 2 / expected).sum()) > 1e-5
    assert (counts > 0).sum() == 16


def test_gaussian_has_its_moments() -> None:
    rb = draws(Gaussian(0.3, 0.25, 0.02, 0.05, -0.8), 20_000)
    # Standard errors: sd / √20000 of means, about 0.7 % of deviations, 0.003 of the correlation; six of them.
    assert abs(rb[:, 0].mean() - 0.3) < 6 * 0.02 / 141
    assert abs(rb[:, 1].mean() - 0.25) < 6 * 0.05 / 141
    np.testing.assert_allclose(rb.std(axis=0), [0.02, 0.05], rtol=0.03)
    standard = (rb - rb.mean(axis=0)) / rb.std(axis=0)
    assert (standard[:, 0] * standard[:, 1]).mean() == pytest.approx(-0.8, abs=0.02)
    assert uniformity_probability(ndtr((rb[:, 1] - 0.25) / 0.05)) > 1e-5


def test_fit_has_moments_of_data() -> None:
    rng = np.random.default_rng(1)
    clusters = np.concatenate([rng.normal([0.2, 0.4], 0.005, (300, 2)), rng.normal([0.5, 0.1], 0.005, (100, 2))])
    truths = 900 * np.stack([clusters[:, 0], 1 - clusters.sum(axis=1), clusters[:, 1]], axis=1)
    rb = draws(Fitted.of(truths), 20_000)
    first = rb[:, 0] < 0.35
    # Binomial, three quarters expected: standard error 0.0031; the kernels mix hardly any over the gap.
    assert first.mean() == pytest.approx(0.75, abs=0.02)
    np.testing.assert_allclose(rb.mean(axis=0), clusters.mean(axis=0), atol=0.006)
    covariance = np.cov(clusters.T, ddof=1)
    np.testing.assert_allclose(np.cov(rb.T), covariance * (1 + 400 ** (-1 / 3)), rtol=0.08)


@pytest.mark.parametrize("truths", [[[1, 2, 3]], [[1, 2, 1], [2, 2, 2]], [[1, 1, 1], [1, 2, 1], [1, 3, 1], [1, 4, 1]]])
def test_refuses_data_without_density(truths: list[list[float]]) -> None:
    with pytest.raises(FormatError, match=r"\d ground truths of gt\.csv"):
        Fitted.of(np.array(truths, dtype=np.float64), "gt.csv")


@pytest.mark.parametrize(
    ("numbers", "is_valid"),
    [([0, 0, 1], True), ([0.5, 0.5, 0], True), ([0, 0, 0], False), ([2, -1, 1], False), ([1, 1], False)],
)
def test_ground_truth_has_three_nonnegative_numbers(numbers: list[float], is_valid: bool) -> None:
    assert is_ground_truth(numbers) is is_valid


@pytest.mark.slow
def test_drawn_lights_are_uniform_inside_gamut() -> None:
    choice = DrawnLights(GAMUT, Uniform(), 2, seed=4)
    assert isinstance(choice, LightChoice)
    assert choice.lights_each == 2
    rb = drawn_chromaticities(choice, 300)
    assert len(rb) == 600
    barycentric = np.linalg.solve(CORNERS.T, np.stack([rb[:, 0], 1 - rb.sum(axis=1), rb[:, 1]])).T
    assert barycentric.min() > -1e-6
    # For points uniform over the triangle, the smallest of three shares has the distribution 1 − (1 − 3x)².
    assert uniformity_probability(1 - (1 - 3 * np.clip(barycentric.min(axis=1), 0, 1 / 3)) ** 2) > 1e-5


@pytest.mark.slow
def test_drawn_lights_depend_on_seed_and_position() -> None:
    choice = DrawnLights(GAMUT, Uniform(), 2, seed=4)
    unpickled = pickle.loads(pickle.dumps(DrawnLights(GAMUT, Uniform(), 2, seed=4)))
    forwards = [choice.lightings_of(position) for position in range(20)]
    assert [unpickled.lightings_of(position) for position in reversed(range(20))] == forwards[::-1]
    labels = {lighting.mixtures[0].label for lightings in forwards for lighting in lightings}
    assert len(labels) == 40
    assert DrawnLights(GAMUT, Uniform(), 2, seed=5).lightings_of(0) != forwards[0]
    # A larger number of illuminants does not change the first ones.
    assert DrawnLights(GAMUT, Uniform(), 5, seed=4).lightings_of(7)[:2] == forwards[7]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("uniform:r=1", "is not a distribution"),
        ("fit:", "is not a distribution"),
        (
            "gaussian:r=.3,b=.2,sd=0",
            "'sd=0' of the distribution gaussian is invalid, expected a number from 1e-06 to 1",
        ),
    ],
)
def test_refuses_invalid_distribution(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_distribution(text)
