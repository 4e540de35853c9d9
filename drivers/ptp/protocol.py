"""PTP on any cable: datasets as bytes and as values, and a session of numbered transactions.

A transaction is a request, at most one data phase, and a response; events come beside. Everything is little-endian. A
string is a count of UTF-16 units with the closing NUL, then the units; an empty string is the count 0 alone. An array
is a count of 32 bits, then the items.

Rules that hold inside:

- ``decode`` and ``encode`` undo each other on well-formed bytes, so that both ends of the cable share one type.
- Whatever bytes a device sends, the only error is `ProtocolError`; a count is compared with the bytes that are left
  before anything is made from it. Bytes behind a dataset's last field are no fault, for later editions append.
  ``encode`` raises ValueError for what the wire cannot hold; that is our own mistake, never a device's.
- A fault of cable or protocol goes straight to the caller: whether an operation may be repeated is not known here.
  After one, the session is spent; a new one begins with `Transport.reset` or a new transport.

Source: ISO 15740:2013, clauses 5 (types and datasets), 9.3 (sessions and transactions) and 13 (properties).
"""

from __future__ import annotations

import contextlib
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from typing import Annotated, Any, ClassVar, Protocol, Self, get_origin, get_type_hints

from drivers.ptp.codes import DataType, EventCode, Operation, ResponseCode
from foundation.clock import Clock
from foundation.errors import DeviceError, DeviceRefused, LinkClosed, LinkError, LinkTimeout, ProtocolError


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
        begin, end = self.at, self.at + count
        if end > len(self._data):
            raise ProtocolError(
                f"{self.what}: {field} at byte {begin} needs {count} bytes, but only {self.left} follow"
            )
        self._before, self.at = begin, end
        return self._data[begin:end]

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


# Bytes of the largest dataset that is read; real ones stay below 10 kB, long lists of handles included.
MAX_DATASET = 1 << 20
_MAX_STRING_UNITS = 254  # UTF-16 units of the longest string, its closing NUL not counted

Value = int | str | tuple[int, ...]  # A property's value: an integer, a string, or an array of integers

_ARRAY = 0x4000  # Bit that makes an array of a type of integers (ISO 15740, table of data type codes)
# Bytes and sign of each integer type.
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


def _read_string(cursor: Cursor, field: str) -> str:
    """Return the next string, up to its first NUL; what is no UTF-16 becomes U+FFFD."""
    count = cursor.u8(f"the length of {field}")
    octets = cursor.take(2 * count, field)
    return octets[: 2 * _MAX_STRING_UNITS].decode("utf-16-le", "replace").partition("\0")[0]


def encode_string(text: str) -> bytes:
    """Return `text` as a string of PTP."""
    if not text:
        return b"\0"
    octets = text.encode("utf-16-le")
    units = len(octets) // 2
    if units > _MAX_STRING_UNITS or "\0" in text:
        raise ValueError(f"{text[:40]!r} of {units} UTF-16 units is no PTP string; at most {_MAX_STRING_UNITS}, no NUL")
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
        return _read_string(cursor, field)
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


def _of_type(data_type: int) -> FieldKind:
    """Return how a field of one of ISO 15740's types stands on the wire."""
    if data_type in _INTEGERS:
        size, signed = _INTEGERS[data_type]
        return FieldKind(
            lambda cursor, field: cursor.integer(size, field, signed), lambda value: encode_integer(value, size, signed)
        )
    return FieldKind(
        lambda cursor, field: read_value(cursor, data_type, field), lambda value: encode_value(data_type, value)
    )


U16 = Annotated[int, _of_type(DataType.UINT16)]
U32 = Annotated[int, _of_type(DataType.UINT32)]
U64 = Annotated[int, _of_type(DataType.UINT64)]
U16s = Annotated[tuple[int, ...], _of_type(_ARRAY + DataType.UINT16)]
Text = Annotated[str, _of_type(DataType.STRING)]
Rest = Annotated[bytes, FieldKind(lambda cursor, _: cursor.rest(), bytes)]  # What a dataset's fields are on the wire


class PtpDataset:
    """A frozen dataclass whose fields, each a type above, follow each other on the wire."""

    @classmethod
    @cache
    def _layout(cls) -> tuple[tuple[str, str, FieldKind], ...]:
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


