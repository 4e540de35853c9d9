"""Exposure of counts and crops: noise model, rounding, saturation, independence of tiles and threads."""

from __future__ import annotations

import pickle
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import InputError
from generator import philox
from generator.rendering.black_points import BlackPoint
from generator.training.crops import Crops
from generator.training.gallery import gallery_of
from generator.variation.exposing import add_noise, brightness_reached, expose
from generator.variation.iso_speed import IsoSpeed
from generator.variation.sensor_noise import SensorNoise, measured_noise, normal_deviates
from tests.generator.conftest import MakeLut

PLANES = SensorNoise((6.0, 4.2, 5.0), (0.56, 0.28, 0.4))
WHITE = 10000


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "ratio"), [(0.25, 1.0), (0.5, 8.0), (2.0, 4.0)])
def test_crop_noise_follows_the_model(gain: float, ratio: float) -> None:
    mean = np.array([2000.0] * 3)
    counts = np.random.default_rng(1).normal(size=(1, 3, 300, 300))
    counts = mean[:, None, None] + counts * np.sqrt(np.square(PLANES.read) + PLANES.shot * mean)[:, None, None]
    items = (counts * gain / WHITE).astype(np.float32)
    target = PLANES.at(ratio, 2.8)
    add_noise(
        items,
        np.array([gain]),
        PLANES,
        np.array([5], np.uint64),
        white_level=WHITE,
        target_noise=target,
        iso_ratio=ratio,
    )
    expected = np.square(target.read) + np.array(target.shot) * mean * gain
    counted = items.astype(np.float64)[0] * WHITE
    # The variance of 90 000 values has a standard error of 1/212.
    assert np.abs(counted.var(axis=(1, 2)) / expected - 1).max() < 4.5 / 212
    assert np.abs(counted.mean(axis=(1, 2)) - gain * mean).max() < 4.5 * np.sqrt(expected.max()) / 300


@pytest.mark.slow
def test_noise_is_independent_of_batches_and_threads(make_lut: MakeLut) -> None:
    lut = make_lut(bits=3)
    gallery = gallery_of([np.full((40, 50, 3), 200, np.uint8)])
    noise = measured_noise(lut)
    plain = Crops(lut, gallery, (16, 16), length=40, exposure=(0.2, 2.0), seed=3)
    noisy = Crops(lut, gallery, (16, 16), length=40, exposure=(0.2, 2.0), seed=3, noise=noise)
    threaded = pickle.loads(
        pickle.dumps(Crops(lut, gallery, (16, 16), length=40, exposure=(0.2, 2.0), seed=3, noise=noise, threads=3))
    )
    plainly, noised, threaded_run = (crops.batch(np.arange(40)).images.copy() for crops in (plain, noisy, threaded))
    np.testing.assert_array_equal(noised, threaded_run)
    np.testing.assert_array_equal(noisy.batch([7, 3]).images, noised[[7, 3]])
    changed = (plainly != noised).any(axis=(1, 2, 3))
    # Crops with gains above 1 keep their samples, the others get noise; 40 items contain both.
    assert changed.any()
    assert not changed.all()
    assert np.abs(plainly.mean(axis=(2, 3)) - noised.mean(axis=(2, 3))).max() < 0.002
    loud = Crops(lut, gallery, (16, 16), length=40, seed=3, noise=noise, iso=IsoSpeed(1600, 100))
    quiet = Crops(lut, gallery, (16, 16), length=40, seed=3)
    spread = loud.batch(np.arange(40)).images.std(axis=(2, 3)) / quiet.batch(np.arange(40)).images.std(axis=(2, 3))
    # The samples have Poisson noise only, so 16 times the speed has 16 times the variance.
    assert np.median(spread) == pytest.approx(4, rel=0.1)


