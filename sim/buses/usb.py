"""Simulated USB: a still-image device, and a bus that pyusb uses like a real one.

A transfer consists of packets and ends with a packet that is not full. If its last packet is full, an empty packet
follows. Calls never wait: if a pipe has no data (NAK), a read times out at once. If the host sends data that are not
PTP, the bulk pipes are halted until the host clears them.

Sources: `usb.backend` of pyusb; error codes of libusb 1.0; USB 2.0, clauses 8.5 (transactions), 9.4 (standard requests)
and 9.6 (descriptors); USB Still Image Capture Device Definition 1.0, clauses 5 to 7.
"""

from __future__ import annotations

import errno
import struct
from array import array
from collections import deque
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Final

import usb.core
from usb.backend import IBackend

from drivers.links.usb import STILL_IMAGE_CLASS, open_usb
from drivers.ptp.codes import VENDOR_CANON_USB, ResponseCode
from drivers.ptp.protocol import NoAnswer, PtpRequest, Responder
from drivers.ptp.usb import (
    HIGH_SPEED_PACKET,
    ContainerReader,
    ControlRequest,
    DataPiece,
    DataStart,
    DeviceStatus,
    Message,
    UsbTransport,
    decode_cancel,
    encode,
    encode_data_header,
    ends_with_empty_packet,
)
from foundation.clock import SimulatedClock
from foundation.errors import ProtocolError

PACKET = HIGH_SPEED_PACKET
INTERRUPT_PACKET = 8  # wMaxPacketSize of the interrupt pipe, bytes, as of an EOS.

# Endpoint addresses of an EOS. Bit 7 marks the direction to the host (USB 2.0, 9.6.6).
BULK_IN = 0x81
BULK_OUT = 0x02
INTERRUPT_IN = 0x83

_BULK, _INTERRUPT = 2, 3  # Transfer types in bmAttributes of an endpoint (USB 2.0, 9.6.6).
# Types of descriptors (USB 2.0, 9.4, table 9-5).
_DEVICE, _CONFIGURATION, _STRING, _INTERFACE, _ENDPOINT = 1, 2, 3, 4, 5
_LANGUAGE_ENGLISH = 0x0409  # Language of the string descriptors: LANGID of English, United States (USB 2.0, 9.6.7).


class Stalled(Exception):
    """The device answers with STALL: the pipe is halted, or the request is refused."""


class Overflowed(Exception):
    """The packet is larger than the buffer of the host."""


@dataclass(frozen=True)
class UsbIdentity:
    """Identification of a device, by default of an EOS 550D; `serial` is None without a serial number."""

    vendor: int = VENDOR_CANON_USB
    product: int = 0x31EA
    serial: str | None = "0123456789"
    manufacturer: str = "Canon Inc."
    name: str = "Canon Digital Camera"
    version: int = 0x0200  # bcdUSB: 2.00 or higher for high speed


@dataclass(frozen=True)
class Setup:
    """The eight bytes at the start of a control transfer (USB 2.0, 9.3)."""

    request_type: int
    request: int
    value: int
    index: int
    length: int

    @classmethod
    def decode(cls, data: bytes) -> Setup:
        """Decode eight bytes."""
        return cls(*struct.unpack("<BBHHH", data))


@dataclass
class _Exchange:
    """State of the pipes, which a disconnection or the host resets."""

    # Splits the bytes of the host into containers
    reader: ContainerReader = field(default_factory=lambda: ContainerReader(PACKET))
    request: PtpRequest | None = None  # Operation whose data phase is being received
    payload: bytearray = field(default_factory=bytearray)  # Data of this operation received so far
    # Complete operation and its data, which is answered at the end of the transfer
    complete: tuple[PtpRequest, bytes | None] | None = None
    outgoing: deque[memoryview] = field(default_factory=deque[memoryview])  # Transfers to the host on the bulk pipe
    events: deque[memoryview] = field(default_factory=deque[memoryview])  # Transfers to the host on the interrupt pipe


