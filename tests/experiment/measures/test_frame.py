"""What is measured of a decoded frame."""

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
def test_a_frame_is_measured_by_means_of_its_colours_and_shares_of_odd_photosites() -> None:
    frame = mosaic()
    whole = measures.measure(frame)
    np.testing.assert_allclose(whole.tiles, np.tile([1000.0, 2200, 1500], (24 * 16, 1)))
    np.testing.assert_allclose(whole.strips, np.tile([1000.0, 2200, 1500], (160 * 4, 1)))
    assert (whole.brightest_dn, whole.range_dn, whole.black) == (2400, 15831 - 2048, 2048)
    assert (whole.clipped, whole.empty, whole.black_measured) == (0, 0, False)
    assert whole.samples.shape == (8192, 2)
    assert (whole.samples == 2048 + np.array([2000, 2400])).all()
    # 98 % of saturation is 15514.4; half of black 1024.
    frame.counts[100, 100:110] = 15514
    frame.counts[101, 100:107] = 15515
    frame.counts[200, 200:205] = 1024
    frame.counts[201, 200:203] = 1023
    odd = measures.measure(frame)
    assert (odd.clipped, odd.empty) == pytest.approx((7 / 320 / 480, 3 / 320 / 480))
    # Rows 100 and 101 are of the sixth row of tiles, columns 100 to 109 of the sixth column.
    rise = 5 * (15514 - 2048 - 1000)
    assert odd.tiles[5 * 24 + 5, 0] == pytest.approx(1000 + rise / 100)
    assert odd.strips[50 * 4, 0] == pytest.approx(1000 + rise / 60)
    assert odd.digest != whole.digest


@pytest.mark.slow
@pytest.mark.parametrize(("black", "empty"), [(63.0, 0), (64.0, 4)])
def test_counts_below_black_are_none_of_a_sensor_where_there_is_black(black: float, empty: int) -> None:
    frame = mosaic(black)
    frame.counts[10, 10:14] = 0
    assert measures.measure(frame).empty == empty / frame.counts.size


@pytest.mark.parametrize(("floor", "slope", "top"), [(36.0, 0.55, 800.0), (0.5, 0.2, 40.0), (4.0, 0.0, 800.0)])
def test_noise_is_read_from_the_greens_of_one_block(floor: float, slope: float, top: float) -> None:
    random = np.random.default_rng(4)
    level = random.uniform(0, top, 40_000)
    greens = level[:, None] + random.standard_normal((len(level), 2)) * np.sqrt(floor + slope * level)[:, None]
    # Some blocks lie across an edge between two cells.
    greens[::50, 0] += 200
    found = measures._noise(greens)
    at = top * np.array([0.25, 0.5, 1.0])
    np.testing.assert_allclose(found.variance(at), floor + slope * at, rtol=0.12)
    assert found.variance(-100.0) == found.variance(0.0) == found.floor
