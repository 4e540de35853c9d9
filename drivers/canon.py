"""Driver of Canon EOS bodies over PTP, for hours of unattended exposures; see `drivers.camera.Camera`.

`CanonEos` is the camera, `EosBody` one connection to it, and `EosState` holds the values that the body has reported.

The operation GetEvent returns a chain of records. A record has its size with header (32 bits), its type (32 bits) and
its content. A record of size 8 and type 0 ends the chain, but some bodies leave it out. The first reply contains the
whole state of the body, and later replies only changes. A property value is a number of 32 bits, a text that ends with
NUL, or in a few cases a structure.

``decode`` reads bytes, and ``encode`` writes them. Records of unknown type or form become `OtherRecord`. Inconsistent
records raise `ProtocolError`.

Sources: there is no public standard. Formats and conversations were recorded from an EOS 60D and an EOS 400D. Their
meaning and the sequence of a release are from libgphoto2 2.5.34. The number of the mirror lockup function is from
ExifTool (CanonCustom::Functions2).
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
    START_TIMEOUT_S,
    TRANSIENT,
    TRANSIENT_LIMIT_S,
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

_RAW: Final = 6  # `ImageFile.kind` of a raw file
_LOSSLESS: Final = 4  # `ImageFile.compression` of a lossless raw file

_JPEG_SIZES: Final = {0: "L", 1: "M", 2: "S", 5: "M1", 6: "M2", 14: "S1", 15: "S2", 16: "S3"}

_IMAGE_FILE_LENGTH: Final = 16  # Bytes of the format of one file: this length, kind, size, compression; 32 bits each

_MAX_IMAGE_FILES: Final = 2  # Most files of one release: a raw file and a JPEG

_SETTING_HEADER: Final = 8  # Bytes before a new property value: length and property code


def number_value(number: int) -> bytes:
    """Encode a number as a property value; a negative number as two's complement of 32 bits."""
    return encode_integer(number & 0xFFFFFFFF if -(1 << 31) <= number < 0 else number, 4)


def text_value(text: str) -> bytes:
    """Encode a text as a property value, which ends with NUL."""
    octets = text.encode("latin-1", "replace")
    if b"\0" in octets:
        raise ValueError(f"{text[:40]!r} contains a NUL, which ends a text")
    return octets + b"\0"


def number_of(value: bytes) -> int:
    """Return the number in the first 32 bits of a property value."""
    return Cursor(value, "a property's value").u32("the number")


def text_of(value: bytes) -> str:
    """Return the text of a property value, up to its first NUL."""
    return value.partition(b"\0")[0].decode("latin-1")


@dataclass(frozen=True)
class ImageFile:
    """Format of one of the files that a release writes.

    - `kind`: 1 JPEG, 6 raw.
    - `size`: 0 large, 1 medium (mRAW), 2 small (sRAW), 5 M1, 6 M2, 14 S1, 15 S2, 16 S3.
    - `compression`: 2 normal or 3 fine for a JPEG; 4 lossless or 3 lossy for a raw file.
    """

    kind: int
    size: int
    compression: int

    @property
    def is_raw(self) -> bool:
        """True for a raw file of any size."""
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
    """Formats of the one or two files of a release; value of properties 0xd120 to 0xd123."""

    files: tuple[ImageFile, ...]

    @classmethod
    def read(cls, cursor: Cursor) -> ImageFormat:
        """Read an image format at the position of a cursor."""
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
        """Return the image format of a property value."""
        return cls.read(Cursor(value, "an image format"))

    def encode(self) -> bytes:
        """Return the property value."""
        if not 1 <= len(self.files) <= _MAX_IMAGE_FILES:
            raise ValueError(f"{len(self.files)} files, expected 1 or {_MAX_IMAGE_FILES}")
        return encode_integer(len(self.files), 4) + b"".join(
            encode_integer(number, 4)
            for file in self.files
            for number in (_IMAGE_FILE_LENGTH, file.kind, file.size, file.compression)
        )

    def __str__(self) -> str:
        return " + ".join(str(file) for file in self.files)


RAW_ONLY = ImageFormat((ImageFile(_RAW, 0, _LOSSLESS),))  # One full-size raw file, required for measurements

# Properties that have an `ImageFormat` as value.
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
    """Data of SetDevicePropValueEx (0x9110): a property, and its value from `number_value` or `text_value`."""

    code: int
    value: bytes

    @classmethod
    def decode(cls, data: bytes) -> PropertySetting:
        """Return the setting in the data of a request."""
        cursor = Cursor(data, "SetDevicePropValueEx", MAX_DATASET)
        length = cursor.u32("length")
        if length < cursor.position + 4 or length > len(data):
            raise cursor.fault("length", f"8 to {len(data)}", length)
        return cls(cursor.u32("property"), cursor.take(length - cursor.position, "value"))

    def encode(self) -> bytes:
        """Return the data of the request."""
        return encode_integer(_SETTING_HEADER + len(self.value), 4) + encode_integer(self.code, 4) + bytes(self.value)


_NAME_WIDTH: Final = 16  # Bytes of the name field: a name of 8.3 characters and padding

_TIME_LENGTH: Final = 4  # Bytes of the time field, in seconds since 1970


