"""Outcome of a transfer: statistics, intervals and ratios of rows, and their tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments.bootstrap import ErrorSample, bounded_figures, compare_paired, hide_tails
from evaluation.experiments.transfer.outcome import (
    adaptation_table,
    errors_table,
    figures_of,
    harm_notes,
    intervals_table,
)
from evaluation.experiments.transfer.rows import RealUse, Training, TransferRow
from evaluation.metrics import summarise
from evaluation.results.result import Result

ERRORS = np.arange(1.0, 41.0)


def _plain_row(kind: Training, *gains: float, guessed: int = 0, images: int = 9) -> TransferRow:
    blind = np.arange(40) < guessed
    results = tuple(
        Result("Trees", np.ones((40, 3)), {"recovery": gain * ERRORS, "reproduction": ERRORS}, blind) for gain in gains
    )
    return TransferRow("Trees", kind, "" if kind in ("cross-validation", "none") else "made", images, results)


def _adapted_row(kind: Training, real_use: RealUse, gain: float, real: str = "20") -> TransferRow:
    data = "" if kind == "real" else "made"
    return replace(_plain_row(kind, gain), data=data, real_use=real_use, real=real)


@pytest.mark.slow
def test_adapted_row_is_relative_to_better_part() -> None:
    rows = [
        _plain_row("cross-validation", 1.0),
        _adapted_row("real", "alone", 4.0),
        _adapted_row("real", "alone", 1.5, "all"),
        _plain_row("generated", 2.0),
        _plain_row("naive", 3.0),
        _adapted_row("generated", "adapted", 1.8),
        _adapted_row("generated", "adapted", 1.2, "all"),
        _adapted_row("naive", "adapted", 3.6),
    ]
    figures = figures_of(rows, "recovery")
    base = {(ratio.row.kind, ratio.row.real): (ratio.base.kind, ratio.ratios[0].value) for ratio in figures.to_better}
    assert base["generated", "20"] == ("generated", pytest.approx(0.9))
    assert base["generated", "all"] == ("real", pytest.approx(0.8))
    assert base["naive", "20"] == ("naive", pytest.approx(1.2))
    (harmful,) = harm_notes(figures)
    assert "linear sRGB" in harmful
    assert "1.20" in harmful
    (naive,) = figures.to_naive_adapted
    assert (naive.row.real, naive.ratios[0].value) == ("20", pytest.approx(0.5))
    # They are neither among the rows without real images nor in ratios of those.
    assert len(errors_table(figures, "Real", 40).rows) == len(intervals_table(figures, "Real").rows) == 3
    assert len(figures.to_real) == 2
    table = adaptation_table(figures, "Real")
    assert table is not None
    assert table.texts()[0] == (*("Trees", "made: generated", "20", "82.00", "41.00", "36.90", "0.90 (0.90 – 0.90)"),)
    assert adaptation_table(figures_of([_plain_row("generated", 1.0)], "recovery"), "Real") is None


RANDOM = np.random.default_rng(3)
REAL, OTHER, THIRD = (np.abs(RANDOM.normal(2, 1, 90)) for _ in range(3))


def _row(kind: Training, *errors: npt.NDArray[np.float64], method: str = "Trees") -> TransferRow:
    results = tuple(
        Result(method, np.ones((90, 3)), {"recovery": row_errors, "reproduction": 2 * row_errors}, np.zeros(90, bool))
        for row_errors in errors
    )
    return TransferRow(method, kind, "" if kind == "cross-validation" else "made", 9, results)


@pytest.mark.slow
def test_one_seed_matches_bootstrap() -> None:
    rows = [_row("cross-validation", REAL), _row("generated", OTHER), _row("naive", THIRD)]
    figures = figures_of(rows, "recovery")
    for row, errors in zip(figures.rows, (REAL, OTHER, THIRD), strict=True):
        np.testing.assert_allclose([figure.value for figure in row.statistics], summarise(errors).as_tuple())
        expected = hide_tails(bounded_figures(ErrorSample.of(errors).statistics, len(errors)), len(errors))
        for figure, reference in zip(row.statistics, expected, strict=True):
            assert tuple(figure) == pytest.approx(tuple(reference), nan_ok=True)
    for ratios, base in ((figures.to_real[0], REAL), (figures.to_naive[0], THIRD)):
        for compared, figure in zip(compare_paired(OTHER, base), ratios.ratios, strict=True):
            assert tuple(figure) == pytest.approx(tuple(compared.ratio), nan_ok=True)
    assert [(item.row.kind, item.base.kind) for item in figures.to_real] == [
        ("generated", "cross-validation"),
        ("naive", "cross-validation"),
    ]
    assert [row.spread for row in figures.rows] == [None] * 3


def test_several_seeds_are_averaged() -> None:
    figures = figures_of([_row("cross-validation", REAL), _row("generated", OTHER, THIRD)], "reproduction")
    rows = np.array([summarise(2 * errors).as_tuple() for errors in (OTHER, THIRD)])
    row = figures.rows[1]
    np.testing.assert_allclose([figure.value for figure in row.statistics], rows.mean(axis=0))
    assert row.spread is not None
    np.testing.assert_allclose(row.spread, np.abs(rows[0] - rows[1]) / np.sqrt(2))
    expected = rows.mean(axis=0) / summarise(2 * REAL).as_tuple()
    np.testing.assert_allclose([figure.value for figure in figures.to_real[0].ratios], expected)
    # The same errors twice know no more than once.
    once, twice = (figures_of([_row("generated", *several)], "recovery") for several in ([REAL], [REAL, REAL]))
    assert once.rows[0].statistics == twice.rows[0].statistics


def test_ratios_compare_same_method() -> None:
    rows = [
        _row("cross-validation", REAL),
        _row("cross-validation", OTHER, method="Cat"),
        _row("generated", OTHER, method="Cat"),
        _row("none", THIRD, method="Gray-world"),
    ]
    figures = figures_of(rows, "recovery")
    assert [(ratio.row.method, ratio.base.method) for ratio in figures.to_real] == [("Cat", "Cat")]
    assert [figure.value for figure in figures.to_real[0].ratios] == [1.0] * 7
    assert not figures.to_naive


def test_base_without_error_has_no_ratio() -> None:
    figures = figures_of([_row("cross-validation", np.zeros(90)), _row("generated", OTHER)], "recovery")
    assert all(np.isnan(figure.value) and np.isnan(figure.low) for figure in figures.to_real[0].ratios)
