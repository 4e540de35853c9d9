"""Lays out the head of a TIFF or DNG file of one picture in one uncompressed strip: everything before its pixels.

A pure function of numbers: the same tags give the same bytes, and whoever writes the file puts the head before the
pixels as they lie in memory, little-endian. Reading is `drivers.tiff.reading`.

Sources: TIFF 6.0 section 2, Exif 2.32 section 4.6, DNG 1.7.1 chapter 2.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from fractions import Fraction
from typing import Final

from drivers.tiff.tags import TiffTag


class ValueType(IntEnum):
    """The types of a tag's values that are written (TIFF 6.0, section 2)."""

    BYTE = 1
    ASCII = 2
    SHORT = 3
    LONG = 4
    RATIONAL = 5
    UNDEFINED = 7
    SRATIONAL = 10


Value = tuple[ValueType, Sequence[int]]
"""A tag's type and its numbers; a rational is two of them, numerator first."""

Tags = dict[TiffTag, Value]
"""Values by tag."""

LARGEST_FILE: Final = (1 << 32) - 1
"""Bytes that the 32-bit offsets of TIFF reach."""

_LETTERS: Final = {
    ValueType.BYTE: "B",
    ValueType.ASCII: "B",
    ValueType.SHORT: "H",
    ValueType.LONG: "I",
    ValueType.RATIONAL: "II",
    ValueType.UNDEFINED: "B",
    ValueType.SRATIONAL: "ii",
}
_HEADER: Final = struct.pack("<2sHI", b"II", 42, 8)
_ALIGNMENT: Final = 16
"""Bytes on whose multiple the pixels begin, so that samples of any type are aligned."""


def text(value: str) -> Value:
    """Return the value of an ASCII tag; what ASCII cannot write becomes a question mark."""
    return ValueType.ASCII, value.encode("ascii", "replace") + b"\0"


def rationals(*values: float | Fraction) -> Value:
    """Return numbers ≥ 0 as the nearest fractions of denominators up to 100 000."""
    near = (Fraction(value).limit_denominator(100_000) for value in values)
    return ValueType.RATIONAL, [part for value in near for part in value.as_integer_ratio()]


def head(main: Tags, strip: int, exif: Tags | None = None) -> bytes:
    """Return the bytes before the pixels."""
    tags: Tags = {
        **main,
        TiffTag.STRIP_OFFSETS: (ValueType.LONG, [0]),
        TiffTag.STRIP_BYTE_COUNTS: (ValueType.LONG, [min(strip, LARGEST_FILE)]),
    }
    if exif is not None:
        tags[TiffTag.EXIF_IFD_POINTER] = (ValueType.LONG, [0])
    exif_at = len(_HEADER) + len(_directory(tags, 0))
    end = exif_at
    if exif is not None:
        tags[TiffTag.EXIF_IFD_POINTER] = (ValueType.LONG, [exif_at])
        end += len(_directory(exif, 0))
    strip_at = end + -end % _ALIGNMENT
    if strip_at + strip > LARGEST_FILE:
        raise ValueError(f"{strip} bytes of pixels are more than the 4 GiB of a TIFF file")
    tags[TiffTag.STRIP_OFFSETS] = (ValueType.LONG, [strip_at])
    directories = _directory(tags, len(_HEADER)) + (b"" if exif is None else _directory(exif, exif_at))
    return _HEADER + directories + bytes(strip_at - end)


def _directory(tags: Tags, at: int) -> bytes:
    """Return a directory that stands at byte `at` of the file, its longer values behind it; of even length."""
    entries = struct.pack("<H", len(tags))
    values = b""
    values_at = at + 2 + 12 * len(tags) + 4
    for code, (kind, numbers) in sorted(tags.items()):
        letters = _LETTERS[kind]
        value = struct.pack(f"<{len(numbers)}{letters[0]}", *numbers)
        entries += struct.pack("<HHI", code, kind, len(numbers) // len(letters))
        if len(value) <= 4:
            entries += value.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", values_at + len(values))
            values += value + bytes(len(value) % 2)
    return entries + struct.pack("<I", 0) + values
