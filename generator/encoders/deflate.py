"""Deflate (RFC 1951) for the rows of a 16-bit RGB PNG, made for images drawn from a table.

Two ways to pack a band of rows, whichever is smaller:

    repeats     no filter; a pixel that came before as it is, anywhere in the 32 KiB that deflate looks back, becomes a
                match of six bytes, or more where runs repeat. A table has only so many samples of a colour, so half
                the pixels of a photograph find one. Matches of less than a pixel are not looked for.
    neighbours  the difference to the pixel on the left (filter Sub), in Huffman codes alone. Smaller where a picture
                is so smooth that few pixels share a colour.

Every band is one block with its own codes, ends on a whole byte and looks back into no other, so bands can be packed
at once by several threads and put one after the other.

Which is smaller is tried on a few rows from the band's middle. Of a band that is not small, the codes of repeats come
from every few rows: counting all of them takes a third as long as the packing, and saves a six-hundredth.

A band is packed in one compiled call, in which the interpreter's lock is let go once: taking it back between steps of
a millisecond costs several threads more than the steps.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import uint16, uint32, uint64

from generator.encoders.huffman import (
    DISTANCES,
    END,
    LITERALS,
    LONGEST,
    code_lengths,
    codes_of,
    flush,
    put,
    put_head,
)
from generator.kernels.compiled import compiled

WIDEST: Final = 1 << 28
"""Pixels of a row that positions are counted for."""

_WINDOW: Final = 32768
_WINDOW_PIXELS: Final = _WINDOW // 6
_LONGEST_RUN: Final = 258 // 6
"""Pixels of the longest match."""
_PLACES: Final = 1 << 15
"""Of the table of pixels seen: the last one with each hash."""
_MIX: Final = 0x9E3779B97F4B
"""Odd, so that multiplying modulo 2⁴⁸ gives every pixel a number of its own."""
_TRIED: Final = 3 * _WINDOW_PIXELS
_STEP: Final = 8
"""Of a large band, one row of so many is counted."""
_FEW_ROWS: Final = 4
"""Rows that are counted at least."""
_FEW: Final = 1 << 13
"""Symbols from which the counted rows speak for the others."""
_ROOM: Final = 1024
"""Bytes for the head of a block, its end, and what a flush writes beyond; no byte of a row takes two, see `LONGEST`."""


def _distance_symbol(distance: int) -> int:
    """Return the symbol of a distance 1 … 32768 (RFC 1951, 3.2.5)."""
    bits = (distance - 1).bit_length()
    return distance - 1 if bits <= 2 else 2 * (bits - 1) + ((distance - 1) >> (bits - 2) & 1)


def _length_symbol(length: int) -> tuple[int, int, int]:
    """Return symbol, extra bits and their value of a match's length 3 … 258 bytes (RFC 1951, 3.2.5)."""
    if length == 258:
        return 285, 0, 0
    bits = max((length - 3).bit_length() - 3, 0)
    return 257 + 4 * bits + ((length - 3) >> bits), bits, (length - 3) & ((1 << bits) - 1)


