"""Place the marks in the margins of a sheet: crop marks, rulers, sharpness targets and lines of text.

- Every mark consists of black rectangles, so no file needs a font. Positions and sizes are whole pixels at 600 dpi, so
  TIFF and PDF show the same.
- A mark is at least 1.5 mm away from the patches and does not touch the references in the margin. A mark without enough
  room is omitted.
- Each tick of a ruler is rounded to a whole pixel, with an error of at most 0.022 mm. Errors do not accumulate.

Positions in a margin are (u, v): u along the margin, from the left or top end of the patch area; v outwards from the
edge of the patch area.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

MM_PER_INCH = 25.4  # Exact, by definition of the international inch

DESIGN_DPI = 600  # Resolution of the design, dpi. Photo printers and plotters use this resolution or a multiple.

PX_MM = MM_PER_INCH / DESIGN_DPI  # Size of a pixel of the design, mm

# A coordinate this close to a whole pixel counts as whole. Files round coordinates by up to 2e-5 px.
_ROUNDING_PX = 1e-3

Boxes = npt.NDArray[np.int64]  # (N, 4) int64: left, top, right, bottom, px at 600 dpi


def whole_px(boxes_mm: npt.ArrayLike) -> Boxes:
    """Return the smallest boxes (N, 4) int64 px that contain boxes (N, 4) mm: left, top, right, bottom."""
    exact = np.asarray(boxes_mm, dtype=np.float64).reshape(-1, 4) / PX_MM
    return np.concatenate([np.floor(exact[:, :2] + _ROUNDING_PX), np.ceil(exact[:, 2:] - _ROUNDING_PX)], axis=1).astype(
        np.int64
    )


# Width of bare paper around the patches, 1.5 mm. In an image by the EOS 550D, this is wider than the blur.
GAP_PX = 35

# Length and width of the strokes of a crop mark, 5 mm and 0.2 mm.
CROP_PX, CROP_STROKE_PX = 120, 5

TICK_PX = 4  # Width of a tick of a ruler, 0.17 mm, as on a steel ruler

TICKS_PX = ((100, 60), (10, 47), (5, 36), (1, 24))  # Ticks of a ruler: distance in mm, and length in px

NUMBERS_PX = 100  # Distance of the numbers of a ruler from the patches, px

# Widths of the bars, three bars of each: 0.39 to 11.8 line pairs per millimetre. A half-size image of an A0 sheet by an
# EOS 550D resolves 0.97 line pairs per millimetre.
BARS_PX = (30, 20, 15, 12, 10, 8, 6, 5, 4, 3, 2, 1)

BAR_LENGTH_PX = 75  # Length of the bars, 3.2 mm: several half-size pixels, which can be averaged

# Diameter and number of spokes of the Siemens star. At its edge it has 0.75 line pairs per millimetre.
STAR_PX, STAR_CYCLES = 120, 12

# Slanted edge of ISO 12233 with 4.8 degrees: number of steps, length of a step, and smallest depth of the black area.
EDGE_STEPS, EDGE_RUN_PX, EDGE_DEPTH_PX = 24, 12, 60

_DOT_PX = 2  # Size of a dot of the text, px; capitals are 15 dots high, that is 1.3 mm

_LINE_PX = 48  # Distance of the lines of text, 2 mm

_MARK_GAP_PX = 20  # Width of bare paper around each mark, 0.85 mm

_SEARCH_PX = 24  # Step of the search for free space along a margin, 1 mm

Side = Literal["left", "top", "right", "bottom"]


def text_boxes(text: str, dot_px: int = _DOT_PX) -> Boxes:
    """Return a line of ASCII text as black boxes (N, 4) int64 px, starting at (0, 0); capitals are 15 dots high."""
    import cv2

    font, scale, stroke = cv2.FONT_HERSHEY_SIMPLEX, 0.7, 2
    (columns, ascent), descent = cv2.getTextSize(text, font, scale, stroke)
    bitmap = np.zeros((ascent + descent + stroke, columns + 2 * stroke), dtype=np.uint8)
    cv2.putText(bitmap, text, (0, ascent), font, scale, 255, stroke, cv2.LINE_8)
    used_columns = np.flatnonzero((bitmap > 127).any(axis=0))
    width = int(used_columns.max()) + 1 if used_columns.size else 0
    return _boxes_of((bitmap > 127)[:, :width]) * dot_px


def _boxes_of(bitmap: npt.NDArray[np.bool_]) -> Boxes:
    """Convert a bitmap (H, W) to boxes (N, 4). Each box joins equal runs of true pixels in successive rows."""
    edges = np.diff(np.pad(bitmap.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    boxes: list[list[int]] = []
    open_boxes: dict[tuple[int, int], int] = {}
    for row, start, end in zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True):
        previous = open_boxes.get((start, end))
        if previous is not None and boxes[previous][3] == row:
            boxes[previous][3] = row + 1
        else:
            open_boxes[start, end] = len(boxes)
            boxes.append([start, row, end, row + 1])
    return np.array(boxes, dtype=np.int64).reshape(-1, 4)


def star_boxes() -> Boxes:
    """Return a Siemens star of 12 black spokes, 5.1 mm wide, as boxes (N, 4) int64 px, starting at (0, 0).

    Source: ISO 15775. The radius at which the spokes merge shows the resolution of the print or the lens.
    """
    size = STAR_PX // _DOT_PX
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    is_dark = (np.sin(STAR_CYCLES * np.arctan2(y, x)) > 0) & (np.hypot(x, y) <= size / 2)
    return _boxes_of(is_dark) * _DOT_PX


def edge_boxes() -> Boxes:
    """Return a black area with a lower edge that falls by one pixel in twelve (ISO 12233): (24, 4) int64."""
    step = np.arange(EDGE_STEPS)
    # Each box overlaps the next box, because a hairline may be visible between boxes that only touch.
    return np.stack(
        [step * EDGE_RUN_PX, 0 * step, 0 * step + EDGE_STEPS * EDGE_RUN_PX, EDGE_DEPTH_PX + step], axis=1
    ).astype(np.int64)


def bar_boxes() -> Boxes:
    """Return groups of three bars along u, from the widest of `BARS_PX` to the narrowest: (36, 4) int64 px."""
    boxes: list[tuple[int, int, int, int]] = []
    start = 0
    for width in BARS_PX:
        boxes += [(start + k * width, 0, start + (k + 1) * width, BAR_LENGTH_PX) for k in (0, 2, 4)]
        start += 5 * width + max(width, 12)
    return np.array(boxes, dtype=np.int64)


def ruler_ticks(length_px: int) -> list[tuple[int, int, int]]:
    """Return (position in mm, u of the first pixel, length in px) of every tick of a ruler with `length_px`."""
    ticks: list[tuple[int, int, int]] = []
    for mm in range(math.floor(length_px * PX_MM) + 1):
        start = round(mm / PX_MM)
        if start + TICK_PX <= length_px:
            ticks.append((mm, start, next(tick for step_mm, tick in TICKS_PX if mm % step_mm == 0)))
    return ticks


def number_every_mm(length_px: int) -> int:
    """Return the distance between the numbers of a ruler: 100 mm, or 10 mm on a short sheet."""
    return 100 if length_px * PX_MM > 300 else 10


class Margins:
    """The four margins of a sheet around its patches, and the marks in them.

    `field`: (4,) int64 px, box of the patch area. `occupied`: (N, 4) int64 px, boxes in the margins that marks must not
    touch, for example references.
    """

    def __init__(self, field: Boxes, page_px: tuple[int, int], occupied: Boxes) -> None:
        self._field = field
        self._page = page_px
        self._occupied = [occupied.reshape(-1, 4)]
        self._marks: list[Boxes] = []

    @property
    def boxes(self) -> Boxes:
        """(N, 4) int64 px, all marks."""
        return np.concatenate([np.empty((0, 4), dtype=np.int64), *self._marks])

    def length(self, side: Side) -> int:
        """Return the extent of the patch area along a margin, px."""
        left, top, right, bottom = self._field.tolist()
        return right - left if side in {"top", "bottom"} else bottom - top

    def put(self, side: Side, boxes: Boxes) -> bool:
        """Put boxes (N, 4) int64 px in (u, v) into a margin if the space is free; return whether it was free."""
        placed = self._on_sheet(side, boxes)
        return self._put(placed, boxes[:, 1].min() >= GAP_PX)

    def put_somewhere(self, side: Side, boxes: Boxes, start: int) -> bool:
        """Put boxes (N, 4) int64 px at the first free position of a margin with u ≥ `start`; return success."""
        positions = np.arange(max(0, start), self.length(side) - int(boxes[:, 2].max()) + 1, _SEARCH_PX)
        # Try the first position alone, because it is usually free.
        if len(positions) and self.put(side, boxes + np.array([positions[0], 0, positions[0], 0])):
            return True
        overlaps = self._overlaps_at(side, boxes, positions)
        return any(self.put(side, boxes + np.array([u, 0, u, 0])) for u in positions[~overlaps].tolist())

    def crop_marks(self) -> None:
        """Mark each corner of the sheet by two strokes along the edges to be cut."""
        width, height = self._page
        long, stroke = CROP_PX, CROP_STROKE_PX
        strokes = [(0, 0, long, stroke), (0, 0, stroke, long)]
        boxes = [
            (
                *((width - x1, width - x0) if right else (x0, x1)),
                *((height - y1, height - y0) if low else (y0, y1)),
            )
            for right in (False, True)
            for low in (False, True)
            for x0, y0, x1, y1 in strokes
        ]
        self._put(np.array(boxes, dtype=np.int64)[:, [0, 2, 1, 3]], has_gap=True)

    def ruler(self, side: Literal["left", "bottom"]) -> bool:
        """Put a millimetre ruler along the whole patch area; return success. Its numbers start at the left or top."""
        length = self.length(side)
        ticks = ruler_ticks(length)
        boxes = [np.array([[start, GAP_PX, start + TICK_PX, GAP_PX + end] for _, start, end in ticks], dtype=np.int64)]
        interval_mm = number_every_mm(length)
        for mm, start, _ in ticks:
            if mm % interval_mm:
                continue
            number = text_boxes(f"{mm}")
            width, height = number[:, 2:].max(axis=0).tolist()
            if side == "left":
                # Turn the number by 180°, so that its top points to the edge of the sheet.
                number = np.array([width, height, width, height]) - number[:, [2, 3, 0, 1]]
            offset = start + TICK_PX // 2 - width // 2
            boxes.append(number + np.array([offset, NUMBERS_PX, offset, NUMBERS_PX]))
        return bool(ticks) and self.put(side, np.concatenate(boxes))

    def lines(self, lines: Sequence[str], start: int) -> bool:
        """Put lines of text into the top margin, if necessary at half the size; return success."""
        for dot_px in (_DOT_PX, 1):
            boxes: list[Boxes] = []
            for row, line in enumerate(lines):
                offset = row * _LINE_PX * dot_px // _DOT_PX
                boxes.append(text_boxes(line, dot_px) + np.array([0, offset, 0, offset]))
            text = np.concatenate(boxes)
            bottom = int(text[:, 3].max()) + GAP_PX
            # In the top margin, v increases upwards.
            if self.put_somewhere(
                "top", np.stack([text[:, 0], bottom - text[:, 3], text[:, 2], bottom - text[:, 1]], 1), start
            ):
                return True
        return False

    def _on_sheet(self, side: Side, boxes: Boxes) -> Boxes:
        left, top, right, bottom = self._field.tolist()
        u0, v0, u1, v1 = boxes.T
        match side:
            case "bottom":
                placed = (left + u0, bottom + v0, left + u1, bottom + v1)
            case "top":
                placed = (left + u0, top - v1, left + u1, top - v0)
            case "left":
                placed = (left - v1, top + u0, left - v0, top + u1)
            case "right":
                placed = (right + v0, top + u0, right + v1, top + u1)
        return np.stack(placed, axis=1)

    def _overlaps_at(self, side: Side, boxes: Boxes, shifts: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Return for each shift (M,) px along a margin whether boxes (N, 4) px in (u, v) overlap other marks."""
        # A box and a mark that overlap in v also overlap in u for one open interval of shifts.
        axis, across = (0, 1) if side in {"top", "bottom"} else (1, 0)
        boxes, marks = self._on_sheet(side, boxes), np.concatenate(self._occupied)
        lows, highs = boxes[:, None, across] - _MARK_GAP_PX, boxes[:, None, across + 2] + _MARK_GAP_PX
        marks = marks[(lows.min() < marks[:, across + 2]) & (marks[:, across] < highs.max())]
        box_index, other_index = np.nonzero((lows < marks[:, across + 2]) & (marks[:, across] < highs))
        starts = marks[other_index, axis] - boxes[box_index, axis + 2] - _MARK_GAP_PX
        ends = marks[other_index, axis + 2] - boxes[box_index, axis] + _MARK_GAP_PX
        started = np.bincount(np.searchsorted(shifts, starts, "right"), minlength=len(shifts) + 1)
        ended = np.bincount(np.searchsorted(shifts, ends, "left"), minlength=len(shifts) + 1)
        return np.cumsum(started - ended)[: len(shifts)] > 0

    def _put(self, boxes: Boxes, has_gap: bool) -> bool:
        hull = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
        is_outside = (hull[:2] < 0).any() or (hull[2:] > np.array(self._page)).any()
        enlarged = np.concatenate([boxes[:, :2] - GAP_PX, boxes[:, 2:] + GAP_PX], axis=1)
        if not has_gap or is_outside or _any_overlap(enlarged, self._field[None]):
            return False
        margin = np.array([-_MARK_GAP_PX, -_MARK_GAP_PX, _MARK_GAP_PX, _MARK_GAP_PX])
        # Only marks that overlap the bounding box can overlap one of the boxes.
        enlarged_hull = hull[None] + margin
        near_boxes = [mark_boxes[_overlapping(mark_boxes, enlarged_hull)] for mark_boxes in self._occupied]
        if any(_any_overlap(boxes + margin, mark_boxes) for mark_boxes in near_boxes):
            return False
        self._occupied.append(boxes)
        self._marks.append(boxes)
        return True


