"""What a session uses up: room on the disk and the card, the battery's charge."""

from __future__ import annotations

from pathlib import Path

from acquisition.check.findings import LIMITS, Finding, judged, not_checked, percent
from acquisition.run.plan import bytes_text, free_bytes_at, needed_bytes
from drivers.camera import Camera, ReportsSupplies, Supplies
from foundation.errors import DeviceError, StorageError

CHARGE = 440
"""Frames to a charge: the least of the paper's cameras (EOS 550D, the maker's figure at 23 °C)."""

SPARE = 1.5
"""How many times the plan's frames a battery must hold to be enough: it ages, and waits between frames count, too."""


def judge_disk(folder: Path, frames: int, frame_bytes: int) -> Finding:
    """Return the finding on the disk of a folder, or of the nearest folder above that exists."""
    needed = needed_bytes(frames, frame_bytes)
    try:
        free = free_bytes_at(folder)
    except StorageError as error:
        return Finding("disk", "fault", str(error))
    return judged(
        LIMITS["disk"],
        free / max(needed, 1),
        f"{bytes_text(free)} free at {folder}, {bytes_text(needed, up=True)} needed for {frames} frames of "
        f"{bytes_text(frame_bytes)}, some of them taken again",
        "free space, or put the session on another disk (--session FOLDER tells where it will be)",
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
    charged = f"{percent(found.battery)} charged, and the plan has {frames} frames"
    if found.battery * CHARGE >= SPARE * frames:
        return Finding("battery", "good", f"the camera's battery is {charged}", found.battery, "share")
    if found.mains is None and found.battery >= 1:
        why = f"{charged}: a battery, or a mains adapter, which this body does not tell apart"
        return not_checked("battery", why, "see that it is a mains adapter")
    limit = LIMITS["battery"]
    low = limit.tolerable[0] or 0.0
    return Finding(
        "battery", "remark" if found.battery >= low else "fault", f"the camera runs on its battery, {charged}",
        found.battery, limit.unit, limit.good, limit.tolerable, limit.why, "use a mains adapter",
    )  # fmt: skip


def _card(found: Supplies, needed: int) -> Finding:
    if found.saves_to_host:
        return Finding("card", "good", "frames go to this machine, the card is not used")
    if found.card_free_bytes is None:
        return not_checked("card", "frames go by the camera's card, and it does not tell its free space")
    return judged(
        LIMITS["card"],
        found.card_free_bytes / max(needed, 1),
        f"frames go by the card: {bytes_text(found.card_free_bytes)} free, {bytes_text(needed, up=True)} needed",
        "put in an empty card",
        {"free_bytes": found.card_free_bytes, "needed_bytes": needed},
    )
