"""Findings: grades, order, text and JSON."""

from __future__ import annotations

import pytest

from acquisition.check.findings import CheckReport, judge_value, not_checked
from calibration.figures.figure import Limit
from foundation.console import json_value

LIMIT = Limit("thing", "A thing", "light", "share", "at least", 0.2, 0.1, why="it breaks", source="", remedy="mend it")


@pytest.mark.parametrize(
    ("value", "grade"),
    [(0.05, "fault"), (0.1, "remark"), (0.2, "good"), (9.0, "good"), (float("nan"), "fault")],
)
def test_grades_values_by_both_limits(value: float, grade: str) -> None:
    finding = judge_value(LIMIT, value)
    assert finding.grade == grade
    assert (finding.remedy, finding.reason == "") == (("", True) if grade == "good" else ("mend it", False))


def test_prints_faults_first() -> None:
    good, fault = judge_value(LIMIT, 0.3, "fine", "x"), judge_value(LIMIT, 0.0, "bad", "mend it")
    report = CheckReport(("camera",), (good, not_checked("other", "no references"), fault))
    lines = report.lines()
    assert [line.split()[0] for line in lines] == ["camera", "fault", "not", "good"]
    assert lines[1].endswith("bad (at least 20 % expected: it breaks); mend it")


def test_json_has_every_finding_and_null_for_nan() -> None:
    report = CheckReport((), (judge_value(LIMIT, float("nan"), "bad", "mend it", {"each": [1.0, float("inf")]}),))
    document = json_value(report.values())
    assert document["faults"] == 1
    (finding,) = document["findings"]
    assert finding["value"] is None
    assert finding["details"] == {"each": [1.0, None]}
    assert (finding["good"], finding["tolerable"]) == ([0.2, None], [0.1, None])
