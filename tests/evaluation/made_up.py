"""Scenes in memory for tests: flat walls, and walls under two illuminants."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from evaluation.scene import Scene, SceneSet

Array = npt.NDArray[np.float64]


def no_log() -> list[str]:
    return []


@dataclass(frozen=True)
class Wall:
    """A wall of random greys under one illuminant; each `read` appends its name to `log`."""

    name: str
    truth: Array
    seed: int = 0
    saturation: float | None = None
    log: list[str] = field(default_factory=no_log)

    def read(self) -> tuple[npt.NDArray[np.float32], None]:
        self.log.append(self.name)
        grey = np.random.default_rng(self.seed).random((12, 16, 1)) + 0.1
        return (grey * self.truth * 100).astype(np.float32), None


@dataclass(frozen=True)
class MixedWall:
    """A wall whose left quarter is under the first illuminant, the rest under the second."""

    name: str
    lights: Array
    saturation: float | None = None
    masked: bool = False

    @property
    def truth(self) -> Array:
        return self.read_truth_map().mean(axis=(0, 1)).astype(np.float64)

    def read_weights(self) -> npt.NDArray[np.float32]:
        weights = np.zeros((12, 16, 2), np.float32)
        weights[:, :4, 0] = weights[:, 4:, 1] = 1
        return weights

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        lights = self.lights / self.lights.sum(axis=1, keepdims=True)
        return (self.read_weights() @ lights).astype(np.float32)

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_] | None]:
        mask = np.zeros((12, 16), bool)
        mask[:, :4] = self.masked
        return self.read_truth_map() * np.float32(50), mask if self.masked else None


def walls(count: int, log: list[str] | None = None) -> tuple[Scene, ...]:
    """Return walls under illuminants of different colours."""
    random = np.random.default_rng(7)
    return tuple(
        Wall(f"wall {number}.png", random.random(3) + 0.3, number, log=no_log() if log is None else log)
        for number in range(count)
    )


def as_set(scenes: tuple[Scene, ...], name: str = "Walls") -> SceneSet:
    """Return scenes as a data set."""
    return SceneSet(name, "made up", "nowhere", scenes, {"black level": "none", "ground truth": "as it was drawn"})
