"""Scenes made up for the tests of descriptions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from evaluation.scene import SceneSet


@dataclass(frozen=True, eq=False)
class Made:
    """A scene in memory."""

    name: str
    truth: npt.NDArray[np.float64]
    image: npt.NDArray[np.float64] | npt.NDArray[np.uint16]
    saturation: float | None = None
    mask: npt.NDArray[np.bool_] | None = None

    def read(
        self,
    ) -> tuple[npt.NDArray[np.float64] | npt.NDArray[np.uint16], npt.NDArray[np.bool_] | None]:
        return self.image, self.mask


@dataclass(frozen=True, eq=False)
class MadeMixture(Made):
    """A scene under two lights, the first on the left half."""

    lights: npt.NDArray[np.float64] = field(default_factory=lambda: np.ones((2, 3)))

    def read_weights(self) -> npt.NDArray[np.float32]:
        height, width = self.image.shape[:2]
        left = np.zeros((height, width), bool)
        left[:, : width // 2] = True
        return np.stack([left, ~left], axis=2).astype(np.float32)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        given = self.lights / self.lights.sum(axis=1, keepdims=True)
        return np.asarray(self.read_weights() @ given, dtype=np.float32)


def made_set(name: str, scenes: list[Made]) -> SceneSet:
    """Return scenes as a data set."""
    return SceneSet(name, "made", f"/{name}", tuple(scenes), {"black level": "none"})


def random_set(
    name: str, count: int, chroma: float = 0.2, seed: int = 0, light: tuple[float, float, float] = (0.5, 1, 0.7)
) -> SceneSet:
    """Return images of 16 x 16 random colours; `chroma` is the deviation of each channel's logarithm."""
    random = np.random.default_rng(seed)
    scenes: list[Made] = []
    for number in range(count):
        lamp = np.array(light) * np.exp(random.normal(0, 0.2, 3))
        grey = np.exp(random.normal(-2, 1, (16, 16, 1)))
        scenes.append(Made(f"{name} {number}", lamp, lamp * grey * np.exp(random.normal(0, chroma, (16, 16, 3)))))
    return made_set(name, scenes)
