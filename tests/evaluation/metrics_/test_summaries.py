"""Summaries against numbers worked by hand, and percentiles against MATLAB's documented example."""

from __future__ import annotations

import math

import numpy as np
import pytest

from evaluation.metrics import percentiles, summarise
from foundation.errors import InputError


def test_the_summary_of_eight_errors() -> None:
    # By MATLAB's prctile the errors stand at 6.25, 18.75, 31.25 ... percent: Q1 = 2.5, Q2 = 4.5, Q3 = 6.5.
    summary = summarise([8, 1, 7, 2, 6, 3, 5, 4])
    assert summary.as_tuple() == pytest.approx((4.5, 4.5, 4.5, 1.5, 7.5, (4.5**3 * 1.5 * 7.5) ** 0.2))
    assert summary.maximum == 8
    assert summary.below3 == 2 / 8  # 3 itself is not below 3.


def test_the_summary_of_five_errors() -> None:
    # At 10, 30, 50, 70, 90 percent: Q1 = 1 + 0.75 = 1.75, Q3 = 4 + 0.25 * 6 = 5.5; with 1, 2, 3, 4, 10.
    summary = summarise([1, 2, 3, 4, 10])
    assert summary.as_tuple()[:5] == pytest.approx((4, 3, (1.75 + 6 + 5.5) / 4, 1, 10))


def test_the_95th_percentile_of_twenty_errors() -> None:
    # The 19th of 20 stands at 92.5 percent, the 20th at 97.5: half-way.
    assert summarise(np.arange(1, 21)).p95 == pytest.approx(19.5)


def test_percentiles_are_matlab_s() -> None:
    # prctile([1 2 3 4 5 6], [25 50 75]): 1.5 places in steps of 100 / 6 from 8.33 percent; the ends stay the ends.
    assert percentiles([6, 5, 4, 3, 2, 1], (25, 50, 75)) == pytest.approx((2, 3.5, 5))
    assert percentiles([6, 5, 4, 3, 2, 1], (0, 5, 100)) == pytest.approx((1, 1, 6))


def test_one_error_is_every_statistic() -> None:
    assert summarise([7.0]).as_tuple() == pytest.approx((7.0,) * 6)


def test_perfect_estimates_have_an_average_of_zero() -> None:
    assert summarise(np.zeros(9)).avg == 0


@pytest.mark.parametrize("errors", [[], [1.0, math.nan], [math.inf]])
def test_nothing_to_sum_up_is_said(errors: list[float]) -> None:
    with pytest.raises(InputError, match="nothing to sum up"):
        summarise(errors)