@dataclass(frozen=True)
class ObjectEntry:
    """A file or folder of the camera, as described in the reply to GetObjectInfoEx and in events.

    - `group`: a second handle, which is equal for files that belong together.
    - `name`: at most `name_width` characters.
    - `time`: seconds since 1970 on the camera's clock; None if the body sends no time.
    - `name_width`: bytes of the name field, padded with NUL; 16 on all recorded bodies.
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
        """Read an object from the rest of a record; `size_length`: bytes of the size field, 4 or 8."""
        handle, storage, object_format = cursor.u32("handle"), cursor.u32("storage"), cursor.u32("format")
        reserved, flags = cursor.u32("reserved"), cursor.u32("flags")
        size = cursor.integer(size_length, "size")
        parent, group = cursor.u32("parent"), cursor.u32("group")
        width = cursor.remaining
        time = None
        if width >= _NAME_WIDTH + _TIME_LENGTH:
            width -= _TIME_LENGTH
        name = text_of(cursor.take(width, "name"))
        if cursor.remaining:
            time = cursor.u32("time")
        return cls(handle, storage, object_format, size, name, parent, group, flags, time, width, reserved)

    def encode(self, size_length: int = 4) -> bytes:
        """Return the body of a record."""
        name = self.name.encode("latin-1", "replace")
        if len(name) > self.name_width or b"\0" in name:
            raise ValueError(f"name {self.name!r}: expected at most {self.name_width} characters and no NUL")
        if self.name_width < _NAME_WIDTH if self.time is not None else self.name_width >= _NAME_WIDTH + _TIME_LENGTH:
            raise ValueError(f"a name field of {self.name_width} bytes cannot be distinguished from a following time")
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
    """Return the bytes of a reply to GetObjectInfoEx."""
    bodies = [entry.encode() for entry in entries]
    return encode_integer(len(bodies), 4) + b"".join(encode_integer(4 + len(body), 4) + body for body in bodies)


@dataclass(frozen=True)
class DeviceInfoEx:
    """Reply to GetDeviceInfoEx (0x9108): record types, properties, and numbers of unknown meaning."""

    events: tuple[int, ...] = ()
    properties: tuple[int, ...] = ()
    unknown: tuple[int, ...] = ()

    @classmethod
    def decode(cls, data: bytes) -> DeviceInfoEx:
        """Return the values of a reply."""
        cursor = Cursor(data, "DeviceInfoEx", MAX_DATASET)
        length = cursor.u32("length")
        if length > len(data):
            raise cursor.fault("length", f"at most {len(data)}, the size of the reply", length)
        return cls(cursor.array(4, "events"), cursor.array(4, "properties"), cursor.array(4, "unknown numbers"))

    def encode(self) -> bytes:
        """Return the bytes of the reply."""
        arrays = b"".join(encode_array(array, 4) for array in (self.events, self.properties, self.unknown))
        return encode_integer(4 + len(arrays), 4) + arrays


MAX_EVENTS: Final = 4 << 20  # Longest accepted reply to GetEvent, bytes; in a day without polling it grows to 250 kB

# Most records of one reply. In 12 h without polling, about 8000 are queued (reports of libgphoto2 users).
MAX_RECORDS: Final = 1 << 16

_HEADER_LENGTH: Final = 8  # Bytes of the header of a record: size and type

_END: Final = struct.pack("<II", _HEADER_LENGTH, EosEvent.END)
_FILLED_LIST: Final = 3  # Kind of a list with values; kinds 1 and 7 are empty lists


@dataclass(frozen=True)
class PropertyChanged:
    """New value of a property (0xc189)."""

    code: int
    value: bytes


@dataclass(frozen=True)
class AvailableValues:
    """Values that a property accepts now (0xc18a); if empty, the property cannot be set now."""

    code: int
    values: tuple[int, ...] = ()
    kind: int = _FILLED_LIST


@dataclass(frozen=True)
class AvailableFormats:
    """Formats that an image format property accepts now (0xc18a)."""

    code: int
    formats: tuple[ImageFormat, ...] = ()
    kind: int = _FILLED_LIST


@dataclass(frozen=True)
class ObjectEvent:
    """An object was written to the card (0xc181, 0xc1a7) or changed there (0xc187, 0xc1a8)."""

    type: int
    entry: ObjectEntry


@dataclass(frozen=True)
class TransferRequest:
    """Announcement of an object, which stays in the camera's memory until TransferComplete (0xc186, 0xc1a9).

    `extra` holds the numbers between size and name; empty if all are 0. In records of type 0xc1b8 they are the parent
    and an unknown number.
    """

    handle: int
    format: int
    size: int
    name: str
    type: int = EosEvent.REQUEST_OBJECT_TRANSFER
    reserved: int = field(default=0, repr=False)
    extra: tuple[int, ...] = field(default=(), repr=False)
    padding: int = field(default=0, repr=False)  # Number of NULs after the closing NUL of the name


@dataclass(frozen=True)
class Notice:
    """A record of one number: a handle, a storage id, a status, or seconds; `rest` holds any further bytes."""

    type: int
    number: int
    rest: bytes = b""


@dataclass(frozen=True)
class OtherRecord:
    """A record of unknown type or form, with its content unchanged."""

    type: int
    body: bytes = b""


Record = PropertyChanged | AvailableValues | AvailableFormats | ObjectEvent | TransferRequest | Notice | OtherRecord

# Bytes of the size field in each type of object event.
_OBJECT_EVENTS: dict[int, int] = {
    EosEvent.OBJECT_ADDED: 4,
    EosEvent.OBJECT_INFO_CHANGED: 4,
    EosEvent.OBJECT_ADDED_64: 8,
    EosEvent.OBJECT_INFO_CHANGED_64: 8,
}
# For each type of transfer request: bytes of the size field, and count of the numbers between size and name.
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
    """Return the records in a reply to GetEvent (0x9116), without the record that ends the chain."""
    cursor = Cursor(data, "GetEvent", MAX_EVENTS)
    records: list[Record] = []
    while True:
        start = cursor.position
        # Some chains end with NULs or without the closing record, although the transport returns complete replies.
        if not any(data[start : start + _HEADER_LENGTH]) and not any(data[start:]):
            return tuple(records)
        if len(records) == MAX_RECORDS:
            raise ProtocolError(f"GetEvent returns more than {MAX_RECORDS} records; switch the camera off and on")
        size, record_type = cursor.u32("the size of a record"), cursor.u32("the type of a record")
        if record_type == EosEvent.END and size == _HEADER_LENGTH:
            return tuple(records)
        if size < _HEADER_LENGTH:
            raise cursor.fault("the size of a record", f"at least {_HEADER_LENGTH}", size, position=start)
        body = cursor.take(size - _HEADER_LENGTH, f"a record of type {describe(EosEvent, record_type)}")
        try:
            records.append(_decode_record(record_type, body))
        except ProtocolError as error:
            raise ProtocolError(f"GetEvent, record {len(records)} at byte {start}: {error}") from error


def encode_events(records: Iterable[Record] = ()) -> bytes:
    """Return the bytes of a reply to GetEvent, with the record that ends the chain."""
    chain = bytearray()
    for record in records:
        record_type, body = _encode_record(record)
        chain += encode_integer(_HEADER_LENGTH + len(body), 4) + encode_integer(record_type, 4) + body
    return bytes(chain) + _END


def _decode_record(record_type: int, body: bytes) -> Record:
    cursor = Cursor(body, describe(EosEvent, record_type))
    if record_type == EosEvent.PROPERTY_CHANGED:
        return PropertyChanged(cursor.u32("property"), cursor.rest())
    if record_type == EosEvent.AVAILABLE_LIST_CHANGED:
        return _decode_list(cursor, body)
    if record_type in _OBJECT_EVENTS:
        return ObjectEvent(record_type, ObjectEntry.read(cursor, _OBJECT_EVENTS[record_type]))
    if record_type in _TRANSFER_REQUESTS:
        return _decode_transfer_request(cursor, record_type)
    if record_type in _NOTICES and len(body) >= 4:
        return Notice(record_type, cursor.u32("number"), cursor.rest())
    return OtherRecord(record_type, body)


def _decode_list(cursor: Cursor, body: bytes) -> Record:
    code, list_kind, count = cursor.u32("property"), cursor.u32("kind of list"), cursor.u32("count")
    cursor.name = f"{cursor.name} for {describe(Property, code)}"
    if list_kind != _FILLED_LIST:
        is_empty = not count and not cursor.remaining
        return AvailableValues(code, (), list_kind) if is_empty else OtherRecord(EosEvent.AVAILABLE_LIST_CHANGED, body)
    if code in IMAGE_FORMAT_PROPERTIES:
        # Each format takes at least four bytes, so the length of the data limits this loop.
        record = AvailableFormats(code, tuple(ImageFormat.read(cursor) for _ in range(count)))
    else:
        record = AvailableValues(code, cursor.integers(count, 4, "values"))
    return OtherRecord(EosEvent.AVAILABLE_LIST_CHANGED, body) if cursor.remaining else record


def _decode_transfer_request(cursor: Cursor, record_type: int) -> TransferRequest:
    size_length, extra_count = _TRANSFER_REQUESTS[record_type]
    handle, format_code, reserved = cursor.u32("handle"), cursor.u32("format"), cursor.u32("reserved")
    size = cursor.integer(size_length, "size")
    extra = cursor.integers(extra_count, 4, "the numbers before the name")
    octets = cursor.rest()
    name = text_of(octets)
    if len(octets) == len(name):
        raise cursor.fault("the name", "closed by NUL", repr(octets[:40]))
    padding = len(octets) - len(name) - 1
    return TransferRequest(handle, format_code, size, name, record_type, reserved, extra if any(extra) else (), padding)


def _encode_record(record: Record) -> tuple[int, bytes]:
    match record:
        case PropertyChanged(code, value):
            return EosEvent.PROPERTY_CHANGED, encode_integer(code, 4) + bytes(value)
        case AvailableValues(code, values, list_kind):
            header = encode_integer(code, 4) + encode_integer(list_kind, 4)
            return EosEvent.AVAILABLE_LIST_CHANGED, header + encode_array(values, 4)
        case AvailableFormats(code, formats, list_kind):
            numbers = b"".join(encode_integer(number, 4) for number in (code, list_kind, len(formats)))
            return EosEvent.AVAILABLE_LIST_CHANGED, numbers + b"".join(item.encode() for item in formats)
        case ObjectEvent(record_type, entry):
            return record_type, entry.encode(_OBJECT_EVENTS[record_type])
        case TransferRequest():
            return record.type, _encode_transfer_request(record)
        case Notice(record_type, number, rest):
            return record_type, encode_integer(number, 4) + rest
        case OtherRecord(record_type, body):
            return record_type, body


def _encode_transfer_request(record: TransferRequest) -> bytes:
    size_length, extra_count = _TRANSFER_REQUESTS[record.type]
    extra = record.extra or (0,) * extra_count
    if len(extra) != extra_count:
        raise ValueError(f"{len(extra)} extra numbers, expected {extra_count} in a record of type 0x{record.type:04x}")
    return b"".join(
        (
            *(encode_integer(number, 4) for number in (record.handle, record.format, record.reserved)),
            encode_integer(record.size, size_length),
            *(encode_integer(number, 4) for number in extra),
            text_value(record.name) + bytes(record.padding),
        )
    )


# Accepted relative deviation from a nominal value; neighbouring nominal values differ by 5 % or more.
TOLERANCE = 0.01


@dataclass(frozen=True)
class DialPosition:
    """One position of a dial of the camera: code, label, and nominal value (s, f-number or ISO speed)."""

    code: int
    label: str
    value: float


@dataclass(frozen=True)
class Scale:
    """A dial of the camera: its steps in order of their codes, and codes without a value."""

    name: str
    steps: tuple[DialPosition, ...]
    specials: dict[int, str]

    def label(self, code: int) -> str:
        """Return the label that the camera shows for a code; "code 0x…" if the code is unknown."""
        if code in self.specials:
            return self.specials[code]
        step = self._step(code)
        return f"code 0x{code:02x}" if step is None else step.label

    def value(self, code: int) -> float:
        """Return the nominal value of a code that the camera reports."""
        step = self._step(code)
        if step is None:
            raise ProtocolError(
                f"the camera reports {self.name} {self.label(code)} (0x{code:02x}), expected a fixed value; "
                "turn its mode dial to M and set a value"
            )
        return step.value

    def code(self, setting: float | str, available: Iterable[int] | None = None) -> int:
        """Return the code of a nominal value or label.

        `setting` is a number (seconds, f-number or ISO speed), or a text as on the dial: ``1/60``, ``30``, ``auto``,
        ``bulb``. If `available` is given, only these codes are considered.
        """
        codes = None if available is None else tuple(available)
        for code, label in self.specials.items():
            if isinstance(setting, str) and setting.strip().lower() == label and (codes is None or code in codes):
                return code
        number = _parse_number(setting)
        steps = [step for step in self.steps if codes is None or step.code in codes]
        matches = [step for step in steps if number is not None and _is_close(number, step.value)]
        if not matches:
            raise self._not_offered_error(setting, number, steps)
        # If several codes match, third stops are preferred to half stops (code ≡ 4 mod 8), then the nearest value.
        best = min(matches, key=lambda step: (step.code % 8 == 4, abs(step.value / (number or 1) - 1), step.code))
        return best.code

    def _step(self, code: int) -> DialPosition | None:
        return next((step for step in self.steps if step.code == code), None)

    def _not_offered_error(self, setting: float | str, number: float | None, steps: list[DialPosition]) -> InputError:
        nearest = steps if number is None else sorted(steps, key=lambda step: abs(math.log2(step.value / number)))[:4]
        labels = ", ".join(dict.fromkeys(step.label for step in sorted(nearest, key=lambda step: step.code)))
        return InputError(
            f"{self.name} {setting} is not offered; choose one of the nearest: {labels or 'none, the list is empty'}"
        )


def _parse_number(setting: float | str) -> float | None:
    if isinstance(setting, str):
        dividend, slash, divisor = setting.strip().lower().removesuffix("s").removeprefix("f/").partition("/")
        try:
            number = float(dividend) / float(divisor) if slash else float(dividend)
        except (ValueError, ZeroDivisionError):
            return None
    else:
        number = float(setting)
    return number if 0 < number < math.inf else None


def _is_close(number: float, nominal: float) -> bool:
    return abs(number / nominal - 1) <= TOLERANCE


def _scale(name: str, table: str, specials: dict[int, str]) -> Scale:
    steps: list[DialPosition] = []
    for entry in table.split():
        code, label = entry.split("=")
        value = _parse_number(label)
        assert value is not None
        steps.append(DialPosition(int(code, 16), label, value))
    return Scale(name, tuple(sorted(steps, key=lambda step: step.code)), specials)


# Shutter time in seconds (property 0xd102). The codes of electronic shutter times to 1/32000 s are from Canon's EDSDK.
# The last three codes are extrapolated in eighths of a stop, to 1/64000 s of the EOS R3.
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

# Aperture as f-number (property 0xd101). Bodies also report code 0 for a lens without contacts.
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

MIRROR_LOCKUP_FUNCTION = 0x060F  # Custom function of mirror lockup, on bodies that have it

MAX_PROPERTIES = 1024  # Most properties that are stored; real bodies report 80 to 300
MAX_VALUE = 1 << 14  # Longest property value that is stored, bytes; the longest known value has about 5000
MAX_LIST = 1024  # Longest list of permitted values that is stored; the longest known list has 76
_MAX_PENDING = 64  # Most objects that are stored; the memory of a body holds fewer
_NOT_RAW = (ObjectFormat.EXIF_JPEG, ObjectFormat.JFIF, ObjectFormat.MOV, ObjectFormat.MOV2)
_NOT_RAW_SUFFIXES = (".jpg", ".jpeg", ".hif", ".mov", ".mp4")
_SINGLE_SHOOTING = (DriveMode.SINGLE, DriveMode.SINGLE_SILENT)
_BATTERY_LOW = 0  # EOS_BATTERY_POWER of a low battery (libgphoto2)
# Charge for each EOS_BATTERY_POWER (libgphoto2); other numbers are unknown.
_BATTERY_LEVELS = {_BATTERY_LOW: 0.0, 5: 0.25, 1: 0.5, 4: 0.75, 2: 1.0}
# EOS_BATTERY_POWER on mains power, from Canon's EDSDK; we have not observed it.
_BATTERY_MAINS = 0xFFFFFFFF

_Value = TypeVar("_Value")


@dataclass(frozen=True)
class PendingObject:
    """An object in the camera's memory; `size` is the announced size in bytes, which may be wrong."""

    handle: int
    format: int
    size: int
    name: str

    @property
    def is_raw(self) -> bool:
        """True for a raw frame; false for a JPEG, HEIF or film."""
        return self.format not in _NOT_RAW and not self.name.lower().endswith(_NOT_RAW_SUFFIXES)


