"""Images at a method's working size."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from evaluation.learning.working_size import reduce

pytestmark = pytest.mark.slow


def test_blocks_are_means_of_usable_pixels() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(1, 60000, (37, 50, 3)).astype(np.uint16)
    mask = rng.random((37, 50)) < 0.3
    small, used = reduce(image, None, mask, 13)
    assert small.shape == (10, 13, 3)
    means = np.zeros((10, 13, 3))
    for row, column in itertools.product(range(10), range(13)):
        block = np.s_[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        free = ~mask[block]
        if free.mean() >= 0.5:
            means[row, column] = image[block][free].mean(axis=0)
        assert used[row, column] == (free.mean() >= 0.5)
    np.testing.assert_allclose(small, means / means.max(), rtol=1e-5, atol=1e-7)
    # Whatever the unit; an image that is no larger keeps its pixels, and one without a usable pixel is black.
    np.testing.assert_allclose(reduce(image * 2.0**-40, None, mask, 13)[0], small, rtol=1e-6)
    kept, free = reduce(image, None, mask, 50)
    np.testing.assert_array_equal(free, ~mask)
    np.testing.assert_allclose(kept, np.where(free[..., None], image, 0) / image[free].max(), rtol=1e-6)
    for longest in (13, 50):
        black, none = reduce(image, None, np.ones_like(mask), longest)
        assert not none.any()
        assert not black.any()
