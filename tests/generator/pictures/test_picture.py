"""Pictures of every kind become the sRGB codes that the head of `picture.py` promises."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from PIL import Image

from foundation.errors import FormatError
from generator.pictures import picture
from generator.pictures.picture import read_picture
from tests.generator.pictures.oiio_files import write


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp", "ppm", "tga", "webp"])
def test_codes_of_lossless_files_are_kept(tmp_path: Path, colours: npt.NDArray[np.uint8], suffix: str) -> None:
    path = tmp_path / f"picture.{suffix}"
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else []
    if suffix == "tga":
        write(path, colours, "uint8")
    else:
        path.write_bytes(cv2.imencode(f".{suffix}", colours[..., ::-1], options)[1].tobytes())
    np.testing.assert_array_equal(read_picture(path), colours)


def test_sixteen_bits_become_the_nearest_eight(tmp_path: Path) -> None:
    values = np.array([[0, 128, 129, 257, 385, 386, 32767, 32768, 65406, 65407, 65535]], np.uint16)
    path = write(tmp_path / "deep.png", values[..., None].repeat(3, axis=2), "uint16")
    nearest = np.rint(values.astype(np.float64) * 255 / 65535)
    np.testing.assert_array_equal(read_picture(path)[..., 1], nearest)


def test_grey_becomes_three_equal_codes(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    path = write(tmp_path / "grey.png", colours[..., :1], "uint8")
    np.testing.assert_array_equal(read_picture(path), colours[..., :1].repeat(3, axis=2))


STRAIGHT = ["png", "tif", "tga", "bmp", "sgi", "dds", "jp2", "jxl", "dpx", "unsaid.tif"]


@pytest.mark.parametrize("suffix", STRAIGHT)
def test_white_shows_through(tmp_path: Path, suffix: str) -> None:
    rgba = np.random.default_rng(1).integers(0, 256, (32, 64, 4)).astype(np.uint8)
    rgba[0, :4, 3] = [0, 64, 128, 255]
    path = tmp_path / f"clear.{suffix}"
    match suffix:
        case "tif":
            tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["unassalpha"])
        case "jp2":
            path.write_bytes(imagecodecs.jpeg2k_encode(rgba, level=0, reversible=True))
        case "jxl":
            path.write_bytes(imagecodecs.jpegxl_encode(rgba, lossless=True))
        case "dpx":
            write(path, rgba, "uint8")
        case "png" | "unsaid.tif":
            path.write_bytes(cv2.imencode(path.suffix, rgba[..., [2, 1, 0, 3]])[1].tobytes())
        case "tga":
            write(path, rgba, "uint8", oiio__UnassociatedAlpha=1)
        case _:
            Image.fromarray(rgba).save(path)
    share = rgba[..., 3:] / 255
    expected = rgba[..., :3] * share + 255 * (1 - share)
    assert np.abs(read_picture(path) - expected).max() <= 1


def test_white_shows_through_a_gif(tmp_path: Path) -> None:
    picture = Image.new("P", (3, 1))
    picture.putpalette([200, 10, 0, 0, 90, 7])
    picture.putdata([0, 1, 0])
    picture.save(tmp_path / "clear.gif", transparency=0)
    np.testing.assert_array_equal(read_picture(tmp_path / "clear.gif"), [[[255] * 3, [0, 90, 7], [255] * 3]])


def test_colours_multiplied_by_alpha_are_not_multiplied_again(tmp_path: Path) -> None:
    path = tmp_path / "associated.tif"
    rgba = np.array([[[100, 5, 0, 128], [0, 0, 0, 0], [9, 8, 7, 255]]], np.uint8)
    tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["assocalpha"])
    np.testing.assert_array_equal(read_picture(path), [[[227, 132, 127], [255] * 3, [9, 8, 7]]])


def test_the_fourth_byte_of_a_plain_bmp_means_nothing(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    height, width, _ = colours.shape
    rows = np.zeros((height, width, 4), np.uint8)
    rows[..., :3] = colours[::-1, :, ::-1]
    head = b"BM" + struct.pack("<IHHI", 54 + rows.nbytes, 0, 0, 54)
    head += struct.pack("<IiiHHIIiiII", 40, width, height, 1, 32, 0, rows.nbytes, 0, 0, 0, 0)
    (tmp_path / "plain.bmp").write_bytes(head + rows.tobytes())
    np.testing.assert_array_equal(read_picture(tmp_path / "plain.bmp"), colours)


def test_grey_with_transparency(tmp_path: Path) -> None:
    path = write(tmp_path / "clear.png", np.array([[[100, 255], [100, 0]]], np.uint8), "uint8")
    np.testing.assert_array_equal(read_picture(path), [[[100] * 3, [255] * 3]])


def test_floating_point_is_linear_light(tmp_path: Path) -> None:
    # IEC 61966-2-1: 0.5 is code 188, 0.18 code 118, 0.002 code 7 (the straight part); beyond the range is clipped.
    row = np.array([[0.5, 0.18, 0.002, 1.0, 7.0, -1.0, np.nan]], np.float32)
    path = write(tmp_path / "light.exr", row[..., None].repeat(3, axis=2), "float")
    np.testing.assert_array_equal(read_picture(path)[0, :, 0], [188, 118, 7, 255, 255, 0, 0])
    hdr = write(tmp_path / "light.hdr", np.full((4, 16, 3), 0.5, np.float32), "float")
    assert set(read_picture(hdr).ravel().tolist()) == {188}


def test_transparent_light_is_mixed_with_white_as_light(tmp_path: Path) -> None:
    half = np.array([[[0.25, 0.0, 0.0, 0.5]]], np.float32)  # associated: red 0.5 at half coverage
    picture = read_picture(write(tmp_path / "clear.exr", half, "float"))
    np.testing.assert_array_equal(picture[0, 0], [225, 188, 188])  # codes of 0.75, 0.5, 0.5


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_stand_upright(tmp_path: Path, colours: npt.NDArray[np.uint8], orientation: int) -> None:
    path = write(tmp_path / "turned.tif", colours, "uint8", Orientation=orientation)
    # TIFF 6.0, tag 274: where the stored row 0 and column 0 are to be seen.
    row0, column0 = {
        1: ("top", "left"),
        2: ("top", "right"),
        3: ("bottom", "right"),
        4: ("bottom", "left"),
        5: ("left", "top"),
        6: ("right", "top"),
        7: ("right", "bottom"),
        8: ("left", "bottom"),
    }[orientation]
    seen = read_picture(path)
    sides = {"top": seen[0], "bottom": seen[-1], "left": seen[:, 0], "right": seen[:, -1]}

    def same(side: npt.NDArray[np.uint8], stored: npt.NDArray[np.uint8]) -> bool:
        return side.tolist() in (stored.tolist(), stored[::-1].tolist())

    assert same(sides[row0], colours[0])
    assert same(sides[column0], colours[:, 0])


def test_only_larger_pictures_are_made_smaller(tmp_path: Path) -> None:
    halves = np.zeros((40, 80, 3), np.uint8)
    halves[:, ::2] = 200
    path = write(tmp_path / "large.png", halves, "uint8")
    assert read_picture(path, 80).shape == (40, 80, 3)
    small = read_picture(path, 40)
    assert small.shape == (20, 40, 3)
    assert set(small.ravel().tolist()) == {100}


DAMAGED = {
    "text.jpg": b"this is no picture",
    "empty.png": b"",
    "half.png": cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (99, 99, 3)))[1].tobytes()[:9000],
    "half.jpg": cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 255, (99, 99, 3)))[1].tobytes()[:3000],
    "unknown.xyz": b"\x00\x01\x02",
}


@pytest.mark.parametrize("name", DAMAGED)
def test_what_is_no_picture_is_named_with_the_reason(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(DAMAGED[name])
    with pytest.raises(FormatError, match=rf"cannot read .*{name}: .+; .*another"):
        read_picture(path)


def test_a_missing_picture_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"none\.png: there is no such file"):
        read_picture(tmp_path / "none.png")


def test_a_picture_larger_than_any_is_named(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "huge.png", colours, "uint8")
    monkeypatch.setattr(picture, "LARGEST_PICTURE", 7 * 5 - 1)
    with pytest.raises(FormatError, match=r"huge\.png: 7x5 px are more than 34; make it smaller"):
        read_picture(path)
