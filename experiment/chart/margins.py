"""What a sheet carries in its margins: crop marks, two rulers, targets of sharpness, and the lines that name it.

Laws that hold here:

- Places and sizes are whole pixels at 600 dpi, the raster in which a chart is designed (lengths on the print are
  millimetres elsewhere), so the TIFF and the PDF show the same; what is printed is black on bare paper, in rectangles,
  so neither file needs a font.
- Nothing stands nearer to the field than 1.5 mm, leaves the sheet, or touches what the chart has in its margin. What
  finds no room is left out, and the rest stays.
- A ruler's ticks stand at the whole pixel nearest to their millimetre: each within 0.022 mm, and the errors do not add
  up; 127 mm are 3000 pixels exactly.

Knows boxes and a sheet, neither colours nor files. Local places (u, v): u along a margin from the field's left or top
end, v outwards from the field's edge.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt

MM_PER_INCH = 25.4  # Exact, by definition of the international inch

DESIGN_DPI = 600  # Resolution of the design: photo printers and plotters work at it or at a multiple

PX_MM = MM_PER_INCH / DESIGN_DPI  # Millimetres of a pixel of the design

# How far a coordinate read from a file may lie beside a whole pixel: six decimals of a millimetre are 2e-5 px.
_ROUNDING_PX = 1e-3

Boxes = npt.NDArray[np.int64]  # (N, 4) int64: left, top, right, bottom, px at 600 dpi


def whole_px(boxes_mm: npt.ArrayLike) -> Boxes:
    """Return the smallest boxes (N, 4) int64, whole pixels, that hold boxes (N, 4) mm: left, top, right, bottom."""
    exact = np.asarray(boxes_mm, dtype=np.float64).reshape(-1, 4) / PX_MM
    return np.concatenate([np.floor(exact[:, :2] + _ROUNDING_PX), np.ceil(exact[:, 2:] - _ROUNDING_PX)], axis=1).astype(
        np.int64
    )


# Bare paper around the field: 1.5 mm are three half-size pixels of the EOS 550D, more than its blur reaches.
GAP_PX = 35

# Length and width of a crop mark's strokes, 5 mm and 0.2 mm: long enough to lay a rule along, and visible.
CROP_PX, CROP_STROKE_PX = 120, 5

TICK_PX = 4  # Width of a ruler's tick: 0.17 mm, as on a steel rule

TICKS_PX = ((100, 60), (10, 47), (5, 36), (1, 24))  # A ruler's ticks: their distance in mm and their length

NUMBERS_PX = 100  # Where a ruler's numbers begin, outwards from the field

# Widths of the line target's bars, three bars each: 0.39, 0.59, 0.79, 0.98, 1.2 … 11.8 line pairs a millimetre. The
# EOS 550D's half-size image of an A0 sheet ends at 0.97, a 600-dpi print at 11.8.
BARS_PX = (30, 20, 15, 12, 10, 8, 6, 5, 4, 3, 2, 1)

BAR_LENGTH_PX = 75  # Length of the bars, 3.2 mm: several pixels of a half-size image of A0 to average along

# Diameter and spokes of the Siemens star: 0.75 line pairs a millimetre at its rim, finer inwards; a half-size image
# of the EOS 550D resolves the rim.
STAR_PX, STAR_CYCLES = 120, 12

# The slanted edge of ISO 12233: 24 steps of one pixel in twelve, 4.8 degrees.
EDGE_STEPS, EDGE_RUN_PX, EDGE_DEPTH_PX = 24, 12, 60

_DOT_PX = 2  # Pixels of a dot of text: capitals of 15 dots are 1.3 mm high

_LINE_PX = 48  # From line to line of text, 2 mm

_AIR_PX = 20  # Bare paper around whatever is put into a margin, 0.85 mm

_SEARCH_PX = 24  # Steps in which a free place along a margin is looked for, 1 mm

Side = Literal["left", "top", "right", "bottom"]


def text_boxes(text: str, dot_px: int = _DOT_PX) -> Boxes:
    """Return a line of ASCII as black boxes (N, 4) int64 px from (0, 0) on; capitals are 15 dots high."""
    import cv2

    font, scale, stroke = cv2.FONT_HERSHEY_SIMPLEX, 0.7, 2
    (columns, ascent), descent = cv2.getTextSize(text, font, scale, stroke)
    bitmap = np.zeros((ascent + descent + stroke, columns + 2 * stroke), dtype=np.uint8)
    cv2.putText(bitmap, text, (0, ascent), font, scale, 255, stroke, cv2.LINE_8)
    used = np.flatnonzero((bitmap > 127).any(axis=0))
    last = int(used.max()) + 1 if used.size else 0
    return _boxes_of((bitmap > 127)[:, :last]) * dot_px


def _boxes_of(bitmap: npt.NDArray[np.bool_]) -> Boxes:
    """Return a bitmap (H, W) as boxes (N, 4): runs along its rows, equal ones below each other joined."""
    edges = np.diff(np.pad(bitmap.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    rows, starts = np.nonzero(edges == 1)
    ends = np.nonzero(edges == -1)[1]
    boxes: list[list[int]] = []
    open_: dict[tuple[int, int], int] = {}
    for row, start, end in zip(rows.tolist(), starts.tolist(), ends.tolist(), strict=True):
        before = open_.get((start, end))
        if before is not None and boxes[before][3] == row:
            boxes[before][3] = row + 1
        else:
            open_[start, end] = len(boxes)
            boxes.append([start, row, end, row + 1])
    return np.array(boxes, dtype=np.int64).reshape(-1, 4)


def star_boxes() -> Boxes:
    """Return a Siemens star of 12 black spokes, 5.1 mm across, as boxes (N, 4) int64 px from (0, 0) on.

    Source: ISO 15775; the radius at which the spokes run together is where print or lens ends.
    """
    size = STAR_PX // _DOT_PX
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    dark = (np.sin(STAR_CYCLES * np.arctan2(y, x)) > 0) & (np.hypot(x, y) <= size / 2)
    return _boxes_of(dark) * _DOT_PX


def edge_boxes() -> Boxes:
    """Return a black field whose lower edge falls by one pixel in twelve (slanted edge, ISO 12233): (24, 4) int64."""
    step = np.arange(EDGE_STEPS)
    # Each box reaches to the end below the next: parts that only touch can show a hairline between them.
    return np.stack(
        [step * EDGE_RUN_PX, 0 * step, 0 * step + EDGE_STEPS * EDGE_RUN_PX, EDGE_DEPTH_PX + step], axis=1
    ).astype(np.int64)


def bar_boxes() -> Boxes:
    """Return groups of three bars across u, from the widest of `BARS_PX` to the finest: (36, 4) int64 px."""
    boxes: list[tuple[int, int, int, int]] = []
    start = 0
    for width in BARS_PX:
        boxes += [(start + k * width, 0, start + (k + 1) * width, BAR_LENGTH_PX) for k in (0, 2, 4)]
        start += 5 * width + max(width, 12)
    return np.array(boxes, dtype=np.int64)


def ruler_ticks(length_px: int) -> list[tuple[int, int, int]]:
    """Return (millimetre, u of the tick's first pixel, length) of every tick of a ruler that is `length_px` long."""
    ticks: list[tuple[int, int, int]] = []
    for mm in range(math.floor(length_px * PX_MM) + 1):
        start = round(mm / PX_MM)
        if start + TICK_PX <= length_px:
            ticks.append((mm, start, next(long for every, long in TICKS_PX if mm % every == 0)))
    return ticks


def number_every_mm(length_px: int) -> int:
    """Return how far apart a ruler's numbers stand: 100 mm, or 10 mm where a sheet is short."""
    return 100 if length_px * PX_MM > 300 else 10


class Margins:
    """The four margins of a sheet around its field, and what is put there.

    `field`: (4,) int64 box of the field, px. `taken`: (N, 4) boxes outside the field that nothing may touch.
    """

    def __init__(self, field: Boxes, page_px: tuple[int, int], taken: Boxes) -> None:
        self._field = field
        self._page = page_px
        self._taken = [taken.reshape(-1, 4)]
        self._placed: list[Boxes] = []

    @property
    def boxes(self) -> Boxes:
        """(N, 4) int64 px: everything that was put into the margins."""
        return np.concatenate([np.empty((0, 4), dtype=np.int64), *self._placed])

    def length(self, side: Side) -> int:
        """Return the field's extent along a margin, px."""
        left, top, right, bottom = self._field.tolist()
        return right - left if side in {"top", "bottom"} else bottom - top

    def put(self, side: Side, boxes: Boxes) -> bool:
        """Put boxes (N, 4) int64 px, given as (u, v), into a margin if all of it is free; return whether it was."""
        there = self._on_sheet(side, boxes)
        return self._put(there, boxes[:, 1].min() >= GAP_PX)

    def put_somewhere(self, side: Side, boxes: Boxes, start: int) -> bool:
        """Put boxes (N, 4) int64 px at the first free place along a margin from u = `start` on, within the field."""
        places = np.arange(max(0, start), self.length(side) - int(boxes[:, 2].max()) + 1, _SEARCH_PX)
        # Mostly the first is free.
        if len(places) and self.put(side, boxes + np.array([places[0], 0, places[0], 0])):
            return True
        taken = self._taken_at(side, boxes, places)
        return any(self.put(side, boxes + np.array([u, 0, u, 0])) for u in places[~taken].tolist())

    def crop_marks(self) -> None:
        """Mark the sheet's corners by two strokes each, along the edges where it is to be cut."""
        width, height = self._page
        long, stroke = CROP_PX, CROP_STROKE_PX
        along = [(0, 0, long, stroke), (0, 0, stroke, long)]
        boxes = [
            (
                *((width - x1, width - x0) if right else (x0, x1)),
                *((height - y1, height - y0) if low else (y0, y1)),
            )
            for right in (False, True)
            for low in (False, True)
            for x0, y0, x1, y1 in along
        ]
        self._put(np.array(boxes, dtype=np.int64)[:, [0, 2, 1, 3]], clear=True)

    def ruler(self, side: Literal["left", "bottom"]) -> bool:
        """Put a millimetre ruler along the whole field, numbered in mm from its left or top end."""
        length = self.length(side)
        ticks = ruler_ticks(length)
        boxes = [
            np.array([[start, GAP_PX, start + TICK_PX, GAP_PX + long] for _, start, long in ticks], dtype=np.int64)
        ]
        every = number_every_mm(length)
        for mm, start, _ in ticks:
            if mm % every:
                continue
            number = text_boxes(f"{mm}")
            width, height = number[:, 2:].max(axis=0).tolist()
            if side == "left":
                # Read upwards: the text's top lies towards the sheet's edge.
                number = np.array([width, height, width, height]) - number[:, [2, 3, 0, 1]]
            first = start + TICK_PX // 2 - width // 2
            boxes.append(number + np.array([first, NUMBERS_PX, first, NUMBERS_PX]))
        return bool(ticks) and self.put(side, np.concatenate(boxes))

    def lines(self, lines: Sequence[str], start: int) -> bool:
        """Put lines of text into the top margin, the last nearest to the field, at half the size if need be."""
        for dot in (_DOT_PX, 1):
            boxes: list[Boxes] = []
            for row, line in enumerate(lines):
                down = row * _LINE_PX * dot // _DOT_PX
                boxes.append(text_boxes(line, dot) + np.array([0, down, 0, down]))
            text = np.concatenate(boxes)
            low = int(text[:, 3].max()) + GAP_PX
            # Upwards from the field v grows.
            if self.put_somewhere(
                "top", np.stack([text[:, 0], low - text[:, 3], text[:, 2], low - text[:, 1]], 1), start
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

    def _taken_at(self, side: Side, boxes: Boxes, shifts: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Return whether something is in the way of boxes (N, 4) px, (u, v), shifted along a margin: (M,) of (M,) px.

        All shifts at once: two boxes that overlap across the margin keep an open interval of shifts from each other.
        """
        axis, across = (0, 1) if side in {"top", "bottom"} else (1, 0)
        boxes, others = self._on_sheet(side, boxes), np.concatenate(self._taken)
        low, high = boxes[:, None, across] - _AIR_PX, boxes[:, None, across + 2] + _AIR_PX
        others = others[(low.min() < others[:, across + 2]) & (others[:, across] < high.max())]
        one, other = np.nonzero((low < others[:, across + 2]) & (others[:, across] < high))
        first = others[other, axis] - boxes[one, axis + 2] - _AIR_PX
        last = others[other, axis + 2] - boxes[one, axis] + _AIR_PX
        begun = np.bincount(np.searchsorted(shifts, first, "right"), minlength=len(shifts) + 1)
        ended = np.bincount(np.searchsorted(shifts, last, "left"), minlength=len(shifts) + 1)
        return np.cumsum(begun - ended)[: len(shifts)] > 0

    def _put(self, boxes: Boxes, clear: bool) -> bool:
        hull = np.concatenate([boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)])
        outside = (hull[:2] < 0).any() or (hull[2:] > np.array(self._page)).any()
        grown = np.concatenate([boxes[:, :2] - GAP_PX, boxes[:, 2:] + GAP_PX], axis=1)
        if not clear or outside or _meet(grown, self._field[None]):
            return False
        air = np.array([-_AIR_PX, -_AIR_PX, _AIR_PX, _AIR_PX])
        # What meets one of them meets the box about all of them, and that is asked of far fewer pairs.
        around = hull[None] + air
        near = [taken[_meeting(taken, around)] for taken in self._taken]
        if any(_meet(boxes + air, taken) for taken in near):
            return False
        self._taken.append(boxes)
        self._placed.append(boxes)
        return True


def target_boxes() -> Boxes:
    """Return star, slanted edge and bars side by side along u, 52 mm long, clear of the field: (N, 4) int64 px."""
    parts: list[Boxes] = []
    start = 0
    for part in (star_boxes(), edge_boxes(), bar_boxes()):
        parts.append(part + np.array([start, GAP_PX, start, GAP_PX]))
        start = int(parts[-1][:, 2].max()) + 30
    return np.concatenate(parts)


def _meet(some: Boxes, others: Boxes) -> bool:
    """Return whether any of some boxes (N, 4) overlaps any of the others (M, 4)."""
    return bool(_meeting(some, others).any())


def _meeting(some: Boxes, others: Boxes) -> npt.NDArray[np.bool_]:
    """Return which of some boxes (N, 4) overlap any of the others (M, 4)."""
    x0, y0, x1, y1 = (edge[:, None] for edge in some.T)
    left, top, right, bottom = others.T
    return np.asarray(((x0 < right) & (left < x1) & (y0 < bottom) & (top < y1)).any(axis=1))


def margin_marks(field: Boxes, page_px: tuple[int, int], taken: Boxes, lines: Iterable[str]) -> Boxes:
    """Return all marks of a sheet, black on bare paper.

    Crop marks at its corners, rulers below and on the left, the lines that name it above the field, and targets of
    sharpness above and on the right, near the corners and in the middle, as many as find room.

    `field`: (4,) int64 box of the field, px. `taken`: (N, 4) boxes outside the field that nothing may touch. Returns
    (N, 4) int64 px.
    """
    margins = Margins(field, page_px, taken)
    margins.crop_marks()
    margins.ruler("bottom")
    margins.ruler("left")
    names = list(lines)
    targets = target_boxes()
    long = int(targets[:, 2].max()) + GAP_PX
    across, down = margins.length("top"), margins.length("right")
    # A short sheet has no room for both: then it is named and has its targets on the right.
    name_length = max(int(text_boxes(line)[:, 2].max(initial=0)) for line in names) if names else 0
    roomy = across >= 2 * long + name_length
    if roomy:
        margins.put_somewhere("top", targets, 0)
    if names:
        margins.lines(names, long if roomy else 0)
    for start in (0, (down - long) // 2, down - long) if down >= 3 * long else (0,):
        margins.put_somewhere("right", targets, start)
    for start in ((across - long) // 2, across - long) if across >= 3 * long else ():
        margins.put_somewhere("top", targets, start)
    return margins.boxes
