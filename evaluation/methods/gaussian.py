"""Gaussian derivatives of images of any size, in tiles, by separable filters.

Filters follow the program of the authors of the Gray-Edge framework (J. van de Weijer et al., 2007): Gaussian kernels
cut at 3σ, normalised on the grid of pixels, edges continued by their last pixel, order 2 as √(f_xx² + 4 f_xy² + f_yy²).

Rows filtered along x stand in columns of 16 numbers: (columns, rows, 16), one cache line a row, which is what the
filter along y reads from top to bottom. An image is filtered in tiles whose columns fit a core's cache, from top to
bottom; the rows that a tile shares with the one above are kept, and those beyond the image are copies.

Vectors lie one after the other along the axis that is filtered, so that every load is aligned: rows are filtered in
groups of 16 that are transposed first, which costs 4 shuffles a vector, where loads that begin between two cache lines
would cost 2 cycles a tap. `OUTPUTS` neighbouring vectors are found at a time. From tap to tap the neighbours they need
move on by one, so a tap loads two vectors, not two for each of them: what bounds the loop is additions and
multiplications, not loads. Taps that lie symmetrically are combined before they are multiplied: a derivative of
constant whole numbers is exactly zero. Short kernels of three orders at a time are the exception, see `beside_all`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir

from evaluation.scene import Image
from foundation.compiled import compiled, inlined
from generator.kernels.vector import (
    ADDRESS,
    F32,
    FLOATS,
    I32,
    I64,
    LANES,
    LINE,
    Builder,
    Value,
    broadcast,
    constant,
    load,
    step,
    store,
)

# Vectors that are found at a time: as many sums as a multiplication takes cycles, so that none waits for another.
OUTPUTS: Final = 4
_BYTES: Final = 4  # Of a float32
CHUNK: Final = 16  # Interleaved pixels of a row that are three whole vectors
_PIXEL: Final = 3 * LINE  # Bytes from pixel to pixel of 16 rows

# Kinds of kernels: Σ w(k) (x(k) + x(-k)) + w(0) x(0); Σ w(k) (x(k) - x(-k)); Σ w(k) (x(k) + x(-k) - 2 x(0)). Those of
# a Gaussian and of its first two derivatives.
EVEN, ODD, BEND = 0, 1, 2


def _call(builder: Builder, name: str, *arguments: Any) -> Any:
    """Return what an LLVM intrinsic on vectors of 16 float32 gives."""
    whole = f"{name}.v{LANES}f32"
    known = builder.module.globals.get(whole)
    function = known or ir.Function(builder.module, ir.FunctionType(FLOATS, [FLOATS] * len(arguments)), whole)
    return builder.call(function, arguments)


def _fused(builder: Builder, first: Any, second: Any, third: Any) -> Any:
    """Return first · second + third, rounded once."""
    return _call(builder, "llvm.fma", first, second, third)


def _root(builder: Builder, value: Any) -> Any:
    return _call(builder, "llvm.sqrt", value)


def _emit(
    builder: Builder,
    source: Any,
    stride: Any,
    weights: Sequence[Any],
    reach: Any,
    kinds: Sequence[int],
    *,
    side_by_side: bool = False,
) -> list[list[Any]]:
    """Return the filtered vectors at `source` and after for each kind.

    Neighbours lie `stride` bytes apart; `weights` are addresses of reach + 1 float32 a kind. Read are `reach`
    neighbours before the first and after the last vector. The vectors are `OUTPUTS` neighbours, or the three of `CHUNK`
    interleaved pixels side by side, whose neighbours are loaded from wherever they begin.
    """
    from numba.core import cgutils

    def slot_of(value: Any) -> Any:
        slot = cgutils.alloca_once(builder, FLOATS)
        builder.store(value, slot)
        return slot

    def times(number: Any, count: int) -> Any:
        return builder.mul(number, ir.Constant(I64, count))

    outputs = range(3 if side_by_side else OUTPUTS)
    apart = ir.Constant(I64, LINE) if side_by_side else stride
    centre = [load(builder, builder.add(source, times(apart, at)), 0, FLOATS) for at in outputs]
    sums: list[list[Any]] = []
    for kind, table in zip(kinds, weights, strict=True):
        first = broadcast(builder, load(builder, table, 0, F32), FLOATS)
        zero = ir.Constant(FLOATS, [0.0] * LANES)
        sums.append([slot_of(builder.fmul(one, first) if kind == EVEN else zero) for one in centre])
    doubled = [builder.fadd(one, one) for one in centre] if BEND in kinds else []
    lows, highs = [slot_of(one) for one in centre], [slot_of(one) for one in centre]
    last = builder.add(source, times(stride, OUTPUTS - 1))
    with cgutils.for_range(builder, reach) as loop:
        tap = builder.add(loop.index, ir.Constant(I64, 1))
        offset = builder.mul(tap, stride)
        below, above = builder.sub(source, offset), builder.add(last, offset)
        if side_by_side:
            low = [load(builder, below, LINE * at, FLOATS) for at in outputs]
            high = [load(builder, builder.add(source, offset), LINE * at, FLOATS) for at in outputs]
        else:
            low = [load(builder, below, 0, FLOATS), *[builder.load(slot) for slot in lows[:-1]]]
            high = [*[builder.load(slot) for slot in highs[1:]], load(builder, above, 0, FLOATS)]
            for slots, values in ((lows, low), (highs, high)):
                for slot, value in zip(slots, values, strict=True):
                    builder.store(value, slot)
        factors = [
            broadcast(builder, load(builder, builder.add(table, times(tap, _BYTES)), 0, F32), FLOATS)
            for table in weights
        ]
        for at in outputs:
            both = builder.fadd(low[at], high[at]) if EVEN in kinds or BEND in kinds else None
            for kind, factor, slots in zip(kinds, factors, sums, strict=True):
                if kind == EVEN:
                    part = both
                elif kind == ODD:
                    part = builder.fsub(high[at], low[at])
                else:
                    part = builder.fsub(both, doubled[at])
                builder.store(_fused(builder, part, factor, builder.load(slots[at])), slots[at])
    return [[builder.load(slot) for slot in slots] for slots in sums]


def _write(builder: Builder, values: Sequence[Any], target: Any, stride: Any) -> None:
    for at, value in enumerate(values):
        store(builder, value, builder.add(target, builder.mul(stride, ir.Constant(I64, at))), 0)


def _across(builder: Builder, kinds: Sequence[int], source: Value, reach: Value, places: Sequence[Value]) -> None:
    """Filter `OUTPUTS` pixels of 16 rows by each of some kinds; `places` are those of the kernels, then the targets."""
    apart = ir.Constant(I64, _PIXEL)
    found = _emit(builder, source, apart, places[: len(kinds)], reach, kinds)
    for values, target in zip(found, places[len(kinds) :], strict=True):
        _write(builder, values, target, apart)


@step(*[ADDRESS] * 4)
def across_even(builder: Builder, source: Value, reach: Value, even: Value, target: Value) -> None:
    """Write four pixels of 16 rows from `source` on, smoothed along x, to `target`."""
    _across(builder, (EVEN,), source, reach, (even, target))


@step(*[ADDRESS] * 6)
def across_even_odd(
    builder: Builder, source: Value, reach: Value, even: Value, odd: Value, smooth: Value, slope: Value
) -> None:
    """Write four pixels of 16 rows, smoothed and derived once."""
    _across(builder, (EVEN, ODD), source, reach, (even, odd, smooth, slope))


@step(*[ADDRESS] * 8)
def across_all(
    builder: Builder,
    source: Value,
    reach: Value,
    even: Value,
    odd: Value,
    bend: Value,
    smooth: Value,
    slope: Value,
    curve: Value,
) -> None:
    """Write four pixels of 16 rows, smoothed, derived once and derived twice."""
    _across(builder, (EVEN, ODD, BEND), source, reach, (even, odd, bend, smooth, slope, curve))


@step(*[ADDRESS] * 9)
def beside_all(
    builder: Builder,
    source: Value,
    reach: Value,
    even: Value,
    odd: Value,
    bend: Value,
    smooth: Value,
    slope: Value,
    curve: Value,
    column: Value,
) -> None:
    """Write 16 interleaved pixels of a row, smoothed, derived once and twice, as vectors `column` bytes apart."""
    apart = ir.Constant(I64, 3 * _BYTES)
    found = _emit(builder, source, apart, (even, odd, bend), reach, (EVEN, ODD, BEND), side_by_side=True)
    for values, target in zip(found, (smooth, slope, curve), strict=True):
        _write(builder, values, target, column)


@step(*[ADDRESS] * 5)
def down_even(builder: Builder, smooth: Value, reach: Value, even: Value, target: Value, pitch: Value) -> None:
    """Write four rows of 16 numbers, smoothed along y, `pitch` bytes apart."""
    (found,) = _emit(builder, smooth, ir.Constant(I64, LINE), (even,), reach, (EVEN,))
    _write(builder, found, target, pitch)


@step(*[ADDRESS] * 7)
def down_gradient(
    builder: Builder, smooth: Value, slope: Value, reach: Value, even: Value, odd: Value, target: Value, pitch: Value
) -> None:
    """Write the gradient's length from rows smoothed and derived along x."""
    apart = ir.Constant(I64, LINE)
    (along_x,) = _emit(builder, slope, apart, (even,), reach, (EVEN,))
    (along_y,) = _emit(builder, smooth, apart, (odd,), reach, (ODD,))
    lengths = [_root(builder, _fused(builder, x, x, builder.fmul(y, y))) for x, y in zip(along_x, along_y, strict=True)]
    _write(builder, lengths, target, pitch)


