"""Raw files: real files against dcraw's output, generated files with odd margins, damaged files."""

from __future__ import annotations

import hashlib
import struct
import threading
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rawpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from drivers.raw import rawfile
from drivers.raw.rawfile import (
    LAYOUT_START,
    Mosaic,
    decode_raw,
    filled_fault,
    layout_is_known,
    read_raw,
    read_serial_and_lens,
    stored_frames,
)
from drivers.raw.storage import Area
from drivers.tiff import Directory, TiffTag, read_directories
from foundation.errors import FormatError
from tests.data_files import available, shipped
from tests.drivers.raw.maker_files import in_maker_tiff, maker_files, raf
from tests.drivers.raw.raw_files import (
    Tags,
    dng_bytes,
    longs,
    lossless_jpeg,
    ratios,
    shorts,
    text,
    write_cr2,
    write_dng,
)
from tests.fuzz.raw import run, seeds

EOS_550D = shipped("raw/canon_eos_550d_colorchart.dng")
G2 = shipped("raw/canon_powershot_g2.crw")
REAL = (EOS_550D, G2, *available("raw/blackmagic.dng"))


def noise(shape: tuple[int, int], top: int = 4096) -> NDArray[np.uint16]:
    return np.random.default_rng(7).integers(0, top, shape).astype(np.uint16)


def outcome(path: Path) -> Mosaic | FormatError:
    """Return the mosaic or the FormatError; other errors fail the test."""
    try:
        return read_raw(path)
    except FormatError as error:
        return error


# Real files


@pytest.mark.slow
def test_counts_equal_dcraw() -> None:
    # Measured with dcraw 9.28, -D -4 -T.
    for line in shipped("raw/dcraw_D4T.sha256").read_text().splitlines():
        digest, name, shape = line.split()
        mosaic = read_raw(shipped(f"raw/{name}"))
        assert f"{mosaic.counts.shape[0]}x{mosaic.counts.shape[1]}" == shape
        assert hashlib.sha256(mosaic.counts.astype("<u2").tobytes()).hexdigest() == digest


@pytest.mark.slow
def test_reads_a_real_550d_file() -> None:
    # Tags as shown by exiftool and tifffile; the left border of a real sensor is black, near the 2048 counts set in
    # Canon's bodies of this generation.
    mosaic = read_raw(EOS_550D)
    assert mosaic.camera == "Canon EOS Kiss X4"
    assert mosaic.pattern == "RGGB"
    assert mosaic.visible == Area(26, 152, 1156, 1734)
    assert mosaic.sensor.shape == (1182, 1888)
    np.testing.assert_array_equal(mosaic.black, np.full((2, 2), 2056.0))
    assert mosaic.white_level == 15000
    assert (mosaic.iso, mosaic.aperture, mosaic.shutter_s) == (None, None, None)
    black = mosaic.masked_black()
    assert black is not None
    np.testing.assert_allclose(black, 2048, atol=4)


@pytest.mark.slow
def test_reads_a_real_g2_file() -> None:
    mosaic = read_raw(G2)
    assert mosaic.camera == "Canon PowerShot G2"
    assert mosaic.pattern == "RGGB"
    assert (mosaic.iso, mosaic.aperture) == (50, 4.0)
    assert mosaic.shutter_s == pytest.approx(1 / 50, rel=0.02)
    np.testing.assert_array_equal(mosaic.black, np.full((2, 2), 32.0))
    assert mosaic.white_level == 1023
    black = mosaic.masked_black()
    assert black is not None
    np.testing.assert_allclose(black, 32, atol=0.2)


# Frames


