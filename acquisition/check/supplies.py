"""What only a check asks of the body: battery, card, disk, and whether it takes dark frames of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from acquisition.check.findings import Finding, judged, not_checked
from acquisition.run.plan import bytes_text, free_bytes_at, needed_bytes
from calibration.figures.figure import format_value
from calibration.figures.single_frames import BATTERY, CARD, DISK, NOISE_REDUCTION
from drivers.camera import Camera, ReportsSupplies, Supplies
from foundation.errors import DeviceError, StorageError

CHARGE = 440  # Frames to a charge; see the source of `BATTERY`


def judge_disk(folder: Path, frames: int, frame_bytes: int) -> Finding:
    """Return the finding on the disk of a folder, or of the nearest folder above that exists."""
    needed = needed_bytes(frames, frame_bytes)
    try:
        free = free_bytes_at(folder)
    except StorageError as error:
        return Finding("disk", "fault", str(error))
    return judged(
        DISK,
        free / max(needed, 1),
        f"{bytes_text(free)} free at {folder}, {bytes_text(needed, up=True)} needed for {frames} frames of "
        f"{bytes_text(frame_bytes)} (as one that was taken here), some of them taken again",
        "",
        {"free_bytes": free, "needed_bytes": needed, "frames": frames, "frame_bytes": frame_bytes},
    )


def judge_supplies(camera: Camera, frames: int, frame_bytes: int) -> list[Finding]:
    """Return the findings on battery and card, as far as the body tells."""
    silent = "this camera does not tell"
    if not isinstance(camera, ReportsSupplies):
        return [not_checked("battery", silent, "look at its display"), not_checked("card", silent)]
    try:
        found = camera.supplies()
    except DeviceError as error:
        return [not_checked("battery", str(error)), not_checked("card", str(error))]
    return [_battery(found, frames), _card(found, needed_bytes(frames, frame_bytes))]


def _battery(found: Supplies, frames: int) -> Finding:
    if found.mains:
        return Finding("battery", "good", "the camera runs on mains power")
    if found.battery is None:
        why = "the camera does not tell its battery's charge"
        return not_checked("battery", why, f"use a mains adapter: the plan has {frames} frames")
    charged = f"{format_value(found.battery, 'share')} charged, and the plan has {frames} frames"
    enough = found.battery * CHARGE / max(frames, 1)
    if found.mains is None and found.battery >= 1 and BATTERY.outcome(enough) != "accept":
        why = f"{charged}: a battery, or a mains adapter, which this body does not tell apart"
        return not_checked("battery", why, "see that it is a mains adapter")
    return judged(BATTERY, enough, f"the camera's battery is {charged}", details={"charge": found.battery})


def _card(found: Supplies, needed: int) -> Finding:
    if found.saves_to_host:
        return Finding("card", "good", "frames go to this machine, the card is not used")
    if found.card_free_bytes is None:
        return not_checked("card", "frames go by the camera's card, and it does not tell its free space")
    return judged(
        CARD,
        found.card_free_bytes / max(needed, 1),
        f"frames go by the card: {bytes_text(found.card_free_bytes)} free, {bytes_text(needed, up=True)} needed",
        "",
        {"free_bytes": found.card_free_bytes, "needed_bytes": needed},
    )


def judge_noise_reduction(timings: Sequence[tuple[float, float]]) -> Finding:
    """Return the finding on whether the body takes a dark frame of its own after long exposures.

    `timings`: of every frame taken: shutter time and the time until its file was here, seconds.
    """
    times = sorted(timings)
    if not times or times[-1][0] < 1.0 or times[-1][0] < 4 * times[0][0]:
        return not_checked(NOISE_REDUCTION.name, "no two exposures differ enough, the longer 1 s or more, to see it")
    shortest = np.median([took - shutter for shutter, took in times if shutter == times[0][0]])
    longest = np.median([took - shutter for shutter, took in times if shutter == times[-1][0]])
    growth = float((longest - shortest) / (times[-1][0] - times[0][0]))
    return judged(
        NOISE_REDUCTION,
        growth,
        f"a frame of {times[-1][0]:.4g} s takes {longest:.1f} s beyond its exposure, one of {times[0][0]:.4g} s "
        f"{shortest:.1f} s",
    )
