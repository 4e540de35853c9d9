"""Pinned numbers of statistics, comparisons, folds, descriptions and figures, with values at limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.reports import run_page
from evaluation.results.result import Result
from tests.evaluation.shown import recorded_figures
from tests.pinned import Pinned

# Parts are pinned as well, since what is made of them may not show them.

pytestmark = pytest.mark.slow

Floats = npt.NDArray[np.float64]


def errors(count: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).gamma(1.5, 2, count)


def test_figures_of_many_methods(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    figures = recorded_figures(monkeypatch)
    truths = np.random.default_rng(0).uniform(0.2, 2, (31, 3))
    for count in (1, 4, 13):
        kinds: list[Any] = [{"recovery": errors(31, at), "reproduction": errors(31, at + 50)} for at in range(count)]
        results = [Result(f"method {at}", truths, kind, truths[:, 0] > 9) for at, kind in enumerate(kinds)]
        if count == 4:
            run_page.error_curves(results, "recovery")
        run_page.error_planes(results, truths, "reproduction")
    pinned("figures of many methods", figures)
