"""A made-up world whose lights are known: scenes of random surfaces under lights of a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.learning.color_beaver import ColorBeaver
from evaluation.learning.convnet import ConvNet
from evaluation.learning.feature_learner import FeatureLearner
from evaluation.learning.log_chroma import LogChroma
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.learning.standard import standard_learners

SIZE = 32
"""Width and height of scenes, px."""

LEARNERS: dict[str, FeatureLearner] = {
    **standard_learners(),
    "convnet": ConvNet(working_size=SIZE, epochs=40),
    "log-chroma": LogChroma(pretraining=8, training=24),
    "regression-trees": RegressionTrees(windows=3),
}
"""All methods; three train for less long, and the network's square is no larger than the scenes."""

QUICK: dict[str, FeatureLearner] = {
    **LEARNERS,
    "color-beaver": ColorBeaver(population=12, generations=6),
    "convnet": ConvNet(working_size=SIZE, epochs=6),
    "log-chroma": LogChroma(pretraining=2, training=6),
}
"""All methods, trained for so little that what they answer is the same again, but need not be right."""


@dataclass(frozen=True, eq=False)
class MadeUp:
    """A scene in memory."""

    name: str
    truth: npt.NDArray[np.float64]
    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.bool_] | None = None
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_] | None]:
        return self.image, self.mask


def lights_on_a_line(count: int, rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return lights (N, 3) float64 from tungsten to shade: g fixed, r falls as b rises."""
    red = rng.uniform(0.18, 0.42, count)
    return np.stack([red, np.full(count, 0.42), 0.58 - red], axis=1)


def world(count: int, seed: int = 0, size: int = SIZE, cast: float = 0.25) -> list[MadeUp]:
    """Return scenes of 4 px tiles whose surfaces are near grey, each scene with a cast of its own.

    The cast is what keeps Gray-world from being right: log-normal with a standard deviation of `cast` in the red and
    blue of each surface, and a tenth of it common to the scene.
    """
    rng = np.random.default_rng(seed)
    scenes: list[MadeUp] = []
    for number, light in enumerate(lights_on_a_line(count, rng)):
        tiles = rng.uniform(0.05, 1, (size // 4, size // 4, 1)) * np.exp(
            rng.normal(0, cast, (size // 4, size // 4, 3)) * [1, 0.2, 1] + rng.normal(0, cast / 10, 3)
        )
        image = np.kron(tiles, np.ones((4, 4, 1))) * light * np.exp(rng.normal(0, 0.02, (size, size, 3)))
        scenes.append(MadeUp(f"scene {number}", light, image.astype(np.float32)))
    return scenes


def constant_light(scenes: Sequence[MadeUp]) -> npt.NDArray[np.float64]:
    """Return the median light (3,) float64 of scenes, which a method must beat to have learned anything."""
    return np.median([scene.truth for scene in scenes], axis=0)
