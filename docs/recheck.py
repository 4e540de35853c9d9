"""Run the commands of the pages, and list the figures that differ from their output.

`python -m docs.recheck [PAGE…] [--data FOLDER]… [--seconds S]` checks README and docs before a release, in
temporary folders. A comment in TOML precedes each table of printed figures:

    <!-- recheck
    reads = "FOLDER/bits.csv"          # file with the figures; commands write to FOLDER
    rows = ["Algorithm"]               # columns that name a row, as in the table; "a, b" joins two
    columns = "Bits set to zero"       # column with the table's other headings; else they are column names
    value = "Med."                     # column with the figures; else, with `columns`, the row names it
    where = { error = "recovery" }     # selects rows by columns that the table does not show
    names = { "Best 25 %" = "best25" } # columns with other names than the table's headings
    needs = ["thumbnails.npz"]         # files outside the suite, searched below the folders of --data
    seconds = 2                        # time of the commands
    tolerance = 0.02                   # default: slightly more than half a unit of the last digit
    command = "evaluate …"             # default: the last block of commands above, or all Python blocks
    first = "sim table …"              # earlier commands that it needs
    -->

The first number of each table cell is compared. With `says`, sentences below the comment are compared instead. Each
text is a sentence of the page with figures replaced by {COLUMN: ROW}. ROW lists the values of `rows`, separated by
semicolons (* for any). With several rows, min or max precedes the column:

    says = ["Gray-world lies between {min Med.: Gray-world; *}° and {max Med.: Gray-world; *}° in the median"]

Without `reads`, the comment precedes a fenced text block that is compared with the printed output, figures within the
tolerance. On a page of Python cells it precedes the last one, and all text blocks above are compared too. The commands
run unchanged, so check only a copy that you trust. Figures that take hours or restricted data have the words "taken
with version", version and date in their section. On pages in `MEASURED`, a table with neither is a difference.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import math
import os
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict

ROOT = Path(__file__).resolve().parents[1]

# Pages with measured tables; decimals on other pages are limits, formats and settings.
MEASURED = (
    "README.md",
    "docs/paper.md",
    "docs/reference/rendering.md",
    "docs/how-to/table-without-a-lab.md",
    "docs/how-to/transfer.md",
    "docs/how-to/tune.md",
)

NO_SOURCE = 'figures without a source; add a recheck comment or, in their section, "taken with version X, YYYY-MM-DD"'
NUMBER = re.compile(r"-?(?:\d+\.?\d*|\.\d+)")
TAKEN = re.compile(r"taken\s+with\s+version\s+(\S+),\s+(\d{4}-\d\d-\d\d)", re.IGNORECASE)


# Start of a Python cell.
PYTHON = "```python\n"

# A figure in a sentence: min or max, column, row.
SLOT = re.compile(r"\{(?:(min|max) )?([^{}:]+)(?:: ([^{}]*))?\}")


@dataclass(frozen=True)
class Table:
    """A table of a page: first line, headings, rows of cells."""

    line: int
    headings: list[str]
    rows: list[list[str]]

    def has_figures(self) -> bool:
        """Return whether a cell has a decimal."""
        return any(re.search(r"\d?\.\d", cell) for row in self.rows for cell in row)


class Mark(BaseModel):
    """Content of the comment; see the module docstring."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reads: str | None = None
    says: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    columns: str | None = None
    value: str | None = None
    where: dict[str, str] = {}
    names: dict[str, str] = {}
    needs: tuple[str, ...] = ()
    seconds: float
    tolerance: float | None = None
    command: str | None = None
    first: str = ""


@dataclass(frozen=True)
class Check:
    """A comment of a page with the stated figures and the commands that print them.

    `stated`: a table, a text with the sentences of `mark.says`, or the lines of a block, from `line` on.
    """

    page: str
    line: int
    stated: Table | str | list[str]
    command: str
    mark: Mark

    @property
    def place(self) -> str:
        """Return page and line."""
        return f"{self.page}:{self.line}"


