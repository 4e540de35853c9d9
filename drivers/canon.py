"""A Canon EOS body as the suite's `Camera`: one raw frame after another, for hours, without a human.

First what these bodies say beyond the standard, as values: events, lists, codes of shutter, aperture and ISO. GetEvent
answers a chain of records: size (32 bits, these included), type (32), body; a record of size 8 and type 0 ends it,
which some bodies leave out. The first answer after SetEventMode holds the camera's whole state, later ones what has
changed since. Properties travel as bytes: 32 bits for every number, text with a closing NUL, structures for a few.
``decode`` and ``encode`` undo each other on well-formed bytes; a record whose type or form is not known stays as it
came, in `OtherRecord`, and one that contradicts itself raises `ProtocolError`.

Then a body's state and its connection (`EosBody`):

- Every step is one that the recorded conversations have, or one that libgphoto2 takes. Nothing is sent or taken for
  settable that the body does not list. Where it lists an operation and does not know it all the same, the camera does
  without if it can.
- What a body claims costs little: counts and sizes are checked before they are believed, and what it reports is
  held up to limits that no real body comes near.
- A body keeps a frame in its memory until TransferComplete, and refuses the next when that memory is full. So every
  object that it announces is fetched or thrown away, and freed in either case.

And the camera (`CanonEos`):

- A connection that fails is renewed, a limited number of times and for a limited time in one call. Then the call fails,
  with its first cause: longer patience is the caller's, who can say what is awaited.
- A release is never repeated once it may have happened: after a fault the frame is looked for in the camera's memory,
  and what is not found there is an error. What waits there before a release belongs to nobody any more. So no frame is
  ever taken for another one's.
- The exposed frame stays in the memory until it has been downloaded whole, or the next is exposed: a cable that fails
  and a file that cannot be written cost a download, not a frame.

Source: no public standard; layouts and conversations as recorded from an EOS 60D and an EOS 400D with a host;
libgphoto2 2.5.34 for how these are read, and for the order of a release; the number of mirror lockup among the custom
functions as ExifTool names it (CanonCustom::Functions2).
"""

from __future__ import annotations

import contextlib
import math
import re
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from datetime import datetime
from typing import BinaryIO, Final, TypeVar

from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings, Supplies
from drivers.ptp.codes import (
    AeMode,
    CameraStatus,
    CaptureDestination,
    DriveMode,
    EosEvent,
    FocusMode,
    ObjectFormat,
    Operation,
    Property,
    ReleaseButton,
    ResponseCode,
    WhiteBalance,
)
from drivers.ptp.protocol import (
    MAX_DATASET,
    PASSING,
    PASSING_LIMIT_S,
    START_TIMEOUT_S,
    Cursor,
    DeviceInfo,
    OperationDeclined,
    PtpSession,
    StorageInfo,
    Transport,
    decode_u32_array,
    describe,
    encode_array,
    encode_integer,
)
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import DeviceError, DeviceRefused, InputError, LinkClosed, LinkError, LinkTimeout, ProtocolError

_RAW: Final = 6  # Kind of a raw file, see `ImageFile`
_LOSSLESS: Final = 4  # Compression of a raw file, see `ImageFile`

_JPEG_SIZES: Final = {0: "L", 1: "M", 2: "S", 5: "M1", 6: "M2", 14: "S1", 15: "S2", 16: "S3"}

_IMAGE_FILE_LENGTH: Final = 16  # Bytes of one file's format: this length, kind, size and compression, 32 bits each

_MAX_IMAGE_FILES: Final = 2  # Files of one release: a raw file and a JPEG

_SETTING_HEADER: Final = 8  # Bytes before a new value: length and property


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


RAW_ONLY = ImageFormat((ImageFile(_RAW, 0, _LOSSLESS),))  # One full raw file a release: what a measurement wants

# Properties whose value is an `ImageFormat`.
IMAGE_FORMAT_PROPERTIES = frozenset(
    {
        Property.EOS_IMAGE_FORMAT,
        Property.EOS_IMAGE_FORMAT_CF,
        Property.EOS_IMAGE_FORMAT_SD,
        Property.EOS_IMAGE_FORMAT_EXT_HD,
    }
)


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


_NAME_WIDTH: Final = 16  # Bytes of a name's field: 8.3 characters and padding

_TIME_LENGTH: Final = 4  # Bytes of a time, seconds since 1970


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


# Bytes of the longest answer to GetEvent that is read; a body left alone for a day queues some 250 kB.
MAX_EVENTS: Final = 4 << 20

# Records of one answer; a body left alone queues some 8000 in half a day (as users of libgphoto2 report).
MAX_RECORDS: Final = 1 << 16

_HEADER_LENGTH: Final = 8  # Bytes of a record's size and type

_END: Final = struct.pack("<II", _HEADER_LENGTH, EosEvent.END)
_LIST: Final = 3  # The kind of an available list that has items; 1 and 7 say that there is none


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
    padding: int = field(default=0, repr=False)  # NULs behind the name's own


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

# Bytes of the size in each kind of object event.
_OBJECT_EVENTS: dict[int, int] = {
    EosEvent.OBJECT_ADDED: 4,
    EosEvent.OBJECT_INFO_CHANGED: 4,
    EosEvent.OBJECT_ADDED_64: 8,
    EosEvent.OBJECT_INFO_CHANGED_64: 8,
}
# Bytes of the size, and numbers between it and the name, in each kind of transfer request.
_TRANSFER_REQUESTS: dict[int, tuple[int, int]] = {
    EosEvent.REQUEST_OBJECT_TRANSFER: (4, 1),
    EosEvent.REQUEST_OBJECT_TRANSFER_64: (8, 0),
    EosEvent.REQUEST_OBJECT_TRANSFER_64_LFN: (8, 2),
}
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


# How far, of one, a wanted value may lie from a nominal one; neighbouring nominal values are 5 % apart or more.
TOLERANCE = 0.01


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


# Shutter time in seconds (property 0xd102); beyond 1/8000 s of electronic shutters, as Canon's EDSDK names them up to
# 1/32000 s. The last three follow the law of eighths of a stop, and 1/64000 s is the shortest that an EOS R3 offers.
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

