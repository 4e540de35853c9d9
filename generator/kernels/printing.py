"""From source codes to linear camera RGB by colour: each pixel is the print's interpolated mean plus recorded noise.

A light's print is known at nodes: 17 codes of each channel, 0, 16 … 240, 255. There stand m, what the camera sees of
the place of the chart that shows the node's colour, and the number of the cell that is nearest to that place
(`generator.rendering.colorimetric`). The rule is part of the dataset format; a pixel of codes v at (x, y) becomes ::

    m(v) + k σ(v) (x - b)

- m(v) is interpolated between the four nodes of a tetrahedron around v (J. M. Kasson et al., "Performing color space
  conversions with three-dimensional linear interpolation", Journal of Electronic Imaging 4, 1995). Between nodes, v is
  where its light is: (lin v - lin v₀) / (lin v₁ - lin v₀), lin being sRGB's decoding. A print on which light adds as in
  the picture is met exactly, and greys lie between greys alone.
- x is one of the samples of the cell of the node whose codes are nearest, of two the higher code; chosen as by codes
  (`kernels/choice.py`). b is their mean: the deviation is one that was recorded.
- k σ makes deviations, whose spread is that of 25 numbers and of the cell's own level, as large as the table's noise is
  at m(v): σ, the noise of the three channels together by the photon-transfer curve, is interpolated as m is, and k is
  for each channel the noise at the node over that of the cell's 25 samples and over σ there.

Of lights that shine together each has its own samples, drawn independently (place i of `choice.row_keys` for the i-th),
and deviations count with the root of the light's weight, as in `kernels/mixing.py`.
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

SIDE: Final = 17  # Nodes of a channel

NODES: Final = SIDE**3  # Nodes of all colours

NODE_CODES: Final = (*range(0, 256, 16), 255)  # sRGB codes of a channel's nodes

_RED, _GREEN, _BLUE = np.int32(SIDE * SIDE), np.int32(SIDE), np.int32(1)
_ALL, _HALF = np.int32(SIDE * SIDE + SIDE + 1), np.int32(8)


@dataclass(frozen=True, eq=False)
class PrintedLight:
    """What one light makes of the print, for compiled code.

    - `means`: (4913, 4) float32: m in red, green and blue, counts; and their noise, σ.
    - `bases`: (C, 4913, 2, 4) float32 of each of the table's lights in it: b in red, green and blue, counts, and k; the
      fourth of each is 0.
    - `lights`: (C,) int64, numbers of these lights.
    - `roots`: (C,) float32, square roots of their weights.

    Arrays are C-contiguous.
    """

    means: npt.NDArray[np.float32]
    bases: npt.NDArray[np.float32]
    lights: npt.NDArray[np.int64]
    roots: npt.NDArray[np.float32]


@lru_cache(maxsize=1)
def _parts() -> npt.NDArray[np.float32]:
    """Return how far each code is from the node below it to the next, (256,) float32, 0 … 1."""
    codes = np.arange(256)
    below = np.minimum(codes // 16, SIDE - 2)
    light, ends = decode_srgb(codes / 255), decode_srgb(np.array(NODE_CODES) / 255)
    return ((light - ends[below]) / (ends[below + 1] - ends[below])).astype(np.float32)


@compiled
def _count_nearest(picture: Any, counts: Any) -> None:
    """Add to `counts` (4913,) how many pixels of a picture (H, W, 3) are nearest to each node."""
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            red, green, blue = picture[y, x, 0] + 8 >> 4, picture[y, x, 1] + 8 >> 4, picture[y, x, 2] + 8 >> 4
            counts[red * _RED + green * _GREEN + blue] += 1


def nearest_nodes(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Return how many pixels of a picture (H, W, 3) uint8 are nearest to each node, (4913,) int64."""
    check_picture(picture)
    counts = np.zeros(NODES, np.int64)
    _count_nearest(picture, counts)
    return counts


