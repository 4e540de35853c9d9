"""A small chart and a small sensor in the simulated laboratory, for `acquire check`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquisition.check.check import check_lab
from acquisition.check.findings import CheckReport
from experiment.chart.layout import design_chart
from experiment.config import load_lab
from experiment.framing.field import Corners
from experiment.lights import plan_illuminants, save_illuminants

Check = Callable[..., CheckReport]


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with charts of one to three bits and three illuminants."""
    folder = tmp_path_factory.mktemp("check")
    for bits in (1, 2, 3):
        design_chart(bits).save(folder / f"chart{bits}.json")
    save_illuminants(plan_illuminants(1, ()), folder / "illuminations.csv")
    return folder


def lab_toml(chart: str, camera: str = "", more: str = "", seed: int = 1, **room: Any) -> str:
    """Return the text of a LAB.toml of a simulated room."""
    room_text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in room.items())
    return (
        f'rig = "simulated"\nchart = "{chart}"\nilluminations = "illuminations.csv"\n[camera]\n{camera}\n{more}\n'
        f'[sequence]\nwarm_up_s = 0\n[simulated]\nbody = "Test"\nseed = {seed}\n[simulated.room]\n{room_text}'
    )


@pytest.fixture(scope="session")
def check(folder: Path) -> Check:
    """Return a function that checks a room."""

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