@pytest.mark.slow
def test_visible_area_of_a_550d_equals_dcraw(tmp_path: Path) -> None:
    # dcraw 9.28 shows raw[51:3516, 142:5344] as RGGB; LibRaw's visible area starts one row lower.
    columns = np.random.default_rng(2).integers(0, 2, 5344)
    columns[:2] = 1
    counts = np.add.outer(8192 + np.arange(3516), columns).astype(np.uint16)
    write_cr2(tmp_path / "IMG_0001.CR2", counts, "Canon EOS 550D", iso=200)
    mosaic = read_raw(tmp_path / "IMG_0001.CR2")
    np.testing.assert_array_equal(mosaic.counts, counts[51:3516, 142:5344])
    assert mosaic.pattern == "RGGB"
    assert mosaic.camera == "Canon EOS 550D"
    assert (mosaic.iso, mosaic.aperture, mosaic.shutter_s) == (200, 8.0, 0.5)
    assert mosaic.masked == (Area(0, 0, 3516, 140), Area(4, 140, 44, 5204))
    assert mosaic.block_planes().shape == (2, 2, 1732, 2601)


@pytest.mark.slow
@pytest.mark.parametrize("maker", ["Canon", "Nikon"])
@pytest.mark.parametrize(("top", "left"), [(0, 0), (1, 0), (0, 1), (13, 17), (12, 40)])
def test_visible_area_of_a_dng_is_its_active_area(tmp_path: Path, maker: str, top: int, left: int) -> None:
    # DNG 1.4: CFAPattern starts at the corner of the active area, also if it is odd.
    counts = noise((61, 90))
    more = {271: text(maker), 272: text("Test"), 50829: longs(top, left, 60, 88), 33422: (1, 4, b"\2\1\1\0")}
    write_dng(tmp_path / "odd.dng", counts, more)
    mosaic = read_raw(tmp_path / "odd.dng")
    assert mosaic.visible == Area(top, left, 60 - top, 88 - left)
    assert mosaic.pattern == "BGGR"
    assert mosaic.camera == f"{maker} Test"
    np.testing.assert_array_equal(mosaic.counts, counts[top:60, left:88])
    np.testing.assert_array_equal(mosaic.sensor, counts)


def no_plain_mosaic(path: Path, data: bytes, contents: object) -> None:
    """Replace the reader of plain files, so that LibRaw reads all files."""


def uses_libraw(path: Path) -> bool:
    """Return whether LibRaw decodes a file, or the file is refused."""
    asked: list[object] = []

    def imread(source: object) -> rawpy.RawPy:
        asked.append(source)
        raise rawpy.LibRawFileUnsupportedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rawpy, "imread", imread)
        try:
            read_raw(path)
        except FormatError:
            return True
    assert not asked
    return False


_CODES = [b"\0\1\1\2", b"\1\0\2\1", b"\1\2\0\1", b"\2\1\1\0"]


@pytest.mark.slow
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    size=st.tuples(st.integers(40, 70), st.integers(40, 70)),
    code=st.sampled_from(_CODES),
    corner=st.none() | st.tuples(st.integers(0, 9), st.integers(0, 9)),
    black=st.sampled_from([{}, {50714: shorts(2048)}, {50713: shorts(2, 2), 50714: shorts(1, 2, 3, 4)}]),
    table=st.booleans(),
    maker=st.sampled_from(["Canon", "Nikon"]),
)
def test_plain_dng_equals_libraw(
    tmp_path: Path,
    size: tuple[int, int],
    code: bytes,
    corner: tuple[int, int] | None,
    black: Tags,
    table: bool,
    maker: str,
) -> None:
    more: Tags = {271: text(maker), 272: text("Test"), 33422: (1, 4, code), **black}
    if corner is not None:
        more[50829] = longs(*corner, *size)
    if table:
        more[50712] = shorts(*range(0, 8192, 2))
    write_dng(tmp_path / "a.dng", noise(size), more)
    # LibRaw applies linearisation tables, and has the visible area if it is not stated.
    assert uses_libraw(tmp_path / "a.dng") == (table or corner is None)
    read = read_raw(tmp_path / "a.dng")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rawfile, "_plain_mosaic", no_plain_mosaic)
        unpacked = read_raw(tmp_path / "a.dng")
    np.testing.assert_array_equal(read.sensor, unpacked.sensor)
    np.testing.assert_array_equal(read.black, unpacked.black)
    alike = ("pattern", "white_level", "camera", "visible", "masked", "iso", "aperture", "shutter_s")
    assert [getattr(read, name) for name in alike] == [getattr(unpacked, name) for name in alike]


