"""Findings: grades, order, text and JSON; and the table of limits in the documentation."""

from __future__ import annotations

from pathlib import Path

import pytest

from acquisition.check.findings import LIMITS, CheckReport, Finding, Limit, amount, judged, not_checked, worst
from foundation.console import plain

LIMIT = Limit("thing", "A thing", "share", (0.2, 0.5), (0.1, None), "it breaks")


@pytest.mark.parametrize(
    ("value", "grade"),
    [(0.05, "fault"), (0.1, "remark"), (0.2, "good"), (0.5, "good"), (0.51, "remark"), (9.0, "remark"),
     (float("nan"), "fault")],
)  # fmt: skip
def test_a_value_is_graded_by_both_limits(value: float, grade: str) -> None:
    found = judged(LIMIT, value, "seen", "mend it")
    assert found.grade == grade
    assert (found.remedy, found.reason == "") == (("", True) if grade == "good" else ("mend it", False))


def test_faults_are_told_first_and_what_was_not_checked_is_never_good() -> None:
    report = CheckReport(
        ("camera",),
        (judged(LIMIT, 0.3, "fine", "x"), not_checked("other", "no references"), judged(LIMIT, 0.0, "bad", "mend it")),
    )
    lines = report.lines()
    assert [line.split()[0] for line in lines] == ["camera", "fault", "not", "good"]
    assert lines[1].endswith("bad (20 % to 50 % wanted: it breaks); mend it")


def test_json_holds_every_finding_and_no_number_that_is_none() -> None:
    report = CheckReport((), (judged(LIMIT, float("nan"), "bad", "mend it", {"each": [1.0, float("inf")]}),))
    document = plain(report.values())
    assert document["faults"] == 1
    (found,) = document["findings"]
    assert found["value"] is None
    assert found["details"] == {"each": [1.0, None]}
    assert (found["good"], found["tolerable"]) == ([0.2, 0.5], [0.1, None])


def test_the_worst_grade() -> None:
    assert worst(["good", "remark"]) == "remark"
    assert worst([]) == "good"


def test_every_limit_tolerates_what_is_good() -> None:
    for limit in LIMITS.values():
        for bound in limit.good:
            if bound is not None:
                assert limit.grade(bound) == "good", limit.name
        for good, bound in zip(limit.good, limit.tolerable, strict=True):
            assert bound is None or good is None or limit.grade(bound) in ("good", "remark"), limit.name


def test_the_table_of_the_documentation_has_the_limits_of_the_code() -> None:
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "check.md").read_text()
    rows = {
        cells[0]: cells[1:3]
        for line in page.splitlines()
        if line.startswith("| ") and len(cells := [cell.strip() for cell in line.strip("|").split("|")]) == 5
    }
    for limit in LIMITS.values():
        assert rows.get(limit.name) == [_words(limit, limit.good), _words(limit, limit.tolerable)], limit.name


def _words(limit: Limit, bounds: tuple[float | None, float | None]) -> str:
    low, high = (None if bound is None else amount(bound, limit.unit) for bound in bounds)
    if low is None and high is None:
        return "–"
    if low is None:
        return f"≤ {high}"
    return f"≥ {low}" if high is None else f"{low} … {high}"


def test_a_finding_has_a_whole_sentence() -> None:
    assert Finding("a", "good", "seen").sentence() == "seen"