def checks_of(page: str, text: str) -> list[Check]:
    """Return the checks of a page."""
    checks: list[Check] = []
    for comment in re.finditer(r"^<!-- recheck\n(.*?)^-->\n", text, re.MULTILINE | re.DOTALL):
        mark = Mark.model_validate(tomllib.loads(comment[1]))
        line = text.count("\n", 0, comment.end()) + 1
        text_below = text[comment.end() :]
        stated: Table | str | list[str] | None
        if mark.says:
            stated = text_below
        elif mark.reads is None:
            block = re.match(r"\n*```text\n(?:.*\n)*?```\n", text_below)
            # Cells run as one program, which prints the text of all blocks.
            source = (text[: comment.start()] if PYTHON in text[: comment.start()] else "") + (
                block[0] if block else ""
            )
            stated = [
                line for lines in re.findall(r"(?ms)^```text\n(.*?)^```\n", source) for line in lines.splitlines()
            ]
        else:
            stated = next((table for table in tables_of(text) if table.line >= line), None)
            line = stated.line if stated else line
        if not stated:
            raise ValueError(f"{page}:{line}: no table or text block below a recheck comment; add one")
        command = mark.command or _commands_above(text[: comment.start()])
        # The output of the first commands is not compared.
        setup = f"{{\n{mark.first}\n}} >&2\n" if mark.first else ""
        checks.append(Check(page, line, stated, setup + command, mark))
    return checks


def tables_of(text: str) -> list[Table]:
    """Return the tables of a page, in order."""
    lines = text.splitlines()
    tables: list[Table] = []
    for is_table, group in itertools.groupby(enumerate(lines, 1), key=lambda pair: pair[1].startswith("|")):
        if is_table and len(rows := [(n, [cell.strip() for cell in row[1:-1].split("|")]) for n, row in group]) > 2:
            tables.append(Table(rows[0][0], rows[0][1], [cells for _, cells in rows[2:]]))
    return tables


def tables_without_source(text: str) -> list[Table]:
    """Return the tables of figures without commands and without version and date in their section."""
    checked = {check.line for check in checks_of("", text)}
    starts = [1, *(n for n, line in enumerate(text.splitlines(), 1) if line.startswith("## "))]
    lines = text.splitlines()
    tables: list[Table] = []
    for table in tables_of(text):
        start = max(n for n in starts if n <= table.line)
        end = min((n for n in starts if n > table.line), default=len(lines) + 1)
        dated = TAKEN.search("\n".join(lines[start - 1 : end - 1]))
        if table.has_figures() and table.line not in checked and not dated:
            tables.append(table)
    return tables


def _commands_above(text: str) -> str:
    """Return the last block of commands (indented or fenced); of Python, all blocks joined."""
    text = re.sub(r"^<!--.*?-->\n", "", text, flags=re.MULTILINE | re.DOTALL)
    found = re.finditer(r"(?:^    .*\n)+|^```(\w*)\n((?:.*\n)*?)```\n", text, re.MULTILINE)
    blocks = [(block[1], block[2] or block[0]) for block in found if block[1] in (None, "", "sh", "console", "python")]
    language, last_block = blocks[-1]
    if language != "python":
        return "\n".join(line.removeprefix("    ") for line in last_block.splitlines())
    return "\n".join(["python - <<'END'", *(code for language, code in blocks if language == "python"), "END"])


def differences(check: Check, folder: Path, output: str = "") -> list[str]:
    """Compare the figures of a page with the file in `folder` or the output; return one line per difference."""
    if check.mark.reads is None:
        assert isinstance(check.stated, list)
        return list(_differences_of_lines(check, check.stated, output.splitlines()))
    with (folder / check.mark.reads).open(encoding="utf-8", newline="") as file:
        printed = [row for row in csv.DictReader(file) if all(row[k] == v for k, v in check.mark.where.items())]
    if isinstance(check.stated, str):
        return [line for template in check.mark.says for line in _differences_of_sentence(check, template, printed)]
    assert isinstance(check.stated, Table)
    rows = check.stated.rows
    if not any(NUMBER.search(cell) for cells in rows for cell in cells[max(len(check.mark.rows), 1) :]):
        return [f"{check.place}: the table states no figure"]
    return [line for cells in rows for line in _differences_of_row(check, check.stated, cells, printed)]


