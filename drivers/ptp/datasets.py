"""The datasets of PTP as bytes and as values: device, object, storage, property; and the cursor that reads them.

Rules that hold inside:

- ``decode`` and ``encode`` undo each other on well-formed bytes, so that both ends of the cable share one type.
- Whatever bytes a device sends, the only error is `ProtocolError`; it names the dataset, the field, the place, what was
  expected and what came. A count is compared with the bytes that are left before anything is made from it, and a
  dataset of more than `MAX_DATASET` bytes is refused unread. Bytes behind a dataset's last field are no fault, for
  later editions append.
- ``encode`` raises ValueError for what the wire cannot hold; that is our own mistake, never a device's.

Everything is little-endian, as USB and TCP carry it. A string is a count of UTF-16 units with the closing NUL, then
the units; an empty string is the count 0 alone. An array is a count of 32 bits, then the items.

Source: ISO 15740:2013, clauses 5 (types and datasets) and 13 (properties).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from typing import Annotated, Any, Self, get_origin, get_type_hints

from drivers.ptp.codes import DataType
from foundation.errors import ProtocolError


def describe(kind: type[IntEnum], code: int) -> str:
    """Return a code for people: ``DEVICE_BUSY (0x2019)``, or ``0x2fff`` where no name is known."""
    try:
        return f"{kind(code).name} (0x{code:04x})"
    except ValueError:
        return f"0x{code:04x}"


class Cursor:
    """Reads `data`, little-endian, from its start; `what` names it in messages."""

    def __init__(self, data: bytes, what: str, limit: int | None = None) -> None:
        if limit is not None and len(data) > limit:
            raise ProtocolError(f"{what} of {len(data)} bytes; at most {limit} were expected")
        self._data = bytes(data)
        self.what = what
        self.at = 0
        self._before = 0

    @property
    def left(self) -> int:
        """Bytes not yet read."""
        return len(self._data) - self.at

    def fault(self, field: str, expected: str, came: object, at: int | None = None) -> ProtocolError:
        """Return the error that states what is wrong with the field that was read last, or with the one at `at`."""
        place = self._before if at is None else at
        return ProtocolError(f"{self.what}: {field} at byte {place} is {came}; expected {expected}")

    def take(self, count: int, field: str) -> bytes:
        """Return the next `count` bytes."""
        if count > self.left:
            raise ProtocolError(
                f"{self.what}: {field} at byte {self.at} needs {count} bytes, but only {self.left} follow"
            )
        self._before = self.at
        self.at += count
        return self._data[self._before : self.at]

    def rest(self) -> bytes:
        """Return all bytes that are left."""
        return self.take(self.left, "the rest")

    def integer(self, size: int, field: str, signed: bool = False) -> int:
        """Return the next integer of `size` bytes."""
        return int.from_bytes(self.take(size, field), "little", signed=signed)

    def u8(self, field: str) -> int:
        """Return the next byte."""
        return self.integer(1, field)

    def u16(self, field: str) -> int:
        """Return the next unsigned integer of 2 bytes."""
        return self.integer(2, field)

    def u32(self, field: str) -> int:
        """Return the next unsigned integer of 4 bytes."""
        return self.integer(4, field)

    def u64(self, field: str) -> int:
        """Return the next unsigned integer of 8 bytes."""
        return self.integer(8, field)

    def integers(self, count: int, size: int, field: str, signed: bool = False) -> tuple[int, ...]:
        """Return `count` integers of `size` bytes."""
        if count * size > self.left:
            raise ProtocolError(
                f"{self.what}: {field} at byte {self.at} announces {count} items of {size} bytes, "
                f"but only {self.left} bytes follow"
            )
        octets = self.take(count * size, field)
        return tuple(
            int.from_bytes(octets[at : at + size], "little", signed=signed) for at in range(0, len(octets), size)
        )

    def array(self, size: int, field: str, signed: bool = False) -> tuple[int, ...]:
        """Return an array: a count of 4 bytes, then as many integers of `size` bytes (ISO 15740, 5.3.3)."""
        return self.integers(self.u32(f"the count of {field}"), size, field, signed)


MAX_DATASET = 1 << 20
"""Bytes of the largest dataset that is read; real ones stay below 10 kB, long lists of handles included."""
MAX_STRING_UNITS = 254
"""UTF-16 units of the longest string, its closing NUL not counted."""

Value = int | str | tuple[int, ...]
"""A property's value: an integer, a string, or an array of integers."""