@dataclass
class EosState:
    """Properties of a body, their permitted values, and the objects in its memory.

    - `values`: last reported value of each property.
    - `lists`, `formats`: permitted values of each property.
    - `functions`: first value of each custom function.
    - `busy`: the last status of the body was "busy".
    - `pending`: objects in the memory by handle, in the order of their announcement.
    """

    values: dict[int, bytes] = field(default_factory=dict[int, bytes])
    lists: dict[int, tuple[int, ...]] = field(default_factory=dict[int, tuple[int, ...]])
    formats: dict[int, tuple[ImageFormat, ...]] = field(default_factory=dict[int, tuple[ImageFormat, ...]])
    functions: dict[int, int] = field(default_factory=dict[int, int])
    busy: bool = False
    pending: dict[int, PendingObject] = field(default_factory=dict[int, PendingObject])

    def update(self, records: Iterable[Record]) -> None:
        """Update the state from the records of one reply."""
        for record in records:
            match record:
                case PropertyChanged(Property.EOS_CUSTOM_FUNCTIONS, value):
                    for number, first_value in custom_functions(value[:MAX_VALUE]).items():
                        _store(self.functions, number, first_value)
                case PropertyChanged(code, value):
                    if len(value) <= MAX_VALUE:
                        _store(self.values, code, value)
                case AvailableValues(code, values):
                    if len(values) <= MAX_LIST:
                        _store(self.lists, code, values)
                case AvailableFormats(code, formats):
                    if len(formats) <= MAX_LIST:
                        _store(self.formats, code, formats)
                case TransferRequest():
                    self._add_pending(PendingObject(record.handle, record.format, record.size, record.name))
                case ObjectEvent(EosEvent.OBJECT_ADDED | EosEvent.OBJECT_ADDED_64, entry):
                    if entry.format != ObjectFormat.ASSOCIATION:
                        self._add_pending(PendingObject(entry.handle, entry.format, entry.size, entry.name))
                case Notice(EosEvent.OBJECT_REMOVED, handle):
                    self.pending.pop(handle, None)
                case Notice(EosEvent.CAMERA_STATUS_CHANGED, status):
                    self.busy = status == CameraStatus.BUSY

    def number(self, code: int) -> int | None:
        """Return the value of a numeric property; None if it was not reported."""
        value = self.values.get(code)
        return number_of(value) if value is not None and len(value) >= 4 else None

    def text(self, code: int) -> str:
        """Return the value of a text property; empty if it was not reported."""
        return text_of(self.values.get(code, b""))

    def has_value(self, code: int, value: bytes) -> bool:
        """Return whether a property has this value now."""
        # Some bodies report a longer value than was set.
        return code in self.values and self.values[code][: len(value)] == value

    def _add_pending(self, pending: PendingObject) -> None:
        # An object that is announced again keeps its position. If there are too many objects, the oldest are removed.
        self.pending[pending.handle] = pending
        while len(self.pending) > _MAX_PENDING:
            del self.pending[next(iter(self.pending))]


