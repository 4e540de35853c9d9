"""The kernel compared with its rule in Python integers, and the statistics of its choices."""

from __future__ import annotations

import mmap
import re
from collections.abc import Callable
from inspect import signature
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foundation.errors import InputError
from generator.kernels import vector as streaming
from generator.kernels.choice import channel_bits, readable
from generator.kernels.mixing import mix_samples, mixed_table
from generator.kernels.planar import draw_batch
from generator.kernels.printing import draw_printed
from generator.kernels.rendering import draw_samples
from generator.rendering.render import render
from tests.generator.conftest import MakeLut

Rule = Callable[..., npt.NDArray[np.int64]]


def expected_image(
    rule: Rule, samples: npt.NDArray[np.uint16], picture: npt.NDArray[np.uint8], seed: int, image: int, **place: int
) -> npt.NDArray[np.uint16]:
    """Return `draw_samples` by the rules of `rendering.py` and `choice.py`, in numpy."""
    bits = {8: 1, 64: 2, 512: 3, 4096: 4, 32768: 5}[len(samples)]
    upper = (picture >> (8 - bits)).astype(np.int64)
    colour = (upper[..., 0] << (2 * bits)) | (upper[..., 1] << bits) | upper[..., 2]
    return samples[colour, rule(seed, image, *colour.shape, count=samples.shape[1], **place)]


def test_table_of_the_paper_follows_the_rule(rule: Rule) -> None:
    # Each sample has its address as value, so any wrong colour, sample or channel is detected.
    address = np.arange(32768 * 25).reshape(32768, 25)
    samples = np.stack([address >> 8, address & 0xFF, address % 65521], axis=-1).astype(np.uint16)
    picture = np.random.default_rng(3).integers(0, 256, (5, 1031, 3)).astype(np.uint8)
    seed, image = 0xFEDCBA9876543210, 0xDEADBEEF
    drawn_image = draw_samples(samples, picture, seed=seed, image=image)
    np.testing.assert_array_equal(drawn_image, expected_image(rule, samples, picture, seed, image))


def test_first_choices_of_seed_0() -> None:
    # The published output of Philox for counter and key 0 begins 6627e8d5 e169c58d bc57ac4c: the keys of row 0. The
    # rest is computed here in Python integers.
    samples = np.zeros((8, 25, 3), np.uint16)
    samples[..., 0] = np.arange(25)
    row = draw_samples(samples, np.zeros((1, 12, 3), np.uint8))[0, :, 0].tolist()
    expected_numbers: list[int] = []
    for x in (0, 1, 2, 3):
        h = (x ^ 0x6627E8D5) * 0x21F0AAAD % 2**32 ^ 0xE169C58D
        h = (h ^ h >> 16) * 0x735A2D97 % 2**32 ^ 0xBC57AC4C
        h = (h ^ h >> 15) * 0x31848BAB % 2**32
        expected_numbers += [h * 25 >> 32, h * 25 % 2**32 * 25 >> 32]
    assert row[:4] == expected_numbers[::2]
    assert row[8:] == expected_numbers[1::2]
    assert row == [22, 24, 3, 14, 11, 8, 22, 6, 3, 7, 7, 19]


@pytest.mark.slow
@settings(max_examples=30)
@given(
    st.integers(1, 5),
    st.integers(1, 30),
    st.integers(1, 9),
    st.integers(1, 40),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
)
def test_any_table_and_size_follows_the_rule(
    rule: Rule, bits: int, count: int, height: int, width: int, seed: int, image: int
) -> None:
    rng = np.random.default_rng(seed % 1000)
    samples = rng.integers(0, 65536, (8**bits, count, 3)).astype(np.uint16)
    picture = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    drawn_image = draw_samples(samples, picture, seed=seed, image=image)
    np.testing.assert_array_equal(drawn_image, expected_image(rule, samples, picture, seed, image))


def test_result_is_independent_of_bands_threads_memory_order_and_target(
    make_lut: MakeLut, picture: npt.NDArray[np.uint8]
) -> None:
    samples = make_lut().samples[1]
    whole = draw_samples(samples, picture, seed=4, image=2)
    for threads in (2, 3, 64):
        np.testing.assert_array_equal(draw_samples(samples, picture, seed=4, image=2, threads=threads), whole)
    bands = [draw_samples(samples, picture[top : top + 7], seed=4, image=2, first_row=top) for top in range(0, 37, 7)]
    np.testing.assert_array_equal(np.concatenate(bands), whole)
    fortran = np.asfortranarray(picture)
    target = np.zeros((37, 2 * 1053, 3), np.uint16)[:, ::2]
    assert draw_samples(samples, fortran, seed=4, image=2, out=target) is target
    np.testing.assert_array_equal(target, whole)