@pytest.mark.slow
def test_noise_does_not_raise_subtracted_black(make_lut: MakeLut) -> None:
    lut = make_lut(bits=3)
    gallery = gallery_of([np.zeros((60, 60, 3), np.uint8)])
    black = BlackPoint("random", largest_share=0.97)
    crops = Crops(
        lut, gallery, (48, 48), length=6, lights=[0], noise=PLANES, iso=IsoSpeed(6400, 100), black_point=black
    )
    quiet = Crops(lut, gallery, (48, 48), length=6, lights=[0], black_point=black)
    noisy = crops.batch(np.arange(6)).images.astype(np.float64)
    plain = quiet.batch(np.arange(6)).images.astype(np.float64)
    # Noise of mean 0; clipped at 0 it would raise black by 0.4 standard deviations, 60 standard errors.
    errors = (noisy - plain).std(axis=(2, 3)) / 48
    assert np.abs((noisy - plain).mean(axis=(2, 3)) / errors).max() < 5
    assert noisy.min() < 0


NOISE = SensorNoise(read=(6.0, 4.2, 5.0), shot=(0.56, 0.28, 0.4))
QUIET = SensorNoise((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
Image = npt.NDArray[np.uint16]


def photographed_patch(mean: float, noise: SensorNoise, side: int = 400, seed: int = 1) -> Image:
    """Return a flat patch photographed with that noise."""
    sd = np.sqrt(np.square(noise.read) + np.array(noise.shot) * mean)
    drawn = np.random.default_rng(seed).normal(mean, 1, (side, side, 3))
    return np.rint(mean + (drawn - mean) * sd).clip(0, 65535).astype(np.uint16)


def assert_noise(patch: Image, mean: float, noise: SensorNoise) -> None:
    """Check mean and variance of a flat patch within 4.5 standard errors; rounding adds a variance of 1/12."""
    count = patch.shape[0] * patch.shape[1]
    expected = np.square(noise.read) + np.array(noise.shot) * mean + 1 / 12
    assert np.abs(patch.mean(axis=(0, 1)) - mean).max() < 4.5 * np.sqrt(expected.max() / count)
    ratio = patch.var(axis=(0, 1)) / expected
    # The samples of the patch were rounded, too, which adds up to 1/12.
    assert np.abs(ratio - 1).max() < 4.5 * np.sqrt(2 / count) + 0.2 / expected.min()


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.25, 0.5, 0.9])
def test_noise_of_less_light(factor: float) -> None:
    patch = photographed_patch(2000, NOISE)
    expose(patch, factor, NOISE)
    assert_noise(patch, factor * 2000, NOISE)
    # The test detects counts that are only divided.
    divided = np.rint(photographed_patch(2000, NOISE) * factor).astype(np.uint16)
    with pytest.raises(AssertionError):
        assert_noise(divided, factor * 2000, NOISE)


@pytest.mark.parametrize(("ratio", "factor"), [(8.0, 1.0), (8.0, 0.5), (4.0, 3.0)])
def test_noise_of_higher_iso_speed(ratio: float, factor: float) -> None:
    target = NOISE.at(ratio, sensor_electrons=2.8)
    patch = photographed_patch(1000, NOISE)
    expose(patch, factor, NOISE, target_noise=target, iso_ratio=ratio)
    assert_noise(patch, factor * 1000, target)


def test_noise_of_factor_above_iso_ratio() -> None:
    noise = SensorNoise((0.0, 0.0, 0.0), NOISE.shot)
    patch = photographed_patch(1000, noise)
    expose(patch, 3.0, noise, target_noise=noise.at(2), iso_ratio=2)
    variance = patch.var(axis=(0, 1)) / (3 * 3 * 1000 * np.array(noise.shot))
    assert np.abs(variance - 1).max() < 0.02


