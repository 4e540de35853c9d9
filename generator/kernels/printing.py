"""Draw images by colour: each pixel is the interpolated mean of the print plus recorded noise.

The print under an illuminant is described at nodes. A node is a colour with one of 17 codes in each channel: 0, 16 …
240, 255. Each node has the counts m that the camera records of this colour on the chart, and a nearest patch
(`generator.rendering.colorimetric`). The rule is part of the data set format. A pixel with codes v becomes ::

    m(v) + k σ(v) (x - b)

- m(v) is interpolated between four nodes, the corners of a tetrahedron around v (J. M. Kasson et al., "Performing color
  space conversions with three-dimensional linear interpolation", Journal of Electronic Imaging 4, 1995). Codes are
  decoded first: v lies at (lin v - lin v₀) / (lin v₁ - lin v₀) between nodes v₀ and v₁, where lin decodes sRGB. Greys
  are interpolated between greys only.
- x is a sample of the patch of the nearest node, chosen as in `kernels/choice.py`. If two nodes are equally near, the
  one with the higher code is used. b is the mean of all samples of the patch, so x - b is a recorded deviation.
- k σ(v) scales the deviation to the noise of the LUT at m(v). σ is the total noise of the three channels by the
  photon-transfer curve, interpolated like m. The nearest node has a factor k = s / (d σ) for each channel. s is the
  noise of this channel by the curve, and d is the standard deviation of the 25 samples of the patch.

Images are rounded down to whole counts after adding a random number u, 0 ≤ u < 1, to each channel. The samples of a
patch are whole counts, so rounding to the nearest count would move all deviations of a flat area in the same direction.
With u, the mean over many pixels is exact. u is ⌊h/2²¹⌋, ⌊h/2¹¹⌋ or ⌊h/2⌋ mod 2¹⁰, divided by 2¹⁰, for red, green and
blue. h is the word of `kernels/choice.py` with i = x and the keys of the purpose `philox.ROUNDING`, stream 0. Crops are
not rounded.

If several illuminants are mixed, each has its own samples, chosen independently (stream i of `choice.row_keys` for the
i-th). Each deviation is multiplied by the square root of the weight, as in `kernels/mixing.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numpy import uint32

from foundation.colorimetry import decode_srgb
from foundation.compiled import compiled, inlined
from generator.kernels.choice import (
    check_out,
    check_picture,
    check_seed,
    choose_for_colours,
    copied_back,
    emit_prefetch,
    hashed,
    packed_rows,
    prefetch,
    readable,
    row_keys,
    run_in_threads,
    writable,
)
from generator.kernels.vector import (
    ADDRESS,
    F32,
    FLOATS,
    GROUP,
    I8,
    I16,
    I32,
    I64,
    LANES,
    LINE,
    SAMPLE_BYTES,
    WORDS,
    Builder,
    Value,
    broadcast,
    concatenated,
    constant,
    load,
    minimum,
    pixel_codes,
    step,
    store,
)
from generator.philox import ROUNDING

SIDE: Final = 17  # Nodes per channel

NODES: Final = SIDE**3  # Nodes of all colours

NODE_CODES: Final = (*range(0, 256, 16), 255)  # sRGB codes of the nodes of a channel

# Differences between the indices of nodes that are neighbours in one channel, and in all three.
_RED, _GREEN, _BLUE = np.int32(SIDE * SIDE), np.int32(SIDE), np.int32(1)
_ALL = np.int32(SIDE * SIDE + SIDE + 1)
_HALF = np.int32(8)  # Half the distance between nodes, codes
_ROUNDING_PURPOSE: Final = np.uint32(ROUNDING)


@dataclass(frozen=True, eq=False)
class PrintedLight:
    """The print under one illuminant, which may be a mixture of C illuminants of the LUT; for compiled code.

    - `means`: (4913, 4) float32: m in red, green and blue, and σ; counts.
    - `bases`: (C, 4913, 2, 4) float32: for each illuminant of the LUT, b in red, green and blue, counts, and k. The
      fourth value of b and k is 0.
    - `lights`: (C,) int64, indices of these illuminants.
    - `roots`: (C,) float32, square roots of their weights.

    Arrays are C-contiguous.
    """

    means: npt.NDArray[np.float32]
    bases: npt.NDArray[np.float32]
    lights: npt.NDArray[np.int64]
    roots: npt.NDArray[np.float32]


@lru_cache(maxsize=1)
def _node_fractions() -> npt.NDArray[np.float32]:
    # Position of each code between its lower and its upper node, 0 … 1, linear in light.
    codes = np.arange(256)
    low = np.minimum(codes // 16, SIDE - 2)
    linear, nodes = decode_srgb(codes / 255), decode_srgb(np.array(NODE_CODES) / 255)
    return ((linear - nodes[low]) / (nodes[low + 1] - nodes[low])).astype(np.float32)


@compiled
def _count_nearest(picture: Any, counts: Any) -> None:
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            red, green, blue = picture[y, x, 0] + 8 >> 4, picture[y, x, 1] + 8 >> 4, picture[y, x, 2] + 8 >> 4
            counts[red * _RED + green * _GREEN + blue] += 1


def count_by_node(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Return the number of pixels of a picture (H, W, 3) uint8 nearest to each node, (4913,) int64."""
    check_picture(picture)
    counts = np.zeros(NODES, np.int64)
    _count_nearest(picture, counts)
    return counts


