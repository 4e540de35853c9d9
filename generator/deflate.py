"""Deflate (RFC 1951) for the rows of a 16-bit RGB PNG, optimised for images rendered from a LUT.

`Packer.pack` packs a band of rows with one of two methods, whichever gives fewer bytes:

    repeats     No filter. A pixel equal to an earlier one in the window of 32 KiB becomes a match of six bytes, or
                part of a longer match in a run. A LUT has few samples of each colour, so half of the pixels of a
                photograph match. Matches shorter than a pixel are not searched.
    neighbours  Difference to the pixel on the left (filter Sub), with Huffman codes only. This method gives fewer
                bytes for smooth images, in which few pixels share a colour.

Each band is one block with its own codes. It ends on a whole byte and refers to no other band, so several threads can
pack bands in parallel. All arithmetic is in integers, so equal images give equal bytes on every machine.
docs/decisions/0040-png-keeps-its-own-deflate.md gives the reasons for our own packer.
"""

# A Huffman code is stored in one number: its bits from bit 0 on, in the order in which deflate writes them, and its
# length from bit 16 on.

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numpy import uint8, uint16, uint32, uint64

from foundation.compiled import compiled

LITERALS: Final = 286  # Symbols for literals, the end of a block and lengths (RFC 1951, 3.2.5)
DISTANCES: Final = 30  # Symbols for distances (RFC 1951, 3.2.5)
END: Final = 256  # Symbol for the end of a block (RFC 1951, 3.2.5)
# Largest length of a code for literals and distances, in bits. Three codes and seven bits that
# wait to be written fit into 64 bits.
LONGEST: Final = 12

# Largest length of a code for code lengths, in bits: the largest number in the three bits of RFC 1951, 3.2.7.
_LONGEST_OF_LENGTHS: Final = 7
_LENGTHS: Final = 19  # Symbols of the code for code lengths (RFC 1951, 3.2.7)
_SYMBOL_BITS: Final = 9  # Bits of a symbol (below 512); frequency and symbol are sorted as one number
# Order in which the lengths of the code for code lengths are written (RFC 1951, 3.2.7).
_ORDER: Final = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])


@compiled
def _sort(keys: Any, used: int) -> None:
    # Shellsort of the first `used` keys. They are few, and the sort of numba takes seconds to compile.
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
    """Return the code length (N,) int64 in bits of each symbol from frequencies (N,) int64; 0 for unused symbols."""
    # Huffman's algorithm on two queues instead of a heap (A. Moffat, J. Katajainen, 1995). Codes longer than `longest`
    # bits are shortened, and other codes are lengthened until Kraft's sum is 1 again.
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
        # A code of `longest` bits becomes the sibling of the longest of the other codes. That code gets one more bit,
        # and both siblings have equal length.
        length = longest - 1
        while not number[length]:
            length -= 1
        number[longest] -= 1
        number[length] -= 1
        number[length + 1] += 2
        excess -= 1
    position = 0
    for length in range(longest, 0, -1):
        for _ in range(number[length]):
            lengths[keys[position] & mask] = length
            position += 1
    return lengths


@compiled
def codes_of(lengths: Any) -> Any:
    """Return the canonical codes (N,) uint32 of lengths (N,) int64 (RFC 1951, 3.2.2)."""
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
        reversed_code = 0
        for bit in range(length):
            reversed_code = (reversed_code << 1) | ((code >> bit) & 1)
        codes[symbol] = uint32(reversed_code | (length << 16))
    return codes


@compiled
def flush(out: Any, offset: Any, waiting: Any, bit_count: Any) -> Any:
    """Write up to 63 waiting bits to `out` (n,) uint8; return the new offset, the waiting bits and their number.

    Eight bytes are written at `offset`, which advances by the complete bytes; up to seven bits remain waiting.
    """
    # The compiler combines these eight stores into one.
    out[offset] = uint8(waiting)
    out[offset + uint64(1)] = uint8(waiting >> uint64(8))
    out[offset + uint64(2)] = uint8(waiting >> uint64(16))
    out[offset + uint64(3)] = uint8(waiting >> uint64(24))
    out[offset + uint64(4)] = uint8(waiting >> uint64(32))
    out[offset + uint64(5)] = uint8(waiting >> uint64(40))
    out[offset + uint64(6)] = uint8(waiting >> uint64(48))
    out[offset + uint64(7)] = uint8(waiting >> uint64(56))
    return offset + (bit_count >> uint64(3)), waiting >> (bit_count & uint64(56)), bit_count & uint64(7)


