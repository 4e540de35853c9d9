"""Read the directories of TIFF files, and make the header of a new TIFF file; pixels are not read or written.

Any bytes give a result or raise `TiffDamaged`. Only the tags in `_DECODED` are decoded; maker notes and previews are
ignored. The magic numbers of Olympus and Panasonic are also accepted, because the rest of these files is TIFF. A new
header describes one image in one uncompressed strip, little-endian. The caller writes the pixels after it.

Sources: TIFF 6.0, sections 2, 8 and 15 and supplement 1 (SubIFDs); TIFF/EP (ISO 12234-2) for the colour filter array;
Exif 2.32, section 4.6; DNG 1.7.1, chapters 2 and 4. Tags of Canon, Panasonic and Fujifilm have no public standard:
P. Harvey, ExifTool, lib/Image/ExifTool/{Exif,PanasonicRaw,FujiFilm}.pm.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from typing import Final


class TiffTag(IntEnum):
    """Tag codes of TIFF, TIFF/EP, Exif, DNG and Canon."""

    # TIFF 6.0
    NEW_SUBFILE_TYPE = 254
    IMAGE_WIDTH = 256
    IMAGE_LENGTH = 257
    BITS_PER_SAMPLE = 258
    COMPRESSION = 259
    PHOTOMETRIC_INTERPRETATION = 262
    IMAGE_DESCRIPTION = 270
    MAKE = 271
    MODEL = 272
    STRIP_OFFSETS = 273
    ORIENTATION = 274
    SAMPLES_PER_PIXEL = 277
    ROWS_PER_STRIP = 278
    STRIP_BYTE_COUNTS = 279
    PLANAR_CONFIGURATION = 284
    GRAY_RESPONSE_CURVE = 291
    SOFTWARE = 305
    DATE_TIME = 306
    TILE_WIDTH = 322
    TILE_LENGTH = 323
    TILE_OFFSETS = 324
    TILE_BYTE_COUNTS = 325
    SUB_IFDS = 330
    SAMPLE_FORMAT = 339

    # TIFF/EP
    CFA_REPEAT_PATTERN_DIM = 33421
    CFA_PATTERN = 33422

    # Exif 2.32
    EXPOSURE_TIME = 33434
    F_NUMBER = 33437
    EXIF_IFD_POINTER = 34665
    PHOTOGRAPHIC_SENSITIVITY = 34855
    EXIF_VERSION = 36864
    DATE_TIME_ORIGINAL = 36867
    OFFSET_TIME_ORIGINAL = 36881
    FOCAL_LENGTH = 37386
    FOCAL_PLANE_X_RESOLUTION = 41486
    FOCAL_PLANE_RESOLUTION_UNIT = 41488
    BODY_SERIAL_NUMBER = 42033
    LENS_MODEL = 42036

    # DNG 1.7.1
    DNG_VERSION = 50706
    DNG_BACKWARD_VERSION = 50707
    UNIQUE_CAMERA_MODEL = 50708
    CFA_PLANE_COLOR = 50710
    CFA_LAYOUT = 50711
    LINEARIZATION_TABLE = 50712
    BLACK_LEVEL_REPEAT_DIM = 50713
    BLACK_LEVEL = 50714
    BLACK_LEVEL_DELTA_H = 50715
    BLACK_LEVEL_DELTA_V = 50716
    WHITE_LEVEL = 50717
    COLOR_MATRIX_1 = 50721
    AS_SHOT_NEUTRAL = 50728
    CAMERA_SERIAL_NUMBER = 50735
    CALIBRATION_ILLUMINANT_1 = 50778
    ACTIVE_AREA = 50829
    MASKED_AREAS = 50830

    # Canon CR2: widths of the vertical slices of the stored raw pixels
    CR2_SLICES = 50752


RGB: Final = 2  # PhotometricInterpretation of red, green and blue (TIFF 6.0, section 8)

CFA: Final = 32803  # PhotometricInterpretation of a colour filter array (TIFF/EP)

D65: Final = 21  # Code of D65 in Exif's LightSource (Exif 2.32, section 4.6.5) and DNG's CalibrationIlluminant


class TiffDamaged(ValueError):
    """The bytes are not a TIFF, or a directory points beyond their end."""


_MAX_DIRECTORIES: Final = 64  # Most directories that are read; camera files have fewer than ten

_MAX_ENTRIES: Final = 512  # Most entries of a directory, as in LibRaw; camera files have fewer than 100

# Most values in a directory. The longest list of values, a linearisation table, has at most 65 536.
_MAX_VALUES: Final = 1 << 18

# Largest accepted floating-point number. All smaller integers are exact, and real values are much smaller.
_LARGEST: Final = 2.0**53

_TEXT: Final = 2  # Type ASCII (TIFF 6.0, section 2)

# `struct` formats by type code (TIFF 6.0, section 2; type 13, IFD, TIFF technical note 1). A rational has two numbers.
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

_INTEGERS: Final = frozenset({1, 3, 4, 7})
_OFFSETS: Final = frozenset({4, 13})
_NUMBERS: Final = frozenset(_FORMATS) - {_TEXT}

_T = TiffTag
# Decoded tags, and the permitted types of each. A number of another type means a damaged file. A text of another type
# is ignored, because the pixels do not depend on it and programs write different types. Integers may have the type
# UNDEFINED, as for colour filters in Exif.
_DECODED: Final[dict[int, frozenset[int]]] = {
    tag: types
    for types, tags in (
        (
            _INTEGERS,
            (
                _T.NEW_SUBFILE_TYPE, _T.IMAGE_WIDTH, _T.IMAGE_LENGTH, _T.BITS_PER_SAMPLE, _T.COMPRESSION,
                _T.PHOTOMETRIC_INTERPRETATION, _T.SAMPLES_PER_PIXEL, _T.ROWS_PER_STRIP, _T.STRIP_BYTE_COUNTS,
                _T.TILE_WIDTH, _T.TILE_LENGTH, _T.TILE_BYTE_COUNTS, _T.CFA_REPEAT_PATTERN_DIM, _T.CFA_PATTERN,
                _T.DNG_VERSION, _T.CFA_PLANE_COLOR, _T.CFA_LAYOUT, _T.LINEARIZATION_TABLE, _T.BLACK_LEVEL_REPEAT_DIM,
                _T.CR2_SLICES, _T.ACTIVE_AREA, _T.MASKED_AREAS, _T.SAMPLE_FORMAT,
                _T.GRAY_RESPONSE_CURVE, _T.FOCAL_PLANE_RESOLUTION_UNIT,
            ),
        ),
        (
            _OFFSETS,
            (
                _T.STRIP_OFFSETS, _T.TILE_OFFSETS, _T.SUB_IFDS, _T.EXIF_IFD_POINTER,
            ),
        ),
        (
            _NUMBERS,
            (
                _T.EXPOSURE_TIME, _T.F_NUMBER, _T.PHOTOGRAPHIC_SENSITIVITY, _T.BLACK_LEVEL, _T.BLACK_LEVEL_DELTA_H,
                _T.BLACK_LEVEL_DELTA_V, _T.WHITE_LEVEL, _T.FOCAL_LENGTH, _T.FOCAL_PLANE_X_RESOLUTION,
            ),
        ),
        (
            frozenset({_TEXT}),
            (
                _T.MAKE, _T.MODEL, _T.BODY_SERIAL_NUMBER, _T.LENS_MODEL, _T.CAMERA_SERIAL_NUMBER,
                _T.UNIQUE_CAMERA_MODEL,
            ),
        ),
    )
    for tag in tags
}  # fmt: skip

# Tags in which 0/0 means an unknown value.
_EXPOSURES: Final = frozenset({TiffTag.EXPOSURE_TIME, TiffTag.F_NUMBER, TiffTag.PHOTOGRAPHIC_SENSITIVITY})

_POINTERS: Final = (TiffTag.SUB_IFDS, TiffTag.EXIF_IFD_POINTER)  # Tags that point to further directories

ReadValue = str | tuple[float, ...]


@dataclass(frozen=True)
class Directory:
    """One image file directory: its decoded tags, with rationals as floats."""

    values: dict[int, ReadValue]

    def numbers(self, tag: TiffTag) -> tuple[float, ...]:
        """Return the numbers of `tag`; empty if the tag is missing."""
        value = self.values.get(tag, ())
        return () if isinstance(value, str) else value

    def integers(self, tag: TiffTag) -> tuple[int, ...]:
        """Return the numbers of `tag`, truncated to integers; empty if the tag is missing."""
        return tuple(int(number) for number in self.numbers(tag))

    def text(self, tag: TiffTag) -> str:
        """Return the text of `tag`; empty if the tag is missing."""
        value = self.values.get(tag, "")
        return value if isinstance(value, str) else ""

    def first(self, tag: TiffTag) -> int:
        """Return the first number of `tag`, truncated to an integer; 0 if the tag is missing."""
        return next(iter(self.integers(tag)), 0)


def is_tiff(data: bytes | memoryview) -> bool:
    """Return whether `data` starts with the magic number of TIFF or of a variant (Olympus, Panasonic)."""
    return data[:4] in (b"II*\0", b"MM\0*", b"IIRO", b"IIRS", b"MMOR", b"IIU\0")


def read_directories(data: bytes | memoryview) -> list[Directory]:
    """Return the directories of the main chain, each followed by its SubIFDs and Exif directory."""
    if not is_tiff(data) or len(data) < 8:
        raise TiffDamaged("it does not start as a TIFF file")
    order = "<" if data[:2] == b"II" else ">"
    directories: list[Directory] = []
    read_offsets: set[int] = set()
    pending_offsets = [_unpack(order, "I", data, 4)[0]]
    while pending_offsets:
        offset = pending_offsets.pop()
        if offset == 0 or offset in read_offsets or len(read_offsets) >= _MAX_DIRECTORIES:
            continue
        read_offsets.add(offset)
        directory, next_offset = _read_directory(order, data, offset)
        directories.append(directory)
        pending_offsets.append(next_offset)
        pending_offsets.extend(reversed([position for tag in _POINTERS for position in directory.integers(tag)]))
    return directories


def _read_directory(order: str, data: bytes | memoryview, offset: int) -> tuple[Directory, int]:
    (count,) = _unpack(order, "H", data, offset)
    if count > _MAX_ENTRIES:
        raise TiffDamaged(f"a directory has {count} entries, expected at most {_MAX_ENTRIES}")
    values: dict[int, ReadValue] = {}
    value_count = 0
    for number in range(count):
        entry_offset = offset + 2 + 12 * number
        tag, value_type, length = _unpack(order, "HHI", data, entry_offset)
        allowed = _DECODED.get(tag)
        if allowed is None:
            continue
        value_count += length
        if value_count > _MAX_VALUES:
            raise TiffDamaged(f"a directory has {value_count} values, expected at most {_MAX_VALUES}")
        if value_type in allowed:
            values[tag] = _read_value(order, data, entry_offset + 8, value_type, length, exact=tag not in _EXPOSURES)
        elif _TEXT not in allowed:
            raise TiffDamaged(f"its tag {tag} is of type {value_type}, expected one of {sorted(allowed)}")
    end = offset + 2 + 12 * count
    # Some programs leave out the offset of the next directory (0 for none) at the end of the file.
    next_offset = _unpack(order, "I", data, end)[0] if end + 4 <= len(data) else 0
    return Directory(values), next_offset


def _read_value(order: str, data: bytes | memoryview, offset: int, code: int, length: int, *, exact: bool) -> ReadValue:
    layout = _FORMATS[code]
    size = struct.calcsize(order + layout) * length
    if size > 4:
        (offset,) = _unpack(order, "I", data, offset)
    if code == _TEXT:
        if offset + length > len(data):
            raise TiffDamaged(f"a text extends to byte {offset + length}, the file has {len(data)} bytes")
        return bytes(data[offset : offset + length]).split(b"\0")[0].decode("utf-8", "replace").strip()
    numbers = _unpack(order, layout * length if len(layout) == 2 else f"{length}{layout}", data, offset)
    if len(layout) == 2:
        if exact and not all(numbers[1::2]):
            raise TiffDamaged("a tag has a rational with denominator 0")
        return tuple(top / bottom if bottom else 0.0 for top, bottom in zip(numbers[::2], numbers[1::2], strict=True))
    if layout in "fd" and not all(abs(number) <= _LARGEST for number in numbers):
        raise TiffDamaged(f"a tag has a number that is not finite or above {_LARGEST:g}")
    return tuple(numbers)


def _unpack(order: str, layout: str, data: bytes | memoryview, offset: int) -> tuple[int, ...]:
    try:
        if not 0 <= offset <= len(data):
            raise struct.error
        return struct.unpack_from(order + layout, data, offset)
    except struct.error as error:
        raise TiffDamaged(f"it points to byte {offset}, the file has {len(data)} bytes") from error


class ValueType(IntEnum):
    """Types of written values (TIFF 6.0, section 2)."""

    BYTE = 1
    ASCII = 2
    SHORT = 3
    LONG = 4
    RATIONAL = 5
    UNDEFINED = 7
    SRATIONAL = 10


Value = tuple[ValueType, Sequence[int]]  # Type and numbers; a rational is numerator and denominator

Tags = dict[TiffTag, Value]  # Values by tag

LARGEST_FILE: Final = (1 << 32) - 1  # Bytes, limited by the 32-bit offsets of TIFF

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
_ALIGNMENT: Final = 16  # The pixels start at a multiple of 16 bytes, so that samples of any type are aligned


def text(value: str) -> Value:
    """Return the value of an ASCII tag; characters outside ASCII become question marks."""
    return ValueType.ASCII, value.encode("ascii", "replace") + b"\0"


def rationals(*values: float | Fraction) -> Value:
    """Return the value of a tag of rationals ≥ 0: the nearest fractions with denominators up to 100 000."""
    fractions = (Fraction(value).limit_denominator(100_000) for value in values)
    return ValueType.RATIONAL, [number for value in fractions for number in value.as_integer_ratio()]


def head(main: Tags, strip: int, exif: Tags | None = None) -> bytes:
    """Return the bytes of a new file that precede the `strip` bytes of its pixels; `main`: tags of the image."""
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
        raise ValueError(f"{strip} bytes of pixels, expected at most 4 GiB in a TIFF file")
    tags[TiffTag.STRIP_OFFSETS] = (ValueType.LONG, [strip_at])
    directories = _directory(tags, len(_HEADER)) + (b"" if exif is None else _directory(exif, exif_at))
    return _HEADER + directories + bytes(strip_at - end)


def _directory(tags: Tags, at: int) -> bytes:
    """Return the bytes of a directory that starts at byte `at` of the file, and its longer values after it."""
    entries = struct.pack("<H", len(tags))
    values = b""
    values_at = at + 2 + 12 * len(tags) + 4
    for code, (value_type, numbers) in sorted(tags.items()):
        letters = _LETTERS[value_type]
        value = struct.pack(f"<{len(numbers)}{letters[0]}", *numbers)
        entries += struct.pack("<HHI", code, value_type, len(numbers) // len(letters))
        if len(value) <= 4:
            entries += value.ljust(4, b"\0")
        else:
            entries += struct.pack("<I", values_at + len(values))
            values += value + bytes(len(value) % 2)
    return entries + struct.pack("<I", 0) + values