@compiled
def means_at(
    samples: Any, corners: Any, weights: Any, nearest: Any, cells: Any, means: Any, bases: Any, spreads: Any
) -> None:
    """Calculate the mean counts of nodes under an illuminant.

    `samples` (N, S, 3) uint16; `cells` (U,) are the patches that the K nodes use. `corners` (K, 8) and `nearest` (K,)
    are indices into `cells`, and `weights` (K, 8) are the weights of the corners. Three arrays (K, 3) float64 are
    filled: `means` of the nodes, and mean (`bases`) and variance (`spreads`) of the samples of the nearest patch.
    """
    count = samples.shape[1]
    cell_means = np.empty((len(cells), 3))
    for number in range(len(cells)):
        red = green = blue = 0
        for i in range(count):
            red += samples[cells[number], i, 0]
            green += samples[cells[number], i, 1]
            blue += samples[cells[number], i, 2]
        cell_means[number, 0], cell_means[number, 1], cell_means[number, 2] = red / count, green / count, blue / count
    for node in range(len(nearest)):
        for channel in range(3):
            total = 0.0
            for corner in range(8):
                total += weights[node, corner] * cell_means[corners[node, corner], channel]
            means[node, channel] = total
            mean, total = cell_means[nearest[node], channel], 0.0
            for i in range(count):
                total += (samples[cells[nearest[node]], i, channel] - mean) ** 2
            bases[node, channel], spreads[node, channel] = mean, total / count


_FOUR: Final = ir.VectorType(F32, 4)
PRINTED_BLOCK: Final = LANES  # Pixels of a block, which are planned and interpolated together
# The plan of a block has eight rows of 16 numbers, one per pixel: byte offsets of three nodes, weights of four nodes,
# and 4 times the index of the nearest node. The fourth node needs no row: it is the next one after the first in all
# channels.
_PLAN_ROWS: Final = 8
_ROW: Final = 4 * PRINTED_BLOCK  # Bytes of a row of the plan: one 32-bit number per pixel
_PLAN_BYTES: Final = _ROW * _PLAN_ROWS
_LINE_BYTES: Final = 16 * PRINTED_BLOCK  # Bytes of the pixels of a block: red, green, blue and noise, float32
# Blocks per segment. A segment is planned, and its samples are prefetched, before the previous segment is interpolated.
_SEGMENT: Final = 8
_ROWS_AHEAD: Final = 2  # The picture is prefetched this many rows before it is planned
# Largest number of groups (32 pixels whose samples are chosen together) that overlap a segment.
_SEGMENT_GROUPS: Final = _SEGMENT * PRINTED_BLOCK // GROUP + 2


