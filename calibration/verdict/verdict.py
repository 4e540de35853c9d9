"""Accept, accept with remarks, or refuse: values compared with `calibration.verdict.thresholds`.

Rules that hold inside:

- Judging is a pure function of values: the same values give the same verdict, whoever measured them.
- A value that could not be measured is not judged; one that is not a number is refused.
- The verdict is its worst row.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from calibration.verdict.thresholds import THRESHOLDS, Threshold

Outcome = Literal["accept", "accept with remarks", "refuse"]
OUTCOMES: tuple[Outcome, Outcome, Outcome] = ("accept", "accept with remarks", "refuse")
"""From the best to the worst."""

_LARGE = 1000.0
"""From here on three significant digits would be written with an exponent."""


@dataclass(frozen=True)
class JudgedValue:
    """One measured value, its limit, and what follows."""

    threshold: Threshold
    value: float
    outcome: Outcome

    def text(self) -> str:
        """Return value, expectation and consequence, for a line of text."""
        limit, unit = self.threshold, self.threshold.unit
        refused = "" if limit.refuse is None else f", refused beyond {format_value(limit.refuse, unit)}"
        return (
            f"{limit.title}: {format_value(self.value, unit)}, {limit.sense} {format_value(limit.accept, unit)} "
            f"expected{refused}; {limit.why}"
        )


@dataclass(frozen=True)
class Verdict:
    """The judgement on a table, value by value."""

    rows: tuple[JudgedValue, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst of the rows."""
        return OUTCOMES[max((OUTCOMES.index(row.outcome) for row in self.rows), default=0)]

    @property
    def refused(self) -> tuple[JudgedValue, ...]:
        """The rows for which no table is made."""
        return tuple(row for row in self.rows if row.outcome == "refuse")

    @property
    def remarks(self) -> tuple[JudgedValue, ...]:
        """The rows beyond what is expected, with which a table is made all the same."""
        return tuple(row for row in self.rows if row.outcome == "accept with remarks")


def judge(values: Mapping[str, float], thresholds: Sequence[Threshold] = THRESHOLDS) -> Verdict:
    """Return the verdict on values by name; a threshold whose value is missing is passed over."""
    return Verdict(
        tuple(
            JudgedValue(limit, values[limit.name], _outcome(values[limit.name], limit))
            for limit in thresholds
            if limit.name in values
        )
    )


def _outcome(value: float, limit: Threshold) -> Outcome:
    if math.isnan(value):
        return "refuse" if limit.refuse is not None else "accept with remarks"
    sign = 1 if limit.sense == "at most" else -1
    if limit.refuse is not None and sign * value > sign * limit.refuse:
        return "refuse"
    return "accept with remarks" if sign * value > sign * limit.accept else "accept"


def format_value(value: float, unit: str) -> str:
    """Return a value for people: shares as per cent, three significant digits, two of an angle.

    `unit` is that of `Threshold.unit`.
    """
    if unit == "share":
        return f"{100 * value:.3g} %"
    if unit == "°":
        return f"{value:.2g}°"
    return f"{value:.3g} {unit}".strip() if abs(value) < _LARGE else f"{value:.0f} {unit}".strip()
