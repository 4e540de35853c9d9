"""Pictures of every kind become the sRGB codes that the head of `picture.py` promises.

Profiles, crops and sizes: what is done to pictures on their way to the printer.

"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import numpy.typing as npt
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms

from foundation.errors import FormatError
from generator.pictures.conversion import to_srgb
from generator.pictures.sources import PROFILE_UNUSED, Preparation, open_picture, read_picture
from tests.generator.pictures.icc import ADOBE_RGB, PROPHOTO_RGB, gamma_profile
from tests.generator.pictures.oiio_files import write

Codes = npt.NDArray[np.uint8]

ADOBE = gamma_profile("Adobe RGB stand-in", 563 / 256, ADOBE_RGB)
PROPHOTO = gamma_profile("ProPhoto stand-in", 1.8, PROPHOTO_RGB)


def save(path: Path, codes: Codes, icc: bytes | None) -> Path:
    """Write a picture with Pillow."""
    Image.fromarray(codes).save(path, icc_profile=icc)
    return path


@pytest.fixture
def dull() -> Codes:
    # Not too saturated, so that no code falls outside sRGB.
    return np.random.default_rng(3).integers(90, 170, (16, 16, 3)).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("icc", "space"),
    [(ADOBE, "Adobe RGB (1998)"), (PROPHOTO, "ProPhoto RGB")],
    ids=["adobe", "prophoto"],
)
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_codes_of_another_space_are_converted(tmp_path: Path, dull: Codes, icc: bytes, space: str, suffix: str) -> None:
    import colour

    grey = np.full_like(dull, 120) if suffix == "jpg" else dull
    path = save(tmp_path / f"picture.{suffix}", grey, icc)
    reading = open_picture(path)
    source = colour.RGB_COLOURSPACES[space]
    gamma = 563 / 256 if "Adobe" in space else 1.8
    linear = (grey / 255.0) ** gamma
    # The profile connection space has the white D50; both ends are adapted by Bradford's transform.
    target = colour.RGB_COLOURSPACES["sRGB"]
    wanted = colour.RGB_to_RGB(linear, source, target, chromatic_adaptation_transform="Bradford")
    code = np.where(wanted <= 0.0031308, 12.92 * wanted, 1.055 * np.abs(wanted) ** (1 / 2.4) - 0.055) * 255
    assert np.abs(reading.picture - np.clip(code, 0, 255)).max() <= 2
    assert "stand-in, converted to sRGB" in reading.profile
    assert np.abs(reading.picture.astype(int) - grey).max() > 2 or suffix == "jpg"


def test_profiles_are_ignored_when_asked(tmp_path: Path, dull: Codes) -> None:
    path = save(tmp_path / "picture.png", dull, ADOBE)
    reading = open_picture(path, Preparation(profiles="ignore"))
    np.testing.assert_array_equal(reading.picture, dull)
    assert reading.profile == "ignored, taken as sRGB"


def test_srgb_under_any_name_is_left_alone(tmp_path: Path, dull: Codes) -> None:
    made = ImageCms.createProfile("sRGB")
    icc = ImageCms.ImageCmsProfile(made).tobytes()
    reading = open_picture(save(tmp_path / "picture.png", dull, icc))
    np.testing.assert_array_equal(reading.picture, dull)
    assert reading.profile.endswith("is sRGB")


@pytest.mark.parametrize("icc", [b"", b"nonsense", ADOBE[:200]])
def test_a_damaged_profile_costs_no_picture(dull: Codes, icc: bytes) -> None:
    codes, word = to_srgb(dull, icc)
    np.testing.assert_array_equal(codes, dull)
    assert word.startswith("damaged")
    assert word.endswith("taken as sRGB")


def png_with(path: Path, codes: Codes, profile: bytes) -> bytes:
    """Return a PNG file whose colour profile is what is given, as it stands in the file."""
    plain = save(path, codes, None).read_bytes()
    chunk = b"iCCPname\0\0" + profile
    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return plain[:33] + whole + plain[33:]


@pytest.mark.parametrize("profile", [b"rubbish", zlib.compress(b"no profile" * 30), zlib.compress(ADOBE[:200])])
def test_a_profile_that_the_reader_drops_is_noted(tmp_path: Path, dull: Codes, profile: bytes) -> None:
    path = tmp_path / "picture.png"
    path.write_bytes(png_with(path, dull, profile))
    reading = open_picture(path)
    np.testing.assert_array_equal(reading.picture, dull)
    assert reading.profile.startswith("damaged")
    assert reading.notes == (PROFILE_UNUSED,)
    path.write_bytes(png_with(path, dull, zlib.compress(ADOBE)))
    assert open_picture(path).profile.endswith("converted to sRGB")


@pytest.mark.parametrize("damage", ["checksum", "cut"])
def test_of_a_damaged_png_nothing_reaches_the_terminal_but_our_sentence(
    tmp_path: Path, dull: Codes, damage: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = save(tmp_path / "picture.png", dull, None)
    data = bytearray(path.read_bytes())
    data[-30] ^= 1
    path.write_bytes(data if damage == "checksum" else data[: len(data) // 2])
    with pytest.raises(FormatError, match=r"IDAT at byte 33"):
        open_picture(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("index", ["R03", "R98"])
def test_a_camera_s_adobe_rgb_is_converted(
    tmp_path: Path, dull: Codes, index: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The space is named by EXIF's "uncalibrated" and DCF's interoperability index R03; R98 is sRGB."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: index}
    path = tmp_path / "_MG_0001.jpg"
    Image.fromarray(dull).save(path, exif=exif, quality=100)
    reading, ignored = open_picture(path), open_picture(path, Preparation(profiles="ignore"))
    if index == "R98":
        np.testing.assert_array_equal(reading.picture, ignored.picture)
        assert reading.profile == "none, taken as sRGB"
        return
    wanted, _ = to_srgb(ignored.picture, ADOBE)
    assert np.abs(reading.picture.astype(int) - wanted).max() <= 1
    assert np.abs(reading.picture.astype(int) - ignored.picture).max() > 10
    assert reading.profile == "Adobe RGB (1998) by EXIF, converted to sRGB"
    assert ignored.profile == "ignored, taken as sRGB"
    # What Pillow refuses to open for its size is no fault.
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1)
    assert open_picture(path).profile == "none, taken as sRGB"


def test_a_grey_profile_is_applied(tmp_path: Path) -> None:
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    icc = gamma_profile("Grey 1.8", 1.8, None)
    reading = open_picture(save(tmp_path / "grey.png", grey, icc))
    linear = (grey / 255.0) ** 1.8
    code = 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(reading.picture - code[..., None]).max() <= 1.5


@pytest.mark.parametrize("mode", ["YCbCr", "L", "CMYK"])
def test_jpeg_gives_the_codes_that_pillow_gives(tmp_path: Path, dull: Codes, mode: str) -> None:
    path = tmp_path / "picture.jpg"
    Image.fromarray(dull).convert(mode).save(path, quality=90)
    seen = np.asarray(Image.open(path).convert("RGB"), dtype=np.int16)
    assert np.abs(open_picture(path).picture - seen).max() <= (1 if mode != "CMYK" else 3)


@given(keep=st.floats(0.05, 0.999))
def test_a_jpeg_cut_short_is_refused(tmp_path_factory: pytest.TempPathFactory, keep: float) -> None:
    stream = io.BytesIO()
    Image.fromarray(np.random.default_rng(3).integers(0, 255, (40, 40, 3)).astype(np.uint8)).save(stream, "JPEG")
    path = tmp_path_factory.mktemp("cut") / "picture.jpg"
    path.write_bytes(stream.getvalue()[: int(keep * len(stream.getvalue())) - 2])
    with pytest.raises(FormatError, match=r"picture\.jpg"):
        open_picture(path)


def ramp(width: int, height: int) -> Codes:
    """Return a picture whose codes are the place: R the column, G the row."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([columns, rows, rows * 0], axis=-1).astype(np.uint8)


