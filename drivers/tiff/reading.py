"""Reads the directories of a TIFF file: the description of the pixels, never the pixels themselves.

Rules that hold inside:

- A pure function of bytes; nothing is opened, printed or logged, and every byte sequence whatever ends in a result or
  in `TiffDamaged`.
- Only the tags in `_DECODED` are decoded; maker notes and previews are not touched.
- Maker's own magic numbers (Olympus, Panasonic) pass, since what follows is TIFF all the same.

Source: TIFF 6.0 section 2; TIFF/EP (ISO 12234-2) for the colour filter array; DNG 1.7 for the tags from 50706 on.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

from drivers.tiff.tags import TiffTag


class TiffDamaged(ValueError):
    """The bytes are no TIFF, or a directory points beyond their end."""


_MAX_DIRECTORIES: Final = 64
"""Directories that are read: a camera's file has under ten, and a damaged chain must end."""

_MAX_VALUES: Final = 1 << 20
"""Values of one tag: a linearisation table, the longest that is read, has at most 65 536."""

_TEXT: Final = 2
"""Type ASCII (TIFF 6.0, section 2)."""

_FORMATS: Final = {
    1: "B",
    2: "s",
    3: "H",
    4: "I",
    5: "II",
    6: "b",
    7: "B",
    8: "h",
    9: "i",
    10: "ii",
    11: "f",
    12: "d",
    13: "I",
}
"""Letters of `struct` by type (TIFF 6.0, section 2; 13, IFD: TIFF technical note 1); rationals are two numbers."""

_DECODED: Final = frozenset(
    {
        TiffTag.IMAGE_WIDTH,
        TiffTag.IMAGE_LENGTH,
        TiffTag.BITS_PER_SAMPLE,
        TiffTag.COMPRESSION,
        TiffTag.PHOTOMETRIC_INTERPRETATION,
        TiffTag.MAKE,
        TiffTag.MODEL,
        TiffTag.STRIP_OFFSETS,
        TiffTag.SAMPLES_PER_PIXEL,
        TiffTag.STRIP_BYTE_COUNTS,
        TiffTag.TILE_OFFSETS,
        TiffTag.TILE_BYTE_COUNTS,
        TiffTag.SUB_IFDS,
        TiffTag.CFA_REPEAT_PATTERN_DIM,
        TiffTag.CFA_PATTERN,
        TiffTag.EXPOSURE_TIME,
        TiffTag.F_NUMBER,
        TiffTag.EXIF_IFD_POINTER,
        TiffTag.PHOTOGRAPHIC_SENSITIVITY,
        TiffTag.BODY_SERIAL_NUMBER,
        TiffTag.LENS_MODEL,
        TiffTag.CAMERA_SERIAL_NUMBER,
        TiffTag.DNG_VERSION,
        TiffTag.UNIQUE_CAMERA_MODEL,
        TiffTag.CFA_PLANE_COLOR,
        TiffTag.CFA_LAYOUT,
        TiffTag.LINEARIZATION_TABLE,
        TiffTag.BLACK_LEVEL_REPEAT_DIM,
        TiffTag.BLACK_LEVEL,
        TiffTag.BLACK_LEVEL_DELTA_H,
        TiffTag.BLACK_LEVEL_DELTA_V,
        TiffTag.WHITE_LEVEL,
        TiffTag.CR2_SLICES,
        TiffTag.ACTIVE_AREA,
        TiffTag.MASKED_AREAS,
    }
)
"""Tags whose values are read; a damaged value of any other is no fault of the pixels."""

Value = str | tuple[float, ...]


