"""AVIF pictures: read as others are, and refused where their codes are not sRGB's."""

from __future__ import annotations

from pathlib import Path

import colour
import numpy as np
import pytest
from PIL import Image, features

from foundation.errors import FormatError
from generator.pictures.picture import open_picture
from generator.pictures.sources import find_pictures
from tests.generator.pictures.icc import gamma_profile

pytestmark = pytest.mark.skipif(not features.check("avif"), reason="this Pillow is without libavif")

SMOOTH = np.linspace(20, 235, 48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Return a picture of 64 x 48 px."""
    place = tmp_path / "a.avif"
    Image.fromarray(SMOOTH).save(place, quality=95, subsampling="4:4:4")
    return place


def test_codes_are_those_of_the_picture(path: Path) -> None:
    read = open_picture(path)
    assert read.picture.shape == (48, 64, 3)
    assert np.abs(read.picture.astype(int) - SMOOTH).max() <= 6, "the codec loses little at this quality"
    assert read.profile == "none, taken as sRGB"
    assert [source.name for source in find_pictures(path.parent)] == ["a.avif"]


def test_a_profile_is_converted(tmp_path: Path) -> None:
    wide = gamma_profile("wide", 2.2, colour.RGB_COLOURSPACES["Adobe RGB (1998)"])
    Image.fromarray(SMOOTH).save(tmp_path / "wide.avif", quality=95, subsampling="4:4:4", icc_profile=wide)
    Image.fromarray(SMOOTH).save(tmp_path / "wide.png", icc_profile=wide)
    read, other = open_picture(tmp_path / "wide.avif"), open_picture(tmp_path / "wide.png")
    assert read.profile == other.profile == "wide, converted to sRGB"
    assert np.abs(read.picture.astype(int) - other.picture).max() <= 12


def test_orientation_and_transparency(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(SMOOTH).save(tmp_path / "turned.avif", quality=95, subsampling="4:4:4", exif=exif)
    turned = open_picture(tmp_path / "turned.avif").picture
    assert turned.shape == (64, 48, 3)
    assert np.abs(turned.astype(int) - np.rot90(SMOOTH, -1)).max() <= 6
    clear = np.concatenate([SMOOTH, np.zeros((48, 64, 1), np.uint8)], axis=2)
    Image.fromarray(clear).save(tmp_path / "clear.avif", quality=95)
    assert open_picture(tmp_path / "clear.avif").picture.min() == 255, "paper shows through"


@pytest.mark.parametrize(("primaries", "transfer", "is_read"), [(9, 16, False), (12, 13, False), (1, 13, True)])
def test_other_colours_are_refused(path: Path, primaries: int, transfer: int, is_read: bool) -> None:
    """Of Rec. 2100 PQ, Display P3 and sRGB by the code points of H.273."""
    data = bytearray(path.read_bytes())
    place = data.index(b"colrnclx") + 8
    data[place : place + 4] = bytes((0, primaries, 0, transfer))
    path.write_bytes(data)
    if is_read:
        assert open_picture(path).picture.shape == (48, 64, 3)
        return
    with pytest.raises(FormatError, match=f"primaries {primaries} and transfer function {transfer} "):
        open_picture(path)


def test_a_damaged_file_is_named(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(FormatError, match=r"cannot read .*a.avif: .*; use another copy, or convert it to PNG"):
        open_picture(path)
    path.write_bytes(b"no picture")
    with pytest.raises(FormatError, match=r"a\.avif"):
        open_picture(path)