# Aperture as f-number (property 0xd101); 0 also where the lens has no contacts.
APERTURE = _scale(
    "aperture",
    """
    08=1 0B=1.1 0C=1.2 0D=1.2 10=1.4 13=1.6 14=1.8 15=1.8 18=2 1B=2.2 1C=2.5 1D=2.5 20=2.8 23=3.2 24=3.5 25=3.5
    28=4 2B=4.5 2C=4.5 2D=5 30=5.6 33=6.3 34=6.7 35=7.1 38=8 3B=9 3C=9.5 3D=10 40=11 43=13 44=13 45=14 48=16 4B=18
    4C=19 4D=20 50=22 53=25 54=27 55=29 58=32 5B=36 5C=38 5D=40 60=45
    """,
    {0x00: "auto", 0xB0: "auto", 0xFFFF: "auto"},
)

# ISO speed (property 0xd103).
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

MIRROR_LOCKUP_FUNCTION = 0x060F  # Number of mirror lockup among the custom functions, on bodies that have it there

MAX_PROPERTIES = 1024  # Properties that are remembered; a real body reports 80 to 300
# Bytes of a property's value that are remembered; the longest known, of focus points, has some 5000.
MAX_VALUE = 1 << 14
# Values of a property's list that are remembered; the longest known, of image formats, has 31 and of Kelvin 76.
MAX_LIST = 1024
_MAX_WAITING = 64  # Objects that are remembered; more than a body's memory holds
_NOT_RAW = (ObjectFormat.EXIF_JPEG, ObjectFormat.JFIF, ObjectFormat.MOV, ObjectFormat.MOV2)
_NOT_RAW_SUFFIXES = (".jpg", ".jpeg", ".hif", ".mov", ".mp4")
_SILENT_OR_PLAIN = (DriveMode.SINGLE, DriveMode.SINGLE_SILENT)
_BATTERY_LOW = 0  # Of EOS_BATTERY_POWER: 0 is low, as libgphoto2 reads it
# Of EOS_BATTERY_POWER, as libgphoto2 reads it; other numbers are not known.
_BATTERY_LEVELS = {_BATTERY_LOW: 0.0, 5: 0.25, 1: 0.5, 4: 0.75, 2: 1.0}
# Of EOS_BATTERY_POWER: mains power, as Canon's EDSDK has it of the same state; not seen on the wire.
_BATTERY_MAINS = 0xFFFFFFFF

_Kept = TypeVar("_Kept")


@dataclass(frozen=True)
class WaitingObject:
    """An object that the body wants fetched; `size` in bytes as announced, and not to be trusted."""

    handle: int
    format: int
    size: int
    name: str

    @property
    def is_raw(self) -> bool:
        """Whether it is the frame itself rather than the picture or film beside it."""
        return self.format not in _NOT_RAW and not self.name.lower().endswith(_NOT_RAW_SUFFIXES)


@dataclass
class EosState:
    """The properties of a body, what they can be set to, and the objects that wait in its memory.

    - `values`: the value of each property reported so far.
    - `lists`, `formats`: what a property can be set to now.
    - `functions`: the custom functions: number to first value.
    - `busy`: whether the body reported that it is exposing or writing.
    - `waiting`: by handle, in the order of their announcement.
    """

    values: dict[int, bytes] = field(default_factory=dict[int, bytes])
    lists: dict[int, tuple[int, ...]] = field(default_factory=dict[int, tuple[int, ...]])
    formats: dict[int, tuple[ImageFormat, ...]] = field(default_factory=dict[int, tuple[ImageFormat, ...]])
    functions: dict[int, int] = field(default_factory=dict[int, int])
    busy: bool = False
    waiting: dict[int, WaitingObject] = field(default_factory=dict[int, WaitingObject])

    def take(self, records: Iterable[Record]) -> None:
        """Update the state from the records of one answer."""
        for record in records:
            match record:
                case PropertyChanged(Property.EOS_CUSTOM_FUNCTIONS, value):
                    for number, first in custom_functions(value[:MAX_VALUE]).items():
                        _remember(self.functions, number, first)
                case PropertyChanged(code, value):
                    if len(value) <= MAX_VALUE:
                        _remember(self.values, code, value)
                case AvailableValues(code, values):
                    if len(values) <= MAX_LIST:
                        _remember(self.lists, code, values)
                case AvailableFormats(code, formats):
                    if len(formats) <= MAX_LIST:
                        _remember(self.formats, code, formats)
                case TransferRequest():
                    self._announce(WaitingObject(record.handle, record.format, record.size, record.name))
                case ObjectEvent(EosEvent.OBJECT_ADDED | EosEvent.OBJECT_ADDED_64, entry):
                    if entry.format != ObjectFormat.ASSOCIATION:
                        self._announce(WaitingObject(entry.handle, entry.format, entry.size, entry.name))
                case Notice(EosEvent.OBJECT_REMOVED, handle):
                    self.waiting.pop(handle, None)
                case Notice(EosEvent.CAMERA_STATUS_CHANGED, status):
                    self.busy = status == CameraStatus.BUSY

    def number(self, code: int) -> int | None:
        """Return the value of a property that is a number, None where it was not reported."""
        value = self.values.get(code)
        return number_of(value) if value is not None and len(value) >= 4 else None

    def text(self, code: int) -> str:
        """Return the value of a property that is text, empty where it was not reported."""
        return text_of(self.values.get(code, b""))

    def holds(self, code: int, value: bytes) -> bool:
        """Return whether a property has this value now."""
        # Some bodies send more bytes than they take.
        return code in self.values and self.values[code][: len(value)] == value

    def _announce(self, waiting: WaitingObject) -> None:
        # An object announced twice keeps its place; of too many the oldest are forgotten.
        self.waiting[waiting.handle] = waiting
        while len(self.waiting) > _MAX_WAITING:
            del self.waiting[next(iter(self.waiting))]


def battery_level(state: EosState) -> float | None:
    """Return the charge that a body reports, 0 … 1 in quarters; None where it does not, or runs on mains power."""
    power = state.number(Property.EOS_BATTERY_POWER)
    return None if power is None else _BATTERY_LEVELS.get(power)


