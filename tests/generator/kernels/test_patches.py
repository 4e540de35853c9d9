"""Patches of generated images against the table: mean and variance of every colour under mixed and several lights.

A picture holds a patch of each of the table's 64 colours, 25 600 pixels each. A pixel is an independent draw, so a
patch's mean and variance are normal about the table's, with standard errors that follow from the table's own moments.
Each test looks at 64 · 3 means and as many variances; all of its bounds together fail a true generator once in 10⁵.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import norm

from foundation.colorimetry import angles_deg
from generator.kernels.mixing import mix_samples
from generator.kernels.rendering import draw_samples
from generator.lights.lighting import Lighting, Mixture, plain
from generator.masks.making import FULL, parse_masks
from generator.masks.maps import quantised_chromaticities

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_Array = npt.NDArray[np.float64]
SIDE = 160
BOUND = float(norm.isf(1e-5 / (64 * 3 * 2) / 2))
MIXTURE = Mixture((0, 1, 3), (0.2, 0.3, 0.5))


@pytest.fixture(scope="module")
def patches() -> npt.NDArray[np.uint8]:
    """Return (8 · SIDE, 8 · SIDE, 3): colour i in row i // 8, column i mod 8."""
    index = np.arange(64).reshape(8, 8)
    codes = np.stack([index >> 4 & 3, index >> 2 & 3, index & 3], axis=-1).astype(np.uint8) * 64 + 17
    return codes.repeat(SIDE, axis=0).repeat(SIDE, axis=1)


def cells(image: npt.NDArray[np.generic]) -> _Array:
    """Return the pixels (64, N, 3) of each of 8 x 8 patches."""
    side = len(image) // 8
    blocks = image.reshape(8, side, 8, side, -1).transpose(0, 2, 1, 3, 4)
    return np.asarray(blocks.reshape(64, side * side, -1), dtype=np.float64)


def cumulants(samples: npt.NDArray[np.uint16]) -> tuple[_Array, _Array, _Array]:
    """Return mean, variance and fourth cumulant (C, 3) of one draw from samples (C, S, 3)."""
    values = samples.astype(np.float64)
    mean = values.mean(axis=1)
    deviation = values - mean[:, None]
    variance = (deviation**2).mean(axis=1)
    return mean, variance, (deviation**4).mean(axis=1) - 3 * variance**2


def require_moments(image: npt.NDArray[np.uint16], mean: _Array, variance: _Array, fourth: _Array) -> None:
    pixels = cells(image)
    count = pixels.shape[1]
    assert np.abs((pixels.mean(axis=1) - mean) / np.sqrt(variance / count)).max() < BOUND
    error = np.sqrt((fourth + 2 * variance**2) / count)
    assert np.abs((pixels.var(axis=1, ddof=1) - variance) / error).max() < BOUND


def test_under_a_mixture(make_lut: Callable[..., Lut], patches: npt.NDArray[np.uint8]) -> None:
    """The mixture's own 25 samples are what is drawn; they average to the mixture of means but for rounding."""
    lut = make_lut()
    samples = MIXTURE.samples(lut, seed=5)
    image = draw_samples(samples, patches, seed=11, image=3)
    require_moments(image, *cumulants(samples))
    means = np.tensordot(MIXTURE.weights, lut.samples[list(MIXTURE.lights)].astype(np.float64).mean(axis=2), 1)
    # Rounding to whole counts moves a mean of 25 by less than 6.5 standard errors √(1/12/25).
    assert np.abs(samples.astype(np.float64).mean(axis=1) - means).max() < 6.5 * np.sqrt(1 / 300)


def test_under_several_lights(make_lut: Callable[..., Lut], patches: npt.NDArray[np.uint8]) -> None:
    """With weights alike in all pixels each light is drawn from on its own: means and all cumulants add."""
    lut = make_lut()
    weights = np.array([0.25, 0.75], np.float32)
    maps = np.broadcast_to(weights, (*patches.shape[:2], 2)).copy()
    image = mix_samples([lut.samples[0], lut.samples[3]], patches, maps, seed=11, image=3)
    mean, variance, fourth = (
        weights[0] ** power * one + weights[1] ** power * other
        for power, one, other in zip((1, 1, 2), cumulants(lut.samples[0]), cumulants(lut.samples[3]), strict=True)
    )
    # Rounding to whole counts adds the variance and the fourth cumulant of a uniform number.
    require_moments(image, mean, variance + 1 / 12, fourth - 1 / 120)


def test_white_follows_the_ground_truth_of_every_pixel(make_lut: Callable[..., Lut]) -> None:
    """A white picture under masks: each block's mean chromaticity is the mean of the map there."""
    lut = make_lut()
    side = SIDE // 2
    white = np.full((side * 8, side * 8, 3), 255, np.uint8)
    lighting = Lighting((plain(0), plain(3)), parse_masks("soft-edge:width=.6", 2, 4).maker(0))
    weights = lighting.weights_of(*white.shape[:2])
    tables = [mixture.samples(lut) for mixture in lighting.mixtures]
    image = mix_samples(tables, white, weights, seed=2)
    light = cells(weights @ lighting.whites(lut)).mean(axis=1)
    mean = cells(image).mean(axis=1)
    # The table's 25 samples of white are drawn about the ground truth: 5 · √(variance / 25) is 1.3 % of it, 0.7°.
    assert angles_deg(mean, light).max() < 0.7
    own = cells(weights @ np.array([table[-1].mean(axis=0) for table in tables])).mean(axis=1)
    assert angles_deg(mean, own).max() < 0.05
    # And the map that is written says the same in every pixel, to 16 bits: a step is 0.0026°.
    truth = quantised_chromaticities(weights, lighting.whites(lut), FULL).astype(np.float64)
    assert angles_deg(truth, (weights @ lighting.whites(lut)).astype(np.float64)).max() < 3e-3
