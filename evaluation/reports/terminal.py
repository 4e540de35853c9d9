"""Tables on a terminal: names are folded where it is narrow, numbers are never cut."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evaluation.results.tables import Table

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
