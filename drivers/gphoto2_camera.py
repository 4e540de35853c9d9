"""Any tethered camera that libgphoto2 supports, as a `Camera`: for makers that have no driver of their own here.

Rules that hold inside:

- python-gphoto2 is an optional extra and is imported only when a camera is opened.
- libgphoto2's errors become ours in `_speaking`. After a fault the connection is dropped, and the next call opens a
  new one; a frame that was being transferred is lost and may be retaken.
- Settings are chosen from the lists that libgphoto2 shows for the body, and read back.

libgphoto2 may focus before it releases, so that a body that does not focus by hand is refused.
"""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, BinaryIO

from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings
from foundation.clock import Clock, SystemClock
from foundation.errors import ConfigurationError, DeviceError, DeviceRefused, LinkClosed, LinkTimeout

if TYPE_CHECKING:
    import gphoto2

TOLERANCE = 0.06
"""Relative difference allowed between a label and the value wanted: libgphoto2 lists 6.3 s where the dial shows 6."""

_SYSTEM_CLOCK = SystemClock()
_MANUAL = ("Manual", "M")
_SINGLE = ("Single", "Single silent", "Single Shot")
_RAW_FORMATS = ("RAW", "NEF (Raw)", "Raw")
_HOST_TARGETS = ("Internal RAM", "sdram")
_IDENTITY = {
    "maker": ("manufacturer",),
    "model": ("cameramodel",),
    "serial": ("eosserialnumber", "serialnumber"),
    "firmware": ("deviceversion",),
}