def _remember(kept: dict[int, _Kept], code: int, value: _Kept) -> None:
    if code in kept or len(kept) < MAX_PROPERTIES:
        kept[code] = value


def custom_functions(value: bytes) -> dict[int, int]:
    """Return the custom functions in a value of property 0xd1a0: number to first value.

    A value holds one group: its length, 1, the group's number, the length of the rest, the count of functions, then
    for each its number, the count of its values, and those; 32 bits each. What does not fit that is left out.
    """
    cursor = Cursor(value, "custom functions")
    functions: dict[int, int] = {}
    try:
        cursor.integers(4, 4, "the head")
        for _ in range(cursor.u32("the count of functions")):
            number = cursor.u32("the number of a function")
            first, *_ = cursor.array(4, "the values of a function") or (0,)
            functions[number] = first
    except ProtocolError:
        pass
    return functions


def problems(state: EosState) -> list[str]:
    """Return everything about a body's own settings that would spoil a series, each with its remedy."""
    found: list[str] = []
    mode, focus, drive = (
        state.number(code) for code in (Property.EOS_AE_MODE, Property.EOS_FOCUS_MODE, Property.EOS_DRIVE_MODE)
    )
    if mode is not None and mode != AeMode.MANUAL:
        found.append(f"the mode dial stands at {_named(AeMode, mode)}: turn it to M")
    if focus is not None and focus != FocusMode.MANUAL:
        found.append("autofocus is on: set the lens to MF and focus by hand")
    if drive is not None and drive not in _SILENT_OR_PLAIN:
        found.append(f"the drive mode is {_named(DriveMode, drive)}: set single shooting")
    if state.number(Property.EOS_MIRROR_UP_SETTING) or state.functions.get(MIRROR_LOCKUP_FUNCTION) == 1:
        found.append("mirror lockup is on: switch it off")
    if state.number(Property.EOS_AEB) or state.number(Property.EOS_BRACKET_MODE):
        found.append("exposure bracketing is on: switch it off")
    if state.number(Property.EOS_HDR_SETTING):
        found.append("HDR mode is on: switch it off")
    off_after = state.number(Property.EOS_AUTO_POWER_OFF)
    if off_after:
        found.append(f"auto power off is set to {off_after} s: set it to off")
    if state.number(Property.EOS_BATTERY_POWER) == _BATTERY_LOW:
        found.append("the battery is low: charge it, or use mains power")
    return found


def plan(state: EosState, settings: ExposureSettings) -> dict[int, bytes]:
    """Return which property gets which value for a series of raw frames, in the order of setting."""
    refused = problems(state)
    wanted: dict[int, bytes] = {}
    try:
        wanted[Property.EOS_IMAGE_FORMAT] = _raw_format(state).encode()
    except InputError as error:
        refused.append(str(error))
    for code, scale, value in (
        (Property.EOS_ISO_SPEED, ISO, settings.iso),
        (Property.EOS_APERTURE, APERTURE, settings.aperture),
        (Property.EOS_SHUTTER_SPEED, SHUTTER, settings.shutter_s),
    ):
        offered = _offered(state, code, scale)
        if value is None:
            if offered:
                refused.append(f"the lens has apertures, {scale.label(offered[0])} among them: name one as f-number")
        elif scale is APERTURE and not offered:
            refused.append(
                f'aperture {value:g} cannot be set, for the lens tells of none: set aperture = "none" for it'
            )
        else:
            try:
                wanted[code] = number_value(scale.code(value, offered))
            except InputError as error:
                refused.append(str(error))
    if refused:
        raise DeviceRefused(f"the camera cannot take the series: {'; '.join(refused)}")
    if WhiteBalance.DAYLIGHT in state.lists.get(Property.EOS_WHITE_BALANCE, ()):
        # Raw values do not depend on it; a fixed one keeps what converters show the same through the series.
        wanted[Property.EOS_WHITE_BALANCE] = number_value(WhiteBalance.DAYLIGHT)
    return wanted


def shutter_speeds(state: EosState) -> tuple[float, ...]:
    """Return the nominal shutter times that a body lists, seconds, rising; bulb and codes in no table are left out."""
    values = {step.code: step.value for step in SHUTTER.steps}
    return tuple(sorted({values[code] for code in state.lists.get(Property.EOS_SHUTTER_SPEED, ()) if code in values}))


def host_destination(state: EosState) -> bytes:
    """Return the value of property 0xd11c that sends frames to the host; a body that lists none is given it to try."""
    offered = state.lists.get(Property.EOS_CAPTURE_DESTINATION, ())
    known = (*offered, state.number(Property.EOS_CAPTURE_DESTINATION))
    if offered and CaptureDestination.HOST not in known:
        listed = ", ".join(str(value) for value in offered)
        raise DeviceRefused(
            f"the camera offers the capture destinations {listed}, but not {CaptureDestination.HOST.value}, the host; "
            "such a body cannot be tethered here"
        )
    return number_value(CaptureDestination.HOST)


def _raw_format(state: EosState) -> ImageFormat:
    offered = state.formats.get(Property.EOS_IMAGE_FORMAT, ())
    if RAW_ONLY not in offered and not state.holds(Property.EOS_IMAGE_FORMAT, RAW_ONLY.encode()):
        raws = ", ".join(str(item) for item in offered if any(file.is_raw for file in item.files))
        raise InputError(f"image format {RAW_ONLY} alone is not offered; with raw are: {raws or 'none'}")
    return RAW_ONLY


def _offered(state: EosState, code: int, scale: Scale) -> tuple[int, ...]:
    """Return the codes that a body can be set to, or stands at where it lists nothing: then nothing can be set."""
    current = state.number(code)
    standing = () if current is None or current in scale.specials else (current,)
    return state.lists.get(code) or standing


def _named(kind: type[AeMode] | type[DriveMode], value: int) -> str:
    try:
        return kind(value).name.lower().replace("_", " ")
    except ValueError:
        return f"0x{value:02x}"


