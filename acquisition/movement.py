"""How far the chart has moved between two frames, measured on its tags in one colour plane."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from acquisition.framing import FoundTag, Framing
from acquisition.planes import Plane

MAX_SHIFT_PX = 3.0

_GAUGE_TAGS = 8
_STEPS = 5

_Points = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shift:
    """How far the chart moved between two frames.

    Attributes
    ----------
    dx, dy
        Median over the tags measured, half-size px; positive when the chart lies further right or down.
    largest_px
        The largest movement of a tag, so that a rotation shows.
    tags
        Tags that could be measured; 0 leaves the rest 0 and means unknown.
    """

    dx: float
    dy: float
    largest_px: float
    tags: int

    @property
    def length_px(self) -> float:
        """Length of the median movement, half-size px."""
        return float(np.hypot(self.dx, self.dy))


def shift_between(reference: Plane, framing: Framing, plane: Plane) -> Shift:
    """Return how far the chart has moved in `plane` since `reference`, of the same channel.

    Two-parameter Lucas–Kanade on tag crops (Lucas and Kanade 1981), gain and offset free, up to about 3 px: below
    that, good to 0.005 px where paper has some hundred counts. Costs about a millisecond.

    Parameters
    ----------
    reference
        The plane to compare with.
    framing
        Where the tags are in `reference`; only tags and places are used, so its own plane may be another colour.
    plane
        The later plane.
    """
    tags = sorted(framing.tags, key=lambda tag: tag.id)
    shifts: list[_Points] = []
    last = len(tags) - 1
    for number in sorted({round(last * part / (_GAUGE_TAGS - 1)) for part in range(_GAUGE_TAGS)}):
        tag = tags[number]
        shift = _tag_shift(reference, plane, tag)
        if shift is not None:
            shifts.append(shift)
    if not shifts:
        return Shift(0.0, 0.0, 0.0, 0)
    table = np.array(shifts)
    median = np.median(table, axis=0)
    return Shift(float(median[0]), float(median[1]), float(np.linalg.norm(table, axis=1).max()), len(shifts))


def _tag_shift(reference: Plane, plane: Plane, tag: FoundTag) -> _Points | None:
    """Return the movement (2,) of one tag, or None where it cannot be told."""
    margin = int(np.ceil(MAX_SHIFT_PX)) + 2
    height, width = reference.values.shape
    corners = tag.corners_px - reference.offset_px
    x0, y0 = np.floor(corners.min(axis=0)).astype(int) - 2
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 3
    if x0 < margin or y0 < margin or x1 > width - margin or y1 > height - margin:
        return None
    # Both crops are slightly smoothed, so that the gradient is one of the light and not of the noise.
    crop = np.s_[y0 - margin : y1 + margin, x0 - margin : x1 + margin]
    before = cv2.GaussianBlur(reference.values[crop], (0, 0), 0.7).astype(np.float64)
    after = cv2.GaussianBlur(plane.values[crop], (0, 0), 0.7)
    inner = np.s_[margin:-margin, margin:-margin]
    gy, gx = (np.asarray(gradient)[inner].ravel() for gradient in np.gradient(before))
    template = before[inner].ravel()
    now = template
    rows, columns = np.mgrid[margin : before.shape[0] - margin, margin : before.shape[1] - margin].astype(np.float32)
    shift = np.zeros(2)
    for _ in range(_STEPS):
        moved = cv2.remap(after, columns + np.float32(shift[0]), rows + np.float32(shift[1]), cv2.INTER_CUBIC)
        now = np.asarray(moved, dtype=np.float64).ravel()
        # now = gain · (template + g · step) + offset, linear in (gain, offset, gain · step).
        design = np.column_stack([template, np.ones_like(template), gx, gy])
        solution, _, rank, _ = np.linalg.lstsq(design, now, rcond=None)
        if rank < 4 or solution[0] <= 0:
            return None
        step = solution[2:] / solution[0]
        # The crop read at x + shift shows the tag as it was at x + shift − movement.
        shift -= np.clip(step, -1, 1)
        if np.abs(shift).max() > MAX_SHIFT_PX + 1:
            return None
        if np.abs(step).max() < 1e-3:
            break
    correlation = np.corrcoef(now, template)[0, 1]
    return shift if correlation > 0.5 else None
