"""Measurements of one decoded frame."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.raw.rawfile import Mosaic
from drivers.raw.storage import Area
from experiment.measures import frame as measures


def mosaic(black: float = 2048.0) -> Mosaic:
    """Return a frame of 240 × 160 blocks in which each photosite of a block has its own level above black."""
    counts = np.tile(np.array([[1000, 2000], [2400, 1500]], dtype=np.uint16), (160, 240)) + np.uint16(black)
    return Mosaic(counts, "RGGB", np.full((2, 2), black), 15831, "a camera", counts, Area(0, 0, 320, 480), ())


@pytest.mark.slow
def test_measures_means_and_counts_clipped_photosites() -> None:
    frame = mosaic()
    even = measures.measure(frame)
    np.testing.assert_allclose(even.tiles, np.tile([1000.0, 2200, 1500], (24 * 16, 1)))
    np.testing.assert_allclose(even.strips, np.tile([1000.0, 2200, 1500], (160 * 4, 1)))
    assert (even.brightest_dn, even.range_dn, even.black) == (2400, 15831 - 2048, 2048)
    assert (even.clipped, even.empty, even.black_measured) == (0, 0, False)
    assert even.samples.shape == (8192, 2)
    assert (even.samples == 2048 + np.array([2000, 2400])).all()
    # 98 % of saturation is 15514.4; half of black 1024.
    frame.counts[100, 100:110] = 15514
    frame.counts[101, 100:107] = 15515
    frame.counts[200, 200:205] = 1024
    frame.counts[201, 200:203] = 1023
    uneven = measures.measure(frame)
    assert (uneven.clipped, uneven.empty) == pytest.approx((7 / 320 / 480, 3 / 320 / 480))
    # Rows 100 and 101 are in the sixth row of tiles, columns 100 to 109 in the sixth column.
    rise = 5 * (15514 - 2048 - 1000)
    assert uneven.tiles[5 * 24 + 5, 0] == pytest.approx(1000 + rise / 100)
    assert uneven.strips[50 * 4, 0] == pytest.approx(1000 + rise / 60)
    assert uneven.digest != even.digest


@pytest.mark.slow
@pytest.mark.parametrize(("black", "empty"), [(63.0, 0), (64.0, 4)])
def test_counts_photosites_far_below_black(black: float, empty: int) -> None:
    frame = mosaic(black)
    frame.counts[10, 10:14] = 0
    assert measures.measure(frame).empty == empty / frame.counts.size


@pytest.mark.parametrize(("floor", "slope", "top"), [(36.0, 0.55, 800.0), (0.5, 0.2, 40.0), (4.0, 0.0, 800.0)])
def test_measures_noise_from_pairs_of_greens(floor: float, slope: float, top: float) -> None:
    random = np.random.default_rng(4)
    level = random.uniform(0, top, 40_000)
    greens = level[:, None] + random.standard_normal((len(level), 2)) * np.sqrt(floor + slope * level)[:, None]
    # Some blocks are on an edge between two patches.
    greens[::50, 0] += 200
    noise = measures._noise(greens)
    levels = top * np.array([0.25, 0.5, 1.0])
    np.testing.assert_allclose(noise.variance(levels), floor + slope * levels, rtol=0.12)
    assert noise.variance(-100.0) == noise.variance(0.0) == noise.floor
