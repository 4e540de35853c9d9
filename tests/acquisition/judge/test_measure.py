"""What is measured of a frame, and where it is looked at in which no chart is known."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.judge import measure
from drivers.raw.rawfile import Mosaic, Plane
from drivers.raw.storage import Area


def mosaic(black: float = 2048.0) -> Mosaic:
    """Return a frame of 240 × 160 blocks in which each photosite of a block has its own level above black."""
    counts = np.tile(np.array([[1000, 2000], [2400, 1500]], dtype=np.uint16), (160, 240)) + np.uint16(black)
    return Mosaic(counts, "RGGB", np.full((2, 2), black), 15831, "a camera", counts, Area(0, 0, 320, 480), ())


@pytest.mark.slow
def test_a_frame_is_measured_by_means_of_its_colours_and_shares_of_odd_photosites() -> None:
    frame = mosaic()
    whole = measure.measure(frame)
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
    odd = measure.measure(frame)
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
    assert measure.measure(frame).empty == empty / frame.counts.size


@pytest.mark.parametrize(("floor", "slope", "top"), [(36.0, 0.55, 800.0), (0.5, 0.2, 40.0), (4.0, 0.0, 800.0)])
def test_noise_is_read_from_the_greens_of_one_block(floor: float, slope: float, top: float) -> None:
    random = np.random.default_rng(4)
    level = random.uniform(0, top, 40_000)
    greens = level[:, None] + random.standard_normal((len(level), 2)) * np.sqrt(floor + slope * level)[:, None]
    # Some blocks lie across an edge between two cells.
    greens[::50, 0] += 200
    found = measure._noise(greens)
    at = top * np.array([0.25, 0.5, 1.0])
    np.testing.assert_allclose(found.variance(at), floor + slope * at, rtol=0.12)
    assert found.variance(-100.0) == found.variance(0.0) == found.floor


def test_the_brightest_place_of_each_part_is_paper() -> None:
    height, width = 12 * 24, 16 * 20
    values = np.full((height, width), 100, dtype=np.float32)
    random = np.random.default_rng(1)
    corners = [(left, top) for top in range(2, height - 24, 24) for left in range(2, width - 20, 20)]
    places = [(left + int(random.integers(2, 16)), top + int(random.integers(2, 20))) for left, top in corners]
    for number, (x, y) in enumerate(places):
        # A third are darker than paper may be where light falls off.
        values[y - 1 : y + 2, x - 1 : x + 2] = 600 if number % 3 == 0 else 1000
    values[:, -16:] = 1000  # beyond the last whole part but the margin
    found = measure._brightest(values)
    assert found.tolist() == [list(place) for number, place in enumerate(places) if number % 3]


def test_paper_that_does_not_change_is_as_bright_in_the_frame_that_its_places_were_chosen_in() -> None:
    """As of the brightest of the noise it would be 1.2 % brighter there."""
    random = np.random.default_rng(4)
    scene = np.full((400, 600), 200.0)
    middles = [(x, y) for y in range(20, 380, 20) for x in range(20, 580, 20)]
    for x, y in middles:
        # Light falls off by a quarter, as it does over a frame.
        scene[y - 5 : y + 6, x - 5 : x + 6] = 1000 * (1 - 0.25 * np.hypot(x - 300, y - 200) / 360)
    first, later = (np.asarray(scene + random.normal(0, 15, scene.shape), dtype=np.float32) for _ in range(2))
    found = measure._paper(first, np.array(middles, dtype=np.float64))
    x, y = found.T
    assert len(found) == len(middles)
    assert np.abs(found - middles).max() <= 2
    levels = [np.mean([frame[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]) for frame in (first, later)]
    assert levels[0] == pytest.approx(levels[1], rel=1.5e-3)


def test_texture_is_many_edges_and_no_single_bright_photosite() -> None:
    values = np.zeros((480, 640), dtype=np.float32)
    x, y = 90, 100
    values[y - 12 : y + 12 : 2, x - 12 : x + 12] = 20
    values[180, 140] = 150
    framing = measure._textures(Plane("G", values, (0.5, 0.0)))
    middles = np.array([tag.corners_px.mean(axis=0) for tag in framing.tags])
    assert len(middles) == 8
    assert np.abs(middles - (x + 0.5, y)).max(axis=1).min() <= 6
