"""The tables say what was found, and what it does not hold for."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.experiments.transfer.outcome import (
    HEADS,
    errors_table,
    figures_of,
    intervals_table,
    long_table,
    naive_ratios_table,
    paper_ratios_table,
    real_ratios_table,
)
from evaluation.experiments.transfer.rows import Kind, TransferRow
from evaluation.results.result import Result
from evaluation.results.tables import table_to_csv

ERRORS = np.arange(1.0, 41.0)


def _row(kind: Kind, *gains: float, guessed: int = 0, images: int = 9) -> TransferRow:
    blind = np.arange(40) < guessed
    results = tuple(
        Result("Trees", np.ones((40, 3)), {"recovery": gain * ERRORS, "reproduction": ERRORS}, blind) for gain in gains
    )
    return TransferRow("Trees", kind, "" if kind in ("cross-validation", "none") else "made", images, results)


def test_all_statistics_stand_in_every_table() -> None:
    found = figures_of([_row("cross-validation", 1.0), _row("generated", 2.0), _row("naive", 4.0)], "recovery")
    naive = naive_ratios_table(found, "Real")
    assert naive is not None
    for table in (
        errors_table(found, "Real", 40),
        intervals_table(found, "Real"),
        real_ratios_table(found, "Real"),
        naive,
    ):
        assert table.columns[-6:] == HEADS
    assert errors_table(found, "Real", 40).texts()[1][:5] == ("Trees", "made: generated", "9", "41.00", "41.00")
    # Twice the errors on every image: the interval of the ratio has no width.
    assert real_ratios_table(found, "Real").texts()[0][2:] == ("2.00 (2.00 – 2.00)",) * 6
    assert naive.texts()[0][1:3] == ("made: linear sRGB × light", "0.50 (0.50 – 0.50)")
    assert naive_ratios_table(figures_of([_row("generated", 1.0)], "recovery"), "Real") is None


def test_what_a_number_hides_is_noted() -> None:
    found = figures_of([_row("cross-validation", 1.0, 1.2), _row("none", 1.0, guessed=3, images=0)], "recovery")
    table = errors_table(found, "Real", 40)
    assert table.notes == (
        "Trees, none: no light in 3 images; grey stands in for it",
        # Medians 20.5 and 24.6, whose standard deviation is 4.1 / sqrt 2.
        "Means over seeds; the standard deviation of a median over seeds is up to 2.90 degrees.",
    )
    assert table.texts()[1][2] == "–"


def test_all_numbers_for_other_programs() -> None:
    found = figures_of([_row("cross-validation", 1.0), _row("generated", 2.0, 4.0)], "recovery")
    lines = table_to_csv(long_table(found)).splitlines()
    assert lines[0].split(",") == [
        *("method", "training", "data", "images", "seeds", "error", "statistic", "degrees", "low", "high"),
        *("seed_sd", "ratio_to_real", "ratio_low", "ratio_high"),
    ]
    assert len(lines) == 13
    fields = dict(zip(lines[0].split(","), lines[8].split(","), strict=True))
    assert (fields["statistic"], fields["training"], fields["seeds"]) == ("median", "generated", "2")
    assert float(fields["degrees"]) == pytest.approx(61.5)
    assert float(fields["ratio_to_real"]) == pytest.approx(3)
    assert lines[1].endswith(",,,,")


def test_the_papers_ratios_by_hand() -> None:
    medians = {row[0]: row[3] for row in paper_ratios_table().rows}
    assert medians == pytest.approx(
        {
            "Regression trees (simple features)": 1.66 / 0.89,
            "Smart Color Cat": 1.43 / 1.35,
            "Color Beaver (using Gray-world)": 0.74 / 0.77,
        }
    )