def endpoint_descriptor(address: int, transfer_type: int, packet: int, interval: int = 0) -> bytes:
    """Return the 7-byte descriptor of an endpoint; `transfer_type` is 2 for bulk, 3 for interrupt."""
    return struct.pack("<BBBBHB", 7, _ENDPOINT, address, transfer_type, packet, interval)


class PtpUsbDevice:
    """Still-image device at high speed: descriptors, standard requests, pipes."""

    pipes: Final = frozenset({BULK_IN, BULK_OUT, INTERRUPT_IN})  # Endpoint addresses

    def __init__(self, responder: Responder, identity: UsbIdentity | None = None) -> None:
        self.identity = identity or UsbIdentity()
        self._responder = responder
        self._exchange = _Exchange()
        self._halted: set[int] = set()
        self._configuration = 1

    def device_descriptor(self) -> bytes:
        """Return the 18-byte device descriptor."""
        identity = self.identity
        serial = 0 if identity.serial is None else 3
        numbers = (identity.version, 0, 0, 0, 64, identity.vendor, identity.product, 0x0002, 1, 2, serial, 1)
        return struct.pack("<BBHBBBBHHHBBBB", 18, _DEVICE, *numbers)

    def configuration_descriptor(self) -> bytes:
        """Return the descriptors of the configuration, its interface and its endpoints."""
        body = self._interface_descriptors()
        return struct.pack("<BBHBBBBB", 9, _CONFIGURATION, 9 + len(body), 1, 1, 0, 0xC0, 1) + body

    def control(self, setup: Setup, data: bytes = b"") -> bytes:
        """Process a control request; return the data for the host."""
        match setup.request_type & 0x60, setup.request_type & 0x1F:
            case 0x00, recipient:
                answer = self._standard(setup, recipient)
            case 0x20, 1:
                answer = self._class_request(setup, data)
            case _:
                raise Stalled
        return answer[: setup.length]

    def halt(self, endpoint: int) -> None:
        """Halt a pipe until the host clears it."""
        self._halted.add(endpoint)

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

    def _interface_descriptors(self) -> bytes:
        interface = struct.pack("<BBBBBBBBB", 9, _INTERFACE, 0, 0, 3, *STILL_IMAGE_CLASS, 0)
        bulk = endpoint_descriptor(BULK_IN, _BULK, PACKET) + endpoint_descriptor(BULK_OUT, _BULK, PACKET)
        return interface + bulk + endpoint_descriptor(INTERRUPT_IN, _INTERRUPT, INTERRUPT_PACKET, 6)

    def write(self, endpoint: int, data: bytes) -> None:
        """Receive packets, of which only the last may be short; b"" is an empty packet."""
        if BULK_OUT in self._halted:
            raise Stalled
        exchange = self._exchange
        try:
            for message in exchange.reader.feed(data):
                self._handle_message(message)
        except ProtocolError as error:
            self._halted |= {BULK_OUT, BULK_IN}
            raise Stalled from error
        unfinished = bool(data) and len(data) % PACKET == 0
        if exchange.complete is not None and not unfinished:
            request, payload = exchange.complete
            exchange.complete = None
            self._answer(request, payload)

    def read(self, endpoint: int, limit: int) -> bytes | None:
        """Return up to `limit` bytes of a transfer to the host, None if there are no data."""
        if endpoint == BULK_IN:
            return self._packets(BULK_IN, self._exchange.outgoing, PACKET, limit)
        for event in self._responder.events():
            self._exchange.events.append(memoryview(encode(event)))
        return self._packets(INTERRUPT_IN, self._exchange.events, INTERRUPT_PACKET, limit)

    def unplugged(self) -> None:
        """Reset all state after a disconnection or a bus reset."""
        self._exchange = _Exchange()
        self._halted.clear()
        self._responder.unplugged()

    def _handle_message(self, message: Message) -> None:
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
                raise ProtocolError(f"unexpected {type(message).__name__}")

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
        # A read by the host ends with a packet that is not full, or after `limit` bytes.
        if endpoint in self._halted:
            raise Stalled
        if not queue:
            return None
        packets: list[memoryview] = []
        space = limit
        while queue:
            transfer = queue.popleft()
            if len(transfer) <= space:
                packets.append(transfer)
                space -= len(transfer)
                if not transfer or len(transfer) % packet:
                    break
            else:
                if space % packet:
                    queue.appendleft(transfer)
                    raise Overflowed
                packets.append(transfer[:space])
                queue.appendleft(transfer[space:])
                break
        return b"".join(packets)

    def _class_request(self, setup: Setup, data: bytes) -> bytes:
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


