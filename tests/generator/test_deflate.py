"""The deflate packer: other libraries unpack its data, codes are optimal, and files are small."""

from __future__ import annotations

import heapq
import zlib
from collections.abc import Callable
from itertools import pairwise

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from isal import isal_zlib

from foundation.errors import InputError
from generator import files
from generator.deflate import LONGEST, Packer, code_lengths, codes_of, find_repeats
from generator.files import ImageMetadata, encode_image

METADATA = ImageMetadata(12000, (1.0, 1.0, 1.0), "Benchmark")

Image16 = npt.NDArray[np.uint16]


def drawn(height: int, width: int, colours: int, seed: int = 0) -> Image16:
    """Return an image of 25 samples of each colour; few colours make it smooth."""
    rng = np.random.default_rng(seed)
    table = rng.poisson(rng.uniform(30, 9000, (colours, 1, 3)), (colours, 25, 3)).astype(np.uint16)
    picture = np.sort(rng.integers(0, colours, (height, width)), axis=1)
    return table[picture, rng.integers(0, 25, (height, width))]


def smooth(height: int, width: int) -> Image16:
    """Return a gradient with noise, in which hardly any pixel repeats."""
    rng = np.random.default_rng(1)
    means = 3000 + 1000 * np.sin(np.arange(height)[:, None, None] / 50 + np.arange(width)[None, :, None] / 70)
    return rng.poisson(means * [0.6, 1.0, 0.8]).astype(np.uint16)


def rows_of(image: Image16, filters: npt.NDArray[np.uint8]) -> bytes:
    """Return the rows of a PNG with filters 0 (None) or 1 (Sub) (ISO/IEC 15948, 9.2)."""
    height, width, _ = image.shape
    plain = image.astype(">u2").view(np.uint8).reshape(height, 6 * width).astype(np.int64)
    previous = np.pad(plain, ((0, 0), (6, 0)))[:, :-6]
    filtered = (plain - np.where(filters[:, None] == 1, previous, 0)) % 256
    return np.hstack([filters[:, None], filtered]).astype(np.uint8).tobytes()


@pytest.mark.slow
@settings(max_examples=60)
@given(
    image=hnp.arrays(
        np.uint16,
        st.tuples(st.integers(1, 12), st.integers(1, 200), st.just(3)),
        elements=st.integers(0, 65535) | st.integers(0, 2),
        fill=st.integers(0, 65535),
    ),
    last=st.booleans(),
)
def test_band_unpacks_to_its_rows(image: Image16, last: bool) -> None:
    data, rows = Packer().pack(image, last=last)
    assert rows.tobytes() == rows_of(image, rows[:, 0])
    stream = zlib.decompressobj(wbits=-15)
    assert stream.decompress(data.data) == rows.tobytes()
    assert stream.eof == last
    assert not stream.unused_data


IMAGES: dict[str, Callable[[int, int], Image16]] = {
    "drawn": lambda height, width: drawn(height, width, 500),
    "smooth": smooth,
    "even": lambda height, width: np.full((height, width, 3), 300, np.uint16),
}


@pytest.mark.parametrize("image_name", IMAGES)
def test_other_libraries_unpack_bands(image_name: str) -> None:
    data, rows = Packer().pack(IMAGES[image_name](150, 400), last=True)
    assert isal_zlib.decompress(data.data, wbits=-15) == rows.tobytes()
    assert imagecodecs.deflate_decode(data.tobytes(), raw=True, out=rows.nbytes) == rows.tobytes()


def test_selects_smaller_method() -> None:
    _, rows = Packer().pack(drawn(200, 300, 100), last=True)
    assert set(rows[:, 0]) == {0}
    _, rows = Packer().pack(smooth(200, 300), last=True)
    assert set(rows[:, 0]) == {1}


def test_bands_are_independent() -> None:
    packer = Packer()
    first = packer.pack(drawn(90, 200, 50), last=False)[0].tobytes()
    packer.pack(smooth(200, 300), last=True)
    assert packer.pack(drawn(90, 200, 50), last=False)[0].tobytes() == first


def test_packs_bands_of_any_shape() -> None:
    packer = Packer()
    for height, width in ((700, 1), (8, 100), (1, 900), (30, 29)):
        data, rows = packer.pack(drawn(height, width, 50), last=True)
        assert zlib.decompress(data.data, wbits=-15) == rows.tobytes()


def test_uncounted_rows_may_have_any_values() -> None:
    """Codes are made from every eighth row. Here these have few values, and the others all values and runs."""
    image = drawn(400, 500, 300)
    other_rows = np.random.default_rng(5).integers(0, 65536, (100, 500, 3)).astype(np.uint16)
    for run in range(1, 50):
        other_rows[run, 100 : 100 + run] = other_rows[run, 99]
        other_rows[run + 50, 9 * run :] = other_rows[run + 50, : 500 - 9 * run]
    image[:100][np.arange(100) % 8 != 4] = other_rows[np.arange(100) % 8 != 4]
    data, rows = Packer().pack(image, last=True)
    assert not rows[:, 0].any()
    assert zlib.decompress(data.data, wbits=-15) == rows.tobytes() == rows_of(image, rows[:, 0])


