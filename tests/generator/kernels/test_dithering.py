"""Dithering against its rule in numpy, and the statistics of the cells it takes."""

from __future__ import annotations

import hashlib

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from foundation.errors import InputError
from generator import philox
from generator.kernels.dithering import dither
from generator.kernels.planar import draw_batch
from generator.kernels.rendering import draw_mosaic, draw_samples

pytestmark = pytest.mark.slow

U = np.uint64
WORD = U(0xFFFFFFFF)
GOLDEN = "855b59c1dfc62a281539284d555a1a0e25d59db077a0ecc9db0d40f12c510361"
"""Of a picture that the rule above was held against."""


def numbers(seed: int, image: int, height: int, width: int, *, first_row: int = 0) -> npt.NDArray[np.int64]:
    """Return e (H, W), 0 … 65535, by the rule of `dithering.py`."""
    y, x = np.arange(first_row, first_row + height), np.arange(width)
    keys = [key.astype(U)[:, None] for key in philox.words(seed, y, 0, image, 0)]
    h = (8 * (x // 16) + x % 8).astype(U)[None] ^ keys[0]
    h = (h * U(0x21F0AAAD) & WORD) ^ keys[1]
    h = ((h ^ (h >> U(16))) * U(0x735A2D97) & WORD) ^ keys[2]
    h = (h ^ (h >> U(15))) * U(0x31848BAB) & WORD
    g = h ^ keys[3]
    g = (g ^ (g >> U(14))) * U(0x21F0AAAD) & WORD
    word = (g ^ (g >> U(16))).astype(np.int64)
    return np.where(x % 16 < 8, word & 0xFFFF, word >> 16)


def by_rule(
    picture: npt.NDArray[np.uint8], cells: npt.NDArray[np.uint16], bits: int, seed: int, image: int, first_row: int = 0
) -> npt.NDArray[np.uint8]:
    """Return the code picture by the rule at the head of `dithering.py`."""
    e = numbers(seed, image, *picture.shape[:2], first_row=first_row)
    nodes = ((257 * 63489 * picture.astype(np.int64) >> 16) + (e >> 5)[..., None]) >> 11
    cell = cells[nodes[..., 0] << 10 | nodes[..., 1] << 5 | nodes[..., 2], e % 16].astype(np.int64)
    fields = [cell >> 2 * bits, cell >> bits, cell]
    return np.stack([field % 2**bits << (8 - bits) for field in fields], axis=-1).astype(np.uint8)


def any_cells(bits: int, seed: int = 0) -> npt.NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 8**bits, (32768, 16)).astype(np.uint16)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 5),
    st.integers(1, 9),
    st.one_of(st.integers(1, 70), st.integers(480, 1100)),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 1000),
)
def test_any_picture_by_the_rule(bits: int, height: int, width: int, seed: int, image: int, first_row: int) -> None:
    picture = np.random.default_rng(width).integers(0, 256, (height, width, 3)).astype(np.uint8)
    cells = any_cells(bits)
    got = dither(picture, cells, bits, seed, image, first_row=first_row)
    np.testing.assert_array_equal(got, by_rule(picture, cells, bits, seed, image, first_row))


