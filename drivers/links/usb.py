"""USB cables: the pipes of still image devices.

Devices are distinguished by vendor, product and serial number, or by the port they are plugged into: the address
changes whenever a device restarts. The kernel's own driver is asked to step aside, and given the interface back at the
end. The system's errors are translated here and nowhere else, and say what helps. pyusb opens anew what was closed as
soon as it is used; here, closed is closed.

Sources: USB 2.0, clauses 5.8 (bulk), 5.7 (interrupt), 9.4 (SetConfiguration) and 9.6 (descriptors); libusb 1.0's error
codes.
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
    """A pipe is halted: the device declines this transfer, and all others until the halt is cleared."""


class Pipe(Enum):
    """The pipes of a still image device, beside the control pipe."""

    BULK_OUT = "bulk out"
    BULK_IN = "bulk in"
    INTERRUPT_IN = "interrupt in"


class UsbPipes(Protocol):
    """The open, claimed interface of one device.

    Every method but `interrupt_read` raises `LinkTimeout` when nothing happened in time; all raise `LinkClosed` when
    the device is gone, and, where they transfer, `PipeStalled`.
    """

    @property
    def label(self) -> str:
        """What messages call the device."""

    @property
    def packet_size(self) -> int:
        """Bytes of a full packet on the bulk pipes (wMaxPacketSize)."""

    @property
    def polling_s(self) -> float:
        """Seconds between two looks of the bus at the interrupt pipe; who waits less may never see anything."""

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Send all of `data`; none is a zero-length packet."""

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return what one transfer brings, up to `limit` bytes; b"" for a zero-length packet.

        A transfer ends with a packet that is not full, or with `limit`, which must be a multiple of `packet_size`.
        """

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe; b"" where none comes in time, as most often."""

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a request of the interface's class on the control pipe."""

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the answer to a request of the interface's class, up to `limit` bytes."""

    def clear_halt(self, pipe: Pipe) -> None:
        """Let a stalled pipe transfer again."""

    def reset_port(self) -> None:
        """Have the bus reset the device, as if it had been unplugged and plugged in again."""

    def close(self) -> None:
        """Release the interface; a second call does nothing."""


UDEV_RULE = "70-crop-cameras.rules"  # The file in `drivers/data` that lets users of a Linux machine open cameras
_FORBIDDEN = (
    f"may not be opened by this user; on Linux install the rule {UDEV_RULE}, as docs/devices.md shows under USB "
    "permission, and plug the camera in again"
)
_HELD = (
    ", such as the desktop's photo monitor; close photo programs, and on Linux run: "
    "systemctl --user stop gvfs-gphoto2-volume-monitor.service (on macOS: killall ptpcamerad)"
)

_CLASS_OUT: Final = 0x21  # bmRequestType of requests of the class to the interface (USB 2.0, 9.3)
_CLASS_IN: Final = 0xA1  # bmRequestType of requests of the class from the interface

_BULK: Final = 2  # Transfer type in an endpoint's bmAttributes (USB 2.0, 9.6.6)
_INTERRUPT: Final = 3  # Transfer type, as above

# Longest interval that is believed: a wrong descriptor must not slow the events down to seconds.
_MAX_POLLING_S: Final = 0.05


@dataclass(frozen=True)
class UsbDevice:
    """A still image device on the bus.

    `serial` is None where the device has no number, or does not let us read it. `port` is the bus and the ports on the
    way, such as ``1-2.4``; it stays when the device restarts, unlike `address`.
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
    """Return the still image devices on the bus; `backend` stands for another bus than the machine's own."""
    return tuple(description for _, description, _ in _found(backend))


def open_usb(
    *,
    vendor: int | None = None,
    serial: str | None = None,
    port: str | None = None,
    backend: IBackend | None = None,
) -> OpenUsbDevice:
    """Open the one still image device that has all the marks given, and claim its interface."""
    matching: list[tuple[usb.core.Device, UsbDevice]] = []
    others: list[UsbDevice] = []
    hidden: DeviceRefused | None = None
    for device, description, refusal in _found(backend):
        marks = ((vendor, description.vendor), (port, description.port))
        alike = all(wanted is None or wanted == is_ for wanted, is_ in marks)
        if alike and (serial is None or serial == description.serial):
            matching.append((device, description))
        else:
            others.append(description)
            if alike and refusal is not None:
                hidden = refusal
    if not matching:
        if hidden is not None:
            raise hidden
        raise LinkClosed(_absent(vendor, serial, port, others))
    if len(matching) > 1:
        choice = "; ".join(str(description) for _, description in matching)
        raise InputError(f"{len(matching)} cameras on USB fit: {choice}; name one by serial number or port")
    return OpenUsbDevice(*matching[0])


