"""Training items in less light, and at another ISO speed, are as noisy as a camera's."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np
import pytest

from calibration.table.lut import Lut
from foundation.errors import InputError
from generator.rendering.black_points import BlackPoint
from generator.training.crops import Crops
from generator.training.gallery import gallery_of
from generator.variation.exposing import add_noise
from generator.variation.iso_speed import IsoSpeed
from generator.variation.sensor_noise import SensorNoise, measured_noise

NOISE = SensorNoise((6.0, 4.2, 5.0), (0.56, 0.28, 0.4))
WHITE = 10000


@pytest.mark.parametrize(("gain", "ratio"), [(0.25, 1.0), (0.5, 8.0), (2.0, 4.0)])
def test_the_noise_is_that_of_the_model(gain: float, ratio: float) -> None:
    mean = np.array([2000.0] * 3)
    counts = np.random.default_rng(1).normal(size=(1, 3, 300, 300))
    counts = mean[:, None, None] + counts * np.sqrt(np.square(NOISE.read) + NOISE.shot * mean)[:, None, None]
    items = (counts * gain / WHITE).astype(np.float32)
    wanted = NOISE.at(ratio, 2.8)
    add_noise(items, np.array([gain]), NOISE, np.array([5], np.uint64), white_level=WHITE, wanted=wanted, ratio=ratio)
    expected = np.square(wanted.read) + np.array(wanted.shot) * mean * gain
    seen = items.astype(np.float64)[0] * WHITE
    # Of 90 000 values a variance is known to a part in 212.
    assert np.abs(seen.var(axis=(1, 2)) / expected - 1).max() < 4.5 / 212
    assert np.abs(seen.mean(axis=(1, 2)) - gain * mean).max() < 4.5 * np.sqrt(expected.max()) / 300


def test_items_are_the_same_whoever_makes_them(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut(bits=3)
    gallery = gallery_of([np.full((40, 50, 3), 200, np.uint8)])
    noise = measured_noise(lut)
    plain = Crops(lut, gallery, (16, 16), length=40, exposure=(0.2, 2.0), seed=3)
    noisy = Crops(lut, gallery, (16, 16), length=40, exposure=(0.2, 2.0), seed=3, noise=noise)
    threaded = pickle.loads(
        pickle.dumps(Crops(lut, gallery, (16, 16), length=40, exposure=(0.2, 2.0), seed=3, noise=noise, threads=3))
    )
    one, other, again = (crops.batch(np.arange(40)).images.copy() for crops in (plain, noisy, threaded))
    np.testing.assert_array_equal(other, again)
    np.testing.assert_array_equal(noisy.batch([7, 3]).images, other[[7, 3]])
    changed = (one != other).any(axis=(1, 2, 3))
    # Gains above 1 keep their samples, those below get noise; both are among 40 items.
    assert changed.any()
    assert not changed.all()
    assert np.abs(one.mean(axis=(2, 3)) - other.mean(axis=(2, 3))).max() < 0.002
    loud = Crops(lut, gallery, (16, 16), length=40, seed=3, noise=noise, iso=IsoSpeed(1600, 100))
    quiet = Crops(lut, gallery, (16, 16), length=40, seed=3)
    spread = loud.batch(np.arange(40)).images.std(axis=(2, 3)) / quiet.batch(np.arange(40)).images.std(axis=(2, 3))
    # The samples are Poisson's, so all noise is shot noise, and 16 times the speed has 16 times the variance.
    assert np.median(spread) == pytest.approx(4, rel=0.1)


def test_black_that_is_taken_out_is_not_lifted_by_noise(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut(bits=3)
    gallery = gallery_of([np.zeros((60, 60, 3), np.uint8)])
    black = BlackPoint("random", most=0.97)
    crops = Crops(lut, gallery, (48, 48), length=6, lights=[0], noise=NOISE, iso=IsoSpeed(6400, 100), black_point=black)
    quiet = Crops(lut, gallery, (48, 48), length=6, lights=[0], black_point=black)
    noisy = crops.batch(np.arange(6)).images.astype(np.float64)
    plain = quiet.batch(np.arange(6)).images.astype(np.float64)
    # Noise of mean 0: cut off at 0 it would lift black by .4 of its standard deviation, that is by 60 standard errors.
    errors = (noisy - plain).std(axis=(2, 3)) / 48
    assert np.abs((noisy - plain).mean(axis=(2, 3)) / errors).max() < 5
    assert noisy.min() < 0


def test_what_is_refused(make_lut: Callable[..., Lut]) -> None:
    gallery = gallery_of([np.full((9, 9, 3), 200, np.uint8)])
    with pytest.raises(InputError, match="noise"):
        Crops(make_lut(), gallery, (8, 8), iso=IsoSpeed(200, 100))
    items, seeds = np.zeros((2, 3, 4, 4), np.float32), np.zeros(2, np.uint64)
    for gains in (np.ones(3), np.array([1.0, 0.0])):
        with pytest.raises(InputError):
            add_noise(items, gains, NOISE, seeds, white_level=100)
    with pytest.raises(InputError):
        add_noise(items.astype(np.float64), np.ones(2), NOISE, seeds, white_level=100)  # type: ignore[arg-type]
