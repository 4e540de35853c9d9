"""Simulated worlds: scenes of random surfaces under illuminants with a given spread, and a fast learner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from evaluation.learning.feature_learner import FeatureLearner, Features
from evaluation.methods.method import Method
from evaluation.scene import Image, Scene

WARM = (0.45, 0.38, 0.17)
COOL = (0.22, 0.42, 0.36)


@dataclass(frozen=True, eq=False)
class Patches:
    """A scene of 16 × 16 surfaces whose mean is not exactly grey."""

    name: str
    truth: npt.NDArray[np.float64]
    seed: int
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0)
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float64], None]:
        random = np.random.default_rng(self.seed)
        surfaces = random.uniform(0, 1, (16, 16, 3)) * random.uniform(0.8, 1.2, 3)
        return 1000 * surfaces * self.cast * self.truth, None


def world(
    count: int,
    seed: int,
    centre: tuple[float, float, float] = WARM,
    cast: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> tuple[Patches, ...]:
    """Return scenes under illuminants around a centre, with a colour cast of their surfaces."""
    random = np.random.default_rng([seed, 99])
    lights = np.array(centre) * np.exp(random.normal(0, 0.12, (count, 3)))
    return tuple(
        Patches(f"{seed}_{number:03d}", light / light.sum(), 1000 * seed + number, cast)
        for number, light in enumerate(lights)
    )


@dataclass(frozen=True)
class MeanColour(FeatureLearner):
    """Linear map from the chromaticities of the mean colour to those of the illuminant, by least squares."""

    key = "mean-colour"
    title = "Mean colour"

    def features(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64] | None:
        mean = image.reshape(-1, 3).mean(axis=0, dtype=np.float64)
        return None if not mean.any() else np.append(mean / mean.sum(), 1)[[0, 2, 3]]

    def fit_features(self, features: Features, truths: npt.NDArray[np.float64], seed: int = 0) -> StraightMap:
        solved = np.linalg.lstsq(np.asarray(features, dtype=np.float64), truths, rcond=None)[0]
        return StraightMap(np.asarray(solved, dtype=np.float64))

    def restore(self, arrays: Mapping[str, npt.NDArray[np.generic]]) -> StraightMap:
        return StraightMap(np.asarray(arrays["map"], dtype=np.float64))


@dataclass(frozen=True, eq=False)
class StraightMap:
    map: npt.NDArray[np.float64]

    def lights(self, features: Features) -> npt.NDArray[np.float64]:
        estimates = np.maximum(np.asarray(features, dtype=np.float64) @ self.map, 1e-6)
        return estimates / estimates.sum(axis=1, keepdims=True)

    def arrays(self) -> Mapping[str, npt.NDArray[np.generic]]:
        return {"map": self.map}


@dataclass(frozen=True)
class Mean:
    light: npt.NDArray[np.float64]
    name: str = "Mean light"

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        if not image.any():
            raise ZeroDivisionError("black")
        return self.light


@dataclass(frozen=True)
class MeanLearner:
    """User class without features, with `fit` only."""

    name: str = "Mean light"

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Method:
        mean = np.mean([scene.truth / np.linalg.norm(scene.truth) for scene in scenes], axis=0)
        return Mean(mean / np.linalg.norm(mean))