def battery_level(state: EosState) -> float | None:
    """Return the battery charge, 0 to 1 in quarters; None if it is not reported, or on mains power."""
    power = state.number(Property.EOS_BATTERY_POWER)
    return None if power is None else _BATTERY_LEVELS.get(power)


def _store(store: dict[int, _Value], code: int, value: _Value) -> None:
    if code in store or len(store) < MAX_PROPERTIES:
        store[code] = value


def custom_functions(value: bytes) -> dict[int, int]:
    """Return the first value of each custom function in a value of property 0xd1a0.

    The value has fields of 32 bits: its length, 1, the number of a group, the length of the rest, and the count of
    functions. For each function follow its number, the count of its values, and the values. A malformed rest is
    ignored.
    """
    cursor = Cursor(value, "custom functions")
    functions: dict[int, int] = {}
    try:
        cursor.integers(4, 4, "the header")
        for _ in range(cursor.u32("the count of functions")):
            number = cursor.u32("the number of a function")
            first_value, *_ = cursor.array(4, "the values of a function") or (0,)
            functions[number] = first_value
    except ProtocolError:
        pass
    return functions


def find_setting_faults(state: EosState) -> list[str]:
    """Return a message with a remedy for each setting of the body that would spoil a series of frames."""
    faults: list[str] = []
    mode, focus, drive = (
        state.number(code) for code in (Property.EOS_AE_MODE, Property.EOS_FOCUS_MODE, Property.EOS_DRIVE_MODE)
    )
    if mode is not None and mode != AeMode.MANUAL:
        faults.append(f"the mode dial is set to {_code_name(AeMode, mode)}: turn it to M")
    if focus is not None and focus != FocusMode.MANUAL:
        faults.append("autofocus is on: set the lens to MF and focus by hand")
    if drive is not None and drive not in _SINGLE_SHOOTING:
        faults.append(f"the drive mode is {_code_name(DriveMode, drive)}: set single shooting")
    if state.number(Property.EOS_MIRROR_UP_SETTING) or state.functions.get(MIRROR_LOCKUP_FUNCTION) == 1:
        faults.append("mirror lockup is on: switch it off")
    if state.number(Property.EOS_AEB) or state.number(Property.EOS_BRACKET_MODE):
        faults.append("exposure bracketing is on: switch it off")
    if state.number(Property.EOS_HDR_SETTING):
        faults.append("HDR mode is on: switch it off")
    power_off_s = state.number(Property.EOS_AUTO_POWER_OFF)
    if power_off_s:
        faults.append(f"auto power off is set to {power_off_s} s: set it to off")
    if state.number(Property.EOS_BATTERY_POWER) == _BATTERY_LOW:
        faults.append("the battery is low: charge it, or use mains power")
    return faults


def plan_settings(state: EosState, settings: ExposureSettings) -> dict[int, bytes]:
    """Return the property values for a series of raw frames, in the order in which they are set."""
    faults = find_setting_faults(state)
    values: dict[int, bytes] = {}
    try:
        values[Property.EOS_IMAGE_FORMAT] = _raw_format(state).encode()
    except InputError as error:
        faults.append(str(error))
    for code, scale, value in (
        (Property.EOS_ISO_SPEED, ISO, settings.iso),
        (Property.EOS_APERTURE, APERTURE, settings.aperture),
        (Property.EOS_SHUTTER_SPEED, SHUTTER, settings.shutter_s),
    ):
        offered_codes = _offered_codes(state, code, scale)
        if value is None:
            if offered_codes:
                faults.append(
                    f"the lens offers apertures, such as {scale.label(offered_codes[0])}: set one as f-number"
                )
        elif scale is APERTURE and not offered_codes:
            faults.append(f'aperture {value:g} cannot be set, because the lens reports none: set aperture = "none"')
        else:
            try:
                values[code] = number_value(scale.code(value, offered_codes))
            except InputError as error:
                faults.append(str(error))
    if faults:
        raise DeviceRefused("the camera cannot take the series", remedy="; ".join(faults))
    if WhiteBalance.DAYLIGHT in state.lists.get(Property.EOS_WHITE_BALANCE, ()):
        # Raw values do not depend on the white balance. A fixed white balance gives all previews the same colours.
        values[Property.EOS_WHITE_BALANCE] = number_value(WhiteBalance.DAYLIGHT)
    return values


def shutter_speeds(state: EosState) -> tuple[float, ...]:
    """Return the nominal shutter times that a body lists, in seconds, ascending, without bulb and unknown codes."""
    values = {step.code: step.value for step in SHUTTER.steps}
    return tuple(sorted({values[code] for code in state.lists.get(Property.EOS_SHUTTER_SPEED, ()) if code in values}))


def host_destination(state: EosState) -> bytes:
    """Return the value of property 0xd11c that sends frames to the host; refuse a body that does not offer it."""
    offered = state.lists.get(Property.EOS_CAPTURE_DESTINATION, ())
    values = (*offered, state.number(Property.EOS_CAPTURE_DESTINATION))
    if offered and CaptureDestination.HOST not in values:
        offered_text = ", ".join(str(number) for number in offered)
        raise DeviceRefused(
            f"the camera offers capture destinations {offered_text}, expected {CaptureDestination.HOST.value} (host); "
            "use another camera"
        )
    return number_value(CaptureDestination.HOST)


def _raw_format(state: EosState) -> ImageFormat:
    offered = state.formats.get(Property.EOS_IMAGE_FORMAT, ())
    if RAW_ONLY not in offered and not state.has_value(Property.EOS_IMAGE_FORMAT, RAW_ONLY.encode()):
        raws = ", ".join(str(item) for item in offered if any(file.is_raw for file in item.files))
        raise InputError(
            f"image format {RAW_ONLY} alone is not offered; formats with raw: {raws or 'none'}; use another camera"
        )
    return RAW_ONLY


def _offered_codes(state: EosState, code: int, scale: Scale) -> tuple[int, ...]:
    """Return the codes that a body accepts; if it lists none, only the present code, which cannot be changed."""
    current = state.number(code)
    current_codes = () if current is None or current in scale.specials else (current,)
    return state.lists.get(code) or current_codes


