"""Values against their limits."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import Figure, format_value
from calibration.verdict import judge

LIMIT = Figure("x", "A figure", "px", "at most", 1.0, 2.0, "why", "source", "remedy")


@pytest.mark.parametrize(
    ("sense", "accept", "refuse", "value", "outcome"),
    [
        ("at most", 1.0, 2.0, 1.0, "accept"),
        ("at most", 1.0, 2.0, 1.1, "accept with remarks"),
        ("at most", 1.0, 2.0, 2.0, "accept with remarks"),
        ("at most", 1.0, 2.0, 2.1, "refuse"),
        ("at most", 1.0, None, 1e9, "accept with remarks"),
        ("at least", 2.0, 1.0, 2.0, "accept"),
        ("at least", 2.0, 1.0, 1.5, "accept with remarks"),
        ("at least", 2.0, 1.0, 0.9, "refuse"),
        ("at least", 2.0, 1.0, float("nan"), "refuse"),
        ("at most", 2.0, None, float("nan"), "accept with remarks"),
    ],
)
def test_a_figure_is_judged_by_both_limits(
    sense: str, accept: float, refuse: float | None, value: float, outcome: str
) -> None:
    limit = replace(LIMIT, sense=sense, accept=accept, refuse=refuse)
    assert judge({"x": value}, [limit]).outcome == outcome


def test_the_worst_row_is_the_verdict() -> None:
    rows = [replace(LIMIT, name=name) for name in "abc"]
    assert judge({"a": 0, "b": 3, "c": 1.5}, rows).outcome == "refuse"
    assert judge({"a": 0, "c": 1.5}, rows).outcome == "accept with remarks"
    assert judge({}, rows).outcome == "accept"


def test_every_limit_has_its_reason_and_its_order() -> None:
    assert len({limit.name for limit in FIGURES}) == len(FIGURES)
    for limit in FIGURES:
        assert limit.why
        assert limit.source
        if limit.refuse is not None:
            assert (limit.refuse > limit.accept) == (limit.sense == "at most")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.0123, "share", "1.23 %"),
        (12.04, "°", "12°"),
        (0.0034, "px RMS", "0.0034 px RMS"),
        (12345.6, "counts", "12346 counts"),
        (2.0, "", "2"),
    ],
)
def test_a_value_is_shown_with_its_unit(value: float, unit: str, text: str) -> None:
    assert format_value(value, unit) == text


def test_a_row_gives_value_expectation_and_consequence() -> None:
    (row,) = judge({"x": 1.5}, [LIMIT]).remarks
    assert row.text() == "A figure: 1.5 px, at most 1 px expected, refused beyond 2 px; why"
