"""Compiled loops over the pixels of an image, in its own dtype: nothing of an image's size is made.

Sums are float64, or whole numbers where the image is: they do not depend on the dtype. An image is (H, W, 3) uint16,
float32 or float64; `free` is (H, W) bool, True where a pixel may be used, or (0, 0) where every one may be; `border`
leaves out pixels along every edge.

Projections are counted in `BINS` equal bins from 0 to the greatest possible one. What is sought is first bracketed by
bins, then summed and collected in one pass, in which a chunk of projections is found before any of them is judged: both
loops then have no branch, the first is made of vectors, and only the few pixels at either end are looked at one by one.
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


SPAN = 64  # Pixels of a row that are added at a time where none is left out: a few vectors in each of three channels
SPANS_OF_A_SUM = 60_000  # Values of uint16 that a sum of uint32 holds, less those of one more row of 350 000 px
CHUNK = 256  # Pixels whose powers are found at a time, in the nearest cache
BLOCK = 16  # Pixels of float32 whose whole powers are found at a time: three vectors, which become six of float64
MOST_PRODUCTS = 64  # Powers up to which products are used


_BYTES = 4  # Of a float32
_DOUBLES = ir.VectorType(ir.DoubleType(), 8)


@compiled
def mark_clipped(image: Image, saturation: Any, clipped: npt.NDArray[np.uint8]) -> int:
    """Set `clipped` (H, W) uint8 to 1 where a channel of `image` (H, W, 3) reaches `saturation`, and count them.

    `saturation` has the dtype of the image. Whole rows are compared first, which is done by vectors.
    """
    count = 0
    flat = image.reshape(-1)
    length = 3 * image.shape[1]
    for y in range(image.shape[0]):
        row = flat[y * length : (y + 1) * length]
        over = 0
        for at in range(row.size):
            over |= row[at] >= saturation
        if not over:
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
    highs: npt.NDArray[np.uint16],
) -> None:
    """Add the values of a span to sums a place; the loops are such as LLVM makes vectors of."""
    for j in range(3 * SPAN):
        value = span[j]
        sums[j] += uint32(value)
        highs[j] = max(highs[j], value)
    for j in range(3 * SPAN):
        wide = uint32(span[j])
        squares[j] += uint64(uint32(wide * wide))


@compiled
def _count(free: npt.NDArray[np.bool_]) -> int:
    usable = 0
    for x in range(free.size):
        usable += free[x]
    return usable


@compiled
def whole_moments(
    image: npt.NDArray[np.uint16], free: npt.NDArray[np.bool_], border: int
) -> tuple[npt.NDArray[np.uint64], int]:
    """Return (3, 3) uint64, of red, green and blue of an image (H, W, 3): sum, sum of squares, maximum; and the count.

    Exact for images of fewer than 2³² pixels.
    """
    found = np.zeros((3, 3), np.uint64)
    height, width = image.shape[:2]
    flat = image.reshape(-1)
    sums = np.zeros(3 * SPAN, np.uint32)
    squares = np.zeros(3 * SPAN, np.uint64)
    highs = np.zeros(3 * SPAN, np.uint16)
    count, since = 0, 0
    for y in range(border, height - border):
        for left in range(border, width - border, SPAN):
            right = min(width - border, left + SPAN)
            usable = right - left
            if free.size:
                usable = _count(free[y, left:right])
            count += usable
            if usable == SPAN:
                begin = 3 * (y * width + left)
                _add_span(flat[begin : begin + 3 * SPAN], sums, squares, highs)
                since += 1
                continue
            for x in range(left, right):
                if not free.size or free[y, x]:
                    for channel in range(3):
                        value = uint64(image[y, x, channel])
                        found[0, channel] += value
                        found[1, channel] += value * value
                        found[2, channel] = max(found[2, channel], value)
        if since >= SPANS_OF_A_SUM or y == height - border - 1:
            for j in range(sums.size):
                found[0, j % 3] += uint64(sums[j])
                sums[j] = 0
            since = 0
    for j in range(sums.size):
        found[1, j % 3] += squares[j]
        found[2, j % 3] = max(found[2, j % 3], uint64(highs[j]))
    return found, count


@compiled
def float_moments(
    image: npt.NDArray[np.float32] | npt.NDArray[np.float64], free: npt.NDArray[np.bool_], border: int, scale: float
) -> tuple[npt.NDArray[np.float64], int]:
    """Return (3, 3) float64, of red, green and blue times `scale`: sum, sum of squares, maximum; and the count.

    The image is (H, W, 3). Rows are summed apart, which keeps twelve digits in an image of any size.
    """
    found = np.zeros((3, 3), np.float64)
    height, width = image.shape[:2]
    count = 0
    for y in range(border, height - border):
        row = np.zeros((3, 3), np.float64)
        for x in range(border, width - border):
            if free.size and not free[y, x]:
                continue
            for channel in range(3):
                value = image[y, x, channel] * scale
                row[0, channel] += value
                row[1, channel] += value * value
                row[2, channel] = max(row[2, channel], value)
            count += 1
        for channel in range(3):
            found[0, channel] += row[0, channel]
            found[1, channel] += row[1, channel]
            found[2, channel] = max(found[2, channel], row[2, channel])
    return found, count


@compiled
def _raise(factors: npt.NDArray[np.float64], powers: npt.NDArray[np.float64], length: int, p: float) -> None:
    """Write the powers p of the first numbers of `factors`, which are lost; whole powers by products of vectors."""
    left = int(p) if p <= MOST_PRODUCTS else 0
    if left != p:
        for j in range(length):
            powers[j] = factors[j] ** p
        return
    for j in range(length):
        powers[j] = 1.0
    while left:
        if left & 1:
            for j in range(length):
                powers[j] *= factors[j]
        left >>= 1
        if left:
            for j in range(length):
                factors[j] *= factors[j]


@step(ADDRESS, ADDRESS, "float64", ADDRESS, ADDRESS, ADDRESS)
def _add_powers(
    builder: Builder, source: Value, blocks: Value, scale: Value, p: Value, bits: Value, sums: Value
) -> None:
    """Add to 48 float64 at `sums` the powers `p` of `blocks` times 48 float32 from `source` on, times `scale`.

    `p` is whole and of `bits` bits. Factors, powers and sums stay in registers.
    """
    from numba.core import cgutils

    one, places = ir.Constant(I64, 1), range(6)
    halves = [constant(ir.VectorType(I32, 8), range(first, first + 8)) for first in (0, 8)]

    def slot_of(value: Any) -> Any:
        slot = cgutils.alloca_once(builder, _DOUBLES)
        builder.store(value, slot)
        return slot

    def multiply(slots: list[Any], by: list[Any]) -> None:
        for slot, other in zip(slots, by, strict=True):
            builder.store(builder.fmul(builder.load(slot), builder.load(other)), slot)

    totals = [slot_of(load(builder, sums, LINE * at, _DOUBLES)) for at in places]
    factor = broadcast(builder, scale, _DOUBLES)
    with cgutils.for_range(builder, blocks) as loop:
        start = builder.add(source, builder.mul(loop.index, ir.Constant(I64, 3 * LINE)))
        vectors = [load(builder, start, LINE * at, FLOATS) for at in range(3)]
        parts = [builder.shuffle_vector(vectors[at // 2], vectors[at // 2], halves[at % 2]) for at in places]
        factors = [slot_of(builder.fmul(builder.fpext(part, _DOUBLES), factor)) for part in parts]
        powers = [slot_of(ir.Constant(_DOUBLES, [1.0] * 8)) for _ in places]
        with cgutils.for_range(builder, bits) as bit:
            wanted = builder.and_(builder.lshr(p, bit.index), one)
            with builder.if_then(builder.icmp_unsigned("!=", wanted, ir.Constant(I64, 0))):
                multiply(powers, factors)
            with builder.if_then(builder.icmp_unsigned("<", builder.add(bit.index, one), bits)):
                multiply(factors, factors)
        for total, power in zip(totals, powers, strict=True):
            builder.store(builder.fadd(builder.load(total), builder.load(power)), total)
    for at, total in enumerate(totals):
        store(builder, builder.load(total), sums, LINE * at)


@compiled
def sum_powers(
    values: Image,
    free: npt.NDArray[np.bool_],
    border: int,
    top: int,
    first: int,
    height: int,
    width: int,
    p: float,
    scale: float,
    sums: npt.NDArray[np.float64],
) -> None:
    """Add to `sums` (3,) float64 the powers p of the values times `scale` of some rows of an image.

    `values`: (rows, Q) uint16, float32 or float64, not below 0: rows of interleaved pixels, or parts of them. What lies
    beyond the image does not count. `free`: (H, W) or (0, 0) bool, see above; that of the whole image. `height`,
    `width`: of the image, px. `sums`: (3,) float64.
    """
    factors = np.empty(3 * CHUNK, np.float64)
    powers = np.empty(3 * CHUNK, np.float64)
    found = np.zeros(3 * CHUNK, np.float64)
    whole = int(p) if 1 < p <= MOST_PRODUCTS and values.itemsize == _BYTES else 0
    bits = 0
    while whole == p and whole >> bits:
        bits += 1
    right = min(width - border, first + values.shape[1] // 3)
    for row in range(values.shape[0]):
        y = top + row
        if y < border or y >= height - border:
            continue
        for left in range(max(border, first), right, CHUNK):
            length = min(CHUNK, right - left)
            span = values[row, 3 * (left - first) : 3 * (left - first + length)]
            usable = length
            if free.size:
                usable = _count(free[y, left : left + length])
            if p == 1 and usable == length:
                for j in range(span.size):
                    found[j] += span[j] * scale
                continue
            if bits and usable == length:
                blocks = length // BLOCK
                _add_powers(span.ctypes.data, blocks, scale, whole, bits, found.ctypes.data)
                span = span[3 * BLOCK * blocks :]
            for j in range(span.size):
                factors[j] = span[j] * scale
            if usable < length:
                for x in range(length):
                    if not free[y, left + x]:
                        factors[3 * x : 3 * x + 3] = 0.0
            if np.isinf(p):
                for j in range(span.size):
                    found[j] = max(found[j], factors[j])
                continue
            _raise(factors, powers, span.size, p)
            for j in range(span.size):
                found[j] += powers[j]
    for j in range(found.size):
        if np.isinf(p):
            sums[j % 3] = max(sums[j % 3], found[j])
        else:
            sums[j % 3] += found[j]


BINS = 4096  # Of the histogram of projections: one that holds a limit has some thousand pixels of 18 million
# Pixels by which the counted ones move on from row to row: no column is preferred where every 16th pixel counts.
_STRIDE = 5


@compiled
def count_projections(
    image: Image, free: npt.NDArray[np.bool_], direction: npt.NDArray[np.float64], step: float, every: int
) -> npt.NDArray[np.int64]:
    """Return (BINS,) int64, the histogram of the projections of every so manieth pixel on a direction (3,) float64.

    `step` is bins a unit of projection.
    """
    counts = np.zeros(BINS, np.int64)
    for y in range(image.shape[0]):
        for x in range(_STRIDE * y % every, image.shape[1], every):
            if free.size and not free[y, x]:
                continue
            along = image[y, x, 0] * direction[0] + image[y, x, 1] * direction[1] + image[y, x, 2] * direction[2]
            counts[min(BINS - 1, int(along * step))] += 1
    return counts


@compiled
def sum_outer_bins(
    image: Image,
    free: npt.NDArray[np.bool_],
    direction: npt.NDArray[np.float64],
    step: float,
    brackets: npt.NDArray[np.int64],
    bordering: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], int, int, int]:
    """Sum and count the pixels of bins outside of two brackets, and collect those of bins within.

    `image`, `free`: (H, W, 3) uint16, float32 or float64; (H, W) or (0, 0) bool, see above. `direction`, `step`: (3,)
    float64, and bins a unit of projection; as for `count_projections`. `brackets`: (4,) int64: the first and the last
    bin of the lower bracket, then of the upper one; they may overlap. `bordering`: (N, 4) float64, written: red, green,
    blue and the projection of pixels of the brackets, in reading order. Returns (3, 3) float64, the sum of x xᵀ over
    the pixels below the lower bracket and above the upper one; how many these are below and above; how many lie within
    the brackets, of which the first N are written.
    """
    total = np.zeros((3, 3), np.float64)
    bins, kept = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    first, low, high, last = brackets
    below, above, inside = 0, 0, 0
    width = image.shape[1]
    flat = image.reshape(-1)
    for y in range(image.shape[0]):
        a, b, c, ab, ac, bc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for left in range(0, width, CHUNK):
            length = min(CHUNK, width - left)
            row = flat[3 * (y * width + left) : 3 * (y * width + left + length)]
            for j in range(length):
                along = row[3 * j] * direction[0] + row[3 * j + 1] * direction[1] + row[3 * j + 2] * direction[2]
                bins[j] = min(BINS - 1, np.int32(along * step))
            found = 0
            for j in range(length):
                kept[found] = j
                found += (bins[j] <= low) | (bins[j] >= high)
            for at in range(found):
                j = kept[at]
                if free.size and not free[y, left + j]:
                    continue
                red, green, blue = np.float64(row[3 * j]), np.float64(row[3 * j + 1]), np.float64(row[3 * j + 2])
                if first <= bins[j] <= last:
                    if inside < bordering.shape[0]:
                        bordering[inside, 0] = red
                        bordering[inside, 1] = green
                        bordering[inside, 2] = blue
                        bordering[inside, 3] = red * direction[0] + green * direction[1] + blue * direction[2]
                    inside += 1
                    continue
                a += red * red
                b += green * green
                c += blue * blue
                ab += red * green
                ac += red * blue
                bc += green * blue
                if bins[j] < first:
                    below += 1
                else:
                    above += 1
        total += np.array([[a, ab, ac], [ab, b, bc], [ac, bc, c]])
    return total, below, above, inside