def _code_name(code_type: type[AeMode] | type[DriveMode], value: int) -> str:
    try:
        return code_type(value).name.lower().replace("_", " ")
    except ValueError:
        return f"0x{value:02x}"


PIECE_BYTES = 1 << 20  # Bytes that one request transfers; requests of 5 MiB have crashed newer bodies
MAX_FRAME_BYTES = 256 << 20  # Largest accepted frame; raw files of EOS bodies are much smaller
MAX_POLLS = 64  # Most GetEvent requests in a row, because some firmware repeats records without end
KEEP_ALIVE_S = 10.0  # Interval of KeepDeviceOn requests, seconds, as in libgphoto2
SETTLE_LIMIT_S = 5.0  # Time in which a body must report a new value, or memory for a frame, seconds
# Longest accepted busy time after a connection or at a release, seconds (gphoto2, issue 382: EOS 2000D).
BUSY_LIMIT_S = 30.0
RELEASE_TRIES = 5  # Attempts at one release, distributed over `TRANSIENT_LIMIT_S`, if the body is busy
CAPTURE_TIMEOUT_S = 100.0  # Timeout of a release, seconds, as in libgphoto2; some bodies reply after the exposure

_REMOTE_ON, _REMOTE_OFF = 1, 0  # Parameter of SetRemoteMode and SetEventMode, as recorded and in libgphoto2
# Bodies that need another remote mode (0x15 or 0x11) and live view before each frame. These are compact cameras and EOS
# M except the M6 Mark II (libgphoto2, ptp-private.h, `is_canon_eos_m`). "Canon EOS Kiss M" is the M50 in Japan.
_OTHER_REMOTE_MODE_NAME = re.compile(r"Canon (?!EOS)|Canon EOS (Kiss )?M(?!6 Mark II\b)")
_WITHOUT_AF = 1  # Second parameter of RemoteReleaseOn: a release without autofocus
# Disk space of the host, which is sent to the body: clusters, and bytes per cluster (320 GiB in total).
_HOST_CLUSTERS, _HOST_CLUSTER_BYTES = 0x04FFFFFF, 0x1000
_PAUSES_S = (0.05, 0.1, 0.15, 0.2)  # Pauses between polls, seconds, as in libgphoto2
_PIECE_TRIES = 5  # Most requests for one piece, because a transient fault may last 1 s
_FREE_TRIES = 3  # Requests to free an object in the camera's memory
# Operations that return a part of an object, the preferred one first.
_PARTIAL_READS = (Operation.EOS_GET_PARTIAL_OBJECT, Operation.GET_PARTIAL_OBJECT)
# Responses to an operation that a body lists but does not support.
_UNSUPPORTED = (ResponseCode.OPERATION_NOT_SUPPORTED, ResponseCode.EOS_UNKNOWN_COMMAND)
# Responses after which the request for a piece is not repeated.
_NOT_REPEATED = (
    *_UNSUPPORTED,
    ResponseCode.INVALID_OBJECT_HANDLE,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.DEVICE_BUSY,
)
# Responses to a request for a card or property that the body does not have.
_NOT_PRESENT = (
    ResponseCode.PARAMETER_NOT_SUPPORTED,
    ResponseCode.INVALID_STORAGE_ID,
    ResponseCode.DEVICE_PROP_NOT_SUPPORTED,
    ResponseCode.ACCESS_DENIED,
    ResponseCode.STORE_NOT_AVAILABLE,
    ResponseCode.INVALID_PARAMETER,
)
_SLOT_FILLED = 0xFFFF  # Bits of a storage id that are 0 if the card slot is empty (ISO 15740, 5.2.1)
_MAX_CARDS = 8  # Most cards that are queried; bodies have one or two
# Messages by the parameter of the response to RemoteRelease; 0 means success.
_RELEASE_RESULTS = {
    1: "the autofocus failed; set the lens to MF",
    3: "its mirror is up; switch mirror lockup off",
    7: "its card is full; empty it or insert another",
    8: "its card is read-only; unlock it",
}