@step(ADDRESS, ADDRESS, ADDRESS)
def plan_block(builder: Builder, picture: Value, fractions: Value, target: Value) -> None:
    """Write the plan of a block to `target`; 48 bytes at `picture` and 256 float32 at `fractions` are read."""

    def filled(value: int) -> Value:
        return constant(WORDS, value)

    codes = pixel_codes(builder, picture)
    channels = [builder.and_(builder.lshr(codes, filled(shift)), filled(255)) for shift in (16, 8, 0)]
    pixel_fractions: list[Value] = []
    for channel in range(3):
        vector: Value = ir.Constant(FLOATS, ir.Undefined)
        for pixel in range(PRINTED_BLOCK):
            code = builder.zext(load(builder, picture, 3 * pixel + channel, I8), I64)
            fraction = load(builder, builder.add(fractions, builder.shl(code, ir.Constant(I64, 2))), 0, F32)
            vector = builder.insert_element(vector, fraction, ir.Constant(I32, pixel))
        pixel_fractions.append(vector)
    red, green, blue = pixel_fractions
    strides = [filled(16 * int(stride)) for stride in (_RED, _GREEN, _BLUE)]

    def node(offset: int, scale: int) -> Value:
        # `scale`, a power of two, times the index of the node at (codes + offset) / 16; shifts are fast.
        red, green, blue = (builder.lshr(builder.add(codes, filled(offset)), filled(4)) for codes in channels)
        index = red
        for codes in (green, blue):
            index = builder.add(builder.add(builder.shl(index, filled(4)), index), codes)
        return builder.shl(index, filled(scale.bit_length() - 1))

    def at_least(first: Value, second: Value) -> Value:
        return builder.fcmp_ordered(">=", first, second)

    def smaller(first: Value, second: Value) -> Value:
        return builder.select(builder.fcmp_ordered("<", first, second), first, second)

    def larger(first: Value, second: Value) -> Value:
        return builder.select(builder.fcmp_ordered(">", first, second), first, second)

    # Whether red ≥ green, red ≥ blue and green ≥ blue.
    red_green, red_blue, green_blue = (at_least(*two) for two in ((red, green), (red, blue), (green, blue)))
    blue_least = builder.and_(red_blue, green_blue)
    high = builder.select(green_blue, strides[1], strides[2])
    high = builder.select(builder.and_(red_green, red_blue), strides[0], high)
    low = builder.select(blue_least, strides[2], builder.select(red_green, strides[1], strides[0]))
    upper, lower = larger(red, green), smaller(red, green)
    middle = smaller(upper, larger(lower, blue))
    upper, lower = larger(upper, blue), smaller(lower, blue)
    base = node(0, 16)
    nodes = base, builder.add(base, high), builder.sub(builder.add(base, filled(16 * int(_ALL))), low)
    ones = ir.Constant(FLOATS, [1.0] * LANES)
    weights = builder.fsub(ones, upper), builder.fsub(upper, middle), builder.fsub(middle, lower), lower
    for row, offsets in enumerate(nodes):
        store(builder, offsets, target, _ROW * row)
    for row, row_weights in enumerate(weights):
        store(builder, row_weights, target, _ROW * (3 + row))
    store(builder, node(int(_HALF), 4), target, _ROW * 7)


@step(*[ADDRESS] * 5)
def place_samples(builder: Builder, plan: Value, cells: Value, choices: Value, samples: Value, target: Value) -> None:
    """Write the byte offsets (uint32) of the chosen samples of a block to `target`, and prefetch the samples.

    `cells` is the address of one uint32 per node, the offset of its first sample in `samples`. `choices` is the address
    of one uint32 per pixel, which is added to that offset.
    """
    for pixel in range(PRINTED_BLOCK):
        nearest_offset = load(builder, plan, _ROW * 7 + 4 * pixel, I32)
        first = load(builder, builder.add(cells, builder.zext(nearest_offset, I64)), 0, I32)
        address = builder.add(first, load(builder, choices, 4 * pixel, I32))
        store(builder, address, target, 4 * pixel)
        emit_prefetch(builder, builder.add(samples, builder.zext(address, I64)), 3)


