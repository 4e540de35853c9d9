"""Run what the pages state as printed by commands, and list the figures that differ from what is printed now.

`python -m docs.recheck [PAGE…] [--data FOLDER]… [--seconds S]` runs, before a release, all of README and docs, in
folders that are removed afterwards. A table of figures that commands print has a comment before it, in TOML:

    <!-- recheck
    reads = "FOLDER/bits.csv"          # the file that holds the figures; commands write to FOLDER
    rows = ["Algorithm"]               # its columns that name a row, as the table's first ones do; "a, b" joins two
    columns = "Bits set to zero"       # its column with the table's other headings; else they are names of columns
    value = "Med."                     # its column with the figures; else, with `columns`, the row's label names it
    where = { error = "recovery" }     # which rows are meant, by columns that the table does not show
    names = { "Best 25 %" = "best25" } # columns whose names are not the table's headings
    needs = ["thumbnails.npz"]         # files that do not come with the suite, looked for below the folders of --data
    seconds = 2                        # what the commands take
    tolerance = 0.02                   # by default a bit more than half of the last digit's unit
    command = "evaluate …"             # by default the last block of commands above, or all blocks of Python
    first = "sim table …"              # commands further up that it needs
    -->

The first number of each cell is compared. Where the comment has `says`, sentences below it are compared in place of a
table: each text is that of the page, with a column in braces where a figure stands, behind a colon the row by what its
`rows` hold, between semicolons (* for any), and before it min or max where several rows are meant:

    says = ["Gray-world lies between {min Med.: Gray-world; *}° and {max Med.: Gray-world; *}° in the median"]

Without `reads` the comment stands before a fenced block of text, which is what the commands print, figures within the
tolerance; on a page of cells of Python before the last, and all such blocks above are compared with it. Commands run as
they stand, so recheck only a copy that you trust. Figures that cannot be run so, because they take hours or data that
nobody may pass on, have in their section the words "taken with version", the version and the date; on pages of
measurements (`MEASURED`) a table with neither counts as a difference.
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

# Pages whose tables of decimals are measurements; tables of other pages state limits, formats and settings.
MEASURED = (
    "README.md",
    "docs/paper.md",
    "docs/reference/rendering.md",
    "docs/how-to/table-without-a-lab.md",
    "docs/how-to/transfer.md",
    "docs/how-to/tune.md",
)

NO_SOURCE = 'figures with neither a recheck comment nor, in their section, "taken with version X, YYYY-MM-DD"'
NUMBER = re.compile(r"-?(?:\d+\.?\d*|\.\d+)")
TAKEN = re.compile(r"taken\s+with\s+version\s+(\S+),\s+(\d{4}-\d\d-\d\d)", re.IGNORECASE)


# What a cell begins with.
PYTHON = "```python\n"

# A figure of a sentence: which of several, its column, its row.
SLOT = re.compile(r"\{(?:(min|max) )?([^{}:]+)(?:: ([^{}]*))?\}")


@dataclass(frozen=True)
class Table:
    """A table of a page: the line it begins in, headings, and rows of cells."""

    line: int
    headings: list[str]
    rows: list[list[str]]

    def has_figures(self) -> bool:
        """Return whether a cell has a decimal."""
        return any(re.search(r"\d?\.\d", cell) for row in self.rows for cell in row)


class Mark(BaseModel):
    """What the comment says; see above."""

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
    """What a page states below a comment, the commands that print its figures, and how these are found.

    `stated`: a table, a text with the sentences of `mark.says`, or the lines of a block. `line` is where it begins.
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
    found: list[Check] = []
    for comment in re.finditer(r"^<!-- recheck\n(.*?)^-->\n", text, re.MULTILINE | re.DOTALL):
        mark = Mark.model_validate(tomllib.loads(comment[1]))
        line = text.count("\n", 0, comment.end()) + 1
        below = text[comment.end() :]
        stated: Table | str | list[str] | None
        if mark.says:
            stated = below
        elif mark.reads is None:
            block = re.match(r"\n*```text\n(?:.*\n)*?```\n", below)
            # Cells run as one program, which prints what stands below each.
            whole = (text[: comment.start()] if PYTHON in text[: comment.start()] else "") + (block[0] if block else "")
            stated = [line for lines in re.findall(r"(?ms)^```text\n(.*?)^```\n", whole) for line in lines.splitlines()]
        else:
            stated = next((one for one in tables_of(text) if one.line >= line), None)
            line = stated.line if stated else line
        if not stated:
            raise ValueError(
                f"{page}:{line}: a recheck comment has neither a table below it nor, as it has no reads, text"
            )
        command = mark.command or _commands_above(text[: comment.start()])
        # What comes first prints nothing that is compared.
        before = f"{{\n{mark.first}\n}} >&2\n" if mark.first else ""
        found.append(Check(page, line, stated, before + command, mark))
    return found


