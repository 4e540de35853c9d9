"""Rows of a transfer in simulated worlds with a known answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from evaluation.experiments.folds import draw_folds
from evaluation.experiments.transfer.outcome import TransferFigures, figures_of
from evaluation.experiments.transfer.rows import TrainingSet, TransferRow, draw_images, transfer
from evaluation.learning.constant_light import ConstantLight
from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Method
from evaluation.scene import Scene
from foundation.errors import InputError
from tests.evaluation.experiments.transfer.worlds import COOL, MeanColour, MeanLearner, world

pytestmark = pytest.mark.slow

LEARNERS = (MeanColour(), ConstantLight())
TEST = world(120, seed=1)
FOLDS = tuple(draw_folds(120, 3, seed) for seed in range(2))


def _rows(*training: TrainingSet, images: int = 80) -> tuple[TransferRow, ...]:
    return transfer(TEST, training, LEARNERS, FOLDS, images, [GrayEdge("Gray-world", 0, 1, 0)])


def _ratio(figures: TransferFigures, method: str, data: str, index: int = 1) -> tuple[float, float, float]:
    (figure,) = [
        ratio.ratios[index] for ratio in figures.to_real if (ratio.row.method, ratio.row.data) == (method, data)
    ]
    return figure.value, figure.low, figure.high


def test_same_world_gives_ratio_one() -> None:
    figures = figures_of(_rows(TrainingSet("same", "generated", world(200, seed=2))), "reproduction")
    for index in range(6):
        for method in ("Mean colour", "Constant light"):
            ratio, low, high = _ratio(figures, method, "same", index)
            assert 0.85 < ratio < 1.15
            assert low < 1.05
            assert high > 0.95


def test_other_worlds_increase_errors() -> None:
    elsewhere = TrainingSet("elsewhere", "generated", world(200, seed=2, centre=COOL))
    tinted = TrainingSet("tinted", "generated", world(200, seed=2, cast=(1.0, 1.0, 0.7)))
    figures = figures_of(_rows(elsewhere, tinted), "reproduction")
    # The constant light is that of another world, and the interval leaves no doubt.
    assert _ratio(figures, "Constant light", "elsewhere")[1] > 2
    # A straight map of chromaticities is none of their colours: where no light of its training was, it is off.
    assert _ratio(figures, "Mean colour", "elsewhere")[1] > 2
    assert _ratio(figures, "Mean colour", "tinted")[1] > 1.5
    assert _ratio(figures, "Constant light", "tinted")[2] < 1.3


def test_order_of_rows() -> None:
    same = world(90, seed=2)
    rows = _rows(TrainingSet("a", "generated", same), TrainingSet("a", "naive", same), images=50)
    assert [(row.method, row.kind, row.images, len(row.results)) for row in rows] == [
        ("Mean colour", "cross-validation", 80, 2),
        ("Mean colour", "generated", 50, 2),
        ("Mean colour", "naive", 50, 2),
        ("Constant light", "cross-validation", 80, 2),
        ("Constant light", "generated", 50, 2),
        ("Gray-world", "none", 0, 1),
    ]
    # Naive counterparts that are the generated images themselves give the same estimates: the same places are drawn.
    for first, second in zip(rows[1].results, rows[2].results, strict=True):
        np.testing.assert_array_equal(first.estimates, second.estimates)
    assert (rows[1].results[0].estimates != rows[1].results[1].estimates).any()


def test_learner_without_features() -> None:
    training = world(30, seed=2)
    rows = transfer(TEST, [TrainingSet("a", "generated", training)], [MeanLearner()], FOLDS, 30)
    assert [row.kind for row in rows] == ["cross-validation", "generated"]
    expected = MeanLearner().fit(training).estimate(np.ones((1, 1, 3)))
    np.testing.assert_allclose(rows[1].results[0].estimates, np.tile(expected, (120, 1)))


def test_image_without_usable_pixel_is_guessed() -> None:
    black = (replace(TEST[0], cast=(0.0, 0.0, 0.0)), *TEST[1:])
    for row in transfer(black, [TrainingSet("a", "generated", world(40, seed=2))], [MeanColour()], FOLDS, 40):
        assert row.results[0].guessed.nonzero()[0].tolist() == [0]
        np.testing.assert_allclose(row.results[0].estimates[0], 3**-0.5)


def test_draws_images_without_repetition() -> None:
    drawn = [draw_images(1000, 100, seed) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert len(np.unique(drawn[2])) == 100
    assert len(np.intersect1d(drawn[0], drawn[2])) < 30
    with pytest.raises(InputError, match="11 training images requested, expected 1 to 10"):
        draw_images(10, 11, 0)


def test_rows_with_real_images() -> None:
    tinted = TrainingSet("tinted", "generated", world(90, seed=2, cast=(1.0, 1.0, 0.7)))
    rows = transfer(TEST, [tinted], LEARNERS, FOLDS, 80, real_counts=(10, None))
    entries = [
        (row.method, row.kind, row.real_use, row.real, row.images) for row in rows if row.method == "Mean colour"
    ]
    assert entries == [
        ("Mean colour", "cross-validation", "", "", 80),
        ("Mean colour", "real", "alone", "10", 10),
        ("Mean colour", "real", "alone", "all", 80),
        ("Mean colour", "generated", "", "", 80),
        ("Mean colour", "generated", "adapted", "10", 80),
        ("Mean colour", "generated", "adapted", "all", 80),
    ]
    assert [row.real_use for row in rows if row.method == "Constant light"] == ["", ""]
    row_of = {(row.kind, row.real_use, row.real): row for row in rows if row.method == "Mean colour"}
    for alone_row, adapted_row in zip(row_of["real", "alone", "all"].results, rows[0].results, strict=True):
        np.testing.assert_array_equal(alone_row.estimates, adapted_row.estimates)
    mean = {key: np.mean([result.errors["recovery"].mean() for result in row.results]) for key, row in row_of.items()}
    # The set is of another world and 80 real images know it: they have the word.
    assert mean["real", "alone", "all"] < 0.7 * mean["generated", "", ""]
    assert mean["generated", "adapted", "all"] < 1.1 * mean["real", "alone", "all"]
    assert mean["generated", "adapted", "10"] < mean["generated", "", ""]


@dataclass(frozen=True)
class RecordsTraining(MeanLearner):
    """Records its training images."""

    fitted_scenes: list[frozenset[str]] = field(default_factory=list)

    def __deepcopy__(self, memory: object) -> RecordsTraining:
        return self

    def fit(self, scenes: Sequence[Scene], seed: int = 0) -> Method:
        self.fitted_scenes.append(frozenset(scene.name for scene in scenes))
        return super().fit(scenes, seed)


def test_real_images_are_nested_and_from_other_folds() -> None:
    learner = RecordsTraining()
    transfer(TEST, [], [learner], FOLDS[:1], 1, real_counts=(5, 20))
    folds = {scene.name: int(fold) for scene, fold in zip(TEST, FOLDS[0], strict=True)}
    alone = learner.fitted_scenes[3:]
    assert [len(fitted) for fitted in alone] == [5] * 3 + [20] * 3
    for fold, (few, many) in enumerate(zip(alone[:3], alone[3:], strict=True)):
        assert few < many
        assert fold not in {folds[name] for name in many}
