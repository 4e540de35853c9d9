"""What is asked of a frame besides its light: file, camera, exposure, the chart's place, darkness, drift.

Each check has its number and its limits, also where it passes, and the sentence that a person is told where it fails.
`CAUSES` says which of a frame's faults is named, and what it means for the frames around it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from acquisition.judge import limits
from acquisition.judge.light import BLACK_DN
from acquisition.judge.light_checks import lamp_check, same_light
from acquisition.judge.measure import TILE_COLUMNS, TILE_ROWS, Anchor, Exposure, Frame, Measured, disagreement, refusal
from acquisition.judge.state import JudgeState, is_brightest_grey
from drivers.raw.rawfile import Mosaic
from experiment.config import JudgeSettings, LabSettings
from experiment.framing.planes import CHANNELS, Channel
from experiment.session.records import Check, SessionStep


def judge_file(
    state: JudgeState, mosaic: Mosaic, measured: Measured, step: SessionStep, settings: LabSettings
) -> tuple[Check, ...]:
    """Return what is said of a frame's file and exposure, before anything is looked for in its picture."""
    return (
        *_judge_origin(state, mosaic, measured, settings),
        _judge_repeated(state, measured, settings),
        *_judge_exposure(state, measured, step, settings),
    )


def _judge_origin(
    state: JudgeState, mosaic: Mosaic, measured: Measured, settings: LabSettings
) -> tuple[Check, Check, Check]:
    """Return whether the file is of the session's camera, exposed as asked, and whole."""
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


def _judge_repeated(state: JudgeState, measured: Measured, settings: LabSettings) -> Check:
    """Return whether the camera gave a frame again that it gave before: its noise is the same."""
    if settings.rig == "replay":
        # A recording has one frame of a light, and gives it as often as it is asked.
        return Check("repeated")
    reason = "the camera handed out a frame that it had given before; check its cable and its memory card"
    if measured.digest in state.digests:
        return Check("repeated", 0.0, limits.SAME_NOISE, None, "", reason)
    values = [_independence(measured, seen.measured) for seen in state.recent]
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


UNKNOWN_PLACE: npt.NDArray[np.float64] = np.full(2, np.nan)
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


def has_moved_far(state: JudgeState, mosaic: Mosaic, black: npt.NDArray[np.float64], measured: Measured) -> bool:
    """Return whether the chart lies elsewhere than in the earlier run; `black` (2, 2) float64 counts of the frame."""
    assert state.anchor is not None
    channel, level = best_channel(measured)
    if level < limits.DIM_DN / 2:
        return False
    shift = state.anchor.shift(mosaic, black, channel)
    return shift.gauges == 0 or shift.length_px > limits.MOVED_FOLLOWED_PX