def _load_pixels(builder: Builder, base: Value, offsets: Sequence[Value], shift: int, value_type: Any) -> Value:
    return concatenated(builder, [load(builder, builder.add(base, offset), shift, value_type) for offset in offsets])


def _load_offsets(builder: Builder, address: Value, position: int) -> list[Value]:
    # Four offsets, stored as uint32; each 64-bit load gives two of them.
    low, half = ir.Constant(I64, 0xFFFFFFFF), ir.Constant(I64, 32)
    pairs = [load(builder, address, position + shift, I64) for shift in (0, 8)]
    return [number for pair in pairs for number in (builder.and_(pair, low), builder.lshr(pair, half))]


def _repeated_four_times(builder: Builder, address: Value, position: int) -> Value:
    numbers = load(builder, address, position, _FOUR)
    return builder.shuffle_vector(numbers, numbers, constant(WORDS, [lane // 4 for lane in range(LANES)]))


def _interpolated(builder: Builder, plan: Value, means: Value, first_pixel: int) -> Value:
    # Returns red, green, blue and noise of four pixels, each interpolated between the four nodes of the pixel.
    total: Value = None
    corners = [_load_offsets(builder, plan, _ROW * row + 4 * first_pixel) for row in range(3)]
    for corner, offsets in enumerate((*corners, corners[0])):
        weights = _repeated_four_times(builder, plan, _ROW * (3 + corner) + 4 * first_pixel)
        node_means = _load_pixels(builder, means, offsets, 16 * int(_ALL) * (corner == 3), _FOUR)
        summand = builder.fmul(weights, node_means)
        total = summand if total is None else builder.fadd(total, summand)
    return total


def _with_deviations(builder: Builder, values: Value, first_pixel: int, addresses: Sequence[Value]) -> Value:
    plan, bases, samples, sample_offsets, factors = addresses
    noise = builder.shuffle_vector(values, values, constant(WORDS, [lane | 3 for lane in range(LANES)]))
    node_row = builder.add(plan, ir.Constant(I64, 7 * _ROW))
    node_offsets, pixel_offsets = (_load_offsets(builder, at, 4 * first_pixel) for at in (node_row, sample_offsets))
    node_offsets = [builder.shl(offset, ir.Constant(I64, 3)) for offset in node_offsets]
    cell_mean, spread_factor = (_load_pixels(builder, bases, node_offsets, shift, _FOUR) for shift in (0, 16))
    drawn = builder.zext(_load_pixels(builder, samples, pixel_offsets, 0, ir.VectorType(I16, 4)), WORDS)
    deviation = builder.fsub(builder.sitofp(drawn, FLOATS), cell_mean)
    scale = builder.fmul(spread_factor, builder.fmul(noise, _repeated_four_times(builder, factors, 4 * first_pixel)))
    return builder.fadd(values, builder.fmul(deviation, scale))


@step(*[ADDRESS] * 7)
def draw_block(
    builder: Builder,
    plan: Value,
    bases: Value,
    samples: Value,
    sample_offsets: Value,
    factors: Value,
    means: Value,
    line: Value,
) -> None:
    """Write the pixels of a block to `line`, four float32 each: interpolated means plus deviations.

    A deviation is (sample − b) · k · σ · factor; `factors` is the address of one float32 per pixel. For the fourth
    number, k is 0.
    """
    for first_pixel in range(0, PRINTED_BLOCK, 4):
        values = _interpolated(builder, plan, means, first_pixel)
        values = _with_deviations(builder, values, first_pixel, (plan, bases, samples, sample_offsets, factors))
        store(builder, values, line, 16 * first_pixel)


@step(*[ADDRESS] * 6)
def add_deviations(
    builder: Builder, plan: Value, bases: Value, samples: Value, sample_offsets: Value, factors: Value, line: Value
) -> None:
    """Add the deviations of another illuminant of the LUT to the pixels at `line`, as `draw_block` does."""
    for first_pixel in range(0, PRINTED_BLOCK, 4):
        values = load(builder, line, 16 * first_pixel, FLOATS)
        values = _with_deviations(builder, values, first_pixel, (plan, bases, samples, sample_offsets, factors))
        store(builder, values, line, 16 * first_pixel)


def _write_planes(builder: Builder, line: Value, scales: Value, targets: Sequence[Value], mirrored: bool) -> None:

    def broadcast_value(index: int) -> Value:
        return broadcast(builder, load(builder, scales, 4 * index, F32), FLOATS)

    quarters = [load(builder, line, 64 * quarter, FLOATS) for quarter in range(4)]
    for channel, target in enumerate(targets):
        lanes = [4 * pixel + channel for pixel in range(8)]
        lanes = lanes[::-1] if mirrored else lanes
        eight = ir.VectorType(I32, 8)
        halves = [builder.shuffle_vector(*quarters[i : i + 2], constant(eight, lanes)) for i in (0, 2)]
        channel_values = concatenated(builder, halves[::-1] if mirrored else halves)
        value = builder.fadd(builder.fmul(channel_values, broadcast_value(channel)), broadcast_value(3 + channel))
        store(builder, minimum(builder, value, broadcast_value(6)), target, 0)


@step(*[ADDRESS] * 5)
def write_planes(builder: Builder, line: Value, scales: Value, red: Value, green: Value, blue: Value) -> None:
    """Write a block as float32 to three planes; `scales` is the same as for `vector.planes8`."""
    _write_planes(builder, line, scales, (red, green, blue), mirrored=False)


@step(*[ADDRESS] * 5)
def write_mirrored(builder: Builder, line: Value, scales: Value, red: Value, green: Value, blue: Value) -> None:
    """Write a block as `write_planes` does, but mirrored."""
    _write_planes(builder, line, scales, (red, green, blue), mirrored=True)


@step("uint32", "uint32", "uint32", "uint32", ADDRESS)
def write_words(builder: Builder, x: Value, k0: Value, k1: Value, k2: Value, target: Value) -> None:
    """Write the words for rounding of a block, uint32; `x` is the position of its first pixel in the image."""
    store(builder, hashed(builder, x, (k0, k1, k2)), target, 0)


@step(ADDRESS, ADDRESS, "float32", ADDRESS)
def write_pixels(builder: Builder, words: Value, line: Value, upper_limit: Value, target: Value) -> None:
    """Write a block as uint16 RGB pixels (96 bytes), rounded at random and clipped to 0 … `upper_limit`."""
    masks = constant(WORDS, [1023 << shift for shift in (21, 11, 1, 1)] * 4)
    zero, steps = ir.Constant(FLOATS, [0.0] * LANES), ir.Constant(FLOATS, [2.0**-31, 2.0**-21, 2.0**-11, 2.0**-11] * 4)
    limit, shorts = broadcast(builder, upper_limit, FLOATS), ir.VectorType(I16, LANES)
    rounded: list[Value] = []
    for quarter in range(4):
        pixel_words = builder.bitcast(_repeated_four_times(builder, words, 16 * quarter), WORDS)
        parts = builder.sitofp(builder.and_(pixel_words, masks), FLOATS)
        value = builder.fadd(load(builder, line, 64 * quarter, FLOATS), builder.fmul(parts, steps))
        value = builder.select(builder.fcmp_ordered(">", value, zero), value, zero)
        rounded.append(builder.trunc(builder.fptosi(minimum(builder, value, limit), WORDS), shorts))
    lanes = [lane for lane in range(2 * LANES) if lane % 4 < 3]
    for i in (0, 2):
        index_type = ir.VectorType(I32, len(lanes))
        store(builder, builder.shuffle_vector(*rounded[i : i + 2], constant(index_type, lanes)), target, 24 * i)


@inlined
def _block_at(block: int, width: int) -> int:
    return min(PRINTED_BLOCK * block, width - PRINTED_BLOCK)


@inlined
def _plan_segment(
    row: int,
    pitch: int,
    first: int,
    stop: int,
    width: int,
    x0: int,
    tables: Any,
    samples: Any,
    count: Any,
    keys: Any,
    plans: int,
    sample_offsets: int,
    choices: int,
) -> None:
    _, _, cells, fractions, zeros = tables
    for line in range(3 * PRINTED_BLOCK * first, 3 * PRINTED_BLOCK * stop + LINE, LINE):
        prefetch(row + _ROWS_AHEAD * pitch + line)
    for block in range(first, stop):
        plan_block(row + 3 * _block_at(block, width), fractions, plans + (block - first) * _PLAN_BYTES)
    low, high = (x0 + _block_at(first, width)) // GROUP, (x0 + _block_at(stop - 1, width) + PRINTED_BLOCK - 1) // GROUP
    for number in range(len(samples)):
        k0, k1, k2 = keys[number, 0], keys[number, 1], keys[number, 2]
        for group in range(low, high + 1):
            choose_for_colours(zeros, uint32(LANES * group), k0, k1, k2, count, choices + 4 * GROUP * (group - low))
        for block in range(first, stop):
            block_choices = choices + 4 * (x0 + _block_at(block, width) - GROUP * low)
            target = sample_offsets + _ROW * (number * _SEGMENT + block - first)
            plan = plans + (block - first) * _PLAN_BYTES
            place_samples(plan, cells, block_choices, samples[number], target)


@inlined
def _mix_block(plan: int, offsets_at: int, tables: Any, members: Any, shares: Any, factors: Any, lines: Any) -> None:
    samples, roots, owners = members
    factor_at, second_line = factors.ctypes.data, lines.ctypes.data + _LINE_BYTES
    share = factors[1]
    lines[0] = 0
    for number in range(len(samples)):
        owner = owners[number]
        first, last = number == 0 or owner != owners[number - 1], number + 1 == len(owners)
        lit = False
        for pixel in range(PRINTED_BLOCK):
            share[pixel] = shares[pixel, owner]
            lit |= share[pixel] != 0
            factors[0, pixel] = roots[number] / np.sqrt(share[pixel]) if share[pixel] else np.float32(0)
        if not lit:
            continue
        bases, offsets = tables[1] + 32 * NODES * number, offsets_at + _ROW * _SEGMENT * number
        if first:
            draw_block(plan, bases, samples[number], offsets, factor_at, tables[0] + 16 * NODES * owner, second_line)
        else:
            add_deviations(plan, bases, samples[number], offsets, factor_at, second_line)
        if last or owners[number + 1] != owner:
            for pixel in range(PRINTED_BLOCK):
                for channel in range(3):
                    lines[0, pixel, channel] += share[pixel] * lines[1, pixel, channel]


@compiled
def print_segments(
    source: int,
    pitch: int,
    frame: Any,
    flip: bool,
    tables: Any,
    members: Any,
    shares: Any,
    masked: bool,
    count: Any,
    seed: Any,
    image: int,
    memory: Any,
    target: int,
    pitches: Any,
    scales: int,
    upper_limit: Any,
) -> None:
    """Fill an image (height, width, 3) uint16, or a crop (3, height, width) float32 if `scales` is not 0.

    `frame` is (x0, y0, width, height): the pixel at address `source` is (x0, y0), and the width is at least 16. If
    `masked`, `shares` (height, width, M) are the weights of M illuminants.
    """
    x0, y0, width, height = frame
    plans, sample_offsets, choices, line, words, factors, lines, keys = memory
    samples, roots, _ = members
    for number in range(len(samples)):
        factors[number] = roots[number]
    blocks = (width + PRINTED_BLOCK - 1) // PRINTED_BLOCK
    segments = (blocks + _SEGMENT - 1) // _SEGMENT
    rounding = row_keys(y0, 0, image, seed, _ROUNDING_PURPOSE)
    for segment in range(height * segments + 1):
        if segment < height * segments:
            y, first = segment // segments, _SEGMENT * (segment % segments)
            slot, stop = segment & 1, min(first + _SEGMENT, blocks)
            if first == 0:
                for number in range(len(samples)):
                    keys[number, 0], keys[number, 1], keys[number, 2] = row_keys(y0 + y, number, image, seed)
            _plan_segment(
                source + y * pitch,
                pitch,
                first,
                stop,
                width,
                x0,
                tables,
                samples,
                count,
                keys,
                plans + slot * _SEGMENT * _PLAN_BYTES,
                sample_offsets + slot * _SEGMENT * _ROW * len(samples),
                choices,
            )
        if segment == 0:
            continue
        y, first = (segment - 1) // segments, _SEGMENT * ((segment - 1) % segments)
        slot = segment - 1 & 1
        if first == 0 and scales == 0:
            rounding = row_keys(y0 + y, 0, image, seed, _ROUNDING_PURPOSE)
        for block in range(first, min(first + _SEGMENT, blocks)):
            x = _block_at(block, width)
            plan = plans + (slot * _SEGMENT + block - first) * _PLAN_BYTES
            block_offsets = sample_offsets + (slot * _SEGMENT * len(samples) + block - first) * _ROW
            if scales == 0:
                # Written before the block is interpolated, which hides the latency of the products.
                write_words(uint32(x0 + x), rounding[0], rounding[1], rounding[2], words)
            if masked:
                _mix_block(plan, block_offsets, tables, members, shares[y, x : x + PRINTED_BLOCK], factors, lines)
            else:
                draw_block(plan, tables[1], samples[0], block_offsets, factors.ctypes.data, tables[0], line)
                for number in range(1, len(samples)):
                    bases, offsets = tables[1] + 32 * NODES * number, block_offsets + _ROW * _SEGMENT * number
                    add_deviations(plan, bases, samples[number], offsets, factors.ctypes.data + _ROW * number, line)
            if scales == 0:
                write_pixels(words, line, upper_limit, target + y * pitches[0] + SAMPLE_BYTES * x)
                continue
            red = target + y * pitches[1] + 4 * (width - PRINTED_BLOCK - x if flip else x)
            green, blue = red + pitches[0], red + 2 * pitches[0]
            if flip:
                write_mirrored(line, scales, red, green, blue)
            else:
                write_planes(line, scales, red, green, blue)


class PrintMemory:
    """Scratch memory of `print_segments`: plans, choices and offsets of samples, pixels, and keys of a row."""

    def __init__(self, components: int) -> None:
        sizes = {
            "plans": 2 * _SEGMENT * _PLAN_BYTES,
            "sample_offsets": 2 * _SEGMENT * _ROW * components,
            "choices": 4 * GROUP * _SEGMENT_GROUPS,
            "lines": 2 * _LINE_BYTES,
            "words": _ROW,
            "factors": _ROW * max(components, 2),
        }
        self._bytes = np.zeros(sum(sizes.values()) + LINE, np.uint8)
        first = -self._bytes.ctypes.data % LINE
        arrays: dict[str, npt.NDArray[np.uint8]] = {}
        for name, size in sizes.items():
            arrays[name], first = self._bytes[first : first + size], first + size
        addresses = (array.ctypes.data for name, array in arrays.items() if name != "factors")
        self.arrays = (
            *addresses,
            arrays["factors"].view(np.float32).reshape(-1, PRINTED_BLOCK),
            arrays["lines"].view(np.float32).reshape(2, PRINTED_BLOCK, 4),
            np.zeros((components, 3), np.uint32),
        )


class PrintedMembers:
    """Members of all illuminants of an image or batch, for compiled code.

    Each of the M illuminants is a mixture. Its members are the illuminants of the LUT in this mixture. `arrays` holds
    the address of the samples of each member, the square root of its weight, and the index of its illuminant. `starts`
    (M + 1,) int64 is the first member of each illuminant, and the end. The addresses are valid as long as this object
    exists.
    """

    def __init__(self, samples: npt.NDArray[np.uint16], lights: Sequence[PrintedLight]) -> None:
        self._samples = np.ascontiguousarray(samples)
        self._last = readable(self._samples[-1])
        sizes = [len(light.lights) for light in lights]
        numbers = np.concatenate([light.lights for light in lights])
        addresses = self._samples.ctypes.data + numbers * self._samples.strides[0]
        addresses[numbers == len(samples) - 1] = self._last.ctypes.data
        owners, roots = np.repeat(np.arange(len(lights)), sizes), np.concatenate([light.roots for light in lights])
        self.arrays = addresses, roots, owners
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self.largest_size = max(sizes)


_ZEROS: Final = np.zeros(GROUP, np.uint32)  # Used as `colours` of `choose_for_colours` for offsets within a colour


class SharedTables:
    """Addresses of arrays for all illuminants: offset of each node's samples, `_node_fractions`, and zeros."""

    def __init__(self, samples: npt.NDArray[np.uint16], cells: npt.NDArray[np.uint32]) -> None:
        self._kept = (cells * (SAMPLE_BYTES * samples.shape[2])).astype(np.uint32), _node_fractions(), _ZEROS
        self.addresses = tuple(array.ctypes.data for array in self._kept)


def padded_to_block(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a picture (H, W, 3) with contiguous rows, padded with black to the width of a block."""
    missing = PRINTED_BLOCK - picture.shape[1]
    return packed_rows(picture) if missing <= 0 else np.pad(picture, ((0, 0), (0, missing), (0, 0)))


def draw_printed(
    samples: npt.NDArray[np.uint16],
    picture: npt.NDArray[np.uint8],
    lights: Sequence[PrintedLight],
    cells: npt.NDArray[np.uint32],
    *,
    shares: npt.NDArray[np.float32] | None = None,
    white_level: int = 65535,
    seed: int = 0,
    image: int = 0,
    first_row: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.uint16]:
    """Draw the raw linear image (H, W, 3) uint16 of `picture` by colour; the module docstring has the rule.

    `samples`: (L, 8**bits, S, 3) uint16, of all illuminants of the LUT. `picture`: (H, W, 3) uint8, sRGB codes.
    `lights`: M illuminants. `shares`: (H, W, M) float32, weight of each illuminant in each pixel; None for one
    illuminant. `cells`: (4913,) uint32, nearest patch of each node. `white_level`: saturation level, counts. `seed`,
    `image`, `first_row`, `threads` and `out`: as for `rendering.draw_samples`.
    """
    check_picture(picture)
    target = check_out(out, picture.shape, np.uint16)
    key = check_seed(seed, image)
    count, is_mixed, width = np.uint32(samples.shape[2]), shares is not None, picture.shape[1]
    members, shared = PrintedMembers(samples, lights), SharedTables(samples, cells)
    means, bases = (
        np.concatenate([getattr(light, name) for light in lights]) if is_mixed else getattr(lights[0], name)
        for name in ("means", "bases")
    )
    share_array = np.zeros((1, 1, 1), np.float32) if shares is None else shares
    source = padded_to_block(picture)
    if is_mixed and width < PRINTED_BLOCK:
        share_array = np.pad(share_array, ((0, 0), (0, PRINTED_BLOCK - width), (0, 0)))
    work = writable(target) if width >= PRINTED_BLOCK else np.empty(source.shape, np.uint16)

    def fill(top: int, bottom: int) -> None:
        memory = PrintMemory(len(members.arrays[0]))
        print_segments(
            source.ctypes.data + top * source.strides[0],
            source.strides[0],
            (0, first_row + top, source.shape[1], bottom - top),
            False,
            (means.ctypes.data, bases.ctypes.data, *shared.addresses),
            members.arrays,
            share_array[top:bottom] if is_mixed else share_array,
            is_mixed,
            count,
            key,
            image,
            memory.arrays,
            work.ctypes.data + top * work.strides[0],
            (work.strides[0], 0),
            0,
            np.float32(white_level),
        )

    run_in_threads(fill, len(picture), threads)
    if width < PRINTED_BLOCK:
        target[...] = work[:, :width]
        return target
    return copied_back(work, target)