@compiled
def means_at(
    samples: Any, corners: Any, weights: Any, nearest: Any, cells: Any, means: Any, bases: Any, spreads: Any
) -> None:
    """Write what the camera sees of nodes under a light.

    `samples` (N, S, 3) uint16; `cells` (U,) the cells that nodes need; `corners` (K, 8) and `nearest` (K,) places in
    `cells`; `weights` (K, 8); `means`, `bases` and `spreads` (K, 3) float64, the last two the mean and variance of the
    nearest cell's samples.
    """
    count = samples.shape[1]
    seen = np.empty((len(cells), 3))
    for number in range(len(cells)):
        red = green = blue = 0
        for i in range(count):
            red += samples[cells[number], i, 0]
            green += samples[cells[number], i, 1]
            blue += samples[cells[number], i, 2]
        seen[number, 0], seen[number, 1], seen[number, 2] = red / count, green / count, blue / count
    for node in range(len(nearest)):
        for channel in range(3):
            total = 0.0
            for corner in range(8):
                total += weights[node, corner] * seen[corners[node, corner], channel]
            means[node, channel] = total
            mean, total = seen[nearest[node], channel], 0.0
            for i in range(count):
                total += (samples[cells[nearest[node]], i, channel] - mean) ** 2
            bases[node, channel], spreads[node, channel] = mean, total / count


_FOUR: Final = ir.VectorType(F32, 4)
PRINTED_BLOCK: Final = LANES  # Pixels that are planned and interpolated at a time
# Rows of 16 numbers that the plan of a block has: offsets of three nodes in bytes, weights of four, the offset of the
# nearest. The fourth node is one step farther in each channel than the first.
_PLAN_ROWS: Final = 8
_ROW: Final = 4 * PRINTED_BLOCK  # Bytes of a row: one number of 32 bits a pixel
_PLAN_BYTES: Final = _ROW * _PLAN_ROWS
_LINE_BYTES: Final = 16 * PRINTED_BLOCK  # Bytes of a block's pixels: red, green, blue and noise, float32 each
# Blocks of a row that are planned, and their samples prefetched, while those before are interpolated.
_SEGMENT: Final = 8
_ROWS_AHEAD: Final = 2  # Rows by which prefetching the picture leads planning it
# Groups of 32 pixels, whose choices are made together, that a segment may touch.
_SEGMENT_GROUPS: Final = _SEGMENT * PRINTED_BLOCK // GROUP + 2


