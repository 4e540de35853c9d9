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
from pathlib import Path

from calibration.causes.rules import CAUSES, RULES, UNKNOWN, Condition, Evidence, Rule
from calibration.figures.all_figures import FIGURES
from calibration.figures.figure import QUESTIONS, Figure, Limit
from calibration.figures.single_frames import FRAME_LIMITS, RIG_LIMITS

_DOCS = Path(__file__).parent
_RESULTS = _DOCS / "results"

_FIGURES_HEAD = """# Figures

What `build-lut` judges a table by. Within what is *accepted* nothing is said; beyond it a figure is remarked on, and
beyond what is *refused* there is no table. `acquire check` judges most of them before a session, by trial frames.
`build-lut check` reads one frame, and judges those that this tells; what more frames can only make worse it judges
where it is *beyond* already. The names are those of `report.json`.

*Written by `python -m docs.reference_pages` from `calibration/figures`.*
"""

_CAUSES_HEAD = """# Causes

Each remark and refusal of `build-lut` names the frame, the place on the print, the probable cause, and what mends it.
The cause is decided by the table below, from evidence that stands in `report.json` under `causes` and in the report
beside each cause. The first rule that holds decides; what was not measured lies in no interval. Where no rule holds,
the cause is said to be unknown: look at the place in the report, where it is circled.

*Written by `python -m docs.reference_pages` from `calibration/causes`.*
"""

_AGAIN = {
    "frames": "the frames named: `acquire run LAB.toml SESSION --retake 12,40`, or `--retake bad` as the report says",
    "session": "the session",
    "nothing": "nothing",
}

# What stands in the table for "more than none".
_LEAST = 1e-9


_TOLD = {"known": "yes", "bounded": "beyond", "unknown": "–"}


def figures_page() -> str:
    """Return the page of the figures, Markdown."""
    parts = [_FIGURES_HEAD]
    for group, question in QUESTIONS.items():
        parts.append(f"## {group.capitalize()}\n\n{question}\n")
        parts.append(
            "| figure | accepted | refused beyond | in a check | of one frame | what goes wrong beyond | what helps |"
        )
        parts += ["|---|---|---|---|---|---|---|", *(_limits(one) for one in FIGURES if one.group == group), ""]
    for heading, limits in (("Before a session", RIG_LIMITS), ("While a session is taken", FRAME_LIMITS)):
        parts += [f"## {heading}\n", "| limit | accepted | fault beyond | what goes wrong beyond | what helps |"]
        parts += ["|---|---|---|---|---|", *(_plain_limit(one) for one in limits), ""]
    return "\n".join(parts)


def _plain_limit(one: Limit) -> str:
    limits = f"{one.expected} | {_refused(one)}"
    return f"| {one.title} (`{one.name}`) | {limits} | {one.why} ({one.source}) | {one.remedy} |"


def _refused(one: Limit) -> str:
    return "–" if one.refuse is None else one.text(one.refuse)


def _limits(one: Figure) -> str:
    refused, known = _refused(one), "yes" if one.before_session else "–"
    helps = one.remedy or "what most of them are decides"
    told = _TOLD[one.of_one_frame]
    limits = f"{one.expected} | {refused} | {known} | {told}"
    return f"| {one.title} (`{one.name}`) | {limits} | {one.why} ({one.source}) | {helps} |"


def causes_page() -> str:
    """Return the page of the causes, Markdown."""
    parts = [_CAUSES_HEAD]
    parts += ["## What helps\n", "| cause | what it is | what helps | to be taken again |\n|---|---|---|---|"]
    parts += [
        f"| {one.name} | {one.description} | {one.remedy} | {_AGAIN[one.repeats]} |"
        for one in CAUSES
        if one is not UNKNOWN
    ]
    parts += ["\n## The table\n", "| cause | figures | holds where | because |\n|---|---|---|---|"]
    for rule in RULES:
        figures = ", ".join(f"`{name}`" for name in _names(rule))
        where = ", ".join(_interval(one) for one in rule.conditions)
        parts.append(f"| {rule.cause.name} | {figures} | {where} | {rule.why} |")
    parts += ["\n## The evidence\n", "| name | what it is |\n|---|---|"]
    parts += [f"| `{name}` | {text} |" for name, text in _evidence()]
    return "\n".join(parts) + "\n"


def _names(rule: Rule) -> list[str]:
    """Return the names of the figures that a rule may explain."""
    return sorted(one.name for one in FIGURES if one.cause is not None and one.cause.about in rule.about)


def _interval(one: Condition) -> str:
    low, high = (f"{value:.9g}" for value in (one.low, one.high))
    if one.low == one.high:
        return f"{one.name} = {low}"
    if one.low == _LEAST:
        return f"0 < {one.name} ≤ {high}"
    if math.isinf(one.high):
        return f"{one.name} ≥ {low}"
    return f"{one.name} ≤ {high}" if math.isinf(one.low) else f"{low} ≤ {one.name} ≤ {high}"


def _evidence() -> list[tuple[str, str]]:
    """Return each name of the evidence with what its docstring says of it."""
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
    with path.open(encoding="utf-8", newline="") as file:
        header, *rows = csv.reader(file)
    command = header.index("command")
    for row in rows:
        row[command] = f"`{row[command]}`"
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def generated_pages() -> dict[Path, str]:
    """Return the text of each page with generated parts."""
    pages = {_DOCS / "reference/figures.md": figures_page(), _DOCS / "reference/causes.md": causes_page()}
    for name in ("measured.md", "transfer.md", "reference/judge.md"):
        pages[_DOCS / name] = fill_results((_DOCS / name).read_text(encoding="utf-8"))
    return pages


if __name__ == "__main__":
    for path, text in generated_pages().items():
        path.write_text(text, encoding="utf-8")
