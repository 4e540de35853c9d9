"""Small sessions with one known fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drivers.camera import ExposureSettings
from drivers.presenter import Colour
from experiment.lights import Illuminant
from experiment.session.folder import Session
from experiment.session.records import SessionStep
from sim.world.world import UNDISTURBED, Blob, Situation
from tests.calibration.lab import LIGHTS, SETTINGS, Lab, renumbered, take

# Each primary alone, and two lights under which most cells can be compared.
BRIGHT = renumbered(
    [light for light in LIGHTS if sum(light.colour) == max(light.colour) == 255]
    + [light for light in LIGHTS if min(light.colour) > 80][:2]
)

Which = Callable[[SessionStep], bool]
Counts = npt.NDArray[np.uint16]
# A hand in front of the centre of the chart.
HAND = Situation(blobs=(Blob((0.4, 0.3, 0.62, 0.6), left=0.08),))


def all_frames(step: SessionStep) -> bool:
    return True


def frame(
    lab: Lab,
    step: SessionStep,
    situation: Situation = UNDISTURBED,
    settings: ExposureSettings = SETTINGS,
    colour: Colour | None = None,
    paint: Callable[[Counts, Colour], None] | None = None,
) -> bytes:
    """Return a frame taken with `settings`, which its file records."""
    projected = step.colour if colour is None else colour

    def onto(counts: Counts) -> None:
        if paint is not None:
            paint(counts, projected)

    return lab.dng(projected, step.number + 1, settings, onto, situation=situation)


def taken(
    lab: Lab,
    folder: Path,
    which: Which = all_frames,
    lights: tuple[Illuminant, ...] = BRIGHT,
    situation: Situation = UNDISTURBED,
    settings: ExposureSettings = SETTINGS,
    paint: Callable[[Counts, Colour], None] | None = None,
    shown: Callable[[SessionStep], Colour] | None = None,
) -> Session:
    """Return a session with a white frame before every two lights, and a fault in the frames of `which`."""

    def one(step: SessionStep) -> bytes:
        colour = None if shown is None else shown(step)
        if which(step):
            return frame(lab, step, situation, settings, colour, paint)
        return frame(lab, step, colour=colour)

    return take(lab, folder, lights, every=2, frame=one)


def glare(lab: Lab, share: float, radius: float = 0.3) -> Callable[[Counts, Colour], None]:
    """Return a painter that adds `share` of paper's light to a soft round area, like a mirrored projector."""

    def paint(counts: Counts, colour: Colour) -> None:
        body, white = lab.world.body, lab.world.white(colour, SETTINGS)
        visible = body.visible
        pixels = counts[visible.top : visible.top + visible.height, visible.left : visible.left + visible.width]
        y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]] / visible.height
        soft = np.exp(-((x - 0.65) ** 2 + (y - 0.45) ** 2) / radius**2 * 2)
        for number, letter in enumerate(body.pattern):
            row, column = divmod(number, 2)
            part = pixels[row::2, column::2]
            part[...] = np.rint(part + share * white["RGB".index(letter)] * soft[row::2, column::2]).astype(np.uint16)

    return paint


def nth_white(number: int) -> Which:
    """Return a selector of the n-th white frame of a session, from 0."""
    pixels: list[int] = []

    def which(step: SessionStep) -> bool:
        if step.kind == "white" and step.number not in pixels:
            pixels.append(step.number)
        return step.kind == "white" and pixels.index(step.number) == number

    return which


def half(settings: ExposureSettings = SETTINGS) -> ExposureSettings:
    return replace(settings, shutter_s=settings.shutter_s / 2)
