"""Judge each frame as it is taken: what it shows, where, how sharp, and whether that is what was ordered.

Rules that hold inside:

- A frame is decoded once and measured once (`experiment.measures.frame`); what it is compared with is one frozen value
  (`acquisition.judge.state`), which each frame replaces.
- Every check has its number and its limits, also where it passes, and the sentence that a person is told where it
  fails; one that cannot tell has no number.
- A cause is named once: what follows from it (a chart that moved does not look like its old picture) has no reason.
  `CAUSES` says which of a frame's faults is named, and what it means for the frames around it.

Of light: the amounts of the three primaries in a frame are compared with those predicted from the codes. The lamp's
level is left free for the colour, and judged by itself. A light that is not the one ordered is held against everything
else that it could be: the light of the frame before, another one of the plan, the ordered one and light from elsewhere.
Tiles and rows that show another light than the whole frame are covered, half of another picture, or damaged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter

from acquisition.judge import limits
from acquisition.judge.measure import Anchor, Frame, disagreement, refusal
from acquisition.judge.state import (
    BLACK_DN,
    Basis,
    Codes,
    Examined,
    Fit,
    FrameLight,
    JudgeState,
    LampSeen,
    Leaning,
    Prediction,
    ProjectorModel,
    Residuals,
    Seen,
    combined,
    is_brightest_grey,
    primary_of,
)
from calibration.figures.light import (
    ADDITIVITY,
    DARK_DRIFT,
    LEAK_SHARE,
    OFF_BRIGHTNESS,
    OFF_CODES_DEG,
    STRAY_SHARE,
    WHITE_DRIFT,
)
from calibration.figures.radiometry import OTHER_CAMERA
from calibration.figures.single_frames import EMPTY_PHOTOSITES, REPEATED, ROWS, UNIFORMITY
from drivers.raw.rawfile import CHANNELS, Channel, Mosaic, filled_fault, frame_black, phases, read_raw
from experiment.chart.model import Chart
from experiment.config import JudgeSettings, LabSettings
from experiment.framing.pictures import preview_jpeg
from experiment.lights import Illumination
from experiment.measures.exposure import Exposure
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS, Measured, measure
from experiment.session.records import REFERENCES, Check, Judgement, SessionStep
from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import FormatError, RegistrationError
from foundation.robust import robust_sigma

_BESIDE = "it was under way when the frames before it were found to contradict each other; they are taken again first"

_UNFOUNDED = (
    "no frame of each primary, or none of black, is accepted, from which it is known what this light should look like; "
    "see why those were refused"
)


@dataclass(frozen=True, eq=False)
class _Findings:
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
        # A chart without tags is found by corners that are given by hand, and a run has none.
        self._chart = chart if settings.judge.chart and chart.tags else None
        self._plan = tuple(dict.fromkeys(light.colour for light in illuminations))
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
            return Judgement.of_reason(OFF_CODES_DEG.name, _BESIDE)
        try:
            mosaic = read_raw(file)
        except FormatError as error:
            return Judgement.of_reason("file", str(error))
        fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
        if fault is not None:
            return Judgement.of_reason("data", f"{file}: {fault}")
        before, black = self._state, frame_black(mosaic)
        found = self._look(mosaic, black, step)
        checks = _named_once(found.checks)
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
            voids = step.kind in REFERENCES and _voids_others(before, cause.name)
            lasting = _is_lasting(self._state, step, cause.name)
        return Judgement(
            checks=checks,
            seen=_seen(found.frame.paper),
            measurement=found.frame.to_bytes(with_strips=_is_compared(step)),
            preview=self._preview(mosaic, black, before, found, cause),
            voids=voids,
            lasting=lasting,
        )

    def _look(self, mosaic: Mosaic, black: npt.NDArray[np.float64], step: SessionStep) -> _Findings:
        """Return what is found of a frame of a step; `black` (2, 2) float64 counts is its black level."""
        state, settings = self._state, self._settings
        measured = measure(mosaic, black)
        frame = Frame(measured, np.full(3, np.nan), UNKNOWN_PLACE)
        checks = [
            *_judge_origin(state, mosaic, measured, settings),
            _judge_repeated(state, measured),
            *_judge_exposure(state, measured, step, settings),
        ]
        if any(check.reason for check in checks):
            return _Findings(frame, tuple(checks))
        if state.awaits_primaries and (step.kind == "light" or (step.kind == "response" and not _is_compared(step))):
            return _Findings(frame, (*checks, Check(OFF_CODES_DEG.name, reason=_UNFOUNDED)))
        anchor = state.anchor
        if step.kind != "dark" and (
            anchor is None or (state.rested and _has_moved_far(state, mosaic, black, measured))
        ):
            # The first lit frame is white; of a run taken up again it is the first in which the chart lies elsewhere.
            try:
                anchor = Anchor.of(mosaic, black, self._chart)
            except RegistrationError as error:
                return _Findings(frame, (*checks, Check("chart", reason=str(error))))
            checks.append(Check("chart", float(len(anchor.framing.tags) or len(anchor.paper))))
            if state.anchor is not None:
                moved = state.anchor.displacement(mosaic, black, _best_channel(measured)[0])
                if moved is not None:
                    checks.append(Check("movement", round(float(np.hypot(*moved)), 3), None, None, "px"))
                state = replace(state, basis=None)
            frame = replace(frame, anchor=anchor, moved_px=np.zeros(2))
        if anchor is not None:
            frame = replace(frame, paper=anchor.paper_level(mosaic, black, phases(mosaic)))
        if step.kind == "dark":
            dark = judge_dark(state, measured, settings.judge.dark_percent, settings.judge.ambient_percent)
            light = None if state.basis is None else state.basis.light(measured)
            return _Findings(frame, (*checks, *dark), light)
        if frame.anchor is None and anchor is not None:
            movement, place = _judge_movement(state, anchor, mosaic, black, frame, settings.judge)
            checks += movement
            frame = replace(frame, moved_px=place)
        if step.kind == "white":
            checks.append(judge_white(state.first_white, frame))
        if is_brightest_grey(step):
            checks.append(judge_white(state.first_grey, frame))
        of_light = self._look_at_light(state, frame, step)
        return replace(of_light, checks=(*checks, *of_light.checks))

    def _look_at_light(self, state: JudgeState, frame: Frame, step: SessionStep) -> _Findings:
        """Return what is found of the light of a lit frame, and of its evenness."""
        measured = frame.measured
        primary = primary_of(step.colour) if step.kind == "response" else None
        checks: list[Check] = []
        if primary is not None and not state.modelled:
            checks.append(judge_first_primary(state, measured, primary))
        if state.basis is None:
            return _Findings(frame, tuple(checks))
        light = state.basis.light(measured)
        if not state.modelled and step.kind == "response":
            # A primary alone is not what the camera's colours under white describe.
            return _Findings(frame, tuple(checks), light)
        moved = frame.moved_px if not np.isnan(frame.moved_px).any() else state.moved_px
        before = state.recent[-1] if state.recent else None
        evenness, off = _judge_evenness(state.basis, light, measured, np.zeros(2) if moved is None else moved, before)
        judge = self._settings.judge
        of_light, lamp = _judge_light(state, step, light, self._plan, judge.light_deg, judge.drift_percent)
        checks += [*evenness, *of_light]
        if step.kind == "white" and state.modelled:
            # Told, and never a reason to refuse.
            checks.append(Check(ADDITIVITY.name, round(100 * state.model.overlap, 2), None, None, "%"))
        return _Findings(frame, tuple(checks), light, off, lamp)

    def _preview(
        self,
        mosaic: Mosaic,
        black: npt.NDArray[np.float64],
        before: JudgeState,
        found: _Findings,
        cause: Check | None,
    ) -> bytes:
        frame = found.frame
        first = frame.paper if before.first_white is None else before.first_white.paper
        white = np.maximum(first, 1.0)
        if np.isnan(first).any():
            white = np.full(3, max(frame.measured.brightest_dn, 1.0))
        places = frame.measured.places
        boxes = [] if found.off is None else [places.tile_box(tile) for tile in np.flatnonzero(found.off).tolist()]
        outlines = () if self._state.anchor is None else self._state.anchor.outlines
        return preview_jpeg(mosaic, black, white, outlines, boxes, cause.reason if cause else "")


def _is_compared(step: SessionStep) -> bool:
    """Return whether later frames are held against the frame of a step, so that all of it is kept."""
    return step.kind in REFERENCES or (step.kind == "response" and primary_of(step.colour) is not None)


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
    checks, _ = _judge_evenness(following.basis, following.basis.light(state.witness), state.witness, moved)
    if all(check.passed for check in checks):
        return None
    uneven = next((check for check in checks if check.name == "uniformity"), Check(UNIFORMITY.name))
    return replace(
        uneven,
        reason="the frames of the three primaries do not add up to the white or grey frame before them everywhere; did "
        "somebody pass, or a window cover the picture? all of them are taken again",
    )


def _judge_origin(
    state: JudgeState, mosaic: Mosaic, measured: Measured, settings: LabSettings
) -> tuple[Check, Check, Check]:
    first = state.first
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
    if measured.empty > EMPTY_PHOTOSITES.accept:
        empty = (
            f"{measured.empty:.2%} of the photosites have no count, {EMPTY_PHOTOSITES.accept:.3%} allowed; "
            f"{EMPTY_PHOTOSITES.why}: {EMPTY_PHOTOSITES.remedy}"
        )
    return (
        Check(OTHER_CAMERA.name, reason=reason),
        Check("settings", reason=differs or ""),
        Check(EMPTY_PHOTOSITES.name, round(100 * measured.empty, 4), None, 100 * EMPTY_PHOTOSITES.accept, "%", empty),
    )


def _judge_repeated(state: JudgeState, measured: Measured) -> Check:
    """Return whether the camera gave a frame again that it gave before: its noise is the same."""
    reason = f"{REPEATED.why}; {REPEATED.remedy}"
    if measured.digest in state.digests:
        return Check(REPEATED.name, 0.0, REPEATED.accept, None, "", reason)
    values = [_independence(measured, seen.measured) for seen in state.recent]
    told = [value for value in values if value is not None]
    if not told:
        return Check(REPEATED.name)
    least = min(told)
    low = least < REPEATED.accept
    return Check(REPEATED.name, round(least, 3), REPEATED.accept, None, "", reason if low else "")


def _independence(one: Measured, other: Measured) -> float | None:
    """Return the noise of two frames' difference over that of independent ones; None where noise is too small."""
    if one.samples.shape != other.samples.shape or len(one.samples) == 0:
        return None
    ours, theirs = one.green_noise, other.green_noise
    if min(ours.spread, theirs.spread) < limits.LEAST_NOISE:
        return None
    correlation = float((ours.pattern * theirs.pattern).mean() / (ours.deviation * theirs.deviation))
    return float(np.sqrt(max(1 - max(correlation, 0.0) ** 2, 0.0)))


