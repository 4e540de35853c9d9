"""Where a point of the wavy print falls in the picture, and back.

The print is a sheet held at its middle: a point (x, y) mm on it stands `height` mm out of the plane, towards the
camera. The sheet is turned by roll, then tilt, then pan, and seen through a pinhole and Brown's lens distortion
(D. C. Brown, "Close-range camera calibration", 1971; normalised coordinates and coefficient order as OpenCV has them).
The paper does not stretch: its heights are so small against their wavelengths that a point keeps its x and y.

Pixels are half-size, centres at integers, x right, y down; millimetres on the print, origin at its top-left corner.
Pure functions of frozen values; light is not treated here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from sim.world.room import Room
from sim.world.wear import Fold

_RIPPLE: Final = 0.1
"""Height of each of the weaker short waves over that of the first; chosen."""

_A0_DIAGONAL_MM: Final = math.hypot(1189, 841)
"""Of a sheet of A0 (ISO 216)."""

_NEWTON_STEPS = 6
"""An end to steps that do not converge; they stop earlier once every point is met within 10⁻⁷ px."""
_STEP_MM = 0.05
"""Half the distance of the differences that stand for derivatives: short beside folds and waves, long beside
rounding."""


@dataclass(frozen=True, eq=False)
class Waviness:
    """A smooth paper surface: the sum of a few standing waves.

    - `cycles`: (M, 2) float64, cycles along x and y over the whole page.
    - `phases`: (M,) float64, radians.
    - `amplitudes_mm`: (M,) float64.
    - `page_mm`: width and height of the page.
    """

    cycles: NDArray[np.float64]
    phases: NDArray[np.float64]
    amplitudes_mm: NDArray[np.float64]
    page_mm: tuple[float, float]

    @classmethod
    def random(
        cls, seed: int, peak_to_valley_mm: float, page_mm: tuple[float, float], modes: int = 7, wave_mm: float = 0.0
    ) -> Waviness:
        """Draw a surface whose highest and lowest points lie `peak_to_valley_mm` apart.

        `wave_mm`: the waves' length, within 15 %; 0 for those long ones. One wave in any direction, and weak ones
        across it.
        """
        random = np.random.default_rng([seed, 0x77617679])
        longer = max(page_mm)
        cycles = random.uniform(-3, 3, (modes, 2)) * np.array(page_mm) / longer
        amplitudes = random.uniform(0.5, 1, modes) / (0.5 + np.hypot(cycles[:, 0], cycles[:, 1]))
        if wave_mm:
            length, direction = wave_mm * random.uniform(0.85, 1.15, modes), random.uniform(0, np.pi, modes)
            cycles = np.column_stack([np.cos(direction), np.sin(direction)]) * np.array(page_mm) / length[:, None]
            # Damp paper cockles: ridges beside each other, not quite regular.
            amplitudes = np.where(np.arange(modes) == 0, 1.0, _RIPPLE)
        shape = cls(cycles, random.uniform(0, 2 * np.pi, modes), amplitudes, page_mm)
        x, y = np.meshgrid(np.linspace(0, page_mm[0], 201), np.linspace(0, page_mm[1], 201))
        extent = float(np.ptp(shape.height(np.stack([x, y], axis=-1))))
        return cls(shape.cycles, shape.phases, amplitudes * (peak_to_valley_mm / extent), page_mm)

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm, towards the camera, of points (..., 2) mm on the print, or off the page."""
        share = points_mm / np.array(self.page_mm)
        total = np.zeros(points_mm.shape[:-1])
        for (along_x, along_y), phase, amplitude in zip(self.cycles, self.phases, self.amplitudes_mm, strict=True):
            total += amplitude * np.sin(2 * np.pi * (along_x * share[..., 0] + along_y * share[..., 1]) + phase)
        return total


class Surface(Protocol):
    """The shape of a sheet of paper."""

    @property
    def page_mm(self) -> tuple[float, float]:
        """Width and height of the page."""
        ...

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm, towards the camera, of points (..., 2) mm on the print, or off the page."""
        ...


@dataclass(frozen=True, eq=False)
class Folded:
    """A surface with a crease."""

    surface: Surface
    fold: Fold

    @property
    def page_mm(self) -> tuple[float, float]:
        """Width and height of the page."""
        return self.surface.page_mm

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm, towards the camera, of points (..., 2) mm on the print, or off the page."""
        return self.surface.height(points_mm) + self.fold.height(points_mm)


