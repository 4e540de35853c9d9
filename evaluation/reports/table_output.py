"""Output of result tables for people: terminal, LaTeX, HTML.

On a narrow terminal, names are wrapped; numbers are never cut. LaTeX needs the package booktabs, and graphicx for wide
tables. Tables are floats with a caption and a label, the best numbers are bold, and headings of several words are
stacked. Tables with the same columns can be joined in one float, each with its title.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from markupsafe import Markup

from evaluation.results.tables import Table
from foundation import pages
from foundation.console import JsonOutput

_UNLIMITED_WIDTH = 10_000  # Terminal columns, more than any table needs, for measuring the natural width of a table


def print_table(table: Table) -> None:
    """Print a table with title and notes to standard output.

    Text is wrapped only on a terminal that is narrower than the table; files and pipes get the full width.
    """
    from rich.console import Console
    from rich.table import Table as Grid
    from rich.text import Text

    texts, numeric = table.texts(), table.numeric()
    grid = Grid()
    for index, head in enumerate(table.columns):
        words = [head, *(row[index] for row in texts)]
        if numeric[index]:
            grid.add_column(Text(head), justify="right", no_wrap=True, min_width=max(map(len, words)))
        else:
            min_width = max((len(word_part) for word in words for word_part in word.split()), default=1)
            grid.add_column(Text(head), min_width=min_width)
    for row in texts:
        # Text objects are used, because rich would interpret square brackets in a str as markup.
        grid.add_row(*map(Text, row))
    console = Console()
    natural_width = Console(width=_UNLIMITED_WIDTH).measure(grid)
    # A file or pipe has no width. For these, rich would use the width of the terminal on stdin or stderr.
    console.width = max(console.width, natural_width.minimum) if console.is_terminal else natural_width.maximum
    # Rich would end the process if its output is closed. Its text is therefore captured and printed here, because
    # `foundation.console.run` handles closed output.
    with console.capture() as captured:
        console.print(grid)
    print(f"{table.title}\n{captured.get()}", end="")
    for note in table.notes:
        print(note)


def show_tables(output: JsonOutput, tables: Sequence[Table], separator: str | None = None) -> None:
    """Print the tables, or add them to `tables` of the JSON output."""
    for table in tables:
        if output.is_requested:
            rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
            table_object = {"title": table.title, "columns": table.columns, "rows": rows, "notes": table.notes}
            output.append("tables", table_object)
            continue
        print_table(table)
        if separator is not None:
            print(separator)


def show_notes(output: JsonOutput, notes: Sequence[str], treatment: Mapping[str, str] | None = None) -> None:
    """Print notes and treatment of the images, or add them to the JSON output."""
    if output.is_requested:
        output.add(notes=list(notes))
        if treatment is not None:
            output.add(treatment=dict(treatment))
        return
    for note in notes:
        print(note)
    for aspect, treatment_text in (treatment or {}).items():
        print(f"{aspect}: {treatment_text}")


# Characters that are LaTeX commands or missing in its default fonts, with their replacements.
_LATEX_TEXTS = {
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


_NORMAL_COLUMNS = 8  # Columns of a table with all error statistics; wider tables are scaled to the text width


def escape_latex(text: str) -> str:
    r"""Return LaTeX that prints the text unchanged.

    Examples
    --------
    >>> print(escape_latex("A_1 & 25% of σ"))
    A\_1 \& 25\% of $\sigma$
    """
    return "".join(_LATEX_TEXTS.get(mark, mark) for mark in text)


def table_to_latex(table: Table) -> str:
    r"""Return the table as a LaTeX float, with its title as caption, a label, its best numbers bold and notes below.

    Examples
    --------
    >>> from evaluation.results.tables import Table
    >>> print(table_to_latex(Table("Errors", ("Algorithm", "Best 25%"), (("Gray-world", 1.5),))), end="")
    % \usepackage{booktabs}
    \begin{table}[ht]
    \centering
    \caption{Errors}
    \label{tab:errors}
    \begin{tabular}{lr}
    \toprule
    Algorithm & \shortstack{\strut Best\\25\%}\\
    \midrule
    Gray-world & 1.50\\
    \bottomrule
    \end{tabular}
    \end{table}
    """
    return _float(table.title, table, [_head_row(table), "\\midrule", *_rows(table)], table.notes)


def tables_to_latex(caption: str, tables: Sequence[Table]) -> str:
    r"""Return tables with the same number of columns as one LaTeX float, each with its title, as in the paper."""
    widths = sorted({len(table.columns) for table in tables})
    if len(widths) != 1:
        raise ValueError(
            f"{len(tables)} tables with {widths} columns, expected at least one, all with the same number of columns"
        )
    lines: list[str] = []
    for index, table in enumerate(tables):
        title = f"\\multicolumn{{{len(table.columns)}}}{{c}}{{{escape_latex(table.title)}}}\\\\"
        lines += ["\\midrule"] if index else []
        lines += [title, "\\midrule", _head_row(table), "\\midrule", *_rows(table)]
    return _float(caption, tables[0], lines, [note for table in tables for note in table.notes])


def _float(caption: str, layout: Table, lines: Sequence[str], notes: Sequence[str]) -> str:
    alignments = "".join("r" if is_number else "l" for is_number in layout.numeric())
    is_wide = len(alignments) > _NORMAL_COLUMNS
    note_text = " ".join(f"{note.rstrip('.')}." for note in dict.fromkeys(notes))
    note_lines = [f"\\\\[.3em]\\parbox{{\\linewidth}}{{\\footnotesize {escape_latex(note_text)}}}"] if notes else []
    label = re.sub(r"[^a-z0-9]+", "-", caption.lower()).strip("-")
    return "\n".join(
        [
            "% \\usepackage{booktabs,graphicx}" if is_wide else "% \\usepackage{booktabs}",
            "\\begin{table}[ht]",
            "\\centering",
            f"\\caption{{{escape_latex(caption)}}}",
            f"\\label{{tab:{label}}}",
            *(["\\setlength{\\tabcolsep}{3pt}\\resizebox{\\linewidth}{!}{%"] if is_wide else []),
            f"\\begin{{tabular}}{{{alignments}}}",
            "\\toprule",
            *lines,
            "\\bottomrule",
            "\\end{tabular}" + "}" * is_wide,
            *note_lines,
            "\\end{table}",
            "",
        ]
    )


def _head_row(table: Table) -> str:
    # Columns of numbers are narrow, so their headings are stacked.
    heads = [
        _stacked(head) if is_number else escape_latex(head)
        for head, is_number in zip(table.columns, table.numeric(), strict=True)
    ]
    return f"{' & '.join(heads)}\\\\"


def _stacked(head: str) -> str:
    words = [escape_latex(word) for word in head.split()]
    over_each_other = r"\\".join(words)
    return words[0] if len(words) == 1 else f"\\shortstack{{\\strut {over_each_other}}}"


def _rows(table: Table) -> list[str]:
    best = table.best_cells()
    cells = [
        [
            f"\\textbf{{{escape_latex(text)}}}" if (row, column) in best else escape_latex(text)
            for column, text in enumerate(texts)
        ]
        for row, texts in enumerate(table.texts())
    ]
    return [f"{' & '.join(row)}\\\\" for row in cells]


def table_part(table: Table) -> Markup:
    """Return the table with title and notes as HTML."""
    return pages.table(table.title, table.columns, table.texts(), table.numeric(), table.notes)
