"""What Canon's EOS bodies say beyond the standard, as values: events, lists, codes of shutter, aperture and ISO.

GetEvent answers a chain of records: size (32 bits, these included), type (32), body; a record of size 8 and type 0
ends it, which some bodies leave out. The first answer after SetEventMode holds the camera's whole state, later ones
what has changed since.

Rules that hold inside:

- ``decode`` and ``encode`` undo each other on well-formed bytes. A record whose type or inner form is not known stays
  as it came, in `OtherRecord`, and is skipped by its size; a record that contradicts itself raises `ProtocolError`.
- Counts and sizes are checked before they are believed; more than `MAX_EVENTS` bytes are refused unread, and more than
  `MAX_RECORDS` records once so many have been read.
- Properties travel as bytes: 32 bits for every number, text with a closing NUL, structures for a few. Nothing here
  knows which property is what, except for the image formats, whose lists cannot be cut without it.

Source: no public standard; layouts as recorded from an EOS 60D and an EOS 400D, and as libgphoto2 2.5.34 reads them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final

from drivers.ptp.codes import EosEvent, Property
from drivers.ptp.protocol import MAX_DATASET, Cursor, describe, encode_array, encode_integer
from foundation.errors import InputError, ProtocolError

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


TOLERANCE = 0.01
"""How far, of one, a wanted value may lie from a nominal one; neighbouring nominal values are 5 % apart or more."""


@dataclass(frozen=True)
class DialPosition:
    """One position of a dial: the camera's code, its label, and the nominal value (s, f-number or ISO)."""

    code: int
    label: str
    value: float


@dataclass(frozen=True)
class Scale:
    """A dial: its steps by ascending code, and special codes without a value."""

    name: str
    steps: tuple[DialPosition, ...]
    specials: dict[int, str]

    def label(self, code: int) -> str:
        """Return what the camera shows for `code`; the code itself where it is in no table."""
        if code in self.specials:
            return self.specials[code]
        step = self._step(code)
        return f"code 0x{code:02x}" if step is None else step.label

    def value(self, code: int) -> float:
        """Return the nominal value of a code that a camera reports."""
        step = self._step(code)
        if step is None:
            raise ProtocolError(
                f"the camera reports {self.name} {self.label(code)} (0x{code:02x}), which is no fixed value; "
                "turn its mode dial to M and set a value"
            )
        return step.value

    def code(self, wanted: float | str, available: Iterable[int] | None = None) -> int:
        """Return the code of a nominal value or label, one of `available` where a camera's list is given.

        `wanted`: seconds, f-number or ISO speed; or text as on the dial: ``1/60``, ``0.5``, ``30``, ``auto``, ``bulb``.
        """
        offered = None if available is None else tuple(available)
        for code, label in self.specials.items():
            if isinstance(wanted, str) and wanted.strip().lower() == label and (offered is None or code in offered):
                return code
        number = _number(wanted)
        steps = [step for step in self.steps if offered is None or step.code in offered]
        fitting = [step for step in steps if number is not None and _near(number, step.value)]
        if not fitting:
            raise self._absent(wanted, number, steps)
        # Third stops before half stops (code ≡ 4 mod 8), then the nearer nominal value, then the lower code.
        best = min(fitting, key=lambda step: (step.code % 8 == 4, abs(step.value / (number or 1) - 1), step.code))
        return best.code

    def _step(self, code: int) -> DialPosition | None:
        return next((step for step in self.steps if step.code == code), None)

    def _absent(self, wanted: float | str, number: float | None, steps: list[DialPosition]) -> InputError:
        near = steps if number is None else sorted(steps, key=lambda step: abs(math.log2(step.value / number)))[:4]
        offers = ", ".join(dict.fromkeys(step.label for step in sorted(near, key=lambda step: step.code)))
        return InputError(f"{self.name} {wanted} is not offered; near it: {offers or 'nothing, the list is empty'}")


