"""Log-chroma: a light shifts the histogram, the torus is cut where no light lies, gradients are derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning import log_chroma
from evaluation.learning.log_chroma import BINS, LogChroma, crossentropy, likelihood, moments
from evaluation.metrics import recovery_error
from foundation.errors import InputError
from tests.evaluation.learning.made_up_world import world
from tests.evaluation.made_scenes import Made

pytestmark = pytest.mark.slow

LEARNER = LogChroma(pretraining=8, training=32)


def extracted(image: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    found = LEARNER.features(image)
    assert found is not None
    return found


def taught_by(scenes: list[Made]) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.float64]]:
    lights = np.stack([scene.truth for scene in scenes])
    return np.stack([extracted(scene.image) for scene in scenes]), lights / lights.sum(axis=1, keepdims=True)


def test_a_light_shifts_both_histograms() -> None:
    # Powers of two and whole bins: no pixel comes to lie on the other side of a bin's edge, none below the least value.
    (scene,) = world(1)
    image = scene.image / scene.image.max() * 0.5 + 0.25
    image[0, 0] = 4
    plain = extracted(image)
    lit = extracted((image * np.exp([-3 / 32, 0, 5 / 32])).astype(np.float32))
    shifted = np.roll(plain, (3, -5), axis=(1, 2))
    for channel, allowed in ((0, 0.02), (1, 0.05)):
        differ = np.abs(lit[channel].astype(int) - shifted[channel]).sum() / 2
        assert differ <= allowed * plain[channel].sum()
        assert np.abs(lit[channel].astype(int) - plain[channel]).sum() / 2 > 0.5 * plain[channel].sum()


def test_chromas_are_counted_in_bins_of_a_32nd_on_a_torus_of_four() -> None:
    # u = ln(g / r) and v = ln(g / b), in 32nds: (3, -2), and (65, -64), which lies a torus of 128 from (65, 64).
    steps = np.array([[-3, 0, 2], [-65, 0, 64], [0, 0, 0], [0, 0, 0]], dtype=np.float64) / 32
    pixels = (np.exp(steps) * [[0.5], [0.5], [2**-8], [0.9]]).astype(np.float32)
    pixels[3, 1] = 2**-8.001
    counts = log_chroma._histogram(pixels, 2.0**-8)
    assert counts.sum() == 3
    assert (counts[3, 126], counts[65, 64], counts[0, 0]) == (1, 1, 1)
    assert counts.dtype == np.uint16


def test_deviations_are_from_the_usable_of_eight_neighbours() -> None:
    random = np.random.default_rng(0)
    image, used = random.random((5, 6, 3)).astype(np.float32), random.random((5, 6)) < 0.6
    used[:2, :3] = False
    found = log_chroma._deviations(image, used)
    for row, column in np.ndindex(5, 6):
        near = [
            np.abs(image[y, x] - image[row, column])
            for y in range(max(row - 1, 0), min(row + 2, 5))
            for x in range(max(column - 1, 0), min(column + 2, 6))
            if used[y, x] and (y, x) != (row, column)
        ]
        np.testing.assert_allclose(found[row, column], np.mean(near, axis=0) if near else 0, rtol=1e-5, atol=1e-7)


def test_the_penalty_of_what_is_scaled_is_its_squared_length() -> None:
    scaled = np.random.default_rng(1).normal(0, 1, (BINS, BINS))
    spectrum = np.fft.rfft2(scaled) * log_chroma._scale(0.3, 0.002)
    # The authors' penalty of a filter: its squares, and an eighth of its squared differences, of all coefficients.
    full = np.fft.fft2(np.fft.irfft2(spectrum, s=(BINS, BINS)))
    turn = np.abs(1 - np.exp(2j * np.pi * np.arange(BINS) / BINS)) ** 2
    penalty = (np.abs(full) ** 2 * (0.3 * (turn[:, None] + turn) / 8 + 0.002)).sum()
    assert penalty == pytest.approx(((scaled - scaled.mean()) ** 2).sum(), rel=1e-9)
    assert abs(full[0, 0]) < 1e-9


def relit(count: int, reds: npt.NDArray[np.float64], seed: int = 0) -> list[Any]:
    """Return the scenes of the world under lights whose red over green and blue over green are given, (N, 2)."""
    scenes = world(count, seed)
    lights = np.stack([reds[:, 0], np.ones(count), reds[:, 1]], axis=1)
    return [
        replace(scene, truth=light, image=(scene.image / scene.truth * light).astype(np.float32))
        for scene, light in zip(scenes, lights, strict=True)
    ]


def test_rare_lights_at_the_end_of_the_range_are_not_wrapped() -> None:
    # As with the 1Ds Mark III: many lights at one end, few at the other, and more than half a torus in between.
    rng = np.random.default_rng(2)
    logs = np.concatenate([rng.uniform(-0.05, 0.05, 48), rng.uniform(1.2, 1.3, 12)])
    scenes = relit(60, np.exp(np.stack([logs / 3, -logs], axis=1)))
    method = LEARNER.fit(scenes[::2])
    found = np.stack([method.estimate(scene.image) for scene in scenes[1::2]])
    errors = recovery_error(found, np.stack([scene.truth for scene in scenes[1::2]]))
    assert errors.max() < 12
    assert np.median(errors) < 3


def test_lights_that_span_more_than_the_torus_get_wider_bins() -> None:
    rng = np.random.default_rng(3)
    logs = rng.uniform(-1.3, 1.3, 60)
    scenes = relit(60, np.exp(np.stack([logs, -logs], axis=1)))
    method = LEARNER.fit(scenes[:48])
    errors = [float(recovery_error(method.estimate(scene.image), scene.truth)) for scene in scenes[48:]]
    assert np.median(errors) < 3
    arrays = method.model.arrays()
    again = replace(method, model=LEARNER.restore(arrays))
    assert again.estimate(scenes[50].image) == pytest.approx(method.estimate(scenes[50].image))
    with pytest.raises(ValueError, match="bins of"):
        LEARNER.restore({**arrays, "grid": np.array([0.5, 0.1])})
    with pytest.raises(InputError, match=r"3\.\d\d natural.*tells 3"):
        LEARNER.fit(relit(60, np.exp(np.stack([logs * 1.5, -logs], axis=1))))


def hat(mean: tuple[float, float], covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a normal distribution (1, 64, 64), wrapped by its nearest turn."""
    bins = np.stack(np.meshgrid(np.arange(BINS), np.arange(BINS), indexing="ij"), axis=-1) - np.array(mean)
    away = (bins + BINS / 2) % BINS - BINS / 2
    likely = np.exp(-0.5 * np.einsum("...i,ij,...j", away, np.linalg.inv(covariance), away))
    return (likely / likely.sum())[None]