# Black


@pytest.mark.slow
def test_black_keeps_fraction_and_position(tmp_path: Path) -> None:
    # DNG 1.4: BlackLevel starts at the corner of the active area; deltas of columns and rows are added.
    levels = ratios((20483, 10), (20495, 10), (2050, 1), (2051, 1))
    more = {50713: shorts(2, 2), 50714: levels, 50829: longs(3, 5, 40, 60)}
    write_dng(tmp_path / "a.dng", noise((40, 60)), more)
    np.testing.assert_allclose(read_raw(tmp_path / "a.dng").black, [[2048.3, 2049.5], [2050, 2051]])
    write_dng(tmp_path / "b.dng", noise((40, 60)), {50713: shorts(1, 2), 50714: shorts(100, 200)})
    np.testing.assert_array_equal(read_raw(tmp_path / "b.dng").black, [[100, 200], [100, 200]])


@pytest.mark.slow
def test_masked_black_is_the_mean_of_each_position(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    counts = np.full((201, 300), 4000, np.uint16)
    truth = np.array([[2047.25, 2048.0], [2049.5, 2046.75]])
    for row in range(2):
        for column in range(2):
            # The visible corner (13, 41) has position (0, 0); even sensor rows and columns have the other position.
            border = counts[(row + 1) % 2 :: 2, (column + 1) % 2 : 41 : 2]
            border[...] = np.round(rng.normal(truth[row, column], 6.0, border.shape))
    counts[:, :4] = 2066  # disturbed first columns, too similar to be excluded by their value
    counts[50, 20:24] = 16000  # hot photosites
    write_dng(tmp_path / "a.dng", counts, {50829: longs(13, 41, 201, 300), 50830: longs(0, 0, 201, 40)})
    mosaic = read_raw(tmp_path / "a.dng")
    black = mosaic.masked_black()
    assert black is not None
    # 1800 photosites a phase: a standard error of 0.14.
    np.testing.assert_allclose(black, truth, atol=0.6)


# Other files


@pytest.mark.slow
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"x",
        b"II*\0",
        b"MM\0*\0\0\0\x08\0\0\0\0\0\0",
        b"kind,illumination,file\n" * 100,
        b"\x89PNG\r\n\x1a\n" + bytes(1000),
        b"\xff\xd8\xff\xe0" + bytes(1000),
        bytes(100_000),
    ],
    ids=["empty", "one byte", "four bytes", "empty TIFF", "text", "PNG", "JPEG", "zeros"],
)
def test_refuses_other_files(tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "frame.CR2").write_bytes(content)
    with pytest.raises(FormatError, match=r"frame\.CR2.*raw file"):
        read_raw(tmp_path / "frame.CR2")
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_refuses_other_sensors(tmp_path: Path) -> None:
    counts = noise((60, 90))
    xtrans = bytes([1, 1, 0, 1, 1, 2] * 6)
    write_dng(tmp_path / "x.dng", counts, {33421: shorts(6, 6), 33422: (1, 36, xtrans)})
    cyan = {33422: (1, 4, b"\3\4\1\5"), 50710: (1, 4, b"\3\4\1\5")}
    write_dng(tmp_path / "c.dng", counts, cyan)
    write_dng(tmp_path / "linear.dng", counts, {262: shorts(34892)})
    for name in ("x.dng", "c.dng", "linear.dng"):
        with pytest.raises(FormatError, match=f"{name} .*(Bayer|raw file)"):
            read_raw(tmp_path / name)


# Damage


