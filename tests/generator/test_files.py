"""Files of images: every format gives back what was written, other programs read it, previews look right."""

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
from typing import Any

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
        with pytest.raises(FormatError):
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


WHITES = {
    "candle": (1945.3, 492.3, 105.1),
    "blue projector": (103.0, 1092.0, 4418.0),
    "green": (1064.0, 5498.0, 839.0),
    "daylight": (2804.0, 6411.0, 5254.0),
}

CAMERAS = ("Canon EOS 550D", "Canon EOS 6D Mark II", "Benchmark", "Ένας")


def grey_scene(white: tuple[float, float, float]) -> npt.NDArray[np.uint16]:
    """Return a grey ramp under a light, with shot noise; its brightest place reflects 90 %."""
    reflectance = np.linspace(0.15, 0.9, 96)[None, :, None]
    return np.random.default_rng(3).poisson(np.full((64, 1, 1), 1.0) * reflectance * white).astype(np.uint16)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("light", WHITES)
def test_what_libraw_shows_is_neutral_where_the_scene_is(light: str, camera: str) -> None:
    white = WHITES[light]
    # Saturation far enough above the white that no channel clips when LibRaw multiplies it by its balance.
    metadata = ImageMetadata(white_level=12000, white=white, camera=camera)
    with rawpy.imread(io.BytesIO(encode_image(grey_scene(white), "dng", metadata))) as raw:
        shown = raw.postprocess(
            use_camera_wb=True, output_bps=16, no_auto_bright=True, gamma=(1, 1), highlight_mode=rawpy.HighlightMode(1)
        )
    means = shown[8:-8, 8:-8].reshape(-1, 3).mean(axis=0, dtype=np.float64)
    # The mean of some 3800 pixels of the dimmest channel (some 55 DN) is known to .3 %; six of that are allowed.
    np.testing.assert_allclose(means / means[1], 1, atol=0.02)


def test_without_the_ground_truth_it_is_not_neutral() -> None:
    """So that the test above can fail: the same scene, the balance of another light."""
    metadata = ImageMetadata(white_level=12000, white=WHITES["daylight"], camera="Canon EOS 550D")
    with rawpy.imread(io.BytesIO(encode_image(grey_scene(WHITES["candle"]), "dng", metadata))) as raw:
        shown = raw.postprocess(use_camera_wb=True, output_bps=16, no_auto_bright=True, gamma=(1, 1))
    means = shown.reshape(-1, 3).mean(axis=0, dtype=np.float64)
    assert abs(means[0] / means[1] - 1) > 0.5


@pytest.mark.slow
@settings(max_examples=40)
@given(height=st.integers(22, 41), width=st.integers(22, 41), seed=st.integers(0, 99))
def test_each_photosite_is_its_own_channel_of_its_pixel(height: int, width: int, seed: int) -> None:
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


def test_dcraw_sees_the_same_counts_and_balance(tmp_path: Path) -> None:
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


def test_the_tags_are_those_of_the_standard() -> None:
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
    known = camera_matrix("Canon EOS 550D")
    assert known is not None
    np.testing.assert_allclose(matrix[..., 0] / matrix[..., 1], known, atol=5e-5)
    # TIFF 6.0, sections 8 and 4: one uncompressed picture, pixel by pixel. TIFF/EP: blocks of RGGB. DNG 1.7.1, chapter
    # 4: a file of 1.4 that readers from 1.1 on can read, planes red, green and blue, sites in rows, daylight.
    assert tags == {
        254: 0, 256: 40, 257: 30, 258: 16, 259: 1, 262: 32803, 274: 1, 277: 1, 278: 30, 284: 1,
        271: "CroP", 272: "Canon EOS 550D generated", 50708: "CroP Canon EOS 550D generated",
        33421: (2, 2), 33422: bytes([0, 1, 1, 2]), 50706: bytes([1, 4, 0, 0]), 50707: bytes([1, 1, 0, 0]),
        50710: bytes([0, 1, 2]), 50711: 1, 50714: 0, 50717: 11536, 50778: 21,
    }  # fmt: skip


