"""Measure the blur of an image at the edges of the tags or of the patch area, in half-size pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from drivers.raw.rawfile import Plane
from experiment.chart.model import TAG_MODULES
from experiment.framing.field import DetectedField
from experiment.framing.finding import ChartPose, DetectedTag

_Points = npt.NDArray[np.float64]

# Largest acceptable σ of the blur, half-size px. Above it, a patch of 10 px gets more than 1 % of its light from its
# neighbours.
MAX_BLUR_PX = 1.0

# Candidates for the σ of the blur, half-size px.
_BLURS = np.geomspace(0.15, 4, 48)

# Number of outline points at which blur is measured; marks in the margin disturb few of them.
_OUTLINE_POINTS = 80

# Extent of the pixels that are used around an outline point, half-size px: inwards, outwards, and along the outline.
_INWARDS_PX, _OUTWARDS_PX, _ALONG_PX = 5.0, 2.5, 3.0


def blur_px(pose: ChartPose) -> float:
    """Return the blur of the image as the σ of a Gaussian, half-size px: the median over the measured edges.

    The edges belong to the tags, or to the patch area if the chart has no tags. NaN if no edge can be measured. The
    blur includes lens, focus, movement and the size of the photosites. The photosites alone give 0.29 px in green,
    where two of them are averaged, and 0.14 px in red and blue. If the blur exceeds a quarter of a tag module, the
    result is up to 10 % too high.
    """
    if pose.field is not None:
        blurs = _outline_blurs(pose.plane, pose.field)[1]
    else:
        blurs = np.concatenate([_edge_blurs(pose.plane, tag) for tag in pose.tags])
    return float(np.median(blurs)) if len(blurs) else float("nan")


def edge_blurs(pose: ChartPose) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return points (N, 2) half-size px, and the blur at each of them, σ (N,) px, as in `blur_px`.

    The points are the centres of the tags, each with the median of its four edges. If the chart has no tags, the points
    are on the outline of the patch area.
    """
    if pose.field is not None:
        return _outline_blurs(pose.plane, pose.field)
    blurred_tags = [(tag.centre_px, edges) for tag in pose.tags if len(edges := _edge_blurs(pose.plane, tag))]
    centres = np.array([centre for centre, _ in blurred_tags], dtype=np.float64).reshape(-1, 2)
    return centres, np.array([float(np.median(edges)) for _, edges in blurred_tags])


def _edge_blurs(plane: Plane, tag: DetectedTag) -> npt.NDArray[np.float64]:
    # A line across the edge of a tag crosses data modules, the black border, the white rim and the surroundings. Border
    # and rim are one module wide, so the positions of the three steps are known. Blurred steps are fitted to the pixels
    # at their own distances from the edge, because interpolation would add blur (slanted edge, as in ISO 12233).
    module = tag.side_px / TAG_MODULES
    corners = tag.corners_px - plane.offset_px
    left, top = np.floor(corners.min(axis=0) - module).astype(int)
    right, bottom = np.ceil(corners.max(axis=0) + module).astype(int) + 1
    height, width = plane.values.shape
    if left < 0 or top < 0 or right > width or bottom > height:
        return np.empty(0)
    values = plane.values[top:bottom, left:right].ravel().astype(np.float64)
    rows, columns = np.mgrid[top:bottom, left:right]
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    blurs = np.empty(4)
    for edge, (start, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        length = float(np.linalg.norm(end - start))
        tangent = (end - start) / length
        along = (pixels - start) @ tangent / length
        # The corners are clockwise with y down, so this vector points out of the tag.
        across = (pixels - start) @ np.array([tangent[1], -tangent[0]])
        # Omit pixels near a corner, because the next edge influences them, too.
        near = (along > 0.2) & (along < 0.8) & (np.abs(across) < module)
        counts, distances = values[near], across[near]
        blurs[edge] = _sigma(counts, distances, (-module, 0.0, module))
    return blurs


def _outline_blurs(plane: Plane, field: DetectedField) -> tuple[_Points, npt.NDArray[np.float64]]:
    """Return points on the outline of the patch area, (N, 2) px, and the σ of the edge at each point, (N,) px."""
    height, width = plane.values.shape
    reach = int(np.ceil(_INWARDS_PX + _ALONG_PX))
    blurs: list[float] = []
    points: list[_Points] = []
    for index in range(0, len(field.outline_px), max(1, len(field.outline_px) // _OUTLINE_POINTS)):
        point, normal = field.outline_px[index] - plane.offset_px, field.normals[index]
        left, top = np.floor(point).astype(int) - reach
        if left < 0 or top < 0 or left + 2 * reach + 2 > width or top + 2 * reach + 2 > height:
            continue
        rows, columns = np.mgrid[top : top + 2 * reach + 2, left : left + 2 * reach + 2]
        pixels = np.column_stack([columns.ravel(), rows.ravel()]) - point
        across = pixels @ normal
        along = pixels @ np.array([-normal[1], normal[0]])
        near = (np.abs(along) < _ALONG_PX) & (across > -_INWARDS_PX) & (across < _OUTWARDS_PX)
        counts = plane.values[top : top + 2 * reach + 2, left : left + 2 * reach + 2].ravel()[near].astype(np.float64)
        blurs.append(_sigma(counts, across[near], (0.0,)))
        points.append(field.outline_px[index])
    return np.array(points, dtype=np.float64).reshape(-1, 2), np.array(blurs)


def _sigma(counts: _Points, distances: _Points, step_positions: Sequence[float]) -> float:
    # For each candidate σ, fit blurred steps of unknown height.
    sigma = _BLURS[:, None]
    steps = [ndtr((distances - position) / sigma) for position in step_positions]
    # The derivative of the step at 0 corrects an error of the edge position.
    slope = np.exp(-0.5 * (distances / sigma) ** 2)
    basis = np.linalg.qr(np.stack([np.ones_like(slope), *steps, slope], axis=-1)).Q
    misfit = (counts**2).sum() - ((counts @ basis) ** 2).sum(axis=-1)
    best = int(np.clip(misfit.argmin(), 1, len(_BLURS) - 2))
    previous, lowest, following = misfit[best - 1 : best + 2]
    offset = 0.5 * (previous - following) / max(previous - 2 * lowest + following, 1e-12)
    return float(_BLURS[best] * (_BLURS[1] / _BLURS[0]) ** float(np.clip(offset, -1, 1)))
