"""What is printed around each patch, and the light that kernels of a point spread bring to it from there.

- The print is a grid of slots of one size, as charts of `experiment.chart.layout` are made: every cell and reference
  fills a slot, a tag has 4 × 4 of them and a module is two fifths of one. A patch is a cell (in the order of colour
  indices) or a reference behind them, the white ones before the grey ones.
- Near kernels are integrated over each slot and each of a window's pixels, channel by channel; tags and margins in
  fifths of a slot. Far kernels blur the print slot by slot.
- Of bare paper and black ink levels are the usual ones in the light of the place, of what lies behind the print the
  mean of places beside it.

Half-size pixels; P patches as in `PrintedGrid`; counts above black.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from calibration import kernels
from calibration.kernels import PARTS, REACH
from calibration.spread.fitting import NEAR_PX
from drivers.raw.rawfile import CHANNELS, Mosaic, channel_offset_px, phases
from experiment.chart.model import Chart
from experiment.chart.printing import drawing

PAD = 6  # Slots around the outermost patches: margins and what lies behind the print, as far as wide kernels see them

_OFF_GRID = 0.02  # Part of a slot that a patch may lie beside its grid: rounding of a file, and nothing to a lens

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int32]

# Bits of a channel from which on a cell has neighbours in colour whose curvature can be told from chance.
LEAST_BITS = 3

# First, step and number of the offsets of windows that shares are tabulated at: rounding, a quarter pixel of the
# colour filters, registration and lateral colour stay within 2 px, and cubic terms of a step below 10⁻⁴ of a share.
_OFFSETS_PX = (-2.0, 1 / 16, 65)

_PITCHES = 9  # Sizes of slots that shares are tabulated at, over those that occur

_FAR_REACH = 3.0  # Standard deviations after which a far kernel's tail, 0.3 %, is dropped; it is scaled to keep its sum

_Float = npt.NDArray[np.float32]


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

    @cached_property
    def plain_slots(self) -> float:
        """How many slots bare paper and black ink would fill."""
        return float(self.others[..., :2].sum())

    @cached_property
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


@dataclass(frozen=True, eq=False)
class FrameLevels:
    """What a frame shows, before the lens is corrected.

    - `patches`: (P, 3) float64 counts, mean of each patch.
    - `beyond`: (3,) float64 counts, what lies behind the print.
    """

    patches: _Array
    beyond: _Array


@dataclass(frozen=True, eq=False)
class UsualLight:
    """The field of the session's first frame, by which the light of what is not measured is known in all of them.

    - `patches`, `slots`: (P, 3) and (R K, 3) float64, at patches and slots; beyond the outermost patches as at those.
    - `elsewhere`: (2 kinds, 3) float64, bare paper and black ink, summed over all slots.
    """

    patches: _Array
    slots: _Array
    elsewhere: _Array

    @staticmethod
    def of(grid: PrintedGrid, patches: _Array, slots: _Array) -> UsualLight:
        """Return the light of a grid, given the field at patches (P, 3) and slots (R K, 3)."""
        shares = grid.others.reshape(-1, 3).astype(np.float64)
        return UsualLight(patches, slots, shares[:, :2].T @ slots)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """A frame's patches and what lies around them; made by `PrintView.around`.

    - `grid`, `window`: the print, and pixels along a patch's window.
    - `offset_px`: (P, 3, 2) float64, from each patch's centre to the middle of its window, along the print's axes, by
      channel.
    - `pitch_px`: (P, 2) float64, a slot's width and height.
    - `frame_slots`: how many slots the frame would hold.
    - `places`: (P, 9) float64, the terms of a share over the frame at each patch (`place_terms`).
    - `whites`: places of the white references among the patches.
    """

    grid: PrintedGrid
    window: int
    offset_px: _Array
    pitch_px: _Array
    frame_slots: float
    places: _Array
    whites: slice
    light: UsualLight

    def near(self, amounts: _Array) -> NearLight:
        """Return the light that near kernels bring, `amounts` (9, 3, N) of each: terms over the frame, by channel."""
        count = len(self.grid.row)
        first, step, number = _OFFSETS_PX
        low, high = float(self.pitch_px.min()), float(self.pitch_px.max())
        pitches = np.linspace(low, max(high, low * 1.001), _PITCHES)
        offsets = np.linspace(first, first + step * (number - 1), number)
        shares = np.empty((len(NEAR_PX), _PITCHES, number, kernels.ACROSS * PARTS))
        for k, scale in enumerate(NEAR_PX):
            kernels.window_shares(scale, pitches, offsets, self.window, shares[k])
        weights = np.empty((count, kernels.ACROSS**2, 3), dtype=np.float32)
        others = np.empty((count, 3, 3), dtype=np.float32)
        table = np.array([pitches[0], pitches[1] - pitches[0], first, step])
        grid, local = self.grid, np.ascontiguousarray(np.einsum("np,pck->nck", self.places, amounts))
        kernels.weights_around(
            grid.row, grid.column, grid.neighbours, grid.parts, self.offset_px, self.pitch_px, shares, table, local,
            weights, others,
        )  # fmt: skip
        return NearLight(grid.neighbours, weights, others, local.sum(axis=2), self.light.patches)

    def inks(self, levels: FrameLevels) -> _Array:
        """Return bare paper, black ink, and what lies behind the print, (3, 3) float64 counts where the field is 1."""
        whites = levels.patches[self.whites] / self.light.patches[self.whites]
        # The first colour is the code (0, 0, 0), which tags are printed with.
        return np.stack([np.median(whites, axis=0), levels.patches[0] / self.light.patches[0], levels.beyond])

    def mean(self, levels: FrameLevels, inks: _Array) -> _Array:
        """Return the mean light (3,) float64 counts of the frame: the print, and beside it what lies behind.

        `inks` (3, 3) are those of `inks`.
        """
        sheet = levels.patches.sum(axis=0) + (self.light.elsewhere * inks[:2]).sum(axis=0)
        slots = len(levels.patches) + self.grid.plain_slots
        beside = max(self.frame_slots - slots, 0.0)
        return (sheet + beside * inks[2]) / (slots + beside)

    def image(self, levels: FrameLevels, inks: _Array) -> _Float:
        """Return the print slot by slot, (R, K, 3) float32 counts; `inks` (3, 3) are those of `inks`."""
        image = np.empty((*self.grid.source.shape, 3), dtype=np.float32)
        kernels.print_slots(self.grid.others.reshape(-1, 3), self.light.slots, inks, image.reshape(-1, 3))
        image[self.grid.row, self.grid.column] = levels.patches
        return image

    def blurred(self, image: _Float, scale_px: float) -> _Float:
        """Return what a far kernel makes of the print, (K, R, 3) float32 counts: columns first."""
        width, height = self._mean_pitch_px
        # Columns and channels in one, so that the compiled loop runs along them.
        rows = image.reshape(image.shape[0], -1)
        down = np.empty_like(rows)
        kernels.blur_rows(rows, far_taps(scale_px / height), down)
        turned = np.ascontiguousarray(down.reshape(image.shape).transpose(1, 0, 2))
        columns = turned.reshape(turned.shape[0], -1)
        across = np.empty_like(columns)
        kernels.blur_rows(columns, far_taps(scale_px / width), across)
        return across.reshape(turned.shape)

    def far(self, image: _Float, scale_px: float) -> _Array:
        """Return what a far kernel brings to the patches, (P, 3) float64 counts, their own slots' light included."""
        return self.blurred(image, scale_px)[self.grid.column, self.grid.row].astype(np.float64)

    @cached_property
    def _mean_pitch_px(self) -> tuple[float, float]:
        width, height = self.pitch_px.mean(axis=0).tolist()
        return width, height

    def own_share(self, scale_px: float) -> float:
        """Return the share of a far kernel's light at a patch that comes from its own slot."""
        width, height = self._mean_pitch_px
        taps = far_taps(scale_px / width), far_taps(scale_px / height)
        return float(taps[0][len(taps[0]) // 2] * taps[1][len(taps[1]) // 2])


@dataclass(frozen=True, eq=False)
class NearLight:
    """The weights by which near kernels bring light to patches.

    - `neighbours`: (P, 25) int32, the patches around each.
    - `weights`, `others`: (P, 25, 3) and (P, 3 kinds, 3) float32, of each of them, and of bare paper, black ink and
      what lies behind.
    - `total`: (P, 3) float64, sum of a patch's weights.
    - `light`: (P, 3) float64, the usual field of the session at the patches.
    """

    neighbours: npt.NDArray[np.int32]
    weights: _Float
    others: _Float
    total: _Array
    light: _Array

    @property
    def own(self) -> _Array:
        """(P, 3) float64, the weight of each patch's own slot."""
        return self.weights[:, self.weights.shape[1] // 2].astype(np.float64)

    def at(self, levels: FrameLevels, inks: _Array) -> _Array:
        """Return the light (P, 3) float64 counts; `inks` (3, 3) are those of `Surroundings.inks`."""
        out = np.empty_like(levels.patches)
        kernels.light_around(self.neighbours, self.weights, self.others, levels.patches, self.light, inks, out)
        return out


def far_taps(scale: float) -> _Float:
    """Return the shares (n,) float32, n odd, of slots on a line in a Gaussian's light, σ `scale` slots, of sum 1."""
    reach = max(1, math.ceil(_FAR_REACH * scale))
    edges = np.arange(-reach, reach + 2) - 0.5
    taps = np.diff(ndtr(edges / scale))
    return (taps / taps.sum()).astype(np.float32)


def photosite_offsets_px(mosaic: Mosaic) -> _Array:
    """Return (3, 2) float64 half-size px: where photosites of red, green and blue lie from their block's centre."""
    found = phases(mosaic)
    return np.array([channel_offset_px(found[channel]) for channel in CHANNELS])
