"""Training crops compared with the image of the whole picture."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from foundation.errors import InputError
from generator.kernels.planar import draw_batch
from generator.kernels.rendering import draw_samples
from tests.generator.conftest import MakeLut

WHITE = 3500


def expected_crop(
    image: npt.NDArray[np.uint16], window: tuple[int, int, int, int], flip: bool, gain: float
) -> npt.NDArray[np.float32]:
    x, y, width, height = window
    cut = image[y : y + height, x : x + width][:, :: -1 if flip else 1]
    return np.minimum(cut.astype(np.float32) * np.float32(gain / WHITE), np.float32(1)).transpose(2, 0, 1)


@pytest.mark.slow
def test_crop_of_whole_picture_equals_image(make_lut: MakeLut, picture: npt.NDArray[np.uint8]) -> None:
    samples = make_lut().samples[2]
    image = draw_samples(samples, picture, seed=6, image=4)
    whole = (0, 0, 1053, 37)
    (crops,) = draw_batch(samples[None], [0], [picture], [whole], white_level=WHITE, seeds=6, images=4)
    np.testing.assert_array_equal(crops, expected_crop(image, whole, False, 1))
    assert crops.dtype == np.float32
    assert crops.max() == 1
    target = np.zeros((2, 3, 37, 1053), np.float32)[::2]
    draw_batch(samples[None], [0], [picture], [whole], white_level=WHITE, seeds=6, images=4, threads=5, out=target)
    np.testing.assert_array_equal(target[0], crops)


@pytest.mark.slow
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_crops_equal_windows_of_the_image(picture: npt.NDArray[np.uint8], data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 1000)))
    tables = rng.integers(0, 4096, (3, 8, 5, 3)).astype(np.uint16)
    width, height = data.draw(st.integers(1, 90)), data.draw(st.integers(1, 12))
    count = data.draw(st.integers(1, 5))
    first_columns = [int(column) for column in rng.integers(0, 900, count)]
    pictures = [picture[:, column:] for column in first_columns]
    windows = [
        (int(rng.integers(0, 1054 - column - width)), int(rng.integers(0, 38 - height)), width, height)
        for column in first_columns
    ]
    lights: npt.NDArray[np.int64] = rng.integers(0, 3, count)
    flips, gains = rng.random(count) < 0.5, rng.uniform(0, 3, count)
    seeds, images = rng.integers(0, 2**63, count), rng.integers(0, 2**32, count)
    threads = data.draw(st.integers(1, 3))
    crops = draw_batch(
        tables,
        lights,
        pictures,
        windows,
        white_level=WHITE,
        flips=flips,
        gains=gains,
        seeds=seeds,
        images=images,
        threads=threads,
    )
    for i in range(count):
        image = draw_samples(tables[int(lights[i])], pictures[i], seed=int(seeds[i]), image=int(images[i]))
        np.testing.assert_array_equal(crops[i], expected_crop(image, windows[i], bool(flips[i]), float(gains[i])))


@pytest.mark.slow
def test_batch_from_mapped_samples_with_shared_values(make_lut: MakeLut, picture: npt.NDArray[np.uint8]) -> None:
    lut = make_lut()
    windows = [(0, 0, 64, 32), (989, 5, 64, 32), (500, 1, 64, 32)]
    target = np.empty((3, 3, 32, 64), np.float32)
    crops = draw_batch(
        lut.samples, [3, 0, 1], [picture] * 3, windows, white_level=WHITE, gains=0.5, seeds=7, images=2, out=target
    )
    assert crops is target
    for light, window, crop in zip([3, 0, 1], windows, crops, strict=True):
        image = draw_samples(lut.samples[light], picture, seed=7, image=2)
        np.testing.assert_array_equal(crop, expected_crop(image, window, False, 0.5))


def test_refuses_invalid_arguments(make_lut: MakeLut, picture: npt.NDArray[np.uint8]) -> None:
    samples = make_lut().samples
    for window in ((-1, 0, 5, 5), (0, 0, 5, 38), (1050, 0, 4, 4), (0, 0, 0, 4)):
        with pytest.raises(InputError):
            draw_batch(samples, [0], [picture], [window], white_level=WHITE)
    with pytest.raises(InputError):
        draw_batch(samples, [0], [picture], [(0, 0, 4, 4)], white_level=WHITE, gains=-1)
    with pytest.raises(InputError):
        draw_batch(samples, [0], [picture], [(0, 0, 4, 4)], white_level=65536)
    valid_window = (0, 0, 4, 4)
    # Each window of a repeated picture is checked.
    with pytest.raises(InputError, match=r"4x4 at \(1050, 2\)"):
        draw_batch(samples, [0, 0, 0], [picture] * 3, [valid_window, (1050, 2, 4, 4), valid_window], white_level=WHITE)
    for seed in (-1, 1 << 64, np.array([3, -2])):
        with pytest.raises(InputError):
            draw_batch(samples, [0, 0], [picture] * 2, [valid_window, valid_window], white_level=WHITE, seeds=seed)
    with pytest.raises(InputError):
        draw_batch(samples, [0, 0], [picture] * 2, [valid_window, (0, 0, 4, 5)], white_level=WHITE)
    with pytest.raises(InputError):
        draw_batch(samples, [4], [picture], [valid_window], white_level=WHITE)
    with pytest.raises(InputError):
        draw_batch(samples, [0, 1], [picture], [valid_window, valid_window], white_level=WHITE)
    with pytest.raises(InputError):
        draw_batch(samples, [0], [picture], [valid_window], white_level=WHITE, out=np.empty((1, 3, 4, 5), np.float32))