def _judge_exposure(
    state: JudgeState, measured: Measured, step: SessionStep, settings: LabSettings
) -> tuple[Check, Check]:
    exposure = Exposure(measured.clipped, measured.brightest_dn, measured.range_dn)
    # Where white is known, a dark frame is held against it.
    free = step.kind == "dark" and state.white is not None
    reason = "" if free else refusal(exposure, step.kind, settings.limits) or ""
    clipped = 100 * measured.clipped > settings.limits.clipped_percent and step.kind != "dark"
    allowed = None if step.kind == "dark" else settings.limits.clipped_percent
    return (
        Check("clipping", round(100 * measured.clipped, 4), None, allowed, "%", reason if clipped else ""),
        Check("exposure", round(100 * exposure.level, 2), None, None, "%", "" if clipped else reason),
    )


UNKNOWN_PLACE: npt.NDArray[np.float64] = np.full(2, np.nan)  # Place of a chart in a frame that is too dark to tell

_UNRECOGNISED = (
    "the chart is not recognised where it was: it is covered, out of focus, or has moved by more than its tags show; "
    "look at the picture, and put camera and chart back"
)


def _best_channel(measured: Measured) -> tuple[Channel, float]:
    """Return the channel with the best signal to noise, and its mean level, counts above black."""
    level = np.maximum(measured.level, 0)
    best = int((level / np.sqrt(measured.noise.variance(level))).argmax())
    return CHANNELS[best], float(level[best])


def _has_moved_far(state: JudgeState, mosaic: Mosaic, black: npt.NDArray[np.float64], measured: Measured) -> bool:
    """Return whether the chart lies elsewhere than in the earlier run; `black` (2, 2) float64 counts of the frame."""
    assert state.anchor is not None
    channel, level = _best_channel(measured)
    if level < limits.DIM_DN / 2:
        return False
    shift = state.anchor.shift(mosaic, black, channel)
    return shift.gauges == 0 or shift.length_px > limits.MOVED_FOLLOWED_PX


