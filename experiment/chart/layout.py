"""Design a chart: choose the positions of colours, tags and references.

- The sheet is divided into square slots, with a side of 125 pixels at 600 dpi (5.292 mm). On a page that is too small
  for this, the side is the largest multiple of 5 pixels that fits. All edges of patches and tag modules are then edges
  of pixels at 600 dpi.
- Each colour is printed once, in random order. A random chart can be registered more accurately than a smooth one, and
  a registration that is wrong by one patch is detected.
- The tags form a regular grid that reaches the edges. Each tag takes 4 × 4 slots, for the 10 modules of an AprilTag
  36h11 with its rim.
- All other slots are achromatic references. They are spread evenly but irregularly, because a regular grid would cause
  streaks in the fitted flat field.

The same bits, page and seed give the same chart. For existing sheets, `paper_chart` makes the plain grid of Banić et
al. (2019) with 256 × 128 patches.
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

SLOT_PX = 125  # Normal side of a slot: the largest with which 32 768 colours, tags and references fit on A0

# The side of a slot is a multiple of this length, so that a tag module (2/5 of a slot) has whole pixels.
SLOT_STEP_PX = 5

# Smallest side of a slot, 1.06 mm. A printer cannot mix a colour from fewer dots.
LEAST_SLOT_PX = 25

TAG_SLOTS = 4  # Number of slots along a tag with its white rim

TAG_SPACING_SLOTS = 38  # Largest distance between neighbouring tags, in slots

TAG_IDS = 587  # Number of codes in the family 36h11

MARGIN_MM = 8.0  # Smallest white margin. Printers need 3 to 5 mm, rulers and targets need the rest.

# Columns and rows of blocks in `paper_chart`, for each number of bits. A block contains all patches with one level of
# blue.
PAPER_BLOCKS = {1: (2, 1), 2: (2, 2), 3: (4, 2), 4: (4, 4), 5: (8, 4)}

PAPER_REFERENCE_MM = 100.0  # Largest distance between the white references in the margins of `paper_chart`

# Side of these references, 5 mm. The number is even, so that the centre has whole coordinates.
PAPER_REFERENCE_PX = 118

PAPER_REFERENCE_INTERVALS = 4  # Smallest number of intervals between white references in the top and right margin

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

# Codes of the grey references. In sRGB, each grey reflects half the light of the previous grey: 1/2, 1/4, 1/8 and 1/16
# of white. These levels show whether a frame is linear. No grey is a colour of a patch, because its low bits are not 0.
GREY_CODES = (188, 137, 99, 71)

# Smallest number of white references with which calibration can measure the fall-off to the corners.
LEAST_WHITES = 18

# Longest side of a page. A larger number is probably in a wrong unit.
LARGEST_PAGE_MM = 10_000.0

_Slots = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class _Grid:
    """The grid of slots on a page: numbers of columns and rows, side of a slot, and origin, px at 600 dpi."""

    columns: int
    rows: int
    slot_px: int
    origin_px: tuple[int, int]

    @classmethod
    def on(cls, page_mm: tuple[float, float], slot_px: int = SLOT_PX) -> _Grid:
        """Return the largest grid of slots within the margins of a page, centred."""
        page_px = [math.floor(side / PX_MM) for side in page_mm]
        margin_px = math.ceil(MARGIN_MM / PX_MM)
        columns, rows = (max(0, side - 2 * margin_px) // slot_px for side in page_px)
        x0, y0 = ((side - count * slot_px) // 2 for side, count in zip(page_px, (columns, rows), strict=True))
        return cls(columns, rows, slot_px, (x0, y0))

    @property
    def cell_mm(self) -> tuple[float, float]:
        return self.slot_px * PX_MM, self.slot_px * PX_MM

    @property
    def tag_slots(self) -> list[tuple[int, int]]:
        """(column, row) of the top-left slot of each tag, row by row."""
        return [(column, row) for row in _tag_starts(self.rows) for column in _tag_starts(self.columns)]

    @property
    def free_slot_count(self) -> int:
        """Number of slots without tags, for colours and references."""
        return self.columns * self.rows - len(self.tag_slots) * TAG_SLOTS**2

    def fits(self, bits: int) -> bool:
        # A chart of `bits` bits needs places for its colours and references, and at least two by two tags.
        if min(self.columns, self.rows) < 2 * TAG_SLOTS or len(self.tag_slots) > TAG_IDS:
            return False
        return self.free_slot_count >= 8**bits + _least_references(bits)

    def position_mm(self, column: float, row: float) -> tuple[float, float]:
        """Return the position (x, y) of a point of the slot grid, mm."""
        x0, y0 = self.origin_px
        return (x0 + column * self.slot_px) * PX_MM, (y0 + row * self.slot_px) * PX_MM


def _tag_starts(slots: int) -> list[int]:
    # Space the tags evenly; the outermost tags are at the edges.
    last = slots - TAG_SLOTS
    steps = max(1, math.ceil(last / TAG_SPACING_SLOTS))
    return [round(step * last / steps) for step in range(steps + 1)]


def _least_references(bits: int) -> int:
    # 20 whites and three of each grey, or one reference for 40 colours if that is more.
    return max(32, 8**bits // 40)


def smallest_page(bits: int) -> str:
    """Return the name of the smallest A page, landscape, on which a chart of `bits` bits fits."""
    return next(name for name in reversed(A_SERIES_MM) if _Grid.on(A_SERIES_MM[name]).fits(bits))


def design_chart(bits: int = 5, page: str | tuple[float, float] | None = None, seed: int = 1) -> Chart:
    """Design a chart of all 8**bits colours.

    Parameters
    ----------
    bits
        Bits per channel, 1 … 5.
    page
        "A0" … "A8" (landscape), or width and height in mm; by default the smallest A page that fits.
    seed
        Seed of the random order, ≥ 0.

    Returns
    -------
        The chart, with the sizes that the module docstring gives.
    """
    if not 1 <= bits <= 5:
        raise InputError(f"{bits} bits per channel are given, expected 1 to 5; give another number")
    if seed < 0:
        raise InputError(f"the seed is {seed}, expected a whole number of 0 or more; give another one")
    grid, page_mm = _choose_grid(bits, page)
    rng = np.random.default_rng(seed)
    is_free = np.ones((grid.rows, grid.columns), dtype=np.bool_)
    for column, row in grid.tag_slots:
        is_free[row : row + TAG_SLOTS, column : column + TAG_SLOTS] = False
    is_reference = spread(is_free, int(is_free.sum()) - 8**bits, rng)
    rows, columns = np.nonzero(is_free & ~is_reference)
    (x0, y0), slot = grid.origin_px, grid.slot_px
    return Chart(
        page_mm=page_mm,
        bits=bits,
        cell_mm=grid.cell_mm,
        centres_mm=PX_MM * np.array([x0 + (columns + 0.5) * slot, y0 + (rows + 0.5) * slot], dtype=np.float64).T,
        colours=rng.permutation(8**bits).astype(np.int64),
        tags=tuple(_tag(grid, number, *slot) for number, slot in enumerate(grid.tag_slots)),
        references=tuple(_references(grid, is_reference, rng)),
        seed=seed,
        software=software(),
    )


def _choose_grid(bits: int, page: str | tuple[float, float] | None) -> tuple[_Grid, tuple[float, float]]:
    page_mm = _page_mm(smallest_page(bits) if page is None else page)
    grid = _Grid.on(page_mm)
    if grid.fits(bits):
        return grid, page_mm
    if len(grid.tag_slots) > TAG_IDS:
        raise InputError(
            f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm needs {len(grid.tag_slots)} tags, but the family "
            f"{TAG_FAMILY} has {TAG_IDS}; choose a smaller page"
        )
    smaller = (_Grid.on(page_mm, slot) for slot in range(SLOT_PX - SLOT_STEP_PX, LEAST_SLOT_PX - 1, -SLOT_STEP_PX))
    fitting_grid = next((grid for grid in smaller if grid.fits(bits)), None)
    problem = (
        f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm is too small for the {8**bits} colours of a chart of {bits} bits"
    )
    if fitting_grid is None:
        name = next(name for name in reversed(A_SERIES_MM) if _Grid.on(A_SERIES_MM[name], LEAST_SLOT_PX).fits(bits))
        width, height = A_SERIES_MM[name]
        raise InputError(
            f"{problem}, even with the smallest printable patches of {LEAST_SLOT_PX * PX_MM:.2f} mm; choose at least "
            f"{name} ({width:g} × {height:g} mm), or {smallest_page(bits)} for patches of full size"
        )
    return fitting_grid, page_mm


def paper_chart(page: str | tuple[float, float] | None = None, bits: int = 5) -> Chart:
    """Return the plain grid of Banić et al. (2019): 256 × 128 patches, one for each of 32 768 colours, without tags.

    The authors do not describe the order of the colours, so this order is a reconstruction. There are 8 × 4 blocks of
    32 × 32 patches. Red changes along the columns of a block, green along its rows, and blue from block to block. The
    directions alternate between blocks, so that neighbouring patches usually differ by one step in one channel.

    The references are squares of bare paper in the margin, 5 mm wide. They are at the corners, and at most 100 mm apart
    above the patches and to their right. The sheet is assumed to have this margin.

    Parameters
    ----------
    page
        As in `design_chart`; by default A0.
    bits
        Bits per channel, 1 … 5.

    Returns
    -------
        The chart. Its patches are as large as possible with a margin of 8 mm and whole pixels at 600 dpi. On A0 they
        measure 4.57 × 6.43 mm.
    """
    if bits not in PAPER_BLOCKS:
        raise InputError(f"{bits} bits per channel are given, expected 1 to 5; give another number")
    page_mm = _page_mm("A0" if page is None else page)
    margin_px = math.ceil(MARGIN_MM / PX_MM)
    page_px = [math.floor(side / PX_MM) for side in page_mm]
    across, down = PAPER_BLOCKS[bits]
    levels = 1 << bits
    counts = (levels * across, levels * down)
    cell_w, cell_h = ((side - 2 * margin_px) // count for side, count in zip(page_px, counts, strict=True))
    if min(cell_w, cell_h) < LEAST_SLOT_PX:
        raise InputError(
            f"a page of {page_mm[0]:g} × {page_mm[1]:g} mm is too small for {counts[0]} × {counts[1]} patches of "
            f"{LEAST_SLOT_PX * PX_MM:.2f} mm, the smallest that can be printed; choose a larger page, if possible A0"
        )
    x0, y0 = ((side - count * cell) // 2 for side, count, cell in zip(page_px, counts, (cell_w, cell_h), strict=True))
    row, column = (indices.ravel() for indices in np.indices((counts[1], counts[0]), dtype=np.int64))
    block_column, block_row = column // levels, row // levels
    top_level = levels - 1
    red = np.where(block_column % 2 == 0, column % levels, top_level - column % levels)
    green = np.where(block_row % 2 == 0, row % levels, top_level - row % levels)
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
    left, top, right, bottom = field_px
    side, distance, step = PAPER_REFERENCE_PX, GAP_PX + PAPER_REFERENCE_PX // 2, PAPER_REFERENCE_MM / PX_MM
    sides = ((left, right), (top, bottom))
    across, down = (max(PAPER_REFERENCE_INTERVALS, math.ceil((high - low) / step)) for low, high in sides)
    centres = [(x, y) for y in (top - distance, bottom + distance) for x in (left - distance, right + distance)]
    centres += [(left + round(k * (right - left) / across), top - distance) for k in range(1, across)]
    centres += [(right + distance, top + round(k * (bottom - top) / down)) for k in range(1, down)]
    return [Reference("white", PAPER_WHITE, (x * PX_MM, y * PX_MM), (side * PX_MM, side * PX_MM)) for x, y in centres]


def _page_mm(page: str | tuple[float, float]) -> tuple[float, float]:
    if isinstance(page, str):
        size = A_SERIES_MM.get(page.strip().upper())
        if size is None:
            raise InputError(
                f"the page is {page!r}, expected one of {', '.join(A_SERIES_MM)}, or width and height in mm; correct it"
            )
        return float(size[0]), float(size[1])
    width, height = page
    if not (math.isfinite(width) and math.isfinite(height) and width > 0 and height > 0):
        raise InputError(f"a page of {width:g} × {height:g} mm is given, expected sides above 0 mm; give others")
    if max(width, height) > LARGEST_PAGE_MM:
        raise InputError(
            f"a page of {width:g} × {height:g} mm is given, expected at most {LARGEST_PAGE_MM:g} mm per side; "
            "give width and height in mm"
        )
    return float(width), float(height)


def _tag(grid: _Grid, number: int, column: int, row: int) -> Tag:
    rim = TAG_SLOTS / (TAG_MODULES + 2)
    near, far = rim, rim + TAG_MODULES * rim
    corners = [(near, near), (far, near), (far, far), (near, far)]
    return Tag(TAG_FAMILY, number, np.array([grid.position_mm(column + x, row + y) for x, y in corners]))


def _references(grid: _Grid, is_reference: _Slots, rng: np.random.Generator) -> list[Reference]:
    codes = np.zeros(is_reference.shape, dtype=np.int64)
    codes[is_reference] = PAPER_WHITE[0]
    is_white = is_reference.copy()
    count = int(is_reference.sum())
    # Each grey gets an eighth of the references, or less, so that at least `LEAST_WHITES` references are white.
    grey_count = min(count // (2 * len(GREY_CODES)), (count - LEAST_WHITES) // len(GREY_CODES))
    for code in GREY_CODES:
        is_grey = spread(is_white, grey_count, rng)
        codes[is_grey] = code
        is_white &= ~is_grey
    return [
        Reference(
            name="white" if code == PAPER_WHITE[0] else f"grey {code}",
            rgb=(code, code, code),
            centre_mm=grid.position_mm(int(column) + 0.5, int(row) + 0.5),
            size_mm=grid.cell_mm,
        )
        for row, column in np.argwhere(is_reference)
        for code in [int(codes[row, column])]
    ]


def spread(allowed: _Slots, count: int, rng: np.random.Generator) -> _Slots:
    """Choose `count` of the allowed slots (rows, columns), spread evenly but irregularly over the grid.

    Source: R. Ulichney, "The void-and-cluster method for dither array generation", 1993. The first choice is random.
    Then each chosen slot in turn moves to the emptiest position in its quarter of the grid. One pass is enough.
    """
    rows, columns = allowed.shape
    middle_row, middle_column = (rows + 1) // 2, (columns + 1) // 2
    quarters = [
        (down, across)
        for down in (slice(middle_row), slice(middle_row, rows))
        for across in (slice(middle_column), slice(middle_column, columns))
    ]
    slot_numbers = np.arange(allowed.size).reshape(allowed.shape)
    quarter_slots = [slot_numbers[quarter][allowed[quarter]] for quarter in quarters]
    is_chosen = np.zeros_like(allowed)
    for slots, quota in zip(quarter_slots, _quotas([len(slots) for slots in quarter_slots], count), strict=True):
        is_chosen.flat[rng.choice(slots, quota, replace=False)] = True
    if count == 0:
        return is_chosen
    # Standard deviation of the Gaussian weights, in slots. On A0, 0.4 times the mean distance between neighbours gives
    # the most even pattern.
    sigma = 0.4 * math.sqrt(allowed.size / count)
    down, across = _nearness(rows, sigma), _nearness(columns, sigma)
    # Small random numbers decide between slots with equal densities.
    density = down @ is_chosen.astype(np.float64) @ across.T + 1e-6 * rng.random(allowed.shape)
    penalty, contribution = np.where(allowed & ~is_chosen, 0.0, np.inf), np.empty_like(density)
    for row, column in rng.permutation(np.argwhere(is_chosen)):
        density -= np.multiply(down[:, row, None], across[:, column], out=contribution)
        penalty[row, column] = 0.0
        quarter = quarters[2 * int(row >= middle_row) + int(column >= middle_column)]
        score = density[quarter] + penalty[quarter]
        row, column = divmod(int(slot_numbers[quarter].flat[score.argmin()]), columns)
        density += np.multiply(down[:, row, None], across[:, column], out=contribution)
        penalty[row, column] = np.inf
    return allowed & (penalty > 0)


def _nearness(count: int, sigma: float) -> npt.NDArray[np.float64]:
    """Return the Gaussian weight [i, j] of slot j at position i, (count, count) float64; sum over j is 1."""
    positions = np.arange(count)
    weights = np.exp(-0.5 * ((positions[:, None] - positions[None, :]) / sigma) ** 2)
    # Subnormal numbers are slow and do not change any sum.
    weights[weights < 1e-40] = 0
    # A position at the edge has neighbours on one side only. Without normalisation, the slots would move to the edges.
    return weights / weights.sum(axis=1, keepdims=True)


def _quotas(sizes: list[int], count: int) -> list[int]:
    exact_shares = [count * size / sum(sizes) for size in sizes]
    shares = [math.floor(share) for share in exact_shares]
    by_remainder = sorted(range(len(sizes)), key=lambda quarter: shares[quarter] - exact_shares[quarter])
    for quarter in by_remainder[: count - sum(shares)]:
        shares[quarter] += 1
    return shares