@pytest.mark.slow
@settings(max_examples=60)
@given(st.one_of(st.integers(1, 40), st.integers(480, 1100)), st.integers(1, 4), st.integers(0, 100), st.booleans())
def test_streamed_image_is_the_same_and_stays_within_its_target(
    width: int, height: int, margin: int, is_odd: bool
) -> None:
    rng = np.random.default_rng(width)
    samples = rng.integers(0, 65536, (512, 25, 3)).astype(np.uint16)
    picture = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    memory = np.full(2 * height * 3 * (width + 2 * margin) + 1, 171, np.uint8)
    whole = memory[is_odd : memory.size - (not is_odd)].view(np.uint16).reshape(height, width + 2 * margin, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(streaming, "STREAMED_BYTES", 0)
        draw_samples(samples, picture, out=whole[:, margin : margin + width])
    np.testing.assert_array_equal(whole[:, margin : margin + width], draw_samples(samples, picture))
    outside = np.concatenate([whole[:, :margin], whole[:, margin + width :]], axis=1)
    np.testing.assert_array_equal(outside, np.full_like(outside, 171 << 8 | 171))
    assert memory[-1 if not is_odd else 0] == 171


def choices(seed: int, image: int, height: int, width: int) -> npt.NDArray[np.uint16]:
    """Return the sample numbers (H, W) of an image."""
    samples = np.zeros((8, 25, 3), np.uint16)
    samples[..., 0] = np.arange(25)
    return draw_samples(samples, np.zeros((height, width, 3), np.uint8), seed=seed, image=image)[..., 0]


def chi_square(pairs: npt.NDArray[np.int64], classes: int) -> float:
    expected_count = pairs.size / classes
    return float(((np.bincount(pairs.ravel(), minlength=classes) - expected_count) ** 2 / expected_count).sum())


# Chi-square limits for an error probability of 1e-6 (Wilson and Hilferty, z = 4.753): 24 degrees of freedom 77,
# 624 degrees of freedom 812. All seeds are fixed, so a test that passes passes always.
LIMIT_24, LIMIT_624 = 77.0, 812.0


@pytest.mark.slow
def test_samples_are_drawn_uniformly() -> None:
    drawn = choices(2019, 7, 1500, 4000).astype(np.int64)
    assert drawn.size == 6_000_000
    assert chi_square(drawn, 25) < LIMIT_24
    # Also for each phase of the pixels that share words.
    for phase in range(16):
        assert chi_square(drawn[:, phase::16], 25) < LIMIT_24


@pytest.mark.slow
@pytest.mark.parametrize(("down", "right"), [(0, 1), (0, 2), (0, 4), (1, 0), (1, 1), (4, 0), (0, 1024)])
def test_neighbours_are_independent(down: int, right: int) -> None:
    drawn = choices(5, 0, 1500, 2000).astype(np.int64)
    height, width = drawn.shape
    pairs = drawn[: height - down, : width - right] * 25 + drawn[down:, right:]
    # Overlapping pairs share a member, which widens the statistic a little at right = 1; non-overlapping are taken.
    step = 2 * max(right, 1)
    distinct_pairs = pairs[:, ::step] if right in (1, 2, 4) else pairs[:: 2 * max(down, 1)] if down else pairs[:, :1024]
    assert chi_square(distinct_pairs, 625) < LIMIT_624


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"),
    [((0, 0), (1, 0)), ((0, 0), (1 << 32, 0)), ((0, 0), (0, 1)), ((1, 0), (0, 1)), ((6, 3), (7, 3)), ((2, 9), (3, 8))],
)
def test_seeds_and_images_are_independent(first: tuple[int, int], second: tuple[int, int]) -> None:
    # With a single round, images would be equal after swapping neighbours.
    a, b = (choices(*seed_and_image, 800, 1024).astype(np.int64) for seed_and_image in (first, second))
    assert chi_square(a * 25 + b, 625) < LIMIT_624
    for x_flip, y_flip in ((1, 0), (2, 0), (3, 0), (0, 1), (4, 0), (1, 1)):
        swapped = b[np.arange(800) ^ y_flip][:, np.arange(1024) ^ x_flip]
        assert chi_square(a * 25 + swapped, 625) < LIMIT_624


