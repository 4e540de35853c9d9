"""The values of a Canon body's properties as they travel: numbers, text, image formats, and how one is set.

Rules that hold inside:

- ``decode`` and ``encode`` undo each other on well-formed bytes.
- Properties travel as bytes: 32 bits for every number, text with a closing NUL, structures for a few. Nothing here
  knows which property is what, except for the image formats, whose lists cannot be cut without it.

Source: no public standard; layouts as recorded from an EOS 60D and an EOS 400D, and as libgphoto2 2.5.34 reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from drivers.ptp.codes import Property
from drivers.ptp.cursor import Cursor
from drivers.ptp.datasets import MAX_DATASET, encode_integer

_RAW: Final = 6
"""Kind of a raw file, see `ImageFile`."""
_LOSSLESS: Final = 4
"""Compression of a raw file, see `ImageFile`."""

_JPEG_SIZES: Final = {0: "L", 1: "M", 2: "S", 5: "M1", 6: "M2", 14: "S1", 15: "S2", 16: "S3"}

_IMAGE_FILE_LENGTH: Final = 16
"""Bytes of one file's format: this length, kind, size and compression, 32 bits each."""

_MAX_IMAGE_FILES: Final = 2
"""Files of one release: a raw file and a JPEG."""

_SETTING_HEADER: Final = 8
"""Bytes before a new value: length and property."""


def number_value(number: int) -> bytes:
    """Return a number as a property's value; negative ones as their two's complement in 32 bits."""
    return encode_integer(number & 0xFFFFFFFF if -(1 << 31) <= number < 0 else number, 4)


def text_value(text: str) -> bytes:
    """Return text as a property's value, closed by NUL."""
    octets = text.encode("latin-1", "replace")
    if b"\0" in octets:
        raise ValueError(f"{text[:40]!r} holds a NUL")
    return octets + b"\0"


def number_of(value: bytes) -> int:
    """Return the number in a property's value: its first 32 bits."""
    return Cursor(value, "a property's value").u32("the number")


def text_of(value: bytes) -> str:
    """Return the text in a property's value, up to its first NUL."""
    return value.partition(b"\0")[0].decode("latin-1")


@dataclass(frozen=True)
class ImageFile:
    """One of the files that a release makes.

    - `kind`: 1 JPEG, 6 raw.
    - `size`: 0 large, 1 medium (of raw: mRAW), 2 small (sRAW), 5 and 6 M1 and M2, 14, 15 and 16 S1, S2 and S3.
    - `compression`: of JPEG 2 normal and 3 fine; of raw 4 lossless and 3 lossy.
    """

    kind: int
    size: int
    compression: int

    @property
    def is_raw(self) -> bool:
        """Whether the file is raw, of any size."""
        return self.kind == _RAW

    def __str__(self) -> str:
        if self.is_raw:
            size = {0: "RAW", 1: "mRAW", 2: "sRAW"}.get(self.size, f"RAW of size {self.size}")
            return size if self.compression == _LOSSLESS else f"{size} of compression {self.compression}"
        size = _JPEG_SIZES.get(self.size, f"of size {self.size}")
        quality = {2: "normal", 3: "fine"}.get(self.compression, f"of compression {self.compression}")
        return f"JPEG {size} {quality}"


@dataclass(frozen=True)
class ImageFormat:
    """The one or two files of a release; the value of properties 0xd120 to 0xd123."""

    files: tuple[ImageFile, ...]

    @classmethod
    def read(cls, cursor: Cursor) -> ImageFormat:
        """Return the next image format at a cursor."""
        count = cursor.u32("the count of files")
        if not 1 <= count <= _MAX_IMAGE_FILES:
            raise cursor.fault("the count of files", f"1 or {_MAX_IMAGE_FILES}", count)
        files: list[ImageFile] = []
        for _ in range(count):
            length = cursor.u32("the length of a file's format")
            if length != _IMAGE_FILE_LENGTH:
                raise cursor.fault("the length of a file's format", str(_IMAGE_FILE_LENGTH), length)
            files.append(ImageFile(cursor.u32("kind"), cursor.u32("size"), cursor.u32("compression")))
        return cls(tuple(files))

    @classmethod
    def decode(cls, value: bytes) -> ImageFormat:
        """Return the image format in a property's value."""
        return cls.read(Cursor(value, "an image format"))

    def encode(self) -> bytes:
        """Return the property's value."""
        if not 1 <= len(self.files) <= _MAX_IMAGE_FILES:
            raise ValueError(f"{len(self.files)} files; a release makes 1 or {_MAX_IMAGE_FILES}")
        return encode_integer(len(self.files), 4) + b"".join(
            encode_integer(number, 4)
            for file in self.files
            for number in (_IMAGE_FILE_LENGTH, file.kind, file.size, file.compression)
        )

    def __str__(self) -> str:
        return " + ".join(str(file) for file in self.files)


RAW_ONLY = ImageFormat((ImageFile(_RAW, 0, _LOSSLESS),))
"""One full raw file a release: what a measurement wants."""

IMAGE_FORMAT_PROPERTIES = frozenset(
    {
        Property.EOS_IMAGE_FORMAT,
        Property.EOS_IMAGE_FORMAT_CF,
        Property.EOS_IMAGE_FORMAT_SD,
        Property.EOS_IMAGE_FORMAT_EXT_HD,
    }
)
"""Properties whose value is an `ImageFormat`."""


@dataclass(frozen=True)
class PropertySetting:
    """What SetDevicePropValueEx (0x9110) sends: a property's new value, see `number_value` and `text_value`."""

    code: int
    value: bytes

    @classmethod
    def decode(cls, data: bytes) -> PropertySetting:
        """Return the setting in the data of a request."""
        cursor = Cursor(data, "SetDevicePropValueEx", MAX_DATASET)
        length = cursor.u32("length")
        if length < cursor.at + 4 or length > len(data):
            raise cursor.fault("length", f"8 to {len(data)}", length)
        return cls(cursor.u32("property"), cursor.take(length - cursor.at, "value"))

    def encode(self) -> bytes:
        """Return the data of the request."""
        return encode_integer(_SETTING_HEADER + len(self.value), 4) + encode_integer(self.code, 4) + bytes(self.value)