class Gphoto2Camera:
    """A `drivers.camera.Camera` through libgphoto2.

    Parameters
    ----------
    port
        libgphoto2's name of the port, ``usb:001,005`` or ``ptpip:192.168.1.1``; None takes the first camera found.
    model
        libgphoto2's name of the model; None lets it find out, which works on USB. ``PTP/IP Camera`` on a network.
    clock
        Stamps the releases.
    """

    def __init__(self, port: str | None = None, model: str | None = None, clock: Clock = _SYSTEM_CLOCK) -> None:
        self._port = port
        self._model = model
        self._clock = clock
        self._camera: gphoto2.Camera | None = None
        self._settings: ExposureSettings | None = None
        self._exposed: tuple[gphoto2.CameraFilePath, datetime] | None = None
        self._closed = False
        library()

    def identity(self) -> CameraIdentity:
        """Return maker, model, serial number and firmware; empty what the body does not say."""
        with self._speaking() as camera:
            return CameraIdentity(**{field: _text(camera, names) for field, names in _IDENTITY.items()})

    def configure(self, settings: ExposureSettings) -> None:
        """Set and verify the exposure, raw format and destination.

        Raises
        ------
        DeviceRefused
            The body does not offer a value, or has a setting that spoils a series; all of it in one message.
        """
        self._settings = None
        with self._speaking() as camera:
            self._apply(camera, settings)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times in libgphoto2's list, seconds, rising; empty if it shows none.

        Raises
        ------
        DeviceError
            The body cannot be reached.
        """
        with self._speaking() as camera:
            numbers = (_number(label) for label in _choices(camera, "shutterspeed"))
            return tuple(sorted({number for number in numbers if number is not None}))

    def expose(self) -> datetime:
        """Release the shutter; return when it was released, UTC, once libgphoto2 names the file.

        A frame that was exposed before and has not been downloaded is dropped.

        Raises
        ------
        DeviceRefused
            The body was never configured.
        DeviceError
            No frame was taken, or it cannot be reached; it may be exposed again.
        """
        settings = self._settings
        if settings is None:
            raise DeviceRefused("the camera has no exposure settings; configure it before the first exposure")
        gp = library()
        fresh = self._camera is None
        with self._speaking() as camera:
            self._forget(camera)
            if fresh:
                self._apply(camera, settings)
            released_at = self._clock.now()
            self._exposed = camera.capture(gp.GP_CAPTURE_IMAGE), released_at
        return released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the frame exposed last, whole and unchanged, to `into`.

        It may be tried again where writing failed; after a fault of the connection libgphoto2 has forgotten the frame.

        Raises
        ------
        DeviceError
            The frame did not arrive, and what `into` holds is worthless; or there is none, and the message says so.
        """
        if self._exposed is None:
            raise DeviceError("no exposed frame waits in the camera to be downloaded; expose it again")
        path, released_at = self._exposed
        gp = library()
        with self._speaking() as camera:
            # The bytes belong to `file` and go with it.
            file = camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)
            size = into.write(file.get_data_and_size())
            self._forget(camera)
        return CapturedFrame(path.name, size, released_at)

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""
        self._closed = True
        self._drop()

    def _forget(self, camera: gphoto2.Camera) -> None:
        """Delete the exposed frame, if any: what waits in the camera's memory would fill it."""
        exposed, self._exposed = self._exposed, None
        if exposed is not None:
            path, _ = exposed
            with contextlib.suppress(library().GPhoto2Error):  # where it has gone already there is nothing to delete
                camera.file_delete(path.folder, path.name)

    def _drop(self) -> None:
        self._exposed = None
        # libgphoto2 takes its leave when the last reference goes; an `exit` that fails and is then repeated closes file
        # descriptors that belong to others by then.
        self._camera = None

    @contextmanager
    def _speaking(self) -> Generator[gphoto2.Camera]:
        """Give the open camera; translate what libgphoto2 raises."""
        if self._closed:
            raise DeviceError("the camera has been closed; open the rig again")
        gp = library()
        try:
            if self._camera is None:
                self._camera = self._opened()
            yield self._camera
        except gp.GPhoto2Error as error:
            self._drop()
            raise _translated(error, self._port or "the camera") from error

    def _opened(self) -> gphoto2.Camera:
        gp = library()
        camera = gp.Camera()
        if self._port is not None:
            ports = gp.PortInfoList()
            ports.load()
            with _lookup_errors_translated(f"port {self._port!r}", "such as usb:001,004 or ptpip:192.168.1.20"):
                camera.set_port_info(ports[ports.lookup_path(self._port)])
        if self._model is not None:
            models = gp.CameraAbilitiesList()
            models.load()
            with _lookup_errors_translated(f"model {self._model!r}", "gphoto2 --list-cameras lists those it knows"):
                camera.set_abilities(models[models.lookup_model(self._model)])
        camera.init()
        return camera

    def _apply(self, camera: gphoto2.Camera, settings: ExposureSettings) -> None:
        refused: list[str] = []
        for name, allowed, remedy in (
            ("autoexposuremode", _MANUAL, "turn the mode dial to M"),
            ("focusmode", _MANUAL, "set the lens to MF and focus by hand"),
            ("drivemode", _SINGLE, "set single shooting"),
        ):
            value = _text(camera, (name,))
            if value and value not in allowed:
                refused.append(f"{name} is {value}: {remedy}")
        wanted: dict[str, str] = {}
        for name, labels in (("capturetarget", _HOST_TARGETS), ("imageformat", _RAW_FORMATS)):
            choices = _choices(camera, name)
            found = next((label for label in labels if label in choices), None)
            if found is not None:
                wanted[name] = found
            elif choices:
                refused.append(f"{name} offers {', '.join(choices)}, none of {', '.join(labels)}")
        for name, value in (
            ("iso", float(settings.iso)),
            ("aperture", settings.aperture),
            ("shutterspeed", settings.shutter_s),
        ):
            choices = _choices(camera, name)
            found = _nearest(choices, value)
            if found is not None:
                wanted[name] = found
            else:
                refused.append(f"{name} {value:g} is not offered; offered are {', '.join(choices) or 'none'}")
        if refused:
            raise DeviceRefused(f"the camera cannot take the series: {'; '.join(refused)}")
        for name, label in wanted.items():
            _set(camera, name, label)


def library():
    """Return python-gphoto2.

    Raises
    ------
    ConfigurationError
        It is not installed.
    """
    try:
        import gphoto2
    except ImportError as error:
        raise ConfigurationError(
            "python-gphoto2 is not installed; install the extra: pip install 'croplab[gphoto2]'"
        ) from error
    return gphoto2


