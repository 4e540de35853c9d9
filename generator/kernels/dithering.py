"""Which cell of the chart a pixel gets so that the camera sees its colour: a pure function of (seed, image, x, y).

Colorimetric rendering wants each pixel to look as its source colour should. No cell shows just any colour, so a pixel
takes one of several whose mean does: the picture is dithered. For each of 32 x 32 x 32 source nodes there are 32
equally likely cells (`generator.rendering`); node n of a channel stands for the source code 255 n / 31. The rule is
part of the dataset format; all arithmetic is modulo 2³² but for products with 255::

    keys     k0 … k3: the words of Philox4x32-10 with counter (y, 0, image, 8) and the seed as key
    word     i = 16 ⌊x/32⌋ + x mod 16,  h = (i ⊕ k0) · 0x21F0AAAD ⊕ k1,  h = (h ⊕ ⌊h/2¹⁶⌋) · 0x735A2D97 ⊕ k2,
             h = (h ⊕ ⌊h/2¹⁵⌋) · 0x31848BAB,  g = h ⊕ k3,  g = (g ⊕ ⌊g/2¹⁴⌋) · 0x21F0AAAD,
             e = h ⊕ ⌊h/2¹⁶⌋,  f = g ⊕ ⌊g/2¹⁶⌋; of both the lower half where x mod 32 < 16, else the upper
    digits   p = 255 e and q = 255 f: u = ⌊p/2¹⁶⌋ for blue, ⌊255 (p mod 2¹⁶)/2¹⁶⌋ for red, ⌊q/2¹⁶⌋ for green
    node     ⌊(31 v + u)/255⌋ of each channel's code v: one of its two neighbours
    cell     number ⌊(q mod 2¹⁶)/2¹¹⌋ of the node's 32

u is one of 0 … 254, each as likely within 2⁻¹⁶, so that the node's mean is 31 v/255 less at most 2⁻¹⁶. Two channels
round up together, and a channel with a certain cell, with a probability within .001 of what independent ones have.
Rows are keyed by 128 random bits of a purpose of their own, so that cells depend neither on other rows nor on the
samples that `choice.py` draws. All lights of a mixture see the same cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numba
import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types, uint32
from numba.extending import intrinsic

from foundation.compiled import compiled
from foundation.errors import InputError
from generator.kernels.arguments import Picture, check_picture, check_seed, packed_rows, run_in_threads
from generator.kernels.choice import OFFSETS_BYTES, SCRATCH_BYTES, group_address, philox4x32
from generator.kernels.vector import (
    ADDRESS,
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
    copy1,
    load,
    store,
    void,
    write_choices,
)
from generator.philox import DITHERING

Cells = npt.NDArray[np.uint16]
"""(32768, 32) uint16: for each source node its equally likely cells, as `dither` takes them."""

NODES: Final = 32
"""Source nodes of a channel: 5 bits, the paper's."""
SLOTS: Final = 32
"""Equally likely cells of a node: 64 bytes of uint16, a line of the cache."""
PLACES_BYTES: Final = OFFSETS_BYTES
"""Bytes of where a group's cells stand in the table of cells, uint32 each."""
DITHER_BYTES: Final = 4 * PLACES_BYTES
"""Bytes of scratch memory behind `choice.SCRATCH_BYTES`: the places of four groups."""

_PURPOSE: Final = np.uint32(DITHERING)
_MULTIPLIERS: Final = (0x21F0AAAD, 0x735A2D97, 0x31848BAB)
"""Of the rounds; those of `choice.py`, where their source stands. The fourth round has the first's."""
_SHORTS: Final = ir.VectorType(I16, GROUP)
_WIDE: Final = ir.VectorType(I32, GROUP)


def _mixed(builder: Builder, h: Value, shift: int) -> Value:
    return builder.xor(h, builder.lshr(h, constant(WORDS, shift)))


