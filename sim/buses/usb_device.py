"""The device's side of a USB cable as a pure machine: descriptors, control requests, and PTP on the bulk pipes.

Rules that hold inside:

- Packets count, as on a wire: a transfer from the host has ended only with a packet that is not full, and one to the
  host is closed by a zero-length packet when it fills its last one.
- Nothing waits: a pipe without anything to say returns None, which on a bus is a NAK.
- A transfer that is no PTP halts the bulk pipes, until the host clears them.

`sim.buses.usb` puts it on a bus for pyusb, `sim.buses.usbip` on a network for USB/IP, `sim.buses.ptp_memory` on no
cable at all.

Sources: USB 2.0, clauses 8.5 (transactions), 9.4 (standard requests) and 9.6 (descriptors); USB Still Image Capture
Device Definition 1.0, clauses 5 to 7.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass, field

from drivers.links.link import STILL_IMAGE_CLASS
from drivers.ptp.codes import VENDOR_CANON_USB, ResponseCode
from drivers.ptp.transaction import PtpRequest
from drivers.ptp.usb import (
    HIGH_SPEED_PACKET,
    ContainerReader,
    ControlRequest,
    DataPiece,
    DataStart,
    DeviceStatus,
    Message,
    decode_cancel,
    encode,
    encode_data_header,
    ends_with_empty_packet,
)
from foundation.errors import ProtocolError
from sim.buses.responder import NoAnswer, Responder

PACKET = HIGH_SPEED_PACKET
INTERRUPT_PACKET = 8
"""wMaxPacketSize of the interrupt pipe: an EOS splits its events over packets of 8 bytes."""
BULK_IN = 0x81
"""Endpoint address of a real EOS; bit 7 is the direction, to the host (USB 2.0, 9.6.6)."""
BULK_OUT = 0x02
"""Endpoint address of a real EOS."""
INTERRUPT_IN = 0x83
"""Endpoint address of a real EOS; bit 7 as in `BULK_IN`."""

_BULK, _INTERRUPT = 2, 3
"""Transfer types in an endpoint's bmAttributes (USB 2.0, 9.6.6)."""
_DEVICE, _CONFIGURATION, _STRING = 1, 2, 3
"""Types of descriptors (USB 2.0, 9.4, table 9-5)."""
_LANGUAGE_ENGLISH = 0x0409
"""The one language of the string descriptors: LANGID of English, United States (USB 2.0, 9.6.7)."""


class Stalled(Exception):
    """The pipe is halted, or declines this request."""


class Overflowed(Exception):
    """The host asked for less than the packet that comes."""


@dataclass(frozen=True)
class UsbIdentity:
    """How a device identifies itself before PTP begins; the default is an EOS 550D's. `serial` None: it has none."""

    vendor: int = VENDOR_CANON_USB
    product: int = 0x31EA
    serial: str | None = "0123456789"
    manufacturer: str = "Canon Inc."
    name: str = "Canon Digital Camera"


@dataclass(frozen=True)
class Setup:
    """The eight bytes that open a control transfer (USB 2.0, 9.3)."""

    request_type: int
    request: int
    value: int
    index: int
    length: int

    @classmethod
    def decode(cls, data: bytes) -> Setup:
        """Return the request in eight bytes."""
        return cls(*struct.unpack("<BBHHH", data))


@dataclass
class _Exchange:
    """What a device remembers of its pipes, until the host or a pulled cable makes it start over.

    - `reader`: cuts what the host sends into containers.
    - `request`, `payload`: the operation whose data phase comes in, and as much of it as has come.
    - `complete`: an operation that is whole but for the end of its transfer, with its data phase.
    - `outgoing`, `events`: transfers to the host on the bulk and on the interrupt pipe.
    """

    reader: ContainerReader = field(default_factory=lambda: ContainerReader(PACKET))
    request: PtpRequest | None = None
    payload: bytearray = field(default_factory=bytearray)
    complete: tuple[PtpRequest, bytes | None] | None = None
    outgoing: deque[memoryview] = field(default_factory=deque[memoryview])
    events: deque[memoryview] = field(default_factory=deque[memoryview])