@step(*[ADDRESS] * 9)
def down_curvature(
    builder: Builder,
    smooth: Value,
    slope: Value,
    curve: Value,
    reach: Value,
    even: Value,
    odd: Value,
    bend: Value,
    target: Value,
    pitch: Value,
) -> None:
    """Write √(f_xx² + 4 f_xy² + f_yy²) from rows smoothed, derived once, and derived twice along x."""
    apart = ir.Constant(I64, LINE)
    (xx,) = _emit(builder, curve, apart, (even,), reach, (EVEN,))
    (xy,) = _emit(builder, slope, apart, (odd,), reach, (ODD,))
    (yy,) = _emit(builder, smooth, apart, (bend,), reach, (BEND,))
    sizes: list[Value] = []
    for a, b, c in zip(xx, xy, yy, strict=True):
        mixed = builder.fadd(b, b)
        total = _fused(builder, a, a, _fused(builder, mixed, mixed, builder.fmul(c, c)))
        sizes.append(_root(builder, total))
    _write(builder, sizes, target, pitch)


@step(ADDRESS, ADDRESS)
def copy_line(builder: Builder, source: Value, target: Value) -> None:
    """Copy 16 numbers."""
    store(builder, load(builder, source, 0, FLOATS), target, 0)


@step(*[ADDRESS] * 3)
def transpose(builder: Builder, source: Value, pitch: Value, target: Value) -> None:
    """Write the 16 x 16 numbers whose rows stand `pitch` bytes apart, transposed, to 16 cache lines at `target`."""
    rows = [
        load(builder, builder.add(source, builder.mul(pitch, ir.Constant(I64, row))), 0, FLOATS) for row in range(LANES)
    ]
    size = LANES // 2
    while size:
        # Squares of `size` numbers change places across the diagonal.
        upper = [lane if not lane & size else LANES + lane - size for lane in range(LANES)]
        lower = [lane + size if not lane & size else LANES + lane for lane in range(LANES)]
        for row in range(LANES):
            if not row & size:
                pair = rows[row], rows[row + size]
                for at, lanes in ((row, upper), (row + size, lower)):
                    rows[at] = builder.shuffle_vector(*pair, constant(ir.VectorType(I32, LANES), lanes))
        size //= 2
    for row, value in enumerate(rows):
        store(builder, value, target, LINE * row)


