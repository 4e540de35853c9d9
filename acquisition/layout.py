"""The chart's design: which colour, tag and reference is printed where.

Laws that hold here:

- The sheet is a grid of square slots of 125 pixels at 600 dpi (5.292 mm) whose origin is a whole pixel, so that every
  edge printed, of cells and of tag modules, falls between two pixels; at any other multiple of 24 dpi their sizes are
  still whole.
- Each colour stands once, in random order: random order registers four times better than a smooth one and makes a
  slip by one cell visible.
- Tags stand on an even grid that reaches the field's edges: 4 × 4 slots each, which are the 10 modules of an AprilTag
  36h11 with a white rim of one module.
- Every slot left is an achromatic reference. References are spread evenly but without a lattice, because a lattice
  leaves streaks in the field fitted through them.

The same bits, page and seed give the same chart. On A0 221 × 155 slots hold 32 768 colours, 35 tags and 927
references. Knows nothing of printing or of cameras.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from acquisition.chart import PAPER_WHITE, Chart, Reference, Tag
from drivers.errors import InputError

DESIGN_DPI = 600
SLOT_PX = 125
MODULE_PX = 50
TAG_FAMILY = "36h11"
TAG_SLOTS = 4
TAG_MODULES = 8
"""Modules along a tag's black square: 6 of data and a black border of one; the white rim comes on top."""

TAG_SPACING_SLOTS = 38
TAG_IDS = 587
"""Codes in the family 36h11."""

MARGIN_MM = 8.0
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
"""Landscape sheets of ISO 216, largest first."""

GREY_CODES = (188, 137, 99, 71)
"""Reference greys besides paper white: in sRGB each reflects half the light of the one before, 1/2 … 1/16 of white.

Four even stops show whether a frame is linear, and the darkest is still some hundred counts where white is well
exposed. None is a colour of the chart: its low bits are not zero.
"""

