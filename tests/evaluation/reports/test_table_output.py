"""Tables on terminals of different widths, and as LaTeX."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from evaluation.reports.table_output import escape_latex, print_table, table_to_latex, tables_to_latex
from evaluation.results.tables import Table

TABLE = Table(
    "A [bold]title[/]",
    ("Algorithm", "Mean", "Worst 25%"),
    (("Shades-of-Gray [p=2] of many words", 123.456, 7.0),),
    notes=("[a] note",),
)


def test_prints_square_brackets_literally(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(TABLE)
    title, *rest, note = capsys.readouterr().out.splitlines()
    assert title == TABLE.title
    assert note == "[a] note"
    assert "Shades-of-Gray [p=2] of many words" in "\n".join(rest)


def test_narrow_terminal_folds_only_names(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # By which rich takes any output for a terminal.
    monkeypatch.setenv("COLUMNS", "45")
    print_table(TABLE)
    text = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out)
    assert max(map(len, text.splitlines())) <= 45
    for word in ("123.46", "7.00", "Shades-of-Gray", "Worst 25%"):
        assert word in text


def test_file_gets_full_width(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    print_table(TABLE)
    lines = capsys.readouterr().out.splitlines()[1:-1]
    assert len({len(line) for line in lines}) == 1
    (row,) = [line for line in lines if TABLE.texts()[0][0] in line]
    assert re.findall(r"\d+\.\d\d ", row) == ["123.46 ", "7.00 "]


HEADS = ("Algorithm", "Mean", "Best 25%")


def test_joined_tables_have_one_preamble_and_all_titles() -> None:
    tables = [Table(f"Set {number}", HEADS, (("Gray-world", 1.0, 2.0),)) for number in range(3)]
    text = tables_to_latex("All of them", tables)
    assert text.count("\\begin{tabular}") == 1
    assert [f"\\multicolumn{{3}}{{c}}{{Set {number}}}\\\\" in text for number in range(3)] == [True] * 3
    with pytest.raises(ValueError, match="expected at least one"):
        tables_to_latex("None", [])
    with pytest.raises(ValueError, match="same number of columns"):
        tables_to_latex("Two kinds", [tables[0], Table("Narrow", ("a",), ())])


RIVALS = Table(
    "Cube+ & NUS_8: errors, degrees",
    ("Algorithm", "Mean", "< 3° (%)", "Note"),
    (("A_1", 2.004, 10.0, "–"), ("B", 1.996, 30.0, "50 %"), ("C", 3.0, None, "≥ 2")),
    notes=("95 % intervals",),
    best={"Mean": "smallest", "< 3° (%)": "largest"},
    margins={(1, 1): 0.25},
)


def test_best_numbers_are_bold() -> None:
    rows = [line for line in table_to_latex(RIVALS).splitlines() if line[:1] in "ABC" and "&" in line][1:]
    # 2.004 and 1.996 are both printed as 2.00, so neither is better.
    assert rows == [
        r"A\_1 & \textbf{2.00} & 10.00 & --\\",
        r"B & \textbf{2.00 $\pm$ 0.25} & \textbf{30.00} & 50 \%\\",
        r"C & 3.00 & -- & $\ge$ 2\\",
    ]
    alone = replace(RIVALS, rows=RIVALS.rows[:1], margins={})
    assert "textbf" not in table_to_latex(alone)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex with booktabs")
def test_latex_compiles(tmp_path: Path) -> None:
    tables = table_to_latex(RIVALS) + tables_to_latex("Several", [TABLE, replace(TABLE, title="Another")])
    text = f"\\documentclass{{article}}\\usepackage{{booktabs}}\\begin{{document}}{tables}"
    (tmp_path / "a.tex").write_text(text + r"\ref{tab:cube-nus-8-errors-degrees}\end{document}", encoding="utf-8")
    for _ in range(2):  # The second run resolves the reference.
        command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "a.tex"]
        log = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert log.returncode == 0, log.stdout
    assert "undefined" not in log.stdout
    assert "Overfull" not in log.stdout


@pytest.mark.parametrize("mark", list("\\&%$#_{}~^<>|"))
def test_escapes_special_characters(mark: str) -> None:
    # Not alone after the escape as a character that TeX acts on: preceded by a backslash, within $…$, or by its name.
    assert escape_latex(mark) in (f"\\{mark}", f"${mark}$") or escape_latex(mark).startswith("\\text")
