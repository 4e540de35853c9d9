"""Colour spaces of source pictures, held against the library colour-science."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import colour
import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813
import pytest
import tifffile

from foundation.errors import FormatError
from generator.pictures.sources import open_picture
from tests.generator.pictures.icc import ADOBE_RGB, gamma_profile

Codes = npt.NDArray[np.uint16]

# Colours with all channels inside sRGB after conversion, 16 bits, (2, 4, 3). OpenImageIO misreads a TIFF of 64-bit
# floats with a single row.
MUTED: Codes = np.tile(
    np.array([[[40000, 30000, 20000], [9000, 12000, 15000], [60000, 60000, 60000], [3000, 2000, 2500]]], np.uint16),
    (2, 1, 1),
)


def write_png(path: Path, codes: npt.NDArray[Any], **chunks: bytes) -> Path:
    """Write a PNG with these chunks before its pixels (PNG, third edition, clause 5)."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    height, width, _ = codes.shape
    is_deep = codes.dtype == np.uint16
    rows = b"".join(b"\0" + row.astype(">u2" if is_deep else "u1").tobytes() for row in codes)
    head = struct.pack(">IIBBBBB", width, height, 16 if is_deep else 8, 2, 0, 0, 0)
    parts = [(b"IHDR", head), *((name.encode(), data) for name, data in chunks.items())]
    parts += [(b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts))
    return path


def converted(codes: npt.NDArray[Any], space: str, decoding: Any) -> npt.NDArray[np.float64]:
    """Return sRGB codes by colour-science, with Bradford adaptation."""
    light = decoding(codes / 65535)
    return np.asarray(
        255
        * colour.RGB_to_RGB(
            light, space, "sRGB", chromatic_adaptation_transform="Bradford", apply_cctf_encoding=True
        ).clip(0, 1)
    )


