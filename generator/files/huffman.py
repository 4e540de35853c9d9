"""Huffman codes for deflate (RFC 1951): lengths from frequencies, codes from lengths, and the head of a block.

Whole numbers only, so that the same image gives the same bytes on every machine and with every version of whatever
compiles this. A code is kept as its bits, the first one lowest as deflate packs them, and its length from bit 16 on.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy import uint8, uint32, uint64

from foundation.compiled import compiled

LITERALS: Final = 286
"""Symbols for literals, the end of a block and lengths (RFC 1951, 3.2.5)."""
DISTANCES: Final = 30
"""Symbols for distances (RFC 1951, 3.2.5)."""
END: Final = 256
"""The symbol that ends a block (RFC 1951, 3.2.5)."""
LONGEST: Final = 12
"""Bits of the longest code for literals and distances: three codes beside up to seven waiting bits fit into 64."""

_LONGEST_OF_LENGTHS: Final = 7
"""Bits of the longest code for code lengths: its length is written in three bits (RFC 1951, 3.2.7)."""
_LENGTHS: Final = 19
"""Symbols of the code for code lengths (RFC 1951, 3.2.7)."""
_SYMBOL_BITS: Final = 9
"""Bits of a symbol, below 512: frequency and symbol are sorted as one number."""
_ORDER: Final = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])
"""The order in which the lengths of the code for code lengths are written (RFC 1951, 3.2.7)."""


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
