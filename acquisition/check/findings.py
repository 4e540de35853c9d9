"""What a check found: one frozen value for each thing measured, its grade by its limit, text and JSON of all of them.

A value that a table is accepted with is good, one that it is remarked on for a remark, beyond that a fault
(`calibration.figures.figure.Limit`). What could not be measured is `not checked`, with the reason; it is never good.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from calibration.figures.figure import Limit, Outcome, Range

Grade = Literal["fault", "remark", "not checked", "good"]
GRADES: tuple[Grade, ...] = ("fault", "remark", "not checked", "good")  # In the order in which findings are reported

_GRADES: Mapping[Outcome, Grade] = {"accept": "good", "accept with remarks": "remark", "refuse": "fault"}


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    - `name`: of the figure or limit that judges it, or of what was looked at: "chart".
    - `grade`: good, remark, fault, or not checked.
    - `said`: what was seen, with its numbers; or why nothing was.
    - `value`: the number that was judged; None where there is none.
    - `unit`: of the value and the limits, as in `Limit`.
    - `reason`: what goes wrong beyond them; empty where the value is good.
    - `remedy`: what to do; empty where nothing is to be done.
    - `details`: further numbers and words by name, for programs.
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
        """Return what was seen, why it matters, and what to do, as one sentence."""
        why = f" ({self.reason})" if self.reason else ""
        return f"{self.said}{why}{f'; {self.remedy}' if self.remedy else ''}"

    def line(self) -> str:
        """Return grade, name and sentence, in columns."""
        return f"{self.grade:<12}{self.name:<24}{self.sentence()}"


@dataclass(frozen=True)
class CheckReport:
    """What a whole check found.

    - `devices`: what answered, a line each, and what was done with it.
    - `findings`: in the order in which they were looked at.
    - `forecast`: what `build-lut` would say, as far as these frames show it: "accept", "accept with remarks" or
      "refuse"; None where the chart was not found, or the exposure of the settings is not that of the frames.
    - `figures`: the table's figures that are known, by their names in `report.json`.
    - `not_known`: the names of those that are known only when there are frames of a session.
    - `first_s`: the shutter time to set before anything is forecast, at which the figures hold; None if it is set.
    """

    devices: tuple[str, ...]
    findings: tuple[Finding, ...]
    forecast: Outcome | None = None
    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    not_known: tuple[str, ...] = ()
    first_s: float | None = None

    def sorted(self) -> list[Finding]:
        """Return the findings by their grades, faults first."""
        return [finding for grade in GRADES for finding in self.of(grade)]

    def of(self, grade: Grade) -> tuple[Finding, ...]:
        """Return the findings of one grade."""
        return tuple(finding for finding in self.findings if finding.grade == grade)

    def lines(self) -> tuple[str, ...]:
        """Return the report as lines for a terminal: devices, then findings, faults first."""
        return *self.devices, *(finding.line() for finding in self.sorted()), *self._forecast_lines()

    def _forecast_lines(self) -> list[str]:
        if not self.figures:
            return []
        names = ", ".join(name.replace("_", " ") for name in self.not_known)
        said = f"build-lut would say {self.forecast!r} by the {len(self.figures)} figures known now"
        if self.first_s is not None:
            said = f"set camera.shutter_s to {self.first_s:.4g} first; these figures hold for {self.first_s:.4g} s"
        return [
            f"table       {said}",
            f"            not known before the session: {names}",
        ]

    def values(self) -> dict[str, Any]:
        """Return the report for programs: `devices`, `faults` (their number), `findings`, `table`."""
        table = {
            "outcome": self.forecast,
            "shutter_s": self.first_s,
            "figures": self.figures,
            "not_known": self.not_known,
        }
        return {
            "devices": self.devices,
            "faults": len(self.of("fault")),
            "findings": self.findings,
            "table": table if self.figures else None,
        }


def judged(
    limit: Limit, value: float, said: str = "", remedy: str = "", details: Mapping[str, Any] | None = None
) -> Finding:
    """Return the finding of a value by its limit; title and remedy of the limit if nothing else is said."""
    grade, (good, tolerable) = _GRADES[limit.outcome(value)], limit.ranges
    is_good = grade == "good"
    expected = f", {limit.expected} expected" if is_good else ""
    return Finding(
        limit.name,
        grade,
        said or f"{limit.title}: {limit.text(value)}{expected}",
        value,
        limit.unit,
        good,
        tolerable,
        "" if is_good else f"{limit.expected} expected: {limit.why}",
        "" if is_good else remedy or limit.remedy,
        {} if details is None else details,
    )


def not_checked(name: str, why: str, remedy: str = "") -> Finding:
    """Return the finding of what could not be looked at."""
    return Finding(name, "not checked", why, remedy=remedy)
