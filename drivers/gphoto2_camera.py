"""Any tethered camera that libgphoto2 supports, as a `Camera`: for makers that have no driver of their own here.

python-gphoto2 is an optional extra and is imported only when a camera is opened. After a fault the connection is
dropped, and the next call opens a new one; a frame that was being transferred is lost and may be retaken.

libgphoto2 names one thing differently for each maker, and one maker's bodies differ: the first of some names that a
body has is used. Labels are those of libgphoto2's own tables, untranslated; a setting is read back. A raw format that
cannot be asked for is refused, and so is what is known to spoil a series; what a body does not show at all is no
problem. libgphoto2 may focus before it releases, so that a body that does not focus by hand is refused.

Source: libgphoto2 2.5.34, camlibs/ptp2/config.c (names and labels), camlibs/ptp2/cameras (what bodies of each maker
show).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, BinaryIO

from drivers.camera import CameraIdentity, CapturedFrame, ExposureSettings, Supplies
from foundation.clock import SYSTEM_CLOCK, Clock
from foundation.errors import RUN_AGAIN, ConfigurationError, DeviceError, DeviceRefused, LinkClosed, LinkTimeout

if TYPE_CHECKING:
    import gphoto2


# Relative difference allowed between a label and the value wanted: libgphoto2 lists 6.3 s where the dial shows 6.
TOLERANCE = 0.06
# Relative difference between two labels of one value: a Nikon's 1/60 is listed as 0.0166 s too, cut off there.
SAME = 0.011
_LISTED = 30  # Choices that a message lists, at most

RAW_FORMAT = ("imageformat", "imagequality")  # Canon, Fuji and Olympus have the former, Nikon and Sony the latter
ISO = ("iso",)
APERTURE = ("aperture", "f-number")
# A Nikon has both, and only the former is exact: the latter lists 1/6400 s as 0.0001 s.
SHUTTER = ("shutterspeed2", "shutterspeed")
TARGET = ("capturetarget",)
HOST_TARGETS = ("Internal RAM", "sdram")  # Frames go to the host and leave nothing on the card

_RAW_LABELS = ("RAW", "NEF (Raw)", "Raw", "NEF", "RAW (Uncompressed)", "RAW (Lossless)")
_NOT_RAW_SUFFIXES = (".jpg", ".jpeg", ".hif", ".heif", ".heic", ".tif", ".tiff", ".mov", ".mp4")
# Names of a state, labels of which one must be shown, and the remedy; a body may show a state under two names.
_STATES: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    (("autoexposuremode", "expprogram"), ("Manual", "M"), "turn the mode dial to M"),
    (
        ("focusmode", "focusmode2"),
        ("Manual", "Manual Reverse", "MF", "MF (fixed)", "MF (selection)"),
        "set the lens or the body to MF and focus by hand",
    ),
    (
        ("drivemode", "capturemode"),
        ("Single", "Single silent", "Single Shot", "Quiet Release"),
        "set single shooting",
    ),
)
# Names of what must be off, the labels for that, and what it would do.
_SWITCHES: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("isoauto", ("Off",), "the body would choose the ISO speed"),
    ("autoiso", ("Off",), "the body would choose the ISO speed"),
    ("bracketing", ("Off",), "every frame would be exposed differently"),
    ("longexpnr", ("Off",), "the body would subtract a dark frame of its own"),
    ("autofocus", ("Off",), "the body would focus before each frame"),
    ("rawcompression", ("Lossless", "Uncompressed"), "raw values would be rounded"),
)
_BATTERY_WORDS = {"low": 0.0, "empty": 0.0, "full": 1.0}


@dataclass(frozen=True)
class BodySetting:
    """A setting as a body shows it now.

    - `name`: libgphoto2's, such as ``f-number``.
    - `value`: what is set: a label, or a number as text.
    - `choices`: what it can be set to; empty where the body lists nothing.
    - `bounds`: least and greatest number that it can be set to, where it is a range.
    - `fixed`: whether it cannot be set.
    """

    name: str
    value: str
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    fixed: bool = False

    @property
    def is_silent(self) -> bool:
        """Whether it names no number that it has, nor any that it could have."""
        return self.bounds is None and all(number_of(label) is None for label in (self.value, *self.choices))

    def offered(self) -> str:
        """Return what it can be set to, as a message lists it."""
        if self.bounds is not None:
            return f"{self.bounds[0]:g} to {self.bounds[1]:g}"
        listed = ", ".join(self.choices[:_LISTED]) + (" …" if len(self.choices) > _LISTED else "")
        return listed or f"nothing (it stands at {self.value or 'nothing'})"


Body = Callable[[str], BodySetting | None]  # Gives a body's setting of a name, None where it has none


def first_of(body: Body, names: Iterable[str]) -> BodySetting | None:
    """Return the first of some settings that a body has; of several, one that has something to choose from."""
    found = [setting for name in names if (setting := body(name)) is not None]
    return next((setting for setting in found if setting.choices or setting.bounds), found[0] if found else None)


def plan(body: Body, settings: ExposureSettings) -> dict[str, str]:
    """Return which setting gets which value for a series of raw frames, in the order of setting."""
    refused: list[str] = []
    wanted: dict[str, str] = {}
    for names, allowed, remedy in _STATES:
        shown = [setting for name in names if (setting := body(name)) is not None and setting.value]
        if shown and not any(setting.value in allowed for setting in shown):
            refused.append(f"{shown[0].name} is {shown[0].value}: {remedy}")
    for name, labels, harm in _SWITCHES:
        setting = body(name)
        if setting is None or setting.value in labels or not setting.choices:
            continue
        label = next((label for label in labels if label in setting.choices), None)
        if label is None or setting.fixed:
            refused.append(f"{name} is {setting.value}, so that {harm}: set it to {labels[0]} on the camera")
        else:
            wanted[name] = label
    _choose(first_of(body, TARGET), HOST_TARGETS, wanted, refused)
    raw = first_of(body, RAW_FORMAT)
    if raw is None:
        refused.append(
            f"a raw format cannot be asked for: the body shows neither {' nor '.join(RAW_FORMAT)}; set it to raw alone "
            "by hand and take the frames with another program, then use `acquire import`"
        )
    _choose(raw, _RAW_LABELS, wanted, refused)
    for names, value in (
        (ISO, float(settings.iso)),
        (APERTURE, settings.aperture),
        (SHUTTER, settings.shutter_s),
    ):
        setting = first_of(body, names)
        if value is None:
            if setting is not None and number_of(setting.value) is not None:
                refused.append(f"the lens has apertures, it stands at {setting.value}: name one as f-number")
            continue
        if names is APERTURE and setting is not None and setting.is_silent:
            refused.append(
                f'aperture {value:g} cannot be set, for the lens tells of none: set aperture = "none" for it'
            )
            continue
        label = None if setting is None else label_of(setting, value)
        if setting is None:
            refused.append(f"{' or '.join(names)} {value:g} cannot be asked for: the body does not show it")
        elif label is None:
            refused.append(f"{setting.name} {value:g} is not offered; offered are {setting.offered()}")
        else:
            wanted[setting.name] = label
    if refused:
        raise DeviceRefused(f"the camera cannot take the series: {'; '.join(refused)}")
    return wanted


def label_of(setting: BodySetting, wanted: float) -> str | None:
    """Return the label that sets a setting to a number, None where none comes near enough."""
    if setting.fixed:
        return setting.value if is_same(setting.value, f"{wanted:.9g}", TOLERANCE) else None
    if setting.bounds is not None:
        least, greatest = setting.bounds
        return f"{wanted:.9g}" if least <= wanted <= greatest else None
    if not setting.choices:
        # Some bodies list nothing for what can be set all the same; what comes of it is read back.
        return f"{wanted:.9g}"
    numbers = {label: number for label in setting.choices if (number := number_of(label)) is not None}
    near = [label for label, number in numbers.items() if abs(number / wanted - 1) <= TOLERANCE]
    return min(near, key=lambda label: abs(numbers[label] / wanted - 1), default=None)


def is_same(label: str, other: str, tolerance: float = SAME) -> bool:
    """Return whether two labels mean the same: the same text, or the same number written differently."""
    if label == other:
        return True
    number, second = number_of(label), number_of(other)
    return number is not None and second is not None and abs(number / second - 1) <= tolerance


def number_of(label: str) -> float | None:
    """Return the number in a label: ``f/5.6``, ``0,0400s``, ``32/10``, ``1/60``, ``100``; None where it is none.

    Labels with more in them than a number, such as ``100 Multi Frame Noise Reduction`` or ``x 200``, are none.
    """
    over, _, under = label.lower().replace(",", ".").removeprefix("f/").removesuffix("s").partition("/")
    try:
        number = float(over) / float(under or 1)
    except (ValueError, ZeroDivisionError):
        return None
    return number if 0 < number < float("inf") else None


def battery_level(text: str) -> float | None:
    """Return the charge in a label such as ``80%`` or ``Low``, 0 … 1; None where it says none."""
    found = text.strip().lower()
    if found in _BATTERY_WORDS:
        return _BATTERY_WORDS[found]
    if found.endswith("%") and found[:-1].strip().isdecimal():
        return min(int(found[:-1]), 100) / 100
    return None


def _choose(setting: BodySetting | None, labels: tuple[str, ...], wanted: dict[str, str], refused: list[str]) -> None:
    """Note which of some labels a setting is to have; a body that has it already need not offer it."""
    if setting is None:
        return
    found = next((label for label in labels if label in setting.choices), None)
    if found is not None and not setting.fixed:
        wanted[setting.name] = found
    elif setting.value not in labels:
        refused.append(f"{setting.name} offers {setting.offered()}, none of {', '.join(labels)} that can be set")


# How long a body may take to report a value that it was given: a Sony turns its dials step by step.
SETTLE_LIMIT_S = 5.0

# Requests of a file in all from a body that says that it is busy: a second each, for it may still be writing. Any
# other fault loses the connection, and the frame with it.
BUSY_TRIES = 5
BUSY_PAUSE_S = 1.0  # Between two of them
_LOOK_AGAIN_S = 0.1  # Between two looks at a value that is to settle; each costs an exchange with the body

_IDENTITY = {
    "maker": ("manufacturer",),
    "model": ("cameramodel",),
    "serial": ("eosserialnumber", "serialnumber"),
    "firmware": ("deviceversion",),
}


class Gphoto2Camera:
    """A `drivers.camera.Camera` through libgphoto2.

    `port`: libgphoto2's name of the port, ``usb:001,005`` or ``ptpip:192.168.1.1``; None takes the first camera found.
    `model`: libgphoto2's name of the model; None lets it find out, which works on USB. ``PTP/IP Camera`` on a network.
    """

    def __init__(self, port: str | None = None, model: str | None = None, clock: Clock = SYSTEM_CLOCK) -> None:
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
        """Set and verify the exposure, raw format and destination."""
        self._settings = None
        with self._speaking() as camera:
            self._apply(camera, settings)
        self._settings = settings

    def shutter_speeds(self) -> tuple[float, ...]:
        """Return the shutter times in libgphoto2's list, seconds, rising; empty if it shows none."""
        with self._speaking() as camera:
            setting = first_of(lambda name: _setting(camera, name), SHUTTER)
            numbers = (number_of(label) for label in (setting.choices if setting is not None else ()))
            return tuple(sorted({number for number in numbers if number is not None}))

    def supplies(self) -> Supplies:
        """Return what is left of battery and card, as far as libgphoto2 shows it.

        See `drivers.camera.ReportsSupplies`.
        """
        with self._speaking() as camera:
            power = _text(camera, ("acpower",))
            target = first_of(lambda name: _setting(camera, name), TARGET)
            # What is not set yet, `configure` sets.
            to_host = target is None or any(label in (target.value, *target.choices) for label in HOST_TARGETS)
            return Supplies(
                battery_level(_text(camera, ("batterylevel",))),
                {"On": True, "Off": False}.get(power),
                _card_free_bytes(camera),
                to_host,
            )

    def expose(self) -> datetime:
        """Release the shutter; return when it was released, UTC, once libgphoto2 names the file.

        A frame that was exposed before and has not been downloaded is dropped.
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
            path = camera.capture(gp.GP_CAPTURE_IMAGE)
            self._exposed = path, released_at
            if path.name.lower().endswith(_NOT_RAW_SUFFIXES):
                self._forget(camera)
                raise DeviceRefused(
                    f"the camera made {path.name}, no raw file, though it was asked for one; set raw alone by hand"
                )
        return released_at

    def download(self, into: BinaryIO) -> CapturedFrame:
        """Write the raw file of the frame exposed last, whole and unchanged, to `into`.

        It may be tried again where writing failed; after a fault of the connection libgphoto2 has forgotten the frame.
        """
        if self._exposed is None:
            raise DeviceError("no exposed frame waits in the camera to be downloaded; expose it again")
        path, released_at = self._exposed
        with self._speaking() as camera:
            # The bytes belong to `file` and go with it.
            file = self._file(camera, path)
            size = into.write(file.get_data_and_size())
            self._forget(camera)
        return CapturedFrame(path.name, size, released_at)

    def close(self) -> None:
        """Give the camera back to its user; a second call does nothing."""
        self._closed = True
        self._drop()

    def _file(self, camera: gphoto2.Camera, path: gphoto2.CameraFilePath) -> gphoto2.CameraFile:
        """Return a file that waits in the camera; one that is busy is asked again."""
        gp = library()
        for _ in range(BUSY_TRIES - 1):
            try:
                return camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)
            except gp.GPhoto2Error as error:
                if error.code != gp.GP_ERROR_CAMERA_BUSY:
                    raise
            self._clock.sleep(BUSY_PAUSE_S)
        return camera.file_get(path.folder, path.name, gp.GP_FILE_TYPE_NORMAL)

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
        for name, label in plan(lambda name: _setting(camera, name), settings).items():
            self._set(camera, name, label)

    def _set(self, camera: gphoto2.Camera, name: str, label: str) -> None:
        gp = library()
        widget = camera.get_single_config(name)
        if is_same(_shown(widget.get_value()), label):
            return
        widget.set_value(float(label) if widget.get_type() == gp.GP_WIDGET_RANGE else label)
        camera.set_single_config(name, widget)
        end = self._clock.monotonic() + SETTLE_LIMIT_S
        while True:
            came = _shown(camera.get_single_config(name).get_value())
            if is_same(came, label):
                return
            if self._clock.monotonic() >= end:
                raise DeviceRefused(f"{name} was set to {label}, and the camera reports {came}; set it by hand")
            self._clock.sleep(_LOOK_AGAIN_S)


def library():
    """Return python-gphoto2."""
    try:
        import gphoto2
    except ImportError as error:
        raise ConfigurationError("python-gphoto2 is not installed; install it: pip install gphoto2") from error
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
            return DeviceError(f"{what}; switch the camera off and on, {RUN_AGAIN}")


def _text(camera: gphoto2.Camera, names: Iterable[str]) -> str:
    found = (_setting(camera, name) for name in names)
    return next((setting.value for setting in found if setting is not None and setting.value), "")


def _setting(camera: gphoto2.Camera, name: str) -> BodySetting | None:
    gp = library()
    try:
        widget = camera.get_single_config(name)
    except gp.GPhoto2Error as error:
        if error.code != gp.GP_ERROR_BAD_PARAMETERS:
            raise
        return None
    kind = widget.get_type()
    choices: tuple[str, ...] = ()
    bounds: tuple[float, float] | None = None
    if kind in (gp.GP_WIDGET_RADIO, gp.GP_WIDGET_MENU):
        choices = tuple(widget.get_choice(index) for index in range(widget.count_choices()))
    elif kind == gp.GP_WIDGET_RANGE:
        least, greatest, _ = widget.get_range()
        bounds = least, greatest
    return BodySetting(name, _shown(widget.get_value()), choices, bounds, bool(widget.get_readonly()))


def _shown(value: object) -> str:
    """Return a value as text; a number as short as it is true."""
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _card_free_bytes(camera: gphoto2.Camera) -> int | None:
    """Return the room on all cards together; None where none tells it."""
    gp = library()
    try:
        stores = camera.get_storageinfo()
    except gp.GPhoto2Error as error:
        if error.code != gp.GP_ERROR_NOT_SUPPORTED:
            raise
        return None
    free = [1024 * store.freekbytes for store in stores if store.fields & gp.GP_STORAGEINFO_FREESPACEKBYTES]
    return sum(free) if free else None
