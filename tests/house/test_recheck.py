"""Figures that pages state as printed by commands equal the printed ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from docs.recheck import MEASURED, ROOT, checks_of, run, tables_of, tables_without_source
from tests.data_files import LOCAL

# Time limit for a block of commands in the suite, s; the others run before a release.
FEW_SECONDS = 5.0

PAGE = """
    mkdir FOLDER
    printf 'Method,Bits,Med.,Note\\nA,0,1.234,x\\nA,1,2.5,x\\nB,0,3.249,x\\n' > FOLDER/out.csv

<!-- recheck
reads = "FOLDER/out.csv"
rows = ["Method"]
columns = "Bits"
value = "Med."
seconds = 0
-->

| method | 0 | 1 |
|---|---|---|
| **a** | 1.23 / 7 | 2.5 |
| B | 3.25 | – |
"""


def page_with(text: str, replacement: str) -> str:
    assert PAGE.count(text) == 1
    return PAGE.replace(text, replacement)


def test_accepts_printed_figures() -> None:
    (check,) = checks_of("page.md", PAGE)
    assert check.place == f"page.md:{PAGE.splitlines().index('| method | 0 | 1 |') + 1}"
    assert run([check], []) == ([], [])


@pytest.mark.parametrize(
    ("text", "replacement", "expected"),
    [
        ("1.23 /", "1.24 /", "a**; 0: 1.24 stated, 1.234 printed"),
        ("| – |", "| 4 |", "B; 1: 4 stated, not one figure printed"),
        ("| B |", "| C |", "C; 0: 3.25 stated, not one figure printed"),
        ("mkdir FOLDER", "exit 7", "the commands ended with exit code 7"),
        ('reads = "FOLDER/out.csv"', 'reads = "FOLDER/other.csv"', "left no FOLDER/other.csv"),
        ('rows = ["Method"]', 'rows = ["Name"]', "FOLDER/out.csv has no column 'Name'"),
        ("| **a** | 1.23 / 7 | 2.5 |\n| B | 3.25 | – |\n", "| a | – | – |\n", "states no figure"),
        ("A,1,2.5,x", "A,1,2.5,x\\nA,1,2.6,x", "a**; 1: 2.5 stated, not one figure printed"),
    ],
)
def test_reports_differences(text: str, replacement: str, expected: str) -> None:
    differ, skipped = run(checks_of("page.md", page_with(text, replacement)), [])
    assert len(differ) == 1
    assert expected in differ[0]
    assert skipped == []


def test_obeys_tolerance() -> None:
    for tolerance, count in ((0.01, 0), (0.005, 1)):
        text = page_with("seconds = 0", f"seconds = 0\ntolerance = {tolerance}").replace("1.23 /", "1.24 /")
        assert len(run(checks_of("page.md", text), [])[0]) == count


def test_selects_columns_and_rows() -> None:
    text = page_with(
        'columns = "Bits"\nvalue = "Med."', 'where = { Bits = "0" }\nnames = { "0" = "Med.", "1" = "Bits" }'
    )
    differ, _ = run(checks_of("page.md", text), [])
    assert [line.split("; ")[1] for line in differ] == ["1: 2.5 stated, 0 printed"]


SENTENCES = """
    mkdir FOLDER
    printf 'Method,Bits,Med.\\nA,0,1.234\\nA,1,2.5\\nB,0,3.249\\nB,1,-\\n' > FOLDER/out.csv

<!-- recheck
reads = "FOLDER/out.csv"
rows = ["Method", "Bits"]
says = [
    "of A rises from {Med.: A; 0}° to {Med.: A; 1}°,",
    "with 0 bits lies between {min Med.: *; 0}° and {max Med.: *; 0}°",
]
seconds = 0
-->

