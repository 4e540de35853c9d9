"""Whether a raw file is of the session's camera, exposed as asked, whole, and a frame that was not given before."""

from __future__ import annotations

import numpy as np

from acquisition.judge import limits
from acquisition.judge.exposure import Exposure, disagreement, refusal
from acquisition.judge.known.knowledge import Knowledge
from acquisition.judge.measured.measuring import Measured
from drivers.raw.rawfile import Mosaic
from experiment.config import LabSettings
from experiment.session.plan import SessionStep
from experiment.session.records import Check


def judge_file(
    known: Knowledge, mosaic: Mosaic, measured: Measured, step: SessionStep, settings: LabSettings
) -> tuple[Check, ...]:
    """Return what is said of a frame's file and exposure, before anything is looked for in its picture."""
    return (
        *_judge_origin(known, mosaic, measured, settings),
        _judge_repeated(known, measured, settings),
        *_judge_exposure(known, measured, step, settings),
    )


def _judge_origin(
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