PIECE_BYTES = 1 << 20  # Asked for at once; pieces of 5 MiB have crashed newer bodies
MAX_FRAME_BYTES = 256 << 20  # No raw file of an EOS body comes near it
# GetEvent answers that one drain takes, at most: a few empty the queue, and some firmware repeats itself.
MAX_POLLS = 64
KEEP_ALIVE_S = 10.0  # After this long a body is asked to stay awake, as libgphoto2 asks it
SETTLE_LIMIT_S = 5.0  # How long a body may take to report a value that it was given, or room for a frame
# How long a body may be busy after it was connected, or when it is to release, before it is refused: an EOS 2000D is
# for seconds at either (gphoto2, issue 382).
BUSY_LIMIT_S = 30.0
# Presses in a row, spread over `PASSING_LIMIT_S`: what keeps a body busy ends by itself or by what is fetched
# between.
RELEASE_TRIES = 5
# Wait for the answer to a release; some bodies expose before they answer. libgphoto2 waits as long.
CAPTURE_TIMEOUT_S = 100.0

_REMOTE_ON, _REMOTE_OFF = 1, 0  # Parameter of SetRemoteMode, as the recorded conversations and libgphoto2 send it
# Bodies to which libgphoto2 sends 0x15 or 0x11 as remote mode (`is_canon_eos_m` in its ptp-private.h), with live view
# on before each frame: EOS M, but for the M6 Mark II, which is as the reflex bodies, and compact cameras. "Canon EOS
# Kiss M" is the M50's name in Japan.
_OTHER_REMOTE_MODE = re.compile(r"Canon (?!EOS)|Canon EOS (Kiss )?M(?!6 Mark II\b)")
_WITHOUT_AF = 1  # Second parameter of RemoteReleaseOn: a release without autofocus
# Room announced to the body: so many clusters of so many bytes, 320 GiB, more than a session takes.
_HOST_CLUSTERS, _HOST_CLUSTER_BYTES = 0x04FFFFFF, 0x1000
# Pauses between questions to the body, seconds; short at first, for most answers come at once (as libgphoto2 waits).
_PAUSES_S = (0.05, 0.1, 0.15, 0.2)
# Requests of one piece in all, with the longest pause between: a second for a fault that passes, then the frame is
# retaken.
_PIECE_TRIES = 5
_FREE_TRIES = 3  # Few, as the next `make_ready` tries again
# Operations that give a part of an object, the preferred one first.
_IN_PIECES = (Operation.EOS_GET_PARTIAL_OBJECT, Operation.GET_PARTIAL_OBJECT)
# Responses to an operation that a body has not got, whatever it lists.
_NOT_GOT = (ResponseCode.OPERATION_NOT_SUPPORTED, ResponseCode.EOS_UNKNOWN_COMMAND)
# Responses to a request for a piece that asking again does not change.
_LASTING = (
    *_NOT_GOT,
    ResponseCode.INVALID_OBJECT_HANDLE,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.DEVICE_BUSY,
)
# Responses to a question after something that a body has not got: a card, a property.
_NOTHING_THERE = (
    ResponseCode.PARAMETER_NOT_SUPPORTED,
    ResponseCode.INVALID_STORAGE_ID,
    ResponseCode.DEVICE_PROP_NOT_SUPPORTED,
    ResponseCode.ACCESS_DENIED,
    ResponseCode.STORE_NOT_AVAILABLE,
    ResponseCode.INVALID_PARAMETER,
)
_SLOT_FILLED = 0xFFFF  # Bits of a storage number that are 0 where there is no card in the slot (ISO 15740, 5.2.1)
_MAX_CARDS = 8  # Cards that are asked for their room; bodies have one or two
# What RemoteRelease answers as parameter; 0 is success.
_RELEASE_RESULTS = {
    1: "it finds no focus: set the lens to MF",
    3: "its mirror is up: switch mirror lockup off",
    7: "its card is full: empty it",
    8: "its card is read-only: unlock it",
}


