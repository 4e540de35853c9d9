"""The print as a plane seen through a lens: a homography and Brown's distortion, fitted to places known on both.

Places are half-size pixels, pixel centres at integers; millimetres on the print. Source: D. C. Brown, "Close-range
camera calibration", 1971.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import optimize

from experiment.framing.homography import fit_homography, on_one_line, project
from foundation.errors import RegistrationError

_PAIRS_FOR_ALL, _PAIRS_FOR_ONE = 48, 16
"""Pairs from which on all four coefficients are fitted, or the first: the corners of twelve tags and of four. Fewer do
not determine them, and each would fit noise."""

_FOCAL_RADII = 2.2
"""Focal length over half the frame's diagonal, as it is taken to be: a tilt of 2° is then seen to move the foot of the
camera's perpendicular by 3 to 5 % of the diagonal, where with lenses of 1.5 to .8 diagonals it moves by 5 to 3 %."""

_STEP = 1e-3
"""Of the distance, by which points leave the plane: small enough for a straight line."""

_ON_ONE_LINE = (
    "the marks of the chart that were found lie on one line, and marks spread over the sheet are expected; bring all "
    "of the chart into the frame, and uncover it"
)

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Lens:
    """A plane seen through a lens: homography, then Brown's radial and tangential distortion about the frame's middle.

    - `homography`: (3, 3) float64, millimetres to undistorted half-size px.
    - `centre_px`: (2,) middle of the frame.
    - `radius_px`: unit of distance for the coefficients: half the frame's diagonal.
    - `distortion`: (4,) k1, k2, p1, p2.
    """

    homography: _Array
    centre_px: _Array
    radius_px: float
    distortion: _Array

    def to_pixels(self, points_mm: npt.ArrayLike) -> _Array:
        """Return places (N, 2) float64 half-size px, x then y, of points (N, 2) mm on the print."""
        return self._bent((project(self.homography, points_mm) - self.centre_px) / self.radius_px)

    def _bent(self, undistorted: _Array) -> _Array:
        """Return places (N, 2) px of undistorted ones (N, 2) in units of the radius about the centre."""
        k1, k2, p1, p2 = self.distortion
        x, y = undistorted.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * k2)
        seen = np.column_stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ]
        )
        return seen * self.radius_px + self.centre_px

    def parallax(self, points_mm: npt.ArrayLike) -> _Array:
        """Return into which direction (N, 2) float64 points (N, 2) mm are seen to move when they leave the plane.

        Its length is 1 at half the frame's diagonal from the foot of the camera's perpendicular, and grows evenly from
        0 there: plane and parallax (R. Hartley and A. Zisserman, "Multiple View Geometry", 2nd edition, section 13.3).
        """
        points = np.asarray(points_mm, dtype=np.float64).reshape(-1, 2)
        x, y = self.centre_px
        to_camera = np.array([[1, 0, -x], [0, 1, -y], [0, 0, _FOCAL_RADII * self.radius_px]])
        plane = to_camera @ self.homography
        normal = np.cross(plane[:, 0], plane[:, 1])
        # The plane's distance from the camera along its normal is the same at all its points.
        step = _STEP * (normal @ plane[:, 2]) / (normal @ normal) * normal
        places = np.column_stack([points, np.ones(len(points))]) @ plane.T
        before, after = (
            self._bent(_FOCAL_RADII * side[:, :2] / side[:, 2:]) for side in (places + step, places - step)
        )
        return (after - before) / (2 * _STEP * self.radius_px)


def fit_lens(
    points_mm: _Array, places_px: _Array, frame_size: tuple[int, int], normals: _Array | None = None
) -> tuple[Lens, _Array]:
    """Return the lens through point pairs and the residuals.

    Plain least squares first, then robust (soft L1 beyond 1 px): robust from the start it stops in a local minimum.

    `points_mm`, `places_px`: (N, 2) float64 pairs, mm and half-size px, N ≥ 8. `frame_size`: width and height of the
    frame, half-size px. `normals`: (N, 2) the directions in which places are known, if they lie on lines; None where
    they are points. Returns (N, 2) float64 residuals, seen minus fitted, px; along the normals if there are some.
    """
    centre = (np.array(frame_size, dtype=np.float64) - 1) / 2
    radius = float(np.hypot(*frame_size)) / 2
    free = 4 if len(points_mm) >= _PAIRS_FOR_ALL else 1 if len(points_mm) >= _PAIRS_FOR_ONE else 0
    if on_one_line(points_mm) or on_one_line(places_px):
        raise RegistrationError(_ON_ONE_LINE)
    middle, spread = points_mm.mean(axis=0), points_mm.std(axis=0).max()
    normal = np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1]])
    start = fit_homography((points_mm - middle) / spread, (places_px - centre) / radius)
    if start is None:
        raise RegistrationError(_ON_ONE_LINE)
    scale = np.array([[radius, 0, centre[0]], [0, radius, centre[1]], [0, 0, 1]])

    def lens(parameters: _Array) -> Lens:
        inner = np.append(parameters[:8], 1.0).reshape(3, 3)
        return Lens(scale @ inner @ normal, centre, radius, np.append(parameters[8:], np.zeros(4 - free)))

    def residuals(parameters: _Array) -> _Array:
        off = lens(parameters).to_pixels(points_mm) - places_px
        return off.ravel() if normals is None else np.asarray((off * normals).sum(axis=1))

    start = np.append((start / start[2, 2]).ravel()[:8], np.zeros(free))
    plain = optimize.least_squares(residuals, start, x_scale="jac")
    robust = optimize.least_squares(residuals, plain.x, loss="soft_l1", f_scale=1.0, x_scale="jac")
    found = lens(np.asarray(robust.x))
    left = places_px - found.to_pixels(points_mm)
    return found, left if normals is None else (left * normals).sum(axis=1, keepdims=True) * normals
