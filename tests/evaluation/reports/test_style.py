"""Figures show names as they are written."""

from __future__ import annotations

import re
from html import unescape

import numpy as np
import pytest

from evaluation.experiments.comparing import error_scatter
from evaluation.reports.run_page import error_curves, error_planes
from evaluation.results.result import Result

NAMES = ["a $\\bad{x$ b", "$y_1$", "_mine"]


def texts(svg: bytes) -> list[str]:
    """Return the texts of an SVG in their order."""
    return [unescape(re.sub("<[^>]+>", "", each)).strip() for each in re.findall(r"(?s)<text.*?</text>", svg.decode())]


@pytest.mark.filterwarnings("error")
def test_names_are_neither_mathematics_nor_left_out() -> None:
    random = np.random.default_rng(0)
    results = [
        Result(
            name, np.ones((5, 3)), {"recovery": random.random(5), "reproduction": random.random(5)}, np.zeros(5, bool)
        )
        for name in NAMES
    ]
    curves = texts(error_curves(results, "recovery"))
    planes = texts(error_planes(results, random.random((5, 3)) + 0.1, "recovery"))
    scatter = texts(error_scatter(random.random(5), random.random(5), ("$a$", "_b"), {0: "im $x_1$"}))
    assert all(name in curves and name in planes for name in NAMES)
    assert {"im $x_1$", "$a$: error, degrees", "_b: error, degrees"} <= set(scatter)
