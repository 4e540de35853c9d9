"""Whether a table may be used: figures against their limits, why one is beyond, what to take again, all in words.

Judging is a pure function of values. A value that could not be measured is not judged. Taken again are frames that are
beyond a refusing limit by themselves, and those that are a cause; what all frames share is not mended so. All that
differs from figure to figure stands in the figure (`calibration.figures`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibration.causes.gathering import PrintPlace
from calibration.causes.rules import UNKNOWN, Decision, Evidence, decide
from calibration.figures.all_figures import BY_NAME, FIGURES
from calibration.figures.figure import Figure, Outcome, worst_outcome
from calibration.measurements import TableMeasurements
from experiment.session.records import FrameRecord
from experiment.session.repair import lights_text
from foundation.errors import counted, first_few

COMMAND = "acquire run LAB.toml SESSION --retake bad"  # What takes frames again, as the report names them

_THEN = "what else is refused may follow from these, else take the session anew"


@dataclass(frozen=True)
class JudgedValue:
    """One measured value, its figure, and what follows."""

    figure: Figure
    value: float
    outcome: Outcome

    @property
    def measured(self) -> str:
        """The value for people."""
        return self.figure.text(self.value)

    def text(self) -> str:
        """Return value, expectation and consequence, for a line of text."""
        figure = self.figure
        refused = "" if figure.refuse is None else f", refused beyond {figure.text(figure.refuse)}"
        return f"{figure.title}: {self.measured}, {figure.expected} expected{refused}; {figure.why}"


@dataclass(frozen=True)
class Verdict:
    """The judgement on a table, value by value."""

    rows: tuple[JudgedValue, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst of the rows."""
        return worst_outcome(row.outcome for row in self.rows)

    @property
    def refused(self) -> tuple[JudgedValue, ...]:
        """The rows for which no table is made."""
        return tuple(row for row in self.rows if row.outcome == "refuse")

    @property
    def remarks(self) -> tuple[JudgedValue, ...]:
        """The rows beyond what is expected, with which a table is made all the same."""
        return tuple(row for row in self.rows if row.outcome == "accept with remarks")


@dataclass(frozen=True, eq=False)
class BuildResult:
    """A table, or a check, as measured and judged.

    - `lut`: the table's folder; None after a check.
    """

    figures: TableMeasurements
    verdict: Verdict
    lut: Path | None


@dataclass(frozen=True)
class ProbableCause:
    """Why a figure is beyond its limit.

    - `decision`: the cause, and the rule that says so.
    - `frames`: the frames in which it shows, the worst first; empty where all share it.
    """

    figure: str
    decision: Decision
    evidence: Evidence
    frames: tuple[FrameRecord, ...]
    places: tuple[PrintPlace, ...]

    @property
    def is_known(self) -> bool:
        """Whether a cause is named."""
        return self.decision.cause is not UNKNOWN

    @property
    def is_of_frames(self) -> bool:
        """Whether it is mended by taking the frames named again."""
        return self.decision.cause.mends == "frames" and bool(self.frames)


def judged_values(table: TableMeasurements) -> dict[str, float]:
    """Return the values that are judged, by the names of their figures; without those that are not known."""
    values = ((figure.name, figure.judged_value(table)) for figure in FIGURES)
    return {name: value for name, value in values if value is not None}


def judge(values: Mapping[str, float], figures: Sequence[Figure] = FIGURES) -> Verdict:
    """Return the verdict on values by name; a figure whose value is missing is passed over."""
    known = ((figure, values[figure.name]) for figure in figures if figure.name in values)
    return Verdict(tuple(JudgedValue(figure, value, figure.outcome(value)) for figure, value in known))


def explain(figure: Figure, table: TableMeasurements) -> ProbableCause | None:
    """Return why a figure is beyond its limit; None for one that explains itself, such as the size of a cell."""
    gathered = None if figure.cause is None else figure.cause.gather(table, figure.accept)
    if figure.cause is None or gathered is None:
        return None
    decision = decide(figure.cause.about, gathered.evidence)
    found = ProbableCause(figure.name, decision, gathered.evidence, gathered.frames, gathered.places)
    return found if found.is_known else _as_another(found, figure.cause.follows, table)


def _as_another(unknown: ProbableCause, follows: Sequence[str], table: TableMeasurements) -> ProbableCause:
    """Return a finding with the cause of a figure that it goes with, in the same frames; as it is where there is none.

    What lies on the print in a frame spreads its cells; a light that bears another's name has another's brightness.
    """
    for name in follows:
        main = explain(BY_NAME[name], table)
        if main is None or not main.is_known or not main.frames:
            continue
        own, others = ({frame.sha256 for frame in finding.frames} for finding in (unknown, main))
        if own and own <= others:
            decision = replace(main.decision, follows=name)
            return replace(unknown, decision=decision, evidence=main.evidence, places=unknown.places or main.places)
    return unknown


def findings(verdict: Verdict, table: TableMeasurements) -> dict[str, ProbableCause]:
    """Return what each row beyond its limit is probably caused by, by the name of its figure."""
    explained = (explain(row.figure, table) for row in (*verdict.refused, *verdict.remarks))
    return {found.figure: found for found in explained if found is not None}


def retake_command(records: Sequence[FrameRecord]) -> str:
    """Return the command that takes frames again: by the lights' numbers, or by the report where one is a reference."""
    lights = [record.illumination for record in records if record.kind == "light"]
    numbers = [light for light in lights if light is not None]
    return COMMAND if len(numbers) < len(records) else COMMAND.replace("bad", lights_text(numbers))


