"""A table of results as a value: what commands print, pages show, papers set and other programs read.

Every command of `evaluate` makes one of these and hands it to `reports.terminal`, `reports.latex` or `reports.page`;
as CSV it is written here.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass

Cell = str | float | None
"""A name, a number (an `int` stays one), or nothing known."""

MISSING = "–"
"""What stands for `None` where people read; in CSV the field is empty."""


@dataclass(frozen=True)
class Table:
    """A table with a title.

    - `title`: what it shows, with the unit of its numbers: "Cube+: reproduction angular error of 1707 images, degrees".
    - `columns`: heads of the columns, at least one.
    - `rows`: as many cells as columns each. A column whose cells are numbers or None is set as numbers.
    - `digits`: decimals of a float where people read; CSV has them all.
    - `notes`: sentences below the table.

    Examples
    --------
    >>> Table("Errors, degrees", ("Algorithm", "Mean"), (("Gray-world", 3.14159), ("Grey", None))).texts()
    (('Gray-world', '3.14'), ('Grey', '–'))
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    digits: int = 2
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lengths = {len(row) for row in self.rows} | {len(self.columns)}
        if len(lengths) > 1 or not self.columns:
            raise ValueError(f"{self.title}: rows of {sorted(lengths)} cells under {len(self.columns)} heads")

    def texts(self) -> tuple[tuple[str, ...], ...]:
        """Return the rows as people read them, numbers rounded to `digits`."""
        return tuple(tuple(_text(cell, self.digits) for cell in row) for row in self.rows)

    def numeric(self) -> tuple[bool, ...]:
        """Return for each column whether it holds numbers: at least one, and no text."""
        columns = [[row[place] for row in self.rows] for place in range(len(self.columns))]
        return tuple(
            not any(isinstance(cell, str) for cell in column) and any(cell is not None for cell in column)
            for column in columns
        )


def _text(cell: Cell, digits: int) -> str:
    match cell:
        case None:
            return MISSING
        case float():
            return f"{cell:.{digits}f}"
        case _:
            return str(cell)


def table_to_csv(table: Table) -> str:
    """Return the columns and rows as CSV text (RFC 4180, lines end with LF): numbers to nine significant digits.

    Title and notes are left out, so that the text is a table and nothing else; an unknown value is an empty field.

    Examples
    --------
    >>> print(table_to_csv(Table("Errors", ("method", "mean", "images"), (("a, b", 1 / 3, 9), ("c", None, 0)))), end="")
    method,mean,images
    "a, b",0.333333333,9
    c,,0
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    for row in table.rows:
        writer.writerow(["" if cell is None else f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row])
    return text.getvalue()
