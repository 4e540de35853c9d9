"""Tables as values and as CSV, which is read back by Python's own reader."""

from __future__ import annotations

import csv

import pytest

from evaluation.results.tables import Table, table_to_csv

TABLE = Table(
    'Cube+, "all"',
    ("Algorithm", "Mean", "Images", "95 %"),
    (('White, "Patch"\nof two lines', 2 / 3, 1707, "1.2 to 3.4"), ("None known", None, 0, "–")),
    notes=("A note.",),
)


def test_text_is_rounded_and_csv_is_not() -> None:
    assert TABLE.texts()[0][1:] == ("0.67", "1707", "1.2 to 3.4")
    assert TABLE.texts()[1][1] == "–"
    head, *rows = csv.reader(table_to_csv(TABLE).splitlines(keepends=True))
    assert tuple(head) == TABLE.columns
    assert rows[0][0] == 'White, "Patch"\nof two lines'
    assert float(rows[0][1]) == pytest.approx(2 / 3, abs=1e-9)
    assert rows[1] == ["None known", "", "0", "–"]


def test_small_numbers_keep_their_digits_in_csv() -> None:
    text = table_to_csv(Table("p", ("p",), ((1.23456789e-12,),)))
    assert float(text.splitlines()[1]) == pytest.approx(1.23456789e-12, rel=1e-8)


def test_columns_of_numbers() -> None:
    assert TABLE.numeric() == (False, True, True, False)
    assert Table("", ("a", "b"), ((None, 1.0), (None, None))).numeric() == (False, True)
    assert Table("", ("a",), ()).numeric() == (False,)


@pytest.mark.parametrize("rows", [((1.0,),), ((1.0, 2.0), (1.0, 2.0, 3.0))])
def test_a_row_of_another_length_is_refused(rows: tuple[tuple[float, ...], ...]) -> None:
    with pytest.raises(ValueError, match="cells under 2 heads"):
        Table("t", ("a", "b"), rows)
