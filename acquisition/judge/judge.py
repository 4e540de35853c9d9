"""Judge each frame as it is taken: what it shows, where, how sharp, and whether that is what was ordered.

Rules that hold inside:

- A frame is decoded once and measured once (`acquisition.judge.measuring`); what it is compared with is one frozen
  value (`acquisition.judge.knowledge`), which each frame replaces.
- Every check has its number and its limits, also where it passes; one that cannot tell has no number.
- A cause is named once: what follows from it (a chart that moved does not look like its old picture) has no reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from acquisition.chart.model import Chart
from acquisition.config import LabSettings
from acquisition.framing.planes import CHANNELS, Channel, frame_black, phases
from acquisition.framing.previews import preview_jpeg
from acquisition.judge import limits
from acquisition.judge.anchor import Anchor
from acquisition.judge.basis import FrameLight
from acquisition.judge.evenness import judge_evenness
from acquisition.judge.exposure import Exposure, disagreement, refusal
from acquisition.judge.frame import Frame
from acquisition.judge.knowledge import Examined, Knowledge, Leaning, is_brightest_grey, primary_of
from acquisition.judge.lights import judge_light
from acquisition.judge.measuring import Measured, measure
from acquisition.judge.references import (
    MOST_RESTARTS,
    judge_dark,
    judge_first_frames,
    judge_first_primary,
    judge_white,
)
from acquisition.lights.illuminations import Illumination
from acquisition.session.judgement import Check, Judgement
from acquisition.session.plan import REFERENCES, SessionStep
from drivers.raw.rawfile import Mosaic, read_raw
from foundation.errors import FormatError, RegistrationError

_CAUSES = (
    "file", "camera", "settings", "data", "repeated", "clipping", "exposure", "chart", "movement", "blur", "rows",
    "uniformity", "light", "ambient", "lamp", "dark", "white drift", "additivity",
)  # fmt: skip
"""Checks in the order in which they are named as the cause: what comes first explains what comes after."""

_AT_ONCE = ("camera", "chart")
"""Causes that taking the frame again never mends."""

_HIDDEN = ("ambient", "dark")
"""Causes that a reference shows and the lights between may hide: what was taken since the last good one is in doubt."""

_BY_MODEL = ("light", "uniformity", "rows", "lamp", "white drift")
"""Causes that each light shows by itself, where frames of the primaries say what it should look like."""

_NONE: npt.NDArray[np.float64] = np.full(2, np.nan)


@dataclass(frozen=True, eq=False)
class _Looked:
    """What was found of a frame: checks, light, tiles that deviate, brightness."""

    frame: Frame
    checks: tuple[Check, ...]
    light: FrameLight | None = None
    off: npt.NDArray[np.bool_] | None = None
    brightness: float = float("nan")
    stepped: bool = False
    leaning: Leaning = field(default_factory=Leaning)


class LiveJudge:
    """Judges the frames of a session as they come: `acquisition.session.judgement.FrameJudge`.

    Parameters
    ----------
    settings
        Of the lab: limits, exposure, whether the chart is looked for.
    chart
        The print before the camera.
    illuminations
        The lights of the plan, among which another one than the one ordered is looked for.
    """

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
        """Take in a frame of an earlier run; see `acquisition.session.judgement.FrameJudge.recall`."""
        frame = Frame.of_bytes(measurement) if measurement else None
        if frame is None:
            lost = accepted and step.kind in ("white", "dark")
            self._known = replace(self._known, lost=self._known.lost or lost)
            return
        light = None if self._known.basis is None else self._known.basis.light(frame.measured)
        self._known = self._known.after(step, Examined(frame, light, accepted))

    def after_pause(self) -> None:
        """Take in that lamp and chart may have changed; see `acquisition.session.judgement.OutlastsPauses`."""
        self._known = self._base = self._known.paused()
        self._fresh = False

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Return what is said of a raw file; see `acquisition.session.judgement.FrameJudge.judge`."""
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
        looked = _look(known, mosaic, black, step, self._settings, self._chart, self._plan)
        checks = _named_once(looked.checks)
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
        lasting = cause is not None and _lasts(self._known, step, cause.name)
        if disagreeing is not None:
            lasting = self._known.restarts > MOST_RESTARTS
        return Judgement(
            checks=checks,
            seen=None if np.isnan(paper).any() else (red, green, blue),
            measurement=looked.frame.to_bytes(with_strips=_is_compared(step)),
            preview=preview_jpeg(mosaic, black, white, outlines, boxes, cause.reason if cause else ""),
            voids=disagreeing is not None
            or (cause is not None and step.kind in REFERENCES and _voids(known, cause.name)),
            lasting=lasting,
        )


