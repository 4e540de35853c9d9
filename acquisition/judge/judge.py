"""Judge each frame as it is taken: what it shows, where, how sharp, and whether that is what was ordered.

Rules that hold inside:

- A frame is decoded once and measured once (`acquisition.judge.measure`); what it is compared with is one frozen value
  (`acquisition.judge.state`), which each frame replaces.
- Every check (`acquisition.judge.checks`, `acquisition.judge.light_checks`) has its number and its limits, also where
  it passes; one that cannot tell has no number.
- A cause is named once: what follows from it (a chart that moved does not look like its old picture) has no reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.judge.checks import (
    MOST_RESTARTS,
    UNKNOWN_PLACE,
    best_channel,
    has_moved_far,
    is_lasting,
    judge_dark,
    judge_file,
    judge_first_frames,
    judge_first_primary,
    judge_movement,
    judge_white,
    named_once,
    voids_others,
    white_overlap,
)
from acquisition.judge.light import FrameLight
from acquisition.judge.light_checks import judge_evenness, judge_light
from acquisition.judge.measure import Anchor, Frame, measure
from acquisition.judge.state import Examined, JudgeState, LampSeen, is_brightest_grey, primary_of
from drivers.raw.rawfile import Mosaic, filled_fault, read_raw
from experiment.chart.model import Chart
from experiment.config import LabSettings
from experiment.framing.pictures import preview_jpeg
from experiment.framing.planes import frame_black, phases
from experiment.lights import Illumination
from experiment.session.records import REFERENCES, Check, Judgement, SessionStep
from foundation.errors import FormatError, RegistrationError

_BESIDE = "it was under way when the frames before it were found to contradict each other; they are taken again first"

_UNFOUNDED = (
    "no frame of each primary, or none of black, is accepted, from which it is known what this light should look like; "
    "see why those were refused"
)


@dataclass(frozen=True, eq=False)
class Findings:
    """What is found of a frame: checks, its light, tiles (T,) bool that deviate, the lamp."""

    frame: Frame
    checks: tuple[Check, ...]
    light: FrameLight | None = None
    off: npt.NDArray[np.bool_] | None = None
    lamp: LampSeen = field(default_factory=LampSeen)


class LiveJudge:
    """Judges the frames of a session as they come: `experiment.session.records.FrameJudge`."""

    def __init__(self, settings: LabSettings, chart: Chart, illuminations: Sequence[Illumination]) -> None:
        self._settings = settings
        self._chart = chart if settings.judge.chart else None
        self._plan = tuple(dict.fromkeys(light.codes for light in illuminations))
        self._state = self._base = JudgeState()
        self._fresh = True

    @property
    def state(self) -> JudgeState:
        """What is known so far."""
        return self._state

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Take in a frame of an earlier run; see `experiment.session.records.FrameJudge.recall`."""
        frame = Frame.of_bytes(measurement) if measurement else None
        if frame is None:
            lost = accepted and step.kind in ("white", "dark")
            self._state = replace(self._state, lost=self._state.lost or lost)
            return
        light = None if self._state.basis is None else self._state.basis.light(frame.measured)
        self._state = self._state.after(step, Examined(frame, light, accepted))

    def after_pause(self) -> None:
        """Take in that lamp and chart may have changed; see `experiment.session.records.OutlastsPauses`."""
        self._state = self._base = self._state.paused()
        self._fresh = False

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return what is said of a raw file; see `experiment.session.records.FrameJudge.judge`."""
        if self._fresh:
            self.after_pause()
        expected, self._state = self._state.expected, replace(self._state, expected=None)
        if expected not in (None, step.number):
            return Judgement.of_reason("light", _BESIDE)
        try:
            mosaic = read_raw(file)
        except FormatError as error:
            return Judgement.of_reason("file", str(error))
        fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
        if fault is not None:
            return Judgement.of_reason("data", f"{file}: {fault}")
        before, black = self._state, frame_black(mosaic)
        found = self._look(mosaic, black, step)
        checks = named_once(found.checks)
        cause = next((check for check in checks if check.reason), None)
        examined = Examined(found.frame, found.light, cause is None, cause.name if cause else "", found.lamp)
        self._state = before.after(step, examined)
        odd = _judge_basis(before, self._state) or judge_first_frames(before, step, cause, self._settings.judge)
        if odd is not None:
            checks, cause = (*(check for check in checks if check.name != odd.name), odd), odd
            refused = before.after(step, replace(examined, accepted=False, cause=odd.name))
            self._state = refused.begun_anew(self._base)
        if cause is None:
            untold = {check.name for check in checks if check.value is None and check.name in ("movement", "blur")}
            self._state = replace(self._state, untold=self._state.untold | untold)
            voids = lasting = False
        elif odd is not None:
            voids, lasting = True, self._state.restarts > MOST_RESTARTS
        else:
            voids = step.kind in REFERENCES and voids_others(before, cause.name)
            lasting = is_lasting(self._state, step, cause.name)
        return Judgement(
            checks=checks,
            seen=_seen(found.frame.paper),
            measurement=found.frame.to_bytes(with_strips=is_compared(step)),
            preview=self._preview(mosaic, black, before, found, cause),
            voids=voids,
            lasting=lasting,
        )

    def _look(self, mosaic: Mosaic, black: npt.NDArray[np.float64], step: SessionStep) -> Findings:
        """Return what is found of a frame of a step; `black` (2, 2) float64 counts is its black level."""
        state, settings = self._state, self._settings
        measured = measure(mosaic, black)
        frame = Frame(measured, np.full(3, np.nan), UNKNOWN_PLACE)
        checks = [*judge_file(state, mosaic, measured, step, settings)]
        if any(check.reason for check in checks):
            return Findings(frame, tuple(checks))
        if state.awaits_primaries and (step.kind == "light" or (step.kind == "response" and not is_compared(step))):
            return Findings(frame, (*checks, Check("light", reason=_UNFOUNDED)))
        anchor = state.anchor
        if step.kind != "dark" and (anchor is None or (state.rested and has_moved_far(state, mosaic, black, measured))):
            # The first lit frame is white; of a run taken up again it is the first in which the chart lies elsewhere.
            try:
                anchor = Anchor.of(mosaic, black, self._chart)
            except RegistrationError as error:
                return Findings(frame, (*checks, Check("chart", reason=str(error))))
            checks.append(Check("chart", float(len(anchor.framing.tags) or len(anchor.paper))))
            if state.anchor is not None:
                moved = state.anchor.displacement(mosaic, black, best_channel(measured)[0])
                if moved is not None:
                    checks.append(Check("movement", round(float(np.hypot(*moved)), 3), None, None, "px"))
                state = replace(state, basis=None)
            frame = replace(frame, anchor=anchor, moved_px=np.zeros(2))
        if anchor is not None:
            frame = replace(frame, paper=anchor.paper_level(mosaic, black, phases(mosaic)))
        if step.kind == "dark":
            dark = judge_dark(state, measured, settings.judge.dark_percent, settings.judge.ambient_percent)
            light = None if state.basis is None else state.basis.light(measured)
            return Findings(frame, (*checks, *dark), light)
        if frame.anchor is None and anchor is not None:
            movement, place = judge_movement(state, anchor, mosaic, black, frame, settings.judge)
            checks += movement
            frame = replace(frame, moved_px=place)
        if step.kind == "white":
            checks.append(judge_white(state.first_white, frame))
        if is_brightest_grey(step):
            checks.append(judge_white(state.first_grey, frame))
        of_light = self._look_at_light(state, frame, step)
        return replace(of_light, checks=(*checks, *of_light.checks))

    def _look_at_light(self, state: JudgeState, frame: Frame, step: SessionStep) -> Findings:
        """Return what is found of the light of a lit frame, and of its evenness."""
        measured = frame.measured
        primary = primary_of(step.colour.codes) if step.kind == "response" else None
        checks: list[Check] = []
        if primary is not None and not state.modelled:
            checks.append(judge_first_primary(state, measured, primary))
        if state.basis is None:
            return Findings(frame, tuple(checks))
        light = state.basis.light(measured)
        if not state.modelled and step.kind == "response":
            # A primary alone is not what the camera's colours under white describe.
            return Findings(frame, tuple(checks), light)
        moved = frame.moved_px if not np.isnan(frame.moved_px).any() else state.moved_px
        before = state.recent[-1] if state.recent else None
        evenness, off = judge_evenness(state.basis, light, measured, np.zeros(2) if moved is None else moved, before)
        judge = self._settings.judge
        of_light, lamp = judge_light(state, step, light, self._plan, judge.light_deg, judge.drift_percent)
        checks += [*evenness, *of_light]
        if step.kind == "white" and state.modelled:
            checks.append(white_overlap(state))
        return Findings(frame, tuple(checks), light, off, lamp)

    def _preview(
        self,
        mosaic: Mosaic,
        black: npt.NDArray[np.float64],
        before: JudgeState,
        found: Findings,
        cause: Check | None,
    ) -> bytes:
        """Return the frame as JPEG, paper of the first white frame as white, with the chart and what deviates."""
        frame = found.frame
        first = frame.paper if before.first_white is None else before.first_white.paper
        white = np.maximum(first, 1.0)
        if np.isnan(first).any():
            white = np.full(3, max(frame.measured.brightest_dn, 1.0))
        places = frame.measured.places
        boxes = [] if found.off is None else [places.tile_box(tile) for tile in np.flatnonzero(found.off).tolist()]
        outlines = () if self._state.anchor is None else self._state.anchor.outlines
        return preview_jpeg(mosaic, black, white, outlines, boxes, cause.reason if cause else "")


def is_compared(step: SessionStep) -> bool:
    """Return whether later frames are held against the frame of a step, so that all of it is kept."""
    return step.kind in REFERENCES or (step.kind == "response" and primary_of(step.colour.codes) is not None)


def _seen(paper: npt.NDArray[np.float64]) -> tuple[float, float, float] | None:
    red, green, blue = paper.tolist()
    return None if np.isnan(paper).any() else (red, green, blue)


def _judge_basis(state: JudgeState, following: JudgeState) -> Check | None:
    """Return why frames of the primaries that are now known make no picture of the white or grey one; None if they do.

    Each of them alone tells nothing of a part that is covered; all that follows would be held against it.
    """
    if state.modelled or not following.modelled or state.witness is None or following.basis is None:
        return None
    moved = np.zeros(2) if following.moved_px is None else following.moved_px
    checks, _ = judge_evenness(following.basis, following.basis.light(state.witness), state.witness, moved)
    if all(check.passed for check in checks):
        return None
    uneven = next((check for check in checks if check.name == "uniformity"), Check("uniformity"))
    return replace(
        uneven,
        reason="the frames of the three primaries do not add up to the white or grey frame before them everywhere; did "
        "somebody pass, or a window cover the picture? all of them are taken again",
    )
