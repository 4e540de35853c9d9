"""Tables on a terminal: names are folded where it is narrow, numbers are never cut."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evaluation.results.tables import Table
    from foundation.console import JsonOutput

_WIDE = 10_000
"""Columns of a terminal that no table fills: the table is measured as wide as it likes to be."""


def print_table(table: Table) -> None:
    """Print a table to standard output: its title, its rows, its notes.

    A terminal narrower than the table folds text between words; a file or pipe gets the table in full width.
    """
    from rich.console import Console
    from rich.table import Table as Grid
    from rich.text import Text

    texts, numeric = table.texts(), table.numeric()
    grid = Grid()
    for place, head in enumerate(table.columns):
        words = [head, *(row[place] for row in texts)]
        if numeric[place]:
            grid.add_column(Text(head), justify="right", no_wrap=True, min_width=max(map(len, words)))
        else:
            least = max((len(part) for word in words for part in word.split()), default=1)
            grid.add_column(Text(head), min_width=least)
    for row in texts:
        # Text, not str: a name with square brackets is no markup.
        grid.add_row(*map(Text, row))
    console = Console()
    needed = Console(width=_WIDE).measure(grid)
    # A file or pipe has no width, but rich would take that of the terminal on stdin or stderr.
    console.width = max(console.width, needed.minimum) if console.is_terminal else needed.maximum
    print(table.title)
    console.print(grid)
    for note in table.notes:
        print(note)


def show_tables(told: JsonOutput, tables: Sequence[Table], between: str | None = None) -> None:
    """Print tables, or add them to `tables` of the JSON object where one is asked for."""
    for table in tables:
        if told.asked:
            rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
            whole = {"title": table.title, "columns": table.columns, "rows": rows, "notes": table.notes}
            told.append("tables", whole)
            continue
        print_table(table)
        if between is not None:
            print(between)


def show_notes(told: JsonOutput, notes: Sequence[str], treatment: Mapping[str, str] | None = None) -> None:
    """Print notes and what was done to the images, or add them to the JSON object where one is asked for."""
    if told.asked:
        told.add(notes=list(notes))
        if treatment is not None:
            told.add(treatment=dict(treatment))
        return
    for note in notes:
        print(note)
    for what, how in (treatment or {}).items():
        print(f"{what}: {how}")