@compiled
def put(out: Any, writer: Any, value: int, bits: int) -> None:
    """Write `value` in `bits` bits, at most 32; its higher bits must be 0.

    `writer` (3,) uint64 has the offset in `out`, the waiting bits and their number.
    """
    waiting = writer[1] | (uint64(value) << writer[2])
    writer[0], writer[1], writer[2] = flush(out, writer[0], waiting, writer[2] + uint64(bits))


@compiled
def _run_lengths(sequence: Any, tokens: Any) -> int:
    # Fill `tokens` (n, 3) with symbol, extra bits and number of extra bits of the run-length code; return n.
    count = 0
    i = 0
    while i < len(sequence):
        value, run = sequence[i], 1
        while i + run < len(sequence) and sequence[i + run] == value:
            run += 1
        i += run
        if value:
            tokens[count, 0], tokens[count, 1], tokens[count, 2] = value, 0, 0
            count += 1
            run -= 1
        while run >= 3:
            if value:
                length = min(run, 6)
                symbol, extra, bits = 16, length - 3, 2
            elif run < 11:
                length = run
                symbol, extra, bits = 17, length - 3, 3
            else:
                length = min(run, 138)
                symbol, extra, bits = 18, length - 11, 7
            tokens[count, 0], tokens[count, 1], tokens[count, 2] = symbol, extra, bits
            count += 1
            run -= length
        for _ in range(run):
            tokens[count, 0], tokens[count, 1], tokens[count, 2] = value, 0, 0
            count += 1
    return count


@compiled
def _used_length(lengths: Any, minimum: int) -> int:
    # Number of lengths to write: zeros at the end are omitted.
    used = len(lengths)
    while used > minimum and not lengths[used - 1]:
        used -= 1
    return used


@compiled
def put_head(out: Any, writer: Any, literals: Any, distances: Any, last: int) -> None:
    """Write the head of a block with codes of these lengths (RFC 1951, 3.2.7); `last` is 1 for the final block."""
    used_literals, used_distances = _used_length(literals, END + 1), _used_length(distances, 1)
    sequence = np.concatenate((literals[:used_literals], distances[:used_distances]))
    tokens = np.empty((len(sequence), 3), np.int64)
    token_count = _run_lengths(sequence, tokens)
    frequencies = np.zeros(_LENGTHS, np.int64)
    for i in range(token_count):
        frequencies[tokens[i, 0]] += 1
    lengths = code_lengths(frequencies, _LONGEST_OF_LENGTHS)
    codes = codes_of(lengths)
    length_count = _LENGTHS
    while length_count > 4 and not lengths[_ORDER[length_count - 1]]:
        length_count -= 1
    put(out, writer, last, 1)
    put(out, writer, 2, 2)
    put(out, writer, used_literals - 257, 5)
    put(out, writer, used_distances - 1, 5)
    put(out, writer, length_count - 4, 4)
    for i in range(length_count):
        put(out, writer, lengths[_ORDER[i]], 3)
    for i in range(token_count):
        code = codes[tokens[i, 0]]
        put(out, writer, code & 0xFFFF, code >> 16)
        put(out, writer, tokens[i, 1], tokens[i, 2])


# Largest number of pixels in a row. An entry of the history in `find_repeats` has 64 bits: 31 for a byte
# position, and 33 for the bits of a pixel that are not in its hash.
WIDEST: Final = 1 << 28

