"""Model the print around each patch, and the light that the kernels of the point spread bring to the patch.

- The print is a grid of slots of one size, as made by `experiment.chart.layout`. A patch or a reference fills one slot,
  a tag fills 4 × 4 slots, and a module of a tag is 0.4 slots wide. In this module, "patches" are the patches in the
  order of colour indices, then the white references, then the grey references.
- Near kernels are integrated over each slot and over each photosite of a window, in each channel. Tags and margins are
  divided into fifths of a slot. For far kernels, the print is blurred slot by slot.
- Paper and black ink have one level each, multiplied by the local flat field. The background has the mean level that is
  measured next to the sheet.

Lengths are half-size pixels; levels are counts above black level; P is the number of patches in `PrintedGrid`.
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

PAD_SLOTS = 6  # number of slots around the outermost patches, for margins and background

_OFF_GRID = 0.02  # tolerance of positions on the grid, in slots, because positions in files are rounded

_Array = npt.NDArray[np.float64]
_Index = npt.NDArray[np.int32]

# Minimum bits per channel: with fewer bits, the curvature between codes cannot be separated from noise.
LEAST_BITS = 3

# Window offsets in a table: first offset and step in px, and number. Rounding, colour filters, registration and lateral
# chromatic aberration together cause at most 2 px.
_OFFSETS_PX = (-2.0, 1 / 16, 65)

_PITCHES = 9  # number of slot sizes in this table, over the range of sizes in the frame

_FAR_REACH = 3.0  # half width of a far kernel, in σ; the truncated kernel is scaled to a sum of 1

_Float = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PrintedGrid:
    """The print as a grid of slots."""

    pitch_mm: tuple[float, float]  # width and height of a slot
    points_mm: _Array  # (P, 2) centres of patches, then references
    row: npt.NDArray[np.int64]  # (P,) slot of each patch
    column: npt.NDArray[np.int64]  # (P,)
    source: _Index  # (R, K) patch in each slot; −1: none
    parts: _Index  # (5 R, 5 K) patch in each part of a slot; P: paper, P + 1: black ink, P + 2: background
    blank_shares: npt.NDArray[np.float32]  # (R, K, 3) area fractions of paper, black ink and background in each slot
    slots_mm: _Array  # (R K, 2) centres of the slots

    @cached_property
    def plain_slots(self) -> float:
        """Area of paper and black ink, in slots."""
        return float(self.blank_shares[..., :2].sum())

    @cached_property
    def neighbours(self) -> _Index:
        """(P, 25) int32, patches in the 5 × 5 slots around each patch, row by row; −1: none."""
        steps = np.arange(-REACH, REACH + 1)
        rows, columns = self.row[:, None, None] + steps[:, None], self.column[:, None, None] + steps
        return np.ascontiguousarray(self.source[rows, columns].reshape(len(self.row), -1))


def unsuitable(chart: Chart) -> str:
    """Return the reason why the lens cannot be measured with a chart, as a clause; "" if it can be measured."""
    if not chart.tags:
        return "the chart has no tags, so its colours are in a smooth order, and neighbours are too similar"
    if chart.bits < LEAST_BITS:
        return f"the chart has {chart.colour_count} patches, expected at least {8**LEAST_BITS} to average noise"
    return "" if _fits_grid(chart) else "patches and references are not on a common grid of slots of their size"


def _points(chart: Chart) -> _Array:
    whites = [reference.centre_mm for reference in chart.references if reference.is_white]
    greys = [reference.centre_mm for reference in chart.references if not reference.is_white]
    references = np.array([*whites, *greys], dtype=np.float64).reshape(-1, 2)
    return np.concatenate([chart.centres_mm[chart.cell_of_colour], references])


def _slots(chart: Chart) -> tuple[_Array, _Array]:
    points = _points(chart)
    # Return the centre of the first slot in mm, and the column and row (P, 2) of each patch in slots.
    low = points.min(axis=0)
    return low, (points - low) / np.array(chart.cell_mm)


def _fits_grid(chart: Chart) -> bool:
    _, slots = _slots(chart)
    sizes = np.array([reference.size_mm for reference in chart.references]).reshape(-1, 2)
    same_size = np.allclose(sizes, chart.cell_mm, rtol=_OFF_GRID)
    is_unique = len(np.unique(np.rint(slots), axis=0)) == len(slots)
    return same_size and is_unique and bool(np.abs(slots - np.rint(slots)).max() < _OFF_GRID)


def printed_grid(chart: Chart) -> PrintedGrid:
    """Return the grid of a chart that is not `unsuitable`."""
    low, slots = _slots(chart)
    column, row = np.rint(slots).astype(np.int64).T + PAD_SLOTS
    count = len(row)
    rows, columns = int(row.max()) + 1 + PAD_SLOTS, int(column.max()) + 1 + PAD_SLOTS
    source = np.full((rows, columns), -1, dtype=np.int32)
    source[row, column] = np.arange(count)
    width, height = chart.cell_mm
    x = low[0] + ((np.arange(columns * PARTS) + 0.5) / PARTS - 0.5 - PAD_SLOTS) * width
    y = low[1] + ((np.arange(rows * PARTS) + 0.5) / PARTS - 0.5 - PAD_SLOTS) * height
    sheet = ((y > 0) & (y < chart.page_mm[1]))[:, None] & ((x > 0) & (x < chart.page_mm[0]))
    parts = np.where(sheet, count, count + 2).astype(np.int32)
    drawn = drawing(chart)
    drawn_count = len(drawn.rgb) - drawn.tiles
    rectangles = np.asarray(drawn.rectangles_mm[:drawn_count], dtype=np.float64).reshape(-1, 2, 2)
    edges = np.stack([np.searchsorted(x, rectangles[..., 0]), np.searchsorted(y, rectangles[..., 1])], axis=-1)
    for ((left, top), (right, bottom)), rgb in zip(edges.tolist(), drawn.rgb[:drawn_count], strict=True):
        parts[top:bottom, left:right] = count if rgb[0] > 127 else count + 1
    slot_parts = parts.reshape(rows, PARTS, columns, PARTS)
    patches = source[:, None, :, None]
    parts = np.where(patches >= 0, patches, slot_parts).reshape(parts.shape).astype(np.int32)
    kinds = parts.reshape(rows, PARTS, columns, PARTS, 1) == np.arange(count, count + 3)
    slot_x, slot_y = x[PARTS // 2 :: PARTS], y[PARTS // 2 :: PARTS]
    return PrintedGrid(
        pitch_mm=(width, height),
        points_mm=_points(chart),
        row=row,
        column=column,
        source=source,
        parts=parts,
        blank_shares=kinds.mean(axis=(1, 3)).astype(np.float32),
        slots_mm=np.column_stack([np.tile(slot_x, rows), np.repeat(slot_y, columns)]),
    )


@dataclass(frozen=True, eq=False)
class FrameLevels:
    """Levels in a frame before the lens correction."""

    patches: _Array  # (P, 3) counts, mean of each patch
    background: _Array  # (3,) counts of the background behind the print


@dataclass(frozen=True, eq=False)
class UsualLight:
    """Flat field of the first frame of the session, used in all frames for areas that are not measured."""

    patches: _Array  # (P, 3)
    slots: _Array  # (R K, 3); outside of the outermost patches, the value at these patches
    elsewhere: _Array  # (2, 3) sum of the flat field over all paper and over all black ink, in slots

    @staticmethod
    def of(grid: PrintedGrid, patches: _Array, slots: _Array) -> UsualLight:
        """Return the light of a grid from the field at patches (P, 3) and slots (R K, 3)."""
        shares = grid.blank_shares.reshape(-1, 3).astype(np.float64)
        return UsualLight(patches, slots, shares[:, :2].T @ slots)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Patches of a frame and their surroundings; made by `PrintView.around`."""

    grid: PrintedGrid
    window: int  # width in pixels of a patch's window
    # (P, 3, 2) vector from the patch centre to the centre of its window in each channel, along the axes of the print
    offset_px: _Array
    pitch_px: _Array  # (P, 2) width and height of a slot
    frame_slots: float  # area of the frame in slots
    places: _Array  # (P, 9) terms of a near share at each patch (`frame_terms`)
    whites: slice  # indices of the white references
    light: UsualLight

    def near(self, amounts: _Array) -> NearLight:
        """Return the light of near kernels with shares `amounts` (9, 3, N): terms over the frame, channels, kernels."""
        count = len(self.grid.row)
        first, step, number = _OFFSETS_PX
        low, high = float(self.pitch_px.min()), float(self.pitch_px.max())
        pitches = np.linspace(low, max(high, low * 1.001), _PITCHES)
        offsets = np.linspace(first, first + step * (number - 1), number)
        shares = np.empty((len(NEAR_PX), _PITCHES, number, kernels.ACROSS * PARTS))
        for k, scale in enumerate(NEAR_PX):
            kernels.window_shares(scale, pitches, offsets, self.window, shares[k])
        weights = np.empty((count, kernels.ACROSS**2, 3), dtype=np.float32)
        blank_weights = np.empty((count, 3, 3), dtype=np.float32)
        table = np.array([pitches[0], pitches[1] - pitches[0], first, step])
        grid, local = self.grid, np.ascontiguousarray(np.einsum("np,pck->nck", self.places, amounts))
        kernels.weights_around(
            grid.row, grid.column, grid.neighbours, grid.parts, self.offset_px, self.pitch_px, shares, table, local,
            weights, blank_weights,
        )  # fmt: skip
        return NearLight(grid.neighbours, weights, blank_weights, local.sum(axis=2), self.light.patches)

    def inks(self, levels: FrameLevels) -> _Array:
        """Return the levels of paper, black ink and background, (3, 3) float64 counts, for a flat field of 1."""
        whites = levels.patches[self.whites] / self.light.patches[self.whites]
        # The first colour is the code (0, 0, 0), the black of tags.
        return np.stack([np.median(whites, axis=0), levels.patches[0] / self.light.patches[0], levels.background])

    def mean(self, levels: FrameLevels, inks: _Array) -> _Array:
        """Return the mean light (3,) float64 counts of print and background in the frame; `inks` (3, 3) from `inks`."""
        sheet = levels.patches.sum(axis=0) + (self.light.elsewhere * inks[:2]).sum(axis=0)
        slots = len(levels.patches) + self.grid.plain_slots
        background = max(self.frame_slots - slots, 0.0)
        return (sheet + background * inks[2]) / (slots + background)

    def image(self, levels: FrameLevels, inks: _Array) -> _Float:
        """Return the print slot by slot, (R, K, 3) float32 counts; `inks` (3, 3) from `inks`."""
        image = np.empty((*self.grid.source.shape, 3), dtype=np.float32)
        kernels.print_slots(self.grid.blank_shares.reshape(-1, 3), self.light.slots, inks, image.reshape(-1, 3))
        image[self.grid.row, self.grid.column] = levels.patches
        return image

    def blurred(self, image: _Float, scale_px: float) -> _Float:
        """Return the print blurred by a far kernel, (K, R, 3) float32 counts: columns first."""
        width, height = self._mean_pitch_px
        # Columns and channels are merged into one axis, over which the innermost loop of `blur_rows` runs.
        rows = image.reshape(image.shape[0], -1)
        down = np.empty_like(rows)
        kernels.blur_rows(rows, far_taps(scale_px / height), down)
        turned = np.ascontiguousarray(down.reshape(image.shape).transpose(1, 0, 2))
        columns = turned.reshape(turned.shape[0], -1)
        across = np.empty_like(columns)
        kernels.blur_rows(columns, far_taps(scale_px / width), across)
        return across.reshape(turned.shape)

    def far(self, image: _Float, scale_px: float) -> _Array:
        """Return the light of a far kernel at the patches, (P, 3) float64 counts, with light of the patch itself."""
        return self.blurred(image, scale_px)[self.grid.column, self.grid.row].astype(np.float64)

    @cached_property
    def _mean_pitch_px(self) -> tuple[float, float]:
        width, height = self.pitch_px.mean(axis=0).tolist()
        return width, height

    def own_share(self, scale_px: float) -> float:
        """Return the fraction of the light of a far kernel that comes from the patch itself."""
        width, height = self._mean_pitch_px
        taps = far_taps(scale_px / width), far_taps(scale_px / height)
        return float(taps[0][len(taps[0]) // 2] * taps[1][len(taps[1]) // 2])


@dataclass(frozen=True, eq=False)
class NearLight:
    """Weights of the light that near kernels bring to patches."""

    neighbours: npt.NDArray[np.int32]  # (P, 25) patches around each patch, as in `PrintedGrid`
    weights: _Float  # (P, 25, 3) weight of each neighbour
    blank_weights: _Float  # (P, 3, 3) weights of paper, black ink and background
    total: _Array  # (P, 3) sum of the weights of a patch
    light: _Array  # (P, 3) flat field at the patches, as in `UsualLight`

    @property
    def own(self) -> _Array:
        """(P, 3) float64, weight of the patch itself."""
        return self.weights[:, self.weights.shape[1] // 2].astype(np.float64)

    def at(self, levels: FrameLevels, inks: _Array) -> _Array:
        """Return the light (P, 3) float64 counts; `inks` (3, 3) from `Surroundings.inks`."""
        out = np.empty_like(levels.patches)
        kernels.light_around(self.neighbours, self.weights, self.blank_weights, levels.patches, self.light, inks, out)
        return out


def far_taps(scale: float) -> _Float:
    """Return the weights (n,) float32 of slots along a line for a Gaussian with σ = `scale` slots; n is odd, sum 1."""
    reach = max(1, math.ceil(_FAR_REACH * scale))
    edges = np.arange(-reach, reach + 2) - 0.5
    taps = np.diff(ndtr(edges / scale))
    return (taps / taps.sum()).astype(np.float32)


def photosite_offsets_px(mosaic: Mosaic) -> _Array:
    """Return (3, 2) float64 half-size px: offset of red, green and blue photosites from the centre of a block."""
    channel_phases = phases(mosaic)
    return np.array([channel_offset_px(channel_phases[channel]) for channel in CHANNELS])
