"""Notes on illuminants written in another convention: given for wrong conventions, absent for correct data."""

from __future__ import annotations

import numpy as np

from evaluation.experiments.running import evaluate
from evaluation.experiments.suspicions import detect_other_conventions
from evaluation.methods import GrayEdge
from tests.evaluation.made_up import Wall

NAMES = [f"{number}.png" for number in range(1, 41)]
RANDOM = np.random.default_rng(3)
TRUTHS = RANDOM.uniform([0.3, 0.9, 0.2], [0.6, 1.1, 0.5], (40, 3))


def test_reports_only_wrong_conventions() -> None:
    truths = TRUTHS * [2, 1, 1]
    scenes = [Wall(name, truth) for name, truth in zip(NAMES, truths, strict=True)]
    results = evaluate(scenes, [GrayEdge("Gray-world", 0, 1, 0), GrayEdge("White-Patch", 0, np.inf, 0)])
    assert detect_other_conventions(NAMES, truths, results) == ()
    assert "red and blue exchanged" in detect_other_conventions(NAMES, truths[:, ::-1], results)[0]
    assert "as gains" in detect_other_conventions(NAMES, 1 / truths, results)[0]
