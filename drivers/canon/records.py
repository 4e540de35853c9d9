"""The event records of Canon's EOS bodies, as bytes and as values.

GetEvent answers a chain of records: size (32 bits, these included), type (32), body; a record of size 8 and type 0
ends it, which some bodies leave out. The first answer after SetEventMode holds the camera's whole state, later ones
what has changed since.

Rules that hold inside:

- ``decode`` and ``encode`` undo each other on well-formed bytes. A record whose type or inner form is not known stays
  as it came, in `OtherRecord`, and is skipped by its size; a record that contradicts itself raises `ProtocolError`.
- Counts and sizes are checked before they are believed; more than `MAX_EVENTS` bytes are refused unread, and more than
  `MAX_RECORDS` records once so many have been read.

Source: no public standard; layouts as recorded from an EOS 60D and an EOS 400D, and as libgphoto2 2.5.34 reads them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from drivers.canon.datasets import ObjectEntry
from drivers.canon.values import IMAGE_FORMAT_PROPERTIES, ImageFormat, number_of, text_of, text_value
from drivers.ptp.codes import EosEvent, Property, describe
from drivers.ptp.cursor import Cursor
from drivers.ptp.datasets import encode_array, encode_integer
from foundation.errors import ProtocolError

MAX_EVENTS: Final = 4 << 20
"""Bytes of the longest answer to GetEvent that is read; a body left alone for a day queues some 250 kB."""

MAX_RECORDS: Final = 1 << 16
"""Records of one answer; a body left alone queues some 8000 in half a day (as users of libgphoto2 report)."""

_HEADER_LENGTH: Final = 8
"""Bytes of a record's size and type."""

_END: Final = struct.pack("<II", _HEADER_LENGTH, EosEvent.END)
_LIST: Final = 3
"""The kind of an available list that has items; 1 and 7 say that there is none."""


@dataclass(frozen=True)
class PropertyChanged:
    """A property has this value now (0xc189)."""

    code: int
    value: bytes

    @property
    def number(self) -> int:
        """The value as a number; ProtocolError where it has fewer than 32 bits."""
        return number_of(self.value)

    @property
    def text(self) -> str:
        """The value as text."""
        return text_of(self.value)


@dataclass(frozen=True)
class AvailableValues:
    """A property can be set to one of these now (0xc18a); to none where the list is empty."""

    code: int
    values: tuple[int, ...] = ()
    kind: int = _LIST


@dataclass(frozen=True)
class AvailableFormats:
    """An image format property can be set to one of these now (0xc18a)."""

    code: int
    formats: tuple[ImageFormat, ...] = ()
    kind: int = _LIST


@dataclass(frozen=True)
class ObjectEvent:
    """An object has been written to the card (0xc181, 0xc1a7) or has changed there (0xc187, 0xc1a8)."""

    type: int
    entry: ObjectEntry


@dataclass(frozen=True)
class TransferRequest:
    """An object waits in the camera's memory to be fetched, and blocks it until TransferComplete (0xc186, 0xc1a9).

    `extra` are the numbers between size and name, empty where all are 0; on bodies that send 0xc1b8 instead, the
    parent and one whose meaning is not known.
    """

    handle: int
    format: int
    size: int
    name: str
    type: int = EosEvent.REQUEST_OBJECT_TRANSFER
    reserved: int = field(default=0, repr=False)
    extra: tuple[int, ...] = field(default=(), repr=False)
    padding: int = field(default=0, repr=False)
    """NULs behind the name's own."""


@dataclass(frozen=True)
class Notice:
    """A record that is one number: a handle, a storage, a status, seconds; `rest` is what a body adds to it."""

    type: int
    number: int
    rest: bytes = b""


@dataclass(frozen=True)
class OtherRecord:
    """A record as it came, for its type or form is not known."""

    type: int
    body: bytes = b""


Record = PropertyChanged | AvailableValues | AvailableFormats | ObjectEvent | TransferRequest | Notice | OtherRecord

_OBJECT_EVENTS: dict[int, int] = {
    EosEvent.OBJECT_ADDED: 4,
    EosEvent.OBJECT_INFO_CHANGED: 4,
    EosEvent.OBJECT_ADDED_64: 8,
    EosEvent.OBJECT_INFO_CHANGED_64: 8,
}
"""Bytes of the size in each kind of object event."""
_TRANSFER_REQUESTS: dict[int, tuple[int, int]] = {
    EosEvent.REQUEST_OBJECT_TRANSFER: (4, 1),
    EosEvent.REQUEST_OBJECT_TRANSFER_64: (8, 0),
    EosEvent.REQUEST_OBJECT_TRANSFER_64_LFN: (8, 2),
}
"""Bytes of the size, and numbers between it and the name, in each kind of transfer request."""
_NOTICES: frozenset[int] = frozenset(
    {
        EosEvent.OBJECT_REMOVED,
        EosEvent.REQUEST_GET_OBJECT_INFO,
        EosEvent.STORAGE_STATUS_CHANGED,
        EosEvent.STORAGE_INFO_CHANGED,
        EosEvent.OBJECT_CONTENT_CHANGED,
        EosEvent.CAMERA_STATUS_CHANGED,
        EosEvent.WILL_SOON_SHUT_DOWN,
        EosEvent.SHUTDOWN_TIMER_UPDATED,
        EosEvent.REQUEST_CANCEL_TRANSFER,
        EosEvent.STORE_ADDED,
        EosEvent.STORE_REMOVED,
        EosEvent.BULB_EXPOSURE_TIME,
        EosEvent.RECORDING_TIME,
        EosEvent.AF_RESULT,
        EosEvent.CTG_INFO_CHECK_COMPLETE,
    }
)


