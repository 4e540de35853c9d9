"""How even and how independent the choices of samples are: `python -m benchmarks.choices [DRAWS]`, 10⁸ by default.

Chi-square of the 25 samples, of each place that shares a word, and of all 625 pairs of two pixels: at distances along a
row near and at powers of two, where weak functions show; above each other; in images and seeds that follow each other;
and with neighbours swapped between two seeds. Each statistic is reported as its distance from what chance expects, in
standard deviations of the normal distribution that Wilson and Hilferty's cube root makes of it; LIMIT is passed by
chance once in 10⁵ runs of all of them. Ends with exit code 1 if one is.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.generator import SAMPLES, report
from foundation.compiled import compiled
from generator.kernels.rendering import draw_samples

# Of 72 statistics, two-sided: 72 · 1.2·10⁻⁷ = 0.8·10⁻⁵.
LIMIT = 5.3
WIDTH, HEIGHT = 8192, 1024
DISTANCES = tuple(
    sorted({n for power in range(13) for n in (2**power, 3 * 2**power // 2, 2**power + 1, 17 * 2**power // 16)})
)
SWAPS = (1, 2, 4, 8, 16, 64, 1024)

Choices = npt.NDArray[np.uint8]


@compiled
def _count(one: Any, other: Any, distance: int, swap: int, counts: Any) -> None:
    """Count the pairs of `one` at x and `other` at (x ⊕ swap) + distance."""
    for y in range(one.shape[0]):
        for x in range(one.shape[1] - distance):
            counts[one[y, x] * SAMPLES + other[y, (x ^ swap) + distance]] += 1


def choices(seed: int, image: int, first_row: int) -> Choices:
    """Return the sample numbers (HEIGHT, WIDTH) uint8."""
    samples = np.zeros((8, SAMPLES, 3), np.uint16)
    samples[..., 0] = np.arange(SAMPLES)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    return draw_samples(samples, picture, seed=seed, image=image, first_row=first_row)[..., 0].astype(np.uint8)


def deviation(counts: npt.NDArray[np.int64]) -> float:
    """Return how far counts of equally likely classes are from chance, in standard deviations."""
    freedom = counts.size - 1
    expected = counts.sum() / counts.size
    statistic = float(((counts - expected) ** 2 / expected).sum())
    variance = 2 / (9 * freedom)
    return ((statistic / freedom) ** (1 / 3) - (1 - variance)) / variance**0.5


def main(draws: int = 10**8) -> int:
    bands = -(-draws // (WIDTH * HEIGHT))
    pairs: dict[str, npt.NDArray[np.int64]] = {}
    places = np.zeros((16, SAMPLES), np.int64)

    def count(name: str, one: Choices, other: Choices, distance: int = 0, swap: int = 0) -> None:
        _count(one, other, distance, swap, pairs.setdefault(name, np.zeros(SAMPLES**2, np.int64)))

    for band in range(bands):
        image, first_row = band // 4, band % 4 * HEIGHT
        here = choices(7, image, first_row)
        for place in range(16):
            places[place] += np.bincount(here[:, place::16].ravel(), minlength=SAMPLES)
        for distance in DISTANCES:
            count(f"pixels {distance} apart", here, here, distance)
        count("pixels above each other", here[:-1], here[1:])
        count("images that follow each other", here, choices(7, image + 1, first_row))
        count("seeds that differ above 2^32", here, choices(7 + (1 << 32), image, first_row))
        next_seed = choices(8, image, first_row)
        count("seeds that follow each other", here, next_seed)
        for swap in SWAPS:
            count(f"seeds with pixels {swap} apart swapped", here, next_seed, 0, swap)
    found = {name: deviation(counts) for name, counts in pairs.items()}
    found["all samples"] = deviation(places.sum(axis=0))
    found |= {f"samples at x mod 16 = {place}": deviation(counts) for place, counts in enumerate(places)}
    report("draws", float(places.sum()), "draws")
    for name, value in found.items():
        report(name, value, "standard deviations", "chance")
    worst = max(found, key=lambda name: abs(found[name]))
    report(f"worst of {len(found)}: {worst}", found[worst], "standard deviations", f"limit {LIMIT}")
    return int(abs(found[worst]) > LIMIT)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:2])))
