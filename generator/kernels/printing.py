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
from foundation.compiled import compiled, inlined, intrinsic
from generator.kernels.choice import check_out, check_picture, check_seed, readable, row_keys, run_in_threads
from generator.kernels.vector import (
    ADDRESS,
    F32,
    GROUP,
    I16,
    I32,
    I64,
    LANES,
    LINE,
    SAMPLE_BYTES,
    Builder,
    Value,
    broadcast,
    choose_for_colours,
    load,
    offset_at,
    store,
    void,
)

SIDE: Final = 17
"""Nodes of a channel."""

NODES: Final = SIDE**3
"""Nodes of all colours."""

NODE_CODES: Final = (*range(0, 256, 16), 255)
"""sRGB codes of a channel's nodes."""

_RED, _GREEN, _BLUE = np.int32(SIDE * SIDE), np.int32(SIDE), np.int32(1)
_ALL, _LAST, _HALF = np.int32(SIDE * SIDE + SIDE + 1), np.int32(SIDE - 2), np.int32(8)


@dataclass(frozen=True, eq=False)
class PrintedLight:
    """What one light makes of the print, for compiled code.

    - `means`: (4913, 4) float32: m in red, green and blue, counts; and their noise, σ.
    - `bases`: (C, 4913, 2, 4) float32 of each of the table's lights in it: b in red, green and blue, counts, and k; the
      fourth of each is not used.
    - `lights`: (C,) int64, numbers of these lights.
    - `roots`: (C,) float32, square roots of their weights.
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
    """Return how many pixels of a picture (H, W, 3) uint8 are nearest to each node, (4913,) int64.

    Examples
    --------
    >>> np.flatnonzero(nearest_nodes(np.array([[[255, 0, 4], [0, 0, 9]]], np.uint8)))
    array([   1, 4624])
    """
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
_PLAN_ROWS: Final = 9
"""Rows of 32 numbers that the plan of a group has: places of four nodes in bytes, their weights, the nearest node's."""


def _four(builder: Builder, base: Value, offset: Value) -> Value:
    """Return the four float32 that stand `offset` bytes, an uint32, behind `base`."""
    return load(builder, builder.add(base, builder.zext(offset, I64)), 0, _FOUR)


@intrinsic
def mean_of(typing: Any, plan: Any, means: Any, target: Any) -> Any:
    """Write four numbers, float32, to `target`: `means` interpolated between the nodes of the pixel at `plan`."""
    del typing, plan, means, target

    def emit(builder: Builder, plan: Value, means: Value, target: Value) -> None:
        total: Value = None
        for corner in range(4):
            weight = broadcast(builder, load(builder, plan, 4 * GROUP * (4 + corner), F32), _FOUR)
            part = builder.fmul(weight, _four(builder, means, load(builder, plan, 4 * GROUP * corner, I32)))
            total = part if total is None else builder.fadd(total, part)
        store(builder, total, target, 0)

    return void(emit, ADDRESS, ADDRESS, ADDRESS)


@intrinsic
def add_deviation(typing: Any, plan: Any, bases: Any, sample: Any, factor: Any, target: Any) -> Any:
    """Add to three numbers at `target` how far the sample at `sample` is from its cell's mean, which is in `bases`.

    It is multiplied by `factor`, by the fourth number at `target`, and by what stands behind the mean.
    """
    del typing, plan, bases, sample, factor, target

    def emit(builder: Builder, plan: Value, bases: Value, sample: Value, factor: Value, target: Value) -> None:
        place = builder.add(
            bases, builder.zext(builder.shl(load(builder, plan, 4 * GROUP * 8, I32), ir.Constant(I32, 1)), I64)
        )
        base, spread = load(builder, place, 0, _FOUR), load(builder, place, 16, _FOUR)
        seen, last = load(builder, target, 0, _FOUR), ir.Constant(I32, 3)
        scale = builder.fmul(builder.extract_element(seen, last), factor)
        drawn = builder.uitofp(load(builder, sample, 0, ir.VectorType(I16, 4)), _FOUR)
        deviation = builder.fmul(builder.fsub(drawn, base), builder.fmul(spread, broadcast(builder, scale, _FOUR)))
        total = builder.fadd(seen, deviation)
        store(builder, builder.insert_element(total, builder.extract_element(seen, last), last), target, 0)

    return void(emit, ADDRESS, ADDRESS, ADDRESS, "float32", ADDRESS)