@step(ADDRESS, ADDRESS, ADDRESS)
def plan_block(builder: Builder, picture: Value, part: Value, target: Value) -> None:
    """Write the plan of the 16 pixels at `picture`; of them 48 bytes are read, and of `part` 256 float32."""

    def number(value: int) -> Value:
        return constant(WORDS, value)

    codes = pixel_codes(builder, picture)
    channels = [builder.and_(builder.lshr(codes, number(shift)), number(255)) for shift in (16, 8, 0)]
    parts: list[Value] = []
    for channel in range(3):
        vector: Value = ir.Constant(FLOATS, ir.Undefined)
        for pixel in range(PRINTED_BLOCK):
            code = builder.zext(load(builder, picture, 3 * pixel + channel, I8), I64)
            its = load(builder, builder.add(part, builder.shl(code, ir.Constant(I64, 2))), 0, F32)
            vector = builder.insert_element(vector, its, ir.Constant(I32, pixel))
        parts.append(vector)
    red, green, blue = parts
    strides = [number(16 * int(stride)) for stride in (_RED, _GREEN, _BLUE)]

    def node(added: int, size: int) -> Value:
        """Return `size` times the node whose places in the channels are those of codes with something added."""
        total: Value = None
        for codes, stride in zip(channels, (_RED, _GREEN, _BLUE), strict=True):
            place = builder.lshr(builder.add(codes, number(added)), number(4))
            part = builder.mul(place, number(size * int(stride)))
            total = part if total is None else builder.add(total, part)
        return total

    def not_less(first: Value, second: Value) -> Value:
        return builder.fcmp_ordered(">=", first, second)

    def least(first: Value, second: Value) -> Value:
        return builder.select(builder.fcmp_ordered("<", first, second), first, second)

    def most(first: Value, second: Value) -> Value:
        return builder.select(builder.fcmp_ordered(">", first, second), first, second)

    red_green, red_blue, green_blue = (not_less(*two) for two in ((red, green), (red, blue), (green, blue)))
    green_red, blue_least = not_less(red, green), builder.and_(not_less(red, blue), not_less(green, blue))
    high = builder.select(green_blue, strides[1], strides[2])
    high = builder.select(builder.and_(red_green, red_blue), strides[0], high)
    low = builder.select(blue_least, strides[2], builder.select(green_red, strides[1], strides[0]))
    upper, lower = most(red, green), least(red, green)
    middle = least(upper, most(lower, blue))
    upper, lower = most(upper, blue), least(lower, blue)
    base = node(0, 16)
    nodes = base, builder.add(base, high), builder.sub(builder.add(base, number(16 * int(_ALL))), low)
    one = ir.Constant(FLOATS, [1.0] * LANES)
    weights = builder.fsub(one, upper), builder.fsub(upper, middle), builder.fsub(middle, lower), lower
    for row, its in enumerate(nodes):
        store(builder, its, target, _ROW * row)
    for row, its in enumerate(weights):
        store(builder, its, target, _ROW * (3 + row))
    store(builder, node(int(_HALF), 32), target, _ROW * 7)


@step(*[ADDRESS] * 5)
def place_samples(builder: Builder, plan: Value, cells: Value, choices: Value, samples: Value, target: Value) -> None:
    """Write where in `samples` those of a block's pixels are, uint32 bytes, and prefetch them.

    At `cells` is an uint32 for each node, where its samples begin, and at `choices` for each pixel what is added.
    """
    for pixel in range(PRINTED_BLOCK):
        near = load(builder, plan, _ROW * 7 + 4 * pixel, I32)
        cell = builder.zext(builder.lshr(near, ir.Constant(I32, 3)), I64)
        place = builder.add(load(builder, builder.add(cells, cell), 0, I32), load(builder, choices, 4 * pixel, I32))
        store(builder, place, target, 4 * pixel)
        emit_prefetch(builder, builder.add(samples, builder.zext(place, I64)), 3)


def _of_pixels(builder: Builder, base: Value, offsets: Sequence[Value], shift: int, kind: Any) -> Value:
    """Return vectors of four pixels as one: each is `shift` bytes and the pixel's offset, an int64, behind `base`."""
    return concatenated(builder, [load(builder, builder.add(base, offset), shift, kind) for offset in offsets])


def _offsets(builder: Builder, address: Value, at: int) -> list[Value]:
    """Return four offsets, int64, that stand as uint32 in a row; two come by one load."""
    low, half = ir.Constant(I64, 0xFFFFFFFF), ir.Constant(I64, 32)
    pairs = [load(builder, address, at + shift, I64) for shift in (0, 8)]
    return [number for two in pairs for number in (builder.and_(two, low), builder.lshr(two, half))]


