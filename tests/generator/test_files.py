"""Image files: round trips, other programs as readers, and previews."""

from __future__ import annotations

import io
import json
import shutil
import struct
import subprocess
import sys
import zlib
from bisect import bisect_left
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813
import pytest
import rawpy
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from drivers.raw.rawfile import camera_matrix, decode_raw
from foundation.errors import FormatError, InputError
from generator import files
from generator.deflate import code_lengths, codes_of
from generator.files import (
    FORMATS,
    Format,
    ImageMetadata,
    decode_image,
    decode_png,
    decode_tiff,
    encode_dng,
    encode_exr,
    encode_image,
    encode_map,
    encode_preview,
    encode_tiff,
    fit_flash,
    flash,
    libraries_of,
    preview_of,
    require_plausible,
    suffix_of,
)
from tests.pinned import Pinned

METADATA = ImageMetadata(white_level=11536, white=(2046.0, 1579.5, 4520.0), camera="Canon EOS 550D")

# Formats with all three channels of each pixel.
FULL_COLOUR: tuple[Format, ...] = ("png", "tiff", "exr", "jxl")

Image16 = npt.NDArray[np.uint16]

images = hnp.arrays(
    np.uint16,
    st.tuples(st.integers(1, 9), st.integers(1, 40), st.just(3)),
    elements=st.integers(0, 65535) | st.integers(0, 3),
    fill=st.integers(0, 65535),
)


def noisy(height: int, width: int) -> Image16:
    """Return an image with shot noise on a gradient, and extreme values."""
    rng = np.random.default_rng(0)
    means = np.linspace(20, 12000, height * width * 3).reshape(height, width, 3)
    image = rng.poisson(means).astype(np.uint16)
    image[0, 0] = (65535, 1, 256)
    return image


def by_openimageio(path: Path) -> Image16:
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None, oiio.geterror()
    values = np.asarray(stream.read_image("float" if path.suffix == ".exr" else "uint16"))
    return values.astype(np.uint16)


@pytest.mark.parametrize("form", FULL_COLOUR)
def test_round_trip_of_every_format(tmp_path: Path, form: Format) -> None:
    image = noisy(31, 45)
    path = tmp_path / f"image{suffix_of(form)}"
    path.write_bytes(encode_image(image, form, METADATA))
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    assert str(stream.spec().format) == ("float" if form == "exr" else "uint16")
    np.testing.assert_array_equal(by_openimageio(path), image)
    np.testing.assert_array_equal(decode_image(path.read_bytes(), form, "image"), image)