_ERRORS = {
    errno.EIO: (-1, "Input/Output Error"),
    errno.EACCES: (-3, "Access denied (insufficient permissions)"),
    errno.ENODEV: (-4, "No such device (it may have been disconnected)"),
    errno.ENOENT: (-5, "Entity not found"),
    errno.EBUSY: (-6, "Resource busy"),
    errno.ETIMEDOUT: (-7, "Operation timed out"),
    errno.EOVERFLOW: (-8, "Overflow"),
    errno.EPIPE: (-9, "Pipe error"),
}
_HIGH_SPEED = 3  # LIBUSB_SPEED_HIGH, 480 Mbit/s, as in real bodies.

# Fields of each descriptor type after length and type (USB 2.0, 9.6). Fields with the prefix w, id or bcd have two
# bytes, other fields one byte.
_FIELDS = {
    _DEVICE: "bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 idVendor idProduct bcdDevice "
    "iManufacturer iProduct iSerialNumber bNumConfigurations",
    _CONFIGURATION: "wTotalLength bNumInterfaces bConfigurationValue iConfiguration bmAttributes bMaxPower",
    _INTERFACE: "bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass bInterfaceSubClass "
    "bInterfaceProtocol iInterface",
    _ENDPOINT: "bEndpointAddress bmAttributes wMaxPacketSize bInterval",
}


@dataclass(frozen=True)
class Attachment:
    """Port and address of a plugged-in device; the address changes when it is plugged in again."""

    device: PtpUsbDevice
    port: int
    address: int


class Handle:
    """An opened device; only the handle that claimed the interface may use the pipes."""

    def __init__(self, attachment: Attachment) -> None:
        self.attachment = attachment
        self.device = attachment.device


