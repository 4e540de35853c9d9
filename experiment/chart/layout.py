"""The chart's design: which colour, tag and reference is printed where.

Laws that hold here:

- The sheet is a grid of square slots of 125 pixels at 600 dpi (5.292 mm) whose origin is a whole pixel, so that every
  edge printed, of cells and of tag modules, falls between two pixels; at any other multiple of 24 dpi their sizes are
  still whole. On a page too small for that a slot is the largest multiple of 5 pixels that fits: a tag module, 2/5 of
  it, stays whole at 600 dpi.
- Each colour stands once, in random order: random order registers four times better than a smooth one and makes a
  slip by one cell visible.
- Tags stand on an even grid that reaches the field's edges: 4 × 4 slots each, which are the 10 modules of an AprilTag
  36h11 with a white rim of one module.
- Every slot left is an achromatic reference. References are spread evenly but without a lattice, because a lattice
  leaves streaks in the field fitted through them.

`paper_chart` is the other arrangement: the paper's plain grid of 256 × 128 cells, for sheets printed before.

The same bits, page, cell and seed give the same chart. On A0 221 × 155 slots hold 32 768 colours, 35 tags and 927
references. Knows nothing of printing or of cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiment.chart.margins import GAP_PX, PX_MM
from experiment.chart.model import PAPER_WHITE, TAG_FAMILY, TAG_MODULES, Chart, Reference, Tag
from foundation.errors import InputError
from foundation.version import software

SLOT_PX = 125  # Usual side of a slot, 5.29 mm: the largest at which A0 holds 32 768 colours, tags and references

SLOT_STEP_PX = 5  # Slots are multiples of it, because a tag's ten modules are four slots

LEAST_SLOT_PX = 25  # A cell of 1.06 mm, a module of 0.42 mm: below, a printer's dots are too few to mix a colour

TAG_SLOTS = 4  # Slots along a tag with its white rim: its ten modules are then 2/5 of a slot, whole pixels at 600 dpi

TAG_SPACING_SLOTS = 38  # Largest distance between tags: 35 tags on A0, seven by five

TAG_IDS = 587  # Codes in the family 36h11

MARGIN_MM = 8.0  # Least white margin: printers leave 3 to 5 mm, and rulers and targets need the rest

# Columns and rows of blocks in the paper's grid, for each number of bits: one block for each level of blue.
PAPER_BLOCKS = {1: (2, 1), 2: (2, 2), 3: (4, 2), 4: (4, 4), 5: (8, 4)}

PAPER_REFERENCE_MM = 100.0  # Largest distance between the patches of bare paper in the margin of the paper's grid

# Side of these patches, 5 mm: about that of a cell, and even, so that its middle is a whole pixel.
PAPER_REFERENCE_PX = 118

PAPER_REFERENCES = 4  # Parts into which these patches divide the upper and the right margin at least

# Landscape sheets of ISO 216, largest first.
A_SERIES_MM: dict[str, tuple[float, float]] = {
    "A0": (1189, 841),
    "A1": (841, 594),
    "A2": (594, 420),
    "A3": (420, 297),
    "A4": (297, 210),
    "A5": (210, 148),
    "A6": (148, 105),
    "A7": (105, 74),
    "A8": (74, 52),
}

# Reference greys besides paper white: in sRGB each reflects half the light of the one before, 1/2 … 1/16 of white.
# Four even stops show whether a frame is linear, and the darkest is still some hundred counts where white is well
# exposed. None is a colour of the chart: its low bits are not zero.
GREY_CODES = (188, 137, 99, 71)

# White references from which on calibration sees the light fall towards the corners; from fewer, a slope alone.
LEAST_WHITES = 18

# Longest side of a page: no printer has wider rolls, and a larger number is a mistake of units.
LARGEST_PAGE_MM = 10_000.0

_Slots = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class _Grid:
    """The slot grid of a page: its size in slots, a slot and its origin in pixels of the design."""

    columns: int
    rows: int
    slot_px: int
    origin_px: tuple[int, int]

    @classmethod
    def on(cls, page_mm: tuple[float, float], slot_px: int = SLOT_PX) -> _Grid:
        """Return the largest grid of slots that fits on a page within its margins, in the middle."""
        page_px = [math.floor(side / PX_MM) for side in page_mm]
        margin_px = math.ceil(MARGIN_MM / PX_MM)
        columns, rows = (max(0, side - 2 * margin_px) // slot_px for side in page_px)
        x0, y0 = ((side - count * slot_px) // 2 for side, count in zip(page_px, (columns, rows), strict=True))
        return cls(columns, rows, slot_px, (x0, y0))

    @property
    def cell_mm(self) -> tuple[float, float]:
        """Width and height of a slot."""
        return self.slot_px * PX_MM, self.slot_px * PX_MM

    @property
    def tag_slots(self) -> list[tuple[int, int]]:
        """(column, row) of each tag's top-left slot, row by row."""
        return [(column, row) for row in _tag_starts(self.rows) for column in _tag_starts(self.columns)]

    @property
    def reference_count(self) -> int:
        """Slots that tags leave free."""
        return self.columns * self.rows - len(self.tag_slots) * TAG_SLOTS**2

    def holds(self, bits: int) -> bool:
        """Return whether the colours, two by two tags and enough references find a place."""
        if min(self.columns, self.rows) < 2 * TAG_SLOTS or len(self.tag_slots) > TAG_IDS:
            return False
        return self.reference_count >= 8**bits + _least_references(bits)

    def mm(self, column: float, row: float) -> tuple[float, float]:
        """Return the place (x, y), mm on the print, of a point of the slot grid."""
        x0, y0 = self.origin_px
        return (x0 + column * self.slot_px) * PX_MM, (y0 + row * self.slot_px) * PX_MM