_NO_FORM, _ENUMERATION = 0, 2  # How a property's values are listed (13.3.3): not at all, or one by one


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


_log = logging.getLogger(__name__)

# Wait for the answer to OpenSession: a body that a killed host left behind never answers before a reset.
START_TIMEOUT_S = 1.5
TIMEOUT_S = 20.0  # Wait for every other answer, unless the caller sets another; libgphoto2 waits as long
PASSING_LIMIT_S = 10.0  # How long an operation is asked again when a device declines it for the moment
OPEN_TRIES = 3  # Tries at OpenSession with a reset between them, as many as libgphoto2 makes

# Responses that mean: not now.
PASSING = (ResponseCode.DEVICE_BUSY, ResponseCode.EOS_OBJECT_NOT_READY, ResponseCode.EOS_MEMORY_STATUS_NOT_READY)

_FIRST_PAUSE_S = 0.05  # Before the first repetition: short to an operator, long beside the milliseconds of an operation
_LONGEST_PAUSE_S = 1.0  # Pauses double up to here, so that a device that is free again waits for a second at most
# Session numbers tried where a device declines the transaction number, as libgphoto2 does; a few, then no more.
_LAST_SESSION = 8


class OperationDeclined(DeviceRefused):
    """A device answered an operation with another response than OK: `code`."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


_REMEDIES: dict[int, str] = {
    ResponseCode.STORE_FULL: "; its card is full: empty it, or put another in",
    ResponseCode.STORE_READ_ONLY: "; its card is read-only: unlock it",
    ResponseCode.EOS_LOW_BATTERY: "; its battery is empty: change it, or connect a mains adapter",
}


class PtpSession:
    """The initiator's side of a session."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport = transport
        self._clock = clock
        self._transaction = 0

    @property
    def label(self) -> str:
        """What messages call the device."""
        return self._transport.label

    def open(self) -> None:
        """Open the session; one that a former host left open is taken over."""
        faults = 0
        session = 1
        pauses = self._pauses(PASSING_LIMIT_S)
        while True:
            try:
                code = self._transport.transact(
                    PtpRequest(Operation.OPEN_SESSION, 0, (session,)), timeout=START_TIMEOUT_S
                ).response.code
            except (LinkTimeout, ProtocolError):
                faults += 1
                if faults == OPEN_TRIES:
                    raise
                self._transport.reset()
                continue
            if code in (ResponseCode.OK, ResponseCode.SESSION_ALREADY_OPEN):
                self._transaction = 0
                return
            if code == ResponseCode.INVALID_TRANSACTION_ID and session < _LAST_SESSION:
                session += 1
            elif code not in PASSING or not next(pauses, False):
                raise self._declined(PtpRequest(Operation.OPEN_SESSION, 0, (session,)), code)

    def close(self) -> None:
        """Close the session as far as the device still answers; the cable stays open."""
        with contextlib.suppress(DeviceError):
            self.call(Operation.CLOSE_SESSION, timeout=START_TIMEOUT_S, retry_s=0.0)

    def call(
        self,
        operation: int,
        *parameters: int,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float = TIMEOUT_S,
        retry_s: float = PASSING_LIMIT_S,
    ) -> tuple[tuple[int, ...], bytes]:
        """Carry out an operation.

        `send`: the data phase to the device; None where the operation has none. `receive`: takes the data phase from
        the device piece by piece; None collects it. `timeout`: longest wait for each answer, seconds. `retry_s`: how
        long it is asked again when the device declines for the moment, seconds.
        """
        pauses = self._pauses(retry_s)
        while True:
            self._transaction = next_transaction(self._transaction)
            request = PtpRequest(operation, self._transaction, parameters)
            done = self._transport.transact(request, send=send, receive=receive, timeout=timeout)
            answered = describe(ResponseCode, done.response.code)
            _log.debug("%s%s: %s", describe(Operation, operation), parameters, answered)
            if done.response.ok:
                return done.response.parameters, done.data
            # A device that declines sends no data, so that `receive` has seen nothing of a try that is repeated.
            if done.response.code not in PASSING or not next(pauses, False):
                raise self._declined(request, done.response.code)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that came on the event channel since the last call; never waits."""
        return self._transport.events()

    def _pauses(self, limit: float) -> Iterator[bool]:
        """Let growing pauses pass, one at each step; end when `limit` seconds are over."""
        end = self._clock.monotonic() + limit
        pause = _FIRST_PAUSE_S
        while (left := end - self._clock.monotonic()) > 0:
            self._clock.sleep(min(pause, left))
            pause = min(2 * pause, _LONGEST_PAUSE_S)
            yield True

    def _declined(self, request: PtpRequest, code: int) -> OperationDeclined:
        remedy = "; wait until it is idle, then try again" if code in PASSING else _REMEDIES.get(code, "")
        return OperationDeclined(f"{self.label} answers {describe(ResponseCode, code)} to {request}{remedy}", code)


MAX_PARAMETERS = 5  # Parameters of 32 bits that a request, response or event may carry
LAST_TRANSACTION = 0xFFFFFFFE  # The highest transaction number; 1 follows it, for 0 and 0xffffffff are taken


def _read_parameters(cursor: Cursor, field: str) -> tuple[int, ...]:
    count, odd = divmod(cursor.left, 4)
    if odd or count > MAX_PARAMETERS:
        expected = f"0 to {MAX_PARAMETERS} of 4 bytes"
        raise cursor.fault(f"the list of {field}", expected, f"{cursor.left} bytes", at=cursor.at)
    return cursor.integers(count, 4, field)


def _encode_parameters(parameters: tuple[int, ...]) -> bytes:
    if len(parameters) > MAX_PARAMETERS:
        raise ValueError(f"{len(parameters)} parameters; at most {MAX_PARAMETERS} are possible")
    return b"".join(encode_integer(parameter, 4) for parameter in parameters)


@dataclass(frozen=True)
class _Coded(PtpDataset):
    """What request, response and event have: a number of `codes`, and parameters; in text ``NAME(0x1, 0x2)``."""

    codes: ClassVar[type[IntEnum]]
    code: U16
    transaction: U32 = 0
    parameters: Annotated[tuple[int, ...], FieldKind(_read_parameters, _encode_parameters)] = ()

    def __str__(self) -> str:
        listed = ", ".join(f"0x{parameter:x}" for parameter in self.parameters)
        return describe(self.codes, self.code) + (f"({listed})" if listed else "")


@dataclass(frozen=True)
class PtpRequest(_Coded):
    """An operation that the initiator asks for."""

    codes = Operation


@dataclass(frozen=True)
class PtpResponse(_Coded):
    """How an operation ended; `transaction` is the request's."""

    codes = ResponseCode

    @property
    def ok(self) -> bool:
        """Whether the operation was carried out."""
        return self.code == ResponseCode.OK


