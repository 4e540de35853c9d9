"""Checks of battery, memory card, disk, and the noise reduction of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from acquisition.check.findings import Finding, judge_value, not_checked
from acquisition.run.plan import needed_bytes
from calibration.figures.figure import format_value
from calibration.figures.single_frames import BATTERY, CARD, DISK, NOISE_REDUCTION
from drivers.camera import Camera, ReportsSupplies, Supplies
from foundation.errors import DeviceError, StorageError
from foundation.folders import bytes_text, free_bytes_at

CHARGE = 440  # Number of frames for one battery charge; source: see `BATTERY`.


def judge_disk(folder: Path, frames: int, frame_bytes: int) -> Finding:
    """Judge the free space of a folder, or of its nearest existing parent."""
    needed = needed_bytes(frames, frame_bytes)
    try:
        free_bytes = free_bytes_at(folder)
    except StorageError as error:
        return Finding("disk", "fault", str(error))
    return judge_value(
        DISK,
        free_bytes / max(needed, 1),
        f"{bytes_text(free_bytes)} free at {folder}, {bytes_text(needed, up=True)} needed for {frames} frames of "
        f"{bytes_text(frame_bytes)} (measured), retakes included",
        "",
        {"free_bytes": free_bytes, "needed_bytes": needed, "frames": frames, "frame_bytes": frame_bytes},
    )


def judge_supplies(camera: Camera, frames: int, frame_bytes: int) -> list[Finding]:
    """Judge battery and card, if the camera reports them."""
    if not isinstance(camera, ReportsSupplies):
        return [not_checked(name, "the camera does not report it", "see its display") for name in ("battery", "card")]
    try:
        supplies = camera.supplies()
    except DeviceError as error:
        return [not_checked("battery", str(error)), not_checked("card", str(error))]
    return [_battery(supplies, frames), _card(supplies, needed_bytes(frames, frame_bytes))]


def _battery(supplies: Supplies, frames: int) -> Finding:
    if supplies.mains:
        return Finding("battery", "good", "the camera runs on mains power")
    if supplies.battery is None:
        reason = "the camera does not report the charge of its battery"
        return not_checked("battery", reason, f"use a mains adapter: the plan has {frames} frames")
    charge = f"{format_value(supplies.battery, 'share')} charged, and the plan has {frames} frames"
    frames_share = supplies.battery * CHARGE / max(frames, 1)
    if supplies.mains is None and supplies.battery >= 1 and BATTERY.outcome(frames_share) != "accept":
        reason = f"{charge}: this camera reports a full battery and a mains adapter in the same way"
        return not_checked("battery", reason, "make sure that a mains adapter is connected")
    return judge_value(BATTERY, frames_share, f"the camera's battery is {charge}", details={"charge": supplies.battery})


def _card(supplies: Supplies, needed: int) -> Finding:
    if supplies.saves_to_host:
        return Finding("card", "good", "frames are saved on this computer, the card is not used")
    if supplies.card_free_bytes is None:
        return not_checked("card", "free space on the card is not reported", f"keep {bytes_text(needed, up=True)} free")
    return judge_value(
        CARD,
        supplies.card_free_bytes / max(needed, 1),
        f"the card has {bytes_text(supplies.card_free_bytes)} free, {bytes_text(needed, up=True)} needed for frames",
        "",
        {"free_bytes": supplies.card_free_bytes, "needed_bytes": needed},
    )


def judge_noise_reduction(timings: Sequence[tuple[float, float]]) -> Finding:
    """Judge whether the camera takes its own dark frame after a long exposure (noise reduction).

    `timings`: shutter time, and time from the release until the file was received, s, of every frame.
    """
    times = sorted(timings)
    if not times or times[-1][0] < 1.0 or times[-1][0] < 4 * times[0][0]:
        return not_checked(NOISE_REDUCTION.name, "no exposure of at least 1 s is 4 times as long as another one")
    shortest = np.median([elapsed_s - shutter_s for shutter_s, elapsed_s in times if shutter_s == times[0][0]])
    longest = np.median([elapsed_s - shutter_s for shutter_s, elapsed_s in times if shutter_s == times[-1][0]])
    growth = float((longest - shortest) / (times[-1][0] - times[0][0]))
    return judge_value(
        NOISE_REDUCTION,
        growth,
        f"a frame is ready {longest:.1f} s after an exposure of {times[-1][0]:.4g} s, and "
        f"{shortest:.1f} s after one of {times[0][0]:.4g} s",
    )
