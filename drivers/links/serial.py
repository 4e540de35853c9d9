"""Serial port.

The port has eight data bits, no parity, one stop bit and no flow control, as all projectors in
`drivers.serial_projectors` require. It is opened exclusively, and earlier input is discarded. If the cable is
disconnected, the last bytes may be lost.
"""

from __future__ import annotations

import contextlib
import errno

import serial
from serial.tools import list_ports

from foundation.errors import RUN_AGAIN, ConfigurationError, DeviceRefused, LinkClosed, LinkError, LinkTimeout


class SerialLink:
    """A `drivers.links.link.Link` over one serial port."""

    def __init__(self, port: serial.Serial, device: str) -> None:
        self._port = port
        self._device = device

    @classmethod
    def open(cls, device: str, baud: int) -> SerialLink:
        """Open `device`, such as ``/dev/ttyUSB0``, at `baud` bits per second."""
        try:
            port = serial.Serial(device, baud, timeout=0, write_timeout=0, exclusive=True)
        except (ValueError, OverflowError) as error:
            raise ConfigurationError(f"{device} cannot be opened at {baud} baud: {error}; set another speed") from error
        except OSError as error:
            raise _open_error(error, device) from error
        return cls(port, device)

    def write(self, data: bytes, timeout: float) -> None:
        """Send all of `data` within `timeout` seconds."""
        try:
            if self._port.write_timeout != timeout:
                self._port.write_timeout = timeout
            sent = self._port.write(data)
        except serial.SerialTimeoutException as error:
            raise self._write_timeout(timeout) from error
        except OSError as error:
            raise self._lost_error(error) from error
        if sent is not None and sent < len(data):
            raise self._write_timeout(timeout)

    def read(self, limit: int, timeout: float) -> bytes:
        """Return the next 1 to `limit` bytes; see `Link.read`."""
        try:
            if self._port.timeout != timeout:
                self._port.timeout = timeout
            data = self._port.read(1)
            if data and limit > 1:
                data += self._port.read(min(limit - 1, self._port.in_waiting))
        # pyserial raises TypeError if the port is closed during a read.
        except (OSError, TypeError) as error:
            raise self._lost_error(error) from error
        if not data and timeout:
            raise LinkTimeout(
                f"{self._device} received nothing for {timeout:g} s; check the cable, and that the device is on"
            )
        return data

    def close(self) -> None:
        """Release the port; a second call does nothing."""
        with contextlib.suppress(OSError):
            self._port.close()

    def _write_timeout(self, timeout: float) -> LinkTimeout:
        return LinkTimeout(f"{self._device} accepted no data for {timeout:g} s; unplug its cable and plug it in again")

    def _lost_error(self, error: Exception) -> LinkClosed:
        if not self._port.is_open:
            return LinkClosed(f"{self._device} was closed; open it again")
        return LinkClosed(f"{self._device} is disconnected ({error}); plug its cable in again")


def _open_error(error: OSError, device: str) -> LinkError | DeviceRefused:
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceRefused(
            f"this user may not open {device}, or another program uses it; on Linux run "
            f"sudo usermod -aG dialout $USER (on Arch: uucp) and log in again"
        )
    if error.errno in (errno.EBUSY, errno.EAGAIN):
        return DeviceRefused(f"{device} is in use by another program; close that program, {RUN_AGAIN}")
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        present_ports = ", ".join(sorted(port.device for port in list_ports.comports())) or "none"
        return LinkClosed(
            f"serial port {device} does not exist (present: {present_ports}); plug the adapter in, or set one of them"
        )
    return LinkClosed(f"{device} cannot be opened: {error}; check that it is a serial port")


def list_serial_ports() -> tuple[str, ...]:
    """Return the serial ports of this machine with the system's description, sorted by name."""
    return tuple(f"{port.device} ({port.description})" for port in sorted(list_ports.comports()))