GROUP: Final = LANES  # Rows that are filtered along x at a time: one a lane
# Reach of kernels up to which rows are not transposed for order 2: its four transpositions a vector take longer than
# loads that begin between two cache lines. Orders 0 and 1 have two and three, and are not faster so.
NEAR: Final = 9
# Numbers of a row that are converted before they are transposed: 16 rows of them take 12 KB of the nearest cache.
STRETCH: Final = 4 * 3 * CHUNK


@inlined
def _convert(
    values: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    line: npt.NDArray[np.float32],
) -> None:
    """Write values (N,) times `scale` to `line` (N,) float32."""
    if scale == 1:
        for j in range(values.size):
            line[j] = np.float32(values[j])
    else:
        for j in range(values.size):
            line[j] = np.float32(values[j] * scale)


@compiled
def _turn_rows(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    top: int,
    left: int,
    lines: npt.NDArray[np.float32],
    turned: npt.NDArray[np.float32],
) -> None:
    """Write 16 rows of an image (H, 3 W) from `top` on, times `scale`, transposed to `turned` (3 P + 16, 16) float32.

    Its P pixels begin with pixel `left`; beyond the image stand copies of its first and last pixels and of its last
    row. `lines` (16, STRETCH) float32 is scratch.
    """
    height, length = image.shape
    begin = max(0, 3 * left)
    end = min(length, 3 * left + turned.shape[0] - LANES)
    before = begin - 3 * left
    for start in range(begin, end, STRETCH):
        count = min(STRETCH, end - start)
        for row in range(GROUP):
            values = image[min(top + row, height - 1), start : start + count]
            _convert(values, scale, lines[row, :count])
        for at in range(0, count, LANES):
            target = turned.ctypes.data + (start - 3 * left + at) * LINE
            transpose(lines.ctypes.data + at * _BYTES, STRETCH * _BYTES, target)
    for at in range(before):
        turned[at] = turned[before + at % 3]
    for at in range(end - 3 * left, turned.shape[0]):
        turned[at] = turned[at - 3]


