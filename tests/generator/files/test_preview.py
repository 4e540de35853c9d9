"""The Flash operator by hand, and back again."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from generator.files import fit_flash, flash, preview_of


def test_two_pixels_by_hand() -> None:
    # V = 0.1 and 0.4, geometric mean 0.2, k = 5 * 0.2 = 1; y = x / (V + 1); brightest 0.4 / 1.4 becomes 255.
    image = np.array([[[0.1, 0.05, 0.0], [0.2, 0.4, 0.1]]])
    operator = fit_flash(image, gamma=1)
    assert operator.k == pytest.approx(1)
    expected = np.array([[[0.1 / 1.1, 0.05 / 1.1, 0], [0.2 / 1.4, 0.4 / 1.4, 0.1 / 1.4]]]) / (0.4 / 1.4) * 255
    np.testing.assert_allclose(operator.apply(image), expected)
    display = fit_flash(image).apply(image)
    np.testing.assert_allclose(display, 255 * (expected / 255) ** (1 / 2.2))
    np.testing.assert_array_equal(flash(image), np.rint(display))


@given(
    hnp.arrays(np.float64, (3, 4, 3), elements=st.floats(1e-4, 1)),
    st.floats(0.5, 20),
    st.sampled_from([1.0, 2.2]),
)
def test_the_inverse_gives_back_the_image(image: np.ndarray, a: float, gamma: float) -> None:
    operator = fit_flash(image, a, gamma)
    np.testing.assert_allclose(operator.invert(operator.apply(image)), image, rtol=1e-6)


def test_the_scale_of_the_values_does_not_matter() -> None:
    image = np.random.default_rng(0).uniform(0.01, 1, (9, 9, 3))
    np.testing.assert_allclose(fit_flash(image).apply(image), fit_flash(image / 50).apply(image / 50))


def test_codes_of_eight_bits_lose_little() -> None:
    image = np.random.default_rng(0).uniform(0.02, 1, (50, 50, 3))
    operator = fit_flash(image)
    back = operator.invert(np.rint(operator.apply(image)))
    assert np.median(np.abs(back / image - 1)) < 0.02


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_single_precision_moves_no_code_by_more_than_one(gamma: float) -> None:
    image = np.random.default_rng(4).exponential(0.05, (200, 200, 3))
    image[:3] = 0
    exact = np.clip(fit_flash(image, gamma=gamma).apply(image), 0, 255)
    codes = flash(image, gamma=gamma)
    assert np.abs(codes - exact).max() < 0.501
    assert (codes != np.rint(exact)).mean() < 1e-3


@given(
    hnp.arrays(np.uint16, (3, 4, 3), elements=st.integers(0, 65535) | st.integers(0, 3)),
    st.sampled_from([255, 12000, 65535]),
)
def test_previews_are_the_operator_by_tables(image: npt.NDArray[np.uint16], white_level: int) -> None:
    linear = image / white_level
    exact = np.clip(fit_flash(linear).apply(linear), 0, 255)
    assert np.abs(preview_of(image, white_level) - exact).max() <= 0.5 + 1e-4


@given(
    hnp.arrays(np.uint16, st.tuples(st.integers(1, 12), st.integers(1, 12), st.just(3))),
    st.integers(1, 12),
)
def test_a_pixel_of_a_preview_is_the_mean_of_what_it_stands_for(image: npt.NDArray[np.uint16], side: int) -> None:
    factor = -(-max(image.shape[:2]) // side)
    means = np.array(
        [
            [
                image[top : top + factor, left : left + factor].reshape(-1, 3).mean(axis=0)
                for left in range(0, image.shape[1], factor)
            ]
            for top in range(0, image.shape[0], factor)
        ]
    )
    rounded = np.floor(means + 0.5).astype(np.uint16)
    assert np.abs(preview_of(image, 65535, side).astype(int) - preview_of(rounded, 65535, side)).max() <= 1


@pytest.mark.parametrize("shape", [(64, 90, 3), (64, 89, 3), (63, 90, 3)])
def test_means_of_two_by_two_are_rounded_as_all_others(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(5).integers(0, 65536, shape, dtype=np.uint16)
    rows, columns = np.arange(0, shape[0], 2), np.arange(0, shape[1], 2)
    sums, pixels = image.astype(np.int64), np.ones(shape, np.int64)
    for axis, starts in enumerate((rows, columns)):
        sums, pixels = np.add.reduceat(sums, starts, axis), np.add.reduceat(pixels, starts, axis)
    rounded = ((2 * sums + pixels) // (2 * pixels)).astype(np.uint16)
    np.testing.assert_array_equal(preview_of(image, 65535, 45), preview_of(rounded, 65535, 45))
