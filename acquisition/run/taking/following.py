"""What a run says of accepted frames that show a change it follows: a chart that moved, another level of the lamp."""

from __future__ import annotations

from collections.abc import Sequence

from acquisition.run.taking.agenda import step_name
from experiment.config import JudgeSettings
from experiment.session.plan import SessionStep
from experiment.session.records import Check, Judgement


def followed_changes(
    step: SessionStep, judgement: Judgement, steps: Sequence[SessionStep], judge: JudgeSettings
) -> list[tuple[str, str]]:
    """Return what a run's reports say of an accepted frame: words (``moved``, ``level``), each with a sentence."""
    found = {check.name: check for check in judgement.checks if check.value is not None}
    said: list[tuple[str, str]] = []
    moved = found.get("movement")
    if moved is not None and (moved.value or 0) > judge.moved_px:
        said.append(
            (
                "moved",
                f"{step_name(step)}: the chart lies {moved.value:.2f} px from where it was; the run goes on with its "
                "new place, and build-lut follows it with a remark. Fix camera and print; to have all lights of one "
                "place, begin a new session",
            )
        )
    lamp = found.get("lamp")
    if lamp is not None and _is_followed(lamp, step, steps, judge):
        percent = lamp.value or 0.0
        more = "stronger" if percent > 0 else "weaker"
        said.append(
            (
                "level",
                f"{step_name(step)}: the light is {abs(percent):.1f} % {more} than in the frames before; the run goes "
                "on at the new level, and build-lut follows it by the white frames",
            )
        )
    return said


def _is_followed(lamp: Check, step: SessionStep, steps: Sequence[SessionStep], judge: JudgeSettings) -> bool:
    """Return whether a lamp's level is that of a step: small ones shown twice, any in frames that tie two halves."""
    # Frames that tie have wide limits: everything may have changed.
    ties = step.kind == "response" and any(one.kind == "light" and one.number < step.number for one in steps)
    return lamp.is_beyond or (ties and abs(lamp.value or 0) > judge.drift_percent)
