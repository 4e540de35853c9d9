"""Illuminant maps from patches and from clusters of gray pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.methods import gray_pixels
from evaluation.methods.gray_pixels import LocalGraynessIndex
from evaluation.methods.method import LocalMethod
from evaluation.methods.standard import local_methods, standard_methods
from evaluation.methods.wrapped import PatchwiseMethod, fill_unknown
from evaluation.metrics import recovery_error

RED, BLUE = np.array([0.5, 0.3, 0.2]), np.array([0.2, 0.3, 0.5])


def two_lights() -> npt.NDArray[np.float64]:
    """Return nearly grey texture (96, 160, 3) under a red illuminant on the left and a blue one on the right."""
    random = np.random.default_rng(0)
    grey = random.uniform(200, 3000, (96, 160, 1)) * random.uniform(0.99, 1.01, (96, 160, 3))
    image = grey * RED
    image[:, 80:] = (grey * BLUE)[:, 80:]
    return image


def patches_of(name: str, patches: int = 6) -> PatchwiseMethod:
    return PatchwiseMethod(standard_methods()[name], patches)


@pytest.mark.slow
@pytest.mark.parametrize("method", [*local_methods().values(), patches_of("gray-edge-1"), patches_of("pca")])
def test_estimates_illuminant_of_each_side(method: LocalMethod) -> None:
    assert isinstance(method, LocalMethod)
    lights = method.estimate_map(two_lights())
    assert lights.dtype == np.float32
    np.testing.assert_allclose(lights.sum(axis=2), 1, rtol=1e-5)
    limit = 5 if isinstance(method, LocalGraynessIndex) else 2
    assert recovery_error(lights[:, :8].reshape(-1, 3), RED).max() < limit
    assert recovery_error(lights[:, -8:].reshape(-1, 3), BLUE).max() < limit
    errors = recovery_error(np.tile(method.estimate(two_lights()), (2, 1)), np.stack([RED, BLUE]))
    assert errors.min() > 8


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [1, 1000])
@pytest.mark.parametrize("name", ["grayness-index", "mean-shifted-gray-pixel"])
def test_estimate_does_not_depend_on_strips(name: str, pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Strips of 1000 px, and of one row because it has more than one pixel.
    image, method = two_lights(), standard_methods()[name]
    expected = method.estimate(image)
    monkeypatch.setattr(gray_pixels, "_STRIP", pixels)
    np.testing.assert_allclose(method.estimate(image), expected, rtol=1e-5)


@pytest.mark.parametrize("method", local_methods().values())
def test_map_fulfils_contract(method: LocalMethod) -> None:
    image = two_lights()
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, 50:90] = True
    lights = method.estimate_map(image, None, mask)
    np.testing.assert_array_equal(method.estimate_map(image, None, mask), lights)
    np.testing.assert_allclose(method.estimate_map(image * 8, None, mask), lights, rtol=1e-5)
    changed = image.copy()
    changed[:, 62:78] = 1
    np.testing.assert_allclose(method.estimate_map(changed, None, mask), lights, rtol=1e-6)
    grey_map = method.estimate_map(image, None, np.ones_like(mask))
    np.testing.assert_allclose(grey_map, 1 / 3, rtol=1e-6)
    tiny: Any = np.ones((1, 3, 3), np.uint16)
    np.testing.assert_allclose(method.estimate_map(tiny), 1 / 3, rtol=1e-6)


def test_patches_without_usable_pixel_use_nearest() -> None:
    image = two_lights()
    mask = np.zeros(image.shape[:2], dtype=bool)
    mask[:, :32] = True
    lights = patches_of("gray-world").estimate_map(image, None, mask)
    assert recovery_error(lights[:, :32].reshape(-1, 3), RED).max() < 0.5


def test_saturation_excludes_neighbours_in_next_patch() -> None:
    image = np.ones((8, 8, 3)) * RED
    image[:, 3], image[:, 4] = 9, BLUE
    lights = patches_of("gray-world", 2).estimate_map(image, 8.0)
    assert recovery_error(lights.reshape(-1, 3), RED).max() < 0.1


def test_averages_nearest_known_illuminants() -> None:
    lights = np.full((3, 3, 3), np.nan)
    assert (fill_unknown(lights) == 1 / 3).all()
    lights[0, 0], lights[2, 2] = RED, BLUE
    filled = fill_unknown(lights)
    np.testing.assert_allclose(filled[1, 1], (RED + BLUE) / 2)
    np.testing.assert_allclose(filled[0, 1], RED)
