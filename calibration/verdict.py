"""Judge a LUT: compare its figures with their limits, explain values beyond a limit, and select frames to take again.

The verdict depends only on the values. A value that could not be measured is not judged. A frame is selected if its
value exceeds the limit of refusal, or if it causes a value beyond a limit. If all frames have the same fault, none is
selected, because new frames would have it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibration.causes.gathering import PrintPosition
from calibration.causes.rules import UNKNOWN, Decision, Evidence, decide
from calibration.figures.all_figures import BY_NAME, FIGURES
from calibration.figures.figure import Figure, Outcome, worst_outcome
from calibration.measurements import TableMeasurements
from experiment.session.records import FrameRecord
from experiment.session.repair import lights_text
from foundation.errors import counted, first_few

COMMAND = "acquire run LAB.toml SESSION --retake bad"  # Repeats the frames listed in the report

_IF_REFUSED = "if the LUT is still refused, take the session again"


@dataclass(frozen=True)
class JudgedValue:
    """One measured value with its figure and outcome."""

    figure: Figure
    value: float
    outcome: Outcome

    @property
    def measured(self) -> str:
        """The value with its unit."""
        return self.figure.text(self.value)

    def text(self) -> str:
        """Return value, accepted range and consequence in one line."""
        figure = self.figure
        side = "above" if figure.sense == "at most" else "below"
        refusal = "" if figure.refuse is None else f", refused {side} {figure.text(figure.refuse)}"
        return f"{figure.title}: {self.measured}, expected {figure.expected}{refusal}; {figure.why}"


@dataclass(frozen=True)
class Verdict:
    """Judged values of a LUT."""

    rows: tuple[JudgedValue, ...]

    @property
    def outcome(self) -> Outcome:
        """The worst outcome."""
        return worst_outcome(row.outcome for row in self.rows)

    @property
    def refused(self) -> tuple[JudgedValue, ...]:
        """Values for which the LUT is refused."""
        return tuple(row for row in self.rows if row.outcome == "refuse")

    @property
    def remarks(self) -> tuple[JudgedValue, ...]:
        """Values beyond the accepted limit, but not beyond the limit of refusal."""
        return tuple(row for row in self.rows if row.outcome == "accept with remarks")


@dataclass(frozen=True, eq=False)
class BuildResult:
    """Measurements and verdict of a LUT or a check."""

    figures: TableMeasurements
    verdict: Verdict
    lut: Path | None  # The LUT's folder; None after a check


@dataclass(frozen=True)
class ProbableCause:
    """Cause of a figure beyond its limit."""

    figure: str  # Name of the figure
    decision: Decision  # The cause, and the rule that applied
    evidence: Evidence
    frames: tuple[FrameRecord, ...]  # Frames that show the cause, the worst first; empty if all frames show it
    positions: tuple[PrintPosition, ...]

    @property
    def is_known(self) -> bool:
        """True if a rule applied."""
        return self.decision.cause is not UNKNOWN

    @property
    def is_of_frames(self) -> bool:
        """True if it is sufficient to repeat the listed frames."""
        return self.decision.cause.repeats == "frames" and bool(self.frames)


def judged_values(table: TableMeasurements) -> dict[str, float]:
    """Return the values to judge by figure name, without those that are unknown."""
    values = ((figure.name, figure.judged_value(table)) for figure in FIGURES)
    return {name: value for name, value in values if value is not None}


def judge(values: Mapping[str, float], figures: Sequence[Figure] = FIGURES) -> Verdict:
    """Return the verdict on values by figure name; figures without a value are skipped."""
    measured = ((figure, values[figure.name]) for figure in figures if figure.name in values)
    return Verdict(tuple(JudgedValue(figure, value, figure.outcome(value)) for figure, value in measured))


def explain(figure: Figure, table: TableMeasurements) -> ProbableCause | None:
    """Return the cause of a figure beyond its limit; None without evidence, or if the figure has only one cause."""
    gathered = None if figure.cause is None else figure.cause.gather(table, figure.accept)
    if figure.cause is None or gathered is None:
        return None
    decision = decide(figure.cause.about, gathered.evidence)
    cause = ProbableCause(figure.name, decision, gathered.evidence, gathered.frames, gathered.positions)
    return cause if cause.is_known else _shared_cause(cause, figure.cause.follows, table)


def _shared_cause(unknown: ProbableCause, follows: Sequence[str], table: TableMeasurements) -> ProbableCause:
    """Return the known cause of a related figure if it has the same frames; else the unknown cause.

    `follows`: names of the related figures.
    """
    # For example, an object on the print in a frame also increases the scatter of the frame's patches.
    for name in follows:
        related = explain(BY_NAME[name], table)
        if related is None or not related.is_known or not related.frames:
            continue
        own_frames, related_frames = ({frame.sha256 for frame in cause.frames} for cause in (unknown, related))
        if own_frames and own_frames <= related_frames:
            decision = replace(related.decision, follows=name)
            positions = unknown.positions or related.positions
            return replace(unknown, decision=decision, evidence=related.evidence, positions=positions)
    return unknown


def findings(verdict: Verdict, table: TableMeasurements) -> dict[str, ProbableCause]:
    """Return the probable cause of each value beyond its accepted limit, by figure name."""
    explained = (explain(row.figure, table) for row in (*verdict.refused, *verdict.remarks))
    return {cause.figure: cause for cause in explained if cause is not None}


def retake_command(records: Sequence[FrameRecord]) -> str:
    """Return the command that repeats frames: with their numbers if all show illuminants, else with `bad`."""
    lights = [record.illumination for record in records if record.kind == "light"]
    numbers = [light for light in lights if light is not None]
    return COMMAND if len(numbers) < len(records) else COMMAND.replace("bad", lights_text(numbers))


def retaken_frames(verdict: Verdict, table: TableMeasurements) -> tuple[FrameRecord, ...]:
    """Return the frames to repeat, in the order of their attempts."""
    causes = findings(verdict, table)
    hashes = {frame.sha256 for row in verdict.refused for frame in _frames_beyond(row, table, causes) or ()}
    for cause in causes.values():
        if cause.is_of_frames:
            hashes |= {frame.sha256 for frame in cause.frames}
    # A dark frame is repeated only if its camera or exposure differs from the other frames.
    foreign = [frame.record for frame in (*table.origins.other_camera, *table.origins.other_exposure)]
    records = [*(frame.record for frame in table.frames), *(record for record in foreign if record.kind == "dark")]
    return tuple(sorted((record for record in records if record.sha256 in hashes), key=lambda record: record.attempt))


def is_mended_by_retaking(verdict: Verdict, table: TableMeasurements) -> bool:
    """Return True if every refused value concerns single frames, so that new frames make a LUT possible."""
    causes = findings(verdict, table)
    return bool(verdict.refused) and all(
        _frames_beyond(row, table, causes) or (row.figure.name in causes and causes[row.figure.name].is_of_frames)
        for row in verdict.refused
    )


def retake_json(records: tuple[FrameRecord, ...], registered_sha256: str, newest_sha256: str) -> dict[str, Any]:
    """Return the part of a report that `acquire run --retake bad` reads (docs/formats.md)."""
    return {
        "retake": lights_text([record.illumination for record in records if record.illumination is not None]),
        "retake_sha256": [record.sha256 for record in records],
        "registered_sha256": registered_sha256,
        "newest_sha256": newest_sha256,
    }


def _frames_beyond(
    row: JudgedValue, table: TableMeasurements, causes: Mapping[str, ProbableCause]
) -> list[FrameRecord] | None:
    """Return the frames whose value is beyond the limit of refusal.

    None if the value does not concern single frames, or if new frames would have the same fault.
    """
    figure, cause = row.figure, causes.get(row.figure.name)
    if cause is not None and cause.is_known and cause.decision.cause.repeats != "frames":
        return None
    return None if figure.refuse is None or figure.retake is None else figure.retake(table, figure.refuse)


def refusal(verdict: Verdict, table: TableMeasurements, *, reported: bool = False) -> str:
    """Return reason and remedy of the refusal in one line, for the most informative refused value."""
    causes = findings(verdict, table)
    # A value with a known cause is more informative than a value without.
    explained = [row for row in verdict.refused if row.figure.name in causes and causes[row.figure.name].is_known]
    foremost = [row for row in verdict.refused if row.figure.foremost]
    main_row = (*foremost, *explained, *verdict.refused)[0]
    others_text = f" (and {len(verdict.refused) - 1} more)" if len(verdict.refused) > 1 else ""
    detail, remedy = detail_and_remedy(main_row.figure, table)
    cause = causes.get(main_row.figure.name)
    if cause is not None and cause.is_known:
        remedy = cause.decision.cause.remedy
    action, frames = "take the session again", retaken_frames(verdict, table)
    command = COMMAND if reported else retake_command(frames)
    if frames and (reported or command != COMMAND):
        repeat_text = f"take {counted(len(frames), 'frame')} again"
        is_sufficient = is_mended_by_retaking(verdict, table)
        action = f"{repeat_text}: {command}" if is_sufficient else f"{repeat_text} first ({command}); {_IF_REFUSED}"
    return f"{_text_with_position(main_row, table)}{detail}{others_text}; {_cause_text(cause)}{remedy}, and {action}"


def remark(row: JudgedValue, table: TableMeasurements) -> str:
    """Return a remark in one line: value, accepted range, position, cause, remedy and command."""
    cause, repeat_text = explain(row.figure, table), ""
    detail, remedy = detail_and_remedy(row.figure, table)
    if cause is not None and cause.is_known:
        remedy = cause.decision.cause.remedy
        if cause.is_of_frames:
            repeat_text = f", and take {counted(len(cause.frames), 'frame')} again: {retake_command(cause.frames)}"
    return f"{_text_with_position(row, table)}{detail}; {_cause_text(cause)}{remedy}{repeat_text}"


def detail_and_remedy(figure: Figure, table: TableMeasurements) -> tuple[str, str]:
    """Return the text that is added to the value of a figure, or "", and the remedy."""
    detail = None if figure.detail is None else figure.detail(table)
    return ("", figure.remedy) if detail is None else detail


def _cause_text(cause: ProbableCause | None) -> str:
    if cause is None:
        return ""
    decision = cause.decision
    if decision.rule is None:
        return "cause unknown; possible remedy: "
    # If the cause was taken from a related figure, the message of that figure contains the reason.
    why = "" if decision.follows else f" ({decision.rule.why})"
    return f"probably {decision.cause.description}{why}; "


def _text_with_position(row: JudgedValue, table: TableMeasurements) -> str:
    position = position_text(row.figure, table)
    return f"{row.text()}, {position}" if position else row.text()


def position_text(figure: Figure, table: TableMeasurements) -> str:
    """Return the frames, illuminants or position of a figure beyond its limit, or ""."""
    return positions_text(explain(figure, table)) if figure.where is None else figure.where(table, figure.accept)


def positions_text(cause: ProbableCause | None) -> str:
    """Return the frames of a cause and its position on the print, or ""."""
    if cause is None:
        return ""
    files = [frame.file for frame in cause.frames]
    described = [f"in {first_few(files)}"] if files else []
    if cause.positions:
        position = cause.positions[0]
        described.append(f"about {position.x_mm:.0f}, {position.y_mm:.0f} mm from the sheet's top-left corner")
        if position.size_mm > 0:
            described.append(f"{position.size_mm:.0f} mm across")
        if not files:
            described[0] = f"visible in {position.file} {described[0]}"
    return ", ".join(described)
