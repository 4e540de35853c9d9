"""Bright and dark pixels alone decide."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from evaluation.methods import BrightDark
from evaluation.metrics import recovery_error

LIGHT = np.array([0.5, 1.0, 0.7])


def test_bright_and_dark_pixels_alone_decide() -> None:
    image = np.random.default_rng(1).uniform(400, 600, (50, 50, 3))
    image[:2] = 2000 * LIGHT
    image[-2:] = 20 * LIGHT
    assert recovery_error(BrightDark().estimate(image), LIGHT) < 1e-6


@pytest.mark.parametrize("share", [0.035, 0.2, 1e-9, 0.5, 0.499])
@pytest.mark.parametrize("kind", [np.uint16, np.float64])
def test_the_svd_of_sorted_pixels_gives_the_same_light(share: float, kind: type[np.uint16 | np.float64]) -> None:
    random = np.random.default_rng(2)
    values = random.gamma(2, 900, (300, 500, 3)) * LIGHT * random.uniform(0.3, 1, (300, 500, 1))
    image: Any = values.astype(kind)
    mask = random.uniform(size=(300, 500)) < 0.05
    pixels = image[~mask].astype(np.float64)
    mean = pixels.mean(axis=0)
    order = np.argsort(pixels @ mean, kind="stable")
    count = int(np.ceil(len(pixels) * share))
    ends = pixels[np.unique(np.concatenate([order[:count], order[-count:]]))]
    expected = np.abs(np.linalg.svd(ends, full_matrices=False)[2][0])
    np.testing.assert_allclose(BrightDark(share=share).estimate(image, mask=mask), expected, rtol=1e-6)


def test_many_equal_pixels() -> None:
    image = np.full((41, 40, 3), (100, 300, 200), np.uint16)
    image[0, 0] = (900, 30, 30)
    # 58 pixels at either end: the odd one and 115 of the others.
    ends = np.concatenate([image[0, :1], image[1].repeat(3, axis=0)[:115]]).astype(np.float64)
    expected = np.abs(np.linalg.svd(ends)[2][0])
    np.testing.assert_allclose(BrightDark().estimate(image), expected, rtol=1e-9)
