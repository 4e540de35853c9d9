"""Learned methods trained on real and on generated images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.paper.table1 import LEARNERS, table2, table2_tables
from evaluation.methods.prepared import unit
from evaluation.metrics import recovery_error
from evaluation.scene import Scene
from foundation.errors import InputError


@dataclass(frozen=True, eq=False)
class Photo:
    """An image of one colour, whose light is another."""

    name: str
    truth: npt.NDArray[np.float64]
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float64], None]:
        return np.ones((4, 4, 3)), None


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
REAL = [Photo(f"r{place}", light) for place, light in enumerate(LIGHTS)]
MADE = [Photo("m", np.array([2.0, 1, 1]))]
FOLDS = np.array([0, 0, 1, 1, 2, 2])


def test_who_was_trained_on_what() -> None:
    (trained,) = table2(REAL, MADE, {"regression-trees": MeanLight()}, FOLDS)
    for place, light in enumerate(LIGHTS):
        others = LIGHTS[place // 2 != FOLDS].mean(axis=0)
        assert trained.real.errors["recovery"][place] == pytest.approx(float(recovery_error(others, light)))
        assert trained.generated.errors["recovery"][place] == pytest.approx(float(recovery_error([2, 1, 1], light)))


def test_the_tables() -> None:
    found = table2(REAL, MADE, {"regression-trees": MeanLight(), "mine": MeanLight("Mine")}, FOLDS)
    real, generated, ratios = table2_tables(found, "recovery", "Cube+")
    assert [row[0] for row in real.rows] == ["Mean light", "paper", "Mine"]
    for table, result in ((real, found[0].real), (generated, found[0].generated)):
        assert table.rows[0][1:] == result.summary("recovery").as_tuple()
    assert real.rows[1][1:] == (1.57, 0.89, 1.04, 0.20, 4.15, 1.04)
    assert generated.rows[1][1:] == (2.54, 1.66, 1.89, 0.45, 6.07, 1.85)
    expected = found[0].generated.summary("recovery").median / found[0].real.summary("recovery").median
    assert ratios.rows[0] == ("Mean light", expected, 1.66 / 0.89)
    assert ratios.rows[1][2] is None
    alone = table2_tables(found, "recovery", "other", with_published=False)
    assert [row[0] for row in alone[0].rows] == ["Mean light", "Mine"]
    assert alone[2].rows[0][2] == 1.66 / 0.89


def test_the_learners_are_the_paper_s() -> None:
    from evaluation.experiments.paper.published import TABLE2

    assert set(LEARNERS.values()) == set(TABLE2["real"]) == set(TABLE2["generated"])


def test_nothing_to_train_on() -> None:
    with pytest.raises(InputError, match="0 generated images"):
        table2(REAL, [], {"mine": MeanLight()}, FOLDS)
    with pytest.raises(InputError, match="0 learners"):
        table2(REAL, MADE, {}, FOLDS)
