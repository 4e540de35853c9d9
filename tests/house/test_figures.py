"""The figures of docs/architecture.md show the imports, contracts and states as they are."""

from __future__ import annotations

import pytest

from docs.figures import ROOT, figures, read_plan


@pytest.mark.slow
def test_the_figures_are_drawn_from_what_is() -> None:
    old = [file.name for file, drawn in figures().items() if file.read_text(encoding="utf-8") != drawn]
    assert old == [], "out of date; run python docs/figures.py and commit"


@pytest.mark.slow
def test_every_room_is_explained() -> None:
    """Each package, each room and each module beside the rooms is named in the tables of architecture.md."""
    told = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    plan = read_plan()
    named = {f"`{room.partition('.')[2]}" for package in plan.packages for room in plan.rooms(package)}
    assert {name for name in named if name not in told} == set()