class EosBody:
    """An EOS body behind an open cable."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._clock = clock
        self._session = PtpSession(transport, clock)
        self._info = DeviceInfo()
        self._destination: bytes | None = None
        self._unsupported: set[int] = set()
        self._spoken_at = clock.monotonic()
        self.state = EosState()

    @property
    def label(self) -> str:
        """What messages call the body."""
        return self._session.label

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware; the serial number is the engraved one where it is sent."""
        serial = self.state.text(Property.EOS_SERIAL_NUMBER) or self._info.serial_number
        return CameraIdentity(self._info.manufacturer, self._info.model, serial, self._info.device_version)

    def connect(self) -> None:
        """Open the session, take the body under remote control and learn its state."""
        self._while_busy(self._session.open)
        self._while_busy(self._take_control)

    def _take_control(self) -> None:
        _, data = self._session.call(Operation.GET_DEVICE_INFO)
        self._info = DeviceInfo.decode(data)
        remote = (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_GET_EVENT)
        if "canon" not in self._info.manufacturer.lower() or not all(map(self._offers, remote)):
            raise DeviceRefused(
                f"{self.label} is a {self._info.manufacturer} {self._info.model}, which does not speak as a Canon EOS "
                "does; connect an EOS body, or take the frames otherwise and use `acquire import`"
            )
        if _OTHER_REMOTE_MODE.match(self._info.model):
            raise DeviceRefused(
                f"{self.label} is a {self._info.model}; EOS M and compact bodies want another remote mode than 1, and "
                'other steps to a frame, which are not known well enough here; set connection = "gphoto2" in '
                "[lab.camera], or take the frames otherwise and use `acquire import`"
            )
        self._session.call(Operation.EOS_SET_REMOTE_MODE, _REMOTE_ON)
        self._session.call(Operation.EOS_SET_EVENT_MODE, _REMOTE_ON)
        self.drain()
        # libgphoto2 asks again, too: newer bodies have nothing to tell when they are asked at once.
        if not self._settled(lambda: bool(self.state.values)):
            raise ProtocolError(f"{self.label} sends no state when asked for events; switch it off and on")
        if self._requested(Property.EOS_SERIAL_NUMBER):
            self._settled(lambda: Property.EOS_SERIAL_NUMBER in self.state.values)
        self._receive_frames()

    def supplies(self) -> Supplies:
        """Return what is left of battery and card, as far as the body tells."""
        self.drain()
        level = self._battery_level()
        # On mains power a battery is reported, too: anything else is not known.
        mains = True if self.state.number(Property.EOS_BATTERY_POWER) == _BATTERY_MAINS else None
        saves_to_host = self.state.holds(Property.EOS_CAPTURE_DESTINATION, number_value(CaptureDestination.HOST))
        return Supplies(level, mains, self._card_free_bytes(), saves_to_host)

    def disconnect(self) -> None:
        """Give the body back as it was found; a fault of the cable goes to the caller."""
        self.free_waiting()
        if self._destination is not None:
            with contextlib.suppress(OperationDeclined):
                self._send(Property.EOS_CAPTURE_DESTINATION, self._destination)
        for operation in (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_SET_EVENT_MODE):
            with contextlib.suppress(OperationDeclined):
                self._session.call(operation, _REMOTE_OFF, timeout=START_TIMEOUT_S, retry_s=1.0)
        self._session.close()

    def poll(self) -> bool:
        """Ask once what is new; return whether anything was."""
        with contextlib.suppress(ProtocolError):
            self._session.events()  # hints that asking would be worth while, which it is anyway
        _, data = self._session.call(Operation.EOS_GET_EVENT)
        records = decode_events(data)
        self.state.take(records)
        self._keep_awake()
        return bool(records)

    def drain(self) -> None:
        """Ask until there is nothing new."""
        for _ in range(MAX_POLLS):
            if not self.poll():
                return

    def set(self, code: int, value: bytes) -> None:
        """Set a property, and see that the body reports it."""
        if self.state.holds(code, value):
            return
        self._send(code, value)
        self._verify(code, value)

    def make_ready(self) -> None:
        """Empty the event queue and the memory, and wait until the body can take a frame."""
        self.drain()
        self.free_waiting()
        # A body whose "idle" was lost would seem busy for ever; its answer shows whether it takes the release.
        self._settled(lambda: not self.state.busy)
        self.free_waiting()
        if not self._settled(lambda: self.state.number(Property.EOS_AVAILABLE_SHOTS) != 0):
            raise DeviceRefused(f"{self.label} has no room for a frame; switch it off and on to empty its memory")

    def release(self) -> None:
        """Press the release down and let it go, without autofocus."""
        if self._offers(Operation.EOS_REMOTE_RELEASE_ON):
            try:
                self._while_busy(self._press)
            except OperationDeclined as error:
                if not self._lacks(Operation.EOS_REMOTE_RELEASE_ON, error):
                    raise
            else:
                return
        parameters, _ = self._session.call(Operation.EOS_REMOTE_RELEASE, timeout=CAPTURE_TIMEOUT_S)
        result = parameters[0] if parameters else 0
        if result:
            reason = _RELEASE_RESULTS.get(result, f"result 0x{result:x}")
            raise DeviceRefused(f"{self.label} does not release: {reason}")

    def _press(self) -> None:
        for left in reversed(range(RELEASE_TRIES)):
            try:
                self._session.call(
                    Operation.EOS_REMOTE_RELEASE_ON,
                    ReleaseButton.HALF_AND_FULL,
                    _WITHOUT_AF,
                    timeout=CAPTURE_TIMEOUT_S,
                    retry_s=0.0,
                )
                break
            except OperationDeclined as error:
                # What keeps a body busy here is a release still held down, or events that nobody fetched.
                self._let_go()
                self.drain()
                if error.code != ResponseCode.DEVICE_BUSY:
                    raise
                if not left:
                    raise OperationDeclined(
                        f"{error}; look for mirror lockup, a timer or a menu on its display", error.code
                    ) from error
                self._clock.sleep(PASSING_LIMIT_S / RELEASE_TRIES)
        self._let_go()

    def await_object(self, not_before: float, until: float, wanted: Callable[[WaitingObject], bool]) -> WaitingObject:
        """Return the newest object that waits and is wanted."""
        pauses = iter(_PAUSES_S)
        while True:
            if self.poll():
                pauses = iter(_PAUSES_S)
            if self._clock.monotonic() < not_before:
                self.free_waiting()
            # Of two the later one belongs to this release: the other's announcement was late.
            for candidate in reversed(list(self.state.waiting.values())):
                if wanted(candidate):
                    return candidate
            if self._clock.monotonic() >= until:
                raise LinkTimeout(f"{self.label} has announced no frame in time")
            self._clock.sleep(next(pauses, _PAUSES_S[-1]))

    def fetch(self, waiting: WaitingObject, into: BinaryIO, offset: int = 0) -> None:
        """Append an object's bytes from `offset` on to `into`, piece by piece."""
        if not 0 < waiting.size <= MAX_FRAME_BYTES:
            raise DeviceError(
                f"{self.label} announces {waiting.name!r} of {waiting.size} bytes; 1 to {MAX_FRAME_BYTES} were expected"
            )
        while offset < waiting.size:
            operation = next((known for known in _IN_PIECES if self._offers(known)), None)
            if operation is None:
                self._fetch_whole(waiting, into, offset)
                return
            try:
                offset += into.write(self._piece(operation, waiting, offset))
            except OperationDeclined as error:
                if not self._lacks(operation, error):
                    raise
            self._keep_awake()

    def free(self, waiting: WaitingObject) -> None:
        """Let the body forget an object; where it will not, the next `make_ready` tries again."""
        for left in reversed(range(_FREE_TRIES)):
            try:
                self._session.call(Operation.EOS_TRANSFER_COMPLETE, waiting.handle)
            except OperationDeclined as error:
                # What has gone is as well, and where nothing can be freed the body frees it by itself.
                gone = error.code == ResponseCode.INVALID_OBJECT_HANDLE
                if not gone and not self._lacks(Operation.EOS_TRANSFER_COMPLETE, error):
                    if left:
                        self._clock.sleep(_PAUSES_S[-1])
                    continue
            self.state.waiting.pop(waiting.handle, None)
            return

    def free_waiting(self) -> None:
        """Let the body forget every object that waits."""
        for waiting in list(self.state.waiting.values()):
            self.free(waiting)

    def _fetch_whole(self, waiting: WaitingObject, into: BinaryIO, offset: int) -> None:
        """Append an object's bytes from `offset` on, from a body that gives no parts: those before come again."""
        came = 0

        def take(piece: bytes) -> None:
            nonlocal came
            if came + len(piece) > waiting.size:
                raise ProtocolError(f"{self.label} announced {waiting.size} bytes for {waiting.name!r} and gives more")
            into.write(piece[max(offset - came, 0) :])
            came += len(piece)

        self._session.call(Operation.GET_OBJECT, waiting.handle, receive=take)
        if came < waiting.size:
            raise self._cut(waiting, came)

    def _piece(self, operation: Operation, waiting: WaitingObject, offset: int) -> bytes:
        """Return the next bytes of an object; fewer than were asked for are good, for the rest follows."""
        wanted = min(PIECE_BYTES, waiting.size - offset)
        for left in reversed(range(_PIECE_TRIES)):
            try:
                sent, data = self._session.call(operation, waiting.handle, offset, wanted)
            except OperationDeclined as error:
                if not left or error.code in _LASTING:
                    raise
            else:
                if len(data) > wanted:
                    raise ProtocolError(f"{self.label} gives {len(data)} bytes at {offset}; {wanted} were asked for")
                # The standard's operation answers how many bytes were sent; what Canon's own answers is not known.
                counted = sent[0] if sent and operation == Operation.GET_PARTIAL_OBJECT else len(data)
                if data and counted == len(data):
                    return data
            self._clock.sleep(_PAUSES_S[-1])
        raise self._cut(waiting, offset)

    def _cut(self, waiting: WaitingObject, came: int) -> DeviceError:
        return DeviceError(
            f"{self.label} announced {waiting.size} bytes for {waiting.name!r}, but gives only {came}; "
            "the frame is worthless and may be retaken"
        )

    def _receive_frames(self) -> None:
        host = host_destination(self.state)
        # A body that a killed run left behind stands at the host already; its user wants the card again.
        self._destination = number_value(CaptureDestination.CARD)
        if not self.state.holds(Property.EOS_CAPTURE_DESTINATION, host):
            self._destination = self.state.values.get(Property.EOS_CAPTURE_DESTINATION, self._destination)
            self._send(Property.EOS_CAPTURE_DESTINATION, host)
        self._optional(Operation.EOS_PC_HDD_CAPACITY, _HOST_CLUSTERS, _HOST_CLUSTER_BYTES, 1)
        self.drain()
        self._verify(Property.EOS_CAPTURE_DESTINATION, host)

    def _send(self, code: int, value: bytes) -> None:
        self._session.call(Operation.EOS_SET_DEVICE_PROP_VALUE_EX, send=PropertySetting(code, value).encode())

    def _verify(self, code: int, value: bytes) -> None:
        if self._settled(lambda: self.state.holds(code, value)):
            return
        if self._requested(code) and self._settled(lambda: self.state.holds(code, value)):
            return
        came = self.state.values.get(code)
        raise DeviceRefused(
            f"{self.label} was given {value.hex()} for property {describe(Property, code)} and reports "
            f"{came.hex() if came is not None else 'nothing'}; set it by hand, or switch the camera off and on"
        )

    def _while_busy(self, action: Callable[[], None]) -> None:
        """Do something until the body is not busy, for a limited time: a new session would only begin its work anew."""
        end = self._clock.monotonic() + BUSY_LIMIT_S
        while True:
            try:
                return action()
            except OperationDeclined as error:
                if error.code != ResponseCode.DEVICE_BUSY:
                    raise
                if self._clock.monotonic() >= end:
                    raise DeviceRefused(f"{error}; it has been so for {BUSY_LIMIT_S:g} s") from error

    def _let_go(self) -> None:
        with contextlib.suppress(OperationDeclined):
            self._session.call(Operation.EOS_REMOTE_RELEASE_OFF, ReleaseButton.HALF_AND_FULL)

    def _settled(self, condition: Callable[[], bool]) -> bool:
        """Poll until `condition` holds, for a limited time; return whether it does."""
        end = self._clock.monotonic() + SETTLE_LIMIT_S
        while not condition():
            if self._clock.monotonic() >= end:
                return False
            self.poll()
            if not condition():
                self._clock.sleep(_PAUSES_S[0])
        return True

    def _keep_awake(self) -> None:
        now = self._clock.monotonic()
        if now - self._spoken_at >= KEEP_ALIVE_S:
            self._spoken_at = now
            if self._offers(Operation.EOS_KEEP_DEVICE_ON):
                with contextlib.suppress(OperationDeclined):
                    self._session.call(Operation.EOS_KEEP_DEVICE_ON, retry_s=0.0)

    def _battery_level(self) -> float | None:
        level = battery_level(self.state)
        if level is None and Property.BATTERY_LEVEL in self._info.properties:
            answer = self._optional(Operation.GET_DEVICE_PROP_VALUE, Property.BATTERY_LEVEL)
            # 0 may stand for power from elsewhere (ISO 15740, 13.4.1); an empty battery would not answer.
            if answer is not None and answer[1][:1] not in (b"", b"\0"):
                level = min(answer[1][0], 100) / 100
        return level

    def _card_free_bytes(self) -> int | None:
        """Return the room on all cards together; None where there is no card, or none is told of."""
        listed = self._optional(Operation.EOS_GET_STORAGE_IDS)
        if listed is None:
            return None
        free: list[int] = []
        for storage in decode_u32_array(listed[1], "the list of cards")[:_MAX_CARDS]:
            if storage & _SLOT_FILLED:
                answer = self._optional(Operation.EOS_GET_STORAGE_INFO, storage)
                if answer is not None:
                    free.append(StorageInfo.decode(answer[1]).free)
        return sum(free) if free else None

    def _requested(self, code: int) -> bool:
        """Ask for a property whose value an event will bring; return whether the body takes the question."""
        return self._optional(Operation.EOS_REQUEST_DEVICE_PROP_VALUE, code) is not None

    def _optional(self, operation: Operation, *parameters: int) -> tuple[tuple[int, ...], bytes] | None:
        """Return what an operation answers; None where the body has not got it, or declines these parameters."""
        if not self._offers(operation):
            return None
        try:
            return self._session.call(operation, *parameters)
        except OperationDeclined as error:
            if not self._lacks(operation, error) and error.code not in _NOTHING_THERE:
                raise
            return None

    def _lacks(self, operation: Operation, error: OperationDeclined) -> bool:
        """Return whether a body has not got an operation that it lists, by its answer; it is not asked again then."""
        if error.code not in _NOT_GOT:
            return False
        self._unsupported.add(operation)
        return True

    def _offers(self, operation: int) -> bool:
        return operation in self._info.operations and operation not in self._unsupported