class EosBody:
    """One connection to an EOS body.

    - Optional operations are called only if the body lists them, and never again if the body rejects them as unknown.
    - A body keeps a frame in memory until TransferComplete, and refuses to release while the memory is full. Therefore
      every announced object is fetched or discarded, and then freed.
    """

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._clock = clock
        self._session = PtpSession(transport, clock)
        self._info = DeviceInfo()
        self._user_destination: bytes | None = None
        self._unsupported: set[int] = set()
        self._last_keep_alive = clock.monotonic()
        self.state = EosState()

    @property
    def label(self) -> str:
        """Name of the body in messages."""
        return self._session.label

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number (the engraved one if it is reported) and firmware."""
        serial = self.state.text(Property.EOS_SERIAL_NUMBER) or self._info.serial_number
        return CameraIdentity(self._info.manufacturer, self._info.model, serial, self._info.device_version)

    def connect(self) -> None:
        """Open the session, start remote control and read the state of the body."""
        self._retry_while_busy(self._session.open)
        self._retry_while_busy(self._start_remote_control)

    def _start_remote_control(self) -> None:
        _, data = self._session.call(Operation.GET_DEVICE_INFO)
        self._info = DeviceInfo.decode(data)
        required = (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_GET_EVENT)
        if "canon" not in self._info.manufacturer.lower() or not all(map(self._offers, required)):
            raise DeviceRefused(
                f"{self.label} is a {self._info.manufacturer} {self._info.model}, expected a Canon EOS "
                "body; connect one, or take the frames otherwise and use `acquire import`"
            )
        if _OTHER_REMOTE_MODE_NAME.match(self._info.model):
            raise DeviceRefused(
                f"{self.label} is a {self._info.model}, expected a body with the remote mode of EOS bodies, which EOS "
                'M and compact bodies lack; set connection = "gphoto2" in [lab.camera], or take the frames otherwise '
                "and use `acquire import`"
            )
        self._session.call(Operation.EOS_SET_REMOTE_MODE, _REMOTE_ON)
        self._session.call(Operation.EOS_SET_EVENT_MODE, _REMOTE_ON)
        self.drain()
        # The first poll of newer bodies returns nothing, so polling continues, as in libgphoto2.
        if not self._poll_until(lambda: bool(self.state.values)):
            raise ProtocolError(f"{self.label} sent no state within {SETTLE_LIMIT_S:g} s; switch it off and on")
        if self._request_property(Property.EOS_SERIAL_NUMBER):
            self._poll_until(lambda: Property.EOS_SERIAL_NUMBER in self.state.values)
        self._send_frames_to_host()

    def supplies(self) -> Supplies:
        """Return battery charge and free space on the cards, if the body reports them."""
        self.drain()
        level = self._battery_level()
        # Bodies may report a battery on mains power as well, so other values do not exclude mains power.
        mains = True if self.state.number(Property.EOS_BATTERY_POWER) == _BATTERY_MAINS else None
        saves_to_host = self.state.has_value(Property.EOS_CAPTURE_DESTINATION, number_value(CaptureDestination.HOST))
        return Supplies(level, mains, self._card_free_bytes(), saves_to_host)

    def disconnect(self) -> None:
        """Restore the initial state of the body and close the session; faults of the connection are raised."""
        self.free_pending()
        if self._user_destination is not None:
            with contextlib.suppress(OperationDeclined):
                self._send_property(Property.EOS_CAPTURE_DESTINATION, self._user_destination)
        for operation in (Operation.EOS_SET_REMOTE_MODE, Operation.EOS_SET_EVENT_MODE):
            with contextlib.suppress(OperationDeclined):
                self._session.call(operation, _REMOTE_OFF, timeout=START_TIMEOUT_S, retry_s=1.0)
        self._session.close()

    def poll(self) -> bool:
        """Read new events once; return whether there were any."""
        with contextlib.suppress(ProtocolError):
            self._session.events()  # these events only announce records, which the next line requests
        _, data = self._session.call(Operation.EOS_GET_EVENT)
        records = decode_events(data)
        self.state.update(records)
        self._keep_awake()
        return bool(records)

    def drain(self) -> None:
        """Poll until there are no new events."""
        for _ in range(MAX_POLLS):
            if not self.poll():
                return

    def set(self, code: int, value: bytes) -> None:
        """Set a property, and wait until the body reports the new value."""
        if self.state.has_value(code, value):
            return
        self._send_property(code, value)
        self._verify_property(code, value)

    def make_ready(self) -> None:
        """Empty the event queue and the memory, and wait until the body can take a frame."""
        self.drain()
        self.free_pending()
        # The result is ignored, because the record "idle" may be lost. If the body is really busy, the release fails.
        self._poll_until(lambda: not self.state.busy)
        self.free_pending()
        if not self._poll_until(lambda: self.state.number(Property.EOS_AVAILABLE_SHOTS) != 0):
            raise DeviceRefused(f"{self.label} has no memory for a frame; switch it off and on to empty its memory")

    def release(self) -> None:
        """Press and release the shutter button, without autofocus."""
        if self._offers(Operation.EOS_REMOTE_RELEASE_ON):
            try:
                self._retry_while_busy(self._press_button)
            except OperationDeclined as error:
                if not self._mark_unsupported(Operation.EOS_REMOTE_RELEASE_ON, error):
                    raise
            else:
                return
        parameters, _ = self._session.call(Operation.EOS_REMOTE_RELEASE, timeout=CAPTURE_TIMEOUT_S)
        result = parameters[0] if parameters else 0
        if result:
            reason = _RELEASE_RESULTS.get(result, f"result 0x{result:x}: look at its display")
            raise DeviceRefused(f"{self.label} does not release: {reason}")

    def _press_button(self) -> None:
        for remaining_tries in reversed(range(RELEASE_TRIES)):
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
                # A body is busy if its button is still pressed, or if there are events that were not read.
                self._release_button()
                self.drain()
                if error.code != ResponseCode.DEVICE_BUSY:
                    raise
                if not remaining_tries:
                    raise OperationDeclined(
                        f"{error}; check mirror lockup, timer, and an open menu on its display", error.code
                    ) from error
                self._clock.sleep(TRANSIENT_LIMIT_S / RELEASE_TRIES)
        self._release_button()

    def wait_for_object(self, not_before: float, until: float, fits: Callable[[PendingObject], bool]) -> PendingObject:
        """Return the newest pending object for which `fits` is true; discard objects announced before `not_before`."""
        pauses = iter(_PAUSES_S)
        while True:
            if self.poll():
                pauses = iter(_PAUSES_S)
            if self._clock.monotonic() < not_before:
                self.free_pending()
            # If two objects fit, the newer one belongs to this release. The older one was announced late.
            for candidate in reversed(list(self.state.pending.values())):
                if fits(candidate):
                    return candidate
            if self._clock.monotonic() >= until:
                raise LinkTimeout(f"{self.label} announced no frame in time; switch it off and on")
            self._clock.sleep(next(pauses, _PAUSES_S[-1]))

    def fetch(self, pending: PendingObject, into: BinaryIO, offset: int = 0) -> None:
        """Append the bytes of an object from byte `offset` on to the stream `into`, piece by piece."""
        if not 0 < pending.size <= MAX_FRAME_BYTES:
            raise DeviceError(
                f"{self.label} announces {pending.name!r} of {pending.size} bytes, 1 to {MAX_FRAME_BYTES} expected; "
                "expose again"
            )
        while offset < pending.size:
            operation = next((candidate for candidate in _PARTIAL_READS if self._offers(candidate)), None)
            if operation is None:
                self._fetch_whole(pending, into, offset)
                return
            try:
                offset += into.write(self._fetch_piece(operation, pending, offset))
            except OperationDeclined as error:
                if not self._mark_unsupported(operation, error):
                    raise
            self._keep_awake()

    def free(self, pending: PendingObject) -> None:
        """Remove an object from the body's memory; if this fails, the next `make_ready` tries again."""
        for remaining_tries in reversed(range(_FREE_TRIES)):
            try:
                self._session.call(Operation.EOS_TRANSFER_COMPLETE, pending.handle)
            except OperationDeclined as error:
                # If the handle is unknown, the object is free. Bodies without this operation free objects themselves.
                is_freed = error.code == ResponseCode.INVALID_OBJECT_HANDLE
                if not is_freed and not self._mark_unsupported(Operation.EOS_TRANSFER_COMPLETE, error):
                    if remaining_tries:
                        self._clock.sleep(_PAUSES_S[-1])
                    continue
            self.state.pending.pop(pending.handle, None)
            return

    def free_pending(self) -> None:
        """Remove all pending objects from the body's memory."""
        for pending in list(self.state.pending.values()):
            self.free(pending)

    def _fetch_whole(self, pending: PendingObject, into: BinaryIO, offset: int) -> None:
        """Append an object from byte `offset` on, for bodies without partial reads, which send the whole object."""
        received = 0

        def append(piece: bytes) -> None:
            nonlocal received
            if received + len(piece) > pending.size:
                raise ProtocolError(
                    f"{self.label} sends more than {pending.size} bytes for {pending.name!r}; download it again"
                )
            into.write(piece[max(offset - received, 0) :])
            received += len(piece)

        self._session.call(Operation.GET_OBJECT, pending.handle, receive=append)
        if received < pending.size:
            raise self._truncated_error(pending, received)

    def _fetch_piece(self, operation: Operation, pending: PendingObject, offset: int) -> bytes:
        # The body may send fewer bytes than requested.
        limit = min(PIECE_BYTES, pending.size - offset)
        for remaining_tries in reversed(range(_PIECE_TRIES)):
            try:
                parameters, data = self._session.call(operation, pending.handle, offset, limit)
            except OperationDeclined as error:
                if not remaining_tries or error.code in _NOT_REPEATED:
                    raise
            else:
                if len(data) > limit:
                    raise ProtocolError(
                        f"{self.label} sent {len(data)} bytes at {offset}, at most {limit} expected; download again"
                    )
                # The standard operation reports the number of sent bytes. Canon's own operation has other parameters.
                count = parameters[0] if parameters and operation == Operation.GET_PARTIAL_OBJECT else len(data)
                if data and count == len(data):
                    return data
            self._clock.sleep(_PAUSES_S[-1])
        raise self._truncated_error(pending, offset)

    def _truncated_error(self, pending: PendingObject, received: int) -> DeviceError:
        return DeviceError(
            f"{self.label} sent only {received} of {pending.size} bytes for {pending.name!r}; download it again"
        )

    def _send_frames_to_host(self) -> None:
        host = host_destination(self.state)
        # If an earlier program was killed, the body still sends to the host. The card is then set at the end.
        self._user_destination = number_value(CaptureDestination.CARD)
        if not self.state.has_value(Property.EOS_CAPTURE_DESTINATION, host):
            self._user_destination = self.state.values.get(Property.EOS_CAPTURE_DESTINATION, self._user_destination)
            self._send_property(Property.EOS_CAPTURE_DESTINATION, host)
        self._call_if_supported(Operation.EOS_PC_HDD_CAPACITY, _HOST_CLUSTERS, _HOST_CLUSTER_BYTES, 1)
        self.drain()
        self._verify_property(Property.EOS_CAPTURE_DESTINATION, host)

    def _send_property(self, code: int, value: bytes) -> None:
        self._session.call(Operation.EOS_SET_DEVICE_PROP_VALUE_EX, send=PropertySetting(code, value).encode())

    def _verify_property(self, code: int, value: bytes) -> None:
        if self._poll_until(lambda: self.state.has_value(code, value)):
            return
        if self._request_property(code) and self._poll_until(lambda: self.state.has_value(code, value)):
            return
        reported = self.state.values.get(code)
        raise DeviceRefused(
            f"{self.label} reports {reported.hex() if reported is not None else 'nothing'} for property "
            f"{describe(Property, code)}, {value.hex()} expected; set it by hand, or switch the camera off and on"
        )

    def _retry_while_busy(self, action: Callable[[], None]) -> None:
        # A new session would not help, because the body would start its work again.
        end = self._clock.monotonic() + BUSY_LIMIT_S
        while True:
            try:
                return action()
            except OperationDeclined as error:
                if error.code != ResponseCode.DEVICE_BUSY:
                    raise
                if self._clock.monotonic() >= end:
                    raise DeviceRefused(
                        f"{error}; it has been busy for {BUSY_LIMIT_S:g} s; switch it off and on"
                    ) from error

    def _release_button(self) -> None:
        with contextlib.suppress(OperationDeclined):
            self._session.call(Operation.EOS_REMOTE_RELEASE_OFF, ReleaseButton.HALF_AND_FULL)

    def _poll_until(self, condition: Callable[[], bool]) -> bool:
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
        if now - self._last_keep_alive >= KEEP_ALIVE_S:
            self._last_keep_alive = now
            if self._offers(Operation.EOS_KEEP_DEVICE_ON):
                with contextlib.suppress(OperationDeclined):
                    self._session.call(Operation.EOS_KEEP_DEVICE_ON, retry_s=0.0)

    def _battery_level(self) -> float | None:
        level = battery_level(self.state)
        if level is None and Property.BATTERY_LEVEL in self._info.properties:
            answer = self._call_if_supported(Operation.GET_DEVICE_PROP_VALUE, Property.BATTERY_LEVEL)
            # 0 may mean another power source (ISO 15740, 13.4.1). It is not an empty battery, which cannot reply.
            if answer is not None and answer[1][:1] not in (b"", b"\0"):
                level = min(answer[1][0], 100) / 100
        return level

    def _card_free_bytes(self) -> int | None:
        storage_ids = self._call_if_supported(Operation.EOS_GET_STORAGE_IDS)
        if storage_ids is None:
            return None
        free: list[int] = []
        for storage in decode_u32_array(storage_ids[1], "the list of cards")[:_MAX_CARDS]:
            if storage & _SLOT_FILLED:
                answer = self._call_if_supported(Operation.EOS_GET_STORAGE_INFO, storage)
                if answer is not None:
                    free.append(StorageInfo.decode(answer[1]).free)
        return sum(free) if free else None

    def _request_property(self, code: int) -> bool:
        return self._call_if_supported(Operation.EOS_REQUEST_DEVICE_PROP_VALUE, code) is not None

    def _call_if_supported(self, operation: Operation, *parameters: int) -> tuple[tuple[int, ...], bytes] | None:
        """Return the reply to an operation; None if the body does not support the operation or these parameters."""
        if not self._offers(operation):
            return None
        try:
            return self._session.call(operation, *parameters)
        except OperationDeclined as error:
            if not self._mark_unsupported(operation, error) and error.code not in _NOT_PRESENT:
                raise
            return None

    def _mark_unsupported(self, operation: Operation, error: OperationDeclined) -> bool:
        """Return whether `error` reports an unsupported operation, which is then never called again."""
        if error.code not in _UNSUPPORTED:
            return False
        self._unsupported.add(operation)
        return True

    def _offers(self, operation: int) -> bool:
        return operation in self._info.operations and operation not in self._unsupported


