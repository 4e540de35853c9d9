"""Write the generated parts of the documentation.

`docs/reference/figures.md` and `causes.md` come from the code. The result tables of `docs/measured.md`,
`docs/transfer.md` and `docs/reference/judge.md` come from the recorded results in `docs/results`. A test compares the
files with the output of this module.
"""

from __future__ import annotations

import csv
import inspect
import math
import re
from collections.abc import Sequence
from pathlib import Path

from calibration.causes.rules import CAUSES, RULES, UNKNOWN, Condition, Evidence, Rule
from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import QUESTIONS, Figure, Limit
from calibration.figures.single_frames import FRAME_LIMITS, RIG_LIMITS

_DOCS = Path(__file__).parent
_RESULTS = _DOCS / "results"
_SOURCE_COLUMNS = ("command", "version", "date", "machine")

_FIGURES_HEAD = """# Figures

`build-lut` judges a LUT by these figures. A figure beyond the *accepted* limit causes a remark. If a figure is
beyond the *refused* limit, no LUT is made. `report.json` uses the same names. The columns are:

- *In check*: `acquire check` judges the figure before a session, from trial frames.
- *From one frame*: `build-lut check` judges the figure from one frame. With *beyond*, one frame can only show
  that the figure is beyond the accepted limit.
- *Basis*: origin of the limits, or values without and with faults.

Terms in the tables:

- *White*: camera RGB of bare paper under an illuminant. It is predicted from its codes and from the whites of the
  other illuminants. *Paper white* is bare paper under full white.
- *Block*: group of adjacent patches that are compared together.
- *Worst sample*: sample in the corner of a window, nearest to the neighbouring patches.
- *Frame registered first*: usually the first white frame. The other frames are compared with it.
- *Unfit patch*: patch that must not be used; `lut.json` lists unfit patches with the reason.

*Written by `python -m docs.reference_pages` from `calibration/figures`.*
"""

_CAUSES_HEAD = """# Causes

Each remark and refusal of `build-lut` names the frame, the position on the print, the probable cause and the remedy.
Each row of *The rules* is a rule. For a figure beyond its limit, the first rule whose conditions all hold gives the
cause. A value that was not measured satisfies no condition. If no rule applies, the cause is reported as unknown, and
the position is circled in the report. `report.json` contains the evidence under `causes`.

*Written by `python -m docs.reference_pages` from `calibration/causes`.*
"""

# Text for each value of `Cause.repeats`.
_REPEATED_FRAMES = {
    "frames": "the named frames: `acquire run LAB.toml SESSION --retake 12,40`, or `--retake bad`",
    "session": "the session",
    "nothing": "nothing",
}

# Lower limit of an interval that excludes 0; it is printed as "0 <".
_ABOVE_ZERO = 1e-9

_FROM_ONE_FRAME = {"yes": "yes", "beyond": "beyond", "no": "–"}  # Text for each value of `Figure.from_one_frame`


def figures_page() -> str:
    """Return the page of the figures, Markdown."""
    parts = [_FIGURES_HEAD]
    for group, question in QUESTIONS.items():
        parts.append(f"## {group.capitalize()}\n\n{question}\n")
        parts.append(
            "| figure | accepted | refused beyond | in check | from one frame | effect beyond | basis | remedy |"
        )
        parts += [
            "|---|---|---|---|---|---|---|---|",
            *(_limits(figure) for figure in FIGURES if figure.group == group),
            "",
        ]
    for heading, limits in (("Before a session", RIG_LIMITS), ("While a session is taken", FRAME_LIMITS)):
        parts += [f"## {heading}\n", "| limit | accepted | fault beyond | effect beyond | basis | remedy |"]
        parts += ["|---|---|---|---|---|---|", *(_plain_limit(figure) for figure in limits), ""]
    return "\n".join(parts)


def _plain_limit(limit: Limit) -> str:
    limits = f"{limit.expected} | {_refused(limit)}"
    return f"| {limit.title} (`{limit.name}`) | {limits} | {limit.why} | {limit.source} | {limit.remedy} |"


def _refused(limit: Limit) -> str:
    return "–" if limit.refuse is None else limit.text(limit.refuse)


def _limits(figure: Figure) -> str:
    refused, before_session = _refused(figure), "yes" if figure.before_session else "–"
    remedy = figure.remedy or "depends on the detected fault"
    from_one_frame = _FROM_ONE_FRAME[figure.from_one_frame]
    limits = f"{figure.expected} | {refused} | {before_session} | {from_one_frame}"
    return f"| {figure.title} (`{figure.name}`) | {limits} | {figure.why} | {figure.source} | {remedy} |"


