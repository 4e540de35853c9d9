"""Rendering by colour compared with the rule in numpy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foundation.colorimetry import decode_srgb
from foundation.errors import InputError
from generator import philox
from generator.kernels.planar import scales_of
from generator.kernels.printed_crops import draw_printed_crops
from generator.kernels.printing import NODE_CODES, NODES, SIDE, PrintedLight, count_by_node, draw_printed
from generator.kernels.rendering import draw_samples

Array = npt.NDArray[np.float64]

CELLS, COUNT, LIGHTS = 64, 5, 4
RNG = np.random.default_rng(20)
SAMPLES = RNG.integers(100, 4000, (LIGHTS, CELLS, COUNT, 3)).astype(np.uint16)
CELL_OF = RNG.integers(0, CELLS, NODES).astype(np.uint32)


def light(*numbers: int, weights: tuple[float, ...] = (1.0,)) -> PrintedLight:
    """Return an illuminant with arbitrary numbers."""
    rng = np.random.default_rng(sum(numbers))
    means, cells = np.empty((NODES, 4), np.float32), np.zeros((len(numbers), NODES, 2, 4), np.float32)
    means[:, :3], means[:, 3] = rng.uniform(900, 5000, (NODES, 3)), rng.uniform(20, 30, NODES)
    cells[..., 0, :3] = SAMPLES[list(numbers)].mean(axis=2)[:, CELL_OF]
    cells[..., 1, :3] = rng.uniform(0.01, 0.02, (len(numbers), NODES, 3))
    return PrintedLight(means, cells, np.array(numbers), np.sqrt(weights).astype(np.float32))


def nearest_node(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Return the node nearest to each pixel, the higher code if two are equally near."""
    distance = np.abs(picture[..., None].astype(np.int64) - np.array(NODE_CODES)[::-1])
    return (SIDE - 1 - distance.argmin(axis=-1)) @ np.array([SIDE * SIDE, SIDE, 1])


def choices(picture: npt.NDArray[np.uint8], stream: int, seed: int, image: int) -> npt.NDArray[np.int64]:
    """Return the sample number of each pixel in a stream; stream 0 is that of `draw_samples`."""
    if stream == 0:
        indices = np.arange(COUNT, dtype=np.uint16)[None, :, None] * np.ones((8, 1, 3), np.uint16)
        return draw_samples(indices, picture, seed=seed, image=image)[..., 0].astype(np.int64)
    from generator.kernels.mixing import mix_samples

    indices = np.zeros((stream + 1, 8, COUNT, 3), np.uint16)
    indices[stream] = np.arange(COUNT)[None, :, None]
    weights = np.zeros((*picture.shape[:2], stream + 1), np.float32)
    weights[..., stream] = 1
    return mix_samples(indices, picture, weights, white_level=65535, seed=seed, image=image)[..., 0].astype(np.int64)


def rounding(shape: tuple[int, ...], seed: int, image: int) -> Array:
    """Return the number u for each channel (H, W, 3)."""
    k0, k1, k2, _ = (word[:, None] for word in philox.words(seed, np.arange(shape[0]), 0, image, philox.ROUNDING))
    h = (np.arange(shape[1], dtype=np.uint32) ^ k0) * np.uint32(0x21F0AAAD) ^ k1
    h = (h ^ h >> np.uint32(16)) * np.uint32(0x735A2D97) ^ k2
    h = (h ^ h >> np.uint32(15)) * np.uint32(0x31848BAB)
    return np.stack([h >> np.uint32(shift) & np.uint32(1023) for shift in (21, 11, 1)], axis=-1) / 1024


def assert_rounded(image_drawn: npt.NDArray[np.uint16], expected: Array, seed: int, image: int) -> None:
    """Compare an image with ⌊expected + u⌋; sums in float32 may be on the other side of a whole number."""
    before = np.maximum(expected + rounding(expected.shape, seed, image), 0)
    np.testing.assert_allclose(image_drawn + 0.5, np.maximum(before, 0.5), atol=0.505)


def image_by_rule(
    picture: npt.NDArray[np.uint8], lights: list[PrintedLight], shares: Array, seed: int, image: int
) -> Array:
    """Return the image before rounding and clipping."""
    nodes, lin = np.array(NODE_CODES), decode_srgb(np.arange(256) / 255)
    lower = np.minimum(picture.astype(np.int64) // 16, SIDE - 2)
    fraction = (lin[picture] - lin[nodes[lower]]) / (lin[nodes[lower + 1]] - lin[nodes[lower]])
    nearest_nodes = nearest_node(picture)
    out: Array = np.zeros(picture.shape)
    stream = 0
    for number, light in enumerate(lights):
        # Along the edges of a cube, the channel with the largest fraction first.
        order = np.argsort(-fraction, axis=-1, kind="stable")
        ends = np.concatenate([np.ones((*order.shape[:2], 1)), np.take_along_axis(fraction, order, -1)], axis=-1)
        weights, corner = -np.diff(ends, axis=-1, append=0.0), lower.copy()
        values = np.zeros((*picture.shape[:2], 4))
        for step in range(4):
            values += weights[..., step, None] * light.means[corner @ np.array([SIDE * SIDE, SIDE, 1])]
            if step < 3:
                corner += order[..., step, None] == np.arange(3)
        share = shares[..., number, None]
        out += share * values[..., :3]
        for table, root, cells in zip(light.lights, light.roots, light.bases, strict=True):
            drawn = SAMPLES[table][CELL_OF[nearest_nodes], choices(picture, stream, seed, image)]
            scale = root * values[..., 3:] * cells[nearest_nodes, 1, :3]
            out += np.sqrt(share) * scale * (drawn - cells[nearest_nodes, 0, :3])
            stream += 1
    return out


@pytest.mark.slow
@settings(max_examples=25)
@given(st.integers(1, 70), st.integers(1, 9), st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1))
def test_image_follows_the_rule(width: int, height: int, seed: int, image: int) -> None:
    picture = np.random.default_rng(width).integers(0, 256, (height, width, 3)).astype(np.uint8)
    picture[::2, :, 1] = picture[::2, :, 0]
    for lights in ([light(2)], [light(0, 3, weights=(0.25, 0.75))]):
        expected = image_by_rule(picture, lights, np.ones((height, width, 1)), seed, image)
        image_drawn = draw_printed(SAMPLES, picture, lights, CELL_OF, seed=seed, image=image)
        assert_rounded(image_drawn, expected, seed, image)