# Most renewals of the connection in one call. Chosen without measurement.
RECOVERIES = 3
# Time after the first fault of a call in which the connection may be renewed, seconds. A body that was switched off
# and on is ready within 10 s. Chosen without measurement.
RECOVERY_S = 30.0
# Time in which a frame must be announced after the exposure, seconds. The shutter time is added to it, because some
# bodies take a dark frame of the same length. Chosen without measurement.
FRAME_S = 30.0
# Time in which a frame must be announced on a new connection, seconds. The body then sends its whole state at once.
REDISCOVERY_S = 10.0

_SHORTEST_RELATIVE_TIME = 0.9  # Smallest ratio of real and nominal shutter time; nominal 1/6 s is really 0.149 s
# First and longest pause between attempts to reconnect, seconds. The pauses double.
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 5.0
# Responses after which a new session may help.
_SESSION_FAULTS = (
    *TRANSIENT,
    ResponseCode.UNDEFINED,
    ResponseCode.GENERAL_ERROR,
    ResponseCode.SESSION_NOT_OPEN,
    ResponseCode.INVALID_TRANSACTION_ID,
    ResponseCode.INCOMPLETE_TRANSFER,
    ResponseCode.TRANSACTION_CANCELLED,
)
_SUFFIXES: dict[int, str] = {ObjectFormat.CRW: ".CRW", ObjectFormat.CR2: ".CR2", ObjectFormat.CR3: ".CR3"}
_CONNECTION_REMEDY = (
    "check its cable and battery, switch it off and on, and close other programs that use it (the photo importer of a "
    "desktop starts automatically)"
)

_Result = TypeVar("_Result")


@dataclass
class _Release:
    """A release of the shutter that has happened, or may have happened.

    - `not_before`, `until`: clock times between which the frame may be announced.
    - `announced`: the frame that was announced. `fetched`: the frame of an unfinished download.
    - `excluded`: handles of other objects.
    """

    body: EosBody
    released_at: datetime
    not_before: float
    until: float
    shutter_s: float
    announced: PendingObject | None = None
    fetched: PendingObject | None = None
    excluded: set[int] = field(default_factory=set[int])