def test_noise_at_the_far_end() -> None:
    patch = photographed_patch(2000, NOISE)
    weights = np.zeros((400, 400, 2), np.float32)
    weights[:, :200, 0], weights[:, 200:, 1] = 1, 1
    expose(patch, 1.0, NOISE, weights=weights, far_end=(0.5, 0.5, 0.5))
    assert_noise(patch[:, :200], 2000, NOISE)
    assert_noise(patch[:, 200:], 1000, NOISE)
    np.testing.assert_array_equal(patch[:, :200], photographed_patch(2000, NOISE)[:, :200])


def test_far_end_with_tint() -> None:
    image = np.full((1, 3, 3), 1000, np.uint16)
    weights = np.array([[[1, 0], [0.5, 0.5], [0, 1]]], np.float32)
    expose(image, 2.0, QUIET, weights=weights, far_end=(0.5, 1.0, 0.25))
    np.testing.assert_array_equal(image[0], [[2000, 2000, 2000], [1500, 2000, 1250], [1000, 2000, 500]])


def test_rounding_has_no_bias() -> None:
    # Every odd count is a tie at half the light: rounding halves up would raise the mean by 0.25.
    image = np.arange(60000, dtype=np.uint16).reshape(100, 200, 3)
    expose(image, 0.5, QUIET)
    assert abs(image.mean() - np.arange(60000).mean() / 2) < 1e-3


@pytest.mark.parametrize("factor", [1.0, 4.0, 64.0, 1e6])
def test_clips_at_saturation(factor: float) -> None:
    image = np.tile(np.arange(65536, dtype=np.uint16)[:, None, None], (1, 2, 3))
    loud = SensorNoise((300.0, 300.0, 300.0), (5.0, 5.0, 5.0))
    share = expose(image, factor, loud, target_noise=loud.at(16), iso_ratio=16, white_level=12000)
    assert image.max() == 12000
    # Far above saturation all pixels are saturated; a wrapped count would be dark.
    assert (image[40000:] == 12000).all()
    assert share == pytest.approx((image.max(axis=2) == 12000).mean())


def test_clips_at_0() -> None:
    image = np.zeros((200, 200, 3), np.uint16)
    expose(image, 0.5, NOISE, target_noise=NOISE.at(4), iso_ratio=4)
    assert (image == 0).mean() == pytest.approx(0.5, abs=0.05)
    assert image.max() < 200


def test_deviates_follow_the_rule() -> None:
    image = np.full((3, 37, 3), 4000, np.uint16)
    noise, seed, number = SensorNoise((3.0, 2.0, 4.0), (0.5, 0.25, 0.5)), 0xFEDCBA9876543210, 77
    expose(image, 0.5, noise, seed=seed, number=number, first_row=5)
    quantiles: list[float] = [NormalDist().inv_cdf((index + 0.5) / 2**14) for index in range(2**14)]
    scale = float(np.sqrt(np.mean(np.square(quantiles))))
    for y in range(3):
        k0, k1, _, _ = (int(key) for key in philox.words(seed, 5 + y, 0, number, philox.NOISE))
        for x in range(37):
            word: int = ((k1 << 32 | k0) + (x + 1) * 0x9E3779B97F4A7C15) % 2**64
            word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 % 2**64
            word = (word ^ word >> 27) * 0x94D049BB133111EB % 2**64
            word ^= word >> 31
            for channel in range(3):
                z: float = quantiles[word >> (50 - 14 * channel) & 16383] / scale
                added_variance = 0.75 * noise.read[channel] ** 2 + 0.5 * noise.shot[channel] * 2000
                assert abs(image[y, x, channel] - (2000 + z * added_variance**0.5)) < 0.501


def test_splitmix64_matches_published_output() -> None:
    # The published first output of SplitMix64 for state 0 is e220a8397b1dcdaf; the rule above uses the same steps.
    word = 0x9E3779B97F4A7C15
    word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9 % 2**64
    word = (word ^ word >> 27) * 0x94D049BB133111EB % 2**64
    assert word ^ word >> 31 == 0xE220A8397B1DCDAF


