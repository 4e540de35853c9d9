"""Rooms for checks: a small chart before a small sensor, in the simulated lab that `acquire check` opens."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquisition.check.check import check_lab
from acquisition.check.findings import CheckReport
from experiment.chart.layout import design_chart
from experiment.config import load_lab
from experiment.framing.field import Corners
from experiment.lights import plan_illuminations, save_illuminations
from tests.pinned import Pinned

Check = Callable[..., CheckReport]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with charts of one to three bits and three lights."""
    place = tmp_path_factory.mktemp("check")
    for bits in (1, 2, 3):
        design_chart(bits).save(place / f"chart{bits}.json")
    save_illuminations(plan_illuminations(1, ()), place / "illuminations.csv")
    return place


def lab_toml(chart: str, camera: str = "", more: str = "", seed: int = 1, **room: Any) -> str:
    """Return the text of a LAB.toml of a simulated room."""
    told = "".join(f"{key} = {json.dumps(value)}\n" for key, value in room.items())
    return (
        f'rig = "simulated"\nchart = "{chart}"\nilluminations = "illuminations.csv"\n[camera]\n{camera}\n{more}\n'
        f'[sequence]\nwarm_up_s = 0\n[simulated]\nbody = "Test"\nseed = {seed}\n[simulated.room]\n{told}'
    )


@pytest.fixture(scope="session")
def checking(folder: Path) -> Check:
    """Return what checks a room."""

    def run(
        bits: int = 2,
        camera: str = "",
        more: str = "",
        chart: str | None = None,
        linearity: bool = False,
        seed: int = 1,
        corners: Corners | None = None,
        **room: Any,
    ) -> CheckReport:
        lab = folder / "LAB.toml"
        lab.write_text(lab_toml(chart or f"chart{bits}.json", camera, more, seed, **room))
        return check_lab(load_lab(lab), linearity=linearity, corners=corners)

    return run


@pytest.fixture
def check(checking: Check, pinned: Pinned, request: pytest.FixtureRequest) -> Check:
    """Return what checks a room, and holds what it finds against what it found in the room of this test before."""
    name = re.sub("[^a-z0-9]+", " ", str(request.node.name).removeprefix("test_")).strip()

    def run(*given: Any, **named: Any) -> CheckReport:
        report = checking(*given, **named)
        # What is free on a disk changes by itself.
        known = [found for found in report.findings if found.name not in ("disk", "card")]
        found = {
            one.name: {"value": one.value, "details": one.details if one.grade != "good" else None} for one in known
        }
        pinned(f"check, {name}", {**found, "forecast": report.forecast}, same=1e-4)
        return report

    return run