def test_first_cells_of_seed_0_are_fixed_for_ever() -> None:
    # Worked out in Python's integers from the four Philox words of counter (0, 0, 0, 0) and key 0.
    keys = [int(word) for word in philox.words(0, 0, 0, 0, 0)]
    by_hand: list[tuple[int, int]] = []
    pixels = (0, 1, 8, 15, 16, 24, 32)
    for x in pixels:
        h = (8 * (x // 16) + x % 8 ^ keys[0]) * 0x21F0AAAD % 2**32 ^ keys[1]
        h = (h ^ h >> 16) * 0x735A2D97 % 2**32 ^ keys[2]
        h = (h ^ h >> 15) * 0x31848BAB % 2**32
        g = h ^ keys[3]
        g = (g ^ g >> 14) * 0x21F0AAAD % 2**32
        e = (g ^ g >> 16) >> (0 if x % 16 < 8 else 16) & 0xFFFF
        node = [(63489 * 257 * code // 2**16 + e // 32) // 2048 for code in (100, 110, 91)]
        by_hand.append((node[0] << 10 | node[1] << 5 | node[2], e % 16))
    # A chart whose cell is the node, and one whose cell is the slot.
    nodes = np.repeat(np.arange(32768, dtype=np.uint16)[:, None], 16, axis=1)
    slots = np.repeat(np.arange(16, dtype=np.uint16)[None], 32768, axis=0)
    row = np.full((1, 33, 3), (100, 110, 91), np.uint8)
    codes = [dither(row, cells, 5)[0].astype(int) >> 3 for cells in (nodes, slots)]
    found = [(code[:, 0] << 10 | code[:, 1] << 5 | code[:, 2])[list(pixels)].tolist() for code in codes]
    assert list(zip(*found, strict=True)) == by_hand


def test_bytes_of_a_picture_are_fixed_for_ever() -> None:
    y, x, channel = np.indices((64, 517, 3))
    picture = ((7 * x + 13 * y + 85 * channel) % 256).astype(np.uint8)
    node, slot = np.indices((32768, 16))
    cells = ((node * 2654435761 + slot * 40503) % 32768).astype(np.uint16)
    codes = dither(picture, cells, 5, seed=0xFEDCBA9876543210, image=0xDEADBEEF)
    assert hashlib.sha256(codes.tobytes()).hexdigest() == GOLDEN


def test_bands_threads_memory_order_and_a_given_target_change_nothing(picture: npt.NDArray[np.uint8]) -> None:
    cells = any_cells(4)
    whole = dither(picture, cells, 4, 4, 2)
    for threads in (2, 3, 64):
        np.testing.assert_array_equal(dither(picture, cells, 4, 4, 2, threads=threads), whole)
    bands = [dither(picture[top : top + 7], cells, 4, 4, 2, first_row=top) for top in range(0, 37, 7)]
    np.testing.assert_array_equal(np.concatenate(bands), whole)
    target = np.zeros((37, 2 * 1053, 3), np.uint8)[:, ::2]
    odd = np.asfortranarray(cells)
    assert dither(np.asfortranarray(picture), odd, 4, 4, 2, out=target) is target
    np.testing.assert_array_equal(target, whole)
    narrow = dither(picture[:, :1000], cells, 4, 4, 2)
    np.testing.assert_array_equal(narrow, whole[:, :1000])


@pytest.mark.parametrize("width", [1, 31, 32, 33, 64, 96, 128, 577])
def test_kernels_that_dither_draw_what_they_draw_from_the_code_picture(width: int) -> None:
    rng = np.random.default_rng(width)
    picture = rng.integers(0, 256, (13, width, 3)).astype(np.uint8)
    samples = rng.integers(0, 65536, (512, 25, 3)).astype(np.uint16)
    cells = any_cells(3)
    codes = dither(picture, cells, 3, 6, 9)
    expected = draw_samples(samples, codes, seed=6, image=9)
    for threads in (1, 3):
        got = draw_samples(samples, picture, seed=6, image=9, cells=cells, threads=threads)
        np.testing.assert_array_equal(got, expected)
    window = (width // 3, 2, width - width // 3, 10)
    of_codes = draw_batch(samples[None], [0], [codes], [window], white_level=65535, seeds=6, images=9)
    got = draw_batch(samples[None], [0], [picture], [window], white_level=65535, seeds=6, images=9, cells=[cells])
    np.testing.assert_array_equal(got, of_codes)
    np.testing.assert_array_equal(draw_mosaic(samples, codes, seed=6, image=9)[0, ::2], expected[0, ::2, 0])


def test_an_image_that_is_streamed_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    from generator.kernels import vector as streaming

    rng = np.random.default_rng(8)
    picture = rng.integers(0, 256, (5, 1701, 3)).astype(np.uint8)
    samples, cells = rng.integers(0, 65536, (512, 25, 3)).astype(np.uint16), any_cells(3)
    expected = draw_samples(samples, dither(picture, cells, 3))
    monkeypatch.setattr(streaming, "STREAMED_BYTES", 0)
    np.testing.assert_array_equal(draw_samples(samples, picture, cells=cells), expected)


@pytest.mark.parametrize("code", [0, 1, 4, 127, 128, 200, 254, 255])
def test_the_mean_of_the_nodes_is_the_code(code: int) -> None:
    nodes = np.repeat(np.arange(32768, dtype=np.uint16)[:, None], 16, axis=1)
    picture = np.full((1024, 1024, 3), code, np.uint8)
    got = (dither(picture, nodes, 5, seed=code) >> 3).reshape(-1, 3)
    wanted = 31 * code / 255
    # Of 2^20 nodes, each one of two neighbours with share f of the upper: 5 standard errors, and what the rule owes.
    share = wanted % 1
    assert np.abs(got.mean(axis=0) - wanted).max() <= 5 * (share * (1 - share) / 2**20) ** 0.5 + 2.0**-11
    assert set(np.unique(got)) <= {int(wanted), int(np.ceil(wanted))}


def test_the_share_of_every_code_is_right_and_greys_stay_on_greys() -> None:
    # Exactly, over all 2^11 numbers that nodes come from: the bias that the rule states, and no more.
    up = np.arange(2048)
    codes = np.arange(256)
    nodes = ((63489 * 257 * codes >> 16)[:, None] + up) >> 11
    bias = nodes.mean(axis=1) - 31 * codes / 255
    assert bias.min() >= -(2.0**-11)
    assert bias.max() <= 2.0**-17
    assert (nodes[0] == 0).all()
    assert (nodes[255] == 31).all()
    # With one number for the three channels a grey has grey nodes only, any colour four nodes at most.
    table = np.repeat(np.arange(32768, dtype=np.uint16)[:, None], 16, axis=1)
    picture = np.broadcast_to(codes.astype(np.uint8)[:, None, None], (256, 256, 3))
    greys = dither(picture, table, 5)
    assert (greys == greys[..., :1]).all()
    colours = dither(np.full((256, 256, 3), (100, 110, 93), np.uint8), table, 5)
    assert len(np.unique(colours.reshape(-1, 3), axis=0)) == 4


def deviation(counts: npt.NDArray[np.int64]) -> float:
    """Return how far counts are from equal ones, in standard deviations (Wilson and Hilferty's cube root)."""
    freedom = counts.size - 1
    expected = counts.sum() / counts.size
    variance = 2 / (9 * freedom)
    statistic = float(((counts - expected) ** 2).sum() / expected)
    return ((statistic / freedom) ** (1 / 3) - (1 - variance)) / variance**0.5


def outcomes(seed: int, image: int, first_row: int) -> npt.NDArray[np.int64]:
    """Return of each of 512 x 2048 pixels which of two nodes it got and which of the 16 cells: 0 … 31."""
    node, slot = np.indices((32768, 16))
    cells = ((node & 1) << 4 | slot).astype(np.uint16)
    # 31 v / 255 is 15.5 but for a 510th: half of the nodes are odd, but for so many.
    picture = np.full((512, 2048, 3), 127, np.uint8)
    codes = dither(picture, cells, 5, seed, image, first_row=first_row)
    return codes[..., 2].astype(np.int64) >> 3


def test_cells_are_independent_of_place_image_seed_and_of_the_samples() -> None:
    here = outcomes(7, 3, 0)
    assert set(np.unique(here)) == set(range(32))
    # Nodes are not all as likely, so that tables of two outcomes are held against the product of their margins.
    drawn: dict[int, npt.NDArray[np.int64]] = {}
    for count in (16, 25, 32):
        samples = np.zeros((32768, count, 3), np.uint16)
        samples[..., 0] = np.arange(count)
        image = draw_samples(samples, np.zeros((512, 2048, 3), np.uint8), seed=7, image=3)
        drawn[count] = image[..., 0].astype(np.int64)
    pairs = {f"{distance} apart": (here[:, :-distance], here[:, distance:]) for distance in (1, 2, 7, 8, 9, 15, 16)}
    pairs |= {f"{distance} apart": (here[:, :-distance], here[:, distance:]) for distance in (17, 32, 128, 512, 1024)}
    pairs |= {
        "above": (here[:-1], here[1:]),
        "image": (here, outcomes(7, 4, 0)),
        "seed": (here, outcomes(8, 3, 0)),
        "high seed": (here, outcomes(7 + 2**32, 3, 0)),
    }
    # Number and sample of a pixel come from one word, and so do those of the pixel eight on.
    for count, its in drawn.items():
        pairs |= {f"one of {count} samples": (here, its), f"{count}, left": (here[:, 8:], its[:, :-8])}
        pairs[f"{count}, right"] = (here[:, :-8], its[:, 8:])
    for name, (one, other) in pairs.items():
        assert abs(association(one, other)) < 5, name
    # What would be wrong: the same words for cells and samples.
    assert association(here, here) > 100


def association(one: npt.NDArray[np.int64], other: npt.NDArray[np.int64]) -> float:
    """Return how far a table of two outcomes is from the product of its margins, in standard deviations."""
    table = np.bincount((one << 5 | other).ravel(), minlength=1024).reshape(32, 32).astype(np.float64)
    table = table[table.sum(axis=1) > 0][:, table.sum(axis=0) > 0]
    expected = table.sum(axis=1, keepdims=True) * table.sum(axis=0) / table.sum()
    freedom = (table.shape[0] - 1) * (table.shape[1] - 1)
    variance = 2 / (9 * freedom)
    statistic = float(((table - expected) ** 2 / expected).sum())
    return ((statistic / freedom) ** (1 / 3) - (1 - variance)) / variance**0.5


def test_every_slot_is_as_likely_as_another_whichever_the_node() -> None:
    here = outcomes(2, 0, 0)
    assert abs(deviation(np.bincount(here.ravel() % 16, minlength=16))) < 5
    assert abs(association(here >> 4, here % 16)) < 5


def test_faults_are_named() -> None:
    picture = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(InputError, match=r"the cells are uint16 \(8, 16\), expected uint16 \(32768, 16\)"):
        dither(picture, np.zeros((8, 16), np.uint16), 5)
    with pytest.raises(InputError, match="cell 512 is not in a chart of 3 bits a channel, expected 0 to 511"):
        dither(picture, np.full((32768, 16), 512, np.uint16), 3)
    with pytest.raises(InputError, match=r"the target is uint8 \(3, 4, 3\)"):
        dither(picture, any_cells(1), 1, out=np.zeros((3, 4, 3), np.uint8))
    samples = np.zeros((1, 8, 1, 3), np.uint16)
    windows = [(0, 0, 2, 2)] * 2
    with pytest.raises(InputError, match="1 tables of cells were given for 2 items"):
        draw_batch(samples, [0, 0], [picture] * 2, windows, white_level=9, cells=[any_cells(1)])
