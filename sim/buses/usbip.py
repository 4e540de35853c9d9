"""Simulated USB devices lent over a network: Linux attaches them as if they were plugged in, so do USB/IP libraries.

On Linux, as root: ``modprobe vhci-hcd``, then ``usbip attach -r 127.0.0.1 -b 1-1``.

Rules that hold inside:

- A device is lent to one client at a time, and only the thread of its connection uses it.
- A transfer in that finds nothing waits, in order, until the device has something to say or the client unlinks it;
  interrupt pipes are looked at 50 times a second.
- Where a transfer that must not be short is short, those queued behind it on its pipe are held, as host controllers
  hold them, until the client unlinks them: they were parts of the same read.

Source: the Linux kernel's documentation, usb/usbip_protocol; URB semantics, driver-api/usb/URB.
"""

from __future__ import annotations

import errno
import threading
from collections.abc import Sequence

from drivers.links.link import Link
from drivers.links.network import LOOPBACK, TcpServer
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError
from sim.buses.usb_device import BULK_IN, BULK_OUT, INTERRUPT_IN, PACKET, Overflowed, PtpUsbDevice, Setup, Stalled
from sim.buses.usbip_wire import (
    PORT,
    SHORT_NOT_OK,
    ZERO_PACKET,
    ImportRequest,
    Incoming,
    ListRequest,
    RequestReader,
    Submit,
    Unlink,
    encode_import,
    encode_list,
    encode_result,
    encode_unlinked,
)

_READ = 256 * 1024
"""Bytes read at once; large beside a request, so that a long transfer out takes few calls."""
_TICK_S = 0.02
"""Between two looks at transfers that wait for data: short beside the times a host waits."""
_PATIENCE_S = 10.0
"""For a host that is slow to read or write; an idle one is listened to again."""
_EREMOTEIO = 121
"""Linux's number for a transfer that was short although that was not allowed; not every system has it in errno."""


def serve_usbip(devices: Sequence[PtpUsbDevice], port: int = PORT, *, host: str = LOOPBACK) -> TcpServer:
    """Lend devices under the bus ids 1-1, 1-2, …; port 0 picks a free one.

    Use the result in a ``with`` block; its `address` is host and port.
    """
    return TcpServer(UsbIpService(devices).handle, port, host)


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
            while not (requests := reader.feed(link.read(_READ, _PATIENCE_S))):
                pass
            match requests[0]:
                case ListRequest():
                    link.write(encode_list(self._devices), _PATIENCE_S)
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
        link.write(encode_import(bus_id, device), _PATIENCE_S)
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
                piece = self._link.read(_READ, _TICK_S if self._waiting else _PATIENCE_S)
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
        self._link.write(encode_unlinked(unlink, status), _PATIENCE_S)

    def _control(self, submit: Submit) -> None:
        try:
            data = self._device.control(Setup.decode(submit.setup), submit.data)
        except Stalled:
            self._end(submit, -errno.EPIPE)
        else:
            self._end(submit, 0, data if submit.inward else b"")

    def _out(self, submit: Submit) -> None:
        try:
            self._device.bulk_out(submit.data)
            if submit.flags & ZERO_PACKET and submit.data and len(submit.data) % PACKET == 0:
                self._device.bulk_out(b"")
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
        pipes = {BULK_IN: self._device.bulk_in, INTERRUPT_IN: self._device.interrupt_in}
        read = pipes.get(submit.endpoint | 0x80)
        if read is None:
            self._end(submit, -errno.ENOENT)
            return True
        try:
            data = read(submit.length)
        except Stalled:
            self._end(submit, -errno.EPIPE)
        except Overflowed:
            self._end(submit, -errno.EOVERFLOW)
        else:
            if data is None:
                return False
            short = bool(submit.flags & SHORT_NOT_OK) and len(data) < submit.length
            if short:
                self._held |= {other.number for other in self._waiting if other.endpoint == submit.endpoint}
            self._end(submit, -_EREMOTEIO if short else 0, data)
        return True

    def _end(self, submit: Submit, status: int, data: bytes = b"") -> None:
        self._link.write(encode_result(submit, status, data), _PATIENCE_S)
