"""The claim on one interface of a USB device, the same for cameras and for HID devices.

Rules that hold inside:

- The kernel's own driver is asked to step aside, and given the interface back at the end.
- What the bus raises while it is claimed passes through: the callers know whose device it is, and what helps.

Source: USB 2.0, clause 9.4 (SetConfiguration); libusb 1.0, claiming of interfaces.
"""

from __future__ import annotations

import contextlib

import usb.core
import usb.util


class Claim:
    """A claim that has not been made yet; `release` undoes as much as was done."""

    def __init__(self, device: usb.core.Device) -> None:
        self._device = device
        self._detached: int | None = None
        self.released = False
        """Whether it has been given up."""

    def configuration(self) -> usb.core.Configuration:
        """Return the device's configuration, made active if none is."""
        try:
            return self._device.get_active_configuration()
        except usb.core.USBError as error:
            if error.errno is not None:
                raise
            # None is active: a device fresh from the bus on systems that leave this to us.
            self._device.set_configuration()
            return self._device.get_active_configuration()

    def make(self, interface: int) -> None:
        """Claim the interface of this number, also again after a reset of the device."""
        with contextlib.suppress(NotImplementedError):
            if self._device.is_kernel_driver_active(interface):
                self._device.detach_kernel_driver(interface)
                self._detached = interface
        usb.util.claim_interface(self._device, interface)

    def release(self) -> None:
        """Give the interface back, to the kernel's driver if there was one; a second call does nothing."""
        if self.released:
            return
        self.released = True
        # A device that was unplugged cannot be released, and need not be.
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            if self._detached is not None:
                usb.util.release_interface(self._device, self._detached)
                self._device.attach_kernel_driver(self._detached)
        with contextlib.suppress(usb.core.USBError, NotImplementedError):
            usb.util.dispose_resources(self._device)
