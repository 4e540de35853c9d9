"""PTP for USB and network: the binary format of its data, and a session of numbered transactions.

The computer is the initiator, and the camera is the responder. A transaction is a request of the initiator, at most one
data phase, and a response. Events are sent separately. A dataset is a sequence of fields. Numbers are little-endian. A
string has the count of its UTF-16 units with the closing NUL, then the units; an empty string is only the count 0. An
array has a count of 32 bits, then the items.

- ``decode`` reads bytes, and ``encode`` writes the same bytes again.
- Invalid bytes from a device raise only `ProtocolError`. Extra bytes after the last field are accepted, because later
  editions of the standard append fields. ``encode`` raises ValueError for a value that the format cannot hold.
- After a fault of the connection or the protocol, the session has ended. `Transport.reset` or a new transport starts a
  new session.

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
from foundation.errors import (
    RUN_AGAIN,
    DeviceError,
    DeviceRefused,
    LinkClosed,
    LinkError,
    LinkTimeout,
    ProtocolError,
    counted,
)


def describe(kind: type[IntEnum], code: int) -> str:
    """Return name and number of a code, such as ``DEVICE_BUSY (0x2019)``, or the number if it has no name."""
    try:
        return f"{kind(code).name} (0x{code:04x})"
    except ValueError:
        return f"0x{code:04x}"


class Cursor:
    """Reader of little-endian `data` that starts at the first byte; messages contain `name`."""

    def __init__(self, data: bytes, name: str, limit: int | None = None) -> None:
        if limit is not None and len(data) > limit:
            raise ProtocolError(f"{name} has {len(data)} bytes, expected at most {limit}")
        self._data = bytes(data)
        self.name = name
        self.position = 0
        self._field_position = 0

    @property
    def remaining(self) -> int:
        """Number of bytes not yet read."""
        return len(self._data) - self.position

    def fault(self, field: str, expected: str, value: object, position: int | None = None) -> ProtocolError:
        """Return the error for a wrong field: the field that was read last, or the field at `position`."""
        start = self._field_position if position is None else position
        return ProtocolError(f"{self.name}: {field} at byte {start} is {value}, expected {expected}")

    def take(self, count: int, field: str) -> bytes:
        """Return the next `count` bytes."""
        start, end = self.position, self.position + count
        if end > len(self._data):
            raise ProtocolError(
                f"{self.name}: {field} at byte {start} has {counted(self.remaining, 'byte')}, expected {count}"
            )
        self._field_position, self.position = start, end
        return self._data[start:end]

    def rest(self) -> bytes:
        """Return all remaining bytes."""
        return self.take(self.remaining, "the rest")

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
        if count * size > self.remaining:
            raise ProtocolError(
                f"{self.name}: {field} at byte {self.position} announces {count} items of {size} bytes, "
                f"but only {self.remaining} bytes follow"
            )
        octets = self.take(count * size, field)
        return tuple(
            int.from_bytes(octets[at : at + size], "little", signed=signed) for at in range(0, len(octets), size)
        )

    def array(self, size: int, field: str, signed: bool = False) -> tuple[int, ...]:
        """Return an array: a count of 4 bytes, then `count` integers of `size` bytes (ISO 15740, 5.3.3)."""
        return self.integers(self.u32(f"the count of {field}"), size, field, signed)


# Largest accepted dataset, bytes. Real datasets have less than 10 kB.
MAX_DATASET = 1 << 20
_MAX_STRING_UNITS = 254  # Longest string without its closing NUL, UTF-16 units

Value = int | str | tuple[int, ...]  # A property's value: an integer, a string, or an array of integers

_ARRAY = 0x4000  # Bit of the types of arrays (ISO 15740, table of data type codes)
# Size in bytes of each integer type, and whether the type is signed.
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
    # The string ends at its first NUL. Invalid UTF-16 becomes U+FFFD.
    count = cursor.u8(f"the length of {field}")
    octets = cursor.take(2 * count, field)
    return octets[: 2 * _MAX_STRING_UNITS].decode("utf-16-le", "replace").partition("\0")[0]


def encode_string(text: str) -> bytes:
    """Return `text` as a PTP string."""
    if not text:
        return b"\0"
    octets = text.encode("utf-16-le")
    units = len(octets) // 2
    if units > _MAX_STRING_UNITS or "\0" in text:
        raise ValueError(f"{text[:40]!r} has {units} UTF-16 units, expected at most {_MAX_STRING_UNITS} and no NUL")
    return bytes([units + 1]) + octets + b"\0\0"


def encode_integer(value: int, size: int, signed: bool = False) -> bytes:
    """Return `value` in `size` bytes; ValueError if it does not fit."""
    try:
        return value.to_bytes(size, "little", signed=signed)
    except OverflowError as error:
        raise ValueError(f"{value} does not fit into {size} bytes") from error


def encode_array(values: Iterable[int], size: int, signed: bool = False) -> bytes:
    """Return `values` as an array of integers of `size` bytes."""
    items = tuple(values)
    return encode_integer(len(items), 4) + b"".join(encode_integer(item, size, signed) for item in items)


def decode_u32_array(data: bytes, name: str = "the list") -> tuple[int, ...]:
    """Return the items of an array of 32-bit integers, such as storage ids or object handles."""
    return Cursor(data, name, MAX_DATASET).array(4, "items")


def encode_u32_array(values: Iterable[int]) -> bytes:
    """Return `values` as an array of 32-bit integers."""
    return encode_array(values, 4)


def read_value(cursor: Cursor, data_type: int, field: str) -> Value:
    """Return the next property value; `data_type` is a code of `DataType`, or of an array of such a type."""
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
    """Return a property value, as in the reply to GetDevicePropValue."""
    return read_value(Cursor(data, "the property's value", MAX_DATASET), data_type, "value")


def encode_value(data_type: int, value: Value) -> bytes:
    """Return the bytes of a property value; ValueError if the value does not have this type."""
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
    """Format of a field of a dataset; `read` takes a cursor and the name of the field for messages."""

    read: Callable[[Cursor, str], Any]
    encode: Callable[[Any], bytes]


def _field_kind(data_type: int) -> FieldKind:
    if data_type in _INTEGERS:
        size, signed = _INTEGERS[data_type]
        return FieldKind(
            lambda cursor, field: cursor.integer(size, field, signed), lambda value: encode_integer(value, size, signed)
        )
    return FieldKind(
        lambda cursor, field: read_value(cursor, data_type, field), lambda value: encode_value(data_type, value)
    )


U16 = Annotated[int, _field_kind(DataType.UINT16)]
U32 = Annotated[int, _field_kind(DataType.UINT32)]
U64 = Annotated[int, _field_kind(DataType.UINT64)]
U16s = Annotated[tuple[int, ...], _field_kind(_ARRAY + DataType.UINT16)]
Text = Annotated[str, _field_kind(DataType.STRING)]
Rest = Annotated[bytes, FieldKind(lambda cursor, _: cursor.rest(), bytes)]  # All remaining bytes


class PtpDataset:
    """Base class of datasets: frozen dataclasses whose fields have the types above and the order of the bytes."""

    @classmethod
    @cache
    def _layout(cls) -> tuple[tuple[str, str, FieldKind], ...]:
        hints = get_type_hints(cls, include_extras=True).items()
        fields = [(name, hint.__metadata__[0]) for name, hint in hints if get_origin(hint) is Annotated]
        return tuple((name, name.replace("_", " "), field_kind) for name, field_kind in fields)

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Return the value of a dataset."""
        return cls.read(Cursor(data, cls.__name__, MAX_DATASET))

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Return the value at a cursor."""
        return cls(**{name: field_kind.read(cursor, label) for name, label, field_kind in cls._layout()})

    def encode(self) -> bytes:
        """Return the bytes of the dataset."""
        return b"".join([field_kind.encode(getattr(self, name)) for name, _, field_kind in self._layout()])


@dataclass(frozen=True)
class DeviceInfo(PtpDataset):
    """Identity and capabilities of a device (GetDeviceInfo, 5.5.1); the number of version 1.00 is 100."""

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
    """A file or folder in a storage (GetObjectInfo, 5.5.3): sizes in bytes or pixels, dates as ``YYYYMMDDThhmmss``."""

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
    """A storage, such as a card (GetStorageInfo, 5.5.2); capacities in bytes.

    `free_images` is 0xffffffff if the device does not report it. `padding` holds the bytes after the dataset.
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