def test_the_centre_is_cut(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(60, 41), None)
    np.testing.assert_array_equal(open_picture(path, Preparation(crop=(10, 5))).picture, ramp(60, 41)[18:23, 25:35])


def test_covering_keeps_all_of_the_narrow_side(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(200, 100), None)
    seen = open_picture(path, Preparation(crop=(50, 50), cover=True)).picture
    assert seen.shape == (50, 50, 3)
    assert seen[0, 0].tolist()[1] <= 1
    assert seen[-1, 0].tolist()[1] >= 98
    assert 49 <= seen[0, 0, 0] <= 52


@pytest.mark.slow
def test_random_places_depend_on_name_and_seed_and_reach_every_edge(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(13, 12), None)
    corners: set[tuple[int, int]] = set()
    for seed in range(200):
        seen = open_picture(path, Preparation(crop=(10, 10), crop_at="random", seed=seed), "a").picture
        corners.add((int(seen[0, 0, 0]), int(seen[0, 0, 1])))
    # Of 12 places one is missed by 200 draws with a chance below 12 · (11/12)^200 < 1e-6.
    assert corners == {(x, y) for x in range(4) for y in range(3)}
    cut = Preparation(crop=(10, 10), crop_at="random")
    np.testing.assert_array_equal(open_picture(path, cut, "a").picture, open_picture(path, cut, "a").picture)
    named = {tuple(open_picture(path, cut, str(number)).picture[0, 0]) for number in range(200)}
    assert len(named) == 12


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
    sources = Image.new("P", (3, 1))
    sources.putpalette([200, 10, 0, 0, 90, 7])
    sources.putdata([0, 1, 0])
    sources.save(tmp_path / "clear.gif", transparency=0)
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
    sources = read_picture(write(tmp_path / "clear.exr", half, "float"))
    np.testing.assert_array_equal(sources[0, 0], [225, 188, 188])  # codes of 0.75, 0.5, 0.5


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
    with pytest.raises(FormatError, match=r"none\.png.*no such file"):
        read_picture(tmp_path / "none.png")
