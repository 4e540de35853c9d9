"""Whether a dark frame is dark and as dark as before, how far white has drifted, and whether first frames agree."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from acquisition.judge import limits
from acquisition.judge.checks.lights import same_light
from acquisition.judge.known.basis import BLACK_DN
from acquisition.judge.known.knowledge import Knowledge
from acquisition.judge.measured.frame import Frame
from acquisition.judge.measured.measuring import TILE_COLUMNS, TILE_ROWS, Measured
from experiment.config import JudgeSettings
from experiment.session.plan import SessionStep
from experiment.session.records import Check

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


def judge_dark(known: Knowledge, frame: Measured, dark_percent: float, ambient_percent: float) -> tuple[Check, ...]:
    """Return whether a dark frame is dark, and changed by no more than `ambient_percent` of white since the first.

    Both limits are per cent of what white gives in the same place and channel; the change is that of the region, one of
    24, that changed most, so that a lamp in a corner shows.
    """
    if known.white is None:
        return (Check("dark"),)
    white = known.white.tiles - (0 if known.dark is None else known.dark.tiles)
    # Of a tile that white hardly lights, such as a black backdrop, against a third of the mean.
    scale = np.maximum(white, np.maximum(white.mean(axis=0) / 3, 1.0))
    level = 100 * frame.tiles / scale
    value = float(max(level.mean(axis=0).max(), np.percentile(level, 94)))
    stale = ""
    before = known.recent[-1] if known.recent else None
    if value > dark_percent and known.basis is not None and before is not None and before.amounts is not None:
        amounts = known.basis.light(frame).amounts
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
    first = known.first_dark
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


def judge_first_primary(known: Knowledge, frame: Measured, primary: int) -> Check:
    """Return whether the first frame of a primary shows it: against white, its own channel is the brightest.

    Of a frame's three channels none sees another's primary better than its own, whatever the camera.
    """
    if known.white is None:
        return Check("light")
    dark = np.zeros(3) if known.dark is None else known.dark.level
    share = (frame.level - dark) / np.maximum(known.white.level - dark, 1.0)
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


def judge_first_frames(known: Knowledge, step: SessionStep, cause: Check | None, judge: JudgeSettings) -> Check | None:
    """Return why the first frames of a session or run cannot be trusted; None where nothing speaks against them.

    What they show is learnt, and only later frames tell that one of them was the odd one: a step whose frame is refused
    twice contradicts them, and before the first light white is held against what all others foretell.

    `cause`: the check that refuses the frame; None where it is accepted.
    """
    if not known.founding or all(not any(one.codes) for one in known.first_frames):
        return None
    why = cause
    if cause is None:
        why = _odd_white(known, judge) if step.kind == "light" else None
    elif cause.name not in _CONTRADICTIONS or step.number not in known.doubted:
        why = None
    elif known.awaits_primaries and cause.value is None:
        # What it should look like is not known yet.
        why = None
    if why is None:
        return None
    odd = f"{why.reason}; one of the first frames may be the odd one, white, dark or a primary"
    if known.restarts < MOST_RESTARTS:
        return replace(why, reason=f"{odd}: they are taken again")
    return replace(
        why,
        reason=f"{odd}: they were taken {known.restarts + 1} times and do not agree; see that lamp, room light and "
        "focus are steady. They are taken again after the pause, or by the same command later",
    )


def _odd_white(known: Knowledge, judge: JudgeSettings) -> Check | None:
    """Return why the first white frame is not what the frames behind it foretell; None where it is."""
    white = next((one.measured for one in known.first_frames if one.codes == (255, 255, 255)), None)
    model = known.without_white()
    if white is None or model is None or known.basis is None:
        return None
    light = known.basis.light(white)
    fit = model.compare(light.amounts, (255, 255, 255), light.covariance)
    limit = max(judge.light_deg, fit.angle_limit(limits.LIGHT_SIGMAS))
    if fit.angle_deg > limit:
        said = f"the first white frame is {fit.angle_deg:.1f}° from the light that greys and primaries foretell"
        return Check("light", round(fit.angle_deg, 3), None, round(limit, 3), "°", said)
    room = max(judge.drift_percent / 100, limits.BRIGHTNESS_SIGMAS * fit.brightness_sd)
    if abs(fit.brightness) > room:
        percent = 100 * float(np.expm1(fit.brightness))
        said = f"the first white frame is {percent:+.1f} % as bright as greys and primaries foretell"
        return Check("lamp", round(percent, 2), round(-100 * room, 2), round(100 * room, 2), "%", said)
    return None
