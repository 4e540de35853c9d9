"""The serial cable: the one file that imports pyserial.

Eight data bits, no parity, one stop bit, no flow control: every projector in `drivers.serial_projectors` wants that.
The port is ours alone while it is open, and what waited in it before is thrown away. A cable that is pulled out loses
what the system had not handed over yet: last words may be missing.
"""

from __future__ import annotations

import contextlib
import errno

import serial
from serial.tools import list_ports

from foundation.errors import ConfigurationError, DeviceRefused, LinkClosed, LinkError, LinkTimeout


class SerialLink:
    """A `drivers.links.link.Link` over one serial port."""

    def __init__(self, port: serial.Serial, device: str) -> None:
        self._port = port
        self._device = device

    @classmethod
    def open(cls, device: str, baud: int) -> SerialLink:
        """Open the port `device`, such as ``/dev/ttyUSB0``, at `baud` bits per second."""
        try:
            port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (ValueError, OverflowError) as error:
            raise ConfigurationError(
                f"{device} cannot be opened at {baud} baud: {error}; choose another speed"
            ) from error
        except OSError as error:
            raise _unopened(error, device) from error
        return cls(port, device)

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""
        try:
            if self._port.write_timeout != timeout:
                self._port.write_timeout = timeout
            sent = self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise self._late(timeout) from error
        except OSError as error:
            raise self._lost(error) from error
        if sent is not None and sent < len(data):
            raise self._late(timeout)

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 … `limit` bytes, waiting at most `timeout` seconds for the first; see `Link.read`."""
        try:
            if self._port.timeout != timeout:
                self._port.timeout = timeout
            data = self._port.read(1)
            if data and limit > 1:
                data += self._port.read(min(limit - 1, self._port.in_waiting))
        # pyserial lets a TypeError through when the port is closed while it is read.
        except (OSError, TypeError) as error:
            raise self._lost(error) from error
        if not data and timeout:
            raise LinkTimeout(
                f"{self._device} brought nothing for {timeout:g} s; check the cable, and that the device is on"
            )
        return data

    def close(self) -> None:
        """Give the port back; a second call does nothing."""
        with contextlib.suppress(OSError):
            self._port.close()

    def _late(self, timeout: float) -> LinkTimeout:
        return LinkTimeout(f"{self._device} takes no data for {timeout:g} s; plug its cable out and in")

    def _lost(self, error: Exception) -> LinkClosed:
        if not self._port.is_open:
            return LinkClosed(f"{self._device} was closed; open it again")
        return LinkClosed(f"{self._device} is gone ({error}); plug its cable in again")


def _unopened(error: OSError, device: str) -> LinkError | DeviceRefused:
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(
            f"{device} may not be opened by this user, or another program has it; on Linux run "
            f"sudo usermod -aG dialout $USER (on Arch: uucp) and log in again"
        )
    if error.errno in (errno.EBUSY, errno.EAGAIN):
        return DeviceRefused(f"{device} is in use by another program; close it and try again")
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        found = ", ".join(sorted(port.device for port in list_ports.comports())) or "none at all"
        return LinkClosed(
            f"there is no serial port {device}; found: {found}: plug the adapter in, or name one of these"
        )
    return LinkClosed(f"{device} cannot be opened: {error}; check that it is a serial port")


def list_serial_ports() -> tuple[str, ...]:
    """Return the machine's serial ports with what the system reports of them, sorted by name."""
    return tuple(f"{port.device} ({port.description})" for port in sorted(list_ports.comports()))