def test_the_matrix_of_srgb_is_the_inverse_of_the_standards() -> None:
    # Of IEC 61966-2-1, which gives it to four decimals beside its inverse.
    inverse = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    np.testing.assert_allclose(np.array(files._SRGB) @ inverse, np.eye(3), atol=3e-4)


def test_two_pixels_by_hand() -> None:
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
def test_the_inverse_gives_back_the_image(image: np.ndarray, a: float, gamma: float) -> None:
    operator = fit_flash(image, a, gamma)
    np.testing.assert_allclose(operator.invert(operator.apply(image)), image, rtol=1e-6)


def test_the_scale_of_the_values_does_not_matter() -> None:
    image = np.random.default_rng(0).uniform(0.01, 1, (9, 9, 3))
    np.testing.assert_allclose(fit_flash(image).apply(image), fit_flash(image / 50).apply(image / 50))


def test_codes_of_eight_bits_lose_little() -> None:
    image = np.random.default_rng(0).uniform(0.02, 1, (50, 50, 3))
    operator = fit_flash(image)
    back = operator.invert(np.rint(operator.apply(image)))
    assert np.median(np.abs(back / image - 1)) < 0.02


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_single_precision_moves_no_code_by_more_than_one(gamma: float) -> None:
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
def test_previews_are_the_operator_by_tables(image: npt.NDArray[np.uint16], white_level: int) -> None:
    linear = image / white_level
    exact = np.clip(fit_flash(linear).apply(linear), 0, 255)
    assert np.abs(preview_of(image, white_level) - exact).max() <= 0.5 + 1e-4


