"""Which pixels a method may use."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from evaluation.methods.prepared import usable

if TYPE_CHECKING:
    pass


def test_which_pixels_are_used() -> None:
    image = np.ones((7, 9, 3))
    image[3, 4, 1] = 10
    mask = np.zeros((7, 9), dtype=bool)
    mask[1, 1] = True
    used = usable(image, 10, mask, 1)
    expected = np.zeros((7, 9), dtype=bool)
    expected[1:6, 1:8] = True
    expected[2:5, 3:6] = False
    expected[1, 1] = False
    np.testing.assert_array_equal(used, expected)
