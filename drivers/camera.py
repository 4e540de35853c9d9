"""The interface of a tethered camera, and the values that it takes and returns.

Kept small so that a second maker fits beside the first: a camera is configured once, then asked for one raw frame
after another, each written whole into a file that the caller opened. Exposure and download are two calls, so that the
light can be changed while the frame travels.
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

    @property
    def name(self) -> str:
        """Maker and model, the maker once where the model begins with it."""
        first, begins = (words.casefold().split()[:1] for words in (self.maker, self.model))
        return self.model if first == begins else f"{self.maker} {self.model}".strip()


@dataclass(frozen=True)
class ExposureSettings:
    """How a frame is exposed: ISO speed, f-number, None where the body has no say in it, shutter time in seconds."""

    iso: int
    aperture: float | None
    shutter_s: float

    def __str__(self) -> str:
        opening = "aperture not set by the body" if self.aperture is None else f"f/{self.aperture:g}"
        return f"ISO {self.iso}, {opening}, {self.shutter_s:g} s"


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

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify the exposure, raw format and manual mode.

        Raises
        ------
        DeviceRefused
            The body does not offer a value; the message lists what it offers.
        """

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers now, as engraved, seconds, rising; empty if it lists none.

        Raises
        ------
        DeviceError
            It cannot be reached.
        """

    def expose(self) -> datetime:
        """Release the shutter without autofocus; return when it was released, UTC, once the light may change.

        A frame that was exposed before and has not been downloaded is dropped.

        Raises
        ------
        DeviceRefused
            The body was never configured, or declines to take a frame.
        DeviceError
            No frame was taken, or none can be found; it may be exposed again.
        """

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the frame exposed last, whole and unchanged, to `into`.

        A download that failed may be tried again with a new stream, and gives the same frame.

        Raises
        ------
        DeviceError
            The frame did not arrive, and what `into` holds is worthless; or the body holds no frame, or no longer, and
            the message says so: then it must be exposed again.
        """

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""


@dataclass(frozen=True)
class Supplies:
    """What a camera has left for a long series; None is what it does not tell.

    Attributes
    ----------
    battery
        Charge, 0 … 1, in the few steps that the body reports.
    mains
        Whether it runs on mains power.
    card_free_bytes
        Room on the card where frames go, bytes; on all cards together where there are several.
    saves_to_host
        Whether frames go to the host and leave nothing on the card, once the camera is configured.
    """

    battery: float | None = None
    mains: bool | None = None
    card_free_bytes: int | None = None
    saves_to_host: bool = True


@runtime_checkable
class ReportsSupplies(Protocol):
    """A camera that can tell how long it will last."""

    def supplies(self) -> Supplies:
        """Return what is left of battery and card.

        Raises
        ------
        DeviceError
            It cannot be reached.
        """


@runtime_checkable
class NeedsKeepAlive(Protocol):
    """A camera that must be polled for events in long pauses: to stay awake, and to empty its queue."""

    def idle(self) -> None:
        """Keep the camera awake and empty its queue of events; call it every few seconds of a pause."""


def capture(camera: Camera, into: BinaryIO) -> CapturedFrame:
    """Take a frame: expose it, and write its raw file to `into`.

    Raises
    ------
    DeviceError
        From either; what `into` holds is worthless, and the frame may be taken again.
    """
    camera.expose()
    return camera.download(into)


def keep_awake(camera: Camera) -> None:
    """Keep a camera awake that would fall asleep; call it every few seconds of a pause."""
    if isinstance(camera, NeedsKeepAlive):
        camera.idle()