def tables_of(text: str) -> list[Table]:
    """Return the tables of a page, in its order."""
    lines = text.splitlines()
    found: list[Table] = []
    for is_table, group in itertools.groupby(enumerate(lines, 1), key=lambda pair: pair[1].startswith("|")):
        if is_table and len(rows := [(n, [cell.strip() for cell in row[1:-1].split("|")]) for n, row in group]) > 2:
            found.append(Table(rows[0][0], rows[0][1], [cells for _, cells in rows[2:]]))
    return found


def without_a_source(text: str) -> list[Table]:
    """Return the tables of figures that have neither commands nor, in their section, a version and a date."""
    checked = {check.line for check in checks_of("", text)}
    starts = [1, *(n for n, line in enumerate(text.splitlines(), 1) if line.startswith("## "))]
    lines = text.splitlines()
    left: list[Table] = []
    for table in tables_of(text):
        start = max(n for n in starts if n <= table.line)
        end = min((n for n in starts if n > table.line), default=len(lines) + 1)
        dated = TAKEN.search("\n".join(lines[start - 1 : end - 1]))
        if table.has_figures() and table.line not in checked and not dated:
            left.append(table)
    return left


def _commands_above(text: str) -> str:
    """Return the last block of commands: lines with four spaces, or a fenced block; of Python all blocks, as one."""
    text = re.sub(r"^<!--.*?-->\n", "", text, flags=re.MULTILINE | re.DOTALL)
    found = re.finditer(r"(?:^    .*\n)+|^```(\w*)\n((?:.*\n)*?)```\n", text, re.MULTILINE)
    blocks = [(block[1], block[2] or block[0]) for block in found if block[1] in (None, "", "sh", "console", "python")]
    language, last = blocks[-1]
    if language != "python":
        return "\n".join(line.removeprefix("    ") for line in last.splitlines())
    return "\n".join(["python - <<'END'", *(code for language, code in blocks if language == "python"), "END"])


def differences(check: Check, folder: Path, output: str = "") -> list[str]:
    """Return what a page states otherwise than the file in `folder`, or the output, of its commands, a line each."""
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
    texts = [r"\s+".join(map(re.escape, part.split(" "))) for part in SLOT.split(template)[:: SLOT.groups + 1]]
    found = re.search(f"({NUMBER.pattern})".join(texts), str(check.stated).replace("−", "-"))
    if not slots or found is None:
        yield f"{check.place}: the page does not say, with figures: {template}"
        return
    for slot, number in zip(slots, found.groups(), strict=True):
        which, column, row = slot.groups()
        wanted = [part.strip() for part in (row or "").split(";")]
        values = [
            float(one[column])
            for one in printed
            if NUMBER.fullmatch(one[column])
            and all(want in ("*", "", one[key]) for key, want in zip(check.mark.rows, wanted, strict=False))
        ]
        if not values or (which is None and len(values) > 1):
            yield f"{check.place}: {slot[0]}: {number} stated, not one figure printed"
        elif abs(float(number) - (value := max(values) if which == "max" else min(values))) > _tolerance(
            check.mark, number
        ):
            yield f"{check.place}: {slot[0]}: {number} stated, {value:.6g} printed"


def _differences_of_row(
    check: Check, table: Table, cells: Sequence[str], printed: Sequence[dict[str, str]]
) -> Iterator[str]:
    labels = max(len(check.mark.rows), 1)
    named = [_plain(cell) for cell in cells[: len(check.mark.rows)]]
    rows = [row for row in printed if [_label(row, names) for names in check.mark.rows] == named]
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
    """Return the printed figure; None where there is none, or more than one."""
    if mark.columns is not None:
        rows = [row for row in rows if _plain(row[mark.columns]) == _plain(heading)]
    name = mark.names.get(heading, heading) if mark.columns is None else mark.value or label
    found = [value for row in rows for key, value in row.items() if _plain(key) == _plain(name)]
    return float(found[0]) if len(found) == 1 and re.fullmatch(r"-?[\d.]+(?:e[+-]?\d+)?", found[0]) else None


