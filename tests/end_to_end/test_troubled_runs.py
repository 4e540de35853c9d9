"""Runs in which causes come and go, and a night without an operator; `benchmarks.troubled_runs` has all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.troubled_runs import CAUSES, night, outcome_of
from calibration.cli import main as build_lut

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn")]


def test_a_run_ends_as_the_how_to_says(tmp_path: Path) -> None:
    (cause,) = (cause for cause in CAUSES if cause.name == "one frame late, from a frame on")
    outcome = outcome_of(cause, tmp_path / "lab")
    assert outcome.as_documented, outcome


def test_a_night_without_an_operator_becomes_a_table_and_a_story(tmp_path: Path) -> None:
    """Power dips twice, router, disk, card, battery, and a clock that is set by an hour, between 45 frames."""
    found = night(tmp_path / "night", grid=3)
    assert found.missing_events == ()
    assert found.doubled == 0
    assert found.hours > 12
    assert build_lut([str(tmp_path / "night" / "session"), str(tmp_path / "lut")]) == 0
    said = (tmp_path / "night" / "session" / "report.html").read_text()
    assert "battery" in said
    assert "power was lost" in said
