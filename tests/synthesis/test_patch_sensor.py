"""The photosites under the patches of a chart: whose light each has, how they differ, and how well black is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim.world.sensors import BODIES, Rectangle
from sim.world.world import Room
from synthesis.lamps import PatchSensor

BODY = BODIES["Test"]
EVEN = Room(response_spread=0.0, hot_per_million=0.0)


def test_every_photosite_has_the_light_of_its_own_channel_of_its_patch() -> None:
    sensor = PatchSensor.of(BODY, 2, 3, EVEN, 0.5)
    signals = np.array([[[10.0, 1], [20, 2], [30, 3]], [[40, 4], [50, 5], [60, 6]]])
    found = sensor.light(signals)
    assert found.shape == (3, 2 * 2 * 3, 2 * 3)
    assert BODY.pattern == "RGGB"
    blocks = [np.tile([[red, green], [green, blue]], (3, 3)) for red, green, blue in ((10, 20, 30), (40, 50, 60))]
    np.testing.assert_array_equal(found[0], np.concatenate(blocks))
    np.testing.assert_array_equal(found[1], found[0] / 10)
    assert not found[2].any()
    # Half-size pixels: patches of three of them, one below the other.
    assert (sensor.sites.rows.tolist(), sensor.sites.columns.tolist(), sensor.sites.window) == ([1, 4], [1, 1], 3)


def test_photosites_differ_by_the_spread_of_the_room() -> None:
    response = PatchSensor.of(BODY, 100, 5, replace(EVEN, response_spread=0.02), 0.5).response
    # 10 000 photosites: the mean is known to a hundredth of the spread, the spread to .7 %.
    assert response.mean() == pytest.approx(1, abs=5 * 0.0002)
    assert response.std() == pytest.approx(0.02, rel=5 * 0.007)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("masked", "photosites"),
    [
        ((), None),
        ((Rectangle(0, 0, 20, 4),), None),
        ((Rectangle(0, 0, 20, 14),), 20 * 10 / 4),
        ((Rectangle(0, 0, 20, 14), Rectangle(0, 20, 10, 8)), (20 * 10 + 10 * 4) / 4),
    ],
)
def test_black_is_known_by_the_masked_photosites(masked: tuple[Rectangle, ...], photosites: float | None) -> None:
    """But for the four columns beside each border, and a quarter of them for each place of the pattern."""
    body = replace(BODY, masked=masked, read_noise_dn=0.3, sensor_noise_e=0.0)
    sensor = PatchSensor.of(body, 1, 3, EVEN, 0.5)
    dark = np.zeros((3, 6, 6), np.float32)
    frames = range(400)
    found = np.array([sensor.expose(dark, np.ones(3), 400, frame)[1] for frame in frames]) - body.black
    if photosites is None:
        assert not found.any()
        return
    # The variances of read noise and of rounding to whole counts; 1600 numbers tell a spread to 1.8 %.
    error = np.sqrt((0.09 + 1 / 12) / photosites)
    assert found.std() == pytest.approx(error, rel=4 * 0.018)
    assert abs(found.mean()) < 4 * error / 40
