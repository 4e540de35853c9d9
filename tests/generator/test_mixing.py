"""Mixed lights: exact where one light is alone, additive in the mean, and as noisy as one exposure."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from drivers.errors import InputError
from generator.mixing import mixed_table

if TYPE_CHECKING:
    from collections.abc import Callable

    from calibration.lut import Lut

GAIN, READ = 1.0, 6.0
MEANS = (np.linspace(200, 4000, 512), np.linspace(3000, 100, 512))


@pytest.fixture(scope="module")
def noisy() -> npt.NDArray[np.uint16]:
    """Return two lights (2, 512, 400, 3): photon noise of gain 1 and read noise of 6 counts."""
    rng = np.random.default_rng(77)
    lights = [
        rng.poisson(mean[:, None, None], (512, 400, 3)) + rng.normal(0, READ, (512, 400, 3)) + 100 for mean in MEANS
    ]
    return np.rint(lights).astype(np.uint16)


def test_a_light_alone_is_that_light_to_the_last_bit(make_lut: Callable[..., Lut]) -> None:
    lut = make_lut()
    for light in range(4):
        weights = np.eye(4)[light]
        np.testing.assert_array_equal(mixed_table(lut.samples, weights, seed=3), lut.samples[light])
    np.testing.assert_array_equal(mixed_table([lut.samples[2]], [1]), lut.samples[2])


@pytest.mark.parametrize("weights", [(0.5, 0.5), (0.2, 0.8), (1.5, 0.5), (0.05, 0.3)])
def test_mean_and_variance_are_those_of_one_exposure(
    noisy: npt.NDArray[np.uint16], weights: tuple[float, float]
) -> None:
    mixed = mixed_table(noisy, weights, seed=9).astype(np.float64)
    samples = noisy.astype(np.float64)
    # Means: exact but for rounding, whose error of 1200 values is below 5 * sqrt(1/12/1200) = 0.042 except once in
    # 1.7 million.
    expected = np.tensordot(weights, samples.mean(axis=2), axes=1)
    assert np.abs(mixed.mean(axis=1) - expected).max() < 0.1
    # Variances, pooled over 512 x 3 sets of 400: relative error of the pool sqrt(2 / 614 400) = 0.0018; 5 of these.
    true = sum(w * (GAIN * mean + READ**2) for w, mean in zip(weights, MEANS, strict=True)) + 1 / 12
    measured = mixed.var(axis=1, ddof=1).mean(axis=1)
    assert abs((measured / true).mean() - 1) < 5 * 0.0018
    if weights == (0.5, 0.5):
        # The test can tell: the plain average has half the variance.
        plain = (samples * 0.5).sum(axis=0).var(axis=1, ddof=1).mean(axis=1)
        assert abs((plain / true).mean() - 0.5) < 0.02


def test_noise_of_the_lights_meets_by_chance(make_lut: Callable[..., Lut]) -> None:
    # Twice the same light: were sample i always to meet sample i, every variance would be doubled. The shuffles make
    # the ratio of pooled variances 1 but for 64 x 3 covariances of 25 pairs: standard error
    # sqrt(1 / (24 x 192)) = .015.
    samples = make_lut().samples[0]
    mixed = mixed_table([samples, samples], (0.5, 0.5), seed=1).astype(np.float64)
    ratio = (mixed.var(axis=1) / samples.var(axis=1)).mean()
    assert abs(ratio - 1) < 5 * 0.015
    assert not np.array_equal(mixed_table([samples, samples], (0.5, 0.5), seed=2), mixed)


def test_saturation_is_kept(noisy: npt.NDArray[np.uint16]) -> None:
    mixed = mixed_table(noisy, (3, 3), white_level=4095)
    assert mixed.max() == 4095


def test_faults_are_named(make_lut: Callable[..., Lut]) -> None:
    samples = make_lut().samples
    with pytest.raises(InputError, match=r"the weights are \[1.0, -0.5\]"):
        mixed_table(samples[:2], [1.0, -0.5])
    with pytest.raises(InputError, match="expected 2 finite numbers"):
        mixed_table(samples[:2], [float("nan"), 0])
    with pytest.raises(InputError, match="expected 2 finite numbers"):
        mixed_table(samples[:2], [1])
    with pytest.raises(InputError, match="no light was given"):
        mixed_table([], [])
    with pytest.raises(InputError, match="expected one shape"):
        mixed_table([samples[0], samples[0][:, :5]], [1, 1])
    with pytest.raises(InputError, match="the white level is 0"):
        mixed_table(samples[:1], [1], white_level=0)
    with pytest.raises(InputError, match="the samples are int64"):
        mixed_table([samples[0].astype(np.int64)], [1])  # pyright: ignore[reportArgumentType] - the fault under test
