"""Learned methods trained on real and on generated images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.paper.table1 import LEARNERS, table2
from evaluation.methods.prepared import unit
from evaluation.metrics import recovery_error
from evaluation.scene import Scene
from foundation.errors import InputError
from tests.evaluation.made_scenes import Made


@dataclass(frozen=True, eq=False)
class Constant:
    """Always the same light."""

    name: str
    light: npt.NDArray[np.float64]

    def estimate(
        self, image: object, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        return self.light


@dataclass(frozen=True)
class MeanLight:
    """Learns the mean of the training lights."""

    name: str = "Mean light"

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Constant:
        return Constant(self.name, unit(np.mean([scene.truth for scene in scenes], axis=0)))


LIGHTS = np.array([[1.0, 2, 1], [1.2, 2, 1], [1, 2, 1.3], [1.4, 2, 0.9], [1, 2, 0.8], [1.1, 2, 1.2]])
REAL = [Made(f"r{place}", light, np.ones((4, 4, 3))) for place, light in enumerate(LIGHTS)]
MADE = [Made("m", np.array([2.0, 1, 1]), np.ones((4, 4, 3)))]
FOLDS = np.array([0, 0, 1, 1, 2, 2])


def test_who_was_trained_on_what() -> None:
    (trained,) = table2(REAL, MADE, {"regression-trees": MeanLight()}, FOLDS)
    for place, light in enumerate(LIGHTS):
        others = LIGHTS[place // 2 != FOLDS].mean(axis=0)
        assert trained.real.errors["recovery"][place] == pytest.approx(float(recovery_error(others, light)))
        assert trained.generated.errors["recovery"][place] == pytest.approx(float(recovery_error([2, 1, 1], light)))


def test_the_learners_are_the_paper_s() -> None:
    from evaluation.experiments.paper.published import TABLE2

    assert set(LEARNERS.values()) == set(TABLE2["real"]) == set(TABLE2["generated"])


def test_nothing_to_train_on() -> None:
    with pytest.raises(InputError, match="0 generated images"):
        table2(REAL, [], {"mine": MeanLight()}, FOLDS)
    with pytest.raises(InputError, match="0 learners"):
        table2(REAL, MADE, {}, FOLDS)