def distances_of(image: Image16) -> npt.NDArray[np.uint16]:
    distances = np.empty(image.shape[:2], np.uint16)
    find_repeats(image, np.empty(1 << 15, np.uint64), distances)
    return distances


def test_finds_repeats_within_window() -> None:
    """Pixel 5461 is 32766 bytes after the first, within the window of 32768; the next one is outside."""
    # All pixels differ, except for the two that are compared.
    row = np.arange(1, 5464).astype(np.uint16)[None, :, None] * np.array([1, 3, 7], np.uint16)
    for index, distance in ((5461, 32766), (5462, 0)):
        image = row.copy()
        image[0, index] = image[0, 0]
        expected = np.zeros((1, 5463))
        expected[0, index] = distance
        np.testing.assert_array_equal(distances_of(image), expected)


def test_distances_include_filter_bytes() -> None:
    image = np.arange(60).astype(np.uint16).reshape(4, 5, 3)
    image[3, 4] = image[1, 0]
    image[2, 2] = image[2, 1]
    expected = np.zeros((4, 5))
    expected[3, 4] = 2 * (1 + 6 * 5) + 6 * 4
    expected[2, 2] = 6
    np.testing.assert_array_equal(distances_of(image), expected)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.integers(0, 1 << 32), st.integers(1, 40), st.integers(1, 40), st.integers(2, 40))
def test_repeated_pixels_are_equal(seed: int, height: int, width: int, colours: int) -> None:
    image = drawn(height, width, colours, seed)
    data = rows_of(image, np.zeros(height, np.uint8))
    for (y, x), distance in np.ndenumerate(distances_of(image)):
        offset = y * (1 + 6 * width) + 1 + 6 * x
        if distance:
            assert data[offset - distance : offset - distance + 6] == data[offset : offset + 6]


@pytest.mark.parametrize("band", [1, 400, 5000])
def test_bands_form_one_stream(monkeypatch: pytest.MonkeyPatch, band: int) -> None:
    monkeypatch.setattr(files, "BAND", band)
    image = drawn(37, 400, 60)
    data = encode_image(image, "png", METADATA)
    assert data.count(b"IDAT") == -(-37 // max(1, band // 400))
    np.testing.assert_array_equal(imagecodecs.png_decode(data), image)


@pytest.mark.slow
@pytest.mark.parametrize("image_name", IMAGES)
def test_files_are_not_larger_than_opencv(image_name: str) -> None:
    image = IMAGES[image_name](512, 512)
    opencv_file = cv2.imencode(".png", image[..., ::-1])[1]
    assert len(encode_image(image, "png", METADATA)) <= len(opencv_file)


def test_refuses_images_too_large_for_png() -> None:
    wide = np.broadcast_to(np.zeros(1, np.uint16), (1, (1 << 28) + 1, 3))
    with pytest.raises(InputError, match=r"268435457x1 px.*PNG"):
        encode_image(wide, "png", METADATA)
    tall = np.broadcast_to(np.zeros(1, np.uint16), (1 << 31, 1, 3))
    with pytest.raises(InputError, match=r"1x2147483648 px.*PNG"):
        encode_image(tall, "png", METADATA)


frequencies = st.lists(st.integers(0, 1 << 40) | st.just(0), min_size=1, max_size=286)


@pytest.mark.slow
@settings(max_examples=80)
@given(frequencies)
def test_codes_are_complete_and_prefix_free(counts: list[int]) -> None:
    lengths = code_lengths(np.array(counts), LONGEST)
    used_lengths = lengths[lengths > 0]
    assert ((lengths > 0) == (np.array(counts) > 0)).all()
    if len(used_lengths) > 1:
        assert used_lengths.max() <= LONGEST
        assert (1 << (LONGEST - used_lengths)).sum() == 1 << LONGEST
    codes = [format(code & 0xFFFF, f"0{code >> 16}b")[::-1] for code in codes_of(lengths).tolist() if code >> 16]
    ordered = sorted(codes)
    assert not any(following.startswith(code) for code, following in pairwise(ordered))


@pytest.mark.slow
@settings(max_examples=60)
@given(st.lists(st.integers(1, 60), min_size=2, max_size=40))
def test_codes_are_optimal(counts: list[int]) -> None:
    """Compare with Huffman's construction by a heap, where no code reaches the limit."""
    heap = list(counts)
    heapq.heapify(heap)
    best = 0
    while len(heap) > 1:
        joined = heapq.heappop(heap) + heapq.heappop(heap)
        best += joined
        heapq.heappush(heap, joined)
    lengths = code_lengths(np.array(counts), 16)
    assert (lengths * counts).sum() == best


def test_limits_code_length() -> None:
    fibonacci = [1, 1]
    while len(fibonacci) < 40:
        fibonacci.append(fibonacci[-1] + fibonacci[-2])
    lengths = code_lengths(np.array(fibonacci), LONGEST)
    assert lengths.max() == LONGEST
    assert (1 << (LONGEST - lengths)).sum() == 1 << LONGEST
    assert (np.diff(lengths) <= 0).all()