@pytest.mark.slow
@pytest.mark.parametrize("real", REAL, ids=lambda real: real.name)
def test_refuses_truncated_files(tmp_path: Path, real: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = real.read_bytes()
    # The last 58 bytes of blackmagic.dng are padding; no tag points to them.
    whole = len(data) - (58 if real.name == "blackmagic.dng" else 0)
    lengths = [0, 7, 8, 100, 999, 1500, 5000, 20_000, *np.linspace(30_000, whole - 1, 9).astype(int).tolist()]
    cut = tmp_path / real.name
    for length in lengths:
        cut.write_bytes(data[:length])
        assert isinstance(outcome(cut), FormatError), length
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_threads_decode_in_parallel(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    counts = noise((64, 96), 64)
    write_cr2(tmp_path / "good.CR2", counts, "Canon EOS 550D")
    data = (tmp_path / "good.CR2").read_bytes()
    (tmp_path / "bad.CR2").write_bytes(data[:-4000] + bytes(4000))
    failures: list[object] = []

    def decode(name: str) -> None:
        for _ in range(20):
            found = outcome(tmp_path / name)
            if name == "good.CR2" and not (isinstance(found, Mosaic) and np.array_equal(found.sensor, counts)):
                failures.append(found)

    threads = [threading.Thread(target=decode, args=(name,)) for name in ("good.CR2", "bad.CR2") * 2]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert capfd.readouterr() == ("", "")


def canon_file(serial: int, lens: bytes) -> bytes:
    """Return the directories of a CR2: the first one, Exif with only the maker note, Canon's note."""

    def directory(*entries: tuple[int, int, int, int]) -> bytes:
        rows = b"".join(struct.pack("<HHII", *entry) for entry in entries)
        return struct.pack("<H", len(entries)) + rows + bytes(4)

    first, exif, note = 16, 40, 64
    text = note + len(directory((0, 0, 0, 0), (0, 0, 0, 0)))
    data = b"II*\0" + struct.pack("<I", first) + b"CR\x02\0" + bytes(4)
    data = (data + directory((34665, 4, 1, exif))).ljust(exif, b"\0")
    data = (data + directory((37500, 7, 64, note))).ljust(note, b"\0")
    return data + directory((0x000C, 4, 1, serial), (0x0095, 2, len(lens), text)) + lens


@pytest.mark.slow
def test_reads_canon_maker_note() -> None:
    data = canon_file(330101234, b"EF-S18-55mm f/3.5-5.6 IS\0")
    assert read_serial_and_lens(data, read_directories(data)) == ("330101234", "EF-S18-55mm f/3.5-5.6 IS")


SIDE = 128
FILES = maker_files()
WHERE = Path("frame.raw")

T = TiffTag


def frame() -> NDArray[np.uint16]:
    return np.random.default_rng(1).integers(60, 4000, (SIDE, 2 * SIDE)).astype(np.uint16)


# Whole files


@pytest.mark.parametrize("name", FILES)
def test_reads_complete_files_and_refuses_truncated_ones(name: str) -> None:
    data, counts = FILES[name]
    np.testing.assert_array_equal(decode_raw(data, WHERE).sensor, counts)
    for length in (0, 7, 12, 40, 200, len(data) // 2, len(data) - 40, len(data) - 1):
        # The last byte of a lossless JPEG belongs to its end marker.
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


# Pixel tags of real cameras, from the tag lists of drewnoakes/metadata-extractor-images. Invented: first positions
# of the strips of the D200 and the tiles of the A7 IV, and the Samsung.
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


@pytest.mark.slow
@pytest.mark.parametrize("model", STATED)
def test_accepts_layouts_of_real_cameras(model: str) -> None:
    maker, pixels = STATED[model]
    # Each tile starts with the header of a lossless JPEG.
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
        ({256: longs(3664), 257: longs(2754), 278: longs(2754)}, "rows of 3664 px"),
        ({257: longs(SIDE + 1)}, "photosites|tiles"),
        ({324: longs(0xFFFFFFFF), 325: longs(9), 322: longs(2 * SIDE), 323: longs(SIDE)}, "the file has|9 bytes"),
        ({324: longs(600, 700), 325: longs(99999, 99999), 322: longs(SIDE), 323: longs(SIDE)}, "the file has|overlap"),
        ({324: longs(600, 900), 325: longs(200)}, "2 offsets and 1 sizes"),
        ({278: longs(16)}, "1 strips or tiles, expected 8"),
        ({258: shorts(0)}, "0 bits"),
        ({339: shorts(3)}, "not integers"),
        ({262: shorts(34892)}, "not from a Bayer sensor: its pixels have all colours"),
        ({277: shorts(2)}, "2 samples"),
        ({50712: shorts(64)}, "linearisation table does not rise"),
        ({50712: shorts(0, 9, 8)}, "linearisation table does not rise"),
        ({322: longs(0), 323: longs(0), 324: longs(600), 325: longs(65536)}, "have 0×0 px"),
    ],
)
def test_refuses_invalid_extents(more: Tags, reason: str) -> None:
    with pytest.raises(FormatError, match=reason):
        decode_raw(dng_bytes(frame(), more), WHERE)


def test_refuses_a_stub_that_points_beyond_its_end() -> None:
    stub = in_maker_tiff("NIKON CORPORATION", "NIKON D3", bytes(12_000), {256: longs(3664), 257: longs(2754)})
    for places in (longs(0xFFFFFFFF), longs(400)):
        with pytest.raises(FormatError):
            decode_raw(stub.replace(longs(len(stub) - 12_000)[2], places[2]), WHERE)


def test_refuses_zeros_of_a_size_known_to_libraw() -> None:
    """LibRaw accepts any file of 786 432 bytes as a frame of an industrial camera."""
    with pytest.raises(FormatError):
        decode_raw(bytes(786_432), WHERE)


def test_unchecked_layout_equals_libraw() -> None:
    data, counts = raf()
    assert not layout_is_known(data[:LAYOUT_START])
    np.testing.assert_array_equal(decode_raw(data, WHERE).sensor, counts)
    for length in (0, 7, 12, 40, 200, 600):
        with pytest.raises(FormatError):
            decode_raw(data[:length], WHERE)


@pytest.mark.parametrize("name", FILES)
def test_recognises_checked_layouts(name: str) -> None:
    assert layout_is_known(FILES[name][0][:LAYOUT_START])


def test_refuses_makers_of_unknown_layout() -> None:
    data = in_maker_tiff("Eastman Kodak", "DC50", bytes(8000), {})
    with pytest.raises(FormatError) as caught:
        decode_raw(data, WHERE)
    assert "copy" not in str(caught.value)


@pytest.mark.parametrize(
    ("compression", "name"), [(8, "Deflate"), (32946, "Deflate"), (9, "VC-5"), (52546, "JPEG XL"), (5, "number 5")]
)
def test_reports_unsupported_compression(compression: int, name: str) -> None:
    with pytest.raises(FormatError, match=f"{name}.*supported") as caught:
        decode_raw(dng_bytes(frame(), {259: shorts(compression)}), WHERE)
    assert "copy" not in str(caught.value)


# Pixels


def in_strips(more: Tags, strips: int, pixels: bytes) -> bytes:
    """Return a DNG with contiguous strips."""
    tags: Tags = {**more, 278: longs(SIDE // strips), 279: longs(*(len(pixels) // strips,) * strips)}
    start = len(dng_bytes(frame(), {**tags, 273: longs(*(0,) * strips)}, pixels, place=None)) - len(pixels)
    places = longs(*(start + number * (len(pixels) // strips) for number in range(strips)))
    return dng_bytes(frame(), {**tags, 273: places}, pixels, place=None)


def test_reads_contiguous_strips_and_refuses_others() -> None:
    pixels = frame().astype("<u2").tobytes()
    data = in_strips({}, 4, pixels)
    np.testing.assert_array_equal(decode_raw(data, WHERE).sensor, frame())
    first = struct.pack("<I", len(data) - len(pixels))
    with pytest.raises(FormatError):
        decode_raw(data.replace(first, struct.pack("<I", 8), 1), WHERE)


def test_refuses_lossless_jpeg_in_strips() -> None:
    """LibRaw treats the first strip as all data, and leaves the other rows at zero."""
    strip = lossless_jpeg(frame()[: SIDE // 2])
    data = in_strips({259: shorts(7), 258: shorts(14)}, 2, strip * 2)
    with pytest.raises(FormatError):
        decode_raw(data, WHERE)


def test_refuses_a_jpeg_of_another_size() -> None:
    strip = lossless_jpeg(frame()[:-2])
    with pytest.raises(FormatError, match="not a JPEG of 128 rows"):
        decode_raw(dng_bytes(frame(), {259: shorts(7), 258: shorts(14)}, strip), WHERE)


def test_refuses_invalid_pentax_codes(capfd: pytest.CaptureFixture[str]) -> None:
    """Pentax uses Huffman codes; noise decodes to samples above their precision."""
    noise = np.random.default_rng(5).bytes(48 * 80 * 8)
    data = in_maker_tiff("PENTAX", "PENTAX K-1", noise, {258: shorts(14), 259: shorts(65535)})
    with pytest.raises(FormatError, match="LibRaw reports 'Data error"):
        decode_raw(data, WHERE)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("hole", [np.s_[100:101], np.s_[64:96, :256], np.s_[100:]], ids=["row", "tile", "end"])
@pytest.mark.parametrize(
    ("black", "filling", "reason"),
    [(64, 0, "half of its black level"), (0, 0, "do not reach one count"), (64, 65535, "only the count 65535")],
)
def test_detects_padded_parts_of_a_frame(
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


def test_accepts_dark_and_saturated_frames() -> None:
    dark = np.random.default_rng(2).normal(64, 8, (SIDE, 2 * SIDE)).clip(0).astype(np.uint16)
    dark[:, 7] = 0  # a dead column
    assert filled_fault(dark, np.full((2, 2), 64.0), 4095) is None
    assert filled_fault(np.full_like(dark, 32), np.full((2, 2), 64.0), 4095) is None, (
        "half of the black level is accepted"
    )
    assert filled_fault(np.full_like(dark, 31), np.full((2, 2), 64.0), 4095) is not None
    # Some bodies subtract black, and half of the noise.
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
        ({50714: (5, 1, struct.pack("<II", 64, 0))}, "denominator 0"),
    ],
)
def test_refuses_impossible_levels(levels: Tags, reason: str, more: Tags, strip: bytes | None) -> None:
    stored: Tags = {} if strip is None else {259: shorts(7), 258: shorts(14)}
    with pytest.raises(FormatError, match=reason):
        decode_raw(dng_bytes(frame(), {**stored, **more, **levels}, strip), WHERE)


def test_white_level_fits_the_bits() -> None:
    twelve = {258: shorts(12), 279: longs(SIDE * SIDE * 3)}
    pixels = bytes(SIDE * SIDE * 3)
    assert decode_raw(dng_bytes(frame(), {**twelve, 50717: longs(4096)}, pixels), WHERE).white_level == 4096
    tones = {50712: shorts(*range(0, 65536, 16)), 50717: longs(65535)}
    assert decode_raw(dng_bytes(frame(), {**twelve, **tones}, pixels), WHERE).white_level == 65535
    with pytest.raises(FormatError, match=r"1 to 4096.*12 bits"):
        decode_raw(dng_bytes(frame(), {**twelve, 50717: longs(16383)}, pixels), WHERE)


with zipfile.ZipFile(shipped("raw/found.zip")) as _kept:
    FOUND = {name: _kept.read(name) for name in _kept.namelist()}


@pytest.mark.parametrize("name", FOUND)
def test_refuses_files_of_earlier_searches(name: str) -> None:
    """Refused by reading, or by the later check for padded parts."""
    try:
        mosaic = decode_raw(FOUND[name], Path(name))
    except FormatError:
        return
    assert filled_fault(mosaic.counts, mosaic.black, mosaic.white_level) is not None


@pytest.mark.slow
def test_fuzz_search_runs() -> None:
    tally = Counter[str]()
    assert list(run(seeds(None), 5, range(100), tally)) == []
    assert tally.total() == 100
    assert {outcome.rpartition(": ")[2] for outcome in tally} == {"accepted", "refused"}