def _look(
    known: Knowledge,
    mosaic: Mosaic,
    black: npt.NDArray[np.float64],
    step: SessionStep,
    settings: LabSettings,
    chart: Chart | None,
    plan: Sequence[tuple[int, int, int]],
) -> _Looked:
    """Return what is found of a frame of a step."""
    measured = measure(mosaic, black)
    frame = Frame(measured, np.full(3, np.nan), _NONE)
    checks = [
        *_judge_file(known, mosaic, measured, settings),
        _judge_repeated(known, measured, settings),
        *_judge_exposure(known, measured, step, settings),
    ]
    if any(check.reason for check in checks):
        return _Looked(frame, tuple(checks))
    if known.awaits_primaries and (step.kind == "light" or (step.kind == "response" and not _is_compared(step))):
        return _Looked(frame, (*checks, Check("light", reason=_UNFOUNDED)))
    anchor = known.anchor
    if step.kind != "dark" and (anchor is None or (known.rested and _moved_far(known, mosaic, black, measured))):
        # The first lit frame is white; of a run taken up again it is the first in which the chart lies elsewhere.
        try:
            anchor = Anchor.of(mosaic, black, chart)
        except RegistrationError as error:
            return _Looked(frame, (*checks, Check("chart", reason=str(error))))
        checks.append(Check("chart", float(len(anchor.framing.tags) or len(anchor.paper))))
        moved = None if known.anchor is None else known.anchor.displacement(mosaic, black, _best_channel(measured)[0])
        if moved is not None:
            checks.append(Check("movement", round(float(np.hypot(*moved)), 3), None, None, "px"))
        known = replace(known, basis=None) if known.anchor is not None else known
        frame = replace(frame, anchor=anchor, moved_px=np.zeros(2))
    if anchor is not None:
        frame = replace(frame, paper=anchor.paper_level(mosaic, black, phases(mosaic)))
    if step.kind == "dark":
        dark = judge_dark(known, measured, settings.judge.dark_percent, settings.judge.ambient_percent)
        light = None if known.basis is None else known.basis.light(measured)
        return _Looked(frame, (*checks, *dark), light)
    if frame.anchor is None and anchor is not None:
        movement, moved = _judge_movement(known, anchor, mosaic, black, frame, settings)
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
) -> _Looked:
    """Return what is found of the light of a lit frame, and of its evenness."""
    measured = frame.measured
    primary = primary_of(step.colour.codes) if step.kind == "response" else None
    checks: list[Check] = []
    if primary is not None and not known.modelled:
        checks.append(judge_first_primary(known, measured, primary))
    if known.basis is None:
        return _Looked(frame, tuple(checks))
    light = known.basis.light(measured)
    if not known.modelled and step.kind == "response":
        # A primary alone is not what the camera's colours under white describe.
        return _Looked(frame, tuple(checks), light)
    moved = frame.moved_px if not np.isnan(frame.moved_px).any() else known.moved_px
    evenness = judge_evenness(known.basis, light, measured, np.zeros(2) if moved is None else moved)
    judge = settings.judge
    verdict = judge_light(known, step, light, plan, judge.light_deg, judge.drift_percent)
    checks += [*evenness.checks, *verdict.checks]
    if step.kind == "white" and known.modelled:
        checks.append(Check("additivity", round(100 * known.model.overlap, 2), None, None, "%"))
    return _Looked(frame, tuple(checks), light, evenness.off, verdict.brightness, verdict.stepped, verdict.leaning)


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


def _judge_file(
    known: Knowledge, mosaic: Mosaic, measured: Measured, settings: LabSettings
) -> tuple[Check, Check, Check]:
    """Return whether the file is of the session's camera, exposed as asked, and whole."""
    first = known.first
    reason = ""
    if first is not None:
        size = (measured.places.rows, measured.places.columns)
        for what, before, now in (
            ("frame size in half-size pixels", f"{first.places.columns}×{first.places.rows}", f"{size[1]}×{size[0]}"),
            ("camera", first.camera, measured.camera),
            ("serial number", first.serial, measured.serial),
        ):
            if before and now and before != now and not reason:
                reason = (
                    f"the {what} is {now}, and {before} in the session's first frame; connect the camera that the "
                    "session was begun with, set to its full raw format"
                )
    differs = None if settings.rig == "imported" else disagreement(mosaic, settings.camera.exposure)
    empty = ""
    if measured.empty > limits.EMPTY_SHARE:
        empty = (
            f"{measured.empty:.2%} of the photosites have no count, {limits.EMPTY_SHARE:.3%} allowed; part of the file "
            "was lost on its way: check the cable and the memory card"
        )
    return (
        Check("camera", reason=reason),
        Check("settings", reason=differs or ""),
        Check("data", round(100 * measured.empty, 4), None, 100 * limits.EMPTY_SHARE, "%", empty),
    )


