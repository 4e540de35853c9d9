"""A table of results as a piece of a page."""

from __future__ import annotations

from markupsafe import Markup

from evaluation.results.tables import Table
from foundation import pages


def table_part(table: Table) -> Markup:
    """Return a table with its title and notes."""
    return pages.table(table.title, table.columns, table.texts(), table.numeric(), table.notes)
