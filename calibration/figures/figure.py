"""A judged figure is one object with all that is ever asked of it; judging and reporting loop over them.

Rules that hold inside:

- Limits stand here alone; the check and the live judge take them from here. What no table shows has a plain `Limit`
  (`calibration.figures.single_frames`).
- A value within `accept` is accepted; between `accept` and `refuse` it is remarked on; beyond `refuse` there is no
  table. Without `refuse` it is only ever remarked on: what it measures does not make the table wrong.
- Where a measurement refuses by itself (`calibration.registration.register`), the number is defined there and imported.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

if TYPE_CHECKING:
    from calibration.causes.gathering import Gathered
    from calibration.causes.rules import Subject
    from calibration.measurements import TableMeasurements
    from experiment.session.records import FrameRecord

Sense = Literal["at most", "at least"]
Outcome = Literal["accept", "accept with remarks", "refuse"]
OUTCOMES: Final[tuple[Outcome, ...]] = get_args(Outcome)  # From the best to the worst

# What a scientist asks about, one question a group of the report; no figure is of devices.
Group = Literal["geometry", "light", "radiometry", "noise", "truth", "devices"]

QUESTIONS: Final[dict[Group, str]] = {
    "geometry": "Was the chart found, and does each sample lie in its cell?",
    "light": "Is each light the one that was ordered, alone, and of one lamp?",
    "radiometry": "Are counts proportional to light, and cells their codes' colours?",
    "noise": "Is the noise that of light and sensor?",
    "truth": "How well is each light's colour known?",
}

# Names of the report's pictures (`calibration.report.report`).
Drawing = Literal[
    "chart", "lights", "budget", "errors", "noise", "residuals", "field", "course"
]  # fmt: skip

JUDGEMENT: Final = "judgement"  # The source of a limit that nothing but experience supports

# The source of a limit found in rooms whose truth is known (`benchmarks.rooms`, `benchmarks.accuracy`).
SIMULATED: Final = "measured on simulated frames"

Range = tuple[float | None, float | None]  # Lowest and highest value; None where open

# Below it a figure is nothing: every limit that is not 0 is a thousand times as high and more (rounding of sums).
_SMALL = 1e-7

_LARGE = 1000.0  # From here on three significant digits would be written with an exponent


@dataclass(frozen=True)
class Explanation:
    """How the cause of a figure beyond its limit is found (`calibration.causes`).

    - `about`: what the figure is about, which rules ask for.
    - `gather`: what is known of it, its frames and places, from which value on (the limit accepted).
    - `follows`: names of figures that it moves along with: whose cause it shares where it has none of its own.
    """

    about: Subject
    gather: Callable[[TableMeasurements, float], Gathered | None]
    follows: tuple[str, ...] = ()


@dataclass(frozen=True)
class SummaryRow:
    """What was measured, in words.

    - `name`, `value`: what, and the number with its unit.
    - `note`: what it means, or what is usual; may be "".
    - `brief`: whether it is among the few that a command prints.
    """

    name: str
    value: str
    note: str
    brief: bool = False


@dataclass(frozen=True)
class Line:
    """A figure's line in the summary: its place among all lines, rising, and its row; None where there is nothing."""

    place: int
    row: Callable[[TableMeasurements], SummaryRow | None]


