"""A plane seen by a pinhole: points mapped by a homography, and the homography through pairs of points.

Source: R. Hartley and A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., chapter 4 (direct linear
transform, algorithm 4.1, and its robust estimate by RANSAC, algorithm 4.6), as OpenCV's `findHomography` has them.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

# Extent of points across a line, over that along it, below which they lie on it: rounding of coordinates leaves 1e-9,
# and the corners of two small tags at the ends of an A0 sheet have 1e-3.
FLAT = 1e-6

_Points = npt.NDArray[np.float64]


def project(homography: npt.NDArray[np.float64], points: npt.ArrayLike) -> _Points:
    """Return points (N, 2) float64 mapped by a homography (3, 3) float64, in the units that it maps to."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def rms(vectors: npt.NDArray[np.float64]) -> float:
    """Return the root of the mean squared length of vectors (..., 2) float64, in their unit; 0 of none."""
    return float(np.sqrt((vectors**2).sum() * vectors.shape[-1] / max(vectors.size, 1)))


def robust_homography(
    chart_points: _Points, frame_points: _Points, tolerance_px: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Return the homography through most pairs of points, and which pairs it fits.

    `chart_points`, `frame_points`: (N, 2) float64, from (mm on the print) and to (half-size px). Returns (3, 3)
    float64, least squares over the pairs that fit; the identity where there is none. Returns (N,) bool, which pairs lie
    within the tolerance.
    """
    homography = fit_homography(chart_points, frame_points, tolerance_px)
    if homography is None:
        return np.eye(3), np.zeros(len(chart_points), dtype=np.bool_)
    good = np.asarray(np.linalg.norm(project(homography, chart_points) - frame_points, axis=1) <= tolerance_px)
    if good.sum() >= 4:
        refined = fit_homography(chart_points[good], frame_points[good])
        homography = homography if refined is None else refined
    return homography, good


def on_one_line(points: _Points) -> bool:
    """Return whether points (N, 2) float64 lie on one line, whatever its direction, to `FLAT`; NaN does not."""
    if not np.isfinite(points).all():
        return False
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[-1] <= FLAT * extents[0])


def fit_homography(points: _Points, places: _Points, tolerance: float | None = None) -> npt.NDArray[np.float64] | None:
    """Return the homography (3, 3) float64 through point pairs, or None where they do not determine one.

    Points on one line, on either side, do not; OpenCV returns a matrix for some of them all the same.

    `points`, `places`: (N, 2) float64, from and to. `tolerance`: in units of `places`; if given, pairs further off are
    left out (RANSAC), else all count (least squares).
    """
    if on_one_line(points) or on_one_line(places):
        return None
    # OpenCV returns None for other degenerate pairs, which becomes an array without shape.
    method, threshold = (0, 3.0) if tolerance is None else (cv2.RANSAC, tolerance)
    found = np.asarray(cv2.findHomography(points, places, method, threshold)[0], dtype=np.float64)
    return found if found.shape == (3, 3) else None
