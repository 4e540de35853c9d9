"""The page of causes in the documentation, written from the table: `python -m calibration.causes.reference`."""

from __future__ import annotations

import inspect
import math
import re

from calibration.causes.rules import CAUSES, RULES, UNKNOWN, Condition, Evidence

_HEAD = """# Causes

Each remark and refusal of `build-lut` names the frame, the place on the print, the probable cause, and what mends it.
The cause is decided by the table below, from evidence that stands in `report.json` under `causes` and in the report
beside each cause. The first rule that holds decides; what was not measured lies in no interval. Where no rule holds,
the cause is said to be unknown: look at the place in the report, where it is circled.

*Written by `python -m calibration.causes.reference > docs/reference/causes.md` from `calibration/causes`.*
"""

_AGAIN = {
    "frames": "the frames named: `acquire run LAB.toml SESSION --retake 12,40`, or `--retake bad` as the report says",
    "session": "the session",
    "nothing": "nothing",
}


def causes_page() -> str:
    """Return the page, Markdown."""
    parts = [_HEAD, "## What helps\n", "| cause | what it is | what helps | to be taken again |\n|---|---|---|---|"]
    parts += [
        f"| {one.name} | {one.says} | {one.remedy} | {_AGAIN[one.mends]} |" for one in CAUSES if one is not UNKNOWN
    ]
    parts += ["\n## The table\n", "| cause | figures | holds where | because |\n|---|---|---|---|"]
    for rule in RULES:
        figures = ", ".join(f"`{figure}`" for figure in sorted(rule.figures))
        where = ", ".join(_interval(one) for one in rule.conditions)
        parts.append(f"| {rule.cause.name} | {figures} | {where} | {rule.why} |")
    parts += ["\n## The evidence\n", "| name | what it is |\n|---|---|"]
    parts += [f"| `{name}` | {text} |" for name, text in _evidence()]
    return "\n".join(parts) + "\n"


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
    text = inspect.cleandoc(Evidence.__doc__ or "").split("----------\n", 1)[1]
    entries = re.findall(r"^(\w+)\n((?: {4}.*\n?)+)", text, flags=re.MULTILINE)
    return [(name, " ".join(line.strip() for line in lines.splitlines())) for name, lines in entries]


_LEAST = 1e-9
"""What stands in the table for "more than none"."""

if __name__ == "__main__":
    print(causes_page(), end="")