def causes_page() -> str:
    """Return the page of the causes, Markdown."""
    parts = [_CAUSES_HEAD]
    parts += ["## Remedies\n", "| cause | description | remedy | frames to repeat |\n|---|---|---|---|"]
    parts += [
        f"| {cause.name} | {cause.description} | {cause.remedy} | {_REPEATED_FRAMES[cause.repeats]} |"
        for cause in CAUSES
        if cause is not UNKNOWN
    ]
    parts += ["\n## The rules\n", "| cause | figures | conditions | reason |\n|---|---|---|---|"]
    for rule in RULES:
        figures = ", ".join(f"`{name}`" for name in _names(rule))
        where = ", ".join(_interval(condition) for condition in rule.conditions)
        parts.append(f"| {rule.cause.name} | {figures} | {where} | {rule.why} |")
    parts += ["\n## The evidence\n", "| name | description |\n|---|---|"]
    parts += [f"| `{name}` | {text} |" for name, text in _evidence()]
    return "\n".join(parts) + "\n"


def _names(rule: Rule) -> list[str]:
    """Return the names of the figures that a rule can explain."""
    return sorted(figure.name for figure in FIGURES if figure.cause is not None and figure.cause.about in rule.about)


def _interval(condition: Condition) -> str:
    low, high = (f"{value:.9g}" for value in (condition.low, condition.high))
    if condition.low == condition.high:
        return f"{condition.name} = {low}"
    if condition.low == _ABOVE_ZERO:
        return f"0 < {condition.name} ≤ {high}"
    if math.isinf(condition.high):
        return f"{condition.name} ≥ {low}"
    return f"{condition.name} ≤ {high}" if math.isinf(condition.low) else f"{low} ≤ {condition.name} ≤ {high}"


def _evidence() -> list[tuple[str, str]]:
    """Return each name of the evidence with its description in the docstring of `Evidence`."""
    text = inspect.cleandoc(Evidence.__doc__ or "")
    entries = re.findall(r"^- `(\w+)`: ((?:.*\n?)(?:  .*\n?)*)", text, flags=re.MULTILINE)
    texts = ((name, " ".join(line.strip() for line in lines.splitlines())) for name, lines in entries)
    return [(name, text[0].upper() + text[1:]) for name, text in texts]


def fill_results(page: str) -> str:
    """Replace each table between "results" comments by the rows of the CSV file that the comment names."""
    return re.sub(
        r"(<!-- results (\S+) -->\n).*?(<!-- end of results -->)",
        lambda match: f"{match[1]}\n{_results_table(_RESULTS / match[2])}\n{match[3]}",
        page,
        flags=re.DOTALL,
    )


def _results_table(path: Path) -> str:
    """Return a table of results, and a table of their numbered sources: command, version, date and machine."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = [name for name in rows[0] if name not in _SOURCE_COLUMNS]
    source_columns = [name for name in _SOURCE_COLUMNS if name in rows[0]]
    sources = list(dict.fromkeys(tuple(row[name] for name in source_columns) for row in rows))
    results = [[*columns, "source"]]
    for row in rows:
        # Non-breaking spaces keep numbers and units together.
        cells = [row[name].replace(" %", "\N{NO-BREAK SPACE}%") for name in columns]
        results.append([*cells, str(1 + sources.index(tuple(row[name] for name in source_columns)))])
    numbered = [[str(number), f"`{source[0]}`", *source[1:]] for number, source in enumerate(sources, 1)]
    return f"{_markdown_table(results)}\n{_markdown_table([['source', *source_columns], *numbered])}"


def _markdown_table(rows: Sequence[Sequence[str]]) -> str:
    header, *body = rows
    return "".join(f"| {' | '.join(cells)} |\n" for cells in (header, ["---"] * len(header), *body))


def generated_pages() -> dict[Path, str]:
    """Return the text of each page with generated parts."""
    pages = {_DOCS / "reference/figures.md": figures_page(), _DOCS / "reference/causes.md": causes_page()}
    for name in ("measured.md", "transfer.md", "reference/judge.md"):
        pages[_DOCS / name] = fill_results((_DOCS / name).read_text(encoding="utf-8"))
    return pages


if __name__ == "__main__":
    for path, text in generated_pages().items():
        path.write_text(text, encoding="utf-8")
