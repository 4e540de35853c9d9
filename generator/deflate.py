"""Deflate (RFC 1951) for the rows of a 16-bit RGB PNG, made for images drawn from a table.

A band of rows is packed by one of two methods, whichever gives fewer bytes:

    repeats     no filter; a pixel equal to one before it, anywhere in the 32 KiB that deflate looks back, becomes a
                match of six bytes, or of more where runs repeat. A table has only so many samples of a colour, so half
                the pixels of a photograph find one. Matches of less than a pixel are not looked for.
    neighbours  the difference to the pixel on the left (filter Sub), in Huffman codes alone. Smaller where a picture
                is so smooth that few pixels share a colour.

Every band is one block with its own codes, ends on a whole byte and looks back into no other, so bands can be packed
at once by several threads and put one after the other.

Which is smaller is tried on a few rows from the band's middle. Of a band that is not small, the codes of repeats are
made from one row in `_STEP`: counting all rows takes a third as long as packing them, and saves a six-hundredth.

A band is packed in one compiled call, which releases the interpreter's lock once: to take it again between steps of a
millisecond would cost several threads more time than the steps.

All arithmetic is in whole numbers, so that the same image gives the same bytes on every machine and with every version
of whatever compiles this. A Huffman code is kept as its bits, the first one lowest as deflate packs them, and its
length from bit 16 on. `docs/decisions/0040-png-keeps-its-own-deflate.md` says why this is not left to ISA-L.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint8, uint16, uint32, uint64

from foundation.compiled import compiled

LITERALS: Final = 286  # Symbols for literals, the end of a block and lengths (RFC 1951, 3.2.5)
DISTANCES: Final = 30  # Symbols for distances (RFC 1951, 3.2.5)
END: Final = 256  # The symbol that ends a block (RFC 1951, 3.2.5)
# Bits of the longest code for literals and distances: three codes beside up to seven waiting bits fit into 64.
LONGEST: Final = 12

# Bits of the longest code for code lengths: its length is written in three bits (RFC 1951, 3.2.7).
_LONGEST_OF_LENGTHS: Final = 7
_LENGTHS: Final = 19  # Symbols of the code for code lengths (RFC 1951, 3.2.7)
_SYMBOL_BITS: Final = 9  # Bits of a symbol, below 512: frequency and symbol are sorted as one number
# The order in which the lengths of the code for code lengths are written (RFC 1951, 3.2.7).
_ORDER: Final = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])


@compiled
def _sort(keys: Any, used: int) -> None:
    """Sort the first `used` keys by Shell's method: they are few, and numba's own sort takes seconds to compile."""
    for gap in (57, 23, 10, 4, 1):
        for i in range(gap, used):
            key = keys[i]
            j = i
            while j >= gap and keys[j - gap] > key:
                keys[j] = keys[j - gap]
                j -= gap
            keys[j] = key


@compiled
def code_lengths(frequencies: Any, longest: int) -> Any:
    """Return the bits (N,) int64 of each symbol's code, of frequencies (N,) int64: 0 where it does not occur.

    Huffman's algorithm on two queues instead of a heap (A. Moffat, J. Katajainen, 1995). Codes of more than `longest`
    bits are cut, and others made longer until Kraft's sum is 1 again: hardly more bits than the best codes have.
    """
    lengths = np.zeros(len(frequencies), np.int64)
    keys = np.empty(len(frequencies), np.int64)
    used = 0
    for symbol in range(len(frequencies)):
        if frequencies[symbol]:
            keys[used] = (frequencies[symbol] << _SYMBOL_BITS) | symbol
            used += 1
    mask = (1 << _SYMBOL_BITS) - 1
    if used <= 1:
        for i in range(used):
            lengths[keys[i] & mask] = 1
        return lengths
    _sort(keys, used)
    weight = np.empty(2 * used, np.int64)
    parent = np.zeros(2 * used, np.int64)
    for i in range(used):
        weight[i] = keys[i] >> _SYMBOL_BITS
    leaf, node, end = 0, used, used
    for _ in range(used - 1):
        total = 0
        for _ in range(2):
            if leaf < used and (node >= end or weight[leaf] <= weight[node]):
                total += weight[leaf]
                parent[leaf] = end
                leaf += 1
            else:
                total += weight[node]
                parent[node] = end
                node += 1
        weight[end] = total
        end += 1
    depth = np.zeros(2 * used, np.int64)
    number = np.zeros(longest + 1, np.int64)
    for i in range(end - 2, -1, -1):
        depth[i] = depth[parent[i]] + 1
        if i < used:
            number[min(depth[i], longest)] += 1
    excess = -(1 << longest)
    for length in range(1, longest + 1):
        excess += number[length] << (longest - length)
    while excess > 0:
        # A longest code goes beside the deepest shorter one, which becomes one bit longer.
        length = longest - 1
        while not number[length]:
            length -= 1
        number[longest] -= 1
        number[length] -= 1
        number[length + 1] += 2
        excess -= 1
    place = 0
    for length in range(longest, 0, -1):
        for _ in range(number[length]):
            lengths[keys[place] & mask] = length
            place += 1
    return lengths


@compiled
def codes_of(lengths: Any) -> Any:
    """Return the canonical codes (N,) uint32, in the form above, of lengths (N,) int64 (RFC 1951, 3.2.2)."""
    number = np.zeros(17, np.int64)
    for length in lengths:
        number[length] += 1
    number[0] = 0
    following = np.zeros(17, np.int64)
    for length in range(1, 17):
        following[length] = (following[length - 1] + number[length - 1]) << 1
    codes = np.zeros(len(lengths), np.uint32)
    for symbol in range(len(lengths)):
        length = lengths[symbol]
        code = following[length]
        following[length] += 1
        turned = 0
        for bit in range(length):
            turned = (turned << 1) | ((code >> bit) & 1)
        codes[symbol] = uint32(turned | (length << 16))
    return codes


@compiled
def flush(out: Any, at: Any, waiting: Any, number: Any) -> Any:
    """Write the waiting bits, 63 at most, to `out` (n,) uint8; return the new place, waiting bits and their number.

    Eight bytes are written at `at`, and the place moves on by the whole bytes among them; up to seven bits remain
    waiting, in the order in which deflate writes them.
    """
    # The compiler makes a single store of these.
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
def put(out: Any, writer: Any, value: int, bits: int) -> None:
    """Write `value` in `bits` bits, 32 at most; its other bits are 0.

    `writer` (3,) uint64 holds the place in `out`, the waiting bits and their number.
    """
    waiting = writer[1] | (uint64(value) << writer[2])
    writer[0], writer[1], writer[2] = flush(out, writer[0], waiting, writer[2] + uint64(bits))


@compiled
def _run_lengths(sequence: Any, tokens: Any) -> int:
    """Fill `tokens` (n, 3) with symbol, extra bits and their number, by which lengths in a row are coded; return n."""
    found = 0
    i = 0
    while i < len(sequence):
        value, run = sequence[i], 1
        while i + run < len(sequence) and sequence[i + run] == value:
            run += 1
        i += run
        if value:
            tokens[found, 0], tokens[found, 1], tokens[found, 2] = value, 0, 0
            found += 1
            run -= 1
        while run >= 3:
            if value:
                taken = min(run, 6)
                symbol, extra, bits = 16, taken - 3, 2
            elif run < 11:
                taken = run
                symbol, extra, bits = 17, taken - 3, 3
            else:
                taken = min(run, 138)
                symbol, extra, bits = 18, taken - 11, 7
            tokens[found, 0], tokens[found, 1], tokens[found, 2] = symbol, extra, bits
            found += 1
            run -= taken
        for _ in range(run):
            tokens[found, 0], tokens[found, 1], tokens[found, 2] = value, 0, 0
            found += 1
    return found


@compiled
def _used_length(lengths: Any, least: int) -> int:
    """Return the number of lengths to be written, at least `least`: up to the last one that is not 0."""
    used = len(lengths)
    while used > least and not lengths[used - 1]:
        used -= 1
    return used


@compiled
def put_head(out: Any, writer: Any, literals: Any, distances: Any, last: int) -> None:
    """Write the head of a block with codes of these lengths (RFC 1951, 3.2.7); `last`: 1 if none follows, else 0."""
    used_literals, used_distances = _used_length(literals, END + 1), _used_length(distances, 1)
    sequence = np.concatenate((literals[:used_literals], distances[:used_distances]))
    tokens = np.empty((len(sequence), 3), np.int64)
    found = _run_lengths(sequence, tokens)
    frequencies = np.zeros(_LENGTHS, np.int64)
    for i in range(found):
        frequencies[tokens[i, 0]] += 1
    lengths = code_lengths(frequencies, _LONGEST_OF_LENGTHS)
    codes = codes_of(lengths)
    number = _LENGTHS
    while number > 4 and not lengths[_ORDER[number - 1]]:
        number -= 1
    put(out, writer, last, 1)
    put(out, writer, 2, 2)
    put(out, writer, used_literals - 257, 5)
    put(out, writer, used_distances - 1, 5)
    put(out, writer, number - 4, 4)
    for i in range(number):
        put(out, writer, lengths[_ORDER[i]], 3)
    for i in range(found):
        code = codes[tokens[i, 0]]
        put(out, writer, code & 0xFFFF, code >> 16)
        put(out, writer, tokens[i, 1], tokens[i, 2])


# Most pixels of a row: positions of its bytes fit into 31 bits, above the 33 that the hash leaves of a pixel.
WIDEST: Final = 1 << 28

_WINDOW: Final = 32768  # Bytes that deflate looks back at most (RFC 1951, 2)
_WINDOW_PIXELS: Final = _WINDOW // 6  # The same in pixels of six bytes
_LONGEST_RUN: Final = 258 // 6  # Pixels of the longest match, 258 bytes (RFC 1951, 3.2.5)
# Entries of the table of pixels, the last one with each hash: 256 KiB, which second-level caches hold.
_PLACES: Final = 1 << 15
# Multiplier of the hash, odd, so that multiplying modulo 2⁴⁸ gives every pixel a number of its own.
_MIX: Final = 0x9E3779B97F4B
# Pixels on which both methods are tried: one window that fills the look back, and two that are counted.
_TRIED: Final = 3 * _WINDOW_PIXELS
_STEP: Final = 8  # Rows of a large band of which one is counted; the head of this file has the gain and the cost
_FEW_ROWS: Final = 4  # Rows that are counted at least, so that no single row decides
_FEW: Final = 1 << 13  # Symbols that the counted rows must have to represent all rows; with fewer, all are counted
_ROOMY: Final = 56  # Bits that can be added to up to seven waiting ones before a flush, which takes 63 at most
# Bytes for a block's head and end and what a flush writes beyond it; no byte of a row takes two, see `LONGEST`.
_ROOM: Final = 1024


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


# Symbols of the distances 1 … 256, then of every 128th (RFC 1951, 3.2.5).
_DISTANCE_SYMBOLS: Final = np.array(
    [_distance_symbol(distance) for distance in (*range(1, 257), *range(1, _WINDOW, 128))], dtype=np.uint8
)
# Extra bits of each symbol of a distance (RFC 1951, 3.2.5).
_DISTANCE_BITS: Final = np.array([max(symbol // 2 - 1, 0) for symbol in range(DISTANCES)], dtype=np.int64)
# Symbol, extra bits and their value of a match of so many pixels.
_RUNS: Final = np.array([(0, 0, 0), *(_length_symbol(6 * run) for run in range(1, _LONGEST_RUN + 1))], dtype=np.int64)
_ONE: Final = int(_RUNS[1, 0])  # The symbol of a match of one pixel
_LENGTH_BITS: Final = np.zeros(LITERALS, np.int64)  # Extra bits of each symbol of a literal or length
_LENGTH_BITS[_RUNS[:, 0]] = _RUNS[:, 1]


@compiled
def _split(image: Any, rows: Any) -> Any:
    """Fill `rows` (h, 1 + 6 w) uint8 with the bytes of `image` (h, w, 3), big-endian, a 0 before each row."""
    joined = uint16(0)
    for y in range(image.shape[0]):
        samples, row = image[y].reshape(-1), rows[y]
        row[0] = 0
        # Combined by row, or the compiler would not vectorise it.
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
    """Fill `distances` (h, w) uint16 with the bytes back to the last equal pixel, 0 where there is none in reach.

    `image` is (h, w, 3) uint16. `seen` (32768,) uint64 holds for each hash the position, in bytes, of the last pixel
    that had it, above those bits of the mixed pixel that are not in the hash. Mixing is one to one, so pixels that
    agree in both are equal.
    """
    left, turn = uint64(48) - uint64(15), uint64(64 - 48 + 15)
    open_bits = (uint64(1) << left) - uint64(1)
    for place in range(_PLACES):
        seen[place] = 0
    samples, backs = image.reshape(-1), distances.reshape(-1)
    # Empty entries are out of reach of every pixel. All numbers are unsigned: numba adds a branch to every index that
    # may be negative.
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
            mixed = pixel * uint64(_MIX)
            place = (mixed >> left) & uint64(_PLACES - 1)
            here = (position << left) | (mixed & open_bits)
            gone = here - seen[place]
            seen[place] = here
            # The bytes back to the last pixel of this hash, and above them bits that are not 0 if it is another pixel.
            # Whether a pixel repeats cannot be predicted, so there is no branch on it.
            back = (gone >> left) | (gone << turn)
            backs[pixels] = uint16(back) if back - uint64(1) < uint64(_WINDOW) else uint16(0)
            at += uint64(3)
            pixels += uint64(1)
            position += uint64(6)


@compiled
def _place_of(less: Any) -> Any:
    """Return the index in `_DISTANCE_SYMBOLS` of a distance, given the distance less one."""
    return less if less < uint64(256) else uint64(256) + (less >> uint64(7))


@compiled
def _symbol_of(distance: Any) -> Any:
    """Return the symbol of a distance; of distance 0, which is none, any symbol."""
    return _DISTANCE_SYMBOLS[_place_of((uint64(distance) - uint64(1)) & uint64(_WINDOW - 1))]


@compiled
def _count(rows: Any, distances: Any, step: int, literals: Any, backs: Any) -> None:
    """Add the symbols of one row of every `step` to the frequencies of literals and distances."""
    # Whether a pixel is a match cannot be predicted, so there is no branch on it; each of a pixel's bytes has a counter
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
    """Return the number of bits that symbols of these frequencies take in their best codes."""
    lengths, back_lengths = code_lengths(literals, LONGEST), code_lengths(backs, LONGEST)
    total = 0
    for symbol in range(LITERALS):
        total += literals[symbol] * (lengths[symbol] + _LENGTH_BITS[symbol])
    for symbol in range(DISTANCES):
        total += backs[symbol] * (back_lengths[symbol] + _DISTANCE_BITS[symbol])
    return total


@compiled
def _repeats_pay(image: Any, plain: Any, filtered: Any, distances: Any, seen: Any) -> bool:
    """Return whether the method of repeats packs the middle of a band into fewer bits than that of neighbours."""
    height, width = distances.shape
    tried = min(height, 1 + _TRIED // width)
    top = (height - tried) // 2
    # The first rows have too little before them to repeat.
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
    """Fill the frequencies of a band's literals and distances: estimates of them, above 0 for all that may occur."""
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
        # Several runs share a symbol, and add more than 1 to it, which does no harm.
        for run in range(1, _LONGEST_RUN + 1):
            literals[_RUNS[run, 0]] += 1
        for symbol in range(DISTANCES):
            backs[symbol] = step * backs[symbol] + 1