@dataclass(frozen=True)
class PtpEvent(_Coded):
    """Something that happened in the device; `transaction` is 0xffffffff where it belongs to none."""

    codes = EventCode
    transaction: U32 = 0xFFFFFFFF


def next_transaction(transaction: int) -> int:
    """Return the number that follows `transaction`; OpenSession carries 0 and 0xffffffff means none."""
    return 1 if transaction >= LAST_TRANSACTION else transaction + 1


# Bytes of a data phase that a transport collects for a caller who takes none of it piece by piece.
MAX_COLLECTED = 4 * 1024 * 1024


@dataclass(frozen=True)
class Transaction:
    """How a transaction ended: the device's response, and the data phase if it was collected."""

    response: PtpResponse
    data: bytes = b""


class Transport(Protocol):
    """An open cable to a PTP device, seen from the initiator."""

    @property
    @abstractmethod
    def label(self) -> str:
        """What messages call the device: address and name as far as known."""

    @abstractmethod
    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction.

        `send`: the data phase to the device; None where the operation has none. `receive`: takes the data phase from
        the device piece by piece; None collects up to `MAX_COLLECTED` bytes. `timeout`: longest wait for each answer of
        the device, seconds.
        """

    @abstractmethod
    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come since the last call; never waits."""

    @abstractmethod
    def reset(self) -> None:
        """Bring cable and device back to where a session can be opened; costs a session that is open."""

    @abstractmethod
    def close(self) -> None:
        """Release the device; a second call does nothing."""


@dataclass(frozen=True)
class Answer:
    """A response, and the data phase before it; None where there is none (an empty one is b"")."""

    response: PtpResponse
    data: bytes | None = None