@pytest.mark.parametrize("mean", [(30.3, 20.0), (0.4, 63.7)])
def test_moments_of_a_normal_distribution_anywhere_on_the_torus(mean: tuple[float, float]) -> None:
    covariance = np.array([[6.0, 2.0], [2.0, 3.0]])
    found = moments(hat(mean, covariance))
    apart = (found.mean[0] - mean + BINS / 2) % BINS - BINS / 2
    np.testing.assert_allclose(apart, 0, atol=1e-6)
    np.testing.assert_allclose(found.covariance[0], [6, 3, 2], rtol=1e-3)


def softmax(response: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    likely = np.exp(response - response.max())
    return likely / likely.sum()


@pytest.mark.parametrize("loss", ["likelihood", "cross-entropy"])
def test_derivatives_are_what_finite_differences_say(loss: str) -> None:
    rng = np.random.default_rng(0)
    response = np.log(hat((62.8, 5.2), np.array([[9.0, 2.0], [2.0, 5.0]])) + 1e-4) + rng.normal(0, 0.3, (1, BINS, BINS))
    place = np.array([[66.0, 3.0]])

    def value(given: npt.NDArray[np.float64]) -> tuple[float, npt.NDArray[np.float64]]:
        likely = softmax(given)
        if loss == "cross-entropy":
            losses, slopes = crossentropy(np.log(likely), likely, place)
        else:
            losses, slopes = likelihood(likely, moments(likely), place, 1.0)
        return float(losses.sum()), slopes

    _, slope = value(response)
    for _ in range(5):
        step = rng.normal(0, 1, response.shape)
        expected = (value(response + 1e-5 * step)[0] - value(response - 1e-5 * step)[0]) / 2e-5
        assert float((slope * step).sum()) == pytest.approx(expected, rel=1e-4)


def test_the_likelihood_is_least_at_the_truth() -> None:
    likely = hat((20.0, 30.0), np.eye(2) * 1e-3)
    (hit,), _ = likelihood(likely, moments(likely), np.array([[20.0, 30.0 + BINS]]), 1.0)
    (miss,), _ = likelihood(likely, moments(likely), np.array([[24.0, 30.0]]), 1.0)
    assert hit == pytest.approx(0, abs=1e-3)
    assert miss == pytest.approx(8, rel=1e-2)


def test_an_image_that_stands_for_three_is_as_three() -> None:
    known, lights = taught_by(world(12))
    few, their_lights = taught_by(world(2, seed=5))
    # Of 12 images worth 4, each of the two stands for three.
    learner = replace(LEARNER, pretraining=2, training=8)
    tuned = learner.tune(learner.fit_features(known, lights), few, their_lights, worth=4)
    both = learner.fit_features(np.concatenate([known, *[few] * 3]), np.concatenate([lights, *[their_lights] * 3]))
    assert recovery_error(tuned.lights(known), both.lights(known)).max() < 0.1