@compiled
def _convert_row(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    y: int,
    left: int,
    line: npt.NDArray[np.float32],
) -> None:
    """Write a row of an image (H, 3 W) times `scale`, from pixel `left` on, to `line` (3 P,) float32.

    Beyond the image stand copies of its first and last pixels and of its last row.
    """
    height, length = image.shape
    begin = max(0, 3 * left)
    end = min(length, 3 * left + line.size)
    values = image[min(y, height - 1), begin:end]
    before = begin - 3 * left
    inside = line[before : before + end - begin]
    _convert(values, scale, inside)
    for at in range(before):
        line[at] = inside[at % 3]
    for at in range(before + inside.size, line.size):
        line[at] = line[at - 3]


@compiled
def _filter_row(
    row: int, weights: npt.NDArray[np.float32], line: npt.NDArray[np.float32], columns: npt.NDArray[np.float32]
) -> None:
    """Filter a row, as `_convert_row` wrote it from `reach` pixels before the tile on, to a row of three columns."""
    reach = weights.shape[1] - 1
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    column = columns.shape[2] * LINE
    field = columns.shape[1] * column
    for at in range(0, columns.shape[1], 3):
        source = line.ctypes.data + 3 * reach * _BYTES + at * LINE
        smooth = columns.ctypes.data + at * column + row * LINE
        beside_all(source, reach, even, odd, bend, smooth, smooth + field, smooth + 2 * field, column)


