"""What is printed around each patch: cells and references in slots of one size, tags and margins in fifths of a slot.

Charts of `experiment.chart.layout` are made so: every cell and reference fills a slot, a tag has 4 × 4 of them and a
module is two fifths of one. A patch is a cell (in the order of colour indices) or a reference behind them, the white
ones before the grey ones. Slots and millimetres on the print; knows nothing of frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.chart.model import Chart
from experiment.chart.printing import drawing

PARTS = 5
"""Parts along a slot: a tag's module is two of them, so that every edge printed lies between two parts."""

REACH = 2
"""Slots on each side of a patch that are looked at one by one, 25 px and more: what comes from further away does not
depend on where within its slot a patch is sampled."""

PAD = 6
"""Slots around the outermost patches: margins and what lies behind the print, as far as wide kernels see them."""

_OFF_GRID = 0.02
"""Part of a slot that a patch may lie beside its grid: rounding of a file, and nothing to a lens."""

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class PrintedGrid:
    """The print as a grid of slots.

    - `pitch_mm`: width and height of a slot.
    - `points_mm`: (P, 2) float64 mm, centres of the patches: C cells, then references.
    - `row`, `column`: (P,) int64, the slot of each patch.
    - `source`: (R, K) int32, the patch in each slot; −1 where there is none.
    - `parts`: (5 R, 5 K) int32, the patch that each part of a slot shows; P for bare paper, P + 1 for black ink, P + 2
      beyond the sheet.
    - `others`: (R, K, 3) float32, share of each slot that is bare paper, black ink, and beyond the sheet.
    - `slots_mm`: (R K, 2) float64 mm, centres of the slots.
    """

    pitch_mm: tuple[float, float]
    points_mm: _Array
    row: npt.NDArray[np.int64]
    column: npt.NDArray[np.int64]
    source: _Index
    parts: _Index
    others: npt.NDArray[np.float32]
    slots_mm: _Array

    @property
    def neighbours(self) -> _Index:
        """(P, 25) int32, the patches in the 5 × 5 slots around each patch, row by row; −1 where there is none."""
        steps = np.arange(-REACH, REACH + 1)
        rows, columns = self.row[:, None, None] + steps[:, None], self.column[:, None, None] + steps
        return np.ascontiguousarray(self.source[rows, columns].reshape(len(self.row), -1))


def unsuitable(chart: Chart) -> str:
    """Return why the lens cannot be measured on a chart, as a clause; "" where it can."""
    if not chart.tags:
        return "the chart has no tags, and its colours lie in a smooth order: neighbours are too much alike"
    if chart.bits < LEAST_BITS:
        return f"the chart has {chart.colour_count} cells; {8**LEAST_BITS} are expected, so that chance averages out"
    return "" if _fits_grid(chart) else "cells and references do not all lie on one grid of slots of their own size"


LEAST_BITS = 3
"""Bits of a channel from which on a cell has neighbours in colour whose curvature can be told from chance."""


def _points(chart: Chart) -> _Array:
    whites = [reference.centre_mm for reference in chart.references if reference.is_white]
    greys = [reference.centre_mm for reference in chart.references if not reference.is_white]
    references = np.array([*whites, *greys], dtype=np.float64).reshape(-1, 2)
    return np.concatenate([chart.centres_mm[chart.cell_of_colour], references])


def _slots(chart: Chart) -> tuple[_Array, _Array]:
    """Return the first slot's centre (2,) mm and the slots (P, 2) float64 of patches, column then row."""
    points = _points(chart)
    low = points.min(axis=0)
    return low, (points - low) / np.array(chart.cell_mm)


def _fits_grid(chart: Chart) -> bool:
    _, slots = _slots(chart)
    sizes = np.array([reference.size_mm for reference in chart.references]).reshape(-1, 2)
    alike = np.allclose(sizes, chart.cell_mm, rtol=_OFF_GRID)
    own = len(np.unique(np.rint(slots), axis=0)) == len(slots)
    return alike and own and bool(np.abs(slots - np.rint(slots)).max() < _OFF_GRID)


def printed_grid(chart: Chart) -> PrintedGrid:
    """Return the grid of a chart of which `unsuitable` says nothing."""
    low, slots = _slots(chart)
    column, row = np.rint(slots).astype(np.int64).T + PAD
    count = len(row)
    rows, columns = int(row.max()) + 1 + PAD, int(column.max()) + 1 + PAD
    source = np.full((rows, columns), -1, dtype=np.int32)
    source[row, column] = np.arange(count)
    width, height = chart.cell_mm
    x = low[0] + ((np.arange(columns * PARTS) + 0.5) / PARTS - 0.5 - PAD) * width
    y = low[1] + ((np.arange(rows * PARTS) + 0.5) / PARTS - 0.5 - PAD) * height
    sheet = ((y > 0) & (y < chart.page_mm[1]))[:, None] & ((x > 0) & (x < chart.page_mm[0]))
    parts = np.where(sheet, count, count + 2).astype(np.int32)
    drawn = drawing(chart)
    plain = len(drawn.rgb) - drawn.tiles
    rectangles = np.asarray(drawn.rectangles_mm[:plain], dtype=np.float64).reshape(-1, 2, 2)
    edges = np.stack([np.searchsorted(x, rectangles[..., 0]), np.searchsorted(y, rectangles[..., 1])], axis=-1)
    for ((left, top), (right, bottom)), rgb in zip(edges.tolist(), drawn.rgb[:plain], strict=True):
        parts[top:bottom, left:right] = count if rgb[0] > 127 else count + 1
    of_slots = parts.reshape(rows, PARTS, columns, PARTS)
    patches = source[:, None, :, None]
    parts = np.where(patches >= 0, patches, of_slots).reshape(parts.shape).astype(np.int32)
    kinds = parts.reshape(rows, PARTS, columns, PARTS, 1) == np.arange(count, count + 3)
    slot_x, slot_y = x[PARTS // 2 :: PARTS], y[PARTS // 2 :: PARTS]
    return PrintedGrid(
        pitch_mm=(width, height),
        points_mm=_points(chart),
        row=row,
        column=column,
        source=source,
        parts=parts,
        others=kinds.mean(axis=(1, 3)).astype(np.float32),
        slots_mm=np.column_stack([np.tile(slot_x, rows), np.repeat(slot_y, columns)]),
    )