@compiled
def _join_codes(codes: Any, largest: Any, samples: Any) -> None:
    """Fill `samples` (65536,) uint32 with the codes of both bytes of every sample up to `largest`.

    Their length is in the lowest eight bits, so that a word is the number of places by which the next code is shifted,
    and a sum of words has the sum of the lengths.
    """
    mask, length = uint32(0xFFFF), uint32(16)
    for high in range((largest >> 8) + 1):
        first = codes[high]
        bits = first >> length
        for low in range(256):
            second = codes[low]
            joined = (first & mask) | ((second & mask) << bits)
            samples[256 * high + low] = (joined << uint32(8)) | (bits + (second >> length))


@compiled
def _run_codes(codes: Any) -> Any:
    """Return the code and extra bits, 12 + 5 at most, of each run's length; (`_LONGEST_RUN` + 1,) uint64.

    The codes begin at bit 8, their number of bits is in the lowest eight.
    """
    runs = np.zeros(_LONGEST_RUN + 1, np.uint64)
    for run in range(1, _LONGEST_RUN + 1):
        code, extra = uint64(codes[_RUNS[run, 0]]), uint64(_RUNS[run, 2])
        bits = code >> uint64(16)
        runs[run] = (((code & uint64(0xFFFF)) | (extra << bits)) << uint64(8)) | (bits + uint64(_RUNS[run, 1]))
    return runs


