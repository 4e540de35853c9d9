"""Profiles, crops and sizes: what is done to pictures on their way to the printer."""

from __future__ import annotations

import io
from pathlib import Path

import colour
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageCms

from foundation.errors import FormatError, InputError
from generator.pictures.picture import Preparation, open_picture, to_srgb
from tests.generator.pictures.icc import gamma_profile

Codes = npt.NDArray[np.uint8]

ADOBE_RGB = gamma_profile("Adobe RGB stand-in", 563 / 256, colour.RGB_COLOURSPACES["Adobe RGB (1998)"])
PROPHOTO = gamma_profile("ProPhoto stand-in", 1.8, colour.RGB_COLOURSPACES["ProPhoto RGB"])


def save(path: Path, codes: Codes, icc: bytes | None) -> Path:
    """Write a picture with Pillow."""
    Image.fromarray(codes).save(path, icc_profile=icc)
    return path


@pytest.fixture
def dull() -> Codes:
    # Not too saturated, so that no code falls outside sRGB.
    return np.random.default_rng(3).integers(90, 170, (16, 16, 3)).astype(np.uint8)


@pytest.mark.parametrize(
    ("icc", "space"),
    [(ADOBE_RGB, "Adobe RGB (1998)"), (PROPHOTO, "ProPhoto RGB")],
    ids=["adobe", "prophoto"],
)
@pytest.mark.parametrize("suffix", ["png", "tif", "jpg"])
def test_codes_of_another_space_are_converted(tmp_path: Path, dull: Codes, icc: bytes, space: str, suffix: str) -> None:
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
    path = save(tmp_path / "picture.png", dull, ADOBE_RGB)
    reading = open_picture(path, Preparation(profiles="ignore"))
    np.testing.assert_array_equal(reading.picture, dull)
    assert reading.profile == "ignored, taken as sRGB"


def test_srgb_under_any_name_is_left_alone(tmp_path: Path, dull: Codes) -> None:
    made = ImageCms.createProfile("sRGB")  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    icc = ImageCms.ImageCmsProfile(made).tobytes()  # pyright: ignore[reportUnknownArgumentType]
    reading = open_picture(save(tmp_path / "picture.png", dull, icc))
    np.testing.assert_array_equal(reading.picture, dull)
    assert reading.profile.endswith("is sRGB")


def test_no_profile_is_said(tmp_path: Path, dull: Codes) -> None:
    assert open_picture(save(tmp_path / "picture.png", dull, None)).profile == "none, taken as sRGB"


@pytest.mark.parametrize("icc", [b"", b"nonsense", ADOBE_RGB[:200]])
def test_a_damaged_profile_costs_no_picture(dull: Codes, icc: bytes) -> None:
    codes, word = to_srgb(dull, icc)
    np.testing.assert_array_equal(codes, dull)
    assert word.startswith("damaged")
    assert word.endswith("taken as sRGB")


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
    wanted, _ = to_srgb(ignored.picture, ADOBE_RGB)
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


def test_a_grey_profile_says_nothing_of_colours(dull: Codes) -> None:
    codes, word = to_srgb(dull, gamma_profile("Grey 1.8", 1.8, None))
    np.testing.assert_array_equal(codes, dull)
    assert word == "Grey 1.8 of grey, not applied to colours, taken as sRGB"


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


def test_random_places_depend_on_name_and_seed_and_reach_every_edge(tmp_path: Path) -> None:
    path = save(tmp_path / "ramp.png", ramp(13, 12), None)
    corners: set[tuple[int, int]] = set()
    for seed in range(400):
        cut = Preparation(crop=(10, 10), crop_at="random", seed=seed)
        seen = open_picture(path, cut, "a").picture
        np.testing.assert_array_equal(seen, open_picture(path, cut, "a").picture)
        corners.add((int(seen[0, 0, 0]), int(seen[0, 0, 1])))
    # Of 12 places one is missed by 400 draws with a chance below 12 · (11/12)^400 < 1e-14.
    assert corners == {(x, y) for x in range(4) for y in range(3)}
    cut = Preparation(crop=(10, 10), crop_at="random")
    named = {tuple(open_picture(path, cut, str(number)).picture[0, 0]) for number in range(400)}
    assert len(named) == 12


def test_a_picture_smaller_than_the_crop_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "small.png", ramp(60, 41), None)
    with pytest.raises(FormatError, match="60x41 px where the crop is 60x42"):
        open_picture(path, Preparation(crop=(60, 42)))


@pytest.mark.parametrize(
    "wrong", [{"max_side": 0}, {"crop": (0, 5)}, {"crop": (5, 70000)}, {"cover": True}, {"crop_at": "random"}]
)
def test_impossible_preparations_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(InputError):
        Preparation(**wrong)  # pyright: ignore[reportArgumentType]