def _tag_starts(slots: int) -> list[int]:
    """Return the first slots of the tags along a side: evenly spread, the outermost at the edges."""
    last = slots - TAG_SLOTS
    steps = max(1, math.ceil(last / TAG_SPACING_SLOTS))
    return [round(step * last / steps) for step in range(steps + 1)]


def _least_references(bits: int) -> int:
    """Return the fewest references: three of each grey and 20 whites, and one for 40 colours."""
    return max(32, 8**bits // 40)


def smallest_page(bits: int) -> str:
    """Return the name of the smallest A page, landscape, that holds a chart of `bits` bits: A0 holds the largest."""
    return next(name for name in reversed(A_SERIES_MM) if _Grid.on(A_SERIES_MM[name]).holds(bits))


def design_chart(bits: int = 5, page: str | tuple[float, float] | None = None, seed: int = 1) -> Chart:
    """Return the chart of all 8**bits colours on a page.

    `page`: "A0" … "A8" (landscape), or width and height in mm; the smallest A page that holds the chart when not given.
    Cells have a side of 5.292 mm, or the largest that fits on a smaller page, a multiple of 5 pixels at 600 dpi.
    """
    if not 1 <= bits <= 5:
        raise InputError(f"a chart has 1 to 5 bits a channel, not {bits}")
    if seed < 0:
        raise InputError(f"the seed is {seed}; give a whole number from 0")
    grid, page_mm = _choose_grid(bits, page)
    rng = np.random.default_rng(seed)
    free = np.ones((grid.rows, grid.columns), dtype=np.bool_)
    for column, row in grid.tag_slots:
        free[row : row + TAG_SLOTS, column : column + TAG_SLOTS] = False
    referenced = spread(free, int(free.sum()) - 8**bits, rng)
    rows, columns = np.nonzero(free & ~referenced)
    (x0, y0), slot = grid.origin_px, grid.slot_px
    return Chart(
        page_mm=page_mm,
        bits=bits,
        cell_mm=grid.cell_mm,
        centres_mm=PX_MM * np.array([x0 + (columns + 0.5) * slot, y0 + (rows + 0.5) * slot], dtype=np.float64).T,
        colours=rng.permutation(8**bits).astype(np.int64),
        tags=tuple(_tag(grid, number, *slot) for number, slot in enumerate(grid.tag_slots)),
        references=tuple(_references(grid, referenced, rng)),
        seed=seed,
        software=software(),
    )


def _choose_grid(bits: int, page: str | tuple[float, float] | None) -> tuple[_Grid, tuple[float, float]]:
    """Return the grid and its page: with the usual cells, or the largest that fit."""
    page_mm = _page_mm(smallest_page(bits) if page is None else page)
    grid = _Grid.on(page_mm)
    if grid.holds(bits):
        return grid, page_mm
    if len(grid.tag_slots) > TAG_IDS:
        raise InputError(
            f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm needs {len(grid.tag_slots)} tags and the family "
            f"{TAG_FAMILY} has {TAG_IDS}; choose a smaller page"
        )
    smaller = (_Grid.on(page_mm, slot) for slot in range(SLOT_PX - SLOT_STEP_PX, LEAST_SLOT_PX - 1, -SLOT_STEP_PX))
    fitting = next((grid for grid in smaller if grid.holds(bits)), None)
    text = (
        f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm is too small for the {8**bits} colours of a chart of {bits} bits"
    )
    if fitting is None:
        name = next(name for name in reversed(A_SERIES_MM) if _Grid.on(A_SERIES_MM[name], LEAST_SLOT_PX).holds(bits))
        width, height = A_SERIES_MM[name]
        raise InputError(
            f"{text} even with cells of {LEAST_SLOT_PX * PX_MM:.2f} mm, the smallest that can be printed; the "
            f"smallest page that holds it is {name} ({width:g} × {height:g} mm), at its best size {smallest_page(bits)}"
        )
    return fitting, page_mm


def paper_chart(page: str | tuple[float, float] | None = None, bits: int = 5) -> Chart:
    """Return the paper's plain grid: 256 × 128 cells, each of the 32 768 colours once, without tags.

    The paper's figure of the pattern gives no order, so this one is a reconstruction: 8 × 4 blocks of 32 × 32 cells.
    In a block red rises by column and green by row, one block after the other (row by row, the second row from right to
    left, and so on) blue rises; every second column of blocks runs red backwards and every second row green, so that
    neighbours differ by one step in one channel, but for blue between blocks above each other.

    References are patches of bare paper in the margin, which the sheet is taken to have: 5 mm squares at the corners
    and every 100 mm or less above and on the right of the field.

    `page`: as in `design_chart`; A0 when not given. Cells are the largest whole pixels at 600 dpi that leave a margin
    of 8 mm: 108 × 152 on A0, 4.57 × 6.43 mm.
    """
    if bits not in PAPER_BLOCKS:
        raise InputError(f"a chart has 1 to 5 bits a channel, not {bits}")
    page_mm = _page_mm("A0" if page is None else page)
    margin_px = math.ceil(MARGIN_MM / PX_MM)
    page_px = [math.floor(side / PX_MM) for side in page_mm]
    across, down = PAPER_BLOCKS[bits]
    levels = 1 << bits
    counts = (levels * across, levels * down)
    cell_w, cell_h = ((side - 2 * margin_px) // count for side, count in zip(page_px, counts, strict=True))
    if min(cell_w, cell_h) < LEAST_SLOT_PX:
        raise InputError(
            f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm is too small for {counts[0]} × {counts[1]} cells of "
            f"{LEAST_SLOT_PX * PX_MM:.2f} mm, the smallest that can be printed; choose a larger one, A0 at best"
        )
    x0, y0 = ((side - count * cell) // 2 for side, count, cell in zip(page_px, counts, (cell_w, cell_h), strict=True))
    row, column = (places.ravel() for places in np.indices((counts[1], counts[0]), dtype=np.int64))
    block_column, block_row = column // levels, row // levels
    last = levels - 1
    red = np.where(block_column % 2 == 0, column % levels, last - column % levels)
    green = np.where(block_row % 2 == 0, row % levels, last - row % levels)
    blue = across * block_row + np.where(block_row % 2 == 0, block_column, across - 1 - block_column)
    field = (x0, y0, x0 + counts[0] * cell_w, y0 + counts[1] * cell_h)
    return Chart(
        page_mm=page_mm,
        bits=bits,
        cell_mm=(cell_w * PX_MM, cell_h * PX_MM),
        centres_mm=PX_MM * np.array([x0 + (column + 0.5) * cell_w, y0 + (row + 0.5) * cell_h], dtype=np.float64).T,
        colours=(red << 2 * bits) | (green << bits) | blue,
        tags=(),
        references=tuple(_margin_whites(field)),
        software=software(),
    )


def _margin_whites(field_px: tuple[int, int, int, int]) -> list[Reference]:
    """Return patches of bare paper around a field, `GAP_PX` of bare paper away from it."""
    left, top, right, bottom = field_px
    side, away, step = PAPER_REFERENCE_PX, GAP_PX + PAPER_REFERENCE_PX // 2, PAPER_REFERENCE_MM / PX_MM
    sides = ((left, right), (top, bottom))
    across, down = (max(PAPER_REFERENCES, math.ceil((high - low) / step)) for low, high in sides)
    places = [(x, y) for y in (top - away, bottom + away) for x in (left - away, right + away)]
    places += [(left + round(k * (right - left) / across), top - away) for k in range(1, across)]
    places += [(right + away, top + round(k * (bottom - top) / down)) for k in range(1, down)]
    return [Reference("white", PAPER_WHITE, (x * PX_MM, y * PX_MM), (side * PX_MM, side * PX_MM)) for x, y in places]


def _page_mm(page: str | tuple[float, float]) -> tuple[float, float]:
    if isinstance(page, str):
        size = A_SERIES_MM.get(page.strip().upper())
        if size is None:
            raise InputError(
                f"page {page!r} is not known; name one of {', '.join(A_SERIES_MM)}, or give its size in mm"
            )
        return float(size[0]), float(size[1])
    width, height = page
    if not (math.isfinite(width) and math.isfinite(height) and width > 0 and height > 0):
        raise InputError(f"a page of {width:g} × {height:g} mm cannot be printed; give width and height above 0")
    if max(width, height) > LARGEST_PAGE_MM:
        raise InputError(
            f"a page of {width:g} × {height:g} mm is larger than any print, {LARGEST_PAGE_MM:g} mm a side; give width "
            "and height in mm"
        )
    return float(width), float(height)


def _tag(grid: _Grid, number: int, column: int, row: int) -> Tag:
    rim = TAG_SLOTS / (TAG_MODULES + 2)
    near, far = rim, rim + TAG_MODULES * rim
    corners = [(near, near), (far, near), (far, far), (near, far)]
    return Tag(TAG_FAMILY, number, np.array([grid.mm(column + x, row + y) for x, y in corners]))


def _references(grid: _Grid, referenced: _Slots, rng: np.random.Generator) -> list[Reference]:
    """Return the references: of each level of grey an eighth, evenly over the field, and the rest white.

    Where they are few there is less of each grey, so that there are `LEAST_WHITES` white ones.
    """
    codes = np.zeros(referenced.shape, dtype=np.int64)
    codes[referenced] = PAPER_WHITE[0]
    left = referenced.copy()
    count = int(referenced.sum())
    each = min(count // (2 * len(GREY_CODES)), (count - LEAST_WHITES) // len(GREY_CODES))
    for code in GREY_CODES:
        chosen = spread(left, each, rng)
        codes[chosen] = code
        left &= ~chosen
    return [
        Reference(
            name="white" if code == PAPER_WHITE[0] else f"grey {code}",
            rgb=(code, code, code),
            centre_mm=grid.mm(int(column) + 0.5, int(row) + 0.5),
            size_mm=grid.cell_mm,
        )
        for row, column in np.argwhere(referenced)
        for code in [int(codes[row, column])]
    ]


def spread(allowed: _Slots, count: int, rng: np.random.Generator) -> _Slots:
    """Return a choice of slots that are spread evenly over a grid, without a lattice.

    After the void-and-cluster method (Ulichney, "The void-and-cluster method for dither array generation", 1993):
    from a random choice, each slot in turn moves to the emptiest place. Once round is enough: on A0 no two references
    are then nearer than 4 slots and none of the field is farther than 6 from one, and the spectrum shows the even
    ring of blue noise and no peaks of a lattice. Each quarter of the grid keeps its share.

    `allowed`: (rows, columns) bool, slots that may be chosen. Returns (rows, columns) bool with `count` slots true, all
    of them allowed.
    """
    rows, columns = allowed.shape
    middle_row, middle_column = (rows + 1) // 2, (columns + 1) // 2
    quarters = [
        (down, across)
        for down in (slice(middle_row), slice(middle_row, rows))
        for across in (slice(middle_column), slice(middle_column, columns))
    ]
    number = np.arange(allowed.size).reshape(allowed.shape)
    members = [number[quarter][allowed[quarter]] for quarter in quarters]
    chosen = np.zeros_like(allowed)
    for places, quota in zip(members, _quotas([len(places) for places in members], count), strict=True):
        chosen.flat[rng.choice(places, quota, replace=False)] = True
    if count == 0:
        return chosen
    # In units of the mean distance between neighbours; found best by the nearest pair and the largest gap on A0.
    sigma = 0.4 * math.sqrt(allowed.size / count)
    down, across = _nearness(rows, sigma), _nearness(columns, sigma)
    # Equals are decided at random, by less than any difference that matters.
    crowd = down @ chosen.astype(np.float64) @ across.T + 1e-6 * rng.random(allowed.shape)
    closed, own = np.where(allowed & ~chosen, 0.0, np.inf), np.empty_like(crowd)
    for row, column in rng.permutation(np.argwhere(chosen)):
        crowd -= np.multiply(down[:, row, None], across[:, column], out=own)
        closed[row, column] = 0.0
        quarter = quarters[2 * int(row >= middle_row) + int(column >= middle_column)]
        # Nothing is emptiest where nothing may be.
        free = crowd[quarter] + closed[quarter]
        row, column = divmod(int(number[quarter].flat[free.argmin()]), columns)
        crowd += np.multiply(down[:, row, None], across[:, column], out=own)
        closed[row, column] = np.inf
    return allowed & (closed > 0)


def _nearness(count: int, sigma: float) -> npt.NDArray[np.float64]:
    """Return how near each slot (column) is to each place (row), (count, count) float64, rows of sum 1."""
    places = np.arange(count)
    weights = np.exp(-0.5 * ((places[:, None] - places[None, :]) / sigma) ** 2)
    # Numbers below the normal ones slow a processor down, and no sum notices these.
    weights[weights < 1e-40] = 0
    # A place at the edge has neighbours on one side only; without this all would gather at the edges.
    return weights / weights.sum(axis=1, keepdims=True)


def _quotas(sizes: list[int], count: int) -> list[int]:
    """Return shares of `count` for the quarters in proportion to their sizes: whole, none above its size."""
    exact = [count * size / sum(sizes) for size in sizes]
    shares = [math.floor(share) for share in exact]
    largest = sorted(range(len(sizes)), key=lambda quarter: shares[quarter] - exact[quarter])
    for quarter in largest[: count - sum(shares)]:
        shares[quarter] += 1
    return shares