@compiled
def filter_rows(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    top: int,
    left: int,
    rows: int,
    done: int,
    weights: npt.NDArray[np.float32],
    order: int,
    lines: npt.NDArray[np.float32],
    turned: npt.NDArray[np.float32],
    chunk: npt.NDArray[np.float32],
    columns: npt.NDArray[np.float32],
) -> int:
    """Filter the rows of an image along x that a tile needs and the tile above it has not left.

    Returns the first row of the image that is not filtered, `done` of the tile below.

    `image`: (H, 3 W) uint16, float32 or float64, rows of interleaved pixels. `scale`: factor for values that float32
    does not hold. `weights`: (3, reach + 1) float32: the halves of the kernels of order 0, 1 and 2 from their centres
    on. `lines`: (16, STRETCH) float32, scratch. `turned`: (Q + 6 reach + 16, 16) float32, scratch, its first number at
    a cache line; Q, numbers of a row of the tile, is a multiple of 48. `chunk`: (order + 1, 48, 16) float32, scratch,
    its first number at a cache line. `columns`: (order + 1, Q / 16, rows + 2 reach + 16, 16) float32: the filtered rows
    in columns of 16 numbers, from row top - reach on; its first number at a cache line. What stands there of the tile
    above is used.
    """
    reach = weights.shape[1] - 1
    height = image.shape[0]
    start = top - reach
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    plane = chunk.shape[1] * LINE
    kept = chunk.ctypes.data
    column = columns.shape[2] * LINE
    field = columns.shape[1] * column
    if top:
        for at in range(columns.shape[1] * (order + 1)):
            first = columns.ctypes.data + at * column
            for row in range(done - start):
                copy_line(first + (row + rows) * LINE, first + row * LINE)
    line = turned.reshape(-1)[: columns.shape[1] * LANES + 6 * reach]
    while done < min(height, top + rows + reach):
        if order == 2 and reach <= NEAR:
            for row in range(GROUP):
                _convert_row(image, scale, done + row, left - reach, line)
                _filter_row(done + row - start, weights, line, columns)
            done += GROUP
            continue
        _turn_rows(image, scale, done, left - reach, lines, turned)
        to = columns.ctypes.data + (done - start) * LINE
        for at in range(0, columns.shape[1], 3):
            for channel in range(3):
                for pixel in range(0, CHUNK, OUTPUTS):
                    source = turned.ctypes.data + (3 * reach + at * LANES + 3 * pixel + channel) * LINE
                    smooth = kept + (3 * pixel + channel) * LINE
                    if order == 0:
                        across_even(source, reach, even, smooth)
                    elif order == 1:
                        across_even_odd(source, reach, even, odd, smooth, smooth + plane)
                    else:
                        across_all(source, reach, even, odd, bend, smooth, smooth + plane, smooth + 2 * plane)
            for one in range(order + 1):
                for part in range(3):
                    transpose(kept + one * plane + part * LANES * LINE, LINE, to + one * field + (at + part) * column)
        done += GROUP
    for at in range(columns.shape[1] * (order + 1)):
        first = columns.ctypes.data + at * column
        if not top:
            for row in range(reach):
                copy_line(first + reach * LINE, first + row * LINE)
        for row in range(done - start, rows + 2 * reach):
            copy_line(first + (row - 1) * LINE, first + row * LINE)
    return done


@compiled
def filter_columns(
    columns: npt.NDArray[np.float32],
    weights: npt.NDArray[np.float32],
    order: int,
    rows: int,
    out: npt.NDArray[np.float32],
) -> None:
    """Write the size of the Gaussian derivative of rows that are filtered along x to `out`.

    `columns`: (order + 1, Q / 16, R, 16) float32, what `filter_rows` wrote: R ≥ rows + 2 reach, rows rounded up to
    fours. `weights`: (3, reach + 1) float32: the halves of the kernels of order 0, 1 and 2 from their centres on.
    `out`: (rows, Q) or longer float32, its first number at a cache line.
    """
    reach = weights.shape[1] - 1
    even = weights.ctypes.data
    odd = even + weights.shape[1] * _BYTES
    bend = odd + weights.shape[1] * _BYTES
    column = columns.shape[2] * LINE
    field = columns.shape[1] * column
    pitch = out.shape[1] * _BYTES
    for at in range(columns.shape[1]):
        for y in range(0, rows, OUTPUTS):
            smooth = columns.ctypes.data + at * column + (y + reach) * LINE
            target = out.ctypes.data + y * pitch + at * LINE
            if order == 0:
                down_even(smooth, reach, even, target, pitch)
            elif order == 1:
                down_gradient(smooth, smooth + field, reach, even, odd, target, pitch)
            else:
                down_curvature(smooth, smooth + field, smooth + 2 * field, reach, even, odd, bend, target, pitch)


