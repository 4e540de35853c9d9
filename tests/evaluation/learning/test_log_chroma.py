"""Log-chroma: histograms, torus, losses and gradients."""

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


def extract(image: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    features = LEARNER.features(image)
    assert features is not None
    return features


def training_data(scenes: list[Made]) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.float64]]:
    lights = np.stack([scene.truth for scene in scenes])
    return np.stack([extract(scene.image) for scene in scenes]), lights / lights.sum(axis=1, keepdims=True)


def test_illuminant_shifts_both_histograms() -> None:
    # Powers of two and whole bins: no pixel crosses the edge of a bin or the smallest value.
    (scene,) = world(1)
    image = scene.image / scene.image.max() * 0.5 + 0.25
    image[0, 0] = 4
    plain = extract(image)
    lit = extract((image * np.exp([-3 / 32, 0, 5 / 32])).astype(np.float32))
    shifted = np.roll(plain, (3, -5), axis=(1, 2))
    for channel, allowed in ((0, 0.02), (1, 0.05)):
        difference = np.abs(lit[channel].astype(int) - shifted[channel]).sum() / 2
        assert difference <= allowed * plain[channel].sum()
        assert np.abs(lit[channel].astype(int) - plain[channel]).sum() / 2 > 0.5 * plain[channel].sum()


def test_counts_chromas_in_bins_of_one_32nd() -> None:
    # u = ln(g / r) and v = ln(g / b), in 32nds: (3, -2), and (65, -64), which is (65, 64) on a torus of 128.
    steps = np.array([[-3, 0, 2], [-65, 0, 64], [0, 0, 0], [0, 0, 0]], dtype=np.float64) / 32
    pixels = (np.exp(steps) * [[0.5], [0.5], [2**-8], [0.9]]).astype(np.float32)
    pixels[3, 1] = 2**-8.001
    counts = log_chroma._histogram(pixels, 2.0**-8)
    assert counts.sum() == 3
    assert (counts[3, 126], counts[65, 64], counts[0, 0]) == (1, 1, 1)
    assert counts.dtype == np.uint16


def test_deviations_use_eight_usable_neighbours() -> None:
    random = np.random.default_rng(0)
    image, used = random.random((5, 6, 3)).astype(np.float32), random.random((5, 6)) < 0.6
    used[:2, :3] = False
    deviations = log_chroma._deviations(image, used)
    for row, column in np.ndindex(5, 6):
        differences = [
            np.abs(image[y, x] - image[row, column])
            for y in range(max(row - 1, 0), min(row + 2, 5))
            for x in range(max(column - 1, 0), min(column + 2, 6))
            if used[y, x] and (y, x) != (row, column)
        ]
        np.testing.assert_allclose(
            deviations[row, column], np.mean(differences, axis=0) if differences else 0, rtol=1e-5, atol=1e-7
        )


def test_penalty_is_squared_length_of_scaled_parameters() -> None:
    scaled = np.random.default_rng(1).normal(0, 1, (BINS, BINS))
    spectrum = np.fft.rfft2(scaled) * log_chroma._fourier_scale(0.3, 0.002)
    # Authors' penalty of a filter: squares and an eighth of the squared differences, for all coefficients.
    full = np.fft.fft2(np.fft.irfft2(spectrum, s=(BINS, BINS)))
    turn = np.abs(1 - np.exp(2j * np.pi * np.arange(BINS) / BINS)) ** 2
    penalty = (np.abs(full) ** 2 * (0.3 * (turn[:, None] + turn) / 8 + 0.002)).sum()
    assert penalty == pytest.approx(((scaled - scaled.mean()) ** 2).sum(), rel=1e-9)
    assert abs(full[0, 0]) < 1e-9


def relit(count: int, ratios: npt.NDArray[np.float64], seed: int = 0) -> list[Any]:
    """Return scenes under illuminants with red over green and blue over green, (N, 2)."""
    scenes = world(count, seed)
    lights = np.stack([ratios[:, 0], np.ones(count), ratios[:, 1]], axis=1)
    return [
        replace(scene, truth=light, image=(scene.image / scene.truth * light).astype(np.float32))
        for scene, light in zip(scenes, lights, strict=True)
    ]


def test_rare_illuminants_are_not_wrapped() -> None:
    # As for the 1Ds Mark III: many illuminants at one end, few at the other, more than half a torus apart.
    rng = np.random.default_rng(2)
    logs = np.concatenate([rng.uniform(-0.05, 0.05, 48), rng.uniform(1.2, 1.3, 12)])
    scenes = relit(60, np.exp(np.stack([logs / 3, -logs], axis=1)))
    method = LEARNER.fit(scenes[::2])
    estimates = np.stack([method.estimate(scene.image) for scene in scenes[1::2]])
    errors = recovery_error(estimates, np.stack([scene.truth for scene in scenes[1::2]]))
    assert errors.max() < 12
    assert np.median(errors) < 3


