"""Simulated USB devices lent over a network: Linux attaches them as if they were plugged in, so do USB/IP libraries.

On Linux, as root: ``modprobe vhci-hcd``, then ``usbip attach -r 127.0.0.1 -b 1-1``. A device is lent to one client at a
time, and only the thread of its connection uses it. Numbers are big-endian, save the eight bytes of a control request,
which are USB's own. Whatever arrives, the only error is `ProtocolError`.

Source: the Linux kernel's documentation, usb/usbip_protocol; URB semantics, driver-api/usb/URB.
"""

from __future__ import annotations

import errno
import struct
import threading
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.links.link import Link
from drivers.links.network import TcpServer
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError
from sim.buses.usb import BULK_OUT, PACKET, Overflowed, PtpUsbDevice, Setup, Stalled

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


def _describe(bus_id: str, device: PtpUsbDevice) -> bytes:
    """Return what a client is told of a device, whose bus id is such as ``1-2``."""
    bus, port = (int(part) for part in bus_id.split("-"))
    vendor, product, release = struct.unpack_from("<HHH", device.device_descriptor(), 8)
    path = f"/sys/devices/simulated/usb{bus}/{bus_id}"
    names = path.encode("ascii"), bus_id.encode("ascii")
    return struct.pack(
        ">256s32sIIIHHHBBBBBB", *names, bus, port + 1, HIGH_SPEED, vendor, product, release, 0, 0, 0, 1, 1, 1
    )


_READ = 128 * 1024
"""Bytes read at once: few calls for a long transfer out, and no buffer that has to be mapped anew for each request."""
_TICK_S = 0.02
"""Between two looks at transfers that wait for data: short beside the times a host waits."""
_TIMEOUT_S = 10.0
"""For a host that is slow to read or write; an idle one is listened to again."""
_EREMOTEIO = 121
"""Linux's number for a transfer that was short although that was not allowed; not every system has it in errno."""


def serve_usbip(devices: Sequence[PtpUsbDevice], port: int = PORT) -> TcpServer:
    """Lend devices under the bus ids 1-1, 1-2, …; port 0 picks a free one.

    Use the result in a ``with`` block; its `address` is host and port.
    """
    return TcpServer(UsbIpService(devices).handle, port)


class UsbIpService:
    """Speaks USB/IP for devices on connections that it is given."""

    def __init__(self, devices: Sequence[PtpUsbDevice]) -> None:
        self._devices = {f"1-{number}": device for number, device in enumerate(devices, 1)}
        self._lent: set[str] = set()
        self._guard = threading.Lock()

    def handle(self, link: Link) -> None:
        """Serve one connection until it ends."""
        reader = RequestReader()
        try:
            while not (requests := reader.feed(link.read(_READ, _TIMEOUT_S))):
                pass
            match requests[0]:
                case ListRequest():
                    link.write(encode_list(self._devices), _TIMEOUT_S)
                case ImportRequest(bus_id):
                    self._lend(link, reader, bus_id, requests[1:])
                case _:
                    pass
        except ProtocolError as error:
            raise LinkClosed(f"a stream without requests is of no use: {error}") from error

    def _lend(self, link: Link, reader: RequestReader, bus_id: str, early: list[Incoming]) -> None:
        with self._guard:
            device = None if bus_id in self._lent else self._devices.get(bus_id)
            if device is not None:
                self._lent.add(bus_id)
        link.write(encode_import(bus_id, device), _TIMEOUT_S)
        if device is None:
            return
        try:
            _Loan(link, device).serve(reader, early)
        finally:
            device.unplugged()
            with self._guard:
                self._lent.discard(bus_id)


class _Loan:
    """The transfers of one imported device."""

    def __init__(self, link: Link, device: PtpUsbDevice) -> None:
        self._link = link
        self._device = device
        self._waiting: list[Submit] = []
        self._held: set[int] = set()

    def serve(self, reader: RequestReader, requests: list[Incoming]) -> None:
        while True:
            for request in requests:
                match request:
                    case Submit():
                        self._submit(request)
                    case Unlink():
                        self._unlink(request)
                    case _:
                        raise ProtocolError("a USB/IP client sends an operation among transfers")
            self._serve_waiting()
            try:
                piece = self._link.read(_READ, _TICK_S if self._waiting else _TIMEOUT_S)
            except LinkTimeout:
                piece = b""
            requests = reader.feed(piece)

    def _submit(self, submit: Submit) -> None:
        if submit.endpoint == 0:
            self._control(submit)
        elif submit.inward:
            self._waiting.append(submit)
        elif submit.endpoint == BULK_OUT:
            self._out(submit)
        else:
            self._end(submit, -errno.ENOENT)

    def _unlink(self, unlink: Unlink) -> None:
        left = [submit for submit in self._waiting if submit.number != unlink.victim]
        status = -errno.ECONNRESET if len(left) < len(self._waiting) else 0
        self._waiting = left
        self._held.discard(unlink.victim)
        self._link.write(encode_unlinked(unlink, status), _TIMEOUT_S)

    def _control(self, submit: Submit) -> None:
        try:
            data = self._device.control(Setup.decode(submit.setup), submit.data)
        except Stalled:
            self._end(submit, -errno.EPIPE)
        else:
            self._end(submit, 0, data if submit.inward else b"")

    def _out(self, submit: Submit) -> None:
        try:
            self._device.write(BULK_OUT, submit.data)
            if submit.flags & ZERO_PACKET and submit.data and len(submit.data) % PACKET == 0:
                self._device.write(BULK_OUT, b"")
        except Stalled:
            self._end(submit, -errno.EPIPE)
        else:
            self._end(submit, 0)

    def _serve_waiting(self) -> None:
        """End the transfers in for which the device has something, each pipe's in their order."""
        busy: set[int] = set()
        for submit in list(self._waiting):
            if submit.endpoint in busy or submit.number in self._held:
                continue
            if self._try_in(submit):
                self._waiting.remove(submit)
            else:
                busy.add(submit.endpoint)

    def _try_in(self, submit: Submit) -> bool:
        """Serve one transfer in; return whether it has ended."""
        address = submit.endpoint | 0x80
        if address not in self._device.pipes:
            self._end(submit, -errno.ENOENT)
            return True
        try:
            data = self._device.read(address, submit.length)
        except Stalled:
            self._end(submit, -errno.EPIPE)
        except Overflowed:
            self._end(submit, -errno.EOVERFLOW)
        else:
            if data is None:
                return False
            short = bool(submit.flags & SHORT_NOT_OK) and len(data) < submit.length
            if short:
                # They were parts of the same read: host controllers hold them until the client unlinks them.
                self._held |= {other.number for other in self._waiting if other.endpoint == submit.endpoint}
            self._end(submit, -_EREMOTEIO if short else 0, data)
        return True

    def _end(self, submit: Submit, status: int, data: bytes = b"") -> None:
        self._link.write(encode_result(submit, status, data), _TIMEOUT_S)