@dataclass(frozen=True, eq=False)
class Curled:
    """A surface whose left and right edges stand off its middle: a cylinder, to second order a parabola.

    - `surface`: what it is without the curl.
    - `curl_mm`: height of both edges above the middle, towards the camera.
    """

    surface: Surface
    curl_mm: float

    @property
    def page_mm(self) -> tuple[float, float]:
        """Width and height of the page."""
        return self.surface.page_mm

    def height(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (...) in mm, towards the camera, of points (..., 2) mm on the print, or off the page."""
        across = 2 * points_mm[..., 0] / self.page_mm[0] - 1
        return self.surface.height(points_mm) + self.curl_mm * across**2


def surface_of(room: Room, page_mm: tuple[float, float], fold: Fold | None) -> Surface:
    """Return the shape of a room's sheet; waves and curl shrink with its size."""
    size = math.hypot(*page_mm) / _A0_DIAGONAL_MM
    surface: Surface = Waviness.random(room.seed, room.waviness_mm * size, page_mm, wave_mm=room.wave_mm * size)
    if room.curl_mm:
        surface = Curled(surface, room.curl_mm * size)
    return surface if fold is None else Folded(surface, fold)


@dataclass(frozen=True, eq=False)
class View:
    """A camera in front of a print.

    - `surface`: the print's surface and size.
    - `rotation`: (3, 3) float64, from the print's axes (x right, y down, z away from the camera) to the camera's.
    - `distance_mm`: from the pinhole to the print's centre.
    - `focal_px`: focal length.
    - `centre_px`: where the optical axis meets the picture.
    - `distortion`: k1, k2, p1, p2.
    """

    surface: Surface
    rotation: NDArray[np.float64]
    distance_mm: float
    focal_px: float
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float]

    @classmethod
    def framed(
        cls,
        surface: Surface,
        frame_px: tuple[float, float],
        *,
        fill: float,
        focal_diagonals: float,
        turn_deg: tuple[float, float, float],
        distortion: tuple[float, float, float, float],
    ) -> View:
        """Stand so far off that the print, were it not turned, fills a share of the frame.

        `turn_deg`: tilt (about the horizontal axis), pan (about the vertical), roll (about the optical axis), degrees.
        """
        width, height = frame_px
        focal = focal_diagonals * float(np.hypot(width, height))
        distance = focal * max(surface.page_mm[0] / width, surface.page_mm[1] / height) / fill
        centre = ((width - 1) / 2, (height - 1) / 2)
        return cls(surface, _rotation(*turn_deg), distance, focal, centre, distortion)

    def project(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the half-size pixels where points of the print are seen.

        `points_mm`: (..., 2) float64, millimetres; may lie off the page, where the surface goes on. Returns (..., 2)
        float64, x then y.
        """
        page = np.array(self.surface.page_mm)
        flat = points_mm - page / 2
        turned = flat @ self.rotation[:, :2].T - self.surface.height(points_mm)[..., None] * self.rotation[:, 2]
        depth = turned[..., 2] + self.distance_mm
        x, y = turned[..., 0] / depth, turned[..., 1] / depth
        k1, k2, p1, p2 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        seen = np.stack([bent_x, bent_y], axis=-1)
        return seen * self.focal_px + np.array(self.centre_px)

    def locate(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the points of the print that are seen at half-size pixels: the inverse of `project`.

        Newton's method with central differences; the error is below a millionth of a pixel wherever the surface is
        seen without a fold, which is everywhere for sheets that lie within a few millimetres.

        `pixels`: (..., 2) float64. Returns (..., 2) float64, millimetres; off the page where the picture shows what
        lies beyond it.
        """
        page = np.array(self.surface.page_mm)
        points = (pixels - np.array(self.centre_px)) * (self.distance_mm / self.focal_px) + page / 2
        along_x, along_y = np.array([_STEP_MM, 0]), np.array([0, _STEP_MM])
        for _ in range(_NEWTON_STEPS):
            miss = pixels - self.project(points)
            if float(np.abs(miss).max(initial=0)) < 1e-7:
                break
            by_x = (self.project(points + along_x) - self.project(points - along_x)) / (2 * _STEP_MM)
            by_y = (self.project(points + along_y) - self.project(points - along_y)) / (2 * _STEP_MM)
            determinant = by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]
            step_x = (miss[..., 0] * by_y[..., 1] - miss[..., 1] * by_y[..., 0]) / determinant
            step_y = (by_x[..., 0] * miss[..., 1] - by_x[..., 1] * miss[..., 0]) / determinant
            points = points + np.stack([step_x, step_y], axis=-1)
        return points


def _rotation(tilt_deg: float, pan_deg: float, roll_deg: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation by roll, then tilt, then pan."""
    (ct, st), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in np.radians([tilt_deg, pan_deg, roll_deg]))
    tilt = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    pan = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return pan @ tilt @ roll
