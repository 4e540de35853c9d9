"""The plan of a session as data: every frame to take, in order, before any device is touched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from acquisition.lights.illuminations import Illumination
from drivers.presenter import BLACK, WHITE, Colour

FrameKind = Literal["light", "white", "dark"]
"""What a frame shows: one of the planned lights, full white, or the picture's black."""


@dataclass(frozen=True)
class SessionStep:
    """One frame of the plan.

    Attributes
    ----------
    number
        Its place in taking order, from 0.
    kind
        What it shows.
    illumination
        Index of its light in `illuminations.csv`; None for white and dark frames.
    colour
        Codes that the projector shows, 0 … 255.
    """

    number: int
    kind: FrameKind
    illumination: int | None
    colour: Colour

    @property
    def stem(self) -> str:
        """The file name without suffix, e.g. ``0007_light_005``; sorts in taking order."""
        tail = "" if self.illumination is None else f"_{self.illumination:03d}"
        return f"{self.number:04d}_{self.kind}{tail}"


def plan_steps(illuminations: Sequence[Illumination], reference_every: int) -> tuple[SessionStep, ...]:
    """Return the whole session as data: a white and a dark frame first, every `reference_every` lights, and last.

    Parameters
    ----------
    illuminations
        Lights in the order in which they are to be shown.
    reference_every
        Lights between two pairs of white and dark frames, ≥ 1.
    """
    steps: list[SessionStep] = []

    def add(kind: FrameKind, illumination: int | None, colour: Colour) -> None:
        steps.append(SessionStep(len(steps), kind, illumination, colour))

    for position, light in enumerate(illuminations):
        if position % reference_every == 0:
            add("white", None, WHITE)
            add("dark", None, BLACK)
        add("light", light.index, light.colour)
    add("white", None, WHITE)
    add("dark", None, BLACK)
    return tuple(steps)
