"""The datasets of Canon's EOS bodies that the standard does not have: lists of objects, and what a body can report.

``decode`` and ``encode`` undo each other on well-formed bytes; counts and sizes are checked before they are believed.

Source: no public standard; layouts as recorded from an EOS 60D and an EOS 400D, and as libgphoto2 2.5.34 reads them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from drivers.canon.values import text_of
from drivers.ptp.cursor import Cursor
from drivers.ptp.datasets import MAX_DATASET, encode_array, encode_integer

_NAME_WIDTH: Final = 16
"""Bytes of a name's field: 8.3 characters and padding."""

_TIME_LENGTH: Final = 4
"""Bytes of a time, seconds since 1970."""


@dataclass(frozen=True)
class ObjectEntry:
    """An object as EOS bodies list it, in GetObjectInfoEx and in events.

    - `group`: A second handle; one and the same for files that belong together, else often the handle again.
    - `name`: at most `name_width` characters.
    - `time`: seconds since 1970 on the camera's clock; None where the body leaves it out.
    - `name_width`: bytes of the name's field, padded with NUL; 16 on all bodies recorded.
    """

    handle: int
    storage: int
    format: int
    size: int
    name: str
    parent: int = 0
    group: int = 0
    flags: int = 0
    time: int | None = 0
    name_width: int = _NAME_WIDTH
    reserved: int = field(default=0, repr=False)

    @classmethod
    def read(cls, cursor: Cursor, size_length: int = 4) -> ObjectEntry:
        """Return the object in the rest of a record; `size_length` is 8 on bodies with sizes of 64 bits."""
        handle, storage, kind = cursor.u32("handle"), cursor.u32("storage"), cursor.u32("format")
        reserved, flags = cursor.u32("reserved"), cursor.u32("flags")
        size = cursor.integer(size_length, "size")
        parent, group = cursor.u32("parent"), cursor.u32("group")
        width = cursor.left
        time = None
        if width >= _NAME_WIDTH + _TIME_LENGTH:
            width -= _TIME_LENGTH
        name = text_of(cursor.take(width, "name"))
        if cursor.left:
            time = cursor.u32("time")
        return cls(handle, storage, kind, size, name, parent, group, flags, time, width, reserved)

    def encode(self, size_length: int = 4) -> bytes:
        """Return the body of a record."""
        name = self.name.encode("latin-1", "replace")
        if len(name) > self.name_width or b"\0" in name:
            raise ValueError(f"{self.name!r} is no name of at most {self.name_width} characters")
        if self.name_width < _NAME_WIDTH if self.time is not None else self.name_width >= _NAME_WIDTH + _TIME_LENGTH:
            raise ValueError(f"a name's field of {self.name_width} bytes and a time behind it look alike")
        time = b"" if self.time is None else encode_integer(self.time, _TIME_LENGTH)
        return b"".join(
            (
                *(encode_integer(n, 4) for n in (self.handle, self.storage, self.format, self.reserved, self.flags)),
                encode_integer(self.size, size_length),
                encode_integer(self.parent, 4),
                encode_integer(self.group, 4),
                name.ljust(self.name_width, b"\0"),
                time,
            )
        )


def decode_object_entries(data: bytes) -> tuple[ObjectEntry, ...]:
    """Return the objects that GetObjectInfoEx (0x9109) answers."""
    cursor = Cursor(data, "GetObjectInfoEx", MAX_DATASET)
    count = cursor.u32("the count of objects")
    entries: list[ObjectEntry] = []
    # A record takes at least four bytes, so that the bytes left bound the loop whatever the count says.
    for number in range(count):
        length = cursor.u32("the length of a record")
        body = cursor.take(max(length - 4, 0), f"record {number} of {count}")
        entries.append(ObjectEntry.read(Cursor(body, f"GetObjectInfoEx, record {number}")))
    return tuple(entries)


def encode_object_entries(entries: Iterable[ObjectEntry]) -> bytes:
    """Return the answer to GetObjectInfoEx."""
    bodies = [entry.encode() for entry in entries]
    return encode_integer(len(bodies), 4) + b"".join(encode_integer(4 + len(body), 4) + body for body in bodies)


@dataclass(frozen=True)
class DeviceInfoEx:
    """What GetDeviceInfoEx (0x9108) answers: record types, properties, and numbers whose meaning is not known."""

    events: tuple[int, ...] = ()
    properties: tuple[int, ...] = ()
    others: tuple[int, ...] = ()

    @classmethod
    def decode(cls, data: bytes) -> DeviceInfoEx:
        """Return the device in an answer."""
        cursor = Cursor(data, "DeviceInfoEx", MAX_DATASET)
        length = cursor.u32("length")
        if length > len(data):
            raise cursor.fault("length", f"at most {len(data)}, the bytes there are", length)
        return cls(cursor.array(4, "events"), cursor.array(4, "properties"), cursor.array(4, "others"))

    def encode(self) -> bytes:
        """Return the answer."""
        arrays = b"".join(encode_array(array, 4) for array in (self.events, self.properties, self.others))
        return encode_integer(4 + len(arrays), 4) + arrays
