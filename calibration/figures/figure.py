"""Type of a figure: a measured property of a session or LUT, with its limits, explanation and report lines.

A value within `accept` is accepted. Between `accept` and `refuse`, the LUT is accepted with a remark. Beyond `refuse`,
the LUT is not written. A figure without `refuse` only leads to remarks. If another module applies a limit as well, the
limit is imported from there, for example from `calibration.registration.register`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

if TYPE_CHECKING:
    from calibration.causes.gathering import CauseEvidence
    from calibration.causes.rules import Subject
    from calibration.measurements import TableMeasurements
    from experiment.session.records import FrameRecord

Sense = Literal["at most", "at least"]
Outcome = Literal["accept", "accept with remarks", "refuse"]
OUTCOMES: Final[tuple[Outcome, ...]] = get_args(Outcome)  # From best to worst

# Groups of limits in the report. The group "devices" has no figure, only limits for single frames.
Group = Literal["geometry", "light", "radiometry", "noise", "truth", "devices"]

QUESTIONS: Final[dict[Group, str]] = {
    "geometry": "Is the chart registered, and does each sample lie in its patch?",
    "light": "Is each illuminant the planned one, without other light, and from one lamp?",
    "radiometry": "Are counts proportional to light, and do patches have the colours of their codes?",
    "noise": "Is the noise explained by photons and sensor?",
    "truth": "How uncertain is the ground truth of each illuminant?",
}

# Names of the plots in the report (`calibration.report.report`).
Drawing = Literal[
    "chart", "lights", "budget", "errors", "noise", "residuals", "field", "frames"
]  # fmt: skip

JUDGEMENT: Final = "chosen by judgement"  # Source of a limit that is based on experience only

# Source of a limit measured in simulated rooms with known ground truth (`benchmarks.rooms`, `benchmarks.accuracy`).
SIMULATED: Final = "measured on simulated frames"

Range = tuple[float | None, float | None]  # Lowest and highest value; None if unlimited

# Smaller values are rounding errors of sums and are printed as 0.
_ZERO_BELOW = 1e-7

_INTEGER_FROM = 1000.0  # Larger values are printed without decimals, because :.3g would print an exponent


@dataclass(frozen=True)
class Explanation:
    """How the cause of a figure beyond its limit is determined (`calibration.causes`).

    - `about`: subject of the figure, by which rules are selected.
    - `gather`: returns evidence, frames and positions from the measurements of a LUT and the accepted limit.
    - `follows`: names of related figures. If the cause of this figure is unknown, their cause is reported.
    """

    about: Subject
    gather: Callable[[TableMeasurements, float], CauseEvidence | None]
    follows: tuple[str, ...] = ()


@dataclass(frozen=True)
class SummaryRow:
    """One measured value as text.

    - `name`, `value`: quantity, and number with unit.
    - `note`: meaning or usual value; "" if not needed.
    - `brief`: True for the few rows that a command prints.
    """

    name: str
    value: str
    note: str
    brief: bool = False


@dataclass(frozen=True)
class Line:
    """A line in the summary: its rank among all lines, and a function that returns its row, or None for no row."""

    position: int
    row: Callable[[TableMeasurements], SummaryRow | None]


@dataclass(frozen=True)
class Limit:
    """Limit of one measured value, for the check, for frames during a session, and for the LUT.

    - `name`: identifier in messages and files.
    - `title`: name of the quantity in reports.
    - `group`: group of the report's page.
    - `unit`: unit of value and limits; "" for a number or ratio, "share" for a fraction 0 … 1.
    - `sense`: side of the limits on which a value is accepted.
    - `accept`: limit of acceptance without a remark.
    - `refuse`: limit beyond which the LUT is refused or the frame is repeated; None if the limit only causes remarks.
    - `why`: consequence of a value beyond the limit.
    - `source`: origin of the limits.
    - `remedy`: instruction for the user; "" if it depends on the detected fault.
    """

    name: str
    title: str
    group: Group
    unit: str
    sense: Sense
    accept: float
    refuse: float | None
    _: KW_ONLY
    why: str
    source: str
    remedy: str

    def outcome(self, value: float) -> Outcome:
        """Return the outcome of a value; NaN has the worst outcome of this limit."""
        sign = 1 if self.sense == "at most" else -1
        if self.refuse is not None and not sign * value <= sign * self.refuse:
            return "refuse"
        return "accept" if sign * value <= sign * self.accept else "accept with remarks"

    @property
    def ranges(self) -> tuple[Range, Range]:
        """Range of accepted values and range of values that are not refused; None if unlimited."""
        if self.sense == "at most":
            return (None, self.accept), (None, self.refuse)
        return (self.accept, None), (self.refuse, None)

    def text(self, value: float) -> str:
        """Return a value with its unit."""
        return format_value(value, self.unit)

    @property
    def expected(self) -> str:
        """The accepted range as text."""
        return f"{self.sense} {self.text(self.accept)}"

    def limit_json(self) -> dict[str, Any]:
        """Return the limit for `report.json`."""
        keys = ("name", "title", "unit", "sense", "accept", "refuse", "why", "source", "remedy")
        return {key: getattr(self, key) for key in keys}


@dataclass(frozen=True)
class Figure(Limit):
    """A limit by which a LUT is judged, with the measurement and explanation of its value.

    - `measure`: returns the value; None if it could not be measured, for example without tags or dark frames.
    - `before_session`: True if the trial frames of `acquire check` are sufficient to judge the value.
    - `from_one_frame`: whether `build-lut check` judges the value from one light or white frame and one dark frame.
      With `beyond`, only a value beyond its limit is judged, because more frames cannot bring it back.
    - `where`: returns the frames, illuminants or position beyond the accepted limit as text; None if the cause
      contains them.
    - `retake`: returns the frames beyond a limit; None if all frames are, or if the value is not of single frames.
    - `cause`: how the cause is determined; None if the value has only one cause.
    - `drawing`: the plot that shows the figure, if any.
    - `lines`: lines of the figure in the summary.
    - `foremost`: True if a refusal reports this figure first, because other figures may follow from it.
    - `detail`: returns text to append to the value in messages, and a remedy, if both depend on the detected fault.
    """

    _: KW_ONLY
    measure: Callable[[TableMeasurements], float | None]
    before_session: bool = True
    from_one_frame: Literal["yes", "beyond", "no"] = "no"
    where: Callable[[TableMeasurements, float], str] | None = None
    retake: Callable[[TableMeasurements, float], list[FrameRecord] | None] | None = None
    cause: Explanation | None = None
    drawing: Drawing | None = None
    lines: tuple[Line, ...] = ()
    foremost: bool = False
    detail: Callable[[TableMeasurements], tuple[str, str] | None] | None = None

    def judged_value(self, table: TableMeasurements) -> float | None:
        """Return the value to judge; None if it was not measured or if other frames may change its outcome."""
        value = self.measure(table)
        if value is None or not table.is_of_one_frame or self.from_one_frame == "yes":
            return value
        return value if self.from_one_frame == "beyond" and self.outcome(value) != "accept" else None


def worst_outcome(outcomes: Iterable[Outcome]) -> Outcome:
    """Return the worst of the outcomes; "accept" if there are none."""
    return OUTCOMES[max((OUTCOMES.index(outcome) for outcome in outcomes), default=0)]


def format_value(value: float, unit: str) -> str:
    """Return a value as text: fractions in %, two significant digits for degrees, otherwise at least three.

    `unit`: as in `Limit`.
    """
    if abs(value) < _ZERO_BELOW:
        value = 0.0
    if unit == "share":
        return f"{100 * value:.3g} %"
    if unit == "°":
        return f"{value:.2g}°"
    number = f"{value:.3g}" if abs(value) < _INTEGER_FROM else f"{value:.0f}"
    return f"{number} {unit.removesuffix('s') if number == '1' else unit}".strip()