# Symbols of distances: of 1 … 256, then of every 128th.
_DISTANCE_SYMBOLS: Final = np.array(
    [_distance_symbol(distance) for distance in (*range(1, 257), *range(1, _WINDOW, 128))], dtype=np.uint8
)
_DISTANCE_BITS: Final = np.array([max(symbol // 2 - 1, 0) for symbol in range(DISTANCES)], dtype=np.int64)
# Symbol, extra bits and their value of a run of so many pixels; extra bits of each symbol.
_RUNS: Final = np.array([(0, 0, 0), *(_length_symbol(6 * run) for run in range(1, _LONGEST_RUN + 1))], dtype=np.int64)
_ONE: Final = int(_RUNS[1, 0])
"""The symbol of a match of one pixel."""
_LENGTH_BITS: Final = np.zeros(LITERALS, np.int64)
_LENGTH_BITS[_RUNS[:, 0]] = _RUNS[:, 1]


@compiled
def _split(image: Any, rows: Any) -> Any:
    """Fill `rows` with the unfiltered bytes of `image`, upper before lower, a 0 before each row.

    Returns
    -------
    int
        Every sample's bits joined: no sample is larger.
    """
    joined = uint16(0)
    for y in range(image.shape[0]):
        samples, row = image[y].reshape(-1), rows[y]
        row[0] = 0
        # Joined by row, or the compiler makes no vectors of it.
        of_row = uint16(0)
        for i in range(len(samples)):
            row[1 + 2 * i] = samples[i] >> 8
            row[2 + 2 * i] = samples[i] & 255
            of_row |= samples[i]
        joined |= of_row
    return joined


@compiled
def _subtract(rows: Any, filtered: Any) -> None:
    """Fill `filtered` with `rows` after the filter Sub (ISO/IEC 15948, 9.2)."""
    for y in range(rows.shape[0]):
        left, row, target = rows[y, 1:], rows[y, 7:], filtered[y, 7:]
        filtered[y, 0] = 1
        for i in range(6):
            filtered[y, 1 + i] = left[i]
        for i in range(len(row)):
            target[i] = row[i] - left[i]


@compiled
def _count_bytes(rows: Any, literals: Any) -> None:
    # Four counters, so that equal bytes do not wait for each other.
    counts = np.zeros((4, 256), np.uint32)
    data = rows.reshape(-1)
    whole = len(data) // 4 * 4
    for i in range(0, whole, 4):
        counts[0, data[i]] += 1
        counts[1, data[i + 1]] += 1
        counts[2, data[i + 2]] += 1
        counts[3, data[i + 3]] += 1
    for i in range(whole, len(data)):
        counts[0, data[i]] += 1
    for value in range(256):
        for part in range(4):
            literals[value] += counts[part, value]


@compiled
def find_repeats(image: Any, seen: Any, distances: Any) -> None:
    """Fill `distances` (rows, columns) with the bytes back to the last equal pixel, 0 where there is none in reach.

    `seen` holds for each hash of a pixel where it was last seen, in bytes, above the bits of the pixel that the
    hash leaves open. As mixing is one to one, what agrees in both is the pixel itself.
    """
    left = uint64(48) - uint64(15)
    open_bits = (uint64(1) << left) - uint64(1)
    mask = (uint64(1) << uint64(48)) - uint64(1)
    for place in range(_PLACES):
        seen[place] = 0
    samples, backs = image.reshape(-1), distances.reshape(-1)
    # Empty places lie out of reach of every pixel. Unsigned numbers everywhere, since one that may be negative makes
    # every index a choice.
    position = uint64(_WINDOW + 1)
    at, pixels = uint64(0), uint64(0)
    for _ in range(image.shape[0]):
        position += uint64(1)
        for _ in range(image.shape[1]):
            pixel = (
                uint64(samples[at])
                | (uint64(samples[at + uint64(1)]) << uint64(16))
                | (uint64(samples[at + uint64(2)]) << uint64(32))
            )
            mixed = (pixel * uint64(_MIX)) & mask
            last = seen[mixed >> left]
            seen[mixed >> left] = (position << left) | (mixed & open_bits)
            back = position - (last >> left)
            # Whether a pixel repeats cannot be foreseen, so there is no branch on it: 0 where it is equal and in reach.
            other = ((last ^ mixed) & open_bits) | ((back - uint64(1)) // uint64(_WINDOW))
            backs[pixels] = uint16(back * uint64(other == uint64(0)))
            at += uint64(3)
            pixels += uint64(1)
            position += uint64(6)


@compiled
def _symbol_of(distance: Any) -> Any:
    """Return the symbol of a distance; some symbol where there is none."""
    back = (uint32(distance) - uint32(1)) & uint32(_WINDOW - 1)
    return _DISTANCE_SYMBOLS[back if back < uint32(256) else uint32(256) + (back >> uint32(7))]


@compiled
def _count(rows: Any, distances: Any, step: int, literals: Any, backs: Any) -> None:
    """Add the symbols of one row of every `step` to the frequencies of literals and distances."""
    # Whether a pixel is a match cannot be foreseen, so there is no branch on it; each of a pixel's bytes has a counter
    # of its own, so that equal ones do not wait for each other.
    counts = np.zeros((6, 256), np.uint32)
    matches = 0
    for y in range(step // 2, rows.shape[0], step):
        row, back = rows[y], distances[y]
        literals[row[0]] += 1
        run, before = 1, uint32(0)
        for x in range(len(back)):
            distance = uint32(back[x])
            if distance == before and distance != uint32(0) and run < _LONGEST_RUN:
                literals[_RUNS[run, 0]] -= 1
                run += 1
                literals[_RUNS[run, 0]] += 1
                continue
            run, before = 1, distance
            literal = uint32(distance == uint32(0))
            for i in range(6):
                counts[i, row[1 + 6 * x + i]] += literal
            match = np.int64(uint32(1) - literal)
            backs[_symbol_of(distance)] += match
            matches += match
    literals[_ONE] += matches
    for value in range(256):
        for i in range(6):
            literals[value] += counts[i, value]


@compiled
def _bits(literals: Any, backs: Any) -> int:
    """Return the bits of symbols of such frequencies in their best codes."""
    lengths, back_lengths = code_lengths(literals, LONGEST), code_lengths(backs, LONGEST)
    total = 0
    for symbol in range(LITERALS):
        total += literals[symbol] * (lengths[symbol] + _LENGTH_BITS[symbol])
    for symbol in range(DISTANCES):
        total += backs[symbol] * (back_lengths[symbol] + _DISTANCE_BITS[symbol])
    return total


@compiled
def _repeats_pay(image: Any, plain: Any, filtered: Any, distances: Any, seen: Any) -> bool:
    """Return whether repeats pack the middle of a band into fewer bits than neighbours."""
    height, width = distances.shape
    tried = min(height, 1 + _TRIED // width)
    top = (height - tried) // 2
    # The first rows of a look back have nothing before them.
    counted = top + min(tried - 1, _WINDOW_PIXELS // width)
    end = top + tried
    find_repeats(image[top:end], seen, distances[top:end])
    literals, backs = np.zeros(LITERALS, np.int64), np.zeros(DISTANCES, np.int64)
    _count(plain[counted:end], distances[counted:end], 1, literals, backs)
    _subtract(plain[counted:end], filtered[counted:end])
    differences = np.zeros(LITERALS, np.int64)
    _count_bytes(filtered[counted:end], differences)
    return _bits(literals, backs) <= _bits(differences, np.zeros(DISTANCES, np.int64))


@compiled
def _estimate(plain: Any, distances: Any, literals: Any, backs: Any) -> None:
    """Fill the frequencies of a band's literals and distances, or near them and of none 0 that might occur."""
    step = max(1, min(_STEP, len(distances) // _FEW_ROWS))
    _count(plain, distances, step, literals, backs)
    if step > 1 and literals.sum() < _FEW:
        literals[:], backs[:], step = 0, 0, 1
        literals[END] = 1
        _count(plain, distances, step, literals, backs)
    if step > 1:
        for value in range(256):
            literals[value] = step * literals[value] + 1
        for symbol in range(END + 1, LITERALS):
            literals[symbol] *= step
        # Several runs share a symbol; that they add more than 1 does no harm.
        for run in range(1, _LONGEST_RUN + 1):
            literals[_RUNS[run, 0]] += 1
        for symbol in range(DISTANCES):
            backs[symbol] = step * backs[symbol] + 1


@compiled
def _join_codes(codes: Any, largest: Any, samples: Any) -> None:
    """Fill `samples` with the code of both bytes of every sample up to `largest`, its length from bit 24 on."""
    mask, length = uint32(0xFFFF), uint32(16)
    for high in range((largest >> 8) + 1):
        first = codes[high]
        bits = first >> length
        for low in range(256):
            second = codes[low]
            joined = (first & mask) | ((second & mask) << bits)
            samples[256 * high + low] = joined | ((bits + (second >> length)) << uint32(24))


@compiled
def _put_bytes(out: Any, writer: Any, rows: Any, codes: Any) -> None:
    """Write rows (height, 1 + 6 width) byte by byte."""
    at, waiting, number = writer[0], writer[1], writer[2]
    mask, length, one, two = uint64(0xFFFF), uint64(16), uint64(1), uint64(2)
    data = rows.reshape(-1)
    i = uint64(0)
    for _ in range(rows.shape[0]):
        code = uint64(codes[data[i]])
        waiting |= (code & mask) << number
        at, waiting, number = flush(out, at, waiting, number + (code >> length))
        i += one
        for _ in range(rows.shape[1] // 3):
            first, second, third = uint64(codes[data[i]]), uint64(codes[data[i + one]]), uint64(codes[data[i + two]])
            bits = (first >> length) + (second >> length)
            joined = (first & mask) | ((second & mask) << (first >> length)) | ((third & mask) << bits)
            waiting |= joined << number
            at, waiting, number = flush(out, at, waiting, number + bits + (third >> length))
            i += uint64(3)
    writer[0], writer[1], writer[2] = at, waiting, number


@compiled
def _put_repeats(out: Any, writer: Any, image: Any, distances: Any, codes: Any, back_codes: Any, joined: Any) -> None:
    """Write rows as literals, from the `joined` codes of samples, and matches."""
    at, waiting, number = writer[0], writer[1], writer[2]
    mask, length, one, two = uint64(0xFFFF), uint64(16), uint64(1), uint64(2)
    sample_mask, sample_length = uint64(0xFFFFFF), uint64(24)
    samples, backs = image.reshape(-1), distances.reshape(-1)
    width = uint64(image.shape[1])
    row_code = uint64(codes[0])
    x = uint64(0)
    for _ in range(image.shape[0]):
        waiting |= (row_code & mask) << number
        at, waiting, number = flush(out, at, waiting, number + (row_code >> length))
        end = x + width
        while x < end:
            distance = backs[x]
            if distance == 0:
                i = uint64(3) * x
                red, green = uint64(joined[samples[i]]), uint64(joined[samples[i + one]])
                blue = uint64(joined[samples[i + two]])
                bits = red >> sample_length
                waiting |= ((red & sample_mask) | ((green & sample_mask) << bits)) << number
                at, waiting, number = flush(out, at, waiting, number + bits + (green >> sample_length))
                waiting |= (blue & sample_mask) << number
                at, waiting, number = flush(out, at, waiting, number + (blue >> sample_length))
                x += one
                continue
            run = one
            while run < uint64(_LONGEST_RUN) and x + run < end and backs[x + run] == distance:
                run += one
            # Length, its extra bits, distance, its extra bits: 12 + 5 + 12 + 13 at most.
            code = uint64(codes[_RUNS[run, 0]])
            match, bits = code & mask, code >> length
            match |= uint64(_RUNS[run, 2]) << bits
            bits += uint64(_RUNS[run, 1])
            symbol = _symbol_of(distance)
            code = uint64(back_codes[symbol])
            match |= (code & mask) << bits
            bits += code >> length
            extra = uint64(_DISTANCE_BITS[symbol])
            match |= ((uint64(distance) - one) & ((one << extra) - one)) << bits
            waiting |= match << number
            at, waiting, number = flush(out, at, waiting, number + bits + extra)
            x += run
    writer[0], writer[1], writer[2] = at, waiting, number


@compiled
def _pack(image: Any, last: int, plain: Any, filtered: Any, distances: Any, seen: Any, joined: Any, out: Any) -> Any:
    """Fill `out` with a packed band; return its bytes, and whether `filtered` are its rows, or else `plain`."""
    largest = _split(image, plain)
    repeats = _repeats_pay(image, plain, filtered, distances, seen)
    literals, backs = np.zeros(LITERALS, np.int64), np.zeros(DISTANCES, np.int64)
    literals[END] = 1
    if repeats:
        find_repeats(image, seen, distances)
        _estimate(plain, distances, literals, backs)
    else:
        _subtract(plain, filtered)
        _count_bytes(filtered, literals)
    lengths, back_lengths = code_lengths(literals, LONGEST), code_lengths(backs, LONGEST)
    codes = codes_of(lengths)
    writer = np.zeros(3, np.uint64)
    put_head(out, writer, lengths, back_lengths, last)
    if repeats:
        _join_codes(codes, largest, joined)
        _put_repeats(out, writer, image, distances, codes, codes_of(back_lengths), joined)
    else:
        _put_bytes(out, writer, filtered, codes)
    put(out, writer, codes[END] & 0xFFFF, codes[END] >> 16)
    if not last:
        # An empty stored block (RFC 1951, 3.2.4) ends on a whole byte.
        put(out, writer, 0, 3)
    put(out, writer, 0, (uint64(8) - writer[2]) & uint64(7))
    if not last:
        put(out, writer, 0xFFFF0000, 32)
    return writer[0], not repeats


class Packer:
    """Packs bands, one at a time; keeps its working memory, since fresh pages take as long as the packing."""

    def __init__(self) -> None:
        self._seen = np.empty(_PLACES, np.uint64)
        self._joined = np.empty(1 << 16, np.uint32)
        self._bytes = np.empty((2, 0), np.uint8)
        self._distances = np.empty(0, np.uint16)
        self._out = np.empty(0, np.uint8)

    def pack(self, image: npt.NDArray[np.uint16], *, last: bool) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
        """Return a band of an image as deflate data, and the bytes that they unpack to.

        Parameters
        ----------
        image
            (h, w, 3) uint16, contiguous, w at most `WIDEST`.
        last
            Whether no band follows.

        Returns
        -------
        tuple
            (n,) uint8, the bytes of whole blocks, the final one among them if `last`; and (h, 1 + 6 w) uint8, the rows
            of a PNG, each led by its filter. Both are views of memory that the next band overwrites.
        """
        height, width, _ = image.shape
        size = height * (1 + 6 * width)
        if self._bytes.shape[1] < size:
            self._bytes = np.empty((2, size), np.uint8)
            # As many as any shape of that size can need.
            self._distances = np.empty(size // 6, np.uint16)
            self._out = np.empty(_ROOM + 2 * size, np.uint8)
        plain, filtered = (part[:size].reshape(height, 1 + 6 * width) for part in self._bytes)
        distances = self._distances[: height * width].reshape(height, width)
        done, subtracted = _pack(image, int(last), plain, filtered, distances, self._seen, self._joined, self._out)
        return self._out[: int(done)], filtered if subtracted else plain
