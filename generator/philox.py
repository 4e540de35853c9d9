"""Random words as a pure function of the place of their use: Philox4x32-10.

Every random choice of the generator is a word of this function, so that a dataset's bytes depend on its seed alone and
never on tiles, threads, workers or the version of a library. The key is the seed (low word, high word). The counter is
(a, b, number, purpose): `purpose` keeps the streams below apart, `number` is the image, source or scene the word is
for, and a, b its place in there.

Source: J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011, section 3.3 and table 2.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError

MULTIPLIERS: Final = (0xD2511F53, 0xCD9E8D57)  # Of a round's two products: table 2 of the source
# Added to the key words after each round: the golden ratio and √3 − 1 (section 3.3).
KEY_STEPS: Final = (0x9E3779B9, 0xBB67AE85)
ROUNDS: Final = 10  # The authors' recommendation: three more than pass every statistical test

# Purpose of the words that choose which cell of the chart stands for a pixel, and one of the table's samples of it.
SAMPLES: Final = 0
LIGHTS: Final = 1  # Purpose of the words that choose the lights of a source picture
SCENES: Final = 2  # Purpose of the words that are the pixels of a random scene
MIXTURES: Final = 3  # Purpose of the words that shuffle the samples of mixed lights
CHROMATICITIES: Final = 4  # Purpose of the words that draw the chromaticities of lights from a distribution
MASKS: Final = 5  # Purpose of the words that shape where each of a picture's lights falls
CROPS: Final = 6  # Purpose of the words that choose where pictures are cut
ITEMS: Final = 7  # Purpose of the words that choose what a training item shows
VEILS: Final = 9  # Purpose of the words that choose which share of the print's veil is taken out of an image
EXPOSURES: Final = 12  # Purpose of the words that draw how much light an image is exposed to
GRADIENTS: Final = 13  # Purpose of the words that shape how the light of an image falls off
NOISE: Final = 14  # Purpose of the words that are the keys of the noise that is added to an image's rows

_WORD: Final = 0xFFFFFFFF  # Mask of the lower 32 bits, a word

Words = npt.NDArray[np.uint32]


def key_of(seed: int) -> tuple[int, int]:
    """Return the two key words of a seed 0 … 2⁶⁴ − 1."""
    if not 0 <= seed < 1 << 64:
        raise InputError(f"the seed is {seed}, expected a whole number from 0 to 2^64 - 1")
    return seed & _WORD, seed >> 32


def words(
    seed: int, a: npt.ArrayLike, b: npt.ArrayLike, number: npt.ArrayLike, purpose: int
) -> tuple[Words, Words, Words, Words]:
    """Return the four random words of each place.

    Returns uint32, of the broadcast shape of `a`, `b` and `number`, such as (N,).
    """
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
    """Return `count` distinct numbers of 0 … total − 1 in random order; every order is equally likely.

    A shuffle of Fisher and Yates stopped after `count` steps. Step i takes the first word w of place (i, 0) and draws
    i + ⌊w (total − i) / 2³²⌋.
    """
    drawn = [int(word) for word in words(seed, np.arange(count), 0, number, purpose)[0]]
    moved: dict[int, int] = {}
    chosen: list[int] = []
    for i, word in enumerate(drawn):
        j = i + (word * (total - i) >> 32)
        chosen.append(moved.get(j, j))
        moved[j] = moved.get(i, i)
    return tuple(chosen)


def standard_normal(words: tuple[Words, Words, Words, Words]) -> npt.NDArray[np.float64]:
    """Return standard normal (N, 2) float64 from the first two words (N,) uint32 (G. E. P. Box, M. E. Muller, 1958)."""
    radius = np.sqrt(-2 * np.log((words[0] + 1.0) / (_WORD + 1)))
    angle = 2 * np.pi * words[1] / (_WORD + 1)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
