"""Pictures of every kind become the sRGB codes that the head of `scene.py` promises."""

from __future__ import annotations

import errno
import hashlib
import os
import struct
import sys
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813
import pytest
import tifffile
from PIL import Image

from foundation.errors import FormatError, InputError, StorageError
from generator.dataset.store import filesystem
from generator.pictures import picture
from generator.pictures import sources as scene
from generator.pictures.picture import Preparation, read_picture
from generator.pictures.sources import RandomScene, find_pictures, random_scenes


def write(path: Path, pixels: npt.NDArray[np.generic], form: str, **attributes: object) -> Path:
    """Write `pixels` (H, W, C) with OpenImageIO as `form` ("uint8", "half", ...)."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], form)
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out: Any = oiio.ImageOutput.create(str(path))
    assert out is not None
    assert out.open(str(path), spec)
    assert out.write_image(pixels)
    out.close()
    return path


@pytest.fixture
def colours() -> npt.NDArray[np.uint8]:
    return np.random.default_rng(1).integers(0, 256, (5, 7, 3)).astype(np.uint8)


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


def test_folders_are_searched_in_order_of_names(tmp_path: Path) -> None:
    names = ("b.png", "a/z.JPG", "a.tif", "a-b/y.png", "B.png", "notes.txt", ".hidden.png", ".cache/c.png", "a/b/c.exr")
    for name in names:
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).touch()
    (tmp_path / "alone.dat").touch()
    found = find_pictures([tmp_path / "alone.dat", str(tmp_path / "in")], Preparation(max_side=99))
    assert [source.name for source in found] == [
        *("alone.dat", "B.png", "a-b/y.png", "a.tif", "a/b/c.exr", "a/z.JPG", "b.png")
    ]
    assert [source.location for source in found[2:4]] == [str(tmp_path / "in/a-b/y.png"), str(tmp_path / "in/a.tif")]
    assert {source.preparation.max_side for source in found} == {99}


def test_links_to_folders_are_not_followed_and_links_to_files_are(tmp_path: Path) -> None:
    (tmp_path / "in/deep").mkdir(parents=True)
    (tmp_path / "in/deep/a.png").touch()
    (tmp_path / "in/again").symlink_to(tmp_path / "in")
    (tmp_path / "in/b.png").symlink_to(tmp_path / "in/deep/a.png")
    assert [source.name for source in find_pictures([tmp_path / "in"])] == ["b.png", "deep/a.png"]


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes, whatever they mean, on Linux only")
def test_names_that_are_no_text_are_read_and_told_as_escapes(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    folder = tmp_path / os.fsdecode(b"folder \xe9")
    folder.mkdir()
    data = cv2.imencode(".png", colours[..., ::-1])[1].tobytes()
    (folder / os.fsdecode(b"picture \xff.png")).write_bytes(data)
    (folder / os.fsdecode(b"damaged \xff.png")).write_bytes(data[:60])
    damaged, whole = find_pictures([folder])
    assert (damaged.name, whole.name) == ("damaged \\xff.png", "picture \\xff.png")
    np.testing.assert_array_equal(whole.read().picture, colours)
    with pytest.raises(FormatError, match="damaged"):
        damaged.read()


def test_a_picture_larger_than_any_is_named(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "huge.png", colours, "uint8")
    monkeypatch.setattr(picture, "LARGEST_PICTURE", 7 * 5 - 1)
    with pytest.raises(FormatError, match=r"huge\.png: 7x5 px are more than 34; make it smaller"):
        read_picture(path)


@pytest.mark.parametrize("url", [False, True])
def test_datasets_among_the_pictures_are_no_sources(tmp_path: Path, colours: npt.NDArray[np.uint8], url: bool) -> None:
    for name in ("a.png", "made/images/000000.png", "made/previews/000000.jpg", "more/b.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write(tmp_path / name, colours, "uint8")
    (tmp_path / "made" / "dataset.json").write_text("{}")
    place = str(tmp_path)
    if url:
        place = f"memory://{tmp_path.name}"
        store, top = filesystem(place)
        for path in tmp_path.rglob("*.*"):
            store.pipe_file(f"{top}/{path.relative_to(tmp_path).as_posix()}", path.read_bytes())
    assert [found.name for found in find_pictures([place])] == ["a.png", "more/b.png"]
    # Who names it wants it.
    named = find_pictures(f"{place}/made")
    assert [found.name for found in named] == ["images/000000.png", "previews/000000.jpg"]


def test_two_pictures_of_one_name_are_told(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "a.png", colours, "uint8")
    with pytest.raises(InputError, match=r"two pictures would be called a\.png: .*one/a\.png and .*two/a\.png; name"):
        find_pictures([tmp_path / "one", tmp_path / "two"])
    with pytest.raises(InputError, match=r"two pictures would be called a\.png"):
        find_pictures([tmp_path / "one", tmp_path / "one"])
    assert [found.name for found in find_pictures(tmp_path)] == ["one/a.png", "two/a.png"]


def test_a_name_is_one_line_of_a_list(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    write(tmp_path / "a.png", colours, "uint8").rename(tmp_path / "a\rb.png")
    assert find_pictures([tmp_path])[0].name == "a\\rb.png"


def test_a_picture_that_memory_does_not_hold_is_named(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "large.png", colours, "uint8")

    def full(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr(scene, "open_picture", full)
    with pytest.raises(InputError, match=r"not enough memory to read .*large\.png; use fewer workers"):
        find_pictures(path)[0].read()


def test_links_that_lead_round_in_a_circle_are_passed_over(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    write(tmp_path / "picture.png", colours, "uint8")
    (tmp_path / "a.png").symlink_to(tmp_path / "b.png")
    (tmp_path / "b.png").symlink_to(tmp_path / "a.png")
    assert [found.name for found in find_pictures([tmp_path])] == ["picture.png"]


@pytest.mark.parametrize(
    ("number", "kind"),
    [(errno.EACCES, FormatError), (errno.EIO, FormatError), (errno.EMFILE, StorageError), (errno.ESTALE, StorageError)],
)
def test_what_a_file_is_itself_is_told_from_what_the_machine_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[Exception]
) -> None:
    (tmp_path / "a.png").write_bytes(b"any")
    (source,) = find_pictures([tmp_path])

    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(kind, match=rf"cannot read .*a\.png: {os.strerror(number)};"):
        source.read()


def test_pictures_of_a_store_are_those_of_a_folder(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    store, root = filesystem(f"memory://{tmp_path.name}")
    local: list[Path] = []
    for name in ("b.png", "in/a.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        local.append(write(tmp_path / f"{name}.png", colours, "uint8"))
        store.pipe_file(f"{root}/{name}", local[-1].read_bytes())
    found = find_pictures([f"memory://{tmp_path.name}"])
    assert [source.name for source in found] == ["b.png", "in/a.png"]
    for source in found:
        scene = source.read()
        np.testing.assert_array_equal(scene.picture, colours)
        assert scene.sha256 == hashlib.sha256(local[0].read_bytes()).hexdigest()
    (alone,) = find_pictures([f"memory://{tmp_path.name}/b.png"])
    assert alone.name == "b.png"
    np.testing.assert_array_equal(alone.read().picture, colours)
    store.rm(f"{root}/b.png")
    with pytest.raises(FormatError, match=r"cannot read memory://.*b\.png"):
        alone.read()
    with pytest.raises(InputError, match="holds no picture"):
        find_pictures([f"memory://{tmp_path.name}/nothing"])
    with pytest.raises(InputError, match="cannot reach nostore://"):
        find_pictures(["nostore://a/b"])


def test_places_without_pictures_are_named(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty holds no picture"):
        find_pictures([tmp_path / "empty"])
    with pytest.raises(InputError, match=r"there is no .*nowhere"):
        find_pictures([tmp_path / "nowhere"])


def test_random_scenes_are_uniform_and_their_own() -> None:
    first, second = (scene.read().picture for scene in random_scenes(2, 1001, 800, seed=9))
    assert first.shape == (800, 1001, 3)
    # Chi-square with 255 degrees of freedom exceeds 370 once in a million; the seed is fixed.
    for channel in range(3):
        counts = np.bincount(first[..., channel].ravel(), minlength=256)
        expected = first[..., channel].size / 256
        assert ((counts - expected) ** 2 / expected).sum() < 370
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.005
    assert abs(np.corrcoef(first[..., 0].ravel(), first[..., 1].ravel())[0, 1]) < 0.007
    np.testing.assert_array_equal(RandomScene(1, 500, 30, 9).read().picture, second[:30, :500])


@pytest.mark.parametrize(("count", "width", "height"), [(0, 5, 5), (1, 0, 5), (1, 5, 65536)])
def test_impossible_random_scenes_are_refused(count: int, width: int, height: int) -> None:
    with pytest.raises(InputError, match="asked for, expected"):
        random_scenes(count, width, height)
