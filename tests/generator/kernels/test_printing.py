"""Rendering by colour against the rule at the head of the kernel, spelled out in numpy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foundation.colorimetry import decode_srgb
from foundation.errors import InputError
from generator.kernels.planar import scales_of
from generator.kernels.printed_crops import draw_printed_crops
from generator.kernels.printing import NODE_CODES, NODES, SIDE, PrintedLight, draw_printed, nearest_nodes
from generator.kernels.rendering import draw_samples

Array = npt.NDArray[np.float64]

CELLS, COUNT, LIGHTS = 64, 5, 4
RNG = np.random.default_rng(20)
SAMPLES = RNG.integers(100, 4000, (LIGHTS, CELLS, COUNT, 3)).astype(np.uint16)
CELL_OF = RNG.integers(0, CELLS, NODES).astype(np.uint32)


def light(*numbers: int, weights: tuple[float, ...] = (1.0,)) -> PrintedLight:
    """Return a light of numbers that have nothing to do with each other."""
    rng = np.random.default_rng(sum(numbers))
    means, cells = np.empty((NODES, 4), np.float32), np.zeros((len(numbers), NODES, 2, 4), np.float32)
    means[:, :3], means[:, 3] = rng.uniform(900, 5000, (NODES, 3)), rng.uniform(20, 30, NODES)
    cells[..., 0, :3] = SAMPLES[list(numbers)].mean(axis=2)[:, CELL_OF]
    cells[..., 1, :3] = rng.uniform(0.01, 0.02, (len(numbers), NODES, 3))
    return PrintedLight(means, cells, np.array(numbers), np.sqrt(weights).astype(np.float32))


def nearest(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Return the node nearest to each pixel; of two the one of the higher code."""
    distance = np.abs(picture[..., None].astype(np.int64) - np.array(NODE_CODES)[::-1])
    return (SIDE - 1 - distance.argmin(axis=-1)) @ np.array([SIDE * SIDE, SIDE, 1])


def choices(picture: npt.NDArray[np.uint8], place: int, seed: int, image: int) -> npt.NDArray[np.int64]:
    """Return which sample each pixel has of the light at a place; the rule of place 0 is `draw_samples`'."""
    if place == 0:
        numbered = np.arange(COUNT, dtype=np.uint16)[None, :, None] * np.ones((8, 1, 3), np.uint16)
        return draw_samples(numbered, picture, seed=seed, image=image)[..., 0].astype(np.int64)
    from generator.kernels.mixing import mix_samples

    numbered = np.zeros((place + 1, 8, COUNT, 3), np.uint16)
    numbered[place] = np.arange(COUNT)[None, :, None]
    weights = np.zeros((*picture.shape[:2], place + 1), np.float32)
    weights[..., place] = 1
    return mix_samples(numbered, picture, weights, white_level=65535, seed=seed, image=image)[..., 0].astype(np.int64)


def spelled_out(
    picture: npt.NDArray[np.uint8], lights: list[PrintedLight], shares: Array, seed: int, image: int
) -> Array:
    """Return the image before it is rounded and cut off at 0."""
    nodes, lin = np.array(NODE_CODES), decode_srgb(np.arange(256) / 255)
    below = np.minimum(picture.astype(np.int64) // 16, SIDE - 2)
    part = (lin[picture] - lin[nodes[below]]) / (lin[nodes[below + 1]] - lin[nodes[below]])
    near = nearest(picture)
    out: Array = np.zeros(picture.shape)
    place = 0
    for number, one in enumerate(lights):
        # Along the edges of a cube, the channel with the largest part first.
        order = np.argsort(-part, axis=-1, kind="stable")
        ends = np.concatenate([np.ones((*order.shape[:2], 1)), np.take_along_axis(part, order, -1)], axis=-1)
        weights, corner = -np.diff(ends, axis=-1, append=0.0), below.copy()
        seen = np.zeros((*picture.shape[:2], 4))
        for step in range(4):
            seen += weights[..., step, None] * one.means[corner @ np.array([SIDE * SIDE, SIDE, 1])]
            if step < 3:
                corner += order[..., step, None] == np.arange(3)
        share = shares[..., number, None]
        out += share * seen[..., :3]
        for table, root, cells in zip(one.lights, one.roots, one.bases, strict=True):
            drawn = SAMPLES[table][CELL_OF[near], choices(picture, place, seed, image)]
            out += np.sqrt(share) * root * seen[..., 3:] * cells[near, 1, :3] * (drawn - cells[near, 0, :3])
            place += 1
    return out


@pytest.mark.slow
@settings(max_examples=25)
@given(st.integers(1, 70), st.integers(1, 9), st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1))
def test_an_image_is_what_the_rule_says(width: int, height: int, seed: int, image: int) -> None:
    picture = np.random.default_rng(width).integers(0, 256, (height, width, 3)).astype(np.uint8)
    picture[::2, :, 1] = picture[::2, :, 0]
    for lights in ([light(2)], [light(0, 3, weights=(0.25, 0.75))]):
        wanted = spelled_out(picture, lights, np.ones((height, width, 1)), seed, image)
        got = draw_printed(SAMPLES, picture, lights, CELL_OF, seed=seed, image=image)
        np.testing.assert_allclose(got, np.maximum(wanted, 0), atol=0.51)