def test_widely_spread_illuminants_get_wider_bins() -> None:
    rng = np.random.default_rng(3)
    logs = rng.uniform(-1.3, 1.3, 60)
    scenes = relit(60, np.exp(np.stack([logs, -logs], axis=1)))
    method = LEARNER.fit(scenes[:48])
    errors = [float(recovery_error(method.estimate(scene.image), scene.truth)) for scene in scenes[48:]]
    assert np.median(errors) < 3
    arrays = method.model.arrays()
    restored = replace(method, model=LEARNER.restore(arrays))
    assert restored.estimate(scenes[50].image) == pytest.approx(method.estimate(scenes[50].image))
    with pytest.raises(ValueError, match="the grid is"):
        LEARNER.restore({**arrays, "grid": np.array([0.5, 0.1])})
    with pytest.raises(InputError, match=r"range of 3\.\d\d, expected at most 3"):
        LEARNER.fit(relit(60, np.exp(np.stack([logs * 1.5, -logs], axis=1))))


def hat(mean: tuple[float, float], covariance: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a normal distribution (1, 64, 64) on the torus."""
    bins = np.stack(np.meshgrid(np.arange(BINS), np.arange(BINS), indexing="ij"), axis=-1) - np.array(mean)
    offsets = (bins + BINS / 2) % BINS - BINS / 2
    probabilities = np.exp(-0.5 * np.einsum("...i,ij,...j", offsets, np.linalg.inv(covariance), offsets))
    return (probabilities / probabilities.sum())[None]


@pytest.mark.parametrize("mean", [(30.3, 20.0), (0.4, 63.7)])
def test_moments_of_normal_distribution_on_torus(mean: tuple[float, float]) -> None:
    covariance = np.array([[6.0, 2.0], [2.0, 3.0]])
    fit = moments(hat(mean, covariance))
    difference = (fit.mean[0] - mean + BINS / 2) % BINS - BINS / 2
    np.testing.assert_allclose(difference, 0, atol=1e-6)
    np.testing.assert_allclose(fit.covariance[0], [6, 3, 2], rtol=1e-3)


def softmax(response: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    probabilities = np.exp(response - response.max())
    return probabilities / probabilities.sum()


@pytest.mark.parametrize("loss", ["likelihood", "cross-entropy"])
def test_gradients_agree_with_finite_differences(loss: str) -> None:
    rng = np.random.default_rng(0)
    response = np.log(hat((62.8, 5.2), np.array([[9.0, 2.0], [2.0, 5.0]])) + 1e-4) + rng.normal(0, 0.3, (1, BINS, BINS))
    truth_bins = np.array([[66.0, 3.0]])

    def value(logits: npt.NDArray[np.float64]) -> tuple[float, npt.NDArray[np.float64]]:
        probabilities = softmax(logits)
        if loss == "cross-entropy":
            losses, slopes = crossentropy(np.log(probabilities), probabilities, truth_bins)
        else:
            losses, slopes = likelihood(probabilities, moments(probabilities), truth_bins, 1.0)
        return float(losses.sum()), slopes

    _, slope = value(response)
    for _ in range(5):
        step = rng.normal(0, 1, response.shape)
        expected = (value(response + 1e-5 * step)[0] - value(response - 1e-5 * step)[0]) / 2e-5
        assert float((slope * step).sum()) == pytest.approx(expected, rel=1e-4)


def test_likelihood_loss_is_smallest_at_ground_truth() -> None:
    probabilities = hat((20.0, 30.0), np.eye(2) * 1e-3)
    (hit,), _ = likelihood(probabilities, moments(probabilities), np.array([[20.0, 30.0 + BINS]]), 1.0)
    (miss,), _ = likelihood(probabilities, moments(probabilities), np.array([[24.0, 30.0]]), 1.0)
    assert hit == pytest.approx(0, abs=1e-3)
    assert miss == pytest.approx(8, rel=1e-2)


def test_weight_three_equals_three_copies() -> None:
    old, old_lights = training_data(world(12))
    new, new_lights = training_data(world(2, seed=5))
    # 12 images with worth 4 give each new image the weight 3.
    learner = replace(LEARNER, pretraining=2, training=8)
    tuned = learner.tune(learner.fit_features(old, old_lights), new, new_lights, worth=4)
    fitted = learner.fit_features(np.concatenate([old, *[new] * 3]), np.concatenate([old_lights, *[new_lights] * 3]))
    assert recovery_error(tuned.lights(old), fitted.lights(old)).max() < 0.1