# Pixels of a tile's width at most, a multiple of 16: narrower, and more of a row is neighbours of the tile.
TILE_WIDTH = 256
# Rows of a tile, a multiple of 16: with the widest standard kernels a tile's intermediate results take 0.8 MB at
# most, which a core's cache holds.
TILE_ROWS = 64

_ALIGNMENT = 64  # Bytes of a cache line: aligned buffers make a third of the difference between two loads and three


def gaussian_kernel(sigma: float, order: int) -> npt.NDArray[np.float64]:
    """Return the kernel (N,) float64 of a Gaussian's derivative, to be correlated with; N = 2⌊3σ + ½⌋ + 1.

    Normalised on the grid of pixels: order 0 sums to 1; order 1 gives 1 for the ramp x; order 2 gives 1 for x²/2 and 0
    for a constant.

    `sigma`: standard deviation of the Gaussian, px, above 0.

    Examples
    --------
    >>> gaussian_kernel(0.5, 1).round(3)
    array([-0.002, -0.495,  0.   ,  0.495,  0.002])
    """
    reach = math.floor(3 * sigma + 0.5)
    x = np.arange(-reach, reach + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * sigma**2))
    if order == 0:
        return bell / bell.sum()
    if order == 1:
        slope = x * bell
        return slope / (x * slope).sum()
    bend = (x**2 / sigma**4 - 1 / sigma**2) * bell
    bend -= bend.mean()
    return bend / (0.5 * x**2 * bend).sum()


def put_tile(found: npt.NDArray[np.float32], top: int, left: int, tile: npt.NDArray[np.float32]) -> None:
    """Write a tile of `differentiated_tiles`, (rows, Q) float32, to its place in an image (H, W, 3) float32."""
    wide = min(tile.shape[1] // 3, found.shape[1] - left)
    found[top : top + len(tile), left : left + wide] = tile[:, : 3 * wide].reshape(len(tile), wide, 3)


def differentiated_tiles(
    image: Image, order: int, sigma: float, scale: float
) -> Iterator[tuple[int, int, npt.NDArray[np.float32]]]:
    """Yield the Gaussian derivative of an image times `scale` in tiles, from top to bottom and then from left to right.

    `image`: (H, W, 3) uint16, float32 or float64, not below 0. `order`, `sigma`: of the derivative, 0 to 2, and its
    scale, px, above 0. `scale`: factor for values that float32 does not hold. Yields the tile's first row and pixel;
    (rows, Q) float32, interleaved pixels, of which those within the image count. The array is written anew for the next
    tile.
    """
    height, width = image.shape[:2]
    flat: Any = image.reshape(height, -1)
    kernels = [gaussian_kernel(sigma, one) for one in range(3)]
    reach = len(kernels[0]) // 2
    weights = np.stack([kernel[reach:] for kernel in kernels]).astype(np.float32)
    across = -(-width // TILE_WIDTH)  # tiles of equal width
    wide = -(-width // (across * CHUNK)) * CHUNK
    pitch = 3 * wide
    most = min(TILE_ROWS, -(-height // GROUP) * GROUP)
    lines, turned = np.zeros((GROUP, STRETCH), np.float32), _aligned((pitch + 6 * reach + LANES, LANES))
    chunk = _aligned((order + 1, 3 * CHUNK, LANES))
    columns = _aligned((order + 1, pitch // LANES, most + 2 * reach + GROUP, LANES))
    out = _aligned((most, pitch))
    for left in range(0, width, wide):
        done = 0
        for top in range(0, height, most):
            done = filter_rows(flat, scale, top, left, most, done, weights, order, lines, turned, chunk, columns)
            filter_columns(columns, weights, order, most, out)
            yield top, left, out[: height - top]


def _aligned(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """Return an array of float32 that begins at a cache line."""
    spare = _ALIGNMENT // 4
    memory = np.empty(math.prod(shape) + spare, dtype=np.float32)
    start = -memory.ctypes.data // 4 % spare
    return memory[start : start + math.prod(shape)].reshape(shape)