_NO_FORM, _ENUMERATION = 0, 2  # Form flag (13.3.3): no list of values, or a list of all values


@dataclass(frozen=True)
class DevicePropDesc:
    """A property of a device (GetDevicePropDesc, 13.3.3).

    - `choices`: permitted values; empty if they are not listed.
    - `widened`: the device sends each choice of one byte as two bytes, against the standard. The EOS 60D does this for
      the battery level (0x5001).
    """

    code: int
    data_type: int
    writable: bool
    default: Value
    current: Value
    choices: tuple[Value, ...] = ()
    widened: bool = False

    def encode(self) -> bytes:
        """Return the bytes of the dataset."""
        form = bytes([_NO_FORM])
        if self.choices:
            padding = b"\0" if self.widened else b""
            choices = b"".join(encode_value(self.data_type, value) + padding for value in self.choices)
            form = bytes([_ENUMERATION]) + encode_integer(len(self.choices), 2) + choices
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

# Timeout for OpenSession, seconds. If the previous program was killed, a camera does not reply until it is reset.
START_TIMEOUT_S = 1.5
TIMEOUT_S = 20.0  # Default timeout of all other replies, seconds, as in libgphoto2
TRANSIENT_LIMIT_S = 10.0  # Time for which a temporarily declined operation is repeated, seconds
OPEN_TRIES = 3  # Attempts at OpenSession, with a reset between them, as in libgphoto2

