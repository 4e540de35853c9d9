"""Figures against their limits, and a build that is refused."""

from __future__ import annotations

import html
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acquisition.session.folder import Session
from calibration.cli import main
from calibration.pipeline.build import build, refused_folder
from calibration.report.report import write_report
from calibration.verdict import verdict as verdicts
from calibration.verdict.thresholds import THRESHOLDS, Threshold
from calibration.verdict.verdict import bleed, figures_of, judge, truth_errors_deg
from foundation.errors import QualityError
from tests.calibration.lab import LIGHTS, Lab, take

LIMIT = Threshold("x", "A figure", "px", "at most", 1.0, 2.0, "why", "source", "remedy")


@pytest.mark.parametrize(
    ("sense", "accept", "refuse", "value", "outcome"),
    [
        ("at most", 1.0, 2.0, 1.0, "accept"),
        ("at most", 1.0, 2.0, 1.1, "accept with remarks"),
        ("at most", 1.0, 2.0, 2.0, "accept with remarks"),
        ("at most", 1.0, 2.0, 2.1, "refuse"),
        ("at most", 1.0, None, 1e9, "accept with remarks"),
        ("at least", 2.0, 1.0, 2.0, "accept"),
        ("at least", 2.0, 1.0, 1.5, "accept with remarks"),
        ("at least", 2.0, 1.0, 0.9, "refuse"),
        ("at least", 2.0, 1.0, float("nan"), "refuse"),
        ("at most", 2.0, None, float("nan"), "accept with remarks"),
    ],
)
def test_a_figure_is_judged_by_both_limits(
    sense: str, accept: float, refuse: float | None, value: float, outcome: str
) -> None:
    limit = replace(LIMIT, sense=sense, accept=accept, refuse=refuse)
    assert judge({"x": value}, [limit]).outcome == outcome


def test_the_worst_row_is_the_verdict() -> None:
    rows = [replace(LIMIT, name=name) for name in "abc"]
    assert judge({"a": 0, "b": 3, "c": 1.5}, rows).outcome == "refuse"
    assert judge({"a": 0, "c": 1.5}, rows).outcome == "accept with remarks"
    assert judge({}, rows).outcome == "accept"


def test_every_limit_has_its_reason_and_its_order() -> None:
    assert len({limit.name for limit in THRESHOLDS}) == len(THRESHOLDS)
    for limit in THRESHOLDS:
        assert limit.why
        assert limit.source
        if limit.refuse is not None:
            assert (limit.refuse > limit.accept) == (limit.sense == "at most")


def test_the_bleed_is_that_of_the_table_of_arrangements() -> None:
    """Rendered pixel by pixel: 8.6 px cells and 0.7 px blur give 1.3 %, 0.5 px blur 0.1 %; 10.2 px cells 0.07 %."""
    assert bleed(8.6, 0.7) == pytest.approx(0.013, rel=0.1)
    assert bleed(8.6, 0.5) == pytest.approx(0.001, rel=0.1)
    assert bleed(10.2, 0.7) < 0.0008


def test_the_truth_s_error_is_an_angle() -> None:
    white, error = np.array([[3000.0, 6000.0, 4000.0]]), np.array([[30.0, 20.0, 50.0]])
    seen = white + np.random.default_rng(3).normal(size=(200_000, 3)) * error
    angle = np.degrees(np.arccos((seen @ white[0]) / np.linalg.norm(seen, axis=1) / np.linalg.norm(white)))
    assert truth_errors_deg(white, error)[0] == pytest.approx(np.sqrt((angle**2).mean()), rel=0.01)


def test_a_table_carries_its_verdict(session: Session, tmp_path: Path) -> None:
    result = build(session, tmp_path / "lut", report=write_report)
    told = json.loads((tmp_path / "lut" / "report.json").read_text())
    assert told["format"] == "crop.report"
    assert told["verdict"] == result.verdict.outcome != "refuse"
    assert told["figures"].keys() == figures_of(result).keys()
    assert {limit["name"] for limit in told["limits"]} == told["figures"].keys()
    # No series of exposures was given, and the lights are few.
    assert told["figures"].keys() == {limit.name for limit in THRESHOLDS} - {"linearity", "off_codes_deg"}
    page = (tmp_path / "lut" / "report.html").read_text()
    assert "class='verdict " in page
    for limit in told["limits"]:
        assert html.escape(limit["title"]) in page


def test_a_refused_table_leaves_its_report_alone(lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strict = replace(next(limit for limit in THRESHOLDS if limit.name == "darkest_counts"), refuse=60_000.0)
    monkeypatch.setattr(verdicts.judge, "__defaults__", ((strict,),))
    with take(lab, tmp_path / "session", LIGHTS[:2]) as session:
        with pytest.raises(QualityError, match=r"no table is made\. Bare paper under the darkest .*expose longer"):
            build(session, tmp_path / "lut", report=write_report)
        assert sorted(path.name for path in tmp_path.iterdir()) == ["lut.refused", "session"]
        assert refused_folder(tmp_path / "lut") == tmp_path / "lut.refused"
        kept = sorted(path.name for path in (tmp_path / "lut.refused").iterdir())
        assert kept == ["report.html", "report.json"]
        assert json.loads((tmp_path / "lut.refused" / "report.json").read_text())["verdict"] == "refuse"
    monkeypatch.setattr("sys.argv", ["build-lut", "--check", str(tmp_path / "session")])
    assert main() == 4
    monkeypatch.setattr("sys.argv", ["build-lut", str(tmp_path / "session"), str(tmp_path / "lut")])
    assert main() == 4
