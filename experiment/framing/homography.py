"""Fit homographies to pairs of points, and map points by them.

Source: R. Hartley and A. Zisserman, "Multiple View Geometry in Computer Vision", 2nd ed., chapter 4: direct linear
transform (algorithm 4.1) and RANSAC (algorithm 4.6), as in OpenCV's `findHomography`.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

# Points count as collinear if their extent across a line is at most this fraction of their extent along it. For two
# small tags at opposite ends of an A0 sheet, the ratio is 1e-3.
_COLLINEAR_RATIO = 1e-6

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
        Largest residual of a pair that fits the homography, half-size px.

    Returns
    -------
        Homography (3, 3) float64, and a mask (N,) bool of the pairs that fit. If the points do not determine a
        homography, it is the identity, and no pair fits.
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
    """Return whether points (N, 2) float64 are collinear; false if a coordinate is NaN."""
    if not np.isfinite(points).all():
        return False
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[-1] <= _COLLINEAR_RATIO * extents[0])


def fit_homography(points: _Points, targets: _Points, tolerance: float | None = None) -> npt.NDArray[np.float64] | None:
    """Fit a homography (3, 3) float64 to point pairs; None if the pairs do not determine one.

    Parameters
    ----------
    points, targets
        (N, 2) float64. The homography maps `points` to `targets`.
    tolerance
        Largest residual, in units of `targets`, of the pairs that are used (RANSAC). If None, all pairs are used (least
        squares).
    """
    # Collinear points do not determine a homography, but OpenCV may return one.
    if on_one_line(points) or on_one_line(targets):
        return None
    # For other degenerate pairs OpenCV returns None, and the shape of the array is ().
    method, threshold = (0, 3.0) if tolerance is None else (cv2.RANSAC, tolerance)
    matrix = np.asarray(cv2.findHomography(points, targets, method, threshold)[0], dtype=np.float64)
    return matrix if matrix.shape == (3, 3) else None