class OpenUsbDevice:
    """The claimed interface of a device that `open_usb` found; `close` releases it."""

    def __init__(self, device: usb.core.Device, description: UsbDevice) -> None:
        self._device = device
        self._label = str(description)
        self._detached: int | None = None
        self._closed = False
        try:
            self._interface = self._claimed()
        except BaseException:
            self.close()
            raise

    @property
    def label(self) -> str:
        """The device's name and numbers."""
        return self._label

    def close(self) -> None:
        """Release the device, and give it back to the kernel's driver if there was one; a second call does nothing."""
        if self._closed:
            return
        self._closed = True
        # A device that was unplugged cannot be released, and need not be.
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            if self._detached is not None:
                usb.util.release_interface(self._device, self._detached)
                self._device.attach_kernel_driver(self._detached)
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(self._device)

    @property
    def packet_size(self) -> int:
        """Bytes of a full packet on the bulk pipes."""
        return self._interface.packet_size

    @property
    def polling_s(self) -> float:
        """Seconds between two looks at the interrupt pipe."""
        return self._interface.polling_s

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Send all of `data`; none is a zero-length packet."""
        with self._transfer(f"takes no data for {timeout:g} s"):
            sent = self._device.write(self._interface.addresses[Pipe.BULK_OUT], data, _milliseconds(timeout))
        if sent != len(data):
            raise LinkTimeout(f"{self._label} took {sent} of {len(data)} bytes within {timeout:g} s; reset it")

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return what one transfer brings, up to `limit` bytes."""
        with self._transfer(f"sent nothing for {timeout:g} s"):
            return self._device.read(self._interface.addresses[Pipe.BULK_IN], limit, _milliseconds(timeout)).tobytes()

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe; b"" where none comes in time."""
        with self._transfer(f"has no event for {timeout:g} s"):
            address = self._interface.addresses[Pipe.INTERRUPT_IN]
            try:
                return self._device.read(address, self._interface.interrupt_size, _milliseconds(timeout)).tobytes()
            except usb.core.USBError as error:
                if isinstance(error, usb.core.USBTimeoutError) or error.errno == errno.ETIMEDOUT:
                    return b""
                raise

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a request of the interface's class on the control pipe."""
        with self._transfer(f"takes no control request for {timeout:g} s"):
            number = self._interface.number
            self._device.ctrl_transfer(_CLASS_OUT, request, 0, number, data, _milliseconds(timeout))

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the answer to a request of the interface's class."""
        with self._transfer(f"answers no control request for {timeout:g} s"):
            number = self._interface.number
            answer = self._device.ctrl_transfer(_CLASS_IN, request, 0, number, limit, _milliseconds(timeout))
        return bytes(answer)

    def clear_halt(self, pipe: Pipe) -> None:
        """Let a stalled pipe transfer again."""
        with self._transfer("does not end a stall"):
            self._device.clear_halt(self._interface.addresses[pipe])

    def reset_port(self) -> None:
        """Have the bus reset the device, and claim it again."""
        with self._transfer("does not come back from a reset"):
            self._device.reset()
        self._interface = self._claimed()

    def _claimed(self) -> _StillImageInterface:
        with self._transfer("does not answer"):
            interface = next(found for found in self._configuration() if _is_still_image(found))
            pipes = _pipes_of(interface, self._label)
            self._claim(pipes.number)
        return pipes

    def _configuration(self) -> usb.core.Configuration:
        try:
            return self._device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno is not None:
                raise
            # None is active: a device fresh from the bus on systems that leave this to us.
            self._device.set_configuration()
            return self._device.get_active_configuration()

    def _claim(self, interface: int) -> None:
        with contextlib.suppress(NotImplementedError):
            if self._device.is_kernel_driver_active(interface):
                self._device.detach_kernel_driver(interface)
                self._detached = interface
        usb.util.claim_interface(self._device, interface)

    @contextlib.contextmanager
    def _transfer(self, late: str) -> Generator[None]:
        """Translate what the block raises; `late` is what a timeout means."""
        label = self._label
        if self._closed:
            raise LinkClosed(f"{label} was closed; open it again")
        try:
            yield
        except usb.core.USBTimeoutError as error:
            raise LinkTimeout(f"{label} {late}; reset it, or switch it off and on") from error
        except usb.core.USBError as error:
            reason = error.strerror or str(error)
            match error.errno:
                case errno.ETIMEDOUT:
                    fault = LinkTimeout(f"{label} does not answer ({reason}); reset it, or switch it off and on")
                case errno.EPIPE:
                    fault = PipeStalled(f"{label} stalls")
                case errno.EBUSY:
                    fault = DeviceRefused(f"{label} is held by another program{_HELD}")
                case errno.EACCES | errno.EPERM:
                    fault = DeviceRefused(f"{label} {_FORBIDDEN}")
                case errno.EOVERFLOW:
                    fault = ProtocolError(f"{label} sends more than was asked for; reset it")
                case _:
                    fault = LinkClosed(f"{label} is gone ({reason}); check cable and power, and open it again")
            raise fault from error


