"""Homographies between two planes: mapping points, and fitting a homography to pairs of points.

Source: R. Hartley and A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., chapter 4 (direct linear
transform, algorithm 4.1, and its robust estimate by RANSAC, algorithm 4.6), as in OpenCV's `findHomography`.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

# Extent of points across a line, divided by that along it, below which they count as collinear. Rounding of coordinates
# leaves 1e-9; the corners of two small tags at the ends of an A0 sheet have 1e-3.
FLAT = 1e-6

_Points = npt.NDArray[np.float64]


def project(homography: npt.NDArray[np.float64], points: npt.ArrayLike) -> _Points:
    """Return points (N, 2) float64 mapped by a homography (3, 3) float64."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    mapped = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def rms(vectors: npt.NDArray[np.float64]) -> float:
    """Return the root mean square length of vectors (..., 2) float64, in their unit; 0 if there are no vectors."""
    return float(np.sqrt((vectors**2).sum() * vectors.shape[-1] / max(vectors.size, 1)))


def robust_homography(
    chart_points: _Points, frame_points: _Points, tolerance_px: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Fit a homography to the majority of the point pairs (RANSAC, then least squares).

    Parameters
    ----------
    chart_points, frame_points
        (N, 2) float64, mm on the print and half-size px.
    tolerance_px
        Largest distance of a fitting pair from the homography, half-size px.

    Returns
    -------
        Homography (3, 3) float64, and (N,) bool, the pairs within the tolerance. The identity and no pair if the points
        do not determine a homography.
    """
    homography = fit_homography(chart_points, frame_points, tolerance_px)
    if homography is None:
        return np.eye(3), np.zeros(len(chart_points), dtype=np.bool_)
    fits = np.asarray(np.linalg.norm(project(homography, chart_points) - frame_points, axis=1) <= tolerance_px)
    if fits.sum() >= 4:
        refined = fit_homography(chart_points[fits], frame_points[fits])
        homography = homography if refined is None else refined
    return homography, fits


def on_one_line(points: _Points) -> bool:
    """Return whether points (N, 2) float64 are collinear to `FLAT`; points with NaN are not."""
    if not np.isfinite(points).all():
        return False
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[-1] <= FLAT * extents[0])


def fit_homography(points: _Points, targets: _Points, tolerance: float | None = None) -> npt.NDArray[np.float64] | None:
    """Fit a homography (3, 3) float64 to point pairs; None if the pairs do not determine one.

    Parameters
    ----------
    points, targets
        (N, 2) float64, from and to.
    tolerance
        In units of `targets`. If given, pairs that are further off are ignored (RANSAC); else all pairs count (least
        squares).
    """
    # OpenCV returns a matrix for some collinear points, which do not determine a homography.
    if on_one_line(points) or on_one_line(targets):
        return None
    # OpenCV returns None for other degenerate pairs, which becomes an array without shape.
    method, threshold = (0, 3.0) if tolerance is None else (cv2.RANSAC, tolerance)
    matrix = np.asarray(cv2.findHomography(points, targets, method, threshold)[0], dtype=np.float64)
    return matrix if matrix.shape == (3, 3) else None
