"""USB/IP as bytes: what a computer asks of another one that lends it a USB device, and the answers.

A connection begins with one operation: to list the devices, or to import one. Once a device is imported, the same
connection carries its transfers, each with a number under which its result comes back, in any order.

Rules that hold inside:

- `RequestReader` takes a stream in any pieces. Whatever arrives, the only error is `ProtocolError`; after it the stream
  has lost its place.
- Numbers are big-endian here, save the eight bytes of a control request, which are USB's own.

Source: the Linux kernel's documentation, usb/usbip_protocol.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from foundation.errors import ProtocolError
from sim.buses.usb_device import PtpUsbDevice

PORT = 3240
"""TCP port of a USB/IP server (usb/usbip_protocol)."""
VERSION = 0x0111
"""Version 1.1.1 of the protocol, one hexadecimal digit each."""
HIGH_SPEED = 3
"""Linux's USB_SPEED_HIGH (enum usb_device_speed)."""
SHORT_NOT_OK = 0x0001
"""Flag of a transfer in that is to fail if less comes than was asked for."""
ZERO_PACKET = 0x0040
"""Flag of a transfer out that is to be closed by a zero-length packet if its last packet is full."""
MAX_TRANSFER = 64 * 1024 * 1024
"""Bytes of the longest transfer that is taken."""

# Codes of the operations before a device is imported, and of the messages after (usb/usbip_protocol).
_LIST, _IMPORT = 0x8005, 0x8003
_LIST_REPLY, _IMPORT_REPLY = 0x0005, 0x0003
_SUBMIT, _UNLINK, _SUBMITTED, _UNLINKED = 1, 2, 3, 4
_OPERATION = struct.Struct(">HHI")
_BUS_ID = 32
"""Bytes of a bus id, filled up with zeros."""
_URB = struct.Struct(">IIIIIIiiii8s")


@dataclass(frozen=True)
class ListRequest:
    """The client asks which devices there are."""


@dataclass(frozen=True)
class ImportRequest:
    """The client wants this one, and goes on to use it on the same connection."""

    bus_id: str


@dataclass(frozen=True)
class Submit:
    """A transfer: `data` goes out, or up to `length` bytes come in; `setup` counts on endpoint 0 only."""

    number: int
    inward: bool
    endpoint: int
    flags: int
    length: int
    setup: bytes
    data: bytes = b""


@dataclass(frozen=True)
class Unlink:
    """Forget a transfer that has not ended yet."""

    number: int
    victim: int


Incoming = ListRequest | ImportRequest | Submit | Unlink


class RequestReader:
    """Cuts what a client sends into requests."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._imported = False

    def feed(self, piece: bytes) -> list[Incoming]:
        """Take the next bytes and return what they complete."""
        self._rest += piece
        requests: list[Incoming] = []
        while (request := self._transfer() if self._imported else self._operation()) is not None:
            requests.append(request)
        return requests

    def _operation(self) -> ListRequest | ImportRequest | None:
        if len(self._rest) < _OPERATION.size:
            return None
        version, code, _ = _OPERATION.unpack_from(self._rest)
        if code == _LIST:
            del self._rest[: _OPERATION.size]
            return ListRequest()
        if code != _IMPORT:
            raise ProtocolError(
                f"a USB/IP client asks for operation 0x{code:04x} of version 0x{version:04x}; "
                f"0x{_LIST:04x} list or 0x{_IMPORT:04x} import of version 0x{VERSION:04x} were expected"
            )
        end = _OPERATION.size + _BUS_ID
        if len(self._rest) < end:
            return None
        name = bytes(self._rest[_OPERATION.size : end]).partition(b"\0")[0]
        del self._rest[:end]
        self._imported = True
        return ImportRequest(name.decode("ascii", "replace"))

    def _transfer(self) -> Submit | Unlink | None:
        if len(self._rest) < _URB.size:
            return None
        command, number, _, direction, endpoint, flags, length, _, _, _, setup = _URB.unpack_from(self._rest)
        if command == _UNLINK:
            del self._rest[: _URB.size]
            return Unlink(number, flags)
        if command != _SUBMIT or direction > 1 or endpoint > 15 or not 0 <= length <= MAX_TRANSFER:
            raise ProtocolError(
                f"a USB/IP client sends command {command}, direction {direction}, endpoint {endpoint}, {length} bytes; "
                f"1 submit or 2 unlink, 0 or 1, 0 to 15 and at most {MAX_TRANSFER} bytes were expected"
            )
        inward = direction == 1
        end = _URB.size if inward else _URB.size + length
        if len(self._rest) < end:
            return None
        data = bytes(self._rest[_URB.size : end])
        del self._rest[:end]
        return Submit(number, inward, endpoint, flags, length, setup, data)


def encode_list(devices: dict[str, PtpUsbDevice]) -> bytes:
    """Return the answer to a `ListRequest`: each device under its bus id, with its interface's class."""
    entries = (
        _describe(bus_id, device) + device.configuration_descriptor()[14:17] + b"\0"
        for bus_id, device in devices.items()
    )
    return _OPERATION.pack(VERSION, _LIST_REPLY, 0) + len(devices).to_bytes(4, "big") + b"".join(entries)


def encode_import(bus_id: str, device: PtpUsbDevice | None) -> bytes:
    """Return the answer to an `ImportRequest`; no device: it is not there, or lent already."""
    if device is None:
        return _OPERATION.pack(VERSION, _IMPORT_REPLY, 1)
    return _OPERATION.pack(VERSION, _IMPORT_REPLY, 0) + _describe(bus_id, device)


def encode_result(submit: Submit, status: int, data: bytes = b"") -> bytes:
    """Return how a transfer ended: 0 or a negative error number of Linux, and what came in."""
    actual = len(data) if submit.inward else len(submit.data)
    if status and not submit.inward:
        actual = 0
    return _URB.pack(_SUBMITTED, submit.number, 0, 0, 0, status & 0xFFFFFFFF, actual, 0, 0, 0, b"") + data


def encode_unlinked(unlink: Unlink, status: int) -> bytes:
    """Return how an unlink ended: 0 where the transfer was over already, else a negative error number of Linux."""
    return _URB.pack(_UNLINKED, unlink.number, 0, 0, 0, status & 0xFFFFFFFF, 0, 0, 0, 0, b"")


def device_number(bus_id: str) -> tuple[int, int]:
    """Return bus and device number for a bus id such as ``1-2``."""
    bus, _, port = bus_id.partition("-")
    return int(bus), int(port) + 1


def _describe(bus_id: str, device: PtpUsbDevice) -> bytes:
    bus, number = device_number(bus_id)
    vendor, product, release = struct.unpack_from("<HHH", device.device_descriptor(), 8)
    path = f"/sys/devices/simulated/usb{bus}/{bus_id}"
    return struct.pack(
        ">256s32sIIIHHHBBBBBB",
        path.encode("ascii"),
        bus_id.encode("ascii"),
        bus,
        number,
        HIGH_SPEED,
        vendor,
        product,
        release,
        0,
        0,
        0,
        1,
        1,
        1,
    )