@pytest.mark.parametrize("form", ["png", "tiff"])
def test_opencv_reads_files(form: Format) -> None:
    image = noisy(31, 45)
    data = np.frombuffer(encode_image(image, form, METADATA), np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert read is not None
    np.testing.assert_array_equal(read[..., ::-1], image)


@pytest.mark.slow
@pytest.mark.parametrize("form", FULL_COLOUR)
@settings(max_examples=25)
@given(image=images)
def test_round_trip_of_any_image(form: Format, image: Image16) -> None:
    np.testing.assert_array_equal(decode_image(encode_image(image, form, METADATA), form, "image"), image)


@pytest.mark.parametrize("form", FORMATS)
def test_accepts_noncontiguous_image(form: Format) -> None:
    image = noisy(48, 60)
    turned = image[::-1, ::-1]
    assert encode_image(turned, form, METADATA) == encode_image(turned.copy(), form, METADATA)


def chunks_of(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return name and content of the chunks of a PNG (ISO/IEC 15948, 5.3), and check their CRC."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks: list[tuple[bytes, bytes]] = []
    offset = 8
    while offset < len(data):
        (size,) = struct.unpack_from(">I", data, offset)
        body = data[offset + 4 : offset + 8 + size]
        assert struct.unpack_from(">I", data, offset + 8 + size) == (zlib.crc32(body),)
        chunks.append((body[:4], body[4:]))
        offset += 12 + size
    return chunks


def repeating_maps(count: int) -> list[Image16]:
    """Return maps with constant differences between rows, different in each map."""
    first = np.random.default_rng(0).integers(0, 256, (count, 1, 8), np.uint8)
    rows = np.arange(1, 13, dtype=np.uint8)[:, None] * first
    return list(rows.view(">u2").astype(np.uint16))


def exr_of(values: Image16) -> bytes:
    return encode_exr(np.stack([values] * 3, axis=-1), METADATA)


@pytest.mark.parametrize("encoded", [encode_map, exr_of])
def test_isal_gives_equal_bytes_in_every_thread(encoded: Callable[[Image16], bytes]) -> None:
    # A value left in a register by the thread changed the matches of one map in 400.
    maps = repeating_maps(4000)

    def encode_all() -> list[bytes]:
        return [encoded(values) for values in maps]

    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(encode_all).result() == encode_all()


def test_png_is_16_bit_rgb_with_metadata() -> None:
    chunks = chunks_of(encode_image(noisy(20, 30), "png", METADATA))
    assert [name for name, _ in chunks] == [b"IHDR", b"tEXt", b"IDAT", b"IEND"]
    # 11.2.2: width, height, bit depth, colour type, compression, filter and interlace methods.
    assert struct.unpack(">IIBBBBB", chunks[0][1]) == (30, 20, 16, 2, 0, 0, 0)
    keyword, _, note = chunks[1][1].partition(b"\0")
    assert keyword == b"Description"
    values = json.loads(note)
    assert (values["white_level"], values["white"], values["camera"]) == (
        11536,
        [2046.0, 1579.5, 4520.0],
        "Canon EOS 550D",
    )
    assert len(zlib.decompress(chunks[2][1])) == 20 * (1 + 6 * 30)


def test_pillow_reads_upper_bytes() -> None:
    """Pillow has no 16-bit RGB; it must not apply a profile or gamma."""
    image = noisy(20, 30)
    with Image.open(io.BytesIO(encode_image(image, "png", METADATA))) as read:
        assert read.size == (30, 20)
        assert "gamma" not in read.info
        np.testing.assert_array_equal(np.asarray(read.convert("RGB")), image >> 8)


def test_tiff_tags() -> None:
    image = noisy(4, 5)
    with tifffile.TiffFile(io.BytesIO(encode_image(image, "tiff", METADATA))) as file:
        tags = {tag.code: tag.value for tag in file.pages.first.tags}
        np.testing.assert_array_equal(file.asarray(), image)
    assert json.loads(tags.pop(270))["white_level"] == 11536
    (start,) = tags.pop(273)
    assert start % 16 == 0
    # TIFF 6.0, sections 6 and 8: RGB of 16 bits in one strip, uncompressed, pixel by pixel, unsigned.
    assert tags == {
        254: 0, 256: 5, 257: 4, 258: (16, 16, 16), 259: 1, 262: 2, 277: 3, 278: 4, 279: (120,), 284: 1, 339: (1, 1, 1)
    }  # fmt: skip


def test_exr_header() -> None:
    """By "OpenEXR File Layout": magic number, version, and attributes with name, type, size and value."""
    data = encode_image(noisy(40, 30), "exr", METADATA)
    assert data[:8] == bytes.fromhex("762f3101 02000000")
    attributes: dict[bytes, tuple[bytes, bytes]] = {}
    offset = 8
    while data[offset]:
        name, type_name, _ = data[offset : offset + 200].split(b"\0", 2)
        offset += len(name) + len(type_name) + 2
        (size,) = struct.unpack_from("<i", data, offset)
        attributes[name] = type_name, data[offset + 4 : offset + 4 + size]
        offset += 4 + size
    float_channel = struct.pack("<iB3xii", 2, 0, 1, 1)
    window = struct.pack("<4i", 0, 0, 29, 39)
    assert attributes == {
        b"channels": (b"chlist", b"".join(name + b"\0" + float_channel for name in (b"B", b"G", b"R")) + b"\0"),
        b"compression": (b"compression", bytes([3])),
        b"dataWindow": (b"box2i", window),
        b"displayWindow": (b"box2i", window),
        b"lineOrder": (b"lineOrder", bytes([0])),
        b"pixelAspectRatio": (b"float", struct.pack("<f", 1)),
        b"screenWindowCenter": (b"v2f", struct.pack("<2f", 0, 0)),
        b"screenWindowWidth": (b"float", struct.pack("<f", 1)),
        b"crop:camera": (b"string", b"Canon EOS 550D"),
        b"crop:white": (b"v3f", struct.pack("<3f", 2046, 1579.5, 4520)),
        b"crop:white_level": (b"int", struct.pack("<i", 11536)),
    }
    # Three chunks of 16, 16 and 8 lines at the listed offsets.
    offsets = [*struct.unpack_from("<3Q", data, offset + 1), len(data)]
    assert offsets[0] == offset + 1 + 3 * 8
    for start, stop, line in zip(offsets, offsets[1:], (0, 16, 32), strict=False):
        assert struct.unpack_from("<2i", data, start) == (line, stop - start - 8)


def test_jpeg_xl_is_lossless() -> None:
    image = noisy(20, 30)
    data = encode_image(image, "jxl", METADATA)
    # ISO/IEC 18181-2, 5: the signature box. Lossless 16 bits need level 10, which only a container declares.
    assert data[:12] == bytes.fromhex("0000000c 4a584c20 0d0a870a")
    np.testing.assert_array_equal(imagecodecs.jpegxl_decode(data), image)


@pytest.mark.parametrize(("form", "width", "height"), [("tiff", 30000, 24000), ("dng", 60000, 36000)])
def test_refuses_images_above_4_gib(form: Format, width: int, height: int) -> None:
    # A broadcast value: an image of 4 GiB without memory.
    image = np.broadcast_to(np.uint16(7), (height, width, 3))
    with pytest.raises(InputError, match=rf"an image of {width}x{height} px is too large for {form.upper()}: .* 4 GiB"):
        encode_image(image, form, METADATA)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("keep", [0, 10, 1000])
def test_refuses_damaged_files(form: Format, keep: int) -> None:
    data = encode_image(noisy(40, 40), form, METADATA)
    with pytest.raises(FormatError, match=r"images/000007"):
        decode_image(data[:keep], form, "images/000007")


def test_accepts_png_sizes_possible_with_deflate() -> None:
    """70 bytes unpack to at most 1032 times as many: 10 320 rows of one 16-bit pixel and a filter byte."""

    def png_head(height: int, depth: int = 16) -> bytes:
        head = struct.pack(">I4sIIBB", 13, b"IHDR", 1, height, depth, 2)
        return (b"\x89PNG\r\n\x1a\n" + head).ljust(70, b"\0")

    require_plausible(png_head(10_320), "it")
    require_plausible(png_head(18_060, depth=8), "it")
    for data in (png_head(10_321), png_head(18_061, depth=8)):
        with pytest.raises(FormatError):
            require_plausible(data, "it")


def test_refuses_8_bit_file() -> None:
    data = cv2.imencode(".png", np.zeros((4, 5, 3), np.uint8))[1].tobytes()
    with pytest.raises(FormatError, match=r"a\.png is uint8 \(4, 5, 3\).*uint16"):
        decode_image(data, "png", "a.png")


def test_listed_libraries_are_installed() -> None:
    from importlib.metadata import version

    for form in FORMATS:
        for library in libraries_of(form):
            assert version(library)


def test_preview_is_jpeg_of_right_colour(tmp_path: Path) -> None:
    path = tmp_path / "preview.jpg"
    path.write_bytes(encode_preview(np.full((16, 16, 3), (200, 100, 50), np.uint8)))
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    assert stream.format_name() == "jpeg"
    assert np.abs(np.asarray(stream.read_image("uint8")).reshape(-1, 3) - [200.0, 100, 50]).max() <= 3


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_reads_any_tiff_or_refuses_it(dtype: type[np.generic], planes: bool, compression: str | None) -> None:
    image = noisy(30, 40).astype(dtype)
    stream = io.BytesIO()
    stored, config = (image.transpose(2, 0, 1), "separate") if planes else (image, "contig")
    tifffile.imwrite(stream, stored, photometric="rgb", planarconfig=config, compression=compression)
    decoded = decode_tiff(stream.getvalue())
    assert decoded.dtype == image.dtype
    np.testing.assert_array_equal(decoded, image)
    with pytest.raises(Exception):  # noqa: B017, PT011  # any error of the reader
        decode_tiff(stream.getvalue()[: stream.tell() // 2])


@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_reads_full_picture_of_tiff(byte_order: Literal["<", ">"]) -> None:
    # TIFF 6.0, NewSubfileType: a reduced picture may be first, and the full one in a SubIFD.
    image = noisy(30, 40)
    for subfiles in (0, 1):
        stream = io.BytesIO()
        with tifffile.TiffWriter(stream, byteorder=byte_order) as writer:
            writer.write(image[::4, ::4], photometric="rgb", subfiletype=1, subifds=subfiles)
            writer.write(image, photometric="rgb")
        np.testing.assert_array_equal(decode_tiff(stream.getvalue()), image)


@pytest.mark.parametrize(("compression", "predictor"), [("lzw", 2), ("zlib", 2), ("zlib", 3), ("packbits", None)])
def test_reads_compressed_tiff_without_extra_library(
    monkeypatch: pytest.MonkeyPatch, compression: str, predictor: int | None
) -> None:
    image = noisy(30, 40).astype(np.float32) if predictor == 3 else noisy(30, 40)
    stream = io.BytesIO()
    tifffile.imwrite(stream, image, photometric="rgb", compression=compression, predictor=predictor)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    np.testing.assert_array_equal(decode_tiff(stream.getvalue()), image)


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_reads_any_png_or_refuses_it(channels: int, dtype: type[np.unsignedinteger]) -> None:
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (20, 31, channels), dtype=dtype)
    image = image[..., 0] if channels == 1 else image
    data = bytes(imagecodecs.png_encode(image))
    np.testing.assert_array_equal(decode_png(data), image)
    for damaged in (data[: len(data) // 2], data[:-20], data[:60] + b"\x99" + data[61:], b"", b"GIF89a"):
        with pytest.raises(ValueError, match="not a complete PNG"):
            decode_png(damaged)


def test_jpeg_xl_reports_missing_library(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode_image(noisy(4, 5), "jxl", METADATA)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    for attempt in (
        lambda: libraries_of("jxl"),
        lambda: encode_image(noisy(4, 5), "jxl", METADATA),
        lambda: decode_image(data, "jxl", "image.jxl"),
    ):
        with pytest.raises(InputError, match="pip install imagecodecs"):
            attempt()


WHITES = {
    "candle": (1945.3, 492.3, 105.1),
    "blue projector": (103.0, 1092.0, 4418.0),
    "green": (1064.0, 5498.0, 839.0),
    "daylight": (2804.0, 6411.0, 5254.0),
}

CAMERAS = ("Canon EOS 550D", "Canon EOS 6D Mark II", "Benchmark", "Ένας")


def grey_scene(white: tuple[float, float, float]) -> npt.NDArray[np.uint16]:
    """Return a grey ramp up to 90 % reflectance under an illuminant, with shot noise."""
    reflectance = np.linspace(0.15, 0.9, 96)[None, :, None]
    return np.random.default_rng(3).poisson(np.full((64, 1, 1), 1.0) * reflectance * white).astype(np.uint16)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("light", WHITES)
def test_libraw_develops_neutral_greys(light: str, camera: str) -> None:
    white = WHITES[light]
    # Saturation is so far above the ground truth that LibRaw clips no channel after balancing.
    metadata = ImageMetadata(white_level=12000, white=white, camera=camera)
    with rawpy.imread(io.BytesIO(encode_image(grey_scene(white), "dng", metadata))) as raw:
        developed = raw.postprocess(
            use_camera_wb=True, output_bps=16, no_auto_bright=True, gamma=(1, 1), highlight_mode=rawpy.HighlightMode(1)
        )
    means = developed[8:-8, 8:-8].reshape(-1, 3).mean(axis=0, dtype=np.float64)
    # The mean of 3800 pixels of the darkest channel (55 DN) has an error of 0.3 %; six times this is allowed.
    np.testing.assert_allclose(means / means[1], 1, atol=0.02)


def test_wrong_balance_is_not_neutral() -> None:
    """Check that the test above can fail, with the balance of another illuminant."""
    metadata = ImageMetadata(white_level=12000, white=WHITES["daylight"], camera="Canon EOS 550D")
    with rawpy.imread(io.BytesIO(encode_image(grey_scene(WHITES["candle"]), "dng", metadata))) as raw:
        developed = raw.postprocess(use_camera_wb=True, output_bps=16, no_auto_bright=True, gamma=(1, 1))
    means = developed.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    assert abs(means[0] / means[1] - 1) > 0.5


@pytest.mark.slow
@settings(max_examples=40)
@given(height=st.integers(22, 41), width=st.integers(22, 41), seed=st.integers(0, 99))
def test_photosites_take_channels_of_their_pixels(height: int, width: int, seed: int) -> None:
    image = np.random.default_rng(seed).integers(0, 65536, (height, width, 3)).astype(np.uint16)
    data = encode_image(image, "dng", ImageMetadata(65535, (1.0, 1.0, 1.0), "Canon EOS 550D"))
    mosaic = decode_raw(data, Path("image.dng"))
    assert (mosaic.pattern, mosaic.white_level, mosaic.black.tolist()) == ("RGGB", 65535, [[0, 0], [0, 0]])
    rows, columns = np.indices((height, width)) % 2
    np.testing.assert_array_equal(mosaic.counts, np.take_along_axis(image, (rows + columns)[..., None], 2)[..., 0])
    blocks = mosaic.counts[: height // 2 * 2, : width // 2 * 2].reshape(height // 2, 2, width // 2, 2)
    half = decode_image(data, "dng", "image.dng")
    np.testing.assert_array_equal(half[..., 0], blocks[:, 0, :, 0])
    np.testing.assert_array_equal(half[..., 1], np.ceil((blocks[:, 0, :, 1] + 0.0 + blocks[:, 1, :, 0]) / 2))
    np.testing.assert_array_equal(half[..., 2], blocks[:, 1, :, 1])


def test_dcraw_reads_counts_and_balance(tmp_path: Path) -> None:
    dcraw = shutil.which("dcraw")
    if dcraw is None:
        pytest.skip("dcraw is not installed")
    white = WHITES["candle"]
    image = grey_scene(white)
    path = tmp_path / "image.dng"
    path.write_bytes(encode_image(image, "dng", ImageMetadata(12000, white, "Canon EOS 550D")))
    subprocess.run([dcraw, "-D", "-4", "-T", str(path)], check=True, timeout=60)
    counts = decode_raw(path.read_bytes(), path).counts
    np.testing.assert_array_equal(tifffile.imread(path.with_suffix(".tiff")), counts)
    subprocess.run([dcraw, "-w", "-4", "-H", "1", "-T", str(path)], check=True, timeout=60)
    means = tifffile.imread(path.with_suffix(".tiff"))[8:-8, 8:-8].reshape(-1, 3).mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(means / means[1], 1, atol=0.02)


def test_dng_tags() -> None:
    image = np.zeros((30, 40, 3), np.uint16)
    metadata = ImageMetadata(11536, (500.0, 2000.0, 1000.0), "Canon EOS 550D")
    with tifffile.TiffFile(io.BytesIO(encode_image(image, "dng", metadata))) as file:
        tags = {tag.code: tag.value for tag in file.pages.first.tags}
    (start,) = tags.pop(273)
    assert tags.pop(279) == (30 * 40 * 2,)
    assert start % 16 == 0
    assert json.loads(tags.pop(270))["white"] == [500, 2000, 1000]
    neutral = np.array(tags.pop(50728), dtype=float).reshape(3, 2)
    np.testing.assert_allclose(neutral[:, 0] / neutral[:, 1], [0.25, 1, 0.5])
    matrix = np.array(tags.pop(50721), dtype=float).reshape(3, 3, 2)
    published = camera_matrix("Canon EOS 550D")
    assert published is not None
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], published, atol=5e-5)
    # TIFF 6.0, sections 8 and 4: one uncompressed image, interleaved. TIFF/EP: blocks of RGGB. DNG 1.7.1, chapter 4:
    # version 1.4, readable from 1.1 on, planes red, green and blue, sites in rows, daylight.
    assert tags == {
        254: 0, 256: 40, 257: 30, 258: 16, 259: 1, 262: 32803, 274: 1, 277: 1, 278: 30, 284: 1,
        271: "CroP", 272: "Canon EOS 550D generated", 50708: "CroP Canon EOS 550D generated",
        33421: (2, 2), 33422: bytes([0, 1, 1, 2]), 50706: bytes([1, 4, 0, 0]), 50707: bytes([1, 1, 0, 0]),
        50710: bytes([0, 1, 2]), 50711: 1, 50714: 0, 50717: 11536, 50778: 21,
    }  # fmt: skip


def test_srgb_matrix_is_inverse_of_standard() -> None:
    # From IEC 61966-2-1, which has both matrices with four decimals.
    inverse = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    np.testing.assert_allclose(np.array(files._SRGB) @ inverse, np.eye(3), atol=3e-4)


def test_flash_of_two_pixels() -> None:
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
def test_flash_inverse(image: np.ndarray, a: float, gamma: float) -> None:
    operator = fit_flash(image, a, gamma)
    np.testing.assert_allclose(operator.invert(operator.apply(image)), image, rtol=1e-6)


def test_flash_does_not_depend_on_scale() -> None:
    image = np.random.default_rng(0).uniform(0.01, 1, (9, 9, 3))
    np.testing.assert_allclose(fit_flash(image).apply(image), fit_flash(image / 50).apply(image / 50))


def test_8_bit_codes_lose_little() -> None:
    image = np.random.default_rng(0).uniform(0.02, 1, (50, 50, 3))
    operator = fit_flash(image)
    back = operator.invert(np.rint(operator.apply(image)))
    assert np.median(np.abs(back / image - 1)) < 0.02


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_single_precision_changes_codes_by_at_most_one(gamma: float) -> None:
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
def test_preview_equals_flash(image: npt.NDArray[np.uint16], white_level: int) -> None:
    linear = image / white_level
    exact = np.clip(fit_flash(linear).apply(linear), 0, 255)
    assert np.abs(preview_of(image, white_level) - exact).max() <= 0.5 + 1e-4


@given(
    hnp.arrays(np.uint16, st.tuples(st.integers(1, 12), st.integers(1, 12), st.just(3))),
    st.integers(1, 12),
)
def test_preview_pixels_are_means(image: npt.NDArray[np.uint16], side: int) -> None:
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
def test_2x2_means_are_rounded_like_others(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(5).integers(0, 65536, shape, dtype=np.uint16)
    rows, columns = np.arange(0, shape[0], 2), np.arange(0, shape[1], 2)
    sums, pixels = image.astype(np.int64), np.ones(shape, np.int64)
    for axis, starts in enumerate((rows, columns)):
        sums, pixels = np.add.reduceat(sums, starts, axis), np.add.reduceat(pixels, starts, axis)
    rounded = ((2 * sums + pixels) // (2 * pixels)).astype(np.uint16)
    np.testing.assert_array_equal(preview_of(image, 65535, 45), preview_of(rounded, 65535, 45))


LUT_METADATA = ImageMetadata(white_level=4600, white=(4000.0, 2520.0, 840.5), camera="Known camera")

CAMERA_METADATA = ImageMetadata(white_level=11536, white=(2046.0, 1579.5, 4520.0), camera="Canon EOS 550D")


def named_images() -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield images with runs of every length, repeats near the end of the window, and unusual sizes."""
    rng = np.random.default_rng(8)
    few = rng.integers(0, 4000, (9, 3))
    for height, width in ((1, 1), (1, 2), (2, 1), (3, 7), (1, 300), (300, 1)):
        yield f"noise {height}x{width}", rng.integers(0, 65536, (height, width, 3))
    runs = np.repeat(few[np.arange(90) % 9], np.arange(90), axis=0)
    yield "runs", runs[: 89 * 45].reshape(45, 89, 3)
    yield "one colour", np.full((40, 50, 3), 1234)
    yield "black", np.zeros((30, 30, 3))
    for shift in (-1, 0, 1):
        # Noise that repeats just within, at and just beyond 32768 bytes: 60 rows of 91 pixels and one byte.
        noise = rng.integers(0, 5000, (60, 91 + shift, 3))
        yield f"repeats {shift}", np.concatenate([noise, noise, noise])
    yield "a few colours", few[rng.integers(0, 9, (64, 64))]
    yield "many rows of few colours", few[rng.geometric(0.4, (200, 60)) % 9]
    yield "25 of each of 64", rng.integers(0, 4000, (1600, 3))[rng.integers(0, 1600, (80, 120))]
    yield "rare bytes", np.where(rng.random((90, 90, 1)) < 0.001, rng.integers(0, 65536, (90, 90, 3)), few[:1])
    ramp = np.arange(90 * 70).reshape(90, 70, 1) * np.array([1, 3, 7])
    yield "a ramp", ramp % 65536
    index = np.arange(640 * 480).reshape(640, 480, 1)
    # Enough symbols that only one row in eight is counted.
    yield "samples of cells", (index * index // 97 % 40) * [31, 97, 55] + (index * 2654435761 >> 7) % 25 * [3, 10, 6]
    yield "a noisy ramp", ramp // 8 + rng.poisson(20, (90, 70, 3))


@pytest.mark.slow
def test_pinned_files(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    results: dict[str, Any] = {}
    for name, numbers in named_images():
        image = numbers.astype(np.uint16)
        results[name] = [
            encode_image(image, "png", LUT_METADATA),
            encode_tiff(image, LUT_METADATA),
            encode_exr(image, LUT_METADATA)[:340],
        ]
        # Maps are packed by a library with different versions, so only their size is pinned.
        results[name].append(len(encode_map(image[..., 1])) < 100 + image.nbytes)
        if min(image.shape[:2]) >= 22:
            results[name] += [encode_dng(image, LUT_METADATA), encode_dng(image, CAMERA_METADATA)]
        # In bands of several rows, the last one shorter.
        with monkeypatch.context() as changed:
            changed.setattr(files, "BAND", 7 * image.shape[1] + 3)
            results[name].append(encode_image(image, "png", CAMERA_METADATA))
    pinned("bytes of images' files", results)


@pytest.mark.slow
def test_pinned_codes(pinned: Pinned) -> None:
    rng = np.random.default_rng(9)
    results: list[Any] = []
    frequencies: list[npt.NDArray[np.int64]] = [np.array([0, 0, 5]), np.array([0, 3, 3]), np.zeros(4, np.int64)]
    frequencies += [rng.geometric(probability, 60) * (rng.random(60) < 0.7) for probability in (0.01, 0.2, 0.9)]
    frequencies += [2 ** np.arange(25), np.array([1, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])]
    for counts in frequencies:
        for longest in (7, 12, 15):
            lengths = code_lengths(counts, longest)
            results.append([lengths, codes_of(lengths)])
    pinned("codes of frequencies", results)


@pytest.mark.slow
def test_pinned_limits_of_png_sizes(pinned: Pinned) -> None:
    """Largest number of rows that a file of 200 bytes may declare, by depth and colour type, and chunk sizes."""

    def is_plausible(data: bytes) -> bool:
        try:
            require_plausible(data, "it")
        except FormatError:
            return False
        return True

    def head(rows: int, depth: int, colour: int, size: int = 13) -> bytes:
        return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", size, b"IHDR", 61, rows, depth, colour) + bytes(7)

    results: dict[str, Any] = {}
    for depth in (1, 8, 16):
        for colour in range(8):
            rows = range(1 << 20)
            results[f"{depth} {colour}"] = bisect_left(
                rows,
                True,
                key=lambda row_count, d=depth, c=colour: not is_plausible(head(row_count, d, c) + bytes(167)),
            )
    heads = [head(1, 8, 2)[:length] + struct.pack(">I", size) + bytes(8) for length in (32, 33) for size in range(4)]
    heads += [head(1, 8, 2, size) for size in (12, 13, 14)] + [head(1, 8, 2)[:length] for length in (7, 25, 26, 32)]
    results["parts"] = [is_plausible(probability) for probability in heads]
    pinned("what a head may claim", results)
