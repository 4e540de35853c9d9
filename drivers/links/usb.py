"""Data pipes of USB still image devices (cameras).

A device is selected by its vendor, serial number and port. Its address is not used, because it changes when the device
restarts. The driver of the system's kernel is detached while the device is open, and attached again at the end.

Sources: USB 2.0, clauses 5.8 (bulk), 5.7 (interrupt), 9.4 (SetConfiguration) and 9.6 (descriptors); error codes of
libusb 1.0.
"""

from __future__ import annotations

import contextlib
import errno
import math
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Protocol

import usb.core
import usb.util

from foundation.errors import DeviceRefused, InputError, LinkClosed, LinkError, LinkTimeout, ProtocolError

if TYPE_CHECKING:
    from usb.backend import IBackend


# Class, subclass and protocol of a still image interface (USB Still Image Capture Device Definition 1.0, clause 4).
STILL_IMAGE_CLASS: Final = (6, 1, 1)


class PipeStalled(LinkError):
    """A pipe is halted: it refuses all transfers until the halt is cleared."""


class Pipe(Enum):
    """Pipes of a still image device, without the control pipe."""

    BULK_OUT = "bulk out"
    BULK_IN = "bulk in"
    INTERRUPT_IN = "interrupt in"


class UsbPipes(Protocol):
    """Interface of an open device with its pipes.

    All methods raise `LinkClosed` if the device is disconnected. Transfers raise `PipeStalled` if the pipe is halted.
    All methods except `interrupt_read` raise `LinkTimeout` after their time limit.
    """

    @property
    def label(self) -> str:
        """Name of the device in messages."""

    @property
    def packet_size(self) -> int:
        """Size of a full packet on the bulk pipes (wMaxPacketSize), bytes."""

    @property
    def polling_s(self) -> float:
        """Polling interval of the interrupt pipe, seconds; a shorter wait may miss all events."""

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Send all of `data`; b"" is sent as a zero-length packet."""

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return the data of one transfer, up to `limit` bytes; b"" for a zero-length packet.

        A transfer ends with a short packet or at `limit`, which must be a multiple of `packet_size`.
        """

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe; b"" if none arrives in time."""

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a class request on the control pipe."""

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the reply to a class request, up to `limit` bytes."""

    def clear_halt(self, pipe: Pipe) -> None:
        """Clear the halt of a stalled pipe."""

    def reset_port(self) -> None:
        """Reset the device, as if it had been unplugged and plugged in again."""

    def close(self) -> None:
        """Release the interface; a second call does nothing."""


# File in `drivers/data` that allows users of a Linux machine to open cameras.
UDEV_RULE = "70-crop-cameras.rules"
_PERMISSION_REMEDY = (
    f"may not be opened by this user; on Linux install the rule {UDEV_RULE} (docs/devices.md, USB permission), and "
    "plug the camera in again"
)
_BUSY_REMEDY = (
    ", such as the photo monitor of the desktop; close photo programs, and on Linux run: "
    "systemctl --user stop gvfs-gphoto2-volume-monitor.service (on macOS: killall ptpcamerad)"
)

_CLASS_OUT: Final = 0x21  # bmRequestType: class request to the interface (USB 2.0, 9.3)
_CLASS_IN: Final = 0xA1  # bmRequestType: class request from the interface

_BULK: Final = 2  # Transfer type in an endpoint's bmAttributes (USB 2.0, 9.6.6)
_INTERRUPT: Final = 3  # Transfer type, as above

# Upper limit of the polling interval, seconds, because a wrong descriptor must not delay events.
_MAX_POLLING_S: Final = 0.05


@dataclass(frozen=True)
class UsbDevice:
    """A still image device on the bus.

    - `serial`: serial number; None if there is none, or if it cannot be read.
    - `port`: bus and ports from the computer to the device, such as ``1-2.4``. Unlike `address`, it does not change
      when the device restarts.
    """

    vendor: int
    product: int
    serial: str | None
    name: str
    port: str
    address: int

    def __str__(self) -> str:
        number = f", serial number {self.serial}" if self.serial else ""
        return f"{self.name or 'camera'} ({self.vendor:04x}:{self.product:04x}{number}) at USB port {self.port}"


def list_devices(*, backend: IBackend | None = None) -> tuple[UsbDevice, ...]:
    """Return the still image devices on the bus; `backend` replaces the bus of this machine."""
    return tuple(description for _, description, _ in _still_image_devices(backend))


def open_usb(
    *,
    vendor: int | None = None,
    serial: str | None = None,
    port: str | None = None,
    backend: IBackend | None = None,
) -> OpenUsbDevice:
    """Open the still image device that has all given properties, and claim its interface."""
    matching: list[tuple[usb.core.Device, UsbDevice]] = []
    other_devices: list[UsbDevice] = []
    read_error: DeviceRefused | None = None
    for device, description, refusal in _still_image_devices(backend):
        properties = ((vendor, description.vendor), (port, description.port))
        is_match = all(expected is None or expected == actual for expected, actual in properties)
        if is_match and (serial is None or serial == description.serial):
            matching.append((device, description))
        else:
            other_devices.append(description)
            if is_match and refusal is not None:
                read_error = refusal
    if not matching:
        if read_error is not None:
            raise read_error
        fault = _no_camera_message(vendor, serial, port, other_devices)
        raise LinkClosed(fault, remedy="switch the camera on, check cable and sleep timer")
    if len(matching) > 1:
        choice = "; ".join(str(description) for _, description in matching)
        fault = f"{len(matching)} cameras on USB match, expected 1: {choice}"
        raise InputError(fault, remedy="set a serial number or port")
    return OpenUsbDevice(*matching[0])


class OpenUsbDevice:
    """The claimed interface of a device; `close` releases it."""

    def __init__(self, device: usb.core.Device, description: UsbDevice) -> None:
        self._device = device
        self._label = str(description)
        self._detached: int | None = None
        self._closed = False
        try:
            self._interface = self._claim_still_image()
        except BaseException:
            self.close()
            raise

    @property
    def label(self) -> str:
        """Name and numbers of the device."""
        return self._label

    def close(self) -> None:
        """Release the device and attach the kernel's driver again; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        # If the device was unplugged, these calls fail, but then there is nothing to release.
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            if self._detached is not None:
                usb.util.release_interface(self._device, self._detached)
                self._device.attach_kernel_driver(self._detached)
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(self._device)

    @property
    def packet_size(self) -> int:
        """Size of a full packet on the bulk pipes, bytes."""
        return self._interface.packet_size

    @property
    def polling_s(self) -> float:
        """Polling interval of the interrupt pipe, seconds."""
        return self._interface.polling_s

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Send all of `data`; b"" is sent as a zero-length packet."""
        with self._transfer(f"accepted no data for {timeout:g} s"):
            sent = self._device.write(self._interface.addresses[Pipe.BULK_OUT], data, _milliseconds(timeout))
        if sent != len(data):
            raise LinkTimeout(f"{self._label} accepted {sent} of {len(data)} bytes within {timeout:g} s; reset it")

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return the data of one transfer, up to `limit` bytes."""
        with self._transfer(f"sent nothing for {timeout:g} s"):
            return self._device.read(self._interface.addresses[Pipe.BULK_IN], limit, _milliseconds(timeout)).tobytes()

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe; b"" if none arrives in time."""
        with self._transfer(f"sent no event for {timeout:g} s"):
            address = self._interface.addresses[Pipe.INTERRUPT_IN]
            try:
                return self._device.read(address, self._interface.interrupt_size, _milliseconds(timeout)).tobytes()
            except usb.core.USBError as error:
                if isinstance(error, usb.core.USBTimeoutError) or error.errno == errno.ETIMEDOUT:
                    return b""
                raise

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a class request on the control pipe."""
        with self._transfer(f"accepted no control request for {timeout:g} s"):
            number = self._interface.number
            self._device.ctrl_transfer(_CLASS_OUT, request, 0, number, data, _milliseconds(timeout))

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the reply to a class request."""
        with self._transfer(f"sent no reply to a control request for {timeout:g} s"):
            number = self._interface.number
            answer = self._device.ctrl_transfer(_CLASS_IN, request, 0, number, limit, _milliseconds(timeout))
        return bytes(answer)

    def clear_halt(self, pipe: Pipe) -> None:
        """Clear the halt of a stalled pipe."""
        with self._transfer("did not clear a stalled pipe"):
            self._device.clear_halt(self._interface.addresses[pipe])

    def reset_port(self) -> None:
        """Reset the device, and claim it again."""
        with self._transfer("did not reconnect after a reset"):
            self._device.reset()
        self._interface = self._claim_still_image()

    def _claim_still_image(self) -> _StillImageInterface:
        with self._transfer("does not reply"):
            interface = next(candidate for candidate in self._configuration() if _is_still_image(candidate))
            pipes = _read_descriptors(interface, self._label)
            self._claim_interface(pipes.number)
        return pipes

    def _configuration(self) -> usb.core.Configuration:
        try:
            return self._device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno is not None:
                raise
            # No configuration is active, because some systems let the program choose one.
            self._device.set_configuration()
            return self._device.get_active_configuration()

    def _claim_interface(self, interface: int) -> None:
        with contextlib.suppress(NotImplementedError):
            if self._device.is_kernel_driver_active(interface):
                self._device.detach_kernel_driver(interface)
                self._detached = interface
        usb.util.claim_interface(self._device, interface)

    @contextlib.contextmanager
    def _transfer(self, timeout_meaning: str) -> Generator[None]:
        """Convert errors of pyusb to ours; `timeout_meaning` describes a timeout in the message."""
        label = self._label
        if self._closed:
            raise LinkClosed(f"{label} was closed; open it again")
        try:
            yield
        except usb.core.USBTimeoutError as error:
            raise LinkTimeout(f"{label} {timeout_meaning}; reset it, or switch it off and on") from error
        except usb.core.USBError as error:
            reason = error.strerror or str(error)
            match error.errno:
                case errno.ETIMEDOUT:
                    fault = LinkTimeout(f"{label} does not reply ({reason}); reset it, or switch it off and on")
                case errno.EPIPE:
                    fault = PipeStalled(f"{label} halted the pipe; clear the halt")
                case errno.EBUSY:
                    fault = DeviceRefused(f"{label} is in use by another program{_BUSY_REMEDY}")
                case errno.EACCES | errno.EPERM:
                    fault = DeviceRefused(f"{label} {_PERMISSION_REMEDY}")
                case errno.EOVERFLOW:
                    fault = ProtocolError(f"{label} sent more bytes than were requested; reset it")
                case _:
                    fault = LinkClosed(f"{label} is disconnected ({reason}); check cable and power, and open it again")
            raise fault from error


@dataclass(frozen=True)
class _StillImageInterface:
    """Properties of a still image interface, from its descriptors.

    - `number`: number of the interface.
    - `addresses`: endpoint address of each pipe.
    - `packet_size`, `interrupt_size`: size of a full packet on the bulk pipes and on the interrupt pipe, bytes.
    - `polling_s`: polling interval of the interrupt pipe, seconds.
    """

    number: int
    addresses: Mapping[Pipe, int]
    packet_size: int
    interrupt_size: int
    polling_s: float


def _read_descriptors(interface: usb.core.Interface, label: str) -> _StillImageInterface:
    endpoints: dict[Pipe, usb.core.Endpoint] = {}
    for endpoint in interface:
        transfer_type = endpoint.bmAttributes & 3
        is_input = bool(endpoint.bEndpointAddress & 0x80)
        if transfer_type == _BULK:
            endpoints[Pipe.BULK_IN if is_input else Pipe.BULK_OUT] = endpoint
        elif transfer_type == _INTERRUPT and is_input:
            endpoints[Pipe.INTERRUPT_IN] = endpoint
    missing = [pipe.value for pipe in Pipe if pipe not in endpoints]
    if missing:
        raise ProtocolError(f"{label} has no pipe {', '.join(missing)}; it is not a PTP camera, connect another device")
    interval = endpoints[Pipe.INTERRUPT_IN].bInterval
    # bInterval n means 2^(n-1) microframes of 125 µs at high speed, and n frames of 1 ms at full speed. The longer time
    # is safe for both.
    frames = 2 ** (min(interval, 16) - 1) / 8 if interval else 1
    return _StillImageInterface(
        interface.bInterfaceNumber,
        {pipe: endpoint.bEndpointAddress for pipe, endpoint in endpoints.items()},
        _packet_size(endpoints[Pipe.BULK_IN]),
        _packet_size(endpoints[Pipe.INTERRUPT_IN]),
        min(max(frames, interval) / 1000 + 0.001, _MAX_POLLING_S),
    )


def _packet_size(endpoint: usb.core.Endpoint) -> int:
    # Bits 11 and 12 are not part of the size (USB 2.0, 9.6.6).
    return endpoint.wMaxPacketSize & 0x7FF


def _still_image_devices(backend: IBackend | None) -> Iterator[tuple[usb.core.Device, UsbDevice, DeviceRefused | None]]:
    try:
        devices = list(usb.core.find(find_all=True, backend=backend, custom_match=_has_still_image))
    except usb.core.NoBackendError as error:
        raise LinkClosed(
            "libusb is not installed and is required for USB devices; "
            "install it (Debian and Ubuntu: libusb-1.0-0, Fedora: libusb1, macOS: brew install libusb)"
        ) from error
    for device in devices:
        numbers = ".".join(str(number) for number in device.port_numbers or ())
        port = f"{device.bus}-{numbers}" if numbers else f"{device.bus}"
        address = device.address or 0
        refusal: DeviceRefused | None = None
        serial, name = None, ""
        try:
            serial = usb.util.get_string(device, device.iSerialNumber)
            name = usb.util.get_string(device, device.iProduct) or ""
        except (usb.core.USBError, ValueError, NotImplementedError):
            # pyusb also raises ValueError if it cannot read the device's list of languages.
            label = f"the camera {device.idVendor:04x}:{device.idProduct:04x} at {port}"
            refusal = DeviceRefused(f"{label} {_PERMISSION_REMEDY}")
        finally:
            usb.util.dispose_resources(device)
        yield device, UsbDevice(device.idVendor, device.idProduct, serial, name, port, address), refusal


def _has_still_image(device: usb.core.Device) -> bool:
    try:
        return any(_is_still_image(interface) for configuration in device for interface in configuration)
    except usb.core.USBError:
        # The device was unplugged during the search.
        return False


def _is_still_image(interface: usb.core.Interface) -> bool:
    device_class = (interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol)
    return device_class == STILL_IMAGE_CLASS


def _no_camera_message(vendor: int | None, serial: str | None, port: str | None, devices: list[UsbDevice]) -> str:
    properties = [
        f"vendor {vendor:04x}" if vendor is not None else "",
        f"serial number {serial}" if serial is not None else "",
        f"port {port}" if port is not None else "",
    ]
    expected = ", ".join(text for text in properties if text) or "PTP"
    present = "; ".join(str(device) for device in devices) or "none"
    return f"no camera with {expected} on USB (present: {present})"


def _milliseconds(timeout: float) -> int:
    # For libusb, 0 means no time limit.
    return max(1, math.ceil(timeout * 1000))