def test_several_lights_have_samples_of_their_own_and_shares() -> None:
    picture = RNG.integers(0, 256, (20, 45, 3)).astype(np.uint8)
    lights = [light(1), light(0, 2, weights=(0.5, 0.5)), light(3)]
    shares = RNG.dirichlet((1, 1, 1), (20, 45))
    shares[0, :, 1], shares[1] = 0, (0, 0, 1)
    shares /= shares.sum(axis=-1, keepdims=True)
    got = draw_printed(SAMPLES, picture, lights, CELL_OF, shares=shares.astype(np.float32), seed=3, image=4)
    np.testing.assert_allclose(got, np.maximum(spelled_out(picture, lights, shares, 3, 4), 0), atol=0.52)


def test_bands_threads_and_targets_change_no_byte() -> None:
    picture = RNG.integers(0, 256, (31, 77, 3)).astype(np.uint8)
    whole = draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5)
    np.testing.assert_array_equal(draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5, threads=3), whole)
    lower = draw_printed(SAMPLES, picture[10:], [light(1)], CELL_OF, seed=5, first_row=10)
    np.testing.assert_array_equal(lower, whole[10:])
    out = np.zeros((31, 80, 3), np.uint16)[:, :77]
    draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5, out=out)
    np.testing.assert_array_equal(out, whole)
    assert (draw_printed(SAMPLES, picture, [light(1)], CELL_OF, seed=5, most=2000) == np.minimum(whole, 2000)).all()
    with pytest.raises(InputError):
        draw_printed(SAMPLES, picture[..., :2], [light(1)], CELL_OF)


@pytest.mark.slow
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("window", [(0, 0, 77, 31), (5, 3, 40, 20), (63, 30, 1, 1), (33, 0, 30, 2)])
def test_a_crop_is_a_window_of_the_image(flip: bool, window: tuple[int, int, int, int]) -> None:
    picture = RNG.integers(0, 256, (31, 77, 3)).astype(np.uint8)
    x, y, width, height = window
    taken, stretch = np.array([[30.0, 20.0, 10.0]] * 3), np.array([[1.1, 1.2, 1.3]] * 3)
    lights, flips = [light(2), light(0, 3, weights=(0.25, 0.75)), light(2)], np.array([flip, not flip, flip])
    out = np.empty((3, 3, height, width), np.float32)
    draw_printed_crops(
        SAMPLES,
        lights,
        [picture] * 3,
        np.array([window] * 3),
        CELL_OF,
        scales=scales_of(np.array([0.7] * 3), 4000, taken, stretch),
        flips=flips,
        seeds=np.array([9, 10, 11], np.uint64),
        threads=2,
        out=out,
    )
    for one, seed, mirrored, crop in zip(lights, (9, 10, 11), flips, out, strict=True):
        whole = spelled_out(picture, [one], np.ones((31, 77, 1)), seed, 0)
        wanted = np.minimum((whole[y : y + height, x : x + width] - taken[0]) * stretch[0] * 0.7 / 4000, 0.7)
        shown = crop.transpose(1, 2, 0)
        np.testing.assert_allclose(shown[:, ::-1] if mirrored else shown, wanted, atol=2e-5)


def test_pixels_are_counted_by_the_nearest_node() -> None:
    picture = RNG.integers(0, 256, (9, 40, 3)).astype(np.uint8)
    counts = np.bincount(nearest(picture).ravel(), minlength=NODES)
    np.testing.assert_array_equal(nearest_nodes(picture), counts)