@dataclass(frozen=True)
class _StillImageInterface:
    """A still image interface as its descriptors have it.

    - `number`: the interface's.
    - `addresses`: endpoint of each pipe.
    - `packet_size`, `interrupt_size`: bytes of a full packet on the bulk pipes and on the interrupt pipe.
    - `polling_s`: seconds between two looks at the interrupt pipe.
    """

    number: int
    addresses: Mapping[Pipe, int]
    packet_size: int
    interrupt_size: int
    polling_s: float


def _pipes_of(interface: usb.core.Interface, label: str) -> _StillImageInterface:
    """Return the pipes that the endpoints of an interface describe; `label` names the device."""
    endpoints: dict[Pipe, usb.core.Endpoint] = {}
    for endpoint in interface:
        kind = endpoint.bmAttributes & 3
        inward = bool(endpoint.bEndpointAddress & 0x80)
        if kind == _BULK:
            endpoints[Pipe.BULK_IN if inward else Pipe.BULK_OUT] = endpoint
        elif kind == _INTERRUPT and inward:
            endpoints[Pipe.INTERRUPT_IN] = endpoint
    missing = [pipe.value for pipe in Pipe if pipe not in endpoints]
    if missing:
        raise ProtocolError(f"{label} has no pipe {', '.join(missing)}; it is no PTP device")
    interval = endpoints[Pipe.INTERRUPT_IN].bInterval
    # High speed counts 2^(n-1) microframes of 125 µs, full speed n frames of 1 ms; slower than needed is safe.
    frames = 2 ** (min(interval, 16) - 1) / 8 if interval else 1
    return _StillImageInterface(
        interface.bInterfaceNumber,
        {pipe: endpoint.bEndpointAddress for pipe, endpoint in endpoints.items()},
        _packet_size(endpoints[Pipe.BULK_IN]),
        _packet_size(endpoints[Pipe.INTERRUPT_IN]),
        min(max(frames, interval) / 1000 + 0.001, _MAX_POLLING_S),
    )


def _packet_size(endpoint: usb.core.Endpoint) -> int:
    # Bits 11 and 12 count extra transactions in a microframe (USB 2.0, 9.6.6).
    return endpoint.wMaxPacketSize & 0x7FF


def _found(backend: IBackend | None) -> Iterator[tuple[usb.core.Device, UsbDevice, DeviceRefused | None]]:
    try:
        devices = list(usb.core.find(find_all=True, backend=backend, custom_match=_has_still_image))
    except usb.core.NoBackendError as error:
        raise LinkClosed(
            "libusb is not installed, so that no USB device can be seen; "
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
            # pyusb raises ValueError, with no reason, when it cannot read the list of languages either.
            label = f"the camera {device.idVendor:04x}:{device.idProduct:04x} at {port}"
            refusal = DeviceRefused(f"{label} {_FORBIDDEN}")
        finally:
            usb.util.dispose_resources(device)
        yield device, UsbDevice(device.idVendor, device.idProduct, serial, name, port, address), refusal


def _has_still_image(device: usb.core.Device) -> bool:
    try:
        return any(_is_still_image(interface) for configuration in device for interface in configuration)
    except usb.core.USBError:
        # It was unplugged while we looked.
        return False


def _is_still_image(interface: usb.core.Interface) -> bool:
    kind = (interface.bInterfaceClass, interface.bInterfaceSubClass, interface.bInterfaceProtocol)
    return kind == STILL_IMAGE_CLASS


def _absent(vendor: int | None, serial: str | None, port: str | None, others: list[UsbDevice]) -> str:
    marks = [
        f"vendor {vendor:04x}" if vendor is not None else "",
        f"serial number {serial}" if serial is not None else "",
        f"port {port}" if port is not None else "",
    ]
    wanted = ", ".join(mark for mark in marks if mark) or "PTP"
    there = "; ".join(str(other) for other in others) or "none at all"
    return f"no camera with {wanted} on USB; found: {there}: switch the camera on, check cable and sleep timer"


def _milliseconds(timeout: float) -> int:
    # libusb takes 0 for ever.
    return max(1, math.ceil(timeout * 1000))
