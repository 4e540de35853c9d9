"""Where crops are cut from a picture at random: a function of a seed and the picture's name."""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np

from generator import philox

_CANDIDATES: Final = 8
"""Places of which a further crop takes the best; chosen, not measured: with one, crops may be nearly the same."""


def random_places(
    free: tuple[int, int],
    size: tuple[int, int],
    count: int,
    seed: int,
    name: str,
    first: tuple[int, int] | None = None,
) -> list[tuple[int, int]]:
    """Return `count` different places of crops in a picture.

    Candidate n is made of the first two words of Philox with counter (a + n mod 2³², b, number, 6); a, b, number are
    the first three words of the SHA-256 of the picture's name. The first crop is at candidate 0, or at `first`. Each
    further one is at that of the next eight candidates which overlaps least with the crops before it, the first of
    equals, as in best-candidate sampling (D. Mitchell, "Spectrally optimal sampling for distribution ray tracing",
    SIGGRAPH 1991), where its eight are all taken, at the first free place after them, row by row.

    `free`: columns and rows at which a crop can begin, 1 or more; together `count` or more places. `size`: width and
    height of a crop, px. `first`: column and row of the first crop, px; None for a random place. Returns column and row
    of each, px.

    Examples
    --------
    >>> sorted(random_places((2, 2), (8, 8), 4, seed=0, name="a.png"))
    [(0, 0), (0, 1), (1, 0), (1, 1)]
    """
    digest = hashlib.sha256(name.encode("utf-8", "surrogateescape")).digest()
    a, b, number = (int.from_bytes(digest[at : at + 4], "little") for at in (0, 4, 8))
    tried = (a + np.arange(1 + _CANDIDATES * (count - 1), dtype=np.int64)) % (1 << 32)
    across, down, _, _ = philox.words(seed, tried, b, number, philox.CROPS)
    candidates = [
        (int(column) * free[0] >> 32, int(row) * free[1] >> 32) for column, row in zip(across, down, strict=True)
    ]
    places = candidates[:1] if first is None else [first]
    for crop in range(1, count):
        begin = 1 + _CANDIDATES * (crop - 1)
        left = [place for place in candidates[begin : begin + _CANDIDATES] if place not in places]
        if left:
            places.append(min(left, key=lambda place: max(_overlap(place, other, size) for other in places)))
            continue
        last = candidates[begin + _CANDIDATES - 1]
        start, total = last[1] * free[0] + last[0], free[0] * free[1]
        following = (((start + step) % total % free[0], (start + step) % total // free[0]) for step in range(total))
        places.append(next(place for place in following if place not in places))
    return places


def _overlap(one: tuple[int, int], other: tuple[int, int], size: tuple[int, int]) -> int:
    """Return the pixels that crops at two places share."""
    wide, high = (max(0, side - abs(a - b)) for side, a, b in zip(size, one, other, strict=True))
    return wide * high
