"""Tables on terminals of every width."""

from __future__ import annotations

import re

import pytest

from evaluation.reports.table_output import print_table
from evaluation.results.tables import Table

TABLE = Table(
    "A [bold]title[/]",
    ("Algorithm", "Mean", "Worst 25%"),
    (("Shades-of-Gray [p=2] of many words", 123.456, 7.0),),
    notes=("[a] note",),
)


def test_square_brackets_are_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(TABLE)
    title, *rest, note = capsys.readouterr().out.splitlines()
    assert title == TABLE.title
    assert note == "[a] note"
    assert "Shades-of-Gray [p=2] of many words" in "\n".join(rest)


def test_a_narrow_terminal_folds_names_and_cuts_no_number(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # By which rich takes any output for a terminal.
    monkeypatch.setenv("COLUMNS", "45")
    print_table(TABLE)
    text = re.sub(r"\x1b\[[\d;]*m", "", capsys.readouterr().out)
    assert max(map(len, text.splitlines())) <= 45
    for word in ("123.46", "7.00", "Shades-of-Gray", "Worst 25%"):
        assert word in text
