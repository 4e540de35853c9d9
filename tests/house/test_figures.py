"""The figures of docs/architecture.md show the present imports, contracts and states."""

from __future__ import annotations

import pytest

from docs.figures import ROOT, figures, read_plan


@pytest.mark.slow
def test_figures_are_up_to_date() -> None:
    outdated = [file.name for file, drawn in figures().items() if file.read_text(encoding="utf-8") != drawn]
    assert outdated == [], "out of date; run python docs/figures.py and commit"


@pytest.mark.slow
def test_page_lists_every_room() -> None:
    """Each package, sub-package and top-level module is listed in the tables of architecture.md."""
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    plan = read_plan()
    names = {f"`{room.partition('.')[2]}" for package in plan.packages for room in plan.rooms(package)}
    assert {name for name in names if name not in page} == set()
