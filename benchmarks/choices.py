"""Uniformity and independence of the sample choices: `python -m benchmarks.choices [DRAWS]`, 10⁸ draws by default.

Chi-square statistics are computed for the 25 samples, separately for each pixel position that shares a random word, and
for the 625 combinations of the samples of two pixels. Pairs of pixels are taken:

- in a row, at distances that are powers of two or nearly so, because weak generators fail there;
- above each other;
- from consecutive images and from consecutive seeds;
- from swapped neighbours with two seeds.

Each statistic is reported in standard deviations of a normal distribution (cube root of Wilson and Hilferty). By
chance, a statistic exceeds LIMIT in one of 10⁵ runs. The exit code is then 1.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.generator import SAMPLES, report
from foundation.compiled import compiled
from generator.kernels.rendering import draw_samples

# Limit in standard deviations for 72 statistics, two-sided: 72 · 1.2·10⁻⁷ = 0.8·10⁻⁵.
LIMIT = 5.3
WIDTH, HEIGHT = 8192, 1024
DISTANCES = tuple(
    sorted({n for power in range(13) for n in (2**power, 3 * 2**power // 2, 2**power + 1, 17 * 2**power // 16)})
)
SWAPS = (1, 2, 4, 8, 16, 64, 1024)

Choices = npt.NDArray[np.uint8]


@compiled
def _count(first: Any, second: Any, distance: int, swap: int, counts: Any) -> None:
    """Count the pairs of `first` at x and `second` at (x ⊕ swap) + distance."""
    for y in range(first.shape[0]):
        for x in range(first.shape[1] - distance):
            counts[first[y, x] * SAMPLES + second[y, (x ^ swap) + distance]] += 1


def choices(seed: int, image: int, first_row: int) -> Choices:
    """Return the sample numbers (HEIGHT, WIDTH) uint8."""
    samples = np.zeros((8, SAMPLES, 3), np.uint16)
    samples[..., 0] = np.arange(SAMPLES)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    return draw_samples(samples, picture, seed=seed, image=image, first_row=first_row)[..., 0].astype(np.uint8)


def deviation(counts: npt.NDArray[np.int64]) -> float:
    """Return the deviation of equally likely class counts from chance, in standard deviations."""
    freedom = counts.size - 1
    expected = counts.sum() / counts.size
    statistic = float(((counts - expected) ** 2 / expected).sum())
    variance = 2 / (9 * freedom)
    return ((statistic / freedom) ** (1 / 3) - (1 - variance)) / variance**0.5


def main(draws: int = 10**8) -> int:
    bands = -(-draws // (WIDTH * HEIGHT))
    pairs: dict[str, npt.NDArray[np.int64]] = {}
    position_counts = np.zeros((16, SAMPLES), np.int64)

    def count(name: str, first: Choices, second: Choices, distance: int = 0, swap: int = 0) -> None:
        _count(first, second, distance, swap, pairs.setdefault(name, np.zeros(SAMPLES**2, np.int64)))

    for band in range(bands):
        image, first_row = band // 4, band % 4 * HEIGHT
        band_choices = choices(7, image, first_row)
        for position in range(16):
            position_counts[position] += np.bincount(band_choices[:, position::16].ravel(), minlength=SAMPLES)
        for distance in DISTANCES:
            count(f"pixels {distance} apart", band_choices, band_choices, distance)
        count("pixels above each other", band_choices[:-1], band_choices[1:])
        count("consecutive images", band_choices, choices(7, image + 1, first_row))
        count("seeds that differ above 2^32", band_choices, choices(7 + (1 << 32), image, first_row))
        next_seed = choices(8, image, first_row)
        count("consecutive seeds", band_choices, next_seed)
        for swap in SWAPS:
            count(f"seeds with pixels {swap} apart swapped", band_choices, next_seed, 0, swap)
    deviations = {name: deviation(counts) for name, counts in pairs.items()}
    deviations["all samples"] = deviation(position_counts.sum(axis=0))
    deviations |= {
        f"samples at x mod 16 = {position}": deviation(counts) for position, counts in enumerate(position_counts)
    }
    report("draws", float(position_counts.sum()), "draws")
    for name, value in deviations.items():
        report(name, value, "standard deviations", "chance")
    worst = max(deviations, key=lambda name: abs(deviations[name]))
    report(f"worst of {len(deviations)}: {worst}", deviations[worst], "standard deviations", f"limit {LIMIT}")
    return int(abs(deviations[worst]) > LIMIT)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:2])))
