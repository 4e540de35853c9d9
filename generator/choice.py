"""Which of a colour's samples a pixel gets: a pure function of (seed, image number, light's place, x, y).

Tiles, threads and workers cannot change a choice. The rule is part of the dataset format
(`docs/decisions/0010-compiled-kernel.md` says why it is this one); all arithmetic is modulo 2³² but for p and q:

    keys     k0, k1, k2: the first words of Philox4x32-10 with counter (y, place, image, 0) and the seed as key
    word     i = 16 ⌊x/32⌋ + x mod 16,  h = (i ⊕ k0) · 0x21F0AAAD ⊕ k1,  h = (h ⊕ ⌊h/2¹⁶⌋) · 0x735A2D97 ⊕ k2,
             h = (h ⊕ ⌊h/2¹⁵⌋) · 0x31848BAB
    sample   p = h S and q = (p mod 2³²) S, S the samples of a colour; ⌊p/2³²⌋ where x mod 32 < 16, else ⌊q/2³²⌋

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

import numba
import numpy as np
from numba import uint32, uint64

from generator.philox import KEY_STEPS, MULTIPLIERS, ROUNDS, SAMPLES

M0: Final = np.uint32(0x21F0AAAD)
M1: Final = np.uint32(0x735A2D97)
M2: Final = np.uint32(0x31848BAB)
_P0: Final = np.uint64(MULTIPLIERS[0])
_P1: Final = np.uint64(MULTIPLIERS[1])
_W0: Final = np.uint32(KEY_STEPS[0])
_W1: Final = np.uint32(KEY_STEPS[1])
_HALF: Final = np.uint64(32)
_PURPOSE: Final = np.uint32(SAMPLES)


@numba.njit(inline="always")
def row_keys(y: Any, place: Any, image: Any, seed: Any) -> Any:
    """Return the three keys (uint32) of row `y`; `seed` is uint64."""
    c0, c1, c2, c3 = uint32(y), uint32(place), uint32(image), _PURPOSE
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
    return c0, c1, c2


@numba.njit(inline="always")
def chosen(x: Any, keys: Any, count: Any) -> Any:
    """Return the sample of column `x` in a row of these keys; `count` samples to choose from."""
    h = uint32(uint32(((x >> 5) << 4) | (x & 15)) ^ keys[0])
    h = uint32(uint32(h * M0) ^ keys[1])
    h = uint32(uint32(uint32(h ^ (h >> uint32(16))) * M1) ^ keys[2])
    h = uint32(uint32(h ^ (h >> uint32(15))) * M2)
    p = uint64(h) * uint64(count)
    if x & 16:
        p = uint64(uint32(p)) * uint64(count)
    return np.int64(p >> _HALF)


@numba.njit(inline="always")
def colour_of(pixel: Any, bits: Any) -> Any:
    """Return the colour index of an 8-bit pixel: the upper `bits` of red, green, blue, red first."""
    shift = 8 - bits
    return (
        (np.int64(pixel[0] >> shift) << (2 * bits))
        | (np.int64(pixel[1] >> shift) << bits)
        | np.int64(pixel[2] >> shift)
    )