# How often a call renews the connection: a fault that comes back more often lasts. Chosen, as the next two.
RECOVERIES = 3
# Time after the first fault of a call in which the connection may be renewed; a body that was switched off and on, or
# put back on its cable, is there within 10 s.
RECOVERY_S = 30.0
# Time after its exposure within which a frame may be announced, beside as much time again as it was exposed: so long
# a dark frame takes that some bodies subtract.
FRAME_S = 30.0
# Time for a frame to be announced on a new connection, on which the body sends its whole state at once.
REDISCOVERY_S = 10.0

_CERTAIN_SHARE = 0.9  # Share of the nominal shutter time that passes at least: 1/6 s is really 0.149 s
# Pauses between attempts to find the camera again, doubled from one to the other: soon for a cable put back, seldom
# enough that a body which starts is left alone.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 5.0
# Responses that a new session may cure.
_STUCK = (
    *PASSING,
    ResponseCode.UNDEFINED,
    ResponseCode.GENERAL_ERROR,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.INVALID_TRANSACTION_ID,
    ResponseCode.INCOMPLETE_TRANSFER,
    ResponseCode.TRANSACTION_CANCELLED,
)
_SUFFIXES: dict[int, str] = {ObjectFormat.CRW: ".CRW", ObjectFormat.CR2: ".CR2", ObjectFormat.CR3: ".CR3"}
_REMEDY = (
    "check its cable and battery, switch it off and on, and end other programs that use it (a desktop's photo importer "
    "begins by itself)"
)