def test_result_is_independent_of_tiles() -> None:
    whole = photographed_patch(3000, NOISE, 97)
    source = whole.copy()
    weights = np.random.default_rng(4).random((97, 97, 2), dtype=np.float32)
    options: dict[str, Any] = {"far_end": (0.3, 0.5, 0.4), "white_level": 2500, "seed": 8, "number": 3}
    share = expose(whole, 0.8, NOISE, weights=weights, **options)
    again = np.empty_like(source)
    assert expose(source, 0.8, NOISE, weights=weights, out=again, **options) == share
    np.testing.assert_array_equal(again, whole)
    tile = source[40:60].copy()
    expose(tile, 0.8, NOISE, weights=weights[40:60], first_row=40, **options)
    np.testing.assert_array_equal(tile, whole[40:60])
    other_image = source.copy()
    options["number"] = 4
    expose(other_image, 0.8, NOISE, weights=weights, **options)
    assert (other_image != whole).mean() > 0.5


@pytest.mark.slow
def test_deviates_of_pixels_rows_and_channels_are_independent() -> None:
    # A constant count, so that all variance is added noise.
    image = np.full((500, 500, 3), 20000, np.uint16)
    noise = SensorNoise((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    expose(image, 1.0, QUIET, target_noise=SensorNoise((1000.0, 1000.0, 1000.0), noise.shot))
    z = (image.astype(np.float64) - 20000) / 1000
    limit = 4.5 / 500
    for first, second in (
        (z[:, :-1], z[:, 1:]),
        (z[:, :-16], z[:, 16:]),
        (z[:-1], z[1:]),
        (z[..., 0], z[..., 1]),
        (z[..., 1], z[..., 2]),
        (z[..., 0], z[..., 2]),
    ):
        assert abs((first * second).mean()) < limit
        assert abs((np.square(first) * np.square(second)).mean() - 1) < 3 * limit
    # Kurtosis of a normal distribution; the sum of four uniform numbers would have 2.7.
    assert np.mean(z**4) == pytest.approx(3, abs=0.03)


def test_deviates_have_moments_of_normal_distribution() -> None:
    table = normal_deviates().astype(np.float64)
    assert table.mean() == 0
    assert np.mean(table**2) == pytest.approx(1, abs=1e-6)
    assert np.mean(table**4) == pytest.approx(3, abs=0.01)


def test_brightness_reached_by_share() -> None:
    rng = np.random.default_rng(6)
    image = rng.integers(0, 5000, (120, 130, 3)).astype(np.uint16)
    brightest = np.sort(image.max(axis=2).reshape(-1))[::-1]
    for share in (0.001, 0.02, 0.5):
        assert brightness_reached(image, share) == brightest[round(share * brightest.size) - 1]
    assert brightness_reached(image, 0.0) == brightest[0] + 0.5
    weights = rng.random((120, 130, 2), dtype=np.float32)
    fallen = image * (1 - weights[..., 1:] * np.array([0.5, 0.25, 0.75], np.float32))
    expected = np.sort(np.floor(fallen.max(axis=2)).reshape(-1))[::-1][round(0.02 * brightest.size) - 1]
    assert abs(brightness_reached(image, 0.02, weights, (0.5, 0.75, 0.25)) - expected) <= 1


def test_refuses_invalid_arguments() -> None:
    image = np.zeros((4, 4, 3), np.uint16)
    for invalid_call in (
        lambda: expose(image.astype(np.float32), 1.0, NOISE),  # type: ignore[arg-type]
        lambda: expose(image, 1.0, NOISE, weights=np.zeros((4, 4, 2), np.float32), far_end=(0.5, 1.5, 0.5)),
        lambda: expose(image[:, ::2], 1.0, NOISE),
        lambda: expose(image, 1.0, NOISE, seed=-1),
    ):
        with pytest.raises(InputError):
            invalid_call()
