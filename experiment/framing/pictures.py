"""Measure the movement of the chart between frames, and draw previews of frames.

Movement is measured in half-size pixels, in one colour plane, at a few small regions called gauges. Each gauge is a
tag. On a chart without tags, each gauge is a strip across the edge of the patch area, which is visible under every
illuminant.

Source: B. D. Lucas and T. Kanade, "An iterative image registration technique", IJCAI 1981.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from drivers.raw.rawfile import CHANNELS, Channel, Mosaic, Plane, channel_offset_px, phases
from experiment.framing.field import DetectedField
from experiment.framing.finding import AMBER, FONT, GREEN, RED, ChartPose, DetectedTag
from foundation.robust import huber_weights, robust_sigma

# Largest movement that can be measured, half-size px. After a larger movement, the edge is outside the crop around its
# gauge.
MAX_SHIFT_PX = 3.0

# Largest movement after which the sampling grid stays where it is, half-size px.
STILL_PX = 0.1

# Largest movement after which the grid is only shifted, half-size px. After a larger movement, the chart is registered
# again, because it may also have rotated.
REREGISTER_PX = 0.5

_GAUGE_TAGS = 8  # Number of measured tags; the error of the median of eight is about 0.005 px

_STEPS = 5  # Largest number of Gauss-Newton iterations

_SETTLED_PX = 1e-3  # The iteration ends after a step below this length, half-size px

# Margin that is read around a tag, half-size px: space for the largest movement and for the smoothing.
_AROUND_TAG_PX = 12

_STRIPS = 32  # Number of strips along the outline: so many that some covered strips have little influence

_STRIP_ALONG, _STRIP_ACROSS = 30, 8  # Half the extent of a strip along and across the edge, px

# Margin that is read around a strip, half-size px: space for the largest movement and for cubic interpolation.
_STRIP_REACH_PX = 6

_MIN_STRIPS = 8  # Smallest number of strips: twice the number of parameters of the movement

# Smallest correlation of a gauge between the two frames. Chosen by judgement: a covered gauge has a smaller
# correlation.
_LEAST_CORRELATION = 0.5

# Smallest eigenvalue of the scaled normal matrix of a tag. Below it, the image of the tag has too little structure.
_LEAST_EIGENVALUE = 1e-6

_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shift:
    """Movement of the chart between two frames, half-size px."""

    dx: float  # movement to the right: median over tags, or robust fit of the strips
    dy: float  # movement downwards, from the same tags or strips
    largest_px: float  # largest movement of a tag or of a corner of the patch area, which includes rotation
    gauges: int  # number of measured tags or strips; 0 means that the movement is unknown
    # Variance σ² of the blur in the later frame minus σ² in the earlier frame, px²; median over the gauges. The
    # calculation is a linear approximation, so it underestimates a growth of more than 1 px².
    blur_growth_px2: float = 0.0

    @property
    def length_px(self) -> float:
        """Length of the median movement, half-size px."""
        return float(np.hypot(self.dx, self.dy))


_UNKNOWN = Shift(0.0, 0.0, 0.0, 0)


def gauge_boxes(pose: ChartPose) -> list[tuple[int, int, int, int]]:
    """Return the regions of a plane that `shift_between` reads: left, top, right, bottom (exclusive), array indices."""
    if pose.field is None:
        outlines, margin = [tag.corners_px for tag in _gauge_tags(pose)], _AROUND_TAG_PX
    else:
        outlines = [samples.reshape(-1, 2) for samples in _strip_samples(*_strips(pose.field))]
        margin = _STRIP_REACH_PX
    starts = [np.maximum(np.floor(outline.min(axis=0)).astype(int) - margin, 0) for outline in outlines]
    ends = [np.ceil(outline.max(axis=0)).astype(int) + margin for outline in outlines]
    return [(int(start[0]), int(start[1]), int(end[0]), int(end[1])) for start, end in zip(starts, ends, strict=True)]


def gauges_of(mosaic: Mosaic, channel: Channel, black: npt.NDArray[np.float64], pose: ChartPose) -> Plane:
    """Return one channel of a frame, float32 counts above black, around the gauges of the chart, and 0 elsewhere.

    `black`: (2, 2) float64, black level, counts.
    """
    positions = phases(mosaic)[channel]
    blocks = mosaic.block_planes()
    level = np.float32(np.mean([black[position] for position in positions]))
    values = np.zeros(blocks.shape[2:], dtype=np.float32)
    for left, top, right, bottom in gauge_boxes(pose):
        region = np.s_[top:bottom, left:right]
        total = sum(blocks[position][region].astype(np.float32) for position in positions)
        values[region] = total / np.float32(len(positions)) - level
    return Plane(channel, values, channel_offset_px(positions))


def shift_between(reference: Plane, pose: ChartPose, plane: Plane) -> Shift:
    """Measure movement and growth of blur of the chart between two planes of the same channel.

    The brightness may change between the frames by a factor and an offset. Movements up to `MAX_SHIFT_PX` are measured.
    The error is about 0.005 px if paper has a few hundred counts.

    Parameters
    ----------
    reference
        Plane of the earlier frame.
    pose
        Pose of the chart in the earlier frame.
    plane
        Plane of the later frame.
    """
    if pose.field is not None:
        return _field_shift(reference, plane, pose.field)
    shifts = [shift for tag in _gauge_tags(pose) if (shift := _tag_shift(reference, plane, tag)) is not None]
    if not shifts:
        return _UNKNOWN
    values = np.array(shifts)
    median = np.median(values, axis=0)
    largest = float(np.linalg.norm(values[:, :2], axis=1).max())
    return Shift(float(median[0]), float(median[1]), largest, len(shifts), float(median[2]))


def _gauge_tags(pose: ChartPose) -> list[DetectedTag]:
    tags = sorted(pose.tags, key=lambda tag: tag.id)
    last = len(tags) - 1
    return [tags[index] for index in sorted({round(last * step / (_GAUGE_TAGS - 1)) for step in range(_GAUGE_TAGS)})]


def _tag_shift(reference: Plane, plane: Plane, tag: DetectedTag) -> _Points | None:
    """Return movement and growth of blur of one tag, (3,) px, px, px²; None if they cannot be measured."""
    margin = int(np.ceil(MAX_SHIFT_PX)) + 2
    height, width = reference.values.shape
    corners = tag.corners_px - reference.offset_px
    x0, y0 = np.floor(corners.min(axis=0)).astype(int) - 2
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 3
    if x0 < margin or y0 < margin or x1 > width - margin or y1 > height - margin:
        return None
    # Smooth both crops slightly, so that the gradient follows the image and not its noise.
    crop_region = np.s_[y0 - margin : y1 + margin, x0 - margin : x1 + margin]
    reference_crop = cv2.GaussianBlur(reference.values[crop_region], (0, 0), 0.7).astype(np.float64)
    plane_crop = cv2.GaussianBlur(plane.values[crop_region], (0, 0), 0.7)
    inner = np.s_[margin:-margin, margin:-margin]
    gy, gx = (np.asarray(gradient)[inner].ravel() for gradient in np.gradient(reference_crop))
    template = reference_crop[inner].ravel()
    # A small additional Gaussian blur adds half its variance times the Laplacian (heat equation).
    laplacian = np.asarray(cv2.Laplacian(reference_crop, cv2.CV_64F))[inner].ravel()
    moved = template
    rows, columns = np.mgrid[
        margin : reference_crop.shape[0] - margin, margin : reference_crop.shape[1] - margin
    ].astype(np.float32)
    design = np.column_stack([template - template.mean(), np.ones_like(template), gx, gy, laplacian])
    # Normal equations, because a linear-algebra library would start threads that compete with decoding.
    gram = np.asarray(np.einsum("ni,nj->ij", design, design), dtype=np.float64)
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-9))
    if np.linalg.eigvalsh(gram * scale * scale[:, None])[0] < _LEAST_EIGENVALUE:
        return None
    inverse = np.asarray(np.linalg.inv(gram), dtype=np.float64)
    shift, blur_growth = np.zeros(2), 0.0
    for _ in range(_STEPS):
        remapped = cv2.remap(plane_crop, columns + np.float32(shift[0]), rows + np.float32(shift[1]), cv2.INTER_CUBIC)
        moved = np.asarray(remapped, dtype=np.float64).ravel()
        # moved = gain · (template + g · step + laplacian · growth / 2) + offset. The products with gain are fitted.
        solution = inverse @ np.asarray(np.einsum("ni,n->i", design, moved), dtype=np.float64)
        if solution[0] <= 0:
            return None
        step, blur_growth = solution[2:4] / solution[0], 2 * float(solution[4] / solution[0])
        # A step is the difference between the current shift and the movement.
        shift -= np.clip(step, -1, 1)
        if np.abs(shift).max() > MAX_SHIFT_PX + 1:
            return None
        if np.abs(step).max() < _SETTLED_PX:
            break
    correlation = np.corrcoef(moved, template)[0, 1]
    return np.append(shift, blur_growth) if correlation > _LEAST_CORRELATION else None


def _strips(field: DetectedField) -> tuple[_Points, _Points]:
    indices = np.unique(np.linspace(0, len(field.outline_px) - 1, _STRIPS).round().astype(int))
    return field.outline_px[indices], field.normals[indices]


def _strip_samples(middles: _Points, normals: _Points) -> _Points:
    along = np.stack([-normals[:, 1], normals[:, 0]], axis=-1)
    u = np.arange(-_STRIP_ALONG, _STRIP_ALONG + 1)[None, :, None, None]
    v = np.arange(-_STRIP_ACROSS, _STRIP_ACROSS + 1)[None, None, :, None]
    return middles[:, None, None] + u * along[:, None, None] + v * normals[:, None, None]


def _field_shift(reference: Plane, plane: Plane, field: DetectedField) -> Shift:
    middles, normals = _strips(field)
    height, width = reference.values.shape
    samples = _strip_samples(middles, normals) - reference.offset_px
    margin = _STRIP_REACH_PX
    is_visible = (samples >= margin) & (samples <= np.array([width, height]) - 1 - margin)
    inside = np.asarray(is_visible.all(axis=(1, 2, 3)))
    middles, normals, samples = middles[inside], normals[inside], samples[inside]
    if len(middles) < _MIN_STRIPS:
        return _UNKNOWN
    earlier = _sampled(reference, samples)
    slope = np.asarray(np.gradient(earlier, axis=2))
    # The term of the blur (see `_tag_shift`) has only the direction across the edge: blur along an edge has no effect.
    bend = np.zeros_like(earlier)
    bend[:, :, 1:-1] = np.diff(earlier, 2, axis=2)
    # The samples at the ends of a strip lack a neighbour, so they are not used.
    inner = np.s_[:, :, 1:-1]
    template, slope, bend = (array[inner].reshape(len(middles), -1) for array in (earlier, slope, bend))
    design = np.stack([template, np.ones_like(template), slope, bend], axis=-1)
    gram = np.einsum("kni,knj->kij", design, design) + 1e-9 * np.eye(4)
    offsets: _Points = np.zeros(len(middles))
    solution: _Points = np.zeros((len(middles), 4))
    moved = template
    for _ in range(_STEPS):
        shifted = _sampled(plane, samples + offsets[:, None, None, None] * normals[:, None, None])
        moved = shifted[inner].reshape(len(middles), -1)
        # moved = gain · (template + slope · step) + offset, linear in (gain, offset, gain · step).
        solved = np.asarray(np.linalg.solve(gram, np.einsum("kni,kn->ki", design, moved)[..., None]), dtype=np.float64)
        solution = solved[..., 0]
        step = solution[:, 2] / np.maximum(solution[:, 0], 1e-6)
        offsets = np.clip(offsets - np.clip(step, -1, 1), -MAX_SHIFT_PX - 1, MAX_SHIFT_PX + 1)
        if np.abs(step).max() < _SETTLED_PX:
            break
    centred = [values - values.mean(axis=1, keepdims=True) for values in (template, moved)]
    norms = np.sqrt((centred[0] ** 2).sum(axis=1) * (centred[1] ** 2).sum(axis=1))
    correlation = (centred[0] * centred[1]).sum(axis=1) / np.maximum(norms, 1e-9)
    is_good = (correlation > _LEAST_CORRELATION) & (np.abs(offsets) < MAX_SHIFT_PX)
    if is_good.sum() < max(_MIN_STRIPS, 0.5 * len(middles)):
        return _UNKNOWN
    residual = moved - np.einsum("kni,ki->kn", design, solution)
    information = 1 / np.asarray(np.linalg.inv(gram), dtype=np.float64)[:, 2, 2]
    weights = information * solution[:, 0] ** 2 / np.maximum((residual**2).mean(axis=1), 1e-9)
    blur_growth = 2 * float(np.median(solution[is_good, 3] / solution[is_good, 0]))
    return _similarity(middles[is_good], normals[is_good], offsets[is_good], weights[is_good], field, blur_growth)


def _sampled(plane: Plane, positions: _Points) -> _Points:
    """Return the counts of a plane at positions (K, …, 2) relative to its offset, slightly smoothed along the edge."""
    x, y = (np.ascontiguousarray(positions[..., axis].reshape(len(positions), -1), dtype=np.float32) for axis in (0, 1))
    counts = np.asarray(cv2.remap(plane.values, x, y, cv2.INTER_CUBIC), dtype=np.float64).reshape(positions.shape[:-1])
    return (np.roll(counts, 1, axis=1) + 2 * counts + np.roll(counts, -1, axis=1)) / 4


def _similarity(
    middles: _Points, normals: _Points, offsets: _Points, weights: _Points, field: DetectedField, blur_growth: float
) -> Shift:
    """Fit a similarity transform (shift, rotation, scale) to movements (K,) px across the strips."""
    centre = field.corners_px.mean(axis=0)
    x, y = ((middles - centre) / np.abs(field.corners_px - centre).max()).T
    # A rotation moves (x, y) by (−y, x), a change of scale by (x, y).
    normal_x, normal_y = normals.T
    design = np.column_stack([normals, normal_y * x - normal_x * y, normal_x * x + normal_y * y])
    motion = np.zeros(4)
    robustness = np.ones(len(offsets))
    for _ in range(4):
        root = np.sqrt(weights * robustness)
        motion = np.linalg.lstsq(design * root[:, None], offsets * root, rcond=None)[0].astype(np.float64)
        residual = np.abs(offsets - design @ motion) * np.sqrt(weights)
        sigma = robust_sigma(residual) + 1e-9
        robustness = huber_weights(residual, sigma)
    dx, dy, rotation, scale_change = motion.tolist()
    corners = (field.corners_px - centre) / np.abs(field.corners_px - centre).max()
    u, v = corners.T
    corner_movements = np.stack([dx - rotation * v + scale_change * u, dy + rotation * u + scale_change * v], axis=-1)
    largest = max(float(np.linalg.norm(corner_movements, axis=1).max()), float(np.hypot(dx, dy)))
    return Shift(dx, dy, largest, len(offsets), blur_growth)


WIDTH_PX = 640  # Longest side of a preview, px

_QUALITY = 80  # JPEG quality, for about 40 kB per preview

_LETTER_PX = 7.4  # Width of a letter at `_SCALE`, px

_SCALE = 0.42  # Scale of OpenCV's font: the smallest that is easy to read

# Full brightness of a preview is at least this level, relative to white paper. With a lower level, the noise of a dark
# frame would be visible.
_LEAST_FULL_LEVEL = 0.01


def preview_jpeg(
    mosaic: Mosaic,
    black: _Points,
    white: _Points,
    outlines_px: Sequence[_Points],
    boxes: Sequence[tuple[int, int, int, int]],
    cause: str,
) -> bytes:
    """Return a preview of a frame as JPEG bytes, at most 640 px wide or high, with marked regions and a text.

    `black`: (2, 2) float64, black level, counts. `white`: (3,) float64, camera RGB of white, counts above black.
    `outlines_px`: polygons (K, 2) float64 half-size px. `boxes`: left, top, right, bottom of regions, half-size px.
    """
    blocks = mosaic.block_planes()
    height, width = blocks.shape[2:]
    step = -(-max(height, width) // WIDTH_PX)
    positions = phases(mosaic)
    small = np.empty((-(-height // step), -(-width // step), 3), dtype=np.float32)
    for index, channel in enumerate(CHANNELS):
        row, column = positions[channel][0]
        scale = np.float32(1 / max(float(white[index]), 1.0))
        small[:, :, 2 - index] = (blocks[row, column, ::step, ::step] - np.float32(black[row, column])) * scale
    brightest = max(float(np.percentile(small[::4, ::4].max(axis=2), 99.5)), _LEAST_FULL_LEVEL)
    image = (np.sqrt(np.clip(small, 0, brightest) / np.float32(brightest)) * 255).astype(np.uint8)
    for corners in outlines_px:
        cv2.polylines(image, [(corners / step).round().astype(np.int32)], True, GREEN, 1, cv2.LINE_AA)
    for box in boxes:
        x0, y0, x1, y1 = (edge // step for edge in box)
        cv2.rectangle(image, (x0, y0), (x1 - 1, y1 - 1), RED, 1)
    if cause:
        image = _with_text(image, cause)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()


def _with_text(image: npt.NDArray[np.uint8], cause: str) -> npt.NDArray[np.uint8]:
    # OpenCV's font has only ASCII letters.
    ascii_cause = cause.replace("°", " deg").replace("×", "x").replace("–", "-").replace("−", "-").replace("…", "...")
    width = max(20, int(image.shape[1] / _LETTER_PX))
    lines = textwrap.wrap(ascii_cause.encode("ascii", "replace").decode(), width)[:5]
    height, line_height = len(image), 17
    top = height - line_height * len(lines) - line_height // 2
    image[top:] //= 3
    for index, text in enumerate(lines):
        cv2.putText(image, text, (6, top + line_height * (index + 1)), FONT, _SCALE, AMBER, 1, cv2.LINE_AA)
    return image
