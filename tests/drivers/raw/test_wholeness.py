"""Files that claim a frame and do not hold it are refused, with that reason; whole ones of every layout are read."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.raw.rawfile import LAYOUT_START, decode_raw, filled_fault, layout_is_known, read_raw, stored_frames
from drivers.tiff import Directory, TiffTag
from foundation.errors import FormatError
from tests.drivers.raw.maker_files import in_maker_tiff, maker_files, raf
from tests.drivers.raw.raw_files import Tags, dng_bytes, longs, lossless_jpeg, shorts, write_dng

SIDE = 128
FILES = maker_files()
WHERE = Path("frame.raw")

T = TiffTag


def frame() -> NDArray[np.uint16]:
    return np.random.default_rng(1).integers(60, 4000, (SIDE, 2 * SIDE)).astype(np.uint16)


# Whole files


@pytest.mark.parametrize("name", FILES)
def test_a_whole_file_is_read_and_a_cut_one_is_not(name: str) -> None:
    data, counts = FILES[name]
    np.testing.assert_array_equal(decode_raw(data, WHERE).sensor, counts)
    for length in (0, 7, 12, 40, 200, len(data) // 2, len(data) - 40, len(data) - 1):
        # The last byte of a lossless JPEG is its end's mark.
        if length < len(data) - 1 or name not in ("cr2", "dng lossless"):
            with pytest.raises(FormatError, match=r"frame\.raw cannot be read"):
                decode_raw(data[:length], WHERE)


def described(tags: dict[TiffTag, tuple[int, ...] | str]) -> Directory:
    return Directory({int(tag): value for tag, value in tags.items()})


def one_strip(size: tuple[int, int], compression: int, bits: int, offset: int, bytes_: int) -> Directory:
    columns, rows = size
    return described(
        {
            T.IMAGE_WIDTH: (columns,),
            T.IMAGE_LENGTH: (rows,),
            T.BITS_PER_SAMPLE: (bits,),
            T.COMPRESSION: (compression,),
            T.PHOTOMETRIC_INTERPRETATION: (32803,),
            T.SAMPLES_PER_PIXEL: (1,),
            T.STRIP_OFFSETS: (offset,),
            T.STRIP_BYTE_COUNTS: (bytes_,),
        }
    )


STATED: dict[str, tuple[str, Directory]] = {
    "DSLR-A500": ("SONY", one_strip((4288, 2858), 32767, 12, 917504, 12255104)),
    "ILCE-7M3": ("SONY", one_strip((6048, 4024), 32767, 12, 458752, 24337152)),
    "ILCE-7M4": (
        "SONY",
        Directory(
            {
                **one_strip((7168, 5120), 7, 14, 2039808, 36304000).values,
                T.TILE_WIDTH: (512,),
                T.TILE_LENGTH: (512,),
                T.TILE_OFFSETS: tuple(2039808 + 259314 * number for number in range(140)),
                T.TILE_BYTE_COUNTS: (259314,) * 140,
            }
        ),
    ),
    "D70": ("NIKON CORPORATION", one_strip((3040, 2014), 34713, 12, 809423, 4808449)),
    "D800E": ("NIKON CORPORATION", one_strip((7424, 4924), 34713, 14, 3035136, 38365558)),
    "D200": (
        "NIKON CORPORATION",
        Directory(
            {
                **one_strip((3904, 2616), 1, 12, 0, 0).values,
                T.STRIP_OFFSETS: tuple(1048576 + 64416 * number for number in range(238)),
                T.STRIP_BYTE_COUNTS: (64416,) * 237 + (52704,),
            }
        ),
    ),
    "K-1 Mark II": ("PENTAX", one_strip((7392, 4950), 65535, 14, 169568, 39118125)),
    "DC-X": ("SAMSUNG", one_strip((5632, 3714), 32770, 12, 400000, 22000000)),
}
"""What files of real cameras state of their pixels: the lists of tags of the collection
drewnoakes/metadata-extractor-images. Made up: where D200's strips and A7 IV's tiles begin, and the Samsung."""


@pytest.mark.slow
@pytest.mark.parametrize("model", STATED)
def test_what_real_cameras_state_is_believed(model: str) -> None:
    maker, pixels = STATED[model]
    # Where tiles begin stands a lossless JPEG's header.
    sof = bytes.fromhex("ffd8ffc3000e0e02000200010111000000")
    data = memoryview(bytearray(b"II*\0".ljust(45_000_000, b"\0")))
    for place in pixels.integers(T.TILE_OFFSETS):
        data[place : place + len(sof)] = sof
    (found,) = stored_frames(data, [described({T.MAKE: maker}), pixels])
    assert (found.columns, found.rows) == (pixels.first(T.IMAGE_WIDTH), pixels.first(T.IMAGE_LENGTH))


# Extents


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({256: longs(3664), 257: longs(2754), 278: longs(2754)}, "photosites"),
        ({257: longs(SIDE + 1)}, "photosites|parts"),
        ({324: longs(0xFFFFFFFF), 325: longs(9), 322: longs(2 * SIDE), 323: longs(SIDE)}, "has only|9 bytes"),
        ({324: longs(600, 700), 325: longs(99999, 99999), 322: longs(SIDE), 323: longs(SIDE)}, "has only|upon each"),
        ({324: longs(600, 900), 325: longs(200)}, "2 places of its pixels and 1 sizes"),
        ({278: longs(16)}, "1 parts, 8 expected"),
        ({258: shorts(0)}, "0 bits"),
        ({339: shorts(3)}, "no integers"),
        ({262: shorts(34892)}, "not of a Bayer sensor: its pixels hold all colours"),
        ({277: shorts(2)}, "2 samples"),
        ({50712: shorts(64)}, "table of tones does not rise"),
        ({50712: shorts(0, 9, 8)}, "table of tones does not rise"),
        ({322: longs(0), 323: longs(0), 324: longs(600), 325: longs(65536)}, "parts of 0×0"),
    ],
)
def test_extents_that_hold_no_frame_are_refused(more: Tags, reason: str) -> None:
    with pytest.raises(FormatError, match=reason):
        decode_raw(dng_bytes(frame(), more), WHERE)


def test_a_stub_that_points_beyond_its_end_is_no_white_frame() -> None:
    stub = in_maker_tiff("NIKON CORPORATION", "NIKON D3", bytes(12_000), {256: longs(3664), 257: longs(2754)})
    for places in (longs(0xFFFFFFFF), longs(400)):
        with pytest.raises(FormatError):
            decode_raw(stub.replace(longs(len(stub) - 12_000)[2], places[2]), WHERE)


def test_zeros_of_a_size_that_libraw_knows_are_refused() -> None:
    """LibRaw takes any file of 786 432 bytes for a frame of an industrial camera."""
    with pytest.raises(FormatError):
        decode_raw(bytes(786_432), WHERE)


def test_a_file_of_a_layout_that_is_not_checked_is_what_libraw_makes_of_it() -> None:
    data, counts = raf()
    assert not layout_is_known(data[:LAYOUT_START])
    np.testing.assert_array_equal(decode_raw(data, WHERE).sensor, counts)
    for length in (0, 7, 12, 40, 200, 600):
        with pytest.raises(FormatError):
            decode_raw(data[:length], WHERE)


@pytest.mark.parametrize("name", FILES)
def test_a_layout_that_is_checked_is_known_by_its_beginning(name: str) -> None:
    assert layout_is_known(FILES[name][0][:LAYOUT_START])


def test_makers_of_whose_layout_nothing_is_known_are_named() -> None:
    data = in_maker_tiff("Eastman Kodak", "DC50", bytes(8000), {})
    with pytest.raises(FormatError) as told:
        decode_raw(data, WHERE)
    assert "copy" not in str(told.value)


@pytest.mark.parametrize(
    ("compression", "name"), [(8, "Deflate"), (32946, "Deflate"), (9, "VC-5"), (52546, "JPEG XL"), (5, "number 5")]
)
def test_what_is_not_supported_is_said_so_and_no_copy_helps(compression: int, name: str) -> None:
    with pytest.raises(FormatError, match=f"{name}.*supported") as told:
        decode_raw(dng_bytes(frame(), {259: shorts(compression)}), WHERE)
    assert "copy" not in str(told.value)


# Pixels


def in_strips(more: Tags, strips: int, pixels: bytes) -> bytes:
    """Return a DNG whose pixels are in strips behind one another."""
    tags: Tags = {**more, 278: longs(SIDE // strips), 279: longs(*(len(pixels) // strips,) * strips)}
    start = len(dng_bytes(frame(), {**tags, 273: longs(*(0,) * strips)}, pixels, place=None)) - len(pixels)
    places = longs(*(start + number * (len(pixels) // strips) for number in range(strips)))
    return dng_bytes(frame(), {**tags, 273: places}, pixels, place=None)


def test_strips_in_a_row_are_one_frame_and_others_are_refused() -> None:
    pixels = frame().astype("<u2").tobytes()
    data = in_strips({}, 4, pixels)
    np.testing.assert_array_equal(decode_raw(data, WHERE).sensor, frame())
    first = struct.pack("<I", len(data) - len(pixels))
    with pytest.raises(FormatError):
        decode_raw(data.replace(first, struct.pack("<I", 8), 1), WHERE)


def test_lossless_jpeg_in_strips_is_refused() -> None:
    """LibRaw takes the first strip for all, and leaves the other rows at zero."""
    strip = lossless_jpeg(frame()[: SIDE // 2])
    data = in_strips({259: shorts(7), 258: shorts(14)}, 2, strip * 2)
    with pytest.raises(FormatError):
        decode_raw(data, WHERE)


def test_a_jpeg_of_another_size_is_refused() -> None:
    strip = lossless_jpeg(frame()[:-2])
    with pytest.raises(FormatError, match="no JPEG of 128 rows"):
        decode_raw(dng_bytes(frame(), {259: shorts(7), 258: shorts(14)}, strip), WHERE)


def test_codes_of_a_maker_that_decode_to_nonsense_are_refused(capfd: pytest.CaptureFixture[str]) -> None:
    """Pentax's codes are Huffman's; noise in their place decodes to samples beyond their precision."""
    noise = np.random.default_rng(5).bytes(48 * 80 * 8)
    data = in_maker_tiff("PENTAX", "PENTAX K-1", noise, {258: shorts(14), 259: shorts(65535)})
    with pytest.raises(FormatError, match="LibRaw says 'Data error"):
        decode_raw(data, WHERE)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("hole", [np.s_[100:101], np.s_[64:96, :256], np.s_[100:]], ids=["row", "tile", "end"])
@pytest.mark.parametrize(
    ("black", "filling", "reason"),
    [(64, 0, "half of its black level"), (0, 0, "do not reach one count"), (64, 65535, "nothing but the count 65535")],
)
def test_a_frame_that_was_filled_is_told(
    tmp_path: Path, hole: tuple[slice, ...], black: int, filling: int, reason: str
) -> None:
    counts = np.tile(frame(), (1, 2))
    faults: list[str | None] = []
    for _ in range(2):
        write_dng(tmp_path / "a.dng", counts, {50714: shorts(black)})
        read = read_raw(tmp_path / "a.dng")
        faults.append(filled_fault(read.counts, read.black, read.white_level))
        counts[hole] = filling
    assert faults[0] is None
    assert reason in (faults[1] or "")


def test_darkness_and_too_much_light_are_no_holes() -> None:
    dark = np.random.default_rng(2).normal(64, 8, (SIDE, 2 * SIDE)).clip(0).astype(np.uint16)
    dark[:, 7] = 0  # a dead column
    assert filled_fault(dark, np.full((2, 2), 64.0), 4095) is None
    assert filled_fault(np.full_like(dark, 32), np.full((2, 2), 64.0), 4095) is None, "half of black is not below it"
    assert filled_fault(np.full_like(dark, 31), np.full((2, 2), 64.0), 4095) is not None
    # Black is subtracted in some bodies, and half of the noise with it.
    assert filled_fault(np.maximum(dark, 64) - 64, np.zeros((2, 2)), 4095) is None
    assert filled_fault(np.full_like(dark, 65535), np.zeros((2, 2)), 65535) is None
    assert filled_fault(np.full_like(dark, 16383), np.full((2, 2), 1024.0), 15_000) is None


# Levels


SIGNED: Callable[[float], tuple[int, int, bytes]] = lambda number: (12, 1, struct.pack("<d", number))  # noqa: E731


@pytest.mark.parametrize("strip", [None, lossless_jpeg(frame())], ids=["plain", "lossless"])
@pytest.mark.parametrize("more", [{}, {50829: longs(0, 0, SIDE, 2 * SIDE)}], ids=["", "active area"])
@pytest.mark.parametrize(
    ("levels", "reason"),
    [
        ({50717: SIGNED(-5)}, "white level is"),
        ({50717: longs(0x20000)}, "white level is"),
        ({50714: SIGNED(1e15)}, "black level is"),
        ({50714: SIGNED(-1e9)}, "black level is"),
        ({50714: longs(4095)}, "black level is"),
        ({50716: (10, 1, struct.pack("<ii", -90, 1))}, "black level is -26"),
        ({50714: (5, 1, struct.pack("<II", 64, 0))}, "divided by zero"),
    ],
)
def test_levels_that_no_sensor_has_are_refused(levels: Tags, reason: str, more: Tags, strip: bytes | None) -> None:
    stored: Tags = {} if strip is None else {259: shorts(7), 258: shorts(14)}
    with pytest.raises(FormatError, match=reason):
        decode_raw(dng_bytes(frame(), {**stored, **more, **levels}, strip), WHERE)


def test_a_white_level_is_within_the_bits() -> None:
    twelve = {258: shorts(12), 279: longs(SIDE * SIDE * 3)}
    pixels = bytes(SIDE * SIDE * 3)
    assert decode_raw(dng_bytes(frame(), {**twelve, 50717: longs(4096)}, pixels), WHERE).white_level == 4096
    tones = {50712: shorts(*range(0, 65536, 16)), 50717: longs(65535)}
    assert decode_raw(dng_bytes(frame(), {**twelve, **tones}, pixels), WHERE).white_level == 65535
    with pytest.raises(FormatError, match=r"1 to 4096.*12 bits"):
        decode_raw(dng_bytes(frame(), {**twelve, 50717: longs(16383)}, pixels), WHERE)
