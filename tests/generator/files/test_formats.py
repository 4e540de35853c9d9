"""Files read back by other readers than the one that wrote them, and looked into by parsers of their standards."""

from __future__ import annotations

import io
import json
import struct
import sys
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from foundation.errors import FormatError, InputError
from generator.files import (
    FORMATS,
    Format,
    ImageMetadata,
    decode_image,
    decode_png,
    decode_tiff,
    encode_exr,
    encode_image,
    encode_map,
    encode_preview,
    libraries_of,
    require_plausible,
    suffix_of,
)

METADATA = ImageMetadata(white_level=11536, white=(2046.0, 1579.5, 4520.0), camera="Canon EOS 550D")
WHOLE: tuple[Format, ...] = ("png", "tiff", "exr", "jxl")
"""The formats that keep all three channels."""

Image16 = npt.NDArray[np.uint16]
images = hnp.arrays(
    np.uint16,
    st.tuples(st.integers(1, 9), st.integers(1, 40), st.just(3)),
    elements=st.integers(0, 65535) | st.integers(0, 3),
    fill=st.integers(0, 65535),
)


def noisy(height: int, width: int) -> Image16:
    """Return an image with shot noise on a gradient, and the extreme numbers."""
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


@pytest.mark.parametrize("form", WHOLE)
def test_every_bit_comes_back_in_place(tmp_path: Path, form: Format) -> None:
    image = noisy(31, 45)
    path = tmp_path / f"image{suffix_of(form)}"
    path.write_bytes(encode_image(image, form, METADATA))
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    assert str(stream.spec().format) == ("float" if form == "exr" else "uint16")
    np.testing.assert_array_equal(by_openimageio(path), image)
    np.testing.assert_array_equal(decode_image(path.read_bytes(), form, "image"), image)