def _number(wanted: float | str) -> float | None:
    """Return the positive number that `wanted` is or spells, or None."""
    if isinstance(wanted, str):
        over, slash, under = wanted.strip().lower().removesuffix("s").removeprefix("f/").partition("/")
        try:
            number = float(over) / float(under) if slash else float(over)
        except (ValueError, ZeroDivisionError):
            return None
    else:
        number = float(wanted)
    return number if 0 < number < math.inf else None


def _near(number: float, nominal: float) -> bool:
    return abs(number / nominal - 1) <= TOLERANCE


def _scale(name: str, table: str, specials: dict[int, str]) -> Scale:
    steps: list[DialPosition] = []
    for entry in table.split():
        code, label = entry.split("=")
        value = _number(label)
        assert value is not None
        steps.append(DialPosition(int(code, 16), label, value))
    return Scale(name, tuple(sorted(steps, key=lambda step: step.code)), specials)


SHUTTER = _scale(
    "shutter time",
    """
    10=30 13=25 14=20 15=20 18=15 1B=13 1C=10 1D=10 20=8 23=6 24=6 25=5 28=4 2B=3.2 2C=3 2D=2.5 30=2 33=1.6 34=1.5
    35=1.3 38=1 3B=0.8 3C=0.7 3D=0.6 40=0.5 43=0.4 44=0.3 45=0.3 48=1/4 4B=1/5 4C=1/6 4D=1/6 50=1/8 53=1/10 54=1/10
    55=1/13 58=1/15 5B=1/20 5C=1/20 5D=1/25 60=1/30 63=1/40 64=1/45 65=1/50 68=1/60 6B=1/80 6C=1/90 6D=1/100
    70=1/125 73=1/160 74=1/180 75=1/200 78=1/250 7B=1/320 7C=1/350 7D=1/400 80=1/500 83=1/640 84=1/750 85=1/800
    88=1/1000 8B=1/1250 8C=1/1500 8D=1/1600 90=1/2000 93=1/2500 94=1/3000 95=1/3200 98=1/4000 9B=1/5000 9C=1/6000
    9D=1/6400 A0=1/8000 A3=1/10000 A5=1/12800 A8=1/16000 AB=1/20000 AD=1/25600 B0=1/32000 B3=1/40000 B5=1/51200
    B8=1/64000
    """,
    {0x00: "auto", 0x0C: "bulb", 0x04: "bulb"},
)
"""Shutter time in seconds (property 0xd102); beyond 1/8000 s of electronic shutters, as Canon's EDSDK names them up to
1/32000 s. The last three follow the law of eighths of a stop, and 1/64000 s is the shortest that an EOS R3 offers."""

APERTURE = _scale(
    "aperture",
    """
    08=1 0B=1.1 0C=1.2 0D=1.2 10=1.4 13=1.6 14=1.8 15=1.8 18=2 1B=2.2 1C=2.5 1D=2.5 20=2.8 23=3.2 24=3.5 25=3.5
    28=4 2B=4.5 2C=4.5 2D=5 30=5.6 33=6.3 34=6.7 35=7.1 38=8 3B=9 3C=9.5 3D=10 40=11 43=13 44=13 45=14 48=16 4B=18
    4C=19 4D=20 50=22 53=25 54=27 55=29 58=32 5B=36 5C=38 5D=40 60=45
    """,
    {0x00: "auto", 0xB0: "auto", 0xFFFF: "auto"},
)
"""Aperture as f-number (property 0xd101); 0 also where the lens has no contacts."""

ISO = _scale(
    "ISO speed",
    """
    40=50 43=64 45=80 48=100 4B=125 4D=160 50=200 53=250 55=320 58=400 5B=500 5D=640 60=800 63=1000 65=1250 68=1600
    6B=2000 6D=2500 70=3200 73=4000 75=5000 78=6400 7B=8000 7D=10000 80=12800 83=16000 85=20000 88=25600 8B=32000
    8D=40000 90=51200 93=64000 95=80000 98=102400
    A0=204800 A8=409600
    """,
    {0x00: "auto", 0x01: "auto"},
)
"""ISO speed (property 0xd103)."""