The median of A rises from 1.23° to
2.5°, and with 0 bits lies between 1.2°
and 3.25°.
"""


def test_compares_figures_in_sentences() -> None:
    assert run(checks_of("page.md", SENTENCES), []) == ([], [])


@pytest.mark.parametrize(
    ("text", "replacement", "expected"),
    [
        ("2.5°", "2.6°", "{Med.: A; 1}: 2.6 stated, 2.5 printed"),
        ("and 3.25°", "and 2.5°", "{max Med.: *; 0}: 2.5 stated, 3.249 printed"),
        ("of A rises from 1.23", "of A grows from 1.23", "the page has no such sentence with figures: of A rises"),
        ("{Med.: A; 1}", "{Med.: A; *}", "2.5 stated, not one figure printed"),
        ("{Med.: A; 1}", "{Med.: B; 1}", "2.5 stated, not one figure printed"),
        ("{Med.: A; 1}", "{Mean: A; 1}", "has no column 'Mean'"),
        ("{Med.: A; 0}° to {Med.: A; 1}", "1.23° to\n2.5", "the page has no such sentence with figures"),
    ],
)
def test_reports_differences_in_sentences(text: str, replacement: str, expected: str) -> None:
    assert SENTENCES.count(text) == 1
    page = SENTENCES.replace(text, replacement.replace("\n", " ") if "{" in text else replacement)
    differ, skipped = run(checks_of("page.md", page), [])
    assert skipped == []
    assert len(differ) == 1
    assert expected in differ[0]


CELLS = """
```python
first = 1.234
print(f"one {first:.2f}, two 7 px")
```

```text
one 1.23, two 7 px
```

```python
print("first:", first + 1)
```

<!-- recheck
seconds = 0
first = "echo nothing of this"
-->

```text
first: 2.234
```
"""


@pytest.mark.slow
def test_compares_output_of_cells() -> None:
    assert run(checks_of("page.md", CELLS), []) == ([], [])
    for text, replacement in (
        ("2.234", "2.24"),
        ("first: ", "last: "),
        ("7 px\n```", "7 px\nmore\n```"),
        ("1.23, two 7", "1.23, two 8"),
    ):
        assert CELLS.count(text) == 1
        assert run(checks_of("page.md", CELLS.replace(text, replacement)), [])[0]


def test_reports_skipped_commands(tmp_path: Path) -> None:
    needs = page_with("seconds = 0", 'seconds = 9\nneeds = ["a.npz"]').replace(
        "mkdir FOLDER", "cat a.npz; mkdir FOLDER"
    )
    assert "needs a.npz" in run(checks_of("page.md", needs), [tmp_path])[1][0]
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "a.npz").touch()
    assert "takes 9 s" in run(checks_of("page.md", needs), [tmp_path], 8)[1][0]
    assert run(checks_of("page.md", needs), [tmp_path], 9) == ([], [])


def test_finds_tables_without_source() -> None:
    bare = PAGE.replace("<!-- recheck", "<!-- nothing")
    assert tables_without_source(bare) == tables_of(PAGE)
    assert tables_without_source(f"taken\nwith version 0.1.0, 2026-11-24\n{bare}") == []
    assert tables_without_source(f"taken with version 0.1.0, 2026-11-24\n\n## Next\n{bare}") != []
    assert tables_without_source(PAGE) == []


@pytest.mark.parametrize("page", MEASURED)
def test_each_figure_has_source(page: str) -> None:
    tables = tables_without_source((ROOT / page).read_text(encoding="utf-8"))
    assert [(table.line, table.headings) for table in tables] == []


@pytest.mark.slow
def test_pages_state_printed_figures() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    checks = [check for page in pages for check in checks_of(page.name, page.read_text(encoding="utf-8"))]
    # One block of commands of each kind; variants with other options run before a release.
    kinds = {" ".join(check.command.splitlines()[-1].split()[:3]): check.command for check in checks}
    selected = [check for check in checks if check.command in kinds.values()]
    differ, skipped = run(selected, [folder for folder in LOCAL if folder.is_dir()], FEW_SECONDS)
    assert differ == []
    assert len(skipped) < len(selected)
