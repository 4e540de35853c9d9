"""Which cell of the chart a pixel gets so that the camera sees its colour: a pure function of (seed, image, x, y).

Colorimetric rendering wants each pixel to look as its source colour should. No cell shows just any colour, so a pixel
takes one of several whose mean does: the picture is dithered. For each of 32 x 32 x 32 source nodes there are 16
equally likely cells (`generator.rendering`); node n of a channel stands for the source code 255 n / 31. The rule is
part of the dataset format; all arithmetic is modulo 2³² but for products with 63489::

    word     h as in `choice.py`, with place 0; k3 the fourth word of its keys
             g = h ⊕ k3,  g = (g ⊕ ⌊g/2¹⁴⌋) · 0x21F0AAAD,  g ⊕ ⌊g/2¹⁶⌋
    number   e: the lower half of that word where x mod 16 < 8, else the upper
    node     ⌊(⌊63489 · 257 v / 2¹⁶⌋ + ⌊e/2⁵⌋) / 2¹¹⌋ of each channel's code v: one of its two neighbours
    cell     number e mod 16 of the node's 16

⌊e/2⁵⌋ is uniform on 0 … 2047, so that the node's mean is 31 v/255 within 2⁻¹¹. It is one number for the three
channels: a pixel takes one of the four corners of a tetrahedron around its colour and not of the eight of a cube
(tetrahedral interpolation: J. M. Kasson et al., "Performing color space conversions with three-dimensional linear
interpolation", Journal of Electronic Imaging 4, 1995). So greys come from the cells of greys alone, and the mean of
each channel is what it would be with three numbers. Number and sample of a pixel come from one word by a keyed round
of multiplying; `docs/decisions/0023-one-number-dithers-three-channels.md` says what else was tried. All lights of a
mixture see the same cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numpy import uint32

from foundation.compiled import compiled, inlined, intrinsic
from foundation.errors import InputError
from generator.kernels.choice import (
    OFFSETS_BYTES,
    SCRATCH_BYTES,
    Picture,
    check_picture,
    check_seed,
    group_address,
    packed_rows,
    row_words,
    run_in_threads,
)
from generator.kernels.vector import (
    ADDRESS,
    EIGHT,
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
    digits,
    hashed,
    load,
    store,
    void,
)

Cells = npt.NDArray[np.uint16]
"""(32768, 16) uint16: for each source node its equally likely cells, as `dither` takes them."""

NODES: Final = 32
"""Source nodes of a channel: 5 bits, the paper's."""
SLOTS: Final = 16
"""Equally likely cells of a node: 32 bytes of uint16, so that all nodes' fill the second-level cache and no more."""
PLACES_BYTES: Final = OFFSETS_BYTES
"""Bytes of where a group's cells stand in the table of cells, uint32 each."""
DITHER_BYTES: Final = 4 * (PLACES_BYTES + OFFSETS_BYTES)
"""Bytes of scratch memory for the places and choices of four groups, LOCATE_LEAD - LEAD + 1 in use."""
LOCATE_LEAD: Final = 4
"""Groups by which finding where cells stand leads fetching samples; fetching cells leads it by `choice.LEAD`."""
_MULTIPLIER: Final = 0x21F0AAAD
"""Of the round that makes g of h: the first one of `choice.py`, where its source stands."""
_SPREAD: Final = 63489
"""2048 · 31 + 1, by which 255 becomes 31 whole nodes: ⌊65535 · 63489 / 2¹⁶⌋ = 2048 · 31."""
_SHORTS: Final = ir.VectorType(I16, GROUP)
_WIDE: Final = ir.VectorType(I32, GROUP)


