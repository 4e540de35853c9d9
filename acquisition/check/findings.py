"""Findings of `acquire check`, as text and as JSON. Each finding is the grade of one quantity.

Grades follow the verdicts of `build-lut` (`calibration.figures.figure.Limit`): accepted values are good, values
accepted with remarks are remarks, refused values are faults. A quantity that could not be measured is `not checked`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from calibration.figures.figure import Limit, Outcome, Range

Grade = Literal["fault", "remark", "not checked", "good"]
GRADES: tuple[Grade, ...] = ("fault", "remark", "not checked", "good")  # In the order of the report

_GRADES: Mapping[Outcome, Grade] = {"accept": "good", "accept with remarks": "remark", "refuse": "fault"}


@dataclass(frozen=True)
class Finding:
    """Grade of one quantity. The fields are the keys of `--json`.

    - `name`: name of the figure or limit, or of the checked object, such as "chart".
    - `grade`: good, remark, fault or not checked.
    - `said`: the measured value in words, or the reason why it could not be measured.
    - `value`: the judged value; None without a value.
    - `unit`: unit of the value and the limits, as in `Limit`.
    - `good`, `tolerable`: range of accepted values, and range of values that are accepted at least with remarks.
    - `reason`: the expected value, and the harm of other values; empty if the value is good.
    - `remedy`: action of the user; empty if nothing needs to be done.
    - `details`: further values by name, for programs.
    """

    name: str
    grade: Grade
    said: str
    value: float | None = None
    unit: str = ""
    good: Range = (None, None)
    tolerable: Range = (None, None)
    reason: str = ""
    remedy: str = ""
    details: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def sentence(self) -> str:
        """Return measurement, expectation and remedy as one sentence."""
        reason = f" ({self.reason})" if self.reason else ""
        return f"{self.said}{reason}{f'; {self.remedy}' if self.remedy else ''}"

    def line(self) -> str:
        """Return grade, name and sentence in columns."""
        return f"{self.grade:<12}{self.name:<24}{self.sentence()}"


@dataclass(frozen=True)
class CheckReport:
    """Result of a check.

    - `devices`: one line for each device.
    - `findings`: in the order of measurement.
    - `forecast`: verdict of `build-lut` on the figures that a check measures; None if the chart was not detected, or if
      the trial frames had another shutter time than the settings.
    - `figures`: measured figures by their names in `report.json`.
    - `not_known`: names of the figures that only a session can measure.
    - `shutter_s`: shutter time of the trial frames, s; None if it is the one of the settings.
    """

    devices: tuple[str, ...]
    findings: tuple[Finding, ...]
    forecast: Outcome | None = None
    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    not_known: tuple[str, ...] = ()
    shutter_s: float | None = None

    def sorted(self) -> list[Finding]:
        """Return the findings by grade, faults first."""
        return [finding for grade in GRADES for finding in self.with_grade(grade)]

    def with_grade(self, grade: Grade) -> tuple[Finding, ...]:
        """Return the findings of one grade."""
        return tuple(finding for finding in self.findings if finding.grade == grade)

    def lines(self) -> tuple[str, ...]:
        """Return the report for a terminal: devices, then findings, faults first."""
        return *self.devices, *(finding.line() for finding in self.sorted()), *self._forecast_lines()

    def _forecast_lines(self) -> list[str]:
        if not self.figures:
            return []
        names = ", ".join(name.replace("_", " ") for name in self.not_known)
        forecast = f"build-lut would return {self.forecast!r} on the {len(self.figures)} figures of this check"
        if self.shutter_s is not None:
            forecast = f"no forecast for the shutter time of the settings; set camera.shutter_s = {self.shutter_s:.4g}"
        return [
            f"LUT         {forecast}",
            f"            figures that only a session can measure: {names}",
        ]

    def values(self) -> dict[str, Any]:
        """Return the report for programs: `devices`, `faults` (their number), `findings`, `table`."""
        table = {
            "outcome": self.forecast,
            "shutter_s": self.shutter_s,
            "figures": self.figures,
            "not_known": self.not_known,
        }
        return {
            "devices": self.devices,
            "faults": len(self.with_grade("fault")),
            "findings": self.findings,
            "table": table if self.figures else None,
        }


def judge_value(
    limit: Limit, value: float, sentence: str = "", remedy: str = "", details: Mapping[str, Any] | None = None
) -> Finding:
    """Judge a value by its limit; the sentence and the remedy of the limit are used if none are given."""
    grade, (good, tolerable) = _GRADES[limit.outcome(value)], limit.ranges
    is_good = grade == "good"
    expected = f", expected {limit.expected}" if is_good else ""
    return Finding(
        limit.name,
        grade,
        sentence or f"{limit.title}: {limit.text(value)}{expected}",
        value,
        limit.unit,
        good,
        tolerable,
        "" if is_good else f"{limit.expected} expected: {limit.why}",
        "" if is_good else remedy or limit.remedy,
        {} if details is None else details,
    )


def not_checked(name: str, reason: str, remedy: str = "") -> Finding:
    """Return the finding of a quantity that could not be measured."""
    return Finding(name, "not checked", reason, remedy=remedy)