def _each(builder: Builder, address: Value, at: int) -> Value:
    """Return four numbers, float32 in a row, each four times."""
    numbers = load(builder, address, at, _FOUR)
    return builder.shuffle_vector(numbers, numbers, constant(WORDS, [lane // 4 for lane in range(LANES)]))


def _interpolated(builder: Builder, plan: Value, means: Value, first: int) -> Value:
    """Return the four numbers of each of four pixels: `means` between the nodes of each."""
    total: Value = None
    corners = [_offsets(builder, plan, _ROW * row + 4 * first) for row in range(3)]
    for corner, offsets in enumerate((*corners, corners[0])):
        weights = _each(builder, plan, _ROW * (3 + corner) + 4 * first)
        seen = _of_pixels(builder, means, offsets, 16 * int(_ALL) * (corner == 3), _FOUR)
        part = builder.fmul(weights, seen)
        total = part if total is None else builder.fadd(total, part)
    return total


def _deviating(builder: Builder, seen: Value, first: int, addresses: Sequence[Value]) -> Value:
    """Return the numbers of four pixels with the deviations of their samples; the fourth of each stays."""
    plan, bases, samples, places, factors = addresses
    noise = builder.shuffle_vector(seen, seen, constant(WORDS, [lane | 3 for lane in range(LANES)]))
    near, own = (_offsets(builder, at, 4 * first) for at in (builder.add(plan, ir.Constant(I64, 7 * _ROW)), places))
    base, spread = (_of_pixels(builder, bases, near, shift, _FOUR) for shift in (0, 16))
    drawn = builder.zext(_of_pixels(builder, samples, own, 0, ir.VectorType(I16, 4)), WORDS)
    deviation = builder.fsub(builder.sitofp(drawn, FLOATS), base)
    scale = builder.fmul(spread, builder.fmul(noise, _each(builder, factors, 4 * first)))
    return builder.fadd(seen, builder.fmul(deviation, scale))


@step(*[ADDRESS] * 7)
def draw_block(
    builder: Builder,
    plan: Value,
    bases: Value,
    samples: Value,
    places: Value,
    factors: Value,
    means: Value,
    line: Value,
) -> None:
    """Write a block's pixels, four float32 each: `means` interpolated between the nodes of each, with deviations.

    A deviation is how far a sample is from its cell's mean, which is in `bases`; it is multiplied by the pixel's
    float32 at `factors`, by its noise, and by what stands behind the mean, whose fourth number is 0.
    """
    for first in range(0, PRINTED_BLOCK, 4):
        seen = _interpolated(builder, plan, means, first)
        seen = _deviating(builder, seen, first, (plan, bases, samples, places, factors))
        store(builder, seen, line, 16 * first)


@step(*[ADDRESS] * 6)
def add_deviations(
    builder: Builder, plan: Value, bases: Value, samples: Value, places: Value, factors: Value, line: Value
) -> None:
    """Add to the pixels at `line` the deviations of another light's samples, as `draw_block` does."""
    for first in range(0, PRINTED_BLOCK, 4):
        seen = load(builder, line, 16 * first, FLOATS)
        seen = _deviating(builder, seen, first, (plan, bases, samples, places, factors))
        store(builder, seen, line, 16 * first)


def _write_planes(builder: Builder, line: Value, scales: Value, targets: Sequence[Value], mirrored: bool) -> None:

    def number(place: int) -> Value:
        return broadcast(builder, load(builder, scales, 4 * place, F32), FLOATS)

    quarters = [load(builder, line, 64 * quarter, FLOATS) for quarter in range(4)]
    for channel, target in enumerate(targets):
        lanes = [4 * pixel + channel for pixel in range(8)]
        lanes = lanes[::-1] if mirrored else lanes
        eight = ir.VectorType(I32, 8)
        halves = [builder.shuffle_vector(*quarters[i : i + 2], constant(eight, lanes)) for i in (0, 2)]
        whole = concatenated(builder, halves[::-1] if mirrored else halves)
        value = builder.fadd(builder.fmul(whole, number(channel)), number(3 + channel))
        store(builder, minimum(builder, value, number(6)), target, 0)


@step(*[ADDRESS] * 5)
def write_planes(builder: Builder, line: Value, scales: Value, red: Value, green: Value, blue: Value) -> None:
    """Write a block as float32 to three planes; `scales` are those of `vector.planes8`."""
    _write_planes(builder, line, scales, (red, green, blue), mirrored=False)


@step(*[ADDRESS] * 5)
def write_mirrored(builder: Builder, line: Value, scales: Value, red: Value, green: Value, blue: Value) -> None:
    """Do `write_planes` from right to left."""
    _write_planes(builder, line, scales, (red, green, blue), mirrored=True)


@step(ADDRESS, "float32", ADDRESS)
def write_pixels(builder: Builder, line: Value, most: Value, target: Value) -> None:
    """Write a block as uint16, red, green and blue of each pixel in turn: rounded, from 0 to `most`; 96 bytes."""
    zero, half = ir.Constant(FLOATS, [0.0] * LANES), ir.Constant(FLOATS, [0.5] * LANES)
    top, shorts = broadcast(builder, most, FLOATS), ir.VectorType(I16, LANES)
    rounded: list[Value] = []
    for quarter in range(4):
        value = builder.fadd(load(builder, line, 64 * quarter, FLOATS), half)
        value = builder.select(builder.fcmp_ordered(">", value, zero), value, zero)
        rounded.append(builder.trunc(builder.fptosi(minimum(builder, value, top), WORDS), shorts))
    lanes = [lane for lane in range(2 * LANES) if lane % 4 < 3]
    for i in (0, 2):
        kind = ir.VectorType(I32, len(lanes))
        store(builder, builder.shuffle_vector(*rounded[i : i + 2], constant(kind, lanes)), target, 24 * i)


@inlined
def _block_at(block: int, width: int) -> int:
    """Return where a block of a row begins; the last may overlap the one before."""
    return min(PRINTED_BLOCK * block, width - PRINTED_BLOCK)


@inlined
def _plan_segment(
    row: int,
    pitch: int,
    first: int,
    stop: int,
    width: int,
    x0: int,
    y: int,
    tables: Any,
    samples: Any,
    count: Any,
    seed: Any,
    image: int,
    plans: int,
    places: int,
    choices: int,
) -> None:
    """Plan blocks `first` … `stop` - 1 of a row of which the first pixel is at address `row` and has x = x0."""
    _, _, cells, part, zeros = tables
    for line in range(3 * PRINTED_BLOCK * first, 3 * PRINTED_BLOCK * stop + LINE, LINE):
        prefetch(row + _ROWS_AHEAD * pitch + line)
    for block in range(first, stop):
        plan_block(row + 3 * _block_at(block, width), part, plans + (block - first) * _PLAN_BYTES)
    low, high = (x0 + _block_at(first, width)) // GROUP, (x0 + _block_at(stop - 1, width) + PRINTED_BLOCK - 1) // GROUP
    for number in range(len(samples)):
        k0, k1, k2 = row_keys(y, number, image, seed)
        for group in range(low, high + 1):
            choose_for_colours(zeros, uint32(LANES * group), k0, k1, k2, count, choices + 4 * GROUP * (group - low))
        for block in range(first, stop):
            chosen = choices + 4 * (x0 + _block_at(block, width) - GROUP * low)
            to = places + _ROW * (number * _SEGMENT + block - first)
            of = plans + (block - first) * _PLAN_BYTES
            place_samples(of, cells, chosen, samples[number], to)


@inlined
def _mix_block(plan: int, place: int, tables: Any, members: Any, shares: Any, factors: Any, lines: Any) -> None:
    """Write a block's pixels under lights that share them, `shares` (16, M), to the first line."""
    samples, roots, owners = members
    at, own = factors.ctypes.data, lines.ctypes.data + _LINE_BYTES
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
        bases, to = tables[1] + 32 * NODES * number, place + _ROW * _SEGMENT * number
        if first:
            draw_block(plan, bases, samples[number], to, at, tables[0] + 16 * NODES * owner, own)
        else:
            add_deviations(plan, bases, samples[number], to, at, own)
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
    most: Any,
) -> None:
    """Fill an image (height, width, 3) uint16, or where there are scales a crop (3, height, width) float32.

    The pixel at address `source` is at x0, y0; the width is 16 at least. `shares`: (height, width, M) where `masked`.
    """
    x0, y0, width, height = frame
    plans, places, choices, line, factors, lines = memory
    samples, roots, _ = members
    for number in range(len(samples)):
        factors[number] = roots[number]
    blocks = (width + PRINTED_BLOCK - 1) // PRINTED_BLOCK
    segments = (blocks + _SEGMENT - 1) // _SEGMENT
    for segment in range(height * segments + 1):
        if segment < height * segments:
            y, first = segment // segments, _SEGMENT * (segment % segments)
            slot, stop = segment & 1, min(first + _SEGMENT, blocks)
            _plan_segment(
                source + y * pitch,
                pitch,
                first,
                stop,
                width,
                x0,
                y0 + y,
                tables,
                samples,
                count,
                seed,
                image,
                plans + slot * _SEGMENT * _PLAN_BYTES,
                places + slot * _SEGMENT * _ROW * len(samples),
                choices,
            )
        if segment == 0:
            continue
        y, first = (segment - 1) // segments, _SEGMENT * ((segment - 1) % segments)
        slot = segment - 1 & 1
        for block in range(first, min(first + _SEGMENT, blocks)):
            x = _block_at(block, width)
            plan = plans + (slot * _SEGMENT + block - first) * _PLAN_BYTES
            place = places + (slot * _SEGMENT * len(samples) + block - first) * _ROW
            if masked:
                _mix_block(plan, place, tables, members, shares[y, x : x + PRINTED_BLOCK], factors, lines)
            else:
                draw_block(plan, tables[1], samples[0], place, factors.ctypes.data, tables[0], line)
                for number in range(1, len(samples)):
                    bases, to = tables[1] + 32 * NODES * number, place + _ROW * _SEGMENT * number
                    add_deviations(plan, bases, samples[number], to, factors.ctypes.data + _ROW * number, line)
            if scales == 0:
                write_pixels(line, most, target + y * pitches[0] + SAMPLE_BYTES * x)
                continue
            red = target + y * pitches[1] + 4 * (width - PRINTED_BLOCK - x if flip else x)
            green, blue = red + pitches[0], red + 2 * pitches[0]
            if flip:
                write_mirrored(line, scales, red, green, blue)
            else:
                write_planes(line, scales, red, green, blue)


class PrintMemory:
    """What compiled code works in: plans of two segments, their samples' places and choices, and lines of pixels."""

    def __init__(self, components: int) -> None:
        sizes = {
            "plans": 2 * _SEGMENT * _PLAN_BYTES,
            "places": 2 * _SEGMENT * _ROW * components,
            "choices": 4 * GROUP * _SEGMENT_GROUPS,
            "lines": 2 * _LINE_BYTES,
            "factors": _ROW * max(components, 2),
        }
        self._bytes = np.zeros(sum(sizes.values()) + LINE, np.uint8)
        first = -self._bytes.ctypes.data % LINE
        parts: dict[str, npt.NDArray[np.uint8]] = {}
        for name, size in sizes.items():
            parts[name], first = self._bytes[first : first + size], first + size
        addresses = (part.ctypes.data for name, part in parts.items() if name != "factors")
        self.arrays = (
            *addresses,
            parts["factors"].view(np.float32).reshape(-1, PRINTED_BLOCK),
            parts["lines"].view(np.float32).reshape(2, PRINTED_BLOCK, 4),
        )


class PrintedMembers:
    """The table's lights in those of an image or a batch, as compiled code takes them.

    What they point to lives as long as this. `starts`: (M + 1,) int64, the first member of each light, and the end.
    """

    def __init__(self, samples: npt.NDArray[np.uint16], lights: Sequence[PrintedLight]) -> None:
        self._samples = np.ascontiguousarray(samples)
        self._last = readable(self._samples[-1])
        sizes = [len(one.lights) for one in lights]
        numbers = np.concatenate([one.lights for one in lights])
        places = self._samples.ctypes.data + numbers * self._samples.strides[0]
        places[numbers == len(samples) - 1] = self._last.ctypes.data
        owners, roots = np.repeat(np.arange(len(lights)), sizes), np.concatenate([one.roots for one in lights])
        self.arrays = places, roots, owners
        self.starts = np.concatenate([[0], np.cumsum(sizes)])
        self.most = max(sizes)


_NOTHING: Final = np.zeros(GROUP, np.uint32)  # What is added to choices, none


class SharedTables:
    """What all lights share as compiled code takes it: where nodes' samples begin, parts of codes, and zeros."""

    def __init__(self, samples: npt.NDArray[np.uint16], cells: npt.NDArray[np.uint32]) -> None:
        self._kept = (cells * (SAMPLE_BYTES * samples.shape[2])).astype(np.uint32), _parts(), _NOTHING
        self.addresses = tuple(array.ctypes.data for array in self._kept)


def at_least_a_block(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a picture (H, W, 3) whose rows compiled code can read, with black pixels behind it up to a block."""
    missing = PRINTED_BLOCK - picture.shape[1]
    return packed_rows(picture) if missing <= 0 else np.pad(picture, ((0, 0), (0, missing), (0, 0)))


def draw_printed(
    samples: npt.NDArray[np.uint16],
    picture: npt.NDArray[np.uint8],
    lights: Sequence[PrintedLight],
    cells: npt.NDArray[np.uint32],
    *,
    shares: npt.NDArray[np.float32] | None = None,
    most: int = 65535,
    seed: int = 0,
    image: int = 0,
    first_row: int = 0,
    threads: int = 1,
    out: npt.NDArray[np.uint16] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the raw linear image (H, W, 3) uint16 of `picture` by colour; the rule stands at the head of this file.

    `samples`: (L, 8**bits, S, 3) uint16, of all the table's lights. `picture`: (H, W, 3) uint8, sRGB codes. `lights`: M
    of them; `shares`: (H, W, M) float32, of each in each pixel, None of one light. `cells`: (4913,) uint32, the cell
    whose samples each node has. `most`: value at which counts are cut off. `seed`, `image`, `first_row`, `threads` and
    `out` as of `rendering.draw_samples`.
    """
    check_picture(picture)
    target = check_out(out, picture.shape, np.uint16)
    key = check_seed(seed, image)
    count, masked, width = np.uint32(samples.shape[2]), shares is not None, picture.shape[1]
    members, rest = PrintedMembers(samples, lights), SharedTables(samples, cells)
    means, bases = (
        np.concatenate([getattr(one, name) for one in lights]) if masked else getattr(lights[0], name)
        for name in ("means", "bases")
    )
    given = np.zeros((1, 1, 1), np.float32) if shares is None else shares
    source = at_least_a_block(picture)
    if masked and width < PRINTED_BLOCK:
        given = np.pad(given, ((0, 0), (0, PRINTED_BLOCK - width), (0, 0)))
    work = writable(target) if width >= PRINTED_BLOCK else np.empty(source.shape, np.uint16)

    def fill(top: int, bottom: int) -> None:
        memory = PrintMemory(len(members.arrays[0]))
        print_segments(
            source.ctypes.data + top * source.strides[0],
            source.strides[0],
            (0, first_row + top, source.shape[1], bottom - top),
            False,
            (means.ctypes.data, bases.ctypes.data, *rest.addresses),
            members.arrays,
            given[top:bottom] if masked else given,
            masked,
            count,
            key,
            image,
            memory.arrays,
            work.ctypes.data + top * work.strides[0],
            (work.strides[0], 0),
            0,
            np.float32(most),
        )

    run_in_threads(fill, len(picture), threads)
    if width < PRINTED_BLOCK:
        target[...] = work[:, :width]
        return target
    return copied_back(work, target)
