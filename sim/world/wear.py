"""What handling does to a print: a stain, and a fold.

A stain is a filter on the paper, of one colour, with a soft rim. A fold is a crease that does not lie flat: the sheet
rises towards it on both sides, so that the crease stands off the plane, and either flank is turned a little towards
the light or away from it. Pure functions of places on the print, millimetres from its top-left corner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim.world.room import Room

_SLANT: Final = 0.36
"""Tangent of 20°: a projector beside the camera."""

RIM_MM = 1.0
"""Over which a stain's edge fades."""

ROUND_MM = 4.0
"""Paper bends; a crease is no sharper than this."""

FLANK_MM = 40.0
"""From the crease to where the sheet lies flat again, to 1 / e."""


@dataclass(frozen=True)
class Stain:
    """A round stain.

    - `centre_mm`: its middle on the print.
    - `transmittance`: share of red, green and blue light that comes back through it, over that of clean paper.
    """

    centre_mm: tuple[float, float]
    diameter_mm: float
    transmittance: tuple[float, float, float]

    def passed(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share (..., 3) of red, green and blue light that comes back from points (..., 2)."""
        away = np.linalg.norm(points_mm - np.array(self.centre_mm), axis=-1) - self.diameter_mm / 2
        cover = 1 / (1 + np.exp(np.clip(4 * away / RIM_MM, -40, 40)))
        return 1 - cover[..., None] * (1 - np.array(self.transmittance))


@dataclass(frozen=True)
class Fold:
    """A crease across the sheet, from its upper to its lower edge.

    - `at_mm`: A point of the crease.
    - `along`: its direction, a unit vector.
    - `height_mm`: how far the crease stands off the plane, towards the camera.
    - `slant`: change of the light with a flank's slope: the tangent of the angle under which the light falls in.
    """

    at_mm: tuple[float, float]
    along: tuple[float, float]
    height_mm: float
    slant: float

    def _away(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance (...) of points from the crease, positive on its right."""
        x, y = np.moveaxis(points_mm - np.array(self.at_mm), -1, 0)
        return x * self.along[1] - y * self.along[0]

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm of points (..., 2)."""
        rounded = np.hypot(self._away(points_mm), ROUND_MM) - ROUND_MM
        return self.height_mm * np.exp(-rounded / FLANK_MM)

    def shade(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light (...) on points (..., 2) over that on a flat sheet."""
        away = self._away(points_mm)
        slope = -self.height(points_mm) * away / np.hypot(away, ROUND_MM) / FLANK_MM
        return 1 + self.slant * slope


def worn(room: Room, page_mm: tuple[float, float], random: np.random.Generator) -> tuple[Stain | None, Fold | None]:
    """Return a room's stain and fold, somewhere on a sheet of a size, clear of its edges; None where it has none."""
    page = np.array(page_mm)
    x, y = (page * random.uniform(0.25, 0.75, 2)).tolist()
    taken = room.stain_depth * np.array([0.3, 0.6, 1.0])
    red, green, blue = (1 - taken).tolist()
    stain = Stain((x, y), room.stain_mm, (red, green, blue)) if room.stain_mm else None
    along = math.radians(random.uniform(-6, 6))
    crease = float(page[0] * random.uniform(0.3, 0.7)), float(page[1] / 2)
    direction = math.sin(along), math.cos(along)
    return stain, Fold(crease, direction, room.fold_mm, _SLANT) if room.fold_mm else None
