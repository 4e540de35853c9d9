"""Impossible values in TIFF directories raise one error."""

from __future__ import annotations

import struct

import pytest
import tifffile

from drivers.tiff import TiffDamaged, TiffTag, read_directories

TAG = int(TiffTag.BLACK_LEVEL)


def tiff(tag: int, kind: int, count: int, value: bytes) -> bytes:
    """Return a file of one directory with one tag; a value of more than four bytes follows."""
    place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", 26)
    return b"II*\0" + struct.pack("<IHHHI", 8, 1, tag, kind, count) + place + bytes(4) + value * (len(value) > 4)


@pytest.mark.parametrize(("kind", "letter"), [(11, "f"), (12, "d")])
@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), 1e38, -1e38])
def test_refuses_numbers_out_of_range(kind: int, letter: str, number: float) -> None:
    with pytest.raises(TiffDamaged):
        read_directories(tiff(TAG, kind, 1, struct.pack("<" + letter, number)))


@pytest.mark.parametrize(
    ("tag", "kind", "value"),
    [
        (TiffTag.SUB_IFDS, 12, struct.pack("<d", 1e300)),
        (TiffTag.SUB_IFDS, 9, struct.pack("<i", -8)),
        (TiffTag.STRIP_OFFSETS, 3, struct.pack("<H", 26)),
        (TiffTag.IMAGE_WIDTH, 2, b"640\0"),
        (TiffTag.IMAGE_WIDTH, 5, struct.pack("<II", 640, 1)),
        (TiffTag.BLACK_LEVEL, 2, b"64\0"),
        (TiffTag.CFA_PATTERN, 0, b"\0\1\1\2"),
        (TiffTag.TILE_OFFSETS, 16, struct.pack("<Q", 26)),
    ],
)
def test_refuses_numbers_of_another_type(tag: TiffTag, kind: int, value: bytes) -> None:
    with pytest.raises(TiffDamaged, match=f"its tag {int(tag)} is of type {kind}"):
        read_directories(tiff(tag, kind, 1, value))


def test_ignores_a_text_of_another_type() -> None:
    (directory,) = read_directories(tiff(TiffTag.LENS_MODEL, 7, 4, b"EF\0\0"))
    assert directory.text(TiffTag.LENS_MODEL) == ""


def test_zero_denominator_is_damage_except_in_exposure_tags() -> None:
    nothing = struct.pack("<II", 0, 0)
    with pytest.raises(TiffDamaged):
        read_directories(tiff(TAG, 5, 1, nothing))
    (directory,) = read_directories(tiff(TiffTag.F_NUMBER, 5, 1, nothing))
    assert directory.numbers(TiffTag.F_NUMBER) == (0.0,)


def test_refuses_huge_directories() -> None:
    # Five entries with the largest number of values, and a directory with too many entries.
    entry = struct.pack("<HHII", TiffTag.LINEARIZATION_TABLE, 1, 1 << 17, 0)
    with pytest.raises(TiffDamaged):
        read_directories((b"II*\0" + struct.pack("<IH", 8, 5) + 5 * entry).ljust(1 << 18, b"\0"))
    with pytest.raises(TiffDamaged, match="513 entries"):
        read_directories(b"II*\0" + struct.pack("<IH", 8, 513) + bytes(12 * 513))


def test_reads_floating_point_numbers() -> None:
    (directory,) = read_directories(tiff(TAG, 12, 1, struct.pack("<d", 2047.5)))
    assert directory.numbers(TiffTag.BLACK_LEVEL) == (2047.5,)


# Names of tifffile that differ from ours: an older edition of Exif, and a tag of Canon that Adobe named.
_OTHER_NAMES = {
    "ExifTag": "EXIF_IFD_POINTER",
    "ISOSpeedRatings": "PHOTOGRAPHIC_SENSITIVITY",
    "RawImageSegmentation": "CR2_SLICES",
}


@pytest.mark.parametrize("tag", TiffTag)
def test_tags_have_the_codes_of_the_registry(tag: TiffTag) -> None:
    registered = tifffile.TIFF.TAGS[int(tag)]
    assert _OTHER_NAMES.get(registered, registered).replace("_", "").lower() == tag.name.replace("_", "").lower()
