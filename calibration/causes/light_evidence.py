"""What is known of a light that is not as it should be: exposures by the files, names, light in the dark."""

from __future__ import annotations

import numpy as np

from calibration.causes.evidence import Evidence
from calibration.causes.place_evidence import Gathered
from calibration.figures.table_figures import TableFigures


def light_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return what is known of whites that do not add up, drift, or are not what their codes give."""
    frames = figures.frames
    stated = np.array([frame.exposure for frame in frames])
    known = stated > 0
    exposure, worst = np.nan, -1
    if known.all() and len(frames) > 1:
        # What most light frames have is the session's; white frames are few.
        usual = float(np.median([frame.exposure for frame in frames if frame.record.kind == "light"] or stated))
        ratio = stated / usual
        worst = int(np.argmax(np.abs(np.log(ratio))))
        exposure = float(ratio[worst])
        beyond = [
            frame
            for frame, one in zip(frames, ratio.tolist(), strict=True)
            if abs(np.log(one)) > 0.5 * abs(np.log(exposure))
        ]
    else:
        beyond = []
    evidence = Evidence(frames=float(len(frames)), exposure=exposure)
    differs = exposure == exposure and abs(np.log(exposure)) > _SAME
    return Gathered(evidence, tuple(frame.record for frame in beyond) if differs else (), ())


def name_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return what is known of lights whose whites are not what their codes give; `limit` as in `light_evidence`."""
    gathered, codes = light_evidence(figures, np.inf), figures.lights.codes
    if codes is None:
        return gathered
    exchanged = {light for pair in codes.exchanges for light in (pair.one, pair.other)}
    off = figures.lights.off_codes_deg
    far: set[int] = set() if off is None else set(np.flatnonzero(off > limit).tolist())
    as_another = exchanged | {light for light in far if codes.seen_as[light] >= 0}
    lights = figures.session.lights
    whites = [frame.record for number, frame in enumerate(figures.white_frames) if lights + number in exchanged]
    named = [frame.record for frame in figures.frames if frame.record.illumination in far | exchanged]
    known = gathered.evidence.known() | {"off_codes_deg": float(codes.off_deg.max())}
    if as_another:
        known["named_right"] = 0.0
    return Gathered(Evidence(**known), (*named, *whites), ())


def brightness_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return what is known of lights that are brighter or darker than their codes give; `limit` in `light_evidence`."""
    gathered, codes = light_evidence(figures, limit), figures.lights.codes
    if gathered.frames or codes is None:
        return gathered
    off = set(np.flatnonzero(codes.off_brightness > limit).tolist())
    frames = tuple(frame.record for frame in figures.frames if frame.record.illumination in off)
    return Gathered(gathered.evidence, frames, ())


def camera_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return what is known of frames of another camera or lens; `limit` as in `light_evidence`."""
    origins = figures.origins
    foreign = origins.other_camera or origins.other_lens
    cameras = 1 + len({frame.found for frame in foreign})
    evidence = Evidence(frames=float(len(figures.frames)), cameras=float(cameras))
    return Gathered(evidence, tuple(frame.record for frame in foreign), ())


def iso_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return which frames state another ISO speed; `limit` as in `light_evidence`."""
    frames = tuple(frame.record for frame in figures.origins.other_iso)
    return Gathered(Evidence(frames=float(len(figures.frames)), other_iso=float(len(frames))), frames, ())


def dark_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return what is known of the light while the projector shows black; `limit` as in `light_evidence`."""
    dark, whites = figures.dark_frames, [frame.paper.white for frame in figures.white_frames]
    lights = figures.lights.white
    full = np.mean(whites, axis=0) if whites else lights[int(np.argmax(lights.sum(axis=1)))]
    room = float(np.abs(dark.light / full).max()) if np.isfinite(dark.light).all() else np.nan
    change = float((np.ptp(dark.lights, axis=0) / full).max()) if len(dark.lights) > 1 else np.nan
    return Gathered(Evidence(frames=float(len(dark.files)), room=room, room_change=change), (), ())


def stray_evidence(figures: TableFigures, limit: float) -> Gathered:
    """Return what is known of light that no dark frame shows, and in which frames; `limit` as in `light_evidence`."""
    stray = figures.lights.stray
    if stray is None:
        return Gathered(Evidence(), (), ())
    by_light = {frame.record.illumination: frame.record for frame in figures.frames if frame.record.kind == "light"}
    frames = tuple(by_light[light] for light in stray.lights_beyond(limit) if light in by_light)
    certain = float(stray.certain.max(initial=0.0))
    evidence = Evidence(frames=float(len(figures.frames)), stray=certain, stray_primaries=stray.of_primaries)
    return Gathered(evidence, frames, ())


_SAME = 0.03
"""Logarithm of two exposures' ratio up to which they are one: shutter speeds differ by a quarter, and are rounded."""