def _planes(builder: Builder, picture: Value) -> list[Value]:
    """Return red, green and blue, each code twice, of the 32 pixels at `picture` (96 bytes), in the order of words.

    Pixels 8 apart share a word, so that the order is 0, 8, 1, 9 … 7, 15 and the same from 16 on.
    """
    halves: list[Value] = []
    for half in range(2):
        # Four pixels for each 16 bytes of the vector; the last four are loaded so that nothing behind them is.
        starts = [3 * LANES * half + start for start in (0, 12, 24, 32)]
        halves.append(concatenated(builder, [load(builder, picture, at, ir.VectorType(I8, 16)) for at in starts]))
    planes: list[Value] = []
    for channel in range(3):
        lanes: list[int] = []
        for half in range(2):
            for pixel in (pixel for first in range(EIGHT) for pixel in (first, first + EIGHT)):
                at = 4 * LANES * half + 16 * (pixel // 4) + 3 * (pixel % 4) + channel + (4 if pixel >= 12 else 0)
                lanes += [at, at]
        both = builder.shuffle_vector(*halves, constant(ir.VectorType(I32, 4 * LANES), lanes))
        planes.append(builder.bitcast(both, _SHORTS))
    return planes


def _places(builder: Builder, picture: Value, h: Value, k3: Value, target: Value) -> None:
    """Write where the cells of the pixels at `picture` stand, whose words are `h`."""

    def mixed(word: Value, shift: int) -> Value:
        return builder.xor(word, builder.lshr(word, constant(WORDS, shift)))

    g = builder.mul(mixed(builder.xor(h, broadcast(builder, k3, WORDS)), 14), constant(WORDS, _MULTIPLIER))
    e = builder.bitcast(mixed(g, 16), _SHORTS)
    up, slot = builder.lshr(e, constant(_SHORTS, 5)), builder.and_(e, constant(_SHORTS, SLOTS - 1))

    def position(code: Value) -> Value:
        wide = builder.mul(builder.zext(code, _WIDE), constant(_WIDE, _SPREAD))
        return builder.add(builder.trunc(builder.lshr(wide, constant(_WIDE, 16)), _SHORTS), up)

    def moved(number: Value, by: int) -> Value:
        return builder.lshr(number, constant(_SHORTS, by))

    red, green, blue = map(position, _planes(builder, picture))
    green = builder.and_(moved(green, 6), constant(_SHORTS, 0x3E0))
    red = builder.and_(moved(red, 1), constant(_SHORTS, 0x7C00))
    node = builder.or_(builder.or_(moved(blue, 11), green), red)
    # A place has 19 bits: five of red, green and blue each, and four of the slot.
    low = builder.or_(builder.shl(node, constant(_SHORTS, 4)), slot)
    high = moved(node, 12)
    for half in range(2):
        order = [16 * half + 2 * (pixel % EIGHT) + pixel // EIGHT for pixel in range(LANES)]
        lanes = [lane for at in order for lane in (at, GROUP + at)]
        store(builder, builder.shuffle_vector(low, high, constant(_WIDE, lanes)), target, 4 * LANES * half)


@intrinsic
def find_places(typing: Any, picture: Any, word: Any, k0: Any, k1: Any, k2: Any, k3: Any, target: Any) -> Any:
    """Write to `target` where in the table of cells, uint32 in steps of a cell, the 32 pixels at `picture` have theirs.

    `word` is the number of the group's first word; 96 bytes are read, 128 written.
    """
    del typing, picture, word, k0, k1, k2, k3, target
    number = "uint32"

    def emit(
        builder: Builder, picture: Value, word: Value, k0: Value, k1: Value, k2: Value, k3: Value, target: Value
    ) -> None:
        _places(builder, picture, hashed(builder, word, (k0, k1, k2)), k3, target)

    return void(emit, ADDRESS, number, number, number, number, number, ADDRESS)


@intrinsic
def find_places_and_choose(
    typing: Any, picture: Any, word: Any, k0: Any, k1: Any, k2: Any, k3: Any, count: Any, target: Any, choices: Any
) -> Any:
    """Do `find_places`, and write to `choices` the offsets, uint32 bytes, of the samples among those of a colour."""
    del typing, picture, word, k0, k1, k2, k3, count, target, choices
    number = "uint32"

    def emit(
        builder: Builder,
        picture: Value,
        word: Value,
        k0: Value,
        k1: Value,
        k2: Value,
        k3: Value,
        count: Value,
        target: Value,
        choices: Value,
    ) -> None:
        h = hashed(builder, word, (k0, k1, k2))
        _places(builder, picture, h, k3, target)
        for half, chosen in enumerate(digits(builder, h, count)):
            store(builder, builder.mul(chosen, constant(WORDS, SAMPLE_BYTES)), choices, 4 * LANES * half)

    return void(emit, ADDRESS, number, number, number, number, number, number, ADDRESS, ADDRESS)


def _cells(builder: Builder, places: Value, cells: Value, half: int) -> Value:
    """Return the cells, i16, of 16 pixels whose places `find_places` wrote.

    They are put together in a vector: storing each would fill the queue of stores, which then holds too few pixels for
    the processor to wait for many samples at once.
    """
    named: Value = ir.Constant(ir.VectorType(I16, LANES), ir.Undefined)
    for lane in range(LANES):
        place = builder.zext(load(builder, places, 4 * (LANES * half + lane), I32), I64)
        cell = load(builder, builder.add(cells, builder.shl(place, ir.Constant(I64, 1))), 0, I16)
        named = builder.insert_element(named, cell, ir.Constant(I32, lane))
    return named


@intrinsic
def write_offsets(typing: Any, places: Any, cells: Any, stride: Any, choices: Any, target: Any) -> Any:
    """Write the offsets of the samples of 32 pixels: their cells times `stride`, plus choices."""
    del typing, places, cells, stride, choices, target

    def emit(builder: Builder, places: Value, cells: Value, stride: Value, choices: Value, target: Value) -> None:
        factor = broadcast(builder, stride, WORDS)
        for half in range(2):
            named = builder.zext(_cells(builder, places, cells, half), WORDS)
            chosen = load(builder, choices, 4 * LANES * half, WORDS)
            store(builder, builder.add(builder.mul(named, factor), chosen), target, 4 * LANES * half)

    return void(emit, ADDRESS, ADDRESS, "uint32", ADDRESS, ADDRESS)


@intrinsic
def fetch_cells(typing: Any, places: Any, cells: Any, target: Any) -> Any:
    """Write the cells, uint16, of the 32 pixels whose places `find_places` wrote."""
    del typing, places, cells, target

    def emit(builder: Builder, places: Value, cells: Value, target: Value) -> None:
        for half in range(2):
            store(builder, _cells(builder, places, cells, half), target, 2 * LANES * half)

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

    return void(emit, ADDRESS, "uint32", ADDRESS)


@inlined
def dither_row(cells: int, y: Any, image: Any, seed: Any) -> Any:
    """Return the keys of row `y` that `choice.row_keys` returns, and the table of cells with the row's fourth word."""
    keys, k3 = row_words(y, 0, image, seed)
    return keys, (cells, k3)


@inlined
def _slots(scratch: int, group: int) -> Any:
    """Return where in `DITHER_BYTES` of memory a group's places and choices stand until they are used."""
    slot = scratch + (PLACES_BYTES + OFFSETS_BYTES) * (group & 3)
    return slot, slot + PLACES_BYTES


@inlined
def locate(row: int, width: int, group: int, inks: Any, keys: Any, count: Any, scratch: int, memory: int) -> None:
    """Do the first step of a group: find where the cells of a row's pixels from x = 32 `group` on stand.

    The two steps are to be one to three groups apart, so that neither waits. `memory` is `DITHER_BYTES` long.
    """
    places, choices = _slots(memory, group)
    source, word = group_address(row, width, group, scratch), uint32(LANES * group)
    find_places_and_choose(source, word, keys[0], keys[1], keys[2], inks[1], count, places, choices)


@inlined
def offset_cells(group: int, inks: Any, stride: Any, memory: int, target: int) -> None:
    """Do the second step: write what `choice.choose_group` writes, for the cells; `stride` is a colour's bytes."""
    places, choices = _slots(memory, group)
    write_offsets(places, inks[0], stride, choices, target)


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
    memory = scratch + SCRATCH_BYTES
    named = memory + DITHER_BYTES
    for y in range(rows):
        keys, inks = dither_row(cells, first_row + y, image, seed)
        row, to = picture + y * pitch, target + y * target_pitch
        for group in range(groups + 1):
            if group < groups:
                source, word = group_address(row, width, group, scratch), uint32(LANES * group)
                find_places(source, word, keys[0], keys[1], keys[2], inks[1], _slots(memory, group)[0])
            if group:
                fetch_cells(_slots(memory, group - 1)[0], cells, named + 2 * GROUP * (group - 1))
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

    - `cells`: (32768, 16) uint16, those of a node in half a line of the cache; read-only.
    - `bits`: bits of a channel of the chart that has them.
    """

    cells: Cells
    bits: int


def checked_cells(cells: Cells | CellTable, bits: int) -> CellTable:
    """Return a table of cells to draw from: itself, if it was checked already.

    `cells`: (32768, 16) uint16, cells of a chart of `bits` bits a channel.
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

    `picture`: (H, W, 3) uint8, sRGB codes. `cells`: (32768, 16) uint16: for each source node, (red << 10) | (green <<
    5) | blue, 16 equally likely cells of the chart, ((r << 2n) | (g << n) | b) for n bits a channel; such as
    `CellMixtures.cells` of `generator.rendering`, or what `checked_cells` made of them, which is quicker for many small
    pictures. `out`: (H, W, 3) uint8 to fill instead of a new array. Returns (H, W, 3) uint8, the cells' codes in the
    upper n bits of each, 0 below.

    Examples
    --------
    A chart of one bit a channel, whose cells stand for the nodes nearest to them: .44 of the pixels of a middle grey
    become white.

    >>> node = np.arange(32768)
    >>> near = (node >> 14 & 1) << 2 | (node >> 9 & 1) << 1 | node >> 4 & 1
    >>> cells = np.repeat(near[:, None], 16, axis=1).astype(np.uint16)
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

    `picture`: (H, W, 3) uint8, sRGB codes. Returns (32768,) int64.

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
