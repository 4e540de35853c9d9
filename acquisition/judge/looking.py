"""What is found of a frame: its checks in their order, its light, and which parts of it deviate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from acquisition.judge.checks.evenness import judge_evenness
from acquisition.judge.checks.files import judge_file
from acquisition.judge.checks.lights import judge_light
from acquisition.judge.checks.movement import UNTOLD_PX, best_channel, has_moved_far, judge_movement
from acquisition.judge.checks.references import judge_dark, judge_first_primary, judge_white
from acquisition.judge.known.basis import FrameLight
from acquisition.judge.known.knowledge import Knowledge, Leaning, is_brightest_grey, primary_of
from acquisition.judge.measured.anchor import Anchor
from acquisition.judge.measured.frame import Frame
from acquisition.judge.measured.measuring import measure
from drivers.raw.rawfile import Mosaic
from experiment.chart.model import Chart
from experiment.config import LabSettings
from experiment.framing.planes import phases
from experiment.session.plan import REFERENCES, SessionStep
from experiment.session.records import Check
from foundation.errors import RegistrationError

_UNFOUNDED = (
    "no frame of each primary, or none of black, is accepted, from which it is known what this light should look like; "
    "see why those were refused"
)


@dataclass(frozen=True, eq=False)
class Looked:
    """What was found of a frame: checks, light, tiles that deviate, brightness."""

    frame: Frame
    checks: tuple[Check, ...]
    light: FrameLight | None = None
    off: npt.NDArray[np.bool_] | None = None
    brightness: float = float("nan")
    stepped: bool = False
    leaning: Leaning = field(default_factory=Leaning)


def look(
    known: Knowledge,
    mosaic: Mosaic,
    black: npt.NDArray[np.float64],
    step: SessionStep,
    settings: LabSettings,
    chart: Chart | None,
    plan: Sequence[tuple[int, int, int]],
) -> Looked:
    """Return what is found of a frame of a step.

    `mosaic`, `black`: the frame and its black level, (2, 2) float64 counts. `chart`: the print before the camera; None
    where none is looked for.
    """
    measured = measure(mosaic, black)
    frame = Frame(measured, np.full(3, np.nan), UNTOLD_PX)
    checks = [*judge_file(known, mosaic, measured, step, settings)]
    if any(check.reason for check in checks):
        return Looked(frame, tuple(checks))
    if known.awaits_primaries and (step.kind == "light" or (step.kind == "response" and not is_compared(step))):
        return Looked(frame, (*checks, Check("light", reason=_UNFOUNDED)))
    anchor = known.anchor
    if step.kind != "dark" and (anchor is None or (known.rested and has_moved_far(known, mosaic, black, measured))):
        # The first lit frame is white; of a run taken up again it is the first in which the chart lies elsewhere.
        try:
            anchor = Anchor.of(mosaic, black, chart)
        except RegistrationError as error:
            return Looked(frame, (*checks, Check("chart", reason=str(error))))
        checks.append(Check("chart", float(len(anchor.framing.tags) or len(anchor.paper))))
        moved = None if known.anchor is None else known.anchor.displacement(mosaic, black, best_channel(measured)[0])
        if moved is not None:
            checks.append(Check("movement", round(float(np.hypot(*moved)), 3), None, None, "px"))
        known = replace(known, basis=None) if known.anchor is not None else known
        frame = replace(frame, anchor=anchor, moved_px=np.zeros(2))
    if anchor is not None:
        frame = replace(frame, paper=anchor.paper_level(mosaic, black, phases(mosaic)))
    if step.kind == "dark":
        dark = judge_dark(known, measured, settings.judge.dark_percent, settings.judge.ambient_percent)
        light = None if known.basis is None else known.basis.light(measured)
        return Looked(frame, (*checks, *dark), light)
    if frame.anchor is None and anchor is not None:
        movement, moved = judge_movement(known, anchor, mosaic, black, frame, settings.judge)
        checks += movement
        frame = replace(frame, moved_px=moved)
    looked = _look_at_light(known, frame, step, settings, plan)
    if step.kind == "white":
        checks.append(judge_white(known.first_white, frame))
    if is_brightest_grey(step):
        checks.append(judge_white(known.first_grey, frame))
    return replace(looked, checks=(*checks, *looked.checks))


def _look_at_light(
    known: Knowledge, frame: Frame, step: SessionStep, settings: LabSettings, plan: Sequence[tuple[int, int, int]]
) -> Looked:
    """Return what is found of the light of a lit frame, and of its evenness."""
    measured = frame.measured
    primary = primary_of(step.colour.codes) if step.kind == "response" else None
    checks: list[Check] = []
    if primary is not None and not known.modelled:
        checks.append(judge_first_primary(known, measured, primary))
    if known.basis is None:
        return Looked(frame, tuple(checks))
    light = known.basis.light(measured)
    if not known.modelled and step.kind == "response":
        # A primary alone is not what the camera's colours under white describe.
        return Looked(frame, tuple(checks), light)
    moved = frame.moved_px if not np.isnan(frame.moved_px).any() else known.moved_px
    before = known.recent[-1] if known.recent else None
    evenness = judge_evenness(known.basis, light, measured, np.zeros(2) if moved is None else moved, before)
    judge = settings.judge
    verdict = judge_light(known, step, light, plan, judge.light_deg, judge.drift_percent)
    checks += [*evenness.checks, *verdict.checks]
    if step.kind == "white" and known.modelled:
        checks.append(Check("additivity", round(100 * known.model.overlap, 2), None, None, "%"))
    return Looked(frame, tuple(checks), light, evenness.off, verdict.brightness, verdict.stepped, verdict.leaning)


def is_compared(step: SessionStep) -> bool:
    """Return whether later frames are held against the frame of a step, so that all of it is kept."""
    return step.kind in REFERENCES or (step.kind == "response" and primary_of(step.colour.codes) is not None)
