"""Runs with intermittent causes, and a night without an operator; `benchmarks.troubled_runs` has more."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.troubled_runs import CAUSES, night, outcome_of
from calibration.cli import main as build_lut

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn")]


def test_run_ends_as_documented(tmp_path: Path) -> None:
    (cause,) = (cause for cause in CAUSES if cause.name == "one frame late, from a frame on")
    outcome = outcome_of(cause, tmp_path / "lab")
    assert outcome.as_documented, outcome


def test_night_without_operator_gives_lut_and_report(tmp_path: Path) -> None:
    """Two power cuts, faults of router, disk, card and battery, and a clock set by an hour, in 45 frames."""
    result = night(tmp_path / "night", grid=3)
    assert result.missing_events == ()
    assert result.doubled == 0
    assert result.hours > 12
    assert build_lut([str(tmp_path / "night" / "session"), str(tmp_path / "lut")]) == 0
    report = (tmp_path / "night" / "session" / "report.html").read_text()
    assert "battery" in report
    assert "power was lost" in report