class SimulatedBus(IBackend):
    """USB bus (a backend of pyusb) with devices that can be plugged in and unplugged."""

    def __init__(self, *devices: PtpUsbDevice) -> None:
        self._attachments: list[Attachment] = []
        self._last_address = 1
        self._claims: dict[Attachment, Handle] = {}
        self._held: set[PtpUsbDevice] = set()
        self._locked: set[PtpUsbDevice] = set()
        self._kernel: set[PtpUsbDevice] = set()
        for port, device in enumerate(devices, 1):
            self.plug(device, port)

    def plug(self, device: PtpUsbDevice, port: int = 1) -> None:
        """Plug a device in."""
        self._last_address += 1
        self._attachments.append(Attachment(device, port, self._last_address))

    def unplug(self, device: PtpUsbDevice) -> None:
        """Unplug a device; do nothing if it is not plugged in."""
        for attachment in [attachment for attachment in self._attachments if attachment.device is device]:
            self._attachments.remove(attachment)
            self._claims.pop(attachment, None)
            device.unplugged()

    def replug(self, device: PtpUsbDevice) -> None:
        """Unplug a device and plug it in at the same port, as if it had been restarted."""
        port = next((attachment.port for attachment in self._attachments if attachment.device is device), 1)
        self.unplug(device)
        self.plug(device, port)

    def hold(self, device: PtpUsbDevice, is_held: bool = True) -> None:
        """Let another program claim or release the interface of the device."""
        (self._held.add if is_held else self._held.discard)(device)

    def lock(self, device: PtpUsbDevice, is_locked: bool = True) -> None:
        """Remove or restore the permission to open the device."""
        (self._locked.add if is_locked else self._locked.discard)(device)

    def bind_kernel_driver(self, device: PtpUsbDevice) -> None:
        """Let a kernel driver use the interface."""
        self._kernel.add(device)

    def has_kernel_driver(self, device: PtpUsbDevice) -> bool:
        """Return whether a kernel driver uses the interface."""
        return device in self._kernel

    def is_claimed(self, device: PtpUsbDevice) -> bool:
        """Return whether the interface is claimed on this bus."""
        return any(attachment.device is device for attachment in self._claims)

    # Methods of usb.backend.IBackend, called by pyusb.

    def enumerate_devices(self) -> list[Attachment]:
        """Return the plugged-in devices."""
        return list(self._attachments)

    def get_parent(self, dev: Attachment) -> None:
        """Return None, because all ports belong to the root hub."""

    def get_device_descriptor(self, dev: Attachment) -> SimpleNamespace:
        """Return the device descriptor with bus, address and port."""
        descriptor = _descriptor(dev.device.device_descriptor(), _DEVICE)
        descriptor.bus, descriptor.address, descriptor.speed = 1, dev.address, _HIGH_SPEED
        descriptor.port_number, descriptor.port_numbers = dev.port, (dev.port,)
        return descriptor

    def get_configuration_descriptor(self, dev: Attachment, config: int) -> SimpleNamespace:
        """Return the descriptor of the only configuration."""
        return _descriptor(dev.device.configuration_descriptor(), _CONFIGURATION, config)

    def get_interface_descriptor(self, dev: Attachment, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return the descriptor of the only interface."""
        return _descriptor(dev.device.configuration_descriptor(), _INTERFACE, intf + alt + config)

    def get_endpoint_descriptor(self, dev: Attachment, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return the descriptor of an endpoint."""
        descriptor = _descriptor(dev.device.configuration_descriptor(), _ENDPOINT, ep)
        descriptor.bRefresh = descriptor.bSynchAddress = 0
        return descriptor

    def open_device(self, dev: Attachment) -> Handle:
        """Open a device."""
        handle = Handle(dev)
        self._check(handle)
        if dev.device in self._locked:
            raise _error(errno.EACCES)
        return handle

    def close_device(self, dev_handle: Handle) -> None:
        """Close a device and release its interface."""
        if self._claims.get(dev_handle.attachment) is dev_handle:
            del self._claims[dev_handle.attachment]

    def set_configuration(self, dev_handle: Handle, config_value: int) -> None:
        """Select the configuration."""
        self._control(dev_handle, Setup(0x00, 9, config_value, 0, 0))

    def get_configuration(self, dev_handle: Handle) -> int:
        """Return the selected configuration."""
        return self._control(dev_handle, Setup(0x80, 8, 0, 0, 1))[0]

    def set_interface_altsetting(self, dev_handle: Handle, intf: int, altsetting: int) -> None:
        """Select the alternate setting of the interface."""
        self._control(dev_handle, Setup(0x01, 11, altsetting, intf, 0))

    def claim_interface(self, dev_handle: Handle, intf: int) -> None:
        """Claim the interface for this program."""
        self._check(dev_handle)
        if intf:
            raise _error(errno.ENOENT)
        if dev_handle.device in self._held | self._kernel or dev_handle.attachment in self._claims:
            raise _error(errno.EBUSY)
        self._claims[dev_handle.attachment] = dev_handle

    def release_interface(self, dev_handle: Handle, intf: int) -> None:
        """Release the interface."""
        self._check(dev_handle)
        if self._claims.get(dev_handle.attachment) is dev_handle:
            del self._claims[dev_handle.attachment]

    def bulk_write(self, dev_handle: Handle, ep: int, intf: int, data: array[int], timeout: int) -> int:
        """Write to a pipe."""
        self._check_transfer(dev_handle, ep)
        try:
            dev_handle.device.write(ep, data.tobytes())
        except Stalled as error:
            raise _error(errno.EPIPE) from error
        self._check(dev_handle)
        return len(data)

    def bulk_read(self, dev_handle: Handle, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        """Read from a pipe."""
        self._check_transfer(dev_handle, ep)
        try:
            data = dev_handle.device.read(ep, len(buff))
        except Stalled as error:
            raise _error(errno.EPIPE) from error
        except Overflowed as error:
            raise _error(errno.EOVERFLOW) from error
        if data is None:
            raise _error(errno.ETIMEDOUT)
        memoryview(buff)[: len(data)] = data
        return len(data)

    intr_write, intr_read = bulk_write, bulk_read

    def ctrl_transfer(
        self,
        dev_handle: Handle,
        bmRequestType: int,  # noqa: N803 – pyusb's own names
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: array[int],
        timeout: int,
    ) -> int:
        """Process a control request."""
        setup = Setup(bmRequestType, bRequest, wValue, wIndex, len(data))
        if bmRequestType & 0x80:
            answer = self._control(dev_handle, setup)
            data[: len(answer)] = array("B", answer)
            return len(answer)
        self._control(dev_handle, setup, data.tobytes())
        return len(data)

    def clear_halt(self, dev_handle: Handle, ep: int) -> None:
        """Clear a halted pipe."""
        self._control(dev_handle, Setup(0x02, 1, 0, ep, 0))

    def reset_device(self, dev_handle: Handle) -> None:
        """Reset the device; it keeps its address."""
        self._check(dev_handle)
        dev_handle.device.unplugged()

    def is_kernel_driver_active(self, dev_handle: Handle, intf: int) -> bool:
        """Return whether a kernel driver uses the interface."""
        self._check(dev_handle)
        return dev_handle.device in self._kernel

    def detach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Detach the kernel driver from the interface."""
        self._check(dev_handle)
        self._kernel.discard(dev_handle.device)

    def attach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Attach the kernel driver to the interface."""
        self._check(dev_handle)
        self._kernel.add(dev_handle.device)

    def _check(self, handle: Handle) -> None:
        if handle.attachment not in self._attachments:
            raise _error(errno.ENODEV)

    def _check_transfer(self, handle: Handle, endpoint: int) -> None:
        self._check(handle)
        if endpoint not in handle.device.pipes:
            raise _error(errno.ENOENT)
        if self._claims.get(handle.attachment) is not handle:
            raise _error(errno.EIO)

    def _control(self, handle: Handle, setup: Setup, data: bytes = b"") -> bytes:
        self._check(handle)
        try:
            return handle.device.control(setup, data)
        except Stalled as error:
            raise _error(errno.EPIPE) from error


def _error(number: int) -> usb.core.USBError:
    code, text = _ERRORS[number]
    error_class = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    return error_class(text, code, number)


def _descriptor(descriptors: bytes, code: int, index: int = 0) -> SimpleNamespace:
    """Return the fields of the descriptor number `index` of type `code`."""
    names = _FIELDS[code].split()
    layout = "<" + "".join("H" if name.startswith(("w", "id", "bcd")) else "B" for name in names)
    at = 0
    while at < len(descriptors):
        if descriptors[at + 1] == code:
            if not index:
                fields = struct.unpack_from(layout, descriptors, at + 2)
                values = dict(zip(names, fields, strict=True))
                return SimpleNamespace(bLength=descriptors[at], bDescriptorType=code, **values, extra_descriptors=[])
            index -= 1
        at += descriptors[at]
    raise IndexError(f"there is no descriptor {index} of type {code}")


class MemoryTransport(UsbTransport):
    """Transport (`drivers.ptp.protocol.Transport`) to a responder on its own simulated bus; calls never wait."""

    def __init__(self, responder: Responder) -> None:
        self._device = PtpUsbDevice(responder, UsbIdentity(name="the simulated Canon Digital Camera"))
        self._bus = SimulatedBus(self._device)
        super().__init__(open_usb(backend=self._bus), SimulatedClock())

    def pull(self) -> None:
        """Disconnect the cable."""
        self._bus.unplug(self._device)
