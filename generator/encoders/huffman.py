"""Huffman codes for deflate (RFC 1951): lengths from frequencies, codes from lengths, and the head of a block.

Whole numbers only, so that the same image gives the same bytes on every machine and with every version of whatever
compiles this. A code is kept as its bits, the first one lowest as deflate packs them, and its length from bit 16 on.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from numba import uint32

from generator.compiled import compiled

Lengths = npt.NDArray[np.int64]

LITERALS: Final = 286
"""Symbols for literals, the end of a block and lengths."""
DISTANCES: Final = 30
END: Final = 256
LONGEST: Final = 12
"""Bits of the longest code for literals and distances; three and up to seven bits that wait fit into 64."""

_LONGEST_OF_LENGTHS: Final = 7
_LENGTHS: Final = 19
_SYMBOL_BITS: Final = 9
"""Of a symbol, below 512: frequency and symbol are sorted as one number."""
# RFC 1951, 3.2.7: the order in which the lengths of the code for lengths are told.
_ORDER: Final = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])


@compiled
def _sort(keys: Any, used: int) -> None:
    """Sort the first `used` keys by insertion: they are few, and numba's own sort takes seconds to compile."""
    for i in range(1, used):
        key = keys[i]
        j = i
        while j > 0 and keys[j - 1] > key:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key


@compiled
def code_lengths(frequencies: Any, longest: int) -> Any:
    """Return the bits of each symbol's code, 0 where it does not occur and at most `longest`; (N,) int64.

    Moffat and Katajainen's two queues instead of a heap; codes that would be too long are cut, and others made longer
    until Kraft's sum is 1 again, which costs next to nothing of the best.
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
    """Return the canonical codes of such lengths (RFC 1951, 3.2.2); (N,) uint32, as the head of this file says."""
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


class Bits:
    """Bits in the order in which deflate writes them; for the few before and after a block's own."""

    def __init__(self, value: int = 0, number: int = 0) -> None:
        self.value = value
        self.number = number

    def put(self, value: int, bits: int) -> None:
        """Add the low `bits` of `value`, the others 0."""
        self.value |= value << self.number
        self.number += bits

    def put_code(self, code: int) -> None:
        """Add one code."""
        self.put(code & 0xFFFF, code >> 16)

    def to_bytes(self) -> bytes:
        """Return whole bytes, the last one filled up with zeros."""
        return self.value.to_bytes((self.number + 7) // 8, "little")


def head_of(literals: Lengths, distances: Lengths, *, last: bool) -> Bits:
    """Return the head of a block of dynamic codes of these lengths (RFC 1951, 3.2.7)."""
    told_literals = max(END + 1, int(np.flatnonzero(literals)[-1]) + 1)
    told_distances = max(1, int(np.flatnonzero(distances)[-1]) + 1) if distances.any() else 1
    told = [*literals[:told_literals].tolist(), *distances[:told_distances].tolist()]
    tokens = [token for value, run in groupby(told) for token in _tokens(value, len(list(run)))]
    frequencies = np.bincount([symbol for symbol, _, _ in tokens], minlength=_LENGTHS)
    lengths = code_lengths(frequencies, _LONGEST_OF_LENGTHS)
    codes = codes_of(lengths).tolist()
    ordered = lengths[_ORDER].tolist()
    while len(ordered) > 4 and not ordered[-1]:
        ordered.pop()
    bits = Bits()
    bits.put(int(last), 1)
    bits.put(2, 2)
    bits.put(told_literals - 257, 5)
    bits.put(told_distances - 1, 5)
    bits.put(len(ordered) - 4, 4)
    for length in ordered:
        bits.put(length, 3)
    for symbol, extra, number in tokens:
        bits.put_code(codes[symbol])
        bits.put(extra, number)
    return bits


def _tokens(value: int, run: int) -> Iterator[tuple[int, int, int]]:
    """Yield symbol, extra bits and their number for `run` equal lengths in a row."""
    if value:
        yield value, 0, 0
        run -= 1
    while run >= 3:
        if value:
            taken = min(run, 6)
            yield 16, taken - 3, 2
        elif run < 11:
            taken = run
            yield 17, taken - 3, 3
        else:
            taken = min(run, 138)
            yield 18, taken - 11, 7
        run -= taken
    for _ in range(run):
        yield value, 0, 0
