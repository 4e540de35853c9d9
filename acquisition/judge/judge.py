"""Judge each frame as it is taken: what it shows, where, how sharp, and whether that is what was ordered.

Rules that hold inside:

- A frame is decoded once and measured once (`acquisition.judge.measured`); what it is compared with is one frozen
  value (`acquisition.judge.known.knowledge`), which each frame replaces.
- Every check (`acquisition.judge.checks`) has its number and its limits, also where it passes; one that cannot tell has
  no number.
- A cause is named once: what follows from it (a chart that moved does not look like its old picture) has no reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from acquisition.judge.checks.causes import is_lasting, named_once, voids_others
from acquisition.judge.checks.evenness import judge_evenness
from acquisition.judge.checks.references import MOST_RESTARTS, judge_first_frames
from acquisition.judge.known.knowledge import Examined, Knowledge
from acquisition.judge.looking import is_compared, look
from acquisition.judge.measured.frame import Frame
from drivers.raw.rawfile import read_raw
from experiment.chart.model import Chart
from experiment.config import LabSettings
from experiment.framing.pictures import preview_jpeg
from experiment.framing.planes import frame_black
from experiment.lights import Illumination
from experiment.session.plan import REFERENCES, SessionStep
from experiment.session.records import Check, Judgement
from foundation.errors import FormatError

_BESIDE = "it was under way when the frames before it were found to contradict each other; they are taken again first"


class LiveJudge:
    """Judges the frames of a session as they come: `experiment.session.records.FrameJudge`."""

    def __init__(self, settings: LabSettings, chart: Chart, illuminations: Sequence[Illumination]) -> None:
        self._settings = settings
        self._chart = chart if settings.judge.chart else None
        self._plan = tuple(dict.fromkeys(light.codes for light in illuminations))
        self._known = self._base = Knowledge()
        self._fresh = True

    @property
    def knowledge(self) -> Knowledge:
        """What is known so far."""
        return self._known

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Take in a frame of an earlier run; see `experiment.session.records.FrameJudge.recall`."""
        frame = Frame.of_bytes(measurement) if measurement else None
        if frame is None:
            lost = accepted and step.kind in ("white", "dark")
            self._known = replace(self._known, lost=self._known.lost or lost)
            return
        light = None if self._known.basis is None else self._known.basis.light(frame.measured)
        self._known = self._known.after(step, Examined(frame, light, accepted))

    def after_pause(self) -> None:
        """Take in that lamp and chart may have changed; see `experiment.session.records.OutlastsPauses`."""
        self._known = self._base = self._known.paused()
        self._fresh = False

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return what is said of a raw file; see `experiment.session.records.FrameJudge.judge`."""
        if self._fresh:
            self.after_pause()
        expected, self._known = self._known.expected, replace(self._known, expected=None)
        if expected not in (None, step.number):
            return Judgement.of_reason("light", _BESIDE)
        try:
            mosaic = read_raw(file)
        except FormatError as error:
            return Judgement.of_reason("file", str(error))
        black = frame_black(mosaic)
        known = self._known
        looked = look(known, mosaic, black, step, self._settings, self._chart, self._plan)
        checks = named_once(looked.checks)
        cause = next((check for check in checks if check.reason), None)
        found = Examined(
            looked.frame,
            looked.light,
            cause is None,
            cause.name if cause else "",
            looked.brightness,
            looked.stepped,
            looked.leaning,
        )
        following = known.after(step, found)
        disagreeing = _judge_basis(known, following) or judge_first_frames(known, step, cause, self._settings.judge)
        if disagreeing is not None:
            checks = (*(check for check in checks if check.name != disagreeing.name), disagreeing)
            cause = disagreeing
            following = known.after(step, replace(found, accepted=False, cause=cause.name)).begun_anew(self._base)
        self._known = following
        if cause is None:
            untold = {check.name for check in checks if check.value is None and check.name in ("movement", "blur")}
            self._known = replace(self._known, untold=self._known.untold | untold)
        white = _shown_white(known, looked.frame)
        places = looked.frame.measured.places
        boxes = [] if looked.off is None else [places.tile_box(tile) for tile in np.flatnonzero(looked.off).tolist()]
        outlines = () if self._known.anchor is None else self._known.anchor.outlines
        paper = looked.frame.paper
        red, green, blue = paper.tolist()
        lasting = cause is not None and is_lasting(self._known, step, cause.name)
        if disagreeing is not None:
            lasting = self._known.restarts > MOST_RESTARTS
        return Judgement(
            checks=checks,
            seen=None if np.isnan(paper).any() else (red, green, blue),
            measurement=looked.frame.to_bytes(with_strips=is_compared(step)),
            preview=preview_jpeg(mosaic, black, white, outlines, boxes, cause.reason if cause else ""),
            voids=disagreeing is not None
            or (cause is not None and step.kind in REFERENCES and voids_others(known, cause.name)),
            lasting=lasting,
        )


def _judge_basis(known: Knowledge, following: Knowledge) -> Check | None:
    """Return why frames of the primaries that are now known make no picture of the white or grey one; None if they do.

    Each of them alone tells nothing of a part that is covered; all that follows would be held against it.
    """
    if known.modelled or not following.modelled or known.witness is None or following.basis is None:
        return None
    witness = known.witness
    moved = np.zeros(2) if following.moved_px is None else following.moved_px
    evenness = judge_evenness(following.basis, following.basis.light(witness), witness, moved)
    if all(check.passed for check in evenness.checks):
        return None
    uneven = next((check for check in evenness.checks if check.name == "uniformity"), Check("uniformity"))
    return replace(
        uneven,
        reason="the frames of the three primaries do not add up to the white or grey frame before them everywhere; did "
        "somebody pass, or a window cover the picture? all of them are taken again",
    )


def _shown_white(known: Knowledge, frame: Frame) -> npt.NDArray[np.float64]:
    """Return what a preview shows as white: paper in the first white frame, else in this one."""
    first = frame.paper if known.first_white is None else known.first_white.paper
    return np.full(3, max(frame.measured.brightest_dn, 1.0)) if np.isnan(first).any() else np.maximum(first, 1.0)