@pytest.mark.parametrize("form", ["png", "tiff"])
def test_opencv_reads_the_same(form: Format) -> None:
    image = noisy(31, 45)
    data = np.frombuffer(encode_image(image, form, METADATA), np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    assert read is not None
    np.testing.assert_array_equal(read[..., ::-1], image)


@pytest.mark.slow
@pytest.mark.parametrize("form", WHOLE)
@settings(max_examples=25)
@given(image=images)
def test_any_image_comes_back(form: Format, image: Image16) -> None:
    np.testing.assert_array_equal(decode_image(encode_image(image, form, METADATA), form, "image"), image)


@pytest.mark.parametrize("form", FORMATS)
def test_an_image_need_not_be_contiguous(form: Format) -> None:
    image = noisy(48, 60)
    turned = image[::-1, ::-1]
    assert encode_image(turned, form, METADATA) == encode_image(turned.copy(), form, METADATA)


def chunks_of(data: bytes) -> list[tuple[bytes, bytes]]:
    """Return name and content of a PNG's chunks (ISO/IEC 15948, 5.3), each with its sum checked by zlib."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks: list[tuple[bytes, bytes]] = []
    at = 8
    while at < len(data):
        (size,) = struct.unpack_from(">I", data, at)
        body = data[at + 4 : at + 8 + size]
        assert struct.unpack_from(">I", data, at + 8 + size) == (zlib.crc32(body),)
        chunks.append((body[:4], body[4:]))
        at += 12 + size
    return chunks


def repeating_maps(count: int) -> list[Image16]:
    """Return maps whose rows are the same bytes once the row above is subtracted, other bytes in each map."""
    first = np.random.default_rng(0).integers(0, 256, (count, 1, 8), np.uint8)
    rows = np.arange(1, 13, dtype=np.uint8)[:, None] * first
    return list(rows.view(">u2").astype(np.uint16))


def exr_of(values: Image16) -> bytes:
    return encode_exr(np.stack([values] * 3, axis=-1), METADATA)


@pytest.mark.parametrize("encoded", [encode_map, exr_of])
def test_what_isal_packs_is_the_same_bytes_in_every_thread(encoded: Callable[[Image16], bytes]) -> None:
    """What a thread leaves in a register chose matches: one map of 400, and another in every process."""
    maps = repeating_maps(4000)

    def packed() -> list[bytes]:
        return [encoded(values) for values in maps]

    with ThreadPoolExecutor(1) as other:
        assert other.submit(packed).result() == packed()


def test_png_is_sixteen_bit_rgb_and_tells_its_shot() -> None:
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


def test_pillow_shows_the_upper_bytes() -> None:
    """Pillow has no 16-bit RGB; what it shows is the image all the same, not one changed by a profile or gamma."""
    image = noisy(20, 30)
    with Image.open(io.BytesIO(encode_image(image, "png", METADATA))) as read:
        assert read.size == (30, 20)
        assert "gamma" not in read.info
        np.testing.assert_array_equal(np.asarray(read.convert("RGB")), image >> 8)


def test_tiff_is_uncompressed_and_plain() -> None:
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


def test_the_head_of_exr_is_that_of_the_standard() -> None:
    """By "OpenEXR File Layout": magic number, version, attributes that each have a name, a type, a size and a value."""
    data = encode_image(noisy(40, 30), "exr", METADATA)
    assert data[:8] == bytes.fromhex("762f3101 02000000")
    found: dict[bytes, tuple[bytes, bytes]] = {}
    at = 8
    while data[at]:
        name, kind, _ = data[at : at + 200].split(b"\0", 2)
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        found[name] = kind, data[at + 4 : at + 4 + size]
        at += 4 + size
    float_channel = struct.pack("<iB3xii", 2, 0, 1, 1)
    window = struct.pack("<4i", 0, 0, 29, 39)
    assert found == {
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
    # Three chunks of 16, 16 and 8 lines, each where the table of offsets says, the last to the end of the file.
    offsets = [*struct.unpack_from("<3Q", data, at + 1), len(data)]
    assert offsets[0] == at + 1 + 3 * 8
    for start, stop, line in zip(offsets, offsets[1:], (0, 16, 32), strict=False):
        assert struct.unpack_from("<2i", data, start) == (line, stop - start - 8)


def test_jpeg_xl_is_one_lossless_codestream() -> None:
    image = noisy(20, 30)
    data = encode_image(image, "jxl", METADATA)
    # ISO/IEC 18181-2, 5: the signature box; 16-bit lossless wants level 10, which only a container can tell.
    assert data[:12] == bytes.fromhex("0000000c 4a584c20 0d0a870a")
    np.testing.assert_array_equal(imagecodecs.jpegxl_decode(data), image)


@pytest.mark.parametrize(("form", "width", "height"), [("tiff", 30000, 24000), ("dng", 60000, 36000)])
def test_what_a_format_of_32_bit_offsets_cannot_hold_is_refused_unwritten(
    form: Format, width: int, height: int
) -> None:
    # One count seen everywhere: an image of 4 GiB that takes no memory.
    image = np.broadcast_to(np.uint16(7), (height, width, 3))
    with pytest.raises(InputError, match=rf"an image of {width}x{height} px is too large for {form.upper()}: .* 4 GiB"):
        encode_image(image, form, METADATA)


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("keep", [0, 10, 1000])
def test_damaged_files_are_refused_by_name(form: Format, keep: int) -> None:
    data = encode_image(noisy(40, 40), form, METADATA)
    with pytest.raises(FormatError, match=r"images/000007"):
        decode_image(data[:keep], form, "images/000007")


def test_a_png_may_claim_what_deflate_can_make_of_its_bytes() -> None:
    """70 bytes of a file make 1032 times as many at most: 10 320 rows of one pixel of 16 bits and a byte of filter."""

    def claiming(height: int, depth: int = 16) -> bytes:
        head = struct.pack(">I4sIIBB", 13, b"IHDR", 1, height, depth, 2)
        return (b"\x89PNG\r\n\x1a\n" + head).ljust(70, b"\0")

    require_plausible(claiming(10_320), "it")
    require_plausible(claiming(18_060, depth=8), "it")
    for data in (claiming(10_321), claiming(18_061, depth=8)):
        with pytest.raises(FormatError, match="it claims 1x1"):
            require_plausible(data, "it")


def test_a_file_of_eight_bits_is_refused() -> None:
    data = cv2.imencode(".png", np.zeros((4, 5, 3), np.uint8))[1].tobytes()
    with pytest.raises(FormatError, match=r"a\.png holds uint8 \(4, 5, 3\).*uint16"):
        decode_image(data, "png", "a.png")


def test_the_libraries_named_are_installed() -> None:
    from importlib.metadata import version

    for form in FORMATS:
        for library in libraries_of(form):
            assert version(library)


def test_a_preview_is_a_jpeg_of_the_right_colour(tmp_path: Path) -> None:
    path = tmp_path / "preview.jpg"
    path.write_bytes(encode_preview(np.full((16, 16, 3), (200, 100, 50), np.uint8)))
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    assert stream.format_name() == "jpeg"
    assert np.abs(np.asarray(stream.read_image("uint8")).reshape(-1, 3) - [200.0, 100, 50]).max() <= 3


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("planes", [False, True])
@pytest.mark.parametrize("compression", [None, "zlib"])
def test_any_tiff_is_read_as_it_stands_or_not_at_all(
    dtype: type[np.generic], planes: bool, compression: str | None
) -> None:
    image = noisy(30, 40).astype(dtype)
    stream = io.BytesIO()
    stored, config = (image.transpose(2, 0, 1), "separate") if planes else (image, "contig")
    tifffile.imwrite(stream, stored, photometric="rgb", planarconfig=config, compression=compression)
    found = decode_tiff(stream.getvalue())
    assert found.dtype == image.dtype
    np.testing.assert_array_equal(found, image)
    with pytest.raises(Exception):  # noqa: B017, PT011  # whatever the reader says
        decode_tiff(stream.getvalue()[: stream.tell() // 2])


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_any_png_is_read_as_it_stands_or_not_at_all(channels: int, dtype: type[np.unsignedinteger]) -> None:
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, (20, 31, channels), dtype=dtype)
    image = image[..., 0] if channels == 1 else image
    data = bytes(imagecodecs.png_encode(image))
    np.testing.assert_array_equal(decode_png(data), image)
    for damaged in (data[: len(data) // 2], data[:-20], data[:60] + b"\x99" + data[61:], b"", b"GIF89a"):
        with pytest.raises(ValueError, match="no whole PNG"):
            decode_png(damaged)


def test_jpeg_xl_names_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode_image(noisy(4, 5), "jxl", METADATA)
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    for attempt in (
        lambda: libraries_of("jxl"),
        lambda: encode_image(noisy(4, 5), "jxl", METADATA),
        lambda: decode_image(data, "jxl", "image.jxl"),
    ):
        with pytest.raises(InputError, match="pip install imagecodecs"):
            attempt()
