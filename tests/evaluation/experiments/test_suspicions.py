"""Notes on lights that are written otherwise than they are read: made where they are, and not where all is right."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.running import evaluate
from evaluation.experiments.suspicions import suspicions
from evaluation.methods import GrayEdge
from evaluation.results.result import Result
from tests.evaluation.made_up import Wall

Lights = npt.NDArray[np.float64]
NAMES = [f"{number}.png" for number in range(1, 41)]
RANDOM = np.random.default_rng(3)
TRUTHS = RANDOM.uniform([0.3, 0.9, 0.2], [0.6, 1.1, 0.5], (40, 3))


def notes(estimates: Lights, guessed: int = 0, truths: Lights = TRUTHS) -> tuple[str, ...]:
    result = Result("Mine", estimates, {}, np.arange(40) < guessed)
    return suspicions(NAMES, truths, [result])


BY_TEXT = np.argsort(NAMES)
WRITTEN: dict[str, Lights] = {
    "as gains": 1 / TRUTHS,
    "given to the image before": np.roll(TRUTHS, 1, axis=0),
    "given to the image after": np.roll(TRUTHS, -1, axis=0),
    "in the order of names as numbers": TRUTHS[BY_TEXT],
    "in the order of names as text": TRUTHS[np.argsort(BY_TEXT)],
}


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("told", WRITTEN)
def test_what_is_written_otherwise_is_named(noise: float, told: str) -> None:
    (note,) = notes(WRITTEN[told] * RANDOM.uniform(1 - noise, 1 + noise, TRUTHS.shape))
    assert note.startswith(f"Mine: {told}")


def test_channels_exchanged_in_the_truths_of_several_methods_are_one_note() -> None:
    truths = TRUTHS * [2, 1, 1]
    results = [Result(name, truths * (1, factor, 1), {}, np.zeros(40, bool)) for name, factor in (("A", 1), ("B", 1.1))]
    (note,) = suspicions(NAMES, truths[:, ::-1], results)
    assert note.startswith("A: with red and blue exchanged")
    assert "1 more of 2 methods gain likewise" in note


def test_nothing_is_said_where_it_would_mean_nothing() -> None:
    assert notes(TRUTHS) == ()
    assert notes(TRUTHS[:, [1, 2, 0]]) == ()
    assert (len(notes(1 / TRUTHS, guessed=32)), notes(1 / TRUTHS, guessed=33)) == (1, ())
    for count, said in ((8, 1), (7, 0)):
        few = Result("Mine", 1 / TRUTHS[:count], {}, np.zeros(count, bool))
        assert len(suspicions(NAMES[:count], TRUTHS[:count], [few])) == said


def test_methods_of_the_suite_on_images() -> None:
    truths = TRUTHS * [2, 1, 1]
    scenes = [Wall(name, truth) for name, truth in zip(NAMES, truths, strict=True)]
    results = evaluate(scenes, [GrayEdge("Gray-world", 0, 1, 0), GrayEdge("White-Patch", 0, np.inf, 0)])
    assert suspicions(NAMES, truths, results) == ()
    assert "red and blue exchanged" in suspicions(NAMES, truths[:, ::-1], results)[0]
    assert "as gains" in suspicions(NAMES, 1 / truths, results)[0]