_WINDOW: Final = 32768  # Largest distance of a match in bytes (RFC 1951, 2)
_WINDOW_PIXELS: Final = _WINDOW // 6  # The same in pixels of six bytes
_LONGEST_RUN: Final = 258 // 6  # Pixels of the longest match, 258 bytes (RFC 1951, 3.2.5)
# Entries of the hash table, which has the last pixel of each hash: 256 KiB, which fit into second-level caches.
_HASHES: Final = 1 << 15
# Multiplier of the hash. It is odd, so that multiplication modulo 2⁴⁸ maps pixels one to one.
_MIX: Final = 0x9E3779B97F4B
# Pixels on which both methods are compared: one window to fill the history, and two that are counted.
_TRIAL_PIXELS: Final = 3 * _WINDOW_PIXELS
# In a large band, symbols are counted in one of this number of rows. Counting all rows would take much longer and make
# files only 0.17 % smaller.
_ROW_STEP: Final = 8
_FEW_ROWS: Final = 4  # Smallest number of counted rows, so that no single row decides
# Smallest number of counted symbols that represents a band; with fewer, all rows are counted.
_FEW_SYMBOLS: Final = 1 << 13
_FLUSH_BITS: Final = 56  # Bits that can be added to seven waiting bits before a flush of 63 bits
# Bytes for the head and the end of a block, and for the last flush, which always writes eight bytes. Codes have less
# than 16 bits (`LONGEST`), so packed rows have less than twice the bytes of the rows.
_EXTRA_BYTES: Final = 1024


def _distance_symbol(distance: int) -> int:
    # Symbol of a distance 1 … 32768 (RFC 1951, 3.2.5).
    bits = (distance - 1).bit_length()
    return distance - 1 if bits <= 2 else 2 * (bits - 1) + ((distance - 1) >> (bits - 2) & 1)


def _length_symbol(length: int) -> tuple[int, int, int]:
    # Symbol, number of extra bits and their value for a match of 3 … 258 bytes (RFC 1951, 3.2.5).
    if length == 258:
        return 285, 0, 0
    bits = max((length - 3).bit_length() - 3, 0)
    return 257 + 4 * bits + ((length - 3) >> bits), bits, (length - 3) & ((1 << bits) - 1)


