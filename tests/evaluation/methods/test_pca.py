"""PCA of bright and dark pixels, compared with an SVD of sorted pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods import BrightDark
from evaluation.metrics import recovery_error

LIGHT = np.array([0.5, 1.0, 0.7])


@pytest.mark.slow
def test_uses_only_bright_and_dark_pixels() -> None:
    image = np.random.default_rng(1).uniform(400, 600, (50, 50, 3))
    image[:2] = 2000 * LIGHT
    image[-2:] = 20 * LIGHT
    assert recovery_error(BrightDark().estimate(image), LIGHT) < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("share", "dtype"),
    [(0.035, np.uint16), (0.2, np.float64), (0.0, np.uint16), (0.0, np.float64), (0.5, np.float64), (0.499, np.uint16)],
)
def test_agrees_with_svd_of_sorted_pixels(share: float, dtype: type[np.uint16 | np.float64]) -> None:
    random = np.random.default_rng(2)
    values = random.gamma(2, 900, (300, 500, 3)) * LIGHT * random.uniform(0.3, 1, (300, 500, 1))
    image: Any = values.astype(dtype)
    mask = random.uniform(size=(300, 500)) < 0.05
    expected = estimate_by_sorting(image[~mask].astype(np.float64), share)
    np.testing.assert_allclose(BrightDark(share=share).estimate(image, mask=mask), expected, rtol=1e-6)


def estimate_by_sorting(pixels: npt.NDArray[np.float64], share: float) -> npt.NDArray[np.float64]:
    order = np.argsort(pixels @ pixels.mean(axis=0), kind="stable")
    count = max(1, int(np.ceil(len(pixels) * share)))
    ends = pixels[np.unique(np.concatenate([order[:count], order[-count:]]))]
    return np.abs(np.linalg.svd(ends, full_matrices=False)[2][0])


@pytest.mark.slow
@pytest.mark.parametrize("extreme", ["bright", "dark", "hidden", "even"])
def test_unsampled_pixels_are_considered(extreme: str) -> None:
    # In large images every 16th pixel of a row is sampled, shifted by 5 px from row to row.
    random = np.random.default_rng(3)
    image = random.uniform(900, 1100, (300, 400, 3)) * LIGHT
    y, x = np.indices((300, 400))
    is_sampled = (x - 5 * y) % 16 == 0
    if extreme == "hidden":
        image[~is_sampled] *= random.gamma(1, 2, ((~is_sampled).sum(), 1))
    elif extreme == "even":
        image[is_sampled] = 500 * LIGHT
    else:
        image[is_sampled] *= (random.uniform(2, 3, (is_sampled.sum(), 1)), 0.1)[extreme == "dark"]
    image *= random.uniform(0.8, 1.2, image.shape)
    mask = random.uniform(size=(300, 400)) < 0.01
    expected = estimate_by_sorting(image[~mask], 0.035)
    np.testing.assert_allclose(BrightDark().estimate(image, mask=mask), expected, rtol=1e-6)


def test_handles_images_without_usable_sampled_pixel() -> None:
    image = np.random.default_rng(4).uniform(0, 1000, (300, 400, 3)) * LIGHT
    y, x = np.indices((300, 400))
    mask = np.asarray((x - 5 * y) % 16 == 0)
    np.testing.assert_allclose(
        BrightDark().estimate(image, mask=mask), estimate_by_sorting(image[~mask], 0.035), rtol=1e-6
    )


def test_handles_many_equal_pixels() -> None:
    image = np.full((41, 40, 3), (100, 300, 200), np.uint16)
    image[0, 0] = (900, 30, 30)
    # 58 pixels at either end: the different one and 115 others.
    ends = np.concatenate([image[0, :1], image[1].repeat(3, axis=0)[:115]]).astype(np.float64)
    expected = np.abs(np.linalg.svd(ends)[2][0])
    np.testing.assert_allclose(BrightDark().estimate(image), expected, rtol=1e-9)