def gamma(exponent: float) -> Any:
    def decode(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return values**exponent

    return decode


CHROMATICITIES_OF_P3 = struct.pack(">8I", 31270, 32900, 68000, 32000, 26500, 69000, 15000, 6000)

SRGB_DECODING = colour.models.eotf_sRGB
SPACES = {
    "P3 by cICP": ({"cICP": bytes((12, 13, 0, 1))}, "Display P3", SRGB_DECODING),
    "BT.2020 by cICP": ({"cICP": bytes((9, 14, 0, 1))}, "ITU-R BT.2020", colour.models.oetf_inverse_BT709),
    "linear BT.709 by cICP": ({"cICP": bytes((1, 8, 0, 1))}, "sRGB", gamma(1)),
    "linear by gAMA": ({"gAMA": struct.pack(">I", 100_000)}, "sRGB", gamma(1)),
    "1.8 by gAMA": ({"gAMA": struct.pack(">I", 55_556)}, "sRGB", gamma(1.8)),
    "P3 by cHRM": ({"gAMA": struct.pack(">I", 45_455), "cHRM": CHROMATICITIES_OF_P3}, "Display P3", SRGB_DECODING),
    "cICP before gAMA": (
        {"cICP": bytes((12, 13, 0, 1)), "gAMA": struct.pack(">I", 100_000)},
        "Display P3",
        SRGB_DECODING,
    ),
    "sRGB before gAMA": ({"sRGB": b"\0", "gAMA": struct.pack(">I", 55_556)}, "sRGB", SRGB_DECODING),
}


@pytest.mark.parametrize("name", SPACES)
def test_converts_colour_chunks_of_png(tmp_path: Path, name: str) -> None:
    chunks, space, decoding = SPACES[name]
    picture = open_picture(write_png(tmp_path / "a.png", MUTED, **chunks)).picture
    assert np.abs(picture - converted(MUTED, space, decoding)).max() <= 0.6


@pytest.mark.parametrize(
    "codes", [(9, 16, 0, 1), (9, 18, 0, 1), (12, 13, 0, 0), (12, 13, 1, 1), (2, 2, 0, 1), (22, 13, 0, 1)]
)
def test_refuses_hdr_and_unknown_code_points(tmp_path: Path, codes: tuple[int, ...]) -> None:
    path = write_png(tmp_path / "a.png", MUTED, cICP=bytes(codes))
    with pytest.raises(FormatError, match="/".join(map(str, codes))):
        open_picture(path)


@pytest.mark.parametrize(
    "chunks", [{}, {"sRGB": b"\0"}, {"gAMA": struct.pack(">I", 45_455)}, {"cICP": bytes((1, 13, 0, 1))}]
)
def test_srgb_pictures_keep_their_codes(tmp_path: Path, chunks: dict[str, bytes]) -> None:
    codes = np.arange(3 * 64, dtype=np.uint8).reshape(8, 8, 3)
    np.testing.assert_array_equal(open_picture(write_png(tmp_path / "a.png", codes, **chunks)).picture, codes)


def test_refuses_impossible_chromaticities(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no colour space"):
        open_picture(write_png(tmp_path / "a.png", MUTED, cHRM=bytes(32)))


@pytest.mark.parametrize("dtype", [np.uint16, np.float16, np.float32, np.float64])
def test_float_tiff_is_encoded_as_its_profile_states(tmp_path: Path, dtype: type[np.generic]) -> None:
    # The 16-bit file, whose reading other tests hold against LittleCMS, is the reference.
    values = MUTED if dtype is np.uint16 else (MUTED / 65535).astype(dtype)
    profile = gamma_profile("Adobe RGB stand-in", 563 / 256, ADOBE_RGB)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", iccprofile=profile)
    picture = open_picture(tmp_path / "a.tif").picture
    expected = converted(MUTED, "Adobe RGB (1998)", gamma(563 / 256))
    # A 16-bit float has 11 significant bits; the conversion has 8.
    assert np.abs(picture - expected).max() <= 2


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_linear_profile_keeps_dark_colours(tmp_path: Path, dtype: type[np.generic]) -> None:
    # In 8 bits of linear light, the darkest of these colours would be off by 5 codes.
    dark = (MUTED / 40).astype(np.uint16)
    values = dark if dtype is np.uint16 else (dark / 65535).astype(dtype)
    profile = gamma_profile("linear Adobe RGB", 1.0, ADOBE_RGB)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb", iccprofile=profile)
    picture = open_picture(tmp_path / "a.tif").picture
    assert np.abs(picture - converted(dark, "Adobe RGB (1998)", gamma(1))).max() <= 1


def test_applies_chromaticities_of_openexr(tmp_path: Path) -> None:
    spec = oiio.ImageSpec(4, 2, 3, "float")
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.3127, 0.329))
    output = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert output is not None
    assert output.open(str(tmp_path / "a.exr"), spec)
    assert output.write_image((MUTED / 65535).astype(np.float32))
    output.close()
    picture = open_picture(tmp_path / "a.exr").picture
    assert np.abs(picture - converted(MUTED, "Display P3", gamma(1))).max() <= 0.6


def test_applies_primaries_of_radiance_file(tmp_path: Path) -> None:
    # Radiance, "Radiance Picture Format": PRIMARIES lists x, y of red, green, blue and white.
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nPRIMARIES= 0.68 0.32 0.265 0.69 0.15 0.06 0.3127 0.329\n\n-Y 1 +X 4\n"
    (tmp_path / "a.hdr").write_bytes(head + bytes([128, 96, 64, 128]) * 4)
    picture = open_picture(tmp_path / "a.hdr").picture
    # The value of a mantissa m with exponent 128 is (m + 0.5) / 256, or m / 256 in older programs.
    codes = np.array([[[128, 96, 64]]]) / 256 * 65535
    assert np.abs(picture[:, :1] - converted(codes, "Display P3", gamma(1))).max() <= 1.5