# Symbols of the distances 1 … 256, then of every 128th distance (RFC 1951, 3.2.5).
_DISTANCE_SYMBOLS: Final = np.array(
    [_distance_symbol(distance) for distance in (*range(1, 257), *range(1, _WINDOW, 128))], dtype=np.uint8
)
# Extra bits of each symbol of a distance (RFC 1951, 3.2.5).
_DISTANCE_BITS: Final = np.array([max(symbol // 2 - 1, 0) for symbol in range(DISTANCES)], dtype=np.int64)
# Symbol, number of extra bits and their value, by the length of a match in pixels.
_RUNS: Final = np.array([(0, 0, 0), *(_length_symbol(6 * run) for run in range(1, _LONGEST_RUN + 1))], dtype=np.int64)
_ONE_PIXEL: Final = int(_RUNS[1, 0])  # Symbol of a match of one pixel
_LENGTH_BITS: Final = np.zeros(LITERALS, np.int64)  # Extra bits of each symbol of a literal or length
_LENGTH_BITS[_RUNS[:, 0]] = _RUNS[:, 1]


@compiled
def _split(image: Any, rows: Any) -> Any:
    # Fill `rows` (h, 1 + 6 w) uint8 with the big-endian bytes of `image` (h, w, 3) and the filter type 0 in front;
    # return the bitwise or of all samples.
    joined = uint16(0)
    for y in range(image.shape[0]):
        samples, row = image[y].reshape(-1), rows[y]
        row[0] = 0
        # The samples of each row are combined separately, otherwise the compiler does not vectorise the loop.
        row_bits = uint16(0)
        for i in range(len(samples)):
            row[1 + 2 * i] = samples[i] >> 8
            row[2 + 2 * i] = samples[i] & 255
            row_bits |= samples[i]
        joined |= row_bits
    return joined


@compiled
def _subtract(rows: Any, filtered: Any) -> None:
    # Filter Sub (ISO/IEC 15948, 9.2).
    for y in range(rows.shape[0]):
        previous, row, target = rows[y, 1:], rows[y, 7:], filtered[y, 7:]
        filtered[y, 0] = 1
        for i in range(6):
            filtered[y, 1 + i] = previous[i]
        for i in range(len(row)):
            target[i] = row[i] - previous[i]


@compiled
def _count_bytes(rows: Any, literals: Any) -> None:
    # Add the frequencies of the bytes to `literals`. With four counters for each value, an increment rarely waits for
    # the previous increment of the same counter.
    counts = np.zeros((4, 256), np.uint32)
    data = rows.reshape(-1)
    aligned_size = len(data) // 4 * 4
    for i in range(0, aligned_size, 4):
        counts[0, data[i]] += 1
        counts[1, data[i + 1]] += 1
        counts[2, data[i + 2]] += 1
        counts[3, data[i + 3]] += 1
    for i in range(aligned_size, len(data)):
        counts[0, data[i]] += 1
    for value in range(256):
        for counter in range(4):
            literals[value] += counts[counter, value]


@compiled
def find_repeats(image: Any, history: Any, distances: Any) -> None:
    """Fill `distances` (h, w) uint16 with the distance in bytes to the last equal pixel of `image` (h, w, 3) uint16.

    The distance is 0 if the window has no equal pixel. `history` (32768,) uint64 is working memory.
    """
    # An entry of `history` has the byte position of the last pixel with this hash in its high bits. Its low bits are
    # the bits of the pixel times `_MIX` that are not in the hash. This product is one to one, so pixels with equal hash
    # and equal low bits are equal.
    shift, rotation = uint64(48) - uint64(15), uint64(64 - 48 + 15)
    unhashed_mask = (uint64(1) << shift) - uint64(1)
    for slot in range(_HASHES):
        history[slot] = 0
    samples, flat_distances = image.reshape(-1), distances.reshape(-1)
    # Positions start above the window size, so that empty entries are never in the window. All numbers are unsigned,
    # because numba adds a branch to each index that may be negative.
    position = uint64(_WINDOW + 1)
    index, pixels = uint64(0), uint64(0)
    for _ in range(image.shape[0]):
        position += uint64(1)
        for _ in range(image.shape[1]):
            pixel = (
                uint64(samples[index])
                | (uint64(samples[index + uint64(1)]) << uint64(16))
                | (uint64(samples[index + uint64(2)]) << uint64(32))
            )
            mixed = pixel * uint64(_MIX)
            slot = (mixed >> shift) & uint64(_HASHES - 1)
            entry = (position << shift) | (mixed & unhashed_mask)
            difference = entry - history[slot]
            history[slot] = entry
            # The distance to the last pixel with this hash. If that pixel differs, the result exceeds the window. There
            # is no branch, because the processor cannot predict repeats.
            distance = (difference >> shift) | (difference << rotation)
            flat_distances[pixels] = uint16(distance) if distance - uint64(1) < uint64(_WINDOW) else uint16(0)
            index += uint64(3)
            pixels += uint64(1)
            position += uint64(6)


@compiled
def _distance_index(distance_minus_1: Any) -> Any:
    # Index in `_DISTANCE_SYMBOLS`.
    return distance_minus_1 if distance_minus_1 < uint64(256) else uint64(256) + (distance_minus_1 >> uint64(7))


@compiled
def _symbol_of(distance: Any) -> Any:
    # For distance 0, which means no match, the symbol is arbitrary.
    return _DISTANCE_SYMBOLS[_distance_index((uint64(distance) - uint64(1)) & uint64(_WINDOW - 1))]


@compiled
def _count(rows: Any, distances: Any, step: int, literals: Any, distance_counts: Any) -> None:
    # Add the symbols of one row in `step` to the frequencies of literals and distances. There is no branch on a match,
    # because the processor cannot predict it. Each byte of a pixel has its own counter, so that increments do not wait.
    counts = np.zeros((6, 256), np.uint32)
    matches = 0
    for y in range(step // 2, rows.shape[0], step):
        row, row_distances = rows[y], distances[y]
        literals[row[0]] += 1
        run, previous = 1, uint32(0)
        for x in range(len(row_distances)):
            distance = uint32(row_distances[x])
            if distance == previous and distance != uint32(0) and run < _LONGEST_RUN:
                literals[_RUNS[run, 0]] -= 1
                run += 1
                literals[_RUNS[run, 0]] += 1
                continue
            run, previous = 1, distance
            literal = uint32(distance == uint32(0))
            for i in range(6):
                counts[i, row[1 + 6 * x + i]] += literal
            match = np.int64(uint32(1) - literal)
            distance_counts[_symbol_of(distance)] += match
            matches += match
    literals[_ONE_PIXEL] += matches
    for value in range(256):
        for i in range(6):
            literals[value] += counts[i, value]


@compiled
def _bits(literals: Any, distance_counts: Any) -> int:
    # Total number of bits of symbols with these frequencies.
    lengths, distance_lengths = code_lengths(literals, LONGEST), code_lengths(distance_counts, LONGEST)
    total = 0
    for symbol in range(LITERALS):
        total += literals[symbol] * (lengths[symbol] + _LENGTH_BITS[symbol])
    for symbol in range(DISTANCES):
        total += distance_counts[symbol] * (distance_lengths[symbol] + _DISTANCE_BITS[symbol])
    return total


@compiled
def _are_repeats_smaller(image: Any, plain: Any, filtered: Any, distances: Any, history: Any) -> bool:
    # Compare both methods on rows from the middle of the band.
    height, width = distances.shape
    trial_rows = min(height, 1 + _TRIAL_PIXELS // width)
    top = (height - trial_rows) // 2
    # The first rows are not counted, because their history is too short for repeats.
    counted = top + min(trial_rows - 1, _WINDOW_PIXELS // width)
    end = top + trial_rows
    find_repeats(image[top:end], history, distances[top:end])
    literals, distance_counts = np.zeros(LITERALS, np.int64), np.zeros(DISTANCES, np.int64)
    _count(plain[counted:end], distances[counted:end], 1, literals, distance_counts)
    _subtract(plain[counted:end], filtered[counted:end])
    differences = np.zeros(LITERALS, np.int64)
    _count_bytes(filtered[counted:end], differences)
    return _bits(literals, distance_counts) <= _bits(differences, np.zeros(DISTANCES, np.int64))


@compiled
def _estimate(plain: Any, distances: Any, literals: Any, distance_counts: Any) -> None:
    # Estimate the frequencies of literals and distances of a band; every symbol that may occur gets at least 1.
    step = max(1, min(_ROW_STEP, len(distances) // _FEW_ROWS))
    _count(plain, distances, step, literals, distance_counts)
    if step > 1 and literals.sum() < _FEW_SYMBOLS:
        literals[:], distance_counts[:], step = 0, 0, 1
        literals[END] = 1
        _count(plain, distances, step, literals, distance_counts)
    if step > 1:
        for value in range(256):
            literals[value] = step * literals[value] + 1
        for symbol in range(END + 1, LITERALS):
            literals[symbol] *= step
        # If several runs have the same symbol, it gets more than 1, which is harmless.
        for run in range(1, _LONGEST_RUN + 1):
            literals[_RUNS[run, 0]] += 1
        for symbol in range(DISTANCES):
            distance_counts[symbol] = step * distance_counts[symbol] + 1


@compiled
def _join_codes(codes: Any, largest: Any, samples: Any) -> None:
    # Fill `samples` (65536,) uint32 with the joined codes of both bytes of each sample up to `largest`. The lowest
    # eight bits have the length, so that a sum of entries contains the sum of lengths.
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
    # Code and extra bits (at most 12 + 5) of each run length, from bit 8 on; the lowest eight bits have the number of
    # these bits.
    runs = np.zeros(_LONGEST_RUN + 1, np.uint64)
    for run in range(1, _LONGEST_RUN + 1):
        code, extra = uint64(codes[_RUNS[run, 0]]), uint64(_RUNS[run, 2])
        bits = code >> uint64(16)
        runs[run] = (((code & uint64(0xFFFF)) | (extra << bits)) << uint64(8)) | (bits + uint64(_RUNS[run, 1]))
    return runs


@compiled
def _match_codes(single: Any, codes: Any) -> Any:
    # Codes of a match of one pixel, whose length code is `single`, for each entry of `_DISTANCE_SYMBOLS`. Bits 0 to 7
    # have the number of code bits, bits 8 to 31 two codes of at most 12 bits, bits 32 to 47 the number of all bits, and
    # bits 48 to 63 a mask of the extra bits of the distance (at most 13).
    matches = np.zeros(len(_DISTANCE_SYMBOLS), np.uint64)
    first = single & uint64(63)
    for i in range(len(matches)):
        symbol = _DISTANCE_SYMBOLS[i]
        code, extra = uint64(codes[symbol]), uint64(_DISTANCE_BITS[symbol])
        bits = first + (code >> uint64(16))
        match_code = (single >> uint64(8)) | ((code & uint64(0xFFFF)) << first)
        mask = (uint64(1) << extra) - uint64(1)
        matches[i] = bits | (match_code << uint64(8)) | ((bits + extra) << uint64(32)) | (mask << uint64(48))
    return matches


@compiled
def _match(matches: Any, distance: Any) -> Any:
    # The bits of a match of one pixel, and their number; arbitrary for distance 0, which means no match.
    distance_minus_1 = (distance - uint64(1)) & uint64(_WINDOW - 1)
    match = matches[_distance_index(distance_minus_1)]
    extra = (distance_minus_1 & (match >> uint64(48))) << (match & uint64(63))
    return ((match >> uint64(8)) & uint64(0xFFFFFF)) | extra, (match >> uint64(32)) & uint64(63)


@compiled
def _put_bytes(out: Any, writer: Any, rows: Any, codes: Any) -> None:
    # Three bytes are written in each flush, because three codes fit into 64 bits (`LONGEST`).
    offset, waiting, bit_count = writer[0], writer[1], writer[2]
    mask, length, u1, u2 = uint64(0xFFFF), uint64(16), uint64(1), uint64(2)
    data = rows.reshape(-1)
    i = uint64(0)
    for _ in range(rows.shape[0]):
        code = uint64(codes[data[i]])
        waiting |= (code & mask) << bit_count
        offset, waiting, bit_count = flush(out, offset, waiting, bit_count + (code >> length))
        i += u1
        for _ in range(rows.shape[1] // 3):
            first, second, third = uint64(codes[data[i]]), uint64(codes[data[i + u1]]), uint64(codes[data[i + u2]])
            bits = (first >> length) + (second >> length)
            joined = (first & mask) | ((second & mask) << (first >> length)) | ((third & mask) << bits)
            waiting |= joined << bit_count
            offset, waiting, bit_count = flush(out, offset, waiting, bit_count + bits + (third >> length))
            i += uint64(3)
    writer[0], writer[1], writer[2] = offset, waiting, bit_count


@compiled
def _put_repeats(
    out: Any, writer: Any, image: Any, distances: Any, codes: Any, distance_codes: Any, joined: Any
) -> None:
    # `joined` has the codes of both bytes of each sample value (`_join_codes`).
    offset, waiting, bit_count = writer[0], writer[1], writer[2]
    u0, u1, u2, u3, byte, low = uint64(0), uint64(1), uint64(2), uint64(3), uint64(8), uint64(63)
    samples, flat_distances = image.reshape(-1), distances.reshape(-1)
    runs = _run_codes(codes)
    single = runs[1] & low
    matches = _match_codes(runs[1], distance_codes)
    width = uint64(image.shape[1])
    row_code = uint64(codes[0])
    x = u0
    for _ in range(image.shape[0]):
        waiting |= (row_code & uint64(0xFFFF)) << bit_count
        offset, waiting, bit_count = flush(out, offset, waiting, bit_count + (row_code >> uint64(16)))
        end = x + width
        while x < end:
            distance = uint64(flat_distances[x])
            following = uint64(flat_distances[x + u1]) if x + u1 < end else u0
            # A match rarely continues at the next pixel. A single sign bit tests both conditions, because LLVM would
            # compile them to two branches.
            if (((following ^ distance) - u1) & (u0 - distance)) >> low:
                run = u2
                while run < uint64(_LONGEST_RUN) and x + run < end and uint64(flat_distances[x + run]) == distance:
                    run += u1
                bits, length = _match(matches, distance)
                bits, length = (bits >> single) << (runs[run] & low), length - single + (runs[run] & low)
                waiting |= ((runs[run] >> byte) | bits) << bit_count
                offset, waiting, bit_count = flush(out, offset, waiting, bit_count + length)
                x += run
                continue
            # The codes of three literals and of a match are both computed, because this is faster than a branch that is
            # often predicted wrongly.
            i = u3 * x
            red, green = uint64(joined[samples[i]]), uint64(joined[samples[i + u1]])
            blue = uint64(joined[samples[i + u2]])
            pair = red + green
            start = (red >> byte) | ((green >> byte) << (red & low))
            literal, literal_length = start | ((blue >> byte) << (pair & low)), (pair + blue) & uint64(255)
            match, match_length = _match(matches, distance)
            bits = literal if distance == u0 else match
            length = literal_length if distance == u0 else match_length
            if length > uint64(_FLUSH_BITS):
                waiting |= start << bit_count
                offset, waiting, bit_count = flush(out, offset, waiting, bit_count + (pair & low))
                bits, length = blue >> byte, blue & low
            waiting |= bits << bit_count
            offset, waiting, bit_count = flush(out, offset, waiting, bit_count + length)
            x += u1
    writer[0], writer[1], writer[2] = offset, waiting, bit_count


@compiled
def _pack(image: Any, last: int, plain: Any, filtered: Any, distances: Any, history: Any, joined: Any, out: Any) -> Any:
    # Fill `out` with a packed band; return its size in bytes, and whether `filtered` (else `plain`) was packed. This is
    # one compiled call, because several short calls would often take the interpreter lock and slow other threads.
    largest = _split(image, plain)
    uses_repeats = _are_repeats_smaller(image, plain, filtered, distances, history)
    literals, distance_counts = np.zeros(LITERALS, np.int64), np.zeros(DISTANCES, np.int64)
    literals[END] = 1
    if uses_repeats:
        find_repeats(image, history, distances)
        _estimate(plain, distances, literals, distance_counts)
    else:
        _subtract(plain, filtered)
        _count_bytes(filtered, literals)
    lengths, distance_lengths = code_lengths(literals, LONGEST), code_lengths(distance_counts, LONGEST)
    codes = codes_of(lengths)
    writer = np.zeros(3, np.uint64)
    put_head(out, writer, lengths, distance_lengths, last)
    if uses_repeats:
        _join_codes(codes, largest, joined)
        _put_repeats(out, writer, image, distances, codes, codes_of(distance_lengths), joined)
    else:
        _put_bytes(out, writer, filtered, codes)
    put(out, writer, codes[END] & 0xFFFF, codes[END] >> 16)
    if not last:
        # An empty stored block (RFC 1951, 3.2.4) ends on a whole byte.
        put(out, writer, 0, 3)
    put(out, writer, 0, (uint64(8) - writer[2]) & uint64(7))
    if not last:
        put(out, writer, 0xFFFF0000, 32)
    return writer[0], not uses_repeats


class Packer:
    """Packs bands one at a time. It keeps its working memory, because allocation would take as long as packing."""

    def __init__(self) -> None:
        self._history = np.empty(_HASHES, np.uint64)
        self._joined = np.empty(1 << 16, np.uint32)
        self._bytes = np.empty((2, 0), np.uint8)
        self._distances = np.empty(0, np.uint16)
        self._out = np.empty(0, np.uint8)

    def pack(self, image: npt.NDArray[np.uint16], *, last: bool) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
        """Return the deflate data (n,) uint8 of a band, and its unpacked rows (h, 1 + 6 w) uint8 with filter types.

        `image` is (h, w, 3) uint16, contiguous, w at most `WIDEST`; `last` marks the final band of the image. Both
        results are views of memory that the next call overwrites.
        """
        height, width, _ = image.shape
        size = height * (1 + 6 * width)
        if self._bytes.shape[1] < size:
            self._bytes = np.empty((2, size), np.uint8)
            # Large enough for any shape with this number of bytes.
            self._distances = np.empty(size // 6, np.uint16)
            self._out = np.empty(_EXTRA_BYTES + 2 * size, np.uint8)
        plain, filtered = (buffer[:size].reshape(height, 1 + 6 * width) for buffer in self._bytes)
        distances = self._distances[: height * width].reshape(height, width)
        memory = plain, filtered, distances, self._history, self._joined, self._out
        size_out, is_filtered = _pack(image, int(last), *memory)
        return self._out[: int(size_out)], filtered if is_filtered else plain
