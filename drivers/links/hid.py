"""USB cables to devices of the HID class, which speak in reports of 64 bytes.

Rules that hold inside:

- Only the interrupt pipes are used, one report a transfer; a report is never cut and never joined.
- The system's errors are translated here and nowhere else: ETIMEDOUT is `LinkTimeout`; EBUSY and EACCES are
  `DeviceRefused`; whatever else ends a transfer is `LinkClosed`.

Source: Device Class Definition for HID 1.11, clauses 4.1 and 4.4.
"""

from __future__ import annotations

import contextlib
import errno
import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import usb.core
import usb.util

from drivers.links.usb_claim import Claim
from foundation.errors import DeviceRefused, InputError, LinkClosed, LinkTimeout, ProtocolError

if TYPE_CHECKING:
    from usb.backend import IBackend

REPORT: Final = 64
"""Bytes of a report in either direction."""

_HID_CLASS: Final = 3
"""bInterfaceClass of a human interface device (HID 1.11, 4.1)."""

_INTERRUPT: Final = 3
"""Transfer type in an endpoint's bmAttributes (USB 2.0, 9.6.6)."""


class HidReports(Protocol):
    """An open cable that carries reports of `REPORT` bytes."""

    @property
    def label(self) -> str:
        """What messages call the device."""
        ...

    def write(self, report: bytes, timeout: float) -> None:
        """Send one report; raises `LinkTimeout` or `LinkClosed`."""
        ...

    def read(self, timeout: float) -> bytes:
        """Return the next report; raises `LinkTimeout` or `LinkClosed`."""
        ...

    def close(self) -> None:
        """Release the device; a second call does nothing."""
        ...


def open_hid(
    vendor: int, product: int, *, name: str, serial: str | None = None, backend: IBackend | None = None
) -> HidDevice:
    """Open the one HID device with these marks."""
    marks = f"{name} ({vendor:04x}:{product:04x}{f', serial number {serial}' if serial else ''})"

    def fits(device: usb.core.Device) -> bool:
        if (device.idVendor, device.idProduct) != (vendor, product):
            return False
        return serial is None or _serial(device) == serial

    try:
        found = list(usb.core.find(find_all=True, backend=backend, custom_match=fits))
    except usb.core.NoBackendError as error:
        raise LinkClosed("libusb is not installed; see docs/devices.md under USB permission") from error
    if not found:
        raise LinkClosed(f"no {marks} on USB; switch it on and check its cable")
    if len(found) > 1:
        raise InputError(f"{len(found)} devices on USB fit {marks}; name one by its serial number")
    return HidDevice(found[0], marks)


class HidDevice:
    """The `HidReports` of a device that `open_hid` found."""

    def __init__(self, device: usb.core.Device, label: str) -> None:
        self._device = device
        self._label = label
        self._claimed = Claim(device)
        try:
            with self._transfer("does not answer"):
                self._pipes = _report_pipes(self._claimed.configuration(), label)
                self._claimed.make(self._pipes.interface)
        except BaseException:
            self.close()
            raise

    @property
    def label(self) -> str:
        """The device's name and numbers."""
        return self._label

    def write(self, report: bytes, timeout: float) -> None:
        """Send one report."""
        with self._transfer(f"takes no report for {timeout:g} s"):
            self._device.write(self._pipes.outward, report, max(1, math.ceil(timeout * 1000)))

    def read(self, timeout: float) -> bytes:
        """Return the next report."""
        with self._transfer(f"has not answered for {timeout:g} s"):
            return self._device.read(self._pipes.inward, REPORT, max(1, math.ceil(timeout * 1000))).tobytes()

    def close(self) -> None:
        """Release the device and give it back to the kernel's driver, if there was one."""
        self._claimed.release()

    @contextlib.contextmanager
    def _transfer(self, late: str) -> Generator[None]:
        if self._claimed.released:
            raise LinkClosed(f"{self._label} was closed; open it again")
        try:
            yield
        except usb.core.USBTimeoutError as error:
            raise LinkTimeout(f"{self._label} {late}; switch it off and on") from error
        except usb.core.USBError as error:
            reason = error.strerror or str(error)
            if error.errno == errno.EBUSY:
                raise DeviceRefused(f"{self._label} is held by another program; close its control program") from error
            if error.errno in (errno.EACCES, errno.EPERM):
                raise DeviceRefused(
                    f"{self._label} may not be opened by this user; on Linux add a udev rule for it, "
                    "as docs/devices.md shows under The picture"
                ) from error
            raise LinkClosed(f"{self._label} is gone ({reason}); check cable and power, and open it again") from error
        except NotImplementedError as error:
            raise DeviceRefused(
                f"{self._label} cannot be used with the driver that the system has for it; on Windows install WinUSB"
            ) from error


@dataclass(frozen=True)
class _ReportPipes:
    """Number of a HID interface, and addresses of its two interrupt endpoints."""

    interface: int
    inward: int
    outward: int


def _report_pipes(configuration: usb.core.Configuration, label: str) -> _ReportPipes:
    """Return the first HID interface that has interrupt pipes both ways; `label` names the device."""
    for interface in configuration:
        ends = {
            bool(endpoint.bEndpointAddress & 0x80): endpoint.bEndpointAddress
            for endpoint in interface
            if endpoint.bmAttributes & 3 == _INTERRUPT
        }
        if interface.bInterfaceClass == _HID_CLASS and len(ends) == 2:
            return _ReportPipes(interface.bInterfaceNumber, ends[True], ends[False])
    raise ProtocolError(f"{label} has no HID interface with pipes both ways; it is another device")


def _serial(device: usb.core.Device) -> str | None:
    try:
        return usb.util.get_string(device, device.iSerialNumber)
    except (usb.core.USBError, ValueError, NotImplementedError):
        return None
    finally:
        usb.util.dispose_resources(device)