def test_flat_patch_has_mean_and_variance_of_the_table(make_lut: MakeLut) -> None:
    # 1600 pixels of one colour: each channel's mean is the table's within 5.5 standard errors; 64 colours x 3 channels
    # x 2 lights at a two-sided probability of 4e-8 each: one false alarm in 70 000 seeds, and the seed is fixed.
    lut = make_lut(bits=2)
    code = np.arange(64)
    patches = ((np.stack([code >> 4 & 3, code >> 2 & 3, code & 3], axis=-1) << 6) + 0b10101).astype(np.uint8)
    picture = patches.reshape(8, 8, 3).repeat(40, axis=0).repeat(40, axis=1)
    for light in (0, 3):
        image = render(lut, picture, light, rendering="codes", seed=11, image=1)
        measured = image.reshape(8, 40, 8, 40, 3).mean(axis=(1, 3)).reshape(64, 3)
        table = lut.samples[light].astype(np.float64)
        error = table.std(axis=1) / np.sqrt(1600)
        assert (np.abs(measured - table.mean(axis=1)) < 5.5 * error).all()
        # And the scatter is the table's: the variance of 1600 draws is within 6 of its standard errors (kurtosis < 4).
        variance = image.reshape(8, 40, 8, 40, 3).var(axis=(1, 3)).reshape(64, 3)
        assert (np.abs(variance / table.var(axis=1) - 1) < 6 * np.sqrt(3 / 1600)).all()


def test_render_replaces_unfit_colours(make_lut: MakeLut) -> None:
    lut = make_lut(bits=2, unfit=(0, 1))
    black = render(lut, np.zeros((4, 8, 3), np.uint8), 0, rendering="codes", seed=1)
    # Colour 0 is (0, 0, 0) and 1 (0, 0, 1), both unfit; at distance 1 of black remain 4 (0, 1, 0) and 16 (1, 0, 0).
    green = render(lut, np.zeros((4, 8, 3), np.uint8) + np.array([0, 64, 0], np.uint8), 0, rendering="codes", seed=1)
    np.testing.assert_array_equal(black, green)


def test_refuses_picture_of_another_type(make_lut: MakeLut) -> None:
    with pytest.raises(InputError):
        render(make_lut(unfit=(0,)), np.zeros((4, 4, 3)), 0)  # pyrefly: ignore[bad-argument-type]


def test_refuses_unknown_light(make_lut: MakeLut, picture: npt.NDArray[np.uint8]) -> None:
    lut = make_lut()
    for light in (-1, 4):
        with pytest.raises(InputError, match=rf"illuminant {light};.*0 to 3"):
            render(lut, picture, light)
    invalid: list[Any] = [1.5, [0, 1]]
    for light in invalid:
        with pytest.raises(InputError, match=re.escape(repr(light))):
            render(lut, picture, light)
    np.testing.assert_array_equal(render(lut, picture, np.arange(4)[2]), render(lut, picture, 2))


def test_refuses_invalid_shapes_and_numbers(picture: npt.NDArray[np.uint8]) -> None:
    samples = np.zeros((8, 25, 3), np.uint16)
    with pytest.raises(InputError):
        draw_samples(samples, picture.astype(np.uint16))  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(InputError):
        draw_samples(samples, picture[..., 0])
    with pytest.raises(InputError):
        draw_samples(samples[..., :2], picture)
    with pytest.raises(InputError):
        draw_samples(samples, picture, out=np.zeros((1, 1, 3), np.uint16))
    locked = np.zeros(picture.shape, np.uint16)
    locked.flags.writeable = False
    with pytest.raises(InputError):
        draw_samples(samples, picture, out=locked)
    with pytest.raises(InputError):
        draw_samples(samples, picture, image=1 << 32)
    with pytest.raises(InputError):
        draw_samples(samples, picture, seed=-1)
    with pytest.raises(InputError):
        channel_bits(9)


@pytest.mark.parametrize(
    "function",
    [draw_samples, draw_batch, draw_printed, mix_samples, mixed_table, render],
)
def test_defaults_are_image_0_of_seed_0(function: Callable[..., object]) -> None:
    usual = {"seed": 0, "seeds": 0, "image": 0, "images": 0, "first_row": 0, "threads": 1, "flip": False, "gain": 1}
    defaults = {name: entry.default for name, entry in signature(function).parameters.items() if name in usual}
    assert defaults
    assert defaults == {name: usual[name] for name in defaults}


@pytest.mark.parametrize("bytes_left", [0, 2, 1000])
def test_two_bytes_after_samples_are_readable(bytes_left: int) -> None:
    page = mmap.PAGESIZE
    memory = np.frombuffer(mmap.mmap(-1, 2 * page), np.uint8)
    size = 8 * 4 * 3
    end = page - bytes_left  # Where the samples end: at the end of a page, or within one.
    samples = memory[end - 2 * size : end].view(np.uint16).reshape(8, 4, 3)
    readable_samples = readable(samples)
    assert (readable_samples is samples) is (bytes_left >= 2)
    np.testing.assert_array_equal(readable_samples, samples)
