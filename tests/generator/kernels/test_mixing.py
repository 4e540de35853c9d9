"""Mixed illuminants: equal to a single one, additive in the mean, with the noise of one exposure."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import InputError
from generator.kernels import vector as streaming
from generator.kernels.mixing import mix_samples, mixed_table
from generator.kernels.rendering import draw_samples
from tests.generator.conftest import MakeLut

Rule = Callable[..., npt.NDArray[np.int64]]
GAIN, READ = 1.0, 6.0
MEANS = (np.linspace(200, 4000, 512), np.linspace(3000, 100, 512))


@pytest.fixture(scope="module")
def noisy_lights() -> npt.NDArray[np.uint16]:
    """Return samples of two illuminants (2, 512, 400, 3): photon noise of gain 1 and read noise of 6 counts."""
    rng = np.random.default_rng(77)
    lights = [
        rng.poisson(mean[:, None, None], (512, 400, 3)) + rng.normal(0, READ, (512, 400, 3)) + 100 for mean in MEANS
    ]
    return np.rint(lights).astype(np.uint16)


def test_single_light_keeps_its_samples(make_lut: MakeLut) -> None:
    lut = make_lut()
    for light in range(4):
        weights = np.eye(4)[light]
        np.testing.assert_array_equal(mixed_table(lut.samples, weights, seed=3), lut.samples[light])
    np.testing.assert_array_equal(mixed_table([lut.samples[2]], [1]), lut.samples[2])


@pytest.mark.slow
@pytest.mark.parametrize("weights", [(0.5, 0.5), (0.2, 0.8), (1.5, 0.5), (0.05, 0.3)])
def test_mean_and_variance_are_those_of_one_exposure(
    noisy_lights: npt.NDArray[np.uint16], weights: tuple[float, float]
) -> None:
    mixed = mixed_table(noisy_lights, weights, seed=9).astype(np.float64)
    samples = noisy_lights.astype(np.float64)
    # Means: exact but for rounding, whose error of 1200 values is below 5 * sqrt(1/12/1200) = 0.042 except once in
    # 1.7 million.
    expected = np.tensordot(weights, samples.mean(axis=2), axes=1)
    assert np.abs(mixed.mean(axis=1) - expected).max() < 0.1
    # Variances, pooled over 512 x 3 sets of 400: relative error of the pool sqrt(2 / 614 400) = 0.0018; 5 of these.
    expected_variance = sum(w * (GAIN * mean + READ**2) for w, mean in zip(weights, MEANS, strict=True)) + 1 / 12
    measured = mixed.var(axis=1, ddof=1).mean(axis=1)
    assert abs((measured / expected_variance).mean() - 1) < 5 * 0.0018
    if weights == (0.5, 0.5):
        # The test is sensitive: the plain average has half the variance.
        plain = (samples * 0.5).sum(axis=0).var(axis=1, ddof=1).mean(axis=1)
        assert abs((plain / expected_variance).mean() - 0.5) < 0.02


def test_noise_of_lights_is_uncorrelated(make_lut: MakeLut) -> None:
    # Twice the same illuminant: if sample i were always added to sample i, variances would be doubled. Shuffles make
    # the ratio of pooled variances 1 but for 64 x 3 covariances of 25 pairs: standard error
    # sqrt(1 / (24 x 192)) = 0.015.
    samples = make_lut().samples[0]
    mixed = mixed_table([samples, samples], (0.5, 0.5), seed=1).astype(np.float64)
    ratio = (mixed.var(axis=1) / samples.var(axis=1)).mean()
    assert abs(ratio - 1) < 5 * 0.015
    assert not np.array_equal(mixed_table([samples, samples], (0.5, 0.5), seed=2), mixed)


def test_selected_colours_equal_those_of_whole_table(make_lut: MakeLut) -> None:
    samples = make_lut().samples[:3]
    whole = mixed_table(samples, (0.2, 0.5, 0.3), seed=8)
    selected = np.arange(64) % 5 == 2
    partial = mixed_table(samples, (0.2, 0.5, 0.3), seed=8, colours=selected)
    np.testing.assert_array_equal(partial[selected], whole[selected])
    assert (partial[~selected] == 0).all()
    with pytest.raises(InputError):
        mixed_table(samples, (0.2, 0.5, 0.3), colours=selected[1:])


@pytest.mark.slow
def test_clips_at_saturation(noisy_lights: npt.NDArray[np.uint16]) -> None:
    mixed = mixed_table(noisy_lights, (3, 3), white_level=4095)
    assert mixed.max() == 4095


def test_mixed_table_refuses_invalid_arguments(make_lut: MakeLut) -> None:
    samples = make_lut().samples
    with pytest.raises(InputError):
        mixed_table(samples[:2], [1.0, -0.5])
    with pytest.raises(InputError):
        mixed_table(samples[:2], [float("nan"), 0])
    with pytest.raises(InputError):
        mixed_table(samples[:2], [1])
    with pytest.raises(InputError):
        mixed_table([], [])
    with pytest.raises(InputError):
        mixed_table([samples[0], samples[0][:, :5]], [1, 1])
    with pytest.raises(InputError):
        mixed_table(samples[:1], [1], white_level=0)
    with pytest.raises(InputError):
        mixed_table([samples[0].astype(np.int64)], [1])


def weight_maps(height: int, width: int, lights: int) -> npt.NDArray[np.float32]:
    """Return weights (H, W, K) with areas of a single illuminant, of all, and of none."""
    weights = np.random.default_rng(6).uniform(0, 1.2, (height, width, lights)).astype(np.float32)
    weights[:, :200] = 0
    for light in range(lights):
        weights[:, 40 * light : 40 * (light + 1), light] = 1
    return weights


def by_formula(
    rule: Rule,
    tables: npt.NDArray[np.uint16],
    picture: npt.NDArray[np.uint8],
    weights: npt.NDArray[np.float32],
    white: int,
) -> npt.NDArray[np.uint16]:
    """Return the image of seed 5 and number 9 by the formula of `generator/kernels/mixing.py`."""
    upper = (picture >> 6).astype(np.int64)
    colour = upper[..., 0] << 4 | upper[..., 1] << 2 | upper[..., 2]
    total = np.zeros(picture.shape, np.float32)
    for first in range(0, len(tables), 2):
        pair = np.zeros(picture.shape, np.float32)
        for light in range(first, min(first + 2, len(tables))):
            weight = weights[..., light, None]
            root = np.sqrt(weight)
            drawn = tables[light][colour, rule(5, 9, *colour.shape, place=light)]
            mean = tables[light].mean(axis=1).astype(np.float32)[colour]
            pair += root * drawn.astype(np.float32) + (weight - root) * mean
        total += pair
    return np.clip(total + np.float32(0.5), 0, white).astype(np.uint16)


@pytest.mark.parametrize("lights", [1, 2, 3, 4])
def test_mixed_pixels_follow_the_formula(
    rule: Rule, make_lut: MakeLut, picture: npt.NDArray[np.uint8], lights: int
) -> None:
    tables = make_lut().samples[:lights]
    weights = weight_maps(37, 1053, lights)
    mixed = mix_samples(tables, picture, weights, white_level=3000, seed=5, image=9, threads=3)
    np.testing.assert_array_equal(mixed, by_formula(rule, tables, picture, weights, 3000))
    assert (mixed[:, 40 * lights : 200] == 0).all()
    assert (mixed == 3000).any()


@pytest.mark.slow
@pytest.mark.parametrize("streamed", [False, True])
@pytest.mark.parametrize("lights", [2, 3, 4])
@pytest.mark.parametrize("width", [1, 7, 8, 9, 519, 520, 521, 1053])
def test_rows_with_single_or_missing_lights_follow_the_formula(
    rule: Rule,
    make_lut: MakeLut,
    picture: npt.NDArray[np.uint8],
    monkeypatch: pytest.MonkeyPatch,
    lights: int,
    width: int,
    streamed: bool,
) -> None:
    if streamed:
        monkeypatch.setattr(streaming, "STREAMED_BYTES", 0)
    tables = make_lut().samples[:lights]
    crop = picture[:12, :width]
    weights = np.random.default_rng(8).uniform(0, 1.2, (12, width, lights)).astype(np.float32)
    for row in range(8):
        weights[row] = 0
        # Single at 1, single at another weight, single in the first 512 pixels, and at 1 except for the last pixel.
        weights[row, : 512 if row in (4, 5) else width, row % lights] = 0.5 if row in (2, 3) else 1
        if row > 5:
            weights[row, -1, row % lights] = 0.25
    weights[8] = 0
    weights[9, :, 1:] = 0
    weights[10, :, :-1] = 0
    frame = np.full((12, width + 2, 3), 7, np.uint16)
    mix_samples(tables, crop, weights, white_level=3000, seed=5, image=9, out=frame[:, 1:-1])
    np.testing.assert_array_equal(frame[:, 1:-1], by_formula(rule, tables, crop, weights, 3000))
    assert (frame[:, [0, -1]] == 7).all()


def test_pixels_of_a_single_light_are_its_samples(
    rule: Rule, make_lut: MakeLut, picture: npt.NDArray[np.uint8]
) -> None:
    tables = make_lut().samples[:2]
    first = mix_samples(tables, picture, np.array([1, 0], np.float32), seed=3, image=2)
    np.testing.assert_array_equal(first, draw_samples(tables[0], picture, seed=3, image=2))
    upper = (picture >> 6).astype(np.int64)
    colour = upper[..., 0] << 4 | upper[..., 1] << 2 | upper[..., 2]
    second = mix_samples(tables, picture, np.array([0, 1], np.float32), seed=3, image=2)
    np.testing.assert_array_equal(second, tables[1][colour, rule(3, 2, *colour.shape, place=1)])


def test_result_is_independent_of_bands_and_threads(make_lut: MakeLut, picture: npt.NDArray[np.uint8]) -> None:
    tables = make_lut().samples[1:3]
    weights = weight_maps(37, 1053, 2)
    whole = mix_samples(tables, picture, weights, seed=4)
    np.testing.assert_array_equal(mix_samples(list(tables), picture, weights, seed=4, threads=5), whole)
    bands = [
        mix_samples(tables, picture[top : top + 6], weights[top : top + 6], seed=4, first_row=top)
        for top in range(0, 37, 6)
    ]
    np.testing.assert_array_equal(np.concatenate(bands), whole)


def test_mixed_pixels_have_noise_of_one_exposure(noisy_lights: npt.NDArray[np.uint16]) -> None:
    # One patch of 512 x 512 pixels of each of four colours, half of each light. The table's own variances are the
    # reference; relative error of a variance of n pixels: sqrt(2 / n) = 0.0028, five of them allowed, 12 comparisons.
    weights = np.full((512, 512, 2), 0.5, np.float32)
    for code in (0, 3, 5, 7):
        picture = np.full((512, 512, 3), 32 * code, np.uint8)
        colour = code << 6 | code << 3 | code
        mixed = mix_samples(noisy_lights, picture, weights, seed=code).astype(np.float64)
        table = noisy_lights[:, colour].astype(np.float64)
        expected = 0.5 * table.var(axis=1).sum(axis=0) + 1 / 12
        assert np.abs(mixed.var(axis=(0, 1)) / expected - 1).max() < 5 * 0.0028
        error = np.sqrt(expected) / 512
        assert (np.abs(mixed.mean(axis=(0, 1)) - table.mean(axis=1).mean(axis=0)) < 5 * error).all()


def test_mix_samples_refuses_invalid_weights(make_lut: MakeLut, picture: npt.NDArray[np.uint8]) -> None:
    tables = make_lut().samples[:2]
    weights = weight_maps(37, 1053, 2)
    with pytest.raises(InputError, match=r"weights are an array float32 \(37, 1053, 1\).*\(37, 1053, 2\) or \(2,\)"):
        mix_samples(tables, picture, weights[..., :1])
    for invalid in (-0.1, float("nan"), float("inf")):
        faulty = weights.copy()
        faulty[36, 1052, 1] = invalid
        with pytest.raises(InputError):
            mix_samples(tables, picture, faulty)
