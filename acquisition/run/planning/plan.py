"""The plan of a run: what it takes, needs and finds, and what would end it before its end.

A fault would end the run, and has its remedy; a doubt may. What is estimated says what it rests on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from acquisition.run.planning.answers import Answers
from acquisition.run.planning.sizes import RETAKEN_SHARE, Estimate, bytes_text, frame_bytes, needed_bytes
from acquisition.run.planning.work import Work
from experiment.config import LabSettings
from foundation.errors import CropError, DeviceFault, DeviceRefused, InputError, StorageError, counted

DOWNLOAD_BYTES_PER_S: Final = 25e6
"""What a cable is assumed to carry before a frame was taken: USB 2.0 carries 30 to 40 million bytes a second."""
STEP_S: Final = 0.4
"""What a frame is assumed to need beside light and cable: release, mirror, read-back of the screen, journal."""
LIGHTING_S: Final = 60.0
"""Assumed time from switching on to a lit lamp; makers state 30 to 40 s, and up to 130 s."""
LOW_BATTERY: Final = 0.25
"""At this charge a series of many frames is not begun without mains power: bodies report in steps of a quarter, and
refuse to release a little later."""
FEW_FRAMES: Final = 50
"""So many frames are taken on a low battery all the same."""
OFFERED_WITHIN: Final = 0.01
"""How far a shutter time may lie from one that the body offers, as a share; drivers take no more."""


@dataclass(frozen=True)
class RunPlan:
    """What a run will take, need and find.

    - `settings`: as given.
    - `work`: what is to be done.
    - `answers`: what the devices said.
    - `frame_bytes`: A raw file, bytes.
    - `frame_s`: A frame's time, seconds.
    - `warm_up_s`: of the lamp before the first frame, seconds.
    - `free_bytes`: on the disk of the session.
    - `faults`: what would end the run, each with its remedy.
    - `doubts`: what may; a sentence each.
    """

    settings: LabSettings
    work: Work
    answers: Answers
    frame_bytes: Estimate
    frame_s: Estimate
    warm_up_s: float
    free_bytes: int
    faults: tuple[CropError, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def needed_bytes(self) -> int:
        """Space that the run needs, those that are taken again and a reserve included."""
        return needed_bytes(self.work.left, self.frame_bytes.value)

    @property
    def time_s(self) -> float:
        """How long the run will take if nothing goes wrong."""
        return self.work.left * self.frame_s.value + (self.warm_up_s if self.work.left else 0)

    def require(self) -> None:
        """Refuse a run that could not be brought to its end."""
        if self.faults:
            first, *others = self.faults
            raise type(first)("; moreover, ".join([str(first), *map(str, others)]))


def make_plan(
    settings: LabSettings, work: Work, answers: Answers, free_bytes: int, given_bytes: int | None = None
) -> RunPlan:
    """Return the plan of a run, with all that would end it."""
    size = frame_bytes(work.frame_bytes, answers.camera.model if answers.camera is not None else "", given_bytes)
    cold = answers.lit is False and settings.sequence.warm_up_s > 0
    warm_up_s = LIGHTING_S + settings.sequence.warm_up_s if cold else 0.0
    found = (
        *answers.faults,
        *answers.warnings,
        _exposure_fault(settings, work, answers),
        _battery_fault(work, answers),
        _card_fault(work, answers, size.value),
        _disk_fault(work, size, free_bytes),
        _black_fault(settings, work),
    )
    return RunPlan(
        settings,
        work,
        answers,
        size,
        _frame_s(settings, work, size.value),
        warm_up_s,
        free_bytes,
        tuple(one for one in found if isinstance(one, CropError)),
        tuple(one for one in found if isinstance(one, str)),
    )


def is_offered(shutter_s: float, offered_s: Sequence[float]) -> bool | None:
    """Return whether a body offers a shutter time; None where it lists none. All in seconds."""
    if not offered_s:
        return None
    return any(abs(shutter_s / time - 1) <= OFFERED_WITHIN for time in offered_s)


def _frame_s(settings: LabSettings, work: Work, size: float) -> Estimate:
    if work.frame_s is not None:
        return Estimate(work.frame_s, "median of the session so far", True)
    exposure, settle = settings.camera.shutter_s, settings.sequence.settle_s
    return Estimate(
        exposure + max(settle, size / DOWNLOAD_BYTES_PER_S) + STEP_S,
        f"assumed: exposure {exposure:g} s, settling {settle:g} s while {bytes_text(size)} come at "
        f"{DOWNLOAD_BYTES_PER_S / 1e6:g} MB/s, {STEP_S:g} s beside",
        False,
    )


def _disk_fault(work: Work, size: Estimate, free_bytes: int) -> StorageError | str | None:
    needed = needed_bytes(work.left, size.value)
    missing = needed - free_bytes
    if missing <= 0:
        return None
    sentence = (
        f"the disk of {work.folder} has {bytes_text(free_bytes)} free, the run needs {bytes_text(needed)}: "
        f"{bytes_text(missing, up=True)} are missing; free them, or name a session folder on another disk"
    )
    return StorageError(sentence) if size.sure else f"{sentence} (the size of a frame is {size.basis})"


def _black_fault(settings: LabSettings, work: Work) -> CropError | None:
    """Return why a new session with a light that is none could never be complete; one that is begun goes on."""
    black = [step.illumination for step in work.steps if step.kind == "light" and not any(step.colour.codes)]
    if work.done or not black:
        return None
    return InputError(
        f"{settings.illuminations}: light {black[0]} has the codes 0, 0, 0: no frame under it can be used; take it out"
    )


def _exposure_fault(settings: LabSettings, work: Work, answers: Answers) -> CropError | None:
    shutter = settings.camera.shutter_s
    if not work.left or is_offered(shutter, answers.offered_s) is not False:
        return None
    near = sorted(answers.offered_s, key=lambda time: abs(math.log(time / shutter)))[:3]
    listed = ", ".join(f"{time:.4g}" for time in sorted(near))
    return DeviceRefused(
        f"camera.shutter_s = {shutter:g}: the body does not offer it; the nearest times that it offers are {listed} s"
    )


def _battery_fault(work: Work, answers: Answers) -> CropError | str | None:
    supplies = answers.supplies
    if supplies is None or supplies.battery is None or supplies.mains or work.left <= FEW_FRAMES:
        return None
    state = f"the camera's battery is at {supplies.battery:.0%}"
    frames = counted(work.left, "frame is", "frames are")
    if supplies.battery <= LOW_BATTERY:
        return DeviceFault(f"{state}, and {frames} to be taken; connect a mains adapter, or charge it")
    return f"{state}, and {frames} to be taken: a charge lasts for some hundred; better connect a mains adapter"


def _card_fault(work: Work, answers: Answers, size: float) -> CropError | None:
    supplies = answers.supplies
    if supplies is None or supplies.saves_to_host or supplies.card_free_bytes is None:
        return None
    needed = math.ceil(work.left * (1 + RETAKEN_SHARE) * size)
    missing = needed - supplies.card_free_bytes
    if missing <= 0:
        return None
    return DeviceFault(
        f"the camera's card has {bytes_text(supplies.card_free_bytes)} free, and frames stay on it: "
        f"{bytes_text(missing, up=True)} are missing; put in an empty card of {bytes_text(needed, up=True)}"
    )
