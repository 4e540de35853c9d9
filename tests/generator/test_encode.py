"""Files read back by other readers than the one that wrote them."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
import tifffile

from drivers.errors import InputError
from generator.encode import encode_image, encode_preview


@pytest.mark.parametrize("form", ["png", "tiff"])
def test_every_bit_comes_back_in_place(tmp_path: Path, form: str) -> None:
    image = np.random.default_rng(0).integers(0, 65536, (31, 45, 3)).astype(np.uint16)
    image[0, 0] = (65535, 1, 256)
    path = tmp_path / f"image.{form}"
    path.write_bytes(encode_image(image, "png" if form == "png" else "tiff"))
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    assert str(stream.spec().format) == "uint16"
    np.testing.assert_array_equal(stream.read_image("uint16"), image)


def test_tiff_is_uncompressed_and_plain() -> None:
    image = np.arange(60, dtype=np.uint16).reshape(4, 5, 3)
    with tifffile.TiffFile(io.BytesIO(encode_image(image, "tiff"))) as file:
        assert file.pages.first.compression == 1
        np.testing.assert_array_equal(file.asarray(), image)


def test_png_says_sixteen_bit_rgb() -> None:
    data = encode_image(np.zeros((2, 3, 3), np.uint16))
    # ISO/IEC 15948, 11.2.2: width, height, bit depth, colour type, compression, filter and interlace methods.
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">IIBBBBB", data[16:29]) == (3, 2, 16, 2, 0, 0, 0)


def test_a_preview_is_a_jpeg_of_the_right_colour(tmp_path: Path) -> None:
    path = tmp_path / "preview.jpg"
    path.write_bytes(encode_preview(np.full((16, 16, 3), (200, 100, 50), np.uint8)))
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    assert stream.format_name() == "jpeg"
    assert np.abs(np.asarray(stream.read_image("uint8")).reshape(-1, 3) - [200.0, 100, 50]).max() <= 3


def test_other_arrays_are_refused() -> None:
    with pytest.raises(InputError, match=r"the image is uint16 \(4, 4\)"):
        encode_image(np.zeros((4, 4), np.uint16))
    with pytest.raises(InputError, match=r"the image is uint16 \(0, 4, 3\)"):
        encode_image(np.zeros((0, 4, 3), np.uint16))


def test_large_data_are_cut_into_chunks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 65536, (20, 30, 3)).astype(np.uint16)
    monkeypatch.setattr("generator.encode.LARGEST_CHUNK", 1000)
    data = encode_image(image)
    assert data.count(b"IDAT") == 4
    path = tmp_path / "image.png"
    path.write_bytes(data)
    stream = oiio.ImageInput.open(str(path))
    assert stream is not None
    np.testing.assert_array_equal(stream.read_image("uint16"), image)