class NoAnswer(Exception):
    """Raised instead of answering: the device says nothing, and the initiator waits in vain."""


class Responder(Protocol):
    """The other end of a cable: a device that answers one request at a time, without containers or packets."""

    def takes_data(self, request: PtpRequest) -> bool:
        """Return whether the initiator sends a data phase with this operation."""

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Carry out a request; `data` is the initiator's data phase."""

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that have come up since the last call."""

    def cancelled(self, transaction: int) -> None:
        """Note that the initiator gave up a transaction."""

    def unplugged(self) -> None:
        """Note that the cable was pulled or reset: the session is over."""


class Reception:
    """Takes what the device sends between a request and the end of its response; `label` names the device."""

    def __init__(self, request: PtpRequest, receive: Callable[[bytes], object] | None, label: str) -> None:
        self.request = request
        self._receive = receive
        self.label = label
        self._started = False
        self._announced: int | None = None
        self._taken = 0
        self._collected = bytearray()

    @property
    def left(self) -> int | None:
        """Bytes of the data phase still to come; None where no length was announced."""
        return None if self._announced is None else self._announced - self._taken

    def start(self, transaction: int, length: int | None) -> None:
        """Note that a data phase of `length` bytes begins; None where the device does not know."""
        self._check_transaction("data", transaction)
        if self._started:
            raise ProtocolError(f"{self.label} sends a second data phase with {self.request}; reset it")
        if self._receive is None and length is not None and length > MAX_COLLECTED:
            raise self._too_long(length)
        self._started = True
        self._announced = length

    def take(self, piece: bytes) -> None:
        """Take the next bytes of the data phase."""
        if not self._started:
            raise ProtocolError(f"{self.label} sends data with {self.request} but never announced them; reset it")
        self._taken += len(piece)
        if self._announced is not None and self._taken > self._announced:
            raise ProtocolError(
                f"{self.label} announced {self._announced} bytes with {self.request} "
                f"and sends at least {self._taken}; reset it"
            )
        if self._receive is not None:
            if piece:
                self._receive(piece)
        elif self._taken > MAX_COLLECTED:
            raise self._too_long(self._taken)
        else:
            self._collected += piece

    def end(self, response: PtpResponse) -> Transaction:
        """Return the transaction that `response` ends."""
        self._check_transaction("a response", response.transaction)
        # A device that gives up in the middle reports that by its response: then the response is what counts.
        if response.ok and self._announced is not None and self._taken != self._announced:
            raise ProtocolError(
                f"{self.label} announced {self._announced} bytes with {self.request}, sent {self._taken}, "
                f"and reports success; ask again"
            )
        return Transaction(response, bytes(self._collected))

    def _check_transaction(self, what: str, transaction: int) -> None:
        if transaction != self.request.transaction:
            raise ProtocolError(
                f"{self.label} sends {what} of transaction {transaction} during {self.request}, "
                f"which is transaction {self.request.transaction}; reset it"
            )

    def _too_long(self, length: int) -> ProtocolError:
        return ProtocolError(
            f"{self.label} sends {length} bytes or more with {self.request}; at most {MAX_COLLECTED} were expected"
        )


class CableTransport(Transport, ABC):
    """A `Transport` over a real cable: one transaction after the other, and none where one was left unfinished."""

    def __init__(self) -> None:
        self.closed = False
        self.between_transactions = True

    @abstractmethod
    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request and the data phase to the device, and return what the device answers."""

    @abstractmethod
    def call_off(self, transaction: int) -> bool:
        """Call off a transaction whose data the caller cannot take; return whether the next can follow."""

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Carry out one transaction; see `Transport`."""
        self.check_open()
        if not self.between_transactions:
            raise ProtocolError(f"{self.label}: the transaction before {request} did not end; reset the connection")
        self.between_transactions = False
        try:
            transaction = self.exchange(Reception(request, receive, self.label), send, timeout)
        except LinkClosed:
            self.closed = True
            raise
        except (LinkError, ProtocolError):
            raise
        except BaseException:
            self.between_transactions = self.call_off(request.transaction)
            raise
        self.between_transactions = True
        return transaction

    def check_open(self) -> None:
        """Require that the cable is open."""
        if self.closed:
            raise LinkClosed(f"{self.label} is gone, or the connection to it was closed; open it again")
