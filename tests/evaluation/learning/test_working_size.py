"""Images at the working size."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from evaluation.learning.working_size import reduce_image

pytestmark = pytest.mark.slow


def test_block_means_use_only_usable_pixels() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(1, 60000, (37, 50, 3)).astype(np.uint16)
    mask = rng.random((37, 50)) < 0.3
    small, used = reduce_image(image, None, mask, 13)
    assert small.shape == (10, 13, 3)
    means = np.zeros((10, 13, 3))
    for row, column in itertools.product(range(10), range(13)):
        block = np.s_[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        usable = ~mask[block]
        if usable.mean() >= 0.5:
            means[row, column] = image[block][usable].mean(axis=0)
        assert used[row, column] == (usable.mean() >= 0.5)
    np.testing.assert_allclose(small, means / means.max(), rtol=1e-5, atol=1e-7)
    # For any unit; small images keep their pixels, and images without usable pixels are black.
    np.testing.assert_allclose(reduce_image(image * 2.0**-40, None, mask, 13)[0], small, rtol=1e-6)
    unchanged, usable = reduce_image(image, None, mask, 50)
    np.testing.assert_array_equal(usable, ~mask)
    np.testing.assert_allclose(unchanged, np.where(usable[..., None], image, 0) / image[usable].max(), rtol=1e-6)
    for longest in (13, 50):
        black, is_usable = reduce_image(image, None, np.ones_like(mask), longest)
        assert not is_usable.any()
        assert not black.any()