# Responses to an operation that is declined only temporarily.
TRANSIENT = (ResponseCode.DEVICE_BUSY, ResponseCode.EOS_OBJECT_NOT_READY, ResponseCode.EOS_MEMORY_STATUS_NOT_READY)

_FIRST_PAUSE_S = 0.05  # Pause before the first repetition, seconds; later pauses double
_LONGEST_PAUSE_S = 1.0  # Longest pause, seconds, so that a device that is ready waits at most 1 s
# Largest session number. If OpenSession returns INVALID_TRANSACTION_ID, the next number is tried, as in libgphoto2.
_LAST_SESSION = 8


class OperationDeclined(DeviceRefused):
    """The device declined an operation; `code` is its response code."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


_REMEDIES: dict[int, str] = {
    ResponseCode.STORE_FULL: "; its card is full: empty it or insert another",
    ResponseCode.STORE_READ_ONLY: "; its card is read-only: unlock it",
    ResponseCode.EOS_LOW_BATTERY: "; its battery is empty: replace it, or connect a mains adapter",
}


class PtpSession:
    """A session with a camera, in which operations are executed."""

    def __init__(self, transport: Transport, clock: Clock) -> None:
        self._transport = transport
        self._clock = clock
        self._transaction = 0

    @property
    def label(self) -> str:
        """Name of the device in messages."""
        return self._transport.label

    def open(self) -> None:
        """Open the session, or continue a session that an earlier program left open."""
        fault_count = 0
        session = 1
        pauses = self._pauses(TRANSIENT_LIMIT_S)
        while True:
            try:
                code = self._transport.transact(
                    PtpRequest(Operation.OPEN_SESSION, 0, (session,)), timeout=START_TIMEOUT_S
                ).response.code
            except (LinkTimeout, ProtocolError):
                fault_count += 1
                if fault_count == OPEN_TRIES:
                    raise
                self._transport.reset()
                continue
            if code in (ResponseCode.OK, ResponseCode.SESSION_ALREADY_OPEN):
                self._transaction = 0
                return
            if code == ResponseCode.INVALID_TRANSACTION_ID and session < _LAST_SESSION:
                session += 1
            elif code not in TRANSIENT or not next(pauses, False):
                raise self._declined_error(PtpRequest(Operation.OPEN_SESSION, 0, (session,)), code)

    def close(self) -> None:
        """Close the session if the device still replies; the cable stays open."""
        with contextlib.suppress(DeviceError):
            self.call(Operation.CLOSE_SESSION, timeout=START_TIMEOUT_S, retry_s=0.0)

    def call(
        self,
        operation: int,
        *parameters: int,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float = TIMEOUT_S,
        retry_s: float = TRANSIENT_LIMIT_S,
    ) -> tuple[tuple[int, ...], bytes]:
        """Execute an operation; return the parameters of the response, and the data that the device sent.

        Parameters
        ----------
        operation, parameters
            Code and up to five parameters.
        send
            Data to the device; None if the operation has no data in this direction.
        receive
            Function that is called with each piece of data from the device. If None, the data are returned.
        timeout
            Longest wait for each reply, seconds.
        retry_s
            Time for which a temporarily declined operation is repeated, seconds.
        """
        pauses = self._pauses(retry_s)
        while True:
            self._transaction = next_transaction(self._transaction)
            request = PtpRequest(operation, self._transaction, parameters)
            transaction = self._transport.transact(request, send=send, receive=receive, timeout=timeout)
            response_name = describe(ResponseCode, transaction.response.code)
            _log.debug("%s%s: %s", describe(Operation, operation), parameters, response_name)
            if transaction.response.ok:
                return transaction.response.parameters, transaction.data
            # A device that declines an operation sends no data, so `receive` gets the data only once.
            if transaction.response.code not in TRANSIENT or not next(pauses, False):
                raise self._declined_error(request, transaction.response.code)

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that were received since the last call; wait at most some milliseconds."""
        return self._transport.events()

    def _pauses(self, limit: float) -> Iterator[bool]:
        """Sleep before each step of the iteration, with doubling pauses; end after `limit` seconds."""
        end = self._clock.monotonic() + limit
        pause = _FIRST_PAUSE_S
        while (remaining := end - self._clock.monotonic()) > 0:
            self._clock.sleep(min(pause, remaining))
            pause = min(2 * pause, _LONGEST_PAUSE_S)
            yield True

    def _declined_error(self, request: PtpRequest, code: int) -> OperationDeclined:
        remedy = f"; wait until it is idle, {RUN_AGAIN}" if code in TRANSIENT else _REMEDIES.get(code, "")
        return OperationDeclined(f"{self.label} answers {describe(ResponseCode, code)} to {request}{remedy}", code)


