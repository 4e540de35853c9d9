"""Kernel ridge regression, compared with its equations."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.learning.kernel_ridge import KernelRidge
from evaluation.learning.log_chroma import LogChroma
from tests.evaluation.learning.made_up_world import world
from tests.evaluation.made_scenes import Made

pytestmark = pytest.mark.slow

RED, GREY = (0.8, 0.1, 0.1), (0.2, 0.2, 0.2)


def counts_of(scenes: list[Made]) -> npt.NDArray[np.uint16]:
    counts: list[Any] = [KernelRidge().features(scene.image) for scene in scenes]
    return np.stack(counts)


def test_solves_equations() -> None:
    scenes = world(12)
    counts = counts_of(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    model = KernelRidge(penalty=3.0).fit_features(counts, truths)
    # Equations (K + λ I) a = y - mean y with λ = 3 · 12 / 900, with the kernel computed from distances.
    roots = np.sqrt(counts.reshape(12, -1) / counts.reshape(12, -1).sum(axis=1, keepdims=True))
    distances = ((roots[:, None] - roots[None]) ** 2).sum(axis=2)
    kernel = np.exp(-distances / 2)
    left_side = (kernel + 3 * 12 / 900 * np.eye(12)) @ model.weights
    np.testing.assert_allclose(left_side, truths[:, :2] - truths[:, :2].mean(axis=0), atol=1e-12)
    expected = truths[:, :2].mean(axis=0) + kernel @ model.weights
    np.testing.assert_allclose(model.lights(counts)[:, :2], expected, atol=1e-12)


@pytest.mark.parametrize(
    ("brightness", "red", "green"),
    # Four red pixels with brightness 1 and twelve green ones with 0.5; fractions 4 / (4 + 6) and 4 / (4 + 3) of 65535.
    [(0.0, 4, 12), (1.0, 26214, 39321), (2.0, 37449, 28086)],
)
def test_counts_chromaticities_in_their_bins(brightness: float, red: int, green: int) -> None:
    image = np.zeros((8, 8, 3), np.float32)
    image[0, :4], image[1:2], image[2, :4] = RED, (0.05, 0.4, 0.05), (0.05, 0.4, 0.05)
    counts: Any = KernelRidge(brightness=brightness).features(image)
    assert counts.shape == (64, 64)
    assert (counts[51, 6], counts[6, 51]) == (red, green)
    # Black pixels, most of the image, have no chromaticity.
    assert counts.sum() == red + green


def test_dark_pixels_have_little_weight() -> None:
    # Half of the image has a hundredth of the brightness and another colour, as from noise and black level.
    image = np.full((8, 8, 3), GREY, np.float32)
    image[:4] = np.array(RED) / 200
    features: list[Any] = [KernelRidge().features(pixels) for pixels in (image[4:], image)]
    bright, complete = (np.sqrt(counts / 65535) for counts in features)
    assert 0 < ((bright - complete) ** 2).sum() < 0.02


def test_penalty_is_proportional_to_number_of_images() -> None:
    # Duplicated images are the same problem; with a fixed penalty they would be fitted more closely.
    scenes = world(20)
    learner = KernelRidge()
    counts = counts_of(scenes)
    truths = np.stack([scene.truth / scene.truth.sum() for scene in scenes])
    once = learner.fit_features(counts, truths)
    twice = learner.fit_features(np.concatenate([counts, counts]), np.concatenate([truths, truths]))
    test_counts = counts_of(world(5, seed=1))
    np.testing.assert_allclose(once.lights(test_counts), twice.lights(test_counts), atol=1e-10)


@pytest.mark.parametrize("learner", [KernelRidge, LogChroma])
def test_counts_of_largest_working_size_do_not_overflow(learner: type[KernelRidge | LogChroma]) -> None:
    image = np.full((255, 255, 3), RED, np.float32)
    settings: dict[str, Any] = {"brightness": 0.0} if learner is KernelRidge else {}
    counts: Any = learner(working_size=255, **settings).features(image)
    assert counts.max() == 255 * 255
    with pytest.raises(ValueError, match=r"256 px.*1 to 255"):
        learner(working_size=256)