def decode_events(data: bytes) -> tuple[Record, ...]:
    """Return the records that GetEvent (0x9116) answers, without the closing one; no bytes are no records.

    A chain that ends with its last record, or with NULs, is whole: no cable hands on a part of an answer as all of it.
    """
    cursor = Cursor(data, "GetEvent", MAX_EVENTS)
    records: list[Record] = []
    while True:
        place = cursor.at
        if not any(data[place : place + _HEADER_LENGTH]) and not any(data[place:]):
            return tuple(records)
        if len(records) == MAX_RECORDS:
            raise ProtocolError(f"GetEvent gives more than {MAX_RECORDS} records; switch the camera off and on")
        size, kind = cursor.u32("the size of a record"), cursor.u32("the type of a record")
        if kind == EosEvent.END and size == _HEADER_LENGTH:
            return tuple(records)
        if size < _HEADER_LENGTH:
            raise cursor.fault("the size of a record", f"at least {_HEADER_LENGTH}", size, at=place)
        body = cursor.take(size - _HEADER_LENGTH, f"a record of type {describe(EosEvent, kind)}")
        try:
            records.append(_decode_record(kind, body))
        except ProtocolError as error:
            raise ProtocolError(f"GetEvent, record {len(records)} at byte {place}: {error}") from error


def encode_events(records: Iterable[Record] = ()) -> bytes:
    """Return the answer to GetEvent, closed; without records the answer for nothing new."""
    chain = bytearray()
    for record in records:
        kind, body = _encode_record(record)
        chain += encode_integer(_HEADER_LENGTH + len(body), 4) + encode_integer(kind, 4) + body
    return bytes(chain) + _END


def _decode_record(kind: int, body: bytes) -> Record:
    cursor = Cursor(body, describe(EosEvent, kind))
    if kind == EosEvent.PROPERTY_CHANGED:
        return PropertyChanged(cursor.u32("property"), cursor.rest())
    if kind == EosEvent.AVAILABLE_LIST_CHANGED:
        return _decode_list(cursor, body)
    if kind in _OBJECT_EVENTS:
        return ObjectEvent(kind, ObjectEntry.read(cursor, _OBJECT_EVENTS[kind]))
    if kind in _TRANSFER_REQUESTS:
        return _decode_transfer_request(cursor, kind)
    if kind in _NOTICES and len(body) >= 4:
        return Notice(kind, cursor.u32("number"), cursor.rest())
    return OtherRecord(kind, body)


def _decode_list(cursor: Cursor, body: bytes) -> Record:
    code, kind, count = cursor.u32("property"), cursor.u32("kind of list"), cursor.u32("count")
    cursor.what = f"{cursor.what} for {describe(Property, code)}"
    if kind != _LIST:
        known = not count and not cursor.left
        return AvailableValues(code, (), kind) if known else OtherRecord(EosEvent.AVAILABLE_LIST_CHANGED, body)
    if code in IMAGE_FORMAT_PROPERTIES:
        # A format takes at least four bytes, so that the bytes left bound the loop whatever the count says.
        record = AvailableFormats(code, tuple(ImageFormat.read(cursor) for _ in range(count)))
    else:
        record = AvailableValues(code, cursor.integers(count, 4, "values"))
    return OtherRecord(EosEvent.AVAILABLE_LIST_CHANGED, body) if cursor.left else record


def _decode_transfer_request(cursor: Cursor, kind: int) -> TransferRequest:
    size_length, extras = _TRANSFER_REQUESTS[kind]
    handle, object_format, reserved = cursor.u32("handle"), cursor.u32("format"), cursor.u32("reserved")
    size = cursor.integer(size_length, "size")
    extra = cursor.integers(extras, 4, "the numbers before the name")
    octets = cursor.rest()
    name = text_of(octets)
    if len(octets) == len(name):
        raise cursor.fault("the name", "closed by NUL", repr(octets[:40]))
    padding = len(octets) - len(name) - 1
    return TransferRequest(handle, object_format, size, name, kind, reserved, extra if any(extra) else (), padding)


def _encode_record(record: Record) -> tuple[int, bytes]:
    match record:
        case PropertyChanged(code, value):
            return EosEvent.PROPERTY_CHANGED, encode_integer(code, 4) + bytes(value)
        case AvailableValues(code, values, kind):
            head = encode_integer(code, 4) + encode_integer(kind, 4)
            return EosEvent.AVAILABLE_LIST_CHANGED, head + encode_array(values, 4)
        case AvailableFormats(code, formats, kind):
            numbers = b"".join(encode_integer(number, 4) for number in (code, kind, len(formats)))
            return EosEvent.AVAILABLE_LIST_CHANGED, numbers + b"".join(item.encode() for item in formats)
        case ObjectEvent(kind, entry):
            return kind, entry.encode(_OBJECT_EVENTS[kind])
        case TransferRequest():
            return record.type, _encode_transfer_request(record)
        case Notice(kind, number, rest):
            return kind, encode_integer(number, 4) + rest
        case OtherRecord(kind, body):
            return kind, body


def _encode_transfer_request(record: TransferRequest) -> bytes:
    size_length, extras = _TRANSFER_REQUESTS[record.type]
    extra = record.extra or (0,) * extras
    if len(extra) != extras:
        raise ValueError(f"{len(extra)} extra numbers; a record of type 0x{record.type:04x} has {extras}")
    return b"".join(
        (
            *(encode_integer(number, 4) for number in (record.handle, record.format, record.reserved)),
            encode_integer(record.size, size_length),
            *(encode_integer(number, 4) for number in extra),
            text_value(record.name) + bytes(record.padding),
        )
    )