@compiled
def _match_codes(single: Any, codes: Any) -> Any:
    """Return the codes of a match of a `single` pixel for each entry of `_DISTANCE_SYMBOLS`; (N,) uint64.

    The codes begin at bit 8, 12 bits each at most, and their number of bits is in the lowest eight. The number of all
    bits begins at bit 32, a mask of the distance's extra bits, 13 at most, at bit 48.
    """
    matches = np.zeros(len(_DISTANCE_SYMBOLS), np.uint64)
    first = single & uint64(63)
    for i in range(len(matches)):
        symbol = _DISTANCE_SYMBOLS[i]
        code, extra = uint64(codes[symbol]), uint64(_DISTANCE_BITS[symbol])
        bits = first + (code >> uint64(16))
        both = (single >> uint64(8)) | ((code & uint64(0xFFFF)) << first)
        mask = (uint64(1) << extra) - uint64(1)
        matches[i] = bits | (both << uint64(8)) | ((bits + extra) << uint64(32)) | (mask << uint64(48))
    return matches


@compiled
def _match(matches: Any, distance: Any) -> Any:
    """Return the bits of a match of one pixel, and their number; meaningless for distance 0, which is none."""
    less = (distance - uint64(1)) & uint64(_WINDOW - 1)
    match = matches[_place_of(less)]
    extra = (less & (match >> uint64(48))) << (match & uint64(63))
    return ((match >> uint64(8)) & uint64(0xFFFFFF)) | extra, (match >> uint64(32)) & uint64(63)