class CanonEos:
    """A Canon EOS camera over USB or a network; `open_transport` opens the cable for each connection.

    - A failed connection is renewed a few times in each call. If this does not help, the call raises an error with the
      first fault, and the caller decides about longer waits.
    - A release is never repeated if it may have happened. After a fault, the frame is searched in the camera's memory.
      Objects that are in the memory before a release are discarded, so that an old frame is never taken for a new one.
    - The frame stays in the memory until its download is complete, or until the next exposure. If the cable or the
      written file fails, only the download must be repeated.
    """

    def __init__(self, open_transport: Callable[[], Transport], clock: Clock = SYSTEM_CLOCK) -> None:
        self._open_transport = open_transport
        self._clock = clock
        self._first_fault: DeviceError | None = None
        self._renewal_deadline = math.inf
        self._transport: Transport | None = None
        self._body: EosBody | None = None
        self._identity: CameraIdentity | None = None
        self._settings: ExposureSettings | None = None
        self._last_release: _Release | None = None
        self._closed = False

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware."""
        self._start_call()
        return self._run(EosBody.identity)

    def supplies(self) -> Supplies:
        """Return battery charge and free space on the cards; see `drivers.camera.ReportsSupplies`."""
        self._start_call()
        return self._run(EosBody.supplies)

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify exposure, raw format and destination; a frame that was not downloaded is dropped."""

        def set_up(body: EosBody) -> None:
            body.make_ready()
            _apply(body, settings)

        self._start_call()
        self._settings = self._last_release = None
        self._run(set_up)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers; see `drivers.camera.Camera.shutter_speeds`."""

        def list_speeds(body: EosBody) -> tuple[float, ...]:
            body.drain()
            return shutter_speeds(body.state)

        self._start_call()
        return self._run(list_speeds)

    def expose(self) -> datetime:
        """Release the shutter without autofocus, and return the time of the release (UTC).

        It returns when the body has announced the frame. An earlier frame that was not downloaded is dropped.
        """
        settings = self._settings
        if settings is None:
            raise DeviceRefused("the camera has no exposure settings; call configure before the first exposure")
        self._start_call()
        self._last_release = None
        release = self._release(settings)
        try:
            self._run(lambda body: self._wait_for_frame(body, release))
        except Exception:
            self._empty_memory()
            raise
        self._last_release = release
        return release.released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the last exposure to `into`, complete and unchanged.

        A failed download may be repeated with a new stream, until the next exposure or until the body is switched off.
        """
        release = self._last_release
        if release is None:
            raise DeviceError("the camera has no exposed frame; expose again")
        self._start_call()
        start = into.tell()
        frame = self._run(lambda body: self._receive_frame(body, release, into, start))
        self._last_release = None
        self._empty_memory()
        return CapturedFrame(_file_name(frame), frame.size, release.released_at)

    def idle(self) -> None:
        """Read new events and keep the body awake; call this every few seconds of a pause."""
        self._start_call()
        self._run(EosBody.drain)

    def close(self) -> None:
        """Release the camera; a second call does nothing."""
        self._closed = True
        self._last_release = None
        body = self._body
        if body is not None:
            try:
                body.disconnect()
            except DeviceError as error:
                self._drop_connection(error)
            else:
                self._drop_connection(None)

    def _start_call(self) -> None:
        self._first_fault, self._renewal_deadline = None, math.inf

    def _run(self, action: Callable[[EosBody], _Result]) -> _Result:
        """Return the result of `action` on a connected body; if the connection fails, repeat it over a new one."""
        renewals = 0
        was_busy = False
        while True:
            body = self._ensure_connected()
            try:
                return action(body)
            except DeviceError as error:
                if not _may_recover(error):
                    raise
                self._record_fault(error)
                # If a body is also busy in a new session, its settings are the cause, not the connection.
                is_busy = isinstance(error, OperationDeclined) and error.code == ResponseCode.DEVICE_BUSY
                is_late = self._clock.monotonic() >= self._renewal_deadline
                if renewals == RECOVERIES or is_late or (is_busy and was_busy):
                    error_type = DeviceRefused if is_busy else DeviceError
                    times = "once" if renewals == 1 else f"{renewals} times"
                    attempts = f"the connection was renewed {times} without success"
                    raise error_type(self._failure_message(error, attempts)) from error
                was_busy = is_busy
                renewals += 1

    def _record_fault(self, fault: DeviceError) -> None:
        """Drop a failed connection, and record the first fault of a call, which is the cause of the later ones."""
        if self._first_fault is None:
            self._first_fault = fault
            self._renewal_deadline = self._clock.monotonic() + RECOVERY_S
        self._drop_connection(fault)

    def _failure_message(self, last_fault: DeviceError, attempts: str) -> str:
        first, latest = (fault.without_remedy() for fault in (self._first_fault or last_fault, last_fault))
        return f"{first}, {attempts}{'' if latest == first else f', last fault: {latest}'}; {_CONNECTION_REMEDY}"

    def _release(self, settings: ExposureSettings) -> _Release:
        """Release the shutter; after a fault during the release, it may have happened or not."""

        def press(body: EosBody) -> _Release:
            body.make_ready()
            _apply(body, settings)  # sends only settings that were changed on the camera
            now = self._clock.monotonic()
            not_before = now + _SHORTEST_RELATIVE_TIME * settings.shutter_s
            until = now + 2 * settings.shutter_s + FRAME_S
            old_handles = set(body.state.pending)
            pressed = _Release(body, self._clock.now(), not_before, until, settings.shutter_s, excluded=old_handles)
            try:
                body.release()
            except (LinkError, ProtocolError) as error:
                self._record_fault(error)
            return pressed

        return self._run(press)

    def _wait_for_frame(self, body: EosBody, release: _Release) -> PendingObject:
        """Wait until the body has announced the frame of a release; return the same frame in every call."""
        is_new_connection = body is not release.body
        until = self._clock.monotonic() + release.shutter_s + REDISCOVERY_S if is_new_connection else release.until
        announced = release.announced

        def is_frame(pending: PendingObject) -> bool:
            if announced is not None and (pending.name, pending.size) != (announced.name, announced.size):
                return False  # another frame, released by hand on the camera
            return pending.is_raw and pending.handle not in release.excluded

        try:
            release.announced = body.wait_for_object(release.not_before, until, is_frame)
        except LinkTimeout as error:
            if not is_new_connection:
                raise  # the announcement may be lost; on a new connection the body repeats it
            self._last_release = None
            remedy = "switch it off and on, and expose again"
            raise DeviceError(f"{error.without_remedy()}, and its memory contains no frame", remedy=remedy) from error
        return release.announced

    def _receive_frame(self, body: EosBody, release: _Release, into: BinaryIO, start: int) -> PendingObject:
        while True:
            frame = self._wait_for_frame(body, release)
            # Pieces are written completely or not at all, so data of the same frame before a fault are valid.
            offset = into.tell() - start if frame == release.fetched else 0
            into.seek(start + offset)
            into.truncate()
            release.fetched = frame
            try:
                body.fetch(frame, into, offset)
            except OperationDeclined as error:
                if error.code != ResponseCode.INVALID_OBJECT_HANDLE:
                    raise
                release.excluded.add(frame.handle)
                release.announced = None
                body.free(frame)
                continue
            return frame

    def _empty_memory(self) -> None:
        """Free all pending objects; if this fails, the next call repeats it over a new connection."""
        if self._body is not None:
            try:
                self._body.free_pending()
                self._body.drain()
                self._body.free_pending()
            except DeviceError as error:
                self._drop_connection(error)

    def _ensure_connected(self) -> EosBody:
        if self._closed:
            raise DeviceError("the camera has been closed; open the rig again")
        if self._body is not None:
            return self._body
        is_first = self._identity is None
        start = self._clock.monotonic()
        end = min(self._renewal_deadline, start + RECOVERY_S)
        pause = _FIRST_PAUSE_S
        while True:
            try:
                return self._connect()
            except DeviceError as error:
                # While a body restarts, it may be absent, or in use by the desktop.
                may_recover = not is_first if self._transport is None else _may_recover(error)
                self._drop_connection(error)
                if not may_recover:
                    raise
                if self._clock.monotonic() + pause > end:
                    attempts = f"no connection for {self._clock.monotonic() - start:.0f} s"
                    raise DeviceError(self._failure_message(error, attempts)) from error
            self._clock.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)

    def _connect(self) -> EosBody:
        self._transport = self._open_transport()
        body = EosBody(self._transport, self._clock)
        body.connect()
        identity, expected = body.identity(), self._identity
        if expected is not None and (identity.model, identity.serial) != (expected.model, expected.serial):
            raise DeviceRefused(
                f"the connected camera is a {identity.model} with serial number {identity.serial}, expected the "
                f"{expected.model} with {expected.serial}; connect that camera again"
            )
        if self._settings is not None:
            _apply(body, self._settings)
        self._identity = identity
        self._body = body
        return body

    def _drop_connection(self, fault: DeviceError | None) -> None:
        transport, self._transport, self._body = self._transport, None, None
        if transport is not None:
            if fault is not None and not isinstance(fault, LinkClosed):
                with contextlib.suppress(DeviceError):
                    transport.reset()
            transport.close()


def _apply(body: EosBody, settings: ExposureSettings) -> None:
    for code, value in plan_settings(body.state, settings).items():
        body.set(code, value)


def _may_recover(error: DeviceError) -> bool:
    return isinstance(error, LinkError | ProtocolError) or (
        isinstance(error, OperationDeclined) and error.code in _SESSION_FAULTS
    )


def _file_name(frame: PendingObject) -> str:
    # Replace characters that are invalid in file names.
    name = re.sub(r"[^A-Za-z0-9._-]", "_", frame.name).strip(".") or f"{frame.handle:08X}"
    # Some bodies announce a file without name or suffix. Its format then gives the suffix.
    return name if "." in name else name + _SUFFIXES.get(frame.format, "")