def _judge_repeated(known: Knowledge, measured: Measured, settings: LabSettings) -> Check:
    """Return whether the camera gave a frame again that it gave before: its noise is the same."""
    if settings.rig == "replay":
        # A recording has one frame of a light, and gives it as often as it is asked.
        return Check("repeated")
    reason = "the camera handed out a frame that it had given before; check its cable and its memory card"
    if measured.digest in known.digests:
        return Check("repeated", 0.0, limits.SAME_NOISE, None, "", reason)
    values = [_independence(measured, seen.measured) for seen in known.recent]
    told = [value for value in values if value is not None]
    if not told:
        return Check("repeated")
    least = min(told)
    low = least < limits.SAME_NOISE
    return Check("repeated", round(least, 3), limits.SAME_NOISE, None, "", reason if low else "")


def _independence(one: Measured, other: Measured) -> float | None:
    """Return the noise of two frames' difference over that of independent ones; None where noise is too small."""
    if one.samples.shape != other.samples.shape or len(one.samples) == 0:
        return None
    a, b = one.samples.astype(np.float64), other.samples.astype(np.float64)
    ours, theirs = a[:, 0] - a[:, 1], b[:, 0] - b[:, 1]
    # By the differences of the two greens of a block, from which colour and light drop out.
    spread = [float(np.clip(np.abs(d - np.median(d)), 0, 4 * np.median(np.abs(d)) + 3).std()) for d in (ours, theirs)]
    if min(spread) < limits.LEAST_NOISE:
        return None
    ours, theirs = (np.clip(d - np.median(d), -(q := 4 * float(np.median(np.abs(d))) + 3), q) for d in (ours, theirs))
    correlation = float((ours * theirs).mean() / (ours.std() * theirs.std()))
    return float(np.sqrt(max(1 - max(correlation, 0.0) ** 2, 0.0)))


def _judge_exposure(
    known: Knowledge, measured: Measured, step: SessionStep, settings: LabSettings
) -> tuple[Check, Check]:
    exposure = Exposure(measured.clipped, measured.brightest_dn, measured.range_dn)
    # Where white is known, a dark frame is held against it.
    free = step.kind == "dark" and known.white is not None
    reason = "" if free else refusal(exposure, step.kind, settings.limits) or ""
    clipped = 100 * measured.clipped > settings.limits.clipped_percent and step.kind != "dark"
    allowed = None if step.kind == "dark" else settings.limits.clipped_percent
    return (
        Check("clipping", round(100 * measured.clipped, 4), None, allowed, "%", reason if clipped else ""),
        Check("exposure", round(100 * exposure.level, 2), None, None, "%", "" if clipped else reason),
    )


def _best_channel(measured: Measured) -> tuple[Channel, float]:
    """Return the channel with the best signal to noise, and its mean level, counts above black."""
    level = np.maximum(measured.level, 0)
    best = int((level / np.sqrt(measured.noise.variance(level))).argmax())
    return CHANNELS[best], float(level[best])


def _paper_in(frame: Frame, channel: Channel) -> float:
    paper = float(frame.paper[CHANNELS.index(channel)])
    return 0.0 if np.isnan(paper) else paper


def _moved_far(known: Knowledge, mosaic: Mosaic, black: npt.NDArray[np.float64], measured: Measured) -> bool:
    """Return whether the chart lies elsewhere than in the earlier run."""
    assert known.anchor is not None
    channel, level = _best_channel(measured)
    if level < limits.DIM_DN / 2:
        return False
    shift = known.anchor.shift(mosaic, black, channel)
    return shift.gauges == 0 or shift.length_px > limits.MOVED_FOLLOWED_PX


