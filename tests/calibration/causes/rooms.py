"""Small sessions with one thing wrong, whose cause is known, for these tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.camera import ExposureSettings
from drivers.presenter import Colour
from experiment.lights import Illumination
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from sim.world.world import UNDISTURBED, Blob, Situation
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, renumbered, take

BRIGHT = renumbered(
    [light for light in LIGHTS if sum(light.colour) == max(light.colour) == 255]
    + [light for light in LIGHTS if min(light.colour) > 80][:2]
)
"""Each primary alone, and two lights under which most cells can be compared."""

Which = Callable[[SessionStep], bool]
Counts = npt.NDArray[np.uint16]
HAND = Situation(blobs=(Blob((0.4, 0.3, 0.62, 0.6), left=0.08),))
"""A hand before the middle of the chart."""


def all_frames(step: SessionStep) -> bool:
    """Every frame."""
    return True


def frame(
    lab: Lab,
    step: SessionStep,
    situation: Situation = UNDISTURBED,
    settings: ExposureSettings = SETTINGS,
    colour: Colour | None = None,
    paint: Callable[[Counts, Colour], None] | None = None,
) -> bytes:
    """Return a frame's file; its raw file states `settings`, which it was taken with."""
    shown = step.colour if colour is None else colour

    def onto(counts: Counts) -> None:
        if paint is not None:
            paint(counts, shown)

    return lab.dng(shown, step.number + 1, settings, onto, situation=situation)


def taken(
    lab: Lab,
    folder: Path,
    which: Which = all_frames,
    lights: tuple[Illumination, ...] = BRIGHT,
    situation: Situation = UNDISTURBED,
    settings: ExposureSettings = SETTINGS,
    paint: Callable[[Counts, Colour], None] | None = None,
    shown: Callable[[SessionStep], Colour] | None = None,
) -> Session:
    """Return a session with a white frame before every two lights; in the frames of `which` something is otherwise."""

    def one(step: SessionStep) -> bytes:
        colour = None if shown is None else shown(step)
        if which(step):
            return frame(lab, step, situation, settings, colour, paint)
        return frame(lab, step, colour=colour)

    return take(lab, folder, lights, every=2, frame=one)


def glare(lab: Lab, share: float, radius: float = 0.3) -> Callable[[Counts, Colour], None]:
    """Return what adds `share` of paper's light to a round part of the picture, softly: the projector, mirrored."""

    def paint(counts: Counts, colour: Colour) -> None:
        body, white = lab.world.body, lab.world.white(colour, SETTINGS)
        visible = body.visible
        seen = counts[visible.top : visible.top + visible.height, visible.left : visible.left + visible.width]
        y, x = np.mgrid[: seen.shape[0], : seen.shape[1]] / visible.height
        soft = np.exp(-((x - 0.65) ** 2 + (y - 0.45) ** 2) / radius**2 * 2)
        for number, letter in enumerate(body.pattern):
            row, column = divmod(number, 2)
            part = seen[row::2, column::2]
            part[...] = np.rint(part + share * white["RGB".index(letter)] * soft[row::2, column::2]).astype(np.uint16)

    return paint


def nth_white(number: int) -> Which:
    """Return whether a step is the session's n-th white frame, from 0."""
    seen: list[int] = []

    def which(step: SessionStep) -> bool:
        if step.kind == "white" and step.number not in seen:
            seen.append(step.number)
        return step.kind == "white" and seen.index(step.number) == number

    return which


def half(settings: ExposureSettings = SETTINGS) -> ExposureSettings:
    """Return half of an exposure."""
    return replace(settings, shutter_s=settings.shutter_s / 2)
