"""A USB interface is a bundle of pipes, each with a time limit.

`drivers.links.usb` has the real ones; the simulated lab and the wrappers that make trouble keep the same contract. An
implementation translates the system's errors into `LinkTimeout`, `LinkClosed` and `PipeStalled` at this border and
nowhere else.
"""

from __future__ import annotations

from enum import Enum
from typing import Final, Protocol

from foundation.errors import LinkError

STILL_IMAGE_CLASS: Final = (6, 1, 1)
"""Class, subclass and protocol of a still image interface (USB Still Image Capture Device Definition 1.0, clause 4)."""


class PipeStalled(LinkError):
    """A pipe is halted: the device declines this transfer, and all others until the halt is cleared."""


class Pipe(Enum):
    """The pipes of a still image device, beside the control pipe."""

    BULK_OUT = "bulk out"
    BULK_IN = "bulk in"
    INTERRUPT_IN = "interrupt in"


class UsbPipes(Protocol):
    """The open, claimed interface of one device.

    Every method raises `LinkTimeout` when nothing happened in time, `LinkClosed` when the device is gone, and, where
    it transfers, `PipeStalled`.
    """

    @property
    def label(self) -> str:
        """What messages call the device."""
        ...

    @property
    def packet_size(self) -> int:
        """Bytes of a full packet on the bulk pipes (wMaxPacketSize)."""
        ...

    @property
    def polling_s(self) -> float:
        """Seconds between two looks of the bus at the interrupt pipe; who waits less may never see anything."""
        ...

    def bulk_write(self, data: bytes, timeout: float) -> None:
        """Send all of `data`; none is a zero-length packet."""
        ...

    def bulk_read(self, limit: int, timeout: float) -> bytes:
        """Return what one transfer brings, up to `limit` bytes; b"" for a zero-length packet.

        A transfer ends with a packet that is not full, or with `limit`, which must be a multiple of `packet_size`.
        """
        ...

    def interrupt_read(self, timeout: float) -> bytes:
        """Return the next packet of the interrupt pipe."""
        ...

    def control_out(self, request: int, data: bytes, timeout: float) -> None:
        """Send a request of the interface's class on the control pipe."""
        ...

    def control_in(self, request: int, limit: int, timeout: float) -> bytes:
        """Return the answer to a request of the interface's class, up to `limit` bytes."""
        ...

    def clear_halt(self, pipe: Pipe) -> None:
        """Let a stalled pipe transfer again."""
        ...

    def reset_port(self) -> None:
        """Have the bus reset the device, as if it had been unplugged and plugged in again."""
        ...

    def close(self) -> None:
        """Release the interface; a second call does nothing."""
        ...