MAX_PARAMETERS = 5  # Parameters of 32 bits in a request, response or event
LAST_TRANSACTION = 0xFFFFFFFE  # Highest transaction number; the next is 1, because 0 and 0xffffffff are reserved


def _read_parameters(cursor: Cursor, field: str) -> tuple[int, ...]:
    count, excess = divmod(cursor.remaining, 4)
    if excess or count > MAX_PARAMETERS:
        expected = f"0 to {MAX_PARAMETERS} of 4 bytes"
        raise cursor.fault(f"the list of {field}", expected, f"{cursor.remaining} bytes", position=cursor.position)
    return cursor.integers(count, 4, field)


def _encode_parameters(parameters: tuple[int, ...]) -> bytes:
    if len(parameters) > MAX_PARAMETERS:
        raise ValueError(f"{len(parameters)} parameters, expected at most {MAX_PARAMETERS}")
    return b"".join(encode_integer(parameter, 4) for parameter in parameters)


@dataclass(frozen=True)
class _Message(PtpDataset):
    """Base class of requests, responses and events. As text, a message is ``NAME (0x1001)(0x1, 0x2)``."""

    codes: ClassVar[type[IntEnum]]
    code: U16
    transaction: U32 = 0
    parameters: Annotated[tuple[int, ...], FieldKind(_read_parameters, _encode_parameters)] = ()

    def __str__(self) -> str:
        parameters = ", ".join(f"0x{parameter:x}" for parameter in self.parameters)
        return describe(self.codes, self.code) + (f"({parameters})" if parameters else "")


@dataclass(frozen=True)
class PtpRequest(_Message):
    """An operation requested by the initiator."""

    codes = Operation


@dataclass(frozen=True)
class PtpResponse(_Message):
    """Result of an operation; `transaction` is the number of the request."""

    codes = ResponseCode

    @property
    def ok(self) -> bool:
        """True if the operation was executed."""
        return self.code == ResponseCode.OK


@dataclass(frozen=True)
class PtpEvent(_Message):
    """An event of the device; `transaction` is 0xffffffff if the event belongs to no transaction."""

    codes = EventCode
    transaction: U32 = 0xFFFFFFFF


def next_transaction(transaction: int) -> int:
    """Return the number of the transaction after `transaction`; 0 is the number of OpenSession."""
    return 1 if transaction >= LAST_TRANSACTION else transaction + 1


# Most data that a transport collects if the caller does not pass `receive`, bytes.
MAX_COLLECTED = 4 * 1024 * 1024


@dataclass(frozen=True)
class Transaction:
    """Result of a transaction: the response, and the data that were collected."""

    response: PtpResponse
    data: bytes = b""


class Transport(Protocol):
    """An open connection from the initiator to a PTP device."""

    @property
    @abstractmethod
    def label(self) -> str:
        """Name of the device in messages: its address, and its own name if known."""

    @abstractmethod
    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Execute one transaction; arguments as in `PtpSession.call`. At most `MAX_COLLECTED` bytes are collected."""

    @abstractmethod
    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that were received since the last call; wait at most some milliseconds."""

    @abstractmethod
    def reset(self) -> None:
        """Reset connection and device so that a session can be opened; an open session ends."""

    @abstractmethod
    def close(self) -> None:
        """Release the device; a second call does nothing."""


@dataclass(frozen=True)
class Answer:
    """A response and the data before it; `data` is None without a data phase, and b"" if the phase is empty."""

    response: PtpResponse
    data: bytes | None = None


class NoAnswer(Exception):
    """Raised by a simulated responder that does not reply; the initiator's time limit then ends."""