def test_mixed_lights_have_independent_samples_and_shares() -> None:
    picture = RNG.integers(0, 256, (20, 45, 3)).astype(np.uint8)
    lights = [light(1), light(0, 2, weights=(0.5, 0.5)), light(3)]
    shares = RNG.dirichlet((1, 1, 1), (20, 45))
    shares[0, :, 1], shares[1] = 0, (0, 0, 1)
    shares /= shares.sum(axis=-1, keepdims=True)
    image_drawn = draw_printed(SAMPLES, picture, lights, CELL_OF, shares=shares.astype(np.float32), seed=3, image=4)
    assert_rounded(image_drawn, image_by_rule(picture, lights, shares, 3, 4), 3, 4)


@pytest.mark.slow
def test_rounding_keeps_means_and_is_independent_of_samples() -> None:
    picture, flat = np.full((1000, 1000, 3), 119, np.uint8), light(2)
    flat.means[:, :3] = [[3.3, 40.4, 1000.5]]
    flat.bases[..., 1, :3] = 1e-5
    image_drawn = draw_printed(SAMPLES, picture, [flat], CELL_OF, seed=8).astype(np.float64)
    errors = image_drawn - image_by_rule(picture, [flat], np.ones((1000, 1000, 1)), 8, 0)
    # The standard error of the mean of 10⁶ pixels is at most 0.5 / 1000.
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.002
    drawn = choices(picture, 0, 8, 0)
    for number in range(COUNT):
        assert np.abs(errors[drawn == number].mean(axis=0)).max() < 0.006
    # Neighbours and channels are rounded independently; the standard error of a correlation is 0.001.
    centred = errors - errors.mean(axis=(0, 1))
    for first, second in (
        (centred[1:], centred[:-1]),
        (centred[:, 1:], centred[:, :-1]),
        (centred, centred[..., ::-1]),
    ):
        correlation = (first * second).mean(axis=(0, 1)) / centred.std(axis=(0, 1)) ** 2
        assert np.abs(correlation[:1] if second.shape == centred.shape else correlation).max() < 0.006


def test_result_is_independent_of_bands_threads_and_target() -> None:
    picture = RNG.integers(0, 256, (31, 77, 3)).astype(np.uint8)
    whole = draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5)
    np.testing.assert_array_equal(draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5, threads=3), whole)
    lower = draw_printed(SAMPLES, picture[10:], [light(1)], CELL_OF, seed=5, first_row=10)
    np.testing.assert_array_equal(lower, whole[10:])
    out = np.zeros((31, 80, 3), np.uint16)[:, :77]
    draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5, out=out)
    np.testing.assert_array_equal(out, whole)
    clipped = draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5, white_level=2000)
    assert (clipped == np.minimum(whole, 2000)).all()
    with pytest.raises(InputError):
        draw_printed(SAMPLES, picture[..., :2], [light(1)], CELL_OF)


@pytest.mark.slow
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("window", [(0, 0, 77, 31), (5, 3, 40, 20), (63, 30, 1, 1), (33, 0, 30, 2)])
def test_crop_is_a_window_of_the_image(flip: bool, window: tuple[int, int, int, int]) -> None:
    picture = RNG.integers(0, 256, (31, 77, 3)).astype(np.uint8)
    x, y, width, height = window
    black_counts, stretch = np.array([[30.0, 20.0, 10.0]] * 3), np.array([[1.1, 1.2, 1.3]] * 3)
    lights, flips = [light(2), light(0, 3, weights=(0.25, 0.75)), light(2)], np.array([flip, not flip, flip])
    out = np.empty((3, 3, height, width), np.float32)
    draw_printed_crops(
        SAMPLES,
        lights,
        [picture] * 3,
        np.array([window] * 3),
        CELL_OF,
        scales=scales_of(np.array([0.7] * 3), 4000, black_counts, stretch),
        flips=flips,
        seeds=np.array([9, 10, 11], np.uint64),
        threads=2,
        out=out,
    )
    for crop_light, seed, mirrored, crop in zip(lights, (9, 10, 11), flips, out, strict=True):
        whole = image_by_rule(picture, [crop_light], np.ones((31, 77, 1)), seed, 0)
        expected = np.minimum((whole[y : y + height, x : x + width] - black_counts[0]) * stretch[0] * 0.7 / 4000, 0.7)
        crop_pixels = crop.transpose(1, 2, 0)
        np.testing.assert_allclose(crop_pixels[:, ::-1] if mirrored else crop_pixels, expected, atol=2e-5)


def test_counts_pixels_by_nearest_node() -> None:
    picture = RNG.integers(0, 256, (9, 40, 3)).astype(np.uint8)
    counts = np.bincount(nearest_node(picture).ravel(), minlength=NODES)
    np.testing.assert_array_equal(count_by_node(picture), counts)
