"""Findings: grades, order, text and JSON; and the table of limits in the documentation."""

from __future__ import annotations

import pytest

from acquisition.check.findings import CheckReport, judged, not_checked
from calibration.figures.figure import Limit
from foundation.console import json_value

LIMIT = Limit("thing", "A thing", "light", "share", "at least", 0.2, 0.1, why="it breaks", source="", remedy="mend it")


@pytest.mark.parametrize(
    ("value", "grade"),
    [(0.05, "fault"), (0.1, "remark"), (0.2, "good"), (9.0, "good"), (float("nan"), "fault")],
)
def test_a_value_is_graded_by_both_limits(value: float, grade: str) -> None:
    found = judged(LIMIT, value)
    assert found.grade == grade
    assert (found.remedy, found.reason == "") == (("", True) if grade == "good" else ("mend it", False))


def test_faults_are_told_first_and_what_was_not_checked_is_never_good() -> None:
    report = CheckReport(
        ("camera",),
        (judged(LIMIT, 0.3, "fine", "x"), not_checked("other", "no references"), judged(LIMIT, 0.0, "bad", "mend it")),
    )
    lines = report.lines()
    assert [line.split()[0] for line in lines] == ["camera", "fault", "not", "good"]
    assert lines[1].endswith("bad (at least 20 % expected: it breaks); mend it")


def test_json_holds_every_finding_and_no_number_that_is_none() -> None:
    report = CheckReport((), (judged(LIMIT, float("nan"), "bad", "mend it", {"each": [1.0, float("inf")]}),))
    document = json_value(report.values())
    assert document["faults"] == 1
    (found,) = document["findings"]
    assert found["value"] is None
    assert found["details"] == {"each": [1.0, None]}
    assert (found["good"], found["tolerable"]) == ([0.2, None], [0.1, None])
