"""Judge each frame of a session as it is taken: content, position, sharpness, and agreement with the plan.

Each check returns its value and limits, and a message if it fails. The value is None if it could not be measured. If a
frame fails several checks, only the cause has a message (`CAUSES`), not its consequences.

The amounts of the three primaries in a frame (`acquisition.judge.state`) are compared with a prediction from the
ordered codes, which the projector should show. Colour is compared independently of lamp brightness, which has its own
check. If the colour is wrong, the frame is compared with the previous illuminant, with other illuminants of the plan,
and with the ordered illuminant plus other light. Tiles (regions of a grid on the
frame) and rows that deviate from the rest of the frame are covered, show another picture, or are damaged.
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
    Deviations,
    ExaminedFrame,
    Fit,
    FrameLight,
    JudgeState,
    LampState,
    Prediction,
    ProjectorModel,
    RecentFrame,
    Residuals,
    is_brightest_grey,
    primary_of,
    weighted_mean,
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
from experiment.lights import Illuminant
from experiment.measures.exposure import Exposure
from experiment.measures.frame import SEGMENTS, TILE_COLUMNS, TILE_ROWS, Measured, measure
from experiment.session.records import REFERENCES, Check, Judgement, SessionStep
from foundation.colorimetry import angles_deg, decode_srgb
from foundation.errors import FormatError, RegistrationError, counted
from foundation.robust import robust_sigma

_BEFORE_RESTART = "an error in the first frames was found after the exposure of this frame; they are repeated first"

_UNPREDICTABLE = (
    "this illuminant cannot be predicted, expected accepted frames of black and of each primary; remove the causes of "
    "their refusal"
)


@dataclass(frozen=True, eq=False)
class _FrameChecks:
    """Result of the checks of a frame; `deviating`: (T,) bool, whether each tile deviates; None if not measured."""

    frame: Frame
    checks: tuple[Check, ...]
    light: FrameLight | None = None
    deviating: npt.NDArray[np.bool_] | None = None
    lamp: LampState = field(default_factory=LampState)


class LiveJudge:
    """Judge of the frames of a session: `experiment.session.records.FrameJudge`."""

    def __init__(self, settings: LabSettings, chart: Chart, illuminations: Sequence[Illuminant]) -> None:
        self._settings = settings
        # A chart without tags cannot be used, because it needs corners that a person marks.
        self._chart = chart if settings.judge.chart and chart.tags else None
        self._plan = tuple(dict.fromkeys(light.colour for light in illuminations))
        self._state = self._base = JudgeState()
        self._is_new_run = True

    @property
    def state(self) -> JudgeState:
        """Current state."""
        return self._state

    def recall(self, step: SessionStep, measurement: bytes, accepted: bool) -> None:
        """Update the state by a frame of an earlier run; see `experiment.session.records.FrameJudge.recall`."""
        frame = Frame.from_bytes(measurement) if measurement else None
        if frame is None:
            is_lost = accepted and step.kind in ("white", "dark")
            self._state = replace(self._state, has_lost_reference=self._state.has_lost_reference or is_lost)
            return
        light = None if self._state.basis is None else self._state.basis.light(frame.measured)
        self._state = self._state.updated(step, ExaminedFrame(frame, light, accepted))

    def after_pause(self) -> None:
        """Allow for changes of lamp and chart; see `experiment.session.records.HandlesPauses`."""
        self._state = self._base = self._state.paused()
        self._is_new_run = False

    def judge(self, file: Path, step: SessionStep) -> Judgement:
        """Judge a raw file; see `experiment.session.records.FrameJudge.judge`."""
        if self._is_new_run:
            self.after_pause()
        restart_step, self._state = self._state.restart_step, replace(self._state, restart_step=None)
        if restart_step not in (None, step.number):
            return Judgement.of_reason(OFF_CODES_DEG.name, _BEFORE_RESTART)
        try:
            mosaic = read_raw(file)
        except FormatError as error:
            return Judgement.of_reason("file", str(error))
        fault = filled_fault(mosaic.counts, mosaic.black, mosaic.white_level)
        if fault is not None:
            return Judgement.of_reason("data", f"{file}: {fault}")
        state, black = self._state, frame_black(mosaic)
        result = self._examine(mosaic, black, step)
        checks = _without_consequences(result.checks)
        cause = next((check for check in checks if check.reason), None)
        examined = ExaminedFrame(result.frame, result.light, cause is None, cause.name if cause else "", result.lamp)
        self._state = state.updated(step, examined)
        conflict = _judge_basis(state, self._state) or judge_first_frames(state, step, cause, self._settings.judge)
        if conflict is not None:
            checks, cause = (*(check for check in checks if check.name != conflict.name), conflict), conflict
            refused = state.updated(step, replace(examined, accepted=False, cause=conflict.name))
            self._state = refused.restarted(self._base)
        if cause is None:
            unmeasured = {check.name for check in checks if check.value is None and check.name in ("movement", "blur")}
            self._state = replace(self._state, unmeasured=self._state.unmeasured | unmeasured)
            voids = lasting = False
        elif conflict is not None:
            voids, lasting = True, self._state.restarts > MOST_RESTARTS
        else:
            voids = step.kind in REFERENCES and _voids_earlier_frames(state, cause.name)
            lasting = _is_lasting(self._state, step, cause.name)
        return Judgement(
            checks=checks,
            seen=_paper_rgb(result.frame.paper),
            measurement=result.frame.to_bytes(with_strips=_is_reference(step)),
            preview=self._preview(mosaic, black, state, result, cause),
            voids=voids,
            lasting=lasting,
        )

    def _examine(self, mosaic: Mosaic, black: npt.NDArray[np.float64], step: SessionStep) -> _FrameChecks:
        state, settings = self._state, self._settings
        measured = measure(mosaic, black)
        frame = Frame(measured, np.full(3, np.nan), UNKNOWN_POSITION)
        checks = [
            *_judge_origin(state, mosaic, measured, settings),
            _judge_repeated(state, measured),
            *_judge_exposure(state, measured, step, settings),
        ]
        if any(check.reason for check in checks):
            return _FrameChecks(frame, tuple(checks))
        if state.awaits_primaries and (step.kind == "light" or (step.kind == "response" and not _is_reference(step))):
            return _FrameChecks(frame, (*checks, Check(OFF_CODES_DEG.name, reason=_UNPREDICTABLE)))
        anchor = state.anchor
        if step.kind != "dark" and (anchor is None or (state.resumed and _has_moved(state, mosaic, black, measured))):
            # The first lit frame, which is white, gives the anchor (position of the chart). A resumed run replaces the
            # anchor if the chart was moved.
            try:
                anchor = Anchor.from_white(mosaic, black, self._chart)
            except RegistrationError as error:
                return _FrameChecks(frame, (*checks, Check("chart", reason=str(error))))
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
            return _FrameChecks(frame, (*checks, *dark), light)
        if frame.anchor is None and anchor is not None:
            movement, position = _judge_movement(state, anchor, mosaic, black, frame, settings.judge)
            checks += movement
            frame = replace(frame, moved_px=position)
        if step.kind == "white":
            checks.append(judge_white(state.first_white, frame))
        if is_brightest_grey(step):
            checks.append(judge_white(state.first_grey, frame))
        of_light = self._examine_light(state, frame, step)
        return replace(of_light, checks=(*checks, *of_light.checks))

    def _examine_light(self, state: JudgeState, frame: Frame, step: SessionStep) -> _FrameChecks:
        measured = frame.measured
        primary = primary_of(step.colour) if step.kind == "response" else None
        checks: list[Check] = []
        if primary is not None and not state.has_primaries:
            checks.append(judge_first_primary(state, measured, primary))
        if state.basis is None:
            return _FrameChecks(frame, tuple(checks))
        light = state.basis.light(measured)
        if not state.has_primaries and step.kind == "response":
            # A basis without primaries consists of white, so it cannot describe a frame of one primary.
            return _FrameChecks(frame, tuple(checks), light)
        moved = frame.moved_px if not np.isnan(frame.moved_px).any() else state.moved_px
        previous = state.recent[-1] if state.recent else None
        moved = np.zeros(2) if moved is None else moved
        evenness, uneven = _judge_evenness(state.basis, light, measured, moved, previous)
        judge = self._settings.judge
        of_light, lamp = _judge_light(state, step, light, self._plan, judge.light_deg, judge.drift_percent)
        checks += [*evenness, *of_light]
        if step.kind == "white" and state.has_primaries:
            # This value is only reported; it is never a reason to refuse a frame.
            checks.append(Check(ADDITIVITY.name, round(100 * state.model.overlap, 2), None, None, "%"))
        return _FrameChecks(frame, tuple(checks), light, uneven, lamp)

    def _preview(
        self,
        mosaic: Mosaic,
        black: npt.NDArray[np.float64],
        state: JudgeState,
        result: _FrameChecks,
        cause: Check | None,
    ) -> bytes:
        frame = result.frame
        first = frame.paper if state.first_white is None else state.first_white.paper
        white = np.maximum(first, 1.0)
        if np.isnan(first).any():
            white = np.full(3, max(frame.measured.brightest_dn, 1.0))
        grid, deviating = frame.measured.places, result.deviating
        boxes = [] if deviating is None else [grid.tile_box(tile) for tile in np.flatnonzero(deviating).tolist()]
        outlines = () if self._state.anchor is None else self._state.anchor.outlines
        return preview_jpeg(mosaic, black, white, outlines, boxes, cause.reason if cause else "")


def _is_reference(step: SessionStep) -> bool:
    return step.kind in REFERENCES or (step.kind == "response" and primary_of(step.colour) is not None)


def _paper_rgb(paper: npt.NDArray[np.float64]) -> tuple[float, float, float] | None:
    red, green, blue = paper.tolist()
    return None if np.isnan(paper).any() else (red, green, blue)


def _judge_basis(state: JudgeState, following: JudgeState) -> Check | None:
    # A frame of one primary cannot show whether the chart is partly covered. If it is, all later comparisons are wrong.
    if state.has_primaries or not following.has_primaries or state.white_or_grey is None or following.basis is None:
        return None
    moved = np.zeros(2) if following.moved_px is None else following.moved_px
    checks, _ = _judge_evenness(following.basis, following.basis.light(state.white_or_grey), state.white_or_grey, moved)
    if all(check.passed for check in checks):
        return None
    uneven = next((check for check in checks if check.name == "uniformity"), Check(UNIFORMITY.name))
    text = "" if uneven.passed else f" by {uneven.value} %, at most {uneven.high} % allowed"
    return replace(
        uneven,
        reason=f"red + green + blue differ from the white or grey frame before them{text}; somebody may have stood in "
        "front of the chart, or a window may have covered the projected image. These frames are repeated",
    )


def _judge_origin(
    state: JudgeState, mosaic: Mosaic, measured: Measured, settings: LabSettings
) -> tuple[Check, Check, Check]:
    first = state.first
    reason = ""
    if first is not None:
        size = (measured.places.rows, measured.places.columns)
        for name, expected, value in (
            ("frame size in half-size pixels", f"{first.places.columns}×{first.places.rows}", f"{size[1]}×{size[0]}"),
            ("camera", first.camera, measured.camera),
            ("serial number", first.serial, measured.serial),
        ):
            if expected and value and expected != value and not reason:
                reason = (
                    f"the {name} is {value}, but {expected} in the first frame of the session; connect the camera with "
                    "which the session was started, and set it to full-size raw"
                )
    difference = None if settings.rig == "imported" else disagreement(mosaic, settings.camera.exposure)
    empty = ""
    if measured.empty > EMPTY_PHOTOSITES.accept:
        empty = (
            f"{measured.empty:.2%} of the photosites have no count, at most {EMPTY_PHOTOSITES.accept:.3%} allowed; "
            f"{EMPTY_PHOTOSITES.why}: {EMPTY_PHOTOSITES.remedy}"
        )
    return (
        Check(OTHER_CAMERA.name, reason=reason),
        Check("settings", reason=difference or ""),
        Check(EMPTY_PHOTOSITES.name, round(100 * measured.empty, 4), None, 100 * EMPTY_PHOTOSITES.accept, "%", empty),
    )


def _judge_repeated(state: JudgeState, measured: Measured) -> Check:
    reason = f"{REPEATED.why}; {REPEATED.remedy}"
    if measured.digest in state.digests:
        return Check(REPEATED.name, 0.0, REPEATED.accept, None, "", reason)
    values = [_independence(measured, earlier.measured) for earlier in state.recent]
    value = min((value for value in values if value is not None), default=None)
    if value is None:
        return Check(REPEATED.name)
    return Check(REPEATED.name, round(value, 3), REPEATED.accept, None, "", reason if value < REPEATED.accept else "")


def _independence(frame: Measured, reference: Measured) -> float | None:
    """Return √(1 − r²) for the correlation r of the noise of two frames; None if their noise is too small."""
    if frame.samples.shape != reference.samples.shape or len(frame.samples) == 0:
        return None
    noise, other_noise = frame.green_noise, reference.green_noise
    if min(noise.spread, other_noise.spread) < limits.MIN_NOISE_DN:
        return None
    correlation = float((noise.pattern * other_noise.pattern).mean() / (noise.deviation * other_noise.deviation))
    return float(np.sqrt(max(1 - max(correlation, 0.0) ** 2, 0.0)))


def _judge_exposure(
    state: JudgeState, measured: Measured, step: SessionStep, settings: LabSettings
) -> tuple[Check, Check]:
    exposure = Exposure(measured.clipped, measured.brightest_dn, measured.range_dn)
    # If there is a white frame, `judge_dark` judges the dark frame relative to white.
    is_compared = step.kind == "dark" and state.white is not None
    reason = "" if is_compared else refusal(exposure, step.kind, settings.limits) or ""
    clipped = 100 * measured.clipped > settings.limits.clipped_percent and step.kind != "dark"
    allowed = None if step.kind == "dark" else settings.limits.clipped_percent
    return (
        Check("clipping", round(100 * measured.clipped, 4), None, allowed, "%", reason if clipped else ""),
        Check("exposure", round(100 * exposure.level, 2), None, None, "%", "" if clipped else reason),
    )


UNKNOWN_POSITION: npt.NDArray[np.float64] = np.full(2, np.nan)  # Position of a chart that could not be measured

_CHART_NOT_DETECTED = (
    "the chart was not detected at its last position: it is covered, out of focus, or has moved by more than its tags "
    "can show; check the frame, and restore the positions of camera and chart"
)


def _best_channel(measured: Measured) -> tuple[Channel, float]:
    level = np.maximum(measured.level, 0)
    best = int((level / np.sqrt(measured.noise.variance(level))).argmax())
    return CHANNELS[best], float(level[best])


def _has_moved(state: JudgeState, mosaic: Mosaic, black: npt.NDArray[np.float64], measured: Measured) -> bool:
    assert state.anchor is not None
    channel, level = _best_channel(measured)
    if level < limits.MIN_PAPER_DN / 2:
        return False
    shift = state.anchor.shift(mosaic, black, channel)
    return shift.gauges == 0 or shift.length_px > limits.MOVEMENT_ACCEPTED_PX


def _judge_movement(
    state: JudgeState,
    anchor: Anchor,
    mosaic: Mosaic,
    black: npt.NDArray[np.float64],
    frame: Frame,
    judge: JudgeSettings,
) -> tuple[list[Check], npt.NDArray[np.float64]]:
    """Measure movement and blur relative to the anchor; return also the position of the chart.

    `black`: (2, 2) float64 counts of the frame. The position is (2,) float64 half-size px right and down; NaN if it
    could not be measured.
    """
    channel, _ = _best_channel(frame.measured)
    paper = float(np.nan_to_num(frame.paper[CHANNELS.index(channel)]))
    if paper < limits.MIN_PAPER_DN:
        return [
            Check("movement", None, None, judge.moved_px, "px"),
            Check("blur", None, None, judge.blur_px, "px"),
        ], UNKNOWN_POSITION
    shift = anchor.shift(mosaic, black, channel)
    if shift.gauges == 0:
        large_shift_px = anchor.displacement(mosaic, black, channel)
        if large_shift_px is None:
            return [Check("movement", None, None, judge.moved_px, "px", _CHART_NOT_DETECTED)], UNKNOWN_POSITION
        reason, distance = _movement_reason(large_shift_px, judge.moved_px), round(float(np.hypot(*large_shift_px)), 3)
        return [Check("movement", distance, None, judge.moved_px, "px", reason)], np.array(large_shift_px)
    position = np.array([shift.dx, shift.dy])
    change = position - (state.moved_px if state.moved_px is not None else np.zeros(2))
    moved = float(np.hypot(*change))
    reason = ""
    if moved > judge.moved_px:
        is_repeated = float(np.hypot(*(position - np.array(state.to_confirm[1:])))) <= limits.SAME_POSITION_PX
        is_confirmed = is_repeated and float(np.hypot(*position)) <= limits.MOVEMENT_ACCEPTED_PX
        reason = "" if is_confirmed or state.resumed else _movement_reason(change.tolist(), judge.moved_px)
    checks = [Check("movement", round(moved, 3), None, judge.moved_px, "px", reason)]
    if paper < limits.MIN_PAPER_FOR_BLUR_DN:
        return [*checks, Check("blur", None, None, judge.blur_px, "px")], position
    softer = float(np.sign(shift.blur_growth_px2) * np.sqrt(abs(shift.blur_growth_px2)))
    blurred = ""
    low = -limits.SHARPENING_RATIO * judge.blur_px
    if not low <= softer <= judge.blur_px:
        blurred = (
            f"the frame is {'softer' if softer > 0 else 'sharper'} than the first white frame by a blur of "
            f"{abs(softer):.2f} px, at most {judge.blur_px if softer > 0 else -low:g} px allowed; check the focus, "
            "switch off autofocus and stabilisation, and check for vibrations"
        )
    return [*checks, Check("blur", round(softer, 3), low, judge.blur_px, "px", blurred)], position


def _movement_reason(shift_px: Sequence[float], allowed_px: float) -> str:
    x, y = shift_px
    return (
        f"the chart has moved by {np.hypot(x, y):.2f} px in the image ({x:+.2f} right, {y:+.2f} down), at most "
        f"{allowed_px:g} px allowed; fasten camera and chart, and keep people away"
    )


_DARK_CHANGE_SIGMAS = 6.0  # Significant change of a mean, in standard deviations of its noise

_REGION_TILES = 16  # Tiles in one region of a dark frame. A lamp in a corner lights about as many.

# Largest number of immediate repetitions of the first frames, if later frames contradict them. Most disturbances end
# within a minute; others must be removed by a person.
MOST_RESTARTS: Final = 2

# Checks that compare a frame with earlier frames.
_CONTRADICTIONS: Final = (
    "movement", "blur", "rows", "uniformity",
    OFF_CODES_DEG.name, STRAY_SHARE.name, DARK_DRIFT.name, OFF_BRIGHTNESS.name,
)  # fmt: skip

# Amount of a primary in a dark frame above which the frame may still show the previous illuminant.
_STALE_LIGHT = 0.02


def judge_dark(state: JudgeState, frame: Measured, dark_percent: float, ambient_percent: float) -> tuple[Check, ...]:
    """Check that a dark frame is dark, and that its light has changed little since the first dark frame.

    Both limits are percent of white in the same place and channel. The largest change of 24 regions is judged, so that
    a lamp in a corner is detected.
    """
    if state.white is None:
        return (Check(LEAK_SHARE.name),)
    scale = white_scale(state.white.tiles - (0 if state.dark is None else state.dark.tiles))
    value = dark_level(frame.tiles, scale)
    stale = ""
    previous = state.recent[-1] if state.recent else None
    if value > dark_percent and state.basis is not None and previous is not None and previous.amounts is not None:
        amounts = state.basis.light(frame).amounts
        if amounts.max() > _STALE_LIGHT and _light_distance(amounts, previous.amounts, 0.003) < 2 * limits.STALE_SIGMAS:
            stale = (
                f"the dark frame still shows the previous illuminant, {value:.1f} % of white, at most "
                f"{dark_percent:g} % allowed; check whether the screen is frozen, or increase sequence.settle_s"
            )
    reason = ""
    if value > dark_percent:
        reason = stale or (
            f"the dark frame has {value:.1f} % of white, at most {dark_percent:g} % allowed; switch other lamps off, "
            "and make sure that the projector shows black"
        )
    checks = [Check(OFF_CODES_DEG.name if stale else LEAK_SHARE.name, round(value, 3), None, dark_percent, "%", reason)]
    first = state.first_dark
    if first is not None and not reason:
        changed = _by_region(100 * (frame.tiles - first.tiles) / scale)
        noise = 100 * float(np.sqrt(frame.noise.variance(frame.level).max() / frame.places.tile_blocks.mean()))
        noise /= float(scale.min()) * _REGION_TILES**0.5
        drift = float(np.abs(changed).max())
        black = 100 * BLACK_DN / float(scale.min())
        limit = max(ambient_percent, _DARK_CHANGE_SIGMAS * 2**0.5 * float(np.hypot(noise, black)))
        # Without optical black, the black level is a constant in the file. Its real drift looks like light.
        if not frame.black_measured:
            limit = max(limit, 100 * 8.0 / float(scale.min()))
        reason = ""
        if drift > limit:
            sign = "more" if changed.mean() > 0 else "less"
            reason = (
                f"the room light has changed since the first dark frame by {drift:.2f} % of white ({sign}), at most "
                f"{limit:.2g} % allowed; leave lamps and displays as they were, and keep daylight out"
            )
        checks.append(Check(DARK_DRIFT.name, round(drift, 3), None, round(limit, 3), "%", reason))
    return tuple(checks)


def white_scale(white: _Array) -> _Array:
    """Return the white (T, 3) by which tiles are divided; values are raised to at least a third of the mean."""
    return np.maximum(white, np.maximum(white.mean(axis=0) / 3, 1.0))


def dark_level(tiles: _Array, scale: _Array) -> float:
    """Return the light of a dark frame, percent of white: the larger of mean and 94th percentile of tiles (T, 3)."""
    level = 100 * tiles / scale
    return float(max(level.mean(axis=0).max(), np.percentile(level, 94)))


def _by_region(tiles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    side = round(_REGION_TILES**0.5)
    grid = tiles.reshape(TILE_ROWS // side, side, TILE_COLUMNS // side, side, 3)
    return np.asarray(grid.mean(axis=(1, 3))).reshape(-1, 3)


def judge_white(first: Frame | None, frame: Frame) -> Check:
    """Compare white paper with the first frame under the same illuminant (white, or the brightest grey)."""
    if first is None or np.isnan(frame.paper).any() or np.isnan(first.paper).any():
        return Check(WHITE_DRIFT.name)
    drift = float(100 * (frame.paper.sum() / max(first.paper.sum(), 1.0) - 1))
    reason = ""
    if abs(drift) > limits.MAX_WHITE_DRIFT:
        reason = (
            f"the brightness of white paper has changed by {drift:+.0f} % since the first frame of the session, at "
            f"most ±{limits.MAX_WHITE_DRIFT:g} % allowed; let the lamp warm up, or start a new session"
        )
    return Check(WHITE_DRIFT.name, round(drift, 2), -limits.MAX_WHITE_DRIFT, limits.MAX_WHITE_DRIFT, "%", reason)


def judge_first_primary(state: JudgeState, frame: Measured, primary: int) -> Check:
    """Check that the first frame of a primary shows this primary: its channel is the brightest relative to white."""
    if state.white is None:
        return Check(OFF_CODES_DEG.name)
    dark = np.zeros(3) if state.dark is None else state.dark.level
    share = (frame.level - dark) / np.maximum(state.white.level - dark, 1.0)
    name = ("red", "green", "blue")[primary]
    reason = ""
    if int(share.argmax()) != primary or share[primary] < 0.1:
        content = f"more {('red', 'green', 'blue')[int(share.argmax())]} than {name}"
        reason = (
            f"the frame is {'nearly black' if share.max() < 0.1 else content}, but {name} alone was ordered; check "
            "whether the screen is frozen, or colours are swapped by the cable or the picture mode"
        )
    elif share.min() > 0.9:
        reason = f"the frame is as bright as white, but {name} alone was ordered; check whether the screen is frozen"
    return Check(OFF_CODES_DEG.name, round(100 * float(share[primary]), 1), 10.0, None, "%", reason)


def judge_first_frames(state: JudgeState, step: SessionStep, cause: Check | None, judge: JudgeSettings) -> Check | None:
    """Return the check that shows an error in the first frames of a session or run; None if there is no error.

    The model is learnt from the first frames, so only later frames can show an error in them. One sign is a step that
    is refused twice. The other sign is a white frame that differs from its prediction by the other first frames; it is
    tested with the first illuminant.

    `cause`: the check that refuses the current frame; None if the frame is accepted.
    """
    if not state.is_starting or all(not any(frame.codes) for frame in state.first_frames):
        return None
    check = cause
    if cause is None:
        check = _inconsistent_white(state, judge) if step.kind == "light" else None
    elif cause.name not in _CONTRADICTIONS or step.number not in state.contradicted:
        check = None
    elif state.awaits_primaries and cause.value is None:
        # The frame was refused only because it cannot be predicted without primaries.
        check = None
    if check is None:
        return None
    reason = f"{check.reason}; one of the first frames (white, dark or a primary) may be wrong"
    if state.restarts < MOST_RESTARTS:
        return replace(check, reason=f"{reason}: they are repeated")
    return replace(
        check,
        reason=f"{reason}: they were taken {state.restarts + 1} times and still disagree. Make sure that lamp, room "
        "light and focus are steady; they are repeated after the pause, or when the same command is run again",
    )


def _inconsistent_white(state: JudgeState, judge: JudgeSettings) -> Check | None:
    white = next((frame.measured for frame in state.first_frames if frame.codes == (255, 255, 255)), None)
    model = state.model_without_white()
    if white is None or model is None or state.basis is None:
        return None
    light = state.basis.light(white)
    fit = model.compare(light.amounts, (255, 255, 255), light.covariance)
    limit = max(judge.light_deg, fit.angle_limit(limits.LIGHT_SIGMAS))
    if fit.angle_deg > limit:
        reason = (
            f"the colour of the first white frame differs by {fit.angle_deg:.1f}° from the prediction by grey and "
            f"primary frames, at most {limit:.1f}° allowed"
        )
        return Check(OFF_CODES_DEG.name, round(fit.angle_deg, 3), None, round(limit, 3), "°", reason)
    margin = max(judge.drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    if abs(fit.brightness) > margin:
        percent = 100 * float(np.expm1(fit.brightness))
        reason = (
            f"the brightness of the first white frame differs by {percent:+.1f} % from the prediction by grey and "
            f"primary frames, at most ±{100 * margin:.1f} % allowed"
        )
        return lamp_check(fit.brightness, margin, reason)
    return None


@dataclass(frozen=True)
class _FrameCause:
    """Properties of a check that refuses a frame.

    - `consequences`: checks that fail as a consequence.
    - `is_lasting`: whether every repeated frame fails, too.
    - `is_hidden`: whether only white and dark frames (references) can show the cause. Frames since the last good
      reference are then voided.
    - `is_in_all_lights`: whether every illuminant that can be predicted shows the cause.
    """

    consequences: frozenset[str] = frozenset()
    is_lasting: bool = False
    is_hidden: bool = False
    is_in_all_lights: bool = False


# Checks for added light: in an illuminant, and in a dark frame compared with the first one.
_ADDED_LIGHT = frozenset({STRAY_SHARE.name, DARK_DRIFT.name})

_AMBIENT = _FrameCause(frozenset({OFF_CODES_DEG.name, OFF_BRIGHTNESS.name, "uniformity"}), is_hidden=True)

_LIGHT_CHECKS = frozenset({"uniformity", "blur", OFF_CODES_DEG.name, OFF_BRIGHTNESS.name, WHITE_DRIFT.name})

# If several checks fail, the first one in this order is reported as the cause.
CAUSES: Mapping[str, _FrameCause] = MappingProxyType(
    {
        "file": _FrameCause(),
        OTHER_CAMERA.name: _FrameCause(is_lasting=True),
        "settings": _FrameCause(),
        "data": _FrameCause(),
        "repeated": _FrameCause(),
        "clipping": _FrameCause(),
        "exposure": _FrameCause(),
        "chart": _FrameCause(is_lasting=True),
        "movement": _FrameCause(_LIGHT_CHECKS | {"rows"}),
        "blur": _FrameCause(frozenset({"rows", "uniformity"})),
        "rows": _FrameCause(_LIGHT_CHECKS | _ADDED_LIGHT | {"movement"}, is_in_all_lights=True),
        "uniformity": _FrameCause(
            _LIGHT_CHECKS - {"uniformity"} | _ADDED_LIGHT | {"rows", "movement"}, is_in_all_lights=True
        ),
        OFF_CODES_DEG.name: _FrameCause(_ADDED_LIGHT | {OFF_BRIGHTNESS.name, WHITE_DRIFT.name}, is_in_all_lights=True),
        STRAY_SHARE.name: _AMBIENT,
        DARK_DRIFT.name: _AMBIENT,
        OFF_BRIGHTNESS.name: _FrameCause(is_in_all_lights=True),
        LEAK_SHARE.name: _FrameCause(is_hidden=True),
        WHITE_DRIFT.name: _FrameCause(is_in_all_lights=True),
        ADDITIVITY.name: _FrameCause(),
    }
)

# Uneven light explains a small movement or blur if a tile deviates by this multiple of its limit. A blur of 0.5 px
# alone rarely makes a tile exceed its limit (simulated).
_CLEARLY_UNEVEN = 2.0

# Blur, px, below which rows keep the expected content (simulated). If rows deviate at less blur, wrong rows cause the
# measured blur.
_ROWS_MATCH_PX = 0.7


def _without_consequences(checks: Sequence[Check]) -> tuple[Check, ...]:
    """Return the checks in the order of `CAUSES`, without the messages of the consequences of the first cause."""
    # Two checks may have the same name, such as blur of tags and blur of rows. The failed check is kept.
    by_name = {check.name: check for check in sorted(checks, key=lambda check: bool(check.reason))}
    names = list(CAUSES)
    order = sorted(by_name.values(), key=lambda check: names.index(check.name))
    reasons = [check.name for check in order if check.reason]
    if "movement" in reasons and len(reasons) > 1:
        movement = next(check for check in order if check.name == "movement")
        # A movement has no value if no tag was detected; then another failed check is the cause.
        if movement.value is None:
            reasons.remove("movement")
    blur = by_name.get("blur")
    if "rows" in reasons and "blur" in reasons and blur is not None and abs(blur.value or np.inf) < _ROWS_MATCH_PX:
        reasons.remove("blur")
        by_name["blur"] = replace(blur, reason="")
        order = [by_name[check.name] for check in order]
    uneven = by_name.get("uniformity")
    if uneven is not None and uneven.reason and (uneven.value or 0.0) > _CLEARLY_UNEVEN * (uneven.high or np.inf):
        # Edges of a wrong picture shift and soften the measured edges of the chart.
        for name, limit in (("movement", limits.MOVEMENT_ACCEPTED_PX), ("blur", _ROWS_MATCH_PX)):
            check = by_name.get(name)
            if name in reasons and check is not None and check.value is not None and abs(check.value) < limit:
                reasons.remove(name)
                by_name[name] = replace(check, reason="")
        order = [by_name[check.name] for check in order]
    consequences = CAUSES[reasons[0]].consequences if reasons else frozenset[str]()
    return tuple(replace(check, reason="") if check.name in consequences else check for check in order)


def _voids_earlier_frames(state: JudgeState, cause: str) -> bool:
    hidden = CAUSES[cause].is_hidden or (CAUSES[cause].is_in_all_lights and not state.has_primaries)
    return hidden or cause in state.unmeasured


def _is_lasting(state: JudgeState, step: SessionStep, cause: str) -> bool:
    # A change of the lamp before the start of a run counts as lasting. If it did not, all illuminants before the next
    # white frame would be voided.
    is_changed_lamp = cause == WHITE_DRIFT.name and is_brightest_grey(step)
    # If the first frame of a session is overexposed, so is its repetition.
    is_overexposed = cause == "clipping" and state.white is None
    return is_changed_lamp or is_overexposed or CAUSES[cause].is_lasting or state.refusals[1] >= limits.LASTING_FRAMES


_MIN_SCATTER = 0.0015  # Least relative scatter of amounts between two frames of one illuminant.

_DARK_SCATTER = 4e-4  # Least scatter of amounts in the dark, share of a full primary.

_COMPARED_ILLUMINANTS = 12  # Number of similar illuminants of the plan with which a wrong illuminant is compared.

_PRIMARIES = ("red", "green", "blue")

_MIN_ORDERED_LIGHT = 0.005  # Least ordered light of a primary, share of its full light, that is reported as missing.

# A primary with less than this share of its ordered light is missing. A projector that shows black leaks less light.
_MISSING_SHARE = 0.05

_Array = npt.NDArray[np.float64]


def _judge_light(
    state: JudgeState,
    step: SessionStep,
    light: FrameLight,
    plan: Sequence[Codes],
    angle_deg: float,
    drift_percent: float,
) -> tuple[tuple[Check, ...], LampState]:
    """Compare the light of a frame with the codes of its step; return the checks and the state of the lamp."""
    codes = step.colour
    previous = state.recent[-1] if state.recent else None
    if not state.has_primaries:
        return (_without_model(light, codes, previous),), LampState()
    comparison = _LightComparison(state.model, light, codes, previous, plan)
    fit = comparison.fit
    limit = max(angle_deg, fit.angle_limit(limits.LIGHT_SIGMAS))
    margin = max(drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    is_wrong = fit.angle_deg > limit
    reason, added = "", 0.0
    if is_wrong or fit.distance > limits.STALE_SIGMAS or abs(fit.brightness) > margin:
        reason, added = comparison.cause(is_wrong, margin, was_refused=state.refusals[0] == OFF_CODES_DEG.name)
    stepped = False
    lamp = ""
    if not reason and abs(fit.brightness) > margin:
        level = state.to_confirm[0]
        # A small step of the lamp that two frames show is accepted, because each illuminant has its own ground truth.
        stepped = abs(fit.brightness) <= limits.LAMP_STEP_ACCEPTED and abs(fit.brightness - level) <= margin / 2
        lamp = "" if stepped else _brightness_reason(fit.brightness, margin)
    deviations = Deviations(((fit.brightness, fit.brightness_sd),), (comparison.neutral_light(),))
    if not reason and not lamp and not stepped and not state.resumed:
        lamp, added = slow_change(state.deviations.extended(deviations), drift_percent / 100)
        reason = _ambient_reason(added) if added else ""
    ambient = (Check(STRAY_SHARE.name, round(100 * added, 2), None, None, "%", reason),) if added else ()
    checks = (
        *ambient,
        Check(OFF_CODES_DEG.name, round(fit.angle_deg, 3), None, round(limit, 3), "°", "" if added else reason),
        lamp_check(fit.brightness, margin, lamp),
    )
    return checks, LampState(fit.brightness, stepped, deviations)


def lamp_check(brightness: float, margin: float, reason: str) -> Check:
    """Return the check of `brightness`, the logarithm of measured over predicted brightness, with limit `margin`.

    If `margin` exceeds `MAX_WHITE_DRIFT`, the scatter of the lamp is unknown, and the check has no limit.
    """
    allowed = round(100 * margin, 2) if 100 * margin < limits.MAX_WHITE_DRIFT else None
    low = None if allowed is None else -allowed
    return Check(OFF_BRIGHTNESS.name, round(100 * float(np.expm1(brightness)), 2), low, allowed, "%", reason)


def slow_change(deviations: Deviations, drift: float) -> tuple[str, float]:
    """Judge the last frames together; return a message about a changed lamp, and the added light (share of white).

    Return ("", 0.0) if nothing is significant. `drift`: change of brightness that is always allowed, 0 … 1.
    """
    for count in range(2, len(deviations.lamp) + 1):
        added, sd = weighted_mean(deviations.added[:count])
        if added > max(limits.MIN_ADDED_LIGHT, limits.ADDED_SIGMAS * sd):
            return "", added
        brightness, sd = weighted_mean(deviations.lamp[:count])
        if abs(brightness) > (margin := max(drift, limits.BRIGHTNESS_SIGMAS * sd)):
            return _brightness_reason(brightness, margin), 0.0
    return "", 0.0


def _light_distance(amounts: _Array, reference: _Array, scatter: float) -> float:
    """Return the distance of the amounts (3,) of two frames in standard deviations; `scatter` is relative."""
    sd = max(scatter, _MIN_SCATTER)
    variance = 2 * ((sd * np.maximum(amounts, reference)) ** 2 + _DARK_SCATTER**2)
    return float(np.sqrt(((amounts - reference) ** 2 / variance).sum()))


@dataclass(frozen=True, eq=False)
class _LightComparison:
    """Comparison of the light of a frame with the ordered `codes` and with other explanations.

    - `previous`: the previous frame, or None.
    - `plan`: codes of all illuminants.
    """

    model: ProjectorModel
    light: FrameLight
    codes: Codes
    previous: RecentFrame | None
    plan: Sequence[Codes]

    @cached_property
    def expected(self) -> Prediction:
        """Predicted amounts."""
        return self.model.predict(self.codes)

    @cached_property
    def fit(self) -> Fit:
        """Agreement with the ordered codes."""
        return self.model.compare(self.light.amounts, self.codes, self.light.covariance)

    def cause(self, is_wrong: bool, margin: float, *, was_refused: bool) -> tuple[str, float]:
        """Return the message about a wrong colour, or "", and the light added to the ordered illuminant.

        `is_wrong`: whether the colour is beyond its limit. `margin`: allowed change of log lamp brightness.
        `was_refused`: whether the previous frame was also refused for its colour.
        """
        fit = self.fit
        squared = fit.distance**2 + (fit.brightness / fit.brightness_sd) ** 2
        distance = self._distance_to_previous()
        changed = self.previous is not None and self.previous.codes != self.codes
        fits_previous = distance < limits.LIGHT_SIGMAS and squared - distance**2 > limits.STALE_ADVANTAGE
        if self.previous is not None and changed and fits_previous:
            return _stale_reason(self.previous, self.codes), 0.0
        missing = self._missing_reason()
        if missing:
            return missing, 0.0
        remains, ambient = self._added_light(self.previous), self._added_light(None)
        if is_wrong and remains is not None and (ambient is None or remains[1] + 9 < ambient[1]):
            other_light = ", and check whether other light falls on the chart" if self._coloured_light() else ""
            return (
                f"the frame still has {100 * remains[0]:.1f} % of the previous illuminant; increase sequence.settle_s, "
                f"switch off dynamic contrast and frame interpolation{other_light}",
                0.0,
            )
        if is_wrong:
            if ambient is not None:
                return _ambient_reason(ambient[0]), ambient[0]
            other_illuminant = self._other_reason(squared)
            coloured = 0.0 if other_illuminant else self._coloured_light()
            if coloured:
                return _ambient_reason(coloured), coloured
            repeated = was_refused and not changed and distance < limits.LIGHT_SIGMAS
            if repeated and not other_illuminant and fit.angle_deg <= limits.ANGLE_ACCEPTED_DEG:
                return "", 0.0
            return other_illuminant or self._wrong_reason(), 0.0
        if fit.brightness > margin and ambient is not None and ambient[1] + 9 < fit.distance**2:
            return _ambient_reason(ambient[0]), ambient[0]
        if fit.distance > limits.STALE_SIGMAS:
            return self._other_reason(squared), 0.0
        return "", 0.0

    def neutral_light(self) -> tuple[float, float]:
        """Return the neutral light added to the ordered illuminant, share of white, and its standard deviation."""
        ordered, neutral = self.expected.amounts, np.ones(3)
        scatter = self.model.brightness_sd**2 * np.outer(ordered, ordered)
        weight = np.linalg.inv(self.expected.with_lamp + self.light.covariance + scatter)
        power = float(neutral @ weight @ neutral)
        return float(neutral @ weight @ (self.light.amounts - ordered)) / power, power**-0.5

    def _distance_to_previous(self) -> float:
        """Return the distance to the previous illuminant in standard deviations; infinite if it is unknown."""
        if self.previous is None or self.previous.amounts is None:
            return np.inf
        return _light_distance(self.light.amounts, self.previous.amounts, self.model.chroma_sd)

    def _missing_reason(self) -> str:
        amounts, ordered = self.light.amounts, self.expected.amounts
        sd = np.sqrt(
            np.diag(self.expected.with_lamp + self.light.covariance) + (self.model.brightness_sd * ordered) ** 2
        )
        is_ordered = ordered > np.maximum(_MIN_ORDERED_LIGHT, limits.LIGHT_SIGMAS * sd)
        is_missing = is_ordered & (amounts < _MISSING_SHARE * ordered)
        if (
            not is_missing.any()
            or (np.abs(amounts - ordered) > limits.LIGHT_SIGMAS * sd)[~is_missing].any()
            or not (is_ordered & ~is_missing).any()
        ):
            return ""
        names = " and ".join(name for name, missing in zip(_PRIMARIES, is_missing, strict=True) if missing)
        return (
            f"the light of {names} is missing, the rest is as ordered ({self._amounts_text()}); check the {names} "
            "lamp, panel and filter of the projector, the video cable, and the picture mode"
        )

    def _amounts_text(self) -> str:
        primaries = zip(_PRIMARIES, self.light.amounts, self.expected.amounts, strict=True)
        return ", ".join(
            f"{name} {100 * max(amount, 0.0):.1f} % instead of {100 * ordered:.1f} %"
            for name, amount, ordered in primaries
        )

    def _wrong_reason(self) -> str:
        darker = bool((self.light.amounts < self.expected.amounts).all())
        dimmed = "brightness or contrast was changed, power saving is on, or " if darker else ""
        return (
            f"the illuminant is not the ordered {_codes_text(self.codes)}: it has {self._amounts_text()} of the full "
            f"primaries; check whether {dimmed}a window, a screen saver or a picture mode changes the projected image"
        )

    def _other_reason(self, squared: float) -> str:
        # Black or white may also be shown instead of the ordered illuminant.
        best: tuple[float, Codes] | None = None
        # The full comparison is slow, so only codes of similar amounts are compared.
        for codes in self._nearest([*self.plan, (0, 0, 0), (255, 255, 255)]):
            if codes == self.codes:
                continue
            if not any(codes):
                distance = float(((self.light.amounts / (3 * _DARK_SCATTER)) ** 2).sum())
            else:
                fit = self.model.compare(self.light.amounts, codes, self.light.covariance)
                distance = fit.distance**2 + (fit.brightness / (fit.brightness_sd + 0.01)) ** 2
            if best is None or distance < best[0]:
                best = distance, codes
        if best is None or squared - best[0] < limits.OTHER_ADVANTAGE or best[0] > limits.LIGHT_SIGMAS**2:
            return ""
        # Faint coloured light can make an illuminant look like a similar one of the plan.
        causes = "the projected image is late, or other light falls on the chart" if self._coloured_light() else ""
        return (
            f"the frame shows another illuminant, {_codes_text(best[1])}, but {_codes_text(self.codes)} was ordered; "
            f"check whether another program draws on the screen, {causes or 'or the projected image is late'}"
        )

    def _nearest(self, plan: Sequence[Codes]) -> list[Codes]:
        curves = self.model.curves()
        table = np.array(plan)
        predicted = np.stack([curves[primary, table[:, primary]] for primary in range(3)], axis=-1)
        distance = np.linalg.norm(predicted - self.light.amounts, axis=1)
        return [plan[k] for k in np.argsort(distance, kind="stable")[:_COMPARED_ILLUMINANTS].tolist()]

    def _added_light(self, source: RecentFrame | None) -> tuple[float, float] | None:
        """Return the added neutral light, or the share of another frame's light, that explains the measured light.

        The second value is the remaining squared distance. None if the added light is not significant, or does not
        explain the frame. `source`: the other frame; None for neutral light.
        """
        ordered = self.expected.amounts
        if source is None:
            direction = np.ones(3)
        elif source.amounts is None or source.codes == self.codes or not any(source.codes):
            return None
        else:
            # During a share of the exposure, the other illuminant was shown in place of the ordered one.
            direction = source.amounts - ordered
        # Only the added light is fitted. Lamp brightness may vary within its scatter.
        scatter = (self.model.brightness_sd**2 + 1e-6) * np.outer(ordered, ordered)
        weight = np.linalg.inv(self.expected.covariance + self.light.covariance + scatter)
        power = float(direction @ weight @ direction)
        added = float(direction @ weight @ (self.light.amounts - ordered)) / power
        residual = self.light.amounts - ordered - added * direction
        distance = float(residual @ weight @ residual)
        if added <= 4 * power**-0.5 or added < 0.002 or distance > limits.LIGHT_SIGMAS**2:
            return None
        return added, distance

    def _coloured_light(self) -> float:
        """Return the mean added light, share of white; 0 if it is out of range or a primary is too dark."""
        ordered = self.expected.amounts
        excess = self.light.amounts - ordered
        variance = np.diag(self.expected.with_lamp + self.light.covariance) + (self.model.brightness_sd * ordered) ** 2
        mean = float(np.mean(excess))
        is_added = (excess > -3 * np.sqrt(variance)).all() and limits.MIN_ADDED_LIGHT < mean < limits.MAX_ADDED_LIGHT
        return mean if is_added else 0.0


def _ambient_reason(added: float) -> str:
    return (
        f"other light than the projector's falls on the chart, {100 * added:.1f} % of white; darken the room, close "
        "the door, cover lamps and displays"
    )


def _brightness_reason(brightness: float, margin: float) -> str:
    percent = 100 * float(np.expm1(brightness))
    weaker, stronger = ("weaker", "keep people out of the light"), ("stronger", "darken the room")
    sign, remedy = weaker if percent < 0 else stronger
    return (
        f"the light is {abs(percent):.1f} % {sign} than predicted and has the right colour, at most {100 * margin:.1f} "
        "% allowed; check the lamp and its power mode, the brightness of the projected image, shutter and aperture, "
        f"and {remedy}"
    )


def _without_model(light: FrameLight, codes: Codes, last: RecentFrame | None) -> Check:
    if last is None or last.amounts is None or last.codes == codes or not any(codes) or not any(last.codes):
        return Check(OFF_CODES_DEG.name)
    linear = np.array([decode_srgb(np.array(c) / 255) for c in (codes, last.codes)])
    away = float(angles_deg(linear[:1], linear[1:])[0])
    brighter = abs(float(np.log(linear[0].sum() / linear[1].sum())))
    same = _light_distance(light.amounts, last.amounts, 0.005)
    reason = ""
    if same < 2 * limits.STALE_SIGMAS and (away > limits.DISTINCT_CODES_DEG or brighter > 0.2):
        reason = _stale_reason(last, codes)
    return Check(OFF_CODES_DEG.name, reason=reason)


def _stale_reason(last: RecentFrame, codes: Codes) -> str:
    return (
        f"the frame still shows the previous illuminant, {_codes_text(last.codes)}, but {_codes_text(codes)} was "
        "ordered; check whether the screen is frozen, or increase sequence.settle_s"
    )


def _codes_text(codes: Codes) -> str:
    return "black" if not any(codes) else "({}, {}, {})".format(*codes)


# Median relative deviation below which tiles are reported as covered.
_COVERED_DEVIATION = -0.1

# Share of the squared deviation that may remain unexplained if tiles still show the previous illuminant. This is an
# angle of 6°.
_PREVIOUS_RESIDUAL = 0.01

_WHOLE_FRAME = 0.5  # Share of deviating tiles above which the whole frame deviates.

# Blurs σ, half-size px, that are tried if rows deviate.
_TRIED_BLURS_PX = (0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)

# If a blur is the cause, at most this share of the median deviation remains after blurring the expected rows.
_REMAINING_DEVIATION = 0.4

# Median relative deviation of rows above which blurs are tried. If it is smaller, only some rows deviate.
_MIN_DEVIATION = 0.02

_EDGE_CONTRAST = 2.0  # Relative contrast of the chart (tags, paper, patches) at the edges of a tile.

# If rows are from other places, at least this share of the deviating rows is brighter, and at least this share darker.
_RARER_SIGN_SHARE = 0.1

# Rows are from several places if their deviation changes from row to row by more than this share of its median.
# Shadows, windows and parts of a picture have at most 0.03, scrambled rows at least 0.2 (simulated).
_RAGGED_STEP = 0.1

# Movement or blur, px, that is allowed for rows at the edges of the chart, because it cannot always be measured.
_UNMEASURED_PX = 1.0

# Relative change of a strip per px of sideways movement. The movement brings other patches to the ends of the strip.
_ROW_EDGE_CHANGE = 0.15


def _judge_evenness(
    basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, previous: RecentFrame | None = None
) -> tuple[list[Check], npt.NDArray[np.bool_]]:
    """Check that a lit frame shows one illuminant everywhere; return also which tiles (T,) bool deviate.

    `moved_px`: (2,) displacement of the chart since the frames of the basis. `previous`: the previous frame or None; a
    part of the current frame may still show its illuminant.
    """
    residuals = light.tiles
    systematic = UNIFORMITY.accept if basis.shows_primaries else limits.UNEVEN_WITHOUT_PRIMARIES
    shift_tiles = float(np.hypot(*moved_px)) / float(np.diff(frame.places.x_edges).mean())
    # Movement brings other patches, or paper instead of the backdrop, into a tile.
    systematic = systematic + shift_tiles * _EDGE_CONTRAST * _neighbour_contrast(basis)
    allowed = np.maximum(systematic, limits.UNEVEN_SIGMAS * residuals.noise)
    excess = np.nan_to_num(residuals.relative / allowed, nan=0.0)
    deviating = excess > 1
    worst = int(excess.argmax())
    # The coarse basis from white describes single tiles badly, so more of them must deviate.
    least_tiles = 1 if basis.shows_primaries else max(1, round(limits.UNEVEN_TILES * len(deviating)))
    previous_share = _share_of_previous(basis, light, frame, deviating, previous)
    reason = _uneven_reason(residuals, deviating, previous_share) if deviating.sum() >= least_tiles else ""
    value, limit = (100 * float(np.nan_to_num(number)) for number in (residuals.relative[worst], allowed[worst]))
    checks = [Check(UNIFORMITY.name, round(value, 2), None, round(limit, 2), "%", reason)]
    if len(frame.strips):
        checks += _judge_rows(basis, light, frame, moved_px, bool(reason))
    return checks, deviating if reason else np.zeros_like(deviating)


def _share_of_previous(
    basis: Basis, light: FrameLight, frame: Measured, deviating: npt.NDArray[np.bool_], previous: RecentFrame | None
) -> float:
    """Return the share of the exposure during which the tiles `deviating` (T,) bool showed the previous illuminant.

    The share is 0 if another illuminant was shown, or if a shadow explains the deviation as well.
    """
    if previous is None or previous.amounts is None or not deviating.any() or not basis.shows_primaries:
        return 0.0
    maps = basis.maps[:, deviating]
    expected, change = (np.einsum("p,ptc->tc", a, maps) for a in (light.amounts, previous.amounts - light.amounts))
    deviation = frame.tiles[deviating] - basis.dark[deviating] - expected
    share, residual = _fitted_share(deviation, change)
    _, shadow_residual = _fitted_share(deviation, -expected)
    return float(np.median(share)) if residual < min(_PREVIOUS_RESIDUAL, shadow_residual / 4) else 0.0


def _fitted_share(deviation: _Array, change: _Array) -> tuple[_Array, float]:
    """Return the shares (T,) 0 … 1 of `change` (T, 3) in `deviation` (T, 3), and the share that is not explained."""
    share = np.clip((deviation * change).sum(axis=1) / np.maximum((change**2).sum(axis=1), 1e-9), 0, 1)
    residual = ((deviation - share[:, None] * change) ** 2).sum() / max(float((deviation**2).sum()), 1e-9)
    return share, float(residual)


def _neighbour_contrast(basis: Basis) -> _Array:
    """Return (T,) float64, ≥ 1: white of the brightest neighbour of each tile, relative to white of the tile."""
    strength = np.linalg.norm(basis.maps.sum(axis=0), axis=1).reshape(TILE_ROWS, TILE_COLUMNS)
    return np.asarray(maximum_filter(strength, 3) / np.maximum(strength, 1e-6), dtype=np.float64).ravel()


def _judge_rows(basis: Basis, light: FrameLight, frame: Measured, moved_px: _Array, uneven: bool) -> list[Check]:
    down = float(moved_px[1])
    sharp = basis.strips(frame, light.amounts, down)
    if sharp is None:
        return []
    is_wrong = _wrong_rows(basis, sharp, moved_px)
    count = int(is_wrong.sum())
    checks = [Check(ROWS.name, float(count), None, float(ROWS.accept))]
    if count <= ROWS.accept:
        return checks
    for sigma in _TRIED_BLURS_PX:
        soft = basis.strips(frame, light.amounts, down, sigma)
        if (
            soft is not None
            and _deviation(soft) < _REMAINING_DEVIATION * _deviation(sharp)
            and _deviation(sharp) > _MIN_DEVIATION
        ):
            reason = (
                f"the frame is out of focus or shaken: its rows match with an additional blur of {sigma:g} px; check "
                "the focus, switch off autofocus, and check for vibrations"
            )
            return [*checks, Check("blur", sigma, None, None, "px", reason)]
    # Rows from other places are partly brighter and partly darker. A shadow or other light has one sign everywhere.
    signed = sharp.signed[is_wrong]
    brighter = float((signed > 0).mean())
    ragged = _is_ragged(sharp, is_wrong)
    if uneven and min(brighter, 1 - brighter) < _RARER_SIGN_SHARE and not ragged:
        return checks
    cause = "the file was damaged during transfer: check the cable and the memory card"
    if uneven and not ragged:
        # A drawing also makes some rows brighter and some darker, but changes little from row to row.
        cause = f"check the frame: a screen saver or a window covers the projected image, or {cause}"
    rows = np.flatnonzero(is_wrong.reshape(-1, SEGMENTS).any(axis=1))
    reason = (
        f"{counted(len(rows), 'row')} of 2×2 blocks, frame rows {2 * int(rows[0])} to {2 * int(rows[-1]) + 1}, "
        f"do not have the expected content; {cause}"
    )
    return [Check(ROWS.name, float(count), None, float(ROWS.accept), "", reason)]


def _is_ragged(residuals: Residuals, wrong_strips: npt.NDArray[np.bool_]) -> bool:
    # The deviation of a shadow changes little from row to row, that of scrambled rows changes much.
    deviation, is_wrong = np.nan_to_num(residuals.signed).reshape(-1, SEGMENTS), wrong_strips.reshape(-1, SEGMENTS)
    are_neighbours = is_wrong[1:] & is_wrong[:-1]
    if np.count_nonzero(are_neighbours) < ROWS.accept:
        return False
    steps = np.abs(np.diff(deviation, axis=0))[are_neighbours]
    return bool(np.median(steps) > _RAGGED_STEP * np.median(np.abs(residuals.signed[wrong_strips])))


def _deviation(residuals: Residuals) -> float:
    return float(np.nanmedian(np.where(np.isfinite(residuals.relative), np.abs(residuals.signed), np.nan)))


def _wrong_rows(basis: Basis, residuals: Residuals, moved_px: _Array) -> npt.NDArray[np.bool_]:
    is_measured = np.isfinite(residuals.relative)
    if not is_measured.any():
        return np.zeros(len(is_measured), dtype=np.bool_)
    usual = max(robust_sigma(residuals.signed[is_measured]), 1e-6)
    # A row at an edge of the chart changes with the smallest movement.
    assert basis.strip_maps is not None
    strength = np.linalg.norm(basis.strip_maps.sum(axis=0), axis=1).reshape(-1, SEGMENTS)
    steep = np.abs(np.gradient(strength, axis=0)).ravel() / np.maximum(strength.ravel(), 1e-6)
    shift_px = float(np.hypot(*moved_px))
    least_limit = limits.ROW_DEVIATION + _ROW_EDGE_CHANGE * shift_px + steep * max(shift_px, _UNMEASURED_PX)
    limit = np.maximum(least_limit, limits.ROW_SIGMAS * np.maximum(usual, residuals.noise))
    return np.asarray(np.abs(np.where(is_measured, residuals.signed, 0.0)) > limit)


def _uneven_reason(residuals: Residuals, deviating: npt.NDArray[np.bool_], previous_share: float) -> str:
    lit = np.isfinite(residuals.relative)
    share = float(deviating.sum() / max(int(lit.sum()), 1))
    median = float(np.median(residuals.signed[deviating]))
    amount = f"{max(share, 0.01):.0%} of the frame, {_position_text(deviating)},"
    if previous_share:
        return (
            f"{amount} still showed the previous illuminant for {max(previous_share, 0.01):.0%} of the exposure: only "
            "part of the projected image had changed, or a window of that colour covers it; increase "
            "sequence.settle_s, and close other programs that draw on the screen"
        )
    if share > _WHOLE_FRAME:
        return (
            f"{share:.0%} of the frame differ from the sum of the primaries; check whether a screen saver or another "
            "program draws on the screen, the projected image changed during the exposure, or other light falls on "
            "the chart"
        )
    if median < _COVERED_DEVIATION:
        return (
            f"{amount} are {-median:.0%} darker than the rest; check whether a person or an object is in front of "
            "the chart or the projector, a window covers the projected image, or only part of the projected image has "
            "changed"
        )
    passed = "somebody walked past, " if median < 0 else ""
    return (
        f"{amount} are lit differently from the rest, by {median:+.0%}; check whether {passed}only part of the "
        "projected image has changed, a window or a screen saver covers it, or other light falls on the chart"
    )


def _position_text(deviating: npt.NDArray[np.bool_]) -> str:
    rows, columns = np.nonzero(deviating.reshape(TILE_ROWS, TILE_COLUMNS))
    y, x = (float(np.mean(rows)) + 0.5) / TILE_ROWS, (float(np.mean(columns)) + 0.5) / TILE_COLUMNS
    words = ["top" if y < 0.38 else "bottom" if y > 0.62 else "", "left" if x < 0.38 else "right" if x > 0.62 else ""]
    return " ".join(word for word in words if word) or "in the middle"