def _random(builder: Builder, word: Value, keys: Any) -> tuple[Value, Value]:
    """Return e and f of the 32 pixels of a group: 16-bit numbers of pixels 0, 16, 1, 17 and so on."""
    k0, k1, k2, k3 = (broadcast(builder, key, WORDS) for key in keys)
    m0, m1, m2 = (constant(WORDS, multiplier) for multiplier in _MULTIPLIERS)
    h = builder.add(broadcast(builder, word, WORDS), constant(WORDS, range(LANES)))
    h = builder.xor(builder.mul(builder.xor(h, k0), m0), k1)
    h = builder.xor(builder.mul(_mixed(builder, h, 16), m1), k2)
    h = builder.mul(_mixed(builder, h, 15), m2)
    g = builder.mul(_mixed(builder, builder.xor(h, k3), 14), m0)
    return builder.bitcast(_mixed(builder, h, 16), _SHORTS), builder.bitcast(_mixed(builder, g, 16), _SHORTS)


def _planes(builder: Builder, picture: Value) -> list[Value]:
    """Return red, green and blue of the 32 pixels at `picture` (96 bytes), in the order of `_random`."""
    halves: list[Value] = []
    for half in range(2):
        # Four pixels for each 16 bytes of the vector; the last four are loaded so that nothing behind them is.
        starts = [3 * LANES * half + start for start in (0, 12, 24, 32)]
        halves.append(concatenated(builder, [load(builder, picture, at, ir.VectorType(I8, 16)) for at in starts]))
    planes: list[Value] = []
    for channel in range(3):
        lanes: list[int] = []
        for pixel in range(LANES):
            at = 16 * (pixel // 4) + 3 * (pixel % 4) + channel + (4 if pixel >= 12 else 0)
            lanes += [at, at, 4 * LANES + at, 4 * LANES + at]
        both = builder.shuffle_vector(*halves, constant(ir.VectorType(I32, 4 * LANES), lanes))
        planes.append(builder.and_(builder.bitcast(both, _SHORTS), constant(_SHORTS, 0xFF)))
    return planes


def _digit(builder: Builder, numbers: Value) -> tuple[Value, Value]:
    """Return the first digits in base 255 of 16-bit fractions, and the fractions that are left."""
    wide = builder.mul(builder.zext(numbers, _WIDE), constant(_WIDE, 255))
    return (
        builder.trunc(builder.lshr(wide, constant(_WIDE, 16)), _SHORTS),
        builder.mul(numbers, constant(_SHORTS, 255)),
    )


@intrinsic
def find_places(typing: Any, picture: Any, word: Any, k0: Any, k1: Any, k2: Any, k3: Any, target: Any) -> Any:
    """Write to `target` where in the table of cells, uint32 in steps of a cell, the 32 pixels at `picture` have theirs.

    `word` is the number of the group's first word; 96 bytes are read, 128 written.
    """
    del typing, picture, word, k0, k1, k2, k3, target
    number = types.uint32

    def emit(
        builder: Builder, picture: Value, word: Value, k0: Value, k1: Value, k2: Value, k3: Value, target: Value
    ) -> None:
        e, f = _random(builder, word, (k0, k1, k2, k3))
        up_blue, rest = _digit(builder, e)
        up_red, _ = _digit(builder, rest)
        up_green, rest = _digit(builder, f)
        slot = builder.lshr(rest, constant(_SHORTS, 11))

        def node(code: Value, up: Value) -> Value:
            # ⌊s/255⌋ of 0 ≤ s < 65280 is ⌊(t + ⌊t/256⌋)/256⌋ with t = s + 1.
            t = builder.add(builder.mul(code, constant(_SHORTS, NODES - 1)), builder.add(up, constant(_SHORTS, 1)))
            eighth = constant(_SHORTS, 8)
            return builder.lshr(builder.add(t, builder.lshr(t, eighth)), eighth)

        red, green, blue = map(node, _planes(builder, picture), (up_red, up_green, up_blue))
        # A place has 20 bits: five of red, green, blue and slot each.
        low = builder.or_(
            builder.or_(builder.shl(red, constant(_SHORTS, 15)), builder.shl(green, constant(_SHORTS, 10))),
            builder.or_(builder.shl(blue, constant(_SHORTS, 5)), slot),
        )
        high = builder.lshr(red, constant(_SHORTS, 1))
        for half in range(2):
            lanes = [lane for pixel in range(LANES) for lane in (2 * pixel + half, GROUP + 2 * pixel + half)]
            store(builder, builder.shuffle_vector(low, high, constant(_WIDE, lanes)), target, 4 * LANES * half)

    return void(emit, ADDRESS, number, number, number, number, number, ADDRESS)


def _cell(builder: Builder, places: Value, cells: Value, pixel: int) -> Value:
    """Return the cell, i16, of a pixel whose place `find_places` wrote."""
    place = builder.zext(load(builder, places, 4 * pixel, I32), I64)
    return load(builder, builder.add(cells, builder.shl(place, ir.Constant(I64, 1))), 0, I16)


def _offset(builder: Builder, places: Value, cells: Value, stride: Value, choices: Value, pixel: int) -> Value:
    """Return the offset, i32, of the sample of a pixel; `stride` is the bytes of a colour's samples."""
    colour = builder.zext(_cell(builder, places, cells, pixel), I32)
    return builder.add(builder.mul(colour, stride), load(builder, choices, 4 * pixel, I32))


@intrinsic
def write_offsets(typing: Any, places: Any, cells: Any, stride: Any, choices: Any) -> Any:
    """Replace the 32 offsets at `choices` within a colour's samples, by those in the samples of each pixel's cell."""
    del typing, places, cells, stride, choices

    def emit(builder: Builder, places: Value, cells: Value, stride: Value, choices: Value) -> None:
        for pixel in range(GROUP):
            store(builder, _offset(builder, places, cells, stride, choices, pixel), choices, 4 * pixel)

    return void(emit, ADDRESS, ADDRESS, types.uint32, ADDRESS)


@intrinsic
def copy_dithered(typing: Any, places: Any, cells: Any, stride: Any, choices: Any, samples: Any, target: Any) -> Any:
    """Write the samples of a group's 32 pixels, and two bytes more."""
    del typing, places, cells, stride, choices, samples, target

    def emit(
        builder: Builder, places: Value, cells: Value, stride: Value, choices: Value, samples: Value, target: Value
    ) -> None:
        for pixel in range(GROUP):
            offset = builder.zext(_offset(builder, places, cells, stride, choices, pixel), I64)
            store(builder, load(builder, builder.add(samples, offset), 0, I64), target, SAMPLE_BYTES * pixel)

    return void(emit, ADDRESS, ADDRESS, types.uint32, ADDRESS, ADDRESS, ADDRESS)


@intrinsic
def fetch_cells(typing: Any, places: Any, cells: Any, target: Any) -> Any:
    """Write the cells, uint16, of the 32 pixels whose places `find_places` wrote."""
    del typing, places, cells, target

    def emit(builder: Builder, places: Value, cells: Value, target: Value) -> None:
        for pixel in range(GROUP):
            store(builder, _cell(builder, places, cells, pixel), target, 2 * pixel)

    return void(emit, ADDRESS, ADDRESS, ADDRESS)


@intrinsic
def write_codes(typing: Any, cells: Any, bits: Any, target: Any) -> Any:
    """Write the codes of 32 cells, uint16 each, as 96 bytes, and four bytes more."""
    del typing, cells, bits, target

    def emit(builder: Builder, cells: Value, bits: Value, target: Value) -> None:
        ones = builder.sub(builder.shl(ir.Constant(I32, 1), bits), ir.Constant(I32, 1))
        for half in range(2):
            named = builder.zext(load(builder, cells, 2 * LANES * half, ir.VectorType(I16, LANES)), WORDS)
            codes: Value = constant(WORDS, 0)
            for channel in range(3):
                down = builder.mul(bits, ir.Constant(I32, 2 - channel))
                up = builder.sub(ir.Constant(I32, 8 * (channel + 1)), bits)
                its = builder.lshr(named, broadcast(builder, down, WORDS))
                its = builder.and_(its, broadcast(builder, ones, WORDS))
                codes = builder.or_(codes, builder.shl(its, broadcast(builder, up, WORDS)))
            each = builder.bitcast(codes, ir.VectorType(I8, 4 * LANES))
            for four in range(4):
                lanes = [16 * four + 4 * pixel + channel for pixel in range(4) for channel in range(3)]
                packed = builder.shuffle_vector(each, each, constant(ir.VectorType(I32, 16), [*lanes, *lanes[:4]]))
                store(builder, packed, target, 3 * LANES * half + 12 * four)

    return void(emit, ADDRESS, types.uint32, ADDRESS)


@numba.njit(inline="always")
def dither_keys(cells: int, y: Any, image: Any, seed: Any) -> Any:
    """Return the table of cells and the four keys (uint32) of row `y`; without a table, 0, the keys do not matter."""
    if cells:
        k0, k1, k2, k3 = philox4x32(uint32(y), uint32(0), uint32(image), _PURPOSE, seed)
    else:
        k0 = k1 = k2 = k3 = uint32(0)
    return cells, k0, k1, k2, k3


@numba.njit(inline="always")
def places_slot(scratch: int, group: int) -> int:
    """Return where in a thread's scratch memory the places of `group` stand until they are used."""
    return scratch + SCRATCH_BYTES + PLACES_BYTES * (group & 3)


@numba.njit(inline="always")
def find_group(source: int, group: int, inks: Any, places: int) -> None:
    """Write where the cells of the 32 pixels at `source` stand; `inks` is the row's, from `dither_keys`."""
    find_places(source, uint32(LANES * group), inks[1], inks[2], inks[3], inks[4], places)


@numba.njit(inline="always")
def choose_dithered(
    row: int, width: int, group: int, inks: Any, keys: Any, count: Any, scratch: int, places: int, target: int
) -> None:
    """Do what `choice.choose_group` does, for the cells that stand for the pixels; `places` is memory for a group."""
    find_group(group_address(row, width, group, scratch), group, inks, places)
    write_choices(uint32(LANES * group), keys[0], keys[1], keys[2], count, target)
    write_offsets(places, inks[0], uint32(SAMPLE_BYTES * count), target)


@compiled
def _dither(
    picture: int,
    pitch: int,
    width: int,
    rows: int,
    cells: int,
    bits: Any,
    seed: Any,
    image: int,
    first_row: int,
    target: int,
    target_pitch: int,
    scratch: int,
) -> None:
    """Fill rows of codes; scratch memory holds a group's pixels, the places of four, and the cells of a row."""
    groups, whole = (width + GROUP - 1) // GROUP, width // GROUP
    named = scratch + SCRATCH_BYTES + DITHER_BYTES
    for y in range(rows):
        inks = dither_keys(cells, first_row + y, image, seed)
        row, to = picture + y * pitch, target + y * target_pitch
        for group in range(groups + 1):
            if group < groups:
                find_group(group_address(row, width, group, scratch), group, inks, places_slot(scratch, group))
            if group:
                fetch_cells(places_slot(scratch, group - 1), cells, named + 2 * GROUP * (group - 1))
        for group in range(groups):
            # Four bytes behind a group are written, which are the next one's or nobody's.
            safe = group < whole - 1
            at = to + 3 * GROUP * group if safe else scratch
            write_codes(named + 2 * GROUP * group, bits, at)
            if not safe:
                for i in range(3 * min(GROUP, width - GROUP * group)):
                    copy1(scratch + i, to + 3 * GROUP * group + i)


@dataclass(frozen=True, eq=False)
class CellTable:
    """A table of cells as compiled code reads it, checked once.

    Attributes
    ----------
    cells
        (32768, 32) uint16, those of a node in a line of the cache; read-only.
    bits
        Bits of a channel of the chart that has them.
    """

    cells: Cells
    bits: int


def checked_cells(cells: Cells | CellTable, bits: int) -> CellTable:
    """Return a table of cells to draw from: itself, if it was checked already.

    Parameters
    ----------
    cells
        (32768, 32) uint16, cells of a chart of `bits` bits a channel.
    bits
        1 … 5.

    Raises
    ------
    InputError
        They are of another shape or type, or a cell is not in the chart.
    """
    if isinstance(cells, CellTable):
        if cells.bits != bits:
            raise InputError(f"the cells are of a chart of {cells.bits} bits a channel, the samples of one of {bits}")
        return cells
    if cells.dtype != np.uint16 or cells.shape != (NODES**3, SLOTS):
        raise InputError(f"the cells are {cells.dtype} {cells.shape}, expected uint16 ({NODES**3}, {SLOTS})")
    if not 1 <= bits <= 5:
        raise InputError(f"the chart has {bits} bits a channel, expected 1 to 5")
    if int(cells.max()) >> 3 * bits:
        raise InputError(f"cell {cells.max()} is not in a chart of {bits} bits a channel, expected 0 to {8**bits - 1}")
    memory = np.empty(cells.size + LINE // 2, np.uint16)
    first = -memory.ctypes.data % LINE // 2
    aligned = memory[first : first + cells.size].reshape(cells.shape)
    aligned[...] = cells
    aligned.flags.writeable = False
    return CellTable(aligned, bits)


def dither(
    picture: Picture,
    cells: Cells | CellTable,
    bits: int,
    seed: int = 0,
    image: int = 0,
    *,
    first_row: int = 0,
    threads: int = 1,
    out: Picture | None = None,
) -> Picture:
    """Return the code picture of `picture`: codes of the cells of the chart that stand for its colours.

    The rule stands at the head of this file. Every kernel draws from a code picture as from any picture.

    Parameters
    ----------
    picture
        (H, W, 3) uint8, sRGB codes.
    cells
        (32768, 32) uint16: for each source node, (red << 10) | (green << 5) | blue, 32 equally likely cells of the
        chart, ((r << 2n) | (g << n) | b) for n bits a channel; such as `CellMixtures.cells` of `generator.rendering`,
        or what `checked_cells` made of them, which is quicker for many small pictures.
    bits
        n, 1 … 5.
    seed, image, first_row, threads
        As for `rendering.draw_samples`.
    out
        (H, W, 3) uint8 to fill instead of a new array.

    Returns
    -------
    ndarray
        (H, W, 3) uint8, the cells' codes in the upper n bits of each, 0 below.

    Raises
    ------
    InputError
        A shape, type or number is not as above.

    Examples
    --------
    A chart of one bit a channel, whose cells stand for the nodes nearest to them: .44 of the pixels of a middle grey
    become white.

    >>> node = np.arange(32768)
    >>> near = (node >> 14 & 1) << 2 | (node >> 9 & 1) << 1 | node >> 4 & 1
    >>> cells = np.repeat(near[:, None], 32, axis=1).astype(np.uint16)
    >>> codes = dither(np.full((64, 64, 3), 127, np.uint8), cells, bits=1)
    >>> np.unique(codes[..., 0]), round(float((codes[..., 0] > 0).mean()), 1)
    (array([  0, 128], dtype=uint8), 0.4)
    """
    check_picture(picture)
    table = checked_cells(cells, bits)
    key = check_seed(seed, image)
    if out is None:
        out = np.empty(picture.shape, np.uint8)
    elif out.dtype != np.uint8 or out.shape != picture.shape or not out.flags.writeable:
        raise InputError(f"the target is {out.dtype} {out.shape}, expected uint8 {picture.shape} that can be written")
    source = packed_rows(picture)
    work = out if out.strides[1:] == (3, 1) else np.empty(picture.shape, np.uint8)
    width = picture.shape[1]

    def fill(top: int, bottom: int) -> None:
        scratch = np.empty(SCRATCH_BYTES + DITHER_BYTES + 2 * (width + GROUP), np.uint8)
        _dither(
            source[top:].ctypes.data,
            source.strides[0],
            width,
            bottom - top,
            table.cells.ctypes.data,
            np.uint32(bits),
            key,
            image,
            first_row + top,
            work[top:].ctypes.data,
            work.strides[0],
            scratch.ctypes.data,
        )

    run_in_threads(fill, len(picture), threads)
    if work is not out:
        out[...] = work
    return out


@compiled
def _count_nodes(picture: Any, nearest: Any, counts: Any) -> None:
    for y in range(picture.shape[0]):
        for x in range(picture.shape[1]):
            red, green, blue = nearest[picture[y, x, 0]], nearest[picture[y, x, 1]], nearest[picture[y, x, 2]]
            counts[red << 10 | green << 5 | blue] += 1


def nearest_nodes(picture: Picture) -> npt.NDArray[np.int64]:
    """Return how many pixels of a picture are nearest to each source node.

    Parameters
    ----------
    picture
        (H, W, 3) uint8, sRGB codes.

    Returns
    -------
    ndarray
        (32768,) int64.

    Raises
    ------
    InputError
        The picture is of another shape or type.

    Examples
    --------
    >>> np.flatnonzero(nearest_nodes(np.array([[[255, 0, 4], [0, 0, 5]]], np.uint8)))
    array([    1, 31744])
    """
    check_picture(picture)
    nearest = np.rint(np.arange(256) * (NODES - 1) / 255).astype(np.int64)
    counts = np.zeros(NODES**3, np.int64)
    _count_nodes(picture, nearest, counts)
    return counts
