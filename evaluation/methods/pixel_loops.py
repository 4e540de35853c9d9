"""Compiled loops over the pixels of an image. They need no further arrays of the size of the image.

An image is (H, W, 3) uint16, float32 or float64. `usable` is (H, W) bool, True for pixels that may be used, or (0, 0)
if all may be used. `border` is the number of excluded pixels along every edge of the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numpy import uint32, uint64

from foundation.compiled import compiled
from generator.kernels.vector import (
    ADDRESS,
    FLOATS,
    I32,
    I64,
    LINE,
    Builder,
    Value,
    broadcast,
    constant,
    load,
    step,
    store,
)

if TYPE_CHECKING:
    from evaluation.scene import Image


SPAN = 64  # pixels of a row that are added with vector instructions, if all of them are usable
# Number of spans after which the 32-bit sums are added to the result and reset. The sums can hold 65 537
# spans. The number is checked only at the end of a row, so the difference must be larger than the spans of a row.
LARGEST_SPAN_COUNT = 60_000
CHUNK = 256  # pixels that are processed together; they fit into the first-level cache
BLOCK = 16  # pixels per step of `_add_powers`: three vectors of float32, converted to six of float64
LARGEST_PRODUCT_POWER = 64  # whole-number powers up to this one are computed by multiplications


_FLOAT_BYTES = 4  # size of a float32
_DOUBLES = ir.VectorType(ir.DoubleType(), 8)


@compiled
def mark_clipped(image: Image, saturation: Any, clipped: npt.NDArray[np.uint8]) -> int:
    """Set `clipped` (H, W) uint8 to 1 if a channel of a pixel reaches `saturation`, and return the number of pixels.

    `saturation` has the dtype of the image.
    """
    # Whole rows are checked first, because LLVM uses vector instructions for that loop.
    count = 0
    flat = image.reshape(-1)
    length = 3 * image.shape[1]
    for y in range(image.shape[0]):
        row = flat[y * length : (y + 1) * length]
        is_clipped = 0
        for i in range(row.size):
            is_clipped |= row[i] >= saturation
        if not is_clipped:
            continue
        for x in range(image.shape[1]):
            if image[y, x, 0] >= saturation or image[y, x, 1] >= saturation or image[y, x, 2] >= saturation:
                clipped[y, x] = 1
                count += 1
    return count


@compiled
def _add_span(
    span: npt.NDArray[np.uint16],
    sums: npt.NDArray[np.uint32],
    squares: npt.NDArray[np.uint64],
    maxima: npt.NDArray[np.uint16],
) -> None:
    # LLVM uses vector instructions for loops of this form.
    for j in range(3 * SPAN):
        value = span[j]
        sums[j] += uint32(value)
        maxima[j] = max(maxima[j], value)
    for j in range(3 * SPAN):
        wide = uint32(span[j])
        squares[j] += uint64(uint32(wide * wide))


@compiled
def _count_usable(usable: npt.NDArray[np.bool_]) -> int:
    usable_count = 0
    for x in range(usable.size):
        usable_count += usable[x]
    return usable_count


@compiled
def integer_moments(
    image: npt.NDArray[np.uint16], usable: npt.NDArray[np.bool_], border: int
) -> tuple[npt.NDArray[np.uint64], int]:
    """Return sum, sum of squares and maximum of each channel, (3, 3) uint64, and the number of usable pixels.

    Exact for images of fewer than 2³² pixels.
    """
    moments = np.zeros((3, 3), np.uint64)
    height, width = image.shape[:2]
    flat = image.reshape(-1)
    sums = np.zeros(3 * SPAN, np.uint32)
    squares = np.zeros(3 * SPAN, np.uint64)
    maxima = np.zeros(3 * SPAN, np.uint16)
    count, span_count = 0, 0
    for y in range(border, height - border):
        for left in range(border, width - border, SPAN):
            right = min(width - border, left + SPAN)
            usable_count = right - left
            if usable.size:
                usable_count = _count_usable(usable[y, left:right])
            count += usable_count
            if usable_count == SPAN:
                begin = 3 * (y * width + left)
                _add_span(flat[begin : begin + 3 * SPAN], sums, squares, maxima)
                span_count += 1
                continue
            for x in range(left, right):
                if not usable.size or usable[y, x]:
                    for channel in range(3):
                        value = uint64(image[y, x, channel])
                        moments[0, channel] += value
                        moments[1, channel] += value * value
                        moments[2, channel] = max(moments[2, channel], value)
        if span_count >= LARGEST_SPAN_COUNT or y == height - border - 1:
            for j in range(sums.size):
                moments[0, j % 3] += uint64(sums[j])
                sums[j] = 0
            span_count = 0
    for j in range(sums.size):
        moments[1, j % 3] += squares[j]
        moments[2, j % 3] = max(moments[2, j % 3], uint64(maxima[j]))
    return moments, count


@compiled
def float_moments(
    image: npt.NDArray[np.float32] | npt.NDArray[np.float64], usable: npt.NDArray[np.bool_], border: int, scale: float
) -> tuple[npt.NDArray[np.float64], int]:
    """Return sum, sum of squares and maximum of each channel times `scale`, (3, 3) float64, and the pixel count."""
    # Each row has its own sums, so that rounding errors stay small in large images.
    moments = np.zeros((3, 3), np.float64)
    height, width = image.shape[:2]
    count = 0
    for y in range(border, height - border):
        row = np.zeros((3, 3), np.float64)
        for x in range(border, width - border):
            if usable.size and not usable[y, x]:
                continue
            for channel in range(3):
                value = image[y, x, channel] * scale
                row[0, channel] += value
                row[1, channel] += value * value
                row[2, channel] = max(row[2, channel], value)
            count += 1
        for channel in range(3):
            moments[0, channel] += row[0, channel]
            moments[1, channel] += row[1, channel]
            moments[2, channel] = max(moments[2, channel], row[2, channel])
    return moments, count


@compiled
def _raise_to_power(factors: npt.NDArray[np.float64], powers: npt.NDArray[np.float64], length: int, p: float) -> None:
    # Whole-number powers are calculated by repeated squaring. `factors` is overwritten.
    exponent = int(p) if p <= LARGEST_PRODUCT_POWER else 0
    if exponent != p:
        for j in range(length):
            powers[j] = factors[j] ** p
        return
    for j in range(length):
        powers[j] = 1.0
    while exponent:
        if exponent & 1:
            for j in range(length):
                powers[j] *= factors[j]
        exponent >>= 1
        if exponent:
            for j in range(length):
                factors[j] *= factors[j]


@step(ADDRESS, ADDRESS, "float64", ADDRESS, ADDRESS, ADDRESS)
def _add_powers(
    builder: Builder, source: Value, blocks: Value, scale: Value, p: Value, bits: Value, sums: Value
) -> None:
    # Adds powers of scaled float32 values to the 48 float64 at `sums`. `p` is a whole number with `bits` bits. Factors,
    # powers and sums stay in registers.
    from numba.core import cgutils

    one_bit, positions = ir.Constant(I64, 1), range(6)
    halves = [constant(ir.VectorType(I32, 8), range(first, first + 8)) for first in (0, 8)]

    def slot_of(value: Any) -> Any:
        slot = cgutils.alloca_once(builder, _DOUBLES)
        builder.store(value, slot)
        return slot

    def multiply(slots: list[Any], multipliers: list[Any]) -> None:
        for slot, multiplier in zip(slots, multipliers, strict=True):
            builder.store(builder.fmul(builder.load(slot), builder.load(multiplier)), slot)

    totals = [slot_of(load(builder, sums, LINE * i, _DOUBLES)) for i in positions]
    factor = broadcast(builder, scale, _DOUBLES)
    with cgutils.for_range(builder, blocks) as loop:
        start = builder.add(source, builder.mul(loop.index, ir.Constant(I64, 3 * LINE)))
        vectors = [load(builder, start, LINE * i, FLOATS) for i in range(3)]
        half_vectors = [builder.shuffle_vector(vectors[i // 2], vectors[i // 2], halves[i % 2]) for i in positions]
        factors = [slot_of(builder.fmul(builder.fpext(half_vector, _DOUBLES), factor)) for half_vector in half_vectors]
        powers = [slot_of(ir.Constant(_DOUBLES, [1.0] * 8)) for _ in positions]
        with cgutils.for_range(builder, bits) as bit:
            is_set = builder.and_(builder.lshr(p, bit.index), one_bit)
            with builder.if_then(builder.icmp_unsigned("!=", is_set, ir.Constant(I64, 0))):
                multiply(powers, factors)
            with builder.if_then(builder.icmp_unsigned("<", builder.add(bit.index, one_bit), bits)):
                multiply(factors, factors)
        for total, power in zip(totals, powers, strict=True):
            builder.store(builder.fadd(builder.load(total), builder.load(power)), total)
    for i, total in enumerate(totals):
        store(builder, builder.load(total), sums, LINE * i)


@compiled
def sum_powers(
    values: Image,
    usable: npt.NDArray[np.bool_],
    border: int,
    top: int,
    first: int,
    height: int,
    width: int,
    p: float,
    scale: float,
    sums: npt.NDArray[np.float64],
) -> None:
    """Scale values of a part of an image, raise them to the power `p`, and add them to `sums` (3,) float64.

    If `p` is infinite, `sums` becomes the maximum instead. `values`: (rows, Q) uint16, float32 or float64 ≥ 0, rows of
    interleaved pixels; the first pixel is in row `top` and column `first` of the image. Values outside the image are
    ignored. `height`, `width` and `usable` belong to the whole image.
    """
    factors = np.empty(3 * CHUNK, np.float64)
    powers = np.empty(3 * CHUNK, np.float64)
    sums_by_position = np.zeros(3 * CHUNK, np.float64)
    whole_power = int(p) if 1 < p <= LARGEST_PRODUCT_POWER and values.itemsize == _FLOAT_BYTES else 0
    bits = 0
    while whole_power == p and whole_power >> bits:
        bits += 1
    right = min(width - border, first + values.shape[1] // 3)
    for row in range(values.shape[0]):
        y = top + row
        if y < border or y >= height - border:
            continue
        for left in range(max(border, first), right, CHUNK):
            length = min(CHUNK, right - left)
            span = values[row, 3 * (left - first) : 3 * (left - first + length)]
            usable_count = length
            if usable.size:
                usable_count = _count_usable(usable[y, left : left + length])
            if p == 1 and usable_count == length:
                for j in range(span.size):
                    sums_by_position[j] += span[j] * scale
                continue
            if bits and usable_count == length:
                blocks = length // BLOCK
                _add_powers(span.ctypes.data, blocks, scale, whole_power, bits, sums_by_position.ctypes.data)
                span = span[3 * BLOCK * blocks :]
            for j in range(span.size):
                factors[j] = span[j] * scale
            if usable_count < length:
                for x in range(length):
                    if not usable[y, left + x]:
                        factors[3 * x : 3 * x + 3] = 0.0
            if np.isinf(p):
                for j in range(span.size):
                    sums_by_position[j] = max(sums_by_position[j], factors[j])
                continue
            _raise_to_power(factors, powers, span.size, p)
            for j in range(span.size):
                sums_by_position[j] += powers[j]
    for j in range(sums_by_position.size):
        if np.isinf(p):
            sums[j % 3] = max(sums[j % 3], sums_by_position[j])
        else:
            sums[j % 3] += sums_by_position[j]


# Number of equal bins of projections, from 0 to the largest possible projection. In an image of 18 megapixels, the bins
# that `pca` sorts have a few thousand pixels.
BINS = 4096
# The first counted pixel moves by this number of columns from row to row, so that all columns are counted.
_ROW_SHIFT = 5


@compiled
def count_projections(
    image: Image, usable: npt.NDArray[np.bool_], direction: npt.NDArray[np.float64], step: float, interval: int
) -> npt.NDArray[np.int64]:
    """Return the histogram (BINS,) int64 of projections on a direction (3,) float64, for every `interval`-th pixel.

    `step` is the number of bins per unit of projection.
    """
    counts = np.zeros(BINS, np.int64)
    for y in range(image.shape[0]):
        for x in range(_ROW_SHIFT * y % interval, image.shape[1], interval):
            if usable.size and not usable[y, x]:
                continue
            projection = image[y, x, 0] * direction[0] + image[y, x, 1] * direction[1] + image[y, x, 2] * direction[2]
            counts[min(BINS - 1, int(projection * step))] += 1
    return counts


@compiled
def sum_outer_bins(
    image: Image,
    usable: npt.NDArray[np.bool_],
    direction: npt.NDArray[np.float64],
    step: float,
    brackets: npt.NDArray[np.int64],
    collected: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], int, int, int]:
    """Sum the pixels below a lower and above an upper bracket, and collect the pixels inside the brackets.

    A bracket is a range of bins of `count_projections`. `brackets`: (4,) int64, first and last bin of the lower
    bracket, first and last bin of the upper bracket; brackets may overlap. `collected`: (N, 4) float64, receives red,
    green, blue and the projection of up to N pixels inside, in reading order. Returns the sum of x xᵀ (3, 3) float64
    over the pixels below the lower and above the upper bracket, and the numbers of pixels below, above and inside.
    """
    # All projections of a chunk are computed before they are compared. Without branches, both loops are fast. Only the
    # few pixels in the outer bins are processed one by one.
    total = np.zeros((3, 3), np.float64)
    bins, kept_positions = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    first, low, high, last = brackets
    below_count, above_count, inside_count = 0, 0, 0
    width = image.shape[1]
    flat = image.reshape(-1)
    for y in range(image.shape[0]):
        a, b, c, ab, ac, bc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for left in range(0, width, CHUNK):
            length = min(CHUNK, width - left)
            row = flat[3 * (y * width + left) : 3 * (y * width + left + length)]
            for j in range(length):
                projection = row[3 * j] * direction[0] + row[3 * j + 1] * direction[1] + row[3 * j + 2] * direction[2]
                bins[j] = min(BINS - 1, np.int32(projection * step))
            kept_count = 0
            for j in range(length):
                kept_positions[kept_count] = j
                kept_count += (bins[j] <= low) | (bins[j] >= high)
            for i in range(kept_count):
                j = kept_positions[i]
                if usable.size and not usable[y, left + j]:
                    continue
                red, green, blue = np.float64(row[3 * j]), np.float64(row[3 * j + 1]), np.float64(row[3 * j + 2])
                if first <= bins[j] <= last:
                    if inside_count < collected.shape[0]:
                        collected[inside_count, 0] = red
                        collected[inside_count, 1] = green
                        collected[inside_count, 2] = blue
                        collected[inside_count, 3] = red * direction[0] + green * direction[1] + blue * direction[2]
                    inside_count += 1
                    continue
                a += red * red
                b += green * green
                c += blue * blue
                ab += red * green
                ac += red * blue
                bc += green * blue
                if bins[j] < first:
                    below_count += 1
                else:
                    above_count += 1
        total += np.array([[a, ab, ac], [ab, b, bc], [ac, bc, c]])
    return total, below_count, above_count, inside_count
