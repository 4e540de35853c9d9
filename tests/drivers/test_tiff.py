"""Directories of TIFF whose values no writer means end in one error."""

from __future__ import annotations

import struct

import pytest

from drivers.tiff import TiffDamaged, TiffTag, read_directories

TAG = int(TiffTag.BLACK_LEVEL)


def tiff(tag: int, kind: int, count: int, value: bytes) -> bytes:
    """Return a file of one directory with one tag; a value of more than four bytes follows."""
    place = value.ljust(4, b"\0") if len(value) <= 4 else struct.pack("<I", 26)
    return b"II*\0" + struct.pack("<IHHHI", 8, 1, tag, kind, count) + place + bytes(4) + value * (len(value) > 4)


@pytest.mark.parametrize(("kind", "letter"), [(11, "f"), (12, "d")])
@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf"), 1e38, -1e38])
def test_numbers_that_are_none_are_damage(kind: int, letter: str, number: float) -> None:
    with pytest.raises(TiffDamaged, match="numbers"):
        read_directories(tiff(TAG, kind, 1, struct.pack("<" + letter, number)))


@pytest.mark.parametrize("value", [1e300, 2.0**54])
def test_numbers_that_are_no_place_are_damage(value: float) -> None:
    with pytest.raises(TiffDamaged):
        read_directories(tiff(TiffTag.SUB_IFDS, 12, 1, struct.pack("<d", value)))


@pytest.mark.parametrize("place", [-1, -8, -(1 << 31)])
def test_a_directory_before_the_file_is_damage(place: int) -> None:
    # Python counts negative places from the end.
    with pytest.raises(TiffDamaged, match=f"points to byte {place}"):
        read_directories(tiff(TiffTag.SUB_IFDS, 9, 1, struct.pack("<i", place)))


def test_floating_point_within_reason_is_read() -> None:
    (directory,) = read_directories(tiff(TAG, 12, 1, struct.pack("<d", 2047.5)))
    assert directory.numbers(TiffTag.BLACK_LEVEL) == (2047.5,)
