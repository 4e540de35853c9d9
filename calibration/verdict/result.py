"""What a build, or a check, hands on: its figures, the verdict on them, and where the table is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calibration.measurements import TableMeasurements
from calibration.verdict.verdict import Verdict


@dataclass(frozen=True, eq=False)
class BuildResult:
    """A table as measured and judged.

    - `figures`: what was measured.
    - `verdict`: the judgement on the figures.
    - `lut`: the table's folder; None after a check.
    """

    figures: TableMeasurements
    verdict: Verdict
    lut: Path | None