def _judge_movement(
    known: Knowledge,
    anchor: Anchor,
    mosaic: Mosaic,
    black: npt.NDArray[np.float64],
    frame: Frame,
    settings: LabSettings,
) -> tuple[list[Check], npt.NDArray[np.float64]]:
    """Return whether the chart has moved or is softer than in the anchor's frame, and where it lies from there."""
    judge = settings.judge
    channel, _ = _best_channel(frame.measured)
    paper = _paper_in(frame, channel)
    if paper < limits.DIM_DN:
        return [
            Check("movement", None, None, judge.moved_px, "px"),
            Check("blur", None, None, judge.blur_px, "px"),
        ], _NONE
    shift = anchor.shift(mosaic, black, channel)
    if shift.gauges == 0:
        far = anchor.displacement(mosaic, black, channel)
        if far is None:
            return [Check("movement", None, None, judge.moved_px, "px", _UNRECOGNISED)], _NONE
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
    softer = float(np.sign(shift.softer_px2) * np.sqrt(abs(shift.softer_px2)))
    blurred = ""
    low = -limits.SHARPER * judge.blur_px
    if not low <= softer <= judge.blur_px:
        blurred = (
            f"the frame is {'softer' if softer > 0 else 'sharper'} than the first white frame by a blur of "
            f"{abs(softer):.2f} px, {judge.blur_px:g} px allowed; was the focus touched, is autofocus or stabilisation "
            "on, or does something shake?"
        )
    return [*checks, Check("blur", round(softer, 3), low, judge.blur_px, "px", blurred)], place


_ROWS_STAND_PX = 0.7
"""Blur, px, below which rows show what belongs into them (simulated: none deviates at 0.75 px): rows that do not are
what made edges look softer, and no blur."""

_UNRECOGNISED = (
    "the chart is not recognised where it was: it is covered, out of focus, or has moved by more than its tags show; "
    "look at the picture, and put camera and chart back"
)


def _moved(by: tuple[float, float]) -> str:
    x, y = by
    return (
        f"the chart has moved by {np.hypot(x, y):.2f} px in the picture ({x:+.2f} right, {y:+.2f} down); was camera or "
        "chart touched? fix them, and let nobody walk about"
    )


_UNFOUNDED = (
    "no frame of each primary, or none of black, is accepted, from which it is known what this light should look like; "
    "see why those were refused"
)


_BESIDE = "it was under way when the frames before it were found to contradict each other; they are taken again first"


_FOLLOWS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "movement": frozenset({"rows", "uniformity", "blur", "light", "lamp", "white drift"}),
        "rows": frozenset({"movement", "uniformity", "blur", "light", "lamp", "white drift", "ambient"}),
        "uniformity": frozenset({"rows", "movement", "blur", "light", "lamp", "white drift", "ambient"}),
        "blur": frozenset({"rows", "uniformity"}),
        "light": frozenset({"lamp", "ambient", "white drift"}),
        "ambient": frozenset({"light", "lamp", "uniformity"}),
    }
)
"""What a cause brings about besides itself."""


def _named_once(checks: Sequence[Check]) -> tuple[Check, ...]:
    """Return the checks in the order in which causes are named, what follows from the first cause without a reason."""
    # Blur is measured on tags and on rows, a light's ambient share besides its colour: what is wrong is kept.
    one = {check.name: check for check in sorted(checks, key=lambda check: bool(check.reason))}
    order = sorted(one.values(), key=lambda check: _CAUSES.index(check.name))
    reasons = [check.name for check in order if check.reason]
    if "movement" in reasons and len(reasons) > 1:
        movement = next(check for check in order if check.name == "movement")
        # Tags that are not recognised have a cause; tags that moved are one.
        if movement.value is None:
            reasons.remove("movement")
    blur = one.get("blur")
    if "rows" in reasons and "blur" in reasons and blur is not None and abs(blur.value or np.inf) < _ROWS_STAND_PX:
        reasons.remove("blur")
        one["blur"] = replace(blur, reason="")
        order = [one[check.name] for check in order]
    cause = reasons[0] if reasons else ""
    follows = _FOLLOWS.get(cause, frozenset())
    return tuple(replace(check, reason="") if check.name in follows else check for check in order)


def _shown_white(known: Knowledge, frame: Frame) -> npt.NDArray[np.float64]:
    """Return what a preview shows as white: paper in the first white frame, else in this one."""
    first = frame.paper if known.first_white is None else known.first_white.paper
    return np.full(3, max(frame.measured.brightest_dn, 1.0)) if np.isnan(first).any() else np.maximum(first, 1.0)


def _is_compared(step: SessionStep) -> bool:
    return step.kind in REFERENCES or (step.kind == "response" and primary_of(step.colour.codes) is not None)


def _voids(known: Knowledge, cause: str) -> bool:
    """Return whether a reference that is refused for a cause puts what was taken since the last good one in doubt."""
    return cause in _HIDDEN or cause in known.untold or (cause in _BY_MODEL and not known.modelled)


def _lasts(known: Knowledge, step: SessionStep, cause: str) -> bool:
    """Return whether taking the frame again will not help; `known` includes it."""
    # A lamp that is another one at the beginning of a run would cost every light up to the next white frame.
    another = cause == "white drift" and is_brightest_grey(step)
    return another or cause in _AT_ONCE or known.refused[1] >= limits.LASTING_FRAMES
