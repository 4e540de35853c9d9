"""Which of a colour's samples a pixel gets: a pure function of (seed, image number, light's place, x, y).

Tiles, threads and workers cannot change a choice. The rule is part of the dataset format
(`docs/decisions/0010-compiled-kernel.md` says why it is this one); all arithmetic is modulo 2³² but for p and q::

    keys     k0, k1, k2: the first words of Philox4x32-10 with counter (y, place, image, 0) and the seed as key
    word     i = 8 ⌊x/16⌋ + x mod 8,  h = (i ⊕ k0) · 0x21F0AAAD ⊕ k1,  h = (h ⊕ ⌊h/2¹⁶⌋) · 0x735A2D97 ⊕ k2,
             h = (h ⊕ ⌊h/2¹⁵⌋) · 0x31848BAB
    sample   p = h S and q = (p mod 2³²) S, S the samples of a colour; ⌊p/2³²⌋ where x mod 16 < 8, else ⌊q/2³²⌋

`place` is 0 but where lights are mixed per pixel: there it is the light's place among them. Rows are keyed by 96 random
bits, so rows, images, seeds and places are as independent as Philox makes them. Within a row three keyed rounds of
multiplying and shifting are needed: with one, pictures of two seeds are each other's with neighbours swapped; with two,
pixels whose distance is near a power of two depend on each other. The two choices from one word are its first two
digits in base S and differ from independent ones by less than S²/2³² of their probability.

The multipliers are odd numbers found by others to spread changes well: C. Wellons, "Prospecting for hash functions",
2018, and its collection of improved constants.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy import uint32, uint64

from foundation.compiled import inlined
from generator.kernels.vector import GROUP, LANES, LINE, choose, copy1, prefetch_once
from generator.philox import KEY_STEPS, MULTIPLIERS, ROUNDS, SAMPLES

LEAD: Final = 2
"""Groups of pixels by which choosing offsets leads fetching samples, so that the processor computes while it waits."""
OFFSETS_BYTES: Final = 4 * GROUP
"""Bytes of a group's offsets, uint32 each."""
_PREFETCH_BYTES: Final = 2048
"""Bytes by which prefetching the picture leads reading it, some 21 groups: time for the memory to answer."""
EDGE_BYTES: Final = 128
"""Bytes of scratch memory for the last pixels of a row: a group's 96, rounded up to whole lines of the cache."""
SCRATCH_BYTES: Final = EDGE_BYTES + 4 * OFFSETS_BYTES
"""Bytes of scratch memory a thread needs: a row's last pixels, and the offsets of four groups, LEAD + 1 in use."""

_P0: Final = np.uint64(MULTIPLIERS[0])
_P1: Final = np.uint64(MULTIPLIERS[1])
_W0: Final = np.uint32(KEY_STEPS[0])
_W1: Final = np.uint32(KEY_STEPS[1])
_HALF: Final = np.uint64(32)
_PURPOSE: Final = np.uint32(SAMPLES)


@inlined
def philox4x32(c0: Any, c1: Any, c2: Any, c3: Any, seed: Any) -> Any:
    """Return the four words of Philox4x32-10, compiled; words and counter are uint32, `seed` is uint64."""
    k0, k1 = uint32(seed), uint32(seed >> _HALF)
    for _ in range(ROUNDS):
        p0, p1 = uint64(c0) * _P0, uint64(c2) * _P1
        c0, c1, c2, c3 = (
            uint32(uint32(p1 >> _HALF) ^ c1 ^ k0),
            uint32(p1),
            uint32(uint32(p0 >> _HALF) ^ c3 ^ k1),
            uint32(p0),
        )
        k0, k1 = uint32(k0 + _W0), uint32(k1 + _W1)
    return c0, c1, c2, c3


@inlined
def row_words(y: Any, place: Any, image: Any, seed: Any) -> Any:
    """Return the three keys (uint32) of row `y`, and the word that `dithering.py` has for its own; `seed` is uint64."""
    k0, k1, k2, k3 = philox4x32(uint32(y), uint32(place), uint32(image), _PURPOSE, seed)
    return (k0, k1, k2), k3


@inlined
def row_keys(y: Any, place: Any, image: Any, seed: Any) -> Any:
    """Return the three keys (uint32) of row `y`; `seed` is uint64."""
    return row_words(y, place, image, seed)[0]


@inlined
def offsets_slot(scratch: int, group: int) -> int:
    """Return where in a thread's scratch memory the offsets of `group` stand until they are used."""
    return scratch + EDGE_BYTES + OFFSETS_BYTES * (group & 3)


@inlined
def group_address(row: int, width: int, group: int, scratch: int) -> int:
    """Return where the pixels from x = 32 `group` on can be read; `row` is the address of a row's first pixel.

    Of a group that reaches beyond the row only the pixels in the row are copied to scratch memory.
    """
    source = row + 3 * GROUP * group
    if GROUP * (group + 1) > width:
        for i in range(3 * (width - GROUP * group)):
            copy1(source + i, scratch + i)
        source = scratch
    return source


@inlined
def prefetch_group(row: int, group: int) -> None:
    """Prefetch a group's share of the pixels that will be read soon; to be called for every group in turn."""
    line = row + 3 * GROUP * group + _PREFETCH_BYTES
    prefetch_once(line)
    prefetch_once(line + LINE)


@inlined
def choose_group(row: int, width: int, group: int, keys: Any, count: Any, bits: Any, scratch: int, target: int) -> None:
    """Write the offsets, uint32 bytes, of the samples of a row's pixels from x = 32 `group` on at `target`."""
    source = group_address(row, width, group, scratch)
    choose(source, uint32(LANES * group), keys[0], keys[1], keys[2], count, bits, target)
