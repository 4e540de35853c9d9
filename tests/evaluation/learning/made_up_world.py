"""Synthetic scenes: random surfaces under known illuminants on a line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.learning.color_beaver import ColorBeaver
from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.learning.standard import standard_learners
from tests.evaluation.made_scenes import Made

SIZE = 32  # width and height of scenes, px

# All methods, three with less training, and the network with the size of the scenes.
LEARNERS: dict[str, FeatureLearner] = {
    **standard_learners(),
    "convnet": ConvNet(working_size=SIZE, epochs=40),
    "log-chroma": LogChroma(pretraining=8, training=24),
    "regression-trees": RegressionTrees(windows=3),
}

# All methods with so little training that estimates are reproducible but not accurate.
QUICK: dict[str, FeatureLearner] = {
    **LEARNERS,
    "color-beaver": ColorBeaver(population=12, generations=6),
    "convnet": ConvNet(working_size=SIZE, epochs=6),
    "log-chroma": LogChroma(pretraining=2, training=6),
}


def lights_on_a_line(count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return illuminants (N, 3) float64 from tungsten to shade: g is constant, r decreases with b."""
    red = rng.uniform(0.18, 0.42, count)
    return np.stack([red, np.full(count, 0.42), 0.58 - red], axis=1)


def world(count: int, seed: int = 0, size: int = SIZE, cast: float = 0.25) -> list[Made]:
    """Return scenes of 4 px tiles with nearly grey surfaces.

    Surfaces have a log-normal cast with the standard deviation `cast` in red and blue, and a tenth of it common to the
    scene, so that Gray-world is not accurate.
    """
    rng = np.random.default_rng(seed)
    scenes: list[Made] = []
    for number, light in enumerate(lights_on_a_line(count, rng)):
        tiles = rng.uniform(0.05, 1, (size // 4, size // 4, 1)) * np.exp(
            rng.normal(0, cast, (size // 4, size // 4, 3)) * [1, 0.2, 1] + rng.normal(0, cast / 10, 3)
        )
        image = np.kron(tiles, np.ones((4, 4, 1))) * light * np.exp(rng.normal(0, 0.02, (size, size, 3)))
        scenes.append(Made(f"scene {number}", light, image.astype(np.float32)))
    return scenes


def save_world(path: Path, count: int, seed: int = 0, size: int = SIZE) -> None:
    """Save scenes as thumbnails with the name of the file."""
    scenes = world(count, seed, size)
    np.savez(
        path,
        images=np.stack([scene.image for scene in scenes]),
        gt=np.stack([scene.truth for scene in scenes]),
        names=np.array([f"{path.stem} {number}" for number in range(count)]),
    )


def constant_light(scenes: Sequence[Made]) -> npt.NDArray[np.float64]:
    """Return the median illuminant (3,) float64 of scenes, the baseline of learned methods."""
    return np.median([scene.truth for scene in scenes], axis=0)