@inlined
def _plan_group(row: Any, first: int, stop: int, part: Any, cells: Any, plan: Any, weights: Any) -> None:
    """Write the plan of pixels `first` … `stop` - 1 of a group, and behind it the bytes at which their cells begin.

    In three loops without a branch, of which the second becomes vectors.
    """
    begin = GROUP * (first // GROUP)
    for x in range(first, stop):
        red, green, blue = np.int32(row[x, 0]), np.int32(row[x, 1]), np.int32(row[x, 2])
        at = x - begin
        weights[0, at], weights[1, at], weights[2, at] = part[red], part[green], part[blue]
        plan[0, at] = red << 16 | green << 8 | blue
    for at in range(GROUP):
        codes = np.int32(plan[0, at])
        red, green, blue = codes >> 16, codes >> 8 & 255, codes & 255
        fr, fg, fb = weights[0, at], weights[1, at], weights[2, at]
        base = min(red >> 4, _LAST) * _RED + min(green >> 4, _LAST) * _GREEN + min(blue >> 4, _LAST)
        between = _GREEN if fg >= fb else _BLUE
        high = _RED if (fr >= fg) & (fr >= fb) else between
        between = _GREEN if fg <= fr else _RED
        low = _BLUE if (fb <= fr) & (fb <= fg) else between
        most, least = max(fr, fg), min(fr, fg)
        middle = min(most, max(least, fb))
        most, least = max(most, fb), min(least, fb)
        plan[0, at], plan[1, at] = base << 4, base + high << 4
        plan[2, at], plan[3, at] = base + _ALL - low << 4, base + _ALL << 4
        weights[0, at], weights[1, at] = np.float32(1) - most, most - middle
        weights[2, at], weights[3, at] = middle - least, least
        plan[8, at] = (red + _HALF >> 4) * _RED + (green + _HALF >> 4) * _GREEN + (blue + _HALF >> 4)
    for at in range(first - begin, stop - begin):
        node = plan[8, at]
        plan[_PLAN_ROWS, at], plan[8, at] = cells[node], node << uint32(4)


@inlined
def _key_row(keys: Any, y: int, image: int, seed: Any) -> None:
    """Write the keys of row `y` of each component, (C, 3) uint32."""
    for number in range(len(keys)):
        keys[number, 0], keys[number, 1], keys[number, 2] = row_keys(y, number, image, seed)


@inlined
def _print_group(
    row: Any,
    first: int,
    stop: int,
    keys: Any,
    word: Any,
    part: Any,
    cells: Any,
    addresses: Any,
    members: Any,
    shares: Any,
    masked: bool,
    count: Any,
    memory: Any,
) -> None:
    """Write pixels `first` … `stop` - 1 of a group of 32 of a row to the first lines of memory: four float32 each."""
    samples, roots, owners = members
    means, bases, at, lines = addresses
    plan, weights, line = memory
    begin = GROUP * (first // GROUP)
    _plan_group(row, first, stop, part, cells, plan, weights)
    for number in range(len(samples)):
        to = at + 4 * GROUP * (_PLAN_ROWS + 1 + number)
        named = at + 4 * GROUP * _PLAN_ROWS
        choose_for_colours(named, word, keys[number, 0], keys[number, 1], keys[number, 2], count, to)
    for x in range(first, stop):
        of, target = at + 4 * (x - begin), lines + 16 * (x - first)
        if not masked:
            mean_of(of, means, target)
            for number in range(len(samples)):
                sample = samples[number] + offset_at(of + 4 * GROUP * (_PLAN_ROWS + 1 + number))
                add_deviation(of, bases + 32 * NODES * number, sample, roots[number], target)
            continue
        for channel in range(3):
            line[x - first, channel] = 0
        own = lines + 16 * GROUP
        for number in range(len(samples)):
            share = shares[x, owners[number]]
            if share == 0:
                continue
            if number == 0 or owners[number] != owners[number - 1]:
                mean_of(of, means + 16 * NODES * owners[number], own)
            sample = samples[number] + offset_at(of + 4 * GROUP * (_PLAN_ROWS + 1 + number))
            add_deviation(of, bases + 32 * NODES * number, sample, roots[number] / np.sqrt(share), own)
            if number + 1 == len(samples) or owners[number + 1] != owners[number]:
                for channel in range(3):
                    line[x - first, channel] += share * line[GROUP, channel]


@compiled
def _print(
    picture: Any,
    first_row: int,
    part: Any,
    cells: Any,
    addresses: Any,
    members: Any,
    shares: Any,
    masked: bool,
    count: Any,
    seed: Any,
    image: int,
    most: float,
    memory: Any,
    out: Any,
) -> None:
    """Fill the rows of an image (H, W, 3) uint16."""
    keys = np.empty((len(members[0]), 3), np.uint32)
    top, half, line = np.float32(most), np.float32(0.5), memory[2]
    width = picture.shape[1]
    for y in range(len(picture)):
        _key_row(keys, first_row + y, image, seed)
        row, shared = picture[y], shares[y if masked else 0]
        for begin in range(0, width, GROUP):
            stop, word = min(begin + GROUP, width), uint32(begin // GROUP * LANES)
            _print_group(row, begin, stop, keys, word, part, cells, addresses, members, shared, masked, count, memory)
            for x in range(begin, stop):
                for channel in range(3):
                    value = min(max(line[x - begin, channel] + half, np.float32(0)), top)
                    out[y, x, channel] = np.uint16(np.int32(value))


@compiled
def _print_crop(
    picture: Any,
    window: Any,
    flip: bool,
    part: Any,
    cells: Any,
    addresses: Any,
    members: Any,
    count: Any,
    seed: Any,
    scales: Any,
    memory: Any,
    out: Any,
) -> None:
    """Fill a crop (3, height, width) float32; `scales` (7,) float32: factors and summands of channels, and a limit."""
    keys = np.empty((len(members[0]), 3), np.uint32)
    shares, line = np.ones((1, 1), np.float32), memory[2]
    x0, y0, width, height = window
    for y in range(height):
        _key_row(keys, y0 + y, 0, seed)
        row = picture[y0 + y]
        for begin in range(GROUP * (x0 // GROUP), x0 + width, GROUP):
            first, stop, word = max(begin, x0), min(begin + GROUP, x0 + width), uint32(begin // GROUP * LANES)
            _print_group(row, first, stop, keys, word, part, cells, addresses, members, shares, False, count, memory)
            size = stop - first
            for channel in range(3):
                factor, summand, limit = scales[channel], scales[3 + channel], scales[6]
                if flip:
                    plane = out[channel, y, x0 + width - stop : x0 + width - first]
                    for x in range(size):
                        plane[size - 1 - x] = min(line[x, channel] * factor + summand, limit)
                else:
                    plane = out[channel, y, first - x0 : stop - x0]
                    for x in range(size):
                        plane[x] = min(line[x, channel] * factor + summand, limit)


class _Memory:
    """What compiled code works in: the plan of a group, choices of each component, and lines of pixels."""

    def __init__(self, components: int) -> None:
        rows = _PLAN_ROWS + 1 + components
        memory = np.zeros((rows * GROUP + 4 * (GROUP + 1)) + LINE // 4, np.uint32)
        first = -memory.ctypes.data % LINE // 4
        plan = memory[first : first + rows * GROUP].reshape(rows, GROUP)
        line = memory[first + rows * GROUP :][: 4 * (GROUP + 1)].view(np.float32).reshape(-1, 4)
        self.arrays = plan, plan[4:8].view(np.float32), line
        self.addresses = plan.ctypes.data, line.ctypes.data


class _Components:
    """The lights of an image as compiled code takes them; what they point to lives as long as this."""

    def __init__(self, samples: npt.NDArray[np.uint16], lights: Sequence[PrintedLight]) -> None:
        alone = len(lights) == 1
        samples = np.asarray(samples)
        self.means = lights[0].means if alone else np.stack([one.means for one in lights])
        self.bases = lights[0].bases if alone else np.concatenate([one.bases for one in lights])
        self.tables = [readable(samples[number]) for one in lights for number in one.lights]
        owners = np.array([place for place, one in enumerate(lights) for _ in one.lights], np.int64)
        roots = lights[0].roots if alone else np.concatenate([one.roots for one in lights])
        self.members = np.array([table.ctypes.data for table in self.tables], np.int64), roots, owners
        self.addresses = self.means.ctypes.data, self.bases.ctypes.data


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
    components = _Components(samples, lights)
    count, masked = samples.shape[2], shares is not None
    given = np.ones((1, 1, 1), np.float32) if shares is None else shares
    offsets = (cells * (SAMPLE_BYTES * count)).astype(np.uint32)

    def fill(top: int, bottom: int) -> None:
        memory = _Memory(len(components.tables))
        _print(
            picture[top:bottom],
            first_row + top,
            _parts(),
            offsets,
            components.addresses + memory.addresses,
            components.members,
            given[top:bottom] if masked else given,
            masked,
            np.uint32(count),
            key,
            image,
            float(most),
            memory.arrays,
            target[top:bottom],
        )

    run_in_threads(fill, len(picture), threads)
    return target


def draw_printed_crops(
    samples: npt.NDArray[np.uint16],
    lights: Sequence[PrintedLight],
    pictures: Sequence[npt.NDArray[np.uint8]],
    windows: npt.NDArray[np.int64],
    cells: npt.NDArray[np.uint32],
    *,
    scales: npt.NDArray[np.float32],
    flips: npt.NDArray[np.bool_],
    seeds: npt.NDArray[np.uint64],
    threads: int = 1,
    out: npt.NDArray[np.float32],
) -> npt.NDArray[np.float32]:
    """Return N crops by colour in `out` (N, 3, height, width) float32, 1 = saturation.

    `lights`, `pictures` and `windows` (N, 4: x, y, width, height, inside the picture) are one for each; `scales`
    (N, 7) float32 as of `planar.scales_of`.

    Raises
    ------
    InputError
        `out` is of another shape or type.
    """
    width, height = windows[0, 2:].tolist()
    check_out(out, (len(pictures), 3, height, width), np.float32)
    count, table = samples.shape[2], np.asarray(samples)
    offsets = (cells * (SAMPLE_BYTES * count)).astype(np.uint32)
    most = max(len(light.lights) for light in lights)

    def fill(first: int, end: int) -> None:
        memory = _Memory(most)
        for item in range(first, end):
            components = _Components(table, lights[item : item + 1])
            _print_crop(
                pictures[item],
                tuple(windows[item].tolist()),
                bool(flips[item]),
                _parts(),
                offsets,
                components.addresses + memory.addresses,
                components.members,
                np.uint32(count),
                seeds[item],
                scales[item],
                memory.arrays,
                out[item],
            )

    run_in_threads(fill, len(pictures), threads)
    return out