def _differences_of_lines(check: Check, stated: Sequence[str], printed: Sequence[str]) -> Iterator[str]:
    if len(stated) != len(printed):
        yield f"{check.place}: {len(stated)} lines stated, {len(printed)} printed"
    for line, found in zip(stated, printed, strict=False):
        numbers, values = NUMBER.findall(line), NUMBER.findall(found)
        words, others = (NUMBER.sub("", text).split() for text in (line, found))
        if (words, len(numbers)) != (others, len(values)) or any(
            abs(float(number) - float(value)) > _tolerance(check.mark, number)
            for number, value in zip(numbers, values, strict=False)
        ):
            yield f"{check.place}: {line.strip()!r} stated, {found.strip()!r} printed"


def _differences_of_sentence(check: Check, template: str, printed: Sequence[dict[str, str]]) -> Iterator[str]:
    slots = list(SLOT.finditer(template))
    texts = [r"\s+".join(map(re.escape, value.split(" "))) for value in SLOT.split(template)[:: SLOT.groups + 1]]
    match = re.search(f"({NUMBER.pattern})".join(texts), str(check.stated).replace("−", "-"))
    if not slots or match is None:
        yield f"{check.place}: the page has no such sentence with figures: {template}"
        return
    for slot, number in zip(slots, match.groups(), strict=True):
        pick, column, row = slot.groups()
        row_values = [value.strip() for value in (row or "").split(";")]
        values = [
            float(row[column])
            for row in printed
            if NUMBER.fullmatch(row[column])
            and all(wanted in ("*", "", row[key]) for key, wanted in zip(check.mark.rows, row_values, strict=False))
        ]
        if not values or (pick is None and len(values) > 1):
            yield f"{check.place}: {slot[0]}: {number} stated, not one figure printed"
        elif abs(float(number) - (value := max(values) if pick == "max" else min(values))) > _tolerance(
            check.mark, number
        ):
            yield f"{check.place}: {slot[0]}: {number} stated, {value:.6g} printed"


def _differences_of_row(
    check: Check, table: Table, cells: Sequence[str], printed: Sequence[dict[str, str]]
) -> Iterator[str]:
    labels = max(len(check.mark.rows), 1)
    row_labels = [_plain(cell) for cell in cells[: len(check.mark.rows)]]
    rows = [row for row in printed if [_label(row, names) for names in check.mark.rows] == row_labels]
    for heading, cell in zip(table.headings[labels:], cells[labels:], strict=True):
        stated = NUMBER.search(_plain(cell))
        if stated is None:
            continue
        value = _printed(check.mark, heading, cells[0], rows)
        where = f"{check.place}: {', '.join(cells[:labels])}; {heading}"
        if value is None:
            yield f"{where}: {stated[0]} stated, not one figure printed"
        elif abs(float(stated[0]) - value) > _tolerance(check.mark, stated[0]):
            yield f"{where}: {stated[0]} stated, {value:.6g} printed"


def _label(row: Mapping[str, str], names: str) -> str:
    return _plain(", ".join(row[name.strip()] for name in names.split(",")))


def _printed(mark: Mark, heading: str, label: str, rows: Sequence[dict[str, str]]) -> float | None:
    """Return the printed figure; None if there is none or more than one."""
    if mark.columns is not None:
        rows = [row for row in rows if _plain(row[mark.columns]) == _plain(heading)]
    name = mark.names.get(heading, heading) if mark.columns is None else mark.value or label
    figures = [value for row in rows for key, value in row.items() if _plain(key) == _plain(name)]
    return float(figures[0]) if len(figures) == 1 and re.fullmatch(r"-?[\d.]+(?:e[+-]?\d+)?", figures[0]) else None


def _plain(text: str) -> str:
    """Remove emphasis, typographic signs, case and blanks from a cell or name."""
    return re.sub(r"[*`\s]", "", text).replace("−", "-").casefold()