@dataclass(frozen=True)
class Directory:
    """One image file directory: the decoded tags that it holds; rationals have become floats."""

    values: dict[int, Value]

    def numbers(self, tag: TiffTag) -> tuple[float, ...]:
        """Return the numbers of `tag`; empty where the directory has none."""
        value = self.values.get(tag, ())
        return () if isinstance(value, str) else value

    def integers(self, tag: TiffTag) -> tuple[int, ...]:
        """Return the numbers of `tag` cut to integers; empty where the directory has none."""
        return tuple(int(number) for number in self.numbers(tag))

    def text(self, tag: TiffTag) -> str:
        """Return the text of `tag`; empty where the directory has none."""
        value = self.values.get(tag, "")
        return value if isinstance(value, str) else ""

    def extents(self) -> list[tuple[int, int]]:
        """Return offset and size in bytes of every strip and tile."""
        strips = zip(self.integers(TiffTag.STRIP_OFFSETS), self.integers(TiffTag.STRIP_BYTE_COUNTS), strict=False)
        tiles = zip(self.integers(TiffTag.TILE_OFFSETS), self.integers(TiffTag.TILE_BYTE_COUNTS), strict=False)
        return [*strips, *tiles]


def is_tiff(data: bytes | memoryview) -> bool:
    """Return whether `data` begins as TIFF does, or as a maker's near copy of it."""
    return data[:4] in (b"II*\0", b"MM\0*", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")


def read_directories(data: bytes | memoryview) -> list[Directory]:
    """Return the directories of the main chain and, after each, those it points to by SubIFDs and as Exif."""
    if not is_tiff(data) or len(data) < 8:
        raise TiffDamaged("it does not begin as a TIFF file does")
    order = "<" if data[:2] == b"II" else ">"
    directories: list[Directory] = []
    seen: set[int] = set()
    waiting = [_unpack(order, "I", data, 4)[0]]
    while waiting:
        offset = waiting.pop()
        if offset == 0 or offset in seen or len(seen) >= _MAX_DIRECTORIES:
            continue
        seen.add(offset)
        directory, following = _read_directory(order, data, offset)
        directories.append(directory)
        waiting.append(following)
        waiting.extend(reversed([*directory.integers(TiffTag.SUB_IFDS), *directory.integers(TiffTag.EXIF_IFD_POINTER)]))
    return directories


def _read_directory(order: str, data: bytes | memoryview, offset: int) -> tuple[Directory, int]:
    (count,) = _unpack(order, "H", data, offset)
    values: dict[int, Value] = {}
    for number in range(count):
        entry = offset + 2 + 12 * number
        tag, kind, length = _unpack(order, "HHI", data, entry)
        if tag in _DECODED and kind in _FORMATS:
            values[tag] = _read_value(order, data, entry + 8, kind, length)
    end = offset + 2 + 12 * count
    # Some writers leave out the link that ends the chain when the directory is the last thing in the file.
    following = _unpack(order, "I", data, end)[0] if end + 4 <= len(data) else 0
    return Directory(values), following


def _read_value(order: str, data: bytes | memoryview, place: int, kind: int, length: int) -> Value:
    if length > _MAX_VALUES:
        raise TiffDamaged(f"a tag claims {length} values")
    one = _FORMATS[kind]
    size = struct.calcsize(order + one) * length
    if size > 4:
        (place,) = _unpack(order, "I", data, place)
    if kind == _TEXT:
        if place + length > len(data):
            raise TiffDamaged(f"a text reaches to byte {place + length}, and it has only {len(data)}")
        return bytes(data[place : place + length]).split(b"\0")[0].decode("utf-8", "replace").strip()
    numbers = _unpack(order, one * length if len(one) == 2 else f"{length}{one}", data, place)
    if len(one) == 2:
        return tuple(top / bottom if bottom else 0.0 for top, bottom in zip(numbers[::2], numbers[1::2], strict=True))
    return tuple(numbers)


def _unpack(order: str, layout: str, data: bytes | memoryview, offset: int) -> tuple[int, ...]:
    try:
        return struct.unpack_from(order + layout, data, offset)
    except struct.error as error:
        raise TiffDamaged(f"it points to byte {offset}, and has only {len(data)}") from error