_Result = TypeVar("_Result")


@dataclass
class _Shot:
    """A release that has happened, or may have.

    `announced` is its frame once the body has named it, `fetched` what a download has begun with; objects that are
    `absent` cannot be its frame.
    """

    body: EosBody
    released_at: datetime
    not_before: float
    until: float
    shutter_s: float
    announced: WaitingObject | None = None
    fetched: WaitingObject | None = None
    absent: set[int] = field(default_factory=set[int])


class CanonEos:
    """A `drivers.camera.Camera` over PTP, whatever the cable."""

    def __init__(self, open_transport: Callable[[], Transport], clock: Clock = SYSTEM_CLOCK) -> None:
        self._open_transport = open_transport
        self._clock = clock
        self._fault: DeviceError | None = None
        self._renewable_until = math.inf
        self._transport: Transport | None = None
        self._body: EosBody | None = None
        self._identity: CameraIdentity | None = None
        self._settings: ExposureSettings | None = None
        self._shot: _Shot | None = None
        self._closed = False

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware."""
        self._begin()
        return self._carry_out(EosBody.identity)

    def supplies(self) -> Supplies:
        """Return what is left of battery and card; see `drivers.camera.ReportsSupplies`."""
        self._begin()
        return self._carry_out(EosBody.supplies)

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify the exposure, raw format and destination; a frame that was not downloaded is dropped."""

        def configured(body: EosBody) -> None:
            body.make_ready()
            _apply(body, settings)

        self._begin()
        self._settings = self._shot = None
        self._carry_out(configured)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers now, as engraved, seconds, rising; empty if it lists none."""

        def listed(body: EosBody) -> tuple[float, ...]:
            body.drain()
            return shutter_speeds(body.state)

        self._begin()
        return self._carry_out(listed)

    def expose(self) -> datetime:
        """Release the shutter without autofocus; return when it was released, UTC, once the body announces the frame.

        A frame that was exposed before and has not been downloaded is dropped.
        """
        settings = self._settings
        if settings is None:
            raise DeviceRefused("the camera has no exposure settings; configure it before the first exposure")
        self._begin()
        self._shot = None
        shot = self._release(settings)
        try:
            self._carry_out(lambda body: self._await_frame(body, shot))
        except Exception:
            self._empty()
            raise
        self._shot = shot
        return shot.released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the frame exposed last, whole and unchanged, to `into`.

        A download that failed, for whatever reason, may be tried again with a new stream as long as the body holds the
        frame in its memory: until the next exposure, or until it is switched off.
        """
        shot = self._shot
        if shot is None:
            raise DeviceError("no exposed frame waits in the camera to be downloaded; expose it again")
        self._begin()
        start = into.tell()
        frame = self._carry_out(lambda body: self._receive(body, shot, into, start))
        self._shot = None
        self._empty()
        return CapturedFrame(_file_name(frame), frame.size, shot.released_at)

    def idle(self) -> None:
        """Fetch what has happened while nothing was asked, and keep the body awake; call it now and then in a pause."""
        self._begin()
        self._carry_out(EosBody.drain)

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""
        self._closed = True
        self._shot = None
        body = self._body
        if body is not None:
            try:
                body.disconnect()
            except DeviceError as error:
                self._drop(error)
            else:
                self._drop(None)

    def _begin(self) -> None:
        """Begin a call: it has had no fault yet."""
        self._fault, self._renewable_until = None, math.inf

    def _carry_out(self, action: Callable[[EosBody], _Result]) -> _Result:
        """Return what `action` does with a connected body, over a new connection if this one fails."""
        renewals = 0
        was_busy = False
        while True:
            body = self._connected()
            try:
                return action(body)
            except DeviceError as error:
                if not _curable(error):
                    raise
                self._lose(error)
                # A body that is busy in every session is kept so by its own settings, not by a fault.
                busy = isinstance(error, OperationDeclined) and error.code == ResponseCode.DEVICE_BUSY
                late = self._clock.monotonic() >= self._renewable_until
                if renewals == RECOVERIES or late or (busy and was_busy):
                    kind = DeviceRefused if busy else DeviceError
                    times = "once" if renewals == 1 else f"{renewals} times"
                    raise kind(self._given_up(error, f"the connection was renewed {times} without success")) from error
                was_busy = busy
                renewals += 1

    def _lose(self, fault: DeviceError) -> None:
        """Drop a connection that failed at its work, and keep the first such fault of a call.

        What ails a new connection before it is made follows from the old one's end, and is no first cause.
        """
        if self._fault is None:
            self._fault = fault
            self._renewable_until = self._clock.monotonic() + RECOVERY_S
        self._drop(fault)

    def _given_up(self, last: DeviceError, tried: str) -> str:
        """Return why a call ends, its first cause first, for whatever came of that says less; with one remedy."""
        first, held = (fault.without_remedy() for fault in (self._fault or last, last))
        return f"{first}; {tried}{'' if held == first else f'; at last: {held}'}; {_REMEDY}"

    def _release(self, settings: ExposureSettings) -> _Shot:
        """Return the release that has happened, or may have; one that the body declines has not."""

        def released(body: EosBody) -> _Shot:
            body.make_ready()
            _apply(body, settings)  # sends nothing unless a dial was turned
            now = self._clock.monotonic()
            exposed = now + _CERTAIN_SHARE * settings.shutter_s
            until = now + 2 * settings.shutter_s + FRAME_S
            shot = _Shot(body, self._clock.now(), exposed, until, settings.shutter_s, absent=set(body.state.waiting))
            try:
                body.release()
            except (LinkError, ProtocolError) as error:
                self._lose(error)
            return shot

        return self._carry_out(released)

    def _await_frame(self, body: EosBody, shot: _Shot) -> WaitingObject:
        """Return the frame of a release when the body has announced it; the same one whenever it is asked again."""
        renewed = body is not shot.body
        until = self._clock.monotonic() + shot.shutter_s + REDISCOVERY_S if renewed else shot.until
        known = shot.announced

        def wanted(waiting: WaitingObject) -> bool:
            if known is not None and (waiting.name, waiting.size) != (known.name, known.size):
                return False  # taken since, by a finger on the camera
            return waiting.is_raw and waiting.handle not in shot.absent

        try:
            shot.announced = body.await_object(shot.not_before, until, wanted)
        except LinkTimeout as error:
            if not renewed:
                raise  # its announcement may be lost: a new connection hears it again
            self._shot = None
            raise DeviceError(f"{error}, and holds none in its memory; take it again") from error
        return shot.announced

    def _receive(self, body: EosBody, shot: _Shot, into: BinaryIO, start: int) -> WaitingObject:
        """Return the frame of a release when it is complete in `into`, from `start` on."""
        while True:
            frame = self._await_frame(body, shot)
            # What has come of the same object before a fault is good: pieces are written whole.
            offset = into.tell() - start if frame == shot.fetched else 0
            into.seek(start + offset)
            into.truncate()
            shot.fetched = frame
            try:
                body.fetch(frame, into, offset)
            except OperationDeclined as error:
                if error.code != ResponseCode.INVALID_OBJECT_HANDLE:
                    raise
                shot.absent.add(frame.handle)
                shot.announced = None
                body.free(frame)
                continue
            return frame

    def _empty(self) -> None:
        """Let the body forget what waits; where that fails the next call sees to it over a new connection."""
        if self._body is not None:
            try:
                self._body.free_waiting()
                self._body.drain()
                self._body.free_waiting()
            except DeviceError as error:
                self._drop(error)

    def _connected(self) -> EosBody:
        if self._closed:
            raise DeviceError("the camera has been closed; open the rig again")
        if self._body is not None:
            return self._body
        first = self._identity is None
        begun = self._clock.monotonic()
        end = min(self._renewable_until, begun + RECOVERY_S)
        pause = _FIRST_PAUSE_S
        while True:
            try:
                return self._connect()
            except DeviceError as error:
                # While it comes back a body may be absent, or in the hands of the desktop.
                curable = not first if self._transport is None else _curable(error)
                self._drop(error)
                if not curable:
                    raise
                if self._clock.monotonic() + pause > end:
                    waited = f"no connection for {self._clock.monotonic() - begun:.0f} s"
                    raise DeviceError(self._given_up(error, waited)) from error
            self._clock.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)

    def _connect(self) -> EosBody:
        self._transport = self._open_transport()
        body = EosBody(self._transport, self._clock)
        body.connect()
        found, known = body.identity(), self._identity
        if known is not None and (found.model, found.serial) != (known.model, known.serial):
            raise DeviceRefused(
                f"in place of the {known.model} with serial number {known.serial} there is now a {found.model} with "
                f"{found.serial}; connect the first one again"
            )
        if self._settings is not None:
            _apply(body, self._settings)
        self._identity = found
        self._body = body
        return body

    def _drop(self, fault: DeviceError | None) -> None:
        transport, self._transport, self._body = self._transport, None, None
        if transport is not None:
            if fault is not None and not isinstance(fault, LinkClosed):
                with contextlib.suppress(DeviceError):
                    transport.reset()
            transport.close()


def _apply(body: EosBody, settings: ExposureSettings) -> None:
    for code, value in plan(body.state, settings).items():
        body.set(code, value)


def _curable(error: DeviceError) -> bool:
    return isinstance(error, LinkError | ProtocolError) or (
        isinstance(error, OperationDeclined) and error.code in _STUCK
    )


def _file_name(frame: WaitingObject) -> str:
    """Return the camera's name for a file, with nothing in it that a file name cannot hold, and a suffix."""
    name = re.sub(r"[^A-Za-z0-9._-]", "_", frame.name).strip(".") or f"{frame.handle:08X}"
    # Some bodies announce a file without its name, or without the suffix, but with its format.
    return name if "." in name else name + _SUFFIXES.get(frame.format, "")
