"""The interface of a tethered camera, and the values that it takes and returns.

Kept small so that a second maker fits beside the first: a camera is configured once, then asked for one raw frame
after another, each written whole into a file that the caller opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import BinaryIO, Protocol, runtime_checkable


@dataclass(frozen=True)
class CameraIdentity:
    """Maker, model, serial number and firmware of the connected body."""

    maker: str
    model: str
    serial: str
    firmware: str = ""


@dataclass(frozen=True)
class ExposureSettings:
    """How a frame is exposed: ISO speed, aperture as f-number, shutter time in seconds."""

    iso: int
    aperture: float
    shutter_s: float


@dataclass(frozen=True)
class CapturedFrame:
    """One raw frame that has reached the host completely.

    Attributes
    ----------
    name
        The camera's own name for the file, e.g. ``IMG_0042.CR2``; its suffix names the format.
    size
        Bytes written.
    released_at
        When the shutter was released, UTC.
    """

    name: str
    size: int
    released_at: datetime


class Camera(Protocol):
    """A tethered camera that has been opened."""

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware."""
        ...

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify the exposure, raw format and manual mode.

        Raises
        ------
        DeviceRefused
            The body does not offer a value; the message lists what it offers.
        """
        ...

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers now, as engraved, seconds, rising; empty if it lists none.

        Raises
        ------
        DeviceError
            It cannot be reached.
        """
        ...

    def capture(self, into: BinaryIO) -> CapturedFrame:
        """Release the shutter without autofocus and write the raw file, whole and unchanged, to `into`.

        Raises
        ------
        DeviceError
            The frame did not arrive; what `into` holds is worthless and may be retaken.
        """
        ...

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""
        ...


@runtime_checkable
class NeedsKeepAlive(Protocol):
    """A camera that must be polled for events in long pauses: to stay awake, and to empty its queue."""

    def idle(self) -> None:
        """Keep the camera awake and empty its queue of events; call it every few seconds of a pause."""
        ...


def keep_awake(camera: Camera) -> None:
    """Keep a camera awake that would fall asleep; call it every few seconds of a pause."""
    if isinstance(camera, NeedsKeepAlive):
        camera.idle()