def retaken_frames(verdict: Verdict, table: TableMeasurements) -> tuple[FrameRecord, ...]:
    """Return the frames to be taken again, in the order taken."""
    found = findings(verdict, table)
    named = {frame.sha256 for row in verdict.refused for frame in _frames_of(row, table, found) or ()}
    for finding in found.values():
        if finding.is_of_frames:
            named |= {frame.sha256 for frame in finding.frames}
    # Dark frames have no figures among the others; only where they come from can be refused.
    foreign = [frame.record for frame in (*table.origins.other_camera, *table.origins.other_exposure)]
    records = [*(frame.record for frame in table.frames), *(record for record in foreign if record.kind == "dark")]
    return tuple(sorted((record for record in records if record.sha256 in named), key=lambda record: record.attempt))


def is_mended_by_retaking(verdict: Verdict, table: TableMeasurements) -> bool:
    """Return whether each refusal is of single frames, so that a table could be made once these are taken again."""
    found = findings(verdict, table)
    return bool(verdict.refused) and all(
        _frames_of(row, table, found) or (row.figure.name in found and found[row.figure.name].is_of_frames)
        for row in verdict.refused
    )


def retake_json(records: tuple[FrameRecord, ...], registered_sha256: str, newest_sha256: str) -> dict[str, Any]:
    """Return what `acquire run --retake bad` reads of a report (docs/formats.md)."""
    return {
        "retake": lights_text([record.illumination for record in records if record.illumination is not None]),
        "retake_sha256": [record.sha256 for record in records],
        "registered_sha256": registered_sha256,
        "newest_sha256": newest_sha256,
    }


def _frames_of(
    row: JudgedValue, table: TableMeasurements, found: Mapping[str, ProbableCause]
) -> list[FrameRecord] | None:
    """Return the frames that are beyond a row's refusing limit.

    None where its value is not of single frames, or has a cause that would be in them again.
    """
    figure, finding = row.figure, found.get(row.figure.name)
    if finding is not None and finding.is_known and finding.decision.cause.mends != "frames":
        return None
    return None if figure.refuse is None or figure.retake is None else figure.retake(table, figure.refuse)


def refusal(verdict: Verdict, table: TableMeasurements, *, reported: bool = False) -> str:
    """Return why there is no table and what helps, in a line; of the first of the verdict's refused rows."""
    found = findings(verdict, table)
    # What is explained explains more than what comes first.
    known = [row for row in verdict.refused if row.figure.name in found and found[row.figure.name].is_known]
    foremost = [row for row in verdict.refused if row.figure.foremost]
    worst = (*foremost, *known, *verdict.refused)[0]
    more = f" (and {len(verdict.refused) - 1} more)" if len(verdict.refused) > 1 else ""
    detail, remedy = detail_and_remedy(worst.figure, table)
    finding = found.get(worst.figure.name)
    if finding is not None and finding.is_known:
        remedy = finding.decision.cause.remedy
    what, frames = "take the session anew", retaken_frames(verdict, table)
    command = COMMAND if reported else retake_command(frames)
    if frames and (reported or command != COMMAND):
        again = f"take {counted(len(frames), 'frame')} again"
        mended = is_mended_by_retaking(verdict, table)
        what = f"{again}: {command}" if mended else f"{again} first ({command}); {_THEN}"
    return f"{_with_place(worst, table)}{detail}{more}; {_cause_text(finding)}{remedy}, and {what}"


def remark(row: JudgedValue, table: TableMeasurements) -> str:
    """Return a row that is remarked on: value, expectation, place, cause, remedy and command, in a line."""
    finding, again = explain(row.figure, table), ""
    detail, remedy = detail_and_remedy(row.figure, table)
    if finding is not None and finding.is_known:
        remedy = finding.decision.cause.remedy
        if finding.is_of_frames:
            again = f", and take {counted(len(finding.frames), 'frame')} again: {retake_command(finding.frames)}"
    return f"{_with_place(row, table)}{detail}; {_cause_text(finding)}{remedy}{again}"


def detail_and_remedy(figure: Figure, table: TableMeasurements) -> tuple[str, str]:
    """Return what is added to a figure's value beyond a limit, "" where nothing is, and its remedy."""
    found = None if figure.found is None else figure.found(table)
    return ("", figure.remedy) if found is None else found


def _cause_text(finding: ProbableCause | None) -> str:
    """Return the probable cause and why, before a remedy; that it is unknown, where it was asked for."""
    if finding is None:
        return ""
    decision = finding.decision
    if decision.rule is None:
        return "the cause is not known from what was measured; it may help to "
    # What it goes with says why.
    why = "" if decision.follows else f" ({decision.rule.why})"
    return f"probably {decision.cause.says}{why}; "


def _with_place(row: JudgedValue, table: TableMeasurements) -> str:
    """Return a value against its limit, and where the worst of it is."""
    place = place_of(row.figure, table)
    return f"{row.text()}, {place}" if place else row.text()


def place_of(figure: Figure, table: TableMeasurements) -> str:
    """Return the frames, lights or place of a figure that is beyond its limit; "" if it has none."""
    return places_text(explain(figure, table)) if figure.where is None else figure.where(table, figure.accept)


def places_text(finding: ProbableCause | None) -> str:
    """Return the frames and the place on the print of a finding; "" where it has neither."""
    if finding is None:
        return ""
    files = [frame.file for frame in finding.frames]
    described = [f"in {first_few(files)}"] if files else []
    if finding.places:
        place = finding.places[0]
        described.append(f"about {place.x_mm:.0f}, {place.y_mm:.0f} mm from the sheet's top-left corner")
        if place.size_mm > 0:
            described.append(f"{place.size_mm:.0f} mm across")
        if not files:
            described[0] = f"seen in {place.file} {described[0]}"
    return ", ".join(described)
