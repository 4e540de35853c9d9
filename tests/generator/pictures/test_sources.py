"""Source pictures: finding, reading as 8-bit sRGB codes, reducing and cropping."""

from __future__ import annotations

import errno
import hashlib
import io
import itertools
import os
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms

from foundation.errors import FormatError, InputError, StorageError
from foundation.remote import filesystem
from generator.pictures import sources as sources_module
from generator.pictures.conversion import to_srgb
from generator.pictures.random_scenes import RandomScene, random_scenes
from generator.pictures.sources import (
    PROFILE_UNUSED,
    PictureFile,
    Preparation,
    clear_bits,
    find_pictures,
    open_picture,
    random_positions,
    read_picture,
)
from tests.generator.pictures.icc import ADOBE_RGB, PROPHOTO_RGB, gamma_profile
from tests.generator.pictures.oiio_files import write
from tests.generator.said import said
from tests.pinned import Pinned


def test_lists_pictures_in_order_of_paths(tmp_path: Path) -> None:
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


def test_follows_links_to_unsearched_folders_only(tmp_path: Path) -> None:
    (tmp_path / "in/deep").mkdir(parents=True)
    (tmp_path / "in/deep/a.png").touch()
    (tmp_path / "out/far").mkdir(parents=True)
    (tmp_path / "out/far/c.png").touch()
    (tmp_path / "in/again").symlink_to(tmp_path / "in")
    (tmp_path / "in/above").symlink_to(tmp_path)
    (tmp_path / "in/b.png").symlink_to(tmp_path / "in/deep/a.png")
    (tmp_path / "in/elsewhere").symlink_to(tmp_path / "out")
    (tmp_path / "in/further").symlink_to(tmp_path / "out/far")
    (tmp_path / "out/back").symlink_to(tmp_path / "in/deep")
    (tmp_path / "in/nowhere").symlink_to(tmp_path / "gone")
    (tmp_path / "in/round").symlink_to(tmp_path / "in/round")
    found = find_pictures([tmp_path / "in"])
    assert [source.name for source in found] == ["b.png", "deep/a.png", "elsewhere/far/c.png"]
    (tmp_path / "whole").symlink_to(tmp_path / "in")
    assert len(find_pictures([tmp_path / "whole"])) == 3, "the named folder may be a link"


