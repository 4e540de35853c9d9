"""Compute Gaussian derivatives of images in tiles, with separable filters.

The filters follow the program of the authors of the Gray-Edge framework (J. van de Weijer et al., 2007). Gaussian
kernels are cut at 3σ and normalised on the pixel grid. Positions outside the image have the value of the nearest pixel.
The derivative of order 2 is √(f_xx² + 4 f_xy² + f_yy²).

A vector has 16 float32, one cache line. Neighbouring pixels along the filtered axis belong to different vectors, so
that all loads are aligned. Therefore 16 rows are transposed before the filter along x, except with the shortest kernels
of order 2. For the filter along y, the rows filtered along x are stored as (columns, rows, 16): a column has 16 numbers
of every row. A tile reuses the rows that it shares with the tile above.
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

# Number of vectors that are computed together. Their independent sums hide the latency of a multiplication.
OUTPUTS: Final = 4
_FLOAT: Final = 4  # bytes of a float32
INTERLEAVED_PIXELS: Final = 16  # pixels of a row that fill three vectors with interleaved R, G, B
_PIXEL_BYTES: Final = 3 * LINE  # bytes from a pixel to the next one in 16 transposed rows

# Symmetries of the kernels of a Gaussian and its first and second derivative. With weights w(k) and values x(k), the
# filtered values are: Σ w(k) (x(k) + x(-k)) + w(0) x(0), Σ w(k) (x(k) - x(-k)), Σ w(k) (x(k) + x(-k) - 2 x(0)); k > 0.
EVEN, ODD, CENTRED = 0, 1, 2


def _call_intrinsic(builder: Builder, name: str, *arguments: Any) -> Any:
    full_name = f"{name}.v{LANES}f32"
    existing = builder.module.globals.get(full_name)
    function = existing or ir.Function(builder.module, ir.FunctionType(FLOATS, [FLOATS] * len(arguments)), full_name)
    return builder.call(function, arguments)


def _fma(builder: Builder, first: Any, second: Any, third: Any) -> Any:
    return _call_intrinsic(builder, "llvm.fma", first, second, third)


def _root(builder: Builder, value: Any) -> Any:
    return _call_intrinsic(builder, "llvm.sqrt", value)


def _emit_filter(
    builder: Builder,
    source: Any,
    stride: Any,
    weights: Sequence[Any],
    radius: Any,
    symmetries: Sequence[int],
    *,
    side_by_side: bool = False,
) -> list[list[Any]]:
    """Emit code that filters the vectors from address `source` on, and return the results of each kernel.

    `stride`: bytes between neighbours along the filtered axis. `weights`: for each kernel, a pointer to radius + 1
    float32. A result has `OUTPUTS` vectors; with `side_by_side`, it has the three vectors of `INTERLEAVED_PIXELS`.
    """
    from numba.core import cgutils

    def slot_of(value: Any) -> Any:
        slot = cgutils.alloca_once(builder, FLOATS)
        builder.store(value, slot)
        return slot

    def times(number: Any, count: int) -> Any:
        return builder.mul(number, ir.Constant(I64, count))

    # Without `side_by_side`, neighbours of successive kernel positions differ by one vector on each side, so that only
    # two vectors are loaded. Values at k and -k are combined before multiplication, so that derivatives of constant
    # whole numbers are exactly zero.
    outputs = range(3 if side_by_side else OUTPUTS)
    spacing = ir.Constant(I64, LINE) if side_by_side else stride
    centre = [load(builder, builder.add(source, times(spacing, i)), 0, FLOATS) for i in outputs]
    sums: list[list[Any]] = []
    for symmetry, table in zip(symmetries, weights, strict=True):
        first = broadcast(builder, load(builder, table, 0, F32), FLOATS)
        zero = ir.Constant(FLOATS, [0.0] * LANES)
        sums.append([slot_of(builder.fmul(vector, first) if symmetry == EVEN else zero) for vector in centre])
    doubled = [builder.fadd(vector, vector) for vector in centre] if CENTRED in symmetries else []
    lows, highs = [slot_of(vector) for vector in centre], [slot_of(vector) for vector in centre]
    last = builder.add(source, times(stride, OUTPUTS - 1))
    with cgutils.for_range(builder, radius) as loop:
        tap = builder.add(loop.index, ir.Constant(I64, 1))
        offset = builder.mul(tap, stride)
        below, above = builder.sub(source, offset), builder.add(last, offset)
        if side_by_side:
            low = [load(builder, below, LINE * i, FLOATS) for i in outputs]
            high = [load(builder, builder.add(source, offset), LINE * i, FLOATS) for i in outputs]
        else:
            low = [load(builder, below, 0, FLOATS), *[builder.load(slot) for slot in lows[:-1]]]
            high = [*[builder.load(slot) for slot in highs[1:]], load(builder, above, 0, FLOATS)]
            for slots, values in ((lows, low), (highs, high)):
                for slot, value in zip(slots, values, strict=True):
                    builder.store(value, slot)
        factors = [
            broadcast(builder, load(builder, builder.add(table, times(tap, _FLOAT)), 0, F32), FLOATS)
            for table in weights
        ]
        for i in outputs:
            pair_sum = builder.fadd(low[i], high[i]) if EVEN in symmetries or CENTRED in symmetries else None
            for symmetry, factor, slots in zip(symmetries, factors, sums, strict=True):
                if symmetry == EVEN:
                    term = pair_sum
                elif symmetry == ODD:
                    term = builder.fsub(high[i], low[i])
                else:
                    term = builder.fsub(pair_sum, doubled[i])
                builder.store(_fma(builder, term, factor, builder.load(slots[i])), slots[i])
    return [[builder.load(slot) for slot in slots] for slots in sums]


def _write(builder: Builder, values: Sequence[Any], target: Any, stride: Any) -> None:
    for i, value in enumerate(values):
        store(builder, value, builder.add(target, builder.mul(stride, ir.Constant(I64, i))), 0)


def _filter_x(
    builder: Builder, symmetries: Sequence[int], source: Value, radius: Value, pointers: Sequence[Value]
) -> None:
    # `pointers`: addresses of the kernels, then of the targets.
    spacing = ir.Constant(I64, _PIXEL_BYTES)
    filtered = _emit_filter(builder, source, spacing, pointers[: len(symmetries)], radius, symmetries)
    for values, target in zip(filtered, pointers[len(symmetries) :], strict=True):
        _write(builder, values, target, spacing)


@step(*[ADDRESS] * 4)
def smooth_x(builder: Builder, source: Value, radius: Value, w0: Value, target: Value) -> None:
    """Write four pixels of 16 rows, smoothed along x."""
    _filter_x(builder, (EVEN,), source, radius, (w0, target))


@step(*[ADDRESS] * 6)
def slope_x(builder: Builder, source: Value, radius: Value, w0: Value, w1: Value, smooth: Value, slope: Value) -> None:
    """Write four pixels of 16 rows, smoothed and differentiated once along x."""
    _filter_x(builder, (EVEN, ODD), source, radius, (w0, w1, smooth, slope))


@step(*[ADDRESS] * 8)
def curve_x(
    builder: Builder,
    source: Value,
    radius: Value,
    w0: Value,
    w1: Value,
    w2: Value,
    smooth: Value,
    slope: Value,
    curve: Value,
) -> None:
    """Write four pixels of 16 rows, smoothed and differentiated once and twice along x."""
    _filter_x(builder, (EVEN, ODD, CENTRED), source, radius, (w0, w1, w2, smooth, slope, curve))


@step(*[ADDRESS] * 9)
def filter_interleaved_x(
    builder: Builder,
    source: Value,
    radius: Value,
    w0: Value,
    w1: Value,
    w2: Value,
    smooth: Value,
    slope: Value,
    curve: Value,
    column: Value,
) -> None:
    """Write 16 interleaved pixels of a row, filtered with all kernels, as vectors `column` bytes apart."""
    spacing = ir.Constant(I64, 3 * _FLOAT)
    filtered = _emit_filter(builder, source, spacing, (w0, w1, w2), radius, (EVEN, ODD, CENTRED), side_by_side=True)
    for values, target in zip(filtered, (smooth, slope, curve), strict=True):
        _write(builder, values, target, column)


@step(*[ADDRESS] * 5)
def smooth_y(builder: Builder, smooth: Value, radius: Value, w0: Value, target: Value, pitch: Value) -> None:
    """Write four rows of 16 numbers, smoothed along y, `pitch` bytes apart."""
    (filtered,) = _emit_filter(builder, smooth, ir.Constant(I64, LINE), (w0,), radius, (EVEN,))
    _write(builder, filtered, target, pitch)


@step(*[ADDRESS] * 7)
def gradient_y(
    builder: Builder, smooth: Value, slope: Value, radius: Value, w0: Value, w1: Value, target: Value, pitch: Value
) -> None:
    """Write the length of the gradient from rows smoothed and differentiated along x."""
    spacing = ir.Constant(I64, LINE)
    (along_x,) = _emit_filter(builder, slope, spacing, (w0,), radius, (EVEN,))
    (along_y,) = _emit_filter(builder, smooth, spacing, (w1,), radius, (ODD,))
    lengths = [_root(builder, _fma(builder, x, x, builder.fmul(y, y))) for x, y in zip(along_x, along_y, strict=True)]
    _write(builder, lengths, target, pitch)


@step(*[ADDRESS] * 9)
def curvature_y(
    builder: Builder,
    smooth: Value,
    slope: Value,
    curve: Value,
    radius: Value,
    w0: Value,
    w1: Value,
    w2: Value,
    target: Value,
    pitch: Value,
) -> None:
    """Write √(f_xx² + 4 f_xy² + f_yy²) from rows smoothed and differentiated once and twice along x."""
    spacing = ir.Constant(I64, LINE)
    (xx,) = _emit_filter(builder, curve, spacing, (w0,), radius, (EVEN,))
    (xy,) = _emit_filter(builder, slope, spacing, (w1,), radius, (ODD,))
    (yy,) = _emit_filter(builder, smooth, spacing, (w2,), radius, (CENTRED,))
    magnitudes: list[Value] = []
    for a, b, c in zip(xx, xy, yy, strict=True):
        mixed = builder.fadd(b, b)
        total = _fma(builder, a, a, _fma(builder, mixed, mixed, builder.fmul(c, c)))
        magnitudes.append(_root(builder, total))
    _write(builder, magnitudes, target, pitch)


@step(ADDRESS, ADDRESS)
def copy_line(builder: Builder, source: Value, target: Value) -> None:
    """Copy 16 numbers."""
    store(builder, load(builder, source, 0, FLOATS), target, 0)


@step(*[ADDRESS] * 3)
def transpose(builder: Builder, source: Value, pitch: Value, target: Value) -> None:
    """Transpose 16 x 16 numbers with rows `pitch` bytes apart, and write 16 cache lines to `target`."""
    rows = [
        load(builder, builder.add(source, builder.mul(pitch, ir.Constant(I64, row))), 0, FLOATS) for row in range(LANES)
    ]
    size = LANES // 2
    while size:
        # Blocks of size x size numbers are exchanged across the diagonal.
        upper = [lane if not lane & size else LANES + lane - size for lane in range(LANES)]
        lower = [lane + size if not lane & size else LANES + lane for lane in range(LANES)]
        for row in range(LANES):
            if not row & size:
                pair = rows[row], rows[row + size]
                for i, lanes in ((row, upper), (row + size, lower)):
                    rows[i] = builder.shuffle_vector(*pair, constant(ir.VectorType(I32, LANES), lanes))
        size //= 2
    for row, value in enumerate(rows):
        store(builder, value, target, LINE * row)


ROW_GROUP: Final = LANES  # rows that are filtered together along x, one per lane
# Up to this kernel radius, order 2 filters along x without transposing rows, because unaligned loads then take less
# time than its four transpositions per vector. Orders 0 and 1 need fewer transpositions and always transpose.
LARGEST_DIRECT_RADIUS: Final = 9
# Numbers of a row that are converted to float32 together. 16 rows take 12 KB and fit into the first-level cache.
ROW_BUFFER: Final = 4 * 3 * INTERLEAVED_PIXELS


@inlined
def _convert(
    values: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    line: npt.NDArray[np.float32],
) -> None:
    if scale == 1:
        for j in range(values.size):
            line[j] = np.float32(values[j])
    else:
        for j in range(values.size):
            line[j] = np.float32(values[j] * scale)


@compiled
def _transpose_rows(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    top: int,
    left: int,
    lines: npt.NDArray[np.float32],
    transposed: npt.NDArray[np.float32],
) -> None:
    """Write 16 rows from `top` and P pixels from `left`, times `scale`, to `transposed` (3 P + 16, 16) float32.

    Positions outside the image (H, 3 W) get the nearest pixel. `lines` is a buffer (16, ROW_BUFFER) float32.
    """
    height, length = image.shape
    begin = max(0, 3 * left)
    end = min(length, 3 * left + transposed.shape[0] - LANES)
    padding = begin - 3 * left
    for start in range(begin, end, ROW_BUFFER):
        count = min(ROW_BUFFER, end - start)
        for row in range(ROW_GROUP):
            values = image[min(top + row, height - 1), start : start + count]
            _convert(values, scale, lines[row, :count])
        for i in range(0, count, LANES):
            target = transposed.ctypes.data + (start - 3 * left + i) * LINE
            transpose(lines.ctypes.data + i * _FLOAT, ROW_BUFFER * _FLOAT, target)
    for i in range(padding):
        transposed[i] = transposed[padding + i % 3]
    for i in range(end - 3 * left, transposed.shape[0]):
        transposed[i] = transposed[i - 3]


@compiled
def _convert_row(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    y: int,
    left: int,
    line: npt.NDArray[np.float32],
) -> None:
    # Positions outside the image get the nearest pixel.
    height, length = image.shape
    begin = max(0, 3 * left)
    end = min(length, 3 * left + line.size)
    values = image[min(y, height - 1), begin:end]
    padding = begin - 3 * left
    inside = line[padding : padding + end - begin]
    _convert(values, scale, inside)
    for i in range(padding):
        line[i] = inside[i % 3]
    for i in range(padding + inside.size, line.size):
        line[i] = line[i - 3]


@compiled
def _filter_row(
    row: int, weights: npt.NDArray[np.float32], line: npt.NDArray[np.float32], columns: npt.NDArray[np.float32]
) -> None:
    # `line` starts `radius` pixels before the tile, see `_convert_row`.
    radius = weights.shape[1] - 1
    w0 = weights.ctypes.data
    w1 = w0 + weights.shape[1] * _FLOAT
    w2 = w1 + weights.shape[1] * _FLOAT
    column = columns.shape[2] * LINE
    plane = columns.shape[1] * column
    for i in range(0, columns.shape[1], 3):
        source = line.ctypes.data + 3 * radius * _FLOAT + i * LINE
        smooth = columns.ctypes.data + i * column + row * LINE
        filter_interleaved_x(source, radius, w0, w1, w2, smooth, smooth + plane, smooth + 2 * plane, column)


@compiled
def filter_rows(
    image: npt.NDArray[np.uint16] | npt.NDArray[np.float32] | npt.NDArray[np.float64],
    scale: float,
    top: int,
    left: int,
    rows: int,
    next_y: int,
    weights: npt.NDArray[np.float32],
    order: int,
    lines: npt.NDArray[np.float32],
    transposed: npt.NDArray[np.float32],
    filtered: npt.NDArray[np.float32],
    columns: npt.NDArray[np.float32],
) -> int:
    """Filter the rows of one tile along x, and return the new `next_y`. Rows of the tile above in `columns` are reused.

    `image`: (H, 3 W) uint16, float32 or float64, rows of interleaved pixels. `scale`: factor that brings all values
    into the range of float32. `next_y`: first image row that is not filtered yet. `weights`: (3, radius + 1) float32,
    kernels of order 0, 1 and 2 from their centre on. `columns`: (order + 1, Q / 16, rows + 2 radius + 16, 16) float32,
    filtered rows, the first is image row top - radius. Q is the count of numbers per tile row, a multiple of 48.
    Buffers: `lines` (16, ROW_BUFFER), `transposed` (Q + 6 radius + 16, 16) and `filtered` (order + 1, 48, 16) float32.
    `columns`, `transposed` and `filtered` start at a cache line.
    """
    radius = weights.shape[1] - 1
    height = image.shape[0]
    start = top - radius
    w0 = weights.ctypes.data
    w1 = w0 + weights.shape[1] * _FLOAT
    w2 = w1 + weights.shape[1] * _FLOAT
    # `order_bytes`: bytes of an order in `filtered`. `column`, `plane`: bytes of a column and of an order in `columns`.
    order_bytes = filtered.shape[1] * LINE
    filtered_start = filtered.ctypes.data
    column = columns.shape[2] * LINE
    plane = columns.shape[1] * column
    if top:
        for i in range(columns.shape[1] * (order + 1)):
            column_start = columns.ctypes.data + i * column
            for row in range(next_y - start):
                copy_line(column_start + (row + rows) * LINE, column_start + row * LINE)
    line = transposed.reshape(-1)[: columns.shape[1] * LANES + 6 * radius]
    while next_y < min(height, top + rows + radius):
        if order == 2 and radius <= LARGEST_DIRECT_RADIUS:
            for row in range(ROW_GROUP):
                _convert_row(image, scale, next_y + row, left - radius, line)
                _filter_row(next_y + row - start, weights, line, columns)
            next_y += ROW_GROUP
            continue
        _transpose_rows(image, scale, next_y, left - radius, lines, transposed)
        target = columns.ctypes.data + (next_y - start) * LINE
        for i in range(0, columns.shape[1], 3):
            for channel in range(3):
                for pixel in range(0, INTERLEAVED_PIXELS, OUTPUTS):
                    source = transposed.ctypes.data + (3 * radius + i * LANES + 3 * pixel + channel) * LINE
                    smooth = filtered_start + (3 * pixel + channel) * LINE
                    if order == 0:
                        smooth_x(source, radius, w0, smooth)
                    elif order == 1:
                        slope_x(source, radius, w0, w1, smooth, smooth + order_bytes)
                    else:
                        curve_x(source, radius, w0, w1, w2, smooth, smooth + order_bytes, smooth + 2 * order_bytes)
            for n in range(order + 1):
                for vector in range(3):
                    source = filtered_start + n * order_bytes + vector * LANES * LINE
                    transpose(source, LINE, target + n * plane + (i + vector) * column)
        next_y += ROW_GROUP
    for i in range(columns.shape[1] * (order + 1)):
        column_start = columns.ctypes.data + i * column
        if not top:
            for row in range(radius):
                copy_line(column_start + radius * LINE, column_start + row * LINE)
        for row in range(next_y - start, rows + 2 * radius):
            copy_line(column_start + (row - 1) * LINE, column_start + row * LINE)
    return next_y


@compiled
def filter_columns(
    columns: npt.NDArray[np.float32],
    weights: npt.NDArray[np.float32],
    order: int,
    rows: int,
    out: npt.NDArray[np.float32],
) -> None:
    """Filter the rows of `filter_rows` along y, and write the magnitude of the derivative to `out`.

    `columns`: (order + 1, Q / 16, R, 16) float32 from `filter_rows`, R ≥ rows + 2 radius, rows a multiple of 4.
    `weights`: as in `filter_rows`. `out`: (rows, Q) or longer float32, starts at a cache line.
    """
    radius = weights.shape[1] - 1
    w0 = weights.ctypes.data
    w1 = w0 + weights.shape[1] * _FLOAT
    w2 = w1 + weights.shape[1] * _FLOAT
    column = columns.shape[2] * LINE
    plane = columns.shape[1] * column
    pitch = out.shape[1] * _FLOAT
    for i in range(columns.shape[1]):
        for y in range(0, rows, OUTPUTS):
            smooth = columns.ctypes.data + i * column + (y + radius) * LINE
            target = out.ctypes.data + y * pitch + i * LINE
            if order == 0:
                smooth_y(smooth, radius, w0, target, pitch)
            elif order == 1:
                gradient_y(smooth, smooth + plane, radius, w0, w1, target, pitch)
            else:
                curvature_y(smooth, smooth + plane, smooth + 2 * plane, radius, w0, w1, w2, target, pitch)


# Largest width of a tile, px, a multiple of 16. A tile also reads pixels on its left and right, so narrow tiles cost
# more.
TILE_WIDTH = 256
# Rows of a tile, a multiple of 16. Intermediate results of the widest standard kernels take up to 0.8 MB, which fit
# into the cache of a core.
TILE_ROWS = 64

_ALIGNMENT = 64  # bytes of a cache line; unaligned buffers are slower


def gaussian_kernel(sigma: float, order: int) -> npt.NDArray[np.float64]:
    """Return the correlation kernel (N,) float64 of a Gaussian derivative; N = 2⌊3σ + ½⌋ + 1, σ > 0 in px.

    Kernels are normalised on the pixel grid. Order 0 has the sum 1. Order 1 gives 1 for the ramp x. Order 2 gives 1 for
    x²/2 and 0 for a constant.

    Examples
    --------
    >>> gaussian_kernel(0.5, 1).round(3)
    array([-0.002, -0.495,  0.   ,  0.495,  0.002])
    """
    radius = math.floor(3 * sigma + 0.5)
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    bell = np.exp(-(x**2) / (2 * sigma**2))
    if order == 0:
        return bell / bell.sum()
    if order == 1:
        slope = x * bell
        return slope / (x * slope).sum()
    curve = (x**2 / sigma**4 - 1 / sigma**2) * bell
    curve -= curve.mean()
    return curve / (0.5 * x**2 * curve).sum()


def put_tile(image: npt.NDArray[np.float32], top: int, left: int, tile: npt.NDArray[np.float32]) -> None:
    """Write a tile of `differentiated_tiles`, (rows, Q) float32, to an image (H, W, 3) float32."""
    tile_width = min(tile.shape[1] // 3, image.shape[1] - left)
    image[top : top + len(tile), left : left + tile_width] = tile[:, : 3 * tile_width].reshape(len(tile), tile_width, 3)


def differentiated_tiles(
    image: Image, order: int, sigma: float, scale: float
) -> Iterator[tuple[int, int, npt.NDArray[np.float32]]]:
    """Yield the Gaussian derivative of an image (H, W, 3) ≥ 0 in tiles, from top to bottom and then from left to right.

    `order` is 0 to 2, `sigma` in px, above 0; `scale` is a factor that brings all values into the range of float32.
    Yields the first row and column of a tile, and its values (rows, Q) float32, interleaved pixels. A tile may extend
    beyond the right edge of the image. The next tile overwrites the array.
    """
    height, width = image.shape[:2]
    flat: Any = image.reshape(height, -1)
    kernels = [gaussian_kernel(sigma, kernel_order) for kernel_order in range(3)]
    radius = len(kernels[0]) // 2
    weights = np.stack([kernel[radius:] for kernel in kernels]).astype(np.float32)
    tile_count = -(-width // TILE_WIDTH)  # tiles of equal width
    tile_width = -(-width // (tile_count * INTERLEAVED_PIXELS)) * INTERLEAVED_PIXELS
    pitch = 3 * tile_width
    tile_rows = min(TILE_ROWS, -(-height // ROW_GROUP) * ROW_GROUP)
    lines, transposed = np.zeros((ROW_GROUP, ROW_BUFFER), np.float32), _aligned((pitch + 6 * radius + LANES, LANES))
    filtered = _aligned((order + 1, 3 * INTERLEAVED_PIXELS, LANES))
    columns = _aligned((order + 1, pitch // LANES, tile_rows + 2 * radius + ROW_GROUP, LANES))
    out = _aligned((tile_rows, pitch))
    for left in range(0, width, tile_width):
        next_y = 0
        for top in range(0, height, tile_rows):
            next_y = filter_rows(
                flat, scale, top, left, tile_rows, next_y, weights, order, lines, transposed, filtered, columns
            )
            filter_columns(columns, weights, order, tile_rows, out)
            yield top, left, out[: height - top]


def _aligned(shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    spare = _ALIGNMENT // 4
    memory = np.empty(math.prod(shape) + spare, dtype=np.float32)
    start = -memory.ctypes.data // 4 % spare
    return memory[start : start + math.prod(shape)].reshape(shape)
