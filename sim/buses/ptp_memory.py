"""A PTP device without a cable: in memory, through the containers, without a bus, a thread or a wait."""

from __future__ import annotations

from drivers.links.link import Pipe, PipeStalled
from drivers.ptp.usb import UsbTransport
from foundation.errors import LinkClosed, LinkTimeout, ProtocolError
from sim.buses.responder import Responder
from sim.buses.usb_device import (
    BULK_IN,
    BULK_OUT,
    INTERRUPT_IN,
    INTERRUPT_PACKET,
    PACKET,
    Overflowed,
    PtpUsbDevice,
    Setup,
    Stalled,
)
from sim.clock import SimulatedClock

_ADDRESSES = {Pipe.BULK_OUT: BULK_OUT, Pipe.BULK_IN: BULK_IN, Pipe.INTERRUPT_IN: INTERRUPT_IN}


class MemoryPipes:
    """The `drivers.links.link.UsbPipes` of a device in the same thread; what it has not sent yet, it will not send."""

    def __init__(self, device: PtpUsbDevice) -> None:
        self._device = device
        self._there = True

    @property
    def label(self) -> str:
        """The device's name."""
        return f"the simulated {self._device.identity.name}"

    @property
    def packet_size(self) -> int:
        """Bytes of a full packet on the bulk pipes."""
        return PACKET

    @property
    def polling_s(self) -> float:
        """No time at all."""
        return 0.0

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Hand `data` to the device."""
        self._check()
        try:
            self._device.bulk_out(data)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return what one transfer brings."""
        self._check()
        try:
            return self._said(self._device.bulk_in(limit), timeout)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error
        except Overflowed as error:
            raise ProtocolError(f"{self.label} sends more than the {limit} bytes asked for") from error

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe."""
        self._check()
        try:
            return self._said(self._device.interrupt_in(INTERRUPT_PACKET), timeout)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a request of the interface's class."""
        self._check()
        try:
            self._device.control(Setup(0x21, request, 0, 0, len(data)), data)
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the answer to a request of the interface's class."""
        self._check()
        try:
            return self._device.control(Setup(0xA1, request, 0, 0, limit))
        except Stalled as error:
            raise PipeStalled(f"{self.label} stalls") from error

    def clear_halt(self, pipe: Pipe) -> None:
        """Let a stalled pipe transfer again."""
        self._check()
        self._device.control(Setup(0x02, 1, 0, _ADDRESSES[pipe], 0))

    def reset_port(self) -> None:
        """Have the device forget everything."""
        self._check()
        self._device.unplugged()

    def close(self) -> None:
        """Let go of the device."""
        self._there = False

    def pull(self) -> None:
        """Pull the cable: the device is gone for good."""
        if self._there:
            self._there = False
            self._device.unplugged()

    def _check(self) -> None:
        if not self._there:
            raise LinkClosed(f"{self.label} was unplugged; open it again")

    def _said(self, data: bytes | None, timeout: float) -> bytes:
        if data is None:
            raise LinkTimeout(f"{self.label} sent nothing for {timeout:g} s")
        return data


class MemoryTransport(UsbTransport):
    """A `drivers.ptp.transaction.Transport` straight to a responder."""

    def __init__(self, responder: Responder) -> None:
        self._memory = MemoryPipes(PtpUsbDevice(responder))
        super().__init__(self._memory, SimulatedClock())

    def pull(self) -> None:
        """Pull the cable."""
        self._memory.pull()