def _tolerance(mark: Mark, stated: str) -> float:
    digits = len(stated.partition(".")[2])
    return mark.tolerance if mark.tolerance is not None else 0.51 * 10.0**-digits


def run(checks: Sequence[Check], data: Sequence[Path], max_s: float = math.inf) -> tuple[list[str], list[str]]:
    """Run each block of commands once; return the differences and the checks that were not run, one line each."""
    differing: list[str] = []
    skipped: list[str] = []
    blocks: dict[str, list[Check]] = {}
    for check in checks:
        blocks.setdefault(check.command, []).append(check)
    for command, block in blocks.items():
        paths = {name: _find_file(name, data) for check in block for name in check.mark.needs}
        missing = [name for name, path in paths.items() if path is None]
        seconds = max(check.mark.seconds for check in block)
        if missing or seconds > max_s:
            cause = f"needs {', '.join(missing)}; name its folder with --data" if missing else f"takes {seconds:g} s"
            skipped += [f"{check.place}: {cause}" for check in block]
            continue
        with tempfile.TemporaryDirectory() as folder:
            for name, path in (paths | {"examples": ROOT / "examples"}).items():
                (Path(folder) / name).symlink_to(str(path))
            differing += _run_block(command, block, Path(folder))
    return differing, skipped


def run_commands(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run commands of a page in a folder with the programs of this Python, up to the first failure."""
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    settings = os.environ | {"PATH": paths, "PYTHONPATH": str(ROOT)}
    return subprocess.run(["bash", "-euc", command], cwd=folder, env=settings, capture_output=True, text=True)


def _run_block(command: str, block: Sequence[Check], folder: Path) -> list[str]:
    process = run_commands(command, folder)
    if process.returncode:
        output = (process.stderr or process.stdout).strip()[-500:]
        return [f"{block[0].place}: the commands ended with exit code {process.returncode}: {output}"]
    return [line for check in block for line in _differences_or_error(check, folder, process.stdout)]


def _differences_or_error(check: Check, folder: Path, output: str) -> list[str]:
    try:
        return differences(check, folder, output)
    except OSError as error:
        return [f"{check.place}: the commands left no {check.mark.reads} ({error.strerror})"]
    except KeyError as error:
        return [f"{check.place}: {check.mark.reads} has no column {error.args[0]!r}"]


def _find_file(name: str, folders: Sequence[Path]) -> Path | None:
    return next((path.resolve() for folder in folders for path in sorted(folder.rglob(name))), None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the checks of pages; print differences and skipped checks; return 1 if there is a difference."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="default: README.md and all of docs")
    parser.add_argument("--data", type=Path, action="append", default=[], help="folder with files that commands need")
    parser.add_argument("--seconds", type=float, default=math.inf, help="skip commands that take longer")
    options = parser.parse_args(arguments)
    for folder in options.data:
        if not folder.is_dir():
            parser.error(f"--data {folder} is not a folder; name the folder with the files that commands need")
    named = [Path(page).resolve() for page in options.pages]
    pages = named or [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in pages}
    checks = [check for page, text in texts.items() for check in checks_of(page, text)]
    differing, skipped = run(checks, options.data, options.seconds)
    run_count = len(checks) - len(skipped)
    skipped += [
        f"{page}: no checks on this page" for page, text in texts.items() if named and not checks_of(page, text)
    ]
    for page in set(texts).intersection(MEASURED):
        differing += [f"{page}:{table.line}: {NO_SOURCE}" for table in tables_without_source(texts[page])]
    for page, text in texts.items():
        dates = sorted(set(TAKEN.findall(text)))
        skipped += [f"{page}: taken with version {version}, {date}" for version, date in dates]
    for line in (*(f"not run  {line}" for line in skipped), *(f"differs  {line}" for line in differing)):
        print(line)
    print(f"{run_count} of {len(checks)} checks were run; {len(differing)} differences")
    return int(bool(differing))


if __name__ == "__main__":
    raise SystemExit(main())