@compiled
def _put_bytes(out: Any, writer: Any, rows: Any, codes: Any) -> None:
    """Write rows (h, 1 + 6 w) uint8 byte by byte."""
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
    zero, one, two, three, byte, low = uint64(0), uint64(1), uint64(2), uint64(3), uint64(8), uint64(63)
    samples, backs = image.reshape(-1), distances.reshape(-1)
    runs = _run_codes(codes)
    single = runs[1] & low
    matches = _match_codes(runs[1], back_codes)
    width = uint64(image.shape[1])
    row_code = uint64(codes[0])
    x = zero
    for _ in range(image.shape[0]):
        waiting |= (row_code & uint64(0xFFFF)) << number
        at, waiting, number = flush(out, at, waiting, number + (row_code >> uint64(16)))
        end = x + width
        while x < end:
            distance = uint64(backs[x])
            following = uint64(backs[x + one]) if x + one < end else zero
            # Seldom the next pixel continues a match. One sign bit shows it; of two conditions LLVM makes two branches.
            if (((following ^ distance) - one) & (zero - distance)) >> low:
                run = two
                while run < uint64(_LONGEST_RUN) and x + run < end and uint64(backs[x + run]) == distance:
                    run += one
                bits, length = _match(matches, distance)
                bits, length = (bits >> single) << (runs[run] & low), length - single + (runs[run] & low)
                waiting |= ((runs[run] >> byte) | bits) << number
                at, waiting, number = flush(out, at, waiting, number + length)
                x += run
                continue
            # Whether a pixel is a match cannot be predicted; making both codes is faster than a wrong prediction.
            i = three * x
            red, green = uint64(joined[samples[i]]), uint64(joined[samples[i + one]])
            blue = uint64(joined[samples[i + two]])
            both = red + green
            most = (red >> byte) | ((green >> byte) << (red & low))
            literal, literal_length = most | ((blue >> byte) << (both & low)), (both + blue) & uint64(255)
            match, match_length = _match(matches, distance)
            bits = literal if distance == zero else match
            length = literal_length if distance == zero else match_length
            if length > uint64(_ROOMY):
                waiting |= most << number
                at, waiting, number = flush(out, at, waiting, number + (both & low))
                bits, length = blue >> byte, blue & low
            waiting |= bits << number
            at, waiting, number = flush(out, at, waiting, number + length)
            x += one
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
    """Packs bands, one at a time; keeps its working memory, since new memory takes as long as the packing."""

    def __init__(self) -> None:
        self._seen = np.empty(_PLACES, np.uint64)
        self._joined = np.empty(1 << 16, np.uint32)
        self._bytes = np.empty((2, 0), np.uint8)
        self._distances = np.empty(0, np.uint16)
        self._out = np.empty(0, np.uint8)

    def pack(self, image: npt.NDArray[np.uint16], *, last: bool) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
        """Return a band of an image as deflate data, and the bytes that these unpack to.

        `image`: (h, w, 3) uint16, contiguous, w at most `WIDEST`. Returns (n,) uint8, the bytes of whole blocks, the
        final one among them if `last`; and (h, 1 + 6 w) uint8, the rows of a PNG, each led by its filter. Both are
        views of memory that the next band overwrites.
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