_ARRAY = 0x4000
"""Bit that makes an array of a type of integers (ISO 15740, table of data type codes)."""
_INTEGERS: dict[int, tuple[int, bool]] = {
    DataType.INT8: (1, True),
    DataType.UINT8: (1, False),
    DataType.INT16: (2, True),
    DataType.UINT16: (2, False),
    DataType.INT32: (4, True),
    DataType.UINT32: (4, False),
    DataType.INT64: (8, True),
    DataType.UINT64: (8, False),
    DataType.INT128: (16, True),
    DataType.UINT128: (16, False),
}
"""Bytes and sign of each integer type."""


def read_string(cursor: Cursor, field: str) -> str:
    """Return the next string, up to its first NUL; what is no UTF-16 becomes U+FFFD."""
    count = cursor.u8(f"the length of {field}")
    octets = cursor.take(2 * count, field)
    return octets[: 2 * MAX_STRING_UNITS].decode("utf-16-le", "replace").partition("\0")[0]


def encode_string(text: str) -> bytes:
    """Return `text` as a string of PTP."""
    if not text:
        return b"\0"
    octets = text.encode("utf-16-le")
    units = len(octets) // 2
    if units > MAX_STRING_UNITS or "\0" in text:
        raise ValueError(f"{text[:40]!r} of {units} UTF-16 units is no PTP string; at most {MAX_STRING_UNITS}, no NUL")
    return bytes([units + 1]) + octets + b"\0\0"


def encode_integer(value: int, size: int, signed: bool = False) -> bytes:
    """Return `value` in `size` bytes; ValueError where it does not fit."""
    try:
        return value.to_bytes(size, "little", signed=signed)
    except OverflowError as error:
        raise ValueError(f"{value} does not fit in {size} bytes") from error


def encode_array(values: Iterable[int], size: int, signed: bool = False) -> bytes:
    """Return `values` as an array of integers of `size` bytes."""
    items = tuple(values)
    return encode_integer(len(items), 4) + b"".join(encode_integer(item, size, signed) for item in items)


def decode_u32_array(data: bytes, what: str = "the list") -> tuple[int, ...]:
    """Return the items of an array of 32-bit integers: storage ids, object handles."""
    return Cursor(data, what, MAX_DATASET).array(4, "items")


def encode_u32_array(values: Iterable[int]) -> bytes:
    """Return `values` as an array of 32-bit integers."""
    return encode_array(values, 4)


def read_value(cursor: Cursor, data_type: int, field: str) -> Value:
    """Return the next value of a property of type `data_type`, one of `DataType` or an array of it."""
    if data_type == DataType.STRING:
        return read_string(cursor, field)
    if data_type & _ARRAY and data_type - _ARRAY in _INTEGERS:
        size, signed = _INTEGERS[data_type - _ARRAY]
        return cursor.array(size, field, signed)
    if data_type in _INTEGERS:
        size, signed = _INTEGERS[data_type]
        return cursor.integer(size, field, signed)
    raise cursor.fault(f"the type of {field}", "a type of ISO 15740, 5.3", f"0x{data_type:04x}")


def decode_value(data_type: int, data: bytes) -> Value:
    """Return a property's value, as GetDevicePropValue answers it."""
    return read_value(Cursor(data, "the property's value", MAX_DATASET), data_type, "value")


def encode_value(data_type: int, value: Value) -> bytes:
    """Return a property's value as bytes; ValueError where it is not of the type."""
    if data_type == DataType.STRING and isinstance(value, str):
        return encode_string(value)
    if data_type & _ARRAY and data_type - _ARRAY in _INTEGERS and isinstance(value, tuple):
        size, signed = _INTEGERS[data_type - _ARRAY]
        return encode_array(value, size, signed)
    if data_type in _INTEGERS and isinstance(value, int):
        size, signed = _INTEGERS[data_type]
        return encode_integer(value, size, signed)
    raise ValueError(f"{value!r} is not of type 0x{data_type:04x}")


@dataclass(frozen=True)
class FieldKind:
    """How a dataset's field stands on the wire: `read` takes it at a cursor and is given its name, for messages."""

    read: Callable[[Cursor, str], Any]
    encode: Callable[[Any], bytes]


def of_type(data_type: int) -> FieldKind:
    """Return how a field of one of ISO 15740's types stands on the wire."""
    if data_type in _INTEGERS:
        size, signed = _INTEGERS[data_type]
        return FieldKind(
            lambda cursor, field: cursor.integer(size, field, signed), lambda value: encode_integer(value, size, signed)
        )
    return FieldKind(
        lambda cursor, field: read_value(cursor, data_type, field), lambda value: encode_value(data_type, value)
    )


