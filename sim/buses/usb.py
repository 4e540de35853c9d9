"""A simulated USB bus for pyusb: the code that opens real cameras opens these, by the same calls.

Hand a `SimulatedBus` to `drivers.links.usb` as its backend.

Rules that hold inside:

- A device that is plugged in gets an address that none had before, as on a real bus; its port stays.
- Nothing waits: a pipe that says nothing is a timeout at once.
- Errors are those that pyusb raises over libusb, with the same numbers.

Sources: pyusb's `usb.backend`; libusb 1.0's error codes.
"""

from __future__ import annotations

import errno
import struct
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Protocol

import usb.core
from usb.backend import IBackend

from sim.buses.usb_device import BULK_IN, BULK_OUT, INTERRUPT_IN, Overflowed, Setup, Stalled

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
_HIGH_SPEED = 3
"""LIBUSB_SPEED_HIGH, 480 Mbit/s, as the real bodies."""
_DEVICE_FIELDS = (
    "bLength",
    "bDescriptorType",
    "bcdUSB",
    "bDeviceClass",
    "bDeviceSubClass",
    "bDeviceProtocol",
    "bMaxPacketSize0",
    "idVendor",
    "idProduct",
    "bcdDevice",
    "iManufacturer",
    "iProduct",
    "iSerialNumber",
    "bNumConfigurations",
)
_CONFIGURATION_FIELDS = (
    "bLength",
    "bDescriptorType",
    "wTotalLength",
    "bNumInterfaces",
    "bConfigurationValue",
    "iConfiguration",
    "bmAttributes",
    "bMaxPower",
)
_INTERFACE_FIELDS = (
    "bLength",
    "bDescriptorType",
    "bInterfaceNumber",
    "bAlternateSetting",
    "bNumEndpoints",
    "bInterfaceClass",
    "bInterfaceSubClass",
    "bInterfaceProtocol",
    "iInterface",
)
_ENDPOINT_FIELDS = (
    "bLength",
    "bDescriptorType",
    "bEndpointAddress",
    "bmAttributes",
    "wMaxPacketSize",
    "bInterval",
)


class PluggedDevice(Protocol):
    """What the bus asks of a device; `sim.buses.usb_device.PtpUsbDevice` says what each method does."""

    def device_descriptor(self) -> bytes: ...  # noqa: D102

    def configuration_descriptor(self) -> bytes: ...  # noqa: D102

    def control(self, setup: Setup, data: bytes = b"") -> bytes: ...  # noqa: D102

    def bulk_out(self, data: bytes) -> None: ...  # noqa: D102

    def bulk_in(self, limit: int) -> bytes | None: ...  # noqa: D102

    def interrupt_in(self, limit: int) -> bytes | None: ...  # noqa: D102

    def unplugged(self) -> None: ...  # noqa: D102


@dataclass(frozen=True)
class Place:
    """Where a device is plugged in, and since when: two places of one device differ in their address."""

    device: PluggedDevice
    port: int
    address: int


class Handle:
    """One opening of a device; only the one that claimed the interface may use the pipes."""

    def __init__(self, place: Place) -> None:
        self.place = place
        self.device = place.device


