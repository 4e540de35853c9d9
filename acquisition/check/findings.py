"""What a check found: one frozen value for each thing looked at, its grade, the limits, text and JSON of all of them.

Rules that hold inside:

- A value within the limits of `good` is good, within those of `tolerable` a remark, beyond them a fault. A limit is
  open on a side where it is None.
- What could not be looked at is `not checked`, with the reason; it is never good.
- A finding that is not good says what to do about it.
- What lies beyond `tolerable` is refused later, by the run or by `build-lut`, whose numbers these are
  (`calibration.figures`). Where `good` is narrower than what a table is accepted with, it is a warning while
  something can be mended, and the limit's source says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from calibration.figures.figure import JUDGEMENT, SIMULATED, Outcome, Range
from calibration.figures.geometry import BLEED, CELL_PX
from calibration.figures.light import ADDITIVITY, GREY_TINT_DEG, LEAK_SHARE, LINEARITY, WHITE_DRIFT, WHITE_DRIFT_DEG
from calibration.figures.radiometry import UNFIT_SHARE
from calibration.figures.truth import BRIGHTEST_SHARE, DARKEST_COUNTS, REFERENCE_SPREAD

CELL_PHOTOSITES = 100
"""Photosites under the 25 samples of a cell, each of which has four: any of them may be hot."""

Grade = Literal["fault", "remark", "not checked", "good"]
GRADES: tuple[Grade, ...] = ("fault", "remark", "not checked", "good")
"""In the order in which findings are told."""


@dataclass(frozen=True)
class Limit:
    """What a value may be.

    - `name`: of the finding that it judges.
    - `title`: the value for people.
    - `unit`: of the value and its limits: "share" (0 … 1, shown as per cent), "px", "°", "s", or "" for a plain number.
    - `good`, `tolerable`: lowest and highest value that is good, and that is but remarked on; beyond `tolerable` it is
      a fault.
    - `why`: what goes wrong beyond.
    - `source`: where the numbers come from.
    """

    name: str
    title: str
    unit: str
    good: Range
    tolerable: Range
    why: str
    source: str = JUDGEMENT

    def grade(self, value: float) -> Grade:
        """Return the grade of a value; NaN is a fault."""
        if _within(value, self.good):
            return "good"
        return "remark" if _within(value, self.tolerable) else "fault"

    def wanted(self) -> str:
        """Return the limits of `good` as words, "60 % to 80 %"."""
        low, high = (None if bound is None else amount(bound, self.unit) for bound in self.good)
        if low is None:
            return f"at most {high}"
        return f"at least {low}" if high is None else f"{low} to {high}"


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at.

    - `name`: what: "exposure", "evenness".
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


@dataclass(frozen=True)
class CheckReport:
    """What a whole check found.

    - `devices`: what answered, a line each, and what was done with it.
    - `findings`: in the order in which they were looked at.
    - `forecast`: what `build-lut` would say, as far as these frames show it: "accept", "accept with remarks" or
      "refuse"; None where the chart was not found.
    - `figures`: the table's figures that are known, by their names in `report.json`.
    - `not_known`: the names of those that are known only when there are frames of a session.
    """

    devices: tuple[str, ...]
    findings: tuple[Finding, ...]
    forecast: Outcome | None = None
    figures: Mapping[str, float] = field(default_factory=dict[str, float])
    not_known: tuple[str, ...] = ()

    def of(self, grade: Grade) -> tuple[Finding, ...]:
        """Return the findings of one grade."""
        return tuple(finding for finding in self.findings if finding.grade == grade)

    def lines(self) -> tuple[str, ...]:
        """Return the report as lines for a terminal: devices, then findings, faults first."""
        described = [
            f"{finding.grade:<12}{finding.name:<18}{finding.sentence()}"
            for grade in GRADES
            for finding in self.of(grade)
        ]
        return *self.devices, *described, *self._forecast_lines()

    def _forecast_lines(self) -> list[str]:
        if self.forecast is None:
            return []
        names = ", ".join(name.replace("_", " ") for name in self.not_known)
        return [
            f"table       build-lut would say {self.forecast!r} by the {len(self.figures)} figures known now",
            f"            not known before the session: {names}",
        ]

    def values(self) -> dict[str, Any]:
        """Return the report for programs: `devices`, `faults` (their number), `findings`, `table`."""
        table = {"outcome": self.forecast, "figures": self.figures, "not_known": self.not_known}
        return {
            "devices": self.devices,
            "faults": len(self.of("fault")),
            "findings": self.findings,
            "table": None if self.forecast is None else table,
        }


def judged(limit: Limit, value: float, said: str, remedy: str, details: Mapping[str, Any] | None = None) -> Finding:
    """Return the finding of a value: its grade by the limit, and reason and remedy where it is not good."""
    grade = limit.grade(value)
    wanted = "" if grade == "good" else f"{limit.wanted()} wanted: {limit.why}"
    return Finding(
        limit.name,
        grade,
        said,
        value,
        limit.unit,
        limit.good,
        limit.tolerable,
        wanted,
        "" if grade == "good" else remedy,
        {} if details is None else details,
    )


def not_checked(name: str, why: str, remedy: str = "") -> Finding:
    """Return the finding of what could not be looked at."""
    return Finding(name, "not checked", why, remedy=remedy)


def not_checked_all(names: Iterable[str], why: str) -> list[Finding]:
    """Return the findings of what could not be looked at for one reason."""
    return [not_checked(name, why) for name in names]


def worst(grades: Iterable[Grade]) -> Grade:
    """Return the worst of some grades; good of none."""
    found: list[Grade] = ["good", *grades]
    return min(found, key=lambda grade: GRADES.index(grade))


def amount(value: float, unit: str) -> str:
    """Return a value with its unit, a share as per cent.

    >>> amount(0.046, "share"), amount(0.0004, "share"), amount(1.25, "px"), amount(3, "")
    ('4.6 %', '0.04 %', '1.25 px', '3')
    """
    if unit == "share":
        return percent(value)
    return f"{value:.0f}" if unit == "" and value >= 100 else f"{value:.3g}{'' if unit in ('', '°') else ' '}{unit}"


def percent(share: float) -> str:
    """Return a share as per cent, two digits below ten.

    >>> percent(0.7123), percent(0.0461), percent(0.00042), percent(0.0)
    ('71 %', '4.6 %', '0.04 %', '0 %')
    """
    value = 100 * share
    if abs(value) >= 10 or value == 0:
        return f"{value:.0f} %"
    return f"{value:.1f} %" if abs(value) >= 1 else f"{value:.2f} %"


def _within(value: float, bounds: Range) -> bool:
    low, high = bounds
    return value == value and (low is None or value >= low) and (high is None or value <= high)


_VERDICT = "the limits of a table's verdict"
_EARLY = "a warning while it can be mended; no table is refused for it"

_LIMITS = (
    Limit(
        "exposure", "White under the brightest light, of measured saturation", "share", (0.6, 0.8),
        (None, BRIGHTEST_SHARE.refuse),
        "above, lights and places of the print that are brighter clip; below, dark colours drown in noise",
        "0.8 leaves room for uneven light and the lamp's drift; each stop less doubles the noise of dark cells; a "
        "table is refused where paper clips, or its darkest light has no signal",
    ),
    Limit(
        "darkest light", "Bare paper under the plan's darkest light, foretold from the primaries", "counts",
        *DARKEST_COUNTS.ranges,
        "25 samples of 300 counts have a mean good to 1 %, a print's dark colours a thirtieth of that",
        _VERDICT,
    ),
    Limit(
        "clipping", "Photosites at 98 % of saturation and more, white frame", "share", (None, 0.0002), (None, 0.001),
        "clipped cells cannot be used; beyond limits.clipped_percent the run refuses the frame",
        "0.1 % is the run's own limit; hot photosites and reflections on pins stay below 0.02 %",
    ),
    Limit(
        "brightest light", "A primary alone over white, channel by channel", "share", (None, 1.005), (None, None),
        "the exposure is judged by white, and another light is brighter and may clip",
        "light adds: white holds every primary in full; 0.5 % is the lamp's flicker between two frames; " + _EARLY,
    ),
    Limit(
        ADDITIVITY.name, "White against the sum of the primaries", "share",
        (-ADDITIVITY.accept, ADDITIVITY.accept), (None, None),
        "the projector mixes colours in its own way, so that lights are not what their codes say; "
        "the table is valid all the same",
        _VERDICT,
    ),
    Limit(
        "evenness", "Light missing at the chart's darkest place, of its brightest", "share", (None, 0.55), (None, None),
        "dark corners have too little light for their colours, and the smooth field that divides it out is not known "
        "there well enough",
        SIMULATED + ": fields whose corners have 42 to 52 % of the centre are divided out to 0.2 %; " + _EARLY,
    ),
    Limit(
        "colour evenness", "Change of white's R/G or B/G over the chart", "share", (None, 0.12), (None, None),
        "one end of the chart is lit by another colour than the other",
        "projectors change by some per cent, simulated ones by 4 %; a stain on much of a small chart shows here, too; "
        + _EARLY,
    ),
    Limit(
        "references", "White references about the flat field, under white", "share",
        *REFERENCE_SPREAD.ranges,
        "a reflection, a stain, a fold or a shadow is not smooth, so that the flat field leaves it in the samples",
        _VERDICT,
    ),
    Limit(
        "room light", "Paper under the black picture, of paper under white", "share",
        (None, LEAK_SHARE.accept), (None, 0.05),
        "every light contains it, and the deep colours among the lights become paler",
        "good as in a table's verdict; a contrast of 1 : 1500 gives 0.07 %; the run refuses dark frames from "
        "judge.dark_percent on, half of what a table is refused for",
    ),
    Limit(
        "sharpness", "Light of neighbouring cells in the worst sample, by the blur of printed edges", "share",
        *BLEED.ranges,
        "the samples of a cell take in light from its neighbours",
        _VERDICT + ", which go by the median of all places; the worst place is remarked on; a cell of 10 px has 0.2 % "
        "at a blur of 0.7 px and 1 % at 1 px",
    ),
    Limit(
        "turn", "Angle between the chart's rows and the picture's", "°", (-5.0, 5.0), (None, None),
        "the windows of samples stand along the picture's rows, and their corners come near the neighbouring cells",
        "geometry: 5 px of samples in a cell of 10 px; " + _EARLY,
    ),
    Limit(
        "tilt", "Longer over shorter of two opposite sides, less 1", "share", (None, 0.1), (None, None),
        "cells are smaller on the far side, and it lies out of the plane of focus",
        "judgement; size and sharpness are judged by themselves; " + _EARLY,
    ),
    Limit(
        "size", "Smallest cell", "px", *CELL_PX.ranges,
        "25 samples do not lie safely inside a cell",
        "geometry: half of 5 px, 0.5 px of rounding, 0.25 px of registration, and the blur; " + _VERDICT,
    ),
    Limit(
        "unfit cells", "Cells outside the picture, clipped or stained under white", "share",
        *UNFIT_SHARE.ranges,
        "colours without samples are missing from every picture",
        _VERDICT,
    ),
    Limit(
        "stains", "Cells or references that are not of their codes' colours", "share", (None, 0.0), (None, None),
        "the table would hold the colours of a dirty or creased print; build-lut lists such cells as unfit",
        "a stain of 60 mm covers 0.3 % of an A0 chart's cells, a thumb's 0.05 %; how many make a table useless is "
        "judged by unfit cells; " + _EARLY,
    ),
    Limit(
        "grey tint", "Tint of the print's greys against paper", "°", *GREY_TINT_DEG.ranges,
        "greys are not neutral; methods that rely on grey are judged by another grey than paper's",
        _VERDICT,
    ),
    Limit(
        "flicker", "Angle of white from the first of repeated frames", "°", *WHITE_DRIFT_DEG.ranges,
        "frames that catch parts of a turn of the colour wheel have colours of their own",
        _VERDICT + " on a session's white frames, of which these are the first; 0.24 % of R/G at 0.5 s behind a wheel "
        "with 0.5 ms of jitter are 0.1°, 7 % at 1/60 s 3°",
    ),
    Limit(
        "brightness", "Largest less smallest white of repeated frames", "share", *WHITE_DRIFT.ranges,
        "the lamp is not steady, or exposures differ",
        _VERDICT + " on a session's white frames, of which these are the first",
    ),
    Limit(
        "hot photosites", "Photosites of a million that stand out in the dark", "",
        (None, UNFIT_SHARE.accept * 1e6 / CELL_PHOTOSITES),
        (None, (UNFIT_SHARE.refuse or 1.0) * 1e6 / CELL_PHOTOSITES),
        "each makes a cell unfit whose samples it lies under",
        "100 photosites lie under a cell's samples: 50 of a million reach 0.5 % of the cells; " + _VERDICT,
    ),
    Limit(
        "noise reduction", "Time after the exposure that grows with it, of the exposure", "share", (None, 0.5),
        (None, None),
        "the body takes a dark frame of its own after each exposure: the session takes twice as long, and frames are "
        "no longer as the sensor gave them",
        "without it a file's transfer takes as long after any exposure",
    ),
    Limit(
        LINEARITY.name, "Deviation from proportion to light, 5 to 95 % of saturation", "share",
        *LINEARITY.ranges,
        "chromaticities change with brightness",
        "EMVA 1288 asks for the range; " + _VERDICT,
    ),
    Limit(
        "disk", "Free space over what the plan needs", "", (1.0, None), (1.0, None),
        "the run refuses to begin",
        "the run's own estimate, retakes and a reserve included",
    ),
    Limit(
        "battery", "Charge of the camera's battery, without mains", "share", (None, None), (0.5, None),
        "a charge holds 440 frames (EOS 550D) to 1200 (EOS 6D Mark II), a session of 707 lights has 767",
        "the maker's figures",
    ),
    Limit(
        "card", "Free space on the camera's card over what the plan needs", "", (1.0, None), (1.0, None),
        "the body stops when its card is full",
        "the run's own estimate, retakes and a reserve included",
    ),
)  # fmt: skip

LIMITS: Mapping[str, Limit] = MappingProxyType({limit.name: limit for limit in _LIMITS})
"""The limits by the name of what they judge, in the order of docs/how-to/check.md."""