@given(
    hnp.arrays(np.uint16, st.tuples(st.integers(1, 12), st.integers(1, 12), st.just(3))),
    st.integers(1, 12),
)
def test_a_pixel_of_a_preview_is_the_mean_of_what_it_stands_for(image: npt.NDArray[np.uint16], side: int) -> None:
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
def test_means_of_two_by_two_are_rounded_as_all_others(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(5).integers(0, 65536, shape, dtype=np.uint16)
    rows, columns = np.arange(0, shape[0], 2), np.arange(0, shape[1], 2)
    sums, pixels = image.astype(np.int64), np.ones(shape, np.int64)
    for axis, starts in enumerate((rows, columns)):
        sums, pixels = np.add.reduceat(sums, starts, axis), np.add.reduceat(pixels, starts, axis)
    rounded = ((2 * sums + pixels) // (2 * pixels)).astype(np.uint16)
    np.testing.assert_array_equal(preview_of(image, 65535, 45), preview_of(rounded, 65535, 45))


KNOWN_METADATA = ImageMetadata(white_level=4600, white=(4000.0, 2520.0, 840.5), camera="Known camera")

OF_A_BODY = ImageMetadata(white_level=11536, white=(2046.0, 1579.5, 4520.0), camera="Canon EOS 550D")


def kinds_of_images() -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield images with runs of every length, repeats at the ends of the window, few and many values, odd sizes."""
    rng = np.random.default_rng(8)
    few = rng.integers(0, 4000, (9, 3))
    for height, width in ((1, 1), (1, 2), (2, 1), (3, 7), (1, 300), (300, 1)):
        yield f"noise {height}x{width}", rng.integers(0, 65536, (height, width, 3))
    runs = np.repeat(few[np.arange(90) % 9], np.arange(90), axis=0)
    yield "runs", runs[: 89 * 45].reshape(45, 89, 3)
    yield "one colour", np.full((40, 50, 3), 1234)
    yield "black", np.zeros((30, 30, 3))
    for shift in (-1, 0, 1):
        # The same noise again, just within, at and just beyond 32768 bytes: 60 rows of 91 pixels and a byte each.
        once = rng.integers(0, 5000, (60, 91 + shift, 3))
        yield f"repeats {shift}", np.concatenate([once, once, once])
    yield "a few colours", few[rng.integers(0, 9, (64, 64))]
    yield "many rows of few colours", few[rng.geometric(0.4, (200, 60)) % 9]
    yield "25 of each of 64", rng.integers(0, 4000, (1600, 3))[rng.integers(0, 1600, (80, 120))]
    yield "rare bytes", np.where(rng.random((90, 90, 1)) < 0.001, rng.integers(0, 65536, (90, 90, 3)), few[:1])
    ramp = np.arange(90 * 70).reshape(90, 70, 1) * np.array([1, 3, 7])
    yield "a ramp", ramp % 65536
    index = np.arange(640 * 480).reshape(640, 480, 1)
    # Of so many symbols one row of eight is counted.
    yield "samples of cells", (index * index // 97 % 40) * [31, 97, 55] + (index * 2654435761 >> 7) % 25 * [3, 10, 6]
    yield "a noisy ramp", ramp // 8 + rng.poisson(20, (90, 70, 3))


@pytest.mark.slow
def test_files_of_images(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, Any] = {}
    for name, numbers in kinds_of_images():
        image = numbers.astype(np.uint16)
        found[name] = [
            encode_image(image, "png", KNOWN_METADATA),
            encode_tiff(image, KNOWN_METADATA),
            encode_exr(image, KNOWN_METADATA)[:340],
        ]
        # Maps are packed by a library, whose versions may differ: that they come to less is known.
        found[name].append(len(encode_map(image[..., 1])) < 100 + image.nbytes)
        if min(image.shape[:2]) >= 22:
            found[name] += [encode_dng(image, KNOWN_METADATA), encode_dng(image, OF_A_BODY)]
        # In bands of some rows, the last of them shorter.
        with monkeypatch.context() as changed:
            changed.setattr(files, "BAND", 7 * image.shape[1] + 3)
            found[name].append(encode_image(image, "png", OF_A_BODY))
    pinned("bytes of images' files", found)


@pytest.mark.slow
def test_codes(pinned: Pinned) -> None:
    rng = np.random.default_rng(9)
    found: list[Any] = []
    given: list[npt.NDArray[np.int64]] = [np.array([0, 0, 5]), np.array([0, 3, 3]), np.zeros(4, np.int64)]
    given += [rng.geometric(part, 60) * (rng.random(60) < 0.7) for part in (0.01, 0.2, 0.9)]
    given += [2 ** np.arange(25), np.array([1, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])]
    for counts in given:
        for longest in (7, 12, 15):
            lengths = code_lengths(counts, longest)
            found.append([lengths, codes_of(lengths)])
    pinned("codes of frequencies", found)


@pytest.mark.slow
def test_what_a_head_may_claim(pinned: Pinned) -> None:
    """The most rows that a file of 200 bytes may claim, by bits and kind of colour; and how long a part may be."""

    def is_plausible(data: bytes) -> bool:
        try:
            require_plausible(data, "it")
        except FormatError:
            return False
        return True

    def head(rows: int, depth: int, colour: int, size: int = 13) -> bytes:
        return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", size, b"IHDR", 61, rows, depth, colour) + bytes(7)

    found: dict[str, Any] = {}
    for depth in (1, 8, 16):
        for colour in range(8):
            rows = range(1 << 20)
            found[f"{depth} {colour}"] = bisect_left(
                rows, True, key=lambda many, d=depth, c=colour: not is_plausible(head(many, d, c) + bytes(167))
            )
    parts = [head(1, 8, 2)[:length] + struct.pack(">I", size) + bytes(8) for length in (32, 33) for size in range(4)]
    parts += [head(1, 8, 2, size) for size in (12, 13, 14)] + [head(1, 8, 2)[:length] for length in (7, 25, 26, 32)]
    found["parts"] = [is_plausible(part) for part in parts]
    pinned("what a head may claim", found)