@dataclass(frozen=True)
class Limit:
    """What one measured value may be, and why: the one kind of limit in check, live judge and table.

    - `name`: of the value in messages and files.
    - `title`: the value for people.
    - `group`: of the report's page.
    - `unit`: of the value and both limits; "" for a count or a plain number, "share" for 0 … 1.
    - `sense`: on which side of the limits a value is accepted.
    - `accept`: up to here nothing is remarked.
    - `refuse`: beyond it there is no table, or the frame is taken again; None where the value is only ever remarked on.
    - `why`: what goes wrong beyond.
    - `source`: where the numbers come from.
    - `remedy`: what to do about it; "" where it depends on what was found.
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
        """Return what a value does to a table; one that is not a number is as bad as can be."""
        sign = 1 if self.sense == "at most" else -1
        if self.refuse is not None and not sign * value <= sign * self.refuse:
            return "refuse"
        return "accept" if sign * value <= sign * self.accept else "accept with remarks"

    @property
    def ranges(self) -> tuple[Range, Range]:
        """Lowest and highest value that is accepted, and that is not refused; None where open."""
        if self.sense == "at most":
            return (None, self.accept), (None, self.refuse)
        return (self.accept, None), (self.refuse, None)

    def text(self, value: float) -> str:
        """Return a value of it for people."""
        return format_value(value, self.unit)

    @property
    def expected(self) -> str:
        """What is accepted, for people."""
        return f"{self.sense} {self.text(self.accept)}"

    def limit_json(self) -> dict[str, Any]:
        """Return its limit as in `report.json`."""
        keys = ("name", "title", "unit", "sense", "accept", "refuse", "why", "source", "remedy")
        return {key: getattr(self, key) for key in keys}


@dataclass(frozen=True)
class Figure(Limit):
    """One figure that a table is judged by: a limit, and how its value is measured and explained.

    - `measure`: the value; None where it could not be measured: on a chart without tags or with few colours, without
      dark frames or a series of exposures.
    - `before_session`: whether the trial frames of `acquire check` show it as those of a session do.
    - `of_one_frame`: what `build-lut check` can say of it, which reads one light or white frame and a dark one: it is
      `known`; or `bounded`, since more frames can only make it worse, so that it is told where it is beyond its limit
      already; or `unknown`.
    - `where`: frames, lights or place beyond the limit accepted, for a remark; None for those of its cause.
    - `retake`: the frames that are beyond a limit by themselves, None if all of them are; None for a figure that is not
      of single frames.
    - `cause`: how its cause is found; None if it explains itself.
    - `drawing`: the picture that shows it; None if none does.
    - `lines`: its lines in the summary.
    - `foremost`: whether a refusal speaks of it before others, which may follow from it.
    - `found`: what a refusal or remark adds, and the remedy, where that depends on what was found.
    """

    _: KW_ONLY
    measure: Callable[[TableMeasurements], float | None]
    before_session: bool = True
    of_one_frame: Literal["known", "bounded", "unknown"] = "unknown"
    where: Callable[[TableMeasurements, float], str] | None = None
    retake: Callable[[TableMeasurements, float], list[FrameRecord] | None] | None = None
    cause: Explanation | None = None
    drawing: Drawing | None = None
    lines: tuple[Line, ...] = ()
    foremost: bool = False
    found: Callable[[TableMeasurements], tuple[str, str] | None] | None = None

    def judged_value(self, table: TableMeasurements) -> float | None:
        """Return the value that is judged; None where it was not measured, or other frames may change its outcome."""
        value = self.measure(table)
        if value is None or not table.is_of_one_frame or self.of_one_frame == "known":
            return value
        return value if self.of_one_frame == "bounded" and self.outcome(value) != "accept" else None


def worst_outcome(outcomes: Iterable[Outcome]) -> Outcome:
    """Return the worst of some outcomes; of none, that all is accepted."""
    return OUTCOMES[max((OUTCOMES.index(outcome) for outcome in outcomes), default=0)]


def format_value(value: float, unit: str) -> str:
    """Return a value for people: shares as per cent, three significant digits, two of an angle.

    `unit` is that of `Figure.unit`. What no limit tells from nothing is 0.
    """
    if abs(value) < _SMALL:
        value = 0.0
    if unit == "share":
        return f"{100 * value:.3g} %"
    if unit == "°":
        return f"{value:.2g}°"
    return f"{value:.3g} {unit}".strip() if abs(value) < _LARGE else f"{value:.0f} {unit}".strip()