U16 = Annotated[int, of_type(DataType.UINT16)]
U32 = Annotated[int, of_type(DataType.UINT32)]
U64 = Annotated[int, of_type(DataType.UINT64)]
U16s = Annotated[tuple[int, ...], of_type(_ARRAY + DataType.UINT16)]
Text = Annotated[str, of_type(DataType.STRING)]
Rest = Annotated[bytes, FieldKind(lambda cursor, _: cursor.rest(), bytes)]
"""What a dataset's fields are on the wire."""


class PtpDataset:
    """A frozen dataclass whose fields, each a type above, follow each other on the wire."""

    @classmethod
    @cache
    def _layout(cls) -> tuple[tuple[str, str, FieldKind], ...]:
        """Return name, name in messages and kind of every field."""
        hints = get_type_hints(cls, include_extras=True).items()
        fields = [(name, hint.__metadata__[0]) for name, hint in hints if get_origin(hint) is Annotated]
        return tuple((name, name.replace("_", " "), kind) for name, kind in fields)

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Return the value in a dataset."""
        return cls.read(Cursor(data, cls.__name__, MAX_DATASET))

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Return the value at a cursor."""
        return cls(**{name: kind.read(cursor, words) for name, words, kind in cls._layout()})

    def encode(self) -> bytes:
        """Return the dataset."""
        return b"".join([kind.encode(getattr(self, name)) for name, _, kind in self._layout()])


@dataclass(frozen=True)
class DeviceInfo(PtpDataset):
    """What a device is and can do (GetDeviceInfo, 5.5.1); version 100 is 1.00."""

    standard_version: U16 = 100
    vendor_extension_id: U32 = 0
    vendor_extension_version: U16 = 0
    vendor_extension: Text = ""
    functional_mode: U16 = 0
    operations: U16s = ()
    events: U16s = ()
    properties: U16s = ()
    capture_formats: U16s = ()
    image_formats: U16s = ()
    manufacturer: Text = ""
    model: Text = ""
    device_version: Text = ""
    serial_number: Text = ""


@dataclass(frozen=True)
class ObjectInfo(PtpDataset):
    """An object in a store (GetObjectInfo, 5.5.3): bytes, pixels, dates as ``YYYYMMDDThhmmss``."""

    storage: U32 = 0
    format: U16 = 0
    protection: U16 = 0
    size: U32 = 0
    thumb_format: U16 = 0
    thumb_size: U32 = 0
    thumb_width: U32 = 0
    thumb_height: U32 = 0
    image_width: U32 = 0
    image_height: U32 = 0
    bit_depth: U32 = 0
    parent: U32 = 0
    association_type: U16 = 0
    association_description: U32 = 0
    sequence_number: U32 = 0
    filename: Text = ""
    captured_at: Text = ""
    modified_at: Text = ""
    keywords: Text = ""


@dataclass(frozen=True)
class StorageInfo(PtpDataset):
    """A store (GetStorageInfo, 5.5.2): capacities in bytes; 0xffffffff free images where the device does not know.

    `padding` is what a device sends behind the dataset: two NULs on the EOS 60D.
    """

    storage_type: U16 = 0
    filesystem_type: U16 = 0
    access: U16 = 0
    capacity: U64 = 0
    free: U64 = 0
    free_images: U32 = 0xFFFFFFFF
    description: Text = ""
    label: Text = ""
    padding: Rest = field(default=b"", repr=False)


_NO_FORM, _ENUMERATION = 0, 2
"""How a property's values are listed (13.3.3): not at all, or one by one."""


@dataclass(frozen=True)
class DevicePropDesc:
    """A property of a device (GetDevicePropDesc, 13.3.3): its type, whether it can be set, its values.

    - `choices`: what it can be set to; empty where they are not listed.
    - `widened`: the device sends the choices' one byte as two, as the EOS 60D does for the battery's level
      (0x5001: 100, 75, 50, 25, 0); the standard does not allow it.
    """

    code: int
    data_type: int
    writable: bool
    default: Value
    current: Value
    choices: tuple[Value, ...] = ()
    widened: bool = False

    def encode(self) -> bytes:
        """Return the dataset."""
        form = bytes([_NO_FORM])
        if self.choices:
            gap = b"\0" if self.widened else b""
            listed = b"".join(encode_value(self.data_type, value) + gap for value in self.choices)
            form = bytes([_ENUMERATION]) + encode_integer(len(self.choices), 2) + listed
        return b"".join(
            (
                encode_integer(self.code, 2),
                encode_integer(self.data_type, 2),
                bytes([self.writable]),
                encode_value(self.data_type, self.default),
                encode_value(self.data_type, self.current),
                form,
            )
        )