class SimulatedBus(IBackend):
    """A bus with devices that can be plugged in and pulled out."""

    def __init__(self) -> None:
        self._places: list[Place] = []
        self._addresses = 1
        self._claims: dict[Place, Handle] = {}
        self._held: set[PluggedDevice] = set()
        self._locked: set[PluggedDevice] = set()
        self._kernel: set[PluggedDevice] = set()

    def plug(self, device: PluggedDevice, port: int = 1) -> None:
        """Plug a device in."""
        self._addresses += 1
        self._places.append(Place(device, port, self._addresses))

    def unplug(self, device: PluggedDevice) -> None:
        """Pull a device out; does nothing if it is not plugged in."""
        for place in [place for place in self._places if place.device is device]:
            self._places.remove(place)
            self._claims.pop(place, None)
            device.unplugged()

    def replug(self, device: PluggedDevice) -> None:
        """Pull a device out and plug it in again at its port, as it does itself when it restarts."""
        port = next((place.port for place in self._places if place.device is device), 1)
        self.unplug(device)
        self.plug(device, port)

    def hold(self, device: PluggedDevice, held: bool = True) -> None:
        """Have another program hold the device's interface, or let go of it."""
        (self._held.add if held else self._held.discard)(device)

    def lock(self, device: PluggedDevice, locked: bool = True) -> None:
        """Take away the permission to open the device, or give it."""
        (self._locked.add if locked else self._locked.discard)(device)

    def bind_kernel_driver(self, device: PluggedDevice) -> None:
        """Have the system's own driver sit on the interface."""
        self._kernel.add(device)

    def kernel_driver_sits_on(self, device: PluggedDevice) -> bool:
        """Return whether the system's own driver sits on the interface."""
        return device in self._kernel

    def is_claimed(self, device: PluggedDevice) -> bool:
        """Return whether the interface is claimed on this bus."""
        return any(place.device is device for place in self._claims)

    # What pyusb asks of a backend; see usb.backend.IBackend.

    def enumerate_devices(self) -> list[Place]:
        """Return what is plugged in."""
        return list(self._places)

    def get_parent(self, dev: Place) -> None:
        """Return no parent: every port is the root's."""

    def get_device_descriptor(self, dev: Place) -> SimpleNamespace:
        """Return the device's descriptor and its place."""
        fields = struct.unpack("<BBHBBBBHHHBBBB", dev.device.device_descriptor())
        return SimpleNamespace(
            **dict(zip(_DEVICE_FIELDS, fields, strict=True)),
            bus=1,
            address=dev.address,
            port_number=dev.port,
            port_numbers=(dev.port,),
            speed=_HIGH_SPEED,
        )

    def get_configuration_descriptor(self, dev: Place, config: int) -> SimpleNamespace:
        """Return the only configuration's descriptor."""
        if config:
            raise IndexError(f"configuration {config}")
        return _described(dev, 2, 0, "<BBHBBBBB", _CONFIGURATION_FIELDS)

    def get_interface_descriptor(self, dev: Place, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return the only interface's descriptor."""
        if intf or alt or config:
            raise IndexError(f"interface {intf}, alternate setting {alt}")
        return _described(dev, 4, 0, "<BBBBBBBBB", _INTERFACE_FIELDS)

    def get_endpoint_descriptor(self, dev: Place, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return an endpoint's descriptor."""
        described = _described(dev, 5, ep, "<BBBBHB", _ENDPOINT_FIELDS)
        described.bRefresh = described.bSynchAddress = 0
        return described

    def open_device(self, dev: Place) -> Handle:
        """Open a device."""
        handle = Handle(dev)
        self._check(handle)
        if dev.device in self._locked:
            raise _error(errno.EACCES)
        return handle

    def close_device(self, dev_handle: Handle) -> None:
        """Close a device, and let go of its interface."""
        if self._claims.get(dev_handle.place) is dev_handle:
            del self._claims[dev_handle.place]

    def set_configuration(self, dev_handle: Handle, config_value: int) -> None:
        """Choose the configuration."""
        self._control(dev_handle, Setup(0x00, 9, config_value, 0, 0))

    def get_configuration(self, dev_handle: Handle) -> int:
        """Return the configuration chosen."""
        return self._control(dev_handle, Setup(0x80, 8, 0, 0, 1))[0]

    def set_interface_altsetting(self, dev_handle: Handle, intf: int, altsetting: int) -> None:
        """Choose the interface's setting."""
        self._control(dev_handle, Setup(0x01, 11, altsetting, intf, 0))

    def claim_interface(self, dev_handle: Handle, intf: int) -> None:
        """Take the interface for this program."""
        self._check(dev_handle)
        if intf:
            raise _error(errno.ENOENT)
        if dev_handle.device in self._held | self._kernel or dev_handle.place in self._claims:
            raise _error(errno.EBUSY)
        self._claims[dev_handle.place] = dev_handle

    def release_interface(self, dev_handle: Handle, intf: int) -> None:
        """Give the interface back."""
        self._check(dev_handle)
        if self._claims.get(dev_handle.place) is dev_handle:
            del self._claims[dev_handle.place]

    def bulk_write(self, dev_handle: Handle, ep: int, intf: int, data: array[int], timeout: int) -> int:
        """Send to the bulk pipe."""
        self._check_transfer(dev_handle, ep, BULK_OUT)
        try:
            dev_handle.device.bulk_out(data.tobytes())
        except Stalled as error:
            raise _error(errno.EPIPE) from error
        self._check(dev_handle)
        return len(data)

    def bulk_read(self, dev_handle: Handle, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        """Read from the bulk pipe."""
        self._check_transfer(dev_handle, ep, BULK_IN)
        return _fill(buff, dev_handle.device.bulk_in)

    def intr_read(self, dev_handle: Handle, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        """Read from the interrupt pipe."""
        self._check_transfer(dev_handle, ep, INTERRUPT_IN)
        return _fill(buff, dev_handle.device.interrupt_in)

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
        """Carry out a control request."""
        setup = Setup(bmRequestType, bRequest, wValue, wIndex, len(data))
        if bmRequestType & 0x80:
            answer = self._control(dev_handle, setup)
            data[: len(answer)] = array("B", answer)
            return len(answer)
        self._control(dev_handle, setup, data.tobytes())
        return len(data)

    def clear_halt(self, dev_handle: Handle, ep: int) -> None:
        """End a stall."""
        self._control(dev_handle, Setup(0x02, 1, 0, ep, 0))

    def reset_device(self, dev_handle: Handle) -> None:
        """Reset the device; it keeps its address."""
        self._check(dev_handle)
        dev_handle.device.unplugged()

    def is_kernel_driver_active(self, dev_handle: Handle, intf: int) -> bool:
        """Return whether the system's own driver sits on the interface."""
        self._check(dev_handle)
        return dev_handle.device in self._kernel

    def detach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Take the interface from the system's own driver."""
        self._check(dev_handle)
        self._kernel.discard(dev_handle.device)

    def attach_kernel_driver(self, dev_handle: Handle, intf: int) -> None:
        """Give the interface to the system's own driver."""
        self._check(dev_handle)
        self._kernel.add(dev_handle.device)

    def _check(self, handle: Handle) -> None:
        if handle.place not in self._places:
            raise _error(errno.ENODEV)

    def _check_transfer(self, handle: Handle, endpoint: int, expected: int) -> None:
        self._check(handle)
        if endpoint != expected:
            raise _error(errno.ENOENT)
        if self._claims.get(handle.place) is not handle:
            raise _error(errno.EIO)

    def _control(self, handle: Handle, setup: Setup, data: bytes = b"") -> bytes:
        self._check(handle)
        try:
            return handle.device.control(setup, data)
        except Stalled as error:
            raise _error(errno.EPIPE) from error


def _fill(buff: array[int], read: Callable[[int], bytes | None]) -> int:
    try:
        data = read(len(buff))
    except Stalled as error:
        raise _error(errno.EPIPE) from error
    except Overflowed as error:
        raise _error(errno.EOVERFLOW) from error
    if data is None:
        raise _error(errno.ETIMEDOUT)
    memoryview(buff)[: len(data)] = data
    return len(data)


def _error(number: int) -> usb.core.USBError:
    code, text = _ERRORS[number]
    kind = usb.core.USBTimeoutError if number == errno.ETIMEDOUT else usb.core.USBError
    return kind(text, code, number)


def _described(place: Place, kind: int, index: int, layout: str, names: tuple[str, ...]) -> SimpleNamespace:
    """Return the fields of the `index`-th descriptor of a kind in the configuration."""
    descriptors = place.device.configuration_descriptor()
    at = 0
    while at < len(descriptors):
        if descriptors[at + 1] == kind:
            if not index:
                fields = struct.unpack_from(layout, descriptors, at)
                return SimpleNamespace(**dict(zip(names, fields, strict=True)), extra_descriptors=[])
            index -= 1
        at += descriptors[at]
    raise IndexError(f"descriptor {index} of type {kind}")