def _judge_movement(
    state: JudgeState,
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
    channel, _ = _best_channel(frame.measured)
    paper = float(np.nan_to_num(frame.paper[CHANNELS.index(channel)]))
    if paper < limits.DIM_DN:
        return [
            Check("movement", None, None, judge.moved_px, "px"),
            Check("blur", None, None, judge.blur_px, "px"),
        ], UNKNOWN_PLACE
    shift = anchor.shift(mosaic, black, channel)
    if shift.gauges == 0:
        far = anchor.displacement(mosaic, black, channel)
        if far is None:
            return [Check("movement", None, None, judge.moved_px, "px", _UNRECOGNISED)], UNKNOWN_PLACE
        return [Check("movement", round(float(np.hypot(*far)), 3), None, judge.moved_px, "px", _moved(far))], np.array(
            far
        )
    place = np.array([shift.dx, shift.dy])
    at = state.moved_px if state.moved_px is not None else np.zeros(2)
    moved = float(np.hypot(*(place - at)))
    reason = ""
    if moved > judge.moved_px:
        steady = float(np.hypot(*(place - np.array(state.candidate[1:])))) <= limits.STEADY_PX
        followed = steady and float(np.hypot(*place)) <= limits.MOVED_FOLLOWED_PX
        reason = "" if followed or state.rested else _moved((float(place[0] - at[0]), float(place[1] - at[1])))
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


_SIGMAS = 6.0  # Standard deviations of a mean's noise that no change is made of

_TILES = 16  # Tiles that are averaged before their change in the dark is looked at: a lamp in a corner lights as many

# How often first frames are taken again at once because others contradict them: what passes does so within a minute,
# and what comes back for the third time wants somebody who looks.
MOST_RESTARTS: Final = 2

# Checks that hold a frame against those before it.
_CONTRADICTIONS: Final = (
    "movement", "blur", "rows", "uniformity",
    OFF_CODES_DEG.name, STRAY_SHARE.name, DARK_DRIFT.name, OFF_BRIGHTNESS.name,
)  # fmt: skip

_STALE_LEAST = 0.02  # Amount of light in a dark frame, of a primary, from which on the frame before may be what is seen


def judge_dark(state: JudgeState, frame: Measured, dark_percent: float, ambient_percent: float) -> tuple[Check, ...]:
    """Return whether a dark frame is dark, and changed by no more than `ambient_percent` of white since the first.

    Both limits are per cent of what white gives in the same place and channel; the change is that of the region, one of
    24, that changed most, so that a lamp in a corner shows.
    """
    if state.white is None:
        return (Check(LEAK_SHARE.name),)
    scale = white_scale(state.white.tiles - (0 if state.dark is None else state.dark.tiles))
    value = dark_level(frame.tiles, scale)
    stale = ""
    before = state.recent[-1] if state.recent else None
    if value > dark_percent and state.basis is not None and before is not None and before.amounts is not None:
        amounts = state.basis.light(frame).amounts
        if amounts.max() > _STALE_LEAST and _same_light(amounts, before.amounts, 0.003) < 2 * limits.STALE_SIGMAS:
            stale = (
                "the dark frame shows the light of the frame before; does the screen stand still, or is "
                "sequence.settle_s too short?"
            )
    reason = ""
    if value > dark_percent:
        reason = stale or (
            f"the dark frame has {value:.1f} % of white, {dark_percent:g} % allowed; is another light on, or the "
            "projector's picture not black?"
        )
    checks = [Check(OFF_CODES_DEG.name if stale else LEAK_SHARE.name, round(value, 3), None, dark_percent, "%", reason)]
    first = state.first_dark
    if first is not None and not reason:
        changed = _by_region(100 * (frame.tiles - first.tiles) / scale)
        noise = 100 * float(np.sqrt(frame.noise.variance(frame.level).max() / frame.places.tile_blocks.mean()))
        noise /= float(scale.min()) * _TILES**0.5
        drift = float(np.abs(changed).max())
        black = 100 * BLACK_DN / float(scale.min())
        limit = max(ambient_percent, _SIGMAS * 2**0.5 * float(np.hypot(noise, black)))
        # Without a masked border the black level is a constant of the file's, and its drift looks like light.
        if not frame.black_measured:
            limit = max(limit, 100 * 8.0 / float(scale.min()))
        reason = ""
        if drift > limit:
            more = "more" if changed.mean() > 0 else "less"
            reason = (
                f"the room is not as dark as in the first dark frame: {drift:.2f} % of white {more}, {limit:.2g} % "
                "allowed; was a lamp or a display switched, or does daylight come in?"
            )
        checks.append(Check(DARK_DRIFT.name, round(drift, 3), None, round(limit, 3), "%", reason))
    return tuple(checks)


def white_scale(white: _Array) -> _Array:
    """Return (T, 3) the light of white that tiles are compared with; of a dim one, a third of the mean."""
    return np.maximum(white, np.maximum(white.mean(axis=0) / 3, 1.0))


def dark_level(tiles: _Array, scale: _Array) -> float:
    """Return the light of a dark frame, per cent of white: its mean, or a tile (T, 3) that 6 % are beyond."""
    level = 100 * tiles / scale
    return float(max(level.mean(axis=0).max(), np.percentile(level, 94)))


def _by_region(tiles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return means (24, 3) of 4×4 tiles each of tiles (T, 3)."""
    side = round(_TILES**0.5)
    grid = tiles.reshape(TILE_ROWS // side, side, TILE_COLUMNS // side, side, 3)
    return np.asarray(grid.mean(axis=(1, 3))).reshape(-1, 3)


def judge_white(first: Frame | None, frame: Frame) -> Check:
    """Return how far paper is from that of the session's first frame of this light, white or the brightest grey."""
    if first is None or np.isnan(frame.paper).any() or np.isnan(first.paper).any():
        return Check(WHITE_DRIFT.name)
    drift = float(100 * (frame.paper.sum() / max(first.paper.sum(), 1.0) - 1))
    reason = ""
    if abs(drift) > limits.LAMP_TOTAL:
        reason = (
            f"paper white is {drift:+.0f} % from the session's first frame, {limits.LAMP_TOTAL:g} % allowed; let "
            "the lamp warm up, or begin a new session"
        )
    return Check(WHITE_DRIFT.name, round(drift, 2), -limits.LAMP_TOTAL, limits.LAMP_TOTAL, "%", reason)


def judge_first_primary(state: JudgeState, frame: Measured, primary: int) -> Check:
    """Return whether the first frame of a primary shows it: against white, its own channel is the brightest.

    Of a frame's three channels none sees another's primary better than its own, whatever the camera.
    """
    if state.white is None:
        return Check(OFF_CODES_DEG.name)
    dark = np.zeros(3) if state.dark is None else state.dark.level
    share = (frame.level - dark) / np.maximum(state.white.level - dark, 1.0)
    name = ("red", "green", "blue")[primary]
    reason = ""
    if int(share.argmax()) != primary or share[primary] < 0.1:
        seen = (
            "nearly black" if share.max() < 0.1 else f"more {('red', 'green', 'blue')[int(share.argmax())]} than that"
        )
        reason = (
            f"{name} alone was ordered, and the frame is {seen}; does the screen stand still, or are the colours of "
            "the cable or of the picture mode exchanged?"
        )
    elif share.min() > 0.9:
        reason = (
            f"{name} alone was ordered, and the frame is as bright as white everywhere; does the screen stand still?"
        )
    return Check(OFF_CODES_DEG.name, round(100 * float(share[primary]), 1), 10.0, None, "%", reason)


def judge_first_frames(state: JudgeState, step: SessionStep, cause: Check | None, judge: JudgeSettings) -> Check | None:
    """Return why the first frames of a session or run cannot be trusted; None where nothing speaks against them.

    What they show is learnt, and only later frames tell that one of them was the odd one: a step whose frame is refused
    twice contradicts them, and before the first light white is held against what all others predict.

    `cause`: the check that refuses the frame; None where it is accepted.
    """
    if not state.founding or all(not any(one.codes) for one in state.first_frames):
        return None
    why = cause
    if cause is None:
        why = _odd_white(state, judge) if step.kind == "light" else None
    elif cause.name not in _CONTRADICTIONS or step.number not in state.doubted:
        why = None
    elif state.awaits_primaries and cause.value is None:
        # What it should look like is not known yet.
        why = None
    if why is None:
        return None
    odd = f"{why.reason}; one of the first frames may be the odd one, white, dark or a primary"
    if state.restarts < MOST_RESTARTS:
        return replace(why, reason=f"{odd}: they are taken again")
    return replace(
        why,
        reason=f"{odd}: they were taken {state.restarts + 1} times and do not agree; see that lamp, room light and "
        "focus are steady. They are taken again after the pause, or by the same command later",
    )


def _odd_white(state: JudgeState, judge: JudgeSettings) -> Check | None:
    """Return why the first white frame is not what the frames behind it predict; None where it is."""
    white = next((one.measured for one in state.first_frames if one.codes == (255, 255, 255)), None)
    model = state.without_white()
    if white is None or model is None or state.basis is None:
        return None
    light = state.basis.light(white)
    fit = model.compare(light.amounts, (255, 255, 255), light.covariance)
    limit = max(judge.light_deg, fit.angle_limit(limits.LIGHT_SIGMAS))
    if fit.angle_deg > limit:
        said = f"the first white frame is {fit.angle_deg:.1f}° from the light that greys and primaries foretell"
        return Check(OFF_CODES_DEG.name, round(fit.angle_deg, 3), None, round(limit, 3), "°", said)
    room = max(judge.drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    if abs(fit.brightness) > room:
        percent = 100 * float(np.expm1(fit.brightness))
        said = f"the first white frame is {percent:+.1f} % as bright as greys and primaries foretell"
        return lamp_check(fit.brightness, room, said)
    return None


@dataclass(frozen=True)
class _FrameCause:
    """What is known of a check that refuses a frame.

    - `explains`: checks that it brings about besides itself.
    - `lasts`: whether taking the frame again never helps.
    - `is_hidden`: whether a reference shows it and the lights between may hide it: what was taken since the last good
      reference is in doubt.
    - `in_each_light`: whether each light shows it by itself, where frames of the primaries say how it should look.
    """

    explains: frozenset[str] = frozenset()
    lasts: bool = False
    is_hidden: bool = False
    in_each_light: bool = False


# Light from elsewhere: in a light, and in a dark frame against the first one.
_ELSEWHERE = frozenset({STRAY_SHARE.name, DARK_DRIFT.name})

_AMBIENT = _FrameCause(frozenset({OFF_CODES_DEG.name, OFF_BRIGHTNESS.name, "uniformity"}), is_hidden=True)

_OF_THE_LIGHT = frozenset({"uniformity", "blur", OFF_CODES_DEG.name, OFF_BRIGHTNESS.name, WHITE_DRIFT.name})

# Checks in the order in which they are named as the cause: what comes first explains what comes after.
CAUSES: Mapping[str, _FrameCause] = MappingProxyType(
    {
        "file": _FrameCause(),
        OTHER_CAMERA.name: _FrameCause(lasts=True),
        "settings": _FrameCause(),
        "data": _FrameCause(),
        "repeated": _FrameCause(),
        "clipping": _FrameCause(),
        "exposure": _FrameCause(),
        "chart": _FrameCause(lasts=True),
        "movement": _FrameCause(_OF_THE_LIGHT | {"rows"}),
        "blur": _FrameCause(frozenset({"rows", "uniformity"})),
        "rows": _FrameCause(_OF_THE_LIGHT | _ELSEWHERE | {"movement"}, in_each_light=True),
        "uniformity": _FrameCause(
            _OF_THE_LIGHT - {"uniformity"} | _ELSEWHERE | {"rows", "movement"}, in_each_light=True
        ),
        OFF_CODES_DEG.name: _FrameCause(_ELSEWHERE | {OFF_BRIGHTNESS.name, WHITE_DRIFT.name}, in_each_light=True),
        STRAY_SHARE.name: _AMBIENT,
        DARK_DRIFT.name: _AMBIENT,
        OFF_BRIGHTNESS.name: _FrameCause(in_each_light=True),
        LEAK_SHARE.name: _FrameCause(is_hidden=True),
        WHITE_DRIFT.name: _FrameCause(in_each_light=True),
        ADDITIVITY.name: _FrameCause(),
    }
)

# Deviation of a tile over its limit from which on light is plainly uneven: what little movement or blur is seen with
# it comes from it. Of charts out of focus by half a px one tile in 16 frames was off at all (simulated).
_PLAINLY = 2.0

# Blur, px, below which rows show what belongs into them (simulated: none deviates at 0.75 px): rows that do not are
# what made edges look softer, and no blur.
_ROWS_STAND_PX = 0.7


def _named_once(checks: Sequence[Check]) -> tuple[Check, ...]:
    """Return the checks in the order in which causes are named, what follows from the first cause without a reason."""
    # Blur is measured on tags and on rows, a light's ambient share besides its colour: what is wrong is kept.
    one = {check.name: check for check in sorted(checks, key=lambda check: bool(check.reason))}
    places = list(CAUSES)
    order = sorted(one.values(), key=lambda check: places.index(check.name))
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
    uneven = one.get("uniformity")
    if uneven is not None and uneven.reason and (uneven.value or 0.0) > _PLAINLY * (uneven.high or np.inf):
        # Edges between lights that should not be there draw the chart's edges aside and soften them.
        for name, most in (("movement", limits.MOVED_FOLLOWED_PX), ("blur", _ROWS_STAND_PX)):
            check = one.get(name)
            if name in reasons and check is not None and check.value is not None and abs(check.value) < most:
                reasons.remove(name)
                one[name] = replace(check, reason="")
        order = [one[check.name] for check in order]
    follows = CAUSES[reasons[0]].explains if reasons else frozenset[str]()
    return tuple(replace(check, reason="") if check.name in follows else check for check in order)


def _voids_others(state: JudgeState, cause: str) -> bool:
    """Return whether a reference that is refused for a cause puts what was taken since the last good one in doubt."""
    hidden = CAUSES[cause].is_hidden or (CAUSES[cause].in_each_light and not state.modelled)
    return hidden or cause in state.untold


def _is_lasting(state: JudgeState, step: SessionStep, cause: str) -> bool:
    """Return whether taking the frame again will not help; `state` includes it."""
    # A lamp that is another one at the beginning of a run would cost every light up to the next white frame.
    another = cause == WHITE_DRIFT.name and is_brightest_grey(step)
    # Of a session's first frame the exposure is too long, and a second one is no shorter.
    overexposed = cause == "clipping" and state.white is None
    return another or overexposed or CAUSES[cause].lasts or state.refused[1] >= limits.LASTING_FRAMES


_SAME_SD = 0.0015  # Scatter of amounts between two frames of one light that is reckoned with at least, relative

_SAME_FLOOR = 4e-4  # The same of amounts without light, of a full primary

_NEAREST = 12  # Lights of the plan that are compared in full with one that is not the one ordered

_PRIMARIES = ("red", "green", "blue")

_ASKED_LEAST = 0.005  # Light of a primary, of its full light, from which on it can be missed

_GONE = 0.05  # Share of the ordered light of a primary below which it is missing: a leak of black is less

_Array = npt.NDArray[np.float64]


def _judge_light(
    state: JudgeState,
    step: SessionStep,
    light: FrameLight,
    plan: Sequence[Codes],
    angle_deg: float,
    drift_percent: float,
) -> tuple[tuple[Check, ...], LampSeen]:
    """Return whether a lit frame shows what its step asks for, and what it shows of the lamp."""
    codes = step.colour
    before = state.recent[-1] if state.recent else None
    if not state.modelled:
        return (_without_model(light, codes, before),), LampSeen()
    seen = _SeenLight(state.model, light, codes, before, plan)
    fit = seen.fit
    limit = max(angle_deg, fit.angle_limit(limits.LIGHT_SIGMAS))
    room = max(drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    wrong = fit.angle_deg > limit
    reason, added = "", 0.0
    if wrong or fit.distance > limits.STALE_SIGMAS or abs(fit.brightness) > room:
        reason, added = seen.cause(wrong, room, again=state.refused[0] == OFF_CODES_DEG.name)
    stepped = False
    lamp = ""
    if not reason and abs(fit.brightness) > room:
        level = state.candidate[0]
        # Shown twice alike, and small: the lamp has another level now, and each light has a ground truth of its own.
        stepped = abs(fit.brightness) <= limits.LAMP_FOLLOWED and abs(fit.brightness - level) <= room / 2
        lamp = "" if stepped else _brightness_reason(fit.brightness)
    leaning = Leaning(((fit.brightness, fit.brightness_sd),), (seen.neutral_light(),))
    if not reason and not lamp and not stepped and not state.rested:
        lamp, added = crept(state.leaning.then(leaning), drift_percent / 100)
        reason = _ambient_reason(added) if added else ""
    ambient = (Check(STRAY_SHARE.name, round(100 * added, 2), None, None, "%", reason),) if added else ()
    # Where another cause changes the light, its brightness is none of the lamp's.
    checks = (
        *ambient,
        Check(OFF_CODES_DEG.name, round(fit.angle_deg, 3), None, round(limit, 3), "°", "" if added else reason),
        lamp_check(fit.brightness, room, lamp),
    )
    return checks, LampSeen(fit.brightness, stepped, leaning)


def lamp_check(brightness: float, room: float, reason: str) -> Check:
    """Return a frame's brightness against the one foretold, as logarithms, and how far it may be off.

    No limits are stated where the first frames do not yet tell how the lamp scatters: they would allow what no session
    may have.
    """
    allowed = round(100 * room, 2) if 100 * room < limits.LAMP_TOTAL else None
    low = None if allowed is None else -allowed
    return Check(OFF_BRIGHTNESS.name, round(100 * float(np.expm1(brightness)), 2), low, allowed, "%", reason)


def crept(leaning: Leaning, drift: float) -> tuple[str, float]:
    """Return the reason against the lamp, or how much light is added, of white, that the last lights together show.

    `drift`: change of brightness that is always allowed, 0 … 1.
    """
    for count in range(2, len(leaning.lamp) + 1):
        added, sd = combined(leaning.added[:count])
        if added > max(limits.ADDED_LEAST, limits.ADDED_SIGMAS * sd):
            return "", added
        brightness, sd = combined(leaning.lamp[:count])
        if abs(brightness) > max(drift, limits.BRIGHTNESS_SIGMAS * sd):
            return _brightness_reason(brightness), 0.0
    return "", 0.0


def _same_light(one: _Array, other: _Array, scatter: float) -> float:
    """Return how many standard deviations two frames' amounts (3,) differ by; `scatter` relative, of colours."""
    sd = max(scatter, _SAME_SD)
    variance = 2 * ((sd * np.maximum(one, other)) ** 2 + _SAME_FLOOR**2)
    return float(np.sqrt(((one - other) ** 2 / variance).sum()))


@dataclass(frozen=True, eq=False)
class _SeenLight:
    """The light of a frame, held against the one that was ordered by `codes`, and against what else it may be.

    - `before`: the frame before; None where there is none.
    - `plan`: codes of all lights that may be shown.
    """

    model: ProjectorModel
    light: FrameLight
    codes: Codes
    before: Seen | None
    plan: Sequence[Codes]

    @cached_property
    def expected(self) -> Prediction:
        """The amounts that were ordered."""
        return self.model.predict(self.codes)

    @cached_property
    def fit(self) -> Fit:
        """How well the light agrees with the one ordered."""
        return self.model.compare(self.light.amounts, self.codes, self.light.covariance)

    def cause(self, wrong: bool, room: float, *, again: bool) -> tuple[str, float]:
        """Return why it is not the one ordered, empty where it is but its lamp, and how much light is added to it.

        `wrong`: whether its colour is off by more than its limit. `room`: change of the lamp's level that is allowed.
        `again`: whether the frame before was refused for its light, too.
        """
        fit = self.fit
        squared = fit.distance**2 + (fit.brightness / fit.brightness_sd) ** 2
        same = self._off_before()
        changed = self.before is not None and self.before.codes != self.codes
        fits_before = same < limits.LIGHT_SIGMAS and squared - same**2 > limits.STALE_ADVANTAGE
        if self.before is not None and changed and fits_before:
            return _stale_reason(self.before, self.codes), 0.0
        missing = self._missing()
        if missing:
            return missing, 0.0
        remains, ambient = self._added_of(self.before), self._added_of(None)
        if wrong and remains is not None and (ambient is None or remains[1] + 9 < ambient[1]):
            elsewhere = ", or does light from elsewhere fall on the chart?" if self._coloured() else ""
            return (
                f"{100 * remains[0]:.1f} % of the light of the frame before remain in this one; let the picture settle "
                f"for longer (sequence.settle_s), and switch dynamic contrast and frame interpolation off{elsewhere}",
                0.0,
            )
        if wrong:
            if ambient is not None:
                return _ambient_reason(ambient[0]), ambient[0]
            other = self._other(squared)
            coloured = 0.0 if other else self._coloured()
            if coloured:
                return _ambient_reason(coloured), coloured
            repeated = again and not changed and same < limits.LIGHT_SIGMAS
            if repeated and not other and fit.angle_deg <= limits.LIGHT_FOLLOWED_DEG:
                return "", 0.0
            return other or self._wrong_reason(), 0.0
        if fit.brightness > room and ambient is not None and ambient[1] + 9 < fit.distance**2:
            return _ambient_reason(ambient[0]), ambient[0]
        if fit.distance > limits.STALE_SIGMAS:
            return self._other(squared), 0.0
        return "", 0.0

    def neutral_light(self) -> tuple[float, float]:
        """Return how much neutral light, of white, is added to the one ordered, and its standard deviation."""
        h, neutral = self.expected.amounts, np.ones(3)
        scatter = self.model.brightness_sd**2 * np.outer(h, h)
        weight = np.linalg.inv(self.expected.with_lamp + self.light.covariance + scatter)
        power = float(neutral @ weight @ neutral)
        return float(neutral @ weight @ (self.light.amounts - h)) / power, power**-0.5

    def _off_before(self) -> float:
        """Return by how many standard deviations the light of the frame before is another; infinite if not known."""
        if self.before is None or self.before.amounts is None:
            return np.inf
        return _same_light(self.light.amounts, self.before.amounts, self.model.chroma_sd)

    def _missing(self) -> str:
        """Return the sentence that names primaries without light, where the others are as ordered; empty if none."""
        seen, wanted = self.light.amounts, self.expected.amounts
        sd = np.sqrt(
            np.diag(self.expected.with_lamp + self.light.covariance) + (self.model.brightness_sd * wanted) ** 2
        )
        asked = wanted > np.maximum(_ASKED_LEAST, limits.LIGHT_SIGMAS * sd)
        gone = asked & (seen < _GONE * wanted)
        if (
            not gone.any()
            or (np.abs(seen - wanted) > limits.LIGHT_SIGMAS * sd)[~gone].any()
            or not (asked & ~gone).any()
        ):
            return ""
        names = " and ".join(name for name, lost in zip(_PRIMARIES, gone, strict=True) if lost)
        return (
            f"no {names} comes through, the rest is as ordered ({self._parts()} of the primaries); does the "
            f"projector's {names} fail, its lamp, panel or filter, is the picture's cable damaged, or does a picture "
            "mode leave it out?"
        )

    def _parts(self) -> str:
        numbers = zip(_PRIMARIES, self.light.amounts, self.expected.amounts, strict=True)
        return ", ".join(
            f"{name} {100 * max(seen, 0.0):.1f} % instead of {100 * wanted:.1f} %" for name, seen, wanted in numbers
        )

    def _wrong_reason(self) -> str:
        darker = bool((self.light.amounts < self.expected.amounts).all())
        why = "its brightness or contrast was changed or power is saved, or " if darker else ""
        return (
            f"the light is not the one ordered, {_named(self.codes)}: {self._parts()} of the primaries; see whether "
            f"{why}something covers the picture or changes its colours, a pop-up, a screen saver, a picture mode"
        )

    def _other(self, squared: float) -> str:
        """Return the sentence that names the light of the plan, or black or white, that is seen; empty if none."""
        # Only what is about as bright and of that colour is compared in full.
        found: tuple[float, Codes] | None = None
        for other in self._near([*self.plan, (0, 0, 0), (255, 255, 255)]):
            if other == self.codes:
                continue
            if not any(other):
                left = float(((self.light.amounts / (3 * _SAME_FLOOR)) ** 2).sum())
            else:
                fit = self.model.compare(self.light.amounts, other, self.light.covariance)
                left = fit.distance**2 + (fit.brightness / (fit.brightness_sd + 0.01)) ** 2
            if found is None or left < found[0]:
                found = left, other
        if found is None or squared - found[0] < limits.OTHER_ADVANTAGE or found[0] > limits.LIGHT_SIGMAS**2:
            return ""
        # Faint light of a colour changes a light into its neighbour.
        why = "is the picture late, or does other light fall on the chart" if self._coloured() else ""
        return (
            f"another light is seen, {_named(found[1])}, {_named(self.codes)} was ordered; "
            f"does something else draw on the screen, {why or 'or is the picture late'}?"
        )

    def _near(self, plan: Sequence[Codes]) -> list[Codes]:
        curves = self.model.curves()
        table = np.array(plan)
        predicted = np.stack([curves[primary, table[:, primary]] for primary in range(3)], axis=-1)
        off = np.linalg.norm(predicted - self.light.amounts, axis=1)
        return [plan[k] for k in np.argsort(off, kind="stable")[:_NEAREST].tolist()]

    def _added_of(self, of: Seen | None) -> tuple[float, float] | None:
        """Return how much neutral light added to the one ordered, or share of another frame's, explains what is seen.

        And the squared distance left; None where that is nothing, or unlikely. `of`: the other frame; None asks for
        neutral light.
        """
        h = self.expected.amounts
        if of is None:
            more = np.ones(3)
        elif of.amounts is None or of.codes == self.codes or not any(of.codes):
            return None
        else:
            # For a share of the time the other light was there instead.
            more = of.amounts - h
        # The lamp is where it was, within its scatter: what is added is asked for.
        scatter = (self.model.brightness_sd**2 + 1e-6) * np.outer(h, h)
        weight = np.linalg.inv(self.expected.covariance + self.light.covariance + scatter)
        power = float(more @ weight @ more)
        added = float(more @ weight @ (self.light.amounts - h)) / power
        off = self.light.amounts - h - added * more
        left = float(off @ weight @ off)
        if added <= 4 * power**-0.5 or added < 0.002 or left > limits.LIGHT_SIGMAS**2:
            return None
        return added, left

    def _coloured(self) -> float:
        """Return how much light of any colour, of white, is added to the one ordered; 0 where it is not just more."""
        h = self.expected.amounts
        off = self.light.amounts - h
        variance = np.diag(self.expected.with_lamp + self.light.covariance) + (self.model.brightness_sd * h) ** 2
        more = float(np.mean(off))
        return more if (off > -3 * np.sqrt(variance)).all() and limits.ADDED_LEAST < more < limits.ADDED_MOST else 0.0


def _ambient_reason(added: float) -> str:
    return (
        f"light from elsewhere, {100 * added:.1f} % of white, falls on the chart besides the projector's; "
        "darken the room, close the door, cover lamps and displays"
    )


def _brightness_reason(brightness: float) -> str:
    percent = 100 * float(np.expm1(brightness))
    if percent < 0:
        return (
            f"the light is {-percent:.1f} % weaker than expected, its colour is right; does the lamp fail, did its "
            "power mode, the picture's brightness, the shutter or the aperture change, or stands somebody in the light?"
        )
    return (
        f"the light is {percent:.1f} % stronger than expected, its colour is right; did the lamp's power mode, the "
        "picture's brightness, the shutter or the aperture change, or does other light fall on the chart?"
    )


def _without_model(light: FrameLight, codes: Codes, before: Seen | None) -> Check:
    """Return what can be said without frames of the primaries: whether nothing has changed since the frame before."""
    if before is None or before.amounts is None or before.codes == codes or not any(codes) or not any(before.codes):
        return Check(OFF_CODES_DEG.name)
    wanted = np.array([decode_srgb(np.array(c) / 255) for c in (codes, before.codes)])
    away = float(angles_deg(wanted[:1], wanted[1:])[0])
    brighter = abs(float(np.log(wanted[0].sum() / wanted[1].sum())))
    same = _same_light(light.amounts, before.amounts, 0.005)
    reason = ""
    if same < 2 * limits.STALE_SIGMAS and (away > limits.NOMINAL_DEG or brighter > 0.2):
        reason = _stale_reason(before, codes)
    return Check(OFF_CODES_DEG.name, reason=reason)


def _stale_reason(before: Seen, codes: Codes) -> str:
    return (
        f"the light of the frame before, {_named(before.codes)}, is still seen, {_named(codes)} was ordered; does the "
        "screen stand still, or is sequence.settle_s too short?"
    )


def _named(codes: Codes) -> str:
    return "black" if not any(codes) else "({}, {}, {})".format(*codes)


# Median relative deviation below which places that deviate are called covered or dark, and not differently lit.
_DARKER = -0.1

# Power of the deviation, relative, that the light of the frame before may leave where it is seen: 6° off.
_OF_BEFORE = 0.01

_BOTH_PARTS = 0.5  # Share of the tiles off from which on it is the frame that deviates and not a part of it

# Blurs σ, half-size px, that rows are compared with where they are not what they were.
_BLURS = (0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)

_EXPLAINED = 0.4  # Share of the rows' median deviation that a blur may leave if it is the cause

# Median deviation of rows from which on it is asked for a blur: else it is some rows that deviate, and not all.
_BLURRED = 0.02

_CONTRAST = 2.0  # Contrast of the chart at a tile's edges, over the mean of the brighter tile: tags, paper, cells

_BY_TURNS = 0.1  # Share of deviating rows that are brighter, or darker, from which on they are rows of another place

# Median step from row to row, over the median deviation, from which on rows are those of several places: of shadows,
# windows and parts of a picture it is 0.03 and less, of scrambled rows 0.2 and more (simulated).
_RAGGED = 0.1

# Movement or blur, px, that rows at the print's edges must stand: those are measured where they can be told.
_UNSEEN_PX = 1.0

_EDGE = 0.15  # Relative deviation of a row for each px that the chart lies sideways: cells at a strip's ends are others


def _judge_evenness(
    basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, before: Seen | None = None
) -> tuple[list[Check], npt.NDArray[np.bool_]]:
    """Return whether a lit frame shows one light everywhere, and which tiles (T,) deviate, to be drawn.

    `moved_px`: (2,) how far the chart lies from its place in the basis. `before`: the frame before, whose light may
    still be seen in a part; None where there is none.
    """
    rest = light.tiles
    systematic = UNIFORMITY.accept if basis.of_primaries else limits.UNEVEN_WHITE
    by = float(np.hypot(*moved_px)) / float(np.diff(frame.places.x_edges).mean())
    # Cells that moved across a tile's edge are others than before, and so is paper that moved over the backdrop.
    systematic = systematic + by * _CONTRAST * _beside(basis)
    allowed = np.maximum(systematic, limits.UNEVEN_SIGMAS * rest.noise)
    excess = np.nan_to_num(rest.relative / allowed, nan=0.0)
    off = excess > 1
    worst = int(excess.argmax())
    # A tile of few cells is not what the camera's colours under white describe; many tiles are.
    least = 1 if basis.of_primaries else max(1, round(limits.UNEVEN_TILES * len(off)))
    late = _share_of_before(basis, light, frame, off, before)
    reason = _uneven_reason(rest, off, late) if off.sum() >= least else ""
    value, limit = (100 * float(np.nan_to_num(number)) for number in (rest.relative[worst], allowed[worst]))
    checks = [Check(UNIFORMITY.name, round(value, 2), None, round(limit, 2), "%", reason)]
    if len(frame.strips):
        checks += _judge_rows(basis, light, frame, moved_px, bool(reason))
    return checks, off if reason else np.zeros_like(off)


def _share_of_before(
    basis: Basis, light: FrameLight, frame: Measured, off: npt.NDArray[np.bool_], before: Seen | None
) -> float:
    """Return for how much of the exposure the tiles off (T,) bool showed the light of the frame before; 0 if another.

    And 0 where that light was so much darker that a shadow explains what is seen as well.
    """
    if before is None or before.amounts is None or not off.any() or not basis.of_primaries:
        return 0.0
    maps = basis.maps[:, off]
    expected, change = (np.einsum("p,ptc->tc", a, maps) for a in (light.amounts, before.amounts - light.amounts))
    seen = frame.tiles[off] - basis.dark[off] - expected
    share, left = _explained(seen, change)
    _, left_by_shadow = _explained(seen, -expected)
    return float(np.median(share)) if left < min(_OF_BEFORE, left_by_shadow / 4) else 0.0


def _explained(seen: _Array, by: _Array) -> tuple[_Array, float]:
    """Return shares (T,) 0 … 1 of what deviates (T, 3) that make up `seen` (T, 3), and the part of its power left.

    Each tile has its own: some are cut by an edge.
    """
    share = np.clip((seen * by).sum(axis=1) / np.maximum((by**2).sum(axis=1), 1e-9), 0, 1)
    left = ((seen - share[:, None] * by) ** 2).sum() / max(float((seen**2).sum()), 1e-9)
    return share, float(left)


def _beside(basis: Basis) -> _Array:
    """Return (T,) float64, ≥ 1: white of the brightest tile beside or at each tile, over its own."""
    strength = np.linalg.norm(basis.maps.sum(axis=0), axis=1).reshape(TILE_ROWS, TILE_COLUMNS)
    return np.asarray(maximum_filter(strength, 3) / np.maximum(strength, 1e-6), dtype=np.float64).ravel()


def _judge_rows(basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, uneven: bool) -> list[Check]:
    """Return whether rows show what belongs into them, and by how much they are blurred if not."""
    down = float(moved_px[1])
    rest = basis.strips(frame, light.amounts, down)
    if rest is None:
        return []
    wrong = _wrong_rows(basis, rest, moved_px)
    count = int(wrong.sum())
    checks = [Check(ROWS.name, float(count), None, float(ROWS.accept))]
    if count <= ROWS.accept:
        return checks
    for sigma in _BLURS:
        soft = basis.strips(frame, light.amounts, down, sigma)
        if soft is not None and _typical(soft) < _EXPLAINED * _typical(rest) and _typical(rest) > _BLURRED:
            reason = (
                f"the frame is out of focus or shaken: its rows are what they were with a blur of {sigma:g} px; was "
                "the focus touched, is autofocus on, or does something shake?"
            )
            return [*checks, Check("blur", sigma, None, None, "px", reason)]
    # Rows of another place are brighter and darker by turns; a shadow or another light is one of both.
    signed = rest.signed[wrong]
    brighter = float((signed > 0).mean())
    ragged = _is_ragged(rest, wrong)
    if uneven and min(brighter, 1 - brighter) < _BY_TURNS and not ragged:
        return checks
    cause = "the file was damaged on its way: check the cable and the memory card"
    if uneven and not ragged:
        # What is drawn on the screen, too, is brighter here and darker there, and goes on from row to row.
        cause = f"look at the picture: a screen saver or a window covers the projector's, or {cause}"
    rows = np.flatnonzero(wrong.reshape(-1, SEGMENTS).any(axis=1))
    reason = (
        f"{len(rows)} rows of blocks, from row {2 * int(rows[0])} of the frame to {2 * int(rows[-1]) + 1}, do not show "
        f"what belongs there; {cause}"
    )
    return [Check(ROWS.name, float(count), None, float(ROWS.accept), "", reason)]


def _is_ragged(rest: Residuals, wrong: npt.NDArray[np.bool_]) -> bool:
    """Return whether strips (S,) bool that deviate do so row by row otherwise; a shadow goes on from row to row."""
    deviation, of = np.nan_to_num(rest.signed).reshape(-1, SEGMENTS), wrong.reshape(-1, SEGMENTS)
    both = of[1:] & of[:-1]
    if np.count_nonzero(both) < ROWS.accept:
        return False
    steps = np.abs(np.diff(deviation, axis=0))[both]
    return bool(np.median(steps) > _RAGGED * np.median(np.abs(rest.signed[wrong])))


def _typical(rest: Residuals) -> float:
    return float(np.nanmedian(np.where(np.isfinite(rest.relative), np.abs(rest.signed), np.nan)))


def _wrong_rows(basis: Basis, rest: Residuals, moved_px: _Array) -> npt.NDArray[np.bool_]:
    """Return which strips (S,) bool deviate."""
    seen = np.isfinite(rest.relative)
    if not seen.any():
        return np.zeros(len(seen), dtype=np.bool_)
    usual = max(robust_sigma(rest.signed[seen]), 1e-6)
    # A row at the print's edge changes with the least movement.
    assert basis.strip_maps is not None
    strength = np.linalg.norm(basis.strip_maps.sum(axis=0), axis=1).reshape(-1, SEGMENTS)
    steep = np.abs(np.gradient(strength, axis=0)).ravel() / np.maximum(strength.ravel(), 1e-6)
    by = float(np.hypot(*moved_px))
    least = limits.ROW_DEVIATION + _EDGE * by + steep * max(by, _UNSEEN_PX)
    room = np.maximum(least, limits.ROW_SIGMAS * np.maximum(usual, rest.noise))
    return np.asarray(np.abs(np.where(seen, rest.signed, 0.0)) > room)


def _uneven_reason(rest: Residuals, off: npt.NDArray[np.bool_], late: float) -> str:
    lit = np.isfinite(rest.relative)
    share = float(off.sum() / max(int(lit.sum()), 1))
    median = float(np.median(rest.signed[off]))
    where = _where(off)
    amount = f"{max(share, 0.01):.0%} of the frame, {where},"
    if late:
        return (
            f"{amount} still showed the light of the frame before, for {max(late, 0.01):.0%} of the exposure: only a "
            "part of the picture had changed, or a window covers it that has that colour; let it settle for longer "
            "(sequence.settle_s), and look for what else draws on the screen"
        )
    if share > _BOTH_PARTS:
        return (
            f"{share:.0%} of the frame are not what the primaries give together; does a screen saver or another "
            "program draw on the screen, did the picture change during the exposure, or does other light fall there?"
        )
    if median < _DARKER:
        return (
            f"{amount} are {-median:.0%} darker than the light of the rest; does somebody or something stand before "
            "the chart or the projector, does a window cover the picture, or did only a part of the picture change?"
        )
    passed = "did somebody walk past, " if median < 0 else ""
    return (
        f"{amount} show another light than the rest, {median:+.0%} bright; {passed}did only a part of the picture "
        "change, does a window cover it or a screen saver draw on it, or does other light fall there?"
    )


def _where(off: npt.NDArray[np.bool_]) -> str:
    """Return in words where tiles are: "top left", "right", "middle"."""
    rows, columns = np.nonzero(off.reshape(TILE_ROWS, TILE_COLUMNS))
    y, x = (float(np.mean(rows)) + 0.5) / TILE_ROWS, (float(np.mean(columns)) + 0.5) / TILE_COLUMNS
    words = ["top" if y < 0.38 else "bottom" if y > 0.62 else "", "left" if x < 0.38 else "right" if x > 0.62 else ""]
    return " ".join(word for word in words if word) or "in the middle"