class Responder(Protocol):
    """A simulated device, which answers one request at a time. Containers and packets are made elsewhere."""

    def takes_data(self, request: PtpRequest) -> bool:
        """Return whether the initiator sends data with this operation."""

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Execute a request; `data` are the data from the initiator."""

    def events(self) -> tuple[PtpEvent, ...]:
        """Return the events that occurred since the last call."""

    def cancelled(self, transaction: int) -> None:
        """Record that the initiator cancelled a transaction."""

    def unplugged(self) -> None:
        """Record that the cable was unplugged or reset, which ends the session."""


class Reception:
    """Receiver of the data and the response of one request; `label` is the device in messages."""

    def __init__(self, request: PtpRequest, receive: Callable[[bytes], object] | None, label: str) -> None:
        self.request = request
        self._receive = receive
        self.label = label
        self._started = False
        self._announced_length: int | None = None
        self._received_count = 0
        self._collected = bytearray()

    @property
    def remaining(self) -> int | None:
        """Number of bytes that the data phase still lacks; None if no length was announced."""
        return None if self._announced_length is None else self._announced_length - self._received_count

    def start(self, transaction: int, length: int | None) -> None:
        """Start a data phase of `length` bytes; None if the device did not announce the length."""
        self._check_transaction("data", transaction)
        if self._started:
            raise ProtocolError(f"{self.label} sent a second data phase with {self.request}; reset it")
        if self._receive is None and length is not None and length > MAX_COLLECTED:
            raise self._too_long_error(length)
        self._started = True
        self._announced_length = length

    def take(self, piece: bytes) -> None:
        """Process the next bytes of the data phase."""
        if not self._started:
            raise ProtocolError(f"{self.label} sent data with {self.request} without a start of data; reset it")
        self._received_count += len(piece)
        if self._announced_length is not None and self._received_count > self._announced_length:
            raise ProtocolError(
                f"{self.label} announced {self._announced_length} bytes with {self.request} "
                f"and sent at least {self._received_count}; reset it"
            )
        if self._receive is not None:
            if piece:
                self._receive(piece)
        elif self._received_count > MAX_COLLECTED:
            raise self._too_long_error(self._received_count)
        else:
            self._collected += piece

    def end(self, response: PtpResponse) -> Transaction:
        """Return the transaction that `response` completes."""
        self._check_transaction("a response", response.transaction)
        # A device may end the data phase early and report an error. This response is returned.
        if response.ok and self._announced_length is not None and self._received_count != self._announced_length:
            raise ProtocolError(
                f"{self.label} announced {self._announced_length} bytes with {self.request}, "
                f"sent {self._received_count}, and reports success; repeat the operation"
            )
        return Transaction(response, bytes(self._collected))

    def _check_transaction(self, message_kind: str, transaction: int) -> None:
        if transaction != self.request.transaction:
            raise ProtocolError(
                f"{self.label} sent {message_kind} of transaction {transaction} during {self.request}, "
                f"transaction {self.request.transaction}; reset it"
            )

    def _too_long_error(self, length: int) -> ProtocolError:
        return ProtocolError(
            f"{self.label} sends {length} bytes or more with {self.request}, expected at most {MAX_COLLECTED}; reset it"
        )


class CableTransport(Transport, ABC):
    """Base class of transports over real cables; after an unfinished transaction, all others are refused."""

    def __init__(self) -> None:
        self.closed = False
        self.between_transactions = True

    @abstractmethod
    def exchange(self, reception: Reception, send: bytes | None, timeout: float) -> Transaction:
        """Send the request with its data phase, and return the reply of the device."""

    @abstractmethod
    def cancel(self, transaction: int) -> bool:
        """Cancel a transaction whose data the caller cannot take; return whether another transaction is possible."""

    def transact(
        self,
        request: PtpRequest,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        """Execute one transaction; see `Transport`."""
        self.check_open()
        if not self.between_transactions:
            raise ProtocolError(f"{self.label}: the transaction before {request} is unfinished; reset the connection")
        self.between_transactions = False
        try:
            transaction = self.exchange(Reception(request, receive, self.label), send, timeout)
        except LinkClosed:
            self.closed = True
            raise
        except (LinkError, ProtocolError):
            raise
        except BaseException:
            self.between_transactions = self.cancel(request.transaction)
            raise
        self.between_transactions = True
        return transaction

    def check_open(self) -> None:
        """Raise `LinkClosed` if the cable is closed."""
        if self.closed:
            raise LinkClosed(f"{self.label} is disconnected, or its connection was closed; open it again")
