"""Every figure has its group, and the page reads in the dark and on a phone."""

from __future__ import annotations

import ast
from pathlib import Path

import calibration.report.page as summary_module
from calibration.figures.all_figures import FIGURES
from calibration.report.groups import GROUPS, OF_SUMMARY, OF_THRESHOLDS, QUESTIONS
from calibration.report.page import STYLE


def test_every_limit_has_its_group() -> None:
    assert {figure.name for figure in FIGURES} == OF_THRESHOLDS.keys()
    assert set(OF_THRESHOLDS.values()) == set(GROUPS) == QUESTIONS.keys()


def test_the_groups_of_the_summary_name_rows_that_there_are() -> None:
    tree = ast.parse(Path(str(summary_module.__file__)).read_text())
    written = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert OF_SUMMARY.keys() <= written


def test_colours_of_text_follow_the_reader_s_system() -> None:
    light, _, dark = STYLE.partition("@media (prefers-color-scheme: dark)")
    names = {part.split(":")[0].strip() for part in light.split("{")[1].split(";") if "--" in part}
    for name in names:
        assert f"{name}:" in dark, f"{name} has no colour in the dark"
    # No rule but these two names a colour of text or ground by itself; pictures keep their white one.
    rules = STYLE[STYLE.index("* {") :]
    assert "#" not in rules.replace("background: #fff", "")
