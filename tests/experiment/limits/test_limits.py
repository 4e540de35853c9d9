"""Limits that are used in more than one place: one number each, and the blur that belongs to a bleed."""

from __future__ import annotations

import pytest

from acquisition.judge import limits as judge
from calibration.figures.all_figures import FIGURES
from calibration.sampling import bleed, blur_of_bleed, largest_blur_px
from calibration.verdict import judge as judged
from experiment.limits.table import TABLE_LIMITS, TableLimit


def test_a_verdict_judges_by_the_shared_numbers() -> None:
    found = {limit.name: limit for limit in FIGURES}
    for name, limit in TABLE_LIMITS.items():
        assert (found[name].unit, found[name].sense, found[name].accept, found[name].refuse) == limit.numbers, name


@pytest.mark.parametrize("name", sorted(TABLE_LIMITS))
def test_a_foretold_outcome_is_that_of_the_verdict(name: str) -> None:
    limit = TABLE_LIMITS[name]
    bounds = [limit.accept] if limit.refuse is None else [limit.accept, limit.refuse]
    for value in [bound + step for bound in bounds for step in (-1e-6, 0.0, 1e-6)] + [float("nan")]:
        (row,) = judged({name: value}).rows
        assert limit.outcome(value) == row.outcome, value


def test_not_a_number_is_as_bad_as_can_be() -> None:
    assert TableLimit("", "at least", 2.0, 1.0).outcome(float("nan")) == "refuse"
    assert TableLimit("", "at most", 1.0, None).outcome(float("nan")) == "accept with remarks"


@pytest.mark.parametrize("share", [0.005, 0.03])
@pytest.mark.parametrize("cell_px", [8.6, 10.2, 12.4])
def test_the_blur_of_a_bleed_is_its_inverse(share: float, cell_px: float) -> None:
    assert bleed(cell_px, blur_of_bleed(cell_px, share)) == pytest.approx(share, rel=1e-9)


def test_larger_cells_may_be_softer() -> None:
    assert largest_blur_px(10.0) == 1.0
    assert largest_blur_px(100.0) > 20


def test_the_live_judge_follows_a_lasting_change_as_far_as_a_table_is_made() -> None:
    assert judge.LAMP_TOTAL == 15.0
    assert judge.LIGHT_FOLLOWED_DEG == 2.0
    assert judge.ADDED_LEAST == 0.004