class PtpUsbDevice:
    """A still image device of one configuration and one interface, at high speed."""

    def __init__(self, responder: Responder, identity: UsbIdentity | None = None) -> None:
        self.identity = identity or UsbIdentity()
        self._responder = responder
        self._halted: set[int] = set()
        self._configuration = 1
        self._exchange = _Exchange()

    def device_descriptor(self) -> bytes:
        """Return the 18 bytes that name the device."""
        identity = self.identity
        serial = 0 if identity.serial is None else 3
        numbers = (0x0200, 0, 0, 0, 64, identity.vendor, identity.product, 0x0002, 1, 2, serial, 1)
        return struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, *numbers)

    def configuration_descriptor(self) -> bytes:
        """Return the descriptors of the configuration, its interface and the three endpoints."""
        interface = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 3, *STILL_IMAGE_CLASS, 0)
        endpoints = (
            struct.pack("<BBBBHB", 7, 5, BULK_IN, _BULK, PACKET, 0),
            struct.pack("<BBBBHB", 7, 5, BULK_OUT, _BULK, PACKET, 0),
            struct.pack("<BBBBHB", 7, 5, INTERRUPT_IN, _INTERRUPT, INTERRUPT_PACKET, 6),
        )
        body = interface + b"".join(endpoints)
        return struct.pack("<BBHBBBBB", 9, _CONFIGURATION, 9 + len(body), 1, 1, 0, 0xC0, 1) + body

    def control(self, setup: Setup, data: bytes = b"") -> bytes:
        """Carry out a control request and return its data, if it goes to the host."""
        match setup.request_type & 0x60, setup.request_type & 0x1F:
            case 0x00, recipient:
                answer = self._standard(setup, recipient)
            case 0x20, 1:
                answer = self._class(setup, data)
            case _:
                raise Stalled
        return answer[: setup.length]

    def bulk_out(self, data: bytes) -> None:
        """Take packets from the host: `data` in full packets, the last perhaps short or, for b"", empty."""
        if BULK_OUT in self._halted:
            raise Stalled
        exchange = self._exchange
        try:
            for message in exchange.reader.feed(data):
                self._take(message)
        except ProtocolError as error:
            self._halted |= {BULK_OUT, BULK_IN}
            raise Stalled from error
        unfinished = bool(data) and len(data) % PACKET == 0
        if exchange.complete is not None and not unfinished:
            request, payload = exchange.complete
            exchange.complete = None
            self._answer(request, payload)

    def bulk_in(self, limit: int) -> bytes | None:
        """Return up to `limit` bytes of a transfer to the host, None where there is nothing yet."""
        return self._packets(BULK_IN, self._exchange.outgoing, PACKET, limit)

    def interrupt_in(self, limit: int) -> bytes | None:
        """Return up to `limit` bytes of events, None where there are none."""
        for event in self._responder.events():
            self._exchange.events.append(memoryview(encode(event)))
        return self._packets(INTERRUPT_IN, self._exchange.events, INTERRUPT_PACKET, limit)

    def halt(self, endpoint: int) -> None:
        """Stall a pipe until the host clears it."""
        self._halted.add(endpoint)

    def unplugged(self) -> None:
        """Forget everything: the cable was pulled, or the bus was reset."""
        self._exchange = _Exchange()
        self._halted.clear()
        self._responder.unplugged()

    def _take(self, message: Message) -> None:
        exchange = self._exchange
        match message:
            case PtpRequest() if self._responder.takes_data(message):
                exchange.request = message
                exchange.payload.clear()
            case PtpRequest():
                exchange.complete = (message, None)
            case DataStart() if exchange.request is not None:
                pass
            case DataPiece(piece, last) if exchange.request is not None:
                exchange.payload += piece
                if last:
                    exchange.complete = (exchange.request, bytes(exchange.payload))
                    exchange.request = None
            case _:
                raise ProtocolError(f"{type(message).__name__} was not due")

    def _answer(self, request: PtpRequest, payload: bytes | None) -> None:
        try:
            answer = self._responder.answer(request, payload)
        except NoAnswer:
            return
        if answer.data is not None:
            header = encode_data_header(request.code, request.transaction, len(answer.data))
            self._send(header + answer.data)
        self._send(encode(answer.response))

    def _send(self, transfer: bytes) -> None:
        self._exchange.outgoing.append(memoryview(transfer))
        if ends_with_empty_packet(len(transfer), PACKET):
            self._exchange.outgoing.append(memoryview(b""))

    def _packets(self, endpoint: int, queue: deque[memoryview], packet: int, limit: int) -> bytes | None:
        """Return what one transfer of the host takes from `queue`: until a packet that is not full, or `limit`."""
        if endpoint in self._halted:
            raise Stalled
        if not queue:
            return None
        taken: list[memoryview] = []
        room = limit
        while queue:
            rest = queue.popleft()
            if len(rest) <= room:
                taken.append(rest)
                room -= len(rest)
                if not rest or len(rest) % packet:
                    break
            else:
                if room % packet:
                    queue.appendleft(rest)
                    raise Overflowed
                taken.append(rest[:room])
                queue.appendleft(rest[room:])
                break
        return b"".join(taken)

    def _standard(self, setup: Setup, recipient: int) -> bytes:
        match setup.request, setup.value >> 8:
            case 6, 1:
                return self.device_descriptor()
            case 6, 2:
                return self.configuration_descriptor()
            case 6, 3:
                return self._string(setup.value & 0xFF)
            case 8, _:
                return bytes([self._configuration])
            case 9, _:
                self._configuration = setup.value & 0xFF
                return b""
            case 10, _:
                return b"\0"
            case 11, _:
                return b""
            case 0, _:
                return bytes([recipient == 2 and setup.index in self._halted, 0])
            case 1, _ if recipient == 2:
                self._halted.discard(setup.index)
                return b""
            case 3, _ if recipient == 2:
                self._halted.add(setup.index)
                return b""
            case _:
                raise Stalled

    def _string(self, index: int) -> bytes:
        identity = self.identity
        texts = (identity.manufacturer, identity.name, identity.serial)
        if index == 0:
            body = struct.pack("<H", _LANGUAGE_ENGLISH)
        elif index <= len(texts) and (text := texts[index - 1]) is not None:
            body = text.encode("utf-16-le")
        else:
            raise Stalled
        return bytes([2 + len(body), _STRING]) + body

    def _class(self, setup: Setup, data: bytes) -> bytes:
        match setup.request:
            case ControlRequest.CANCEL:
                try:
                    transaction = decode_cancel(data)
                except ProtocolError as error:
                    raise Stalled from error
                self._exchange = _Exchange()
                self._responder.cancelled(transaction)
                return b""
            case ControlRequest.RESET_DEVICE:
                self.unplugged()
                return b""
            case ControlRequest.GET_DEVICE_STATUS:
                halted = tuple(sorted(self._halted))
                code = ResponseCode.TRANSACTION_CANCELLED if halted else ResponseCode.OK
                return DeviceStatus(code, halted).encode()
            case _:
                raise Stalled
