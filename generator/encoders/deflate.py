"""Deflate (RFC 1951) for the rows of a 16-bit RGB PNG, made for images drawn from a table.

Two ways to pack a band of rows, whichever is smaller:

    repeats     no filter; a pixel that came before as it is, anywhere in the 32 KiB that deflate looks back, becomes a
                match of six bytes, or more where runs repeat. A table has only so many samples of a colour, so half
                the pixels of a photograph find one. Matches of less than a pixel are not looked for.
    neighbours  the difference to the pixel on the left (filter Sub), in Huffman codes alone. Smaller where a picture
                is so smooth that few pixels share a colour.

Every band is one block with its own codes, ends on a whole byte and looks back into no other, so bands can be packed
at once by several threads and put one after the other.

Which is smaller is tried on a few rows from the band's middle.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import uint8, uint16, uint32, uint64

from generator.compiled import compiled
from generator.encoders.huffman import (
    DISTANCES,
    END,
    LITERALS,
    LONGEST,
    Bits,
    code_lengths,
    codes_of,
    head_of,
)

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

Counts = npt.NDArray[np.int64]


@compiled
def _split(image: Any, rows: Any) -> None:
    """Fill `rows` with the unfiltered bytes of `image`, upper before lower, a 0 before each row."""
    for y in range(image.shape[0]):
        samples, row = image[y].reshape(-1), rows[y]
        row[0] = 0
        for i in range(len(samples)):
            row[1 + 2 * i] = samples[i] >> 8
            row[2 + 2 * i] = samples[i] & 255


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
    # Empty places lie out of reach of every pixel.
    position = uint64(_WINDOW + 1)
    for y in range(image.shape[0]):
        position += uint64(1)
        for x in range(image.shape[1]):
            pixel = (
                uint64(image[y, x, 0]) | (uint64(image[y, x, 1]) << uint64(16)) | (uint64(image[y, x, 2]) << uint64(32))
            )
            mixed = (pixel * uint64(_MIX)) & mask
            last = seen[mixed >> left]
            seen[mixed >> left] = (position << left) | (mixed & open_bits)
            back = position - (last >> left)
            equal = ((last ^ mixed) & open_bits) == uint64(0) and back <= uint64(_WINDOW)
            distances[y, x] = uint16(back) if equal else uint16(0)
            position += uint64(6)


@compiled
def _symbol_of(distance: Any) -> Any:
    """Return the symbol of a distance; some symbol where there is none."""
    back = (uint32(distance) - uint32(1)) & uint32(_WINDOW - 1)
    return _DISTANCE_SYMBOLS[back if back < uint32(256) else uint32(256) + (back >> uint32(7))]


@compiled
def _count(rows: Any, distances: Any, literals: Any, backs: Any) -> None:
    """Add the symbols of rows to the frequencies of literals and distances."""
    # Whether a pixel is a match cannot be foreseen, so there is no branch on it; each of a pixel's bytes has a counter
    # of its own, so that equal ones do not wait for each other.
    counts = np.zeros((6, 256), np.uint32)
    matches = 0
    for y in range(rows.shape[0]):
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


def _bits(literals: Counts, backs: Counts) -> int:
    """Return the bits of symbols of such frequencies in their best codes."""
    lengths, back_lengths = code_lengths(literals, LONGEST), code_lengths(backs, LONGEST)
    return int(literals @ (lengths + _LENGTH_BITS) + backs @ (back_lengths + _DISTANCE_BITS))


@compiled
def _flush(out: Any, at: Any, waiting: Any, number: Any) -> Any:
    """Write the waiting bits, 63 at most, and go on after the whole bytes among them."""
    # The compiler makes one store of these.
    out[at] = uint8(waiting)
    out[at + uint64(1)] = uint8(waiting >> uint64(8))
    out[at + uint64(2)] = uint8(waiting >> uint64(16))
    out[at + uint64(3)] = uint8(waiting >> uint64(24))
    out[at + uint64(4)] = uint8(waiting >> uint64(32))
    out[at + uint64(5)] = uint8(waiting >> uint64(40))
    out[at + uint64(6)] = uint8(waiting >> uint64(48))
    out[at + uint64(7)] = uint8(waiting >> uint64(56))
    return at + (number >> uint64(3)), waiting >> (number & uint64(56)), number & uint64(7)


@compiled
def _three(codes: Any, row: Any, i: int) -> Any:
    """Return the codes of three bytes of a row as one, and its bits."""
    mask, length = uint64(0xFFFF), uint64(16)
    first, second, third = uint64(codes[row[i]]), uint64(codes[row[i + 1]]), uint64(codes[row[i + 2]])
    two = (first >> length) + (second >> length)
    joined = (first & mask) | ((second & mask) << (first >> length)) | ((third & mask) << two)
    return joined, two + (third >> length)


@compiled
def _put_bytes(out: Any, writer: Any, rows: Any, codes: Any) -> None:
    """Write rows (height, 1 + 6 width) byte by byte."""
    at, waiting, number = writer[0], writer[1], writer[2]
    for y in range(rows.shape[0]):
        row = rows[y]
        code = uint64(codes[row[0]])
        waiting |= (code & uint64(0xFFFF)) << number
        at, waiting, number = _flush(out, at, waiting, number + (code >> uint64(16)))
        for i in range(1, len(row), 3):
            code, bits = _three(codes, row, i)
            waiting |= code << number
            at, waiting, number = _flush(out, at, waiting, number + bits)
    writer[0], writer[1], writer[2] = at, waiting, number


@compiled
def _put_repeats(out: Any, writer: Any, rows: Any, distances: Any, codes: Any, back_codes: Any) -> None:
    """Write rows as literals and matches."""
    at, waiting, number = writer[0], writer[1], writer[2]
    mask, length = uint64(0xFFFF), uint64(16)
    for y in range(rows.shape[0]):
        row, back = rows[y], distances[y]
        code = uint64(codes[row[0]])
        waiting |= (code & mask) << number
        at, waiting, number = _flush(out, at, waiting, number + (code >> length))
        x = 0
        while x < len(back):
            distance = back[x]
            if distance == 0:
                left, left_bits = _three(codes, row, 1 + 6 * x)
                right, right_bits = _three(codes, row, 4 + 6 * x)
                waiting |= left << number
                at, waiting, number = _flush(out, at, waiting, number + left_bits)
                waiting |= right << number
                at, waiting, number = _flush(out, at, waiting, number + right_bits)
                x += 1
                continue
            run = 1
            while run < _LONGEST_RUN and x + run < len(back) and back[x + run] == distance:
                run += 1
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
            match |= ((uint64(distance) - uint64(1)) & ((uint64(1) << extra) - uint64(1))) << bits
            waiting |= match << number
            at, waiting, number = _flush(out, at, waiting, number + bits + extra)
            x += run
    writer[0], writer[1], writer[2] = at, waiting, number


class Packer:
    """Packs bands, one at a time; keeps its working memory, since fresh pages take as long as the packing."""

    def __init__(self) -> None:
        self._seen = np.empty(_PLACES, np.uint64)
        self._bytes = np.empty((2, 0), np.uint8)
        self._distances = np.empty(0, np.uint16)
        self._out = np.empty(0, np.uint8)

    def pack(self, image: npt.NDArray[np.uint16], *, last: bool) -> tuple[bytes, npt.NDArray[np.uint8]]:
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
            The bytes of whole blocks, the final one among them if `last`; and (h, 1 + 6 w) uint8, the rows of a PNG,
            each led by its filter: a view of memory that the next band overwrites.
        """
        height, width, _ = image.shape
        size = height * (1 + 6 * width)
        if self._bytes.shape[1] < size:
            self._bytes = np.empty((2, size), np.uint8)
            self._distances = np.empty(height * width, np.uint16)
        plain, filtered = (part[:size].reshape(height, 1 + 6 * width) for part in self._bytes)
        distances = self._distances[: height * width].reshape(height, width)
        _split(image, plain)
        repeats = self._repeats_pay(image, plain, filtered, distances)
        literals, backs = np.zeros(LITERALS, np.int64), np.zeros(DISTANCES, np.int64)
        literals[END] = 1
        if repeats:
            rows = plain
            find_repeats(image, self._seen, distances)
            _count(rows, distances, literals, backs)
        else:
            rows = filtered
            _subtract(plain, rows)
            _count_bytes(rows, literals)
        lengths, back_lengths = code_lengths(literals, LONGEST), code_lengths(backs, LONGEST)
        codes = codes_of(lengths)
        head = head_of(lengths, back_lengths, last=last)
        # A flush writes eight bytes, however few of them count.
        size = (head.number + _bits(literals, backs)) // 8 + 16
        if len(self._out) < size:
            self._out = np.empty(size, np.uint8)
        done = head.number // 8
        self._out[:done] = np.frombuffer(head.to_bytes()[:done], np.uint8)
        writer = np.array([done, head.value >> 8 * done, head.number % 8], dtype=np.uint64)
        if repeats:
            _put_repeats(self._out, writer, rows, distances, codes, codes_of(back_lengths))
        else:
            _put_bytes(self._out, writer, rows, codes)
        done, *rest = writer.tolist()
        tail = Bits(*rest)
        tail.put_code(int(codes[END]))
        if not last:
            # An empty stored block (RFC 1951, 3.2.4) ends on a whole byte.
            tail.put(0, 3)
            tail.put(0xFFFF0000 << -tail.number % 8, 32 + -tail.number % 8)
        return self._out[:done].tobytes() + tail.to_bytes(), rows

    def _repeats_pay(
        self,
        image: npt.NDArray[np.uint16],
        plain: npt.NDArray[np.uint8],
        filtered: npt.NDArray[np.uint8],
        distances: npt.NDArray[np.uint16],
    ) -> bool:
        """Return whether repeats pack the middle of a band into fewer bits than neighbours."""
        height, width = distances.shape
        tried = min(height, 1 + _TRIED // width)
        top = (height - tried) // 2
        some = slice(top, top + tried)
        # The first rows of a look back have nothing before them.
        counted = slice(top + min(tried - 1, _WINDOW_PIXELS // width), top + tried)
        find_repeats(image[some], self._seen, distances[some])
        literals, backs = np.zeros(LITERALS, np.int64), np.zeros(DISTANCES, np.int64)
        _count(plain[counted], distances[counted], literals, backs)
        _subtract(plain[counted], filtered[counted])
        differences = np.zeros(LITERALS, np.int64)
        _count_bytes(filtered[counted], differences)
        return _bits(literals, backs) <= _bits(differences, np.zeros(DISTANCES, np.int64))