_PX_MM = 25.4 / DESIGN_DPI
_Slots = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class _Grid:
    """The slot grid of a page: its size in slots, its origin in pixels of the design, its tags' first slots."""

    columns: int
    rows: int
    origin_px: tuple[int, int]

    @classmethod
    def on(cls, page_mm: tuple[float, float]) -> _Grid:
        page_px = [math.floor(side / _PX_MM) for side in page_mm]
        margin_px = math.ceil(MARGIN_MM / _PX_MM)
        columns, rows = (max(0, side - 2 * margin_px) // SLOT_PX for side in page_px)
        x0, y0 = ((side - count * SLOT_PX) // 2 for side, count in zip(page_px, (columns, rows), strict=True))
        return cls(columns, rows, (x0, y0))

    @property
    def tag_slots(self) -> list[tuple[int, int]]:
        """(column, row) of each tag's top-left slot, row by row."""
        return [(column, row) for row in _tag_starts(self.rows) for column in _tag_starts(self.columns)]

    @property
    def reference_count(self) -> int:
        """Slots that tags leave free."""
        return self.columns * self.rows - len(self.tag_slots) * TAG_SLOTS**2

    def holds(self, bits: int) -> bool:
        """Whether the colours, two by two tags and enough references find a place."""
        if min(self.columns, self.rows) < 2 * TAG_SLOTS or len(self.tag_slots) > TAG_IDS:
            return False
        return self.reference_count >= 8**bits + _least_references(bits)

    def mm(self, column: float, row: float) -> tuple[float, float]:
        """Place on the print of a point of the slot grid."""
        x0, y0 = self.origin_px
        return (x0 + column * SLOT_PX) * _PX_MM, (y0 + row * SLOT_PX) * _PX_MM


def _tag_starts(slots: int) -> list[int]:
    """First slots of the tags along a side: evenly spread, the outermost at the edges."""
    last = slots - TAG_SLOTS
    steps = max(1, math.ceil(last / TAG_SPACING_SLOTS))
    return [round(step * last / steps) for step in range(steps + 1)]


def _least_references(bits: int) -> int:
    """Return the fewest references: one of each grey and four whites a quarter, and one for 40 colours."""
    return max(32, 8**bits // 40)


def smallest_page(bits: int) -> str:
    """Return the name of the smallest A page, landscape, that holds a chart of `bits` bits."""
    return next(name for name in reversed(A_SERIES_MM) if _Grid.on(A_SERIES_MM[name]).holds(bits))


def design_chart(bits: int = 5, page: str | tuple[float, float] | None = None, seed: int = 1) -> Chart:
    """Return the chart of all 8**bits colours on a page.

    Parameters
    ----------
    bits
        Bits kept of each channel, 1 … 5; 5 is the paper's chart (section 3.2).
    page
        "A0" … "A8" (landscape), or width and height in mm; the smallest A page that holds the chart when not given.
    seed
        ≥ 0, decides the order of the colours and the places of the references.

    Returns
    -------
    Chart
        Tags are numbered row by row from 0. `corners_mm` are the corners of the black square, clockwise from its
        top-left as the print is seen upright, which is OpenCV's order for `DICT_APRILTAG_36h11`; libraries of the
        AprilTag authors (pyapriltags) give the same corners in the order [1, 0, 3, 2]. References are named "white"
        (bare paper) or "grey 188" by their code.

    Raises
    ------
    InputError
        The bits or the seed are out of range, the page is unknown or too small.
    """
    if not 1 <= bits <= 5:
        raise InputError(f"a chart has 1 to 5 bits a channel, not {bits}")
    if seed < 0:
        raise InputError(f"the seed is {seed}; give a whole number from 0")
    page_mm = _page_mm(smallest_page(bits) if page is None else page)
    grid = _Grid.on(page_mm)
    if not grid.holds(bits):
        if len(grid.tag_slots) > TAG_IDS:
            raise InputError(
                f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm needs {len(grid.tag_slots)} tags and the family "
                f"{TAG_FAMILY} has {TAG_IDS}; choose a smaller page"
            )
        name = smallest_page(bits)
        width, height = A_SERIES_MM[name]
        raise InputError(
            f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm is too small for the {8**bits} colours of a chart of "
            f"{bits} bits; the smallest that holds it is {name} ({width:g} × {height:g} mm)"
        )
    rng = np.random.default_rng(seed)
    free = np.ones((grid.rows, grid.columns), dtype=np.bool_)
    for column, row in grid.tag_slots:
        free[row : row + TAG_SLOTS, column : column + TAG_SLOTS] = False
    referenced = spread(free, int(free.sum()) - 8**bits, rng)
    rows, columns = np.nonzero(free & ~referenced)
    return Chart(
        page_mm=page_mm,
        bits=bits,
        cell_mm=(SLOT_PX * _PX_MM, SLOT_PX * _PX_MM),
        centres_mm=np.array([grid.mm(column + 0.5, row + 0.5) for column, row in zip(columns, rows, strict=True)]),
        colours=rng.permutation(8**bits).astype(np.int64),
        tags=tuple(_tag(grid, number, *slot) for number, slot in enumerate(grid.tag_slots)),
        references=tuple(_references(grid, referenced, rng)),
    )


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
    return float(width), float(height)


def _tag(grid: _Grid, number: int, column: int, row: int) -> Tag:
    rim = MODULE_PX / SLOT_PX
    near, far = rim, rim + TAG_MODULES * MODULE_PX / SLOT_PX
    corners = [(near, near), (far, near), (far, far), (near, far)]
    return Tag(TAG_FAMILY, number, np.array([grid.mm(column + x, row + y) for x, y in corners]))


def _references(grid: _Grid, referenced: _Slots, rng: np.random.Generator) -> list[Reference]:
    """Give each level of grey an eighth of the references, evenly over the field, and leave the rest white."""
    codes = np.zeros(referenced.shape, dtype=np.int64)
    codes[referenced] = PAPER_WHITE[0]
    left = referenced.copy()
    for code in GREY_CODES:
        chosen = spread(left, int(referenced.sum()) // (2 * len(GREY_CODES)), rng)
        codes[chosen] = code
        left &= ~chosen
    size = (SLOT_PX * _PX_MM, SLOT_PX * _PX_MM)
    return [
        Reference(
            name="white" if code == PAPER_WHITE[0] else f"grey {code}",
            rgb=(code, code, code),
            centre_mm=grid.mm(int(column) + 0.5, int(row) + 0.5),
            size_mm=size,
        )
        for row, column in np.argwhere(referenced)
        for code in [int(codes[row, column])]
    ]


def spread(allowed: _Slots, count: int, rng: np.random.Generator) -> _Slots:
    """Choose slots that are spread evenly over a grid, without a lattice.

    After the void-and-cluster method (Ulichney, "The void-and-cluster method for dither array generation", 1993):
    from a random choice, each slot in turn moves to the emptiest place. Once round is enough: on A0 no two references
    are then nearer than 4 slots and none of the field is farther than 6 from one, and the spectrum shows the even
    ring of blue noise and no peaks of a lattice. Each quarter of the grid keeps its share.

    Parameters
    ----------
    allowed
        (rows, columns) bool, slots that may be chosen.
    count
        How many, 0 … the number allowed.
    rng
        Decides the start, and between equals.

    Returns
    -------
    ndarray
        (rows, columns) bool with `count` slots true, all of them allowed.
    """
    rows, columns = allowed.shape
    row_of, column_of = np.indices(allowed.shape, dtype=np.int64)
    quarters: npt.NDArray[np.int64] = 2 * (2 * row_of // rows) + 2 * column_of // columns
    quotas = _quotas([int((allowed & (quarters == quarter)).sum()) for quarter in range(4)], count)
    chosen = np.zeros_like(allowed)
    members = [np.flatnonzero(allowed & (quarters == quarter)) for quarter in range(4)]
    for places, quota in zip(members, quotas, strict=True):
        chosen.flat[rng.choice(places, quota, replace=False)] = True
    if count == 0:
        return chosen
    # In units of the mean distance between neighbours; found best by the nearest pair and the largest gap on A0.
    sigma = 0.4 * math.sqrt(allowed.size / count)
    down, across = _nearness(rows, sigma), _nearness(columns, sigma)
    # Equals are decided at random, by less than any difference that matters.
    crowd = down @ chosen.astype(np.float64) @ across.T + 1e-6 * rng.random(allowed.shape)
    flat, picked = crowd.reshape(-1), chosen.reshape(-1)
    for slot in rng.permutation(np.flatnonzero(chosen)):
        row, column = divmod(int(slot), columns)
        crowd -= np.outer(down[:, row], across[:, column])
        picked[slot] = False
        places = members[int(quarters[row, column])]
        open_ = places[~picked[places]]
        best = int(open_[flat[open_].argmin()])
        row, column = divmod(best, columns)
        crowd += np.outer(down[:, row], across[:, column])
        picked[best] = True
    return chosen


def _nearness(count: int, sigma: float) -> npt.NDArray[np.float64]:
    """(count, count): how near a slot (column) is to a place (row); near an edge the same crowd weighs more."""
    places = np.arange(count)
    weights = np.exp(-0.5 * ((places[:, None] - places[None, :]) / sigma) ** 2)
    # A place at the edge has neighbours on one side only; without this all would gather at the edges.
    return weights / weights.sum(axis=1, keepdims=True)


def _quotas(sizes: list[int], count: int) -> list[int]:
    """Share `count` among the quarters in proportion to their sizes, whole and none above its size."""
    exact = [count * size / sum(sizes) for size in sizes]
    shares = [math.floor(share) for share in exact]
    largest = sorted(range(len(sizes)), key=lambda quarter: shares[quarter] - exact[quarter])
    for quarter in largest[: count - sum(shares)]:
        shares[quarter] += 1
    return shares
