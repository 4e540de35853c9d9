"""All methods of the command, on images with known illuminant."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods import standard_methods
from evaluation.methods.prepared import GREY, estimate_all
from evaluation.metrics import recovery_error

LIGHT = np.array([0.5, 1.0, 0.7])


def grey_scene(seed: int = 0) -> npt.NDArray[np.float64]:
    """Return a grey noise image (64, 80, 3) under LIGHT."""
    grey = np.random.default_rng(seed).uniform(100, 3000, (64, 80, 1))
    return grey * LIGHT


# Degrees: OpenCV uses 14 bits; all other methods are exact within float32.
TOLERANCES = {"opencv-grayworld": 0.01}
# Methods whose filters also use excluded pixels, as in their authors' programs.
USES_NEIGHBOURS = ("general-gray-world", "gray-edge-1", "gray-edge-2", "grayness-index", "mean-shifted-gray-pixel")
# Methods that process channels separately: a gain of a channel is a gain of the estimate.
SEPARATE_CHANNELS = (
    "white-patch",
    "gray-world",
    "shades-of-gray",
    "general-gray-world",
    "gray-edge-1",
    "gray-edge-2",
    "improved-white-patch",
    "color-sparrow",
    "local-surface-reflectance",
)

every_method = pytest.mark.parametrize("name", standard_methods())


def colourful_scene(seed: int = 1) -> npt.NDArray[np.float64]:
    """Return an image (72, 90, 3) of coloured tiles with texture under LIGHT, 20 … 3500."""
    random = np.random.default_rng(seed)
    tiles = random.uniform(0.1, 1, (9, 9, 3)).repeat(8, axis=0).repeat(10, axis=1)
    return 20 + 3000 * tiles * random.uniform(0.6, 1, (72, 90, 1)) * LIGHT


@pytest.mark.slow
@every_method
def test_estimates_illuminant_of_grey_surfaces(name: str) -> None:
    estimate = standard_methods()[name].estimate(grey_scene())
    assert recovery_error(estimate, LIGHT) < TOLERANCES.get(name, 1e-3)
    assert np.linalg.norm(estimate) == pytest.approx(1)


@pytest.mark.slow
@every_method
def test_ignores_masked_and_saturated_pixels(name: str) -> None:
    image = grey_scene()
    image[20:30, 30:50] = (9000, 100, 100)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[20:30, 30:50] = True
    method = standard_methods()[name]
    assert np.isfinite(method.estimate(image)).all()
    if name not in USES_NEIGHBOURS:
        limit = TOLERANCES.get(name, 1e-3)
        assert recovery_error(method.estimate(image, mask=mask), LIGHT) < limit
        assert recovery_error(method.estimate(image, saturation=8000), LIGHT) < limit


@every_method
def test_estimate_does_not_depend_on_masked_pixels(name: str) -> None:
    image = colourful_scene()
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, 60:] = True
    method = standard_methods()[name]
    expected = method.estimate(image, 4000.0, mask)
    # Filters of σ = 9 use 27 px, so the masked pixels that they use are not changed.
    image[:, 88:] = np.random.default_rng(5).uniform(0, 3000, (72, 2, 3))
    np.testing.assert_allclose(method.estimate(image, 4000.0, mask), expected, rtol=1e-12)


@every_method
def test_mask_changes_estimate(name: str) -> None:
    image = np.concatenate([colourful_scene(1), colourful_scene(2)[..., ::-1]], axis=1)
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, 90:] = True
    method = standard_methods()[name]
    assert recovery_error(method.estimate(image, None, mask), method.estimate(image, None, ~mask)) > 1


@pytest.mark.slow
@every_method
def test_returns_grey_without_usable_pixel(name: str) -> None:
    method = standard_methods()[name]
    assert method.estimate(np.full((40, 40, 3), 500, np.uint16), saturation=500) is GREY
    assert method.estimate(np.zeros((40, 40, 3), np.uint16)) is GREY
    assert method.estimate(np.ones((1, 1, 3)), mask=np.ones((1, 1), bool)) is GREY
    assert method.estimate(np.ones((50, 60, 3)), mask=np.ones((50, 60), bool)) is GREY
    np.testing.assert_allclose(GREY, 3**-0.5)


@every_method
@pytest.mark.parametrize("factor", [2.0**-40, 0.37, 2.0**60])
def test_estimate_does_not_depend_on_unit(name: str, factor: float) -> None:
    image, method = colourful_scene(), standard_methods()[name]
    expected = method.estimate(image, 3000.0)
    # Comparisons with limits may depend on the rounding of products.
    limit = 1e-6 if np.log2(factor).is_integer() else 0.05
    assert recovery_error(method.estimate(image * factor, 3000.0 * factor), expected) < limit


@pytest.mark.parametrize("name", SEPARATE_CHANNELS)
def test_gain_of_channel_is_gain_of_estimate(name: str) -> None:
    image, gains = colourful_scene(), np.array([0.5, 1.0, 2.0])
    method = standard_methods()[name]
    assert recovery_error(method.estimate(image * gains), method.estimate(image) * gains) < 1e-5


@pytest.mark.slow
@every_method
def test_estimate_does_not_depend_on_dtype(name: str) -> None:
    image, method = colourful_scene().astype(np.uint16), standard_methods()[name]
    expected = method.estimate(image, 3000.0)
    for dtype in (np.float32, np.float64, np.dtype(">u2")):
        other: Any = image.astype(dtype)
        np.testing.assert_allclose(method.estimate(other, 3000.0), expected, rtol=1e-6)


@every_method
def test_is_reproducible_and_does_not_change_image(name: str) -> None:
    image, method = colourful_scene(), standard_methods()[name]
    original = image.copy()
    expected = method.estimate(image)
    assert np.array_equal(method.estimate(image), expected)
    assert np.array_equal(method.estimate(np.asfortranarray(image)), expected)
    assert np.array_equal(method.estimate(np.concatenate([image, image], axis=1)[:, :90]), expected)
    assert np.array_equal(image, original)


@pytest.mark.slow
@every_method
def test_sharing_prepared_image_does_not_change_estimates(name: str) -> None:
    image, methods = colourful_scene().astype(np.uint16), standard_methods()
    mask = np.random.default_rng(3).uniform(size=image.shape[:2]) < 0.1
    shared = estimate_all(list(methods.values()), image, 3000.0, mask)
    expected = methods[name].estimate(image, 3000.0, mask)
    np.testing.assert_array_equal(dict(zip(methods, shared, strict=True))[name], expected)