def judge_movement(
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
    channel, _ = best_channel(frame.measured)
    paper = _paper_in(frame, channel)
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


def _paper_in(frame: Frame, channel: Channel) -> float:
    paper = float(frame.paper[CHANNELS.index(channel)])
    return 0.0 if np.isnan(paper) else paper


_SIGMAS = 6.0
"""Standard deviations of a mean's noise that no change is made of."""

_TILES = 16
"""Tiles that are averaged before their change in the dark is looked at: a lamp in a corner lights as many."""

MOST_RESTARTS: Final = 2
"""How often first frames are taken again at once because others contradict them: what passes does so within a minute,
and what comes back for the third time wants somebody who looks."""

_CONTRADICTIONS: Final = ("movement", "blur", "rows", "uniformity", "light", "ambient", "lamp")
"""Checks that hold a frame against those before it."""

_STALE_LEAST = 0.02
"""Amount of light in a dark frame, of a primary, from which on the frame before may be what is seen."""


def judge_dark(state: JudgeState, frame: Measured, dark_percent: float, ambient_percent: float) -> tuple[Check, ...]:
    """Return whether a dark frame is dark, and changed by no more than `ambient_percent` of white since the first.

    Both limits are per cent of what white gives in the same place and channel; the change is that of the region, one of
    24, that changed most, so that a lamp in a corner shows.
    """
    if state.white is None:
        return (Check("dark"),)
    white = state.white.tiles - (0 if state.dark is None else state.dark.tiles)
    # Of a tile that white hardly lights, such as a black backdrop, against a third of the mean.
    scale = np.maximum(white, np.maximum(white.mean(axis=0) / 3, 1.0))
    level = 100 * frame.tiles / scale
    value = float(max(level.mean(axis=0).max(), np.percentile(level, 94)))
    stale = ""
    before = state.recent[-1] if state.recent else None
    if value > dark_percent and state.basis is not None and before is not None and before.amounts is not None:
        amounts = state.basis.light(frame).amounts
        if amounts.max() > _STALE_LEAST and same_light(amounts, before.amounts, 0.003) < 2 * limits.STALE_SIGMAS:
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
    checks = [Check("light" if stale else "dark", round(value, 3), None, dark_percent, "%", reason)]
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
        checks.append(Check("ambient", round(drift, 3), None, round(limit, 3), "%", reason))
    return tuple(checks)


def _by_region(tiles: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return means (24, 3) of 4×4 tiles each of tiles (T, 3)."""
    side = round(_TILES**0.5)
    grid = tiles.reshape(TILE_ROWS // side, side, TILE_COLUMNS // side, side, 3)
    return np.asarray(grid.mean(axis=(1, 3))).reshape(-1, 3)


def white_overlap(state: JudgeState) -> Check:
    """Return how far white is beyond the sum of the primaries; told, and never a reason to refuse."""
    return Check("additivity", round(100 * state.model.overlap, 2), None, None, "%")


def judge_white(first: Frame | None, frame: Frame) -> Check:
    """Return how far paper is from that of the session's first frame of this light, white or the brightest grey."""
    if first is None or np.isnan(frame.paper).any() or np.isnan(first.paper).any():
        return Check("white drift")
    drift = float(100 * (frame.paper.sum() / max(first.paper.sum(), 1.0) - 1))
    reason = ""
    if abs(drift) > limits.LAMP_TOTAL:
        reason = (
            f"paper white is {drift:+.0f} % from the session's first frame, {limits.LAMP_TOTAL:g} % allowed; let "
            "the lamp warm up, or begin a new session"
        )
    return Check("white drift", round(drift, 2), -limits.LAMP_TOTAL, limits.LAMP_TOTAL, "%", reason)


def judge_first_primary(state: JudgeState, frame: Measured, primary: int) -> Check:
    """Return whether the first frame of a primary shows it: against white, its own channel is the brightest.

    Of a frame's three channels none sees another's primary better than its own, whatever the camera.
    """
    if state.white is None:
        return Check("light")
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
    return Check("light", round(100 * float(share[primary]), 1), 10.0, None, "%", reason)


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
        return Check("light", round(fit.angle_deg, 3), None, round(limit, 3), "°", said)
    room = max(judge.drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    if abs(fit.brightness) > room:
        percent = 100 * float(np.expm1(fit.brightness))
        said = f"the first white frame is {percent:+.1f} % as bright as greys and primaries foretell"
        return lamp_check(fit.brightness, room, said)
    return None


@dataclass(frozen=True)
class FrameCause:
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


_OF_THE_LIGHT = frozenset({"uniformity", "blur", "light", "lamp", "white drift"})

CAUSES: Mapping[str, FrameCause] = MappingProxyType(
    {
        "file": FrameCause(),
        "camera": FrameCause(lasts=True),
        "settings": FrameCause(),
        "data": FrameCause(),
        "repeated": FrameCause(),
        "clipping": FrameCause(),
        "exposure": FrameCause(),
        "chart": FrameCause(lasts=True),
        "movement": FrameCause(_OF_THE_LIGHT | {"rows"}),
        "blur": FrameCause(frozenset({"rows", "uniformity"})),
        "rows": FrameCause(_OF_THE_LIGHT | {"movement", "ambient"}, in_each_light=True),
        "uniformity": FrameCause(_OF_THE_LIGHT - {"uniformity"} | {"rows", "movement", "ambient"}, in_each_light=True),
        "light": FrameCause(frozenset({"lamp", "ambient", "white drift"}), in_each_light=True),
        "ambient": FrameCause(frozenset({"light", "lamp", "uniformity"}), is_hidden=True),
        "lamp": FrameCause(in_each_light=True),
        "dark": FrameCause(is_hidden=True),
        "white drift": FrameCause(in_each_light=True),
        "additivity": FrameCause(),
    }
)
"""Checks in the order in which they are named as the cause: what comes first explains what comes after."""

_PLAINLY = 2.0
"""Deviation of a tile over its limit from which on light is plainly uneven: what little movement or blur is seen with
it comes from it. Of charts out of focus by half a px one tile in 16 frames was off at all (simulated)."""

_ROWS_STAND_PX = 0.7
"""Blur, px, below which rows show what belongs into them (simulated: none deviates at 0.75 px): rows that do not are
what made edges look softer, and no blur."""


def named_once(checks: Sequence[Check]) -> tuple[Check, ...]:
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


def voids_others(state: JudgeState, cause: str) -> bool:
    """Return whether a reference that is refused for a cause puts what was taken since the last good one in doubt."""
    hidden = CAUSES[cause].is_hidden or (CAUSES[cause].in_each_light and not state.modelled)
    return hidden or cause in state.untold


def is_lasting(state: JudgeState, step: SessionStep, cause: str) -> bool:
    """Return whether taking the frame again will not help; `state` includes it."""
    # A lamp that is another one at the beginning of a run would cost every light up to the next white frame.
    another = cause == "white drift" and is_brightest_grey(step)
    # Of a session's first frame the exposure is too long, and a second one is no shorter.
    overexposed = cause == "clipping" and state.white is None
    return another or overexposed or CAUSES[cause].lasts or state.refused[1] >= limits.LASTING_FRAMES