def target_boxes() -> Boxes:
    """Return star, slanted edge and bars along u, together 52 mm long: (N, 4) int64 px, with the gap to the patches."""
    targets: list[Boxes] = []
    start = 0
    for target in (star_boxes(), edge_boxes(), bar_boxes()):
        targets.append(target + np.array([start, GAP_PX, start, GAP_PX]))
        start = int(targets[-1][:, 2].max()) + 30
    return np.concatenate(targets)


def _any_overlap(boxes: Boxes, marks: Boxes) -> bool:
    return bool(_overlapping(boxes, marks).any())


def _overlapping(boxes: Boxes, marks: Boxes) -> npt.NDArray[np.bool_]:
    x0, y0, x1, y1 = (edge[:, None] for edge in boxes.T)
    left, top, right, bottom = marks.T
    return np.asarray(((x0 < right) & (left < x1) & (y0 < bottom) & (top < y1)).any(axis=1))


def margin_marks(field: Boxes, page_px: tuple[int, int], occupied: Boxes, lines: Iterable[str]) -> Boxes:
    """Return all marks of a sheet, black on bare paper, (N, 4) int64 px; arguments as in `Margins`.

    Crop marks are at the corners, rulers below and on the left, and lines of text above. Sharpness targets are above
    and on the right, as many as fit.
    """
    margins = Margins(field, page_px, occupied)
    margins.crop_marks()
    margins.ruler("bottom")
    margins.ruler("left")
    text_lines = list(lines)
    targets = target_boxes()
    target_length = int(targets[:, 2].max()) + GAP_PX
    across, down = margins.length("top"), margins.length("right")
    # If the text does not fit next to targets above, it has priority.
    name_length = max(int(text_boxes(line)[:, 2].max(initial=0)) for line in text_lines) if text_lines else 0
    has_room = across >= 2 * target_length + name_length
    if has_room:
        margins.put_somewhere("top", targets, 0)
    if text_lines:
        margins.lines(text_lines, target_length if has_room else 0)
    for start in (0, (down - target_length) // 2, down - target_length) if down >= 3 * target_length else (0,):
        margins.put_somewhere("right", targets, start)
    for start in ((across - target_length) // 2, across - target_length) if across >= 3 * target_length else ():
        margins.put_somewhere("top", targets, start)
    return margins.boxes
