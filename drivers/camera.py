"""Interface of a tethered camera, and the values that it takes and returns.

`Camera.configure` sets the exposure. Then `Camera.expose` and `Camera.download` take one raw frame after another. They
are two calls, so that the projector can show the next illuminant while the frame is transferred.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime
from typing import BinaryIO, Protocol, runtime_checkable


def camera_name(maker: str, model: str) -> str:
    """Return maker and model, only the model if it begins with the maker.

    Examples
    --------
    >>> camera_name("NIKON CORPORATION", "NIKON D850"), camera_name("FUJIFILM", "X-T5")
    ('NIKON D850', 'FUJIFILM X-T5')
    """
    maker_word, model_word = (re.split(r"\W+", words.casefold().strip())[0] for words in (maker, model))
    return model if maker_word == model_word else f"{maker} {model}".strip()


@dataclass(frozen=True)
class CameraIdentity:
    """Identity of the connected camera body.

    Attributes
    ----------
    maker, model, serial, firmware
        Texts that the body reports; an empty text if it does not report the value.
    """

    maker: str
    model: str
    serial: str
    firmware: str = ""

    @property
    def name(self) -> str:
        """Maker and model as in raw files, whose maker has no "Inc."."""
        return camera_name(re.sub(r"[ .,]*Inc\.?$", "", self.maker), self.model)


@dataclass(frozen=True)
class ExposureSettings:
    """Settings of one exposure.

    Attributes
    ----------
    iso
        ISO speed.
    aperture
        f-number; None if the body cannot set it, as for a lens without contacts.
    shutter_s
        Shutter time, seconds.
    """

    iso: int
    aperture: float | None
    shutter_s: float

    def __str__(self) -> str:
        aperture = "aperture not set by the body" if self.aperture is None else f"f/{self.aperture:g}"
        return f"ISO {self.iso}, {aperture}, {self.shutter_s:g} s"


@dataclass(frozen=True)
class CapturedFrame:
    """One raw frame that was transferred completely.

    Attributes
    ----------
    name
        File name given by the camera, e.g. ``IMG_0042.CR2``; the suffix is the format.
    size
        Size of the raw file, bytes.
    released_at
        Time at which the shutter was released, UTC.
    """

    name: str
    size: int
    released_at: datetime


class Camera(Protocol):
    """A tethered camera with an open connection."""

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware."""

    def configure(self, settings: ExposureSettings) -> None:
        """Set exposure and raw format, and read them back; require manual mode.

        Parameters
        ----------
        settings
            ISO speed, f-number and shutter time; each must be a value that the body offers.

        Raises
        ------
        DeviceRefused
            The body does not offer a value, or is not in manual mode. The message gives the offered values.
        """

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times that the body offers now.

        Returns
        -------
        tuple of float
            Nominal times in seconds, in ascending order; empty if the body lists none.

        Raises
        ------
        DeviceError
            The camera cannot be reached.
        """

    def expose(self) -> datetime:
        """Release the shutter without autofocus; return as soon as the exposure no longer needs the illuminant.

        An earlier frame that was not downloaded is dropped.

        Returns
        -------
        datetime
            Time of the release, UTC.

        Raises
        ------
        DeviceRefused
            `configure` was not called, or the body refuses to release.
        DeviceError
            No frame was taken; the caller may expose again.
        """

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the last exposure to a stream, complete and unchanged.

        After an error, call the method again with a new stream, to get the same frame.

        Parameters
        ----------
        into
            Writable binary stream; after an error its content is invalid.

        Returns
        -------
        CapturedFrame
            Name, size and release time of the frame.

        Raises
        ------
        DeviceError
            The transfer failed. If the body does not have the frame any more, the message asks for a new exposure.
        """

    def close(self) -> None:
        """Release the camera; a second call does nothing."""


@dataclass(frozen=True)
class Supplies:
    """Battery charge and free space on the cards; a value is None if the camera does not report it.

    Attributes
    ----------
    battery
        Charge, 0 to 1; most bodies report only a few steps.
    mains
        True on mains power.
    card_free_bytes
        Free space for frames, bytes; the sum over all cards.
    saves_to_host
        True if the camera, once configured, sends frames only to the computer.
    """

    battery: float | None = None
    mains: bool | None = None
    card_free_bytes: int | None = None
    saves_to_host: bool = True


@runtime_checkable
class ReportsSupplies(Protocol):
    """A camera that reports battery and card capacity."""

    def supplies(self) -> Supplies:
        """Return battery and card capacity.

        Raises
        ------
        DeviceError
            The camera cannot be reached.
        """


@runtime_checkable
class NeedsKeepAlive(Protocol):
    """A camera that must be polled during pauses; otherwise it goes to sleep, or its event queue fills up."""

    def idle(self) -> None:
        """Poll the camera once; call this every few seconds of a pause."""


def capture(camera: Camera, into: BinaryIO) -> CapturedFrame:
    """Expose one frame and write its raw file to `into`.

    Raises
    ------
    DeviceError
        Exposure or download failed; the content of `into` is invalid, and the frame may be taken again.
    """
    camera.expose()
    return camera.download(into)


def keep_awake(camera: Camera) -> None:
    """Poll the camera if it needs polling; call this every few seconds of a pause."""
    if isinstance(camera, NeedsKeepAlive):
        camera.idle()