def _plain(text: str) -> str:
    """Return a cell or a name without emphasis, typographic signs and differences of case and blanks."""
    return re.sub(r"[*`\s]", "", text).replace("−", "-").casefold()


def _tolerance(mark: Mark, stated: str) -> float:
    digits = len(stated.partition(".")[2])
    return mark.tolerance if mark.tolerance is not None else 0.51 * 10.0**-digits


def run(checks: Sequence[Check], data: Sequence[Path], most_s: float = math.inf) -> tuple[list[str], list[str]]:
    """Run the commands of checks, each block once; return what differs and what was not run, a line each."""
    differ: list[str] = []
    skipped: list[str] = []
    blocks: dict[str, list[Check]] = {}
    for check in checks:
        blocks.setdefault(check.command, []).append(check)
    for command, block in blocks.items():
        places = {name: _found(name, data) for check in block for name in check.mark.needs}
        missing = [name for name, place in places.items() if place is None]
        seconds = max(check.mark.seconds for check in block)
        if missing or seconds > most_s:
            why = f"needs {', '.join(missing)}; name its folder by --data" if missing else f"takes {seconds:g} s"
            skipped += [f"{check.place}: {why}" for check in block]
            continue
        with tempfile.TemporaryDirectory() as folder:
            for name, place in (places | {"examples": ROOT / "examples"}).items():
                (Path(folder) / name).symlink_to(str(place))
            differ += _run_block(command, block, Path(folder))
    return differ, skipped


def run_commands(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run commands of a page in a folder, ours those beside this Python, up to the first that fails."""
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    settings = os.environ | {"PATH": paths, "PYTHONPATH": str(ROOT)}
    return subprocess.run(["bash", "-euc", command], cwd=folder, env=settings, capture_output=True, text=True)


def _run_block(command: str, block: Sequence[Check], folder: Path) -> list[str]:
    done = run_commands(command, folder)
    if done.returncode:
        said = (done.stderr or done.stdout).strip()[-500:]
        return [f"{block[0].place}: the commands ended with {done.returncode}: {said}"]
    return [line for check in block for line in _differences_or_why_not(check, folder, done.stdout)]


def _differences_or_why_not(check: Check, folder: Path, output: str) -> list[str]:
    """Return what differs, or why nothing could be compared."""
    try:
        return differences(check, folder, output)
    except OSError as error:
        return [f"{check.place}: the commands left no {check.mark.reads} ({error.strerror})"]
    except KeyError as error:
        return [f"{check.place}: {check.mark.reads} has no column {error.args[0]!r}"]


def _found(name: str, folders: Sequence[Path]) -> Path | None:
    return next((path.resolve() for folder in folders for path in sorted(folder.rglob(name))), None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the checks of pages and print what differs and what was not run; return 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="by default README.md and all of docs")
    parser.add_argument("--data", type=Path, action="append", default=[], help="where files lie that commands need")
    parser.add_argument("--seconds", type=float, default=math.inf, help="leave out commands that take longer")
    given = parser.parse_args(arguments)
    for folder in given.data:
        if not folder.is_dir():
            parser.error(f"--data {folder} is no folder; name one in which the files lie that commands need")
    named = [Path(page).resolve() for page in given.pages]
    pages = named or [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    texts = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in pages}
    checks = [check for page, text in texts.items() for check in checks_of(page, text)]
    differ, skipped = run(checks, given.data, given.seconds)
    done = len(checks) - len(skipped)
    skipped += [f"{page}: nothing on it is run" for page, text in texts.items() if named and not checks_of(page, text)]
    for page in set(texts).intersection(MEASURED):
        differ += [f"{page}:{table.line}: {NO_SOURCE}" for table in without_a_source(texts[page])]
    for page, text in texts.items():
        taken = sorted(set(TAKEN.findall(text)))
        skipped += [f"{page}: taken with version {version}, {date}" for version, date in taken]
    for line in (*(f"not run  {line}" for line in skipped), *(f"differs  {line}" for line in differ)):
        print(line)
    print(f"{done} of {len(checks)} tables, texts and outputs with commands were run; {len(differ)} differences")
    return int(bool(differ))


if __name__ == "__main__":
    raise SystemExit(main())
