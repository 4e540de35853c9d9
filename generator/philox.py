"""Random words as a pure function of a counter: Philox4x32-10.

Every random choice of the generator is a word of this function. The bytes of a data set therefore depend on the seed,
but not on tiles, threads, workers or versions of libraries. The key is the seed (low word, high word). The counter is
(a, b, number, purpose): `purpose` separates the streams below, `number` is the image, source or scene, and a and b are
the position in it.

Source: J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011, section 3.3 and table 2.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

MULTIPLIERS: Final = (0xD2511F53, 0xCD9E8D57)  # Factors of the two products of a round: table 2 of the source
# Added to the key words after each round: the golden ratio and √3 − 1 (section 3.3).
KEY_STEPS: Final = (0x9E3779B9, 0xBB67AE85)
ROUNDS: Final = 10  # The authors' recommendation: 7 rounds pass all statistical tests, 3 more are a margin

# Purposes, one for each random choice. Do not change the numbers, because the bytes of data sets depend on them.
SAMPLES: Final = 0  # Patch of the chart for a pixel, and one of its samples
LIGHTS: Final = 1  # Illuminants of a source picture
SCENES: Final = 2  # Pixels of a random scene
MIXTURES: Final = 3  # Order of the samples of mixed illuminants
CHROMATICITIES: Final = 4  # Chromaticities of illuminants from a distribution
MASKS: Final = 5  # Shapes of the masks of several illuminants
CROPS: Final = 6  # Positions of crops
ITEMS: Final = 7  # Content of a training item
VEILS: Final = 9  # Share of the black of the print that is subtracted from an image
EXPOSURES: Final = 12  # Exposure of an image
GRADIENTS: Final = 13  # Fall-off of brightness over an image
NOISE: Final = 14  # Keys of the noise added to the rows of an image
ROUNDING: Final = 15  # Keys of the rounding of pixels rendered by colour

_WORD: Final = 0xFFFFFFFF  # Mask of one word, the lower 32 bits

Words = npt.NDArray[np.uint32]


def key_of(seed: int) -> tuple[int, int]:
    """Return the low and the high word of a seed."""
    if not 0 <= seed < 1 << 64:
        raise InputError(f"the seed is {seed}, expected an integer from 0 to 2^64 - 1; correct it")
    return seed & _WORD, seed >> 32


def words(
    seed: int, a: npt.ArrayLike, b: npt.ArrayLike, number: npt.ArrayLike, purpose: int
) -> tuple[Words, Words, Words, Words]:
    """Return the four random words of each counter: uint32, of the broadcast shape of `a`, `b` and `number`."""
    keys = list(key_of(seed))
    c0, c1, c2 = np.broadcast_arrays(*(np.asarray(counter, dtype=np.uint64) for counter in (a, b, number)))
    c3 = np.full_like(c0, purpose)
    low, half = np.uint64(_WORD), np.uint64(32)
    m0, m1 = (np.uint64(multiplier) for multiplier in MULTIPLIERS)
    for _ in range(ROUNDS):
        p0, p1 = c0 * m0, c2 * m1
        c0, c1 = (p1 >> half) ^ c1 ^ np.uint64(keys[0]), p1 & low
        c2, c3 = (p0 >> half) ^ c3 ^ np.uint64(keys[1]), p0 & low
        keys = [(key + step) & _WORD for key, step in zip(keys, KEY_STEPS, strict=True)]
    return c0.astype(np.uint32), c1.astype(np.uint32), c2.astype(np.uint32), c3.astype(np.uint32)


def distinct(seed: int, count: int, total: int, number: int, purpose: int) -> tuple[int, ...]:
    """Return `count` distinct numbers of 0 … total − 1 in random order; every order is equally likely."""
    # Fisher-Yates shuffle, stopped after `count` steps. Step i uses the first word w of counter (i, 0) and draws
    # i + ⌊w (total − i) / 2³²⌋.
    drawn = [int(word) for word in words(seed, np.arange(count), 0, number, purpose)[0]]
    moved: dict[int, int] = {}
    selected: list[int] = []
    for i, word in enumerate(drawn):
        j = i + (word * (total - i) >> 32)
        selected.append(moved.get(j, j))
        moved[j] = moved.get(i, i)
    return tuple(selected)


def standard_normal(words: tuple[Words, Words, Words, Words]) -> npt.NDArray[np.float64]:
    """Return standard normal (N, 2) float64 from the first two words (N,) uint32 (G. E. P. Box, M. E. Muller, 1958)."""
    radius = np.sqrt(-2 * np.log((words[0] + 1.0) / (_WORD + 1)))
    angle = 2 * np.pi * words[1] / (_WORD + 1)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