def test_warns_of_unreadable_formats(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("a.png", "IMG_1.HEIC", "deep/IMG_2.heif"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).touch()
    assert [source.name for source in find_pictures([tmp_path / "in"])] == ["a.png"]
    (warning,) = caplog.messages
    assert warning.startswith(f"{tmp_path}/in contains IMG_1.HEIC and 1 more, skipped: HEIC and AVIF cannot")
    assert [source.name for source in find_pictures(f"file://{tmp_path}/in")] == ["a.png"]
    assert len(caplog.messages) == 2
    (tmp_path / "in/a.png").unlink()
    with pytest.raises(InputError, match=r"IMG_1\.HEIC and 1 more"):
        find_pictures([tmp_path / "in"])
    (tmp_path / "in/deep/IMG_2.heif").unlink()
    with pytest.raises(InputError, match=r"IMG_1\.HEIC, skipped"):
        find_pictures([tmp_path / "in"])


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes, whatever they mean, on Linux only")
def test_escapes_names_that_are_not_text(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    folder = tmp_path / os.fsdecode(b"folder \xe9")
    folder.mkdir()
    data = cv2.imencode(".png", colours[..., ::-1])[1].tobytes()
    (folder / os.fsdecode(b"picture \xff.png")).write_bytes(data)
    (folder / os.fsdecode(b"damaged \xff.png")).write_bytes(data[:60])
    damaged, whole = find_pictures([folder])
    assert (damaged.name, whole.name) == ("damaged \\xff.png", "picture \\xff.png")
    np.testing.assert_array_equal(whole.read().picture, colours)
    with pytest.raises(FormatError):
        damaged.read()


def test_different_paths_have_different_names() -> None:
    parts = [b"\xff", rb"\xff", rb"\\xff", rb"\\\xff", b"\\\xff", b"\\\\\xff", rb"\x7f", b"x", b"\\"]
    paths = {b"".join(some) for count in range(1, 4) for some in itertools.product(parts, repeat=count)}
    names = {PictureFile("folder", os.fsdecode(path)).name for path in paths}
    assert len(names) == len(paths) > 500
    assert PictureFile("folder", r"a\b\x7f.png").name == r"a\b\x7f.png"


@pytest.mark.parametrize("url", [False, True])
def test_skips_data_sets(tmp_path: Path, colours: npt.NDArray[np.uint8], url: bool) -> None:
    for name in ("a.png", "made/images/000000.png", "made/previews/000000.jpg", "more/b.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write(tmp_path / name, colours, "uint8")
    (tmp_path / "made" / "dataset.json").write_text("{}")
    location = str(tmp_path)
    if url:
        location = f"memory://{tmp_path.name}"
        store, top = filesystem(location)
        for path in tmp_path.rglob("*.*"):
            store.pipe_file(f"{top}/{path.relative_to(tmp_path).as_posix()}", path.read_bytes())
    assert [source.name for source in find_pictures([location])] == ["a.png", "more/b.png"]
    # A data set that is named directly is searched.
    inside = find_pictures(f"{location}/made")
    assert [source.name for source in inside] == ["images/000000.png", "previews/000000.jpg"]


def test_refuses_two_pictures_of_one_name(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "a.png", colours, "uint8")
    with pytest.raises(InputError, match=r"name a\.png: .*one/a\.png and .*two/a\.png"):
        find_pictures([tmp_path / "one", tmp_path / "two"])
    with pytest.raises(InputError, match=r"one/a\.png is named twice"):
        find_pictures([tmp_path / "one", tmp_path / "one"])
    assert [found.name for found in find_pictures(tmp_path)] == ["one/a.png", "two/a.png"]


def test_names_have_no_line_breaks(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    write(tmp_path / "a.png", colours, "uint8").rename(tmp_path / "a\rb.png")
    assert find_pictures([tmp_path])[0].name == "a\\rb.png"


def test_reports_picture_too_large_for_memory(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "large.png", colours, "uint8")

    def full(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr(sources_module, "open_picture", full)
    with pytest.raises(InputError, match=r"large\.png.*workers"):
        find_pictures(path)[0].read()


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
def test_large_files_are_hashed_like_small_ones(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    source = find_pictures(write(tmp_path / name, colours, "uint8"))[0]
    at_once = source.read()
    monkeypatch.setattr(sources_module, "_BYTES_READ_AT_ONCE", 10)
    in_pieces = source.read()
    assert at_once.sha256 == in_pieces.sha256 == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
    np.testing.assert_array_equal(at_once.picture, in_pieces.picture)


def test_skips_circular_links(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    write(tmp_path / "picture.png", colours, "uint8")
    (tmp_path / "a.png").symlink_to(tmp_path / "b.png")
    (tmp_path / "b.png").symlink_to(tmp_path / "a.png")
    assert [found.name for found in find_pictures([tmp_path])] == ["picture.png"]


@pytest.mark.parametrize(
    ("number", "kind"),
    [(errno.EACCES, FormatError), (errno.EIO, FormatError), (errno.EMFILE, StorageError), (errno.ESTALE, StorageError)],
)
def test_distinguishes_faults_of_file_and_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[Exception]
) -> None:
    (tmp_path / "a.png").write_bytes(b"any")
    (source,) = find_pictures([tmp_path])

    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(kind, match=rf"cannot read .*a\.png: {os.strerror(number)};"):
        source.read()


def test_reads_pictures_of_a_store(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    store, root = filesystem(f"memory://{tmp_path.name}")
    local: list[Path] = []
    for name in ("b.png", "in/a.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        local.append(write(tmp_path / f"{name}.png", colours, "uint8"))
        store.pipe_file(f"{root}/{name}", local[-1].read_bytes())
    found = find_pictures([f"memory://{tmp_path.name}"])
    assert [source.name for source in found] == ["b.png", "in/a.png"]
    for source in found:
        picture = source.read()
        np.testing.assert_array_equal(picture.picture, colours)
        assert picture.sha256 == hashlib.sha256(local[0].read_bytes()).hexdigest()
    (alone,) = find_pictures([f"memory://{tmp_path.name}/b.png"])
    assert alone.name == "b.png"
    np.testing.assert_array_equal(alone.read().picture, colours)
    store.rm(f"{root}/b.png")
    with pytest.raises(FormatError, match=r"cannot read memory://.*b\.png"):
        alone.read()
    with pytest.raises(InputError):
        find_pictures([f"memory://{tmp_path.name}/nothing"])
    with pytest.raises(InputError, match="cannot open the store nostore://"):
        find_pictures(["nostore://a/b"])


def test_refuses_locations_without_pictures(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError):
        find_pictures([tmp_path / "empty"])
    with pytest.raises(InputError, match=r"nowhere does not exist"):
        find_pictures([tmp_path / "nowhere"])


@pytest.mark.slow
def test_random_scenes_are_uniform_and_independent() -> None:
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


Codes = npt.NDArray[np.uint8]

ADOBE = gamma_profile("Adobe RGB stand-in", 563 / 256, ADOBE_RGB)

PROPHOTO = gamma_profile("ProPhoto stand-in", 1.8, PROPHOTO_RGB)


def save(path: Path, codes: Codes, icc: bytes | None) -> Path:
    """Write a picture with Pillow."""
    Image.fromarray(codes).save(path, icc_profile=icc)
    return path


@pytest.fixture
def muted_codes() -> Codes:
    # Not too saturated, so that no code falls outside sRGB.
    return np.random.default_rng(3).integers(90, 170, (16, 16, 3)).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("icc", "space"),
    [(ADOBE, "Adobe RGB (1998)"), (PROPHOTO, "ProPhoto RGB")],
    ids=["adobe", "prophoto"],
)
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_converts_other_colour_spaces(tmp_path: Path, muted_codes: Codes, icc: bytes, space: str, suffix: str) -> None:
    import colour

    grey = np.full_like(muted_codes, 120) if suffix == "jpg" else muted_codes
    path = save(tmp_path / f"picture.{suffix}", grey, icc)
    reading = open_picture(path)
    source = colour.RGB_COLOURSPACES[space]
    gamma = 563 / 256 if "Adobe" in space else 1.8
    linear = (grey / 255.0) ** gamma
    # The profile connection space has the white D50; both ends are adapted by Bradford's transform.
    target = colour.RGB_COLOURSPACES["sRGB"]
    expected = colour.RGB_to_RGB(linear, source, target, chromatic_adaptation_transform="Bradford")
    codes = np.where(expected <= 0.0031308, 12.92 * expected, 1.055 * np.abs(expected) ** (1 / 2.4) - 0.055) * 255
    assert np.abs(reading.picture - np.clip(codes, 0, 255)).max() <= 2
    assert "stand-in, converted to sRGB" in reading.profile
    assert np.abs(reading.picture.astype(int) - grey).max() > 2 or suffix == "jpg"


def test_keeps_srgb_of_any_name(tmp_path: Path, muted_codes: Codes) -> None:
    made = ImageCms.createProfile("sRGB")
    icc = ImageCms.ImageCmsProfile(made).tobytes()
    reading = open_picture(save(tmp_path / "picture.png", muted_codes, icc))
    np.testing.assert_array_equal(reading.picture, muted_codes)
    assert reading.profile.endswith("is sRGB")


@pytest.mark.parametrize("icc", [b"", b"nonsense", ADOBE[:200]])
def test_ignores_damaged_profile(muted_codes: Codes, icc: bytes) -> None:
    codes, remark = to_srgb(muted_codes, icc)
    np.testing.assert_array_equal(codes, muted_codes)
    assert remark.startswith("damaged")
    assert remark.endswith("taken as sRGB")


def png_with(path: Path, codes: Codes, profile: bytes) -> bytes:
    """Return a PNG file with these bytes as colour profile."""
    content = save(path, codes, None).read_bytes()
    chunk = b"iCCPname\0\0" + profile
    profile_chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return content[:33] + profile_chunk + content[33:]


@pytest.mark.parametrize("profile", [b"rubbish", zlib.compress(b"no profile" * 30), zlib.compress(ADOBE[:200])])
def test_notes_dropped_profile(tmp_path: Path, muted_codes: Codes, profile: bytes) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(png_with(path, muted_codes, profile))
    reading = open_picture(path)
    np.testing.assert_array_equal(reading.picture, muted_codes)
    assert reading.profile.startswith("damaged")
    assert reading.notes == (PROFILE_UNUSED,)
    path.write_bytes(png_with(path, muted_codes, zlib.compress(ADOBE)))
    assert open_picture(path).profile.endswith("converted to sRGB")


@pytest.mark.parametrize("damage", ["checksum", "cut"])
def test_damaged_png_prints_nothing(
    tmp_path: Path, muted_codes: Codes, damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "picture.png", muted_codes, None)
    data = bytearray(path.read_bytes())
    data[-30] ^= 1
    path.write_bytes(data if damage == "checksum" else data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"IDAT at byte 33"):
        open_picture(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("index", ["R03", "R98"])
def test_converts_adobe_rgb_of_cameras(
    tmp_path: Path, muted_codes: Codes, index: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The space is named by EXIF's "uncalibrated" and DCF's interoperability index R03; R98 is sRGB."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: index}
    path = tmp_path / "_MG_0001.jpg"
    Image.fromarray(muted_codes).save(path, exif=exif, quality=100)
    Image.fromarray(muted_codes).save(tmp_path / "plain.jpg", quality=100)
    reading, ignored = open_picture(path), open_picture(tmp_path / "plain.jpg")
    if index == "R98":
        np.testing.assert_array_equal(reading.picture, ignored.picture)
        assert reading.profile == "none, taken as sRGB"
        return
    expected, _ = to_srgb(ignored.picture, ADOBE)
    assert np.abs(reading.picture.astype(int) - expected).max() <= 1
    assert np.abs(reading.picture.astype(int) - ignored.picture).max() > 10
    assert reading.profile == "Adobe RGB (1998) by EXIF, converted to sRGB"
    # A picture too large for Pillow is no error.
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1)
    assert open_picture(path).profile == "none, taken as sRGB"


def test_applies_grey_profile(tmp_path: Path) -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    icc = gamma_profile("Grey 1.8", 1.8, None)
    reading = open_picture(save(tmp_path / "grey.png", grey, icc))
    linear = (grey / 255.0) ** 1.8
    code = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(reading.picture - code[..., None]).max() <= 1.5


@pytest.mark.parametrize("mode", ["YCbCr", "L", "CMYK"])
def test_jpeg_codes_equal_those_of_pillow(tmp_path: Path, muted_codes: Codes, mode: str) -> None:
    path = tmp_path / "picture.jpg"
    Image.fromarray(muted_codes).convert(mode).save(path, quality=90)
    expected = np.asarray(Image.open(path).convert("RGB"), dtype=np.int16)
    assert np.abs(open_picture(path).picture - expected).max() <= (1 if mode != "CMYK" else 3)


@given(keep=st.floats(0.05, 0.999))
def test_refuses_truncated_jpeg(tmp_path_factory: pytest.TempPathFactory, keep: float) -> None:
    stream = io.BytesIO()
    Image.fromarray(np.random.default_rng(3).integers(0, 255, (40, 40, 3)).astype(np.uint8)).save(stream, "JPEG")
    path = tmp_path_factory.mktemp("cut") / "picture.jpg"
    path.write_bytes(stream.getvalue()[: int(keep * len(stream.getvalue())) - 2])
    with pytest.raises(FormatError, match=r"picture\.jpg"):
        open_picture(path)


def ramp(width: int, height: int) -> Codes:
    """Return a picture with the position as codes: R is the column, G the row."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([columns, rows, rows * 0], axis=-1).astype(np.uint8)


def test_crops_the_centre(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(60, 41), None)
    np.testing.assert_array_equal(open_picture(path, Preparation(crop=(10, 5))).picture, ramp(60, 41)[18:23, 25:35])


def test_cover_keeps_the_narrow_side(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(200, 100), None)
    crop = open_picture(path, Preparation(crop=(50, 50), cover=True)).picture
    assert crop.shape == (50, 50, 3)
    assert crop[0, 0].tolist()[1] <= 1
    assert crop[-1, 0].tolist()[1] >= 98
    assert 49 <= crop[0, 0, 0] <= 52


@pytest.mark.slow
def test_random_crops_depend_on_name_and_seed(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(13, 12), None)
    corners: set[tuple[int, int]] = set()
    for seed in range(200):
        crop = open_picture(path, Preparation(crop=(10, 10), crop_at="random", seed=seed), "a").picture
        corners.add((int(crop[0, 0, 0]), int(crop[0, 0, 1])))
    # Of 12 places one is missed by 200 draws with a chance below 12 · (11/12)^200 < 1e-6.
    assert corners == {(x, y) for x in range(4) for y in range(3)}
    cut = Preparation(crop=(10, 10), crop_at="random")
    np.testing.assert_array_equal(open_picture(path, cut, "a").picture, open_picture(path, cut, "a").picture)
    corners_by_name = {tuple(open_picture(path, cut, str(number)).picture[0, 0]) for number in range(200)}
    assert len(corners_by_name) == 12


@pytest.mark.parametrize("suffix", ["png", "tif", "bmp", "ppm", "tga", "webp"])
def test_keeps_codes_of_lossless_files(tmp_path: Path, colours: npt.NDArray[np.uint8], suffix: str) -> None:
    path = tmp_path / f"picture.{suffix}"
    options = [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else []
    if suffix == "tga":
        write(path, colours, "uint8")
    else:
        path.write_bytes(cv2.imencode(f".{suffix}", colours[..., ::-1], options)[1].tobytes())
    np.testing.assert_array_equal(read_picture(path), colours)


def test_rounds_16_bits_to_8(tmp_path: Path) -> None:
    values = np.array([[0, 128, 129, 257, 385, 386, 32767, 32768, 65406, 65407, 65535]], np.uint16)
    path = write(tmp_path / "deep.png", values[..., None].repeat(3, axis=2), "uint16")
    nearest = np.rint(values.astype(np.float64) * 255 / 65535)
    np.testing.assert_array_equal(read_picture(path)[..., 1], nearest)


def test_grey_becomes_three_equal_codes(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    path = write(tmp_path / "grey.png", colours[..., :1], "uint8")
    np.testing.assert_array_equal(read_picture(path), colours[..., :1].repeat(3, axis=2))


STRAIGHT = ["png", "tif", "tga", "bmp", "sgi", "dds", "jp2", "jxl", "dpx", "unsaid.tif"]


@pytest.mark.parametrize("suffix", STRAIGHT)
def test_composites_transparency_on_white(tmp_path: Path, suffix: str) -> None:
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


def test_composites_gif_on_white(tmp_path: Path) -> None:
    sources = Image.new("P", (3, 1))
    sources.putpalette([200, 10, 0, 0, 90, 7])
    sources.putdata([0, 1, 0])
    sources.save(tmp_path / "clear.gif", transparency=0)
    np.testing.assert_array_equal(read_picture(tmp_path / "clear.gif"), [[[255] * 3, [0, 90, 7], [255] * 3]])


def test_does_not_multiply_associated_alpha_again(tmp_path: Path) -> None:
    path = tmp_path / "associated.tif"
    rgba = np.array([[[100, 5, 0, 128], [0, 0, 0, 0], [9, 8, 7, 255]]], np.uint8)
    tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["assocalpha"])
    np.testing.assert_array_equal(read_picture(path), [[[227, 132, 127], [255] * 3, [9, 8, 7]]])


def test_ignores_fourth_byte_of_bmp(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
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


def test_composites_linear_light_before_encoding(tmp_path: Path) -> None:
    half = np.array([[[0.25, 0.0, 0.0, 0.5]]], np.float32)  # associated: red 0.5 at half coverage
    sources = read_picture(write(tmp_path / "clear.exr", half, "float"))
    np.testing.assert_array_equal(sources[0, 0], [225, 188, 188])  # codes of 0.75, 0.5, 0.5


@pytest.mark.parametrize("orientation", range(1, 9))
def test_turns_pictures_upright(tmp_path: Path, colours: npt.NDArray[np.uint8], orientation: int) -> None:
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
    upright = read_picture(path)
    sides = {"top": upright[0], "bottom": upright[-1], "left": upright[:, 0], "right": upright[:, -1]}

    def same(side: npt.NDArray[np.uint8], stored: npt.NDArray[np.uint8]) -> bool:
        return side.tolist() in (stored.tolist(), stored[::-1].tolist())

    assert same(sides[row0], colours[0])
    assert same(sides[column0], colours[:, 0])


def test_reduces_larger_pictures_only(tmp_path: Path) -> None:
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
def test_refuses_damaged_files_with_reason(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(DAMAGED[name])
    with pytest.raises(FormatError, match=rf"cannot read .*{name}: .+; .*another"):
        read_picture(path)


def test_refuses_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"none\.png.*no such file"):
        read_picture(tmp_path / "none.png")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a picture of 60 x 50 px."""
    codes = np.random.default_rng(3).integers(0, 256, (50, 60, 3)).astype(np.uint8)
    file = tmp_path / "a.png"
    file.write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return file


def test_crops_are_parts_of_the_picture(path: Path) -> None:
    whole = open_picture(path).picture
    several = open_picture(path, Preparation(crop=(16, 12), crops=5, seed=4))
    single = open_picture(path, Preparation(crop=(16, 12), crop_at="random", seed=4))
    np.testing.assert_array_equal(several.picture, single.picture)
    assert len({(cut.left, cut.top) for cut in several.cuts}) == 5
    for cut in several.cuts:
        np.testing.assert_array_equal(cut.picture, whole[cut.top : cut.top + 12, cut.left : cut.left + 16])
    fewer = open_picture(path, Preparation(crop=(16, 12), crops=2, seed=4))
    assert [(cut.left, cut.top) for cut in fewer.cuts] == [(cut.left, cut.top) for cut in several.cuts[:2]]
    another_seed = open_picture(path, Preparation(crop=(16, 12), crops=2, seed=5))
    assert [(cut.left, cut.top) for cut in another_seed.cuts] != [(cut.left, cut.top) for cut in fewer.cuts]


def test_first_crop_in_the_centre_on_request(path: Path) -> None:
    whole = open_picture(path, Preparation(crop=(16, 12))).picture
    preparation = Preparation(crop=(16, 12), crops=4, crop_at="centre", seed=4)
    cuts = open_picture(path, preparation).cuts
    assert (cuts[0].left, cuts[0].top) == (22, 19)
    np.testing.assert_array_equal(cuts[0].picture, whole)
    assert len({(cut.left, cut.top) for cut in cuts}) == 4


@pytest.mark.slow
def test_crops_overlap_little() -> None:
    def shared(count: int, is_one_picture: bool) -> float:
        """Return the mean share of a crop that the second has in common with the first."""
        total = 0
        for number in range(count):
            if is_one_picture:
                first, second = random_positions((61, 41), (40, 40), 2, 9, f"{number}.png")
            else:
                (first,), (second,) = (random_positions((61, 41), (40, 40), 1, s, f"{number}.png") for s in (9, 10))
            total += max(0, 40 - abs(first[0] - second[0])) * max(0, 40 - abs(first[1] - second[1]))
        return total / 1600 / count

    assert shared(300, is_one_picture=True) < 0.35 * shared(300, is_one_picture=False)


def test_finds_all_positions(path: Path) -> None:
    assert len(set(random_positions((5, 4), (9, 9), 20, 1, "x"))) == 20
    with pytest.raises(FormatError):
        open_picture(path, Preparation(crop=(58, 50), crops=4))


@pytest.mark.slow
def test_random_positions_are_uniform() -> None:
    places = np.array([random_positions((10, 10), (5, 5), 1, 0, f"{number}")[0] for number in range(1500)])
    counts = np.bincount(places[:, 0] * 10 + places[:, 1], minlength=100)
    # Chi-squared of 99 degrees of freedom exceeds 149 once in a thousand.
    assert np.square(counts - 15).sum() / 15 < 149


@pytest.mark.slow
def test_prepared_pictures(tmp_path: Path, pinned: Pinned) -> None:
    y, x = np.mgrid[:41, :63]
    codes = np.stack([4 * x, 6 * y, (x * y) % 256], axis=-1).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    pins: dict[str, Any] = {}
    options: list[dict[str, Any]] = [{}, *({"max_side": side} for side in (63, 62, 20, 1))]
    options += [{"crop": size} for size in ((63, 41), (64, 41), (10, 12))]
    options += [{"crop": (20, 20), "cover": True}, {"crop": (10, 12), "crop_at": "random", "seed": 5}]
    options += [{"max_side": 30, "crop": (30, 10), "cover": True, "seed": 3, "crops": 4}]
    options += [{"crop": (62, 40), "crops": 4, "seed": 1}, {"crop": (62, 40), "crops": 5}]
    options += [{"crop": (8, 8), "crop_at": "centre", "seed": 2, "crops": 3}]
    options += [{"crop": (40, 3), "cover": True, "crop_at": "random", "seed": 9}]
    preparations = [Preparation(**entry) for entry in options]
    for number, preparation in enumerate(preparations):
        read = said(open_picture, tmp_path / "a.png", preparation)
        cuts = read if isinstance(read, dict) else [
            read.picture.shape, read.picture, [[cut.left, cut.top, cut.picture[0, 0]] for cut in read.cuts]
        ]  # fmt: skip
        pins[str(number)] = [preparation.describe(), preparation.first_crop_at, cuts]
    invalid: list[dict[str, Any]] = [
        {"max_side": 0},
        {"crop": (0, 3)},
        {"crop": (65536, 1)},
        {"cover": True},
        {"crops": 0},
    ]
    invalid += [{"crops": 2}, {"crop_at": "random"}, {"max_side": 8, "crop": (9, 3)}, {"crop": (65535, 1)}]
    pins["refused"] = [said(Preparation, **entry) for entry in invalid]
    start_counts = ((1, 1, 1), (2, 2, 4), (5, 3, 15), (300, 200, 6), (40, 1, 9))
    pins["places"] = [
        random_positions((across, down), (16, 12), count, 2**40 + 1, name, first)
        for across, down, count in start_counts
        for name in ("a.png", "é")
        for first in (None, (across // 2, down // 2))
    ]
    bits = np.arange(256, dtype=np.uint8)[::7]
    pins["bits"] = [clear_bits(bits, 0), clear_bits(bits, 5), clear_bits(bits, 8)]
    scenes = random_scenes(3, 7, 5, 2**33 + 2)
    pins["scenes"] = [
        [scene.name, scene.to_json(), scene.read().picture] for scene in (*scenes, RandomScene(9, 1, 1, 0))
    ]
    pins["no scenes"] = [said(random_scenes, *options) for options in ((0, 4, 4), (1, 0, 4), (1, 65536, 1), (-1, 4, 4))]
    pinned("prepared pictures", pins, same=1e-4)
