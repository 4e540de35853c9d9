"""A table of results as people read it: on a terminal, as LaTeX, as a piece of a page.

On a terminal names are folded where it is narrow, numbers are never cut. LaTeX has the layout of the paper's tables 1
and 2 and needs no package: floats with a caption, heads of several words stacked; several tables with the same heads
become one, each under its title.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from markupsafe import Markup

from evaluation.results.tables import Table
from foundation import pages
from foundation.console import JsonOutput

_WIDE = 10_000  # Columns of a terminal that no table fills: the table is measured as wide as it likes to be


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
    # Rich ends the process where the reader of its output left; our own printing is judged by `foundation.console.run`.
    with console.capture() as drawn:
        console.print(grid)
    print(f"{table.title}\n{drawn.get()}", end="")
    for note in table.notes:
        print(note)


def show_tables(output: JsonOutput, tables: Sequence[Table], between: str | None = None) -> None:
    """Print tables, or add them to `tables` of the JSON object where one is asked for."""
    for table in tables:
        if output.is_requested:
            rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
            whole = {"title": table.title, "columns": table.columns, "rows": rows, "notes": table.notes}
            output.append("tables", whole)
            continue
        print_table(table)
        if between is not None:
            print(between)


def show_notes(output: JsonOutput, notes: Sequence[str], treatment: Mapping[str, str] | None = None) -> None:
    """Print notes and what was done to the images, or add them to the JSON object where one is asked for."""
    if output.is_requested:
        output.add(notes=list(notes))
        if treatment is not None:
            output.add(treatment=dict(treatment))
        return
    for note in notes:
        print(note)
    for what, how in (treatment or {}).items():
        print(f"{what}: {how}")


# Characters that LaTeX reads as commands or that its default fonts lack, and what sets them.
_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
    **{mark: f"${mark}$" for mark in "<>|"},
    "–": "--",
    "—": "---",
    "…": r"\ldots{}",
    "°": r"$^\circ$",
    "×": r"$\times$",
    "±": r"$\pm$",
    "·": r"$\cdot$",
    "−": "$-$",
    "≤": r"$\le$",
    "≥": r"$\ge$",
    "≈": r"$\approx$",
    "∞": r"$\infty$",
    "²": "$^2$",
    "³": "$^3$",
    "½": r"$\frac12$",
    "→": r"$\to$",
    "α": r"$\alpha$",
    "β": r"$\beta$",
    "γ": r"$\gamma$",
    "Δ": r"$\Delta$",
    "λ": r"$\lambda$",
    "μ": r"$\mu$",
    "σ": r"$\sigma$",
}


_WIDE_COLUMNS = 7  # Columns of the paper's tables; with more a table is set smaller, to fit a page's text


def escape_latex(text: str) -> str:
    r"""Return LaTeX that sets a text as it is.

    Examples
    --------
    >>> print(escape_latex("A_1 & 25% of σ"))
    A\_1 \& 25\% of $\sigma$
    """
    return "".join(_SPECIAL.get(mark, mark) for mark in text)


def table_to_latex(table: Table) -> str:
    r"""Return a table as a LaTeX float: its title the caption, its notes below it.

    Examples
    --------
    >>> from evaluation.results.tables import Table
    >>> print(table_to_latex(Table("Errors", ("Algorithm", "Best 25%"), (("Gray-world", 1.5),))), end="")
    \begin{table}[ht]
    \centering
    \caption{Errors}
    \begin{tabular}{|l|r|}
    \hline
    \textbf{Algorithm} & \shortstack{\strut\textbf{Best}\\\textbf{25\%}}\\
    \hline
    Gray-world & 1.50\\
    \hline
    \end{tabular}
    \end{table}
    """
    return _float(table.title, table, [_heads(table), *_rows(table)], table.notes)


def tables_to_latex(caption: str, tables: Sequence[Table]) -> str:
    r"""Return several tables of as many columns as one LaTeX float, as the paper's Table 1: each under its title."""
    widths = sorted({len(table.columns) for table in tables})
    if len(widths) != 1:
        raise ValueError(
            f"{len(tables)} tables of {widths} columns; expected at least one, and the same columns in each"
        )
    lines: list[str] = []
    for number, table in enumerate(tables):
        title = f"\\multicolumn{{{len(table.columns)}}}{{|c|}}{{{escape_latex(table.title)}}}\\\\"
        lines += ["\\hline", "\\hline"] if number else []
        lines += [title, "\\hline", _heads(table), *_rows(table)]
    return _float(caption, tables[0], lines, [note for table in tables for note in table.notes])


def _float(caption: str, like: Table, lines: Sequence[str], notes: Sequence[str]) -> str:
    kinds = ["r" if number else "l" for number in like.numeric()]
    said = " ".join(f"{note.rstrip('.')}." for note in dict.fromkeys(notes))
    below = [f"\\\\[.3em]\\parbox{{\\linewidth}}{{\\footnotesize {escape_latex(said)}}}"] if notes else []
    return "\n".join(
        [
            "\\begin{table}[ht]",
            "\\centering",
            f"\\caption{{{escape_latex(caption)}}}",
            *(["\\scriptsize\\setlength{\\tabcolsep}{3pt}"] if len(kinds) > _WIDE_COLUMNS else []),
            f"\\begin{{tabular}}{{|{kinds[0]}|{''.join(kinds[1:])}{'|' if kinds[1:] else ''}}}",
            "\\hline",
            *lines,
            "\\hline",
            "\\end{tabular}",
            *below,
            "\\end{table}",
            "",
        ]
    )


def _heads(table: Table) -> str:
    """Return the row of heads; a head of several words over numbers is stacked, as the numbers are narrow."""
    heads = [
        _stacked(head) if numeric else f"\\textbf{{{escape_latex(head)}}}"
        for head, numeric in zip(table.columns, table.numeric(), strict=True)
    ]
    return f"{' & '.join(heads)}\\\\\n\\hline"


def _stacked(head: str) -> str:
    words = [f"\\textbf{{{escape_latex(word)}}}" for word in head.split()]
    over_each_other = r"\\".join(words)
    return words[0] if len(words) == 1 else f"\\shortstack{{\\strut{over_each_other}}}"


def _rows(table: Table) -> list[str]:
    return [f"{' & '.join(map(escape_latex, row))}\\\\" for row in table.texts()]


def table_part(table: Table) -> Markup:
    """Return a table with its title and notes."""
    return pages.table(table.title, table.columns, table.texts(), table.numeric(), table.notes)