@contextmanager
def _lookup_errors_translated(what: str, remedy: str) -> Generator[None]:
    """Raise what libgphoto2 does not find as a ConfigurationError that lists what it does."""
    gp = library()
    try:
        yield
    except gp.GPhoto2Error as error:
        raise ConfigurationError(
            f"libgphoto2 knows no {what} ({remedy}); found: {_found()}; name one of these, or leave it out"
        ) from error


def _found() -> str:
    """Return the cameras that libgphoto2 finds by itself, on USB above all."""
    cameras = library().Camera.autodetect()
    names = [f"{cameras.get_name(index)} at {cameras.get_value(index)}" for index in range(cameras.count())]
    return "; ".join(names) or "no camera at all"


def _translated(error: gphoto2.GPhoto2Error, label: str) -> DeviceError:
    gp = library()
    what = f"{label}: libgphoto2 says {error.string} ({error.code})"
    match error.code:
        case gp.GP_ERROR_TIMEOUT:
            return LinkTimeout(f"{what}; look whether the camera is on and awake")
        case gp.GP_ERROR_IO_USB_CLAIM | gp.GP_ERROR_IO_LOCK:
            return LinkClosed(f"{what}; end the other program that uses the camera, photo importers of the desktop too")
        case gp.GP_ERROR_CAMERA_BUSY:
            return DeviceError(f"{what}; the frame may be retaken when it is idle")
        case gp.GP_ERROR_MODEL_NOT_FOUND | gp.GP_ERROR_UNKNOWN_PORT | gp.GP_ERROR_IO_USB_FIND:
            return LinkClosed(
                f"{what}; found: {_found()}; connect the camera, switch it on, or name its port and model"
            )
        case gp.GP_ERROR_IO | gp.GP_ERROR_IO_READ | gp.GP_ERROR_IO_WRITE | gp.GP_ERROR_IO_INIT:
            return LinkClosed(f"{what}; check the cable and the USB permission, switch the camera off and on")
        case _:
            return DeviceError(f"{what}; switch the camera off and on, then run again")


def _text(camera: gphoto2.Camera, names: Iterable[str]) -> str:
    """Return the value of the first of some widgets that the body has, empty where it has none."""
    gp = library()
    for name in names:
        try:
            value = camera.get_single_config(name).get_value()
        except gp.GPhoto2Error as error:
            if error.code != gp.GP_ERROR_BAD_PARAMETERS:
                raise
            continue
        if value:
            return str(value)
    return ""


def _choices(camera: gphoto2.Camera, name: str) -> list[str]:
    """Return what a widget can be set to, empty where the body has no such widget or no list for it."""
    gp = library()
    try:
        widget = camera.get_single_config(name)
    except gp.GPhoto2Error as error:
        if error.code != gp.GP_ERROR_BAD_PARAMETERS:
            raise
        return []
    if widget.get_type() not in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
        return []
    return [widget.get_choice(index) for index in range(widget.count_choices())]


def _set(camera: gphoto2.Camera, name: str, label: str) -> None:
    widget = camera.get_single_config(name)
    if widget.get_value() != label:
        widget.set_value(label)
        camera.set_single_config(name, widget)
        came = camera.get_single_config(name).get_value()
        if came != label:
            raise DeviceRefused(f"{name} was set to {label}, and the camera reports {came}; set it by hand")


def _nearest(choices: Iterable[str], wanted: float) -> str | None:
    """Return the label of the choice nearest to `wanted`, None where none is near enough."""
    numbers = {label: number for label in choices if (number := _number(label)) is not None}
    near = [label for label, number in numbers.items() if abs(number / wanted - 1) <= TOLERANCE]
    return min(near, key=lambda label: abs(numbers[label] / wanted - 1), default=None)


def _number(label: str) -> float | None:
    over, _, under = label.lower().removeprefix("f/").removesuffix("s").partition("/")
    try:
        number = float(over) / float(under or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return number if number > 0 else None
