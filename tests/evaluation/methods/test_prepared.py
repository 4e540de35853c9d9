"""Usable pixels of an image, and methods on smaller images."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.prepared import shrink, usable
from evaluation.methods.standard import standard_methods
from evaluation.methods.wrapped import ResizedMethod
from evaluation.metrics import recovery_error


def test_excludes_masked_saturated_and_border_pixels() -> None:
    image = np.ones((7, 9, 3))
    image[3, 4, 1] = 10
    mask = np.zeros((7, 9), dtype=bool)
    mask[1, 1] = True
    is_usable = usable(image, 10, mask, 1)
    expected = np.zeros((7, 9), dtype=bool)
    expected[1:6, 1:8] = True
    expected[2:5, 3:6] = False
    expected[1, 1] = False
    np.testing.assert_array_equal(is_usable, expected)


def test_shrinks_to_means_of_usable_pixels() -> None:
    image = np.arange(4 * 6 * 3, dtype=np.uint16).reshape(4, 6, 3)
    usable = np.ones((4, 6), dtype=bool)
    usable[0, 0] = usable[:2, 2:4] = False
    usable[2, 4] = usable[3, 5] = False
    small, masked = shrink(image, usable, 3)
    np.testing.assert_allclose(small[0, 0], image[[0, 1, 1], [1, 0, 1]].mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(small[1, 1], image[2:4, 2:4].mean(axis=(0, 1)), rtol=1e-6)
    np.testing.assert_array_equal(masked, [[False, True, False], [False, False, True]])


@pytest.mark.slow
def test_shrinking_removes_effect_of_noise_on_second_derivatives() -> None:
    # Grey surfaces under a warm illuminant, with noise that does not depend on the illuminant.
    light, random = np.array([1.0, 0.8, 0.3]), np.random.default_rng(0)
    tiles = random.uniform(500, 3000, (12, 16, 1)).repeat(40, axis=0).repeat(40, axis=1)
    image = np.maximum(tiles * light + random.normal(0, 60, (480, 640, 3)), 0)
    method = standard_methods()["gray-edge-2"]
    at_full_size, at_80 = (
        recovery_error(candidate.estimate(image), light) for candidate in (method, ResizedMethod(method, 80))
    )
    assert at_full_size > 8
    assert at_80 < 1
    assert recovery_error(GrayEdge("", 2, 1, 6).estimate(image), light) < 2
    assert recovery_error(method.estimate(tiles * light), light) < 0.01
