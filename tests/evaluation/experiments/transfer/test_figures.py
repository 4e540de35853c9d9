"""Statistics, intervals and ratios of rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.bootstrap import STATISTICS, intervals, paired
from evaluation.experiments.transfer.outcome import figures_of
from evaluation.experiments.transfer.rows import Kind, TransferRow
from evaluation.metrics import summarise
from evaluation.results.result import Result
from foundation.errors import InputError

RANDOM = np.random.default_rng(3)
REAL, OTHER, THIRD = (np.abs(RANDOM.normal(2, 1, 90)) for _ in range(3))


def _row(kind: Kind, *errors: npt.NDArray[np.float64], method: str = "Trees") -> TransferRow:
    results = tuple(
        Result(method, np.ones((90, 3)), {"recovery": each, "reproduction": 2 * each}, np.zeros(90, bool))
        for each in errors
    )
    return TransferRow(method, kind, "" if kind == "cross-validation" else "made", 9, results)


def test_one_seed_is_what_the_bootstrap_gives() -> None:
    rows = [_row("cross-validation", REAL), _row("generated", OTHER), _row("naive", THIRD)]
    found = figures_of(rows, "recovery")
    for row, errors in zip(found.rows, (REAL, OTHER, THIRD), strict=True):
        np.testing.assert_allclose([figure.value for figure in row.statistics], summarise(errors).as_tuple()[:6])
        expected = intervals(errors)
        for statistic, figure in zip(STATISTICS, row.statistics, strict=True):
            assert (figure.low, figure.high) == pytest.approx(expected[statistic])
    for ratios, base in ((found.to_real[0], REAL), (found.to_naive[0], THIRD)):
        for compared, figure in zip(paired(OTHER, base), ratios.ratios, strict=True):
            assert (figure.value, figure.low, figure.high) == pytest.approx(compared.ratio)
    assert [(one.row.kind, one.base.kind) for one in found.to_real] == [
        ("generated", "cross-validation"),
        ("naive", "cross-validation"),
    ]
    assert [row.spread for row in found.rows] == [None] * 3


def test_several_seeds_are_the_mean_of_their_statistics() -> None:
    found = figures_of([_row("cross-validation", REAL), _row("generated", OTHER, THIRD)], "reproduction")
    both = np.array([summarise(2 * errors).as_tuple() for errors in (OTHER, THIRD)])
    row = found.rows[1]
    np.testing.assert_allclose([figure.value for figure in row.statistics], both.mean(axis=0))
    assert row.spread is not None
    np.testing.assert_allclose(row.spread, np.abs(both[0] - both[1]) / np.sqrt(2))
    expected = both.mean(axis=0) / summarise(2 * REAL).as_tuple()
    np.testing.assert_allclose([figure.value for figure in found.to_real[0].ratios], expected)
    # The same errors twice know no more than once.
    once, twice = (figures_of([_row("generated", *several)], "recovery") for several in ([REAL], [REAL, REAL]))
    assert once.rows[0].statistics == twice.rows[0].statistics


def test_methods_are_held_to_themselves_only() -> None:
    rows = [
        _row("cross-validation", REAL),
        _row("cross-validation", OTHER, method="Cat"),
        _row("generated", OTHER, method="Cat"),
        _row("none", THIRD, method="Gray-world"),
    ]
    found = figures_of(rows, "recovery")
    assert [(one.row.method, one.base.method) for one in found.to_real] == [("Cat", "Cat")]
    assert [figure.value for figure in found.to_real[0].ratios] == [1.0] * 6
    assert not found.to_naive


def test_rows_are_held_to_one_that_is_asked_for_whatever_its_pictures() -> None:
    chosen = replace(_row("generated", OTHER), data="chosen")
    rows = [
        _row("cross-validation", REAL),
        chosen,
        _row("naive with matrix", THIRD),
        _row("naive with matrix", REAL, method="Cat"),
        _row("none", REAL, method="Gray-world"),
    ]
    found = figures_of(rows, "recovery", base="Made:  matrix x linear sRGB x light")
    assert [(one.row, one.base) for one in found.to_base] == [(rows[0], rows[2]), (chosen, rows[2])]
    for compared, figure in zip(paired(OTHER, THIRD), found.to_base[1].ratios, strict=True):
        assert (figure.value, figure.low, figure.high) == pytest.approx(compared.ratio)
    assert not found.to_naive
    assert not figures_of(rows, "recovery").to_base


def test_a_base_that_is_not_there_is_told_with_those_that_are() -> None:
    with pytest.raises(InputError, match=r"'naive'; expected one of: real, cross-validated; made: generated$"):
        figures_of([_row("cross-validation", REAL), _row("generated", OTHER)], "recovery", base="naive")


@pytest.mark.parametrize("base", ["none", " NONE"])
def test_what_learns_nothing_is_no_base(base: str) -> None:
    with pytest.raises(InputError, match=r"expected one of: real, cross-validated$"):
        figures_of([_row("cross-validation", REAL), _row("none", THIRD, method="Gray-world")], "recovery", base=base)


def test_a_base_with_nothing_to_hold_to_it_is_told() -> None:
    rows = [_row("cross-validation", REAL), _row("generated", OTHER, method="Cat")]
    with pytest.raises(InputError, match=r"no method was trained on anything but 'made: generated'; add results"):
        figures_of(rows, "recovery", base="made: generated")


def test_a_faultless_base_has_no_ratio() -> None:
    found = figures_of([_row("cross-validation", np.zeros(90)), _row("generated", OTHER)], "recovery")
    assert all(np.isnan(figure.value) and np.isnan(figure.low) for figure in found.to_real[0].ratios)
