"""The figures of docs/architecture.md show the imports, contracts and states as they are."""

from __future__ import annotations

from pathlib import Path

import pytest

from docs.figures import ROOT, figures, read_plan

DRAWN = figures()


@pytest.mark.parametrize("file", DRAWN, ids=lambda file: file.name)
def test_a_figure_is_drawn_from_what_is(file: Path) -> None:
    assert file.read_text(encoding="utf-8") == DRAWN[file], "out of date; run python docs/figures.py and commit"


def test_every_room_is_explained() -> None:
    """Each package, each room and each module beside the rooms is named in the tables of architecture.md."""
    told = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    plan = read_plan()
    named = {f"`{room.partition('.')[2]}" for package in plan.packages for room in plan.rooms(package)}
    assert {name for name in named if name not in told} == set()
