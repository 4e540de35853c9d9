"""Whether the chart lies where it lay, and is as sharp."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from acquisition.judge import limits
from acquisition.judge.known.knowledge import Knowledge
from acquisition.judge.measured.anchor import Anchor
from acquisition.judge.measured.frame import Frame
from acquisition.judge.measured.measuring import Measured
from drivers.raw.rawfile import Mosaic
from experiment.config import JudgeSettings
from experiment.framing.planes import CHANNELS, Channel
from experiment.session.records import Check

UNTOLD_PX: npt.NDArray[np.float64] = np.full(2, np.nan)
"""Place of a chart in a frame that is too dark to tell."""

_UNRECOGNISED = (
    "the chart is not recognised where it was: it is covered, out of focus, or has moved by more than its tags show; "
    "look at the picture, and put camera and chart back"
)


def best_channel(measured: Measured) -> tuple[Channel, float]:
    """Return the channel with the best signal to noise, and its mean level, counts above black."""
    level = np.maximum(measured.level, 0)
    best = int((level / np.sqrt(measured.noise.variance(level))).argmax())
    return CHANNELS[best], float(level[best])


def has_moved_far(known: Knowledge, mosaic: Mosaic, black: npt.NDArray[np.float64], measured: Measured) -> bool:
    """Return whether the chart lies elsewhere than in the earlier run; `black` (2, 2) float64 counts of the frame."""
    assert known.anchor is not None
    channel, level = best_channel(measured)
    if level < limits.DIM_DN / 2:
        return False
    shift = known.anchor.shift(mosaic, black, channel)
    return shift.gauges == 0 or shift.length_px > limits.MOVED_FOLLOWED_PX


def judge_movement(
    known: Knowledge,
    anchor: Anchor,
    mosaic: Mosaic,
    black: npt.NDArray[np.float64],
    frame: Frame,
    judge: JudgeSettings,
) -> tuple[list[Check], npt.NDArray[np.float64]]:
    """Return whether the chart has moved or is softer than in the anchor's frame, and where it lies from there.

    `mosaic`, `black`, `frame`: the frame, its black level (2, 2) float64 counts, and what was measured of it. Returns
    (2,) float64 px right and down from the anchor's frame; NaN where that is not told.
    """
    channel, _ = best_channel(frame.measured)
    paper = _paper_in(frame, channel)
    if paper < limits.DIM_DN:
        return [
            Check("movement", None, None, judge.moved_px, "px"),
            Check("blur", None, None, judge.blur_px, "px"),
        ], UNTOLD_PX
    shift = anchor.shift(mosaic, black, channel)
    if shift.gauges == 0:
        far = anchor.displacement(mosaic, black, channel)
        if far is None:
            return [Check("movement", None, None, judge.moved_px, "px", _UNRECOGNISED)], UNTOLD_PX
        return [Check("movement", round(float(np.hypot(*far)), 3), None, judge.moved_px, "px", _moved(far))], np.array(
            far
        )
    place = np.array([shift.dx, shift.dy])
    at = known.moved_px if known.moved_px is not None else np.zeros(2)
    moved = float(np.hypot(*(place - at)))
    reason = ""
    if moved > judge.moved_px:
        steady = float(np.hypot(*(place - np.array(known.candidate[1:])))) <= limits.STEADY_PX
        followed = steady and float(np.hypot(*place)) <= limits.MOVED_FOLLOWED_PX
        reason = "" if followed or known.rested else _moved((float(place[0] - at[0]), float(place[1] - at[1])))
    checks = [Check("movement", round(moved, 3), None, judge.moved_px, "px", reason)]
    if paper < limits.BLUR_DIM_DN:
        return [*checks, Check("blur", None, None, judge.blur_px, "px")], place
    softer = float(np.sign(shift.blur_growth_px2) * np.sqrt(abs(shift.blur_growth_px2)))
    blurred = ""
    low = -limits.SHARPER * judge.blur_px
    if not low <= softer <= judge.blur_px:
        blurred = (
            f"the frame is {'softer' if softer > 0 else 'sharper'} than the first white frame by a blur of "
            f"{abs(softer):.2f} px, {judge.blur_px:g} px allowed; was the focus touched, is autofocus or stabilisation "
            "on, or does something shake?"
        )
    return [*checks, Check("blur", round(softer, 3), low, judge.blur_px, "px", blurred)], place


def _moved(by: tuple[float, float]) -> str:
    x, y = by
    return (
        f"the chart has moved by {np.hypot(x, y):.2f} px in the picture ({x:+.2f} right, {y:+.2f} down); was camera or "
        "chart touched? fix them, and let nobody walk about"
    )


def _paper_in(frame: Frame, channel: Channel) -> float:
    paper = float(frame.paper[CHANNELS.index(channel)])
    return 0.0 if np.isnan(paper) else paper
